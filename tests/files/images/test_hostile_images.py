"""Files of a few bytes that promise gigabytes, nest without end or are cut short: one sentence each, under 1 GB.

All of them are read in one child process, whose greatest use of memory is measured at its end.
"""

import io
import itertools
import json
import struct
import sys
import zipfile
import zlib

import numpy as np
import pytest
from builders import own_memory
from PIL import Image

CHILD = """
import json, resource, sys
from pathlib import Path
from ipjax.bop import alignments, dataset, detections
from ipjax.files.images import run_lengths
from ipjax.files.cameras.reading import read_camera
from ipjax.onboarding.foreground import read_photo
from ipjax.files.images.candidates import read_candidates
from ipjax.files.images.depth import read_depth
from ipjax.files.images.masks import read_mask
from ipjax.files.images.opening import read_rgb, read_size
from ipjax.files.settings import read_config

def read_rle(path):
    return run_lengths.decode_rle(json.loads(Path(path).read_text()))

def read_truths(path):
    scene = Path(path).parent / "bop" / "test" / "000001"
    scene.mkdir(parents=True, exist_ok=True)
    (scene / "scene_gt.json").write_text(Path(path).read_text())
    return dataset.Dataset(scene.parent.parent).truths(1, 0)

readers = dict(rgb=read_rgb, depth=read_depth, mask=read_mask, camera=read_camera, photo=read_photo, rle=read_rle,
               candidates=read_candidates, detections=detections.read_detections, settings=read_config,
               alignment=alignments.read_alignment, truths=read_truths, size=read_size)
told = {}
for path in sorted(Path(sys.argv[1]).iterdir()):
    if not path.is_file():
        continue
    kind = path.name.split("-")[0]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        readers[kind](path)
        said = ["nothing", ""]
    except Exception as error:
        said = [type(error).__name__ if not isinstance(error, ValueError) else "ValueError", str(error)]
    told[path.name] = [*said, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024]
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"told": told, "peak": peak}))
"""


def png(width: int, height: int, *, rows: bytes = b"", kind: int = 2, bits: int = 8, extra: bytes = b"") -> bytes:
    """A PNG that promises a size, whatever rows it has."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + extra + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def bomb_of_text() -> bytes:
    data = b"comment\0\0" + zlib.compress(bytes(300 * 2**20), 9)
    return struct.pack(">I", len(data)) + b"zTXt" + data + struct.pack(">I", zlib.crc32(b"zTXt" + data))


def jpeg(width: int, height: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (8, 8)).save(buffer, "JPEG")
    data = bytearray(buffer.getvalue())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def tiff(width: int, height: int, bits: int, kind: int) -> bytes:
    """A TIFF of one strip that promises a size, with eight bytes of it."""
    entries = [
        (256, width),
        (257, height),
        (258, bits),
        (259, 1),
        (262, 1),
        (273, 8),
        (277, 1),
        (278, height),
        (279, 8),
    ]
    block = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in [*entries, (279, 8), (339, kind)])
    return b"II*\0" + struct.pack("<I", 16) + bytes(8) + struct.pack("<H", 10) + block + bytes(4)


def npy(header: str) -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def aliases(separator: str) -> str:
    names = "abcdefghij"
    lines = [f"{names[0]}: &{names[0]} [x, x, x, x, x, x, x, x, x]"]
    lines += [f"{b}: &{b} [{', '.join(['*' + a] * 9)}]" for a, b in itertools.pairwise(names)]
    return separator.join(lines)


def pickled() -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.array([{}], dtype=object), allow_pickle=True)
    return buffer.getvalue()


def zipped() -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, a=np.zeros(3))
    return buffer.getvalue()


def bomb_of_masks() -> bytes:
    """A zip file of some hundred kilobytes that unpacks to 400 MB of masks."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("masks.npy", "w") as file:
        file.write(npy("{'descr': '|u1', 'fortran_order': False, 'shape': (400, 1024, 1024)}"))
        for _ in range(400):
            file.write(bytes(2**20))
    return buffer.getvalue()


def polygon_of(corners: int) -> bytes:
    """Edges that all go from one side of a wide image to the other."""
    return json.dumps([{"segmentation": [[0, 0, 4000, 9] * (corners // 2)], "height": 10, "width": 4000}]).encode()


def photograph(size: int = 400) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()


K = {"cam_K": [600, 0, 320, 0, 600, 240, 0, 0, 1]}
FILES = {  # what reads it is the first part of the name; words of the sentence
    "rgb-header.png": (png(60_000, 60_000), "pixels"),
    "rgb-moderate.png": (png(9_000, 9_000), "9000 × 9000 pixels would take"),
    "rgb-full.png": (png(8_000, 8_000, rows=bytes(8_000 * 24_001)), "8000 × 8000 pixels would take"),
    "rgb-short.png": (png(300, 300, rows=bytes(1000)), "broken image"),
    "rgb-cut.png": (photograph()[:100_000], "broken image"),
    "rgb-text.png": (png(10, 10, extra=bomb_of_text(), rows=bytes(310)), "broken image"),
    "rgb-header.jpg": (jpeg(65_500, 65_500), "pixels"),
    "rgb-header.gif": (b"GIF89a" + struct.pack("<HH", 65_535, 65_535) + bytes(30), "pixels|broken|not an image"),
    "rgb-header.bmp": (
        b"BM" + struct.pack("<IIIIiiHHIIiiII", 90, 0, 54, 40, 12_000, 12_000, 1, 24, 0, 36, 0, 0, 0, 0) + bytes(36),
        "would take",
    ),
    "rgb-header.ppm": (b"P6 9000 9000 255\n" + bytes(30), "would take"),
    "rgb-program.png": (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "not an image"),
    "photo-header.png": (png(9_000, 9_000), "would take"),
    "photo-header.jpg": (jpeg(65_500, 65_500), "pixels"),
    "mask-header.png": (png(12_000, 9_000, kind=0, bits=1), "would take"),
    "mask-cut.png": (photograph()[:60_000], "broken image"),
    "depth-header.tif": (tiff(60_000, 60_000, 64, 3), "would take"),
    "depth-cut.tif": (tiff(600, 600, 64, 3), "cannot be read"),
    "depth-wide.tif": (tiff(9_000, 9_000, 16, 1), "would take"),
    "depth-header.png": (png(9_000, 9_000, kind=0, bits=16), "would take"),
    "depth-promise.npy": (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (99999, 999999)}"), "header promises"),
    "depth-overflow.npy": (npy(f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**40}, {2**40})}}"), "promises"),
    "depth-string.npy": (npy("{'descr': '<U99999999', 'fortran_order': False, 'shape': (9, 9)}"), "promises"),
    "depth-nested.npy": (npy("(" * 110), "not a readable npy"),
    "depth-object.npy": (pickled(), "Python objects"),
    "depth-zip.npy": (zipped(), "not a readable npy"),
    "camera-nested.json": (b"[" * 200_000, "nested too deeply"),
    "camera-deep.json": (b'{"a":' * 99_999, "nested too deeply"),
    "camera-wide.json": (b'{"a": [' + b"[]," * 5_000_000 + b"[]]}", "would take"),
    "camera-dictionaries.json": (b'{"a": [' + b"{}," * 3_000_000 + b"{}]}", "would take"),
    "camera-digits.json": (json.dumps(K).replace("600", "6" * 5_000, 1).encode(), "not valid JSON"),
    "camera-large.json": (json.dumps({"cam_K": [10**400] * 9}).encode(), "must be numbers"),
    "camera-laughs.yaml": (aliases("\n").encode(), "more than 50,000 values"),
    "camera-nested.yaml": (b"a: " + b"[" * 50_000, "nested too deeply"),
    "camera-dashes.yaml": (b"- " * 50_000, "nested too deeply"),
    "camera-many.yaml": (b"a: [" + b"1," * 500_000 + b"1]", "more than 50,000 values"),
    "camera-object.yaml": (b"!!python/object/apply:os.getcwd []", "could not determine a constructor"),
    "camera-binary.yaml": (bytes(range(256)) * 10, "not a text file"),
    "detections-nested.json": (b"[" * 200_000, "nested too deeply"),
    "candidates-nested.json": (b"[" * 200_000, "nested too deeply"),
    "candidates-object.npy": (pickled(), "Python objects"),
    "candidates-promise.npz": (bomb_of_masks(), "would take"),
    "candidates-zip.npz": (zipped(), "it has no masks"),
    "candidates-edges.json": (polygon_of(300_000), "would take"),
    "candidates-endless.json": (
        json.dumps([{"size": [9, 9], "counts": "o" * 5_000_000}]).encode(),
        "no image has pixels for",
    ),
    "settings-nested.json": (b"[" * 200_000, "nested too deeply"),
    "alignment-nested.json": (b"[" * 200_000, "nested too deeply"),
    "truths-nested.json": (b'{"0":' * 200_000, "nested too deeply"),
    "rle-promise.json": (json.dumps({"size": [20_000, 20_000], "counts": [400_000_000]}).encode(), "would take"),
    "rle-overflow.json": (json.dumps({"size": [2, 2], "counts": [2**62, 2**62, 2**62, 2**62, 4]}).encode(), "cover"),
    "size-header.png": (png(60_000, 60_000), "pixels"),
}


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """What the child said of every file, and the most memory that it took, in MB."""
    folder = tmp_path_factory.mktemp("hostile")
    for name, (data, _) in FILES.items():
        (folder / name).write_bytes(data)
    done = own_memory.run([sys.executable, "-c", CHILD, str(folder)], timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", FILES)
def test_one_sentence_and_little_memory(read, name):
    import re

    kind, said, grown = read["told"][name]
    assert kind == "ValueError", f"{kind}: {said}"
    assert re.search(FILES[name][1], said) and "\n" not in said and len(said) < 400, said
    assert name.startswith("rle") or "bop" in said or name in said, said
    assert grown < 400, f"{grown:.0f} MB"


def test_under_a_gigabyte_in_all(read):
    assert read["peak"] < 1000, f"{read['peak']:.0f} MB"

"""Mesh files that promise, repeat or point to more than they are: one sentence each, and under one gigabyte."""

import json
import struct
import sys
import zlib

import numpy as np
import pytest
from builders import own_memory
from builders.mesh_files import FACES, UV, VERTICES, Gltf, encode, pack_glb, write_obj
from PIL import Image

LIMIT = 1_000_000_000  # bytes of memory, the interpreter and its packages with them

# Reads every file that it is given and says what became of each, and how much memory there was at most so far.
CHILD = """
import json, resource, sys, warnings
from pathlib import Path
from ipjax.files.meshes.loading import load_mesh

answers = {}
for name in sys.argv[1:]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            answer = f"read: {len(load_mesh(name).faces)} faces"
        except ValueError as error:
            answer = f"refused: {error}"
    unit = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    answers[Path(name).name] = [answer, [str(warning.message) for warning in caught], peak]
print(json.dumps(answers))
"""


def blank_png(side: int, shade: int = 0) -> bytes:
    """A PNG of one colour; of more than 4096 a side it has only the first rows, for it is not to be decoded."""
    row = b"\0" + bytes([shade]) * (3 * side)
    body = zlib.compress(row * (side if side <= 4096 else 16), 1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def textured(*images: bytes, repeat: float = 1.0) -> Gltf:
    """A box whose faces share these images."""
    gltf = Gltf()
    for i, image in enumerate(images):
        material = gltf.skin(image)
        gltf.draw(FACES[i % 12 : i % 12 + 1], None, material, TEXCOORD_0=gltf.uv(UV * repeat))
    return gltf


def plain() -> Gltf:
    """A box."""
    gltf = Gltf()
    gltf.draw()
    return gltf


def edited(change) -> bytes:
    """A box whose tree was changed."""
    gltf = plain()
    change(gltf.tree)
    return gltf.glb()


def chain(tree: dict) -> None:
    """Each node holds the next twice: a million boxes in thirty lines."""
    tree["nodes"] = [{"children": [i + 1, i + 1]} for i in range(20)] + [{"mesh": 0}]


def crowd(tree: dict) -> None:
    """Every node shows a mesh of twelve faces."""
    tree["nodes"] = [{"mesh": 0}] * 300_000
    tree["scenes"] = [{"nodes": list(range(300_000))}]


def heavy(tree: dict) -> None:
    """A mesh of nine million vertices that are nowhere stored."""
    tree["accessors"][0] = {"componentType": 5126, "count": 9_000_000, "type": "VEC3"}


def many(tree: dict) -> None:
    """A thousand parts, each with its own million of vertices that are nowhere stored."""
    tree["accessors"][0] = {"componentType": 5126, "count": 1_000_000, "type": "VEC3"}
    tree["meshes"][0]["primitives"] *= 1000


def instances(tree: dict) -> None:
    """As many copies as an accessor of zeros has rows."""
    tree["accessors"].append({"componentType": 5126, "count": 8_000_000, "type": "VEC3"})
    where = {"attributes": {"TRANSLATION": len(tree["accessors"]) - 1}}
    tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": where}


def sparse(count: int, index: int):
    def change(tree: dict) -> None:
        view = {"bufferView": 1, "componentType": 5125}
        tree["accessors"][0]["sparse"] = {"count": count, "indices": view, "values": {"bufferView": 0}}
        tree["accessors"][0]["count"] = index

    return change


def accessor(**values):
    return lambda tree: tree["accessors"][0].update(values)


def view(**values):
    return lambda tree: tree["bufferViews"][0].update(values)


def uri(text: str):
    return lambda tree: tree["buffers"][0].update(uri=text)


def ply(text: str, rows: bytes = b"") -> bytes:
    return b"ply\nformat " + text.encode() + b"\nend_header\n" + rows


XYZ = "property float x\nproperty float y\nproperty float z\n"
BIG = "binary_little_endian 1.0\nelement vertex 3\n" + XYZ
TRIANGLE = np.eye(3, dtype="<f4").tobytes()

# name: the bytes, and a word of the sentence that refuses them; None where the file is read.
FILES = {
    "bomb.glb": (lambda: textured(blank_png(16384)).glb(), "pixels"),
    "bombs.glb": (lambda: textured(*(blank_png(8000, i) for i in range(10))).glb(), "pixels together"),
    "large_images.glb": (lambda: textured(*(blank_png(4096, i) for i in range(4))).glb(), None),
    "repeats.glb": (lambda: textured(blank_png(1024), blank_png(1000), repeat=8).glb(), None),
    "repeats_large.glb": (lambda: textured(blank_png(4096), blank_png(4000), repeat=8).glb(), None),
    "repeats_far.glb": (lambda: textured(blank_png(512), encode(), repeat=1e9).glb(), None),
    "shaded.glb": (
        lambda: edited(lambda tree: None),
        None,
    ),
    "count.glb": (lambda: edited(accessor(count=10**12)), "accessor"),
    "count_negative.glb": (lambda: edited(accessor(count=-1)), "accessor"),
    "count_text.glb": (lambda: edited(accessor(count="9" * 5000)), "accessor"),
    "zeros.glb": (lambda: edited(heavy), "memory|faces"),
    "zeros_many.glb": (lambda: edited(many), "memory|faces"),
    "offset.glb": (lambda: edited(accessor(byteOffset=2**31 - 1)), "bytes|byteOffset"),
    "view_long.glb": (lambda: edited(view(byteLength=2**30)), "buffer view"),
    "view_before.glb": (lambda: edited(view(byteOffset=-8)), "byteOffset"),
    "stride.glb": (lambda: edited(view(byteStride=1)), "byteStride"),
    "buffer_long.glb": (lambda: edited(lambda tree: tree["buffers"][0].update(byteLength=2**30)), "buffer"),
    "sparse_far.glb": (lambda: edited(sparse(9, 24)), "sparse|names"),
    "sparse_many.glb": (lambda: edited(sparse(10**9, 24)), "count"),
    "twice.glb": (lambda: edited(chain), "two parents"),
    "circle.glb": (lambda: edited(lambda tree: tree.update(nodes=[{"children": [0], "mesh": 0}])), "circle"),
    "crowd.glb": (lambda: edited(crowd), "faces|memory"),
    "instances.glb": (lambda: edited(instances), "instances"),
    "huge_place.glb": (lambda: edited(lambda tree: tree["nodes"][0].update(scale=[1e300] * 3)), "wide|finite"),
    "index.glb": (lambda: edited(lambda tree: tree["nodes"][0].update(mesh=7)), "meshes 7 of 1"),
    "wrong_types.glb": (lambda: edited(lambda tree: tree.update(nodes={"0": []})), "no list"),
    "deep.gltf": (lambda: b'{"asset":' * 100_000 + b"1" + b"}" * 100_000, "JSON"),
    "wide.gltf": (lambda: b'{"nodes":[' + b"{}," * 4_000_000 + b"{}]}", "JSON"),
    "json_length.glb": (lambda: struct.pack("<4s4I", b"glTF", 2, 100, 2**32 - 1, 0x4E4F534A) + b"{}", "promises"),
    "data_uri.glb": (lambda: edited(uri("data:;base64," + "A" * 4_000_001)), "data URI"),
    "outside.glb": (lambda: edited(uri("../../../etc/passwd")), "outside"),
    "device.glb": (lambda: edited(uri("/dev/zero")), "outside|missing"),
    "web.glb": (lambda: edited(uri("http://example.org/box.bin")), "missing|outside"),
    "count.ply": (lambda: ply("ascii 1.0\nelement vertex 4000000000\n" + XYZ), "promises"),
    "list.ply": (
        lambda: ply(BIG + "element face 1\nproperty list int int vertex_indices", TRIANGLE + b"\xff\xff\xff\x7f"),
        "list",
    ),
    "list_negative.ply": (
        lambda: ply(BIG + "element face 1\nproperty list int int vertex_indices", TRIANGLE + b"\xff\xff\xff\xff"),
        "list",
    ),
    "properties.ply": (lambda: ply(BIG + "".join(f"property float p{i}\n" for i in range(5000))), "properties|header"),
    "line.ply": (lambda: ply("ascii 1.0\nelement vertex 3\n" + XYZ + "element face 1\nproperty list int int "
                             "vertex_indices", b"1 " * 6_000_000), "million characters"),
    "polygon.obj": (lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + b" 1" * 3_900_000, "characters"),
    "line.obj": (lambda: b"v " + b"1" * 20_000_000, "million characters"),
    "blank.obj": (lambda: b"\n" * 20_000_000, "empty"),
    "numbers.obj": (lambda: b"v" + b" 1" * 3_900_000 + b"\nf 1 1 1", "characters"),
    "libraries.obj": (lambda: b"mtllib a.mtl\n" * 50_000 + b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", None),
    "materials.obj": (
        lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"".join(b"usemtl %d\nf 1 2 3\n" % i for i in range(20_000)),
        None,
    ),
    "far_index.obj": (lambda: b"v 0 0 0\nf 1 2 99999999999999999999999", "whole numbers|names"),
    "count.stl": (lambda: bytes(80) + struct.pack("<I", 2**31) + bytes(50), "promises"),
    "digits.stl": (lambda: b"solid a\nfacet\n" + b"vertex " + b"1" * 20_000_000, "three a face"),
    "text.stl": (lambda: b"solid a\nfacet\n" + b"vertex 1 2 3\n" * 400_001, "three a face"),
}  # fmt: skip


def write(folder) -> list:
    """All files, and what they name."""
    for name, (make, _) in FILES.items():
        data = make()
        (folder / name).write_bytes(data)
        assert len(data) < 64_000_000
    # A shade that varies, over a large image: baked face by face.
    gltf = Gltf()
    light = np.random.default_rng(0).random((24, 3))
    gltf.draw(material=gltf.skin(blank_png(4096)), TEXCOORD_0=gltf.uv(), COLOR_0=gltf.put(light.astype("<f4")))
    gltf.save(folder / "shaded.glb")
    (folder / "skin.mtl").write_text("newmtl m\nmap_Kd skin.png\n")
    (folder / "skin.png").write_bytes(blank_png(16384))
    write_obj(folder / "skin.obj", head="mtllib skin.mtl\nusemtl m")
    (folder / "up.mtl").write_text("newmtl m\nmap_Kd ../../../../etc/passwd\n")
    write_obj(folder / "up.obj", head="mtllib up.mtl\nusemtl m")
    # A JPEG whose header promises what its body has not.
    jpeg = bytearray(encode("JPEG", Image.new("RGB", (64, 64))))
    at = jpeg.index(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = struct.pack(">2H", 65000, 65000)
    (folder / "jpeg.glb").write_bytes(textured(bytes(jpeg)).glb())
    return [*FILES, "skin.obj", "up.obj", "jpeg.glb"]


WORDS = {name: words for name, (_, words) in FILES.items()} | {
    "skin.obj": "pixels",
    "up.obj": "outside",
    "jpeg.glb": "pixels",
}


def find_faults(name: str, words: str | None, answer: str, warned: list[str], peak: int) -> list[str]:
    """What is wrong with the answer to one file, in words."""
    faults = []
    if peak >= LIMIT:
        faults.append(f"{name}: {peak / 1e6:.0f} MB")
    if any("\n" in sentence or len(sentence) > 500 for sentence in (answer, *warned)):
        faults.append(f"{name}: more than a sentence: {answer[:200]!r}")
    wanted = "read: " if words is None else f"refused: {name}: "
    if not answer.startswith(wanted) or (words is not None and not any(word in answer for word in words.split("|"))):
        faults.append(f"{name}: not {wanted!r} with {words}: {answer}")
    return faults


def test_hostile_files_are_refused_in_a_sentence_or_read_small(tmp_path):
    """All in one process, one after the other: its memory at its largest is that of the worst of them."""
    names = [str(tmp_path / name) for name in write(tmp_path)]
    done = own_memory.run([sys.executable, "-c", CHILD, *names], timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    answers = json.loads(done.stdout)
    assert set(answers) == set(WORDS) and len(answers) > 40
    assert [fault for name, answer in answers.items() for fault in find_faults(name, WORDS[name], *answer)] == []


def test_finds_what_is_wrong_with_an_answer():
    assert find_faults("a.glb", "pixels", "refused: a.glb: too many pixels", [], 1) == []
    assert find_faults("a.glb", "pixels", "refused: a.glb: KeyError", [], 1)
    assert find_faults("a.glb", "pixels", "read: 2 faces", [], 1)
    assert find_faults("a.glb", None, "refused: a.glb: too many pixels", [], 1)
    assert find_faults("a.glb", None, "read: 2 faces", ["Traceback\n"], 1)
    assert find_faults("a.glb", None, "read: 2 faces", [], LIMIT)


def test_there_is_one_budget_and_it_can_be_set(tmp_path, monkeypatch):
    from ipjax.files.meshes.loading import load_mesh

    path = tmp_path / "box.glb"
    path.write_bytes(plain().glb())
    assert len(load_mesh(path).faces) == 12
    gltf = Gltf()
    gltf.draw(np.arange(60_000) % 24)
    gltf.save(path)
    monkeypatch.setenv("IPJAX_FILE_BUDGET", "1")
    with pytest.raises(ValueError, match="IPJAX_FILE_BUDGET"):
        load_mesh(path)
    monkeypatch.setenv("IPJAX_FILE_BUDGET", "100")
    assert len(load_mesh(path).faces) == 20_000


def test_a_glb_of_another_order_is_refused(tmp_path):
    text = json.dumps({"asset": {"version": "2.0"}}).encode()
    data = bytearray(pack_glb(text, VERTICES.astype("<f4").tobytes()))
    data[16:20] = b"BIN\0"
    (tmp_path / "box.glb").write_bytes(data)
    with pytest.raises(ValueError, match="glTF JSON"):
        load_hostile(tmp_path / "box.glb")


def load_hostile(path):
    from ipjax.files.meshes.loading import load_mesh

    return load_mesh(path)

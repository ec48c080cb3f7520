"""Files of weights and objects that promise more than they hold: refused in a sentence, before memory is taken."""

import copy
import dataclasses
import json
import struct
import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from builders import own_memory
from builders.objects import make_object
from builders.weight_files import Program, field, onnx_tensor, state_dict, write_pth

from ipjax.files.objects.loading import load
from ipjax.files.objects.pictures import LARGEST_SIDE, PICTURE_SIDE
from ipjax.files.objects.saving import save
from ipjax.files.storage.budget import check_tensors, read_safetensors_header
from ipjax.files.weights.reading import read_weights

MEGABYTE = 2**20
LARGE = 2**18  # numbers in a megabyte


def views_of_one_storage(path: Path) -> None:
    views = [(f"t{i}", "FloatStorage", "0", LARGE, 0, (LARGE,), (1,)) for i in range(300)]
    write_pth(path, state_dict(*views), {"0": bytes(MEGABYTE)})


def entries_over_one_another(path: Path) -> None:
    tensors = [(f"t{i}", "FloatStorage", str(i), LARGE, 0, (1,), (1,)) for i in range(300)]
    write_pth(path, state_dict(*tensors), {"0": bytes(MEGABYTE)})
    with zipfile.ZipFile(path, "a") as archive:
        for i in range(1, 300):
            again = copy.copy(archive.NameToInfo["archive/data/0"])
            again.filename = again.orig_filename = f"archive/data/{i}"
            archive.filelist.append(again)
            archive.NameToInfo[again.filename] = again
        archive._didModify = True


def objects_of_one_byte(path: Path) -> None:
    write_pth(path, Program().add(b"]" * (8 * MEGABYTE), b".").code, {})


def long_description(path: Path) -> None:
    text = json.dumps({f"t{i}": {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]} for i in range(200_000)}).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text)


def description_beyond_the_end(path: Path) -> None:
    path.write_bytes(struct.pack("<Q", 2**62) + b"{}")


def many_sides(path: Path) -> None:
    path.write_bytes(field(7, field(5, field(1, b"\x7f" * MEGABYTE) + field(2, 1) + field(8, b"x") + field(9, b""))))


def many_operations(path: Path) -> None:
    path.write_bytes(field(7, onnx_tensor("x", np.zeros((1, 1))) + field(1, b"") * (2 * MEGABYTE)))


def many_inputs(path: Path) -> None:
    path.write_bytes(field(7, field(1, field(1, b"") * (4 * MEGABYTE))))


HOSTILE = [
    (views_of_one_storage, "a.pth", "its tensors would take 300 MB of memory, but the file has only 2 MB"),
    (entries_over_one_another, "a.pth", "refused|differ"),
    (objects_of_one_byte, "a.pth", "data.pkl is too large"),
    (long_description, "a.safetensors", "bytes of description"),
    (description_beyond_the_end, "a.safetensors", "bytes of description"),
    (many_sides, "a.onnx", "more than eight sides"),
    (many_operations, "a.onnx", "more than 100,000 operations"),
    (many_inputs, "a.onnx", "more than 1,000 inputs"),
    (long_description, "a.ipjax", "bytes of description"),
]

READ = """
import json, resource, sys
from ipjax.files.objects.loading import load
from ipjax.files.weights.reading import read_weights
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform != "darwin" else 2**20)
for path in sys.argv[1:]:
    before = peak()
    try:
        (load if path.endswith(".ipjax") else read_weights)(path)
        said = "it was read"
    except ValueError as error:
        said = str(error)
    print(json.dumps([said, peak() - before]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no resource module")
def test_hostile_files_take_no_memory_and_one_sentence(tmp_path):
    paths = []
    for i, (make, name, _) in enumerate(HOSTILE):
        (tmp_path / str(i)).mkdir()
        paths.append(tmp_path / str(i) / name)
        make(paths[-1])
    command = [sys.executable, "-c", READ, *map(str, paths)]
    done = own_memory.run(command, timeout=120)
    assert done.returncode == 0, done.stderr
    for path, (_, _, words), line in zip(paths, HOSTILE, done.stdout.splitlines(), strict=True):
        said, megabytes = json.loads(line)
        assert any(word in said for word in words.split("|")) and "\n" not in said and str(path) in said, said
        assert megabytes < 100, (path.name, said, megabytes)


def test_shared_tensors_are_still_read(tmp_path):
    """Two names of one tensor, as models tie them, and a slice of it; all lie in the file once."""
    values = np.arange(LARGE, dtype=np.float32)
    tied = [(name, "FloatStorage", "0", LARGE, 0, (512, 512), (512, 1)) for name in ("a", "b")]
    path = write_pth(tmp_path / "a.pth", state_dict(*tied, ("c", "FloatStorage", "0", LARGE, 5, (3,), (2,))), {})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("archive/data/0", values.tobytes())
    found = read_weights(path)
    assert np.array_equal(found["a"], values.reshape(512, 512)) and np.array_equal(found["c"], [5, 7, 9])
    assert np.shares_memory(found["a"], found["b"])
    check_tensors(path, 2 * path.stat().st_size)


def test_a_large_object_is_refused_before_it_is_read(tmp_path, monkeypatch):
    path = save(tmp_path / "mug.ipjax", *make_object())
    assert 0 < read_safetensors_header(path) < path.stat().st_size
    monkeypatch.setenv("IPJAX_FILE_BUDGET", "1")
    load(path)  # some kilobytes
    templates, info = make_object()
    large = dataclasses.replace(info, vertices=np.zeros((600_000, 3), np.float32), colours=None)
    path = save(tmp_path / "big.ipjax", templates, large)
    with pytest.raises(ValueError, match=r"big\.ipjax: the object would take 7 MB .* more than the 1 MB"):
        load(path)
    monkeypatch.setenv("IPJAX_FILE_BUDGET", "8")
    load(path)


def test_a_picture_that_promises_much_is_none(tmp_path):
    _, code = cv2.imencode(".jpg", np.full((16, 16, 3), 90, np.uint8))
    honest = code.tobytes()
    start = honest.index(b"\xff\xc0") + 5  # of the frame's height and width
    bomb = honest[:start] + struct.pack(">HH", 60_000, 60_000) + honest[start + 4 :]
    templates, info = make_object()
    views = len(templates.camera_from_object.scale)
    told = dataclasses.replace(info, pictures=[bomb, b"no picture", *[honest] * (views - 2)])
    _, again = load(save(tmp_path / "mug.ipjax", templates, told))
    assert again.picture(0) is None and again.picture(1) is None
    assert again.picture(2).shape == (16, 16, 3) and abs(int(again.picture(2).mean()) - 90) < 3
    assert PICTURE_SIDE < LARGEST_SIDE

"""Files appear whole or not at all, whoever else writes them, and everything that writes goes through one writer."""

import ast
import os
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import ipjax.files.storage.writing as module
from ipjax.files.storage.writing import append_json, publish, read_lines, write_bytes, write_text, writing

ROOT = Path(__file__).resolve().parents[3]


def test_a_file_is_replaced_as_a_whole_and_nothing_lies_beside_it(tmp_path):
    path = tmp_path / "a.txt"
    for text in ("first\n", "second µ\r\n"):
        assert write_text(path, text) == path
        assert path.read_bytes() == text.encode()
    with writing(path) as temporary:
        assert temporary.parent == path.parent and temporary.suffix == ".txt"
        temporary.write_text("third")
        assert path.read_bytes() == "second µ\r\n".encode()
    assert path.read_text() == "third" and list(tmp_path.iterdir()) == [path]


def test_what_fails_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "a.bin"
    write_bytes(path, b"old")

    def fail():
        with writing(path) as temporary:
            temporary.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    (tmp_path / "folder").mkdir()
    for bad in (tmp_path / "none" / "a", tmp_path / "folder"):
        with pytest.raises(OSError) as caught:
            write_bytes(bad, b"new")
        assert caught.value.filename == str(bad)  # the name that the user knows
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.bin", "folder"]
    assert write_bytes(tmp_path / "none" / "a", b"new", parents=True).read_bytes() == b"new"


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
def test_everybody_may_read_what_the_umask_lets_them(tmp_path):
    old = os.umask(0o027)
    try:
        assert write_bytes(tmp_path / "a", b"").stat().st_mode & 0o777 == 0o640
    finally:
        os.umask(old)


@given(st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1, max_size=60))
def test_any_name_can_be_written(tmp_path_factory, name):
    if name in (".", "..") or len(name.encode()) > 255:
        return
    folder = tmp_path_factory.mktemp("names")
    write_bytes(folder / name, b"x")
    assert [p.name for p in folder.iterdir()] == [name]


def test_many_writers_of_one_name_never_show_a_half(tmp_path):
    path, sizes, seen = tmp_path / "a", [1 + 700_000 * i for i in range(4)], set()
    write_bytes(path, b"")

    def write(size):
        for _ in range(8):
            write_bytes(path, bytes([size % 251]) * size)

    threads = [threading.Thread(target=write, args=(size,)) for size in sizes]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        data = path.read_bytes()
        assert len(set(data)) <= 1
        seen.add(len(data))
    assert seen <= {0, *sizes} and list(tmp_path.iterdir()) == [path]


# What writes a file by itself: a mode that writes, or a function that does.
WRITERS = {"write_text", "write_bytes", "imwrite", "save", "savez", "savez_compressed", "savefig", "save_file", "dump"}
MAY = {  # by package, and why
    ("ipjax/files/storage", "write_bytes"): "the writer itself",
    ("ipjax/files/storage", "os.replace"): "the writer itself",
    ("ipjax/files/storage", "os.rename"): "the writer of whole folders",
    ("ipjax/capture/views", "np.save"): "the child's job, in a folder of its own",
    ("ipjax/capture/views", "np.savez"): "the child's answer, in a folder of its own",
    ("ipjax/capture/views", "write_text"): "the child's job, in a folder of its own",
    ("ipjax/files/storage", "open"): "a journal, a line at a time",
    (
        "ipjax/files/weights",
        "open",
    ): "a download that goes on where it stopped; a wheel unpacked in its own folder",
    ("ipjax/files/meshes", "save"): "a picture, into memory",
    ("ipjax/rendering", "np.save"): "the child's job, in a folder of its own",
    ("ipjax/rendering", "np.savez"): "the child's job, in a folder of its own",
    ("ipjax/rendering", "write_text"): "the child's job, in a folder of its own",
    ("ipjax/rendering", "open"): "what the child says, in a folder of its own",
    ("ipjax/robot", "save"): "an animation, into memory",
    ("ipjax/bop", "open"): "a journal, a line at a time",
}


def find_writers(source: str) -> list[str]:
    """Calls that write a file under its last name, unless they write to what `writing` gave them."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        last = name.rpartition(".")[2]
        words = [ast.unparse(argument) for argument in node.args]
        if "temporary" in words or name.startswith("temporary.") or name in ("write_text", "write_bytes"):
            continue
        modes = [a.value for a in [*node.args, *(k.value for k in node.keywords)] if isinstance(a, ast.Constant)]
        opens = last == "open" and any(isinstance(m, str) and set(m) & set("wax+") and len(m) < 4 for m in modes)
        method = isinstance(node.func, ast.Attribute)
        if opens or (method and last in WRITERS) or name in ("os.replace", "os.rename", "shutil.move"):
            found.append(name if name.startswith(("np.", "os.")) else last)
    return found


@pytest.mark.parametrize("path", [*sorted((ROOT / "ipjax").rglob("*.py")), *sorted((ROOT / "benchmarks").glob("*.py"))])
def test_every_file_goes_through_the_one_writer(path):
    packages = [folder.as_posix() for folder in path.relative_to(ROOT).parents]
    for name in find_writers(path.read_text()):
        allowed = any((package, name) in MAY for package in packages)
        assert allowed, f"{path.relative_to(ROOT)} writes with {name}: use ipjax.files.storage.writing"


def test_finds_writers():
    assert find_writers("open(a, 'w')") == ["open"] and find_writers("p.open(mode='ab')") == ["open"]
    assert find_writers("image.save(path)") == ["save"] and find_writers("os.replace(a, b)") == ["os.replace"]
    assert find_writers("cv2.imwrite(str(path), x)") == ["imwrite"]
    assert find_writers("p.write_text(t)") == ["write_text"]
    assert find_writers("open(a)\nwrite_text(a, b)\nimage.save(temporary)\nImage.open(p)\nopen(a, 'rb')") == []


def test_publish_names_the_file_that_the_user_knows(tmp_path):
    (tmp_path / "part").write_bytes(b"x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError) as caught:
        publish(tmp_path / "part", tmp_path / "folder")
    assert caught.value.filename == str(tmp_path / "folder")
    publish(tmp_path / "part", tmp_path / "whole")
    assert (tmp_path / "whole").read_bytes() == b"x"


def test_what_killed_writers_left_is_removed_by_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_searched", {})
    old, fresh, other = (
        tmp_path / name for name in (".a.0123456789ab.part.txt", ".a.ba9876543210.part.txt", ".a.part")
    )
    for path in (old, fresh, other):
        path.write_bytes(b"half")
    yesterday = time.time() - 25 * 3600
    for path in (old, other):
        os.utime(path, (yesterday, yesterday))
    write_text(tmp_path / "a.txt", "whole")
    assert {p.name for p in tmp_path.iterdir()} == {"a.txt", fresh.name, other.name}


def test_a_killed_writer_leaves_what_the_next_knows(tmp_path, monkeypatch):
    # A killed process runs no clean-up: the generator of a writer that is never closed does not either.
    writer = writing(tmp_path / "a[1].tar.gz")
    writer.__enter__().write_bytes(b"half")
    (left,) = tmp_path.iterdir()
    os.utime(left, (0, 0))
    monkeypatch.setattr(module, "_searched", {})  # as in the next process
    write_bytes(tmp_path / "b", b"whole")
    assert [p.name for p in tmp_path.iterdir()] == ["b"]
    writer.gen.close()


def test_a_folder_is_not_searched_for_every_file(tmp_path, monkeypatch):
    searched = []
    scan = os.scandir
    monkeypatch.setattr(module, "_searched", {})
    monkeypatch.setattr(module.os, "scandir", lambda folder: (searched.append(folder), scan(folder))[1])
    for i in range(20):
        write_text(tmp_path / f"{i}.txt", "")
    assert searched == [tmp_path]


def test_lines_of_json_come_back_without_the_one_that_a_crash_cut_short(tmp_path):
    path = tmp_path / "a.jsonl"
    append_json(path, {"a": 1}, {"b": "µ\n"})
    append_json(path, [2])
    with path.open("ab") as file:
        file.write(b'{"cut": ')
    whole = ['{"a": 1}', '{"b": "\\u00b5\\n"}', "[2]"]
    assert read_lines(path) == whole and path.read_bytes().endswith(b'{"cut": ')
    assert read_lines(path, repair=True) == whole
    append_json(path, [3])
    assert read_lines(path) == [*whole, "[3]"]
    with pytest.raises(ValueError, match="JSON"):
        append_json(path, float("nan"))
    assert len(read_lines(path)) == 4

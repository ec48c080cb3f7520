"""Files appear whole or not at all, whoever else writes them; and one process at a time fetches."""

import ast
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_weights import Server, serving

from ipjax.files.storage import locked, publish, write_bytes, write_text, writing

ROOT = Path(__file__).resolve().parents[2]


# --- writing ----------------------------------------------------------------------------------------------------------


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
MAY = {
    ("storage", "write_bytes"): "the writer itself",
    ("storage", "os.replace"): "the writer itself",
    ("rendering", "np.save"): "the child's job, in a folder of its own",
    ("rendering", "np.savez"): "the child's job, in a folder of its own",
    ("rendering", "write_text"): "the child's job, in a folder of its own",
    ("rendering", "open"): "what the child says, in a folder of its own",
    ("gltf", "save"): "a picture, into memory",
    ("weights", "open"): "a download that goes on where it stopped, and a wheel unpacked in a folder of its own",
    ("evaluation", "open"): "a journal, a line at a time",
    ("photo_pairs", "open"): "a journal, a line at a time",
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
    for name in find_writers(path.read_text()):
        assert (path.stem, name) in MAY, f"{path.name} writes with {name}: use ipjax.files.storage"


def test_finds_writers():
    assert find_writers("open(a, 'w')") == ["open"] and find_writers("p.open(mode='ab')") == ["open"]
    assert find_writers("image.save(path)") == ["save"] and find_writers("os.replace(a, b)") == ["os.replace"]
    assert find_writers("cv2.imwrite(str(path), x)") == ["imwrite"]
    assert find_writers("p.write_text(t)") == ["write_text"]
    assert find_writers("open(a)\nwrite_text(a, b)\nimage.save(temporary)\nImage.open(p)\nopen(a, 'rb')") == []


# --- one at a time ----------------------------------------------------------------------------------------------------


def test_a_lock_keeps_others_out_and_is_gone_afterwards(tmp_path):
    path, order = tmp_path / "lock", []

    def second():
        with locked(path):
            order.append("second")

    with locked(path):
        with pytest.raises(BlockingIOError), locked(path, wait=False):
            pass
        waiting = threading.Thread(target=second)
        waiting.start()
        time.sleep(0.05)
        order.append("first")
    waiting.join(timeout=30)
    assert order == ["first", "second"] and list(tmp_path.iterdir()) == []


def test_a_lock_is_held_by_one_at_a_time(tmp_path):
    path, inside, most = tmp_path / "lock", [0], [0]

    def work():
        for _ in range(30):
            with locked(path):
                inside[0] += 1
                most[0] = max(most[0], inside[0])
                time.sleep(0.0002)
                inside[0] -= 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert most == [1]


def test_a_killed_holder_blocks_nobody(tmp_path):
    code = f"""
import sys, time
sys.path[:0] = {[str(ROOT), str(ROOT / "kernels")]!r}
from ipjax.files.storage import locked
with locked({str(tmp_path / "lock")!r}):
    print("held", flush=True)
    time.sleep(600)
"""
    holder = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None and holder.stdout.readline() == "held\n"
    with pytest.raises(BlockingIOError), locked(tmp_path / "lock", wait=False):
        pass
    holder.kill()
    holder.communicate()
    assert (tmp_path / "lock").exists()
    with locked(tmp_path / "lock", wait=False):
        pass


def test_publish_names_the_file_that_the_user_knows(tmp_path):
    (tmp_path / "part").write_bytes(b"x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError) as caught:
        publish(tmp_path / "part", tmp_path / "folder")
    assert caught.value.filename == str(tmp_path / "folder")
    publish(tmp_path / "part", tmp_path / "whole")
    assert (tmp_path / "whole").read_bytes() == b"x"


# --- two downloads ----------------------------------------------------------------------------------------------------


@pytest.fixture
def slow_server():
    """Serves three megabytes; the second half comes when a test says so, and two downloads overlap."""
    with serving() as running:
        yield running


def fetch(server: Server, cache: Path) -> subprocess.Popen:
    """``ipjax weights fetch test``, in a process of its own, with our server in the catalogue."""
    known = {"sha256": hashlib.sha256(server.data).hexdigest(), "url": server.url}
    code = f"""
import sys
from ipjax.files.weights import encoders as weights
weights.CATALOGUE["test"] = weights.Source("test", "vits14", "weights.pth", "none", **{json.dumps(known)})
from ipjax.cli import main
sys.exit(main(["weights", "fetch", "test"]))
"""
    environment = os.environ | {"IPJAX_CACHE": str(cache), "JAX_PLATFORMS": "cpu"}
    environment["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
    for name in ("IPJAX_OFFLINE", "HF_HUB_OFFLINE", "IPJAX_WEIGHTS"):
        environment.pop(name, None)
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def wait_for(condition, *processes: subprocess.Popen) -> None:
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() - begin < 120 and all(process.poll() is None for process in processes)
        time.sleep(0.005)


def test_two_processes_fetch_the_same_weights(slow_server, tmp_path):
    slow_server.hold = threading.Event()  # the first download stops half way until the second process is waiting
    part = tmp_path / "weights" / "weights.pth.part"
    first = fetch(slow_server, tmp_path)
    wait_for(lambda: part.exists() and part.stat().st_size > 0, first)
    second = fetch(slow_server, tmp_path)
    threading.Timer(3.0, slow_server.hold.set).start()
    said = [process.communicate(timeout=120) for process in (first, second)]
    assert [process.returncode for process in (first, second)] == [0, 0], said
    assert (tmp_path / "weights" / "weights.pth").read_bytes() == slow_server.data
    assert [p.name for p in (tmp_path / "weights").iterdir()] == ["weights.pth"]
    assert len(slow_server.requests) == 1 and "from download" in said[0][0] and "from cache" in said[1][0]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_who_waits_for_a_killed_download_goes_on_from_it(slow_server, tmp_path):
    slow_server.hold = threading.Event()
    part = tmp_path / "weights" / "weights.pth.part"
    first = fetch(slow_server, tmp_path)
    wait_for(lambda: part.exists() and part.stat().st_size >= 2**20, first)
    second = fetch(slow_server, tmp_path)
    waiting = second.stderr
    assert waiting is not None and "waiting" in waiting.readline()
    first.kill()
    first.communicate()
    slow_server.hold.set()
    out, error = second.communicate(timeout=120)
    assert second.returncode == 0, error
    assert (tmp_path / "weights" / "weights.pth").read_bytes() == slow_server.data and "from download" in out
    assert len(slow_server.requests) == 2 and slow_server.requests[1].startswith("bytes=")

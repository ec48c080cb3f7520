"""One process at a time fetches weights; who waited finds or goes on with what the other left."""

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
from builders.weight_server import Server, serving


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
from ipjax.files.weights import catalogue
catalogue.CATALOGUE["test"] = catalogue.Source("test", "vits14", "weights.pth", "none", **{json.dumps(known)})
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

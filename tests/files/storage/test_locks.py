"""Locks between processes and threads: one at a time, and a killed holder blocks nobody."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from ipjax.files.storage.locks import locked

ROOT = Path(__file__).resolve().parents[3]


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
from ipjax.files.storage.locks import locked
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

"""Steps are kept where nothing they are made of changed; a run killed at any moment ends with the same files."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from builders import killed_runs
from builders.killed_runs import hash_files, make_job, make_steps, write_numbers

from ipjax.capture.records import CaptureError
from ipjax.capture.steps.running import Listener, run_steps
from ipjax.files.storage.locks import locked


@pytest.fixture
def folder(tmp_path):
    write_numbers(tmp_path / "capture")
    return tmp_path


def rerun(folder, *, first=None, anyway=False, **settings) -> tuple[list[str], list[str | None]]:
    """Which steps were made, and why."""
    made: list[str] = []
    done = run_steps(make_steps(made), make_job(folder, "out", **settings), first=first, anyway=anyway)
    return made, [one.why for one in done]


def test_killed_at_every_moment_it_goes_on_to_the_same_files(tmp_path):
    paths = [str(Path(killed_runs.__file__).parents[1]), *sys.path]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-W", "ignore::RuntimeWarning", killed_runs.__file__, str(tmp_path)]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stderr
    assert int(ran.stdout) > 40  # moments


def test_a_step_is_made_again_exactly_when_it_has_to_be(folder):
    assert rerun(folder) == (["count", "spread", "publish"], ["it was not made yet"] * 3)
    assert rerun(folder) == ([], [None] * 3)
    before = hash_files(folder / "out.work")

    (folder / "out" / "1.bin").unlink()
    assert rerun(folder) == (["publish"], [None, None, "../out/1.bin is missing"])
    (folder / "out.work" / "spread" / "0.bin").write_bytes(b"x")
    assert rerun(folder)[1] == [None, "spread/0.bin was changed", None]  # its result is the old one again
    assert hash_files(folder / "out.work") == before and len(hash_files(folder / "out")) == 2

    made, why = rerun(folder, odd=True)
    assert made == ["count", "spread"] and why[:2] == ["its settings changed (odd)", "what the step count made changed"]
    assert (folder / "out.work" / "odd.txt").is_file()
    rerun(folder)
    assert not (folder / "out.work" / "odd.txt").exists()  # nothing of the other settings stays
    assert hash_files(folder / "out.work") == before

    (folder / "capture" / "notes.md").write_text("no input")
    assert rerun(folder)[0] == []
    write_numbers(folder / "capture", seed=1)
    assert rerun(folder) == (["count", "spread", "publish"], ["the capture changed"] * 3)

    record = folder / "out.work" / "steps" / "count.json"
    record.write_text(record.read_text().replace('"code": "', '"code": "0'))
    assert rerun(folder)[1] == ["its code changed", None, None]
    record.write_text("{")
    assert rerun(folder)[1] == ["it was not made yet", None, None]


def test_from_a_step_on(folder):
    with pytest.raises(CaptureError, match=r"left no count\.txt there; begin with it: --from count"):
        rerun(folder, first="spread")
    (folder / "out.work" / "count.txt").write_text("7")  # by hand
    with pytest.raises(CaptureError, match="no step is called 'paint'"):
        rerun(folder, first="paint")
    made, why = rerun(folder, first="spread")
    assert made == ["spread", "publish"] and why[0] == "it is taken as it was found, because of --from"
    assert rerun(folder) == ([], [None] * 3)  # and stays so
    assert (folder / "out" / "0.bin").read_bytes()[:2] == bytes([0, 7])
    assert rerun(folder, first="publish")[0] == ["publish"]
    assert rerun(folder, first="count")[0] == ["count", "spread", "publish"]
    assert (folder / "out.work" / "count.txt").read_text() != "7"


def test_a_step_may_stop_the_run(folder):
    made, _ = rerun(folder, little=True)
    assert made == ["count", "spread"] and not (folder / "out").exists()
    assert rerun(folder, little=True) == ([], [None, None])  # said again, not made again
    assert rerun(folder, little=True, anyway=True)[0] == ["publish"]


def test_listens(folder):
    told = []
    listener = Listener(begins=lambda step, why: told.append((step.name, why)), ends=lambda done: told.append(done.why))
    run_steps(make_steps([])[:1], make_job(folder, "out"), listener=listener)
    assert told == [("count", "it was not made yet"), "it was not made yet"]


def test_folders_of_others_are_left_alone(folder):
    work = folder / "out.work"
    work.mkdir()
    (work / "thesis.tex").write_text("x")
    with pytest.raises(CaptureError, match=r"other files in it \(thesis\.tex\)"):
        rerun(folder)
    (work / "count.txt").write_text("7")
    with pytest.raises(CaptureError, match=r"files that single steps made \(count\.txt\); --from STEP"):
        rerun(folder)
    assert sorted(path.name for path in work.iterdir()) == ["count.txt", "thesis.tex"]
    (folder / "file.work").write_text("x")
    with pytest.raises(CaptureError, match="a file of this name is in the way"):
        run_steps(make_steps([]), make_job(folder, "file"))


def test_one_run_at_a_time(folder):
    rerun(folder)
    with locked(folder / "out.work" / "steps" / ".lock"), pytest.raises(CaptureError, match="another run is at work"):
        rerun(folder)


def test_a_full_disc_is_one_sentence_and_leaves_nothing_half(folder, monkeypatch):
    fsync, left = os.fsync, [5]

    def fill(handle):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return fsync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fill)
        with pytest.raises(CaptureError, match=r"no space left on device; the finished steps are kept: make room"):
            rerun(folder)
    assert not (folder / "out").exists() and not list(folder.rglob("*.part*"))
    made, _ = rerun(folder)
    assert made[-1] == "publish" and rerun(folder)[0] == []

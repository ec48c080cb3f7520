"""Shards: killed, short of space, shared between workers, with bad frames, they end in the same files."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders import fake_labels
from builders.fake_labels import hash_labels, make_worker, run, write_frames

from ipjax.bop.results import read_results
from ipjax.files.provenance import list_executed
from ipjax.files.storage.locks import locked
from ipjax.labelling.shards.ledger import Ledger
from ipjax.labelling.shards.plan import CODE, WORK, plan_shards

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> Path:
    return write_frames(tmp_path_factory.mktemp("source") / "frames")


@pytest.fixture(scope="module")
def whole(tmp_path_factory, frames) -> dict[str, str]:
    """The files of an undisturbed run."""
    folder = tmp_path_factory.mktemp("whole") / "labels"
    report = run(folder, frames)
    assert (report.labelled, report.frames) == (2, 7) and [name for name, _ in report.bad] == ["2"]
    return hash_labels(folder)


def test_a_plan_covers_every_frame_once():
    plan = plan_shards(1001, 100)
    assert [s.stop - s.start for s in plan] == [100] * 10 + [1] and plan[3].name == "000003"
    assert [s.start for s in plan[1:]] == [s.stop for s in plan[:-1]] and plan_shards(0, 5) == []
    with pytest.raises(ValueError, match="at least one frame"):
        plan_shards(3, 0)


def test_code_that_reads_frames_is_part_of_what_labels_are_made_of():
    executed = list_executed(*CODE)
    assert {"ipjax.labelling.sources.tar_shards", "ipjax.labelling.sources.frame_folder"} <= executed.keys()


def test_what_a_shard_holds(tmp_path, frames, whole):
    run(tmp_path / "labels", frames)
    assert hash_labels(tmp_path / "labels") == whole
    shard = tmp_path / "labels" / "shards" / "000000"
    rows = read_results(shard / "labels.csv")
    assert {row.im_id for row in rows} == {0, 1, 3} and {row.obj_id for row in rows} == {3, 5}
    assert all(row.time == -1 for row in rows)
    truths = json.loads((shard / "scenes" / "000000" / "scene_gt.json").read_text())
    coco = json.loads((shard / "coco.json").read_text())
    present = sum(len(truth) for truth in truths.values())
    assert sorted(truths) == ["0", "1", "3"] and 0 < present < len(rows) and present == len(coco["annotations"])
    assert all(one["area"] == 64 and one["segmentation"]["size"] == [24, 32] for one in coco["annotations"])
    table = np.load(shard / "table.npz")
    assert table["pose"].shape == (6, 16) and table["covariance"].shape == (6, 36)
    np.testing.assert_allclose(table["pose"][:, 3] * 1000, [row.translation[0] for row in rows])
    bad = json.loads((shard / "bad_frames.json").read_text())
    assert [one["frame"] for one in bad] == ["2"] and "not an image" in bad[0]["reason"]
    assert sorted(p.name for p in (shard / "previews").iterdir()) == ["00000000.jpg", "00000003.jpg"]


def test_killed_again_and_again_it_ends_in_the_same_files(tmp_path, whole):
    command = [sys.executable, fake_labels.__file__, str(tmp_path)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | {"PYTHONPATH": f"{ROOT / 'tests'}{os.pathsep}{ROOT}{os.pathsep}{ROOT / 'kernels'}"},
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 8
    assert hash_labels(tmp_path / "killed 1") == whole


def test_a_part_of_the_shards_and_several_workers_make_the_same_files(tmp_path, frames, whole):
    folder = tmp_path / "labels"
    assert run(folder, frames, (1, 2)).labelled == 1
    first = run(folder, frames)
    assert (first.labelled, first.before, first.elsewhere) == (1, 1, 0)
    assert hash_labels(folder) == whole
    again = run(folder, frames)
    assert (again.labelled, again.before, again.frames) == (0, 2, 0)
    assert hash_labels(folder) == whole


def test_two_workers_do_not_take_the_same_shard(tmp_path, frames):
    folder = tmp_path / "labels"
    (folder / WORK).mkdir(parents=True)
    with locked(folder / WORK / "000000.lock"):
        report = run(folder, frames)
    assert (report.labelled, report.elsewhere) == (1, 1)
    assert [path.name for path in (folder / "shards").iterdir()] == ["000001"]


def test_a_disc_that_fills_up_ends_in_a_sentence_and_nothing_half_written(tmp_path, frames, whole, monkeypatch):
    flush = os.fsync
    for moment in (0, 1, 3, 6, 12, 19):
        folder = tmp_path / str(moment)
        left = [moment]

        def full(handle, left=left):
            left[0] -= 1
            if left[0] < 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            flush(handle)

        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="the disk is full: free some space and run the same command again") as caught:
            run(folder, frames)
        assert caught.value.filename == str(folder)
        monkeypatch.setattr(os, "fsync", flush)
        shards = folder / "shards"
        for path in shards.iterdir() if shards.is_dir() else ():
            assert path.name in ("000000", "000001"), "a folder that is not finished is left"
            assert (path / "labels.csv").is_file() and (path / "coco.json").is_file()
        run(folder, frames)
        assert hash_labels(folder) == whole


def test_a_bad_frame_is_tried_again_once_and_may_be_good_then(tmp_path, frames):
    reads: dict[str, int] = {}
    worker = make_worker(tmp_path / "labels", frames)
    read = worker.source.read

    def failing(key):
        reads[key.name] = reads.get(key.name, 0) + 1
        if key.name == "1" and reads["1"] == 1:
            raise OSError("the network was away")
        return read(key)

    worker.source.read = failing
    report = worker.run()
    assert reads == {"0": 1, "1": 2, "2": 2, "3": 1, "4": 1, "5": 1, "6": 1}
    assert [name for name, _ in report.bad] == ["2"]
    entries = [json.loads(line) for line in (tmp_path / "labels/shards/000000/labels.jsonl").read_text().splitlines()]
    assert [entry["name"] for entry in entries] == ["0", "1", "2", "3"] and not entries[1]["error"]


def test_batches_after_a_crash_are_those_of_before(tmp_path):
    """Half a batch, and a line that was cut short, are done again."""
    path = tmp_path / "labels.jsonl"
    entries = [{"name": str(n), "error": "" if n != 4 else "bad"} for n in range(7)]
    ledger = Ledger(path, 7, 3)
    ledger.append(entries[:3])
    ledger.append(entries[3:5])
    with open(path, "a") as file:
        file.write('{"name": "5", "err')
    again = Ledger(path, 7, 3)
    assert again.done == 3 and len(path.read_text().splitlines()) == 3
    again.append(entries[3:6])
    again.append(entries[6:])
    again = Ledger(path, 7, 3)
    assert again.done == 7 and again.to_try_again() == [4]
    again.append([{"name": "4", "error": "still bad"}])
    again = Ledger(path, 7, 3)
    assert again.to_try_again() == [] and [one["error"] for one in again.collect()][4] == "still bad"
    for line in ("{not json", "5", "{}"):
        path.write_text(f'{{"name": "0", "error": ""}}\n{line}\n')
        with pytest.raises(ValueError, match=r"labels\.jsonl: damaged"):
            Ledger(path, 2, 1)

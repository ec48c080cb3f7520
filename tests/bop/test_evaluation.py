"""A run that was killed ends with the same numbers; failures count as misses; results of other settings are refused."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ipjax.bop.dataset import Dataset
from ipjax.bop.evaluation import evaluate
from ipjax.bop.records import DatasetError, Estimate
from ipjax.bop.scoring.scores import score
from ipjax.bop.scoring.tables import format_score


class Noisy:
    """Estimates from the truth, deterministic per image; counts its calls, and dies after a few."""

    def __init__(self, dataset, calls=None, die_after=None):
        self.dataset, self.calls, self.die_after = dataset, [] if calls is None else calls, die_after

    def __call__(self, frame, targets):
        if self.die_after is not None and len(self.calls) >= self.die_after:
            raise KeyboardInterrupt
        self.calls.append((frame.scene_id, frame.im_id))
        random = np.random.default_rng(frame.im_id)
        truths = {t.obj_id: t for t in self.dataset.truths(frame.scene_id, frame.im_id)}
        return [
            Estimate(
                t.obj_id, 0.5, truths[t.obj_id].rotation, truths[t.obj_id].translation + random.normal(0, 0.01, 3), 1.1
            )
            for t in targets
        ]


def poses_of(folder: Path) -> list[str]:
    return [line.rsplit(",", 1)[0] for line in (folder / "test_small-test.csv").read_text().splitlines()]


def run(small, folder, estimator, **settings):
    return evaluate(small, None, estimator, folder, method="test", progress=False, metrics=("mssd", "mspd"), **settings)


def test_a_killed_run_ends_with_the_same_numbers(small, tmp_path):
    whole = run(small, tmp_path / "whole", Noisy(small))
    assert whole.medians["scale_percent"] == pytest.approx(10.0)
    kept = tmp_path / "whole" / "test_small-test.csv"  # found with its sizes, it scores the same
    assert score(kept, small, ("mssd", "mspd")).all_frames == whole.all_frames
    assert whole.all_frames.sized["size_5"] == 0.0 and whole.all_frames.sized["mssd"] > 0
    calls: list = []
    for stop in (1, 3):
        with pytest.raises(KeyboardInterrupt):
            run(small, tmp_path / "parts", Noisy(small, calls, die_after=stop))
        with open(tmp_path / "parts" / "results.jsonl", "a") as file:
            file.write('{"image": [0, ')  # what a crash in the middle of a write leaves
    resumed = run(small, tmp_path / "parts", Noisy(small, calls))
    assert calls == [(0, 0), (0, 1), (0, 2), (0, 3)]  # each once
    assert resumed.all_frames == whole.all_frames
    assert poses_of(tmp_path / "parts") == poses_of(tmp_path / "whole")
    again = run(small, tmp_path / "parts", Noisy(small, calls))
    assert len(calls) == 4
    assert again.seconds_per_image == resumed.seconds_per_image
    assert json.loads((tmp_path / "parts" / "score.json").read_text())["missing"] == 0


def test_results_of_other_settings_are_refused(small, tmp_path):
    run(small, tmp_path, Noisy(small), settings={"resolution": 224})
    with pytest.raises(DatasetError, match="other settings"):
        run(small, tmp_path, Noisy(small), settings={"resolution": 448})


def test_the_refusal_names_the_setting(small, tmp_path):
    run(small, tmp_path, Noisy(small), settings={"config": {"match": {"views": 4, "pairs": 50}}})
    with pytest.raises(DatasetError, match=re.escape("(settings.config.match.views)")):
        run(small, tmp_path, Noisy(small), settings={"config": {"match": {"views": 8, "pairs": 50}}})


@pytest.mark.parametrize(("restart", "seed", "calls"), [("changed", 0, 0), ("changed", 1, 4), ("always", 0, 4)])
def test_beginning_anew(small, tmp_path, restart, seed, calls):
    run(small, tmp_path, Noisy(small), settings={"seed": 0})
    again = Noisy(small)
    run(small, tmp_path, again, settings={"seed": seed}, restart=restart)
    assert len(again.calls) == calls
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 1 + 4
    head = json.loads((tmp_path / "results.jsonl").read_text().splitlines()[0])
    assert head["settings"] == {"seed": seed}


def test_time_that_another_has_spent_is_counted(small, tmp_path):
    class Sharing(Noisy):
        shared_seconds = 0.0
        notes = ("told the size",)

        def __call__(self, frame, targets):
            self.shared_seconds += 10.0
            return super().__call__(frame, targets)

    found = run(small, tmp_path, Sharing(small))
    assert found.seconds_per_image is not None and 10 <= found.seconds_per_image < 11
    assert "Note: told the size." in format_score(found)


def test_compilation_is_not_time_per_image(small, tmp_path):
    class Slow(Noisy):
        compile_seconds = 0.0

        def __call__(self, frame, targets):
            if not self.calls:
                time.sleep(0.5)
                self.compile_seconds += 0.5
            return super().__call__(frame, targets)

    found = run(small, tmp_path, Slow(small))
    assert found.seconds_per_image is not None and 0 <= found.seconds_per_image < 0.1


def test_what_seeks_needs_no_masks_and_nobody_who_says_what_is_there(small, tmp_path):
    class Seeking(Noisy):
        seeks = True

        def __call__(self, frame, targets):
            self.asked = [(t.obj_id, t.mask) for t in targets]
            return super().__call__(frame, targets)

    root = tmp_path / "bare"
    shutil.copytree(small.root, root)
    for folder in root.glob("test/*/mask_visib"):
        shutil.rmtree(folder)
    seeking = Seeking(small)
    found = run(Dataset(root), tmp_path / "out", seeking)
    assert found.all_frames == run(small, tmp_path / "with_masks", Noisy(small)).all_frames
    assert seeking.asked == [(2, None), (3, None)] and len(seeking.calls) == 4
    asked = [{"scene_id": scene, "im_id": image} for scene, image in small.target_images]
    (root / "asked.json").write_text(json.dumps(asked))
    again = Seeking(small)
    unnamed = Dataset(root, targets="asked.json")
    evaluate(unnamed, None, again, tmp_path / "asked", progress=False, metrics=("ap",))
    assert len(again.calls) == 4 and again.asked == []


def test_a_failure_stops_or_counts_as_a_miss(small, tmp_path):
    good = Noisy(small)

    def fails(frame, targets):
        if frame.im_id == 1:
            raise RuntimeError("no pose today")
        if frame.im_id == 2:
            return [Estimate(2, 1.0, np.full((3, 3), np.nan), np.zeros(3))]
        return good(frame, targets)

    with pytest.raises(RuntimeError, match="no pose today"):
        run(small, tmp_path / "a", fails)
    found = run(small, tmp_path / "b", fails, on_error="skip")
    assert found.missing == 4
    table = format_score(found)
    assert "2 images failed, count as misses" in table
    for reason in ("scene 0, image 1: RuntimeError: no pose today", "scene 0, image 2: ValueError: the estimate of"):
        assert reason in table


def test_what_failed_for_a_passing_reason_is_tried_again(small, tmp_path):
    good, whole = Noisy(small), run(small, tmp_path / "whole", Noisy(small))
    lines = lambda folder: [x.rsplit(",", 1)[0] for x in next(folder.glob("*.csv")).read_text().splitlines()]
    for fails, calls in ((2, 4), (1, 2), (0, 1)):  # images that fail, images that are tried
        tried: list[int] = []

        def sometimes(frame, targets, tried=tried, fails=fails):
            tried.append(frame.im_id)
            if len(tried) <= fails:
                raise OSError(28, "No space left on device")
            return good(frame, targets)

        found = run(small, tmp_path / "b", sometimes, on_error="skip")
        assert len(tried) == calls
        assert format_score(found).count("OSError: [Errno 28] No space left on device") == fails
    assert found.all_frames.recalls == whole.all_frames.recalls and found.notes == whole.notes
    assert lines(tmp_path / "b") == lines(tmp_path / "whole")
    untouched = Noisy(small)
    run(small, tmp_path / "b", untouched, on_error="skip")
    assert untouched.calls == []


@pytest.mark.skipif(sys.platform == "win32", reason="no file locks of this kind")
def test_one_run_at_a_time(small, tmp_path):
    script = (
        "import fcntl, sys, time\n"
        "f = open(sys.argv[1], 'w'); fcntl.flock(f, fcntl.LOCK_EX); print('held', flush=True); time.sleep(60)\n"
    )
    command = [sys.executable, "-c", script, os.fspath(tmp_path / ".lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout is not None and holder.stdout.readline().strip() == "held"
            with pytest.raises(DatasetError, match="another run is writing here"):
                run(small, tmp_path, Noisy(small))
        finally:
            holder.kill()


def test_an_estimator_that_returns_no_pose_is_told(small, tmp_path):
    def estimator(scale, stretch):
        return lambda frame, targets: [Estimate(2, 1.0, stretch * np.eye(3), np.ones(3), scale)]

    with pytest.raises(ValueError, match="object 2: R is no rotation: it scales by 2"):
        run(small, tmp_path / "a", estimator(1.0, 2.0))
    with pytest.raises(ValueError, match="the size of the estimate of object 2 is not positive"):
        run(small, tmp_path / "b", estimator(0.0, 1.0))

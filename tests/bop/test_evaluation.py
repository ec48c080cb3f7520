"""Scores equal BOP's, obey the protocol's laws, and a run that was killed ends with the same numbers."""

import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.bop_roots import ERRORS, PROTOCOL, write_images, write_protocol
from hypothesis import given, settings
from hypothesis import strategies as st

from ipjax.bop import dataset as bop
from ipjax.bop import evaluation
from ipjax.bop import run as studies
from ipjax.bop.dataset import DatasetError, Estimate, ResultRow

VSD = np.load(Path(__file__).resolve().parents[1] / "golden" / "bop_vsd.npz")


def protocol_rows() -> list[ResultRow]:
    columns = [PROTOCOL[f"est_{name}"].tolist() for name in ("scene", "im", "obj", "score")]
    places = zip(*columns, PROTOCOL["est_R"].astype(float), PROTOCOL["est_t"].astype(float), strict=True)
    return [ResultRow(s, i, o, c, tuple(R.ravel()), tuple(t)) for s, i, o, c, R, t in places]


def true_rows(dataset: bop.Dataset) -> list[ResultRow]:
    rows = []
    for (scene, image), targets in dataset.targets_by_image().items():
        for truth in dataset.truths(scene, image):
            if truth.obj_id in {t.obj_id for t in targets}:
                estimate = Estimate(truth.obj_id, truth.visible, truth.rotation, truth.translation)
                rows.append(bop.as_row(scene, image, estimate, 0.5))
    return rows


@pytest.fixture(scope="module")
def protocol(tmp_path_factory) -> bop.Dataset:
    return bop.Dataset(write_protocol(tmp_path_factory.mktemp("bop") / "golden"))


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> bop.Dataset:
    return bop.Dataset(write_images(tmp_path_factory.mktemp("bop") / "small"))


@pytest.fixture(scope="module")
def golden_score(protocol):
    return evaluation.score(protocol_rows(), protocol, ("mssd", "mspd", "ap"), samples=200)


def test_recalls_and_precisions_are_bops_exactly(golden_score):
    found = golden_score
    assert found.all_frames.targets == int(PROTOCOL["targets_count"])
    for name in ("mssd", "mspd"):
        np.testing.assert_allclose(found.curves[name], PROTOCOL[f"{name}_recall"], rtol=1e-12)
        assert found.all_frames.recalls[name] == pytest.approx(float(PROTOCOL[f"AR_{name}"]), abs=1e-12)
        assert found.precision[f"ap_{name}"] == pytest.approx(float(PROTOCOL[f"AP_{name}"]), abs=1e-12)
    assert found.precision["map"] == pytest.approx(float(PROTOCOL["mAP_bop24"]), abs=1e-12)


def test_thousands_of_estimates_in_a_file_agree_with_the_toolkit(tmp_path, monkeypatch, capfd):
    """A root as LM-O's (scene-wise, models_eval, targets, no depth), through the command and a result file."""
    from ipjax import cli

    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    copies = 30
    root = write_protocol(tmp_path / "lmo", copies)
    rows = [replace(r, scene_id=r.scene_id + 100 * k) for k in range(copies) for r in protocol_rows()]
    shuffled = [rows[i] for i in np.random.default_rng(2).permutation(len(rows))]
    path = bop.write_results(tmp_path / "other_lmo-test.csv", shuffled)
    assert len(rows) > 2000
    assert cli.main(["score", str(path), str(root), "-o", str(tmp_path / "score.json")]) == 0
    assert "scored without VSD" in capfd.readouterr().out
    found = json.loads((tmp_path / "score.json").read_text())["all_frames"]
    assert found["targets"] == copies * int(PROTOCOL["targets_count"])
    for name in ("mssd", "mspd"):
        assert found["recalls"][name] == pytest.approx(float(PROTOCOL[f"AR_{name}"]), abs=1e-6)


def test_recall_is_weighted_by_instances(golden_score):
    counts = np.array([entry["targets"] for entry in golden_score.objects.values()])
    recalls = np.array([entry["mssd"] for entry in golden_score.objects.values()])
    assert golden_score.all_frames.recalls["mssd"] == pytest.approx((counts * recalls).sum() / counts.sum())
    assert abs(recalls.mean() - golden_score.all_frames.recalls["mssd"]) > 1e-3  # so the test can tell them apart


def test_intervals_hold_the_value_and_come_back(protocol, golden_score):
    low, high = golden_score.all_frames.intervals["mssd"]
    assert low < golden_score.all_frames.recalls["mssd"] < high
    again = evaluation.score(protocol_rows(), protocol, ("mssd", "mspd"), samples=200)
    assert again.all_frames.intervals["mssd"] == (low, high)


def test_the_order_of_rows_does_not_matter(protocol, golden_score):
    rows = protocol_rows()
    shuffled = [rows[i] for i in np.random.default_rng(1).permutation(len(rows))]
    again = evaluation.score(shuffled, protocol, ("mssd", "mspd", "ap"), samples=0)
    assert again.all_frames.recalls == golden_score.all_frames.recalls
    assert again.precision == golden_score.precision


def test_the_truth_scores_one_on_every_metric(small):
    names = ("mssd", "mspd", "vsd", "add", "add_s", "ap")
    found = evaluation.score(true_rows(small), small, names, scales=[1.0] * 8)
    assert found.all_frames.recalls == {"mssd": 1.0, "mspd": 1.0, "vsd": 1.0, "ar": 1.0}
    assert found.precision == {"ap_mssd": 1.0, "ap_mspd": 1.0, "map": 1.0}
    assert set(found.add.values()) == {1.0}
    assert set(found.medians) == {"rotation_deg", "translation_mm", "scale_percent"}
    assert max(found.medians.values()) < 1e-6
    assert (found.missing, found.seconds_per_image) == (0, 0.5)
    assert json.loads(json.dumps(found.to_dict()))["all_frames"]["recalls"]["ar"] == 1.0
    assert "AR_VSD" in found.table() and "one frame per scene" in found.table()


def shrunk(dataset: bop.Dataset, factor: float, seed: int = 0) -> tuple[list[ResultRow], list[float]]:
    """Poses that are a little off, and one size for all."""
    random = np.random.default_rng(seed)
    rows = [replace(r, translation=tuple(np.add(r.translation, random.normal(0, 4, 3)))) for r in true_rows(dataset)]
    return rows, [factor] * len(rows)


@given(factor=st.floats(0.6, 1.6))
@settings(max_examples=10)
def test_a_wrong_size_costs_what_it_must_and_bops_figures_do_not_see_it(small, factor):
    """True poses: MSSD at the estimated size is |f − 1| · the farthest vertex, and ADD(-S) no more than the mean."""
    rows = true_rows(small)
    names = ("mssd", "mspd", "add")
    right = evaluation.score(rows, small, names, samples=0)
    found = evaluation.score(rows, small, names, scales=[factor] * len(rows), samples=0)
    assert found.all_frames.recalls == right.all_frames.recalls and found.add == right.add
    assert right.all_frames.sized == {}
    for one in found.instances:
        arms = np.linalg.norm(small.mesh(one.obj_id).vertices, axis=-1)
        assert one.sized_mssd == pytest.approx(abs(factor - 1) * arms.max(), abs=1e-7)
        if one.obj_id == 2:  # three symmetries: ADD-S
            assert one.sized_add <= abs(factor - 1) * arms.mean() + 1e-9
    expected = np.mean(
        [
            [i.sized_mssd < t * small.models()[i.obj_id].diameter for t in evaluation.errors.THRESHOLDS]
            for i in found.instances
        ]
    )
    assert found.all_frames.sized["mssd"] == pytest.approx(expected)
    shares = [found.all_frames.sized[f"size_{k}"] for k in (2, 5, 10)]
    assert shares == [float(abs(factor - 1) < t) for t in (0.02, 0.05, 0.1)]


def test_sized_errors_are_those_of_the_metrics(small):
    """The scores' float64 figures against the public functions, pose by pose, where pose and size are both off."""
    import jax.numpy as jnp

    from ipjax import metrics
    from ipjax.records import Similarity

    rows, scales = shrunk(small, 1.07)
    found = evaluation.score(rows, small, ("mssd", "mspd"), scales=scales, samples=0)
    for one in found.instances:
        row = next(r for r in rows if (r.im_id, r.obj_id) == (one.im_id, one.obj_id))
        truth = small.truths(one.scene_id, one.im_id)[one.index]
        model = evaluation.Model.load(small, one.obj_id)
        pose = lambda R, t, s: Similarity(*(jnp.asarray(x, jnp.float32) for x in (R, t, s)))
        expected = metrics.sized_errors(
            model.diameter,
            jnp.asarray(model.points, jnp.float32),
            pose(*model.symmetries, np.ones(len(model.rotations))),
            pose(truth.rotation, truth.translation, 1.0),
            pose(np.reshape(row.rotation, (3, 3)), np.multiply(row.translation, 1e-3), 1.07),
        )
        assert one.sized_mssd / model.diameter == pytest.approx(float(expected.mssd), rel=1e-3)
        assert one.sized_add / model.diameter == pytest.approx(float(expected.add_s), rel=1e-3)


def test_sizes_are_kept_beside_the_bop_file_and_found_there(small, tmp_path):
    rows, scales = shrunk(small, 1.03)
    path = bop.write_results(tmp_path / "mine_small-test.csv", rows)
    plain = path.read_text()
    beside = bop.write_results(bop.sized_path(path), rows, scales=scales)
    assert beside.name == "mine_small-test.sized" and path.read_text() == plain
    assert beside.read_text().splitlines()[1] == f"{plain.splitlines()[1]},1.03"  # BOP's row and a column
    assert [row.scale for row in bop.read_results(beside)] == scales and bop.read_results(beside) == rows
    names = ("mssd", "mspd")
    given_ = evaluation.score(rows, small, names, scales=scales, samples=0).all_frames
    run = lambda *a, **k: evaluation.score(*a, small, names, samples=0, **k)
    assert run(path).all_frames == given_ == run(beside).all_frames
    assert run(path, sizes=False).all_frames.sized == {}
    moved = beside.rename(tmp_path / "elsewhere.csv")
    assert run(path).all_frames.sized == {} and run(path, sizes=moved).all_frames == given_
    assert "size to 5 %" in run(path, sizes=moved).table() and "size to" not in run(path).table()
    # Sizes of other estimates: refused where asked for, left out and told where merely found.
    others = bop.write_results(tmp_path / "others.csv", shrunk(small, 1.03, seed=1)[0], scales=scales)
    with pytest.raises(DatasetError, match=r"others.csv: it holds no size for line 2 of mine_small-test.csv"):
        run(path, sizes=others)
    others.rename(beside)
    found = run(path)
    assert found.all_frames.sized == {} and any("so that sizes are left out" in note for note in found.notes)
    whole = beside.read_text()
    for damaged in ("", whole.replace(",1.03", ",-1.03"), whole.replace("time,scale", "time,size")):
        beside.write_text(damaged)
        found = run(path)
        assert found.all_frames.sized == {} and not found.problems
        assert any(str(beside) in note and "so that sizes are left out" in note for note in found.notes)
        with pytest.raises(DatasetError, match=r"mine_small-test\.sized, line"):
            run(path, sizes=beside)
    beside.write_text(whole)
    for scale in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="its scale is"):
            bop.write_results(tmp_path / "bad.csv", rows, scales=[scale] * len(rows))
    (tmp_path / "bad.csv").write_text(beside.read_text().replace(",1.03", ",-1.03"))
    with pytest.raises(DatasetError, match=r"line 2: scale must be positive, got -1.03"):
        bop.read_results(tmp_path / "bad.csv")


def test_a_missing_estimate_is_a_miss(small):
    rows = true_rows(small)
    found = evaluation.score(rows[:-2], small, ("mssd", "mspd", "add"), samples=0)
    assert found.all_frames.recalls["mssd"] == 6 / 8
    assert found.missing == 2
    assert found.add["recall_01d"] == 6 / 8
    nothing = evaluation.score([], small, ("mssd", "vsd", "ap"), samples=0)
    assert nothing.all_frames.recalls == {"mssd": 0.0, "vsd": 0.0}
    assert nothing.precision["map"] == 0.0


def test_symmetric_errors_in_the_medians(small):
    turn = small.models()[3].symmetry_rotations[200]
    rows = [
        replace(r, rotation=tuple((np.reshape(r.rotation, (3, 3)) @ turn).ravel()))
        for r in true_rows(small)
        if r.obj_id == 3
    ]
    found = evaluation.score(rows, small, ("mssd", "mspd"), objects=[3], samples=0)
    assert found.all_frames.recalls["mspd"] == 1.0
    assert found.medians["rotation_deg"] < 1e-3


def test_wins_against_a_second_file(small, tmp_path):
    rows = true_rows(small)
    worse = [replace(r, translation=(r.translation[0] + 15, *r.translation[1:])) if r.obj_id == 2 else r for r in rows]
    path = bop.write_results(tmp_path / "other_small-test.csv", worse)
    found = evaluation.score(rows, small, ("mssd", "mspd"), against=path, samples=0)
    assert found.against is not None
    assert (found.against["wins"], found.against["ties"], found.against["losses"]) == (1, 1, 0)
    assert "Objects won against other_small-test" in found.table()


def test_without_depth_there_is_no_vsd_and_the_table_says_so(protocol):
    found = evaluation.score(protocol_rows(), protocol, samples=0)
    assert "vsd" not in found.all_frames.recalls and "ar" not in found.all_frames.recalls
    assert "scored without VSD" in found.table()


def test_an_alignment_moves_the_mesh_and_is_named(small, tmp_path):
    turn = ERRORS["R_gt"][5].astype(float)
    path = tmp_path / "mesh_to_model.json"
    path.write_text(json.dumps({"scale": 250.0, "R": turn.tolist(), "t": [3.0, -4.0, 5.0]}))
    alignment = evaluation.read_alignment(path)
    assert alignment.scale == 0.25
    shift = np.array([0.003, -0.004, 0.005])
    truth = small.truths(0, 0)[0]
    # camera_from_mesh = camera_from_model ∘ model_from_mesh
    of_mesh = Estimate(2, 1.0, truth.rotation @ turn, truth.rotation @ shift + truth.translation, 0.25)
    moved = alignment.apply(of_mesh)
    np.testing.assert_allclose(moved.rotation, truth.rotation, atol=1e-6)
    np.testing.assert_allclose(moved.translation_m, truth.translation, atol=1e-7)
    assert moved.scale == pytest.approx(1.0)
    rows = [bop.as_row(0, 0, of_mesh)]
    found = evaluation.score(rows, small, ("mssd",), objects=[2], alignments={2: alignment}, samples=0)
    assert found.all_frames.recalls["mssd"] == 1 / 4
    assert "mesh_to_model.json" in found.table()
    for bad, says in ((-1.0, "it mirrors"), (1.3, "it scales by 1.3")):
        path.write_text(json.dumps({"scale": 250.0, "R": (bad * turn).tolist(), "t": [0, 0, 0]}))
        with pytest.raises(DatasetError, match=f"mesh_to_model.json: R is no rotation: {says}"):
            evaluation.read_alignment(path)
    path.write_text('{"scale": 1}')
    with pytest.raises(DatasetError, match="an alignment is JSON"):
        evaluation.read_alignment(path)


def test_recalls_with_and_without_doubtful_images(tmp_path):
    dataset = bop.Dataset(write_images(tmp_path / "two", scenes=2, images=2))
    rows = [r for r in true_rows(dataset) if (r.scene_id, r.im_id) != (0, 0)]
    found = evaluation.score(rows, dataset, ("mssd",), without=[(0, 0)], samples=20)
    recalls = {title: (part.images, part.targets, part.recalls["mssd"]) for title, part in found.parts().items()}
    assert recalls == {
        "one frame per scene": (2, 4, 0.5),
        "all frames": (4, 8, 0.75),
        "one frame per scene, without 0/0": (2, 4, 1.0),  # the next frame of the scene stands in
        "all frames, without 0/0": (3, 6, 1.0),
    }
    assert "all frames, without 0/0" in found.table() and "in doubt" in found.table()
    assert evaluation.score(rows, dataset, ("mssd",), samples=0).without == {}
    with pytest.raises(DatasetError, match="scene 0, image 7 is no target image"):
        evaluation.score(rows, dataset, ("mssd",), without=[(0, 7)])
    assert bop.parse_images(["3/138"]) == [(3, 138)] and bop.parse_images(None) == []
    for bad in ("3", "3/", "a/1", "3-138"):
        with pytest.raises(ValueError, match="give SCENE/IMAGE"):
            bop.parse_images([bad])


def test_rows_of_things_that_do_not_exist(small, tmp_path):
    rows = true_rows(small)
    for bad, says in ((replace(rows[0], obj_id=77), "no object 77"), (replace(rows[0], im_id=500), "no image 500")):
        path = bop.write_results(tmp_path / "x_small-test.csv", [rows[1], bad])
        with pytest.raises(DatasetError, match=f"line 3: the data set has {says}"):
            evaluation.score(path, small, ("mssd",))
        found = evaluation.score(path, small, ("mssd",), on_error="skip", samples=0)
        assert len(found.problems) == 1
        assert found.all_frames.recalls["mssd"] == 1 / 8
    with pytest.raises(ValueError, match="unknown metric"):
        evaluation.score(rows, small, ("mssq",))


def test_matching_is_greedy_strict_and_one_to_one():
    table = np.array([[0.1, 0.3], [0.05, 0.5]])
    np.testing.assert_array_equal(evaluation.match_poses(table, np.array([0.9, 0.8]), 0.4), [0, -1])
    np.testing.assert_array_equal(evaluation.match_poses(table, np.array([0.8, 0.9]), 0.4), [1, 0])
    np.testing.assert_array_equal(evaluation.match_poses(table, np.array([0.9, 0.8]), 0.1), [-1, 0])
    valid = np.array([False, True])
    np.testing.assert_array_equal(evaluation.match_poses(table, np.array([0.9, 0.8]), 0.4, valid), [1, -1])


def test_average_precision_by_hand():
    assert evaluation.average_precision(np.array([0.9, 0.8]), np.array([True, True]), 2) == 1.0
    # Half of the truths, found first: precision 1 at the recalls 0 … 0.5 (51 of 101).
    assert evaluation.average_precision(np.array([0.9, 0.8]), np.array([True, False]), 2) == pytest.approx(51 / 101)
    assert evaluation.average_precision(np.array([]), np.array([]), 3) == 0.0


def test_rendered_depth_follows_the_toolkits_pixels(small):
    """The golden depth maps sample the surface at pixel + ½, as the toolkit's renderers do."""
    rows = np.flatnonzero(VSD["obj_id"] == 2)[:3]
    poses = [evaluation.Pose(VSD["R_gt"][i].astype(float), VSD["t_gt"][i].astype(float) / 1000) for i in rows]
    cameras = np.repeat(VSD["K"][None], len(rows), 0)
    golden = VSD["depth_gt"][rows]
    apart = {}
    for corner in (0.0, 0.5):
        drawn = 1000 * evaluation.render_depths(small.mesh(2), poses, cameras, 96, 128, corner=corner)
        both = (drawn > 0) & (golden > 0)
        apart[corner] = np.abs(drawn - golden)[both].mean()
        if corner == 0.5:
            assert ((drawn > 0) != (golden > 0)).sum() <= 3  # of some thousand
    assert apart[0.5] < 0.05  # mm; the golden depths are rounded to 1/16 mm
    assert apart[0.0] > 2 * apart[0.5]


# Resuming


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
    return evaluation.evaluate(
        small, None, estimator, folder, method="test", progress=False, metrics=("mssd", "mspd"), **settings
    )


def test_a_killed_run_ends_with_the_same_numbers(small, tmp_path):
    whole = run(small, tmp_path / "whole", Noisy(small))
    assert whole.medians["scale_percent"] == pytest.approx(10.0)
    kept = tmp_path / "whole" / "test_small-test.csv"  # found with its sizes, it scores the same
    assert evaluation.score(kept, small, ("mssd", "mspd")).all_frames == whole.all_frames
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
    assert "Note: told the size." in found.table()


def test_results_hang_on_the_code(monkeypatch):
    """Every file whose change can change an estimate is in the hash; none of those that only print or score."""
    code = studies.hash_code()
    assert re.fullmatch("[0-9a-f]{16}", code) and code == studies.hash_code()
    read: list[str] = []
    opened = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: (read.append(self.name), opened(self))[1])
    studies.hash_code()
    stages = {f"{n}.py" for n in ("pipeline", "matching", "alignment", "refinement", "scoring", "config", "frames")}
    assert stages | {"neighbours.py", "consensus.py", "rasterize.py"} <= set(read)
    assert not {"cli.py", "evaluation.py"} & set(read)


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
    table = found.table()
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
        assert found.table().count("OSError: [Errno 28] No space left on device") == fails
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


def test_the_truth_scores_one_whatever_its_symmetries(protocol):
    """Several instances in an image, hundreds of symmetries, and one object in a frame off its centre."""
    rows = true_rows(protocol)
    found = evaluation.score(rows, protocol, ("mssd", "mspd", "add_s"), samples=50)
    assert found.all_frames.recalls == {"mssd": 1.0, "mspd": 1.0}
    assert found.add["add_or_s_auc"] == 1.0


# Studies: settings, and what they are made of


def test_the_refusal_names_the_setting(small, tmp_path):
    run(small, tmp_path, Noisy(small), settings={"config": {"match": {"views": 4, "pairs": 50}}})
    with pytest.raises(DatasetError, match=re.escape("(settings.config.match.views)")):
        run(small, tmp_path, Noisy(small), settings={"config": {"match": {"views": 8, "pairs": 50}}})


def test_numbered_files(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("")
    assert studies.parse_numbered([f"5={path}"], "--mesh") == {5: path}
    for bad in ("5", f"x={path}", f"5={path}x"):
        with pytest.raises(ValueError, match="--mesh"):
            studies.parse_numbered([bad], "--mesh")


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


def test_several_objects_are_drawn_at_once(small):
    """Each image shows its own object alone, as if it had been drawn by itself."""
    truths = {t.obj_id: t for t in small.truths(0, 0)}
    numbers = sorted(truths)
    poses = [evaluation.Pose(truths[n].rotation, truths[n].translation) for n in numbers]
    camera = small.camera(0, 0)[0][None]
    meshes = [small.mesh(n) for n in numbers]
    together = evaluation.render_depths(
        meshes, poses[::-1], np.repeat(camera, len(poses), 0), 96, 128, which=list(range(len(poses)))[::-1]
    )
    for place, n in enumerate(reversed(numbers)):
        alone = evaluation.render_depths(small.mesh(n), [poses[numbers.index(n)]], camera, 96, 128)[0]
        assert (alone > 0).any()
        np.testing.assert_array_equal(together[place] > 0, alone > 0)
        np.testing.assert_allclose(together[place], alone, atol=1e-6)


# The command: malformed data sets and result files are told in a sentence

ROW = "0,0,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700,0.5"


@pytest.fixture
def scored(tmp_path, monkeypatch, capfd):
    """Runs ``ipjax score`` on a small data set, damaged before: (status, standard output, standard error)."""
    from ipjax import cli

    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    monkeypatch.delenv("IPJAX_DEBUG", raising=False)
    root, path = write_images(tmp_path / "small", images=2), tmp_path / "mine_small-test.csv"
    path.write_text(f"{bop.HEADER}\n{ROW}\n")

    def run(damage, *words):
        damage(root, path)
        try:
            status = cli.main(["score", str(path), str(root), "--metrics", "mssd", "mspd", *words])
        except SystemExit as stop:
            status = stop.code
        return (status, *capfd.readouterr())

    return run


def rows(*lines):
    return lambda root, path: path.write_text("\n".join([bop.HEADER, ROW, *lines]) + "\n")


def written(name, text):
    return lambda root, path: (root / name).write_text(text)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (rows("0,1,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700"), "mine_small-test.csv, line 3: .*7 columns"),
        (rows("0,1,2,1.0,1 0 0 0 1 0 0 0,0 0 700,1"), "mine_small-test.csv, line 3: R must hold 9 numbers, got 8"),
        (rows("0,1,2,nan,1 0 0 0 1 0 0 0 1,0 0 700,1"), "mine_small-test.csv, line 3: .*not finite"),
        (rows("0,1,2,1.0,1 0 0 0 nan 0 0 0 1,0 0 700,1"), "mine_small-test.csv, line 3: .*not finite"),
        (rows("0,1,77,1.0,1 0 0 0 1 0 0 0 1,0 0 700,1"), "mine_small-test.csv, line 3: the data set has no object 77"),
        (rows(ROW), "mine_small-test.csv, line 3: .*same as that of line 2"),
        (rows("0,9,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700,1"), "line 3: the data set has no image 9 in scene 0"),
        (
            rows("0,1,2,1.0,1.3 0 0 0 1.3 0 0 0 1.3,0 0 700,1"),
            r"line 3: R is no rotation: it scales by 1.3 .*2.197",
        ),
        (rows("0,1,2,1.0,1 0 0 0 1 0 0 0 -1,0 0 700,1"), r"line 3: R is no rotation: it mirrors \(det R = -1,"),
        (rows("0,1,2,1.0,1 0.3 0 0 1 0 0 0 1,0 0 700,1"), "line 3: R is no rotation: its rows are not at right angles"),
        (rows("0,1,2,1.0,0 0 0 0 0 0 0 0 0,0 0 700,1"), "line 3: R is no rotation: "),
        (rows("0,1,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700,-2"), "line 3: time must be seconds, or -1 .*, got -2"),
        (rows("0,1,2,inf,1 0 0 0 1 0 0 0 1,0 0 700,1"), "mine_small-test.csv, line 3: score .*not finite"),
        (rows("8,0,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700,1"), "line 3: the data set has no image 0 in scene 8"),
        (lambda root, path: path.write_text("scene_id,im_id\n"), "mine_small-test.csv, line 1: the header must be"),
        (lambda root, path: path.unlink(), "mine_small-test.csv: .*cannot be read"),
        (lambda root, path: (root / "test/000000/rgb/000001.png").unlink(), "000001.png: no such image"),
        (lambda root, path: (root / "models_eval/obj_000003.ply").unlink(), "obj_000003.ply: no such model"),
        (written("test/000000/scene_gt.json", '{"0": [\n}'), "scene_gt.json: not valid JSON: line 2"),
        (
            written("test/000000/scene_gt.json", '{"0": [], "1": []}'),
            "1 instances of object 2 in scene 0, image 0, but 0",
        ),
        (
            written(
                "test/000000/scene_gt.json",
                '{"0": [{"obj_id": 2, "cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, -1], "cam_t_m2c": [0, 0, 700]}]}',
            ),
            "scene_gt.json, image 0, instance 0: cam_R_m2c: R is no rotation: it mirrors",
        ),
        (
            written("test/000000/scene_camera.json", '{"0": {"cam_K": [1]}}'),
            "scene_camera.json, image 0: cam_K must be 9",
        ),
        (written("models_eval/models_info.json", '{"2": {"diameter": 1}}'), "no object 3"),
        (written("test_targets_bop19.json", '[{"scene_id": 0}]'), "test_targets_bop19.json, entry 0: "),
    ],
)
def test_the_command_names_what_is_malformed(scored, damage, says):
    status, out, error = scored(damage)
    assert status == 2 and out == ""
    assert error.count("\n") == 1 and "Traceback" not in error
    assert re.search(says, error), error


def turned(change):
    """All annotated poses, changed as a whole."""

    def damage(root, path):
        bop.write_results(path, [change(row) for row in true_rows(bop.Dataset(root))])

    return damage


def moved(factor):
    return lambda row: replace(row, translation=tuple(np.multiply(row.translation, factor)))


def opposite(row):
    """As OpenGL would have it: y up, z behind."""
    flip = np.diag([1.0, -1, -1])
    rotation = flip @ np.reshape(row.rotation, (3, 3))
    return replace(row, rotation=tuple(rotation.ravel()), translation=tuple(flip @ row.translation))


def transposed(row):
    return replace(row, rotation=tuple(np.reshape(row.rotation, (3, 3)).T.ravel()))


def inverted(row):
    """The camera's pose in the object's frame."""
    R = np.reshape(row.rotation, (3, 3)).T
    return replace(transposed(row), translation=tuple(-R @ row.translation))


def strayed(row):
    return replace(row, obj_id=1)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (moved(1e-3), "1000 times too small .* must be in millimetres; it seems to be in metres"),
        (moved(0.1), "10 times too small .* must be in millimetres; it seems to be in centimetres"),
        (moved(1 / 25.4), "25.4 times too small .* must be in millimetres; it seems to be in inches"),
        (moved(1e3), "1000 times too large .* must be in millimetres"),
        (opposite, "behind the camera .*: poses must be in OpenCV axes"),
        (strayed, "none of the 4 estimates is of a target"),
    ],
)
def test_the_command_says_what_is_wrong_with_all_of_a_file(scored, change, says):
    """Files that would score 0 without a hint, though every row is in order."""
    status, out, error = scored(turned(change))
    assert status == 2 and out == "" and error.count("\n") == 1
    assert re.search(says, error), error
    status, out, _ = scored(lambda *_: None, "--skip-bad")
    assert status == 0 and re.search(f"Note: .*{says}", out)


@pytest.mark.parametrize("change", [transposed, inverted])
def test_poses_the_wrong_way_round_are_told(small, change):
    rows = [change(row) for row in true_rows(small)]
    says = "right when R is transposed: R and t must map the model into the camera's frame"
    with pytest.raises(DatasetError, match=f"results: the rotations are {says}"):
        evaluation.score(rows, small, ("mssd",), samples=0)
    assert says in evaluation.score(rows, small, ("mssd",), samples=0, on_error="skip").table()


@given(seed=st.integers(0, 1000))
@settings(max_examples=10)
def test_rotations_that_are_merely_wrong_are_scored(small, seed):
    random = np.random.default_rng(seed)
    turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in true_rows(small)]
    rows = [
        replace(row, rotation=tuple((turn * np.linalg.det(turn)).ravel()))
        for row, turn in zip(true_rows(small), turns, strict=True)
    ]
    evaluation.score(rows, small, ("mssd",), samples=0)


@pytest.mark.parametrize("change", [moved(1.6), moved(0.6), moved((1, 1, -0.1)), moved((-5, -5, 1))])
def test_what_is_merely_wrong_is_scored(scored, change):
    """A method that fails on every target is no file in another unit."""
    assert scored(turned(change))[0] == 0


@given(seed=st.integers(0, 1000), noise=st.floats(0.0, 5e-4))
def test_rotations_that_are_rounded_are_accepted(seed, noise):
    """Official files have determinants within 0.003 of 1."""
    random = np.random.default_rng(seed)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    bop.check_rotation((turn + noise * random.uniform(-1, 1, (3, 3))).ravel())
    bop.check_rotation((1.001 * turn).ravel())
    for bad in (1.02 * turn, 0.98 * turn, -turn, turn @ np.diag([1, 1.02, 1]), 0 * turn):
        with pytest.raises(ValueError, match="R is no rotation"):
            bop.check_rotation(bad.ravel())


def test_a_file_without_estimates_is_told(small):
    found = evaluation.score([], small, ("mssd",), samples=0)
    assert found.all_frames.recalls["mssd"] == 0 and "every target is a miss" in found.table()


def test_estimates_of_no_target_are_counted(small):
    rows = true_rows(small)
    more = [replace(rows[0], obj_id=1), *rows]
    found = evaluation.score(more, small, ("mssd",), samples=0)
    assert found.all_frames.recalls["mssd"] == 1.0
    assert any("1 of 9 estimates are of no target" in note for note in found.notes)
    with pytest.raises(DatasetError, match="line 2: R is no rotation: it scales by"):
        evaluation.score([replace(r, rotation=tuple(np.multiply(r.rotation, 1.5))) for r in rows], small, ("mssd",))


def test_an_estimator_that_returns_no_pose_is_told(small, tmp_path):
    def estimator(scale, stretch):
        return lambda frame, targets: [Estimate(2, 1.0, stretch * np.eye(3), np.ones(3), scale)]

    with pytest.raises(ValueError, match="object 2: R is no rotation: it scales by 2"):
        run(small, tmp_path / "a", estimator(1.0, 2.0))
    with pytest.raises(ValueError, match="the size of the estimate of object 2 is not positive"):
        run(small, tmp_path / "b", estimator(0.0, 1.0))


def test_the_command_scores_and_goes_on_where_asked(scored, tmp_path):
    bad = "0,1,2,1.0,1 0 0 0 1 0 0 0,0 0 700,1"
    status, out, _ = scored(rows(bad), "--skip-bad", "--without", "0/1", "-o", str(tmp_path / "score.json"))
    assert status == 0 and "1 problems, the first: " in out and "R must hold 9 numbers" in out
    assert "all frames, without 0/1" in out
    kept = json.loads((tmp_path / "score.json").read_text())
    assert kept["all_frames"]["targets"] == 4 and len(kept["problems"]) == 1 and set(kept["without"])

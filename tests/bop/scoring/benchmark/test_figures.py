"""The figures of a participant, against those that NumPy finds in the files themselves."""

import json
from dataclasses import replace

import numpy as np
import pytest
from builders.bop_roots import true_rows, write_images
from scipy.spatial.distance import cdist

from ipjax.bop.dataset import Dataset
from ipjax.bop.results import read_results, write_results
from ipjax.bop.scoring.benchmark.figures import summarise
from ipjax.bop.scoring.benchmark.participants import compare
from ipjax.bop.scoring.scores import score


def measure(dataset, path) -> dict[int, np.ndarray]:
    """ADD, ADD-S (m), rotation (°) and translation (m) of every target by object: all points, all symmetries."""
    rows = {(r.scene_id, r.im_id, r.obj_id): r for r in read_results(path)}
    found: dict[int, list] = {}
    for target in dataset.targets:
        errors = found.setdefault(target.obj_id, [])
        row = rows.get((target.scene_id, target.im_id, target.obj_id))
        if row is None:
            errors.append([np.inf] * 4)
            continue
        truth = next(t for t in dataset.truths(target.scene_id, target.im_id) if t.obj_id == target.obj_id)
        points = dataset.mesh(target.obj_id).vertices.astype(float)
        R, t = np.reshape(row.rotation, (3, 3)), np.divide(row.translation, 1000)
        true, mine = points @ truth.rotation.T + truth.translation, points @ R.T + t
        same = dataset.models()[target.obj_id].symmetries
        cosines = [(np.trace(R.T @ truth.rotation @ turn) - 1) / 2 for turn in same.rotation]
        best = int(np.argmax(cosines))
        errors.append(
            [
                np.linalg.norm(true - mine, axis=1).mean(),
                cdist(true, mine).min(1).mean(),
                np.degrees(np.arccos(min(cosines[best], 1.0))),
                np.linalg.norm(truth.rotation @ same.translation[best] + truth.translation - t),
            ]
        )
    return {obj: np.array(errors) for obj, errors in found.items()}


def integrate(errors, limit=0.1, steps=20_001) -> float:
    """The area under the accuracy curve by the trapezoidal rule."""
    grid = np.linspace(0, limit, steps)
    accuracy = np.searchsorted(np.sort(errors), grid, side="right") / len(errors)
    return float(np.trapezoid(accuracy, grid) / limit)


def test_figures_are_those_of_an_independent_computation(compared):
    entries = iter(compared.found.entries)
    for dataset, files in compared.groups:
        for path in files:
            entry, errors = next(entries), measure(dataset, path)
            assert set(entry.objects) == set(errors) == {2, 3}
            for obj, (add, add_s, turn, shift) in ((o, e.T) for o, e in errors.items()):
                one = entry.objects[obj]
                assert one.auc_add == pytest.approx(integrate(add), abs=1e-4)
                assert one.auc_add_s == pytest.approx(integrate(add_s), abs=1e-4)
                assert one.add_s_2cm == (add_s < 0.02).mean()
                assert one.pose_5deg_5cm == ((turn < 5) & (shift < 0.05)).mean()
                assert (one.targets, one.found) == (3, np.isfinite(add).sum())
            everything = np.concatenate(list(errors.values()))
            assert entry.all.auc_add == pytest.approx(integrate(everything[:, 0]), abs=1e-4)
            assert entry.add_s_curve[100] == (everything[:, 1] < 0.05).mean()
            assert (entry.add_curve[0], entry.all.recalls) == (0.0, entry.score.all_frames.recalls)
            assert entry.mean.auc_add == pytest.approx(np.mean([one.auc_add for one in entry.objects.values()]))


def test_seconds_are_of_the_images_that_show_the_object(compared):
    sure, rough = compared.found.of("real")
    assert sure.objects[2].seconds == pytest.approx(0.8)  # 0.4, 0.8 and 1.2 s
    assert rough.mean.seconds == pytest.approx(4.0)


def test_the_truth_has_full_marks_and_nothing_has_none(small):
    for rows, figure in ((true_rows(small), 1.0), ([], 0.0)):
        entry = summarise(score(rows, small, ("mssd", "add", "add_s"), samples=0), "mine", "small")
        for one in (*entry.objects.values(), entry.mean, entry.all):
            shares = [one.auc_add, one.auc_add_s, one.add_s_2cm, one.pose_5deg_5cm, *one.recalls.values()]
            assert shares == pytest.approx([figure] * 5, abs=1e-12)  # poses are turned into rows and back
        assert (entry.all.targets, entry.all.found) == (8, 8 * figure)
    assert entry.mean.seconds is None
    with pytest.raises(ValueError, match="the areas need ADD and ADD-S"):
        summarise(score([], small, ("mssd",), samples=0), "mine", "small")


def test_what_is_a_diameter_off_counts_to_ten_centimetres(tmp_path):
    """BOP calls ADD infinite there; the area under PoseCNN's curve does not."""
    root = write_images(tmp_path / "tiny", images=1)
    infos = json.loads((root / "models_eval" / "models_info.json").read_text())
    infos["2"]["diameter"] = 50.0
    (root / "models_eval" / "models_info.json").write_text(json.dumps(infos))
    rows = [r for r in true_rows(Dataset(root)) if r.obj_id == 2]
    moved = [replace(r, translation=tuple(np.add(r.translation, (0, 0, 60)))) for r in rows]
    path = write_results(tmp_path / "moved.csv", moved)
    found = compare([(Dataset(root), [path])], ("mssd",), objects=[2], samples=0).entries[0]
    assert found.all.auc_add == pytest.approx(0.4)
    assert (found.score.instances[0].mssd, found.score.add["recall_01d"]) == (np.inf, 0.0)

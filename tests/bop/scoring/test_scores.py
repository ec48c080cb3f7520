"""Scores equal BOP's and obey the protocol's laws."""

import json
from dataclasses import replace

import numpy as np
import pytest
from builders.bop_roots import PROTOCOL, protocol_rows, true_rows, write_images, write_protocol

from ipjax.bop.dataset import Dataset, parse_images
from ipjax.bop.records import DatasetError
from ipjax.bop.results import write_results
from ipjax.bop.scoring.scores import score
from ipjax.bop.scoring.tables import format_score


@pytest.fixture(scope="module")
def golden_score(protocol):
    return score(protocol_rows(), protocol, ("mssd", "mspd", "ap"), samples=200)


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
    path = write_results(tmp_path / "other_lmo-test.csv", shuffled)
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
    again = score(protocol_rows(), protocol, ("mssd", "mspd"), samples=200)
    assert again.all_frames.intervals["mssd"] == (low, high)


def test_the_order_of_rows_does_not_matter(protocol, golden_score):
    rows = protocol_rows()
    shuffled = [rows[i] for i in np.random.default_rng(1).permutation(len(rows))]
    again = score(shuffled, protocol, ("mssd", "mspd", "ap"), samples=0)
    assert again.all_frames.recalls == golden_score.all_frames.recalls
    assert again.precision == golden_score.precision


def test_the_truth_scores_one_on_every_metric(small):
    names = ("mssd", "mspd", "vsd", "add", "add_s", "ap")
    found = score(true_rows(small), small, names, scales=[1.0] * 8)
    assert found.all_frames.recalls == {"mssd": 1.0, "mspd": 1.0, "vsd": 1.0, "ar": 1.0}
    assert found.precision == {"ap_mssd": 1.0, "ap_mspd": 1.0, "ap_mssd_mm": 1.0, "map": 1.0}
    assert set(found.add.values()) == {1.0}
    assert set(found.medians) == {"rotation_deg", "translation_mm", "scale_percent"}
    assert max(found.medians.values()) < 1e-6
    assert (found.missing, found.seconds_per_image) == (0, 0.5)
    assert json.loads(json.dumps(found.to_dict()))["all_frames"]["recalls"]["ar"] == 1.0
    assert "AR_VSD" in format_score(found) and "one frame per scene" in format_score(found)


def test_the_truth_scores_one_whatever_its_symmetries(protocol):
    """Several instances in an image, hundreds of symmetries, and one object in a frame off its centre."""
    rows = true_rows(protocol)
    found = score(rows, protocol, ("mssd", "mspd", "add_s"), samples=50)
    assert found.all_frames.recalls == {"mssd": 1.0, "mspd": 1.0}
    assert found.add["add_or_s_auc"] == 1.0


def test_a_missing_estimate_is_a_miss(small):
    rows = true_rows(small)
    found = score(rows[:-2], small, ("mssd", "mspd", "add"), samples=0)
    assert found.all_frames.recalls["mssd"] == 6 / 8
    assert found.missing == 2
    assert found.add["recall_01d"] == 6 / 8
    nothing = score([], small, ("mssd", "vsd", "ap"), samples=0)
    assert nothing.all_frames.recalls == {"mssd": 0.0, "vsd": 0.0}
    assert nothing.precision["map"] == 0.0


def test_symmetric_errors_in_the_medians(small):
    turn = small.models()[3].symmetries.rotation[200]
    rows = [
        replace(r, rotation=tuple((np.reshape(r.rotation, (3, 3)) @ turn).ravel()))
        for r in true_rows(small)
        if r.obj_id == 3
    ]
    found = score(rows, small, ("mssd", "mspd"), objects=[3], samples=0)
    assert found.all_frames.recalls["mspd"] == 1.0
    assert found.medians["rotation_deg"] < 1e-3


def test_wins_against_a_second_file(small, tmp_path):
    rows = true_rows(small)
    worse = [replace(r, translation=(r.translation[0] + 15, *r.translation[1:])) if r.obj_id == 2 else r for r in rows]
    path = write_results(tmp_path / "other_small-test.csv", worse)
    found = score(rows, small, ("mssd", "mspd"), against=path, samples=0)
    assert found.against is not None
    assert (found.against["wins"], found.against["ties"], found.against["losses"]) == (1, 1, 0)
    assert "Objects won against other_small-test" in format_score(found)


def test_without_depth_there_is_no_vsd_and_the_table_says_so(protocol):
    found = score(protocol_rows(), protocol, samples=0)
    assert "vsd" not in found.all_frames.recalls and "ar" not in found.all_frames.recalls
    assert "scored without VSD" in format_score(found)


def test_recalls_with_and_without_doubtful_images(tmp_path):
    dataset = Dataset(write_images(tmp_path / "two", scenes=2, images=2))
    rows = [r for r in true_rows(dataset) if (r.scene_id, r.im_id) != (0, 0)]
    found = score(rows, dataset, ("mssd",), without=[(0, 0)], samples=20)
    recalls = {title: (part.images, part.targets, part.recalls["mssd"]) for title, part in found.parts().items()}
    assert recalls == {
        "one frame per scene": (2, 4, 0.5),
        "all frames": (4, 8, 0.75),
        "one frame per scene, without 0/0": (2, 4, 1.0),  # the next frame of the scene stands in
        "all frames, without 0/0": (3, 6, 1.0),
    }
    assert "all frames, without 0/0" in format_score(found) and "in doubt" in format_score(found)
    assert score(rows, dataset, ("mssd",), samples=0).without == {}
    with pytest.raises(DatasetError, match="scene 0, image 7 is no target image"):
        score(rows, dataset, ("mssd",), without=[(0, 7)])
    assert parse_images(["3/138"]) == [(3, 138)] and parse_images(None) == []
    for bad in ("3", "3/", "a/1", "3-138"):
        with pytest.raises(ValueError, match="give SCENE/IMAGE"):
            parse_images([bad])


def test_a_file_without_estimates_is_told(small):
    found = score([], small, ("mssd",), samples=0)
    assert found.all_frames.recalls["mssd"] == 0 and "every target is a miss" in format_score(found)

"""Detections in two dimensions score as BOP's toolkit scores them; files of them come back as they were written."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.bop_roots import protocol_rows, write_annotated, write_protocol

from ipjax import cli
from ipjax.bop.dataset import Dataset
from ipjax.bop.detections import (
    Detection,
    as_detection,
    detected_targets,
    every_target,
    read_detections,
    write_detections,
)
from ipjax.bop.records import DatasetError
from ipjax.bop.results import write_results
from ipjax.bop.scoring.overlaps import score_detections
from ipjax.bop.scoring.scores import score
from ipjax.files.images.run_lengths import decode_rle

GOLDEN = np.load(Path(__file__).resolve().parents[2] / "golden" / "coco_detections.npz")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return Dataset(write_annotated(tmp_path_factory.mktemp("coco") / "made", GOLDEN))


def golden_detections(time=0.25):
    columns = (GOLDEN[f"det_{name}"] for name in ("image", "obj", "score", "box"))
    masks = np.unpackbits(GOLDEN["det_mask"], axis=-1).astype(bool)
    return [
        as_detection(5, int(image), int(obj), float(score), mask, time, tuple(box.tolist()))
        for image, obj, score, box, mask in zip(*columns, masks, strict=True)
    ]


def test_boxes_and_masks_score_as_cocos_api_with_bops_rule(dataset):
    found = score_detections(golden_detections(), dataset)
    for kind in ("bbox", "segm"):
        part = found.kinds[kind]
        np.testing.assert_allclose((part.ap, part.ap50, part.ap75, part.ar), GOLDEN[f"{kind}_stats"], atol=1e-12)
        expected = {obj: ap for obj, ap in zip((1.0, 2.0, 3.0, 4.0), GOLDEN[f"{kind}_ap"], strict=True) if ap >= 0}
        assert part.objects == pytest.approx(expected, abs=1e-12)
    assert found.ignored == (GOLDEN["gt_visib"] < 0.1).sum() and found.seconds_per_image == 0.25
    assert found.instances + found.ignored == len(GOLDEN["gt_obj"]) and not found.notes


def test_ignored_instances_cost_nothing_and_win_nothing(dataset):
    """Finding all that counts is 1, whether what need not be found is found as well or not."""
    masks = np.unpackbits(GOLDEN["gt_mask"], axis=-1).astype(bool)
    every = [
        as_detection(5, int(i), int(o), 0.9, m, box=tuple(b.tolist()))
        for i, o, b, m in zip(*(GOLDEN[f"gt_{n}"] for n in ("image", "obj", "box")), masks, strict=True)
    ]
    needed = [one for one, visib in zip(every, GOLDEN["gt_visib"], strict=True) if visib >= 0.1]
    for detections in (every, needed):
        found = score_detections(detections, dataset)
        assert [part.ap for part in found.kinds.values()] == [1.0, 1.0] and found.seconds_per_image is None
    (one,) = score_detections([replace(one, segmentation=None) for one in needed], dataset).kinds
    assert one == "bbox"
    modal = score_detections(every, dataset, ["bbox"], boxes="modal").kinds["bbox"]
    assert modal.ap < 1  # the boxes that are given are those of whole silhouettes


def test_files_come_back_as_they_were_written(dataset, tmp_path, capsys):
    detections = golden_detections()
    path = write_detections(tmp_path / "mine_made-test.json", detections)
    again = read_detections(path)
    assert [replace(one, segmentation=None) for one in again] == [replace(one, segmentation=None) for one in detections]
    assert all((a.mask == b.mask).all() for a, b in zip(again, detections, strict=True))
    entries = json.loads(path.read_text())
    names = {"scene_id", "image_id", "category_id", "score", "bbox", "segmentation", "time"}
    assert all(set(entry) == names and isinstance(entry["score"], float) for entry in entries)
    import gzip

    packed = tmp_path / "mine_made-test.json.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert len(read_detections(packed)) == len(detections)
    folder = tmp_path / "cnos"  # as CNOS leaves its files before they are joined: one of each image
    folder.mkdir()
    for image in sorted({one.im_id for one in detections}):
        mine = [one for one in detections if one.im_id == image]
        np.savez(
            folder / f"scene5_frame{image}.npz",
            scene_id=5,
            image_id=image,
            category_id=[one.obj_id for one in mine],
            score=[one.score for one in mine],
            bbox=np.array([one.box for one in mine]),
            time=0.25,
            segmentation=np.stack([decode_rle(one.segmentation) for one in mine]),
        )
    expected = score_detections(path, dataset)
    assert score_detections(folder, dataset).kinds == expected.kinds == score_detections(packed, dataset).kinds
    assert cli.main(["score", str(path), str(dataset.root), "--json", "-o", str(tmp_path / "score.json")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["kinds"]["segm"]["ap"] == expected.kinds["segm"].ap == pytest.approx(GOLDEN["segm_stats"][0])
    assert json.loads((tmp_path / "score.json").read_text()) == told
    assert cli.main(["score", str(path), str(dataset.root)]) == 0
    out = capsys.readouterr().out
    assert f"boxes   {100 * GOLDEN['bbox_stats'][0]:8.1f}" in out and "Time per image: 0.25 s." in out
    assert cli.main(["score", str(path), str(dataset.root), "--metrics", "mssd"]) == 2
    assert "--metrics belongs to poses" in capsys.readouterr().err


def changed(number, **change):
    def spoil(entries):
        entries[number] |= change

    return spoil


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (changed(1, time=0.5), r"entry 1: time is for the whole image: 0.5 s here, but 0.25 s"),
        (changed(1, time=-3), r"entry 1: time must be seconds"),
        (changed(1, category_id=77), r"entry 1: the data set has no object 77"),
        (changed(1, category_id=None), r"entry 1: a detection needs scene_id, image_id, category_id.*category_id"),
        (changed(1, score="x"), r"entry 1: score must be a number"),
        (changed(1, bbox=[1, 2, -3, 4]), r"entry 1: bbox must be x, y, width, height, none of the last two negative"),
        (changed(1, bbox=[1, 2, 3]), r"entry 1: bbox must be x, y, width, height"),
        (changed(1, segmentation={"size": [9, 9], "counts": [81]}), r"is 9 × 9, but the image 64 × 48"),
        (
            changed(1, segmentation={"size": [48, 64], "counts": [7]}),
            r"the mask of object \d .* the runs of a mask cover 7",
        ),
    ],
)
def test_damage_is_named(dataset, tmp_path, spoil, says):
    entries = json.loads(write_detections(tmp_path / "a.json", golden_detections()).read_text())
    spoil(entries)
    path = tmp_path / "b.json"
    path.write_text(json.dumps(entries))
    with pytest.raises(DatasetError, match=says):
        score_detections(path, dataset)
    skipped = score_detections(path, dataset, on_error="skip")
    assert len(skipped.problems) == 1 and re.search(says, skipped.problems[0])
    # As if the damaged entry were not there.
    rest = [one for number, one in enumerate(golden_detections()) if number != 1]
    assert skipped.kinds == score_detections(rest, dataset).kinds


def test_what_the_challenge_refuses_is_not_written(tmp_path):
    one = Detection(5, 0, 1, 0.5, (1.0, 2.0, 3.0, 4.0), 0.25)
    for bad, says in (
        (replace(one, score=float("nan")), "not finite"),
        (replace(one, time=0.5), "whole image"),
        (replace(one, time=-2.0), "-1 where it is unknown"),
    ):
        with pytest.raises(ValueError, match=says):
            write_detections(tmp_path / "a.json", [one, bad])
    assert not (tmp_path / "a.json").exists()
    with pytest.raises(ValueError, match="is empty"):
        as_detection(5, 0, 1, 0.5, np.zeros((4, 4), bool))
    assert read_detections(write_detections(tmp_path / "b.json", [replace(one, box=None)]))[0].box is None


def test_of_detections_the_task_chooses():
    scores = ((1, 0.2), (2, 0.9), (1, 0.5), (3, 0.7))
    found = [Detection(5, 0, obj, score, None, 0.25) for obj, score in scores]
    assert [(t.obj_id, t.score) for t in every_target(found, None)] == [(2, 0.9), (3, 0.7), (1, 0.5), (1, 0.2)]
    assert [(t.obj_id, t.score) for t in every_target(found, [1, 3], most=2)] == [(3, 0.7), (1, 0.5)]
    assert detected_targets(found, []) == []


def test_targets_of_2024_name_no_objects(tmp_path):
    """The same detections of poses, asked for by image alone: the same precisions, which need no list of objects."""
    root = write_protocol(tmp_path / "golden")
    listed = Dataset(root)
    assert listed.names_objects
    expected = score(protocol_rows(), listed, ("ap",), samples=0).precision
    rows = [{"scene_id": s, "im_id": i} for s, i in listed.target_images]
    (root / "test_targets_bop24.json").write_text(json.dumps(rows))
    assert Dataset(root).targets_file.name == "test_targets_bop19.json"
    asked = Dataset(root, targets="test_targets_bop24.json")
    assert not asked.names_objects and asked.target_images == listed.target_images
    assert score(protocol_rows(), asked, ("ap",), samples=0).precision == expected
    for row, says in (
        ({"scene_id": 1}, "entry 0: scene_id, im_id and obj_id"),
        ({"scene_id": 1, "im_id": 2, "inst_count": 1}, "obj_id"),
    ):
        (root / "test_targets_bop24.json").write_text(json.dumps([row]))
        with pytest.raises(DatasetError, match=says):
            _ = Dataset(root, targets="test_targets_bop24.json").targets
    results = write_results(tmp_path / "mine_golden-test.csv", protocol_rows())
    assert cli.main(["score", str(results), str(root), "--targets", "none.json"]) == 2

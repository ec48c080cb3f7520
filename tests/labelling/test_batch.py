"""Batches give what frames give one by one, whatever else is in them."""

import dataclasses

import numpy as np
import pytest
from builders import detections
from builders.labelled_frames import CONFIG, as_batch, labelled_objects, labeller, make_frames, named_encoder
from builders.tiny_pipeline import TINY, assert_near

from ipjax.detection.assignment import overlap
from ipjax.files.images.run_lengths import decode_rle
from ipjax.inference.estimator import Estimator
from ipjax.labelling import batch as batching
from ipjax.labelling.batch import label_batch
from ipjax.labelling.records import LabelSettings, seed_of, split_into_buckets
from ipjax.transforms import Similarity

EXACT = ("error", "object", "success", "present", "size")


def pick(batch: dict, rows) -> dict:
    return {name: [column[row] for row in rows] for name, column in batch.items()}


def assert_same(made: dict, expected: dict, rows, tolerance: float) -> None:
    """The columns of a batch are those rows of another's, but for the seconds."""
    for name, column in made.items():
        wanted = np.asarray(expected[name])[list(rows)]
        if name == "seconds":
            continue
        if name in EXACT or tolerance == 0 or column.dtype == object:
            equal = np.array_equal(column, wanted, equal_nan=column.dtype.kind == "f")
            assert equal or (name == "mask" and tolerance), name
        else:
            np.testing.assert_allclose(column, wanted, rtol=tolerance, atol=tolerance, err_msg=name)


def decode(made: dict, frame: int, slot: int = 0) -> np.ndarray:
    return decode_rle({"size": made["size"][frame].tolist(), "counts": made["mask"][frame, slot]})


def test_a_batch_gives_what_the_estimator_gives_one_by_one():
    frames = make_frames(4)
    made = labeller(threads=2)(as_batch(frames))
    assert not made["error"].any() and made["success"].all()
    estimator = Estimator(labelled_objects(), named_encoder(), CONFIG, alike=True)
    for number, frame in enumerate(frames):
        obj = number % 2
        crop = estimator.frame(obj, frame.rgb, frame.depth, frame.mask, frame.matrix)
        seed = seed_of(0, f"frame {number}", obj)
        alone = estimator.run(obj, *crop, seed=seed)
        expected = alone.estimate.camera_from_object.to_numpy() @ alone.info.object_from_mesh.to_numpy()
        np.testing.assert_array_equal(made["camera_from_mesh"][number, 0], expected.to_matrix())
        assert made["confidence"][number, 0] == float(alone.estimate.confidence)
        np.testing.assert_array_equal(made["covariance"][number, 0], np.asarray(alone.estimate.covariance, float))
        # It is the true pose, of the mesh file and not of the normalised object.
        pose = Similarity.from_matrix(made["camera_from_mesh"][number, 0])
        mesh_from_object = labelled_objects()[obj][1].object_from_mesh.to_numpy().inverse()
        assert_near((pose @ mesh_from_object).to_jax(), frame.camera_from_object, 0.08, 0.08, 12)
        mask = decode(made, number)
        assert overlap(mask, frame.mask) > 0.75
        assert made["overlap"][number, 0] > 0.75 and made["outline_pixels"][number, 0] >= mask.sum()


def test_buckets_are_padded_and_agree_with_one_by_one():
    """Three crops of an object go into a bucket of four; the repeat that fills it is dropped."""
    batch = as_batch(make_frames(6))
    single, many = labeller(threads=2)(batch), labeller(buckets=(4,), threads=1)(batch)
    assert_same(many, single, range(6), 2e-3)


def test_neither_the_order_nor_the_company_of_a_frame_matters():
    batch = as_batch(make_frames(6))
    whole = labeller(threads=2)(batch)
    order = [5, 2, 3, 0, 4, 1]
    assert_same(labeller(threads=2)(pick(batch, order)), whole, order, 0)
    for rows in ([1], [3, 4]):
        assert_same(labeller(threads=2)(pick(batch, rows)), whole, rows, 0)
    # Of a bucket, too, every lane is computed alike, whoever is in the others.
    lanes = labeller(buckets=(4,), threads=1)(batch)
    assert_same(labeller(buckets=(4,), threads=1)(pick(batch, order)), lanes, order, 1e-6)


def test_random_numbers_depend_on_the_id():
    batch = as_batch(make_frames(2), object_of=lambda number: 0)
    first = labeller(threads=2)(batch)
    renamed = labeller(threads=2)(batch | {"id": ["another", "frame 1"]})
    assert not np.array_equal(first["camera_from_mesh"][0], renamed["camera_from_mesh"][0])
    np.testing.assert_array_equal(first["camera_from_mesh"][1], renamed["camera_from_mesh"][1])
    seeds = {seed_of(seed, name, obj, i) for seed in (0, 1) for name in ("a", "b") for obj in (0, 1) for i in (0, 1)}
    assert len(seeds) == 16 and max(seeds) < 2**32


def test_frames_and_masks_that_cannot_be_used_say_why_and_harm_no_other():
    batch = as_batch(make_frames(4), object_of=lambda number: 0)
    whole = labeller(threads=2)(batch)
    spoiled = {name: np.array(column) for name, column in batch.items()}
    spoiled["depth"][1] = 0
    spoiled["mask"][2] = False
    made = labeller(threads=2)(spoiled)
    assert "depth" in made["error"][1] and list(made["error"][[0, 2, 3]]) == ["", "", ""]
    assert "mask is empty" in made["note"][2, 0] and not made["success"][1:3].any()
    assert np.isnan(made["camera_from_mesh"][1:3]).all() and (made["confidence"][1:3] == 0).all()
    assert_same({n: c[[0, 3]] for n, c in made.items()}, whole, [0, 3], 0)


def test_boxes_and_frames_without_an_object():
    frames = make_frames(3)
    batch = as_batch(frames, object_of=lambda number: -1 if number == 1 else 0)
    del batch["mask"]
    boxes = []
    for frame in frames:
        rows, columns = np.nonzero(frame.mask)
        boxes.append([[columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]])
    made = labeller(threads=2)(batch | {"box": np.array(boxes)})
    assert made["success"][:, 0].tolist() == [True, False, True] and made["object"][1, 0] == -1
    assert np.isnan(made["overlap"]).all() and not made["error"].any()


def test_without_masks_the_objects_are_sought(monkeypatch):
    """By a detector of these objects and settings, here the one that other tests have compiled already."""
    frame = detections.make_frame(detections.place(-0.12, 0.05))
    batch = {"id": ["a"], "rgb": [frame.rgb], "depth": [frame.depth], "camera": [detections.MATRIX]}
    settings = LabelSettings(detection=detections.detector().detection, seeking=TINY, threads=2)
    objects = detections.ellipsoid(), detections.stranger()

    def make_detector(given, encoder, config, *, detection, crop):
        assert list(given) == list(objects) and (config, detection, crop) == (TINY, settings.detection, "square")
        return detections.detector()

    monkeypatch.setattr(batching, "Detector", make_detector)
    made = label_batch(detections.detector().estimator.encoder, objects, batch, config=TINY, settings=settings)
    assert made["object"].shape == (1, 2) and made["object"][0, 0] == 0 and made["present"][0].tolist() == [True, False]
    assert overlap(decode(made, 0), frame.masks[0]) > 0.8


def test_what_was_compiled_is_kept_from_call_to_call(monkeypatch):
    batch = as_batch(make_frames(2))
    first = label_batch(named_encoder(), labelled_objects(), batch, config=CONFIG)
    compiled = []
    monkeypatch.setattr(batching, "Labeller", lambda *given: compiled.append(given))
    again = label_batch(named_encoder(), list(labelled_objects()), batch, config=dataclasses.replace(CONFIG))
    assert_same(again, first, range(2), 0)
    assert not compiled


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"id": ["a", "a"]}, "ids of their own"),
        ({"rgb": np.zeros((1, 4, 4, 3), np.uint8)}, "as many of rgb"),
        ({"object": np.array([[2], [0]])}, "object 2 is not among them"),
        ({"object": None}, "whose each is"),
        ({"object": np.array([[0, 1], [0, 1]])}, "as many masks"),
    ],
)
def test_columns_that_do_not_fit_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        labeller(threads=2)(as_batch(make_frames(2)) | change)


def test_no_objects_and_senseless_settings_are_refused():
    with pytest.raises(ValueError, match="at least one object"):
        label_batch(named_encoder(), [], as_batch(make_frames(1)))
    for wrong in ({"buckets": ()}, {"buckets": (0,)}, {"threads": 0}, {"instances": 0}):
        with pytest.raises(ValueError):
            LabelSettings(**wrong)


def test_a_number_of_crops_is_cut_into_buckets():
    assert split_into_buckets(0, (1, 2, 4, 8)) == []
    assert split_into_buckets(11, (1, 2, 4, 8)) == [(8, 8), (3, 4)]
    assert split_into_buckets(3, (1,)) == [(1, 1)] * 3
    assert split_into_buckets(5, (4, 2)) == [(4, 4), (1, 2)]

"""Objects are found in made frames without a mask: alone, several at once, several of one, and what is not there."""

import dataclasses

import cv2
import numpy as np
import pytest
from builders.detections import HEIGHT, MATRIX, WIDTH, detector, ellipsoid, make_frame, place
from builders.tiny_pipeline import assert_near

from ipjax.cameras import unproject
from ipjax.detection.assignment import overlap
from ipjax.detection.crops import undistort_pixel
from ipjax.detection.records import Reason
from ipjax.detection.verification import is_at
from ipjax.files.cameras.intrinsics import Intrinsics


def test_an_object_is_found_with_its_pose_and_mask():
    frame = make_frame(place(-0.12, 0.05))
    sought = detector()
    found = sought.detect(frame.rgb, frame.depth, MATRIX)
    first = found[0]
    assert (first.name, first.index) == ("ellipsoid", 0)
    assert overlap(first.mask, frame.masks[0]) > 0.85
    assert_near(first.result.estimate.camera_from_object, frame.poses[0], 0.08, 0.1, 20)
    x, y, width, height = first.box
    inside = np.zeros_like(first.mask)
    inside[y : y + height, x : x + width] = True
    assert first.mask.any() and not (first.mask & ~inside).any()
    assert first.score <= first.confidence and found.seconds["verify"] > 0
    assert found.similarity.shape == (2, len(found.proposals.masks))
    # Everything that was tried is told, with a reason, and only one object can have the pixels.
    assert all(one.reason and one.why in Reason and one.steps for one in found.rejected)
    assert not any(overlap(one.mask, first.mask) > 0.5 for one in found[1:])


def test_two_instances_that_touch_are_two_and_none_is_found_twice():
    frame = make_frame(place(-0.075, 0.0, seed=1), place(0.085, 0.02, seed=2))
    found = [
        one for one in detector().detect(frame.rgb, frame.depth, MATRIX, instances=None) if one.name == "ellipsoid"
    ]
    assert len([one for one in found if one.present]) == 2
    for mask in frame.masks:
        assert sum(overlap(one.mask, mask) > 0.6 for one in found) == 1


def test_every_step_is_told():
    """Which proposals were ranked how, which estimates led to a detection, and what each rejected one lost to."""
    frame = make_frame(place(-0.12, 0.05))
    found = detector().detect(frame.rgb, frame.depth, MATRIX)
    first, ranking = found[0], found.rankings[0]
    assert found.names == ("ellipsoid", "stranger") and [one.index for one in found.rankings] == [0, 1]
    assert sorted(ranking.proposals) == list(np.flatnonzero(np.isfinite(found.similarity[0])))
    assert (np.diff(ranking.similarity[: ranking.whole]) <= 0).all() and ranking.estimated <= 3
    assert first.proposal in ranking.proposals[: ranking.estimated]
    before, after = first.steps
    assert np.array_equal(before.mask, found.proposals.masks[first.proposal])
    assert np.array_equal(after.posed, first.mask) and (after.score, after.confidence) == (
        first.score,
        first.confidence,
    )
    lost = [one for one in found.rejected if one.rival is not None]
    # Each proposal that was estimated has one fate.
    tried = [one.proposal for one in (*found.found, *found.rejected) if one.index == 0]
    assert sorted(tried) == sorted(ranking.proposals[: ranking.estimated])
    assert lost and all(one.rival.proposal in found.rankings[one.rival.index].proposals for one in lost)
    kept, rejected = found.told()
    assert {one.index for one in kept} == {one.index for one in found}
    assert len(kept) + len(rejected) == len(found) + len(found.rejected)


def test_no_more_is_ranked_than_was_proposed():
    frame, sought = make_frame(place(-0.12, 0.05)), detector()
    sight = sought.look(frame.rgb, frame.depth, MATRIX, at=[(114.5, 138.5)])
    candidates = sought.rank(sight, 0, 10**12)  # as many instances may be asked for as one likes
    assert sorted(one.proposal for one in candidates) == sight.used.tolist()


def test_a_click_tells_which_of_two():
    frame, sought = make_frame(place(-0.15, 0.0, seed=1), place(0.15, 0.02, seed=2)), detector()
    mask = frame.masks[1]
    y, x = (float(np.median(side)) for side in np.nonzero(mask))
    sight = sought.look(frame.rgb, frame.depth, MATRIX, at=[(x, y)])
    assert all(is_at(one, (x, y), 2) for one in sight.proposals.masks)
    found = sought.choose(sight, *sought.seek(sight, 0, click=(x, y)))
    assert len(found) == 1 and overlap(found[0].mask, mask) > 0.85 and found.clicks == ((x, y),)
    # What is proposed elsewhere is not tried.
    nothing = sought.detect(frame.rgb, frame.depth, MATRIX, clicks=[(2, 2), (2.0, 2.0)])
    assert not len(nothing) and {one.why for one in nothing.rejected} <= {Reason.OFF_CLICK, Reason.NO_POSE}


def test_a_click_moves_with_the_lens():
    frame, matrix = make_frame(place(-0.12, 0.05)), MATRIX
    lens = Intrinsics(matrix, (0.2, 0.0, 0.0, 0.0))
    x, y = undistort_pixel((40, 60), lens, (HEIGHT, WIDTH))
    back = lens_maps(lens)[:, round(y), round(x)]
    assert np.allclose(back, (40, 60), atol=1.5)
    assert undistort_pixel((40, 60), matrix, frame.depth.shape) == (40, 60)
    with pytest.raises(ValueError, match=r"the click \(320, 5\) lies outside the image of 320 × 240"):
        undistort_pixel((320, 5), matrix, (HEIGHT, WIDTH))
    with pytest.raises(ValueError, match="a click is x, y"):
        undistort_pixel((1, 2, 3), matrix, (HEIGHT, WIDTH))


def lens_maps(lens):
    """Where each pixel of the image without distortion is in the distorted one: x, then y."""
    coefficients = np.asarray(lens.distortion)
    return np.stack(
        cv2.initUndistortRectifyMap(lens.matrix, coefficients, np.eye(3), lens.matrix, (WIDTH, HEIGHT), cv2.CV_32FC1)
    )


def test_a_known_size_is_evidence_and_same_seed_gives_same_answer():
    frame = make_frame(place(0.05, -0.02, seed=3))
    sought = detector()
    sight = sought.look(frame.rgb, frame.depth, MATRIX)
    free, right, wrong = (sought.seek(sight, 0, diameter=size)[0] for size in (None, 0.2, 0.3))
    assert right[0].value > 0.5 * free[0].value and right[0].value <= free[0].value
    assert wrong[0].value < 0.01 * free[0].value
    again = sought.seek(sight, 0)[0]
    assert np.array_equal(again[0].pose.rotation, free[0].pose.rotation) and again[0].value == free[0].value


def test_a_known_size_is_compared_with_the_size_that_is_told(monkeypatch):
    """Of an object from a photo without depth the pose's scale is that of the guessed shape."""
    frame, sought = make_frame(place(0.05, -0.02, seed=3)), detector()
    run = sought.estimator.run

    def measured(*given, **options):
        result = run(*given, **options)
        longer = 1.5 * result.estimate.camera_from_object.scale
        return dataclasses.replace(result, estimate=dataclasses.replace(result.estimate, diameter=longer))

    monkeypatch.setattr(sought.estimator, "run", measured)
    sight = sought.look(frame.rgb, frame.depth, MATRIX)
    free, right, wrong = (sought.seek(sight, 0, diameter=size)[0] for size in (None, 0.3, 0.2))
    assert right[0].value > 0.5 * free[0].value and wrong[0].value < 0.01 * free[0].value


def test_of_a_known_size_nothing_longer_is_proposed():
    frame, sought = make_frame(), detector()
    free, sized = (sought.look(frame.rgb, frame.depth, MATRIX, diameter=size) for size in (None, 0.1))
    points = unproject(MATRIX, np.indices((HEIGHT, WIDTH), float)[::-1].reshape(2, -1).T, frame.depth.reshape(-1))

    def lengths(sight):
        inside = [points[mask.reshape(-1) & (frame.depth.reshape(-1) > 0)] for mask in sight.proposals.masks]
        return np.array([np.linalg.norm(np.quantile(p, 0.95, axis=0) - np.quantile(p, 0.05, axis=0)) for p in inside])

    assert lengths(free).max() > 0.2 > 0.18 > lengths(sized).max()


def test_frames_that_cannot_be_searched_are_refused_in_words():
    frame, sought = make_frame(), detector()
    with pytest.raises(ValueError, match="depth image is empty"):
        sought.detect(frame.rgb, 0 * frame.depth, MATRIX)
    with pytest.raises(ValueError, match="no depth image"):
        sought.detect(frame.rgb, None, MATRIX)
    with pytest.raises(ValueError, match=r"looks like millimetres; pass depth_scale=0\.001"):
        sought.detect(frame.rgb, 1000 * frame.depth, MATRIX)
    with pytest.raises(ValueError, match="but depth is"):
        sought.detect(frame.rgb, frame.depth[:100], MATRIX)
    with pytest.raises(ValueError, match="at least one instance"):
        sought.detect(frame.rgb, frame.depth, MATRIX, instances=0)
    with pytest.raises(ValueError, match="2 objects and 1 diameters"):
        sought.detect(frame.rgb, frame.depth, MATRIX, diameters=[0.1])
    with pytest.raises(ValueError, match="2 objects and 1 clicks"):
        sought.detect(frame.rgb, frame.depth, MATRIX, clicks=[(1, 1)])
    for size in (0.0, -0.1, np.nan):
        with pytest.raises(ValueError, match="positive metres"):
            sought.detect(frame.rgb, frame.depth, MATRIX, diameters=[size, None])
    with pytest.raises(ValueError, match="at least one object"):
        type(sought)([], None)


def test_nothing_is_present_before_a_bare_wall():
    frame = make_frame()
    found = detector().detect(frame.rgb, frame.depth, MATRIX)
    assert not any(one.present for one in found)
    assert found.similarity.shape[0] == 2 and frame.depth.shape == (HEIGHT, WIDTH)


def test_an_object_keeps_its_own_templates():
    """Thinning and padding leave what the caller gave as it was."""
    templates, info = ellipsoid()
    assert templates.norm.shape[0] == 80 and detector().names == ["ellipsoid", "stranger"]
    assert info.resolution == 112

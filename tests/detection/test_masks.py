"""The mask of a posed object: its outline, without what hides it or is not it."""

import equinox as eqx
import jax
import numpy as np
from builders.detections import MATRIX, ellipsoid, make_frame, place

from ipjax.detection.assignment import overlap
from ipjax.detection.masks import mask_from_pose
from ipjax.inference.batching import pad_alike


def test_the_mask_is_the_visible_part_of_the_outline():
    behind, before = place(0.0, 0.0, 0.9), place(0.06, 0.0, 0.6, 0.12, seed=4)
    frame = make_frame(behind, before)
    visible, whole = mask_from_pose(ellipsoid()[0], behind, MATRIX, frame.depth)
    alone = make_frame(behind).masks[0]
    assert overlap(visible, frame.masks[0]) > 0.9 and overlap(whole, alone) > 0.93
    assert frame.masks[0].sum() < 0.9 * alone.sum()


def test_depth_that_is_unknown_is_kept_and_another_depth_is_not():
    pose = place(0.0, 0.0)
    frame = make_frame(pose)
    holes = frame.depth.copy()
    holes[:, ::3] = 0
    assert overlap(mask_from_pose(ellipsoid()[0], pose, MATRIX, holes)[0], frame.masks[0]) > 0.93
    farther = np.where(frame.depth > 0, frame.depth + np.float32(0.05), 0).astype(np.float32)
    assert not mask_from_pose(ellipsoid()[0], pose, MATRIX, farther)[0].any()


def test_gaps_between_few_points_are_closed_also_where_they_are_padded():
    templates, pose = ellipsoid()[0], place(0.0, 0.0)
    few = eqx.tree_at(lambda t: t.appearance, templates, jax.tree.map(lambda x: x[:1000], templates.appearance))
    frame = make_frame(pose)
    plain, padded = (mask_from_pose(one, pose, MATRIX, frame.depth)[1] for one in (few, pad_alike([few, templates])[0]))
    assert overlap(plain, frame.masks[0]) > 0.85 and np.array_equal(padded, plain)


def test_masks_in_double_precision_are_the_same(x64):
    pose = place(0.0, 0.0)
    frame = make_frame(pose)
    wide = mask_from_pose(ellipsoid()[0], pose, MATRIX, frame.depth.astype(np.float64))
    with jax.enable_x64(False):
        narrow = mask_from_pose(ellipsoid()[0], pose, MATRIX, frame.depth)
    assert wide[0].any() and overlap(wide[0], narrow[0]) > 0.99 and overlap(wide[1], narrow[1]) > 0.99

"""Proposals cover what is seen, whatever the frame's size and however much of its depth is missing."""

import numpy as np
import pytest
from builders.tables import BLUE, RED, THREE, table_frame

from ipjax.detection.proposals.candidates import Cutting
from ipjax.detection.proposals.propose import ProposalConfig, propose, suppress
from ipjax.records import Camera
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.scenes import make_scene


def best_overlaps(proposals, masks, first=20):
    """For each true mask the IoU of the best of the first proposals."""
    return [max(iou(made, mask) for made in proposals.masks[:first]) for mask in masks]


def iou(one, other):
    return (one & other).sum() / max((one | other).sum(), 1)


@pytest.fixture(scope="module")
def three():
    """A frame of three blocks, its proposals and the true masks."""
    rgb, depth, matrix, masks = table_frame(THREE)
    return (rgb, depth, matrix), propose(rgb, depth, matrix), masks


@pytest.fixture(scope="module")
def scene():
    kinds = ["corner", "drum", "pot"]
    return make_scene([make_object(k) for k in kinds], 5, clutter=1, oversample=1, least_visible=0.9)


def test_covers_the_objects_of_a_made_scene(scene):
    proposals = propose(scene.rgb, scene.depth, scene.camera)
    seen = scene.masks[scene.visible > 0.6]
    assert len(seen) >= 2
    assert min(best_overlaps(proposals, seen)) >= 0.7
    assert proposals.masks.shape[1:] == scene.depth.shape and proposals.masks.dtype == bool
    assert (np.diff(proposals.objectness) <= 0).all() and len(proposals.masks) <= ProposalConfig().most


def test_covers_blocks_on_a_table_with_noise_and_without(three):
    _, proposals, masks = three
    assert min(best_overlaps(proposals, masks, 10)) >= 0.85
    rgb, depth, matrix, masks = table_frame(THREE, noise=0.0)
    assert min(best_overlaps(propose(rgb, depth, matrix), masks, 10)) >= 0.85


def test_the_same_frame_gives_the_same(three):
    frame, one, _ = three
    other = propose(*frame)
    np.testing.assert_array_equal(one.masks, other.masks)
    np.testing.assert_array_equal(one.objectness, other.objectness)


def test_holes_and_half_a_frame_without_depth():
    rgb, depth, matrix, masks = table_frame(THREE)
    rng = np.random.default_rng(1)
    holes = depth.copy()
    for _ in range(25):
        y, x = rng.integers(0, 230), rng.integers(0, 310)
        holes[y : y + 9, x : x + 9] = rng.choice([0, np.nan, np.inf, -1])
    assert min(best_overlaps(propose(rgb, holes, matrix), masks)) >= 0.8
    half = depth.copy()
    half[:, 140:] = 0
    assert min(best_overlaps(propose(rgb, half, matrix), masks)) >= 0.75


def test_no_depth_at_all_leaves_colour():
    rgb, depth, matrix, masks = table_frame(THREE)
    assert min(best_overlaps(propose(rgb, np.zeros_like(depth), matrix), masks)) >= 0.75


def test_no_colour_leaves_depth():
    rgb, depth, matrix, masks = table_frame(THREE)
    assert min(best_overlaps(propose(np.full_like(rgb, 90), depth, matrix), masks)) >= 0.75


def test_two_that_touch_and_differ_in_colour_are_two():
    blocks = [((100, 80, 150, 150), RED, 0.08), ((150, 80, 200, 150), BLUE, 0.08)]
    rgb, depth, matrix, masks = table_frame(blocks)
    assert min(best_overlaps(propose(rgb, depth, matrix), masks)) >= 0.8


@pytest.mark.parametrize("height, width", [(97, 161), (33, 16), (301, 93)])
def test_odd_sizes(height, width):
    block = (int(0.3 * width), int(0.3 * height), int(0.65 * width), int(0.7 * height))
    rgb, depth, matrix, masks = table_frame([(block, RED, 0.1)], height, width)
    proposals = propose(rgb, depth, matrix)
    assert proposals.masks.shape[1:] == (height, width)
    assert min(best_overlaps(proposals, masks)) >= 0.7


def test_a_camera_in_any_form_gives_the_same():
    rgb, depth, matrix, _ = table_frame([((20, 20, 60, 60), RED, 0.1)], 80, 100)
    camera = Camera.from_matrix(matrix)
    np.testing.assert_array_equal(propose(rgb, depth, matrix).masks, propose(rgb, depth, camera).masks)


def test_a_second_resolution_finds_what_is_small():
    rgb, depth, matrix, masks = table_frame([((200, 200, 212, 214), RED, 0.03)], 400, 420)
    config = ProposalConfig()
    assert masks.mean() < config.cuttings[0].least
    assert best_overlaps(propose(rgb, depth, matrix, config), masks)[0] >= 0.7


def test_a_known_diameter_leaves_out_what_is_longer(three):
    frame, anything, masks = three
    small = propose(*frame, config=ProposalConfig(diameters=(0.2,)))
    reach = lambda found: max(np.ptp(np.stack(np.nonzero(mask)), axis=1).max() for mask in found.masks) / 300
    assert reach(small) < 1.6 * 0.2 < reach(anything)  # pixels that are a metre away
    assert best_overlaps(small, masks)[1] >= 0.8


def test_no_mask_of_an_allowed_size_is_no_error():
    grey = np.full((60, 80, 3), 100, np.uint8)
    config = ProposalConfig(cuttings=(Cutting(least=0.2499),))
    found = propose(grey, np.ones((60, 80), np.float32), (100, 100, 40, 30), config)
    assert found.masks.shape == (0, 60, 80) and found.objectness.shape == (0,)


def test_nothing_to_see_is_no_error():
    grey = np.full((60, 80, 3), 100, np.uint8)
    proposals = propose(grey, np.ones((60, 80), np.float32), (100, 100, 40, 30))
    assert proposals.masks.shape[1:] == (60, 80) and np.isfinite(proposals.objectness).all()


@pytest.mark.parametrize(
    "change, words",
    [
        ({"rgb": np.zeros((60, 80), np.uint8)}, "height × width × 3"),
        ({"rgb": np.zeros((60, 80, 3))}, "uint8, not float64"),
        ({"depth": np.zeros((60, 81), np.float32)}, "does not fit"),
        ({"depth": np.zeros((60, 80), np.uint16)}, "metres as floats"),
        ({"camera": (0, 0, 40, 30)}, "singular"),
        ({"config": ProposalConfig(diameters=(0.1, -1.0))}, "positive metres"),
        ({"config": ProposalConfig(most=0)}, "at least 1"),
        ({"config": ProposalConfig(cuttings=(Cutting(least=0.3),))}, "smaller first"),
    ],
)
def test_says_what_is_wrong(change, words):
    given = {
        "rgb": np.zeros((60, 80, 3), np.uint8),
        "depth": np.ones((60, 80), np.float32),
        "camera": (100, 100, 40, 30),
        "config": None,
    } | change
    with pytest.raises(ValueError, match=words):
        propose(given["rgb"], given["depth"], given["camera"], given["config"])


def test_too_small_an_image_is_an_error():
    with pytest.raises(ValueError, match="too small"):
        propose(np.zeros((8, 80, 3), np.uint8), np.ones((8, 80), np.float32), (100, 100, 40, 4))


def test_suppression_keeps_the_better_of_two():
    masks = np.zeros((3, 10, 12), bool)
    masks[0, 2:8, 2:8] = masks[1, 2:8, 2:9] = masks[2, 0:3, 9:12] = True
    kept = suppress(masks, np.array([0.5, 0.9, 0.1]), overlap=0.7, most=5)
    assert kept.tolist() == [1, 2]
    assert suppress(masks, np.array([0.5, 0.9, 0.1]), overlap=0.95, most=2).tolist() == [1, 0]

"""A gripper drawn into the camera's image, at the grasps that were planned."""

import itertools
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from ipjax.cameras import project, resize
from ipjax.files.cameras.reading import as_intrinsics
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.cards import INK, find_font, to_fixed_point
from ipjax.inference.drawing import PALETTE, draw_overlay
from ipjax.robot.grasps.hands import closing_from_gripper, hand_boxes, make_hand
from ipjax.robot.records import Grasps, Gripper, place_grasps, rigid
from ipjax.transforms import Similarity

BEST, OTHERS = (255, 214, 64), (170, 178, 196)
_SHOWN = 6  # grasps: the best whole, the others as lines
_EDGES = [(a, b) for a, b in itertools.combinations(range(8), 2) if bin(a ^ b).count("1") == 1]


def draw_grasps(
    rgb: UInt8[np.ndarray, "h w 3"],
    camera,
    gripper: Gripper,
    grasps: Grasps,
    camera_from_object: Similarity,
    info: ObjectInfo,
    *,
    height: int = 900,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The photo with the object at its pose and the open gripper at the best grasp, its contacts, and a few others.

    Args:
        rgb: the photo, uint8.
        camera: of the photo, as `draw_overlay` takes it.
        gripper, grasps: of one object, best first.
        camera_from_object: of the estimate, with its scale.
        info: of the object.
        height: of the picture, pixels.

    Raises:
        ValueError: rgb is no uint8 image.
    """
    image = draw_overlay(rgb, camera, [camera_from_object], [info], height=height, colours=PALETTE)
    K = resize(as_intrinsics(camera).matrix, rgb.shape[1::-1], image.shape[1::-1])
    stroke = max(round(image.shape[0] / 450), 1)
    valid = np.flatnonzero(np.asarray(grasps.valid))[:_SHOWN]
    poses = place_grasps(grasps.object_from_gripper.to_numpy(), camera_from_object.to_numpy())
    for index in valid[:0:-1]:
        _draw_fork(image, K, gripper, poses.take(int(index)), OTHERS, stroke)
    if len(valid):
        _draw_hand(image, K, gripper, poses.take(int(valid[0])), stroke)
        contacts = rigid(camera_from_object.to_numpy()) @ np.asarray(grasps.contacts[valid[0]], np.float64)
        if (contacts[:, 2] > 1e-3).all():
            for pixel in project(K, contacts):
                cv2.circle(image, to_fixed_point(pixel), 16 * 3 * stroke, (220, 40, 60), -1, cv2.LINE_AA, 4)
    canvas = Image.fromarray(image)
    text = "no grasp"
    if len(valid):
        best = {name: float(getattr(grasps, name)[valid[0]]) for name in ("score", "width", "spare", "safe")}
        text = (
            f"{info.name}, {gripper.name}: score {best['score']:.2f}, closes on {1e3 * best['width']:.0f} mm, "
            f"{1e3 * best['spare']:.0f} mm to spare per finger, holds at {best['safe']:.0%} of likely poses"
        )
    place = (6 * stroke, image.shape[0] - 6 * stroke)
    ImageDraw.Draw(canvas).text(place, text, INK, find_font(9 * stroke), "lb", stroke_width=2, stroke_fill=(10, 10, 10))
    return np.array(canvas)


def _hand_boxes(gripper: Gripper) -> Float[np.ndarray, "k 8 3"]:
    """The corners of the open hand's boxes, fingers first, gripper's frame, in doubles."""
    low, high = (np.asarray(x, np.float64) for x in hand_boxes(make_hand(gripper, np.float32)))
    picks = np.array(list(itertools.product((0, 1), repeat=3)))
    both = np.stack([low, high])
    corners = np.stack([both[picks[:, a], :, a] for a in range(3)], axis=-1).swapaxes(0, 1)
    return corners @ closing_from_gripper(gripper.closing)  # rows: the inverse rotation


def _draw_hand(image: np.ndarray, K: np.ndarray, gripper: Gripper, pose: Similarity[np.ndarray], stroke: int) -> None:
    """The hand's boxes, far ones first, as glass with edges."""
    boxes = [pose @ corners for corners in _hand_boxes(gripper)]
    for corners in sorted(boxes, key=lambda c: -c[:, 2].mean()):
        if (corners[:, 2] < 1e-3).any():
            continue
        pixels = np.clip(project(K, corners), -1e4, 1e4)
        hull = cv2.convexHull(np.round(pixels).astype(np.int32))
        glass = image.copy()
        cv2.fillConvexPoly(glass, hull, BEST, cv2.LINE_AA)
        cv2.addWeighted(glass, 0.3, image, 0.7, 0, image)
        for a, b in _EDGES:
            _line(image, pixels[a], pixels[b], BEST, stroke)


def _draw_fork(
    image: np.ndarray, K: np.ndarray, gripper: Gripper, pose: Similarity[np.ndarray], colour, stroke: int
) -> None:
    """A hand as a fork of lines: the approach, the bar between the fingers, and the fingers."""
    half, tip, root = (float(x) for x in (gripper.opening / 2, gripper.tip, gripper.tip - gripper.finger[0]))
    lines = np.array(
        [[[0, 0, 0], [0, 0, root]], [[-half, 0, root], [half, 0, root]]]
        + [[[u, 0, root], [u, 0, tip]] for u in (-half, half)]
    )
    points = pose @ (lines.reshape(-1, 3) @ closing_from_gripper(gripper.closing))
    if (points[:, 2] < 1e-3).any():
        return
    for a, b in np.clip(project(K, points), -1e4, 1e4).reshape(-1, 2, 2):
        _line(image, a, b, colour, stroke)


def _line(image: np.ndarray, a: Sequence[float] | np.ndarray, b, colour, stroke: int) -> None:
    start, end = to_fixed_point(np.asarray(a)), to_fixed_point(np.asarray(b))
    cv2.line(image, start, end, (10, 10, 10), stroke + 2, cv2.LINE_AA, 4)
    cv2.line(image, start, end, colour, stroke, cv2.LINE_AA, 4)

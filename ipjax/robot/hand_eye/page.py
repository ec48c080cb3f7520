"""A page of a calibration: the answer, each view's errors, and the board drawn where the calibration has it."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ipjax.cameras import project, resize_pixels
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.images.opening import read_rgb
from ipjax.files.pages import embed_image, render_page
from ipjax.files.storage.writing import write_text
from ipjax.inference.cards import to_fixed_point
from ipjax.inference.cutting import undistort_frame
from ipjax.robot.hand_eye.from_files import Outcome
from ipjax.robot.hand_eye.reading.observing import Observation
from ipjax.transforms import Similarity

_TEMPLATE = Path(__file__).with_name("page.html.jinja")
_WIDE = 420  # pixels of a picture
_MOST = 60  # pictures
_SEEN, _TOLD = (74, 222, 128), (251, 146, 60)


def write_page(path: Path, outcome: Outcome, intrinsics: Intrinsics) -> Path:
    """Write the page; returns its path.

    Raises:
      ValueError: an image is not there any more.
      OSError: it cannot be written.
    """
    found, noise = outcome.calibration.found, outcome.calibration.found.noise
    rows = {view.name: view for view in outcome.views}
    numbers = {view.name: i for i, view in enumerate(outcome.views)}
    pictures = []
    for one in outcome.observations[:_MOST]:
        view = rows.get(one.name)
        told = None if view is None else outcome.told.take(numbers[one.name])
        text = one.reason if view is None else f"{np.degrees(view.rotation):.2f}°, {1000 * view.translation:.1f} mm"
        picture = embed_image(draw_view(one, told, outcome.board.span, intrinsics), "jpg")
        wrong = one.name in outcome.calibration.wrong
        pictures.append({"name": one.name, "text": text, "image": picture, "wrong": wrong, "lost": view is None})
    turn, shift = found.deviations
    rotation, translation = outcome.typical
    facts = [
        ("answer", f"{found.answer}, metres"),
        ("camera", "on the hand" if found.eye == "in-hand" else "beside the robot; the board is in the hand"),
        ("how sure", f"± {np.degrees(turn):.3f}°, ± {1000 * shift:.2f} mm (one standard deviation)"),
        ("a view without it", f"off by {np.degrees(rotation):.2f}° and {1000 * translation:.1f} mm (median)"),
        ("robot, each axis", f"± {np.degrees(noise.rotation):.3f}°, ± {1000 * noise.translation:.2f} mm"),
        ("corners", f"± {outcome.corner_noise:.2f} pixels"),
        ("board", outcome.board.word),
        ("views", f"{len(found.used)} of {len(outcome.observations)} images"),
    ]
    values: dict[str, Any] = {
        "answer": found.answer,
        "matrix": [[f"{x:.6f}" for x in row] for row in found.mount_from_camera.to_matrix().tolist()],
        "facts": facts,
        "warnings": [*outcome.calibration.wrong.values(), *outcome.notes],
        "views": [
            {
                "name": view.name,
                "counted": view.counted,
                "corners": view.corners,
                "own": f"{view.own_pixels:.2f}",
                "pixels": f"{view.pixels:.2f}",
                "rotation": f"{np.degrees(view.rotation):.3f}",
                "translation": f"{1000 * view.translation:.2f}",
            }
            for view in outcome.views
        ],
        "pictures": pictures,
        "more": len(outcome.observations) - len(pictures),
    }
    return write_text(path, render_page(_TEMPLATE, **values))


def draw_view(
    observation: Observation,
    told: Similarity[np.ndarray] | None,
    span: tuple[float, float],
    intrinsics: Intrinsics,
) -> UInt8[np.ndarray, "h w 3"]:
    """An image without distortion, smaller, with the corners that were found and where the calibration has the board.

    Args:
      told: ``camera_from_board`` by the calibration; None = there is none.
      span: width and height of the board, metres.
    """
    rgb = read_rgb(observation.path)
    if intrinsics.distortion:
        rgb = undistort_frame(rgb, np.zeros(rgb.shape[:2], np.float32), None, None, intrinsics)[0]
    before = rgb.shape[1], rgb.shape[0]
    after = (_WIDE, max(1, round(_WIDE * before[1] / before[0])))
    picture = cv2.resize(rgb, after, interpolation=cv2.INTER_AREA)
    if observation.sighting is not None:
        for pixel in resize_pixels(observation.sighting.pixels, before, after):
            cv2.circle(picture, to_fixed_point(pixel), 3 * 16, _SEEN, 1, cv2.LINE_AA, 4)
    if told is not None:
        wide, high = span
        rim = np.array([[0, 0, 0], [wide, 0, 0], [wide, high, 0], [0, high, 0]], np.float64)
        _draw_outline(picture, resize_pixels(project(intrinsics.matrix, told @ rim), before, after))
    return picture


def _draw_outline(picture: UInt8[np.ndarray, "h w 3"], corners: Float[np.ndarray, "4 2"]) -> None:
    if np.abs(corners).max() < 1e4:
        for one, other in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            cv2.line(picture, to_fixed_point(one), to_fixed_point(other), _TOLD, 2, cv2.LINE_AA, 4)

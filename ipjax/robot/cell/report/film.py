"""A film of a pick: its recording, drawn by the renderer that draws all else, and written as MP4 or GIF."""

import io
import logging
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from ipjax.cameras import middle
from ipjax.capture.views.paths import look_from
from ipjax.files.storage.writing import write_bytes, writing
from ipjax.inference.cards import find_font
from ipjax.records import Camera
from ipjax.rendering.render import render_frames
from ipjax.robot.cell.appearance import list_shown, surroundings
from ipjax.robot.cell.cell import MIDDLE, Cell
from ipjax.robot.cell.picking import Recording
from ipjax.transforms import Similarity

log = logging.getLogger("ipjax")

SIZE = (640, 480)
WORDS = {
    "move": "to the place before the grasp",
    "approach": "straight to the grasp",
    "close": "close",
    "lift": "lift",
    "hold": "hold",
}


def draw_film(
    cell: Cell,
    recording: Recording,
    *,
    every: int = 1,
    size: tuple[int, int] = SIZE,
    oversample: int = 1,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> UInt8[np.ndarray, "f h w 3"]:
    """The frames of a film, seen from beside the table, with the stage and the time written on them.

    Args:
      every: takes every so manieth frame of the recording.
      size: width and height, pixels.

    Raises:
      RenderError: nothing can draw, with a given `backend`.
    """
    width, height = size
    place = np.array([MIDDLE[0] + 0.72, MIDDLE[1] - 0.92, 0.62])
    base_from_camera = look_from(
        place[None], np.array([MIDDLE[0] - 0.14, MIDDLE[1], 0.26]), np.array([0.0, 0, 1])
    ).take(0)
    camera = Camera.from_matrix(np.array([[0.95 * width, 0, 0], [0, 0.95 * width, 0], [0, 0, 1.0]]))
    camera = Camera(camera.focal, camera.centre + middle(width, height).astype(np.float32))
    camera_from_base = base_from_camera.inverse()
    bodies = recording.base_from_body.take(slice(None, None, every))
    count = len(bodies.translation)
    still = Similarity(*(np.repeat(x[None], count, 0) for x in (np.eye(3), np.zeros(3), np.ones(()))))

    def move(body: int) -> Similarity[np.ndarray]:
        one = Similarity(bodies.rotation[:, body], bodies.translation[:, body], bodies.scale[:, body])
        return camera_from_base @ one

    shown = [(mesh, move(body)) for mesh, body in list_shown(cell)]
    shown += [(mesh, camera_from_base @ still) for mesh in surroundings(cell)]
    light = {
        "direction": camera_from_base.rotation @ np.array([-0.3, 0.4, -1.0]),
        "ambient": 0.55,
        "diffuse": 0.5,
    }
    drawn = render_frames(
        shown, camera, height, width, light=light, oversample=oversample, backend=backend, progress=progress
    )
    times, stages = recording.times[::every], recording.stages[::every]
    return np.stack(
        [
            _label(image, WORDS.get(stage, stage), time)
            for image, stage, time in zip(drawn.rgb, stages, times, strict=True)
        ]
    )


def write_film(path: str | Path, frames: UInt8[np.ndarray, "f h w 3"], rate: float | int) -> Path:
    """Write a film: MP4 (MPEG-4), or where no encoder for it works a GIF of half the size beside it.

    Args:
      path: its name ends in .mp4 or .gif.
      rate: frames a second.

    Returns:
      The path that was written.

    Raises:
      ValueError: another ending.
      OSError: it cannot be written.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"{path}: a film's name ends in .mp4 or .gif")
    if path.suffix == ".mp4":
        with writing(path) as temporary:
            encoded = _encode(temporary, frames, rate)
        if encoded:
            return path
        path.unlink()  # empty
        path = path.with_suffix(".gif")
        log.warning("OpenCV has no encoder for MP4 here: the film is %s", path.name)
    return write_bytes(path, animate(frames[:, ::2, ::2], rate, "GIF"))


def animate(frames: UInt8[np.ndarray, "f h w 3"], rate: float | int, kind: str) -> bytes:
    """Frames as an animated image that plays for ever; ``kind`` is "GIF" or "WEBP", which pages embed."""
    images = [Image.fromarray(np.ascontiguousarray(frame)) for frame in frames]
    more = {"quality": 70, "method": 2} if kind == "WEBP" else {}
    memory = io.BytesIO()
    images[0].save(memory, kind, save_all=True, append_images=images[1:], duration=round(1000 / rate), loop=0, **more)
    return memory.getvalue()


def _encode(path: Path, frames: np.ndarray, rate: float | int) -> bool:
    """Whether OpenCV could write the film."""
    height, width = frames.shape[1:3]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), float(rate), (width, height))
    try:
        if not writer.isOpened():
            return False
        for frame in frames:
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
    finally:
        writer.release()
    return path.stat().st_size > 0


def _label(image: np.ndarray, words: str, time: float) -> np.ndarray:
    picture = Image.fromarray(image)
    pen = ImageDraw.Draw(picture)
    font = find_font(max(len(image) // 26, 10))
    for offset, colour in ((1, (0, 0, 0)), (0, (255, 255, 255))):
        pen.text((10 + offset, 8 + offset), f"{time:4.1f} s   {words}", fill=colour, font=font)
    return np.asarray(picture)

"""A simulated pick as one self-contained HTML page."""

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from ipjax.files.pages import embed_image, render_page
from ipjax.files.storage.writing import write_text
from ipjax.robot.cell.picking import Pick, Recording
from ipjax.robot.cell.report.film import WORDS, animate

_TEMPLATE = Path(__file__).with_name("page.html.jinja")


def write_page(
    path: str | Path,
    title: str,
    done: Pick,
    photo: UInt8[np.ndarray, "h w 3"],
    overlay: UInt8[np.ndarray, "h2 w2 3"],
    grasp: UInt8[np.ndarray, "h3 w3 3"] | None,
    film: UInt8[np.ndarray, "f h4 w4 3"] | None,
    *,
    lead: str,
    pose_title: str,
    every: int,
    facts: Sequence[tuple[str, str]] = (),
    notes: Sequence[str] = (),
) -> None:
    """Write the page: outcome, film, what the camera saw, the pose, the grasp, the stages and the figures.

    Args:
      photo: of the camera.
      overlay: the pose drawn into it.
      grasp: the hand drawn into it; None where there is no grasp.
      film: None where none was drawn.
      every: which frames of the recording the film has.
      facts: name and value of each figure.

    Raises:
      OSError: it cannot be written.
    """
    stages, moving = [], ""
    if film is not None and done.recording is not None:
        stages = _pick_stages(done.recording, film, every)
        data = animate(film, done.recording_rate / every, "WEBP")
        moving = f"data:image/webp;base64,{base64.b64encode(data).decode()}"
    page = render_page(
        _TEMPLATE,
        title=title,
        lead=lead,
        success=done.success,
        verdict=("Success: " if done.success else "Failure: ") + done.why + ".",
        notes=list(notes),
        film=moving,
        photo=embed_image(photo, "jpg"),
        overlay=embed_image(overlay, "jpg"),
        pose_title=pose_title,
        grasp="" if grasp is None else embed_image(grasp, "jpg"),
        stages=stages,
        facts=list(facts),
    )
    write_text(path, page)


def _pick_stages(recording: Recording, film: np.ndarray, every: int) -> list[dict[str, str]]:
    """The last frame of every stage."""
    names = recording.stages[::every]
    last = {name: number for number, name in enumerate(names)}
    return [{"name": WORDS.get(n, n), "image": embed_image(film[i], "jpg", 82)} for n, i in last.items()]

"""What the cell's camera sees is what is there: poses, masks and depth agree; films show where things were."""

import cv2
import numpy as np
import pytest
from builders.cells import grasp_from_above, lie, make_block
from PIL import Image

from ipjax.cameras import project, unproject
from ipjax.robot.cell.camera import look
from ipjax.robot.cell.cell import make_cell
from ipjax.robot.cell.picking import PickConfig, pick
from ipjax.robot.cell.report import film
from ipjax.robot.cell.report.film import animate, draw_film, write_film
from ipjax.synthetic.sensor import PERFECT


@pytest.fixture(scope="module")
def cell():
    return make_cell([make_block()], 3, arm="gantry", base_from_object=[lie()], masses=[0.4])


@pytest.mark.parametrize("place", ["fixed", "wrist"])
def test_poses_masks_and_depth_are_of_one_scene(cell, place):
    sight = look(cell, place, sensor=PERFECT, oversample=1)
    seen = sight.masks[0]
    assert 1000 < seen.sum() < 60000
    rows, columns = np.nonzero(seen)
    points = unproject(sight.matrix, np.stack([columns, rows], -1).astype(float), sight.depth[seen].astype(float))
    inside = sight.camera_from_object[0].inverse() @ points
    beyond = np.abs(inside) - np.array([0.08, 0.025, 0.025])
    assert np.abs(beyond.max(1)).max() < 0.001  # all of them on the block's surface
    above = sight.base_from_camera @ points
    assert above[:, 2].min() > -0.001 and above[:, 2].max() < 0.051
    middle = project(sight.matrix, sight.camera_from_object[0].translation[None])[0]
    assert np.abs(middle - [columns.mean(), rows.mean()]).max() < 15


def test_what_a_sensor_adds_follows_from_the_seed(cell):
    first, second = look(cell, oversample=1), look(cell, oversample=1)
    assert (first.rgb == second.rgb).all() and (first.depth == second.depth).all()
    perfect = look(cell, sensor=PERFECT, oversample=1)
    known = first.depth > 0
    assert (known & (perfect.depth > 0)).mean() > 0.5 and not (first.depth[known] == perfect.depth[known]).all()
    with pytest.raises(ValueError, match="one of fixed, wrist"):
        look(cell, "ceiling")


@pytest.fixture(scope="module")
def frames(cell):
    done = pick(cell, grasp_from_above(cell), config=PickConfig(frames=2))
    return draw_film(cell, done.recording, size=(160, 120)), done.recording


def test_a_film_shows_that_the_thing_rises(frames):
    drawn, recording = frames
    assert drawn.shape == (len(recording.times), 120, 160, 3)
    assert np.abs(drawn[0].astype(int) - drawn[-1]).mean() > 1
    assert recording.stages[-1] == "hold"


def test_films_are_written_as_mp4_or_gif(frames, tmp_path, monkeypatch):
    drawn, _ = frames
    path = write_film(tmp_path / "film.mp4", drawn, 5)
    reader = cv2.VideoCapture(str(path))
    good, first = reader.read()
    assert good and int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) == len(drawn)
    assert np.abs(first[..., ::-1].astype(int) - drawn[0]).mean() < 6
    reader.release()

    monkeypatch.setattr(film, "_encode", lambda *_: False)
    path = write_film(tmp_path / "other.mp4", drawn, 5)
    assert path.name == "other.gif" and not (tmp_path / "other.mp4").exists()
    with Image.open(path) as image:
        assert image.n_frames > 1 and image.size == (80, 60)
    assert animate(drawn, 5, "WEBP")[8:12] == b"WEBP"
    with pytest.raises(ValueError, match=r"\.mp4 or \.gif"):
        write_film(tmp_path / "film.avi", drawn, 5)

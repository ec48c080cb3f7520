"""Masks where the model lacks a part of the object's surface."""

import numpy as np

from ipjax.capture.labels.masks import label_frames
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.making import ObjectModel
from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.transforms import Similarity

K = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])
SIDE, NEAR = 0.1, 0.5  # metres: of a cube, and from the camera to its front


def make_cube(*, open_front: bool) -> Mesh:
    """A cube in metres; its front is at −z, towards the camera."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * SIDE / 2
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (1, 5, 7, 3), (0, 2, 6, 4)]
    sides = sides[:-1] if open_front else sides
    faces = [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))]
    return make_mesh(corners, np.array(faces), colours=np.full((8, 3), 120, np.uint8))


def look(occluder: bool) -> PosedFrame:
    """The whole cube before nothing, seen from the front; with a board before its left half, 4 cm nearer."""
    depth = np.zeros((120, 160), np.float32)
    half = SIDE / 2 / NEAR * 150
    rows, columns = np.mgrid[:120, :160]
    depth[(abs(columns - 79.5) < half) & (abs(rows - 59.5) < half)] = NEAR
    if occluder:
        depth[:, :80] = NEAR - 0.04
    still = Similarity(np.eye(3), np.zeros(3), np.ones(()))
    return PosedFrame("0", np.full((120, 160, 3), 120, np.uint8), depth, np.ones((120, 160), bool), K, still)


def label(open_front: bool, occluder: bool = False) -> np.ndarray:
    mesh = make_cube(open_front=open_front)
    pose = Similarity(np.eye(3), np.array([0, 0, NEAR + SIDE / 2]), np.ones(()))
    model = ObjectModel("cube", mesh, pose)
    return label_frames([model], [look(occluder)])[0].visible[0]


def test_a_hole_in_the_model_hides_nothing():
    whole, lacking = label(False), label(True)
    assert whole.sum() > 800
    assert (whole & lacking).sum() > 0.97 * (whole | lacking).sum()


def test_what_is_before_the_model_hides_it():
    for open_front in (False, True):
        seen = label(open_front, occluder=True)
        assert not seen[:, :78].any() and seen[:, 82:].sum() > 300

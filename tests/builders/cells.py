"""Boxes to be picked, and hands right above them."""

import numpy as np

from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.robot.cell.cell import Cell
from ipjax.transforms import Similarity

SIDES = (0.16, 0.05, 0.05)  # metres


def make_block(sides=SIDES) -> Mesh:
    """A box, metres, its middle at the origin."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(sides) / 2
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([[q[i] for i in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))])
    return make_mesh(corners, faces)


def lie(x=0.5, y=0.0, turn=0.3, sides=SIDES) -> Similarity:
    """``base_from_object`` of a box that lies on the table, turned about the vertical."""
    c, s = np.cos(turn), np.sin(turn)
    return Similarity(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([x, y, sides[2] / 2]), np.ones(()))


def grasp_from_above(cell: Cell, along: float = 0.0, up: float = 0.0) -> Similarity:
    """``base_from_gripper`` [1]: the hand above the first thing, closing along its y or z, its pads at its middle."""
    pose = cell.base_from_object[0]
    level = pose.rotation[:, 1 if abs(pose.rotation[2, 1]) < 0.5 else 2] * [1, 1, 0]
    closing = level / np.linalg.norm(level)
    down = np.array([0.0, 0, -1])
    across = np.cross(closing, down)
    columns = [across, closing, down] if cell.gripper.closing == "y" else [closing, np.cross(down, closing), down]
    at = pose.translation + along * pose.rotation[:, 0] + np.array([0, 0, up + float(cell.gripper.reach)])
    return Similarity(np.stack(columns, 1)[None], at[None], np.ones(1))

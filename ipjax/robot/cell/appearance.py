"""What is to be seen of a cell: a mesh for every body of the robot, the things, the table and the room."""

import functools
from typing import Any

import numpy as np

from ipjax.files.meshes.mesh import Mesh, make_mesh, move
from ipjax.files.meshes.simplification import simplify
from ipjax.robot.cell.cell import MIDDLE, Cell
from ipjax.robot.cell.physics import load_mujoco
from ipjax.synthetic.tables import make_room
from ipjax.transforms import Similarity

_MOST = 2500  # faces of a geom: with all of them a film takes twice as long on a CPU, and looks the same
_SHOWN = 2  # the group of geoms that are seen; those of another only collide


@functools.lru_cache(maxsize=4)
def robot_meshes(model: Any) -> tuple[tuple[int, Mesh], ...]:
    """The robot's bodies that can be seen: each its number in the model and its mesh in the body's frame, metres."""
    found: dict[int, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    for geom in range(model.ngeom):
        if model.geom_group[geom] == _SHOWN:
            found.setdefault(int(model.geom_bodyid[geom]), []).append(_geom_mesh(model, geom))
    meshes = []
    for body, pieces in sorted(found.items()):
        starts = np.cumsum([0] + [len(vertices) for vertices, _, _ in pieces])
        faces = np.concatenate([faces + start for (_, faces, _), start in zip(pieces, starts[:-1], strict=True)])
        vertices = np.concatenate([vertices for vertices, _, _ in pieces])
        colours = np.concatenate([colours for _, _, colours in pieces])
        meshes.append((body, make_mesh(vertices, faces, colours=colours)))
    return tuple(meshes)


def list_shown(cell: Cell) -> list[tuple[Mesh, int]]:
    """What moves: the things, in their order, then the robot; each a mesh and the number of its body."""
    things = [(thing.mesh, cell.model.body(thing.body).id) for thing in cell.things]
    return things + [(mesh, body) for body, mesh in robot_meshes(cell.model)]


def surroundings(cell: Cell) -> list[Mesh]:
    """Table and room, base frame; their colours follow from the cell's seed."""
    return [
        move(mesh, np.eye(3), np.array([*MIDDLE, 0.0])) for mesh in make_room(np.random.default_rng([cell.seed, 97]))
    ]


def _geom_mesh(model: Any, geom: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices in the body's frame, faces, and colours [n 3] of one geom."""
    mujoco = load_mujoco()
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        number = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
        vertices = model.mesh_vert[first : first + count].astype(np.float64)
        first, count = model.mesh_faceadr[number], model.mesh_facenum[number]
        faces = model.mesh_face[first : first + count].astype(np.int64)
        vertices, faces, _ = simplify(vertices, faces, None, _MOST)
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        vertices, faces = _box(size)
    else:
        raise ValueError(f"geom {geom} of the robot is neither a mesh nor a box")
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    body_from_geom = Similarity(turn.reshape(3, 3), model.geom_pos[geom].copy(), np.ones(()))
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    colours = np.tile((255 * rgba[:3]).round().astype(np.uint8), (len(vertices), 1))
    return body_from_geom @ vertices, faces, colours


def _box(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A box whose sides share no corners: each is shaded for itself."""
    vertices, faces = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            along, across = np.roll(np.eye(3), axis, axis=1)[1:] * sign ** np.array([[1], [0]])
            out = sign * np.eye(3)[axis]
            corners = [out + a * along + b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            faces += [[len(vertices) + i for i in face] for face in ((0, 1, 2), (0, 2, 3))]
            vertices += [half * corner for corner in corners]
    return np.array(vertices), np.array(faces)

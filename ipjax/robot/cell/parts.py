"""Convex parts of a mesh, with which it collides: by CoACD (Wei et al., SIGGRAPH 2022), or its hull; checked by volume.

MuJoCo lets convex things collide. A mesh whose hull is hardly larger than itself is its hull. Of any other the parts
are made once, kept in the cache by the mesh's content, and compared with it by volume.
"""

import dataclasses
import hashlib
import logging
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from ipjax.files.meshes.mesh import Mesh, number_places
from ipjax.files.storage.cache import cache_folder
from ipjax.files.storage.writing import writing

log = logging.getLogger("ipjax")

CONVEX = 1.12  # times the mesh's volume, up to which its hull stands for it
FILLED = 1.5  # times the mesh's volume, above which parts close what is hollow
_MOST, _CORNERS = 32, 64  # parts, and corners of each
_VERSION = 1  # of the settings of the decomposition: part of the cache's names


@dataclasses.dataclass(frozen=True)
class Parts:
    """What a thing collides as."""

    corners: tuple[Float[np.ndarray, "_ 3"], ...]  # of each convex part, the mesh's units
    volume: float  # of all parts, the mesh's units³
    filled: float  # the same by the volume that the mesh encloses; 0 where that is not known
    method: str  # hull or coacd
    notes: tuple[str, ...] = ()  # what is to be said about them, a sentence each


def make_parts(mesh: Mesh, name: str = "the mesh", method: str = "auto") -> Parts:
    """The convex parts of a mesh.

    Args:
      mesh: any unit.
      name: for the notes.
      method: "auto", "hull" (for what stands in the way), or "coacd".

    Raises:
      ValueError: the mesh is flat, or the method is unknown; or CoACD is asked for and not installed.
    """
    if method not in ("auto", "hull", "coacd"):
        raise ValueError(f"unknown convex parts {method!r}: auto, hull or coacd")
    try:
        hull = ConvexHull(mesh.vertices)
    except QhullError:
        raise ValueError(f"{name} is flat: it has no inside, and cannot be grasped") from None
    vertices, faces = _merge(mesh)
    inside = _enclosed(vertices, faces)
    whole = Parts((mesh.vertices[hull.vertices],), float(hull.volume), _ratio(hull.volume, inside), "hull")
    if method == "hull" or (method == "auto" and 0 < whole.filled < CONVEX):
        return whole
    try:
        import coacd  # noqa: F401
    except ImportError:
        if method == "coacd":
            raise ValueError("CoACD is not installed: pip install 'ipjax[robot]'") from None
        why = f"{name} collides as its convex hull, {_times(whole)}: for its convex parts pip install 'ipjax[robot]'"
        return dataclasses.replace(whole, notes=(why,))
    corners = _cached_parts(vertices, faces)
    volume = float(sum(ConvexHull(part).volume for part in corners))
    parts = Parts(corners, volume, _ratio(volume, inside), "coacd")
    if parts.filled > FILLED:
        note = f"{len(corners)} convex parts of {name} are {_times(parts)}: hollows and thin walls are filled"
        parts = dataclasses.replace(parts, notes=(note,))
    if volume > 1.02 * whole.volume or volume < 0.5 * inside:
        note = f"the convex parts of {name} are {_times(parts)}, which cannot be: it collides as its convex hull"
        return dataclasses.replace(whole, notes=(note,))
    return parts


def _times(parts: Parts) -> str:
    return f"{parts.filled:.2g} times its volume" if parts.filled else "of no known share of its volume"


def _ratio(volume: float, inside: float) -> float:
    return float(volume) / inside if inside > 0 else 0.0


def _merge(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces with those at one place, which differ in texture, made one."""
    place = number_places(mesh.vertices)
    _, first = np.unique(place, return_index=True)
    faces = place[mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return np.ascontiguousarray(mesh.vertices[first], np.float64), np.ascontiguousarray(faces[whole], np.int32)


def _enclosed(vertices: np.ndarray, faces: np.ndarray) -> float:
    """The volume that a mesh encloses; 0 where more than a hundredth of its edges are open, or it is inside out."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    if (count != 2).mean() > 0.01:
        return 0.0
    a, b, c = ((vertices - vertices.mean(0))[faces[:, i]] for i in range(3))
    return max(float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6), 0.0)


def _cached_parts(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, ...]:
    digest = hashlib.sha256(vertices.tobytes() + faces.tobytes() + bytes([_VERSION])).hexdigest()
    path = cache_folder("parts") / f"{digest}.npz"
    if path.is_file():
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
                return tuple(stored[key] for key in sorted(stored.files))
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            log.info("%s cannot be read, and is made again", path)
    corners = tuple(_decompose(vertices, faces))
    try:
        named: dict[str, Any] = {f"part{i:03d}": part for i, part in enumerate(corners)}
        with writing(path, parents=True) as temporary:
            np.savez(temporary, **named)
    except OSError as error:
        log.info("convex parts are not kept: %s", error)
    return corners


def _decompose(vertices: np.ndarray, faces: np.ndarray) -> Iterator[np.ndarray]:
    """Corners of each part. CoACD wants things of about unit size; its search is seeded."""
    import coacd

    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=0.06,
        max_convex_hull=_MOST,
        preprocess_resolution=50,
        mcts_nodes=10,
        mcts_iterations=60,
        mcts_max_depth=2,
        decimate=True,
        max_ch_vertex=_CORNERS,
    )
    for points, _ in found:
        try:
            yield np.asarray(points, np.float64)[ConvexHull(points).vertices]
        except QhullError:
            continue  # a flake

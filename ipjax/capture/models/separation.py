"""Which parts of the scene's surface are objects: what stands on the support, apart from what stands beside it."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, KDTree

from ipjax.cameras import project, unproject
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.splitting import Seams, make_affinity, split_alone, split_by_seeds
from ipjax.capture.models.support import Support
from ipjax.capture.models.surfaces import cut, number_pieces
from ipjax.capture.records import CaptureError
from ipjax.files.meshes.mesh import Mesh, corner_products

_SEED = 0.008  # metres about a clicked point that are surely the object's
_NEAR = 0.02  # metres from the surface within which a click is on it
_HIDDEN = 0.01  # metres behind what a frame measured, at which it does not see a point
_FOOT = 0.01  # metres above the support: what is lower is where a thing stands
_STANDS = 0.02  # metres above the support, below which a piece begins that is a thing by itself
_APART = 0.03  # metres between pieces of one thing, where what is between them was not seen
_INNER = 0.25  # of a piece's area, below which another under it is a part of it
_WITHIN = 0.7  # of its points
_BESIDE = 0.006  # … and between a thing and a small piece that belongs to it


@dataclasses.dataclass(frozen=True)
class Hint:
    """What a person says of an object: a pixel that shows it, or a box around it, in one frame."""

    name: str
    frame: str | None  # the frame's name; None = the first
    x: float | int
    y: float | int
    right: float | int | None = None  # of a box, whose left upper corner is (x, y)
    bottom: float | int | None = None


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of the surface that is one object."""

    name: str
    mesh: Mesh  # in world
    hinted: bool


def separate(
    surface: Mesh,
    support: Support,
    frames: Sequence[PosedFrame],
    hints: Sequence[Hint] = (),
    *,
    cut_at: float,
    least_area: float,
    least_height: float,
    seams: Seams,
    alone: bool = True,
) -> list[Part]:
    """The objects on the support, those that were hinted at first, the others from the largest to the smallest.

    Args:
      surface: of the scene, in world.
      hints: where several are on one connected piece, it is divided among them.
      cut_at: metres above the support below which the surface is the support's.
      least_area: metres²: pieces with less are no objects.
      least_height: metres that an object rises above the support.
      alone: also divide pieces that no hint divides.

    Raises:
      CaptureError: nothing stands there, or a hint is not on anything that does.
    """
    rest = _cut_off(surface, support, cut_at)
    piece = number_pieces(len(rest.vertices), rest.faces)
    share = np.linalg.norm(corner_products(rest.vertices, rest.faces), axis=-1) / 2
    area = np.bincount(piece[rest.faces[:, 0]], share, piece.max() + 1)
    height = support.heights(rest.vertices)
    top, foot = np.zeros(len(area)), np.full(len(area), np.inf)
    np.maximum.at(top, piece, height)
    np.minimum.at(foot, piece, height)
    large = (area > least_area) & (top > least_height)
    if not large.any():
        raise CaptureError("nothing that stands on the support is large enough to be an object")
    seeds = [_place_hint(hint, frames, rest, np.asarray(large[piece])) for hint in hints]
    meant = np.unique(np.concatenate([piece[seed] for seed in seeds])) if seeds else np.zeros(0, int)
    stands = large & (foot < _STANDS)
    stands[meant] = True
    if not stands.any():
        stands = large
    stands &= ~_find_inner(support.support_from_world @ rest.vertices, piece, area, stands, meant)
    # Of every vertex the number of its object: hints first, then what is found without.
    owner, count = np.full(len(rest.vertices), -1), len(hints)
    for number in np.flatnonzero(stands):
        mine = np.flatnonzero(piece == number)
        mesh = cut(rest, piece[rest.faces[:, 0]] == number)  # keeps the vertices' order
        place = np.full(len(rest.vertices), -1)
        place[mine] = np.arange(len(mine))
        here = [(k, place[seed[piece[seed] == number]]) for k, seed in enumerate(seeds)]
        here = [(k, seed) for k, seed in here if len(seed) > 0.5 * len(seeds[k])]
        if len(here) > 1:
            label = split_by_seeds(make_affinity(mesh, seams), [seed for _, seed in here])
            names = np.array([k for k, _ in here])
        else:
            label = np.zeros(len(mesh.vertices), int)
            if alone and not here:  # what a person says is one thing is one
                near = support.heights(mesh.vertices) < _FOOT
                label = split_alone(make_affinity(mesh, seams), near, least_area=least_area)
            names = count + np.arange(label.max() + 1)
            count += len(names)
            if here:
                names[0] = here[0][0]
        owner[mine] = names[label]
    owner = _attach(rest, piece, owner, np.where(large, _APART, _BESIDE))
    faces_of = np.median(owner[rest.faces], axis=1).astype(int)  # of two corners or three
    sizes = np.bincount(faces_of[faces_of >= 0], share[faces_of >= 0], count)
    order = [*range(len(hints)), *(len(hints) + np.argsort(-sizes[len(hints) :], kind="stable"))]
    taken, found = {hint.name for hint in hints}, []
    for number in order:
        if not sizes[number] > 0:
            continue
        hinted = bool(number < len(hints))
        name = hints[number].name if hinted else _name_freely(taken)
        taken.add(name)
        found.append(Part(name, cut(rest, faces_of == number), hinted))
    return found


def _cut_off(surface: Mesh, support: Support, cut_at: float) -> Mesh:
    """What of a surface is above the support and over what was seen of it."""
    inside = (support.heights(surface.vertices) > cut_at) & support.covers(surface.vertices)
    keep = np.asarray(inside[surface.faces].all(1))
    if not keep.any():
        raise CaptureError("nothing stands on the support: no surface rises above the table")
    return cut(surface, keep)


def _find_inner(
    points: Float[np.ndarray, "n 3"],
    piece: Int[np.ndarray, " n"],
    area: Float[np.ndarray, " p"],
    stands: Bool[np.ndarray, " p"],
    meant: Int[np.ndarray, " _"],
) -> Bool[np.ndarray, " p"]:
    """Pieces that are most probably of a larger one, because they are small and under it: a part of its underside.

    Args:
      points: x, y and height on the support.
      meant: pieces that a hint says are things.
    """
    inner = np.zeros(len(area), bool)
    order = np.flatnonzero(stands)[np.argsort(-area[stands], kind="stable")]
    for larger in order:
        smaller = [k for k in order if area[k] < _INNER * area[larger] and not inner[k] and k not in meant]
        if inner[larger] or not smaller:
            continue
        above = points[piece == larger]
        sides = ConvexHull(above[:, :2]).equations
        for k in smaller:
            mine = points[piece == k]
            covered = (mine[:, :2] @ sides[:, :2].T + sides[:, 2]).max(1) < _BESIDE
            inner[k] = (covered & (mine[:, 2] < above[:, 2].max())).mean() > _WITHIN
    return inner


def _attach(
    mesh: Mesh, piece: Int[np.ndarray, " n"], owner: Int[np.ndarray, " n"], within: Float[np.ndarray, " p"]
) -> Int[np.ndarray, " n"]:
    """The owners of pieces that hang nowhere: of what is nearest, if that is near enough for a piece of its kind."""
    known = owner >= 0
    loose = np.flatnonzero(~known)
    if not len(loose) or not known.any():
        return owner
    distance, nearest = KDTree(mesh.vertices[known]).query(mesh.vertices[loose])
    first = np.full(len(within), np.inf)
    np.minimum.at(first, piece[loose], distance)
    owner = owner.copy()
    candidates = owner[np.flatnonzero(known)[nearest]]
    for number in np.flatnonzero(first <= within):
        mine = piece[loose] == number
        owner[loose[mine]] = candidates[mine][distance[mine].argmin()]
    return owner


def _name_freely(taken: set[str]) -> str:
    return next(f"object_{k}" for k in range(1, len(taken) + 2) if f"object_{k}" not in taken)


def _place_hint(hint: Hint, frames: Sequence[PosedFrame], mesh: Mesh, allowed: np.ndarray) -> Int[np.ndarray, " k"]:
    """Vertices that a hint surely means."""
    frame = find_frame(frames, hint)
    seen, pixels = _see(frame, mesh)
    seen &= allowed
    if hint.right is not None and hint.bottom is not None:
        middle = np.array([(hint.x + hint.right) / 2, (hint.y + hint.bottom) / 2])
        half = np.array([hint.right - hint.x, hint.bottom - hint.y]) / 2
        inner = seen & (np.abs(pixels - middle) < 0.5 * half).all(1)
        if not inner.any():
            raise CaptureError(
                f"{hint.name}: the box in frame {frame.name} is around nothing that stands on the support"
            )
        return np.flatnonzero(inner)
    width, height = frame.size
    column, row = round(hint.x), round(hint.y)
    if not (0 <= column < width and 0 <= row < height):
        raise CaptureError(f"{hint.name}: the click ({hint.x:g}, {hint.y:g}) is outside of {width} × {height} pixels")
    patch = frame.depth[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4]
    if not (patch > 0).any():
        raise CaptureError(f"{hint.name}: frame {frame.name} has no depth where ({hint.x:g}, {hint.y:g}) was clicked")
    point = unproject(frame.camera, np.array([[hint.x, hint.y]], float), np.array([np.median(patch[patch > 0])]))
    distance = np.linalg.norm(mesh.vertices - frame.world_from_camera @ point, axis=-1)
    distance[~allowed] = np.inf
    if distance.min() > _NEAR:
        raise CaptureError(
            f"{hint.name}: ({hint.x:g}, {hint.y:g}) in frame {frame.name} is {100 * distance.min():.0f} cm from "
            "anything that stands on the support"
        )
    return np.flatnonzero(distance < max(_SEED, distance.min() + 0.002))


def find_frame(frames: Sequence[PosedFrame], hint: Hint) -> PosedFrame:
    """The frame that a hint is about.

    Raises:
      CaptureError: no frame with a pose has its name.
    """
    frame = frames[0] if hint.frame is None else next((f for f in frames if f.name == hint.frame), None)
    if frame is None:
        raise CaptureError(f"{hint.name}: no frame with a pose is called {hint.frame}")
    return frame


def _see(frame: PosedFrame, mesh: Mesh) -> tuple[np.ndarray, Float[np.ndarray, "n 2"]]:
    """Which vertices a frame sees, and their pixels."""
    points = frame.camera_from_world @ mesh.vertices
    pixels = project(frame.camera, points)
    column, row = np.rint(pixels).astype(int).T
    width, height = frame.size
    inside = (points[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    measured = frame.depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return inside & (measured > 0) & (points[:, 2] < measured + _HIDDEN), pixels

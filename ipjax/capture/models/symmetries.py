"""Turns that leave a model as it is: tried one by one, by comparing the model with its turned self."""

import dataclasses

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from ipjax.capture.models.finishing import find_rim
from ipjax.files.meshes.mesh import Mesh, corner_products
from ipjax.transforms import Similarity, rotation_from_vector

FOLDS = (2, 3, 4, 5, 6)
_POINTS = 3000
_ROUND = 24  # steps of a full turn by which roundness is tested


@dataclasses.dataclass(frozen=True)
class Symmetries:
    """As BOP's models_info.json has them, in the model's frame and metres."""

    discrete: tuple[Float[np.ndarray, "4 4"], ...] = ()
    continuous: tuple[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]], ...] = ()  # axis, a point on it

    def to_bop(self) -> dict[str, list]:
        """The entries of models_info.json, millimetres; none where there is nothing to say."""
        entries: dict[str, list] = {}
        if self.discrete:
            scale = np.array([1, 1, 1, 1000.0])
            entries["symmetries_discrete"] = [
                (m * np.where(np.arange(4)[:, None] < 3, scale, 1)).ravel().tolist() for m in self.discrete
            ]
        if self.continuous:
            entries["symmetries_continuous"] = [
                {"axis": axis.tolist(), "offset": (1000 * offset).tolist()} for axis, offset in self.continuous
            ]
        return entries


def find_symmetries(
    mesh: Mesh, *, tolerance: float = 0.0015, relative: float = 0.012, colour: float | None = 12.0, seed: int = 0
) -> Symmetries:
    """The symmetries of a model that stands with z up.

    Turns about the axes of its box are tried, half a turn about each and up to a sixth about the upright one, and
    full roundness about each. A turn counts where nine tenths of the turned surface lie on the surface, to `tolerance`
    or `relative` of the size, whichever is more; what comes to lie where nothing was measured is not asked.

    Args:
      mesh: metres; its vertices are looked at where they are `seen`.
      colour: ΔE by which half of the turned surface may differ in colour; None = the shape alone says.
    """
    rng = np.random.default_rng(seed)
    points, lab = _sample(mesh, rng, 8 * _POINTS)
    tree = KDTree(points)
    rim = find_rim(mesh.faces)
    holes = KDTree(mesh.vertices[np.unique(rim)]) if len(rim) else None
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    allowed = max(tolerance, relative * size)
    # The middle of the box is where an axis of symmetry must go through; noise at its ends moves it, so it is bettered.
    picked = rng.choice(len(points), min(_POINTS, len(points)), replace=False)
    middle = (np.quantile(points, 0.001, axis=0) + np.quantile(points, 0.999, axis=0)) / 2

    def turn(axis: np.ndarray, angle: float) -> Similarity[np.ndarray]:
        rotation = rotation_from_vector(axis * angle)
        return Similarity(rotation, middle - rotation @ middle, np.ones(()))

    def holds(axis: np.ndarray, angle: float) -> bool:
        moved = turn(axis, angle) @ points[picked]
        distance, index = tree.query(moved)
        asked = np.ones(len(moved), bool)
        if holes is not None:
            asked = holes.query(moved)[0] > distance + 2 * allowed
        # A turn that carries most of what was seen to where nothing was seen proves nothing.
        if asked.mean() < 0.3 or np.quantile(distance[asked], 0.9) > allowed:
            return False
        if colour is None:
            return True
        close = asked & (distance < allowed)
        return float(np.median(np.linalg.norm(lab[picked][close] - lab[np.asarray(index)[close]], axis=-1))) < colour

    axes = np.eye(3)
    is_round = [all(holds(a, 2 * np.pi * k / _ROUND) for k in (1, 5, 7, 12, 17)) for a in axes]
    if any(is_round):
        flips = [a for a, turns in zip(axes, is_round, strict=True) if not turns and holds(a, np.pi)]
        return Symmetries(
            tuple(turn(a, np.pi).to_matrix() for a in flips[:1]),
            tuple((a, middle) for a, turns in zip(axes, is_round, strict=True) if turns),
        )
    found = []
    up = max((n for n in FOLDS if holds(axes[2], 2 * np.pi / n)), default=1)
    found += [turn(axes[2], 2 * np.pi * k / up) for k in range(1, up)]
    across = [a for a in axes[:2] if holds(a, np.pi)]
    if across:
        found += [turn(axes[2], 2 * np.pi * k / up) @ turn(across[0], np.pi) for k in range(up)]
    return Symmetries(tuple(pose.to_matrix() for pose in found))


def _sample(mesh: Mesh, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the measured surface, evenly, and their colours in CIE L*a*b*."""
    faces = mesh.faces[(mesh.seen[mesh.faces] > 0).all(1)]
    area = np.linalg.norm(corner_products(mesh.vertices, faces), axis=-1)
    chosen = faces[rng.choice(len(faces), count, p=area / area.sum())]
    root, share = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
    weights = np.stack([1 - root, root * (1 - share), root * share], -1)
    points = (mesh.vertices[chosen] * weights[..., None]).sum(1)
    rgb = (mesh.colours[chosen].astype(np.float32) * weights[..., None].astype(np.float32)).sum(1) / 255
    return points, cv2.cvtColor(rgb[None], cv2.COLOR_RGB2Lab)[0]

"""Cutting one surface into the objects that it is made of: along creases, necks and edges of colour, over all views.

The surface is a graph: vertices, and edges that are the weaker the more they look like the seam of two things. What
every view saw is in it already: depth in its shape, colours in its vertices.
"""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import eigsh, splu

from ipjax.files.meshes.mesh import Mesh, corner_products, unit

_HALF = 0.3  # of a surface: a side with more is no handle, even if its foot was not seen
_FOOT = 5e-5  # metres² near the support that a thing which stands there has


@dataclasses.dataclass(frozen=True)
class Seams:
    """How much what lies between two vertices looks like a seam; chosen on made captures."""

    reach: float = 0.004  # metres over which normals are averaged
    crease: float = 20.0  # exponent per radian of a concave crease between neighbours
    colour: float = 0.02  # exponent per ΔE between neighbours
    weakest: float = 1e-5


@dataclasses.dataclass(frozen=True)
class Affinity:
    """A surface as a graph."""

    edges: Int[np.ndarray, "e 2"]
    weight: Float[np.ndarray, " e"]  # above 0; 1 = surely one thing
    length: Float[np.ndarray, " e"]  # metres
    area: Float[np.ndarray, " n"]  # of the surface at each vertex, metres²

    @property
    def count(self) -> int:
        return len(self.area)

    def laplacian(self) -> sparse.csc_matrix:
        """Of the graph, its edges by their weights."""
        a, b = self.edges.T
        graph = sparse.coo_matrix(
            (np.tile(self.weight, 2), (np.concatenate([a, b]), np.concatenate([b, a]))), (self.count, self.count)
        ).tocsr()
        return (sparse.diags(np.asarray(graph.sum(1)).ravel()) - graph).tocsc()


def make_affinity(mesh: Mesh, seams: Seams = Seams()) -> Affinity:
    """The graph of a surface of small triangles."""
    directed = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges = np.unique(np.sort(directed, axis=1), axis=0)
    a, b = edges.T
    length = np.linalg.norm(mesh.vertices[a] - mesh.vertices[b], axis=-1)
    n = len(mesh.vertices)
    normals = _smooth(mesh.normals, edges, n, rounds=_rounds(seams.reach, length))
    across = unit(mesh.vertices[b] - mesh.vertices[a])
    crease = ((normals[a] - normals[b]) * across).sum(-1)  # rad, for small angles; both lean together where concave
    rgb = mesh.colours[None].astype(np.float32) / 255
    lab = _smooth(cv2.cvtColor(rgb, cv2.COLOR_RGB2Lab)[0].astype(np.float64), edges, n, rounds=2)
    step = np.linalg.norm(lab[a] - lab[b], axis=-1)
    weight = np.exp(-seams.crease * np.maximum(crease, 0) - seams.colour * step)
    share = np.linalg.norm(corner_products(mesh.vertices, mesh.faces), axis=-1) / 6
    area = np.bincount(mesh.faces.reshape(-1), np.repeat(share, 3), n)
    return Affinity(edges, np.maximum(weight, seams.weakest), length, area)


def _rounds(reach: float, length: np.ndarray) -> int:
    """Averages over neighbours add up like a random walk."""
    return int(np.clip(round((reach / max(float(np.median(length)), 1e-6)) ** 2), 1, 12))


def _smooth(values: np.ndarray, edges: np.ndarray, n: int, rounds: int) -> np.ndarray:
    a, b = edges.T
    graph = sparse.coo_matrix(
        (np.ones(2 * len(edges)), (np.concatenate([a, b]), np.concatenate([b, a]))), (n, n)
    ).tocsr() + sparse.identity(n)
    total = np.asarray(graph.sum(1))
    for _ in range(rounds):
        values = (graph @ values) / total
    return values


def split_by_seeds(affinity: Affinity, seeds: Sequence[Int[np.ndarray, " _"]]) -> Int[np.ndarray, " _"]:
    """Which seed each vertex belongs to: the one that a random walker from there reaches first (Grady 2006).

    A vertex that no seed is connected with gets −1.

    Raises:
      ValueError: fewer than one seed, or an empty one.
    """
    if not seeds or any(len(seed) == 0 for seed in seeds):
        raise ValueError("every object needs a seed on the surface")
    n = affinity.count
    label = np.full(n, -1)
    for number, seed in enumerate(seeds):
        label[seed] = number
    a, b = affinity.edges.T
    graph = sparse.coo_matrix((np.ones(len(a)), (a, b)), (n, n))
    piece = csgraph.connected_components(graph, directed=False)[1]
    reached = np.isin(piece, piece[label >= 0])
    free = np.flatnonzero(reached & (label < 0))
    if len(free):
        fixed = np.flatnonzero(label >= 0)
        laplacian = affinity.laplacian()
        inner = laplacian[free][:, free] + 1e-12 * sparse.identity(len(free))
        right = np.stack([(label[fixed] == k).astype(np.float64) for k in range(len(seeds))], -1)
        chance = splu(inner.tocsc()).solve(-(laplacian[free][:, fixed] @ right))
        label[free] = chance.argmax(1)
    return label


def split_alone(
    affinity: Affinity,
    stands: Bool[np.ndarray, " n"],
    *,
    least_area: float = 6e-4,
    loosest: float = 0.3,
    vectors: int = 4,
    most: int = 8,
) -> Int[np.ndarray, " n"]:
    """Parts of a connected surface that hang together by seams alone, without being told how many.

    A part is cut in two where that costs least: the cut's length, each bit by its weight, over the square root of the
    smaller side's area (1.9 for a cube cut in half, however large). Cuts are sought along the first eigenvectors of the
    graph (Shi and Malik 2000). A small side that
    does not stand on the support by itself is a handle or a lid, and stays.

    Args:
      stands: vertices at the foot of the surface.
      least_area: metres², of a part.
      loosest: cost of a cut above which it goes through one thing.
      vectors: how many eigenvectors are looked along.
      most: parts.
    """
    label = np.zeros(affinity.count, int)
    queue = [0]
    while queue and label.max() + 1 < most:
        number = queue.pop()
        mine = np.flatnonzero(label == number)
        side = _halve(_part(affinity, mine), stands[mine], least_area, loosest, vectors)
        if side is None:
            continue
        label[mine[side]] = label.max() + 1
        queue += [number, int(label.max())]
    return label


def _part(affinity: Affinity, chosen: np.ndarray) -> Affinity:
    place = np.full(affinity.count, -1)
    place[chosen] = np.arange(len(chosen))
    inside = (place[affinity.edges] >= 0).all(1)
    return Affinity(
        place[affinity.edges[inside]],
        affinity.weight[inside],
        affinity.length[inside],
        affinity.area[chosen],
    )


def _halve(
    part: Affinity, stands: np.ndarray, least_area: float, loosest: float, vectors: int
) -> Bool[np.ndarray, " n"] | None:
    """The cheapest cut that leaves two things that stand; None where there is none that is cheap enough."""
    if part.area.sum() < 2 * least_area or part.count < 200:
        return None
    mass = sparse.diags(part.area + 1e-12)
    start = np.random.default_rng(0).normal(size=part.count)
    scale = float(part.weight.mean() / part.area.mean())
    values, found = eigsh(part.laplacian(), k=vectors + 1, M=mass, sigma=-1e-3 * scale, which="LM", v0=start, tol=1e-2)  # pyright: ignore[reportArgumentType]
    a, b = part.edges.T
    best, best_cost = None, loosest
    for vector in found.T[np.argsort(values)][1:]:
        order = np.argsort(vector, kind="stable")
        rank = np.empty(part.count, int)
        rank[order] = np.arange(part.count)
        first, last = np.minimum(rank[a], rank[b]), np.maximum(rank[a], rank[b])
        # An edge is cut by every threshold between its ends; what a bit of cut is long is half an edge.
        cost = part.weight * part.length / 2
        running = np.cumsum(np.bincount(first, cost, part.count) - np.bincount(last, cost, part.count))
        area = np.cumsum(part.area[order])
        smaller = np.minimum(area, area[-1] - area)
        foot = np.cumsum(stands[order] * part.area[order])
        smaller_foot = np.minimum(foot, foot[-1] - foot)
        good = (smaller > least_area) & ((smaller_foot > _FOOT) | (smaller > _HALF * area[-1]))
        ratio = np.where(good, running / np.sqrt(np.maximum(smaller, 1e-12)), np.inf)
        at = int(ratio.argmin())
        if ratio[at] < best_cost:
            best, best_cost = rank > at, float(ratio[at])
    return best

"""Points on the surface of a mesh."""

import numpy as np
from jaxtyping import Float, Int, UInt8

from ipjax.files.meshes.mesh import Mesh, corner_products, unit
from ipjax.files.meshes.textures import sample_texture


def sample_surface(
    mesh: Mesh, count: int, seed: int = 0
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Points spread evenly over the surface, their unit normals and their `seen`; the same seed gives the same points.

    Uniform samples by area, thinned by farthest-point selection, so that the gaps are even too. Normals are those of
    the faces' winding. Raises ValueError where count is not positive or the mesh has no area.
    """
    if count < 1:
        raise ValueError(f"sample_surface needs a positive count, got {count}")
    points, normals, face, weights = _scatter(mesh, 5 * count, np.random.Generator(np.random.PCG64(seed)))
    chosen = farthest_points(points, count)
    seen = np.einsum("kc,kc->k", weights[chosen], mesh.seen[mesh.faces[face[chosen]]])
    return points[chosen], normals[chosen], np.clip(np.round(seen, 6), 0, 1)  # weights sum to 1 within rounding


def sample_appearance(
    mesh: Mesh, count: int, seed: int = 0
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"], UInt8[np.ndarray, "k 3"]]:
    """Points spread over the surface by area, their unit normals and their colours; for drawing, so many and cheap.

    Raises ValueError where count is not positive or the mesh has no area.
    """
    if count < 1:
        raise ValueError(f"sample_appearance needs a positive count, got {count}")
    points, normals, face, weights = _scatter(mesh, count, np.random.Generator(np.random.PCG64(seed)))
    corners = mesh.faces[face]
    if mesh.texture is not None and mesh.uv is not None:
        colours = sample_texture(mesh.texture, np.einsum("kc,kci->ki", weights, mesh.uv[corners]))
    else:
        mixed = np.einsum("kc,kci->ki", weights, mesh.colours[corners].astype(np.float64))
        colours = np.clip(np.round(mixed), 0, 255).astype(np.uint8)
    return points, normals, colours


def _scatter(mesh: Mesh, count: int, random: np.random.Generator):
    """Points stratified by area, their normals, faces and barycentric weights."""
    products = corner_products(mesh.vertices, mesh.faces)
    area = np.linalg.norm(products, axis=-1)
    if not area.sum() > 0:
        raise ValueError("the mesh has no area")
    ladder = np.cumsum(area)
    face = np.searchsorted(ladder, (np.arange(count) + random.random(count)) / count * ladder[-1], side="right")
    face = np.minimum(face, len(area) - 1)
    a, b = random.random((2, count))
    root = np.sqrt(a)
    weights = np.stack([1 - root, root * (1 - b), root * b], axis=-1)
    points = np.einsum("kc,kci->ki", weights, mesh.vertices[mesh.faces[face]])
    return points, unit(products[face]), face, weights


def farthest_points(points: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, " k"]:
    """Indices of `count` points, each the farthest from all before it; the first is the farthest from the mean."""
    squared = np.full(len(points), np.inf)
    chosen = np.empty(min(count, len(points)), np.int64)
    columns = np.ascontiguousarray(points.T)
    current = int(((points - points.mean(0)) ** 2).sum(1).argmax())
    for i in range(len(chosen)):
        chosen[i] = current
        x, y, z = columns - columns[:, current : current + 1]
        np.minimum(squared, x * x + y * y + z * z, out=squared)
        current = int(squared.argmax())
    return chosen

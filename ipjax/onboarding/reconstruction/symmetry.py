"""Planes of symmetry of a measured front: which one the photo contradicts least, and the back that it makes."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from ipjax.onboarding.reconstruction.outline import Outline, find_nearest_inside, solve_poisson


@dataclasses.dataclass(frozen=True)
class Plane:
    """A plane of symmetry that was tried: unit normal away from the camera, and offset (n·x = offset, metres)."""

    normal: Float[np.ndarray, "3"]
    offset: float
    violation: float  # share of mirrored points that the photo contradicts
    support: float  # share that falls onto measured surface
    cost: float


def find_plane(
    points: Float[np.ndarray, "r c 3"],
    outline: Outline,
    mask: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    camera: tuple[np.ndarray, np.ndarray],
    thickness: Float[np.ndarray, "r c"],
) -> Plane:
    """The plane at which the front, mirrored, agrees best with what the camera saw (after Bohg et al., ICRA 2011).

    A mirrored point contradicts the photo where it would hide the object or the background behind it; it is supported
    where it falls on measured surface of the same orientation. Between planes that differ in neither, the one whose
    thickness is nearest to the inflation's wins.
    """
    from scipy.ndimage import binary_dilation

    focal, centre = camera
    inside = outline.inside
    cloud, normals = points[inside], _sheet_normals(points)[inside]
    keep = np.random.default_rng(0).permutation(len(cloud))[:700]
    cloud, normals = cloud[keep], normals[keep]
    extent = float(np.linalg.norm(np.ptp(points[inside], axis=0)))
    tolerance = 0.03 * extent
    expected = float(np.median(thickness[inside]))
    view = cloud.mean(0) / np.linalg.norm(cloud.mean(0))
    # Directions within 70° of the line of sight, evenly spread.
    index = np.arange(160)
    z = 1 - (index + 0.5) / 160 * (1 - np.cos(np.deg2rad(70)))
    turn = index * np.pi * (3 - np.sqrt(5))
    local = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], -1)
    side = np.cross(view, [0.0, 1.0, 0.0] if abs(view[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    directions = local @ np.stack([side, np.cross(view, side), view])
    soft = np.asarray(binary_dilation(mask, iterations=2))
    surface = np.where(mask, 0.0, np.where(np.isfinite(depth), depth, 0.0))
    height, width = mask.shape
    # What was measured on the object, at full resolution of the grid.
    lookup = _node_index(outline, mask.shape)
    measured_z, measured_n = points[..., 2], _sheet_normals(points)
    best: Plane | None = None
    for normal in directions:
        along = cloud @ normal
        low, high = np.percentile(along, [30, 98])
        offsets = np.linspace(low, high + 0.5 * max(expected, 0.1 * extent), 24)
        mirrored = cloud[None] + 2 * (offsets[:, None] - along[None])[..., None] * normal
        turned = normals - 2 * (normals @ normal)[:, None] * normal
        pixel = mirrored[..., :2] / np.maximum(mirrored[..., 2:], 1e-6) * focal + centre
        column, row = np.rint(pixel[..., 0]).astype(int), np.rint(pixel[..., 1]).astype(int)
        within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
        on = within & mask[row, column]
        node = lookup[row, column]
        gap = mirrored[..., 2] - measured_z.reshape(-1)[node]
        hidden = (surface[row, column] > 0) & (surface[row, column] < mirrored[..., 2] - tolerance)
        against = np.where(on, gap < -tolerance, within & np.logical_not(soft[row, column] | hidden))
        agree = (measured_n.reshape(-1, 3)[node] * turned[None]).sum(-1) > 0.7
        matched = on & (np.abs(gap) < 0.5 * tolerance) & agree
        # Points near the plane map onto themselves whatever the surface: they support nothing.
        matched &= np.abs(offsets[:, None] - along[None]) > tolerance
        violation, support = against.mean(1), matched.mean(1)
        depth_of = np.median(2 * np.maximum(offsets[:, None] - along[None], 0.0), axis=1)
        cost = violation - 0.5 * support + 0.1 * np.abs(np.log((depth_of + 1e-3) / (expected + 1e-3)))
        i = int(np.argmin(cost))
        if best is None or cost[i] < best.cost:
            best = Plane(normal, float(offsets[i]), float(violation[i]), float(support[i]), float(cost[i]))
    assert best is not None
    return best


def mirror_front(
    plane: Plane,
    rays: np.ndarray,
    near: np.ndarray,
    thickness: np.ndarray,
    outline: Outline,
    camera: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """The farthest mirrored depth along every node's ray, and the pixel that it mirrors."""
    import cv2
    from scipy.ndimage import zoom

    focal, centre = camera
    rows, columns = near.shape
    inside = outline.inside
    nearest = find_nearest_inside(inside)  # no values from beyond the outline in between
    double = lambda image: np.asarray(zoom(image, 2, order=1))
    # Twice as many points as nodes each way, so that mirroring leaves few holes.
    points = (rays * near[..., None])[nearest]
    fine = np.stack([double(points[..., k]) for k in range(3)], -1).reshape(-1, 3)
    source = np.stack([double(outline.pixels[..., k][nearest]) for k in range(2)], -1).reshape(-1, 2)
    keep = double(inside.astype(np.float32)).reshape(-1) > 0.5
    fine, source = fine[keep], source[keep]
    mirrored = fine + 2 * (plane.offset - fine @ plane.normal)[:, None] * plane.normal
    pixel = mirrored[:, :2] / np.maximum(mirrored[:, 2:], 1e-6) * focal + centre
    node = np.rint((pixel - outline.pixels[0, 0]) / outline.step).astype(int)
    good = (node >= 0).all(1) & (node[:, 0] < columns) & (node[:, 1] < rows)
    node, mirrored, source = node[good], mirrored[good], source[good]
    order = np.argsort(mirrored[:, 2])  # the farthest is written last
    far = np.zeros((rows, columns))
    pixels = np.zeros((rows, columns, 2))
    far[node[order, 1], node[order, 0]] = mirrored[order, 2]
    pixels[node[order, 1], node[order, 0]] = source[order]
    known = inside & (far > near)
    if not known.any():
        return near + thickness, outline.pixels
    smooth = cv2.medianBlur(np.where(known, far, near).astype(np.float32), 3)
    far = np.where(known, smooth, far)
    # Where nothing was mirrored to, the sheet is stretched; its free edge is the outline.
    deep = solve_poisson(far - near, known, inside)
    return near + np.maximum(deep, 0.0)[nearest], pixels[find_nearest_inside(known)]


def _node_index(outline: Outline, shape: tuple[int, int]) -> np.ndarray:
    """For every pixel of the photo, the number of the nearest node inside the outline."""
    rows, columns = outline.inside.shape
    nearest = find_nearest_inside(outline.inside)
    number = nearest[0] * columns + nearest[1]
    # The first node never moves: it lies outside, three steps off the mask.
    origin = outline.pixels[0, 0]
    row = np.clip(np.rint((np.arange(shape[0]) - origin[1]) / outline.step).astype(int), 0, rows - 1)
    column = np.clip(np.rint((np.arange(shape[1]) - origin[0]) / outline.step).astype(int), 0, columns - 1)
    return number[row[:, None], column[None]]


def _sheet_normals(points: np.ndarray) -> np.ndarray:
    """Unit normals of a grid of points [r c 3], towards the camera."""
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(down, across)  # towards the camera
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)

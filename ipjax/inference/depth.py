"""A query's depth: its unit, metres of it, and which of its values can be trusted."""

import cv2
import numpy as np
from jaxtyping import Float

from ipjax.cameras import project, unproject
from ipjax.files.cameras.intrinsics import Intrinsics, check_depth_scale
from ipjax.records import Camera
from ipjax.transforms import Similarity

_NEAREST, _FARTHEST = 0.01, 30.0  # metres; a median depth outside is taken for a wrong unit
_HARDLY = 0.01  # share of a whole frame's depth between both, below which its unit is wrong: walls may be farther


def clean_depth(depth: np.ndarray, edge_tolerance: float = 0.02) -> np.ndarray:
    """Set flying pixels to 0: those that few of their 5 × 5 neighbours agree with.

    Args:
        depth: height × width, float32, any unit, 0 = unknown.
        edge_tolerance: neighbours within this share of the depth agree.

    Returns:
        A copy. A pixel stays when at least 7 of its 24 neighbours agree; the corner of a box keeps 8.
    """
    height, width = depth.shape
    around = cv2.copyMakeBorder(depth, 2, 2, 2, 2, cv2.BORDER_REPLICATE)
    tolerance = depth * np.float32(edge_tolerance)
    agree = np.zeros(depth.shape, np.uint8)
    difference = np.empty_like(depth)
    for dy in range(5):
        for dx in range(5):
            cv2.absdiff(around[dy : dy + height, dx : dx + width], depth, difference)
            agree += (difference <= tolerance).view(np.uint8)
    return np.where(agree >= 8, depth, np.float32(0))  # it agrees with itself


def drop_untrusted(depth: np.ndarray, mask: np.ndarray, erosion: int, edge_tolerance: float) -> np.ndarray:
    """Depth without flying pixels and without the rim of the mask, as long as that leaves enough."""
    cleaned = clean_depth(depth, edge_tolerance) if edge_tolerance > 0 else depth.copy()
    seen = mask & (depth > 0)
    if (cleaned[seen] > 0).sum() < 0.3 * seen.sum():
        cleaned = depth.copy()  # too noisy or too small to judge
    for pixels in range(erosion, 0, -1):
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
        core = cv2.erode(mask.view(np.uint8), kernel, borderType=cv2.BORDER_REPLICATE).view(bool)
        # A thin object has no core: its rim must do.
        if (core & (cleaned > 0)).sum() >= 0.4 * (mask & (cleaned > 0)).sum():
            return np.where(mask & ~core, np.float32(0), cleaned)
    return cleaned


def sample_depth(
    depth: np.ndarray, x: np.ndarray, y: np.ndarray, edge_tolerance: float = 0.02
) -> Float[np.ndarray, "*n"]:
    """Depth along z where it was not measured: between pixels.

    1 / z is interpolated between the four pixels around, which is exact on a plane. The nearest pixel's depth alone
    would be that of another place, up to half a pixel away, and where an image is halved always to the same side.

    Args:
        depth: height × width, float32, 0 = unknown.
        x, y: places in pixels, of shapes that broadcast; outside the image = the nearest border's.
        edge_tolerance: of four pixels, those within this share of the nearest one are of one surface.

    Returns:
        The depth of the surface that is nearest to the place; 0 where less than half of what is around is known.
    """
    height, width = depth.shape
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    across, down = (x - left).astype(np.float32), (y - top).astype(np.float32)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    near = np.stack([depth[b, a] for b in (top, bottom) for a in (left, right)])
    weight = np.stack([q * p for q in (1 - down, down) for p in (1 - across, across)])
    weight[near <= 0] = 0
    known = weight.sum(0)
    # Of equally near pixels the foremost, which hides the others, so that no direction is preferred.
    foremost = np.where(weight >= weight.max(0) - 1e-4, near, np.inf).min(0)
    weight[np.abs(near - foremost) > edge_tolerance * foremost] = 0
    inverse = np.sum(weight / np.maximum(near, 1e-9), axis=0)
    found = known >= 0.5
    return np.where(found, weight.sum(0) / np.where(found, inverse, 1), 0).astype(np.float32)


def find_depth_scale(depth: np.ndarray, depth_scale: float | None, intrinsics: Intrinsics) -> float:
    """Metres per unit of depth: as given, as the camera's file says, or 1 for floats.

    Raises ValueError where nothing says so, with the unit that the values suggest; or for a scale that is not positive.
    """
    scale = depth_scale if depth_scale is not None else intrinsics.depth_scale
    if scale is None:
        if depth.dtype.kind != "f":
            known = depth[depth > 0]
            median = float(np.median(known)) if known.size else 0.0
            raise ValueError(_unit_in_words(median, "depth of whole numbers has no unit", None))
        scale = 1.0
    return check_depth_scale(scale)


def check_depth_unit(depth: np.ndarray, mask: np.ndarray, bounds: tuple[int, int, int, int], scale: float) -> float:
    """The median depth inside the mask, metres; ``bounds`` are the mask's (left, top, right, bottom) in pixels.

    Raises ValueError where there is no depth, or where no object can be that near or far: its unit is wrong.
    """
    left, top, right, bottom = bounds
    values = depth[top:bottom, left:right][mask[top:bottom, left:right]]
    if values.dtype.kind == "f":
        values = values[np.isfinite(values)]
    values = values[values > 0]
    if values.size == 0:
        raise ValueError("there is no depth inside the mask")
    raw = float(np.median(values))
    median = raw * scale
    if not _NEAREST <= median <= _FARTHEST:
        raise ValueError(_unit_in_words(raw, f"with depth_scale={scale:g} the object is {median:.3g} m away", scale))
    return median


def check_frame_unit(depth: np.ndarray, scale: float) -> None:
    """Refuse the depth of a whole frame in which hardly anything is where objects can be: its unit is wrong.

    Raises ValueError with the unit that the values suggest.
    """
    known = depth[np.isfinite(depth) & (depth > 0)]
    metres = known * np.float64(scale)
    if known.size and np.mean((metres >= _NEAREST) & (metres <= _FARTHEST)) < _HARDLY:
        raw = float(np.median(known))
        raise ValueError(
            _unit_in_words(raw, f"with depth_scale={scale:g} the scene is {raw * scale:.3g} m away", scale)
        )


def to_metres(depth: np.ndarray, scale: float) -> np.ndarray:
    """float32 metres, 0 = unknown."""
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is as infinite
        metres = depth.astype(np.float32)
        if scale != 1.0:
            metres *= np.float32(scale)
    if depth.dtype.kind == "f":
        metres[~np.isfinite(metres)] = 0
    return np.maximum(metres, 0)


def _unit_in_words(median: float, else_say: str, scale: float | None) -> str:
    # A hand-held or table-top scene is 0.1 to 10 m away.
    units = {
        1.0: "metres",
        1e-3: "millimetres",
        1e-4: "tenths of a millimetre",
        1e-2: "centimetres",
        1e-6: "micrometres",
    }
    for unit, name in units.items():
        if 0.1 <= median * unit <= 10:
            asked = f" with depth_scale={scale:g}" if scale not in (None, 1.0) else ""
            return f"median depth {median:.4g}{asked}: this looks like {name}; pass depth_scale={unit:g}"
    return f"median depth {median:.4g}: {else_say}; pass depth_scale, the metres per depth unit"


def register_depth(
    depth: np.ndarray,
    depth_camera: Camera,
    colour_from_depth: Similarity[np.ndarray],
    camera: Camera,
    size: tuple[int, int],
) -> np.ndarray:
    """Raw depth in the colour camera's pixels, as the makers of RGB-D cameras do it: every pixel of the depth camera
    covers what of the colour image it projects to, and the nearest wins.
    """
    width, height = size
    rows, columns = np.nonzero(depth > 0)
    points = unproject(
        depth_camera.to_matrix(), np.stack([columns, rows], -1).astype(np.float64), depth[rows, columns].astype(float)
    )
    moved = colour_from_depth @ points
    moved = moved[moved[:, 2] > 0.05]
    x, y = project(camera.to_matrix(), moved).T
    # Half of what a pixel covers, with a little more so that no seams are left.
    zoom = np.asarray(camera.focal, float) / np.asarray(depth_camera.focal, float)
    half = 0.55 * zoom * np.ones((len(moved), 2))
    nearest = np.full((height, width), np.inf)
    first_x, first_y = np.ceil(x - half[:, 0]).astype(int), np.ceil(y - half[:, 1]).astype(int)
    reach_x, reach_y = (int(np.ceil(2 * side)) + 1 for side in half.max(0))
    for dy in range(reach_y):
        for dx in range(reach_x):
            column, row = first_x + dx, first_y + dy
            inside = (column <= x + half[:, 0]) & (row <= y + half[:, 1])
            inside &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
            np.minimum.at(nearest, (row[inside], column[inside]), moved[inside, 2])
    return np.where(np.isfinite(nearest), nearest, 0).astype(np.float32)

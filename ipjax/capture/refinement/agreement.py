"""How well frames agree under given poses, in metres and as a picture."""

import colorsys
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from ipjax.cameras import project, unproject
from ipjax.capture.pictures import find_upright, write_line
from ipjax.capture.records import Trajectory
from ipjax.records import Camera
from ipjax.transforms import Similarity

FAR = 0.05  # metres: what differs by more is hidden, not wrong
_PANEL = 560  # pixels on a side
_POINTS = 3000  # of each frame in the picture


def measure_agreement(
    depths: Sequence[Float[np.ndarray, "h w"]],
    camera: Camera,
    world_from_camera: Similarity[np.ndarray],
    pairs: Int[np.ndarray, "p 2"],
) -> Float[np.ndarray, " p"]:
    """Of each pair the median difference between depths of the first, carried into the second, and its own; metres.

    What differs by more than `FAR` is hidden, and left out; NaN where nothing is left. A low one does not prove poses:
    what slides along a plane agrees.

    Args:
      depths: of all frames that `pairs` names; metres, 0 = unknown.
    """
    K = camera.to_matrix()
    height, width = depths[0].shape
    found = np.full(len(pairs), np.nan)
    for number, (first, second) in enumerate(pairs):
        one, other = (world_from_camera.take(k) for k in (first, second))
        moved = (other.inverse() @ one) @ lift(depths[first], K)
        moved = moved[moved[:, 2] > 0]
        x, y = np.round(project(K, moved)).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        seen = depths[second][y[inside], x[inside]]
        off = np.abs(seen - moved[inside, 2])[seen > 0]
        off = off[off < FAR]
        if len(off):
            found[number] = np.median(off)
    return found


def lift(
    depth: Float[np.ndarray, "h w"], K: Float[np.ndarray, "3 3"], most: int | None = None
) -> Float[np.ndarray, "k 3"]:
    """Points of a depth image in its camera, metres; every so many, so that they are ``most`` at the most."""
    rows, columns = np.nonzero(depth > 0)
    if most is not None and len(rows) > most:
        chosen = np.linspace(0, len(rows) - 1, most).astype(int)
        rows, columns = rows[chosen], columns[chosen]
    return unproject(K, np.stack([columns, rows], -1).astype(np.float64), depth[rows, columns].astype(np.float64))


def list_neighbours(registered: np.ndarray) -> Int[np.ndarray, "p 2"]:
    """Frames that follow one another, of those that have poses; indices of the capture's frames."""
    known = np.flatnonzero(registered)
    return np.stack([known[:-1], known[1:]], axis=1)


def draw_agreement(
    depths: Sequence[Float[np.ndarray, "h w"] | None],
    camera: Camera,
    before: Trajectory,
    after: Trajectory,
    notes: Sequence[str] = (),
) -> UInt8[np.ndarray, "a b 3"]:
    """The points of all frames from above and from the side, before and after; a colour a frame.

    Surfaces that are seen once where they are, thin and of mixed colours, are right; the same surface twice is not.

    Args:
      depths: of all frames of the capture; None where it is not known.
      notes: lines that are written below.
    """
    K = camera.to_matrix()
    known = [k for k in np.flatnonzero(after.registered).tolist() if depths[k] is not None]
    upright = find_upright(after)
    clouds = {k: lift(np.asarray(depths[k]), K, _POINTS) for k in known}
    place = lambda trajectory, k: (trajectory.world_from_camera.take(k) @ clouds[k]) @ upright.T
    everything = np.concatenate([place(after, k) for k in known])
    low, high = np.percentile(everything, [10, 90], axis=0)
    middle, reach = (low + high) / 2, 1.2 * float((high - low).max())
    image = np.full((2 * _PANEL + 24 * (len(notes) + 1), 2 * _PANEL, 3), 255, np.uint8)
    rng = np.random.default_rng(0)
    colours = [np.array(colorsys.hsv_to_rgb(n / max(len(known), 1), 0.9, 0.8)) * 255 for n in range(len(known))]
    for column, (trajectory, title) in enumerate(((before, "before"), (after, "after"))):
        points = np.concatenate([place(trajectory, k) for k in known])
        shade = np.concatenate([np.tile(colours[n], (len(clouds[k]), 1)) for n, k in enumerate(known)])
        order = rng.permutation(len(points))
        points, shade = (points[order] - middle) * (_PANEL / reach), shade[order].astype(np.uint8)
        for row, (axes, view) in enumerate((((0, 2), "from above"), ((0, 1), "from the side"))):
            xy = np.round(points[:, axes] * [1, -1 if axes[1] == 2 else 1] + _PANEL / 2).astype(int)
            inside = ((xy >= 0) & (xy < _PANEL)).all(1)
            panel = image[row * _PANEL : (row + 1) * _PANEL, column * _PANEL : (column + 1) * _PANEL]
            panel[xy[inside, 1], xy[inside, 0]] = shade[inside]
            write_line(image, f"{title}, {view}", (column * _PANEL + 10, row * _PANEL + 22))
    for line, note in enumerate(notes):
        write_line(image, note.replace("°", " deg").replace("±", "+-"), (10, 2 * _PANEL + 24 * (line + 1) - 6))
    return image

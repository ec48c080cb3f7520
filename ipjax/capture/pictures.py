"""Pictures that show whether a step of a capture is right."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from ipjax.cameras import unproject
from ipjax.capture.records import Trajectory

_PANEL = 720  # pixels on a side
_MARGIN = 40


def draw_trajectory(
    trajectory: Trajectory,
    points: Float[np.ndarray, "c 3"],
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    notes: Sequence[str] = (),
) -> UInt8[np.ndarray, "h w 3"]:
    """Cameras and points from above and from the side; the first camera is blue, the last red.

    Args:
      points: of the scene, in the world.
      K: of the cameras; pixels.
      size: of their images: width, height.
      notes: lines that are written below.
    """
    import cv2

    known = np.flatnonzero(trajectory.registered)
    poses = trajectory.world_from_camera
    upright = find_upright(trajectory)
    corners = np.array([[0, 0], [size[0], 0], [size[0], size[1]], [0, size[1]]], float) - 0.5
    places = poses.translation[known] @ upright.T
    near = points @ upright.T if len(points) else places
    # What most points take, and all cameras, with the same unit in both panels.
    low, high = (np.percentile(near, q, axis=0) for q in (2, 98))
    low, high = np.minimum(low, places.min(0)), np.maximum(high, places.max(0))
    middle, reach = (low + high) / 2, max(float((high - low).max()), 1e-3)
    frustum = 0.06 * reach
    shapes = np.concatenate([np.zeros((1, 3)), unproject(K, corners, np.full(4, frustum))])
    zoom = (_PANEL - 2 * _MARGIN) / (1.1 * reach)
    image = np.full((_PANEL + 24 * (len(notes) + 1), 2 * _PANEL, 3), 255, np.uint8)
    for panel, (axes, title) in enumerate((((0, 2), "from above"), ((0, 1), "from the side"))):

        def place(world: np.ndarray, axes: tuple[int, int] = axes, panel: int = panel) -> np.ndarray:
            flat = ((world @ upright.T - middle) * zoom)[..., axes] * [1, -1 if axes[1] == 2 else 1]
            return np.round(flat + np.array([(panel + 0.5) * _PANEL, 0.5 * _PANEL])).astype(int)

        inside = lambda xy, panel=panel: (
            (xy[:, 0] >= panel * _PANEL) & (xy[:, 0] < (panel + 1) * _PANEL) & (xy[:, 1] >= 0) & (xy[:, 1] < _PANEL)
        )
        dots = place(points) if len(points) else np.zeros((0, 2), int)
        dots = dots[inside(dots)]
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
            image[dots[:, 1] + y, np.minimum(dots[:, 0] + x, image.shape[1] - 1)] = 120
        for order, index in enumerate(known):
            share = order / max(len(known) - 1, 1)
            colour = (int(230 * share), 60, int(230 * (1 - share)))
            tip, *rest = place(shapes @ poses.rotation[index].T + poses.translation[index])
            for one, other in zip(rest, [*rest[1:], rest[0]], strict=True):
                cv2.line(image, one.tolist(), other.tolist(), colour, 1, cv2.LINE_AA)
                cv2.line(image, tip.tolist(), one.tolist(), colour, 1, cv2.LINE_AA)
        write_line(image, title, (panel * _PANEL + 12, 24))
        length = 10.0 ** np.floor(np.log10(reach / 2))  # of the bar, metres
        start = (panel * _PANEL + 12, _PANEL - 14)
        cv2.line(image, start, (start[0] + round(length * zoom), start[1]), (0, 0, 0), 2)
        write_line(image, f"{length:g} m", (start[0], start[1] - 8))
    for line, note in enumerate(notes):
        write_line(image, note.replace("×", "x").replace("°", " deg"), (12, _PANEL + 24 * (line + 1) - 6))
    return image


def write_line(image: UInt8[np.ndarray, "h w 3"], text: str, place: tuple[int, int]) -> None:
    """A line of text, its lower left corner at ``place``."""
    import cv2

    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)


def find_upright(trajectory: Trajectory) -> Float[np.ndarray, "3 3"]:
    """A rotation to axes of which the second points down, as most cameras are held, and the first along their path."""
    known = trajectory.registered
    rotation, places = trajectory.world_from_camera.rotation[known], trajectory.world_from_camera.translation[known]
    # Cameras that are held level have their x axes in one plane; its normal is the vertical.
    across = rotation[:, :, 0]
    values, vectors = np.linalg.eigh(across.T @ across)
    down = vectors[:, 0] if values[1] > 0.05 * values[2] else rotation[:, :, 1].mean(0)
    down = down * np.sign(down @ rotation[:, :, 1].mean(0) or 1) / np.linalg.norm(down)
    spread = (places - places.mean(0)) @ (np.eye(3) - np.outer(down, down))
    along = np.linalg.svd(spread)[2][0] if len(places) > 1 else rotation[0, :, 0]
    along = along - (along @ down) * down
    if np.linalg.norm(along) < 1e-6:
        along = rotation[0, :, 0] - (rotation[0, :, 0] @ down) * down
    along /= np.linalg.norm(along)
    return np.stack([along, down, np.cross(along, down)])

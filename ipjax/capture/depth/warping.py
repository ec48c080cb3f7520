"""Raw depth in the pixels of another camera."""

import numpy as np
from ipjax_kernels.depth.warping import warp_depth
from jaxtyping import Bool, Float
from scipy import ndimage

from ipjax.cameras import unproject
from ipjax.capture.depth.rigs import Rig
from ipjax.transforms import Similarity

JUMP = 0.02  # of the depth: where neighbours differ by more, the surface ends


def lift_raw(
    raw: Float[np.ndarray, "hd wd"], rig: Rig, camera_from_colour: Similarity[np.ndarray] | None = None
) -> Float[np.ndarray, "hd wd 3"]:
    """The points of a raw depth image in the colour camera, or in another; metres. Unknown pixels are where the depth
    camera stands.
    """
    height, width = raw.shape
    camera_from_depth = rig.colour_from_depth
    if camera_from_colour is not None:
        camera_from_depth = camera_from_colour @ camera_from_depth
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns, rows], -1).reshape(-1, 2).astype(np.float32)
    rays = unproject(rig.depth_camera.astype(np.float32), pixels, np.ones(len(pixels), np.float32))
    turned = rays @ camera_from_depth.rotation.T.astype(np.float32)
    depth = (rig.scale * raw.reshape(-1, 1)).astype(np.float32)
    return (depth * turned + camera_from_depth.translation.astype(np.float32)).reshape(height, width, 3)


def warp(
    raw: Float[np.ndarray, "hd wd"],
    rig: Rig,
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    camera_from_colour: Similarity[np.ndarray] | None = None,
) -> Float[np.ndarray, "h w"]:
    """A raw depth image as a colour camera sees it: metres along z, 0 = unknown.

    Args:
      K, size: of the image to make: pixels; width, height.
      camera_from_colour: where that camera stands, beside the colour camera of the raw image's own frame; None = there.
    """
    points = lift_raw(raw, rig, camera_from_colour)
    focal = K[[0, 1], [0, 1]]
    cover = focal / rig.depth_camera[[0, 1], [0, 1]]
    # Cells grow where the camera comes nearer, and by their slant.
    reach = int(np.ceil(1.5 * max(cover.max(), 0.67))) + 1
    image = warp_depth(
        points,
        np.asarray(raw > 0),
        focal.astype(np.float32),
        K[:2, 2].astype(np.float32),
        size[1],
        size[0],
        jump=JUMP,
        size=(1.05 * np.maximum(cover, 1)).astype(np.float32),
        reach=reach,
    )
    return np.asarray(image)


def smooth_depth(depth: Float[np.ndarray, "h w"], sigma: float = 2.0) -> Float[np.ndarray, "h w"]:
    """Depth averaged within surfaces: beside jumps, and where it is unknown, it stays as it is."""
    known: Bool[np.ndarray, "h w"] = depth > 0
    share = ndimage.gaussian_filter(known.astype(float), sigma)
    mean = ndimage.gaussian_filter(np.where(known, depth, 0).astype(float), sigma) / np.maximum(share, 1e-6)
    window = 2 * round(2 * sigma) + 1
    high = ndimage.maximum_filter(np.where(known, depth, 0), window)
    low = ndimage.minimum_filter(np.where(known, depth, np.inf), window)
    return np.where(known & (high - low < 0.08 * depth), mean, depth)

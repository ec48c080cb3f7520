"""What moves with the camera (a gripper, a hand, a stand), found without a mask: it stays in the image.

Its depth and its colours are the same in nearly every frame, whatever the camera's pose. `ipjax.capture.poses.features`
finds some of it by features alone; here every pixel is asked, so that plain surfaces are found, too.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.capture.records import Capture, CaptureError, CaptureFrame, ReadFrame
from ipjax.files.images.masks import read_mask

NEAR = 0.015  # of the depth: what stays is this near to its median
COLOUR = 14.0  # levels of 255: likewise, after exposure was taken off
OFTEN = 0.75  # share of the frames in which it must be so
LEAST = 0.0015  # of the image: smaller patches are left alone
SEEDS = 0.08  # of a patch: so much of it must have a measured depth that stays
MARGIN = 0.012  # of the image's width, added around
_SIDE = 160  # pixels across, of the images that are compared


def find_moving(capture: Capture, *, most: int = 40) -> Bool[np.ndarray, "h w"]:
    """What moves with the camera in a capture: True there; nowhere for most captures.

    Args:
      most: frames that are looked at, evenly over the capture.
    """
    indices = np.unique(np.linspace(0, len(capture) - 1, min(most, len(capture))).round().astype(int))
    frames = [capture.read_frame(int(index)) for index in indices]
    depths = [frame.depth for frame in frames]
    return find_moving_in([frame.rgb for frame in frames], [depth for depth in depths if depth is not None])


def read_ignored(work: Path, capture: Capture) -> Bool[np.ndarray, "h w"] | None:
    """What moves with the camera, as the step pose left it in the folder of work; None = nothing does.

    Raises:
      CaptureError: it is of another size than the frames.
    """
    path = work / "ignore.png"
    if not path.is_file():
        return None
    ignored = read_mask(path)
    width, height = capture.size
    if ignored.shape != (height, width):
        raise CaptureError(f"{path}: it is of another size than the frames, {width} × {height}")
    return ignored


def hide(capture: Capture, ignored: Bool[np.ndarray, "h w"] | None) -> Capture:
    """The capture, its frames without what is ignored in all of them."""
    return capture if ignored is None else dataclasses.replace(capture, read_frame=_Hiding(capture.read_frame, ignored))


@dataclasses.dataclass(frozen=True)
class _Hiding:
    read: ReadFrame
    ignored: Bool[np.ndarray, "h w"]

    def __call__(self, index: int, /) -> CaptureFrame:
        frame = self.read(index)
        return dataclasses.replace(frame, usable=frame.usable & ~self.ignored)


def find_moving_in(
    rgbs: Sequence[UInt8[np.ndarray, "h w 3"]], depths: Sequence[Float[np.ndarray, "h w"]]
) -> Bool[np.ndarray, "h w"]:
    """`find_moving`, of images that are in memory.

    It begins where a depth was measured that stays, and goes on where none ever is (what is too near for the depth
    camera) as long as the colour stays. Where more than half of the image stays the camera did not move, and nothing
    can be told.

    Args:
      depths: of the same frames, metres, 0 = unknown.
    """
    import cv2
    from scipy import ndimage

    height, width = rgbs[0].shape[:2]
    nowhere = np.zeros((height, width), bool)
    if len(rgbs) < 4 or len(depths) != len(rgbs):
        return nowhere
    shrink = max(1, width // _SIDE)
    size = width // shrink, height // shrink
    small = np.stack([cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) for rgb in rgbs]).astype(np.float32)
    measured, unknown = _compare_depths(np.stack([_shrink_depth(depth, shrink, size) for depth in depths]))
    if measured.sum() < LEAST * measured.size or measured.mean() > 0.5:
        return nowhere
    off = _compare_colours(small, measured)
    seeds = measured & ((off < 2 * COLOUR).mean(0) >= OFTEN)
    stays = seeds | (unknown & ((off < COLOUR).mean(0) >= OFTEN))
    # Specks are chance; gaps between what was found are noise.
    stays = np.asarray(ndimage.binary_opening(np.pad(stays, 2, mode="edge"), iterations=1))[2:-2, 2:-2]
    stays = np.asarray(ndimage.binary_closing(np.pad(stays, 4, mode="edge"), iterations=3))[4:-4, 4:-4]
    count, labels = cv2.connectedComponents(stays.astype(np.uint8), connectivity=4)
    sizes = np.bincount(labels.ravel(), minlength=count)
    begun = np.bincount(labels.ravel(), weights=seeds.ravel(), minlength=count)
    large = (sizes >= LEAST * stays.size) & (begun >= SEEDS * sizes)
    large[0] = False
    found = large[np.asarray(labels, int)]
    if not found.any():
        return nowhere
    whole = cv2.resize(found.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    margin = max(1, round(MARGIN * width))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    return cv2.dilate(whole, disc) > 0


def _shrink_depth(depth: Float[np.ndarray, "h w"], shrink: int, size: tuple[int, int]) -> Float[np.ndarray, "b a"]:
    """The nearest depth of each block; 0 = none is known."""
    width, height = size
    blocks = depth[: height * shrink, : width * shrink].reshape(height, shrink, width, shrink)
    nearest = np.where(blocks > 0, blocks, np.inf).min(axis=(1, 3))
    return np.where(np.isfinite(nearest), nearest, 0).astype(np.float32)


def _compare_depths(depths: Float[np.ndarray, "n h w"]) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Where the depth is near its median in most frames, and where it is hardly ever known."""
    known = depths > 0
    middle = np.ma.median(np.ma.masked_array(depths, ~known), axis=0).filled(0)
    near = known & (np.abs(depths - middle) < NEAR * np.maximum(middle, 0.1))
    count = known.sum(0)
    return (near.sum(0) >= OFTEN * count) & (count >= 0.4 * len(depths)), count <= 0.1 * len(depths)


def _compare_colours(
    images: Float[np.ndarray, "n h w 3"], seeds: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "n h w"]:
    """By how much colours differ from their median, less what exposure explains: a gain by the seeds, of each frame."""
    middle = np.median(images, axis=0)
    gain = np.median((images + 1)[:, seeds] / (middle[seeds] + 1), axis=(1, 2))
    off = np.abs(images - gain[:, None, None, None] * middle).max(-1)
    white = (images.min(-1) > 250) & (middle.min(-1) > 250)
    return np.where(white, 0, off / np.maximum(gain, 0.5)[:, None, None])

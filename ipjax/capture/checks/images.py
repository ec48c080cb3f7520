"""What a single frame tells of itself: blur, exposure, how much depth there is and how far away the scene is."""

import dataclasses

import cv2
import numpy as np
from jaxtyping import UInt8

from ipjax.capture.records import CaptureFrame

THUMBNAIL = 200  # pixels of its width
FARTHEST = 3.0  # metres that the picture of depth goes to
_FULL, _EMPTY = 250, 6  # of 255: at least as bright counts as overexposed, at most as dark as underexposed
_WIDTH = 640  # pixels; wider images are reduced for the measure of blur, which depends on the size of what is seen


@dataclasses.dataclass(frozen=True)
class ImageMeasures:
    """Of one frame; pixels that move with the camera are left out where a mask names them."""

    sharpness: float  # of `measure_sharpness`: 1 to about 3
    bright: float  # share of pixels in which a channel is full
    dark: float  # share of pixels in which all channels are empty
    known: float  # share of pixels with depth; of the raw depth where no other is given
    distance: float  # median depth, metres; 0 = there is none
    rgb: UInt8[np.ndarray, "h w 3"]  # small pictures
    depth: UInt8[np.ndarray, "h w 3"]


def measure_image(frame: CaptureFrame) -> ImageMeasures:
    """The measures of a frame."""
    usable = frame.usable
    brightest = frame.rgb.max(-1)[usable]
    depth = frame.depth if frame.depth is not None else frame.raw_depth
    assert depth is not None
    inside = usable if depth.shape == usable.shape else np.ones(depth.shape, bool)
    known = depth[inside] > 0
    return ImageMeasures(
        sharpness=measure_sharpness(frame.rgb),
        bright=float(np.mean(brightest >= _FULL)) if brightest.size else 0.0,
        dark=float(np.mean(brightest <= _EMPTY)) if brightest.size else 0.0,
        known=float(known.mean()) if known.size else 0.0,
        distance=float(np.median(depth[inside][known])) if known.any() else 0.0,
        rgb=_shrink(frame.rgb),
        depth=_shrink(draw_depth(depth)),
    )


def draw_depth(depth: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    """Depth (metres) as a picture: near is bright, unknown is black."""
    near = np.clip(255 - 215 * depth / FARTHEST, 40, 255).astype(np.uint8)
    picture = cv2.applyColorMap(near, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    picture[depth <= 0] = 0
    return picture


def measure_sharpness(rgb: UInt8[np.ndarray, "h w 3"]) -> float:
    """How steep the strongest edges are: their slope over that of the same edges blurred.

    Of a step that the camera blurred by σ pixels it is √((σ² + 9) / (σ² + 1)): near 2.5 where the photo is sharp, 1
    where it is not. A moving camera blurs the edges across its way alone, so the lower quarter of all edges counts.
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    if grey.shape[1] > _WIDTH:
        zoom = _WIDTH / grey.shape[1]
        grey = cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
    fine, coarse = (_slope(cv2.GaussianBlur(grey, (0, 0), sigma)) for sigma in (1.0, 3.0))
    ridge = coarse >= 0.98 * cv2.dilate(coarse, np.ones((3, 3), np.uint8))
    strong = ridge & (coarse > np.quantile(coarse, 0.97))
    if not strong.any():
        return 0.0
    near = cv2.dilate(fine, np.ones((5, 5), np.uint8))
    return float(np.quantile(near[strong] / np.maximum(coarse[strong], 1e-6), 0.25))


def _slope(image: np.ndarray) -> np.ndarray:
    return np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1))


def _shrink(image: np.ndarray) -> np.ndarray:
    height = max(round(THUMBNAIL * image.shape[0] / image.shape[1]), 1)
    return cv2.resize(np.ascontiguousarray(image), (THUMBNAIL, height), interpolation=cv2.INTER_AREA)

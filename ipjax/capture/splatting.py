"""Depth in the pixels of the colours where a capture has raw depth alone, before the depth camera is solved."""

import dataclasses

import numpy as np

from ipjax.capture.records import Capture, CaptureFrame
from ipjax.inference.depth import register_depth
from ipjax.transforms import Similarity


def with_depth(capture: Capture, frame: CaptureFrame) -> CaptureFrame:
    """The frame; where only raw depth is there, that is splatted into the colours as the factory says."""
    if frame.depth is not None or frame.raw_depth is None or capture.depth_camera is None:
        return frame
    factory = capture.colour_from_depth or Similarity(np.eye(3), np.zeros(3), np.ones(()))
    depth = register_depth(frame.raw_depth, capture.depth_camera, factory, capture.camera, capture.size)
    return dataclasses.replace(frame, depth=depth)

"""Pictures of labelled frames: the outline of each object at its pose, and its mask."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ipjax.files.images.run_lengths import decode_rle
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.drawing import PALETTE, draw_mask, draw_overlay
from ipjax.labelling.entries import Entry
from ipjax.labelling.outputs.bop_files import find_pose


def draw_entry(
    rgb: UInt8[np.ndarray, "h w 3"], entry: Entry, infos: Mapping[int, ObjectInfo], *, height: int = 480
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """A labelled frame: outlines, axes and boxes of what was found, masks dotted, each with its name and confidence.

    Args:
        rgb: of the frame.
        infos: of the objects, by number.
        height: of the picture, pixels.
    """
    found = [one for one in entry["instances"] if one["success"]]
    shown = [infos[one["number"]] for one in found]
    poses: list[Any] = [
        find_pose(one) @ info.object_from_mesh.to_numpy().inverse() for one, info in zip(found, shown, strict=True)
    ]
    colours = [PALETTE[list(infos).index(one["number"]) % len(PALETTE)] for one in found]
    camera = np.asarray(entry["camera"]).reshape(3, 3)
    picture = draw_overlay(rgb, camera, poses, shown, colours=colours or PALETTE, height=height)
    for one, info, colour in zip(found, shown, colours, strict=True):
        if one["mask"]:
            mask = decode_rle({"size": entry["size"], "counts": one["mask"]})
            guess = "" if one["present"] else ", a guess"
            draw_mask(picture, mask, f"{info.name} {one['confidence']:.2f}{guess}", colour)
    return picture

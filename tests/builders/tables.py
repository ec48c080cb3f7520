"""Frames of a table with blocks on it, drawn without a renderer."""

import numpy as np


def table_frame(blocks, height=240, width=320, noise=0.001, seed=0):
    """A grey table seen from above at a slant, and blocks: ((left, top, right, bottom), colour, metres of height).

    Returns rgb, depth, K and a mask for each block.
    """
    rng = np.random.default_rng(seed)
    matrix = np.array([[300.0, 0, (width - 1) / 2], [0, 300, (height - 1) / 2], [0, 0, 1]])
    depth = np.broadcast_to(1.0 - 0.2 * np.linspace(-0.5, 0.5, height)[:, None], (height, width)).copy()
    rgb = np.full((height, width, 3), 128.0)
    masks = np.zeros((len(blocks), height, width), bool)
    for mask, ((left, top, right, bottom), colour, up) in zip(masks, blocks, strict=True):
        mask[top:bottom, left:right] = True
        depth[mask] -= up
        rgb[mask] = colour
    rgb += rng.normal(0, 4, rgb.shape)
    depth += rng.normal(0, noise, depth.shape)
    return rgb.clip(0, 255).astype(np.uint8), depth.astype(np.float32), matrix, masks


RED, BLUE, GREEN = (200, 50, 40), (40, 70, 190), (40, 160, 60)
THREE = [((40, 60, 100, 130), RED, 0.08), ((150, 90, 200, 140), BLUE, 0.05), ((230, 150, 290, 215), GREEN, 0.1)]

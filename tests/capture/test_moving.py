"""What moves with the camera is found without a mask, and nothing where nothing does."""

import numpy as np

from ipjax.capture.moving import find_moving_in


def film(frames: int = 8, *, finger: bool = True, moves: bool = True, depth: bool = True):
    """A plain wall of changing distance and exposure; a finger that reaches in, whose tip is too near for depth."""
    rng = np.random.default_rng(0)
    wall = rng.integers(0, 255, (120, 400, 3)).astype(np.float32)
    rgbs, depths = [], []
    for index in range(frames):
        shift = 13 * index if moves else 0
        image = wall[:, shift : shift + 160].copy()
        z = np.full((120, 160), 0.5 + (0.03 * index if moves else 0)) + rng.normal(0, 0.002, (120, 160))
        if finger:
            image[80:, 60:90] = [90, 60, 50]
            z[80:, 60:90] = 0.2 + rng.normal(0, 0.001, (40, 30))
            z[80:, 60:75] = 0
        rgbs.append(np.clip(image * rng.uniform(0.7, 1.0), 0, 255).astype(np.uint8))
        depths.append(np.where(rng.uniform(size=z.shape) < 0.05, 0, z).astype(np.float32))
    return rgbs, depths if depth else []


def test_finds_what_stays_in_the_image():
    mask = find_moving_in(*film())
    assert mask[82:, 62:88].all()
    mask[76:, 55:95] = False
    assert not mask.any()


def test_finds_nothing_where_nothing_stays_or_all_does():
    assert not find_moving_in(*film(finger=False)).any()
    assert not find_moving_in(*film(moves=False)).any()  # the camera stood still: nothing can be told
    assert not find_moving_in(*film(3)).any()
    assert not find_moving_in(*film(depth=False)).any()

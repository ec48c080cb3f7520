"""Borders of masks go where the photo has them, if it shows them."""

import numpy as np
import pytest

from ipjax.capture.labels.borders import snap

HEIGHT, WIDTH = 60, 80
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)


def draw(shift=0):
    """Two things that touch, as ids."""
    left = (np.abs(ROWS - 30) < 15) & (np.abs(COLUMNS - 30 - shift) < 12)
    right = (np.hypot(ROWS - 30, COLUMNS - 52 - shift) < 11) & ~left
    return np.where(left, 0, np.where(right, 1, -1))


def paint(ids, colours, seed=0):
    image = np.array(colours, float)[ids] + np.random.default_rng(seed).normal(0, 4, (HEIGHT, WIDTH, 3))
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shift", [-1, 1])
def test_masks_that_were_drawn_beside_things_find_them(shift):
    truth, drawn = draw(), draw(shift)
    found = snap(paint(truth, [[200, 60, 60], [60, 80, 190], [120, 120, 110]]), drawn, 2, EVERYWHERE)
    wrong = lambda ids: (ids != truth).mean()
    assert wrong(drawn) > 0.01 and wrong(found) < 0.2 * wrong(drawn)


def test_without_contrast_they_stay():
    drawn = draw(1)
    found = snap(np.full((HEIGHT, WIDTH, 3), 128, np.uint8), drawn, 2, EVERYWHERE)
    np.testing.assert_array_equal(found, drawn)


def test_nothing_grows_into_what_is_hidden():
    truth, drawn = draw(), draw(1)
    hidden = COLUMNS < 22
    found = snap(paint(truth, [[200, 60, 60], [60, 80, 190], [120, 120, 110]]), np.where(hidden, -1, drawn), 2, ~hidden)
    assert (found[hidden] == -1).all()

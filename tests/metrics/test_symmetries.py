"""Symmetries are BOP's."""

import numpy as np
import pytest
from builders.poses import ERRORS, OBJECTS, symmetries_of

from ipjax import metrics


@pytest.mark.parametrize("number", OBJECTS)
def test_symmetries_are_bops(number):
    rotations, translations = symmetries_of(number)
    assert len(rotations) == int(ERRORS[f"obj{number}_n_syms"])
    chosen = ERRORS[f"obj{number}_sym_idx"]
    np.testing.assert_allclose(rotations[chosen], ERRORS[f"obj{number}_sym_R"], atol=1e-6)
    np.testing.assert_allclose(translations[chosen], ERRORS[f"obj{number}_sym_t"], atol=1e-5)


def test_symmetries_say_what_is_wrong():
    with pytest.raises(ValueError, match="16 numbers"):
        metrics.discretise_symmetries([np.eye(3)])
    with pytest.raises(ValueError, match="length 0"):
        metrics.discretise_symmetries([], [(np.zeros(3), np.zeros(3))])
    with pytest.raises(ValueError, match="positive"):
        metrics.discretise_symmetries(step=0.0)

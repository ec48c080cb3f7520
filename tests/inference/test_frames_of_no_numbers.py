"""Frames of which parts are no numbers: such depth is unknown, such colours and cameras are refused."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipjax.inference.frames import frame

BAD = (np.nan, np.inf, -np.inf)


def scene() -> dict:
    """A ball before a wall."""
    rows, columns = np.mgrid[:120, :160]
    mask = (rows - 60) ** 2 + (columns - 80) ** 2 < 30**2
    rgb = np.random.default_rng(0).random((120, 160, 3)).astype(np.float32)
    depth = np.where(mask, 0.8, 1.5).astype(np.float64)
    return {"rgb": rgb, "depth": depth, "mask": mask, "camera": np.array([[150.0, 0, 80], [0, 150.0, 60], [0, 0, 1]])}


@given(
    bad=st.sampled_from([*BAD, 1e300, -1.0]),
    kind=st.sampled_from(["float16", "float32", "float64"]),
    seed=st.integers(0, 9),
)
@settings(max_examples=20)
def test_frame_takes_depth_that_is_no_number_for_unknown(bad, kind, seed):
    given_, unknown = scene(), scene()
    places = np.random.default_rng(seed).random((120, 160)) < 0.05
    with np.errstate(over="ignore"):
        given_["depth"][places] = bad
        given_["depth"] = given_["depth"].astype(kind)
    unknown["depth"][places] = 0
    unknown["depth"] = unknown["depth"].astype(kind)
    options = {"resolution": 56, "depth_scale": 1.0}
    jax.tree.map(np.testing.assert_array_equal, frame(**given_, **options), frame(**unknown, **options))


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("place", [("rgb", (3, 4, 0)), ("camera", (0, 0)), ("camera", (1, 2))])
def test_frame_refuses_images_and_cameras_that_are_no_numbers(place, bad):
    name, index = place
    arguments = scene()
    arguments[name][index] = bad
    with pytest.raises(ValueError, match=r"finite|positive|numbers"):
        frame(**arguments, resolution=56)

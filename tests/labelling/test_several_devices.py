"""A batch is divided among the devices of a process, and the answers stay."""

import jax
import numpy as np
from builders import several_devices
from builders.labelled_frames import as_batch, labeller, make_frames

from ipjax.inference.batching import Spread


def test_four_devices_give_the_answers_of_one_from_programs_compiled_once():
    """Two objects, whose three and two crops are padded to four: one for each device."""
    expected = labeller(threads=2)(as_batch(make_frames(5)))
    found = several_devices.label(5)
    assert found["buckets"] == [4]
    assert set(found["programs"]) == {"describe all, divided", "estimate all, divided"}
    assert all(set(counts) == {4} for counts in found["programs"].values())
    for name, column in found["columns"].items():
        if np.asarray(column).dtype.kind == "f":
            np.testing.assert_allclose(column, expected[name], rtol=2e-3, atol=2e-3, err_msg=name)
        elif name != "mask":
            assert column == expected[name].tolist(), name
    assert all(all(row) for row in found["columns"]["success"])


def test_batches_are_divided_only_where_each_device_gets_as_much():
    one = jax.local_devices()[:1]
    assert not Spread(one).fits(4)
    several = Spread.__new__(Spread)
    several.devices = tuple(one * 4)
    assert [size for size in range(1, 13) if several.fits(size)] == [4, 8, 12]

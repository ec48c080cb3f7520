"""A small capture for every test of reading and checking: made once, written once."""

import pytest

from ipjax.synthetic.captures import make_capture, write_capture


@pytest.fixture(scope="session")
def made():
    """Six frames of 320 × 240 pixels, 11° apart, the factory's calibration right."""
    return make_capture(4, views=6, objects=4, size=(320, 240), arc=66, factory_error=0)


@pytest.fixture(scope="session")
def folder(made, tmp_path_factory):
    """The same as a folder of frames, with its poses; not to be changed."""
    return write_capture(made, tmp_path_factory.mktemp("capture"), poses=True)

"""Data sets that several tests score."""

import pytest
from builders.bop_roots import write_images, write_protocol

from ipjax.bop.dataset import Dataset


@pytest.fixture(scope="module")
def protocol(tmp_path_factory) -> Dataset:
    return Dataset(write_protocol(tmp_path_factory.mktemp("bop") / "golden"))


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Dataset:
    return Dataset(write_images(tmp_path_factory.mktemp("bop") / "small"))

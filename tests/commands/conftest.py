"""A folder with every input of a frame."""

import json

import numpy as np
import pytest
from builders.command_lines import K
from builders.objects import make_object
from PIL import Image

from ipjax.files.objects.saving import save


@pytest.fixture
def case(tmp_path, monkeypatch):
    """A folder with every input of a frame, all of them well-formed."""
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    monkeypatch.setenv("IPJAX_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("IPJAX_DEBUG", raising=False)
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (96, 128, 3), dtype=np.uint8)).save(tmp_path / "rgb.png")
    Image.fromarray(np.full((96, 128), 812, np.uint16)).save(tmp_path / "depth.png")
    mask = np.zeros((96, 128), np.uint8)
    mask[30:60, 40:80] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    (tmp_path / "camera.json").write_text(json.dumps(K | {"depth_scale": 1.0}))
    save(tmp_path / "mug.ipjax", *make_object())
    return tmp_path

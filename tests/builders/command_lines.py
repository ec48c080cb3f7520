"""Valid command lines of ``ipjax``, for tests to change, and how tests run them."""

import json
from pathlib import Path

import numpy as np
from builders.objects import make_object
from PIL import Image

from ipjax import cli
from ipjax.files.objects.saving import save

K = {"fx": 110.0, "fy": 108.0, "cx": 63.2, "cy": 47.4}


def write_case(folder: Path) -> None:
    """Every input of a frame, all of them well-formed, and an object file."""
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (96, 128, 3), dtype=np.uint8)).save(folder / "rgb.png")
    Image.fromarray(np.full((96, 128), 812, np.uint16)).save(folder / "depth.png")
    mask = np.zeros((96, 128), np.uint8)
    mask[30:60, 40:80] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    (folder / "camera.json").write_text(json.dumps(K | {"depth_scale": 1.0}))
    save(folder / "mug.ipjax", *make_object())


def estimate_words(folder, *more, **replace) -> list[str]:
    """``ipjax estimate`` on the folder of the fixture `case`; ``replace``: another file for an option, or None.

    ``more`` comes last.
    """
    given = {"rgb": "rgb.png", "depth": "depth.png", "camera": "camera.json", "mask": "mask.png"} | replace
    words = ["estimate", str(folder / given.pop("object", "mug.ipjax")), "-o", str(folder / "out.json")]
    for name, value in given.items():
        if value is not None:
            words += [f"--{name}", str(folder / value)]
    return [*words, "--overlay", str(folder / "out.png"), *map(str, more)]


def run(argv) -> int:
    """The exit status of ``ipjax``, also where argparse ends the process."""
    try:
        return cli.main(argv)
    except SystemExit as stop:  # argparse
        return int(stop.code or 0)

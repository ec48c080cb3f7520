"""``python -m benchmarks.bug_case_images FOLDER``: what is read from each camera, mask and depth file of FOLDER.

FOLDER holds camera/, mask_*/ and depth_endian/, as small files that other people's reports describe. A line per file:
what was read and the warnings, or the sentence of refusal.
"""

import argparse
import logging
import sys
from pathlib import Path

import numpy as np

from ipjax.files.cameras.reading import read_camera
from ipjax.files.images.depth import read_depth
from ipjax.files.images.masks import read_mask
from ipjax.files.images.opening import read_rgb
from ipjax.inference.frames import frame

SIZE = (640, 480)  # of the images that the cameras and masks were made for
K = np.array([[1066.778, 0, 312.9869], [0, 1067.487, 241.3109], [0, 0, 1]])


class _LogLines(logging.Handler):
    def __init__(self):
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    if not (folder / "camera").is_dir():
        print(f"{folder}: it has no folder camera/", file=sys.stderr)
        return 2
    said = _LogLines()
    logging.getLogger("ipjax").addHandler(said)
    for path in sorted((folder / "camera").iterdir()):
        _row(path, said, _camera)
    for path in sorted(folder.glob("mask_*/*")):
        _row(path, said, _mask)
    for path in sorted(folder.glob("depth_endian/depth*")):
        _row(path, said, _depth)
    return 0


def _row(path: Path, said: _LogLines, read) -> None:
    said.lines.clear()
    try:
        text = read(path)
    except Exception as error:
        text = f"{'' if isinstance(error, ValueError) else type(error).__name__ + ': '}{error}"
        text = "refused: " + text.replace(f"{path}: ", "").split("\n")[0]
    warned = "".join(f"; WARNING {line}" for line in said.lines)
    print(f"| {path.parent.name}/{path.name} | {text}{warned} |")


def _camera(path: Path) -> str:
    camera = read_camera(path)
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2]
    text = f"fx {fx:.1f} fy {fy:.1f} cx {cx:.1f} cy {cy:.1f}, size {camera.size}, {camera.lens} {camera.distortion}"
    width, height = SIZE if camera.size is None else camera.size
    y, x = np.mgrid[:height, :width]
    mask = np.hypot(x - width / 2, y - height / 2) < 60
    frame(np.full((height, width, 3), 0.5), np.full((height, width), 0.9), mask, camera, depth_scale=1.0)
    return text


def _mask(path: Path) -> str:
    mask = read_mask(path)
    y, x = np.nonzero(mask)
    text = f"{mask.sum()} pixels" + (f" of x {x.min()}–{x.max()}, y {y.min()}–{y.max()}" if mask.any() else "")
    height, width = mask.shape
    frame(np.full((height, width, 3), 0.5), np.full((height, width), 0.9), mask, K)
    return text


def _depth(path: Path) -> str:
    """The same frame with each of the depth files: all of them hold the same depth."""
    depth = read_depth(path)
    folder = path.parent
    rgb, mask, camera = (
        read(folder / name)
        for read, name in ((read_rgb, "rgb.png"), (read_mask, "mask.png"), (read_camera, "camera.txt"))
    )
    unit = 1.0 if depth.dtype.kind == "f" else 1e-3
    view = frame(rgb, depth, mask, camera, depth_scale=unit)
    known = np.asarray(view.depth)[np.asarray(view.depth) > 0]
    raw = np.load(path) if path.suffix == ".npy" else depth
    again = frame(rgb, raw, mask, camera, depth_scale=unit)
    farthest = float(np.asarray(again.depth).max())
    span = f"{known.min():.3f} to {known.max():.3f} m"
    return f"{depth.dtype.str}: crop from {span}; the array as NumPy loads it {farthest:.3f} m"


if __name__ == "__main__":
    sys.exit(main())

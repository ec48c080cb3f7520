"""TUM RGB-D (https://cvg.cit.tum.de/data/datasets/rgbd-dataset): colours and depth of their own times, poses of others.

``rgb.txt`` and ``depth.txt`` list times and files, or the files in ``rgb/`` and ``depth/`` are named by their times;
``groundtruth.txt`` has ``time tx ty tz qx qy qz qw``. Where names are no times, equal names are of one frame, and the
lines of ``groundtruth.txt`` are in the order of the frames.
"""

from pathlib import Path
from typing import Any

import numpy as np

from ipjax.capture.reading.files import (
    CAMERAS,
    COLOURS,
    DEPTHS,
    FrameFiles,
    assemble,
    check_names,
    find_depth_form,
    list_images,
    pick_camera,
)
from ipjax.capture.reading.poses import NEAR, interpolate, read_timed_poses
from ipjax.capture.records import Capture, CaptureError
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.storage.parsing import read_text

SCALE = 1 / 5000  # metres per number of the depth images
_EARLIEST = 1e6  # seconds: what is a time, not the number of an image
# As the data set's page gives them; the third set was published undistorted.
SEQUENCES = {
    "tum-fr1": Intrinsics(
        np.array([[517.3, 0, 318.6], [0, 516.5, 255.3], [0, 0, 1]]), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "tum-fr2": Intrinsics(
        np.array([[520.9, 0, 325.1], [0, 521.0, 249.7], [0, 0, 1]]), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    "tum-fr3": Intrinsics(np.array([[535.4, 0, 320.1], [0, 539.2, 247.6], [0, 0, 1]])),
}


def is_tum(folder: Path) -> bool:
    """Whether a folder has this form."""
    if any((folder / name).is_file() for name in ("rgb.txt", "groundtruth.txt")):
        return True
    images = list_images(folder / "rgb", COLOURS)
    return bool(images) and all(_as_time(name) is not None and "." in name for name in images)


def open_tum(folder: Path, *, camera: Any, depth_scale: float | int | None, poses: bool, chosen: slice) -> Capture:
    """A capture of this form; arguments and errors are `open_capture`'s."""
    if isinstance(camera, str) and camera in SEQUENCES:
        intrinsics = SEQUENCES[camera]
    else:
        try:
            intrinsics = pick_camera(folder, camera)
        except CaptureError as error:
            if camera is not None or any((folder / name).is_file() for name in CAMERAS):
                raise
            raise CaptureError(f"{error}; of TUM's own sequences one of {', '.join(SEQUENCES)}") from None
    colours, depths = _list(folder, "rgb", COLOURS), _list(folder, "depth", DEPTHS)
    if not colours or not depths:
        raise CaptureError(f"{folder}: {'rgb' if not colours else 'depth'}/ has no images")
    notes = []
    timed = all(time is not None for time, _ in [*colours, *depths])
    if timed:
        pairs = _associate(np.array([t for t, _ in colours], float), np.array([t for t, _ in depths], float))
        if len(pairs) < len(colours):
            notes.append(
                f"{len(colours) - len(pairs)} of {len(colours)} colour images have no depth image within "
                f"{1000 * NEAR:.0f} ms and are left out"
            )
        if not pairs:
            raise CaptureError(
                f"{folder}: no colour image has a depth image within {1000 * NEAR:.0f} ms: are the times right?"
            )
        frames = [(colours[i][0], colours[i][1], depths[j][1]) for i, j in pairs]
    else:
        by_name = {path.stem: path for _, path in depths}
        check_names(folder / "depth", "the depth image", [path.stem for _, path in colours], by_name)
        frames = [(None, path, by_name[path.stem]) for _, path in colours]
    truth, world_from_camera = folder / "groundtruth.txt", None
    known = np.ones(len(frames), bool)
    if poses and truth.is_file():
        times, given = read_timed_poses(truth)
        if timed:
            world_from_camera, known = interpolate(times, given, np.array([time for time, _, _ in frames], float))
            if not known.any():
                raise CaptureError(f"{truth}: no image has a pose within {1000 * NEAR:.0f} ms: are the times right?")
            if not known.all():
                notes.append(
                    f"{(~known).sum()} of {len(frames)} images have no pose within {1000 * NEAR:.0f} ms and are left "
                    "out"
                )
        elif len(times) != len(frames):
            raise CaptureError(
                f"{truth}: {len(times)} poses for {len(frames)} images whose names are no times: nothing says which is "
                "whose"
            )
        else:
            world_from_camera = given
    picked = np.flatnonzero(known)[chosen]
    files = [FrameFiles(frames[i][1].stem, frames[i][1], frames[i][2]) for i in picked]
    stems = [item.name for item in files]
    twice = next((name for name in stems if stems.count(name) > 1), None) if len(set(stems)) < len(stems) else None
    if twice is not None:
        raise CaptureError(f"{folder}: two of its images are called {twice}; frames are told apart by these names")
    if world_from_camera is not None:
        world_from_camera = world_from_camera.take(picked)
    return assemble(
        folder,
        "tum",
        files,
        intrinsics,
        depth=find_depth_form((item.depth for item in files), intrinsics, depth_scale, SCALE),
        world_from_camera=world_from_camera,
        notes=notes,
    )


def _list(folder: Path, kind: str, suffixes: tuple[str, ...]) -> list[tuple[float | None, Path]]:
    """The images of a kind with their times, in the order of the times; None where names are no times."""
    index = folder / f"{kind}.txt"
    found: list[tuple[float | None, Path]] = []
    if not index.is_file():
        for name, path in list_images(folder / kind, suffixes).items():
            found.append((_as_time(name), path))
    else:
        try:
            lines = read_text(index, "list of images").splitlines()
        except ValueError as error:
            raise CaptureError(str(error)) from None
        for number, line in enumerate(lines, 1):
            words = line.split("#")[0].split()
            if not words:
                continue
            time = _as_time(words[0], listed=True)
            if len(words) != 2 or time is None:
                raise CaptureError(f"{index}: line {number}: a time and a file are expected, not {line.strip()[:60]!r}")
            path = folder / words[1]
            if not path.is_file():
                raise CaptureError(f"{index}: line {number}: {path} is not there")
            found.append((time, path))
    return sorted(found, key=lambda item: (item[0] is None, item[0] or 0.0, item[1].name))


def _as_time(text: str, *, listed: bool = False) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if np.isfinite(value) and (listed or value > _EARLIEST) else None


def _associate(first: np.ndarray, second: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of two lists of times, the nearest first, each time once, none farther apart than `NEAR`."""
    candidates = []
    low, high = np.searchsorted(second, first - NEAR), np.searchsorted(second, first + NEAR, side="right")
    for i, (start, end) in enumerate(zip(low, high, strict=True)):
        candidates.extend((abs(first[i] - second[j]), i, j) for j in range(start, end))
    taken: tuple[set[int], set[int]] = (set(), set())
    pairs = []
    for _, i, j in sorted(candidates):
        if i not in taken[0] and j not in taken[1]:
            taken[0].add(i)
            taken[1].add(j)
            pairs.append((i, j))
    return sorted(pairs)

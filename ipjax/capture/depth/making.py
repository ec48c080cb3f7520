"""The step from a capture with poses to depth in the pixels of its colours: a folder of frames again.

::

    WORK/rgb/NAME.png  WORK/depth/NAME.png  WORK/camera.json    colours, depth in tenths of a millimetre, the camera
    WORK/confidence/NAME.png      255 = all that was seen agrees; half of that = a frame's own depth alone; 0 = unknown
    WORK/depth_pictures/NAME.jpg  colours with the edges of the depth that the factory gives, and of this one
    WORK/depth.json               the depth camera, in numbers and words; figures of the modes side by side
"""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from ipjax.cameras import project
from ipjax.capture.depth.figures import Figures, measure_modes
from ipjax.capture.depth.fusion import NEIGHBOURS, FusedDepth, fuse
from ipjax.capture.depth.paper import align_as_paper, lay_over
from ipjax.capture.depth.pictures import draw_depths
from ipjax.capture.depth.rigs import Rig, SolvedRig, find_start, leave
from ipjax.capture.depth.solving import solve_depth_camera, spread
from ipjax.capture.depth.stereo import StereoDepth, Views, choose_neighbours, shrink_views, sweep_view
from ipjax.capture.depth.warping import lift_raw, warp
from ipjax.capture.records import Capture, CaptureError, CaptureFrame, Trajectory
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import write_text, writing

MODES = ("solve", "paper", "factory")
UNIT = 0.0001  # metres per number of the depth images
VERSION = 1
_KEPT = 16  # frames that are kept in memory
_MEASURED = 2  # frames on which the modes are compared
_SCORE = 0.7  # correlation of the stereo that the paper's mode takes

Told = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class DepthReport:
    """What the step found and wrote."""

    mode: str
    solved: SolvedRig
    figures: dict[str, Figures]  # of every mode, on a few frames; none of the factory's mode, or without poses
    made: int  # frames written now; the others were there
    filled: float  # share of the pixels whose depth is known, over all frames
    lines: tuple[str, ...]  # all of it in words


class DepthMaker:
    """Depth of the frames of one capture, one at a time."""

    def __init__(self, capture: Capture, trajectory: Trajectory):
        self.capture, self.trajectory = capture, trajectory
        self.start, self.told = find_start(capture)
        self.K, self.size = np.asarray(capture.camera.to_matrix(), np.float64), capture.size
        self.read = functools.lru_cache(_KEPT)(capture.read_frame)
        self.views: Views | None = None
        self.stereo = functools.lru_cache(_KEPT)(self._sweep)

    def shrink(self, progress: Callable[[int, int], None] | None = None) -> Views:
        """The views for the stereo, read once."""
        if self.views is None:
            self.views = shrink_views(self.capture, self.trajectory, read=self.read, progress=progress)
        return self.views

    def _sweep(self, place: int) -> StereoDepth:
        return sweep_view(self.shrink(), place)

    def raw(self, index: int) -> Float[np.ndarray, "hd wd"]:
        """A frame's depth as its depth camera saw it, or what was registered of it, without what moves along."""
        frame = self.read(index)
        raw = frame.depth if self.capture.depth_camera is None else frame.raw_depth
        if raw is None:
            raise CaptureError(f"{self.capture.folder}: frame {frame.name} has no depth image")
        if frame.usable.all():
            return raw
        points = lift_raw(raw, self.start)
        column, row = np.round(project(self.K, points.reshape(-1, 3))).astype(int).T
        inside = (column >= 0) & (column < self.size[0]) & (row >= 0) & (row < self.size[1])
        use = frame.usable[np.clip(row, 0, self.size[1] - 1), np.clip(column, 0, self.size[0] - 1)]
        return np.where((use | ~inside).reshape(raw.shape), raw, 0)

    def solve(self, progress: Callable[[int, int], None] | None = None) -> SolvedRig:
        """The depth camera, solved over the frames that have poses."""
        if self.trajectory.registered.sum() < 3:
            return leave(self.start, "fewer than three frames have poses: the depth camera's rig is left as it was")
        views = self.shrink()
        return solve_depth_camera(
            views,
            lambda place: self.raw(views.indices[place]),
            self.start,
            told=self.told,
            look=self.stereo,
            progress=progress,
        )

    def by_factory(self, index: int) -> Float[np.ndarray, "h w"]:
        """Registered by the makers of the camera, or by what they tell of it."""
        frame = self.read(index)
        return frame.depth if frame.depth is not None else warp(self.raw(index), self.start, self.K, self.size)

    def by_rig(self, index: int, rig: Rig, *, fused: bool = True) -> FusedDepth:
        """By a rig, and with what neighbouring frames saw of the same surfaces."""
        own = warp(self.raw(index), rig, self.K, self.size)
        views = self.shrink() if fused and self.trajectory.registered[index] else None
        if views is None or len(views.indices) < 3:
            return fuse(own, [])
        place = views.indices.index(index)
        camera_from_world = views.pose(place).inverse()
        others = [
            warp(self.raw(views.indices[other]), rig, self.K, self.size, camera_from_world @ views.pose(other))
            for other in choose_neighbours(views, place, NEIGHBOURS)[0]
        ]
        found = fuse(own, others, slots=NEIGHBOURS)
        usable = self.read(index).usable  # what moves with the camera hides what others saw behind it
        return FusedDepth(np.where(usable, found.depth, 0), np.where(usable, found.confidence, 0))

    def by_paper(self, index: int) -> Float[np.ndarray, "h w"]:
        """By the paper's Algorithm 1, on small images; nothing where the frame has no pose."""
        views = self.shrink()
        if not self.trajectory.registered[index]:
            return np.zeros(self.size[::-1], np.float32)
        found = self.stereo(views.indices.index(index))
        captured = lay_over(self.raw(index), self.start.depth_camera, views.K, views.size)
        small = align_as_paper(captured, np.where(found.score > _SCORE, found.depth, 0), views.K).depth
        return np.asarray(Image.fromarray(small.astype(np.float32)).resize(self.size, Image.Resampling.NEAREST))


def make_depth(
    capture: Capture,
    trajectory: Trajectory,
    work: str | Path,
    *,
    mode: str = "solve",
    fused: bool = True,
    progress: Told | None = None,
) -> DepthReport:
    """Write the depth of every frame, in the pixels of its colours; what is there of the same inputs is kept.

    Args:
      trajectory: of the same frames.
      mode: "solve" = the depth camera solved once, then every frame warped and fused with its neighbours; "paper" =
        RobotP's Algorithm 1; "factory" = as the camera's makers register it.
      fused: in the mode "solve": whether neighbouring frames' depth counts.
      progress: called as ``progress(what, done, total)``.

    Raises:
      CaptureError: poses of other frames, no depth, or a mode that is not known.
    """
    if mode not in MODES:
        raise CaptureError(f"no mode is called {mode!r}; one of {', '.join(MODES)}")
    if trajectory.names != capture.names:
        raise CaptureError(
            f"the poses are of {len(trajectory)} frames, not of the {len(capture)} of {capture.folder}: give those "
            "that ipjax capture pose found in this capture, with the same --every"
        )
    work, tell = Path(work), progress or (lambda what, done, total: None)
    maker = DepthMaker(capture, trajectory)
    key = _hash(capture, trajectory, mode, fused, work)
    for folder in ("rgb", "depth", "confidence", "depth_pictures"):
        (work / folder).mkdir(parents=True, exist_ok=True)
    document = _read(work / "depth.json", key)
    if document is None:
        # What is there is of other poses or settings: its depth, which is written last, is what says that it is done.
        for path in (work / "depth").glob("*.png"):
            path.unlink()
        if mode == "factory":
            solved, figures = leave(maker.start, "the depth camera is where the factory says"), {}
        else:
            maker.shrink(lambda done, total: tell("reading", done, total))
            solved = maker.solve(lambda done, total: tell("solving", done, total))
            figures = measure_modes(maker, solved.rig, spread(len(capture), _MEASURED), progress=tell)
        document = {"key": key, "mode": mode, "solved": _describe(solved), "figures": {}}
        document["figures"] = {name: dataclasses.asdict(each) for name, each in figures.items()}
        width, height = capture.size
        K = maker.K
        camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": width, "height": height}
        write_text(work / "camera.json", json.dumps(camera | {"depth_scale": UNIT * 1000}, indent=2))
        write_text(work / "depth.json", json.dumps(document, indent=1))
    else:
        solved = _restore(document["solved"])
        figures = {name: Figures(**each) for name, each in document["figures"].items()}
    made, known = 0, []
    for index, name in enumerate(capture.names):
        target = work / "depth" / f"{name}.png"
        if not target.is_file():
            known.append(_make_frame(maker, index, name, work, mode, fused, solved.rig))
            made += 1
        tell("depth", index + 1, len(capture))
    filled = float(np.mean(known)) if made == len(capture) else _measure_filled(work, capture.names)
    lines = (*solved.notes, *(f"{name}: {each.tell()}" for name, each in figures.items()))
    return DepthReport(mode, solved, figures, made, filled, (*lines, f"{100 * filled:.1f} % of the pixels are known"))


def _make_frame(maker: DepthMaker, index: int, name: str, work: Path, mode: str, fused: bool, rig: Rig) -> float:
    frame: CaptureFrame = maker.read(index)
    if mode == "solve":
        found = maker.by_rig(index, rig, fused=fused)
    else:
        depth = maker.by_factory(index) if mode == "factory" else maker.by_paper(index)
        found = fuse(depth, [])
    factory = found.depth if mode == "factory" else maker.by_factory(index)
    _save(work / "rgb" / f"{name}.png", frame.rgb)
    _save(work / "confidence" / f"{name}.png", np.round(255 * found.confidence).astype(np.uint8))
    _save(work / "depth_pictures" / f"{name}.jpg", draw_depths(frame.rgb, factory, found.depth, found.confidence))
    units = np.round(found.depth / UNIT)
    # What is farther than an image can say is not known, rather than nearer.
    _save(work / "depth" / f"{name}.png", np.where(units <= 65535, units, 0).astype(np.uint16))
    return float((found.depth > 0).mean())


def _save(path: Path, image: np.ndarray) -> None:
    settings: dict[str, Any] = {"quality": 90} if path.suffix == ".jpg" else {"compress_level": 1}
    with writing(path) as temporary:
        Image.fromarray(image).save(temporary, **settings)


def _measure_filled(work: Path, names: tuple[str, ...]) -> float:
    shares = []
    for name in names:
        with Image.open(work / "depth" / f"{name}.png") as image:
            shares.append(float((np.asarray(image) > 0).mean()))
    return float(np.mean(shares))


def _hash(capture: Capture, trajectory: Trajectory, mode: str, fused: bool, work: Path) -> str:
    """Of what the result depends on; of the capture's files, how large and how new they are."""
    start, told = find_start(capture)
    settings = [VERSION, str(capture.folder.resolve()), capture.names, capture.size, mode, fused, told, start.to_json()]
    own = work.resolve()  # may lie in the capture's folder
    files = sorted(p for p in capture.folder.rglob("*") if p.is_file() and not p.resolve().is_relative_to(own))
    settings.append([(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in files])
    matrices = trajectory.world_from_camera.to_matrix().round(9).tolist()
    text = json.dumps([*settings, matrices, trajectory.registered.tolist()])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _read(path: Path, key: str) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        document = read_json(path, "report of depth")
    except ValueError:
        return None
    return document if isinstance(document, dict) and document.get("key") == key else None


def _describe(solved: SolvedRig) -> dict[str, Any]:
    plain = lambda number: float(number) if np.isfinite(number) else None
    return {
        "rig": solved.rig.to_json(),
        "solution": solved.solution.to_json(),
        "deviation": [plain(x) for x in solved.deviation],
        "trusted": bool(solved.trusted),
        "agreement": plain(solved.agreement),
        "spread": plain(solved.spread),
        "spread_before": plain(solved.spread_before),
        "notes": list(solved.notes),
    }


def _restore(document: dict[str, Any]) -> SolvedRig:
    number = lambda value: np.nan if value is None else float(value)
    return SolvedRig(
        Rig.from_json(document["rig"]),
        Rig.from_json(document["solution"]),
        np.array([np.inf if x is None else x for x in document["deviation"]], float),
        document["trusted"],
        number(document["agreement"]),
        number(document["spread"]),
        number(document["spread_before"]),
        tuple(document["notes"]),
    )

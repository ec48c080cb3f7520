"""The poses of a capture, refined: depth images brought to agree, with recognised points of the colours.

RobotP refines its poses inside groups of frames that look alike, and then all together; ``stages`` has that, and all
together from the start, which ends at the same poses, is quicker, and is the default (`benchmarks.captures refine`).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np
from ipjax_kernels.trajectory import Gates
from jaxtyping import Bool, Float, Int

from ipjax.capture.poses.tracks import collect, reproject, triangulate
from ipjax.capture.records import Capture, CaptureError, Tracks, Trajectory
from ipjax.capture.refinement.certainty import Certainty, judge
from ipjax.capture.refinement.graph import Pairs
from ipjax.capture.refinement.groups import all_pairs, choose_pairs, group_frames
from ipjax.capture.refinement.solving import Equations, Problem, State, descend, evaluate
from ipjax.capture.refinement.surfaces import Level, flatten_light, make_levels
from ipjax.capture.splatting import with_depth
from ipjax.records import Camera
from ipjax.transforms import Similarity

Stages = Literal["global", "groups", "groups then global"]


@dataclasses.dataclass(frozen=True)
class Settings:
    """How poses are refined; the defaults were chosen on made captures (seeds 11 to 14) and real ones."""

    noise: float = 0.0015  # of depth near the camera, along z, m
    growth: float = 1.2  # 1/m²: at depth z the noise is noise (1 + growth z²)
    alike: float = 0.7  # least cosine between the normals of points that are compared
    facing: float = 0.17  # least cosine between a normal and the direction to the camera
    partners: int = 8  # frames that each is compared with
    temper: float = 10.0  # by how much fewer than its points the independent measurements of depth are
    pull: tuple[float, float] = (3.0, 0.03)  # standard deviation of the given poses: degrees, metres
    offset: tuple[float, float] = (0.5, 0.005)  # of the factory's registration: degrees, metres
    pixel_noise: float = 0.2  # of a recognised point, pixels, at least: it is measured
    contrast: float = 0.0  # noise of flattened brightness; 0 = colours are not compared
    # Of each stage: the level (0 = coarsest), the kernel's width in multiples of the noise of depth, the same of
    # recognised points (0 = they do not count yet), and steps.
    stages: tuple[tuple[int, float, float, int], ...] = (
        (0, 40.0, 0.0, 8),
        (0, 20.0, 0.0, 6),
        (1, 10.0, 4.0, 6),
        (1, 5.0, 4.0, 5),
        (2, 4.0, 3.0, 5),
        (2, 2.0, 3.0, 6),
    )


@dataclasses.dataclass(frozen=True)
class Refinement:
    """Refined poses, how well each is known, and how well the frames agree."""

    trajectory: Trajectory
    sure: Bool[np.ndarray, " n"]  # of all frames of the capture; a frame without a pose is not
    remarks: tuple[str, ...]  # of each frame what is not determined; "" = it is sure
    pairs: Int[np.ndarray, "p 2"]  # frames that were compared: indices of the capture's frames
    share_before: Float[np.ndarray, " p"]  # of the compared points of each pair, those that agree, at first
    share_after: Float[np.ndarray, " p"]
    camera_from_depth: Similarity[np.ndarray]  # what the depth's registration to the colours was found to be off by
    offset_told: bool  # whether that was solved: there were recognised points
    spread: float  # by how much pairs disagree more than independent residuals would (a variance's factor)


def refine(
    capture: Capture,
    trajectory: Trajectory,
    tracks: Tracks | None = None,
    *,
    stages: Stages = "global",
    settings: Settings | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Refinement:
    """The poses of a capture, refined; frames without a pose stay without.

    Args:
      trajectory: the poses to begin with, right to about 2° per axis and 15 mm.
      tracks: points recognised in several frames. Without them the depth alone tells the poses: of the depth camera,
        rather than of the colours', if the factory's registration of the two is a little wrong.
      progress: told a part in words, and how much of it is done.

    Raises:
      CaptureError: fewer than two frames have poses, or one has neither depth registered to its colours nor raw depth
        of a known camera.
    """
    say = progress or (lambda part, done, total: None)
    depths, colours = [], []
    wanted = settings or Settings()
    for index in np.flatnonzero(trajectory.registered):
        frame = with_depth(capture, capture.read_frame(int(index)))
        if frame.depth is None:
            raise CaptureError(f"{capture.folder}: frame {frame.name} has no depth registered to its colours")
        depths.append(np.where(frame.usable, frame.depth, 0).astype(np.float32))
        if wanted.contrast:
            colours.append(flatten_light(frame.rgb, frame.usable))
        say("reading", len(depths), int(trajectory.registered.sum()))
    return refine_frames(
        depths, colours or None, capture.camera, trajectory, tracks, stages=stages, settings=wanted, progress=progress
    )


def refine_frames(
    depths: Sequence[Float[np.ndarray, "h w"]],
    brightness: Sequence[Float[np.ndarray, "h w"]] | None,
    camera: Camera,
    trajectory: Trajectory,
    tracks: Tracks | None = None,
    *,
    stages: Stages = "global",
    settings: Settings | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Refinement:
    """`refine`, of images that are in memory.

    Args:
      depths: of the frames that have a pose, in their order; metres, 0 = unknown or not to be used.
      brightness: of the same (`surfaces.flatten_light`), if colours are to be compared.

    Raises:
      CaptureError: fewer than two frames have poses.
    """
    wanted = settings or Settings()
    known = np.flatnonzero(trajectory.registered)
    if len(known) < 2:
        raise CaptureError(f"{len(known)} of {len(trajectory)} frames have a pose: there is nothing to refine")
    levels, shrinkings = _make_levels(depths, brightness, camera)
    poses = trajectory.world_from_camera.to_numpy().take(known)
    problem = _make_problem(poses, _keep(tracks, trajectory.registered), camera, wanted)
    state = State(poses, Similarity(np.eye(3), np.zeros(3), np.ones(())), np.zeros((0, 3)))
    solver = _Solver(levels, shrinkings, problem, wanted, progress or (lambda part, done, total: None))
    if stages != "global":
        state, *_ = solver.run(state, group_frames(poses))
    groups = group_frames(poses) if stages == "groups" else None
    state, equations, pairs = solver.run(state, groups)
    certainty = judge(state, equations, pairs)
    before = solver.measure(dataclasses.replace(state, world_from_camera=poses), pairs)
    return _report(trajectory, known, state, equations, before, pairs, certainty, problem)


class _Solver:
    """The stages of one problem."""

    def __init__(self, levels, shrinkings, problem: Problem, settings: Settings, say):
        self.levels, self.shrinkings, self.problem = levels, shrinkings, problem
        self.settings, self.say = settings, say

    def gates(self, level: Level, width: float) -> Gates:
        one = self.settings
        values = (one.noise, one.growth, width, level.jump, one.alike, one.facing, one.contrast or np.inf)
        return Gates(*(jnp.asarray(value, jnp.float32) for value in values))

    def choose(self, state: State, width: float, groups) -> Pairs:
        """Pairs of frames that see the same, by coarse images."""
        level = self.levels[self.shrinkings[-1]]
        pairs = all_pairs(len(state.world_from_camera.scale))
        found = evaluate(
            state, self.problem, level, pairs, self.gates(level, width), colours=False, track_width=0.0
        ).pairs
        points = np.asarray(level.samples.there.sum(axis=1), np.float64)
        shares = np.zeros((len(points), len(points)))
        shares[pairs.source, pairs.target] = found.near / np.maximum(points[pairs.source], 1)
        if groups is not None:
            shares *= groups[:, None] == groups
        return choose_pairs(shares, self.settings.partners)

    def run(self, state: State, groups) -> tuple[State, Equations, Pairs]:
        """All stages, over all frames, or inside of their groups."""
        stages = self.settings.stages
        pairs, chosen_at, equations = None, -1, None
        for number, (step, width, track_width, steps) in enumerate(stages):
            self.say("refining" if groups is None else "refining groups", number, len(stages))
            level = self.levels[self.shrinkings[step]]
            if step != chosen_at or pairs is None:
                pairs, chosen_at = self.choose(state, width, groups), step
            if track_width and self.problem.tracks is not None:
                state = self._triangulate(state)
            state, equations = descend(
                state,
                self.problem,
                level,
                pairs,
                self.gates(level, width),
                steps=steps,
                colours=self.settings.contrast > 0,
                track_width=track_width,
                tolerance=1e-4 if step == 0 else 2e-5 if step == 1 else 5e-6,
            )
        self.say("refining" if groups is None else "refining groups", len(stages), len(stages))
        assert equations is not None and pairs is not None
        return state, equations, pairs

    def _triangulate(self, state: State) -> State:
        """Points of the tracks as these poses have them; those that rays do not tell are left out of the problem.

        What the points are off by the median is what their pixels' noise is taken for.
        """
        tracks = self.problem.tracks
        assert tracks is not None
        points, told = triangulate(
            tracks, state.world_from_camera, self.problem.K, np.ones(len(state.world_from_camera.scale), bool)
        )
        if not told.any():
            self.problem = dataclasses.replace(self.problem, tracks=None)
            return state
        kept = told[tracks.track]
        tracks = collect(tracks.frame[kept], tracks.track[kept], tracks.pixel[kept], tracks.depth[kept])
        off, _ = reproject(tracks, points[told], state.world_from_camera, self.problem.K)
        # By the median of the length of two normal errors; of a track of two frames a half of them is fitted away.
        noise = float(np.median(off)) / 1.18 * np.sqrt(len(off) / max(len(off) - 1.5 * tracks.count, 1))
        self.problem = dataclasses.replace(
            self.problem, tracks=tracks, pixel_noise=max(noise, self.settings.pixel_noise)
        )
        return dataclasses.replace(state, points=points[told])

    def measure(self, state: State, pairs: Pairs) -> Equations:
        """How well pairs agree at a state, at the finest level, as the last stage has it."""
        step, width, _, _ = self.settings.stages[-1]
        level = self.levels[self.shrinkings[step]]
        return evaluate(state, self.problem, level, pairs, self.gates(level, width), colours=False, track_width=0.0)


def _make_levels(depths, brightness, camera: Camera):
    """Levels from coarse to fine, and last the one by which pairs are chosen; and their keys."""
    height, width = depths[0].shape
    finest = 1
    while width // (2 * finest) >= 240:
        finest *= 2
    shrinkings = []
    for shrink in (4 * finest, 2 * finest, finest):
        pixels = (height // shrink) * (width // shrink)
        shrinkings.append((shrink, max(1, round((pixels / 4800) ** 0.5))))
    shrinkings.append((4 * finest, 2))
    return make_levels(depths, brightness, camera, shrinkings), shrinkings


def _make_problem(poses, tracks: Tracks | None, camera: Camera, settings: Settings) -> Problem:
    spread = lambda pair: 1 / np.repeat([np.deg2rad(pair[0]), pair[1]], 3) ** 2
    K = camera.to_matrix()
    return Problem(
        poses, spread(settings.pull), spread(settings.offset), settings.temper, tracks, K, settings.pixel_noise
    )


def _keep(tracks: Tracks | None, registered: Bool[np.ndarray, " n"]) -> Tracks | None:
    """The tracks of the frames that have a pose, whose numbers are those among them."""
    if tracks is None or not tracks.count:
        return None
    kept = registered[tracks.frame]
    number = np.cumsum(registered) - 1
    left = collect(number[tracks.frame[kept]], tracks.track[kept], tracks.pixel[kept], tracks.depth[kept])
    return left if left.count else None


def _report(trajectory, known, state: State, equations, before, pairs, certainty: Certainty, problem) -> Refinement:
    count = len(trajectory)
    rotation, translation = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    found = state.world_from_camera.orthonormal()
    rotation[known], translation[known] = found.rotation, found.translation
    covariance = np.tile(np.diag([np.pi**2] * 3 + [1e6] * 3), (count, 1, 1))
    covariance[known] = certainty.covariance
    sure, remarks = np.zeros(count, bool), ["not registered"] * count
    sure[known] = certainty.sure
    for index, text in zip(known, certainty.remarks, strict=True):
        remarks[index] = text
    share = lambda found: found.pairs.near / np.maximum(found.pairs.compared, 1)
    refined = Trajectory(
        trajectory.names,
        Similarity(rotation, translation, np.ones(count)),
        trajectory.registered,
        "refined",
        covariance,
        trajectory.scale,
        trajectory.agreement,
    )
    return Refinement(
        refined,
        sure,
        tuple(remarks),
        np.stack([known[pairs.source], known[pairs.target]], axis=1),
        share(before),
        share(equations),
        state.camera_from_depth,
        problem.tracks is not None,
        certainty.spread,
    )


def describe(found: Refinement, before: float | None, after: float | None) -> list[str]:
    """What came of it, in sentences.

    Args:
      before, after: median difference of depth between frames that follow one another, metres.
    """
    known = found.trajectory.registered
    lines = [f"{int(found.sure.sum())} of {int(known.sum())} poses are sure"]
    if found.sure.any() and found.trajectory.covariance is not None:
        own = np.sqrt(np.einsum("nii->ni", found.trajectory.covariance[found.sure]))
        turn, shift = (np.linalg.norm(own[:, at], axis=1) for at in (slice(0, 3), slice(3, 6)))
        lines[0] += (
            f"; by the median they are known to {1000 * np.median(shift):.1f} mm and {np.rad2deg(np.median(turn)):.2f}°"
        )
    if before is not None and after is not None:
        lines.append(
            f"depths of frames that follow one another differ by {1000 * after:.1f} mm by the median, "
            f"{1000 * before:.1f} mm before"
        )
    if found.offset_told:
        tangent = found.camera_from_depth.log()
        lines.append(
            f"by the points recognised in the colours, depth lies {1000 * np.linalg.norm(tangent[3:6]):.1f} mm and "
            f"{np.rad2deg(np.linalg.norm(tangent[:3])):.2f}° off them"
        )
    told = zip(found.trajectory.names, found.remarks, known, strict=True)
    return lines + [f"{name}: {text}" for name, text, there in told if text and there]

"""A depth camera beside a colour camera, and what is known of it."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from ipjax.capture.records import Capture
from ipjax.transforms import Similarity

# How far a factory, or the makers of a rig of which nothing is told, are off: standard deviations of rotation (rad, per
# axis), translation (metres, per axis), log focal length, log scale.
TOLD = np.array([0.01] * 3 + [0.005] * 3 + [0.01, 0.003])
UNTOLD = np.array([0.05] * 3 + [0.05, 0.03, 0.03] + [0.01, 0.003])

# Standard deviations above which a rig is weakly determined; share and spread of the stereo that agrees with it.
_WEAK_ROTATION, _WEAK_TRANSLATION = np.deg2rad(0.3), 0.004
_LEAST_AGREEMENT, _WIDEST = 0.75, 0.006  # made captures: 0.95 and more; a gripped camera in a shelf: 0.55
_FAR = 4  # standard deviations from the start
_WORSE = 1.2  # times the spread of the start; the shift along a plane is in no spread, so that equal is no objection


@dataclasses.dataclass(frozen=True)
class Rig:
    """A depth camera beside the colour camera."""

    depth_camera: Float[np.ndarray, "3 3"]  # K, pixels
    colour_from_depth: Similarity[np.ndarray]  # rigid, metres
    scale: float = 1.0  # metres per metre that the raw depth tells

    def to_json(self) -> dict[str, Any]:
        """For reports: K, the pose as a matrix, the scale."""
        return {
            "K": self.depth_camera.tolist(),
            "colour_from_depth": self.colour_from_depth.to_matrix().tolist(),
            "scale": self.scale,
        }

    @staticmethod
    def from_json(document: dict[str, Any]) -> "Rig":
        """What `to_json` told."""
        pose = Similarity[np.ndarray].from_matrix(np.array(document["colour_from_depth"], float))
        return Rig(np.array(document["K"], float), pose, float(document["scale"]))


@dataclasses.dataclass(frozen=True)
class SolvedRig:
    """What a solution says."""

    rig: Rig  # to use: the solution, or the factory's where it is kept
    solution: Rig
    deviation: Float[np.ndarray, "8"]  # standard: rotation (rad), translation (m), log focal length, log scale
    trusted: bool  # whether nothing speaks against the solution
    agreement: float  # share of the stereo's points that lie within three of the narrowest widths of the raw depth
    spread: float  # median distance from the raw depth of those, metres
    spread_before: float  # the same of the rig that was the start
    notes: tuple[str, ...]  # what was found, a sentence each


def find_start(capture: Capture) -> tuple[Rig, bool]:
    """The rig that the capture tells, and whether it tells where the depth camera stands.

    Without raw depth the colour camera itself is the depth camera: its depth is registered already.
    """
    nowhere = Similarity(np.eye(3), np.zeros(3), np.ones(()))
    if capture.depth_camera is None:
        return Rig(capture.camera.to_matrix(), nowhere), True
    K = np.asarray(capture.depth_camera.to_matrix(), np.float64)
    told = capture.colour_from_depth
    return Rig(K, nowhere if told is None else told), told is not None


def difference(one: Rig, other: Rig) -> Float[np.ndarray, "8"]:
    """How far two rigs are apart: rotation (rad), translation (m), log focal length, log scale."""
    turn = (one.colour_from_depth @ other.colour_from_depth.inverse()).log()[:3]
    shift = one.colour_from_depth.translation - other.colour_from_depth.translation
    focal = np.log(one.depth_camera[0, 0] / other.depth_camera[0, 0])
    return np.concatenate([turn, shift, [focal, np.log(one.scale / other.scale)]])


def decide(
    solution: Rig,
    start: Rig,
    told: bool,
    deviation: Float[np.ndarray, "8"],
    agreement: float,
    spread: float,
    spread_before: float,
) -> SolvedRig:
    """Say in words what was solved, and keep the factory's rig where something speaks against the solution."""
    apart = difference(solution, start)
    degrees, millimetres = np.rad2deg(np.linalg.norm(apart[:3])), 1e3 * np.linalg.norm(apart[3:6])
    whom = "the factory's" if told else "the colour camera"
    notes = [
        f"the depth camera is {degrees:.2f}° and {millimetres:.1f} mm from {whom}, its focal length "
        f"{100 * np.expm1(apart[6]):+.2f} %, its scale {100 * np.expm1(apart[7]):+.2f} %"
    ]
    doubts = []
    if deviation[:3].max() > _WEAK_ROTATION or deviation[3:6].max() > _WEAK_TRANSLATION:
        doubts.append(
            f"it is weakly determined (± {np.rad2deg(deviation[:3].max()):.2f}°, ± {1e3 * deviation[3:6].max():.1f} mm)"
        )
    if agreement < _LEAST_AGREEMENT or spread > _WIDEST:
        doubts.append(
            f"stereo and raw depth disagree ({100 * agreement:.0f} % agree, to {1e3 * spread:.1f} mm): wrong poses, or "
            "colours that stereo cannot follow"
        )
    if (np.abs(apart) > _FAR * (TOLD if told else UNTOLD)).any():
        doubts.append(f"it is farther from {whom} than {'a factory is off' if told else 'cameras of one rig are'}")
    if told and spread > _WORSE * spread_before:
        doubts.append("it explains the stereo worse than the factory's")
    if doubts:
        kept = "the factory's rig is kept" if told else "no other is known, so look at the pictures before trusting it"
        notes.append(f"{'; '.join(doubts)}; {kept}")
    used = start if doubts and told else solution
    return SolvedRig(used, solution, deviation, not doubts, agreement, spread, spread_before, tuple(notes))


def leave(start: Rig, note: str) -> SolvedRig:
    """No solution: the rig stays what it was."""
    return SolvedRig(start, start, np.full(8, np.inf), False, 0.0, np.nan, np.nan, (note,))

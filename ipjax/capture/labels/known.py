"""Objects that ipjax knows already: the poses that single frames give, fused over the trajectory."""

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.making import ObjectModel
from ipjax.capture.models.symmetries import find_symmetries
from ipjax.capture.records import CaptureError
from ipjax.files.meshes.mesh import make_mesh
from ipjax.files.objects.record import ObjectInfo
from ipjax.transforms import Similarity, rotation_from_vector, vector_from_rotation

_TURN = np.deg2rad(12)  # between two frames' poses of one object, up to which they agree
_SHIFT = 0.08  # of the diameter
_ROUNDS = 10


@runtime_checkable
class EstimateFrame(Protocol):
    """How one object is estimated in one frame, within a mask; None where nothing is found."""

    def __call__(
        self, frame: PosedFrame, mask: Bool[np.ndarray, "h w"], /
    ) -> tuple[Similarity[np.ndarray], float] | None: ...


@dataclasses.dataclass(frozen=True)
class FusedPose:
    """One pose in the world out of many frames' poses."""

    world_from_object: Similarity[np.ndarray]  # its scale is the object's size: metres per unit of its mesh
    agreeing: Bool[np.ndarray, " k"]  # which of the poses took part
    turn: float  # rad, rms of these from it
    shift: float  # metres, rms

    @property
    def share(self) -> float:
        """Of all poses, that agreed."""
        return float(self.agreeing.mean())


def fuse_poses(
    poses: Similarity[np.ndarray],
    weight: Float[np.ndarray, " k"],
    diameter: float,
    symmetries: Similarity[np.ndarray] | None = None,
) -> FusedPose:
    """The pose on which most of the weight agrees, and the robust mean of those poses.

    Every pose stands for as many as the object has symmetries: a pose takes part as whichever of them is nearest.

    Args:
      poses: ``world_from_object`` as each frame has it, [k].
      weight: of each, for instance its confidence.
      diameter: of the object, in the unit of the translations.
      symmetries: ``object_from_object``, [s]; the identity alone by default.

    Raises:
      ValueError: there are no poses.
    """
    count = len(poses.scale)
    if not count:
        raise ValueError("there is no pose to fuse")
    turns = np.eye(3)[None] if symmetries is None else symmetries.rotation
    shifts = np.zeros((1, 3)) if symmetries is None else symmetries.translation
    # variant [k s]: pose @ symmetry.
    rotation = poses.rotation[:, None] @ turns
    translation = poses.translation[:, None] + poses.scale[:, None, None] * np.einsum(
        "kij,sj->ksi", poses.rotation, shifts
    )

    def nearest(R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of every pose the variant nearest to this one, its angle and its distance."""
        trace = np.einsum("ij,ksij->ks", R, rotation)
        angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
        distance = np.linalg.norm(translation - t, axis=-1)
        chosen = (angle / _TURN + distance / (_SHIFT * diameter)).argmin(1)
        rows = np.arange(count)
        return chosen, angle[rows, chosen], distance[rows, chosen]

    votes = []
    for k in range(count):
        _, angle, distance = nearest(rotation[k, 0], translation[k, 0])
        votes.append((weight * ((angle < _TURN) & (distance < _SHIFT * diameter))).sum())
    best = int(np.argmax(votes))
    R, t = rotation[best, 0], translation[best, 0]
    agreeing = np.zeros(count, bool)
    angle, distance = np.zeros(count), np.zeros(count)
    for _ in range(_ROUNDS):
        chosen, angle, distance = nearest(R, t)
        agreeing = (angle < _TURN) & (distance < _SHIFT * diameter)
        rows = np.flatnonzero(agreeing)
        steps = vector_from_rotation(rotation[rows, chosen[rows]] @ R.T)
        moves = translation[rows, chosen[rows]] - t
        # Cauchy's weights about what half of them are off.
        shares = []
        for off in (np.linalg.norm(steps, axis=-1), np.linalg.norm(moves, axis=-1)):
            half = max(float(np.median(off)), 1e-9)
            share = weight[rows] / (1 + (off / (2 * half)) ** 2)
            shares.append(share / max(share.sum(), 1e-12))
        step, move = shares[0] @ steps, shares[1] @ moves
        R, t = rotation_from_vector(step) @ R, t + move
        if np.linalg.norm(step) < 1e-7 and np.linalg.norm(move) < 1e-9:
            break
    scale = np.exp(np.average(np.log(poses.scale[agreeing]), weights=np.maximum(weight[agreeing], 1e-9)))
    return FusedPose(
        Similarity(R, t, np.asarray(scale)).orthonormal(),
        agreeing,
        float(np.sqrt((angle[agreeing] ** 2).mean())),
        float(np.sqrt((distance[agreeing] ** 2).mean())),
    )


def find_known(
    frames: Sequence[PosedFrame],
    masks: Sequence[Bool[np.ndarray, "n h w"]],
    estimate: EstimateFrame,
    symmetries: Similarity[np.ndarray] | None = None,
    *,
    views: int = 8,
    least_agreement: float = 0.5,
    name: str = "the object",
) -> tuple[int, FusedPose]:
    """Which of the things that stand there is a known object, of unit diameter as object files have them, and its pose.

    Each thing is estimated in the frames that show most of it, the poses are fused, and the thing with the most
    agreeing confidence is it.

    Args:
      masks: of every frame, what is visible of each thing.
      views: frames in which each thing is looked at.
      least_agreement: share of a thing's poses that must agree.

    Raises:
      CaptureError: no thing's poses agree.
    """
    areas = np.stack([mask.sum((1, 2)) for mask in masks])  # frame × thing
    best: tuple[float, int, FusedPose] | None = None
    for thing in range(areas.shape[1]):
        found = []
        for number in _spread(areas[:, thing], views):
            answer = estimate(frames[number], masks[number][thing])
            if answer is not None:
                found.append((frames[number].world_from_camera @ answer[0], answer[1]))
        if len(found) < 2:
            continue
        poses = Similarity[np.ndarray].stack([pose for pose, _ in found])
        weight = np.array([confidence for _, confidence in found])
        fused = fuse_poses(poses, weight, float(np.median(poses.scale)), symmetries)
        total = float(weight[fused.agreeing].sum() / len(found))
        if fused.share >= least_agreement and fused.agreeing.sum() >= 2 and (best is None or total > best[0]):
            best = (total, thing, fused)
    if best is None:
        raise CaptureError(
            f"{name}: it was found in no place on which half of the frames agree; leave it out, or click it"
        )
    return best[1], best[2]


def replace_model(info: ObjectInfo, fused: FusedPose) -> ObjectModel:
    """The object's own mesh, as large as it was found to be, where it was found.

    Raises:
      ValueError: the object file keeps no mesh.
    """
    if info.vertices is None or info.faces is None:
        raise ValueError(f"{info.name}: its file keeps no mesh")
    pose = fused.world_from_object
    mesh = make_mesh(float(pose.scale) * np.asarray(info.vertices, np.float64), info.faces, colours=info.colours)
    rigid = Similarity(pose.rotation, pose.translation, np.ones(()))
    return ObjectModel(info.name, mesh, rigid, find_symmetries(mesh))


def _spread(area: Int[np.ndarray, " v"], count: int) -> list[int]:
    """Frames that show much of a thing, from all around: the best of each stretch of the trajectory."""
    stretches = np.array_split(np.arange(len(area)), min(count, len(area)))
    chosen = [int(part[area[part].argmax()]) for part in stretches]
    return [number for number in chosen if area[number] > 0.3 * area.max()]

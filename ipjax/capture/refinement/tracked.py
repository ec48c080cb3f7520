"""Recognised points in the graph of poses: distances in the image, the points themselves eliminated.

In NumPy's doubles, dense: 24 frames and 5000 points take 50 ms, 100 frames and 20 000 points a second and 300 MB.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ipjax.capture.records import Tracks
from ipjax.transforms import Similarity


class TrackEquations(NamedTuple):
    """The normal equations of all cameras, and what brings the points along."""

    hessian: Float[np.ndarray, "k k"]  # k = 6 n: of small motions of each camera along its own axes
    slope: Float[np.ndarray, " k"]
    points_from_cameras: Float[np.ndarray, "q k"]  # q = 3 c: the points' move is offset − points_from_cameras ξ
    offset: Float[np.ndarray, " q"]
    off: Float[np.ndarray, " m"]  # of every observation, pixels; infinite behind the camera


def compare_tracks(
    poses: Similarity[np.ndarray],
    points: Float[np.ndarray, "c 3"],
    tracks: Tracks,
    K: Float[np.ndarray, "3 3"],
    *,
    noise: float,
    width: float,
) -> TrackEquations:
    """Robust reprojection of the points (Geman–McClure), their own equations solved away (Schur's complement).

    Args:
      poses: world_from_camera of all frames.
      points: of the tracks, in the world.
      noise: of a pixel's place, pixels.
      width: of the kernel, in multiples of it.
    """
    count, number = len(poses.scale), tracks.count
    frame, track = tracks.frame, tracks.track
    turned = np.swapaxes(poses.rotation[frame], -1, -2)
    local = np.einsum("mij,mj->mi", turned, points[track] - poses.translation[frame])
    ahead = local[:, 2] > 1e-3
    x, y, z = np.where(ahead[:, None], local, [0, 0, 1]).T
    focal, centre = np.diag(K)[:2], K[:2, 2]
    residual = focal * np.stack([x / z, y / z], -1) + centre - tracks.pixel
    off = np.where(ahead, np.linalg.norm(residual, axis=1), np.inf)
    weight = np.where(ahead, 1 / (noise**2 * (1 + (np.where(ahead, off, 0) / (noise * width)) ** 2) ** 2), 0)
    zero = np.zeros_like(z)
    slope = np.stack([focal[0] * np.stack([1 / z, zero, -x / z**2], -1),
                      focal[1] * np.stack([zero, 1 / z, -y / z**2], -1)], -2)  # fmt: skip
    cross = np.stack([np.stack(row, -1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])], -2)
    # A camera that moves by (ω, v) sees the point move by −ω × local − v.
    of_camera = np.concatenate([slope @ cross, -slope], axis=-1)
    of_point = slope @ turned
    weighed = weight[:, None, None] * of_camera
    blocks, right = np.zeros((count, 6, 6)), np.zeros((count, 6))
    np.add.at(blocks, frame, np.swapaxes(weighed, -1, -2) @ of_camera)
    np.add.at(right, frame, np.einsum("mca,mc->ma", weighed, residual))
    weighed_point = weight[:, None, None] * of_point
    own, own_right = np.zeros((number, 3, 3)), np.zeros((number, 3))
    np.add.at(own, track, np.swapaxes(weighed_point, -1, -2) @ of_point)
    np.add.at(own_right, track, np.einsum("mca,mc->ma", weighed_point, residual))
    mixed = np.zeros((number, count, 3, 6))
    mixed[track, frame] = np.swapaxes(weighed_point, -1, -2) @ of_camera  # no frame sees a track twice
    mixed = mixed.transpose(0, 2, 1, 3).reshape(number, 3, 6 * count)
    # Points that rays hardly tell move little, and add nothing to the cameras.
    floor = 1e-4 * np.trace(own, axis1=-2, axis2=-1)[:, None] + 1e-3
    inverse = np.linalg.inv(own + floor[..., None] * np.eye(3))
    gain = inverse @ mixed
    whole = -np.einsum("cik,cil->kl", mixed, gain, optimize=True)
    for k in range(count):
        at = slice(6 * k, 6 * k + 6)
        whole[at, at] += blocks[k]
    slope_all = right.reshape(-1) - np.einsum("cik,ci->k", gain, own_right)
    back = -np.einsum("cij,cj->ci", inverse, own_right)
    return TrackEquations(whole, slope_all, gain.reshape(3 * number, 6 * count), back.reshape(-1), off)

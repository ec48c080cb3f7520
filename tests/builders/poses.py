"""Poses, points and symmetries: drawn, and those of the golden errors of BOP's toolkit."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ipjax import metrics
from ipjax.records import Camera, Similarity

ERRORS = np.load(Path(__file__).resolve().parents[1] / "golden" / "bop_pose_errors.npz")
OBJECTS = (1, 2, 3, 4)
POINTS = jax.random.normal(jax.random.key(0), (200, 3)) * 0.05
CAMERA = Camera(jnp.array([600.0, 610.0]), jnp.array([320.0, 240.0]))
TURN = metrics.discretise_symmetries([], [(np.array([0, 0, 1]), np.zeros(3))], 0.05)


def poses(rotation, translation, dtype=np.float32) -> Similarity:
    rotation, translation = np.asarray(rotation, dtype), np.asarray(translation, dtype)
    return Similarity(jnp.asarray(rotation), jnp.asarray(translation), jnp.ones(rotation.shape[:-2], dtype))


def symmetries_of(number: int) -> tuple[np.ndarray, np.ndarray]:
    info = json.loads(str(ERRORS[f"obj{number}_info_json"]))
    continuous = [(np.array(s["axis"]), np.array(s["offset"])) for s in info.get("symmetries_continuous", [])]
    discrete = [np.array(s) for s in info.get("symmetries_discrete", [])]
    return metrics.discretise_symmetries(discrete, continuous, float(ERRORS["max_sym_disc_step"]))


def rows_of(number: int) -> tuple[np.ndarray, Similarity, Similarity]:
    rows = np.flatnonzero(ERRORS["obj_id"] == number)
    truth = poses(ERRORS["R_gt"][rows], ERRORS["t_gt"][rows])
    return rows, truth, poses(ERRORS["R_est"][rows], ERRORS["t_est"][rows])


@jax.jit
def random_rotation(key) -> jax.Array:
    q = jax.random.normal(key, (4,))
    w, x, y, z = q / jnp.linalg.norm(q)
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def random_pose(seed: int) -> Similarity:
    a, b = jax.random.split(jax.random.key(seed))
    shift = jnp.array([0.0, 0.0, 0.8]) + 0.1 * jax.random.normal(b, (3,))
    return Similarity(random_rotation(a), shift, jnp.ones(()))


NONE = poses(np.eye(3)[None], np.zeros((1, 3)))

"""Estimating objects in frames on the host: crop, describe, estimate, and how long each took."""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ipjax.config import Config
from ipjax.features import describe
from ipjax.host.frames import frame_turned
from ipjax.host.objects import ObjectInfo
from ipjax.pipeline import estimate
from ipjax.types import Patches, PoseEstimate, Query, Similarity, Templates


@dataclasses.dataclass(frozen=True)
class Result:
    """One object in one frame: the estimate in the camera of the whole image, and what it came from."""

    estimate: PoseEstimate
    crop_estimate: PoseEstimate  # the same in the crop's camera, which a look-at crop turns
    query: Query
    templates: Templates
    info: ObjectInfo
    seconds: dict[str, float]  # frame, describe, estimate; compile where it happened


class Estimator:
    """Objects and an encoder, ready for frames; compiles once for each shape of templates.

    Args:
        objects: templates and what is known of them, as `objects.load` returns them.
        encoder: made the templates' features.
        config: of the estimate.
        options: of `frames.frame_turned`; "square" crops by default.
    """

    def __init__(
        self,
        objects: Sequence[tuple[Templates, ObjectInfo]],
        encoder: Any,
        config: Config = Config(),
        **options: Any,
    ):
        self.objects = list(objects)
        self.encoder = encoder
        self.config = config
        self.options: dict[str, Any] = {"crop": "square"} | options
        self._compiled: dict[Any, Any] = {}

    def frame(self, index: int, rgb: Any, depth: Any, mask: Any, camera: Any, box: Any = None):
        """The crop of one object, without looking at it yet: bad input is refused here.

        Raises:
            ValueError: as `frames.frame`.
        """
        options: dict[str, Any] = {"resolution": self.objects[index][1].resolution} | self.options
        return frame_turned(rgb, depth, mask, camera, box=box, **options)

    def run(
        self,
        index: int,
        view: Any,
        camera_from_crop: Similarity,
        *,
        seed: int = 0,
        diameter: float | None = None,
        patches: Patches | None = None,
    ) -> Result:
        """Estimate one object in its crop.

        Args:
            index: of the object.
            view, camera_from_crop: from `frame`.
            seed: same seed, same answer.
            diameter: the object's true diameter in metres, where it is known.
            patches: of the view, where it has been described already.
        """
        templates, info = self.objects[index]
        seconds: dict[str, float] = {}
        key = jax.random.key(seed)
        known = None if diameter is None else jnp.asarray(diameter, jnp.float32)

        described: Any = patches
        if described is None:
            see = self._ready("describe", describe, seconds, self.encoder, view)
            start = time.perf_counter()
            described = jax.block_until_ready(see(self.encoder, view))
            seconds["describe"] = time.perf_counter() - start

        query = Query(patches=described, view=view)
        arguments = self.encoder, templates, query, key, self.config, known
        find = self._ready("estimate", estimate, seconds, *arguments)
        start = time.perf_counter()
        found = jax.block_until_ready(find(*arguments))
        seconds["estimate"] = time.perf_counter() - start
        return Result(_turn(camera_from_crop, found), found, query, templates, info, seconds)

    def _ready(self, name: str, function: Any, seconds: dict[str, float], *args: Any):
        leaves, structure = jax.tree.flatten(args)
        shapes = tuple((np.shape(x), str(getattr(x, "dtype", type(x)))) for x in leaves)
        key = (name, structure, shapes)
        if key not in self._compiled:
            start = time.perf_counter()
            self._compiled[key] = jax.jit(function).lower(*args).compile()
            seconds["compile"] = seconds.get("compile", 0.0) + time.perf_counter() - start
        return self._compiled[key]


def _turn(camera_from_crop: Similarity, found: PoseEstimate) -> PoseEstimate:
    """The estimate in the camera of the whole image: the crop's camera is only turned."""
    turn = np.asarray(camera_from_crop.rotation, np.float64)
    if np.array_equal(turn, np.eye(3)):
        return found

    def turned(pose: Similarity) -> Similarity:
        rotation = turn @ np.asarray(pose.rotation, np.float64)
        translation = np.asarray(pose.translation, np.float64) @ turn.T
        return Similarity(jnp.asarray(rotation, jnp.float32), jnp.asarray(translation, jnp.float32), pose.scale)

    both = np.kron(np.eye(2), turn)
    covariance = both @ np.asarray(found.covariance, np.float64) @ both.T
    return dataclasses.replace(
        found,
        covariance=jnp.asarray(covariance, jnp.float32),
        camera_from_object=turned(found.camera_from_object),
        hypotheses=dataclasses.replace(
            found.hypotheses, camera_from_object=turned(found.hypotheses.camera_from_object)
        ),
    )

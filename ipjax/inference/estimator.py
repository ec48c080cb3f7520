"""Estimating objects in frames on the host: crop, describe, estimate, and how long each took."""

import dataclasses
import threading
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ipjax.config import Config
from ipjax.estimation.features import describe
from ipjax.estimation.pipeline import estimate
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.batching import Spread, compact, pad_alike
from ipjax.inference.frames import frame_turned
from ipjax.records import Patches, PoseEstimate, Query, Similarity, Templates, View

# Compacted templates have a multiple of so many patches: each count is compiled anew, and most objects now share two.
MULTIPLE = 64

# XLA's options on a CPU that compile in two thirds of the time what then takes a twentieth to a tenth longer; rounding
# differs (benchmarks/results/compiling.md). LLVM's level 1 gains nothing more; at level 0 queries take twice as long.
# JAX 0.12 has the older emitters no more, and refuses the option.
QUICK: dict[str, str | bool] = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}


@dataclasses.dataclass(frozen=True)
class Result:
    """One object in one frame: the estimate in the camera of the whole image, and what it came from."""

    estimate: PoseEstimate
    crop_estimate: PoseEstimate  # the same in the crop's camera, which a look-at crop turns
    query: Query
    templates: Templates
    info: ObjectInfo
    seconds: dict[str, float]  # frame, describe, estimate; compile where it happened
    warnings: tuple[str, ...] = ()  # reasons to doubt the estimate, a sentence each

    @property
    def value(self) -> float:
        """Confidence × agreement, by which estimates in several crops are compared; 0 without a pose."""
        found = self.estimate
        return float(found.confidence) * float(found.hypotheses.score[0]) if bool(found.success) else 0.0


class Estimator:
    """Objects and an encoder, ready for frames; compiles once for each shape of templates.

    Several threads may use one: what is compiled is compiled once, and others wait for it.

    Templates are compacted when they are first used (`ipjax.compact`): the estimates are the same, in about half the
    time for matching.

    Args:
        objects: templates and what is known of them, as `ipjax.load` returns them.
        encoder: made the templates' features.
        config: of the estimate.
        quick: compile with `QUICK` on a CPU, for one frame or a few.
        alike: pad the objects to one size (`ipjax.pad_templates`), so that what was compiled for one serves all; not
            those that are added later.
        options: of `ipjax.inference.frames.frame_turned`; "square" crops by default.
    """

    def __init__(
        self,
        objects: Sequence[tuple[Templates, ObjectInfo]],
        encoder: Any,
        config: Config = Config(),
        *,
        quick: bool = False,
        alike: bool = False,
        **options: Any,
    ):
        self.objects = list(objects)
        self.encoder = encoder
        self.config = config
        self.quick = quick
        self.options: dict[str, Any] = {"crop": "square"} | options
        self._compiled: dict[Any, Any] = {}
        self._compiling = threading.RLock()
        self._compacted: dict[int, Templates] = {}
        self._spread = Spread()
        if alike:
            padded = pad_alike([compact(templates, multiple=MULTIPLE) for templates, _ in self.objects])
            self.objects = [(one, info) for one, (_, info) in zip(padded, self.objects, strict=True)]
            self._compacted = dict(enumerate(padded))

    def frame(self, index: int, rgb: Any, depth: Any, mask: Any, camera: Any, box: Any = None):
        """The crop of one object; bad input is refused here, before anything is described.

        Raises:
            ValueError: as `ipjax.frame`.
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
        drawn: bool = True,
    ) -> Result:
        """Estimate one object in its crop.

        Args:
            index: of the object.
            view, camera_from_crop: from `frame`.
            seed: same seed, same answer.
            diameter: the object's true diameter in metres, where it is known.
            patches: of the view, where it has been described already.
            drawn: without it no candidate is drawn: half the time, and a rougher confidence. Poses of objects from a
                photo are found or chosen by drawing, and stay as they are.
        """
        templates = self._compact(index)
        seconds: dict[str, float] = {}
        key = jax.random.key(seed)
        known = None if diameter is None else jnp.asarray(diameter, jnp.float32)

        described: Any = patches
        if described is None:
            describe_compiled = self.compiled("describe", describe, seconds, self.encoder, view)
            start = time.perf_counter()
            described = jax.block_until_ready(describe_compiled(self.encoder, view))
            seconds["describe"] = time.perf_counter() - start

        query = Query(patches=described, view=view)
        config = self.config
        if not drawn and templates.reference is None:
            config = dataclasses.replace(config, score=dataclasses.replace(config.score, drawn=0))
        arguments = self.encoder, templates, query, key, config, known
        estimate_compiled = self.compiled("estimate", estimate, seconds, *arguments)
        start = time.perf_counter()
        found = jax.block_until_ready(estimate_compiled(*arguments))
        seconds["estimate"] = time.perf_counter() - start
        return self._finish(index, found, query, camera_from_crop, seconds, diameter)

    def run_batch(
        self,
        index: int,
        crops: Sequence[tuple[View, Similarity]],
        *,
        seeds: Sequence[int],
        diameter: float | None = None,
        size: int | None = None,
    ) -> list[Result]:
        """Estimate one object in several crops at once: the same as `run` of each, up to rounding.

        Where this process has several devices and ``size`` is a multiple of their number, each takes its part.

        Args:
            index: of the object.
            crops: each from `frame`.
            seeds: of each.
            diameter: as in `run`.
            size: of the program that is compiled, at least as many as there are crops; what is missing is filled with
                repeats, whose results are dropped. None = as many as there are.

        Returns:
            A result for each crop; ``seconds`` are each one's share.

        Raises:
            ValueError: there are no crops, more than ``size``, or not as many seeds.
        """
        size = len(crops) if size is None else size
        if not 0 < len(crops) <= size or len(seeds) != len(crops):
            raise ValueError(f"{len(crops)} crops and {len(seeds)} seeds do not fit a batch of {size}")
        if size == 1:
            return [self.run(index, *crops[0], seed=seeds[0], diameter=diameter)]
        templates = self._compact(index)
        seconds: dict[str, float] = {}
        more = size - len(crops)
        views = [view for view, _ in crops] + [crops[0][0]] * more
        views = jax.tree.map(lambda *x: jnp.stack(x), *views)
        keys = jnp.stack([jax.random.key(seed) for seed in (*seeds, *[seeds[0]] * more)])
        known = None if diameter is None else jnp.asarray(diameter, jnp.float32)
        encoder, config, where = self.encoder, self.config, ""
        describe_batch, estimate_batch = _describe_all, _estimate_all
        if self._spread.fits(size):
            spread, where = self._spread, ", divided"
            views, keys = spread.divide((views, keys))
            encoder, config = spread.copy("encoder", encoder), spread.copy("config", config)
            templates, known = spread.copy(index, templates), spread.copy(("diameter", diameter), known)
            describe_batch = spread.over(describe_batch, (False, True))
            estimate_batch = spread.over(estimate_batch, (False, False, True, True, False, False))
        describe_compiled = self.compiled(f"describe all{where}", describe_batch, seconds, encoder, views)
        start = time.perf_counter()
        patches = jax.block_until_ready(describe_compiled(encoder, views))
        seconds["describe"] = time.perf_counter() - start
        queries = Query(patches=patches, view=views)
        arguments = encoder, templates, queries, keys, config, known
        estimate_compiled = self.compiled(f"estimate all{where}", estimate_batch, seconds, *arguments)
        start = time.perf_counter()
        found = jax.block_until_ready(estimate_compiled(*arguments))
        seconds["estimate"] = time.perf_counter() - start
        shares = {name: value / len(crops) for name, value in seconds.items()}
        many = jax.device_get((found, queries))  # at once: a transfer for each number of each crop takes longer
        results = []
        for place, (_, camera_from_crop) in enumerate(crops):
            estimated, query = jax.tree.map(lambda x, place=place: jnp.asarray(x[place]), many)
            results.append(self._finish(index, estimated, query, camera_from_crop, dict(shares), diameter))
        return results

    def _compact(self, index: int) -> Templates:
        """An object's templates, compacted."""
        templates, info = self.objects[index]
        if self._compacted.get(index) is not templates:
            with self._compiling:
                templates = self._compacted[index] = compact(self.objects[index][0], multiple=MULTIPLE)
                self.objects[index] = templates, info
        return templates

    def _finish(
        self,
        index: int,
        found: PoseEstimate,
        query: Query,
        camera_from_crop: Similarity,
        seconds: dict[str, float],
        diameter: float | None,
    ) -> Result:
        """What was found in a crop as a result in the camera of the whole image."""
        templates, info = self.objects[index]
        found, warning = check_size(found, info, diameter, self.config.confidence.least)
        warnings = (warning,) if warning else ()
        whole = to_image_camera(camera_from_crop, found)
        return Result(whole, found, query, templates, info, seconds, warnings)

    def compiled(self, name: str, function: Any, seconds: dict[str, float], *args: Any) -> Any:
        """A function compiled for arguments of these shapes, once; what that takes is added to ``seconds``."""
        leaves, structure = jax.tree.flatten(args)
        shapes = tuple((np.shape(x), str(getattr(x, "dtype", type(x)))) for x in leaves)
        key = (name, structure, shapes)
        if key not in self._compiled:
            start = time.perf_counter()
            with self._compiling:
                if key not in self._compiled:
                    options = QUICK if self.quick and jax.default_backend() == "cpu" else None
                    self._compiled[key] = jax.jit(function).lower(*args).compile(compiler_options=options)
            seconds["compile"] = seconds.get("compile", 0.0) + time.perf_counter() - start
        return self._compiled[key]


def _describe_all(encoder: Any, views: View) -> Patches:
    """`describe` of several crops."""
    return jax.vmap(describe, in_axes=(None, 0))(encoder, views)


def _estimate_all(encoder: Any, templates: Templates, queries: Query, keys: Any, config: Config, diameter: Any):
    """`estimate` of one object in several crops, whose templates are not copied."""
    one = lambda query, key: estimate(encoder, templates, query, key, config, diameter)
    return jax.vmap(one)(queries, keys)


def check_size(
    found: PoseEstimate, info: ObjectInfo, diameter: float | None = None, least: float = 0.5
) -> tuple[PoseEstimate, str]:
    """The estimate with less confidence where its size is not that of the mesh file.

    Args:
        found: an estimate of the object.
        info: of the object; nothing happens where its ``metres_per_unit`` is unknown.
        diameter: the diameter in metres that was given instead of found: it is compared, and the confidence stays.
        least: confidence below which the object counts as not present.

    Returns:
        The estimate and a sentence with the usual causes; "" where the sizes are within 25 % of each other. The
        confidence falls by exp(−½ (ln ratio / ln 1.25)²): to 0.6 of itself at the limit, 0.01 at twice the size.
    """
    if info.metres_per_unit is None or not bool(found.success):
        return found, ""
    known = info.metres_per_unit / info.mesh_scale
    size = float(found.camera_from_object.scale) if diameter is None else diameter
    if not (np.isfinite(size) and size > 0):
        return found, ""
    ratio = size / known
    deviation = abs(np.log(ratio)) / np.log(1.25)
    if deviation <= 1:
        return found, ""
    compared = f"{1e3 * size:.4g} mm, {ratio:.3g} times the {1e3 * known:.4g} mm of its mesh file"
    if diameter is not None:
        return found, f"{info.name}: the diameter given is {compared}"
    confidence = jnp.asarray(float(found.confidence) * np.exp(-0.5 * deviation**2), found.confidence.dtype)
    found = dataclasses.replace(found, confidence=confidence, present=found.present & (confidence >= least))
    return found, (
        f"{info.name}: the size found is {compared}: is the camera matrix of images of another size, the unit of the "
        "depth (--depth-scale) another, or the unit of the mesh (onboard --unit)?"
    )


def to_image_camera(camera_from_crop: Similarity, found: PoseEstimate) -> PoseEstimate:
    """The estimate in the camera of the whole image: the crop's camera is only turned."""
    host = camera_from_crop.to_numpy()
    turn = host.rotation
    if np.array_equal(turn, np.eye(3)):
        return found

    def turned(pose: Similarity) -> Similarity:
        return (host @ pose.to_numpy()).to_jax()

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

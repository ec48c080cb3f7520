"""Objects in frames without masks: proposals, described once, ranked for each object, verified by their poses."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ipjax.config import Config, DetectConfig
from ipjax.detection.assignment import Claim, assign
from ipjax.detection.crops import Crop, Scene, cut_crop, read_scene, undistort_pixel
from ipjax.detection.proposals.propose import ProposalConfig, Proposals, propose
from ipjax.detection.records import Detections, Ranking, Rejected
from ipjax.detection.signatures import Signature, crop_signature, glance, similarity, template_signatures
from ipjax.detection.stopwatch import Stopwatch
from ipjax.detection.verification import Candidate, Verifier, as_detection, describe_crop, is_at, reject
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.batching import compact, thin_templates
from ipjax.inference.estimator import MULTIPLE, Estimator
from ipjax.progress import bar
from ipjax.records import Templates


@dataclasses.dataclass
class Sight:
    """A frame as no object has changed it yet: its proposals, cut out and described (`Detector.look`)."""

    scene: Scene
    proposals: Proposals
    crops: list[Crop | None]  # None where nothing of a proposal can be used
    signatures: Signature | None  # of the crops that can be used, and as many more as fill a bucket
    used: np.ndarray  # the numbers of those crops
    similarity: np.ndarray  # objects × proposals, filled in by `Detector.seek`
    watch: Stopwatch
    rankings: dict[int, Ranking] = dataclasses.field(default_factory=dict)  # of objects, filled in likewise
    clicks: dict[int, tuple[float, float]] = dataclasses.field(default_factory=dict)  # likewise


class Detector:
    """Objects and an encoder, ready to be found in frames without masks.

    All objects are padded to one size, so that what was compiled for one serves all, and the crops of a frame are cut
    out and described once for all objects.

    Args:
        objects: templates and what is known of them, as `ipjax.load` returns them. Of each, ``detection.views``
            templates are used, and kept in memory: with an iterator that loads them, no more than that and one object.
        encoder: made the templates' features.
        config: of the estimates that verify proposals; None = `Config.fast`. Its ``confidence.drawn`` is that of
            ``detection``.
        detection: how objects are sought.
        proposals: how a frame is cut up; None = as by default.
        quick: as `ipjax.Estimator` has it.
        options: of `ipjax.inference.frames.cut_object`; "square" crops by default.
    """

    def __init__(
        self,
        objects: Iterable[tuple[Templates, ObjectInfo]],
        encoder: Any,
        config: Config | None = None,
        *,
        detection: DetectConfig = DetectConfig(),
        proposals: ProposalConfig | None = None,
        quick: bool = False,
        **options: Any,
    ):
        thinned = [_thinned(*one, detection.views) for one in objects]
        if not thinned:
            raise ValueError("a detector needs at least one object")
        sizes = sorted({info.resolution for _, info in thinned})
        if len(sizes) > 1:
            raise ValueError(f"the objects' templates have {' and '.join(map(str, sizes))} pixels: detect them apart")
        self.detection = detection
        self.proposals = proposals
        config = detection.with_confidence(Config.fast() if config is None else config)
        self.estimator = Estimator(thinned, encoder, config, quick=quick, alike=True, **options)
        self.options = {"resolution": sizes[0]} | self.estimator.options
        self.zoom = _usable_zoom(thinned[0][0], sizes[0], detection.zoom)
        self._signatures: dict[int, Signature] = {}

    @property
    def names(self) -> list[str]:
        """Of the objects, in their order."""
        return [info.name for _, info in self.estimator.objects]

    def detect(
        self,
        rgb: Any,
        depth: Any,
        camera: Any,
        *,
        instances: int | None = 1,
        diameters: Sequence[float | None] | None = None,
        clicks: Sequence[Sequence[int | float] | None] | None = None,
        depth_scale: float | None = None,
        seed: int = 0,
        progress: bool = False,
    ) -> Detections:
        """Find the objects in a frame.

        Args:
            rgb: height × width × 3; uint8, uint16 or float in [0, 1].
            depth: height × width along z, aligned to the colour image; float metres, or any unit with ``depth_scale``.
            camera: `Intrinsics`, `Camera`, 3 × 3 K, or (fx, fy, cx, cy), in pixels. Masks are of the image without lens
                distortion.
            instances: of each object, at most; None = as many as are there (up to ``detection.instances``).
            diameters: each object's true diameter in metres, None where it is not known.
            clicks: of each object a pixel (x, y) that shows it, in the image as it was given; None where it is not
                known. Where all objects have one, only what has a click on it is proposed.
            seed: same seed, same answer.
            progress: show a bar.

        Returns:
            What was found, the surest first. A detection that is not ``present`` is the best guess; whether to believe
            it is the caller's.

        Raises:
            ValueError: the images do not fit together, there is no depth, or a click lies outside; in words.
        """
        most = self.detection.instances if instances is None else instances
        if most < 1:
            raise ValueError(f"at least one instance must be sought, not {instances}")
        count = len(self.estimator.objects)
        diameters = [None] * count if diameters is None else list(diameters)
        if len(diameters) != count:
            raise ValueError(f"{count} objects and {len(diameters)} diameters")
        if not all(one is None or 0 < one < np.inf for one in diameters):
            raise ValueError(f"diameters are positive metres, or None, not {diameters}")
        clicks = [None] * count if clicks is None else list(clicks)
        if len(clicks) != count:
            raise ValueError(f"{count} objects and {len(clicks)} clicks")
        pixels = [None if one is None else undistort_pixel(one, camera, np.shape(rgb)[:2]) for one in clicks]
        # Of one object, the frame is cut up by its size, too; the proposals of several are shared.
        size = diameters[0] if count == 1 else None
        at = [one for one in pixels if one is not None]
        sight = self.look(rgb, depth, camera, depth_scale, diameter=size, at=at if len(at) == count else ())
        claims: list[Claim] = []
        rejected: list[Rejected] = []
        for index in bar(range(count), desc="detecting", unit=" objects", disable=not progress or count < 2):
            about = {"diameter": diameters[index], "click": pixels[index], "seed": seed}
            found, others = self.seek(sight, index, instances=most, **about)
            claims += found
            rejected += others
        return self.choose(sight, claims, rejected, instances=most)

    def look(
        self,
        rgb: Any,
        depth: Any,
        camera: Any,
        depth_scale: float | None = None,
        *,
        diameter: float | None = None,
        at: Sequence[tuple[float, float]] = (),
    ) -> Sight:
        """The first part of `detect`: proposals, cut out and described, of no object in particular.

        Args:
            rgb, depth, camera, depth_scale: as `detect` has them.
            diameter: metres, of all that is sought, where it is known: pieces of that size are proposed, too, and none
                that is much longer.
            at: pixels (x, y) of the image without lens distortion, one of which every proposal has; none = anywhere.

        Raises:
            ValueError: as `detect`.
        """
        scene = read_scene(rgb, depth, camera, depth_scale)
        watch = Stopwatch()
        with watch("propose"):
            settings = ProposalConfig() if self.proposals is None else self.proposals
            if diameter is not None:
                settings = dataclasses.replace(settings, diameters=(diameter,))
            if at:
                settings = dataclasses.replace(settings, at=tuple(at))
            proposals = propose(scene.rgb, scene.depth, scene.matrix, settings)
        with watch("cut"):
            crops = [cut_crop(scene, mask, **self.options) for mask in proposals.masks]
        signatures, used = None, np.zeros(0, int)
        with watch("glance"):
            used = np.flatnonzero([crop is not None for crop in crops])
            if used.size:
                signatures = self._glance_all([crop for crop in crops if crop is not None], watch)
        ranks = np.full((len(self.estimator.objects), len(crops)), -np.inf)
        return Sight(scene, proposals, crops, signatures, used, ranks, watch)

    def seek(
        self,
        sight: Sight,
        index: int,
        *,
        instances: int = 1,
        diameter: float | None = None,
        click: tuple[float, float] | None = None,
        seed: int = 0,
    ) -> tuple[list[Claim], list[Rejected]]:
        """The second part of `detect`: one object in the proposals that are most like it.

        Args:
            sight: from `look`.
            index: of the object.
            instances, diameter, seed: as `detect` has them.
            click: a pixel (x, y) of the object, in the image without lens distortion.

        Returns:
            Poses with the pixels that they claim, and what was given up.
        """
        if click is not None:
            sight.clicks[index] = click
        is_there = None if click is None else lambda mask: is_at(mask, click)
        first = self.detection.verified if click is None else self.detection.clicked
        candidates = self.rank(sight, index, first + 2 * (instances - 1), is_there)
        about = self.estimator, self.detection, self.options, sight.scene, sight.watch
        verifier = Verifier(*about, diameter=diameter, click=click, seed=seed)
        return verifier.verify(candidates, instances), verifier.rejected

    def choose(
        self,
        sight: Sight,
        claims: Sequence[Claim],
        rejected: Sequence[Rejected] = (),
        *,
        instances: int | Sequence[int] = 1,
    ) -> Detections:
        """The last part of `detect`: which claims of all objects hold. ``instances``: of each at most."""
        with sight.watch("assign"):
            kept, dropped = assign(
                claims,
                [templates for templates, _ in self.estimator.objects],
                instances=instances,
                taken=self.detection.taken,
                apart=self.detection.same,
            )
        lost = [reject(claim.source, reason, claim.mask) for claim, reason in dropped]
        seconds = dict(sight.watch.spent)
        found = tuple(as_detection(claim) for claim in kept)
        rankings = tuple(sight.rankings[index] for index in sorted(sight.rankings))
        clicks = tuple(sight.clicks.values())
        about = sight.proposals, sight.similarity, sight.scene, seconds, tuple(self.names), rankings, clicks
        return Detections(found, (*rejected, *lost), *about)

    def rank(
        self, sight: Sight, index: int, count: int, fits: Callable[[np.ndarray], bool] | None = None
    ) -> list[Candidate]:
        """The ``count`` proposals most like an object, the best first: chosen at a glance, ranked by whole crops.

        Args:
            sight: from `look`.
            index: of the object.
            fits: whether a mask may be its; None = any may.
        """
        if sight.signatures is None:
            return []
        if index not in self._signatures:
            self._signatures[index] = jax.block_until_ready(_template_signatures(self.estimator.objects[index][0]))
        settings, mine = self.detection, sight.similarity[index]

        def rate(crops: Signature) -> np.ndarray:
            with sight.watch("rank"):
                found = _similarity(self._signatures[index], crops, settings.alike, settings.colour)
                return np.asarray(found)

        mine[sight.used] = rate(sight.signatures)[: len(sight.used)]
        masks = sight.proposals.masks
        left = [i for i in range(len(mine)) if np.isfinite(mine[i]) and (fits is None or fits(masks[i]))]
        order = np.array(left, int)[np.argsort(-mine[left], kind="stable")]
        most = max(settings.shortlist, min(count, len(masks) + -len(masks) % _BUCKET))
        best = [int(i) for i in order[:most]]
        if best:
            found = [self._signature(sight, proposal) for proposal in best]
            found += [found[0]] * (most - len(found))
            again = rate(jax.tree.map(lambda *x: jnp.stack(x), *found))[: len(best)]
            mine[best] = again
            best = [best[i] for i in np.argsort(-again, kind="stable")]
            order[: len(best)] = best
        estimated = min(count, len(best))
        sight.rankings[index] = Ranking(index, self.names[index], order, mine[order], len(best), estimated)
        chosen = [(i, sight.crops[i]) for i in best[:count]]
        return [Candidate(index, i, float(mine[i]), masks[i], crop) for i, crop in chosen if crop is not None]

    def _glance_all(self, crops: Sequence[Crop], watch: Stopwatch) -> Signature:
        encoder = self.estimator.encoder
        look = lambda encoder, view: glance(encoder, view, self.zoom)
        found = []
        for crop in crops:
            compiled = self.estimator.compiled("glance", look, watch.spent, encoder, crop.view)
            found.append(compiled(encoder, crop.view))
        # Padded to a multiple, so that frames of other numbers of proposals take the same program.
        found += [found[0]] * (-len(found) % _BUCKET)
        return jax.block_until_ready(jax.tree.map(lambda *x: jnp.stack(x), *found))

    def _signature(self, sight: Sight, proposal: int) -> Signature:
        """Of a whole crop, which is described when it is first wanted."""
        crop = sight.crops[proposal]
        assert crop is not None
        if crop.signature is None:
            patches = describe_crop(self.estimator, crop, sight.watch)
            signature = crop.signature = _crop_signature(patches, crop.view)
            return signature
        return crop.signature


_BUCKET = 64
_template_signatures = jax.jit(template_signatures)
_crop_signature = jax.jit(crop_signature)
_similarity = jax.jit(similarity, static_argnums=2)


def _usable_zoom(templates: Templates, resolution: int, zoom: int) -> int:
    """The largest zoom up to the one asked for at which a crop is still a whole number of patches."""
    cells = int(np.asarray(templates.patches.grid).max()) + 1
    patch = resolution // cells
    return next(z for z in range(zoom, 0, -1) if resolution % (z * patch) == 0)


def _thinned(templates: Templates, info: ObjectInfo, count: int) -> tuple[Templates, ObjectInfo]:
    """With fewer templates, and the pictures of those."""
    templates = compact(templates, multiple=MULTIPLE)
    if templates.reference is not None:  # the views of a photo are few, and around it
        return templates, info
    templates, kept = thin_templates(templates, count)
    pictures = info.pictures
    if pictures is not None:
        pictures = pictures[kept] if isinstance(pictures, np.ndarray) else [pictures[i] for i in kept]
    return templates, dataclasses.replace(info, pictures=pictures)

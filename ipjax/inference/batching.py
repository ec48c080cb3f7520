"""Templates with fewer patches, and of one size for several objects, so that one program estimates them all; and
batches divided among the devices of a process."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int

from ipjax.records import Templates


def compact(templates: Templates, *, multiple: int = 32) -> Templates:
    """Templates without most of their background patches; estimates stay the same.

    The valid patches come first, in their old order, then at least one invalid one, as many as give all templates the
    same number, a multiple of ``multiple``. The last patch of the grid always stays, valid or not, so that the size of
    the grid can be read off ``grid``. The reference view keeps its whole grid. To be done once, before ``estimate``; an
    object file keeps every patch.

    Raises:
        ValueError: the templates are no single object's, or ``multiple`` is not positive.
    """
    valid = np.asarray(templates.patches.valid)
    if valid.ndim != 2 or multiple < 1:
        raise ValueError(f"compact takes one object's templates and a positive multiple, not {valid.shape}, {multiple}")
    views, patches = valid.shape
    count = multiple * (int(valid.sum(axis=1).max()) // multiple + 1)
    if count >= patches:
        return templates
    place = np.where(valid, np.arange(patches), 2 * patches - np.arange(patches))
    chosen = np.argsort(place, axis=1)[:, :count]
    take = lambda x: jnp.asarray(np.asarray(x)[np.arange(views)[:, None], chosen])
    return dataclasses.replace(
        templates,
        patches=jax.tree.map(take, templates.patches),
        norm=take(templates.norm),
        seen=take(templates.seen),
    )


def pad_templates(objects: Sequence[Templates]) -> Templates:
    """Several objects' templates padded to one size and stacked, so that ``jax.vmap(estimate, …)`` takes them at once.

    What is added is absent. Patches are not valid. Views repeat the last one's pose and camera without a valid patch:
    they rank behind all others and no feature is taken from them. Surface and appearance points repeat the first one
    with a normal of zero: they face no camera, so they are neither fitted nor drawn and widen no outline. Reference
    views are not padded: all have one size, as objects from photos have that were onboarded alike. Photos with depth,
    which only choose among poses, are left out where not all of the objects have one; so is how far points of the
    surface may be off, on which the deviations of objects from photos without depth rest.
    An object's estimate is the same as without padding, up to rounding, if it has at least ``config.match.views`` views
    and ``config.refine.points`` surface points; with fewer, it gets as many hypotheses and points as the others.

    Args:
        objects: each as ``load`` or ``onboard`` return it, or after ``compact``; not batched.

    Returns:
        Templates with a leading axis of the objects.

    Raises:
        ValueError: there is none, or they are not alike: of different encoders, features of different lengths,
            reference views of different sizes, or some with a basis, appearance or reference view and some without.
    """
    objects = list(objects)
    if not objects:
        raise ValueError("pad_templates takes at least one object's templates")
    shapes = {(np.ndim(o.patches.features), *(np.shape(x)[-1] for x in (o.patches.features, o.mean))) for o in objects}
    if len(shapes) > 1 or next(iter(shapes))[0] != 3:
        raise ValueError(
            "pad_templates takes single objects whose features have one shape [views, patches, channels], not "
            + " and ".join(str(np.shape(o.patches.features)) for o in objects)
        )
    encoders = sorted({e for o in objects for e in _encoders(o) if e is not None})
    if len(encoders) > 1:
        raise ValueError(f"these objects were onboarded with different encoders: {', '.join(map(repr, encoders))}")
    objects = [_described_by(o, None) for o in objects]
    for name in ("basis", "appearance", "photo_centre"):
        if len({getattr(o, name) is None for o in objects}) > 1:
            raise ValueError(f"some of these templates have their {name} and some have none; onboard them alike")
    if any(o.surface.along_std is None or o.surface.across_std is None for o in objects):
        objects = [_without_deviations(o) for o in objects]
    if not all(o.reference is not None and o.reference.measured for o in objects):
        objects = [_without_measured_photo(o) for o in objects]
    _check_references(objects)
    padded = _pad_all(objects)
    stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(one, jnp.result_type(*x)) for one in x]), *padded)
    return _described_by(stacked, encoders[0] if encoders else None)


def pad_alike(objects: Sequence[Templates]) -> list[Templates]:
    """Each object's templates as `pad_templates` pads them, but apart, so that one compiled ``estimate`` takes each.

    Objects that cannot be made alike (some with a basis, appearance or reference view and some without, or of
    different encoders) are padded to the size of those that are like them.
    """
    kinds: dict[Any, list[int]] = {}
    for index, one in enumerate(objects):
        reference = None if one.reference is None else jax.tree.map(np.shape, one.reference)
        has = tuple(getattr(one, name) is None for name in ("basis", "appearance", "photo_centre"))
        leaves, structure = jax.tree.flatten((reference, one.patches.features.shape[-1]))
        kinds.setdefault((has, tuple(leaves), structure, *_encoders(one)), []).append(index)
    padded = list(objects)
    for mine in kinds.values():
        for index, one in zip(mine, _pad_all([objects[i] for i in mine]), strict=True):
            padded[index] = one
    return padded


def thin_templates(templates: Templates, count: int) -> tuple[Templates, Int[np.ndarray, "k"]]:
    """The ``count`` templates whose viewpoints and rolls are farthest apart, and their places in the old order.

    Raises ValueError unless ``count`` is positive. With as many templates as there are, nothing changes.
    """
    if count < 1:
        raise ValueError(f"at least one template must be kept, not {count}")
    rotation = np.asarray(templates.camera_from_object.rotation, np.float64)
    if count >= len(rotation):
        return templates, np.arange(len(rotation))
    chosen = [0]
    nearest = np.einsum("nij,ij->n", rotation, rotation[0])  # the trace of the turn between two: large = near
    while len(chosen) < count:
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, np.einsum("nij,ij->n", rotation, rotation[chosen[-1]]))
    kept = np.sort(chosen)
    parts = ("patches", "norm", "seen", "camera_from_object", "camera")
    return dataclasses.replace(
        templates, **{name: jax.tree.map(lambda x: x[kept], getattr(templates, name)) for name in parts}
    ), kept


class Spread:
    """The first axis of a batch, divided among devices of one process; each works on its part alone.

    Each device runs the program of its own part: left to itself, the compiler would make the loops of all devices wait
    for one another at every turn, to learn whether any of them goes on.

    Args:
        devices: None = all that this process has.
    """

    def __init__(self, devices: Sequence[Any] | None = None):
        self.devices = tuple(jax.local_devices() if devices is None else devices)
        self._mesh = Mesh(np.array(self.devices), ("batch",))
        self._copies: dict[Any, tuple[Any, Any]] = {}

    def fits(self, size: int) -> bool:
        """Whether there are several devices, and a batch of this size gives each of them as much."""
        return len(self.devices) > 1 and size % len(self.devices) == 0

    def divide(self, batch: Any) -> Any:
        """Arrays whose first axis is divided among the devices."""
        return jax.device_put(batch, NamedSharding(self._mesh, PartitionSpec("batch")))

    def copy(self, name: Any, given: Any) -> Any:
        """What all parts need, on every device; it is copied once, and again when another is given by this name."""
        known, copied = self._copies.get(name, (None, None))
        if known is not given:
            copied = jax.device_put(given, NamedSharding(self._mesh, PartitionSpec()))
            self._copies[name] = given, copied
        return copied

    def over(self, function: Callable, divided: Sequence[bool]) -> Callable:
        """A function of batches as one that each device calls with its part.

        Args:
            function: its results have the batch's axis first.
            divided: of each argument, whether it is divided among the devices or the same on all.
        """
        specs = tuple(PartitionSpec("batch") if one else PartitionSpec() for one in divided)
        # Its loops would have to be told which of their values differ between devices; nothing here is shared.
        return jax.shard_map(
            function, mesh=self._mesh, in_specs=specs, out_specs=PartitionSpec("batch"), check_vma=False
        )


def _pad_all(objects: Sequence[Templates]) -> list[Templates]:
    """All padded to the size of the largest."""
    views, patches = (max(o.norm.shape[axis] for o in objects) for axis in (0, 1))
    count = max(o.surface.points.shape[0] for o in objects)
    drawn = max(0 if o.appearance is None else o.appearance.points.shape[0] for o in objects)
    return [_pad(o, views, patches, count, drawn) for o in objects]


def _check_references(objects: list[Templates]) -> None:
    """All have a reference view of one size, or none has one."""
    views = [o.reference for o in objects]
    if len({view is None for view in views}) > 1:
        raise ValueError(
            "some of these objects were made from a photo without depth, through which their pose is found, and some "
            "were not: pad them apart"
        )
    sizes = sorted({(np.shape(view.view.mask), np.shape(view.patches.valid)) for view in views if view is not None})
    if len(sizes) > 1:
        told = " and ".join(f"{list(pixels)} pixels with {patches[0]} patches" for pixels, patches in sizes)
        raise ValueError(f"the reference views of these objects differ in size, {told}; onboard them alike")


def _without_measured_photo(templates: Templates) -> Templates:
    """Without the reference view of a photo with depth: objects that have none beside it are chosen without one."""
    reference = templates.reference
    return dataclasses.replace(templates, reference=None) if reference is not None and reference.measured else templates


def _without_deviations(templates: Templates) -> Templates:
    """Without what tells how far points may be off, which objects from photos without depth have alike."""
    surface = dataclasses.replace(templates.surface, along_std=None, across_std=None)
    return dataclasses.replace(templates, surface=surface)


def _encoders(templates: Templates) -> list[str | None]:
    """Who described the templates, and their reference view if they have one."""
    reference = templates.reference
    return [templates.patches.encoder, *([] if reference is None else [reference.patches.encoder])]


def _described_by(templates: Templates, encoder: str | None) -> Templates:
    """The templates, and their reference view if they have one, with another name of their encoder."""
    name = lambda patches: dataclasses.replace(patches, encoder=encoder)
    reference = templates.reference
    if reference is not None:
        reference = dataclasses.replace(reference, patches=name(reference.patches))
    return dataclasses.replace(templates, patches=name(templates.patches), reference=reference)


def _pad(templates: Templates, views: int, patches: int, count: int, drawn: int) -> Templates:
    """One object's templates with so many views, patches in each, and points of surface and appearance."""

    def extended(array: Any, *sizes: int, repeat: int | None = None):
        """With rows of zeros, or of one that is repeated, at the end of the first axes."""
        array = np.asarray(array)
        for axis, size in enumerate(sizes):
            more = size - array.shape[axis]
            row = np.take(array, [0 if repeat is None else repeat], axis)
            row = np.zeros_like(row) if repeat is None else row
            array = np.concatenate([array, np.repeat(row, more, axis)], axis)
        return jnp.asarray(array)

    def points(record: Any, size: int):
        fields = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
        fields = {name: value for name, value in fields.items() if value is not None}
        more = {name: extended(value, size) for name, value in fields.items() if name != "points"}
        return type(record)(points=extended(record.points, size, repeat=0), **more)

    last = lambda tree: jax.tree.map(lambda x: extended(x, views, repeat=-1), tree)
    return dataclasses.replace(
        templates,
        patches=jax.tree.map(lambda x: extended(x, views, patches), templates.patches),
        norm=extended(templates.norm, views, patches),
        seen=extended(templates.seen, views, patches),
        camera_from_object=last(templates.camera_from_object),
        camera=last(templates.camera),
        surface=points(templates.surface, count),
        appearance=None if templates.appearance is None else points(templates.appearance, drawn),
    )

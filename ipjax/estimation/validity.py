"""NaN and infinity: what is not finite is marked as absent; where it cannot be absent, there is no estimate.

A depth camera writes NaN and infinity where it saw nothing, an undistorted image has borders without a colour, a
network can overflow. Each function returns a record in which such places hold finite numbers and are marked as absent
by the record's own marks (`valid`, `mask`, depth 0), so that later stages need not check again. Gradients with respect
to the remaining numbers are finite.
"""

import dataclasses
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ipjax.records import (
    Appearance,
    Camera,
    Patches,
    PoseEstimate,
    Query,
    ReferenceView,
    Similarity,
    Surface,
    Templates,
    View,
)

_Points = TypeVar("_Points", Surface, Appearance)


def finite_view(view: View) -> tuple[View, Bool[Array, "*b"]]:
    """A view whose pixels without a finite colour are black and not of the object, and whose depth is finite or 0.

    Returns:
      The view, and whether it has a camera: finite, with a positive focal length. Without one, nothing in the view has
      a place in space.
    """
    coloured = jnp.all(jnp.isfinite(view.rgb), axis=-1)
    measured = jnp.isfinite(view.depth) & (view.depth > 0)
    camera, has_camera = _finite_camera(view.camera)
    rgb, depth = jnp.where(coloured[..., None], view.rgb, 0), jnp.where(measured, view.depth, 0)
    return View(rgb, depth, view.mask & coloured, camera), has_camera


def finite_patches(patches: Patches) -> Patches:
    """Patches of which those with a feature, point or place in the grid that is not finite are not valid."""
    fields = {name: getattr(patches, name) for name in ("features", "points", "grid")}
    finite = {name: _finite_rows(value) for name, value in fields.items()}
    kept = {name: jnp.where(finite[name][..., None], value, 0) for name, value in fields.items()}
    valid = patches.valid & finite["features"] & finite["points"] & finite["grid"]
    return dataclasses.replace(patches, **kept, valid=valid)


def finite_query(query: Query) -> tuple[Query, Bool[Array, "*b"]]:
    """A query of finite numbers, and whether it has a camera: see :func:`finite_view`, :func:`finite_patches`."""
    view, has_camera = finite_view(query.view)
    return Query(finite_patches(query.patches), view), has_camera


def finite_templates(templates: Templates) -> tuple[Templates, Bool[Array, ""]]:
    """Templates of finite numbers, of one object; but the features of patches that are not valid stay as they are.

    A view without a finite pose and camera has no valid patch. A point of the surface or the appearance that is not
    finite repeats one that is, without a normal: it faces no camera, as with ``ipjax.pad_templates``. The reference
    view is treated as a view, and its patches as patches.

    Returns:
      The templates, and whether the object is usable: it has a finite surface point, its axes, extents, mean and
      basis are finite throughout, and so are pose and camera of its reference view, if it has one.
    """
    patches, pose = templates.patches, templates.camera_from_object
    camera, has_camera = _finite_camera(templates.camera)
    placed = has_camera & _finite_pose(pose)
    finite = _finite_rows(patches.features) & _finite_rows(patches.points) & _finite_rows(patches.grid)
    valid = patches.valid & finite & jnp.isfinite(templates.norm) & placed[:, None]
    shown = dataclasses.replace(
        patches,
        points=jnp.where(valid[..., None], patches.points, 0),
        grid=jnp.where(_finite_rows(patches.grid)[..., None], patches.grid, 0),
        valid=valid,
    )
    surface, has_points = _finite_points(templates.surface)
    needed = [
        templates.mean,
        templates.axes,
        templates.extents,
        *([] if templates.basis is None else [templates.basis]),
    ]
    reference, has_place = None, []
    if templates.reference is not None:
        reference, has_reference = _finite_reference(templates.reference)
        has_place = [has_reference]
    usable = jnp.stack([has_points, *has_place, *(jnp.all(jnp.isfinite(x)) for x in needed)])
    kept = dataclasses.replace(
        templates,
        patches=shown,
        mean=_or_zero(templates.mean),
        norm=_or_zero(templates.norm),
        seen=_or_zero(templates.seen),
        extents=_or_zero(templates.extents),
        camera_from_object=_or_identity(pose, placed),
        camera=camera,
        surface=surface,
        axes=jnp.where(jnp.all(jnp.isfinite(templates.axes)), templates.axes, jnp.eye(3, dtype=templates.axes.dtype)),
        basis=None if templates.basis is None else _or_zero(templates.basis),
        appearance=None if templates.appearance is None else _finite_points(templates.appearance)[0],
        reference=reference,
        photo_centre=None if templates.photo_centre is None else _or_zero(templates.photo_centre),
    )
    return kept, jnp.all(usable)


def finite_estimate(found: PoseEstimate) -> PoseEstimate:
    """An estimate of finite numbers; without success, confidence and presence where it was not finite.

    Estimates from finite records are finite, unless the settings make no sense: this is the last guard against those.
    """
    uncertainty = found.diameter, found.box, found.confidence, found.covariance, found.scale_std, found.ambiguity
    own = found.camera_from_object, *uncertainty, found.agreement, found.rmse
    fine = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(own)]))
    others = found.hypotheses
    usable = _finite_pose(others.camera_from_object) & jnp.isfinite(others.score)
    answer = dataclasses.replace(
        found,
        camera_from_object=_or_identity(found.camera_from_object, _finite_pose(found.camera_from_object)),
        hypotheses=dataclasses.replace(
            others,
            camera_from_object=_or_identity(others.camera_from_object, usable),
            score=jnp.where(usable, others.score, 0),
        ),
        confidence=jnp.where(fine, found.confidence, 0),
        present=found.present & fine,
        success=found.success & fine,
    )
    return jax.tree.map(lambda x: _or_zero(x) if jnp.issubdtype(x.dtype, jnp.inexact) else x, answer)


def _finite_reference(reference: ReferenceView) -> tuple[ReferenceView, Bool[Array, ""]]:
    """A reference view of finite numbers, and whether it has a camera and a pose: poses are found through it."""
    view, has_camera = finite_view(reference.view)
    placed = _finite_pose(reference.camera_from_object)
    pose = _or_identity(reference.camera_from_object, placed)
    patches = finite_patches(reference.patches)
    kept = dataclasses.replace(reference, view=view, patches=patches, camera_from_object=pose)
    return kept, has_camera & placed


def _finite_camera(camera: Camera) -> tuple[Camera, Bool[Array, "*b"]]:
    finite = jnp.all(jnp.isfinite(camera.focal) & (camera.focal > 0) & jnp.isfinite(camera.centre), axis=-1)
    keep = finite[..., None]
    return Camera(jnp.where(keep, camera.focal, 1), jnp.where(keep, camera.centre, 0)), finite


def _finite_points(record: _Points) -> tuple[_Points, Bool[Array, ""]]:
    fields = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    fields = {name: x for name, x in fields.items() if x is not None}
    rows = [jnp.isfinite(x) if x.ndim == 1 else _finite_rows(x) for x in fields.values()]
    finite = jnp.all(jnp.stack(rows), axis=0)
    first = jnp.where(jnp.any(finite), record.points[jnp.argmax(finite)], 0)
    kept = {name: jnp.where(finite if x.ndim == 1 else finite[:, None], x, 0) for name, x in fields.items()}
    kept["points"] = jnp.where(finite[:, None], record.points, first)
    return type(record)(**kept), jnp.any(finite)


def _finite_pose(pose: Similarity) -> Bool[Array, "*b"]:
    return (
        jnp.all(jnp.isfinite(pose.rotation), axis=(-2, -1)) & _finite_rows(pose.translation) & jnp.isfinite(pose.scale)
    )


def _or_identity(pose: Similarity, keep: Bool[Array, "*b"]) -> Similarity:
    return Similarity(
        jnp.where(keep[..., None, None], pose.rotation, jnp.eye(3, dtype=pose.rotation.dtype)),
        jnp.where(keep[..., None], pose.translation, 0),
        jnp.where(keep, pose.scale, 1),
    )


def _finite_rows(values: Float[Array, "*b c"]) -> Bool[Array, "*b"]:
    return jnp.all(jnp.isfinite(values), axis=-1)


def _or_zero(values: Float[Array, "*b"]) -> Float[Array, "*b"]:
    return jnp.where(jnp.isfinite(values), values, 0)

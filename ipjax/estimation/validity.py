"""Numbers that are not numbers: whatever is not finite is absent; what cannot be absent leaves the answer undetermined.

A depth camera writes NaN and infinity where it saw nothing, an undistorted image has borders without a colour, a
network can overflow. Each function gives a record in which such places hold harmless numbers and are marked as absent.
The marks are the records' own (`valid`, `mask`, depth 0), so nobody after them needs to ask again. Gradients with
respect to what is left are finite.
"""

import dataclasses
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ipjax.records import Appearance, Camera, Patches, PoseEstimate, Query, Similarity, Surface, Templates, View

_Points = TypeVar("_Points", Surface, Appearance)


def finite_view(view: View) -> tuple[View, Bool[Array, "*b"]]:
    """A view whose pixels without a finite colour are black and not of the object, and whose depth is finite or 0.

    Returns:
      The view, and whether it has a camera: finite, with a positive focal length. Without one, nothing in the view has
      a place in space.
    """
    coloured = jnp.all(jnp.isfinite(view.rgb), axis=-1)
    measured = jnp.isfinite(view.depth) & (view.depth > 0)
    camera, there = _finite_camera(view.camera)
    rgb, depth = jnp.where(coloured[..., None], view.rgb, 0), jnp.where(measured, view.depth, 0)
    return View(rgb, depth, view.mask & coloured, camera), there


def finite_patches(patches: Patches) -> Patches:
    """Patches of which those with a feature, point or place in the grid that is not finite are not valid."""
    fields = {name: getattr(patches, name) for name in ("features", "points", "grid")}
    known = {name: _finite_rows(value) for name, value in fields.items()}
    kept = {name: jnp.where(known[name][..., None], value, 0) for name, value in fields.items()}
    valid = patches.valid & known["features"] & known["points"] & known["grid"]
    return dataclasses.replace(patches, **kept, valid=valid)


def finite_query(query: Query) -> tuple[Query, Bool[Array, "*b"]]:
    """A query of finite numbers, and whether it has a camera: see :func:`finite_view`, :func:`finite_patches`."""
    view, there = finite_view(query.view)
    return Query(finite_patches(query.patches), view), there


def finite_templates(templates: Templates) -> tuple[Templates, Bool[Array, ""]]:
    """Templates of finite numbers, of one object; but the features of patches that are not valid stay as they are.

    A view without a finite pose and camera has no valid patch. A point of the surface or the appearance that is not
    finite repeats one that is, without a normal: it faces no camera, as with ``ipjax.pad_templates``.

    Returns:
      The templates, and whether the object is known: some point of its surface, and its axes and its features' mean and
      basis wholly.
    """
    patches, pose = templates.patches, templates.camera_from_object
    camera, placed = _finite_camera(templates.camera)
    placed = placed & _finite_pose(pose)
    here = _finite_rows(patches.features) & _finite_rows(patches.points) & _finite_rows(patches.grid)
    here = patches.valid & here & jnp.isfinite(templates.norm) & placed[:, None]
    shown = dataclasses.replace(
        patches,
        points=jnp.where(here[..., None], patches.points, 0),
        grid=jnp.where(_finite_rows(patches.grid)[..., None], patches.grid, 0),
        valid=here,
    )
    surface, solid = _finite_points(templates.surface)
    whole = [templates.mean, templates.axes, *([] if templates.basis is None else [templates.basis])]
    known = jnp.stack([solid, *(jnp.all(jnp.isfinite(x)) for x in whole)])
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
    )
    return kept, jnp.all(known)


def finite_estimate(found: PoseEstimate) -> PoseEstimate:
    """An estimate of finite numbers: one that is not is no success, and has neither confidence nor presence.

    The last guard, against settings that make no sense: what comes from finite records is finite.
    """
    uncertainty = found.confidence, found.covariance, found.scale_std, found.ambiguity
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


def _finite_camera(camera: Camera) -> tuple[Camera, Bool[Array, "*b"]]:
    there = jnp.all(jnp.isfinite(camera.focal) & (camera.focal > 0) & jnp.isfinite(camera.centre), axis=-1)
    keep = there[..., None]
    return Camera(jnp.where(keep, camera.focal, 1), jnp.where(keep, camera.centre, 0)), there


def _finite_points(record: _Points) -> tuple[_Points, Bool[Array, ""]]:
    fields = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    rows = [jnp.isfinite(x) if x.ndim == 1 else _finite_rows(x) for x in fields.values()]
    here = jnp.all(jnp.stack(rows), axis=0)
    first = jnp.where(jnp.any(here), record.points[jnp.argmax(here)], 0)
    kept = {name: jnp.where(here if x.ndim == 1 else here[:, None], x, 0) for name, x in fields.items()}
    kept["points"] = jnp.where(here[:, None], record.points, first)
    return type(record)(**kept), jnp.any(here)


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

"""Writing object files."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.files.meshes.simplification import simplify
from ipjax.files.objects.layout import FORMAT, OPTIONAL_TENSORS, TEMPLATE_TENSORS, check_shapes, hash_content
from ipjax.files.objects.pictures import compress_pictures
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.storage.writing import writing
from ipjax.records import ReferenceView, Templates


def save(path: str | Path, templates: Templates, info: ObjectInfo) -> Path:
    """Write an object file; the file appears whole or not at all.

    Args:
        path: usually ending in ``.ipjax``; an existing file is replaced.
        templates: of one object, not batched. Features are stored as float16.

    Raises:
        ValueError: the templates are no single object's, or hold numbers that are not finite, or colours that are
            not in [0, 1].
        OSError: the file cannot be written.
    """
    from safetensors.numpy import save_file

    path = Path(path)
    patches, pose = templates.patches, templates.camera_from_object
    tensors: dict[str, Any] = {
        "features": patches.features,
        "points": patches.points,
        "grid": patches.grid,
        "valid": patches.valid,
        "mean": templates.mean,
        "norm": templates.norm,
        "seen": templates.seen,
        "rotation": pose.rotation,
        "translation": pose.translation,
        "focal": templates.camera.focal,
        "centre": templates.camera.centre,
        "surface.points": templates.surface.points,
        "surface.normals": templates.surface.normals,
        "surface.seen": templates.surface.seen,
        "extents": templates.extents,
        "axes": templates.axes,
    }
    if templates.basis is not None:
        tensors["basis"] = templates.basis
    if templates.surface.along_std is not None and templates.surface.across_std is not None:
        tensors |= {"deviation.along": templates.surface.along_std, "deviation.across": templates.surface.across_std}
    if templates.appearance is not None:
        tensors |= {
            "appearance.points": templates.appearance.points,
            "appearance.normals": templates.appearance.normals,
            "appearance.colours": _to_bytes("appearance.colours", templates.appearance.colours),
        }
    if templates.photo_centre is not None:
        tensors["photo_centre"] = templates.photo_centre
    if templates.reference is not None:
        tensors |= _flatten_reference(templates.reference)
    if np.ndim(patches.features) != 3:
        raise ValueError(
            f"templates of one object have features [views, patches, channels], not {patches.features.shape}"
        )
    if not np.allclose(pose.scale, 1):
        raise ValueError("the poses of templates must have scale 1")
    if info.vertices is not None and info.faces is not None:
        vertices, faces, colours = simplify(info.vertices, info.faces, info.colours)
        tensors |= {"mesh.vertices": vertices, "mesh.faces": faces}
        if colours is not None:
            tensors["mesh.colours"] = colours
    if info.pictures is not None:
        pictures = compress_pictures(info.pictures)
        tensors["pictures"] = np.frombuffer(b"".join(pictures), np.uint8)
        tensors["pictures.end"] = np.cumsum([len(picture) for picture in pictures])
    if info.reference is not None and info.reference.picture:
        tensors["photo"] = np.frombuffer(info.reference.picture, np.uint8)
    kinds = TEMPLATE_TENSORS | OPTIONAL_TENSORS
    tensors = {name: np.ascontiguousarray(np.asarray(array), kinds[name][0]) for name, array in tensors.items()}
    check_shapes({name: (array.dtype.name, array.shape) for name, array in tensors.items()}, str(path))
    for name, array in tensors.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name} has values that are not finite")
    header = {
        "format": FORMAT,
        "writer": f"ipjax {_version()}",
        "name": info.name,
        "encoder": info.encoder,
        "mesh": {
            "file": info.mesh_file,
            "sha256": info.mesh_sha256,
            "scale": float(info.mesh_scale),
            "centre": [float(x) for x in info.mesh_centre],
            "metres_per_unit": info.metres_per_unit,
        },
        "config": info.config,
        "notes": list(info.notes),
        "resolution": int(info.resolution),
    }
    if info.reference is not None:
        header["reference"] = info.reference.as_json()
    if templates.reference is not None:
        header["depth_measured"] = bool(templates.reference.measured)
    header = json.loads(json.dumps(header, allow_nan=False))
    text = json.dumps(header | {"content_sha256": hash_content(header, tensors)})
    with writing(path) as temporary:
        save_file(tensors, temporary, metadata={"ipjax": text})
    return path


def _flatten_reference(reference: ReferenceView) -> dict[str, Any]:
    """The photo that poses are found through, by the names of its tensors."""
    view, patches, pose = reference.view, reference.patches, reference.camera_from_object
    if not np.allclose(pose.scale, 1):
        raise ValueError("the pose of the reference view must have scale 1")
    return {
        "reference.rgb": _to_bytes("reference.rgb", view.rgb),
        "reference.depth": view.depth,
        "reference.mask": view.mask,
        "reference.features": patches.features,
        "reference.points": patches.points,
        "reference.grid": patches.grid,
        "reference.valid": patches.valid,
        "reference.rotation": pose.rotation,
        "reference.translation": pose.translation,
        "reference.focal": view.camera.focal,
        "reference.centre": view.camera.centre,
    }


def _to_bytes(name: str, colours: Any) -> np.ndarray:
    colours = np.asarray(colours)
    if not ((colours >= 0) & (colours <= 1)).all():  # as bytes, what is outside would wrap around and NaN be anything
        raise ValueError(f"{name} has values that are not in [0, 1]")
    return np.round(255 * colours)


def _version() -> str:
    from ipjax import __version__

    return __version__

"""Reading object files, and checking them to their last byte."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ipjax.estimation.features import identity_of
from ipjax.files.objects.deviations import with_deviations
from ipjax.files.objects.layout import FORMAT, READABLE, TEMPLATE_TENSORS, check_shapes, hash_content
from ipjax.files.objects.record import ObjectInfo, Reference
from ipjax.files.storage.budget import check_budget, read_safetensors_header
from ipjax.files.storage.parsing import parse_json
from ipjax.records import (
    UNNAMED,
    Appearance,
    Camera,
    Patches,
    ReferenceView,
    Similarity,
    Surface,
    Templates,
    View,
)


def load(path: str | Path, encoder: Any = None) -> tuple[Templates, ObjectInfo]:
    """Read an object file.

    Args:
        encoder: the encoder that will describe queries. None, or one without an ``identity``, is not compared.

    Raises:
        ValueError: missing, damaged, of another version, or made by another encoder; one sentence that names the file.
    """
    header, tensors = _read_tensors(Path(path))
    info = _make_info(header, tensors, Path(path))
    made_by, given = None if info.encoder in ("", UNNAMED) else info.encoder, identity_of(encoder)
    if made_by and given and made_by != given:
        raise ValueError(
            f"{path}: made with the encoder '{made_by}', but the one at hand is '{given}'; "
            "onboard the object again, or give the weights it was made with"
        )
    device = {name: jnp.asarray(tensors[name]) for name in TEMPLATE_TENSORS}
    views = len(tensors["rotation"])
    return (
        Templates(
            patches=Patches(
                features=device["features"],
                points=device["points"],
                grid=device["grid"],
                valid=jnp.asarray(_usable_patches(tensors) & np.isfinite(tensors["norm"])),
                encoder=made_by,
            ),
            mean=device["mean"],
            norm=device["norm"],
            seen=device["seen"],
            camera_from_object=Similarity(
                rotation=device["rotation"],
                translation=device["translation"],
                scale=jnp.ones(views, jnp.float32),
            ),
            camera=Camera(focal=device["focal"], centre=device["centre"]),
            surface=_make_surface(tensors, info, path),
            extents=device["extents"],
            axes=device["axes"],
            basis=jnp.asarray(tensors["basis"]) if "basis" in tensors else None,
            appearance=_make_appearance(tensors),
            reference=_make_reference_view(tensors, made_by, measured=header.get("depth_measured") is True),
            photo_centre=jnp.asarray(tensors["photo_centre"]) if "photo_centre" in tensors else None,
        ),
        info,
    )


def _make_surface(tensors: dict[str, np.ndarray], info: ObjectInfo, path: str | Path) -> Surface:
    """The surface; of an object from a photo, whose file is too old to say it, with what is assumed of its method."""
    names = ("surface.points", "surface.normals", "surface.seen")
    surface = Surface(*(jnp.asarray(tensors[name]) for name in names))
    if "deviation.along" not in tensors:
        return surface if info.reference is None else with_deviations(surface, info.reference.method)
    along, across = tensors["deviation.along"], tensors["deviation.across"]
    if min(along.min(), across.min()) < 0:
        raise ValueError(f"{path}: damaged: the surface's points have deviations below zero")
    return dataclasses.replace(surface, along_std=jnp.asarray(along), across_std=jnp.asarray(across))


def _usable_patches(tensors: dict[str, np.ndarray], prefix: str = "") -> np.ndarray:
    """Which patches are valid: those that the file says are, without those that have a number that is not finite."""
    valid = tensors[f"{prefix}valid"]
    for name in ("features", "points", "grid"):
        valid = valid & np.isfinite(tensors[prefix + name]).all(axis=-1)
    return valid


def _make_appearance(tensors: dict[str, np.ndarray]) -> Appearance | None:
    if "appearance.points" not in tensors:
        return None
    return Appearance(
        points=jnp.asarray(tensors["appearance.points"], jnp.float32),
        normals=jnp.asarray(tensors["appearance.normals"], jnp.float32),
        colours=jnp.asarray(tensors["appearance.colours"].astype(np.float32) / 255),
    )


def _make_reference_view(
    tensors: dict[str, np.ndarray], made_by: str | None, *, measured: bool
) -> ReferenceView | None:
    if "reference.rgb" not in tensors:
        return None
    device = {name: jnp.asarray(x) for name, x in tensors.items() if name.startswith("reference.")}
    return ReferenceView(
        view=View(
            rgb=jnp.asarray(tensors["reference.rgb"].astype(np.float32) / 255),
            depth=device["reference.depth"],
            mask=device["reference.mask"],
            camera=Camera(focal=device["reference.focal"], centre=device["reference.centre"]),
        ),
        patches=Patches(
            features=device["reference.features"],
            points=device["reference.points"],
            grid=device["reference.grid"],
            valid=jnp.asarray(_usable_patches(tensors, "reference.")),
            encoder=made_by,
        ),
        camera_from_object=Similarity(
            rotation=device["reference.rotation"],
            translation=device["reference.translation"],
            scale=jnp.ones((), jnp.float32),
        ),
        measured=measured,
    )


def check(path: str | Path) -> list[str]:
    """Read an object file to its last byte, check it, and describe it.

    Returns:
        Sentences for a person: the object, its size, who made it, what was noted.

    Raises:
        ValueError: as `load`, or the content is not what was written, or cannot be true.
    """
    path = Path(path)
    header, tensors = _read_tensors(path)
    info = _make_info(header, tensors, path)
    if hash_content(header, tensors) != header.get("content_sha256"):
        raise ValueError(f"{path}: damaged: the content does not have the checksum in its header")
    for name, array in tensors.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{path}: damaged: {name} has values that are not finite")
    _check_described(tensors, path)
    views, patches, channels = tensors["features"].shape
    seen = tensors["valid"].sum(axis=1).mean()
    size = 1 / info.mesh_scale
    unit = f" ({size * info.metres_per_unit * 1e3:.1f} mm)" if info.metres_per_unit else ", unit unknown"
    photo = info.reference
    made = [] if photo is None else [f"made from the photo by {photo.method}; {photo.seen:.0%} of its surface was seen"]
    if "reference.rgb" in tensors:
        side, shown = len(tensors["reference.rgb"]), tensors["reference.valid"]
        used = "chosen by" if header.get("depth_measured") is True else "found through"
        made.append(f"poses are {used} the photo: {side} pixels wide, {shown.sum()} of its {len(shown)} patches valid")
    return [
        f"object {info.name!r} from {info.mesh_file or 'a mesh'} (sha256 {info.mesh_sha256[:12] or 'unknown'})",
        f"diameter {size:g} in the mesh's unit{unit}",
        f"{views} templates of {patches} patches with {channels} channels; {seen:.0f} valid each",
        f"encoder {info.encoder}",
        f"written by {header.get('writer', 'an unknown writer')}, format {header['format']}, content as written",
        *made,
        *info.notes,
    ]


def _check_described(tensors: dict[str, np.ndarray], path: Path) -> None:
    """Poses are rotations and valid features unit vectors: of the templates, and of the photo where there is one.

    The photo must have a camera, too; a template without one is only left out.
    """
    described = {"": ("the template poses hold", "no template shows")}
    if "reference.rgb" in tensors:
        described["reference."] = ("the photo's pose holds", "the photo does not show")
    for prefix, (holds, shows) in described.items():
        rotation = tensors[f"{prefix}rotation"].astype(np.float64)
        if np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation).min() < 0:
            raise ValueError(f"{path}: damaged: {holds} something that is no rotation")
        length = np.linalg.norm(tensors[f"{prefix}features"].astype(np.float32), axis=-1)[tensors[f"{prefix}valid"]]
        if length.size == 0:
            raise ValueError(f"{path}: {shows} any patch of the object")
        if np.abs(length - 1).max() > 1e-2:
            raise ValueError(f"{path}: damaged: {prefix}features of valid patches are not unit vectors")
    if "reference.rgb" in tensors and tensors["reference.focal"].min() <= 0:
        raise ValueError(f"{path}: damaged: the photo's camera has a focal length that is not positive")


def _read_tensors(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise ValueError(f"{path}: no such object file")
    types = {"F16": "float16", "F32": "float32", "BOOL": "bool", "U8": "uint8", "I32": "int32", "I64": "int64"}
    try:
        try:
            read_safetensors_header(path)
        except ValueError as error:
            raise ValueError(f"{path}: not an object file, or a damaged one ({error})") from None
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if "ipjax" not in metadata:
                raise ValueError(f"{path}: a safetensors file, but not an object file; make one with 'ipjax onboard'")
            header = _parse_header(metadata["ipjax"], path)
            names = file.keys()  # of a file that is no dictionary
            slices = {name: file.get_slice(name) for name in names}
            check_shapes(
                {
                    name: (types.get(str(s.get_dtype()), str(s.get_dtype())), tuple(s.get_shape()))
                    for name, s in slices.items()
                },
                str(path),
            )
            size = {"BOOL": 1, "U8": 1, "F16": 2, "I64": 8}
            needed = sum(size.get(str(s.get_dtype()), 4) * math.prod(s.get_shape()) for s in slices.values())
            check_budget(needed, f"{path}: the object")
            tensors = {name: file.get_tensor(name) for name in slices}
    except SafetensorError as error:
        raise ValueError(f"{path}: not an object file, or a damaged one ({str(error).splitlines()[0]})") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None
    placed = ("rotation", "translation", "focal", "centre")
    needed = ("extents", "axes", "mean", "basis", "surface.points", "deviation.along", "deviation.across")
    needed = (*placed, *needed, *(f"reference.{name}" for name in placed))
    for name in needed:
        if name in tensors and not np.isfinite(tensors[name]).all():
            raise ValueError(f"{path}: damaged: {name} has values that are not finite")
    return header, tensors


def _parse_header(text: str, path: Path) -> dict[str, Any]:
    try:
        header = parse_json(text)
    except ValueError as error:
        raise ValueError(f"{path}: damaged: its description is {error}") from None
    version = header.get("format") if isinstance(header, dict) else None
    if not isinstance(version, int):
        raise ValueError(f"{path}: damaged: its description has no format version")
    if version not in READABLE:
        advice = "a newer ipjax wrote it; upgrade ipjax" if version > FORMAT else "onboard the object again"
        raise ValueError(f"{path}: object file of format {version}, but this ipjax reads format {FORMAT}: {advice}")
    return header


def _make_info(header: dict[str, Any], tensors: dict[str, np.ndarray], path: Path) -> ObjectInfo:
    try:
        mesh = header["mesh"]
        scale, centre = float(mesh["scale"]), [float(x) for x in mesh["centre"]]
        if not (np.isfinite(scale) and scale > 0 and len(centre) == 3 and np.isfinite(centre).all()):
            raise ValueError("scale")
        unit = mesh.get("metres_per_unit")
        info = ObjectInfo(
            name=str(header["name"]),
            encoder=str(header["encoder"]),
            mesh_scale=scale,
            mesh_centre=(centre[0], centre[1], centre[2]),
            mesh_file=str(mesh.get("file", "")),
            mesh_sha256=str(mesh.get("sha256", "")),
            metres_per_unit=None if unit is None else float(unit),
            config=dict(header.get("config", {})),
            notes=tuple(str(note) for note in header.get("notes", ())),
            resolution=int(header["resolution"]),
            reference=_make_reference(header, tensors),
            content_sha256=str(header.get("content_sha256", "")),
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        raise ValueError(f"{path}: damaged: its description lacks the mesh, the encoder or the name") from None
    vertices, faces = tensors.get("mesh.vertices"), tensors.get("mesh.faces")
    if vertices is None or faces is None or len(vertices) == 0:
        vertices = faces = None
    elif faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"{path}: damaged: faces of the mesh refer to vertices that do not exist")
    pictures = None
    if "pictures" in tensors and "pictures.end" in tensors:
        blob, end = tensors["pictures"], tensors["pictures.end"]
        if end[0] < 0 or (np.diff(end) < 0).any() or end[-1] != len(blob):
            raise ValueError(f"{path}: damaged: the template pictures do not end where they should")
        start = np.concatenate([[0], end[:-1]])
        pictures = [blob[a:b].tobytes() for a, b in zip(start, end, strict=True)]
    return dataclasses.replace(
        info,
        vertices=vertices,
        faces=faces,
        colours=None if vertices is None else tensors.get("mesh.colours"),
        pictures=pictures,
    )


def _make_reference(header: dict[str, Any], tensors: dict[str, np.ndarray]) -> Reference | None:
    entry = header.get("reference")
    if entry is None:
        return None
    return Reference.from_json(entry, tensors["photo"].tobytes() if "photo" in tensors else None)

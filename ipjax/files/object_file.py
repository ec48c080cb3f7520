"""The object file: an onboarded object as one portable safetensors file.

Layout: one safetensors file (https://github.com/huggingface/safetensors). Its metadata holds one JSON text under the
key ``ipjax``: format version, who the object and the encoder are, how the normalised object frame lies in the user's
mesh, and a checksum. Tensors, for v templates of p patches with c channels:

    features f16 [v p f] · mean f32 [c] · norm f32 [v p] · basis f32 [f c]          without the optional basis f = c
    points f32 [v p 3] · grid f32 [v p 2] · valid bool [v p] · seen f32 [v p]
    rotation f32 [v 3 3] · translation f32 [v 3] · focal, centre f32 [v 2]           camera_from_object and its camera
    surface.points, surface.normals f32 [n 3] · surface.seen f32 [n] · extents f32 [3] · axes f32 [3 3]
    appearance.points, appearance.normals f16 [m 3] · appearance.colours u8 [m 3]    optional, to draw candidates from
    mesh.vertices f32 [a 3] · mesh.faces i32 [b 3] · mesh.colours u8 [a 3]           optional, for pictures
    pictures u8 [bytes] · pictures.end i64 [v]                                       optional, one JPEG per template
    photo u8 [bytes]                                                                 optional, JPEG of the reference

Lengths are model units: the object's bounding box is centred at the origin and its diameter is 1.
"""

import dataclasses
import hashlib
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ipjax.estimation.features import identity_of
from ipjax.files.storage.budget import check_budget, read_safetensors_header
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import writing
from ipjax.records import UNNAMED, Appearance, Camera, Patches, Similarity, Surface, Templates

FORMAT = 1
SUFFIX = ".ipjax"
_PICTURE = 160  # pixels, longest side of a stored template image
_LARGEST = 1024  # of one that is read

_TEMPLATE_TENSORS = {
    "features": ("float16", "vpf"),
    "points": ("float32", "vp3"),
    "grid": ("float32", "vp2"),
    "valid": ("bool", "vp"),
    "mean": ("float32", "c"),
    "norm": ("float32", "vp"),
    "seen": ("float32", "vp"),
    "rotation": ("float32", "v33"),
    "translation": ("float32", "v3"),
    "focal": ("float32", "v2"),
    "centre": ("float32", "v2"),
    "surface.points": ("float32", "n3"),
    "surface.normals": ("float32", "n3"),
    "surface.seen": ("float32", "n"),
    "extents": ("float32", "3"),
    "axes": ("float32", "33"),
}
_OPTIONAL_TENSORS = {
    "basis": ("float32", "fc"),
    "appearance.points": ("float16", "m3"),
    "appearance.normals": ("float16", "m3"),
    "appearance.colours": ("uint8", "m3"),
    "mesh.vertices": ("float32", "a3"),
    "mesh.faces": ("int32", "b3"),
    "mesh.colours": ("uint8", "a3"),
    "pictures": ("uint8", "j"),
    "pictures.end": ("int64", "v"),
    "photo": ("uint8", "i"),
}


@dataclasses.dataclass(frozen=True)
class Reference:
    """The photo that an object was made from, and where its camera stood.

    Args:
        file, sha256: of the photo; no folders.
        rotation, translation, scale: ``camera_from_mesh``, x_camera = scale * rotation @ x_mesh + translation; metres
            where `metric`, else in the arbitrary unit of the reconstruction.
        focal, centre, size: of the photo's camera, given or assumed; pixels of the photo as it was read.
        camera_given: the camera was told, not assumed.
        metric: the photo had depth, so the mesh is in metres and its size was measured.
        method: who made the mesh: "depth", "inflate" or "triposr".
        seen: share of the surface that the photo shows; the rest is guessed.
        picture: a small JPEG of the photo; None = not kept.
    """

    file: str
    sha256: str
    rotation: np.ndarray  # 3 × 3
    translation: np.ndarray
    scale: float
    focal: tuple[float, float]
    centre: tuple[float, float]
    size: tuple[int, int]  # width, height
    camera_given: bool
    metric: bool
    method: str
    seen: float
    picture: bytes | None = None

    @property
    def camera_from_mesh(self) -> Similarity:
        """The photo's camera from the coordinates of the reconstructed mesh."""
        values = (self.rotation, self.translation, self.scale)
        return Similarity(*(jnp.asarray(x, jnp.float32) for x in values))

    def as_json(self) -> dict[str, Any]:
        """As the header holds it: without the picture."""
        told = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "picture"}
        return (
            told
            | {"rotation": np.asarray(self.rotation, float).tolist()}
            | {"translation": np.asarray(self.translation, float).tolist()}
        )

    @staticmethod
    def from_json(told: dict[str, Any], picture: bytes | None = None) -> "Reference":
        """The inverse of `as_json`. Raises KeyError, TypeError or ValueError for anything else."""
        rotation = np.asarray(told["rotation"], np.float64).reshape(3, 3)
        translation = np.asarray(told["translation"], np.float64).reshape(3)
        scale, numbers = float(told["scale"]), [float(x) for x in (*told["focal"], *told["centre"])]
        if not (np.isfinite([*rotation.ravel(), *translation, scale, *numbers]).all() and scale > 0):
            raise ValueError("the reference camera is not finite")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
            raise ValueError("the reference camera's pose is no rotation")
        return Reference(
            file=str(told["file"]),
            sha256=str(told["sha256"]),
            rotation=rotation,
            translation=translation,
            scale=scale,
            focal=(numbers[0], numbers[1]),
            centre=(numbers[2], numbers[3]),
            size=(int(told["size"][0]), int(told["size"][1])),
            camera_given=bool(told["camera_given"]),
            metric=bool(told["metric"]),
            method=str(told["method"]),
            seen=float(told["seen"]),
            picture=picture,
        )


@dataclasses.dataclass(frozen=True)
class ObjectInfo:
    """What is known about an onboarded object besides its templates.

    Args:
        name: of the object.
        encoder: `Encoder.identity` of the encoder that described the templates.
        mesh_scale: model units per unit of the mesh file (1 / the diameter there).
        mesh_centre: the object frame's origin in the mesh file's frame, in its units.
        mesh_file: name of the mesh file, without folders.
        mesh_sha256: of the mesh file.
        metres_per_unit: of the mesh file, where the user said so; None = unknown.
        config: how it was onboarded, as JSON can say it.
        notes: what the readers and repairers had to say.
        resolution: side of the template images in pixels.
        vertices, faces, colours: the normalised mesh, for pictures; None = not kept.
        pictures: the template images ``[v h w 3]`` uint8, or the JPEG bytes of each; None = not kept.
        reference: the photo it was made from; None = made from a mesh.
        content_sha256: of the object file it was read from, as its header says; `check` compares.
    """

    name: str
    encoder: str
    mesh_scale: float = 1.0
    mesh_centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mesh_file: str = ""
    mesh_sha256: str = ""
    metres_per_unit: float | None = None
    config: dict[str, Any] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()
    resolution: int = 224
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    colours: np.ndarray | None = None
    pictures: Any = None
    reference: Reference | None = None
    content_sha256: str = ""

    @property
    def measured_diameter(self) -> float | None:
        """The object's diameter in metres, where its reference photo had depth; None = free."""
        if self.reference is None or not self.reference.metric or self.metres_per_unit is None:
            return None
        return self.metres_per_unit / self.mesh_scale

    @property
    def object_from_mesh(self) -> Similarity:
        """Model units from the coordinates of the user's mesh file."""
        scale = jnp.asarray(self.mesh_scale, jnp.float32)
        return Similarity(
            rotation=jnp.eye(3, dtype=jnp.float32),
            translation=jnp.asarray(-self.mesh_scale * np.asarray(self.mesh_centre, np.float64), jnp.float32),
            scale=scale,
        )

    def picture(self, view: int) -> np.ndarray | None:
        """The image of one template, uint8 ``[h w 3]``; None where none was kept."""
        if self.pictures is None:
            return None
        if isinstance(self.pictures, np.ndarray):
            return self.pictures[view]
        return _decode(self.pictures[view])


def save(path: str | Path, templates: Templates, info: ObjectInfo) -> Path:
    """Write an object file; the file appears whole or not at all.

    Args:
        path: usually ending in ``.ipjax``; an existing file is replaced.
        templates: of one object, not batched. Features are stored as float16.

    Raises:
        ValueError: the templates are no single object's, or hold numbers that are not finite.
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
    if templates.appearance is not None:
        tensors |= {
            "appearance.points": templates.appearance.points,
            "appearance.normals": templates.appearance.normals,
            "appearance.colours": np.round(255 * np.asarray(templates.appearance.colours)),
        }
    if np.ndim(patches.features) != 3:
        raise ValueError(
            f"templates of one object have features [views, patches, channels], not {patches.features.shape}"
        )
    if not np.allclose(pose.scale, 1):
        raise ValueError("the poses of templates must have scale 1")
    if info.vertices is not None and info.faces is not None:
        vertices, faces, colours = _simplify(info.vertices, info.faces, info.colours)
        tensors |= {"mesh.vertices": vertices, "mesh.faces": faces}
        if colours is not None:
            tensors["mesh.colours"] = colours
    if info.pictures is not None:
        pictures = _compress(info.pictures)
        tensors["pictures"] = np.frombuffer(b"".join(pictures), np.uint8)
        tensors["pictures.end"] = np.cumsum([len(picture) for picture in pictures])
    if info.reference is not None and info.reference.picture:
        tensors["photo"] = np.frombuffer(info.reference.picture, np.uint8)
    kinds = _TEMPLATE_TENSORS | _OPTIONAL_TENSORS
    tensors = {name: np.ascontiguousarray(np.asarray(array), kinds[name][0]) for name, array in tensors.items()}
    _check_shapes({name: (array.dtype.name, array.shape) for name, array in tensors.items()}, str(path))
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
    header = json.loads(json.dumps(header, allow_nan=False))
    text = json.dumps(header | {"content_sha256": _hash(header, tensors)})
    with writing(path) as temporary:
        save_file(tensors, temporary, metadata={"ipjax": text})
    return path


def compact(templates: Templates, *, multiple: int = 32) -> Templates:
    """Templates with fewer patches each, and the same answers: most of an image is background.

    The valid patches come first, in their old order, then as many others as make all templates alike: a multiple of
    ``multiple``. At least one of the others stays, the last of the grid unless that is valid, so that ``grid`` still
    tells how large it is. To be done once, before ``estimate``; an object file keeps every patch.

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
    they rank behind all others and lend no features. Surface and appearance points repeat the first one without a
    normal: they face no camera, so nothing is fitted to them and they are not drawn, and no outline is wider for them.
    An object gives the same answer as alone, up to rounding, if it has no fewer views than ``config.match.views`` and
    no fewer surface points than ``config.refine.points``; with fewer, it is tried and refined as often as the others.

    Args:
        objects: each as ``load`` or ``onboard`` return it, or after ``compact``; not batched.

    Returns:
        Templates with a leading axis of the objects.

    Raises:
        ValueError: there is none, or they are not alike: of different encoders, features of different lengths, or some
            with a basis or an appearance and some without.
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
    encoders = sorted({o.patches.encoder for o in objects if o.patches.encoder is not None})
    if len(encoders) > 1:
        raise ValueError(f"these objects were onboarded with different encoders: {', '.join(map(repr, encoders))}")
    objects = [dataclasses.replace(o, patches=dataclasses.replace(o.patches, encoder=None)) for o in objects]
    for name in ("basis", "appearance"):
        if len({getattr(o, name) is None for o in objects}) > 1:
            raise ValueError(f"some of these templates have their {name} and some have none; onboard them alike")
    views, patches = (max(o.norm.shape[axis] for o in objects) for axis in (0, 1))
    count = max(o.surface.points.shape[0] for o in objects)
    drawn = max(0 if o.appearance is None else o.appearance.points.shape[0] for o in objects)
    padded = [_pad(o, views, patches, count, drawn) for o in objects]
    stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(one, jnp.result_type(*x)) for one in x]), *padded)
    patches = dataclasses.replace(stacked.patches, encoder=encoders[0] if encoders else None)
    return dataclasses.replace(stacked, patches=patches)


def _pad(templates: Templates, views: int, patches: int, count: int, drawn: int) -> Templates:
    """One object's templates with so many views, patches in each, and points of surface and appearance."""

    def grown(array: Any, *sizes: int, repeat: int | None = None):
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
        more = {name: grown(value, size) for name, value in fields.items() if name != "points"}
        return type(record)(points=grown(record.points, size, repeat=0), **more)

    last = lambda tree: jax.tree.map(lambda x: grown(x, views, repeat=-1), tree)
    return dataclasses.replace(
        templates,
        patches=jax.tree.map(lambda x: grown(x, views, patches), templates.patches),
        norm=grown(templates.norm, views, patches),
        seen=grown(templates.seen, views, patches),
        camera_from_object=last(templates.camera_from_object),
        camera=last(templates.camera),
        surface=points(templates.surface, count),
        appearance=None if templates.appearance is None else points(templates.appearance, drawn),
    )


def load(path: str | Path, encoder: Any = None) -> tuple[Templates, ObjectInfo]:
    """Read an object file.

    Args:
        encoder: the encoder that will describe queries. None, or one without an ``identity``, is not compared.

    Raises:
        ValueError: missing, damaged, of another version, or made by another encoder; one sentence that names the file.
    """
    header, tensors = _read(Path(path))
    info = _info(header, tensors, Path(path))
    made_by, given = None if info.encoder in ("", UNNAMED) else info.encoder, identity_of(encoder)
    if made_by and given and made_by != given:
        raise ValueError(
            f"{path}: made with the encoder '{made_by}', but the one at hand is '{given}'; "
            "onboard the object again, or give the weights it was made with"
        )
    device = {name: jnp.asarray(tensors[name]) for name in _TEMPLATE_TENSORS}
    views = len(tensors["rotation"])
    return (
        Templates(
            patches=Patches(
                features=device["features"],
                points=device["points"],
                grid=device["grid"],
                valid=jnp.asarray(tensors["valid"] & _is_finite(tensors)),
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
            surface=Surface(
                points=device["surface.points"], normals=device["surface.normals"], seen=device["surface.seen"]
            ),
            extents=device["extents"],
            axes=device["axes"],
            basis=jnp.asarray(tensors["basis"]) if "basis" in tensors else None,
            appearance=_appearance(tensors),
        ),
        info,
    )


def _is_finite(tensors: dict[str, np.ndarray]) -> np.ndarray:
    """Which patches have no number that is not finite; the others are not valid."""
    known = np.isfinite(tensors["norm"])
    for name in ("features", "points", "grid"):
        known = known & np.isfinite(tensors[name]).all(axis=-1)
    return known


def _appearance(tensors: dict[str, np.ndarray]) -> Appearance | None:
    if "appearance.points" not in tensors:
        return None
    return Appearance(
        points=jnp.asarray(tensors["appearance.points"], jnp.float32),
        normals=jnp.asarray(tensors["appearance.normals"], jnp.float32),
        colours=jnp.asarray(tensors["appearance.colours"].astype(np.float32) / 255),
    )


def check(path: str | Path) -> list[str]:
    """Read an object file to its last byte and say what it holds.

    Returns:
        Sentences for a person: the object, its size, who made it, what was noted.

    Raises:
        ValueError: as `load`, or the content is not what was written, or cannot be true.
    """
    path = Path(path)
    header, tensors = _read(path)
    info = _info(header, tensors, path)
    if _hash(header, tensors) != header.get("content_sha256"):
        raise ValueError(f"{path}: damaged: the content does not have the checksum in its header")
    for name, array in tensors.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{path}: damaged: {name} has values that are not finite")
    rotation = tensors["rotation"].astype(np.float64)
    if np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation).min() < 0:
        raise ValueError(f"{path}: damaged: the template poses hold something that is no rotation")
    length = np.linalg.norm(tensors["features"].astype(np.float32), axis=-1)[tensors["valid"]]
    if length.size == 0:
        raise ValueError(f"{path}: no template shows any patch of the object")
    if np.abs(length - 1).max() > 1e-2:
        raise ValueError(f"{path}: damaged: features of valid patches are not unit vectors")
    views, patches, channels = tensors["features"].shape
    seen = tensors["valid"].sum(axis=1).mean()
    size = 1 / info.mesh_scale
    unit = f" ({size * info.metres_per_unit * 1e3:.1f} mm)" if info.metres_per_unit else ", unit unknown"
    photo = info.reference
    made = [] if photo is None else [f"made from the photo by {photo.method}; {photo.seen:.0%} of its surface was seen"]
    return [
        f"object {info.name!r} from {info.mesh_file or 'a mesh'} (sha256 {info.mesh_sha256[:12] or 'unknown'})",
        f"diameter {size:g} in the mesh's unit{unit}",
        f"{views} templates of {patches} patches with {channels} channels; {seen:.0f} valid each",
        f"encoder {info.encoder}",
        f"written by {header.get('writer', 'an unknown writer')}, format {header['format']}, content as written",
        *made,
        *info.notes,
    ]


def _version() -> str:
    from ipjax import __version__

    return __version__


def _hash(header: dict[str, Any], tensors: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(tensors):
        array = tensors[name]
        digest.update(f"{name} {array.dtype.name} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    digest.update(json.dumps({k: v for k, v in header.items() if k != "content_sha256"}, sort_keys=True).encode())
    return digest.hexdigest()


def _check_shapes(found: dict[str, tuple[str, tuple[int, ...]]], where: str) -> None:
    """Names, types and shapes fit one another; letters stand for one length each."""
    missing = sorted(_TEMPLATE_TENSORS.keys() - found.keys())
    unknown = sorted(found.keys() - _TEMPLATE_TENSORS.keys() - _OPTIONAL_TENSORS.keys())
    if missing or unknown:
        what = f"{missing[0]} is missing" if missing else f"{unknown[0]!r} is unknown"
        raise ValueError(f"{where}: not an object file: {what}")
    lengths: dict[str, int] = {}
    for name, (dtype, shape) in found.items():
        kind, letters = (_TEMPLATE_TENSORS | _OPTIONAL_TENSORS)[name]
        fits = dtype == kind and len(shape) == len(letters)
        if fits:
            for letter, length in zip(letters, shape, strict=True):
                expected = int(letter) if letter.isdigit() else lengths.setdefault(letter, length)
                fits = fits and length == expected and (length > 0 or letter in "abij")
        if not fits:
            raise ValueError(f"{where}: not a usable object: {name} is {dtype} {list(shape)}")
    if "basis" not in found and lengths["f"] != lengths["c"]:
        shape = list(found["features"][1])
        raise ValueError(f"{where}: not a usable object: features {shape} have no basis and a mean of {lengths['c']}")


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
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
            _check_shapes(
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
    for name in ("rotation", "translation", "focal", "centre", "extents", "axes", "mean", "basis", "surface.points"):
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
    if version != FORMAT:
        advice = "a newer ipjax wrote it; upgrade ipjax" if version > FORMAT else "onboard the object again"
        raise ValueError(f"{path}: object file of format {version}, but this ipjax reads format {FORMAT}: {advice}")
    return header


def _info(header: dict[str, Any], tensors: dict[str, np.ndarray], path: Path) -> ObjectInfo:
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
            reference=_reference(header, tensors),
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


def _reference(header: dict[str, Any], tensors: dict[str, np.ndarray]) -> Reference | None:
    told = header.get("reference")
    if told is None:
        return None
    return Reference.from_json(told, tensors["photo"].tobytes() if "photo" in tensors else None)


def _decode(picture: bytes) -> np.ndarray | None:
    """A JPEG as RGB; None where it is none, or promises more pixels than a picture here can have."""
    import cv2
    from PIL import Image

    try:
        with Image.open(io.BytesIO(picture), formats=["JPEG"]) as image:
            if max(image.size) > _LARGEST:
                return None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def _compress(pictures: Any) -> list[bytes]:
    if not isinstance(pictures, np.ndarray):
        return [bytes(picture) for picture in pictures]
    import cv2

    if pictures.ndim != 4 or pictures.shape[-1] != 3 or pictures.dtype != np.uint8:
        raise ValueError(
            f"pictures must be uint8 [views, height, width, 3], not {pictures.dtype} {list(pictures.shape)}"
        )
    compressed = []
    for picture in pictures:
        zoom = _PICTURE / max(picture.shape[:2])
        if zoom < 1:
            picture = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
        _, code = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 90])
        compressed.append(code.tobytes())
    return compressed


def _simplify(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None, most: int = 60_000):
    """A mesh good enough for outlines: vertices in one cell of a grid become one, until few enough faces remain."""
    vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.int64)
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError("faces of the mesh refer to vertices that do not exist")
    if colours is not None and len(colours) != len(vertices):
        raise ValueError(f"the mesh has {len(vertices)} vertices but {len(colours)} colours")
    cells = 192.0
    original = (vertices, faces, colours)
    while len(faces) > most and cells >= 24:
        vertices, faces, colours = original
        key = np.floor(vertices * cells).astype(np.int64)
        _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
        index = index.reshape(-1)
        count = np.bincount(index).astype(np.float32)
        vertices = np.stack([np.bincount(index, weights=vertices[:, k]) / count for k in range(3)], axis=-1)
        colours = None if colours is None else np.asarray(colours)[first]
        faces = index[faces]
        real = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces = np.unique(faces[real], axis=0)
        cells *= 0.75
    return vertices.astype(np.float32), faces.astype(np.int32), colours

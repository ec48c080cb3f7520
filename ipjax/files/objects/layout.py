"""How an object file is laid out: names, types and shapes of its tensors, and the checksum of its content.

One safetensors file (https://github.com/huggingface/safetensors). Its metadata holds one JSON text under the
key ``ipjax``: format version, names of the object and the encoder, how the normalised object frame lies in the user's
mesh, and a checksum. Tensors, for v templates of p patches with c channels, and a photo of s² pixels and q patches:

    features f16 [v p f] · mean f32 [c] · norm f32 [v p] · basis f32 [f c]          without the optional basis f = c
    points f32 [v p 3] · grid f32 [v p 2] · valid bool [v p] · seen f32 [v p]
    rotation f32 [v 3 3] · translation f32 [v 3] · focal, centre f32 [v 2]           camera_from_object and its camera
    surface.points, surface.normals f32 [n 3] · surface.seen f32 [n] · extents f32 [3] · axes f32 [3 3]
    deviation.along, deviation.across f32 [n]                                        optional, of an object from a photo
    appearance.points, appearance.normals f16 [m 3] · appearance.colours u8 [m 3]    optional, to draw candidates from
    mesh.vertices f32 [a 3] · mesh.faces i32 [b 3] · mesh.colours u8 [a 3]           optional, for pictures
    pictures u8 [bytes] · pictures.end i64 [v]                                       optional, one JPEG per template
    photo u8 [bytes]                                                                 optional, JPEG of the reference
    photo_centre f32 [3]                                             optional, of a mesh that was made from it elsewhere
    reference.rgb u8 [s s 3] · reference.depth f32 [s s] · reference.mask bool [s s] optional, to find poses through
    reference.features f16 [q f] · reference.points f32 [q 3] · reference.grid f32 [q 2] · reference.valid bool [q]
    reference.rotation f32 [3 3] · reference.translation f32 [3] · reference.focal, reference.centre f32 [2]

Lengths are model units: the object's bounding box is centred at the origin and its diameter is 1. Of the tensors under
``appearance.``, ``deviation.`` and ``reference.`` a file holds all or none each. The last are the photo that the
object was made from, as ``ipjax.records.ReferenceView`` has it: a square crop with the depth of the reconstruction's
front, its patches in the object's frame, and ``camera_from_object`` with its camera. ``depth_measured`` in the metadata
tells whether that depth was measured or guessed. ``photo`` is there for people, with or without them. Templates saved
after ``ipjax.compact`` have fewer patches than the photo, which keeps all of its own.

``deviation.`` tells how far each point of the surface may be off, along the ray of the photo's camera and across it
(standard deviations, ``Surface.along_std`` and ``across_std``).

Format 1 had no ``reference.`` tensors; its files are read as they are, and have no reference view. Format 2 had them of
photos without depth only, and no ``depth_measured``. Neither had ``photo_centre``. Up to format 3 nothing said how far
points may be off: what is now assumed of the method that made the object is filled in when such a file is read
(`ipjax.files.objects.deviations`).
"""

import hashlib
import json
from typing import Any

import numpy as np

FORMAT = 4  # the one written
READABLE = (1, 2, 3, FORMAT)
SUFFIX = ".ipjax"

TEMPLATE_TENSORS = {
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
OPTIONAL_TENSORS = {
    "basis": ("float32", "fc"),
    "deviation.along": ("float32", "n"),
    "deviation.across": ("float32", "n"),
    "appearance.points": ("float16", "m3"),
    "appearance.normals": ("float16", "m3"),
    "appearance.colours": ("uint8", "m3"),
    "mesh.vertices": ("float32", "a3"),
    "mesh.faces": ("int32", "b3"),
    "mesh.colours": ("uint8", "a3"),
    "pictures": ("uint8", "j"),
    "pictures.end": ("int64", "v"),
    "photo": ("uint8", "i"),
    "photo_centre": ("float32", "3"),
    "reference.rgb": ("uint8", "ss3"),
    "reference.depth": ("float32", "ss"),
    "reference.mask": ("bool", "ss"),
    "reference.features": ("float16", "qf"),
    "reference.points": ("float32", "q3"),
    "reference.grid": ("float32", "q2"),
    "reference.valid": ("bool", "q"),
    "reference.rotation": ("float32", "33"),
    "reference.translation": ("float32", "3"),
    "reference.focal": ("float32", "2"),
    "reference.centre": ("float32", "2"),
}
_WHOLE = ("appearance.", "deviation.", "reference.")  # a file holds all of these tensors or none


def hash_content(header: dict[str, Any], tensors: dict[str, np.ndarray]) -> str:
    """The sha256 of a header (without its own entry) and of all tensors, in hexadecimal."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        array = tensors[name]
        digest.update(f"{name} {array.dtype.name} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    digest.update(json.dumps({k: v for k, v in header.items() if k != "content_sha256"}, sort_keys=True).encode())
    return digest.hexdigest()


def check_shapes(found: dict[str, tuple[str, tuple[int, ...]]], where: str) -> None:
    """Names, types and shapes fit one another; letters stand for one length each."""
    needed = set(TEMPLATE_TENSORS)
    for prefix in _WHOLE:
        if any(name.startswith(prefix) for name in found):
            needed |= {name for name in OPTIONAL_TENSORS if name.startswith(prefix)}
    missing = sorted(needed - found.keys())
    unknown = sorted(found.keys() - TEMPLATE_TENSORS.keys() - OPTIONAL_TENSORS.keys())
    if missing or unknown:
        what = f"{missing[0]} is missing" if missing else f"{unknown[0]!r} is unknown"
        raise ValueError(f"{where}: not an object file: {what}")
    lengths: dict[str, int] = {}
    for name, (dtype, shape) in found.items():
        kind, letters = (TEMPLATE_TENSORS | OPTIONAL_TENSORS)[name]
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

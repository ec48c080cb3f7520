"""MTL: the colours and images of OBJ files' materials, in any encoding."""

import dataclasses
from pathlib import Path

import numpy as np

from ipjax.files.meshes.formats.source import BYTE_ORDER_MARK, LFS_POINTER, Source

# Options of map_Kd and how many words follow at most; numbers are taken as long as there are any.
NUMBERS = {b"-s": 3, b"-o": 3, b"-t": 3, b"-mm": 2, b"-bm": 1, b"-boost": 1, b"-texres": 1}
WORDS = {b"-blendu": 1, b"-blendv": 1, b"-cc": 1, b"-clamp": 1, b"-imfchan": 1, b"-type": 1, b"-colorspace": 1}


@dataclasses.dataclass
class Material:
    """Colour and image of one material."""

    colour: tuple[float, float, float] | None = None  # Kd, sRGB as it is
    image: bytes | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamp: bool = False


def find_materials(source: Source, libraries: list[bytes], wanted: dict[bytes, int]) -> dict[int, Material]:
    """The materials that faces use, by number; of the MTL file with the mesh's name where its own are missing."""
    found: dict[bytes, Material] = {}
    read: set[Path] = set()
    missing = []
    for line in libraries[:64]:
        path = source.find(line)
        paths = [path] if path is not None else [source.find(name) for name in line.split()]  # several in one line
        if None in paths or not paths:
            missing.append(line.decode("utf-8", "replace")[:200])
        for path in paths:
            if path is not None and path not in read:
                read.add(path)
                found.update(read_mtl(source, path))
    if missing and not found:
        beside = source.find(source.path.stem + ".mtl")
        if beside is not None:
            found.update(read_mtl(source, beside))
        else:
            source.warn(f"{missing[0]} is named but missing")
    return {number: found[name] for name, number in wanted.items() if name in found}


def read_mtl(source: Source, path: Path) -> dict[bytes, Material]:
    """The materials of an MTL file by their names, which are compared as bytes."""
    data = source.read_companion(path).removeprefix(BYTE_ORDER_MARK)
    source.take(4 * len(data), path.name)
    found: dict[bytes, Material] = {}
    if data.startswith(LFS_POINTER):
        source.warn(f"{path.name} is a Git LFS pointer, not the materials (git lfs pull fetches it)")
        return found
    current = Material()
    fallback: dict[int, bytes] = {}
    for line in data.replace(b"\\\n", b" ").splitlines():
        words = line.split(None, 1)
        if len(words) < 2:
            continue
        key, rest = words[0].lower(), words[1].strip()
        if key == b"newmtl":
            current = found.setdefault(rest, Material())
        elif key == b"kd":
            try:
                values = [float(word) for word in rest.split()[:3]]
            except ValueError:
                continue
            values = values * 3 if len(values) == 1 else values
            if len(values) == 3 and np.isfinite(values).all():
                current.colour = (values[0], values[1], values[2])
        elif key == b"map_kd":
            read_map(current, rest)
        elif key in (b"map_ka", b"map_ke") and id(current) not in fallback:
            fallback[id(current)] = rest
    for material in found.values():
        if material.image is None and id(material) in fallback:
            read_map(material, fallback[id(material)])
    return found


def read_map(material: Material, text: bytes) -> None:
    """An image's name behind its options."""
    words = text.split()
    at = 0
    while at < len(words) - 1 and words[at].lower() in NUMBERS | WORDS:
        option = words[at].lower()
        at += 1
        if option in WORDS:
            if option == b"-clamp":
                material.clamp = words[at].lower() == b"on"
            at += 1
            continue
        values = []
        while at < len(words) - 1 and len(values) < NUMBERS[option]:
            try:
                values.append(float(words[at]))
            except ValueError:
                break
            at += 1
        if option in (b"-s", b"-o") and values and np.isfinite(values).all():
            pair = (values[0], values[1] if len(values) > 1 else (1.0 if option == b"-s" else 0.0))
            if option == b"-s":
                material.scale = pair
            else:
                material.offset = pair
    name = text
    for word in words[:at]:  # the name itself may have blanks
        name = name[name.index(word) + len(word) :]
    material.image = name.strip()

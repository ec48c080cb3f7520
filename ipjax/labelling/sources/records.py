"""What every source of frames has: the keys of its frames, in an order of its own, and one frame when asked for it."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8


class SourceError(ValueError):
    """A source that cannot be read at all: one sentence that says what was found and what to do."""


@dataclasses.dataclass(frozen=True)
class FrameKey:
    """A frame by its numbers, as BOP's files want them, and by its name, which is its id."""

    scene: int
    image: int
    name: str


@dataclasses.dataclass(frozen=True)
class SourceFrame:
    """One frame, without lens distortion."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # along z, metres; 0 = unknown
    camera: Float[np.ndarray, "3 3"]  # K, pixels
    # What is visible of objects, and the place of each among the objects; None = nothing says where they are.
    masks: tuple[tuple[int, Bool[np.ndarray, "h w"]], ...] | None
    file: str  # of the colours, relative to the source


@runtime_checkable
class Source(Protocol):
    """Frames that are read when asked for, from several threads at once."""

    kind: str  # in words
    path: Path

    def keys(self) -> Sequence[FrameKey]:
        """Every frame, always in the same order; names differ. Raises SourceError."""
        ...

    def read(self, key: FrameKey) -> SourceFrame:
        """One frame. Raises ValueError or OSError, in words, where it cannot be used."""
        ...

    def identity(self) -> dict[str, Any]:
        """What tells this source from another of the same keys, as plain JSON; the place where it lies does not."""
        ...


def hash_keys(keys: Iterable[FrameKey]) -> str:
    """Sixteen digits of the frames and their order."""
    digest = hashlib.sha256()
    for key in keys:
        digest.update(f"{key.scene} {key.image} {key.name}\n".encode())
    return digest.hexdigest()[:16]


def hash_plain(value: Any) -> str:
    """Sixteen digits of plain JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def number_frames(names: Iterable[str]) -> list[FrameKey]:
    """Keys of frames that have only names: scene 0, and the number that the name is or, where some name is none or two
    are the same, the place."""
    names = list(names)
    numbers = [int(name) for name in names if name.isdecimal()]
    if len(set(numbers)) != len(names):
        numbers = list(range(len(names)))
    return [FrameKey(0, number, name) for number, name in zip(numbers, names, strict=True)]

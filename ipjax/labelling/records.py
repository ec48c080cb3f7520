"""What a batch of frames holds before and after it is labelled, and how it is to be done."""

import dataclasses
import hashlib
from typing import Any, Literal

import numpy as np

from ipjax.config import Config, DetectConfig

Batch = dict[str, Any]
"""A batch of n frames by the names of its columns; each has n rows, arrays or, where frames differ in size, lists.

Given:
    id: names of the frames, each its own; random numbers depend on them, and on nothing else in the batch.
    rgb: ``[n h w 3]`` uint8.
    depth: ``[n h w]`` along z, aligned to the colours; floats in metres, 0 = unknown.
    camera: ``[n 3 3]`` K, pixels; images are without lens distortion.
    mask: ``[n i h w]`` bool, of what is visible of an instance; may be left out.
    box: ``[n i 4]`` x, y, width, height in pixels, instead of masks.
    object: ``[n i]`` the place of each mask's or box's object among the objects, −1 = there is none; default: the
        masks are as many as the objects and in their order.

Where there are neither masks nor boxes, every object is sought in every frame; there are then as many instances i as
objects, times the instances sought of each.

Made:
    id: as given.
    error: ``[n]`` "" or, where a frame cannot be used, a sentence that says why; it then has no instances.
    object: ``[n i]`` as given; −1 where nothing was found.
    success: ``[n i]`` a pose was found.
    present: ``[n i]`` it is to be believed; without it a guess.
    camera_from_mesh: ``[n i 4 4]`` the pose of the mesh file: x_camera = matrix @ (x_mesh, 1), metres; it contains the
        size, [scale · rotation, translation]. NaN where no pose was found, as in all that follows.
    diameter, diameter_std: ``[n i]`` of the object, metres.
    confidence: ``[n i]`` probability that the pose is right; 0 where none was found.
    margin: ``[n i]`` by how much the next pose that differs is worse: 1 = nothing comes near, 0 = a tie.
    covariance: ``[n i 6 6]`` of rotation vector (rad, about the object's centre) and translation (m), camera axes.
    mask: ``[n i]`` COCO's run lengths as text, of what the image shows of the object at its pose; "" = nothing.
    outline_pixels: ``[n i]`` of the whole outline in the image, hidden parts included.
    box: ``[n i 4]`` of that mask, whole pixels; 0 where it is empty.
    overlap: ``[n i]`` intersection over union of that mask and the given one; NaN where there was none.
    note: ``[n i]`` why an instance has no pose, or what makes it doubtful; "" = nothing.
    size: ``[n 2]`` height and width of the image.
    seconds: ``[n]`` that the frame took, its share of what was done for several at once.
"""


@dataclasses.dataclass(frozen=True)
class LabelSettings:
    """How frames are labelled, beside the `Config` of the estimates.

    Args:
        seed: same seed, same answers.
        crop: how a query is cut out.
        instances: of each object, most that are sought where no masks are given; None = as many as there are.
        detection: how they are sought.
        seeking: settings of the estimates that verify where they are; None = `Config.fast`.
        free_size: estimate the size also of objects whose reference photo measured it.
        buckets: numbers of crops that a program is compiled for; a group of crops is cut into these and padded with
            repeats. None = one crop at a time on a CPU, up to 8 elsewhere; as many for each device where a process has
            several. A bucket that is a multiple of the number of devices is divided among them.
        threads: crops, or buckets of them, that are worked on at the same time; None = one for each core, at most 4.
    """

    seed: int = 0
    crop: Literal["square", "look_at"] = "square"
    instances: int | None = 1
    detection: DetectConfig = DetectConfig()
    seeking: Config | None = None
    free_size: bool = False
    buckets: tuple[int, ...] | None = None
    threads: int | None = None

    def __post_init__(self):
        if self.buckets is not None and not (self.buckets and all(one >= 1 for one in self.buckets)):
            raise ValueError(f"buckets are numbers of crops from 1 on, not {self.buckets}")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"at least one thread is needed, not {self.threads}")
        if self.instances is not None and self.instances < 1:
            raise ValueError(f"at least one instance must be sought, not {self.instances}")

    @property
    def most(self) -> int:
        """Instances of an object that a frame has at most where they are sought."""
        return self.detection.instances if self.instances is None else self.instances


def seed_of(seed: int, frame: str, obj: int, instance: int = 0) -> int:
    """A number below 2³² that depends on the frame's id, the object and the instance, and not on any order."""
    text = f"{seed}\n{frame}\n{obj}\n{instance}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")


def split_into_buckets(count: int, buckets: tuple[int, ...]) -> list[tuple[int, int]]:
    """(how many, size of the program) of each part of ``count`` crops; only the last part is padded."""
    sizes = sorted(set(buckets))
    parts = [(sizes[-1], sizes[-1])] * (count // sizes[-1])
    rest = count % sizes[-1]
    if rest:
        parts.append((rest, next(size for size in sizes if size >= rest)))
    return parts


def empty_labels(frames: int, instances: int) -> dict[str, np.ndarray]:
    """The columns of a batch in which nothing has been found."""
    shape = (frames, instances)
    nothing = lambda *more: np.full((*shape, *more), np.nan)
    texts = lambda *size: np.full(size, "", object)
    return {
        "error": texts(frames),
        "object": np.full(shape, -1),
        "success": np.zeros(shape, bool),
        "present": np.zeros(shape, bool),
        "camera_from_mesh": nothing(4, 4),
        "diameter": nothing(),
        "diameter_std": nothing(),
        "confidence": np.zeros(shape),
        "margin": nothing(),
        "covariance": nothing(6, 6),
        "mask": texts(*shape),
        "outline_pixels": np.zeros(shape, int),
        "box": np.zeros((*shape, 4), int),
        "overlap": nothing(),
        "note": texts(*shape),
        "size": np.zeros((frames, 2), int),
        "seconds": np.zeros(frames),
    }

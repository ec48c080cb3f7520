"""Frames in a ROS 2 bag: colour images, the depth images registered to them, and the colour camera.

Read with rosbags (https://gitlab.com/ternaris/rosbags), which needs no ROS; an optional package.
"""

import re
import struct
import threading
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.bop.records import MM
from ipjax.detection.crops import read_scene
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.cameras.reading import read_camera
from ipjax.files.images.opening import read_rgb
from ipjax.files.storage.budget import check_budget
from ipjax.labelling.sources.records import FrameKey, SourceError, SourceFrame, hash_plain

_MISSING = "reading ROS bags needs rosbags, which is not installed: pip install 'ipjax[ros]'"
_IMAGE, _PACKED, _CAMERA = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_TOGETHER = 10_000_000  # nanoseconds by which the stamps of colours and depth may differ
_COLOURS = {"rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "rgba8": (4, (0, 1, 2)), "bgra8": (4, (2, 1, 0)),
            "mono8": (1, (0, 0, 0))}  # fmt: skip
_DEPTHS = {"16UC1": (np.uint16, MM), "mono16": (np.uint16, MM), "32FC1": (np.float32, 1.0)}
_UNREGISTERED = re.compile(r"depth/image_rect_raw|depth/image_raw(?!.*regist)")


class RosBag:
    """Every colour image with a depth image of its time; the objects are to be sought, since a bag has no masks.

    Of several topics, colours are of the one with "color" or "rgb" in its name, depth of the one with "aligned" or
    "registered"; depth that is not registered to the colours is refused.

    Args:
        path: the folder of the bag, with metadata.yaml.

    Raises:
        SourceError: rosbags is missing, the bag is damaged, or has no such topics.
    """

    kind = "ROS 2 bag"

    def __init__(self, path: Path):
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise SourceError(f"{path}: {_MISSING}") from None
        self.path = path
        self.reading = threading.Lock()
        try:
            self.reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self.reader.open()
        except Exception as error:  # of YAML, of SQLite, of MCAP
            raise SourceError(f"{path}: not a readable ROS 2 bag ({' '.join(str(error).split())})") from None
        self.colours = self._choose("colour images", (_IMAGE, _PACKED), ("color", "rgb", "image"), ("depth", "infra"))
        self.depths = self._choose("depth images", (_IMAGE,), ("aligned", "registered", "depth"), ())
        if _UNREGISTERED.search(self.depths.topic):
            raise SourceError(
                f"{path}: {self.depths.topic} is not registered to the colours; record the aligned depth "
                "(aligned_depth_to_color/image_raw, or depth_registered)"
            )
        self.camera = self._read_camera()
        self.pairs = self._pair()

    def keys(self) -> list[FrameKey]:
        """By time; a frame is called by the nanoseconds of its colour image."""
        return [FrameKey(0, place, str(stamp)) for place, stamp in enumerate(self.pairs)]

    def read(self, key: FrameKey) -> SourceFrame:
        """One frame, undistorted."""
        colours, depths = self.pairs[int(key.name)]
        with self.reading:
            colour, depth = self._message(self.colours, colours), self._message(self.depths, depths)
        where = f"{self.path}: {key.name}"
        rgb = self._decode_colours(colour, where)
        if depth.encoding not in _DEPTHS:
            raise ValueError(f"{where}: depth of the encoding {depth.encoding!r}; {', '.join(_DEPTHS)} are known")
        dtype, scale = _DEPTHS[depth.encoding]
        metres = _pixels(depth, np.dtype(dtype).itemsize, where).view(dtype)[..., 0]
        scene = read_scene(rgb, metres, self.camera, scale)
        return SourceFrame(scene.rgb, scene.depth, scene.matrix, None, f"{self.colours.topic}/{key.name}")

    def identity(self) -> dict[str, Any]:
        """The topics, and the times of all frames."""
        return {"topics": [self.colours.topic, self.depths.topic], "frames": hash_plain([*self.pairs])}

    def _choose(self, what: str, kinds: tuple[str, ...], words: tuple[str, ...], not_words: tuple[str, ...]) -> Any:
        """The connection of the topic that these words fit best."""
        found = [
            one
            for one in self.reader.connections
            if one.msgtype in kinds and not any(word in one.topic for word in not_words)
        ]
        for word in words:
            for one in sorted(found, key=lambda one: (one.msgtype != _IMAGE, one.topic)):
                if word in one.topic:
                    return one
        there = ", ".join(sorted({one.topic for one in self.reader.connections})) or "nothing"
        raise SourceError(f"{self.path}: it has no topic of {what}; it has {there}")

    def _read_camera(self) -> Intrinsics:
        """The CameraInfo of the topic that shares most of its name with the colours'."""
        own = self.colours.topic.split("/")
        shared = lambda one: sum(a == b for a, b in zip(one.topic.split("/"), own, strict=False))
        infos = [one for one in self.reader.connections if one.msgtype == _CAMERA and "depth" not in one.topic]
        infos = infos or [one for one in self.reader.connections if one.msgtype == _CAMERA]
        if not infos:
            raise SourceError(f"{self.path}: it has no sensor_msgs/CameraInfo of the colour camera")
        best = max(infos, key=lambda one: (shared(one), one.topic))
        for connection, _, raw in self.reader.messages([best]):
            said: Any = self.reader.deserialize(raw, connection.msgtype)
            entry = {"width": int(said.width), "height": int(said.height), "K": [float(x) for x in said.k]}
            entry |= {"D": [float(x) for x in said.d], "distortion_model": str(said.distortion_model)}
            try:
                return read_camera(entry)
            except ValueError as error:
                raise SourceError(f"{self.path}: {best.topic}: {error}") from None
        raise SourceError(f"{self.path}: {best.topic} has no messages")

    def _pair(self) -> dict[int, tuple[int, int]]:
        """By the stamp of a colour image, when it and the depth image nearest to it were recorded."""
        stamps: dict[str, list[tuple[int, int]]] = {self.colours.topic: [], self.depths.topic: []}
        for connection, recorded, raw in self.reader.messages([self.colours, self.depths]):
            stamps[connection.topic].append((_stamp_of(raw) or recorded, recorded))
        depths = np.array(sorted(stamps[self.depths.topic]), np.int64).reshape(-1, 2)
        found: dict[int, tuple[int, int]] = {}
        for stamp, recorded in sorted(stamps[self.colours.topic]):
            if not len(depths):
                break
            nearest = depths[np.abs(depths[:, 0] - stamp).argmin()]
            if abs(int(nearest[0]) - stamp) <= _TOGETHER:
                found[stamp] = recorded, int(nearest[1])
        if not found:
            raise SourceError(
                f"{self.path}: no image of {self.colours.topic} has one of {self.depths.topic} within "
                f"{_TOGETHER / 1e6:g} ms"
            )
        return found

    def _message(self, connection: Any, recorded: int) -> Any:
        for _, _, raw in self.reader.messages([connection], start=recorded, stop=recorded + 1):
            check_budget(3 * len(raw), f"{self.path}: an image of {connection.topic}")
            return self.reader.deserialize(raw, connection.msgtype)
        raise ValueError(f"{self.path}: the image of {connection.topic} at {recorded} is gone")

    def _decode_colours(self, message: Any, where: str) -> np.ndarray:
        if not hasattr(message, "encoding"):
            return read_rgb(where, bytes(message.data))
        if message.encoding not in _COLOURS:
            raise ValueError(f"{where}: colours of the encoding {message.encoding!r}; {', '.join(_COLOURS)} are known")
        channels, order = _COLOURS[message.encoding]
        return np.ascontiguousarray(_pixels(message, channels, where)[..., list(order)])


def is_bag(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return path.is_dir() and (path / "metadata.yaml").is_file()


def _pixels(message: Any, size: int, where: str) -> np.ndarray:
    """The bytes of an image message, height × width × bytes of a pixel."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8)
    if not (height > 0 and width > 0 and step >= width * size and data.size >= height * step):
        raise ValueError(f"{where}: {data.size} bytes are not {height} rows of {step} bytes of {width} pixels")
    rows = data[: height * step].reshape(height, step)[:, : width * size]
    pixels = np.ascontiguousarray(rows).reshape(height, width, size)
    return (
        pixels[..., ::-1].copy() if message.is_bigendian and size in (2, 4) and message.encoding in _DEPTHS else pixels
    )


def _stamp_of(raw: Any) -> int:
    """Nanoseconds of the header that an image message begins with; 0 = not set."""
    if len(raw) < 12:
        return 0
    order = "<" if raw[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", bytes(raw[:12]), 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)

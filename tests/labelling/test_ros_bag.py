"""Frames of a ROS 2 bag: paired by their stamps, decoded from every encoding, refused in words."""

import numpy as np
import pytest
from builders.labelled_frames import make_frames

from ipjax.labelling.sources import ros_bag
from ipjax.labelling.sources.opening import open_source
from ipjax.labelling.sources.records import SourceError

COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/color/camera_info"


def write_bag(folder, frames, *, encoding="rgb8", depth_encoding="16UC1", topics=(COLOUR, DEPTH, INFO), late=2_000_000):
    """Frames at thirty a second; depth comes ``late`` nanoseconds after the colours."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    image, info = kinds["sensor_msgs/msg/Image"], kinds["sensor_msgs/msg/CameraInfo"]
    time, header = kinds["builtin_interfaces/msg/Time"], kinds["std_msgs/msg/Header"]
    roi = kinds["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)

    def headed(stamp):
        return header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="camera")

    def packed(stamp, pixels, name):
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        data = np.concatenate([rows, np.zeros((height, 4), np.uint8)], 1)  # rows may end in padding
        return image(headed(stamp), height, width, name, 0, data.shape[1], data.reshape(-1))

    colours = {"rgb8": lambda x: x, "bgr8": lambda x: x[..., ::-1], "mono8": lambda x: x[..., :1]}[encoding]
    depths = {"16UC1": lambda x: np.round(1000 * x).astype(np.uint16), "32FC1": lambda x: x.astype(np.float32)}
    with rosbag2.Writer(folder, version=9) as writer:
        open_topic = lambda topic, kind: writer.add_connection(topic, f"sensor_msgs/msg/{kind}", typestore=store)
        lines = [open_topic(topic, kind) for topic, kind in zip(topics, ("Image", "Image", "CameraInfo"), strict=False)]
        for number, frame in enumerate(frames):
            stamp = 10**18 + number * 33_000_000
            messages = [
                packed(stamp, colours(frame.rgb), encoding),
                packed(stamp + late, depths[depth_encoding](frame.depth), depth_encoding),
            ]
            height, width = frame.mask.shape
            eye = np.eye(3, dtype=float).reshape(-1)
            k = np.asarray(frame.matrix, float).reshape(-1)
            messages.append(
                info(headed(stamp), height, width, "plumb_bob", np.zeros(5), k, eye, np.zeros(12), 0, 0, roi)
            )
            for line, message, offset in zip(lines, messages, (0, late, 0), strict=False):
                writer.write(line, stamp + offset + 500, store.serialize_cdr(message, line.msgtype))
    return folder


def same_camera(count: int):
    """Frames that say they are of one camera."""
    import dataclasses

    frames = make_frames(count)
    return [dataclasses.replace(one, matrix=frames[0].matrix) for one in frames]


@pytest.mark.parametrize(("encoding", "depth_encoding"), [("rgb8", "16UC1"), ("bgr8", "32FC1"), ("mono8", "16UC1")])
def test_frames_are_paired_and_decoded(tmp_path, encoding, depth_encoding):
    frames = same_camera(3)
    source = open_source(write_bag(tmp_path / "bag", frames, encoding=encoding, depth_encoding=depth_encoding), [1])
    keys = source.keys()
    assert [key.image for key in keys] == [0, 1, 2] and keys[1].name == str(10**18 + 33_000_000)
    for key, frame in reversed(list(zip(keys, frames, strict=True))):  # in any order
        read = source.read(key)
        wanted = frame.rgb if encoding != "mono8" else np.repeat(frame.rgb[..., :1], 3, -1)
        np.testing.assert_array_equal(read.rgb, wanted)
        np.testing.assert_allclose(read.depth[frame.mask], frame.depth[frame.mask], atol=6e-4)
        np.testing.assert_allclose(read.camera, frame.matrix)
        assert read.masks is None
    again = open_source(tmp_path / "bag", [1])
    assert again.identity() == source.identity()


def test_what_does_not_belong_together_is_refused(tmp_path):
    frames = same_camera(2)
    with pytest.raises(SourceError, match="within 10 ms"):
        open_source(write_bag(tmp_path / "late", frames, late=15_000_000), [1])
    raw = write_bag(tmp_path / "raw", frames, topics=(COLOUR, "/camera/depth/image_rect_raw", INFO))
    with pytest.raises(SourceError, match="not registered to the colours"):
        open_source(raw, [1])
    with pytest.raises(SourceError, match="no topic of depth images; it has /camera/color/image_raw"):
        open_source(write_bag(tmp_path / "colours", frames, topics=(COLOUR,)), [1])
    with pytest.raises(SourceError, match="no sensor_msgs/CameraInfo"):
        open_source(write_bag(tmp_path / "blind", frames, topics=(COLOUR, DEPTH)), [1])
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    with pytest.raises(SourceError, match="not a readable ROS 2 bag"):
        open_source(tmp_path / "broken", [1])


def test_without_rosbags_a_sentence_says_what_is_missing(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    (tmp_path / "metadata.yaml").write_text("")
    with pytest.raises(SourceError, match=r"pip install 'ipjax\[ros\]'"):
        ros_bag.RosBag(tmp_path)

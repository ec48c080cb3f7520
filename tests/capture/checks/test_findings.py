"""What is wrong with a capture is found, told with its number and what to do; what is right raises no alarm."""

import dataclasses

import cv2
import numpy as np
import pytest

from ipjax.cameras import resize
from ipjax.capture.checks.findings import FACT, UNUSABLE, WARNING, list_findings
from ipjax.capture.checks.inspection import inspect
from ipjax.capture.reading.opening import open_capture
from ipjax.transforms import Similarity


@pytest.fixture(scope="module")
def capture(folder):
    return open_capture(folder)


def changed(capture, change, **others):
    """The capture with every frame changed: ``change(index, frame)`` gives what to replace."""

    def read(index):
        frame = capture.read_frame(index)
        return dataclasses.replace(frame, **change(index, frame))

    return dataclasses.replace(capture, read_frame=read, **others)


def told(capture, kind):
    return {finding.topic: finding for finding in list_findings(inspect(capture)) if finding.kind == kind}


def test_a_good_capture_is_told_in_facts(made, capture):
    heard = []
    inspection = inspect(capture, progress=lambda done, total: heard.append((done, total)))
    findings = list_findings(inspection)
    assert {finding.topic for finding in findings if finding.kind != FACT} == {"frames"}  # there are only six
    assert all(finding.text.endswith(".") and not finding.text[0].islower() for finding in findings)
    text = " ".join(finding.text for finding in findings)
    assert "6 frames of 320 × 240 pixels" in text and "256 × 192 pixels is there, with its place" in text
    assert heard[-1][0] == heard[-1][1] and sorted(heard) == heard
    known = np.median((made.depth > 0).mean((1, 2)))
    assert np.median([image.known for image in inspection.images]) == pytest.approx(known, abs=0.01)
    # The given poses are the true ones: what is left is the sensor's noise.
    differences = [pair.differences[0] for pair in inspection.pairs]
    assert len(differences) == 5 and max(d for d in differences if d is not None) < 0.006
    ways = []
    for pair, (first, second) in zip(inspection.pairs, zip(made.names, made.names[1:], strict=False), strict=True):
        assert (pair.first, pair.second) == (first, second) and pair.matches > 15
        assert pair.overlap is not None and 0.6 < pair.overlap <= 1 and pair.moved is not None
        moved = made.world_from_camera.translation[int(second)] - made.world_from_camera.translation[int(first)]
        ways.append(pair.moved[0] / np.linalg.norm(moved))
    assert np.median(ways) == pytest.approx(1, abs=0.1)
    assert inspection.shift is not None and inspection.shift.certain and inspection.shift.length < 2.5


def test_depth_that_does_not_lie_on_the_colours_is_told_with_its_shift(capture):
    moved = changed(capture, lambda _, frame: {"depth": np.roll(frame.depth, (-6, 9), (0, 1))})
    shift = inspect(moved).shift
    assert shift is not None and shift.certain
    assert shift.across == pytest.approx(-9, abs=2) and shift.down == pytest.approx(6, abs=2)
    text = told(moved, WARNING)["registration"].text
    assert "px too far right" in text and "px too far up" in text


def test_depth_of_another_view_is_told(capture):
    turned = changed(capture, lambda _, frame: {"depth": np.ascontiguousarray(frame.depth[::-1, ::-1])})
    assert "fall on no edges" in told(turned, WARNING)["registration"].text


def test_a_wrong_unit_is_told(capture):
    wrong = changed(capture, lambda _, frame: {"depth": frame.depth * np.float32(50)})
    assert "unit of depth is wrong" in told(wrong, UNUSABLE)["depth"].text
    slightly = changed(capture, lambda _, frame: {"depth": frame.depth * np.float32(1.5)})
    ways = [f.text for f in list_findings(inspect(slightly)) if f.kind == WARNING and "times as far" in f.text]
    assert len(ways) == 1 and float(ways[0].split(" times")[0].split()[-1]) == pytest.approx(1.5, abs=0.12)


def test_poses_of_another_form_are_told(capture):
    assert capture.world_from_camera is not None
    backwards = dataclasses.replace(capture, world_from_camera=capture.world_from_camera.inverse())
    assert "camera_from_world" in told(backwards, UNUSABLE)["poses"].text
    flip = Similarity(np.diag([1.0, -1, -1]), np.zeros(3), np.ones(()))
    other_axes = dataclasses.replace(capture, world_from_camera=capture.world_from_camera @ flip)
    assert "OpenGL" in told(other_axes, UNUSABLE)["poses"].text
    rng = np.random.default_rng(0)
    shaken = capture.world_from_camera @ Similarity[np.ndarray].exp(rng.normal(0, [0.05] * 3 + [0.05] * 3, (6, 6)))
    found = list_findings(inspect(dataclasses.replace(capture, world_from_camera=shaken)))
    assert any("do not belong together" in f.text for f in found if f.topic == "poses" and f.kind != FACT)
    none = told(dataclasses.replace(capture, world_from_camera=None), FACT)
    assert "No poses are given" in none["poses"].text


def test_single_frames_that_are_bad_are_named(capture):
    def spoil(index, frame):
        if index == 2:
            return {"rgb": cv2.GaussianBlur(frame.rgb, (0, 0), 4)}
        if index == 3:
            return {"rgb": np.minimum(frame.rgb.astype(int) * 6, 255).astype(np.uint8)}
        if index == 4:
            return {"rgb": frame.rgb // 50}
        return {"depth": np.zeros_like(frame.depth)} if index == 5 else {}

    found = list_findings(inspect(changed(capture, spoil)))
    for word, name in (("blurred", "2"), ("overexposed", "3"), ("underexposed", "4"), ("no depth", "5")):
        assert [f.frames for f in found if f" {word}" in f.text and f.kind == WARNING] == [(f"00000{name}",)]


def test_neighbours_that_share_too_little_are_named(capture):
    blank = changed(capture, lambda index, frame: {"rgb": np.full_like(frame.rgb, 128)} if index == 3 else {})
    finding = told(blank, WARNING)["overlap"]
    assert finding.frames == ("000002–000003", "000003–000004") and "fewer than 15 features" in finding.text
    assert "are needed there" in finding.text
    far = dataclasses.replace(
        capture,
        names=capture.names[::5],
        read_frame=lambda index: capture.read_frame(5 * index),
        world_from_camera=None if capture.world_from_camera is None else _every(capture.world_from_camera, 5),
    )
    assert "2 frames" in told(far, UNUSABLE)["frames"].text


def _every(poses, step):
    return Similarity(poses.rotation[::step], poses.translation[::step], poses.scale[::step])


def test_what_moves_with_the_camera_is_found(capture):
    rng = np.random.default_rng(1)
    patch = cv2.resize(rng.integers(0, 255, (12, 12, 3), dtype=np.uint8), (120, 120), interpolation=cv2.INTER_CUBIC)
    mask = np.ones((480, 640), bool)
    mask[320:, 20:190] = False

    def hold(_, frame, usable=None):
        rgb = cv2.resize(frame.rgb, (640, 480))
        rgb[340:460, 40:160] = patch
        usable = np.ones((480, 640), bool) if usable is None else usable
        return {"rgb": rgb, "depth": cv2.resize(frame.depth, (640, 480)), "usable": usable}

    larger = {"size": (640, 480), "camera": resize(capture.camera, (320, 240), (640, 480)), "world_from_camera": None}
    found = inspect(changed(capture, hold, **larger))
    rows, columns = np.nonzero(found.still)
    assert rows.min() > 320 and rows.max() < 480 and columns.max() < 190 and found.still.mean() > 0.02
    text = next(f.text for f in list_findings(found) if f.topic == "gripper")
    assert "moves with the camera" in text and "ignore.png" in text
    masked = changed(capture, lambda index, frame: hold(index, frame, mask), **larger)
    assert "gripper" not in told(masked, WARNING)
    assert "Masks hide 9 %" in told(masked, FACT)["gripper"].text


def test_captures_without_registered_depth_are_looked_at(capture):
    raw_only = changed(capture, lambda _, frame: {"depth": None}, world_from_camera=None)
    facts = [finding.text for finding in list_findings(inspect(raw_only)) if finding.kind == FACT]
    assert any("of the depth camera alone" in text for text in facts)
    empty = changed(capture, lambda _, frame: {"depth": np.zeros_like(frame.depth)})
    assert "empty" in told(empty, UNUSABLE)["depth"].text


def test_long_captures_are_looked_at_here_and_there(capture):
    first = capture.read_frame(0)
    small = {"rgb": first.rgb[::8, ::8], "depth": first.depth[::8, ::8], "usable": first.usable[::8, ::8]}
    long = dataclasses.replace(
        capture,
        names=tuple(f"{i:06d}" for i in range(200)),
        size=(40, 30),
        read_frame=lambda index: dataclasses.replace(first, name=f"{index:06d}", **small),
        world_from_camera=None,
    )
    inspection = inspect(long)
    assert len(inspection.looked_at) == 60 and len(inspection.pairs) == 45
    assert inspection.looked_at[0] == 0 and inspection.looked_at[-1] == 199

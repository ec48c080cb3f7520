"""Captures in every form come out the same: metres, without distortion, with poses; what cannot be used is told."""

import json
import shutil
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from ipjax.capture.reading.opening import open_capture
from ipjax.capture.records import Capture, CaptureError
from ipjax.synthetic.captures import write_capture
from ipjax.transforms import Similarity, vector_from_rotation

UNIT = 0.0001  # metres per number of the folder's depth


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def millimetres(depth, per=1000):
    return np.round(depth * per).astype(np.uint16)


def copy(folder, to):
    return shutil.copytree(folder, to / "copy")


def test_frames_are_what_the_camera_gave(made, folder):
    capture = open_capture(folder)
    assert (capture.form, capture.names, capture.size) == ("frames", made.names, (320, 240))
    assert capture.depth_size == (256, 192) and len(capture) == 6
    frame = capture.read_frame(3)
    np.testing.assert_array_equal(frame.rgb, made.rgb[3])
    assert frame.depth is not None and frame.raw_depth is not None and frame.usable.all()
    np.testing.assert_allclose(frame.depth, made.depth[3], atol=0.6 * UNIT)
    np.testing.assert_allclose(frame.raw_depth, made.raw_depth[3], atol=0.6 * UNIT)
    np.testing.assert_allclose(capture.camera.to_matrix(), made.camera.to_matrix(), atol=1e-3)
    for told, true in (
        (capture.colour_from_depth, made.factory_colour_from_depth),
        (capture.world_from_camera, made.world_from_camera),
    ):
        assert told is not None
        np.testing.assert_allclose(told.to_matrix(), true.to_matrix(), atol=1e-9)
    some = open_capture(folder, poses=False, every=2)
    assert some.names == made.names[::2] and some.world_from_camera is None


def test_masks_hide_what_moves_with_the_camera(folder, tmp_path):
    here = copy(folder, tmp_path)
    hidden = np.zeros((240, 320), np.uint8)
    hidden[200:] = 255
    save(here / "ignore.png", hidden)
    hidden[:100] = 255
    save(here / "ignore" / "000001.png", hidden)
    capture = open_capture(here)
    assert capture.read_frame(0).usable.mean() == pytest.approx(200 / 240)
    assert capture.read_frame(1).usable.mean() == pytest.approx(100 / 240)


def test_a_lens_is_undone(made, folder, tmp_path):
    here = copy(folder, tmp_path)
    K, lens = made.camera.to_matrix(), np.array([0.25, 0.0, 0, 0])
    # The place in the undistorted photo that every pixel of a distorted one shows.
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), -1).reshape(-1, 1, 2)
    places = cv2.undistortPoints(pixels, K, lens, P=K).reshape(240, 320, 2).astype(np.float32)
    bent = cv2.remap(made.rgb[0], places[..., 0], places[..., 1], cv2.INTER_LINEAR)
    save(here / "rgb" / "000000.png", bent)
    told = json.loads((here / "camera.json").read_text())
    (here / "camera.json").write_text(json.dumps({**told, "k1": 0.25, "k2": 0, "p1": 0, "p2": 0}))
    frame = open_capture(here).read_frame(0)
    off = [np.abs(image.astype(int) - made.rgb[0])[20:-20, 20:-20].mean() for image in (bent, frame.rgb)]
    assert off[1] < 0.5 * off[0] and frame.usable.mean() < 1 and frame.usable[60:180, 80:240].all()


def write_tum(made, folder, late=0.006, gap=False):
    """Colours every 0.2 s, depth a little later, the truth a hundred times a second along straight lines."""
    start, lines = 1341841278.0, {"rgb": ["# time file"], "depth": ["# time file"]}
    for index, (rgb, depth) in enumerate(zip(made.rgb, made.depth, strict=True)):
        time = start + 0.2 * index
        for kind, image, when in (("rgb", rgb, time), ("depth", millimetres(depth, 5000), time + late)):
            name = f"{kind}/{when:.6f}.png"
            save(folder / name, image)
            lines[kind].append(f"{when:.6f} {name}")
    for kind, text in lines.items():
        (folder / f"{kind}.txt").write_text("\n".join(text))
    poses, rows = made.world_from_camera, ["# timestamp tx ty tz qx qy qz qw"]
    for tick in range(-1, 102):
        place = np.clip(tick * 0.01 / 0.2, 0, 4.999)
        low, share = int(place), place % 1
        step = (at(poses, low).inverse() @ at(poses, low + 1)).log()[:6]
        step[3:] = 0
        turn = (at(poses, low) @ Similarity.exp(share * step)).rotation
        shift = (1 - share) * poses.translation[low] + share * poses.translation[low + 1]
        w = np.linalg.norm(vector_from_rotation(turn))
        quaternion = [*(np.sin(w / 2) * vector_from_rotation(turn) / w), np.cos(w / 2)]
        if not (gap and 35 <= tick <= 45):
            rows.append(" ".join(f"{x:.9f}" for x in (start + 0.01 * tick + 0.003, *shift, *quaternion)))
    (folder / "groundtruth.txt").write_text("\n".join(rows))


def at(poses, index):
    return poses.take(index)


def test_tum_is_joined_by_time_and_poses_are_interpolated(made, tmp_path):
    write_tum(made, tmp_path)
    with pytest.raises(CaptureError, match="tum-fr1"):
        open_capture(tmp_path)
    K = made.camera.to_matrix()
    capture = open_capture(tmp_path, camera=K)
    assert capture.form == "tum" and len(capture) == 6 and not capture.notes
    depth = capture.read_frame(2).depth
    assert depth is not None
    np.testing.assert_allclose(depth, made.depth[2], atol=2e-4)
    assert capture.world_from_camera is not None
    # The truth's times are 3 ms off everywhere: the nearest pose would be 1.5 % of the way between frames wrong.
    moved = np.linalg.norm(np.diff(made.world_from_camera.translation, axis=0), axis=1).max()
    expected = made.world_from_camera.translation[2] - 0.015 * np.diff(made.world_from_camera.translation, axis=0)[1]
    assert np.linalg.norm(capture.world_from_camera.translation[2] - expected) < 0.002 * moved
    for index in (1, 2, 3):
        turn = capture.world_from_camera.rotation[index].T @ made.world_from_camera.rotation[index]
        assert np.linalg.norm(vector_from_rotation(turn)) < 0.01
    assert open_capture(tmp_path, camera="tum-fr3").camera.to_matrix()[0, 0] == pytest.approx(535.4)


def test_tum_leaves_out_what_has_no_partner(made, tmp_path):
    write_tum(made, tmp_path, gap=True)
    capture = open_capture(tmp_path, camera=made.camera)
    assert len(capture) == 5 and "1 of 6 images have no pose within 20 ms" in capture.notes[0]
    (tmp_path / "depth.txt").write_text("\n".join((tmp_path / "depth.txt").read_text().splitlines()[:-1]))
    capture = open_capture(tmp_path, camera=made.camera, poses=False)
    assert len(capture) == 5 and "1 of 6 colour images have no depth image" in capture.notes[0]


@pytest.mark.parametrize("coded", [False, True])
def test_numbered_frames(made, tmp_path, coded):
    for index in range(3):
        depth = millimetres(made.depth[index], 10000 if coded else 1000)
        if coded:
            depth = (depth << 3) | (depth >> 13)
            save(tmp_path / "raw" / f"frame-{index:06d}.depth.png", depth)
        else:
            depth[depth == 0] = 65535
        save(tmp_path / f"frame-{index:06d}.color.png", made.rgb[index])
        save(tmp_path / f"frame-{index:06d}.depth.png", depth)
        np.savetxt(tmp_path / f"frame-{index:06d}.pose.txt", made.world_from_camera.to_matrix()[index])
    rows = lambda matrix: "\n".join(" ".join(map(str, row)) for row in matrix)
    shift = np.eye(4)
    shift[0, 3] = 0.0257
    if coded:
        parts = (
            ("Color camera intrinsic matrix", made.camera.to_matrix()),
            ("Depth camera intrinsic matrix", made.depth_camera.to_matrix()),
            ("Depth-to-color camera extrinsic matrix", shift),
        )
        (tmp_path / "cam.info.txt").write_text("\n\n".join(f"# {name}\n{rows(matrix)}" for name, matrix in parts))
    else:
        (tmp_path / "camera-intrinsics.txt").write_text(rows(made.camera.to_matrix()))
    capture = open_capture(tmp_path)
    assert capture.form == "numbered" and capture.names[2] == "frame-000002" and bool(capture.notes) == coded
    assert capture.world_from_camera is not None
    np.testing.assert_allclose(capture.world_from_camera.translation, made.world_from_camera.translation[:3])
    depth = capture.read_frame(1).depth
    assert depth is not None
    np.testing.assert_allclose(depth, made.depth[1], atol=6e-4)
    if coded:
        assert capture.colour_from_depth is not None and capture.colour_from_depth.translation[0] == 0.0257
        assert capture.depth_size == (320, 240)


def test_scenes_of_bop_with_their_cameras(made, tmp_path):
    cameras = {}
    camera_from_world = made.world_from_camera.inverse()
    for index in range(3):
        save(tmp_path / "rgb" / f"{index:06d}.png", made.rgb[index])
        save(tmp_path / "depth" / f"{index:06d}.png", millimetres(made.depth[index]))
        cameras[index] = {
            "cam_K": made.camera.to_matrix().ravel().tolist(),
            "depth_scale": 1.0,
            "cam_R_w2c": camera_from_world.rotation[index].ravel().tolist(),
            "cam_t_w2c": (1000 * camera_from_world.translation[index]).tolist(),
        }
    (tmp_path / "scene_camera.json").write_text(json.dumps(cameras))
    capture = open_capture(tmp_path)
    assert capture.form == "bop" and capture.world_from_camera is not None
    np.testing.assert_allclose(capture.world_from_camera.translation, made.world_from_camera.translation[:3], atol=1e-9)
    depth = capture.read_frame(0).depth
    assert depth is not None
    np.testing.assert_allclose(depth, made.depth[0], atol=6e-4)
    cameras[1]["cam_K"][0] += 3
    (tmp_path / "scene_camera.json").write_text(json.dumps(cameras))
    with pytest.raises(CaptureError, match="image 000001 has another camera"):
        open_capture(tmp_path)


def test_two_images_of_one_name_are_refused(tmp_path):
    colour, depth = np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 700, np.uint16)
    for form in ("numbered", "tum"):
        (tmp_path / form).mkdir()
        (tmp_path / form / "camera.json").write_text('{"fx": 8, "fy": 8, "cx": 3.5, "cy": 2.5}')
    for ending in ("png", "jpg"):
        save(tmp_path / "numbered" / f"frame-0.color.{ending}", colour)
    save(tmp_path / "numbered" / "frame-0.depth.png", depth)
    with pytest.raises(CaptureError, match="two files of one frame"):
        open_capture(tmp_path / "numbered")
    for name in ("left", "right"):
        save(tmp_path / "tum" / name / "0.png", colour)
    save(tmp_path / "tum" / "depth" / "0.png", depth)
    (tmp_path / "tum" / "rgb.txt").write_text("1.0 left/0.png\n2.0 right/0.png\n")
    (tmp_path / "tum" / "depth.txt").write_text("1.0 depth/0.png\n2.0 depth/0.png\n")
    with pytest.raises(CaptureError, match="two of its images are called 0"):
        open_capture(tmp_path / "tum")


def without(name):
    return lambda here: shutil.rmtree(here / name) if (here / name).is_dir() else (here / name).unlink()


def rewritten(name, change):
    return lambda here: (here / name).write_text(change((here / name).read_text()))


def small_depth(here):
    save(here / "depth" / "000002.png", np.full((120, 160), 700, np.uint16))


def broken_rgb(here):
    (here / "rgb" / "000001.png").write_bytes(b"no image")


def no_depth_at_all(here):
    shutil.rmtree(here / "depth")
    shutil.rmtree(here / "raw")


def unscaled(here):
    told = json.loads((here / "camera.json").read_text())
    del told["depth_scale"]
    (here / "camera.json").write_text(json.dumps(told))


def masks_of_other_names(here):
    save(here / "ignore" / "frame7.png", np.full((240, 320), 255, np.uint8))


FAULTS = {
    "no rgb": (without("rgb"), "no capture is recognised"),
    "no camera": (without("camera.json"), "nothing says what the colour camera is"),
    "a depth image missing": (without("depth/000003.png"), "the depth image is missing of 000003"),
    "another size": (small_depth, "160 × 120 pixels, and the colour images have 320 × 240"),
    "broken": (broken_rgb, "000001.png: not an image"),
    "no depth": (no_depth_at_all, "there is no depth"),
    "no unit": (unscaled, "pass depth_scale"),
    "raw of no camera": (lambda h: (without("depth")(h), without("depth_camera.json")(h)), "no depth_camera.json"),
    "camera of another size": (
        rewritten("camera.json", lambda t: t.replace("320", "640")),
        "is for images of 640 × 240",
    ),
    "poses of some": (rewritten("poses.json", lambda t: t.replace("000004", "x")), "there is no pose of 000004"),
    "a pose that mirrors": (
        rewritten("poses.json", lambda t: json.dumps({k: np.diag([1, 1, -1, 1]).tolist() for k in json.loads(t)})),
        "000000: the matrix mirrors",
    ),
    "masks of no frame": (masks_of_other_names, "frame7 is the name of no frame"),
    "no matrix": (
        rewritten(
            "depth_camera.json",
            lambda t: t.replace("colour_from_depth", "x").replace('"x": [', '"colour_from_depth": [[0],'),
        ),
        "depth_camera.json: colour_from_depth",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_sentences(folder, tmp_path, fault):
    here = copy(folder, tmp_path)
    change, said = FAULTS[fault]
    change(here)
    with pytest.raises(CaptureError, match=said):
        open_capture(here)


def test_a_frame_that_breaks_later_is_named(folder, tmp_path):
    here = copy(folder, tmp_path)
    capture = open_capture(here)
    (here / "depth" / "000001.png").unlink()
    with pytest.raises(CaptureError, match=r"000001\.png: no such file"):
        capture.read_frame(1)
    np.save(here / "depth" / "000001.npy", np.full((240, 320), 0.7, np.float32))
    with pytest.raises(CaptureError, match=r"000001\.npy: depth of floats among depth of whole numbers"):
        open_capture(here).read_frame(1)
    (here / "depth" / "000001.npy").unlink()
    faults: dict[str, dict[str, Any]] = {
        "no form": {"form": "other"},
        "every 0-th": {"every": 0},
        "positive": {"depth_scale": 0.0},
    }
    for said, arguments in faults.items():
        with pytest.raises(CaptureError, match=said):
            open_capture(here, **arguments)
    with pytest.raises(CaptureError, match="no such folder"):
        open_capture(here / "elsewhere")


def test_poses_of_a_written_trajectory_are_taken(made, folder, tmp_path):
    from ipjax.capture.records import Trajectory
    from ipjax.capture.trajectories import write_trajectory

    here = copy(folder, tmp_path)
    trajectory = Trajectory(made.names, made.world_from_camera, np.ones(6, bool), "given")
    write_trajectory(here / "poses.json", trajectory)
    capture = open_capture(here)
    assert isinstance(capture, Capture) and capture.world_from_camera is not None
    np.testing.assert_allclose(capture.world_from_camera.translation, made.world_from_camera.translation)


def test_raw_depth_is_left_out_where_it_is_not_wanted(made, tmp_path):
    capture = open_capture(write_capture(made, tmp_path, raw=False))
    assert capture.depth_camera is None and capture.read_frame(0).raw_depth is None

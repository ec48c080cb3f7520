"""Reading what the BOP benchmark defines, and saying what is wrong with it."""

import json
from pathlib import Path

import numpy as np
import pytest
from builders.bop_roots import write_images
from PIL import Image

from ipjax.bop.dataset import Dataset
from ipjax.bop.records import DatasetError


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_images(tmp_path_factory.mktemp("bop") / "small")


def test_a_data_set_is_in_metres(root):
    dataset = Dataset(root)
    assert dataset.scenes() == [0]
    assert dataset.images(0) == [0, 1, 2, 3]
    frame = dataset.frame(0, 1)
    assert frame.rgb.shape == (48, 64, 3)
    assert frame.rgb.dtype == np.uint8
    np.testing.assert_allclose(frame.depth, 0.7)  # 1400 × 0.5 mm
    assert frame.camera[0, 2] == 32
    truth = dataset.truths(0, 1)[1]
    assert (truth.obj_id, truth.index) == (3, 1)
    np.testing.assert_allclose(truth.translation, [0.075, 0.01, 0.7])
    info = dataset.models()[4]
    assert info.diameter == pytest.approx(0.12206555718)
    assert info.symmetries.rotation.shape == (315, 3, 3)
    farthest = 0.02 + np.hypot(0.02, 0.01)  # the axis is off the origin by (20, −10) mm
    assert np.abs(info.symmetries.translation).max() == pytest.approx(farthest, rel=1e-3)
    assert np.ptp(dataset.mesh(3).vertices, axis=0).max() < 0.13
    targets = dataset.given_targets(0, 2)
    assert [t.obj_id for t in targets] == [2, 3]
    assert targets[0].mask is not None and targets[0].mask.sum() == 20 * 28


def test_targets_without_a_file(root):
    dataset = Dataset(root, targets="absent.json")
    assert dataset.targets == Dataset(root).targets


def test_grey_jpg_and_tif_images(tmp_path):
    root = write_images(tmp_path / "grey", images=1)
    folder = root / "test" / "000000"
    Image.fromarray(np.full((48, 64), 77, np.uint8)).save(folder / "rgb" / "x.jpg")
    (folder / "gray").mkdir()
    (folder / "rgb" / "x.jpg").rename(folder / "gray" / "000000.jpg")
    (folder / "rgb" / "000000.png").unlink()
    Image.fromarray(np.full((48, 64), 1000, np.uint16)).save(folder / "depth" / "000000.tif")
    (folder / "depth" / "000000.png").unlink()
    frame = Dataset(root).frame(0, 0)
    assert frame.rgb.shape == (48, 64, 3) and abs(int(frame.rgb.mean()) - 77) <= 1
    np.testing.assert_allclose(frame.depth, 0.5)


def test_a_sensors_own_files(tmp_path):
    root = write_images(tmp_path / "two", images=1)
    folder = root / "test" / "000000"
    (folder / "depth").rename(folder / "depth_left")
    camera = json.loads((folder / "scene_camera.json").read_text())
    camera["0"]["depth_scale"] = 2.0
    (folder / "scene_camera_left.json").write_text(json.dumps(camera))
    np.testing.assert_allclose(Dataset(root, sensor="left").frame(0, 0).depth, 2.8)
    assert Dataset(root).frame(0, 0).depth is None


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda f: (f / "rgb" / "000000.png").unlink(), "000000.png: no such image"),
        (lambda f: (f / "rgb" / "000000.png").write_bytes(b"\x89PNG junk"), "000000.png: "),
        (lambda f: (f / "depth" / "000000.png").unlink(), "no such depth image"),
        (lambda f: (f / "scene_camera.json").write_text('{\n"0": [}'), "scene_camera.json: not valid JSON: line 2"),
        (lambda f: (f / "scene_camera.json").write_text('{"1": {}}'), "there is no image 0"),
        (lambda f: (f / "scene_camera.json").write_text('{"0": {"depth_scale": 1}}'), "cam_K is missing"),
        (lambda f: (f / "scene_camera.json").write_text('{"0": {"cam_K": [1, 2]}}'), "cam_K must be 9 numbers, got 2"),
        (
            lambda f: (f / "scene_camera.json").write_text('{"0": {"cam_K": [1,0,0,0,1,0,0,0,1], "depth_scale": 0}}'),
            "depth_scale must be a positive number",
        ),
    ],
)
def test_damage_is_named(tmp_path, damage, says):
    root = write_images(tmp_path / "damaged", images=1)
    damage(root / "test" / "000000")
    with pytest.raises(DatasetError, match=says) as caught:
        Dataset(root).frame(0, 0)
    assert str(root) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_damaged_annotations_models_and_targets_are_named(tmp_path):
    root = write_images(tmp_path / "damaged", images=1)
    (root / "test" / "000000" / "scene_gt.json").write_text('{"0": [{"obj_id": 1, "cam_R_m2c": [1, 2, 3]}]}')
    with pytest.raises(DatasetError, match=r"scene_gt\.json, image 0, instance 0: cam_R_m2c must be 9 numbers"):
        Dataset(root).truths(0, 0)
    (root / "models_eval" / "models_info.json").write_text('{"1": {"diameter": -4}}')
    with pytest.raises(DatasetError, match="object 1: the diameter must be a positive number"):
        Dataset(root).models()
    (root / "test_targets_bop19.json").write_text('[{"scene_id": 0}]')
    with pytest.raises(DatasetError, match="entry 0: scene_id, im_id and obj_id"):
        _ = Dataset(root).targets
    with pytest.raises(DatasetError, match="no such split; the data set has models_eval, test"):
        Dataset(root, "val")
    with pytest.raises(DatasetError, match=r"obj_000009\.ply: no such model"):
        Dataset(root).mesh(9)


def test_the_mini_set_reads(shared):
    dataset = Dataset(shared / "data" / "ycbv")
    assert len(dataset.targets) == 42
    assert len(dataset.models()) == 21
    frame = dataset.frame(50, 2)
    assert frame.depth is not None
    for target in dataset.given_targets(50, 2):
        assert target.mask is not None
        assert 0.4 < np.median(frame.depth[target.mask & (frame.depth > 0)]) < 1.6

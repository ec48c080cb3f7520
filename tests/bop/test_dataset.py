"""Reading and writing what the BOP benchmark defines, and saying what is wrong with it."""

import json
from pathlib import Path

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from builders.bop_roots import write_images
from hypothesis import given
from PIL import Image

from ipjax.bop import dataset as bop
from ipjax.bop.dataset import DatasetError

GOLDEN_CSV = Path(__file__).resolve().parents[1] / "golden" / "ipjaxgolden_ycbv-test.csv"
R, T = "1 0 0 0 1 0 0 0 1", "0 0 1000"


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_images(tmp_path_factory.mktemp("bop") / "small")


def test_the_golden_csv_survives_byte_for_byte(tmp_path):
    rows = bop.read_results(GOLDEN_CSV)
    assert len(rows) == 6
    written = bop.write_results(tmp_path / "again.csv", rows)
    assert written.read_bytes() == GOLDEN_CSV.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["again.csv"]  # no temporary file stays


def test_an_estimate_becomes_millimetres():
    row = bop.as_row(1, 2, bop.Estimate(3, 0.5, np.eye(3), np.array([0.1, -0.2, 0.7])), 0.25)
    assert bop.format_row(row).startswith("1,2,3,0.5,1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0,100.0 -200.0 700.0,0.25")
    with pytest.raises(ValueError, match="not finite"):
        bop.format_row(bop.as_row(1, 2, bop.Estimate(3, np.nan, np.eye(3), np.zeros(3))))


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (f"1,2,3,1.0,{R},{T}", "7 columns"),
        (f"1,2,3,1.0,{R[:-2]},{T},1", "R must hold 9 numbers, got 8"),
        (f"1,2,3,1.0,{R},0 1000,1", "t must hold 3 numbers, got 2"),
        (f"1,2,3,nan,{R},{T},1", "not finite"),
        (f"1,2,3,1.0,{R.replace('0', 'inf', 1)},{T},1", "not finite"),
        (f"1,2,3,high,{R},{T},1", "no number"),
        (f"1,2.5,3,1.0,{R},{T},1", "im_id must be a whole number"),
        (f"1,-2,3,1.0,{R},{T},1", "im_id must be a whole number"),
        (f"1,1,1,1.0,{R},{T},0.5", "same as that of line 2"),
        (f"1,1,2,1.0,{R},{T},0.7", "0.5 s in line 2"),
    ],
)
def test_a_damaged_row_is_named(tmp_path, line, says):
    path = tmp_path / "x_y-test.csv"
    good = f"1,1,1,1.0,{R},{T},0.5"
    path.write_text("\n".join([bop.HEADER, good, line, f"1,9,1,1.0,{R},{T},0.5"]))
    with pytest.raises(DatasetError, match=says) as caught:
        bop.read_results(path)
    assert str(caught.value).startswith(f"{path}, line 3: ")
    assert "\n" not in str(caught.value)
    problems: list[str] = []
    assert len(bop.read_results(path, problems=problems)) == 2
    assert len(problems) == 1 and says in problems[0]


def test_a_wrong_header_or_file_is_named(tmp_path):
    path = tmp_path / "results.csv"
    for text in ("", "scene_id,im_id\n", "1,2,3\n"):
        path.write_text(text)
        with pytest.raises(DatasetError, match="line 1: the header must be"):
            bop.read_results(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError, match="not a text file"):
        bop.read_results(path)
    with pytest.raises(DatasetError, match="cannot be read"):
        bop.read_results(tmp_path / "absent.csv")


@given(hnp.arrays(bool, (7, 9)))
def test_masks_survive_run_length_coding(mask):
    for compressed in (True, False):
        np.testing.assert_array_equal(bop.decode_rle(bop.encode_rle(mask, compressed=compressed)), mask)


def test_long_runs_and_cocos_text():
    mask = np.zeros((400, 600), bool)
    mask[100:300, 200:500] = True
    coded = bop.encode_rle(mask)
    np.testing.assert_array_equal(bop.decode_rle(coded), mask)
    # Worked by hand from COCO's rule: runs go down the columns and begin with background. 33 = 1 + 1 · 32 is the
    # characters 1 + 32 and 1, each plus 48.
    one = np.zeros((10, 10), bool)
    one[3, 3] = True
    assert bop.encode_rle(one)["counts"] == "Q11R2"
    assert bop.encode_rle(one, compressed=False)["counts"] == [33, 1, 66]
    np.testing.assert_array_equal(
        bop.decode_rle({"size": [2, 2], "counts": [0, 1, 3]}), [[True, False], [False, False]]
    )


@pytest.mark.parametrize(
    "segmentation",
    [
        {"size": [2, 2], "counts": [1, 2]},
        {"size": [2, 2], "counts": [5, -1]},
        {"size": [2, 2], "counts": "Q"},
        {"size": [2, 2], "counts": "é"},
        {"counts": [4]},
    ],
)
def test_damaged_masks_are_refused(segmentation):
    with pytest.raises(ValueError, match="mask"):
        bop.decode_rle(segmentation)


def test_a_data_set_is_in_metres(root):
    dataset = bop.Dataset(root)
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
    assert info.symmetry_rotations.shape == (315, 3, 3)
    farthest = 0.02 + np.hypot(0.02, 0.01)  # the axis is off the origin by (20, −10) mm
    assert np.abs(info.symmetry_translations).max() == pytest.approx(farthest, rel=1e-3)
    assert np.ptp(dataset.mesh(3).vertices, axis=0).max() < 0.13
    targets = dataset.given_targets(0, 2)
    assert [t.obj_id for t in targets] == [2, 3]
    assert targets[0].mask is not None and targets[0].mask.sum() == 20 * 28


def test_targets_without_a_file(root):
    dataset = bop.Dataset(root, targets="absent.json")
    assert dataset.targets == bop.Dataset(root).targets


def test_grey_jpg_and_tif_images(tmp_path):
    root = write_images(tmp_path / "grey", images=1)
    folder = root / "test" / "000000"
    Image.fromarray(np.full((48, 64), 77, np.uint8)).save(folder / "rgb" / "x.jpg")
    (folder / "gray").mkdir()
    (folder / "rgb" / "x.jpg").rename(folder / "gray" / "000000.jpg")
    (folder / "rgb" / "000000.png").unlink()
    Image.fromarray(np.full((48, 64), 1000, np.uint16)).save(folder / "depth" / "000000.tif")
    (folder / "depth" / "000000.png").unlink()
    frame = bop.Dataset(root).frame(0, 0)
    assert frame.rgb.shape == (48, 64, 3) and abs(int(frame.rgb.mean()) - 77) <= 1
    np.testing.assert_allclose(frame.depth, 0.5)


def test_a_sensors_own_files(tmp_path):
    root = write_images(tmp_path / "two", images=1)
    folder = root / "test" / "000000"
    (folder / "depth").rename(folder / "depth_left")
    camera = json.loads((folder / "scene_camera.json").read_text())
    camera["0"]["depth_scale"] = 2.0
    (folder / "scene_camera_left.json").write_text(json.dumps(camera))
    np.testing.assert_allclose(bop.Dataset(root, sensor="left").frame(0, 0).depth, 2.8)
    assert bop.Dataset(root).frame(0, 0).depth is None


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
        bop.Dataset(root).frame(0, 0)
    assert str(root) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_damaged_annotations_models_and_targets_are_named(tmp_path):
    root = write_images(tmp_path / "damaged", images=1)
    (root / "test" / "000000" / "scene_gt.json").write_text('{"0": [{"obj_id": 1, "cam_R_m2c": [1, 2, 3]}]}')
    with pytest.raises(DatasetError, match=r"scene_gt\.json, image 0, instance 0: cam_R_m2c must be 9 numbers"):
        bop.Dataset(root).truths(0, 0)
    (root / "models_eval" / "models_info.json").write_text('{"1": {"diameter": -4}}')
    with pytest.raises(DatasetError, match="object 1: the diameter must be a positive number"):
        bop.Dataset(root).models()
    (root / "test_targets_bop19.json").write_text('[{"scene_id": 0}]')
    with pytest.raises(DatasetError, match="entry 0: scene_id, im_id and obj_id"):
        _ = bop.Dataset(root).targets
    with pytest.raises(DatasetError, match="no such split; the data set has models_eval, test"):
        bop.Dataset(root, "val")
    with pytest.raises(DatasetError, match=r"obj_000009\.ply: no such model"):
        bop.Dataset(root).mesh(9)


def test_detections_and_the_best_of_them(tmp_path):
    mask = np.zeros((4, 5), bool)
    mask[1:3, 2:4] = True
    entry = {"scene_id": 0, "image_id": 1, "category_id": 2, "score": 0.5, "bbox": [2, 1, 2, 2], "time": 0.1}
    path = tmp_path / "detections.json"
    path.write_text(json.dumps([entry | {"segmentation": bop.encode_rle(mask)}, entry | {"score": 0.9}]))
    found = bop.read_detections(path)
    np.testing.assert_array_equal(found[0].mask, mask)
    assert found[1].mask is None
    targets = bop.detected_targets(found, [bop.TargetRow(0, 1, 2, 1)])
    assert [t.score for t in targets] == [0.9]
    path.write_text(json.dumps([{"scene_id": 1}]))
    with pytest.raises(DatasetError, match="entry 0: a detection needs"):
        bop.read_detections(path)


def test_the_mini_set_reads(shared):
    dataset = bop.Dataset(shared / "data" / "ycbv")
    assert len(dataset.targets) == 42
    assert len(dataset.models()) == 21
    frame = dataset.frame(50, 2)
    assert frame.depth is not None
    for target in dataset.given_targets(50, 2):
        assert target.mask is not None
        assert 0.4 < np.median(frame.depth[target.mask & (frame.depth > 0)]) < 1.6

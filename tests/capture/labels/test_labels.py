"""From a capture with poses to models and a BOP data set, as users go: ``ipjax capture model`` and ``label``."""

import json
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest
from builders.bop_roots import true_rows
from builders.command_lines import run
from PIL import Image

from ipjax.bop.dataset import Dataset
from ipjax.bop.results import write_results
from ipjax.bop.scoring.scores import score
from ipjax.capture.labels.dataset import write_dataset
from ipjax.capture.labels.masks import FrameLabels
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.making import SceneModels
from ipjax.capture.models.storing import read_models, write_models
from ipjax.capture.models.support import Support
from ipjax.capture.records import Trajectory
from ipjax.capture.trajectories import write_trajectory
from ipjax.commands.capture.model import describe_inputs
from ipjax.files.meshes.mesh import diameter, move
from ipjax.synthetic.captures import make_capture, write_capture
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.sensor import PERFECT
from ipjax.transforms import Similarity

VIEWS = 10


@pytest.fixture(scope="module")
def made():
    """Two cartons on a table, without noise and with depth registered as it should be."""
    objects = [make_object("carton", 3), make_object("carton", 4)]
    return make_capture(
        8, views=VIEWS, objects=objects, sizes=[0.2, 0.18], size=(200, 150), sensor=PERFECT, factory_error=0
    )


@pytest.fixture(scope="module")
def work(made, tmp_path_factory):
    """The capture on disc, labelled."""
    root = tmp_path_factory.mktemp("capture")
    write_capture(made, root / "table")
    (root / "work").mkdir()
    poses = Trajectory(made.names, made.world_from_camera, np.ones(VIEWS, bool), "given")
    write_trajectory(root / "work" / "poses.json", poses)
    words = [str(root / "table"), "-o", str(root / "work"), "--quiet"]
    assert run(["capture", "model", *words, "--voxel", "4"]) == 0
    assert run(["capture", "label", *words]) == 0
    return root


def place(made, index):
    """The true object in world."""
    poses = made.world_from_object
    pose = Similarity(poses.rotation[index], poses.translation[index], np.asarray(poses.scale[index]))
    return pose @ made.meshes[index].vertices


def find(made, models):
    """Of every true object, the index of its model."""
    middles = np.stack([model.world_from_model.translation for model in models])
    return [int(np.linalg.norm(middles - place(made, k).mean(0), axis=-1).argmin()) for k in range(2)]


def test_models_are_where_and_as_large_as_the_objects(made, work):
    models = read_models(work / "work" / "models")
    assert len(models) == 2 and sorted(find(made, models)) == [0, 1]
    for truth, index in enumerate(find(made, models)):
        model = models[index]
        true = place(made, truth)
        mine = model.world_from_model @ model.mesh.vertices
        # Bottoms are not seen: their walls go straight down to the table.
        assert np.abs(mine.min(0) - true.min(0)).max() < 0.006 and np.abs(mine.max(0) - true.max(0)).max() < 0.006
        assert abs(diameter(model.mesh) / made.world_from_object.scale[truth] - 1) < 0.05
        assert np.ptp(model.mesh.colours.astype(float), axis=0).max() > 30


def test_labels_are_those_of_the_truth(made, work):
    dataset = Dataset(work / "work" / "dataset")
    models = read_models(work / "work" / "models")
    overlaps, boxes = [], []
    for truth, index in enumerate(find(made, models)):
        for image in range(VIEWS):
            mine = dataset.mask(0, image, index)
            true = made.ids[image] == truth
            overlaps.append((mine & true).sum() / (mine | true).sum())
            assert not (mine & ~dataset.mask(0, image, index, visible=False)).any()
            x, y, width, height = dataset.truths(0, image)[index].box
            rows, columns = np.nonzero(true)
            boxes.append(
                [x - columns.min(), y - rows.min(), x + width - 1 - columns.max(), y + height - 1 - rows.max()]
            )
    assert np.median(overlaps) > 0.95 and min(overlaps) > 0.88
    assert np.abs(np.mean(boxes, axis=0)).max() < 1


def test_the_data_set_is_one_and_its_truth_scores_full(work, tmp_path):
    dataset = Dataset(work / "work" / "dataset")
    assert dataset.images(0) == list(range(VIEWS)) and len(dataset.targets) > VIEWS
    infos = dataset.models()
    for number, info in infos.items():
        assert abs(info.diameter - diameter(dataset.mesh(number))) < 1e-5
    for truth in dataset.truths(0, 0):
        assert 0 < truth.visible <= 1
    write_results(tmp_path / "truth.csv", true_rows(dataset))
    found = score(tmp_path / "truth.csv", dataset, ("mssd", "mspd"))
    assert all(recall == 1 for recall in found.all_frames.recalls.values())


def test_steps_are_not_repeated_and_begin_anew_when_told(work, capsys):
    words = [str(work / "table"), "-o", str(work / "work"), "--quiet", "--json"]
    before = (work / "work" / "models" / "models.json").stat().st_mtime_ns
    assert run(["capture", "model", *words, "--voxel", "4"]) == 0
    assert json.loads(capsys.readouterr().out)["made"] is False
    assert (work / "work" / "models" / "models.json").stat().st_mtime_ns == before
    assert run(["capture", "label", *words]) == 0
    assert json.loads(capsys.readouterr().out)["made"] is False


def test_what_is_wrong_is_said_in_a_sentence(work, tmp_path, capsys):
    words = [str(work / "table"), "-o", str(work / "work"), "--quiet"]
    assert run(["capture", "model", *words, "--object", "mug"]) == 2
    assert "NAME:X,Y" in capsys.readouterr().err
    assert run(["capture", "model", str(work / "table"), "-o", str(tmp_path)]) == 2
    assert "ipjax capture pose" in capsys.readouterr().err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("keep me")
    assert run(["capture", "label", *words, "--dataset", str(tmp_path / "mine")]) == 2
    assert run(["capture", "label", *words, "--dataset", str(tmp_path / "mine" / "letter.txt")]) == 2
    assert run(["capture", "label", *words, "--dataset", str(tmp_path / "mine" / "letter.txt" / "inside")]) == 2
    assert "letter.txt is a file" in capsys.readouterr().err
    assert (tmp_path / "mine" / "letter.txt").is_file()


def test_what_others_made_is_not_replaced(work, tmp_path, capsys):
    table, poses = str(work / "table"), (work / "work" / "poses.json").read_text()
    assert run(["capture", "model", table, "-o", table, "--quiet"]) == 2
    assert "would replace the capture's own files" in capsys.readouterr().err
    # The folder of a BOP data set, whose models were made by someone else.
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "obj_000001.ply").write_text("keep me")
    (tmp_path / "poses.json").write_text(poses)
    assert run(["capture", "model", table, "-o", str(tmp_path), "--quiet"]) == 2
    assert "has no models of ipjax capture" in capsys.readouterr().err
    assert (tmp_path / "models" / "obj_000001.ply").read_text() == "keep me"


def test_objects_of_any_name_have_files_of_their_own(work, tmp_path):
    names = ("scene", "a b", "a_b", "../mug", "mug_points", "mug")
    model = read_models(work / "work" / "models")[0]
    objects = tuple(
        replace(model, name=name, mesh=move(model.mesh, np.eye(3), scale=1.0 + k)) for k, name in enumerate(names)
    )
    support = Support(Similarity(np.eye(3), np.zeros(3), np.ones(())), np.zeros(2), np.ones((1, 1), bool), 1.0, 0.0)
    write_models(tmp_path / "models", SceneModels(objects, model.mesh, support, ()))
    again = read_models(tmp_path / "models")
    assert tuple(item.name for item in again) == names
    for item, true in zip(again, objects, strict=True):
        np.testing.assert_allclose(item.mesh.vertices, true.mesh.vertices, atol=1e-6)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["models"]


def test_depth_beyond_the_form_is_unknown(tmp_path):
    depth = np.full((4, 6), 1.2345, np.float32)
    depth[0, 0], depth[0, 1] = 6.5535, 7.2
    still = Similarity(np.eye(3), np.zeros(3), np.ones(()))
    frame = PosedFrame("a", np.zeros((4, 6, 3), np.uint8), depth, depth > 0, np.diag([5.0, 5, 1]), still)
    none = np.zeros((0, 4, 6), bool)
    write_dataset(tmp_path / "dataset", [], [frame], [FrameLabels((), none, none, (), ())])
    with Image.open(tmp_path / "dataset" / "test" / "000000" / "depth" / "000000.png") as image:
        written = np.asarray(image)
    assert written[0].tolist() == [65535, 0, 12345, 12345, 12345, 12345]


def test_steps_are_kept_where_the_work_is_in_the_folder_of_the_capture(tmp_path):
    table = tmp_path / "table"
    (table / "rgb").mkdir(parents=True)
    (table / "rgb" / "0.png").write_text("an image")
    (table / "work").mkdir()
    (table / "work" / "poses.json").write_text("{}")
    words = Namespace(folder=table, form=None, camera=None, depth_scale=None, every=1)
    before = describe_inputs(words, table / "work", {})
    (table / "work" / "models.png").write_text("a picture")
    assert describe_inputs(words, table / "work", {}) == before
    (table / "rgb" / "1.png").write_text("another")
    assert describe_inputs(words, table / "work", {}) != before

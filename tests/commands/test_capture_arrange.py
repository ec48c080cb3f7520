"""``ipjax capture arrange``: meshes in new arrangements, with the truth, as a data set in BOP's layout."""

import json

import numpy as np
import pytest
from builders.bop_roots import true_rows
from builders.command_lines import run

from ipjax.bop.dataset import Dataset
from ipjax.bop.results import write_results
from ipjax.bop.scoring.scores import score
from ipjax.cameras import project
from ipjax.files.meshes.mesh import move
from ipjax.files.meshes.saving import save_mesh
from ipjax.synthetic.objects import make_object


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two meshes in millimetres, and two scenes of three things."""
    root = tmp_path_factory.mktemp("arrange")
    for kind, size in (("carton", 150.0), ("corner", 120.0)):
        save_mesh(move(make_object(kind, 2), np.eye(3), scale=size), root / f"{kind}.ply")
    assert run(words(root, "made", "--quiet")) == 0
    return root


def words(root, name, *more):
    given = [str(root / "carton.ply"), str(root / "corner.ply"), "--unit", "mm", "-o", str(root / name)]
    options = ["--things", "3", "--scenes", "2", "--count", "2", "--size", "128x96"]
    return ["capture", "arrange", *given, *options, *more]


def test_the_truth_is_that_of_the_images(folder, tmp_path):
    dataset = Dataset(folder / "made")
    assert dataset.scenes() == [0, 1] and dataset.images(1) == [0, 1]
    infos = json.loads((folder / "made" / "models" / "models_info.json").read_text())
    assert abs(infos["1"]["diameter"] - 150) < 0.5 and abs(infos["2"]["diameter"] - 120) < 0.5
    for scene in dataset.scenes():
        for image in dataset.images(scene):
            truth = json.loads(((dataset.root / "test" / f"{scene:06d}") / "scene_gt.json").read_text())[str(image)]
            info = json.loads(((dataset.root / "test" / f"{scene:06d}") / "scene_gt_info.json").read_text())[str(image)]
            K, _ = dataset.camera(scene, image)
            depth, taken = dataset.depth(scene, image), np.zeros((96, 128), int)
            assert sorted({entry["obj_id"] for entry in truth}) == [1, 2] and len(truth) == 3
            for index, (entry, about) in enumerate(zip(truth, info, strict=True)):
                mask = dataset.mask(scene, image, index)
                taken += mask
                x, y = project(K, np.reshape(entry["cam_t_m2c"], (1, 3)))[0]
                box = about["bbox_obj"]
                assert box[0] - 2 < x < box[0] + box[2] + 2 and box[1] - 2 < y < box[1] + box[3] + 2
                if mask.any():
                    assert abs(np.median(depth[mask]) - entry["cam_t_m2c"][2] / 1000) < 0.1
                    assert about["px_count_visib"] == mask.sum() and about["visib_fract"] <= 1
            assert taken.max() == 1 and (depth > 0).all()
    targets = json.loads((folder / "made" / "test_targets_bop19.json").read_text())
    assert {target["inst_count"] for target in targets} == {1, 2}
    write_results(tmp_path / "truth.csv", true_rows(dataset))
    assert score(tmp_path / "truth.csv", dataset, ("mssd",)).all_frames.recalls["mssd"] == 1


def test_the_same_seed_makes_the_same(folder, capfd):
    assert run(words(folder, "made")) == 0
    assert "made of the same already" in capfd.readouterr().out
    assert run(words(folder, "again", "--json", "--quiet")) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["scenes"] == 2 and told["objects"] == ["carton", "corner"] and told["deepest_contact_m"] < 0.0008
    files = lambda name: {p.relative_to(folder / name): p for p in (folder / name / "test").rglob("*") if p.is_file()}
    first, second = files("made"), files("again")
    assert first.keys() == second.keys() and len(first) > 20
    for name, path in first.items():
        assert path.read_bytes() == second[name].read_bytes(), name
    assert (folder / "made.png").is_file()


def test_what_is_no_model_is_said_in_a_sentence(folder, tmp_path, capfd):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("no mesh")
    for what, words_of_it in (
        ("empty", "models.json"),
        ("notes.txt", "no folder of models"),
        ("gone.ply", "no mesh file"),
    ):
        assert run(["capture", "arrange", str(tmp_path / what), "-o", str(tmp_path / "out")]) == 2
        assert words_of_it in capfd.readouterr().err
    bop = tmp_path / "bop"
    bop.mkdir()
    save_mesh(make_object("carton", 2), bop / "obj_000001.ply")
    for text in ("[1]", '{"1": [1]}', '{"1": {"symmetries_continuous": [{"axis": [0, 0, 1]}]}}'):
        (bop / "models_info.json").write_text(text)
        assert run(["capture", "arrange", str(bop), "-o", str(tmp_path / "out")]) == 2
        assert "not as BOP has it" in capfd.readouterr().err
    # Millimetres taken for metres.
    assert run(["capture", "arrange", str(folder / "carton.ply"), "-o", str(tmp_path / "out")]) == 2
    assert "is its unit right" in capfd.readouterr().err


def test_what_is_not_ours_is_not_replaced(folder, tmp_path, capfd, monkeypatch):
    assert run(words(folder, "kept", "--quiet", "--scenes", "1", "--count", "1")) == 0
    (folder / "kept" / "notes").mkdir()
    (folder / "kept" / "notes" / "mine.txt").write_text("mine")
    assert run(words(folder, "kept", "--quiet", "--again")) == 2
    assert "has notes in it" in capfd.readouterr().err
    assert (folder / "kept" / "notes" / "mine.txt").read_text() == "mine"
    (tmp_path / "file").write_text("mine")
    mesh = str(folder / "carton.ply")
    assert run(["capture", "arrange", mesh, "--unit", "mm", "-o", str(tmp_path / "file")]) == 2
    assert "in the way" in capfd.readouterr().err
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert run(["capture", "arrange", mesh, "--unit", "mm", "-o", "."]) == 2
    assert "a folder of its own" in capfd.readouterr().err and not list(tmp_path.glob("here/*"))

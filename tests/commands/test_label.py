"""``ipjax label`` as it is typed: shards, parts of them, what resumes, what is refused, and all of it merged."""

import json

import numpy as np
import pytest
from builders.command_lines import run
from builders.fake_labels import hash_labels
from builders.labelled_frames import (
    labelled_objects,
    labeller,
    make_frames,
    named_encoder,
    write_image_wise,
    write_objects,
    write_settings,
)
from builders.tiny_pipeline import assert_near

from ipjax.bop.dataset import Dataset
from ipjax.bop.results import read_results
from ipjax.commands import label
from ipjax.files.images.annotations import read_annotations
from ipjax.labelling import batch
from ipjax.labelling.outputs import tables

COUNT = 6


@pytest.fixture
def words(tmp_path, monkeypatch):
    """What is typed for six frames in shards of four; with the stand-in encoder, and programs that tests share."""
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    monkeypatch.setattr(label, "_load_encoder", lambda *_: named_encoder())
    monkeypatch.setattr(batch, "Labeller", lambda *_: labeller(threads=2))
    source = write_image_wise(tmp_path / "frames", make_frames(COUNT))
    objects = write_objects(tmp_path / "objects")
    settings = write_settings(tmp_path / "settings.json")

    def typed(out: str, *more: str) -> list[str]:
        given = ["label", str(source), "-o", str(tmp_path / out), "--objects", str(objects), "--config", str(settings)]
        return [*given, "--shard-size", "4", "--batch", "3", "--previews", "5", "--quiet", *more]

    return typed


def read_out(capsys):
    return json.loads(capsys.readouterr().out)


def test_frames_are_labelled_in_shards_and_merged(words, tmp_path, capsys):
    assert run(words("out", "--json")) == 0
    said = read_out(capsys)
    assert (said["shards_labelled"], said["frames"], said["bad"]) == (2, COUNT, [])
    before = hash_labels(tmp_path / "out")
    assert run(words("out", "--json")) == 0
    assert read_out(capsys)["shards_before"] == 2 and hash_labels(tmp_path / "out") == before
    # In parts, each by a worker of its own, the shards are the same.
    for part in ("1/2", "0/2"):
        assert run(words("parts", "--shard", part, "--json")) == 0
        assert read_out(capsys)["shards_labelled"] == 1
    assert hash_labels(tmp_path / "parts") == before
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["frames"] == COUNT and [one["number"] for one in manifest["objects"]] == [1, 2]
    assert len(manifest["code"]) == 16 and manifest["encoder"] == "coordinates"

    assert run(words("out", "--merge", "--images", "--json")) == 0
    told = read_out(capsys)
    assert (told["frames"], told["labels"], told["bad"], told["collisions"]) == (COUNT, COUNT, 0, 0)
    merged = tmp_path / "out" / "merged"
    rows = read_results(merged / "labels.csv")
    assert [row.im_id for row in rows] == list(range(COUNT))
    dataset = Dataset(merged)
    assert dataset.scenes() == [0] and dataset.images(0) == list(range(COUNT))
    for number, frame in enumerate(make_frames(COUNT)):
        obj = number % 2
        again = dataset.frame(0, number)
        np.testing.assert_array_equal(again.rgb, frame.rgb)
        (truth,) = dataset.truths(0, number)
        assert truth.obj_id == obj + 1 and truth.visible > 0.6
        mask = dataset.mask(0, number, 0)
        assert (mask & frame.mask).sum() / (mask | frame.mask).sum() > 0.75
        # The label is the pose of the mesh file in millimetres, at the size that was found.
        pose = rows[number].camera_from_object
        mesh_from_object = labelled_objects()[obj][1].object_from_mesh.to_numpy().inverse()
        centre = frame.camera_from_object.to_numpy().translation
        scale = float(frame.camera_from_object.scale) / 0.2
        sized = type(pose)(pose.rotation, pose.translation, np.asarray(scale * 1e-3))
        assert_near((sized @ mesh_from_object).to_jax(), frame.camera_from_object, 0.1, 1e-4, 12)
        assert np.linalg.norm((sized @ mesh_from_object).translation - centre) < 0.02
    coco = read_annotations(merged / "coco.json")
    assert [one.category_id for one in coco] == [1, 2] * 3 and all(one.decode().any() for one in coco)
    page = (merged / "quality.html").read_text()
    assert page.count("data:image/jpeg") == COUNT and "obj_000002" in page and "picked by chance" in page
    quality = json.loads((merged / "quality.json").read_text())
    assert quality["labels"] == COUNT


def test_tables_are_parquet_where_pyarrow_is(words, tmp_path, capsys, monkeypatch):
    parquet = pytest.importorskip("pyarrow.parquet")
    assert run(words("out")) == 0
    assert "Parquet" not in capsys.readouterr().err
    table = parquet.read_table(tmp_path / "out" / "shards" / "000001" / "table.parquet").to_pydict()
    monkeypatch.setattr(tables, "has_parquet", lambda: False)
    monkeypatch.setattr("ipjax.labelling.shards.working.has_parquet", lambda: False)
    assert run([word for word in words("plain") if word != "--quiet"]) == 0
    assert "for Parquet, pip install 'ipjax[tables]'" in capsys.readouterr().err
    plain = np.load(tmp_path / "plain" / "shards" / "000001" / "table.npz")
    assert set(table) == set(plain) and table["frame"] == plain["frame"].tolist() == ["000000_000004", "000000_000005"]
    for name in plain.files:
        if plain[name].dtype.kind == "f":
            np.testing.assert_array_equal(np.array(table[name]), plain[name])


def test_a_shard_that_is_missing_is_named(words, capsys):
    assert run(words("out", "--shard", "0/2")) == 0
    assert run(words("out", "--merge")) == 2
    assert "1 of 2 shards are not labelled: 000001; run 'ipjax label' again" in capsys.readouterr().err


def test_frames_that_cannot_be_used_are_listed(words, tmp_path, capsys):
    (tmp_path / "frames" / "000000_000001.depth.png").write_bytes(b"broken")
    assert run(words("out", "--json")) == 0
    (bad,) = read_out(capsys)["bad"]
    assert bad["frame"] == "000000_000001" and "depth.png" in bad["reason"]
    assert str(tmp_path) not in (tmp_path / "out" / "shards" / "000000" / "bad_frames.json").read_text()
    assert run(words("out", "--merge", "--json")) == 0
    assert read_out(capsys)["bad"] == 1
    page = (tmp_path / "out" / "merged" / "quality.html").read_text()
    assert "1 frames" in page and "000000_000001" in page


def test_labels_of_something_else_are_not_continued(words, tmp_path, capsys):
    assert run(words("out")) == 0
    capsys.readouterr()
    for more in (("--seed", "1"), ("--set", "match.views=3"), ("--batch", "2"), ("--obj-id", "4", "--obj-id", "5")):
        assert run(words("out", *more)) == 2
        assert "made with something else" in capsys.readouterr().err
    assert run(words("out", "--seed", "1", "--restart", "--shard", "0/2")) == 0
    assert [path.name for path in (tmp_path / "out" / "shards").iterdir()] == ["000000"]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--shard", "2/2"], "is no part: give I/N"),
        (["--seek", "--detections", "a.json"], "one of them"),
        (["--images"], "--images belongs to --merge"),
        (["--merge", "--restart"], "one of them"),
        (["--merge"], "no such manifest of labels"),
        (["--previews", "-1"], "--previews is a number from 0 on"),
        (["--obj-id", "4"], "once for each object"),
        (["--obj-id", "4", "--obj-id", "4"], "numbers of their own"),
        (["--objects", "none.ipjax"], "none.ipjax: no such object file"),
        (["--split", "../test"], "--split is the name of a folder"),
        (["--split", ".."], "--split is the name of a folder"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(words, more, said, capsys):
    assert run(words("out", *more)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and said in error, error


def test_what_is_read_is_not_removed(words, tmp_path, capsys):
    """Frames in a folder that is called as those of labels are: --restart removes labels, and nothing else."""
    source = write_image_wise(tmp_path / "data" / "shards", make_frames(1))
    given = words("data", "--restart")
    given[1] = str(source)
    assert run(given) == 2
    assert "choose another -o" in capsys.readouterr().err and len(list(source.iterdir())) == 5
    stranger = tmp_path / "out" / "work" / "letter.txt"
    stranger.parent.mkdir(parents=True)
    stranger.write_text("dear")
    assert run(words("out", "--restart", "--shard", "1/2")) == 0
    assert stranger.is_file(), "there were no labels to forget"


def test_a_source_without_frames_is_refused(words, tmp_path, capsys):
    scene = tmp_path / "bop" / "test" / "000001"
    scene.mkdir(parents=True)
    (scene / "scene_camera.json").write_text("{}")
    given = words("out")
    given[1] = str(tmp_path / "bop")
    assert run(given) == 2
    assert "bop: it has no frames" in capsys.readouterr().err


def test_masks_in_a_folder_of_detections_are_used_and_told_apart(words, tmp_path, capsys):
    folder = tmp_path / "cnos"
    folder.mkdir()

    def write(score):
        mask = make_frames(1)[0].mask[None].astype(np.uint8)
        about = {"scene_id": 0, "image_id": 0, "time": 0.1, "bbox": np.array([[0, 0, 9, 9]])}
        np.savez(folder / "0.npz", **about, category_id=np.array([1]), score=np.array([score]), segmentation=mask)

    write(0.9)
    detections = ("--detections", str(folder), "--shard", "0/2", "--json")
    assert run(words("out", *detections)) == 0
    assert read_out(capsys)["frames"] == 4
    assert len(read_results(tmp_path / "out" / "shards" / "000000" / "labels.csv")) == 1
    write(0.8)
    assert run(words("out", *detections)) == 2
    assert "made with something else (detections.files)" in capsys.readouterr().err

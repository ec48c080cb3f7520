"""``ipjax capture run``: a folder of frames becomes a data set that loads, and a page that shows how."""

import json
import shutil

import numpy as np
import pytest
from builders.command_lines import run
from builders.killed_runs import hash_files

from ipjax.bop.dataset import Dataset
from ipjax.capture.dataset import make_dataset, name_work
from ipjax.capture.models.making import ModelConfig
from ipjax.capture.steps.chain import STEPS
from ipjax.capture.steps.running import Listener
from ipjax.capture.steps.settings import RunSettings
from ipjax.commands.capture import run as command
from ipjax.synthetic.captures import make_capture, write_capture
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.sensor import PERFECT

NAMES = [step.name for step in STEPS]
# Voxels as wide as what a pixel of these images sees; the depth camera, which others test, is not solved.
SETTINGS = RunSettings(depth_mode="factory", models=ModelConfig(voxel=0.004))


@pytest.fixture(scope="module")
def made():
    """A quarter of the way around a table with two cartons, in small images."""
    cartons = [make_object("carton", 1), make_object("carton", 3)]
    return make_capture(
        3, views=6, arc=90, objects=cartons, sizes=(0.2, 0.2), size=(240, 180), sensor=PERFECT, factory_error=0
    )


@pytest.fixture(scope="module")
def folder(made, tmp_path_factory):
    return write_capture(made, tmp_path_factory.mktemp("capture") / "table", poses=True)


@pytest.fixture(scope="module")
def undisturbed(folder, tmp_path_factory):
    """A data set that was made at once."""
    dataset = tmp_path_factory.mktemp("undisturbed") / "mytable"
    made = make_dataset(folder, dataset, settings=SETTINGS)
    assert [one.step.name for one in made.done] == NAMES and all(one.why for one in made.done) and not made.stopped
    return dataset


def test_the_command_knows_all_steps():
    assert tuple(NAMES) == command.STEPS


def test_the_data_set_loads_and_is_true(made, undisturbed):
    dataset = Dataset(undisturbed)
    assert dataset.scenes() == [0] and len(dataset.models()) == 2
    assert sorted(path.name for path in undisturbed.iterdir()) == [
        "camera.json", "dataset_info.json", "models", "models_eval", "test", "test_targets_bop19.json",
    ]  # fmt: skip
    frame, truths = dataset.frame(0, 0), dataset.truths(0, 0)
    np.testing.assert_array_equal(frame.rgb, made.rgb[0])
    assert len(truths) == 2
    # Each label is one of the objects that stand there, in all frames.
    found = set()
    for index in range(2):
        overlaps = np.zeros((len(made.names), 2))
        for image in range(len(made.names)):
            mask = dataset.mask(0, image, index)
            for number in range(2):
                true = made.ids[image] == number
                overlaps[image, number] = (mask & true).sum() / (mask | true).sum()
        assert np.median(overlaps, axis=0).max() > 0.85
        found.add(int(np.median(overlaps, axis=0).argmax()))
    assert found == {0, 1}


def test_the_report_shows_all_steps(undisturbed):
    page = (name_work(undisturbed) / "report.html").read_text()
    assert page.count("data:image/jpeg;base64,") == len(STEPS) and 'src="http' not in page
    for step in STEPS:
        assert f'id="{step.name}"' in page and step.caption.replace("'", "&#39;")[:60] in page
    assert "6 of 6" in page and "What next" in page and str(undisturbed.parent) not in page


class _Interrupting:
    """Interrupts a run in the middle of a step."""

    def __init__(self, name):
        self.name, self.begun = name, []

    def begin(self, step, why):
        self.begun.append(step.name)

    def show(self, part, done, total):
        if self.begun[-1] == self.name and done:
            raise KeyboardInterrupt


def test_interrupted_in_every_step_it_ends_with_the_same_files(folder, undisturbed, tmp_path):
    dataset = tmp_path / "mytable"
    for index, name in enumerate(NAMES):
        listener = _Interrupting(name)
        with pytest.raises(KeyboardInterrupt):
            make_dataset(
                folder, dataset, settings=SETTINGS, listener=Listener(begins=listener.begin, progress=listener.show)
            )
        assert listener.begun == NAMES[max(index - 1, 0) : index + 1]  # what was interrupted last, and this one
        assert not dataset.exists()
    assert [one.why is None for one in make_dataset(folder, dataset, settings=SETTINGS).done] == [True] * (
        len(NAMES) - 1
    ) + [False]
    assert hash_files(dataset) == hash_files(undisturbed)
    assert hash_files(name_work(dataset)) == hash_files(name_work(undisturbed))


def test_a_second_run_keeps_everything(folder, undisturbed, capfd):
    before = hash_files(name_work(undisturbed))
    words = [
        "capture",
        "run",
        str(folder),
        "-o",
        str(undisturbed),
        "--voxel",
        "4",
        "--depth-mode",
        "factory",
        "--quiet",
    ]
    assert run([*words, "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert [step["step"] for step in told["steps"]] == NAMES and not any(step["made"] for step in told["steps"])
    assert told["dataset"] == str(undisturbed) and told["stopped"] is None
    assert told["steps"][1]["figures"]["frames with a pose"] == ["6 of 6", ""]
    assert run([*words, "--from", "label"]) == 0
    out = capfd.readouterr().out
    assert out.count("(kept)") == len(NAMES) - 1 and "look at" in out and "report.html" in out
    assert hash_files(name_work(undisturbed)) == before


def test_refuses_in_one_line(folder, undisturbed, tmp_path, capfd):
    def refused(*words, status=2) -> str:
        assert run(["capture", "run", *map(str, words), "--quiet"]) == status
        err = capfd.readouterr().err
        assert err.startswith("ipjax: ") and err.count("\n") == 1
        return err

    assert "no such folder" in refused(tmp_path / "nothing", "-o", tmp_path / "out")
    assert "describes no board" in refused(folder, "-o", tmp_path / "out", "--board", "chess:7x5")
    assert "--voxel is in millimetres" in refused(folder, "-o", tmp_path / "out", "--voxel", "0.002")
    assert "lies in the data set" in refused(folder, "-o", tmp_path / "out", "--work", tmp_path / "out" / "work")
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("x")
    assert "no data set of ipjax capture" in refused(folder, "-o", mine)
    assert list(tmp_path.iterdir()) == [mine]  # nothing was begun
    copy = shutil.copytree(undisturbed, tmp_path / "copy")
    (copy / "results.csv").write_text("x")
    assert "has results.csv in it" in refused(folder, "-o", copy)
    assert "the capture itself lies in it" in refused(
        folder, "-o", tmp_path / "out", "--work", folder, "--from", "model"
    )
    assert "the capture itself lies in it" in refused(undisturbed / "test" / "000000", "-o", undisturbed)
    file = tmp_path / "file"
    file.write_text("x")
    assert "a file of this name is in the way" in refused(folder, "-o", file)


def test_stops_where_the_check_says_so(made, tmp_path, capfd):
    folder = write_capture(made, tmp_path / "dark")
    for path in (folder / "depth").iterdir():
        if path.name > "000001.png":
            path.unlink()
            (folder / "rgb" / path.name).unlink()
            (folder / "raw" / path.name).unlink()
    assert run(["capture", "run", str(folder), "-o", str(tmp_path / "out"), "--quiet"]) == 1
    assert "It stops here: There are 2 frames" in capfd.readouterr().out
    page = (tmp_path / "out.work" / "report.html").read_text()
    assert "It stopped at the step check. There are 2 frames" in page and "Not done." in page
    assert not (tmp_path / "out").exists()

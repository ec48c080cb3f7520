"""``ipjax evaluate`` and the page of results, as commands, on a small exact data set with a stand-in encoder."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from builders.bop_roots import write_ellipsoids

from ipjax import cli
from ipjax.bop.dataset import Dataset
from ipjax.bop.detections import as_detection, read_detections, write_detections
from ipjax.bop.results import read_results
from ipjax.commands import evaluate as evaluate_command

HERE = Path(__file__).resolve().parents[1]
VIEWS = ["--directions", "6", "--rolls", "4"]
SETTINGS = {
    "quick": {"from": "paper", "match": {"views": 2, "pairs": 32}, "align": {"count": 64}},
    "quicker": {"from": "paper", "match": {"views": 1, "pairs": 24}, "align": {"count": 32}},
}


def start(*words, pause: float = 0.0, stderr: int = subprocess.STDOUT) -> subprocess.Popen:
    environment = dict(os.environ, JAX_COMPILATION_CACHE_DIR=str(HERE.parent / "build" / "xla-cache"))
    roots = [str(HERE.parent), str(HERE.parent / "kernels"), *sys.path]
    environment["PYTHONPATH"] = os.pathsep.join(p for p in roots if p)
    return subprocess.Popen(
        [sys.executable, str(HERE / "builders" / "stand_in.py"), str(pause), *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        env=environment,
    )


def finish(process: subprocess.Popen) -> str:
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0, out[-3000:]
    return out


def results(folder: Path) -> tuple[list[str], dict]:
    """The lines of the result file without their times, and the score without its times."""
    (path,) = folder.glob("*-test.csv")
    score = json.loads((folder / "score.json").read_text())
    del score["seconds_per_image"]
    for one in score["objects"].values():
        del one["seconds"]
    return [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()], score


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("evaluate")
    write_ellipsoids(folder / "balls")
    for name, entry in SETTINGS.items():
        (folder / f"{name}.json").write_text(json.dumps(entry))
    return folder


def evaluate(place: Path, out: str, *more, **how) -> subprocess.Popen:
    words = ["ipjax", "evaluate", place / "balls", "--objects", place / "objects", "-o", place / out]
    return start(*words, "--config", place / "quick.json", "--quiet", *VIEWS, *more, **how)


def test_results_are_named_in_words_that_a_file_name_may_have():
    words = ["evaluate", "data", "-o", "out", "--config", "my settings, new.json", "--set", "align.scale_gate=0.5, 2"]
    name = evaluate_command._method(cli.build_parser().parse_args([*words, "--known-size"]))
    assert name == "ipjax-my-settings-new-align.scale_gate-0.5-2-known-size"


@pytest.fixture(scope="module")
def whole(place) -> str:
    """An uninterrupted run."""
    return finish(evaluate(place, "whole", "--without", "1/0"))


def test_detections_take_the_place_of_annotated_masks(place, whole, capsys):
    """The annotated masks as somebody's detections: the same poses, and the detector's time is added."""
    data = Dataset(place / "balls")
    found = []
    for scene, image in data.target_images:
        for target in data.given_targets(scene, image):
            assert target.mask is not None
            worse = target.mask & (np.arange(target.mask.shape[1]) > target.mask.shape[1] // 2)
            for mask, score in ((worse, 0.4), (target.mask, 1.0)):
                found.append(as_detection(scene, image, target.obj_id, score, mask, 100.0))
    path = write_detections(place / "mine_balls-test.json", found)
    finish(evaluate(place, "detected", "--detections", path))
    assert results(place / "detected")[0] == results(place / "whole")[0]
    rows = read_results(next((place / "detected").glob("*-mine-balls-test_balls-test.csv")))
    assert rows and all(row.time > 100 for row in rows)
    # Of 2024's targets nobody says how many there are, so that every detection is estimated.
    asked = [{"scene_id": s, "im_id": i} for s, i in data.target_images]
    (place / "balls" / "asked.json").write_text(json.dumps(asked))
    finish(evaluate(place, "asked", "--detections", path, "--targets", "asked.json", "--metrics", "ap"))
    rows = read_results(next((place / "asked").glob("*-test.csv")))
    assert len(rows) == len(found) and len({(r.scene_id, r.im_id) for r in rows}) == len(asked)
    path.write_text(json.dumps([json.loads(path.read_text())[0] | {"segmentation": {}}]))
    words = ["evaluate", str(place / "balls"), "-o", str(place / "none"), "--detections", str(path)]
    assert cli.main(words) == 2 and "boxes, but no masks" in capsys.readouterr().err


def test_objects_are_sought_where_no_mask_is_read(place, whole):
    bare = place / "bare"
    shutil.copytree(place / "balls", bare)
    for folder in bare.glob("test/*/mask_visib"):
        shutil.rmtree(folder)
    words = ["ipjax", "evaluate", bare, "--objects", place / "objects", "-o", place / "sought", "--detect"]
    finish(start(*words, "--config", place / "quick.json", "--quiet", "--metrics", "mssd", *VIEWS))
    (path,) = (place / "sought").glob("*-sought_bare-test.csv")
    rows, images = read_results(path), set(Dataset(bare).target_images)
    assert rows and {(row.scene_id, row.im_id) for row in rows} <= images
    found = read_detections(place / "sought" / "detections.json")
    name = lambda one: (one.scene_id, one.im_id, one.obj_id)
    assert [name(one) for one in found] == [name(row) for row in rows]
    assert [one.score for one in found] == pytest.approx([row.score for row in rows])


def test_the_tables_are_printed(place, whole):
    rows, score = results(place / "whole")
    assert len(rows) == 1 + 6
    assert score["all_frames"]["recalls"]["ar"] > 0.4  # the set can be solved, so equal numbers mean something
    for word in ("AR_VSD", "AR_MSSD", "AR_MSPD", "one frame per scene", "all frames, without 1/0", "Median errors"):
        assert word in whole
    assert "size to 5 %" in whole  # the sizes are kept beside the BOP file, and the command finds them there
    (path,) = (place / "whole").glob("*-test.csv")
    again = finish(start("ipjax", "score", path, place / "balls", "--metrics", "mssd", "mspd"))
    sized = [
        [x.split() for x in out.splitlines() if x.startswith("all frames ") and x.count("[") == 5]
        for out in (whole, again)
    ]
    assert len(sized[0]) == 1 and sized[0] == sized[1]
    assert re.search(r"Time per image: \d", whole) and re.search(r"\d\.\d \[\d", whole)


def test_killed_at_once_and_run_again_it_gives_the_same_numbers(place, whole):
    for kills in (1, 3):
        process = evaluate(place, "killed", "--without", "1/0", pause=0.4)
        journal, begin = place / "killed" / "results.jsonl", time.monotonic()
        while not journal.is_file() or journal.read_bytes().count(b"\n") < 1 + kills:
            assert process.poll() is None and time.monotonic() - begin < 240
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
        process.communicate()
        assert kills <= journal.read_bytes().count(b"\n") - 1 < 6
        assert not (place / "killed" / "score.json").exists()
    with open(journal, "ab") as file:
        file.write(b'{"image": [1, ')  # what a crash in the middle of a write leaves
    finish(evaluate(place, "killed", "--without", "1/0"))
    images = [json.loads(line)["image"] for line in journal.read_text().splitlines()[1:]]
    assert sorted(images) == [[s, i] for s in range(2) for i in range(3)]  # none twice, none lost
    assert results(place / "killed") == results(place / "whole")


def test_a_machine_reads_the_same_score(place, whole):
    """Finished images are not done twice, so that this takes no time; what is printed elsewhere goes to stderr."""
    process = evaluate(place, "whole", "--without", "1/0", "--json", stderr=subprocess.PIPE)
    out, error = process.communicate(timeout=300)
    assert process.returncode == 0, error
    told, kept = json.loads(out), json.loads((place / "whole" / "score.json").read_text())
    assert told["not_found"] == [] and told["all_frames"] == kept["all_frames"]
    assert "AR_VSD" not in out + error


def test_a_changed_setting_is_recorded_by_its_name(place, whole):
    (journal,) = (place / "whole").glob("results.jsonl")
    before = journal.read_bytes()
    process = evaluate(place, "whole", "--set", "match.views=1")
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 2 and "settings.config.match.views" in out and "Traceback" not in out
    assert journal.read_bytes() == before


def test_other_settings_are_refused(place, whole):
    process = evaluate(place, "whole", "--seed", "1")
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 2 and "other settings (settings.seed)" in out and "Traceback" not in out


def test_one_command_runs_all_and_makes_the_page(place, whole):
    words = ["benchmark", place / "balls", "--methods", place / "quicker.json", place / "quick.json", "--quiet"]
    words += ["--objects", place / "objects", "-o", place / "study", "--page", place / "page" / "accuracy"]
    out = finish(start(*words))
    # The second method uses what the first has loaded and described, and its answers are the same.
    assert "shared: True 1" in out
    mine, theirs = results(place / "study" / "balls" / "scans" / "quick"), results(place / "whole")
    assert mine[0] == theirs[0]
    assert mine[1]["all_frames"] == theirs[1]["all_frames"]
    assert out.count("one frame per scene") == 2 * 2 and "Objects won against ipjax-quicker" in out
    text = (place / "page" / "accuracy.md").read_text()
    ar = f"{100 * mine[1]['one_frame_per_scene']['recalls']['ar']:.1f}"
    assert re.search(rf"\| balls, scans \| ipjax-quick \| 2 \|.*\| {re.escape(ar)} \[", text)
    assert "| wins |" in text and str(place) not in text
    kept = mine[1]["all_frames"]["sized"]
    cells = " | ".join(f"{100 * kept[name]:.1f}" for name in ("size_2", "size_5", "size_10"))
    assert "size to 10 % |" in text and f"| {cells} |" in text
    page = (place / "page" / "accuracy.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 6 and page.count("<svg") == 5
    assert "http" not in page and "<script" not in page and str(place) not in page


def test_the_page_shows_the_model_where_the_estimate_is(place, whole):
    from benchmarks.results_page.pictures import cut, draw_models, square_around
    from benchmarks.results_page.runs import Study, read_run

    run = read_run(place / "whole")
    study = Study("balls", place / "balls", None, [run])
    from ipjax.bop.dataset import Dataset
    from ipjax.bop.results import read_results

    rows = {
        (r.scene_id, r.im_id, r.obj_id, r.score): r for r in read_results(next((place / "whole").glob("*-test.csv")))
    }
    found = [i for i in run["instances"] if i["found"]][:2]
    dataset = Dataset(place / "balls")
    for one, picture in zip(found, draw_models(study, found, rows), strict=True):
        mask = dataset.mask(one["scene_id"], one["im_id"], 0)
        drawn = picture.any(-1)
        assert (drawn & mask).sum() > 0.7 * (drawn | mask).sum()
    shape = np.zeros((20, 30), bool)
    shape[0:4, 20:29] = True
    top, left, side = square_around(shape)
    inside = cut(shape, (top, left, side))
    assert inside.shape == (side, side) and inside.sum() == shape.sum()

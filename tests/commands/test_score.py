"""``ipjax score``: the table for people, and the same score as JSON on the screen and in a file."""

import json

from builders.bop_roots import write_images
from builders.command_lines import run

from ipjax.bop.results import HEADER

ROW = "0,0,2,1.0,1 0 0 0 1 0 0 0 1,0 0 700,0.5"


def test_the_score_is_the_same_on_the_screen_and_in_the_file(tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    root, rows = write_images(tmp_path / "small", images=2), tmp_path / "mine_small-test.csv"
    rows.write_text(f"{HEADER}\n{ROW}\n")
    words = ["score", str(rows), str(root), "--metrics", "mssd", "mspd"]
    assert run([*words, "--json", "-o", str(tmp_path / "score.json")]) == 0
    out, error = capfd.readouterr()
    told = json.loads(out)
    assert told == json.loads((tmp_path / "score.json").read_text()) and error == ""
    assert told["all_frames"]["targets"] > 0 and set(told["all_frames"]["recalls"]) >= {"mssd", "mspd"}
    assert run(words) == 0
    table = capfd.readouterr().out
    assert "AR_MSSD" in table and "\x1b" not in table
    assert run([*words, "-o", str(tmp_path / "score.txt")]) == 2
    assert "must end in .json" in capfd.readouterr().err


def test_participants_side_by_side_on_two_data_sets(tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    roots = [write_images(tmp_path / name, images=1) for name in ("real", "made")]
    files = {name: tmp_path / f"{name}.csv" for name in ("a", "b", "c", "d")}
    for number, path in enumerate(files.values()):
        path.write_text(f"{HEADER}\n0,0,2,1.0,1 0 0 0 1 0 0 0 1,-75 0 {700 + 10 * number},0.5\n")
    a, b, c, d = map(str, files.values())
    # The second as the folder of its split: without a list of targets every visible instance is one.
    (roots[1] / "test").rename(roots[1] / "train_pbr")
    words = ["score", a, b, str(roots[0]), "--metrics", "mssd", "--titles", "real", "synthetic", "--names", "A", "B"]
    words += ["--beside", c, d, str(roots[1] / "train_pbr")]
    outputs = {name: tmp_path / f"out.{name}" for name in ("json", "csv", "html")}
    written = ["-o", str(outputs["json"]), "--csv", str(outputs["csv"]), "--page", str(outputs["html"])]
    assert run([*words, "--json", *written]) == 0
    out, error = capfd.readouterr()
    told = json.loads(out)
    assert told == json.loads(outputs["json"].read_text()) and error == ""
    assert [score["method"] for score in told["scores"]] == ["A", "B", "A", "B"]
    assert [entry["dataset"] for entry in told["benchmark"]["entries"]] == ["real"] * 2 + ["synthetic"] * 2
    assert [entry["all"]["found"] for entry in told["benchmark"]["entries"]] == [1] * 4
    assert outputs["csv"].read_text().count("\n") == 1 + 4 * 4
    assert "<h1>A, B</h1>" in outputs["html"].read_text()
    assert run(words) == 0
    table = capfd.readouterr().out
    assert "Within 5° and 5 cm (%):" in table and "have no estimate and count as infinitely wrong" in table

    def refused(*more: str) -> str:
        assert run([*words, *more]) == 2
        return capfd.readouterr().err

    assert "b.csv holds results to be scored" in refused("--csv", b)
    assert "must end in .html or .htm" in refused("--page", a)
    assert "--against belongs to one result file" in refused("--against", a)
    assert "as the last word, their data set's folder" in refused("--beside", str(roots[1]))
    assert "every data set needs a result file of each participant" in refused(
        "--beside", c, str(roots[1] / "train_pbr")
    )
    assert run(["score", str(roots[0]), a]) == 2
    assert "a.csv is a file: the last word is the folder of the data set" in capfd.readouterr().err
    boxes = tmp_path / "boxes.json"
    boxes.write_text("[]")
    assert run(["score", a, str(boxes), str(roots[0])]) == 2
    assert "of detections one file at a time" in capfd.readouterr().err

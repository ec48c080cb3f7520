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

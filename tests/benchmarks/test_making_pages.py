"""One command makes all pages of results: what it runs exists, runs once, and is told where it fails."""

import importlib.util
from pathlib import Path

import pytest

from benchmarks import pages
from benchmarks.pages import PAGES, Page, make

ROOT = Path(pages.__file__).resolve().parents[1]
# Not made by it: of other machines, or written by hand of what was tried.
APART = {"gpu_h200", "photo_log", "baselines_cpu_2_cores", "triposr_cpu_2_cores"}


def test_every_page_of_results_is_made_by_it():
    made = {page.name for page in PAGES}
    there = {path.stem for path in (ROOT / "benchmarks" / "results").glob("*.md")}
    assert there - made == APART
    assert len(made) == len(PAGES)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_its_commands_are_modules_and_options_that_exist(page):
    for words in page.expand(Path("OUT"), Path("DATA"), "WEIGHTS"):
        module = (
            words[0]
            if importlib.util.find_spec(words[0]).submodule_search_locations is None
            else f"{words[0]}.__main__"
        )
        text = Path(importlib.util.find_spec(module).origin).read_text()
        if module == "benchmarks.ablation":  # whose options are those of another
            text += Path(importlib.util.find_spec("benchmarks.evaluation").origin).read_text()
        for word in words[1:]:
            if word.startswith("-"):
                assert f'"{word}"' in text, f"{module} has no {word}"
        assert not any("{" in word for word in words)


def test_what_is_done_is_not_done_again_and_what_fails_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    good = Page("good", "json.tool {data}/given.json {out}/copy.json")
    broken = Page("broken", "json.tool {data}/missing.json\njson.tool {data}/given.json {out}/never.json")
    lacking = Page("lacking", "json.tool --help", ("somewhere",))
    (tmp_path / "given.json").write_text("{}")
    out = tmp_path / "out"

    failed = make([good, broken, lacking], out, tmp_path, None)
    assert (out / "copy.json").read_text().strip() == "{}" and not (out / "never.json").exists()
    assert len(failed) == 2
    assert failed[0].startswith("broken: json.tool ended with status") and "missing.json" in failed[0]
    assert "has no somewhere" in failed[1]

    (out / "copy.json").unlink()
    (tmp_path / "missing.json").write_text("{}")
    assert make([good, broken], out, tmp_path, None) == []
    assert not (out / "copy.json").exists() and (out / "never.json").exists()

"""The README's Python runs as it stands there, and its commands exist."""

import functools
import importlib
import json
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from builders import tiny_pipeline
from builders.detections import MATRIX, ellipsoid, make_frame, place, stranger
from PIL import Image

import ipjax
from ipjax.commands.demo_scene import compare, place_through_photo
from ipjax.config import ResectConfig
from ipjax.files.weights.catalogue import WeightsError
from ipjax.files.weights.finding import resolve
from ipjax.synthetic import problems
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.photos import make_photo
from ipjax.synthetic.scenes import make_scene
from ipjax.synthetic.sensor import PERFECT

README = Path(__file__).resolve().parent.parent / "README.md"


def find_blocks(language: str) -> list[str]:
    """The fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README.read_text(), re.MULTILINE | re.DOTALL)


def test_quickstart_runs(tmp_path, monkeypatch):
    """Word for word, on a drawn scene and a photo of its object. Only defaults are smaller, and no TripoSR is sought.

    How the pose departs from the truth is told by the photo's true pose; its camera is not given, as in the README.
    """
    try:
        resolve()
    except WeightsError as error:
        pytest.skip(f"no weights on this machine: {error}")
    code, *_ = find_blocks("python")
    small = ipjax.OnboardConfig(surface=1024)
    quick = ipjax.Config(
        score=ipjax.ScoreConfig(resolution=28),
        resect=ResectConfig(views=6, count=256, drawn=6, polished=2),
    )
    inflate = functools.partial(ipjax.onboard_photo, config=small, lrm="inflate", progress=False)
    monkeypatch.setattr(ipjax, "onboard_photo", inflate)
    monkeypatch.setattr(ipjax, "estimate", functools.partial(ipjax.estimate, config=quick))
    monkeypatch.chdir(tmp_path)
    mug = make_object("mug")
    scene = make_scene([mug], clutter=0, sensor=PERFECT, oversample=1, least_visible=0.9)
    true = scene.camera_from_object[0]
    photo = make_photo(mug, true, scene.camera)
    Image.fromarray(photo.rgb).save(tmp_path / "mug.jpg")
    names = {"rgb": scene.rgb, "depth": scene.depth, "mask": scene.masks[0], "camera": scene.matrix}
    exec(compile(code, str(README), "exec"), names)

    found, picture = names["found"], names["picture"]
    assert bool(found.success)
    placed = place_through_photo(found.camera_from_object, names["info"], photo)
    # One photo whose focal length is guessed, one seed: 9.8° off, and right by the measure of the pages. Place and size
    # are as good as the guesses of depth and focal length are.
    assert compare(placed, true, mug).rotation < 15
    assert abs(float(found.camera_from_object.scale) / float(true.scale) - 1) < 0.2
    offset = np.asarray(found.camera_from_object.translation) - np.asarray(true.translation)
    assert np.linalg.norm(offset) < 0.25 * float(true.scale)
    assert (tmp_path / "mug.ipjax").is_file()
    assert picture.dtype == np.uint8 and picture.shape[2] == 3
    assert jax.tree.all(jax.tree.map(lambda x: bool(np.isfinite(x).all()), found.camera_from_object))


def test_many_at_once_runs(monkeypatch):
    """Word for word: two objects of different sizes, a query of each, and their diameters. With the tests' encoder."""
    _, code, _ = find_blocks("python")
    monkeypatch.setattr(ipjax, "Config", lambda: tiny_pipeline.DRAWN)
    names = {"ipjax": ipjax, "encoder": problems.make_encoder()}
    names["mug"], names["tin"] = tiny_pipeline.two_objects()
    diameters = 0.12, 0.09  # as the text says
    names["first"], first = tiny_pipeline.make_sized_query(0, diameters[0])
    names["second"], second = tiny_pipeline.make_sized_query(1, diameters[1])
    exec(compile(code, str(README), "exec"), names)
    poses = names["found"].camera_from_object
    for index, truth in enumerate((first, second)):
        pose = jax.tree.map(lambda x, index=index: x[index], poses)
        tiny_pipeline.assert_near(pose, truth, 0.05, 1e-6, 15)


def test_without_a_mask_runs(monkeypatch, capsys):
    """Word for word: two objects, of which one is there, with the tests' encoder and the smallest settings."""
    *_, code = find_blocks("python")
    objects = {"mug.ipjax": ellipsoid(), "tin.ipjax": stranger()}
    monkeypatch.setattr(ipjax, "load", lambda path: objects[path])
    monkeypatch.setattr(ipjax, "load_encoder", problems.make_encoder)
    monkeypatch.setattr(ipjax, "Detector", functools.partial(ipjax.Detector, config=tiny_pipeline.DRAWN))
    frame = make_frame(place(-0.1, 0.05))
    exec(compile(code, str(README), "exec"), {"rgb": frame.rgb, "depth": frame.depth, "camera": MATRIX})
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("ellipsoid ")


def test_quickstart_is_ten_lines():
    code, *_ = find_blocks("python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 10


def test_commands_exist():
    """Every `ipjax` command and every option in the README is one that the command line takes."""
    from ipjax.cli import build_parser

    joined = "\n".join(find_blocks("sh")).replace("\\\n", " ")
    lines = [line.split("#")[0].split() for line in joined.splitlines() if line.startswith("ipjax ")]
    assert len(lines) >= 4
    parser = build_parser()
    for words in lines:
        try:
            parser.parse_args(words[1:])
        except SystemExit as refusal:
            pytest.fail(f"the command line refuses {' '.join(words)!r} ({refusal.code})")


def test_names_exist_and_every_public_one_is_listed():
    text = README.read_text()
    for dotted in set(re.findall(r"\bipjax(?:\.[a-zA-Z_]\w*)+", text)) - {"ipjax.NAME"}:
        if dotted.split(".")[-1] in ("html", "ipjax"):  # names of files
            continue
        value = ipjax
        for part in dotted.split(".")[1:]:
            try:
                value = getattr(value, part)
            except AttributeError:
                value = importlib.import_module(f"{value.__name__}.{part}")
    table = text[text.index("## Names") : text.index("## Other ways in and out")]
    listed = set(re.findall(r"`(\w+)`", table))
    assert set(ipjax.__all__) <= listed, f"README does not list {set(ipjax.__all__) - listed}"


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#:]+)\)", README.read_text()):
        assert (README.parent / target).exists(), target


def test_make_targets_exist():
    makefile = (README.parent / "Makefile").read_text()
    targets = re.findall(r"\bmake ([a-z]+)\b", "\n".join(find_blocks("sh")))
    assert targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"make {target}"


PAGES = README.parent / "benchmarks" / "results"


def read_pages() -> str:
    """All pages of results."""
    return "\n".join(page.read_text() for page in sorted(PAGES.glob("*.md")))


def find_row(text: str, *cells: str) -> list[str]:
    """The first row of a Markdown table that begins with these cells."""
    for line in text.splitlines():
        found = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.startswith("|") and found[: len(cells)] == list(cells):
            return found
    raise AssertionError(f"no row {' | '.join(cells)}")


def test_every_accuracy_figure_is_the_page_s():
    """The table's rows are those of the page that a command prints, method by method and column by column."""
    page = (PAGES / "accuracy.md").read_text()
    section = page[page.index("\n## ycbv, scans") :]
    section = section[: section.index("\n## ", 5)]
    table = README.read_text().split("| | AR |", 1)[1].split("\n\n")[0].splitlines()[2:]
    methods = {"`Config()`, with the encoder": "ipjax-default", "`Config.paper()`": "ipjax-paper"}
    assert {line.strip("|").split("|")[0].strip() for line in table} == set(methods)
    for line in table:
        name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        all_frames = find_row(section[section.index("### All frames:") :], methods[name])
        medians = find_row(section[section.index("### Medians") :], methods[name])
        assert cells[0] == all_frames[-1].split()[0]
        assert [c.split()[0].rstrip("°") for c in cells[1:4]] == medians[1:4]
        assert cells[4] == f"{float(medians[7]):.0f} % of targets"


def test_every_figure_stands_on_a_page():
    """Whatever has a decimal point in README's chapter of results is a figure of a page, or of the table above it."""
    text = README.read_text()
    chapter = text[text.index("## How well, how fast") : text.index("## When something does not work")]
    figures = set(re.findall(r"(?<![\w.,-])\d+\.\d+(?![\w.])", chapter.split("<!-- benchmarks -->")[0]))
    figures |= set(re.findall(r"(?<![\w.,-])\d+\.\d+(?![\w.])", chapter.split("<!-- /benchmarks -->")[1]))
    assert len(figures) > 10
    there = set(re.findall(r"\d+\.\d+", read_pages()))
    assert sorted(figures - there) == []


def test_tables_of_times_are_those_of_the_results():
    """What stands between the marks is what `benchmarks.table` makes of the files beside the pages."""
    from benchmarks.table import BEGIN, END, render

    inside = README.read_text().split(BEGIN, 1)[1].split(END, 1)[0]
    files = [json.loads((PAGES / name).read_text()) for name in ("cpu_2_cores.json", "query_cpu_2_cores.json")]
    assert inside.strip() == "\n".join(render(results, short=True) for results in files).strip()
    for path, results in zip(("cpu_2_cores.md", "query_cpu_2_cores.md"), files, strict=True):
        assert (PAGES / path).read_text() == render(results)


@pytest.mark.parametrize("page", sorted(PAGES.glob("*.md")), ids=lambda page: page.name)
def test_a_page_names_its_command_and_its_commit(page):
    """A command that exists, and a commit; README names both the page and the command."""
    text, manual = page.read_text(), README.read_text()
    modules = re.findall(r"python -m (benchmarks[.\w]*)", text)
    assert modules and re.search(r"[cC]ommit `?[0-9a-f]{7,}", text)
    for module in modules:
        parts = module.split(".")
        assert (README.parent / Path(*parts)).with_suffix(".py").is_file() or (README.parent / Path(*parts)).is_dir()
    assert f"(benchmarks/results/{page.name})" in manual
    assert f"python -m {modules[0]}" in manual
    if "**Stale**" in text:
        assert "have not been measured again" in " ".join(manual.split())

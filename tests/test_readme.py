"""The README's Python runs as it stands there, and its commands exist."""

import functools
import re
from pathlib import Path

import jax
import numpy as np
import problems
import pytest
import test_pipeline

import ipjax
from ipjax.host import onboarding
from ipjax.host.meshes import save_mesh
from ipjax.host.synthetic import PERFECT, make_object, make_scene
from ipjax.host.weights import WeightsError, resolve

README = Path(__file__).resolve().parent.parent / "README.md"


def find_blocks(language: str) -> list[str]:
    """The fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README.read_text(), re.MULTILINE | re.DOTALL)


def test_quickstart_runs(tmp_path, monkeypatch):
    """Word for word, on a drawn scene. Only defaults are smaller: 96 templates instead of 400, fewer steps."""
    try:
        resolve()
    except WeightsError as error:
        pytest.skip(f"no weights on this machine: {error}")
    code, _ = find_blocks("python")
    small = ipjax.OnboardConfig(directions=16, rolls=6)
    quick = ipjax.Config(
        match=ipjax.MatchConfig(views=4),
        align=ipjax.AlignConfig(count=256),
        refine=ipjax.RefineConfig(steps=6, points=128),
        score=ipjax.ScoreConfig(resolution=28, alternates=0),
    )
    monkeypatch.setattr(
        onboarding, "onboard", functools.partial(onboarding.onboard, config=small, progress=False), raising=True
    )
    monkeypatch.setattr(ipjax, "estimate", functools.partial(ipjax.estimate, config=quick))
    monkeypatch.chdir(tmp_path)
    mug = make_object("mug")
    scene = make_scene([mug], clutter=0, sensor=PERFECT, oversample=1, least_visible=0.9)
    save_mesh(mug, tmp_path / "mug.glb")
    names = {"rgb": scene.rgb, "depth": scene.depth, "mask": scene.masks[0], "camera": scene.matrix}
    exec(compile(code, str(README), "exec"), names)

    found, picture = names["found"], names["picture"]
    assert bool(found.success)
    true = scene.camera_from_object[0]
    offset = np.asarray(found.camera_from_object.translation) - np.asarray(true.translation)
    assert np.linalg.norm(offset) < 0.25 * float(true.scale)
    assert abs(float(found.camera_from_object.scale) / float(true.scale) - 1) < 0.25
    assert (tmp_path / "mug.ipjax").is_file()
    assert picture.dtype == np.uint8 and picture.shape[2] == 3
    assert jax.tree.all(jax.tree.map(lambda x: bool(np.isfinite(x).all()), found.camera_from_object))


def test_many_at_once_runs(monkeypatch):
    """Word for word: two objects of different sizes, a query of each, and their diameters. With the tests' encoder."""
    _, code = find_blocks("python")
    monkeypatch.setattr(ipjax, "Config", lambda: test_pipeline.DRAWN)
    names = {"ipjax": ipjax, "encoder": problems.make_encoder()}
    names["mug"], names["tin"] = test_pipeline.two_objects()
    diameters = 0.12, 0.09  # as the text says
    names["first"], first = test_pipeline.make_sized_query(0, diameters[0])
    names["second"], second = test_pipeline.make_sized_query(1, diameters[1])
    exec(compile(code, str(README), "exec"), names)
    poses = names["found"].camera_from_object
    for index, truth in enumerate((first, second)):
        pose = jax.tree.map(lambda x, index=index: x[index], poses)
        test_pipeline.assert_near(pose, truth, 0.05, 1e-6)
        assert test_pipeline.rotation_error(pose, truth) < 15


def test_quickstart_is_ten_lines():
    code, _ = find_blocks("python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 10


def test_commands_exist():
    """Every `ipjax` command and every option in the README is one that the command line takes."""
    from ipjax.cli import _parser

    joined = "\n".join(find_blocks("sh")).replace("\\\n", " ")
    lines = [line.split("#")[0].split() for line in joined.splitlines() if line.startswith("ipjax ")]
    assert len(lines) >= 4
    parser = _parser()
    for words in lines:
        try:
            parser.parse_args(words[1:])
        except SystemExit as refusal:
            pytest.fail(f"the command line refuses {' '.join(words)!r} ({refusal.code})")


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#:]+)\)", README.read_text()):
        assert (README.parent / target).exists(), target


def test_make_targets_exist():
    makefile = (README.parent / "Makefile").read_text()
    targets = re.findall(r"\bmake ([a-z]+)\b", "\n".join(find_blocks("sh")))
    assert targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"make {target}"

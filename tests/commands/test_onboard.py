"""``ipjax onboard``: bad meshes are refused in one line before anything is rendered; a good one is told to machines."""

import json
import re
from types import SimpleNamespace

import pytest
import trimesh
from builders.command_lines import run
from builders.tiny_dinov2 import tiny
from flax import nnx

from ipjax.files.objects.loading import load
from ipjax.networks.dinov2 import DinoV2, Encoder


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "mesh|vertices|faces|empty"),
        ("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "finite|NaN"),
        ("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "."),
        (None, "no such mesh"),
    ],
)
def test_bad_meshes_are_refused_in_one_line(case, capfd, monkeypatch, content, words):
    encoder = SimpleNamespace(identity="none")
    monkeypatch.setattr("ipjax.commands.interface.options.load_encoder", lambda _: encoder)
    monkeypatch.setattr("ipjax.onboarding.mesh.make_templates", lambda *_, **__: pytest.fail("a bad mesh was rendered"))
    if content is not None:
        (case / "bad.obj").write_text(content)
    import jaxtyping

    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        assert run(["onboard", str(case / "bad.obj"), "-o", str(case / "bad.ipjax")]) == 2
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and re.search(words, error), error
    assert not (case / "bad.ipjax").exists()


def test_a_mesh_becomes_an_object_file(case, capfd, monkeypatch):
    encoder = Encoder(DinoV2(tiny("plain", 1), rngs=nnx.Rngs(0)), 0, "dinov2 tiny block=0 norm=1 float32 sha256:none")
    monkeypatch.setattr("ipjax.commands.interface.options.load_encoder", lambda arguments: encoder)
    trimesh.creation.box((100, 60, 30)).export(case / "box.stl")
    words = ["onboard", case / "box.stl", "-o", case / "box.ipjax", "--unit", "mm", "--directions", 2, "--rolls", 1]
    words += ["--backend", "raster", "--set", "resolution=56", "--set", "surface=256", "--set", "describe.cover=0.3"]
    assert run([*map(str, words), "--json"]) == 0
    out, _ = capfd.readouterr()
    told = json.loads(out)
    templates, info = load(case / "box.ipjax")
    assert (told["templates"], told["object"], told["object_file"]) == (2, "box", str(case / "box.ipjax"))
    assert told["diameter_mm"] == pytest.approx((100**2 + 60**2 + 30**2) ** 0.5, rel=1e-3)
    assert info.config["resolution"] == 56 and info.config["describe"]["cover"] == 0.3
    assert templates.surface.points.shape == (256, 3)
    assert run([*map(str, words), "--set", "resolution=large"]) == 2
    assert (
        "--set: resolution: a whole number from 1 is expected, for instance 56, not 'large'" in capfd.readouterr().err
    )

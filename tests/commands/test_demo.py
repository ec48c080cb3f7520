"""``ipjax demo``: what it compares, tells and refuses. With real weights ``make demo`` runs the whole of it."""

import dataclasses
import functools
import json
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from builders.command_lines import run
from builders.estimates import make_estimate
from builders.objects import make_object as make_onboarded
from builders.tiny_dinov2 import tiny
from flax import nnx

from ipjax.commands import demo_scene
from ipjax.commands.demo_scene import compare, place_through_photo
from ipjax.config import OnboardConfig
from ipjax.files.objects.record import Reference
from ipjax.networks.dinov2 import DinoV2, Encoder
from ipjax.records import Camera, Similarity
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.photos import MadePhoto
from ipjax.transforms import rotation_from_vector


def test_a_comparison_tells_what_was_changed():
    mesh = make_object("wedge")
    true = Similarity(jnp.eye(3), jnp.asarray([0.0, 0.0, 0.8]), jnp.asarray(0.2))
    same = compare(true, true, mesh)
    assert same.good and same.add < 1e-6 and same.rotation < 0.1 and same.translation == 0
    angle = np.radians(30)
    turn = jnp.asarray([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]], jnp.float32)
    moved = Similarity(turn, true.translation + jnp.asarray([0.06, 0.0, 0.0]), jnp.asarray(0.25))
    found = compare(moved, true, mesh)
    assert found.rotation == pytest.approx(30, abs=0.1) and found.translation == pytest.approx(0.06, rel=1e-5)
    assert (found.true_size, found.size) == (pytest.approx(0.2), pytest.approx(0.25))
    assert not found.good and found.adds <= found.add
    told = found.as_json()
    assert told["translation_mm"] == pytest.approx(60, rel=1e-5) and told["diameter_mm"] == pytest.approx(250)
    assert all(np.isfinite(x) for x in told.values())


def test_a_file_in_the_way_is_told(tmp_path, capfd):
    (tmp_path / "out").write_text("")
    assert run(["demo", "-o", str(tmp_path / "out")]) == 2
    assert "a file of this name is in the way" in capfd.readouterr().err


def test_the_photo_s_true_pose_says_where_the_object_is():
    """A guessed shape of any frame and scale, found exactly where the photo's camera saw it, is the object exactly."""
    turned = lambda *vector: rotation_from_vector(np.array(vector))
    scene = Similarity(turned(0.3, -0.2, 0.5), np.array([0.05, 0.02, 0.7]), np.asarray(0.15))
    there = Similarity(turned(-0.4, 0.6, 0.1), np.array([0.03, -0.02, 0.5]), np.asarray(0.15))
    photo = MadePhoto(
        np.zeros((4, 4, 3), np.uint8),
        np.zeros((4, 4), bool),
        Camera(focal=jnp.full(2, 600.0), centre=jnp.full(2, 1.5)),
        there.to_jax(),
        30.0,
    )
    guessed = Similarity(turned(0.1, 0.2, -0.3), np.array([0.01, 0.02, 1.0]), np.asarray(0.4))
    seen_by = dict(rotation=guessed.rotation, translation=guessed.translation, scale=float(guessed.scale))
    lens = dict(focal=(600.0, 600.0), centre=(1.5, 1.5), size=(4, 4), camera_source="given")
    info = dataclasses.replace(
        make_onboarded()[1],
        reference=Reference(file="", sha256="", metric=False, method="inflate", seen=0.5, **seen_by, **lens),
    )
    # The scene's camera from the photo's, whose unit is the distance from it to the object.
    unit = Similarity(np.eye(3), np.zeros(3), np.asarray(0.5))
    camera_from_reference = scene @ there.inverse() @ unit
    estimate = camera_from_reference @ guessed @ info.object_from_mesh.to_numpy().inverse()
    found = place_through_photo(estimate.to_jax(), info, photo)
    for name in ("rotation", "translation", "scale"):
        np.testing.assert_allclose(getattr(found, name), getattr(scene, name), atol=2e-6)


def guess(encoder, templates, query, key, config, diameter):
    """An estimate that compiles in no time: upright, 100 mm, as far as what the query measured."""
    depth = jnp.sum(jnp.where(query.view.mask, query.view.depth, 0)) / jnp.sum(query.view.mask, dtype=jnp.float32)
    return make_estimate(Similarity(jnp.eye(3), jnp.stack([0 * depth, 0 * depth, depth]), jnp.asarray(0.1)))


def test_it_tells_of_the_mesh_and_of_the_photo(tmp_path, capfd, monkeypatch):
    """All but the estimate: scene, photo, both objects, files, numbers, and commands that would repeat it."""
    encoder = Encoder(DinoV2(tiny("plain", 1), rngs=nnx.Rngs(0)), 0, "dinov2 tiny block=0 norm=1 float32 sha256:none")
    small = OnboardConfig(directions=4, rolls=1, resolution=56, surface=256)
    monkeypatch.setattr("ipjax.commands.interface.options.load_encoder", lambda arguments: encoder)
    monkeypatch.setattr("ipjax.inference.compilation_cache.use_compilation_cache", lambda: None)
    for name in ("onboard", "onboard_photo"):
        quick = functools.partial(getattr(demo_scene, name), config=small, progress=False)
        monkeypatch.setattr(demo_scene, name, quick)
    monkeypatch.setattr("ipjax.inference.estimator.estimate", guess)
    status = run(["demo", "-o", str(tmp_path), "--seed", "1", "--json"])
    out, text = capfd.readouterr()
    told = json.loads(out)
    assert status == (0 if told["found"] else 1) and told["folder"] == str(tmp_path)
    shared = {"rotation_deg", "translation_mm", "true_diameter_mm", "diameter_mm", "add_diameters", "adds_diameters"}
    assert shared < told.keys() and shared < told["photo"].keys()
    assert told["photo"]["true_diameter_mm"] == told["true_diameter_mm"]
    assert 25 <= told["photo"]["angle_deg"] <= 35 and told["photo"]["mask_iou"] > 0.9
    assert told["photo"]["told_diameter_mm"] == pytest.approx(100)
    assert told["photo"]["told_diameter_std_mm"] == pytest.approx(2)
    assert "by the mesh: off by" in text and "by the photo: off by" in text
    for name in ("photo.png", "photo_camera.json", "overlay.png", "photo_overlay.png", "bottle_photo.ipjax"):
        assert (tmp_path / name).is_file(), name
    commands = re.findall(r"^  ipjax (onboard|estimate) (.*)$", text, re.MULTILINE)
    assert [command for command, _ in commands] == ["onboard", "estimate"] * 2
    from ipjax.cli import build_parser

    for command, words in commands:
        given = build_parser().parse_args([command, *words.split()])
        inputs = [given.source, given.camera] if command == "onboard" else [*given.objects, given.rgb, given.depth]
        assert all(Path(path).is_file() for path in inputs if path is not None)

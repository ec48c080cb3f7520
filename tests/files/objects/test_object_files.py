"""The object file: what comes back is what was saved, and nothing else is taken for it."""

import dataclasses
import json
import shutil
import struct
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.objects import make_object, nan, rewrite

from ipjax.files.objects.loading import check, load
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.objects.saving import save
from ipjax.records import Appearance


@pytest.fixture
def file(tmp_path):
    templates, info = make_object()
    return save(tmp_path / "mug.ipjax", templates, info)


def test_what_was_saved_comes_back(file):
    templates, info = make_object()
    again, told = load(file)
    jax.tree.map(np.testing.assert_array_equal, templates, again)
    assert jax.tree.structure(templates) == jax.tree.structure(again)
    assert again.patches.features.dtype == jnp.float16
    assert len(told.content_sha256) == 64  # only a file has one
    for field in dataclasses.fields(ObjectInfo):
        if field.name not in ("vertices", "faces", "colours", "pictures", "content_sha256"):
            assert getattr(told, field.name) == getattr(info, field.name), field.name
    np.testing.assert_array_equal(told.vertices, info.vertices)
    np.testing.assert_array_equal(told.faces, info.faces)
    np.testing.assert_array_equal(told.colours, info.colours)
    np.testing.assert_allclose(told.picture(3)[14, 14], (200, 100, 50), atol=4)  # JPEG
    assert any("mug" in line for line in check(file))
    assert [path.name for path in file.parent.iterdir()] == ["mug.ipjax"]


def test_the_appearance_comes_back_to_the_digits_of_its_file(tmp_path):
    templates, info = make_object()
    points = np.random.default_rng(1).normal(size=(3, 50, 3))
    colours = np.abs(points[2]) / np.abs(points[2]).max()
    look = Appearance(*(jnp.asarray(x, jnp.float32) for x in (points[0], points[1], colours)))
    again, _ = load(save(tmp_path / "a.ipjax", dataclasses.replace(templates, appearance=look), info))
    assert again.appearance is not None
    np.testing.assert_allclose(again.appearance.points, look.points, rtol=1e-3)
    np.testing.assert_allclose(again.appearance.normals, look.normals, rtol=1e-3)
    np.testing.assert_allclose(again.appearance.colours, look.colours, atol=0.5 / 255 + 1e-6)


def test_a_basis_comes_back_and_must_fit(tmp_path):
    templates, info = make_object()
    channels = templates.mean.shape[0]
    short = dataclasses.replace(templates.patches, features=templates.patches.features[..., :3])
    cut = dataclasses.replace(templates, patches=short, basis=jnp.eye(3, channels))
    again, _ = load(save(tmp_path / "cut.ipjax", cut, info))
    np.testing.assert_array_equal(again.basis, cut.basis)
    np.testing.assert_array_equal(again.patches.features, short.features)
    with pytest.raises(ValueError, match="have no basis"):
        save(tmp_path / "bad.ipjax", dataclasses.replace(cut, basis=None), info)
    assert not (tmp_path / "bad.ipjax").exists()


def test_a_loaded_object_can_be_saved_again(file, tmp_path):
    templates, info = load(file)
    save(tmp_path / "again.ipjax", templates, info)
    assert (tmp_path / "again.ipjax").read_bytes() == file.read_bytes()


def test_the_mesh_frame_is_kept(file):
    _, info = load(file)
    mapped = info.object_from_mesh @ jnp.asarray([[1.0, -2.0, 0.5], [1.25, -2.0, 0.5]])
    np.testing.assert_allclose(mapped, [[0, 0, 0], [1, 0, 0]], atol=1e-6)


def test_an_object_needs_no_mesh_and_no_pictures(tmp_path):
    templates, info = make_object()
    bare = dataclasses.replace(info, vertices=None, faces=None, colours=None, pictures=None, metres_per_unit=None)
    _, told = load(save(tmp_path / "bare.ipjax", templates, bare))
    assert told.vertices is None and told.faces is None and told.picture(0) is None and told.metres_per_unit is None


def test_large_meshes_are_simplified_within_a_percent(tmp_path):
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=6, radius=0.5)
    templates, info = make_object()
    info = dataclasses.replace(info, vertices=sphere.vertices, faces=sphere.faces, colours=None)
    _, told = load(save(tmp_path / "ball.ipjax", templates, info))
    assert 1000 < len(told.faces) <= 60_000 < len(sphere.faces)
    np.testing.assert_allclose(np.linalg.norm(told.vertices, axis=-1), 0.5, atol=5e-3)


def test_the_encoder_must_be_the_one_that_made_it(file):
    for alike_or_nameless in ("dinov2 vits14 block=8", "unnamed", ""):
        load(file, SimpleNamespace(identity=alike_or_nameless))
    load(file, lambda image: image)  # as everywhere, what has no identity is not compared
    with pytest.raises(ValueError, match="onboard the object again") as caught:
        load(file, SimpleNamespace(identity="dinov2 vitb14 block=8"))
    assert "vits14" in str(caught.value) and "vitb14" in str(caught.value)


def test_a_failed_save_leaves_nothing_behind(tmp_path):
    templates, info = make_object()
    broken = dataclasses.replace(templates, extents=jnp.full(3, jnp.nan))
    with pytest.raises(ValueError, match="not finite"):
        save(tmp_path / "a.ipjax", broken, info)
    with pytest.raises(ValueError):
        save(tmp_path / "a.ipjax", templates, dataclasses.replace(info, config={"x": float("nan")}))
    many = jax.tree.map(lambda x: jnp.stack([x, x]), templates)
    with pytest.raises(ValueError, match="one object"):
        save(tmp_path / "a.ipjax", many, info)
    with pytest.raises(OSError):
        save(tmp_path / "none" / "a.ipjax", templates, info)
    assert not list(tmp_path.iterdir())


def edit(**changes):
    def apply(text):
        return json.dumps(json.loads(text) | changes)

    return apply


HOSTILE = {
    "empty": (lambda p: p.write_bytes(b""), "damaged"),
    "text": (lambda p: p.write_text("not an object file at all"), "damaged"),
    "truncated": (lambda p: p.write_bytes(p.read_bytes()[:-100]), "damaged"),
    "header cut": (lambda p: p.write_bytes(p.read_bytes()[:60]), "damaged"),
    "header of 2^60 bytes": (lambda p: p.write_bytes(struct.pack("<Q", 2**60) + p.read_bytes()[8:]), "damaged"),
    "folder": (lambda p: (p.unlink(), p.mkdir()), "no such object file"),
    "missing": (lambda p: p.unlink(), "no such object file"),
    "other safetensors": (lambda p: rewrite_plain(p), "not an object file"),
    "no JSON": (lambda p: rewrite(p, metadata=lambda _: "{"), "not valid JSON"),
    "deep JSON": (lambda p: rewrite(p, metadata=lambda _: "[" * 100_000), "nested too deeply"),
    "no version": (lambda p: rewrite(p, metadata=lambda _: "{}"), "no format version"),
    "future version": (lambda p: rewrite(p, metadata=edit(format=99)), "upgrade"),
    "no mesh": (lambda p: rewrite(p, metadata=edit(mesh=None)), "lacks"),
    "scale 0": (lambda p: rewrite(p, metadata=edit(mesh={"scale": 0, "centre": [0, 0, 0]})), "lacks"),
    "missing tensor": (lambda p: rewrite(p, drop=["points"]), "points is missing"),
    "unknown tensor": (lambda p: rewrite(p, change={"extra": np.zeros(3)}), "'extra' is unknown"),
    "wrong shape": (lambda p: rewrite(p, change={"valid": np.ones((5, 3), bool)}), "valid is bool"),
    "wrong type": (lambda p: rewrite(p, change={"extents": np.ones(3)}), "extents is"),
    "NaN pose": (lambda p: rewrite(p, change={"rotation": nan}), "not finite"),
    "faces out of range": (lambda p: rewrite(p, change={"mesh.faces": np.full((1, 3), 9, np.int32)}), "do not exist"),
    "pictures out of range": (lambda p: rewrite(p, change={"pictures.end": lambda e: e + 10}), "pictures"),
}


def rewrite_plain(path):
    from safetensors.numpy import save_file

    save_file({"a": np.zeros(3)}, path)


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_one_sentence(name, file):
    spoil, words = HOSTILE[name]
    spoil(file)
    for read in (load, check):
        with pytest.raises(ValueError, match=words) as caught:
            read(file)
        assert str(file) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda p: p.write_bytes(p.read_bytes()[:-1] + bytes([p.read_bytes()[-1] ^ 1])), "checksum"),
        (lambda p: rewrite(p, metadata=edit(name="another")), "checksum"),
        (lambda p: rewrite(p, change={"points": nan}), "checksum"),
        (lambda p: rewrite(p, change={"rotation": lambda r: 2 * r}), "checksum"),
    ],
)
def test_check_reads_to_the_last_byte(spoil, words, file, tmp_path):
    shutil.copy(file, tmp_path / "kept")
    spoil(file)
    with pytest.raises(ValueError, match=words):
        check(file)
    check(tmp_path / "kept")

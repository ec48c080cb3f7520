"""The object file: what comes back is what was saved, and nothing else is taken for it."""

import dataclasses
import json
import shutil
import struct
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.objects import make_object, nan, rewrite, with_reference

from ipjax.files.objects.deviations import METHODS, with_deviations
from ipjax.files.objects.layout import FORMAT, OPTIONAL_TENSORS, hash_content
from ipjax.files.objects.loading import check, load
from ipjax.files.objects.record import ObjectInfo, Reference
from ipjax.files.objects.saving import save
from ipjax.inference.batching import compact
from ipjax.records import Appearance

REFERENCE = {name for name in OPTIONAL_TENSORS if name.startswith("reference.")}


@pytest.fixture
def file(tmp_path):
    templates, info = make_object()
    return save(tmp_path / "mug.ipjax", templates, info)


@pytest.fixture
def photo_file(tmp_path):
    """Of an object that was made from a photo without depth."""
    templates, info = make_object()
    return save(tmp_path / "photo.ipjax", with_reference(templates), info)


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


def test_the_reference_view_comes_back(photo_file, tmp_path):
    wanted = with_reference(make_object()[0])
    again, info = load(photo_file)
    jax.tree.map(np.testing.assert_array_equal, wanted, again)
    assert jax.tree.structure(wanted) == jax.tree.structure(again)
    kinds = lambda tree: [x.dtype for x in jax.tree.leaves(tree)]
    assert kinds(again) == kinds(wanted)
    assert sum("poses are found through the photo: 28 pixels wide" in line for line in check(photo_file)) == 1
    save(tmp_path / "again.ipjax", again, info)
    assert (tmp_path / "again.ipjax").read_bytes() == photo_file.read_bytes()
    plain = save(tmp_path / "plain.ipjax", *make_object())
    assert load(plain)[0].reference is None and not any("through the photo" in line for line in check(plain))


def test_whether_the_photo_had_depth_comes_back(tmp_path):
    templates, info = make_object()
    guessed = with_reference(templates)
    assert guessed.reference is not None
    measured = dataclasses.replace(guessed, reference=dataclasses.replace(guessed.reference, measured=True))
    for wanted, words in ((guessed, "found through"), (measured, "chosen by")):
        path = save(tmp_path / "a.ipjax", wanted, info)
        again, _ = load(path)
        assert jax.tree.structure(again) == jax.tree.structure(wanted)
        assert sum(f"poses are {words} the photo" in line for line in check(path)) == 1


def test_files_of_format_2_have_photos_without_depth(photo_file):
    """As an earlier ipjax wrote them, which did not tell."""
    from safetensors.numpy import load_file

    wanted, tensors = load(photo_file)[0], load_file(photo_file)

    def older(text):
        header = {name: entry for name, entry in json.loads(text).items() if name != "depth_measured"} | {"format": 2}
        return json.dumps(header | {"content_sha256": hash_content(header, tensors)})

    rewrite(photo_file, metadata=older)
    assert jax.tree.structure(load(photo_file)[0]) == jax.tree.structure(wanted)
    assert "format 2" in " ".join(check(photo_file))


def test_how_far_points_may_be_off_comes_back(tmp_path):
    templates, info = make_object()
    wanted = dataclasses.replace(templates, surface=with_deviations(templates.surface, "inflate"))
    again, _ = load(save(tmp_path / "a.ipjax", wanted, info))
    np.testing.assert_array_equal(again.surface.along_std, wanted.surface.along_std)
    np.testing.assert_array_equal(again.surface.across_std, wanted.surface.across_std)
    rewrite(tmp_path / "a.ipjax", drop=["deviation.across"])
    with pytest.raises(ValueError, match=r"deviation\.across is missing"):
        load(tmp_path / "a.ipjax")
    save(tmp_path / "a.ipjax", wanted, info)
    rewrite(tmp_path / "a.ipjax", change={"deviation.along": lambda x: -x - 1})
    with pytest.raises(ValueError, match="deviations below zero"):
        load(tmp_path / "a.ipjax")


@pytest.mark.parametrize("method", ["inflate", "depth", "triposr", "elsewhere", "of some other version"])
def test_files_of_format_3_get_what_is_assumed_of_their_method(tmp_path, method):
    """As an earlier ipjax wrote them: the default of the method; of scans, nothing."""
    from safetensors.numpy import load_file

    templates, info = make_object()
    templates = eqx.tree_at(lambda t: t.surface.seen, templates, jnp.asarray([0.0, 1, 0, 1, 0, 1, 0.5]))
    reference = Reference(
        file="mug.jpg",
        sha256="",
        rotation=np.eye(3),
        translation=np.array([0, 0, 1.0]),
        scale=1.0,
        focal=(500.0, 500.0),
        centre=(50.0, 50.0),
        size=(100, 100),
        camera_source="given",
        metric=method == "depth",
        method=method,
        seen=0.5,
    )
    for name, kept in (("photo", reference), ("scan", None)):
        path = save(tmp_path / f"{name}.ipjax", templates, dataclasses.replace(info, reference=kept))
        tensors = load_file(path)
        assert not any("deviation" in one for one in tensors)

        def older(text, tensors=tensors):
            header = json.loads(text) | {"format": 3}
            return json.dumps(header | {"content_sha256": hash_content(header, tensors)})

        rewrite(path, metadata=older)
        surface = load(path)[0].surface
        assert check(path)
        if kept is None:
            assert surface.along_std is None and surface.across_std is None
            continue
        assert surface.along_std is not None and surface.across_std is not None
        assumed = METHODS.get(method, METHODS["elsewhere"])
        np.testing.assert_allclose(surface.along_std[:2], [assumed.back, assumed.front], rtol=1e-6)
        np.testing.assert_allclose(surface.along_std[6], np.hypot(assumed.back, assumed.front) / 2**0.5, rtol=1e-6)
        np.testing.assert_allclose(surface.across_std, assumed.across, rtol=1e-6)


def test_compacted_templates_are_saved_beside_the_whole_photo(tmp_path):
    templates, info = make_object(patches=16)
    few = dataclasses.replace(templates.patches, valid=jnp.arange(16) < jnp.full((5, 1), 3))
    small = compact(with_reference(dataclasses.replace(templates, patches=few)), multiple=4)
    assert small.norm.shape == (5, 4)
    again, _ = load(save(tmp_path / "small.ipjax", small, info))
    jax.tree.map(np.testing.assert_array_equal, small, again)
    assert again.reference is not None and again.reference.patches.valid.shape == (16,)


def test_files_of_format_1_are_read(file):
    """As an earlier ipjax wrote them: without a reference view, and with their own checksum."""
    from safetensors.numpy import load_file

    wanted, told = load(file)[0], check(file)
    tensors = load_file(file)

    def older(text):
        header = json.loads(text) | {"format": 1}
        return json.dumps(header | {"content_sha256": hash_content(header, tensors)})

    rewrite(file, metadata=older)
    found, _ = load(file)
    jax.tree.map(np.testing.assert_array_equal, wanted, found)
    assert found.reference is None
    assert check(file) == [line.replace(f"format {FORMAT}", "format 1") for line in told]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda r: eqx.tree_at(lambda r: r.view.depth, r, r.view.depth.at[0, 0].set(jnp.nan)), "reference.depth has"),
        (lambda r: eqx.tree_at(lambda r: r.view.rgb, r, r.view.rgb.at[0, 0].set(jnp.nan)), "reference.rgb has"),
        (lambda r: eqx.tree_at(lambda r: r.view.rgb, r, 255 * r.view.rgb), r"not in \[0, 1\]"),
        (lambda r: eqx.tree_at(lambda r: r.camera_from_object.scale, r, jnp.asarray(2.0)), "must have scale 1"),
        (lambda r: eqx.tree_at(lambda r: r.patches.features, r, r.patches.features[:, :3]), "reference.features is"),
        (lambda r: eqx.tree_at(lambda r: r.view.rgb, r, r.view.rgb[:-1]), "not a usable object: reference.rgb is"),
    ],
)
def test_a_reference_view_that_makes_no_sense_is_not_saved(spoil, words, tmp_path):
    templates, info = make_object()
    reference = spoil(with_reference(templates).reference)
    with pytest.raises(ValueError, match=words):
        save(tmp_path / "a.ipjax", dataclasses.replace(templates, reference=reference), info)
    assert not list(tmp_path.iterdir())


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
    "next version": (lambda p: rewrite(p, metadata=edit(format=FORMAT + 1)), f"format {FORMAT + 1}, but .* upgrade"),
    "no such version": (lambda p: rewrite(p, metadata=edit(format=0)), "onboard the object again"),
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


HOSTILE_PHOTOS = {
    "missing tensor": (lambda p: rewrite(p, drop=["reference.grid"]), "not an object file: reference.grid is missing"),
    "only one tensor": (lambda p: rewrite(p, drop=REFERENCE - {"reference.rgb"}), "reference.centre is missing"),
    "no colours": (lambda p: rewrite(p, drop=["reference.rgb"]), "reference.rgb is missing"),
    "not square": (lambda p: rewrite(p, change={"reference.mask": np.ones((28, 27), bool)}), "reference.mask is bool"),
    "other size": (
        lambda p: rewrite(p, change={"reference.depth": np.ones((14, 14), np.float32)}),
        "usable object: reference",
    ),
    "no patches": (
        lambda p: rewrite(
            p, change={f"reference.{name}": lambda x: x[:0] for name in ("features", "points", "grid", "valid")}
        ),
        "not a usable object: reference",
    ),
    "other features": (
        lambda p: rewrite(p, change={"reference.features": lambda f: f[:, :3]}),
        "reference.features is",
    ),
    "wrong type": (lambda p: rewrite(p, change={"reference.rgb": lambda x: x.astype(np.float32)}), "reference.rgb is"),
    "NaN pose": (
        lambda p: rewrite(p, change={"reference.rotation": nan}),
        "reference.rotation has values that are not",
    ),
    "NaN place": (lambda p: rewrite(p, change={"reference.translation": nan}), "reference.translation has"),
    "NaN camera": (lambda p: rewrite(p, change={"reference.focal": nan}), "reference.focal has"),
}


@pytest.mark.parametrize("name", HOSTILE_PHOTOS)
def test_hostile_reference_views_are_refused_in_one_sentence(name, photo_file):
    spoil, words = HOSTILE_PHOTOS[name]
    spoil(photo_file)
    for read in (load, check):
        with pytest.raises(ValueError, match=words) as caught:
            read(photo_file)
        assert str(photo_file) in str(caught.value) and "\n" not in str(caught.value)


def rewrite_whole(path, change):
    """Alter tensors, and the checksum with them."""
    from safetensors.numpy import load_file

    rewrite(path, change=change)
    tensors = load_file(path)
    rewrite(path, metadata=lambda text: edit(content_sha256=hash_content(json.loads(text), tensors))(text))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"reference.rotation": lambda r: 2 * r}, "the photo's pose holds something that is no rotation"),
        ({"reference.rotation": lambda r: -r}, "the photo's pose holds something that is no rotation"),
        ({"reference.features": lambda f: 2 * f}, "reference.features of valid patches are not unit vectors"),
        ({"reference.valid": lambda v: v & False}, "the photo does not show any patch"),
        ({"reference.focal": lambda f: -f}, "the photo's camera has a focal length that is not positive"),
        ({"reference.depth": nan}, "reference.depth has values that are not finite"),
        ({"rotation": lambda r: 2 * r}, "the template poses hold something that is no rotation"),
        ({"features": lambda f: 2 * f}, "damaged: features of valid patches are not unit vectors"),
        ({"valid": lambda v: v & False}, "no template shows any patch"),
    ],
)
def test_check_finds_what_cannot_be_true(change, words, photo_file):
    rewrite_whole(photo_file, change)
    with pytest.raises(ValueError, match=words):
        check(photo_file)


def test_an_appearance_without_normals_is_refused(tmp_path):
    templates, info = make_object()
    look = dataclasses.replace(templates, appearance=Appearance(*(jnp.ones((4, 3)) for _ in range(3))))
    path = save(tmp_path / "a.ipjax", look, info)
    rewrite(path, drop=["appearance.normals"])
    with pytest.raises(ValueError, match=r"appearance\.normals is missing"):
        load(path)


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

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


@pytest.mark.parametrize("words", [["IMG_1.HEIC"], ["egg.ply", "--photo", "IMG_1.HEIC"]])
def test_a_photo_as_phones_write_it_but_nothing_here_reads_is_told_what_to_become(case, capfd, words):
    for name in ("IMG_1.HEIC", "egg.ply"):
        (case / name).touch()
    assert run(["onboard", *(str(case / word) if "." in word else word for word in words), "-o", "egg.ipjax"]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "save it as JPEG or PNG" in error, error


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


def test_a_mesh_with_its_photo_says_how_well_they_fit(case, capfd, monkeypatch):
    import cv2
    import numpy as np

    from ipjax.files.meshes.mesh import make_mesh
    from ipjax.files.meshes.saving import save_mesh
    from ipjax.synthetic import problems

    monkeypatch.setattr("ipjax.commands.interface.options.load_encoder", lambda arguments: problems.make_encoder())
    ball, whole = trimesh.creation.icosphere(3), problems.make_frame(5)
    points = np.asarray(ball.vertices)
    save_mesh(make_mesh(points * problems.AXES, ball.faces, colours=0.5 + 0.45 * points), case / "egg.ply")
    cv2.imwrite(str(case / "photo.png"), whole.rgb[..., ::-1])
    cv2.imwrite(str(case / "outline.png"), 255 * whole.mask.astype(np.uint8))
    K = whole.matrix
    words = ["onboard", case / "egg.ply", "-o", case / "egg.ipjax", "--directions", 20, "--rolls", 6]
    words += ["--backend", "raster"]
    for change in ("resolution=112", "surface=512", "appearance=2000"):
        words += ["--set", change]
    alone = [*map(str, words), "--json"]
    beside = ["--photo", str(case / "photo.png"), "--mask", str(case / "outline.png")]
    beside += ["--photo-camera", f"{K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]}"]
    assert run([*alone, *beside]) == 0
    told = json.loads(capfd.readouterr().out)
    assert any("camera was found relative to the mesh" in note for note in told["notes"])
    templates, info = load(case / "egg.ipjax")
    assert templates.photo_centre is not None and info.reference.file == "photo.png" and info.reference.camera_given
    assert 0.2 < info.reference.seen < 0.5
    # What belongs to no mesh, or to no photo beside one, is still refused.
    for more, message in (
        (["--mask", str(case / "outline.png")], "--mask does not belong to a mesh"),
        (["--photo-camera", "1,1,1,1"], "--photo-camera belongs to --photo"),
        ([*beside, "--depth", str(case / "outline.png")], "--depth does not belong to a mesh"),
        (["--photo", str(case / "none.png")], "no such photo"),
    ):
        assert run([*alone, *more]) == 2
        assert message in capfd.readouterr().err
    photo = ["onboard", str(case / "photo.png"), "-o", str(case / "egg.ipjax"), *beside[:2]]
    assert run(photo) == 2
    assert "--photo does not belong to a photo" in capfd.readouterr().err

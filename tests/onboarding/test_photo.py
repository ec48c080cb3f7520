"""A photo becomes an object file; its pose is told relative to the photo; bad input is refused in one sentence."""

import dataclasses
import io
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import exif as exif_tags
from builders.objects import make_object
from builders.tiny_dinov2 import tiny
from flax import nnx
from PIL import Image

from ipjax import cli
from ipjax.config import OnboardConfig
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.objects.deviations import deviations_of
from ipjax.files.objects.loading import check, load
from ipjax.files.objects.record import GUESS_DEVIATION, Reference
from ipjax.files.objects.saving import save
from ipjax.inference.reports import CONVENTIONS, relative_pose, relative_pose_as_json
from ipjax.networks.dinov2 import DinoV2, Encoder
from ipjax.onboarding import photo as photos
from ipjax.onboarding.foreground import Photo, read_photo
from ipjax.onboarding.reconstruction.reconstruct import reconstruct_with_weights
from ipjax.onboarding.report import findings
from ipjax.onboarding.report.page import list_knowledge, write_report
from ipjax.records import Similarity

HEIGHT, WIDTH, FOCAL = 120, 160, 300.0
K = np.array([[FOCAL, 0, 79.5], [0, FOCAL, 59.5], [0, 0, 1]])
CONFIG = OnboardConfig(directions=4, rolls=1, resolution=56, surface=256)


@pytest.fixture(scope="module")
def encoder():
    """Random weights: its features mean nothing; frames, units and files do."""
    return Encoder(DinoV2(tiny("plain", 1), rngs=nnx.Rngs(0)), 0, "dinov2 tiny block=0 norm=1 float32 sha256:none")


def ball(radius=0.06, distance=0.6):
    """Photo, mask and depth (metres) of a textured ball before a wall."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    ray = np.stack([(x - 79.5) / FOCAL, (y - 59.5) / FOCAL, np.ones(x.shape)], -1)
    a, b, c = (ray**2).sum(-1), -2 * ray[..., 2] * distance, distance**2 - radius**2
    root = b * b - 4 * a * c
    mask = root > 0
    depth = np.where(mask, (-b - np.sqrt(np.maximum(root, 0))) / (2 * a), 0.9).astype(np.float32)
    rgb = np.stack([x * 255 // WIDTH, y * 255 // HEIGHT, np.full_like(x, 60)], -1).astype(np.uint8)
    return rgb, mask, depth


@pytest.fixture(scope="module")
def metric(encoder):
    rgb, mask, depth = ball()
    return photos.onboard_photo(Photo(rgb), encoder, CONFIG, mask=mask, depth=depth, camera=K, progress=False)


def turn(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), -axis)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def similarity(rotation, translation, scale):
    return Similarity(*(jnp.asarray(x, jnp.float32) for x in (rotation, translation, scale)))


def test_a_photo_with_depth_makes_an_object_in_metres(metric, tmp_path):
    info, reference = metric.info, metric.info.reference
    assert info.metres_per_unit == 1.0 and reference.metric and reference.method == "depth" and reference.camera_given
    assert info.measured_diameter == pytest.approx(0.12, rel=0.25)  # the box's diagonal is what diameter may not exceed
    assert 0.2 < reference.seen < 0.6
    # The centre of the object, told through the file's own numbers, stands where the ball stands.
    camera_from_object = reference.camera_from_mesh @ info.object_from_mesh.inverse()
    np.testing.assert_allclose(camera_from_object.translation[:2], 0, atol=0.005)
    assert 0.54 < camera_from_object.translation[2] < 0.62  # behind its front; how far the back reaches is guessed
    path = tmp_path / "ball.ipjax"
    save(path, metric.templates, info)
    again = load(path)[1].reference
    assert again.as_json() == reference.as_json() and again.picture == reference.picture
    assert Image.open(io.BytesIO(again.picture)).size == (WIDTH, HEIGHT)
    assert any("made from the photo by depth" in line for line in check(path))


def test_points_say_how_far_they_may_be_off(metric, upright):
    """More behind than where the photo shows the object, and more without depth than with it."""
    for made, method in ((metric, "depth"), (upright, "inflate")):
        surface, off = made.templates.surface, deviations_of(method)
        seen, along = np.asarray(surface.seen), np.asarray(surface.along_std)
        assert made.info.reference.method == method and (seen == 1).any() and (seen == 0).any()
        np.testing.assert_allclose(along[seen == 1], off.front, rtol=1e-5)
        np.testing.assert_allclose(along[seen == 0], off.back, rtol=1e-5)
        np.testing.assert_allclose(surface.across_std, off.across, rtol=1e-5)
    assert deviations_of("depth").front < deviations_of("inflate").front < deviations_of("inflate").back


def test_objects_made_from_meshes_have_no_reference(tmp_path):
    templates, info = make_object()
    save(tmp_path / "mug.ipjax", templates, info)
    found = load(tmp_path / "mug.ipjax")[1]
    assert found.reference is None and found.measured_diameter is None  # its unit is known, its size is not kept
    with pytest.raises(ValueError, match="not made from a photo"):
        relative_pose(similarity(np.eye(3), np.zeros(3), 1.0), found)


def test_the_pose_relative_to_the_photo_is_the_motion_of_the_camera(metric):
    """A camera moved by a known motion sees the object where that motion puts it, whatever the mesh's frame."""
    reference, info = metric.info.reference, metric.info
    motion = Similarity(turn([1, 2, -1], 0.7), np.array([0.1, -0.05, 0.2]), np.ones(()))
    here = (motion @ (reference.camera_from_mesh @ info.object_from_mesh.inverse()).to_numpy()).to_jax()
    np.testing.assert_allclose(relative_pose(here, info).to_matrix(), motion.to_matrix(), atol=1e-5)
    # An estimate half as large again at the same place: the rigid motion still takes the centre to the centre.
    large = similarity(here.rotation, here.translation, 1.5 * float(here.scale))
    told = relative_pose_as_json(large, info)
    assert told["scale_m_per_reference_unit"] == pytest.approx(1.5, rel=1e-5) and told["reference_unit"] == "m"
    np.testing.assert_allclose(told["rigid_motion"], motion.to_matrix(), atol=1e-5)
    assert told["rotation_degrees"] == pytest.approx(np.degrees(0.7), abs=1e-3)
    assert "camera_from_reference_camera" in CONVENTIONS


def test_without_depth_the_reference_has_no_unit(metric):
    free = dataclasses.replace(
        metric.info, metres_per_unit=None, reference=dataclasses.replace(metric.info.reference, metric=False)
    )
    told = relative_pose_as_json(similarity(np.eye(3), np.array([0, 0, 1.0]), 0.1), free)
    assert told["reference_unit"] is None and "rigid_motion" not in told
    assert free.measured_diameter is None


def test_a_damaged_reference_is_refused(metric):
    told = metric.info.reference.as_json()
    json.dumps(told)
    for change in ({"scale": 0}, {"rotation": np.zeros((3, 3)).tolist()}, {"translation": [0, 0, float("nan")]}):
        with pytest.raises(ValueError, match=r"finite|rotation"):
            Reference.from_json(told | change)


def test_a_reduced_photo_keeps_its_camera_and_depth():
    """The same ray hits the same surface, before and after the photo was halved."""
    rgb, mask, depth = ball()
    half = Photo(rgb[::2, ::2].copy(), scale=0.5)
    prepared = photos.prepare_photo(half, mask=mask, depth=(1e3 * depth).astype(np.uint16), camera=K, depth_scale=1e-3)
    assert prepared.depth.shape == (HEIGHT // 2, WIDTH // 2)
    assert prepared.depth[30, 40] == pytest.approx(0.54, abs=0.002)
    np.testing.assert_allclose(np.asarray(prepared.camera.focal), FOCAL / 2)
    np.testing.assert_allclose(np.asarray(prepared.camera.centre), [(79.5 + 0.5) / 2 - 0.5, (59.5 + 0.5) / 2 - 0.5])


def test_a_lens_is_undone():
    """A photo bent by a barrel lens shows what one without a lens shows, up to rounding."""
    straight, mask, depth = ball()
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    bent = np.stack([(x - 79.5) / FOCAL, (y - 59.5) / FOCAL])
    ray = bent
    for _ in range(50):  # the ray that the lens bends to this pixel
        squared = np.sum(ray**2, axis=0)
        ray = bent / (1 - squared + 0.5 * squared**2)
    column, row = (np.rint(ray[k] * FOCAL + middle).astype(int) for k, middle in enumerate((79.5, 59.5)))
    seen = lambda image: image[np.clip(row, 0, HEIGHT - 1), np.clip(column, 0, WIDTH - 1)]
    lens = Intrinsics(K, (-1.0, 0.5, 0.0, 0.0, 0.0), "plumb_bob")
    prepared = photos.prepare_photo(Photo(seen(straight)), mask=seen(mask), depth=seen(depth), camera=lens)
    assert any("lens" in note for note in prepared.foreground.notes)
    middle = np.s_[15:105, 20:140]
    off = lambda image: np.abs(image.astype(int) - straight.astype(int))[middle].max()
    assert off(prepared.foreground.rgb) <= 3 and off(seen(straight)) > 6
    both = mask & prepared.foreground.mask
    assert both.sum() > 0.97 * mask.sum() and prepared.foreground.mask.sum() < 1.03 * mask.sum()
    assert np.median(np.abs(prepared.depth - depth)[both]) < 1e-3


BAD = {
    "depth without camera": ({"depth": 0}, "give the camera too"),
    "mask and box": ({"mask": 0, "box": (1, 1, 5, 5)}, "give one of"),
    "box without size": ({"box": (1, 1, 0, 5)}, "positive size"),
    "click of three": ({"click": (1, 1, 1)}, "x, y"),
    "depth of another size": ({"mask": 0, "depth": 1, "camera": K}, "align the depth"),
    "depth in mm without a unit": ({"mask": 0, "depth": 2, "camera": K}, "this looks like milli"),
    "no depth inside": ({"mask": 0, "depth": 3, "camera": K}, "no depth inside the mask"),
    "camera of another size": ({"mask": 0, "camera": Intrinsics(K, size=(640, 480))}, "belongs to images of 640"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_shots_are_refused_in_words(case):
    rgb, mask, depth = ball()
    given, words = BAD[case]
    given = dict(given)
    if "mask" in given:
        given["mask"] = mask
    if "depth" in given:
        millimetres = (1e3 * depth).astype(np.uint16)
        given["depth"] = (depth, depth[:50], millimetres, np.zeros_like(depth))[given["depth"]]
    with pytest.raises(ValueError, match=words):
        photos.prepare_photo(Photo(rgb), **given)


def test_a_photo_that_shows_no_patch_is_refused(encoder):
    """Poses are found through its patches: of a wire none is covered, and no object could be found."""
    rgb, *_ = ball()
    wire = np.zeros((HEIGHT, WIDTH), bool)
    wire[58:63, 5:155] = True
    with pytest.raises(ValueError, match="too thin"):
        photos.onboard_photo(Photo(rgb), encoder, CONFIG, mask=wire, camera=K, lrm="inflate", progress=False)


def test_triposr_without_weights_is_refused_but_auto_goes_on(encoder, monkeypatch, tmp_path):
    monkeypatch.setenv("IPJAX_CACHE", str(tmp_path))
    monkeypatch.delenv("IPJAX_TRIPOSR", raising=False)
    rgb, mask, _ = ball()
    with pytest.raises(ValueError, match="weights of TripoSR are not here"):
        photos.onboard_photo(Photo(rgb), encoder, CONFIG, mask=mask, lrm="triposr", progress=False)
    prepared = photos.prepare_photo(Photo(rgb), mask=mask)
    made, method = reconstruct_with_weights(prepared.foreground)
    assert method == "inflate" and not made.metric
    assert any("TripoSR's weights are not here" in line for line in made.report)


# --- the report -------------------------------------------------------------------------------------------------------


def test_turns_that_look_alike_are_found():
    steps = np.arange(findings.STEPS)
    plain = np.full(findings.STEPS, 0.95)
    told = np.where(steps == 0, 1.0, np.where((steps == 1) | (steps == 11), 0.7, 0.2))
    half = np.where(steps == 6, 0.85, told)
    found = findings.find_ambiguous(np.stack([plain, told, half]))
    assert found == ((60, 90, 120, 150, 180), (), (180,))


def test_the_report_needs_nothing_beside_it_and_says_what_matters(metric, encoder, tmp_path):
    from ipjax.files.meshes.cleaning import clean
    from ipjax.files.meshes.mesh import normalise

    mesh = normalise(clean(metric.reconstruction.mesh)[0])
    axes = np.asarray(metric.templates.axes, np.float64)
    poses = findings.poses_around_axes(axes, 3.0)
    eyes = -np.einsum("vij,vi->vj", np.asarray(poses.rotation), np.asarray(poses.translation))
    # Views of one end stand on a circle about their axis.
    np.testing.assert_allclose((eyes[:12] @ axes[0]), 3 * np.sin(np.deg2rad(findings.TILT)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(np.asarray(poses.rotation)), 1, atol=1e-5)
    found = findings.Findings(
        np.full((3, 12), 0.9), ((180,), (), ()), np.array([0.5, 0.6, 0.7]), 9.0, ("symmetric: <so it is>",)
    )
    path = tmp_path / "r.html"
    write_report(path, metric.templates, metric.info, mesh, found, metric)
    text = path.read_text()
    assert not re.search(r"(src|href)=\"(?!data:)|url\(|<script", text)
    for words in ("symmetric: &lt;so it is&gt;", "mm (measured)", "no learned weights", "front (the photo)", "guessed"):
        assert words in text, words
    assert text.count("<img") >= 1 + 6 + 6 + 3


def test_thin_and_textureless_objects_are_warned_of(metric):
    info = dataclasses.replace(metric.info, pictures=np.full((4, 56, 56, 3), 90, np.uint8))
    texture = findings.measure_texture(info)
    assert texture < 0.1 < findings.measure_texture(metric.info)
    told = findings.list_warnings(
        metric.templates, info, np.array([0.02, 0.5, 0.8]), ((), (60, 90, 120, 150, 180), ()), texture
    )
    assert any("thin" in line for line in told) and any("textureless" in line for line in told)
    assert any("always looks alike" in line and "ambiguous" in line for line in told)


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (("none.jpg",), "no such photo"),
        (("p.png", "--unit", "mm"), "--unit does not belong to a photo"),
        (("p.png", "--rolls", "2"), "--rolls does not belong to a photo without depth"),
        (("m.ply", "--mask", "p.png"), "--mask does not belong to a mesh"),
        (("p.png", "--box", "1,x"), "is no box"),
        (("p.png", "--report", "r.pdf"), "must end in .html"),
        (("p.png", "--depth", "p.png"), "give the camera too"),
        (("p.png",), "blank"),
        (("p.png", "--lrm", "magic"), "invalid choice"),
    ],
)
def test_the_command_refuses_in_one_line(words, answer, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    monkeypatch.chdir(tmp_path)
    Image.fromarray(np.full((40, 40, 3), 120, np.uint8)).save("p.png")
    (tmp_path / "m.ply").write_text("ply")
    try:
        status = cli.main(["onboard", *words, "-o", "o.ipjax"])
    except SystemExit as end:
        status = end.code
    told = capsys.readouterr().err.strip()
    assert status == 2 and answer in told and "\n" not in told


def test_a_photo_goes_through_the_command(encoder, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    monkeypatch.setenv("IPJAX_CACHE", str(tmp_path))
    monkeypatch.setattr("ipjax.commands.interface.options.load_encoder", lambda arguments: encoder)
    rgb, mask, _ = ball()
    Image.fromarray(np.dstack([rgb, np.uint8(255) * mask.astype(np.uint8)])).save(tmp_path / "ball.png")
    out, mesh = tmp_path / "ball.ipjax", tmp_path / "ball.glb"
    words = ["onboard", tmp_path / "ball.png", "-o", out, "--save-mesh", mesh]
    assert cli.main([str(w) for w in words]) == 0
    told = capsys.readouterr().out
    assert "diameter unknown" in told and "made without learned weights" in told
    assert load(out)[1].reference.method == "inflate" and mesh.stat().st_size > 1000


def test_too_many_channels_are_refused_before_anything_is_drawn(encoder, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    monkeypatch.setattr("ipjax.commands.interface.options.load_encoder", lambda arguments: encoder)
    monkeypatch.setattr("ipjax.onboarding.mesh.render", lambda *_, **__: pytest.fail("views were rendered"))
    rgb, mask, _ = ball()
    Image.fromarray(np.dstack([rgb, np.uint8(255) * mask.astype(np.uint8)])).save(tmp_path / "ball.png")
    words = ["onboard", tmp_path / "ball.png", "-o", tmp_path / "ball.ipjax", "--channels", 5000]
    assert cli.main([str(w) for w in words]) == 2
    assert re.search(r"features of \d+ channels cannot be cut to 5000", capsys.readouterr().err)
    assert not (tmp_path / "ball.ipjax").exists()


# --- a photo from anywhere --------------------------------------------------------------------------------------------


STORED = {  # how a camera that was turned stores what is shown upright
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.swapaxes(0, 1),
    6: lambda image: image.swapaxes(0, 1)[::-1],
    7: lambda image: image.swapaxes(0, 1)[::-1, ::-1],
    8: lambda image: image.swapaxes(0, 1)[:, ::-1],
}
ON_FILM = 54  # mm


def save_photo(path, orientation=1, size=None, tags=()):
    """The ball before a plain wall as a camera stores it: no mask, and the sizes before it was turned upright."""
    rgb, mask, _ = ball()
    rgb[~mask] = 200
    image = Image.fromarray(np.ascontiguousarray(STORED[orientation](rgb)))
    image = image if size is None else image.resize(size)
    written = {exif_tags.FOCAL_ON_FILM: ON_FILM, exif_tags.WIDTH: image.width, exif_tags.HEIGHT: image.height}
    image.save(path, exif=exif_tags.make_exif(written | dict(tags), orientation))
    return path


@pytest.fixture(scope="module")
def upright(encoder, tmp_path_factory):
    path = save_photo(tmp_path_factory.mktemp("upright") / "photo.png")
    return photos.onboard_photo(path, encoder, CONFIG, progress=False)


@pytest.mark.parametrize("orientation", range(2, 9))
def test_a_turned_photo_is_the_upright_one(orientation, tmp_path):
    true = photos.prepare_photo(save_photo(tmp_path / "upright.png"))
    found = photos.prepare_photo(save_photo(tmp_path / "turned.png", orientation))
    same = lambda name: np.testing.assert_array_equal(getattr(found.foreground, name), getattr(true.foreground, name))
    same("rgb"), same("mask")
    jax.tree.map(np.testing.assert_array_equal, found.camera, true.camera)
    assert (found.camera_source, found.foreground.notes) == ("exif", true.foreground.notes)


def test_a_turned_photo_makes_the_object_of_the_upright_one(encoder, upright, tmp_path):
    turned = photos.onboard_photo(save_photo(tmp_path / "photo.png", 6), encoder, CONFIG, progress=False)
    true, found = upright.info.reference, turned.info.reference
    assert true.camera_source == found.camera_source == "exif" and 0 < found.focal_deviation < 0.2
    assert found.focal == true.focal == pytest.approx((ON_FILM * np.hypot(160, 120) / np.hypot(36, 24),) * 2)
    assert (found.centre, found.size) == (true.centre, true.size) == ((79.5, 59.5), (160, 120))
    np.testing.assert_array_equal(found.translation, true.translation)
    same = lambda a, b: np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    jax.tree.map(same, turned.templates, upright.templates)


def test_the_object_keeps_where_its_focal_length_is_from(encoder, upright, tmp_path):
    path = tmp_path / "ball.ipjax"
    save(path, upright.templates, upright.info)
    kept = load(path)[1]
    assert kept.reference == dataclasses.replace(
        upright.info.reference, rotation=kept.reference.rotation, translation=kept.reference.translation
    )
    assert "EXIF" in kept.reference.describe_camera() and any("54 mm on 35 mm film" in note for note in kept.notes)
    # Files of before said only whether the camera was given.
    told = upright.info.reference.as_json()
    for name in ("camera_source", "focal_deviation"):
        del told[name]
    before = Reference.from_json(told | {"camera_given": False})
    assert before.camera_source == "guessed" and before.focal_deviation == GUESS_DEVIATION


@pytest.mark.parametrize(
    ("tags", "size", "given", "source", "focal", "words"),
    [
        ({}, (80, 60), {}, "exif", ON_FILM * 100 / np.hypot(36, 24), "54 mm"),
        (
            {exif_tags.WIDTH: 320, exif_tags.HEIGHT: 240},
            None,
            {},
            "exif",
            ON_FILM * 200 / np.hypot(36, 24),
            "320 × 240",
        ),
        ({exif_tags.WIDTH: 320}, None, {}, "guessed", None, "is a part"),  # 320 × 120: cropped since
        ({exif_tags.FOCAL_ON_FILM: 0}, None, {}, "guessed", None, "were guessed"),
        ({}, None, {"camera": K}, "given", FOCAL, "mask is what differs"),
    ],
)
def test_the_focal_length_is_given_or_of_exif_or_guessed(tags, size, given, source, focal, words, tmp_path):
    path = save_photo(tmp_path / "photo.jpg", size=size, tags=tags)
    prepared = photos.prepare_photo(path, **given)
    made, _ = reconstruct_with_weights(prepared.foreground, method="inflate", camera=prepared.camera)
    assert prepared.camera_source == source and any(words in note for note in made.report)
    assert (prepared.camera is None) == (source == "guessed") and (prepared.focal_deviation == 0) == (source == "given")
    if focal is not None:
        np.testing.assert_allclose(made.camera.focal, focal, rtol=1e-6)
    assert not (source == "given" and any("EXIF" in note for note in made.report))


def test_exif_keeps_to_a_photo_that_is_reduced(tmp_path):
    photo = read_photo(save_photo(tmp_path / "photo.jpg", 6), max_side=80)
    prepared = photos.prepare_photo(photo)
    assert prepared.foreground.mask.shape == (60, 80)
    np.testing.assert_allclose(prepared.camera.focal, ON_FILM * 100 / np.hypot(36, 24), rtol=1e-6)
    np.testing.assert_allclose(prepared.camera.centre, (39.5, 29.5))


def test_the_report_says_what_is_known_and_what_is_guessed(metric, upright):
    """With depth the front is measured; without, its depth is a guess, and no turn of it is called a symmetry."""
    headings = lambda reference: {head: {name for name, _ in rows} for head, rows in list_knowledge(reference)}
    true, guess = metric.info.reference, upright.info.reference
    assert headings(true) == {"Known": {"colours", "outline", "front and size", "camera"}, "Guessed": {"back"}}
    found = headings(guess)
    assert {"outline", "directions"} <= found["Known"] and found["Guessed"] == {"depth", "back", "size", "camera"}
    assert "as the photo's EXIF tells" in dict(list_knowledge(guess)[1][1])["camera"]
    alike = (np.array([0.6, 0.6, 0.7]), ((180,), (), ()), 9.0)
    told = findings.list_warnings(upright.templates, upright.info, *alike)
    assert any("no depth" in line for line in told) and not any("symmetric" in line for line in told)
    assert any("symmetric" in line for line in findings.list_warnings(metric.templates, metric.info, *alike))

"""``ipjax estimate``: malformed input gets one line and status 2, a folder of frames is estimated, told and drawn."""

import dataclasses
import json
import re
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from builders.command_lines import K, estimate_words, run
from builders.objects import make_object, nan, rewrite
from PIL import Image

from ipjax.cameras import point_map
from ipjax.estimation.features import describe
from ipjax.files.images.run_lengths import encode_rle
from ipjax.files.objects.saving import save
from ipjax.records import Camera, Patches, Similarity, Surface, Templates, View


def image(array, name):
    def write(folder):
        Image.fromarray(array).save(folder / name)

    return write


def text(name, content):
    return lambda folder: (folder / name).write_text(content)


def cut(name, size):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:size])


FLAT_MM = np.full((96, 128), 812, np.uint16)
# What is wrong, how it comes about, what else is on the command line, and words of the answer.
MALFORMED = {
    "no rgb": (None, {"rgb": "none.png"}, (), "no such file"),
    "no object file": (None, {"object": "none.ipjax"}, (), "no such object file"),
    "no camera file": (None, {"camera": "none.json"}, (), "no such camera file"),
    "no depth option": (None, {"depth": None}, (), "--depth"),
    "rgb is text": (text("rgb.png", "hello"), {}, (), "not an image"),
    "rgb truncated": (cut("rgb.png", 900), {}, (), "broken image"),
    "rgb and depth differ": (image(FLAT_MM[:48], "depth.png"), {}, (), "align the depth"),
    "depth of 8 bits": (image(FLAT_MM.astype(np.uint8), "depth.png"), {}, (), "16-bit or float"),
    "depth all zero": (image(0 * FLAT_MM, "depth.png"), {}, (), "no depth inside the mask"),
    "depth all NaN": (
        image(np.full((96, 128), np.nan, np.float32), "depth.tif"),
        {"depth": "depth.tif"},
        (),
        "no depth",
    ),
    "depth in mm without a unit": (
        text("camera.json", json.dumps(K)),
        {},
        (),
        r"median depth 812: this looks like milli",
    ),
    "depth in mm called metres": (None, {}, ("--depth-scale", 1), r"pass depth_scale=0\.001"),
    "depth scale negative": (None, {}, ("--depth-scale", -1), "positive"),
    "mask empty": (image(np.zeros((96, 128), np.uint8), "mask.png"), {}, (), "the mask is empty"),
    "mask of another size": (image(np.full((40, 50), 255, np.uint8), "mask.png"), {}, (), "but the mask is"),
    "box outside": (None, {"mask": None}, ("--box", "500,500,10,10"), "outside the image"),
    "box without size": (None, {"mask": None}, ("--box", "5,5,0,10"), "positive size"),
    "K singular": (text("camera.json", json.dumps(K | {"fx": 0})), {}, (), "singular"),
    "K not finite": (text("camera.json", json.dumps(K | {"fx": "nan"})), {}, (), "not finite"),
    "camera of another image": (text("camera.json", '{"7": {}, "8": {}}'), {}, (), "say which one"),
    "camera broken": (text("camera.json", '{"fx": '), {}, (), "not valid JSON"),
    "camera of another size": (text("camera.json", json.dumps(K | dict(width=640, height=480))), {}, (), "640 × 480"),
    "lens unknown": (text("camera.json", json.dumps(K | dict(d=[1], distortion_model="mei"))), {}, (), "unknown lens"),
    "object truncated": (cut("mug.ipjax", 700), {}, (), "damaged"),
    "object is an image": (None, {"object": "rgb.png"}, (), "not an object file"),
    "object with NaN": (lambda f: rewrite(f / "mug.ipjax", change={"rotation": nan}), {}, (), "not finite"),
    "no such weights": (None, {}, ("--weights", "none.safetensors"), "no weights file"),
    "two masks for one object": (None, {}, ("--mask", "mask.png"), "needs one"),
    "diameter in mm": (None, {}, ("--diameter", 120), "metres"),
    "seed negative": (None, {}, ("--seed", -1), "seed"),
    "output to nowhere": (None, {}, ("-o", "/nonexistent/pose.json"), "does not exist"),
    "output not JSON": (None, {}, ("-o", "pose.txt"), "must end in .json"),
    "overlay no picture": (None, {}, ("--overlay", "pose.gif"), "must end in .png"),
    "unknown option": (None, {}, ("--colour", "red"), "unrecognized"),
    "not a number": (None, {}, ("--seed", "x"), "invalid int"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_input_gets_one_line_and_status_2(name, case, capfd):
    import jaxtyping

    spoil, replace, more, words = MALFORMED[name]
    if spoil is not None:
        spoil(case)
    before = sorted(path.name for path in case.rglob("*"))
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        status = run(estimate_words(case, *more, **replace))
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    out, error = capfd.readouterr()
    assert status == 2
    assert out == "" and error.count("\n") == 1 and error.startswith("ipjax"), error
    assert re.search(words, error), error
    assert sorted(path.name for path in case.rglob("*")) == before


def test_another_encoders_object_file_is_refused(case, capfd, monkeypatch):
    other = SimpleNamespace(identity="dinov2 vitb14 block=8 norm=1 float32 sha256:00")
    monkeypatch.setattr("ipjax.files.weights.matching.load_encoder", lambda *_, **__: other)
    assert run(estimate_words(case, "--weights", case / "rgb.png")) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "onboard the object again" in error and "vitb14" in error
    assert not (case / "out.json").exists()


class Cells(eqx.Module):
    """A stand-in for the encoder: the mean colour of each of 8 × 8 cells as its feature."""

    identity: str = eqx.field(static=True, default="cells")

    def __call__(self, rgb):
        cells = rgb.reshape(8, 28, 8, 28, 3).mean((1, 3)) - 0.5
        return cells / jnp.maximum(jnp.linalg.norm(cells, axis=-1, keepdims=True), 1e-6)


def relief():
    """A coloured relief before a camera, 224 pixels wide: rgb, depth in model units, mask, K."""
    y, x = np.mgrid[:224, :224]
    depth = (3 + 0.06 * np.sin(x / 25) * np.cos(y / 31) + 0.04 * np.cos(x / 60 + y / 45)).astype(np.float32)
    mask = (abs(x - 111.5) < 93) & (abs(y - 111.5) < 93)
    cells = np.random.default_rng(5).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    rgb = np.kron(cells, np.ones((28, 28, 1), np.uint8))
    return rgb * mask[..., None], depth * mask, mask, (840.0, 840.0, 111.5, 111.5)


@pytest.fixture
def found_case(tmp_path, monkeypatch):
    """An object whose first template is the relief seen straight on; a frame that shows it at 30 cm a unit."""
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    encoder = Cells()
    rgb, depth, mask, (focal, _, centre, _) = relief()
    camera = Camera(focal=jnp.full(2, focal), centre=jnp.full(2, centre))
    view = View(
        rgb=jnp.asarray(rgb / 255, jnp.float32), depth=jnp.asarray(depth), mask=jnp.asarray(mask), camera=camera
    )
    patches = describe(encoder, view)
    offset = np.array([0.0, 0, 3])
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # camera_from_object of the template
    to_object = lambda points: jnp.asarray((np.asarray(points, np.float64) - offset) @ rotation, jnp.float32)
    cloud = np.asarray(point_map(camera, view.depth))[mask][::17]
    flat = jnp.tile(jnp.asarray([[0.0, 0, -1]]), (len(cloud), 1))
    both = lambda x, y: jnp.stack([x, y])
    templates = Templates(
        patches=Patches(
            features=both(patches.features, jnp.roll(patches.features, 7, axis=0)).astype(jnp.float16),
            points=both(to_object(patches.points), to_object(patches.points)[::-1]),
            grid=both(patches.grid, patches.grid),
            valid=both(patches.valid, patches.valid),
        ),
        mean=jnp.zeros(patches.features.shape[-1]),
        norm=jnp.ones((2, 64)),
        seen=jnp.ones((2, 64)),
        camera_from_object=Similarity(
            jnp.asarray(np.stack([rotation, np.eye(3)]), jnp.float32),
            jnp.asarray(np.stack([offset, offset]), jnp.float32),
            jnp.ones(2),
        ),
        camera=Camera(focal=jnp.full((2, 2), focal), centre=jnp.full((2, 2), centre)),
        surface=Surface(points=to_object(cloud), normals=flat, seen=jnp.ones(len(cloud))),
        extents=jnp.asarray(np.ptp(np.asarray(to_object(cloud)), axis=0), jnp.float32),
        axes=jnp.eye(3),
    )
    info = dataclasses.replace(make_object()[1], encoder="cells", resolution=224, vertices=None, faces=None)
    unit = 0.3 * info.mesh_scale  # its diameter is 0.3 m
    info = dataclasses.replace(info, pictures=np.stack([rgb, rgb]), colours=None, metres_per_unit=unit)
    save(tmp_path / "relief.ipjax", templates, info)
    named = dataclasses.replace(info, name="obj_000004", metres_per_unit=unit / 2)  # a mesh file of another unit
    save(tmp_path / "obj_000004.ipjax", templates, named)
    for folder in ("rgb", "depth", "mask", "mask_visib"):
        (tmp_path / "scene" / folder).mkdir(parents=True)
    Image.fromarray(rgb).save(tmp_path / "scene" / "rgb" / "000001.png")
    Image.fromarray((depth * 300).round().astype(np.uint16)).save(tmp_path / "scene" / "depth" / "000001.png")
    # The masks stand in the order of scene_gt.json, which is not that of the objects on the command line.
    for i, shown in enumerate((mask & False, mask[::-1] & False, mask, mask)):
        for folder in ("mask", "mask_visib"):
            path = tmp_path / "scene" / folder / f"000001_{i:06d}.png"
            Image.fromarray(shown.astype(np.uint8) * 255).save(path)
    truths = [{"obj_id": number} for number in (9, 2, 4, 9)]
    shares = [{"visib_fract": share} for share in (0.1, 0.9, 0.9, 0.8)]
    (tmp_path / "scene" / "scene_gt.json").write_text(json.dumps({"1": truths, "2": truths}))
    (tmp_path / "scene" / "scene_gt_info.json").write_text(json.dumps({"1": shares, "2": shares}))
    Image.fromarray(rgb).save(tmp_path / "scene" / "rgb" / "000002.png")  # this frame has no depth
    entry = {"cam_K": [focal, 0, centre, 0, focal, centre, 0, 0, 1], "depth_scale": 1.0}
    (tmp_path / "scene" / "scene_camera.json").write_text(json.dumps({"1": entry, "2": entry}))
    monkeypatch.setattr("ipjax.files.weights.matching.load_matching_encoder", lambda *_: encoder)
    return tmp_path, rotation, 0.3 * offset


def test_a_folder_of_frames_is_estimated_told_and_drawn(found_case, capfd):
    folder, rotation, translation = found_case
    objects = [folder / "relief.ipjax", folder / "obj_000004.ipjax"]
    words = ["estimate", *objects, "--obj-id", 9, "--obj-id", 4, "--frames", folder / "scene"]
    assert run([*map(str, words), "-o", str(folder / "poses.json"), "--overlay", str(folder / "pictures")]) == 0
    out, error = capfd.readouterr()
    assert "000001: mug: centre" in out and "000002: " in error and "no such file" in error
    assert error.count("the size found is") == 1 and error.count("image 000001: of 2 of object 9") == 1
    told = json.loads((folder / "poses.json").read_text())
    good, bad = told["frames"]
    assert bad["frame"] == "000002" and "no such file" in bad["error"]
    one, doubted = good["objects"]
    # Of two instances, the more visible; found by its number in scene_gt.json, not by its place on the command line.
    assert one["mask"].endswith("mask_visib/000001_000003.png")
    assert doubted["mask"].endswith("mask_visib/000001_000002.png")
    # The same answer, but the mesh file says half of the size: less sure, and said so.
    np.testing.assert_allclose(doubted["camera_from_object"]["matrix"], one["camera_from_object"]["matrix"], atol=1e-6)
    ratio = doubted["size_mm"]["diameter"] / doubted["size_from_mesh_mm"]["diameter"]
    assert ratio == pytest.approx(2, rel=0.05)
    loss = np.exp(-0.5 * (np.log(ratio) / np.log(1.25)) ** 2)
    assert doubted["confidence"] == pytest.approx(one["confidence"] * loss, rel=1e-3)
    assert one["present"] and not doubted["present"]
    assert any("times the 150 mm of its mesh file" in line for line in good["warnings"])
    pose = one["camera_from_object"]
    np.testing.assert_allclose(pose["rotation"], rotation, atol=0.05)
    np.testing.assert_allclose(pose["translation_m"], translation, atol=0.015)
    assert one["size_mm"]["diameter"] == pytest.approx(300, rel=0.05)
    assert {"frame", "describe", "estimate", "compile"} <= one["stage_seconds"].keys()
    assert one["success"] and one["template"] == 0 and one["inliers"] >= 10
    assert told["conventions"]["camera"].startswith("OpenCV")
    picture = np.asarray(Image.open(folder / "pictures" / "000001.png"))
    assert picture.shape[0] >= 900 and picture.shape[1] > 1400 and picture.std() > 20
    assert [path.name for path in (folder / "pictures").iterdir()] == ["000001.png"]
    assert told["config"] == "default" and told["set"] == []


def test_a_machine_gets_one_document_and_a_person_one_line(found_case, capfd):
    folder, _, translation = found_case
    words = ["estimate", folder / "relief.ipjax", "--obj-id", 9, "--frames", folder / "scene", "--config", "paper"]
    words += ["--set", "align.count=64", "--set", "match.pairs=32"]
    assert run([*map(str, words), "--json", "--quiet"]) == 0
    out, error = capfd.readouterr()
    told = json.loads(out)
    assert error == "" and (told["config"], told["set"]) == ("paper", ["align.count=64", "match.pairs=32"])
    pose = told["frames"][0]["objects"][0]["camera_from_object"]
    np.testing.assert_allclose(pose["translation_m"], translation, atol=0.03)
    assert run([*map(str, words)]) == 0
    out, error = capfd.readouterr()
    assert out.count("\n") == 1 and "000001: mug: centre" in out and "no such file" in error


def write_detections(path, *masks, **more):
    """Masks as BOP's detections of image 1, the first the surest; none has a class unless ``category_id`` says it."""
    entries = [{"score": 1 / (1 + i), "segmentation": encode_rle(mask)} | more for i, mask in enumerate(masks)]
    path.write_text(json.dumps([entry | {"scene_id": 0, "image_id": 1} for entry in entries]))
    return path


def test_of_several_masks_without_a_class_each_is_tried(found_case, capfd):
    folder, _, translation = found_case
    whole = relief()[2]
    corner, empty = whole.copy(), whole & False
    corner[:, 60:] = corner[60:] = False
    scene = folder / "scene"
    words = ["estimate", folder / "relief.ipjax", "--rgb", scene / "rgb" / "000001.png", "--config", "fast"]
    words += ["--depth", scene / "depth" / "000001.png", "--camera", scene / "scene_camera.json", "--json"]

    def told(file, *more):
        status = run([*map(str, words), "--mask", str(file), *map(str, more)])
        out, error = capfd.readouterr()
        return (json.loads(out)["frames"][0]["objects"][0] if out else status), error

    def place(one):
        return one["camera_from_object"]["translation_m"]

    masks = write_detections(folder / "detections.json", corner, empty, whole)
    one, error = told(masks)
    np.testing.assert_allclose(place(one), translation, atol=0.015)
    tried = {entry["index"]: entry for entry in one["candidates"]}
    assert tried[2]["chosen"] and not tried[0]["chosen"] and tried[2]["confidence"] > tried[0]["confidence"]
    assert one["confidence"] == tried[2]["confidence"]
    assert tried[1]["rejected"] == "the mask is empty" and tried[1]["confidence"] is None
    assert "3 masks may be the object's" in error and "mask 2 has the highest confidence; 2 tried" in error
    assert "1 could not be used" in error
    # The same answer as from that mask alone, which nothing else is said of.
    alone, error = told(masks, "--instance", 2)
    assert place(alone) == place(one) and "candidates" not in alone and "tried" not in error
    # A bound, by their own score, and said; then only the wrong one is left.
    bound, error = told(masks, "--candidates", 1)
    assert bound["confidence"] == tried[0]["confidence"]
    assert "of 3 masks the 1 first by score are tried, one estimate each" in error
    # An image of labels, where the object is the second; and its name or --obj-id chooses among classes.
    labels = folder / "labels.png"
    Image.fromarray((corner * 1 + (whole & ~corner) * 2).astype(np.uint8)).save(labels)
    numbered, _ = told(labels)
    assert {e["index"]: e["source"].rpartition(" ")[2] for e in numbered["candidates"]} == {0: "1", 1: "2"}
    assert [e["index"] for e in numbered["candidates"] if e["chosen"]] == [1]
    classes = write_detections(folder / "classes.json", whole, category_id=4)
    entries = json.loads(classes.read_text())
    classes.write_text(json.dumps([entries[0] | {"category_id": 9, "segmentation": encode_rle(corner)}, *entries]))
    assert place(told(classes, "--obj-id", 4)[0]) == place(alone)
    assert told(classes)[0] == 2
    assert "the objects 4, 9: say with --obj-id which is mug" in told(classes)[1]
    assert "no detection of object 3; it has those of 4, 9" in told(classes, "--obj-id", 3)[1]
    assert "no mask 5 of this image; there are 0, 1, 2" in told(masks, "--instance", 5)[1]
    small = write_detections(folder / "small.json", corner[:90])
    assert "entry 0: its mask is 224 × 90, but the image 224 × 224" in told(small)[1]
    nothing = write_detections(folder / "nothing.json", empty, empty)
    assert "none of 2 masks can be used" in told(nothing)[1]


def test_a_folder_of_frames_may_have_detections_as_masks(found_case, capfd):
    folder, _, translation = found_case
    scene = folder / "scene"
    (scene / "scene_gt.json").unlink()
    for path in (scene / "mask").iterdir():
        path.unlink()
    mask = relief()[2]
    np.savez(scene / "mask" / "000001.npz", segmentation=np.stack([~mask, mask]), category_id=[7, 4], score=[0.5, 0.25])
    words = ["estimate", folder / "obj_000004.ipjax", "--frames", scene, "--config", "fast", "--json"]
    run([*map(str, words)])
    out, _ = capfd.readouterr()
    good, bad = json.loads(out)["frames"]
    (one,) = good["objects"]
    assert one["mask"].endswith("000001.npz") and "no such file" in bad["error"]
    np.testing.assert_allclose(one["camera_from_object"]["translation_m"], translation, atol=0.015)


def test_a_scene_of_bop_asks_which_mask_is_whose(case, capfd):
    """Nothing says which of several masks belongs to an object: it is asked, before anything is computed."""
    scene = case / "scene"
    for folder in ("rgb", "depth", "mask"):
        (scene / folder).mkdir(parents=True)
    (scene / "rgb" / "000007.png").write_bytes((case / "rgb.png").read_bytes())
    (scene / "depth" / "000007.png").write_bytes((case / "depth.png").read_bytes())
    (scene / "camera.json").write_bytes((case / "camera.json").read_bytes())
    for i in range(3):
        (scene / "mask" / f"000007_{i:06d}.png").write_bytes((case / "mask.png").read_bytes())
    words = ["estimate", str(case / "mug.ipjax"), "--frames", str(scene)]

    def told(*more: str) -> str:
        assert run([*words, *more]) == 2
        out, error = capfd.readouterr()
        assert out == "" and error.count("\n") == 1
        return error

    assert "3 masks, and 1 object is wanted: say which mask is whose with --instance" in told()
    assert "needs a scene_gt.json" in told("--obj-id", "3")
    assert "once for each object" in told("--instance", "0", "--instance", "1")
    truth = scene / "scene_gt.json"
    truth.write_text(json.dumps({"7": [{"obj_id": 2}, {"obj_id": 5}, {"obj_id": 2}]}))
    assert "it has the objects 2, 5: say with --obj-id which is mug" in told()
    truth.write_text("[" * 100_000)
    assert "nested too deeply" in told()
    truth.write_text(json.dumps({"7": [{"obj": 2}]}))
    assert "a list of instances with obj_id" in told()

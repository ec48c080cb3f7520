"""``ipjax estimate`` without a mask: the object is sought, told and drawn; and a rough mask is mended."""

import base64
import dataclasses
import html
import json
import re

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from builders import detections
from builders.command_lines import run
from builders.tiny_pipeline import DRAWN
from PIL import Image

from ipjax.commands.interface import options
from ipjax.config import DetectConfig
from ipjax.estimation.confidence import probability
from ipjax.files.images.run_lengths import decode_rle
from ipjax.files.objects.saving import save
from ipjax.records import Agreement
from ipjax.synthetic.problems import CoordinateEncoder, make_encoder


class Named(CoordinateEncoder):
    """The tests' encoder with an identity, as object files want it."""

    identity: str = eqx.field(static=True, default="coordinates")


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A folder with an object file and a frame of two of it, and the words that name them."""
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    plain = make_encoder()
    encoder = Named(plain.frequencies, plain.phases)
    monkeypatch.setattr("ipjax.files.weights.matching.load_matching_encoder", lambda *_: encoder)
    monkeypatch.setattr("ipjax.config.Config.fast", lambda: DRAWN)
    monkeypatch.setattr(options, "read_config", lambda arguments: DRAWN)
    templates, info = detections.ellipsoid()
    assert templates.appearance is not None
    vertices = np.asarray(templates.appearance.points[::40], np.float32)
    save(tmp_path / "mug.ipjax", templates, dataclasses.replace(info, encoder="coordinates", vertices=vertices))
    frame = detections.make_frame(detections.place(-0.12, 0.0, seed=1), detections.place(0.12, 0.02, seed=2))
    Image.fromarray(frame.rgb).save(tmp_path / "rgb.png")
    np.save(tmp_path / "depth.npy", frame.depth)
    (tmp_path / "camera.json").write_text(json.dumps({"cam_K": detections.MATRIX.ravel().tolist()}))
    words = ["estimate", tmp_path / "mug.ipjax", "--rgb", tmp_path / "rgb.png", "--depth", tmp_path / "depth.npy"]
    return tmp_path, [*map(str, words), "--camera", str(tmp_path / "camera.json")], frame


def overlap(mask, truth) -> float:
    return (mask & truth).sum() / (mask | truth).sum()


def test_objects_are_sought_where_no_mask_is_given(scene, capfd):
    folder, words, frame = scene
    assert run([*words, "--instances", "all", "--json", "--overlay", str(folder / "out.png")]) == 0
    out, error = capfd.readouterr()
    (told,) = json.loads(out)["frames"]
    assert "2 masks were found, not given" in error
    assert [one["present"] for one in told["objects"]] == [True, True]
    masks = [decode_rle(one["detected"]["mask"]) for one in told["objects"]]
    for truth in frame.masks:
        assert sum(overlap(mask, truth) > 0.8 for mask in masks) == 1
    one = told["objects"][0]
    assert one["mask"] is None and "verified by its pose" in one["detected"]["how"]
    assert one["object_file"].endswith("mug.ipjax") and len(one["detected"]["box"]) == 4
    assert told["detection"]["proposals"] > 0 and all(r["reason"] for r in told["detection"]["rejected"])
    assert np.asarray(Image.open(folder / "out.png")).std() > 20


def test_a_page_explains_what_was_found_and_what_was_not(scene, capfd):
    folder, words, _ = scene
    page = folder / "why.html"
    assert run([*words, "--explain", str(page), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)["frames"][0]
    assert told["detection"]["page"] == str(page)
    text = page.read_text()
    assert "http" not in text.replace("http-equiv", "")  # nothing of it lies elsewhere
    (ranking,) = told["detection"]["ranking"]
    (one,) = told["objects"]
    for section in ("Found", "Proposals", "Ranking", "Verification", "Time"):
        assert re.search(rf"<h[23]>{section}", text)
    assert f"{one['detected']['confidence']:.2f}" in text and ">found<" in text
    for lost in told["detection"]["rejected"]:
        assert html.escape(lost["reason"]) in text and f">{lost['why']}<" in text and lost["steps"]
        assert lost["lost_to"] is None or lost["lost_to"]["proposal"] in ranking["proposals"]
    pictures = [read_picture(code) for code in re.findall(r"data:image/jpeg;base64,([^\"]+)", text)]
    assert len(pictures) > 2 + ranking["estimated"]
    # The frame with the object drawn into it, and with the proposals; then crops, all of one size.
    assert pictures[0].shape[0] == pictures[1].shape[0] == 900
    assert {picture.shape for picture in pictures[2:]} == {(160, 160, 3)}
    # Estimated with the settings that were asked for, in the mask that was found; with the confidence of detections.
    last = one["detected"]["steps"][-1]
    assert last["where"].endswith("settings asked for")
    assert (last["score"], last["confidence"]) == (one["detected"]["score"], one["confidence"])
    agreement = Agreement(**{name: jnp.float32(value) for name, value in one["agreement"].items()})
    assert one["confidence"] == pytest.approx(float(probability(agreement, jnp.array(DetectConfig().drawn))), abs=1e-5)


def read_picture(code: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(code), np.uint8), cv2.IMREAD_COLOR)


def test_a_folder_of_frames_is_explained_page_by_page(scene):
    folder, (_, mug, *_), frame = scene
    for name in ("rgb", "depth"):
        (folder / name).mkdir()
    depth = np.zeros_like(frame.depth)
    depth[:2, :2] = 1.0  # no proposal has depth: that is explained, too
    Image.fromarray(frame.rgb).save(folder / "rgb" / "b.png")
    np.save(folder / "depth" / "b.npy", depth)
    assert run(["estimate", mug, "--frames", str(folder), "--explain", str(folder / "why"), "--quiet"]) == 1
    assert [path.name for path in (folder / "why").iterdir()] == ["b.html"]
    assert "no proposal to compare it with" in (folder / "why" / "b.html").read_text()


def test_a_click_says_which(scene, capfd):
    _, words, frame = scene
    mask = frame.masks[1]
    y, x = (int(np.median(side)) for side in np.nonzero(mask))
    assert run([*words, "--click", f"{x},{y}", "--json"]) == 0
    (one,) = json.loads(capfd.readouterr().out)["frames"][0]["objects"]
    assert overlap(decode_rle(one["detected"]["mask"]), mask) > 0.8


def test_a_rough_mask_is_mended_and_it_is_said(scene, capfd):
    folder, words, frame = scene
    wide = cv2.dilate(frame.masks[0].astype(np.uint8), np.ones((17, 17), np.uint8))
    Image.fromarray(255 * wide).save(folder / "wide.png")
    assert run([*words, "--mask", str(folder / "wide.png"), "--mask-is-rough", "--json"]) == 0
    out, error = capfd.readouterr()
    (one,) = json.loads(out)["frames"][0]["objects"]
    assert "of the mask" in error and "pixels are not the object's" in error
    mended = one["mended_mask"]
    before = overlap(wide > 0, frame.masks[0])
    assert overlap(decode_rle(mended["mask"]), frame.masks[0]) > before + 0.1
    assert mended["removed_pixels"] > mended["added_pixels"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--instances", "0"), "a number from 1 on, or 'all'"),
        (("--mask-is-rough",), "needs a --mask"),
        (("--mask", "rgb.png", "--instances", "2"), "for objects that are sought"),
        (("--mask", "rgb.png", "--explain", "a.html"), "shows how objects are sought"),
        (("--explain", "a.pdf"), "must end in .html"),
        (("--click", "10,10", "--box", "1,1,9,9"), "give one of them"),
        (("--click", "10,10", "--click", "20,20"), "once for each object, in their order; got 2"),
        (("--click", "10"), "is no pixel"),
        (("--click", "320,10"), "the click (320, 10) lies outside the image"),
        (("--click", "10,10", "--instances", "2"), "a click shows one"),
        (("--depth-scale", "-1"), "positive"),
        (("--depth-scale", "1000"), "pass depth_scale=1"),
        (("--obj-id", "5"), "--obj-id says which of several masks: it needs a --mask"),
    ],
)
def test_what_cannot_be_is_refused(scene, capfd, more, words):
    _, given, _ = scene
    assert run([*given, *more]) == 2
    assert words in capfd.readouterr().err


@pytest.mark.parametrize(
    ("masks", "more", "words"),
    [
        (False, ("--mask-is-rough",), "no masks in mask/"),
        (True, ("--instances", "all"), "is for objects that are sought, but"),
        (True, ("--explain", "pages"), "shows how objects are sought, but"),
        (False, ("--click", "1,1"), "--click belongs to a single frame"),
    ],
)
def test_options_that_a_folder_of_frames_cannot_follow_are_refused(scene, capfd, masks, more, words):
    folder, (_, mug, *_), frame = scene
    for name in ("rgb", "depth", *(("mask",) if masks else ())):
        (folder / name).mkdir()
    Image.fromarray(frame.rgb).save(folder / "rgb" / "a.png")
    assert run(["estimate", mug, "--frames", str(folder), *more]) == 2
    assert words in capfd.readouterr().err


def test_an_object_that_is_nowhere_is_told_by_its_name(scene, capfd):
    folder, words, frame = scene
    depth = np.zeros_like(frame.depth)
    depth[:2, :2] = 1.0  # no proposal has depth
    np.save(folder / "depth.npy", depth)
    assert run([*words, "--json"]) == 1
    out, error = capfd.readouterr()
    (one,) = json.loads(out)["frames"][0]["objects"]
    assert one["object"] == "ellipsoid" and not one["success"] and one["detected"] is None
    assert "no mask was found" in error


def test_an_object_whose_mask_has_no_depth_to_trust_is_told_too(scene, capfd, monkeypatch):
    monkeypatch.setattr("ipjax.detection.crops.cut_crop", lambda *_, **__: None)  # the detector has its own by now
    _, words, _ = scene
    assert run([*words, "--json"]) == 1
    (one,) = json.loads(capfd.readouterr().out)["frames"][0]["objects"]
    assert one["object"] == "ellipsoid" and not one["success"]

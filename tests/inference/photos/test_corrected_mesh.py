"""The written mesh: at its pose, and of an object from a photo nearer to the truth where the query measured it."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from builders.command_lines import run
from builders.photo_pairs import ENCODER, PhotoPair, estimate_at_the_truth, make_photo_pair
from PIL import Image

from ipjax.cameras import project
from ipjax.files.meshes.loading import load_mesh
from ipjax.files.objects.saving import save
from ipjax.inference.estimator import Result, to_image_camera
from ipjax.inference.photos.corrected_mesh import pose_mesh
from ipjax.records import Similarity
from ipjax.synthetic import problems
from ipjax.transforms import rotation_from_vector

ANGLES = {0: 15, 1: 30, 2: 45}


@pytest.fixture(scope="module")
def pairs():
    return {seed: make_photo_pair(seed, angle) for seed, angle in ANGLES.items()}


def result_of(pair: PhotoPair, larger: float | None = None, turn: np.ndarray | None = None) -> Result:
    found, _ = estimate_at_the_truth(pair, larger)
    turn = np.eye(3) if turn is None else turn
    turned = Similarity(jnp.asarray(turn, jnp.float32), jnp.zeros(3), jnp.asarray(1.0))
    return Result(to_image_camera(turned, found), found, pair.query, pair.templates, pair.info, {})


def distance_to_ellipsoid(pair: PhotoPair, points: np.ndarray) -> np.ndarray:
    """Signed, in % of the diameter, to first order; positive outside."""
    there = pair.crop_from_ellipsoid.inverse() @ points
    away = ((there / problems.AXES) ** 2).sum(axis=-1) - 1
    return 100 * away / np.linalg.norm(2 * there / problems.AXES**2, axis=-1)


def is_shown_by_both(pair: PhotoPair, vertices: np.ndarray) -> np.ndarray:
    """Which vertices of the guessed mesh (model units) lie on rays of the photo whose surface the query saw, too."""
    reference, view = pair.reference, pair.query.view
    seen = reference.camera_from_object.to_numpy() @ vertices
    mask, depth = np.asarray(reference.view.mask), np.asarray(reference.view.depth)
    column, row = np.round(project(reference.view.camera.to_matrix(), seen)).astype(int).T
    front = mask[row, column] & (np.abs(seen[:, 2] - depth[row, column]) < 0.01)
    # The photo's exact colour says which point of the ellipsoid it is, and the query's truth whether it faces it.
    point = (np.asarray(reference.view.rgb, np.float64)[row, column] - 0.5) / 0.45 * problems.AXES
    pose = pair.crop_from_ellipsoid
    normal = (point / problems.AXES**2) @ pose.rotation.T
    placed = pose @ point
    slant = -(normal * placed).sum(-1) / np.linalg.norm(normal, axis=-1) / np.linalg.norm(placed, axis=-1)
    inner = np.abs(np.linalg.norm(point / problems.AXES, axis=-1) - 1) < 0.03
    pixel = np.round(project(view.camera.to_matrix(), placed)).astype(int)
    known = np.asarray(view.mask)[tuple(np.clip(pixel, 0, 111)[:, ::-1].T)]
    return front & inner & known & (slant > 0.3)


@pytest.mark.parametrize("larger", [None, 0.85])
@pytest.mark.parametrize("seed", ANGLES)
def test_the_front_is_where_the_query_measured_it(pairs, seed, larger):
    pair = pairs[seed]
    result = result_of(pair, larger)
    guessed = result.estimate.camera_from_object.to_numpy() @ np.asarray(pair.info.vertices, np.float64)
    mesh = pose_mesh(result)
    shown = is_shown_by_both(pair, np.asarray(pair.info.vertices, np.float64))
    before, after = (distance_to_ellipsoid(pair, x[shown]) for x in (guessed, mesh.vertices))
    rms = [float(np.sqrt((x**2).mean())) for x in (before, after)]
    print(
        seed,
        larger,
        shown.mean(),
        "rms",
        rms,
        "mean",
        before.mean(),
        after.mean(),
        "90 %",
        np.percentile(abs(after), 90),
    )
    assert shown.mean() > 0.2
    assert rms[0] > 1
    assert rms[1] < 0.4 * rms[0]
    assert abs(after.mean()) < 0.5
    assert np.median(np.abs(after)) < 0.1
    np.testing.assert_array_equal(mesh.faces, pair.info.faces)
    np.testing.assert_array_equal(mesh.colours, pair.info.colours)


def test_what_the_photo_does_not_show_stays(pairs):
    """Behind the guess, and along the photo's rays in front: nothing moves sideways."""
    pair = pairs[0]
    result = result_of(pair)
    vertices = np.asarray(pair.info.vertices, np.float64)
    guessed, placed = result.estimate.camera_from_object.to_numpy() @ vertices, pose_mesh(result).vertices
    back = vertices @ np.asarray(pair.reference.camera_from_object.rotation)[2] > 0.05
    np.testing.assert_allclose(placed[back], guessed[back], atol=1e-6)
    matrix = pair.reference.view.camera.to_matrix()
    before, after = (project(matrix, pair.reference_from_query @ x) for x in (guessed, placed))
    np.testing.assert_allclose(after, before, atol=0.6)
    assert np.abs((after - before).mean(axis=0)).max() < 0.02


def test_the_answer_is_in_the_images_camera(pairs):
    turn = rotation_from_vector(np.array([0.1, -0.2, 0.05]))
    straight, turned = pose_mesh(result_of(pairs[0])), pose_mesh(result_of(pairs[0], turn=turn))
    np.testing.assert_allclose(turned.vertices, straight.vertices @ turn.T, atol=1e-6)


def test_a_scan_is_posed_as_it_is(pairs):
    result = result_of(pairs[0])
    scan = dataclasses.replace(result, templates=dataclasses.replace(result.templates, reference=None))
    expected = result.estimate.camera_from_object.to_numpy() @ np.asarray(result.info.vertices, np.float64)
    np.testing.assert_allclose(pose_mesh(scan).vertices, expected, atol=1e-7)
    bare = dataclasses.replace(scan, info=dataclasses.replace(scan.info, vertices=None))
    with pytest.raises(ValueError, match="keeps no mesh"):
        pose_mesh(bare)


def test_the_command_writes_comparison_and_mesh(pairs, case, monkeypatch, capfd):
    pair = pairs[1]
    save(case / "egg.ipjax", pair.templates, pair.info)
    monkeypatch.setattr("ipjax.files.weights.matching.load_matching_encoder", lambda *_: ENCODER)
    frame = pair.frame
    Image.fromarray(frame.rgb).save(case / "rgb.png")
    Image.fromarray(frame.mask.astype(np.uint8) * 255).save(case / "mask.png")
    np.save(case / "depth.npy", frame.depth)
    (case / "K.txt").write_text("\n".join(" ".join(map(str, row)) for row in frame.matrix))
    inputs = ["--rgb", case / "rgb.png", "--depth", case / "depth.npy", "--mask", case / "mask.png"]
    inputs += ["--camera", case / "K.txt", "--set", "resect.views=6", "--set", "resect.count=256"]
    outputs = ["--compare", case / "compare.png", "--mesh-out", case / "posed.ply", "-o", case / "out.json"]
    words = ["estimate", case / "egg.ipjax", *inputs, *outputs, "--overlay", case / "overlay.png"]
    assert run([*map(str, words)]) == 0
    told = json.loads((case / "out.json").read_text())["frames"][0]
    assert told["comparison"].endswith("compare.png") and told["objects"][0]["mesh_written"].endswith("posed.ply")
    picture = np.asarray(Image.open(case / "compare.png"))
    assert picture.shape[1] > 1200 and picture.std() > 20
    assert np.asarray(Image.open(case / "overlay.png")).std() > 20
    mesh = load_mesh(case / "posed.ply")
    middle = told["objects"][0]["camera_from_object"]["translation_m"]
    extent = 1e-3 * told["objects"][0]["size_mm"]["diameter"]
    assert np.linalg.norm(mesh.to_file(mesh.vertices) - middle, axis=-1).max() < 0.8 * extent
    assert mesh.colours.std() > 10
    capfd.readouterr()
    assert run([*map(str, words), "--compare", str(case / "x.gif")]) == 2
    assert "must end in .png" in capfd.readouterr().err
    scan = ["estimate", case / "mug.ipjax", *inputs, "--compare", case / "no.png"]
    assert run([*map(str, scan)]) == 2
    assert "keeps no photo that it was made from" in capfd.readouterr().err and not (case / "no.png").exists()

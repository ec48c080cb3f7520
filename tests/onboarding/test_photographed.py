"""A mesh with the photo it was made from: the photo's camera is found, and what it saw told from what was invented."""

import dataclasses
import functools

import equinox as eqx
import jax
import numpy as np
import pytest
import trimesh
from builders.photo_objects import look
from builders.tiny_pipeline import TINY, estimate

import ipjax
from ipjax.config import OnboardConfig
from ipjax.files.meshes.mesh import make_mesh
from ipjax.files.objects.deviations import deviations_of
from ipjax.files.objects.loading import load
from ipjax.inference.frames import frame
from ipjax.inference.reports import relative_pose
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.photographed import mark_vertices, onboard_with_photo
from ipjax.synthetic import problems
from ipjax.transforms import Similarity, rotation_from_vector

CONFIG = OnboardConfig(directions=20, rolls=6, resolution=112, surface=512, appearance=2000)
SIZE, SHIFT = 37.0, np.array([5.0, -80.0, 12.0])  # of the mesh file, in a unit that nobody knows
TURN = rotation_from_vector(np.array([0.4, -1.1, 0.7]))


@functools.cache
def body():
    """The ellipsoid as a mesh of its own frame and size, coloured by the coordinates that the encoder reads."""
    ball = trimesh.creation.icosphere(3)
    points = np.asarray(ball.vertices) * problems.AXES
    return make_mesh(SIZE * points @ TURN.T + SHIFT, ball.faces, colours=0.5 + 0.45 * np.asarray(ball.vertices))


@functools.cache
def made(given: bool = True):
    whole = problems.make_frame(5)
    camera = whole.matrix if given else None
    found = onboard_with_photo(
        body(), problems.make_encoder(), CONFIG, photo=Photo(whole.rgb), mask=whole.mask, camera=camera, progress=False,
        backend="raster", name="egg",
    )  # fmt: skip
    return *found, whole


def true_pose(whole):
    """``camera_from_mesh`` as a rotation and a direction to the mesh's middle."""
    pose = whole.camera_from_object.to_numpy()
    return pose @ Similarity(TURN, SHIFT, np.asarray(SIZE)).inverse()


@pytest.mark.parametrize("given", [True, False])
def test_the_photos_camera_is_found(given):
    _, info, whole = made(given)
    assert info.reference is not None
    true, found = true_pose(whole), info.reference.camera_from_mesh.to_numpy()
    turned = np.degrees(np.arccos(np.clip((np.trace(found.rotation.T @ true.rotation) - 1) / 2, -1, 1)))
    # Degrees. The stand-in reads colours patch by patch, and a wrong focal length looks like a small turn.
    assert turned < (3 if given else 12)
    there, here = true @ SHIFT[None], found @ SHIFT[None]
    off = np.linalg.norm(here / np.linalg.norm(here) - there / np.linalg.norm(there))
    assert off < (0.01 if given else 0.2)
    assert found.scale == 1 and info.reference.camera_given == given
    if given:  # how far it was, in the mesh's unit
        assert np.linalg.norm(here) == pytest.approx(np.linalg.norm(there / true.scale), rel=0.05)


def test_what_the_photo_saw_is_what_faces_it():
    templates, info, whole = made()
    assert info.reference is not None and templates.photo_centre is not None
    true, surface = true_pose(whole) @ info.object_from_mesh.to_numpy().inverse(), templates.surface
    placed = true @ np.asarray(surface.points, np.float64)
    normals = np.asarray(surface.normals, np.float64) @ true.rotation.T
    facing = -(normals * placed).sum(1) / np.linalg.norm(placed, axis=1)
    seen = np.asarray(surface.seen)
    assert set(np.unique(seen)) == {0.0, 1.0}
    assert (seen[facing < 0.0] == 0).mean() > 0.99 and (seen[facing > 0.4] == 1).mean() > 0.99
    assert info.reference.seen == pytest.approx(seen.mean())
    off = deviations_of("elsewhere")
    np.testing.assert_allclose(surface.along_std, np.where(seen == 1, off.front, off.back), rtol=1e-5)
    np.testing.assert_allclose(surface.across_std, off.across, rtol=1e-5)
    eye = -true.rotation.T @ (true.translation / true.scale)
    cosine = eye @ np.asarray(templates.photo_centre) / np.linalg.norm(eye) / np.linalg.norm(templates.photo_centre)
    assert cosine > np.cos(np.deg2rad(3))
    # Templates from the photo's side show what was seen, those from behind what was not.
    eyes = -np.einsum("vji,vj->vi", *(np.asarray(x) for x in dataclasses.astuple(templates.camera_from_object)[:2]))
    side = eyes @ eye / np.linalg.norm(eyes, axis=1) / np.linalg.norm(eye)
    share = np.where(templates.patches.valid, templates.seen, 0).sum(1) / np.asarray(templates.patches.valid).sum(1)
    assert share[side > 0.8].min() > 0.7 and share[side < -0.8].max() < 0.3
    on_vertices = mark_vertices(dataclasses.replace(body(), vertices=np.asarray(info.vertices)), templates).seen
    assert abs(on_vertices.mean() - seen.mean()) < 0.1


def test_the_object_file_keeps_the_photo_and_poses_are_told_relative_to_it(case):
    templates, info, whole = made()
    ipjax.save(case / "egg.ipjax", templates, info)
    again, about = load(case / "egg.ipjax")
    assert (
        again.reference is None and about.reference is not None
    )  # the mesh is good: matches are between points in space
    np.testing.assert_array_equal(again.photo_centre, templates.photo_centre)
    np.testing.assert_array_equal(again.surface.seen, templates.surface.seen)
    assert about.reference.method == "elsewhere" and about.reference.picture and not about.reference.metric
    # The photo itself as a query: the camera has not moved.
    pose = true_pose(whole) @ info.object_from_mesh.to_numpy().inverse()
    moved = relative_pose(pose.to_jax(), about)
    assert np.trace(moved.rotation) > 1 + 2 * np.cos(np.deg2rad(3))


def test_a_photo_of_something_else_is_refused():
    whole = problems.make_frame(5)
    rows, columns = np.nonzero(whole.mask)
    ahead = np.zeros_like(whole.mask)
    ahead[rows.min() : rows.max(), columns.min() : columns.min() + 12] = True  # a thin stripe at its border
    with pytest.raises(ValueError, match="the mesh egg was not made from this photo, or its mask is not of the object"):
        onboard_with_photo(
            body(), problems.make_encoder(), CONFIG, photo=Photo(255 - whole.rgb), mask=ahead, camera=whole.matrix,
            progress=False, backend="raster", name="egg",
        )  # fmt: skip


def test_a_pose_that_rests_on_what_was_invented_is_less_sure():
    templates, _, whole = made()
    pose, fallen = whole.camera_from_object.to_numpy(), []
    believed = eqx.tree_at(lambda c: c.confidence.invented, TINY, 0.0)
    logit = lambda found: np.log(float(found.confidence) / (1 - float(found.confidence)))
    for turn in (np.eye(3), rotation_from_vector(np.array([0, np.pi, 0]))):
        shot = problems.make_frame(11, rotation=turn @ pose.rotation)
        query = look(problems.make_encoder(), frame(shot.rgb, shot.depth, shot.mask, shot.matrix, resolution=112))
        found, sure = (estimate(templates, query, jax.random.key(0), config) for config in (TINY, believed))
        assert bool(found.success)
        jax.tree.map(np.testing.assert_array_equal, found.camera_from_object, sure.camera_from_object)
        fallen.append(logit(sure) - logit(found))
        wanted = float(TINY.confidence.invented) * (1 - float(found.agreement.seen))
        assert fallen[-1] == pytest.approx(wanted, abs=0.01)
    # From the photo's side, and from behind.
    assert fallen[0] < 0.45 * float(TINY.confidence.invented) and fallen[1] > 0.7 * float(TINY.confidence.invented)
    doubted = estimate(templates, query, jax.random.key(0), eqx.tree_at(lambda c: c.score.invented, TINY, 1.0))
    assert np.abs(np.asarray(doubted.hypotheses.score) - np.asarray(found.hypotheses.score)).max() > 1e-3

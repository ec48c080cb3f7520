"""A photo with depth is kept beside its object's templates, and each of its patches knows its place on the surface."""

import jax.numpy as jnp
import numpy as np
from builders.measured_photos import photograph

from ipjax.cameras import project
from ipjax.estimation.features import object_features
from ipjax.synthetic import problems


def test_the_photo_is_kept_beside_the_templates():
    made, _ = photograph(3)
    templates, reference = made.templates, made.templates.reference
    assert reference is not None and reference.measured
    assert len(templates.camera_from_object.scale) == 8  # as many as asked for
    # Its camera stands where the photo's did, turned to the object's centre.
    pose, record = reference.camera_from_object.to_numpy(), made.info.reference
    crop_from_photo = pose.rotation @ record.rotation.T
    centre = (record.camera_from_mesh.to_numpy() @ made.info.object_from_mesh.to_numpy().inverse()).translation
    np.testing.assert_allclose(crop_from_photo @ centre, made.info.measured_diameter * pose.translation, atol=1e-4)
    assert np.abs(pose.translation[:2]).max() < 1e-6


def test_its_patches_lie_where_the_photo_measured_them():
    made, whole = photograph(3)
    reference, record = made.templates.reference, made.info.reference
    inner = np.asarray(reference.view.mask).reshape(8, 14, 8, 14).mean((1, 3)).reshape(-1) == 1
    assert inner.sum() > 10 and np.asarray(reference.patches.valid)[inner].all()
    points = np.asarray(reference.patches.points, np.float64)[inner]
    pixels = np.asarray(project(reference.view.camera, reference.camera_from_object @ jnp.asarray(points)))
    middle = (np.asarray(reference.patches.grid)[inner] + 0.5) * 14 - 0.5
    assert np.abs((pixels - middle).mean(0)).max() < 0.1  # pixels
    # In the photo's own camera they have the depth that it measured there.
    placed = record.camera_from_mesh.to_numpy() @ made.info.object_from_mesh.to_numpy().inverse() @ points
    column, row = np.round(project(whole.matrix, placed)).astype(int).T
    gap = placed[:, 2] - np.asarray(whole.depth)[row, column]
    assert np.median(np.abs(gap)) < 0.01 * made.info.measured_diameter


def test_its_features_are_relative_to_the_objects():
    made, _ = photograph(3)
    reference = made.templates.reference
    wanted = object_features(problems.make_encoder()(reference.view.rgb).reshape(64, -1), made.templates)
    valid = np.asarray(reference.patches.valid)
    np.testing.assert_allclose(np.asarray(reference.patches.features)[valid], wanted[valid], atol=2e-3)

"""The z-buffers against their slow twins, and the laws of a camera."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ipjax_kernels.rasterize import rasterize, splat_colours, splat_depth
from ipjax_kernels.reference import raster as reference_raster

HEIGHT, WIDTH = 13, 17
FOCAL, CENTRE = np.array([20.0, 22.0], np.float32), np.array([7.3, 6.6], np.float32)
SEEDS = st.integers(0, 2**32 - 1)


def triangles(seed: int, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of all sizes in front of the camera, some of them outside the image."""
    random = np.random.default_rng(seed)
    middle = random.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 3.0], (count, 1, 3))
    size = 10 ** random.uniform(-2, 0, (count, 1, 1))
    vertices = np.maximum(middle + size * random.normal(size=(count, 3, 3)), [-9, -9, 0.2])
    return vertices.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def draw(vertices, faces, **options):
    result = rasterize(
        jnp.asarray(vertices), jnp.asarray(faces), jnp.asarray(FOCAL), jnp.asarray(CENTRE), HEIGHT, WIDTH, **options
    )
    return [np.asarray(x) for x in result]


@given(SEEDS)
def test_rasterize_equals_ray_casting(seed):
    vertices, faces = triangles(seed)
    depth, index, weights = draw(vertices, faces)
    want_depth, want_index, _ = reference_raster.rasterize(vertices, faces, FOCAL, CENTRE, HEIGHT, WIDTH)
    # Pixels whose centre is on an edge to within rounding may fall on either side.
    differ = index != want_index
    assert differ.sum() <= 2
    same = ~differ & (index >= 0)
    assert same.any() or not (want_index >= 0).any()
    # A face seen edge-on turns rounding in the image into depth: 1e-5 of the pixel's own slope is allowed.
    corners = vertices[faces[index]].astype(np.float64)
    normal = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    ray = np.stack([(columns - CENTRE[0]) / FOCAL[0], (rows - CENTRE[1]) / FOCAL[1], np.ones_like(rows)], -1)
    slope = np.linalg.norm(normal, axis=-1) / np.maximum(np.abs((normal * ray).sum(-1)), 1e-12)
    assert (np.abs(depth - want_depth)[same] <= 1e-5 * np.maximum(1, slope)[same]).all()
    # The weights give the surface point itself.
    point = (weights[..., None] * corners).sum(-2)
    assert (np.abs(point - ray * depth[..., None]).max(-1)[same] <= 3e-5 * np.maximum(1, slope)[same]).all()
    np.testing.assert_allclose(weights.sum(-1)[index >= 0], 1, atol=1e-6)
    assert (depth[index < 0] == 0).all() and (weights[index < 0] == 0).all()


def test_rasterize_has_no_cracks_and_hides_what_is_behind():
    """A finely cut tilted plane before another: every pixel sees the front one, at its exact depth."""
    n = 40
    y, x = np.meshgrid(np.linspace(-4, 4, n), np.linspace(-4, 4, n), indexing="ij")
    front = np.stack([x, y, 2 + 0.2 * x + 0.1 * y], -1).reshape(-1, 3)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + n], -1), np.stack([corner + 1, corner + n, corner + n + 1], -1)]
    )
    vertices = np.concatenate([front + np.array([0, 0, 1]), front]).astype(np.float32)
    faces = np.concatenate([faces, faces + n * n]).astype(np.int32)
    depth, index, _ = draw(vertices, faces)
    assert (index >= len(faces) // 2).all()
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rx, ry = (columns - CENTRE[0]) / FOCAL[0], (rows - CENTRE[1]) / FOCAL[1]
    np.testing.assert_allclose(depth, 2 / (1 - 0.2 * rx - 0.1 * ry), rtol=3e-6)


@pytest.mark.parametrize("options", [{"tile": 1}, {"tile": 8}, {"block": 7}, {"tile": 16, "block": 3}])
def test_blocks_and_tiles_change_nothing(options):
    vertices, faces = triangles(5)
    for got, want in zip(draw(vertices, faces, **options), draw(vertices, faces), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)


def test_rasterize_ties_take_the_lower_face_and_both_sides_are_seen():
    vertices = np.array([[-1, -1, 2], [1, -1, 2], [0, 1, 2]], np.float32)
    _, index, _ = draw(vertices, np.array([[0, 1, 2], [0, 1, 2]], np.int32))
    assert set(np.unique(index)) == {-1, 0}
    depth, turned, _ = draw(vertices, np.array([[2, 1, 0], [2, 1, 0]], np.int32))
    np.testing.assert_array_equal(turned, index)
    np.testing.assert_allclose(depth[index >= 0], 2, rtol=1e-6)


def test_rasterize_survives_bad_values():
    vertices, faces = triangles(3)
    clean = draw(vertices, faces[1:])
    bad = vertices.copy()
    for poison in (np.nan, np.inf, -1.0, 0.0):
        bad[0] = poison
        got = draw(bad, faces)
        assert all(np.isfinite(x).all() for x in got)
        np.testing.assert_array_equal(got[0], clean[0])
    empty = draw(vertices, np.zeros((0, 3), np.int32))
    assert (empty[0] == 0).all() and (empty[1] == -1).all()
    behind = draw(vertices * np.float32([1, 1, -1]), faces)
    assert (behind[1] == -1).all()


def test_rasterize_near_drops_whole_faces():
    vertices, faces = triangles(11)
    limit = np.float32(np.median(vertices[:, 2]))
    far = (vertices[faces][..., 2] > limit).all(1)
    assert 0 < far.sum() < len(far)
    depth, index, _ = draw(vertices, faces, near=jnp.asarray(limit))
    assert set(np.unique(index)) - {-1} <= set(np.flatnonzero(far))
    np.testing.assert_array_equal(depth, draw(np.where(np.repeat(far, 3)[:, None], vertices, np.nan), faces)[0])


def test_rasterize_vmaps_and_runs_in_float64(x64):
    del x64
    sets = [triangles(seed) for seed in (1, 2, 3)]
    faces = jnp.asarray(sets[0][1])
    stack = jnp.asarray(np.stack([v for v, _ in sets]), jnp.float64)
    focal, centre = jnp.asarray(FOCAL, jnp.float64), jnp.asarray(CENTRE, jnp.float64)
    one = lambda v: rasterize(v, faces, focal, centre, HEIGHT, WIDTH)
    together = jax.vmap(one)(stack)
    assert together[0].dtype == jnp.float64
    for i in range(3):
        for got, want in zip(together, one(stack[i]), strict=True):
            np.testing.assert_allclose(got[i], want, atol=1e-12)


@given(SEEDS, st.sampled_from([0, 1, 3]))
def test_splat_equals_painting(seed, radius):
    random = np.random.default_rng(seed)
    points = random.uniform([-1.5, -1.2, -0.5], [1.5, 1.2, 3], (60, 3)).astype(np.float32)
    points[:3] = [[np.nan, 0, 1], [0, np.inf, 1], [0, 0, 0]]
    valid = random.random(60) < 0.8
    got = splat_depth(
        jnp.asarray(points), jnp.asarray(valid), jnp.asarray(FOCAL), jnp.asarray(CENTRE), HEIGHT, WIDTH, radius
    )
    want = reference_raster.splat_depth(points, valid, FOCAL, CENTRE, HEIGHT, WIDTH, radius)
    # Points that project halfway between two pixels may fall on either.
    with np.errstate(invalid="ignore", divide="ignore"):
        pixel = FOCAL * points[:, :2] / points[:, 2:] + CENTRE
        tie = (np.abs(pixel % 1 - 0.5) < 1e-4).any(1)
    if not tie[valid].any():
        np.testing.assert_array_equal(np.asarray(got), want.astype(np.float32))
    assert np.isfinite(np.asarray(got)).all()


def test_splat_batches():
    points = jnp.asarray(np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (4, 50, 3)), jnp.float32)
    valid = jnp.ones((4, 50), bool)
    one = lambda p, v: splat_depth(p, v, jnp.asarray(FOCAL), jnp.asarray(CENTRE), HEIGHT, WIDTH)
    together = jax.jit(jax.vmap(one))(points, valid)
    np.testing.assert_array_equal(together, np.stack([one(p, v) for p, v in zip(points, valid, strict=True)]))
    np.testing.assert_array_equal(one(points[0], ~valid[0]), 0)


def test_kernels_lower_without_callbacks():
    vertices, faces = triangles(0)
    text = jax.jit(
        lambda v: rasterize(v, jnp.asarray(faces), jnp.asarray(FOCAL), jnp.asarray(CENTRE), HEIGHT, WIDTH)
    ).lower(jnp.asarray(vertices))
    assert "callback" not in text.as_text()


@given(st.integers(0, 2**31))
def test_splat_colours_paints_the_nearest(seed):
    """Two sheets of points, the nearer over the left half: its colour there, the other's elsewhere, black outside."""
    rng = np.random.default_rng(seed)
    near = np.concatenate([rng.uniform([-1, -1], [0, 1], (4000, 2)), np.full((4000, 1), 1.0)], axis=1)
    far = np.concatenate([rng.uniform(-2, 2, (8000, 2)), np.full((8000, 1), 2.0)], axis=1)
    points = jnp.asarray(np.concatenate([near, far]), jnp.float32)
    red, blue = np.array([0.9, 0.1, 0.2]), np.array([0.2, 0.3, 0.8])
    colours = jnp.asarray(np.concatenate([np.tile(red, (4000, 1)), np.tile(blue, (8000, 1))]), jnp.float32)
    valid = jnp.ones(12000, bool)
    focal, centre = jnp.full(2, 8.0), jnp.full(2, 15.5)
    image, depth = splat_colours(points, colours, valid, focal, centre, 32, 32, 0.1)
    np.testing.assert_array_equal(depth, splat_depth(points, valid, focal, centre, 32, 32))
    np.testing.assert_allclose(image[10:22, 10:14], np.broadcast_to(red, (12, 4, 3)), atol=1e-5)
    np.testing.assert_allclose(image[10:22, 18:22], np.broadcast_to(blue, (12, 4, 3)), atol=1e-5)
    assert not np.asarray(image)[np.asarray(depth) == 0].any() and (np.asarray(depth)[:5] == 0).all()
    nothing, empty = splat_colours(points, colours, ~valid, focal, centre, 32, 32, 0.1)
    assert not np.asarray(nothing).any() and not np.asarray(empty).any()

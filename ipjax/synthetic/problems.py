"""Problems with known answers, computed by formulas: an ellipsoid whose colour is its own coordinate.

Tests and benchmarks share them. The stand-in encoder turns that coordinate into smooth random features, so
matching is as hard as the noise asked for, no weights are needed, and every image is exact.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from ipjax.cameras import middle, unproject
from ipjax.estimation.features import describe
from ipjax.onboarding.viewpoints import viewpoints
from ipjax.records import Appearance, Camera, Patches, Query, Similarity, Surface, Templates, View

AXES = np.array([0.28, 0.38, 0.5])  # semi-axes; the longest makes the diameter 1
PATCH = 14
_describe = jax.jit(describe)


class CoordinateEncoder(eqx.Module):
    """Random Fourier features of the mean colour of each patch."""

    frequencies: Float[Array, "3 c"]
    phases: Float[Array, "c"]

    def __call__(self, image: Float[Array, "h w 3"]) -> Float[Array, "gh gw c"]:
        height, width, _ = image.shape
        cells = image.reshape(height // PATCH, PATCH, width // PATCH, PATCH, 3)
        covered = jnp.any(cells > 0, axis=-1, keepdims=True).astype(image.dtype)
        mean = jnp.sum(cells * covered, axis=(1, 3)) / jnp.maximum(jnp.sum(covered, axis=(1, 3)), 1)
        angle = jnp.sum(mean[..., :, None] * self.frequencies, axis=-2) + self.phases
        wave = jnp.cos(angle)
        return wave / jnp.linalg.norm(wave, axis=-1, keepdims=True)


def make_encoder(channels: int = 32, seed: int = 0) -> CoordinateEncoder:
    """The stand-in encoder with random frequencies and phases; features of ``channels`` numbers."""
    rng = np.random.default_rng(seed)
    return CoordinateEncoder(
        jnp.asarray(rng.normal(0, 5, (3, channels)), jnp.float32),
        jnp.asarray(rng.uniform(0, 2 * np.pi, channels), jnp.float32),
    )


def make_view(camera_from_object: Similarity, side: int, fill: float = 0.83) -> View:
    """The ellipsoid's exact image; depth in the unit of the pose's translation; the camera frames the object."""
    translation = np.asarray(camera_from_object.translation, np.float64)
    reach = 0.5 * float(camera_from_object.scale) / np.linalg.norm(translation)
    focal = fill * side / 2 / reach
    centre = middle(side, side) - focal * translation[:2] / translation[2]
    rgb, depth, mask = draw_ellipsoid(camera_from_object, np.array([focal, focal]), centre, side, side)
    return View(
        jnp.asarray(rgb, jnp.float32),
        jnp.asarray(depth, jnp.float32),
        jnp.asarray(mask),
        Camera(jnp.full(2, focal, jnp.float32), jnp.asarray(centre, jnp.float32)),
    )


def draw_ellipsoid(
    camera_from_object: Similarity, focal: np.ndarray, centre: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours, depth and mask of the ellipsoid as any pinhole sees it, exact at every pixel's centre."""
    pose = camera_from_object.to_numpy()
    translation, scale = pose.translation, float(pose.scale)
    # Only pixels within the image of the sphere around it need a ray.
    reach = 0.5 * scale / (translation[2] - 0.5 * scale) * (1 + np.abs(translation[:2]).max() / translation[2])
    middle = translation[:2] / translation[2]
    low = np.clip(np.floor((middle - reach) * focal + centre), 0, [width, height]).astype(int)
    high = np.clip(np.ceil((middle + reach) * focal + centre) + 1, 0, [width, height]).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    rays = unproject(_matrix(focal, centre), np.stack([columns, rows], -1).astype(float), np.ones(rows.shape))
    object_from_camera = pose.inverse()
    origin = object_from_camera.translation / AXES
    direction = object_from_camera.scale * (rays @ pose.rotation) / AXES
    a, b, c = (direction**2).sum(-1), (direction * origin).sum(-1), (origin**2).sum() - 1
    root = b**2 - a * c
    hit = root > 0
    distance = np.where(hit, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    coordinate = origin + distance[..., None] * direction
    rgb, depth = np.zeros((height, width, 3), np.float32), np.zeros((height, width))
    mask = np.zeros((height, width), bool)
    window = np.s_[low[1] : high[1], low[0] : high[0]]
    rgb[window] = np.where(hit[..., None], 0.5 + 0.45 * coordinate, 0)
    depth[window], mask[window] = distance, hit
    return rgb, depth, mask


@dataclasses.dataclass(frozen=True)
class Frame:
    """A whole image of the ellipsoid, and its true pose."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # metres
    mask: Bool[np.ndarray, "h w"]
    matrix: Float[np.ndarray, "3 3"]
    camera_from_object: Similarity


def make_frame(
    seed: int,
    height: int = 480,
    width: int = 640,
    share: tuple[float, float] = (0.25, 0.5),
    rotation: Float[np.ndarray, "3 3"] | None = None,
) -> Frame:
    """An exact image of the ellipsoid before a wall, at a random pose, size and place, by a random camera.

    ``share``: of the image's height that the diameter takes, smallest and largest. ``rotation``: of the object, instead
    of a random one.
    """
    rng = np.random.default_rng(seed)
    focal = rng.uniform(0.8, 1.2) * width * np.array([1, rng.uniform(0.99, 1.01)])
    centre = middle(width, height) + rng.normal(0, 0.01, 2) * width
    scale, wanted = rng.uniform(0.1, 0.3), rng.uniform(*share) * height
    distance = focal[1] * scale / wanted
    room = 0.7 * wanted
    place = rng.uniform([room, room], [width - room, height - room])
    truth = Similarity(
        jnp.asarray(random_rotation(rng) if rotation is None else rotation, jnp.float32),
        jnp.asarray([*((place - centre) / focal * distance), distance], jnp.float32),
        jnp.asarray(scale, jnp.float32),
    )
    rgb, depth, mask = draw_ellipsoid(truth, focal, centre, height, width)
    depth[~mask] = distance + 1.5 * scale
    matrix = _matrix(focal, centre)
    return Frame(np.round(255 * rgb).astype(np.uint8), depth.astype(np.float32), mask, matrix, truth)


def outline_conic(camera_from_object: Similarity, focal: np.ndarray, centre: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The conic that the ellipsoid's silhouette is in the image: x̃ᵀ C x̃ = 0, negative inside."""
    # In the object's frame the dual quadric is diag(a², b², c², −1); a camera projects it to the dual conic.
    projection = _matrix(focal, centre) @ camera_from_object.to_numpy().to_matrix()[:3]
    conic = np.linalg.inv(projection @ np.diag([*AXES**2, -1]) @ projection.T)
    return conic * np.sign(conic[0, 0])


def _matrix(focal: np.ndarray, centre: np.ndarray) -> np.ndarray:
    return np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])


def make_surface(count: int) -> Surface:
    """Points of the ellipsoid with their normals, all of them seen; any prefix covers the whole surface."""
    index = np.arange(count) + 0.5
    height, angle = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    order = np.random.default_rng(0).permutation(count)
    unit = np.stack([np.sqrt(1 - height**2) * np.cos(angle), np.sqrt(1 - height**2) * np.sin(angle), height], -1)[order]
    normals = unit / AXES
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return Surface(
        jnp.asarray(unit * AXES, jnp.float32), jnp.asarray(normals, jnp.float32), jnp.ones(count, jnp.float32)
    )


def make_templates(directions: int = 8, rolls: int = 1, grid: int = 8, channels: int = 32) -> Templates:
    """The ellipsoid, onboarded: ``directions × rolls`` templates of ``grid²`` patches."""
    poses = viewpoints(directions, rolls, distance=3.0)
    encoder = make_encoder(channels)
    views, patches = [], []
    for index in range(directions * rolls):
        pose = jax.tree.map(lambda x, index=index: np.asarray(x)[index], poses)
        view = make_view(pose, grid * PATCH)
        found = _describe(encoder, view)
        inside = pose.inverse() @ found.points
        patches.append(eqx.tree_at(lambda p: p.points, found, inside))
        views.append(view.camera)
    return Templates(
        patches=jax.tree.map(lambda *x: jnp.stack(x), *patches),
        mean=jnp.zeros(channels, jnp.float32),
        norm=jnp.ones((directions * rolls, grid * grid), jnp.float32),
        seen=jnp.ones((directions * rolls, grid * grid), jnp.float32),
        camera_from_object=poses,
        camera=jax.tree.map(lambda *x: jnp.stack(x), *views),
        surface=make_surface(512),
        extents=jnp.asarray(2 * AXES, jnp.float32),
        axes=jnp.eye(3, dtype=jnp.float32),
    )


def blank_templates(views: int, patches: int, channels: int) -> Templates:
    """Half-precision templates of zeros: shapes for the compiler."""
    zeros = lambda *shape: jnp.zeros(shape, jnp.float32)
    return Templates(
        Patches(
            jnp.zeros((views, patches, channels), jnp.float16),
            zeros(views, patches, 3),
            zeros(views, patches, 2),
            jnp.zeros((views, patches), bool),
        ),
        zeros(channels),
        zeros(views, patches),
        zeros(views, patches),
        Similarity(zeros(views, 3, 3), zeros(views, 3), zeros(views)),
        Camera(zeros(views, 2), zeros(views, 2)),
        Surface(zeros(64, 3), zeros(64, 3), zeros(64)),
        zeros(3),
        zeros(3, 3),
    )


def random_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """A rotation drawn uniformly, from a normal quaternion."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def make_query(
    seed: int, grid: int = 8, channels: int = 32, noise: float = 0.0, occlusion: float = 0.0
) -> tuple[Query, Similarity]:
    """A crop of the ellipsoid at a random pose and size, and the truth ``camera_from_object``.

    ``noise`` is added to the features (their norm is 1), ``occlusion`` hides that share of the crop's width.
    """
    rng = np.random.default_rng(seed)
    truth = Similarity(
        jnp.asarray(random_rotation(rng), jnp.float32),
        jnp.asarray([*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.5, 1.2)], jnp.float32),
        jnp.asarray(rng.uniform(0.1, 0.3), jnp.float32),
    )
    view = make_view(truth, grid * PATCH)
    hidden = jnp.asarray(np.arange(grid * PATCH) < occlusion * grid * PATCH)
    view = View(view.rgb, view.depth, view.mask & ~hidden[None, :], view.camera)
    patches = _describe(make_encoder(channels), view)
    features = patches.features + noise * jnp.asarray(
        rng.normal(size=patches.features.shape) / channels**0.5, jnp.float32
    )
    features = features / jnp.linalg.norm(features, axis=-1, keepdims=True)
    return Query(eqx.tree_at(lambda p: p.features, patches, features), view), truth


def make_appearance(count: int) -> Appearance:
    """The ellipsoid's surface with the colours that `make_view` gives it."""
    surface = make_surface(count)
    colours = 0.5 + 0.45 * surface.points / jnp.asarray(AXES, jnp.float32)
    return Appearance(surface.points, surface.normals, colours)

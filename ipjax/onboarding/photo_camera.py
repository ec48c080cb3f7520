"""Where the camera of a photo stood, relative to a mesh that was made from that photo elsewhere.

The photo is matched with the mesh's templates, as a query would be; but the mesh's points are known, so that a match is
a ray of the photo's camera and a point of the mesh: perspective-n-point, as in `ipjax.estimation.photo.resection`. The
best candidates are drawn and compared with the photo patch by patch, and refined on what the drawings match. At last
the outline of the mesh is laid onto the photo's.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.perspective import refine_resection
from jaxtyping import Array, Bool, Float, UInt8
from scipy import ndimage, optimize

from ipjax.cameras import look_at, middle, resize, unproject
from ipjax.config import DescribeConfig, MatchConfig, ResectConfig, ScoreConfig
from ipjax.estimation.features import describe, object_features
from ipjax.estimation.matching import match, select
from ipjax.estimation.photo.resection import Resections, Sight, Sightings, resect
from ipjax.estimation.pipeline import turn as turn_about_axes
from ipjax.estimation.scoring import chroma_correlation
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.meshes.sampling import sample_appearance
from ipjax.onboarding.photo_views import PhotoSource, turn_photo
from ipjax.records import Camera, Patches, Similarity, Templates, View
from ipjax.rendering.render import render
from ipjax.transforms import rotation_from_vector

ROUNDS = 3  # of refinement on what the drawings match
WINDOW = 3  # patches in which the photo is searched for what a drawing shows
VIEWS, DRAWN = 24, 24  # of the mesh that are matched, and poses that are drawn: more than a query can afford
TURNED = 3  # best of them that are also drawn turned about the box's axes
POLISHED = 8  # candidates that are refined
SIDE = 160  # pixels on a side of the images in which outlines are compared
POINTS = 20_000  # of the surface, from which the outline is drawn
SPILL = 0.3  # what a pixel drawn beyond the photo's mask costs, relative to one of it that is not drawn
WIDTH = 0.03  # of the robust loss between outlines, in diagonals of the photo's outline
OUTLINE = 1.0  # weight of the outlines beside the matches
FOCAL, PRIOR = 0.2, 0.05  # deviation of the logarithm of a guessed focal length, and what it costs beside the outlines


@dataclasses.dataclass(frozen=True)
class LocatedPhoto:
    """The camera of a photo that was found relative to a normalised mesh."""

    camera_from_object: Similarity[np.ndarray]  # scale 1, model units
    matrix: Float[np.ndarray, "3 3"]  # K of the photo
    overlap: float  # mean cosine of the patches that the photo and the mesh, drawn there, both cover
    fit: float  # of their outlines, by `compare_outlines`


@dataclasses.dataclass(frozen=True)
class _Crop:
    """The photo as a camera sees it that looks at the object, and its patches."""

    rgb: UInt8[np.ndarray, "s s 3"]
    mask: Bool[np.ndarray, "s s"]
    matrix: Float[np.ndarray, "3 3"]
    middle: Float[np.ndarray, "2"]  # the pixel of the photo that the crop's camera looks at
    patches: Patches  # features as the templates' are; points at depth 1
    rays: Float[np.ndarray, "p 2"]


def locate_photo(
    templates: Templates,
    mesh: Mesh,
    encoder: Callable[..., Any],
    rgb: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    matrix: Float[np.ndarray, "3 3"],
    *,
    resolution: int,
    fill: float,
    camera_given: bool,
    backend: str = "auto",
) -> LocatedPhoto:
    """Find the camera of a masked photo of the object of a normalised mesh.

    Args:
        templates: of the mesh, by the same encoder.
        matrix: K of the photo, given or guessed.
        resolution, fill: as the templates were drawn with.
        camera_given: the focal length is known; else it may change a little.

    The caller decides by `overlap` and `fit` whether the photo is of this mesh at all.
    """
    crop = _cut(rgb, mask, matrix, templates, encoder, resolution, fill)
    found = _find_candidates(crop, templates)
    turns, shifts = (np.asarray(x, np.float64) for x in (found.rotation, found.translation))
    present = np.asarray(found.support) >= 0
    turns, shifts = (turns[present], shifts[present]) if present.any() else (turns[:1], shifts[:1])
    draw = lambda turn, shift: _draw(mesh, crop, turn, shift, templates, encoder, backend)
    drawings = draw(turns, shifts)
    # A can or a banana fits its outline in several ways: the best are also tried turned about the box's axes.
    best = np.argsort([-d.score for d in drawings], kind="stable")[:TURNED]
    some = Similarity(turns[best], shifts[best], np.ones(len(best)))
    others = turn_about_axes(some.to_jax(), templates.axes).to_numpy()
    drawings = drawings + draw(others.rotation, others.translation)
    turns, shifts = np.concatenate([turns, others.rotation]), np.concatenate([shifts, others.translation])
    best = np.argsort([-d.score for d in drawings], kind="stable")[:POLISHED]
    turns, shifts, drawings = turns[best], shifts[best], [drawings[i] for i in best]
    kept = list(zip([d.score for d in drawings], turns, shifts, drawings, strict=True))
    width = ResectConfig().width * _diagonal(crop)
    for _ in range(ROUNDS):
        fits = [_refine(turn, shift, drawn, width) for turn, shift, drawn in zip(turns, shifts, drawings, strict=True)]
        turns, shifts = np.stack([f[0] for f in fits]), np.stack([f[1] for f in fits])
        drawings = draw(turns, shifts)
        fresh = zip([d.score for d in drawings], turns, shifts, drawings, strict=True)
        kept = [max(old, new, key=lambda one: one[0]) for old, new in zip(kept, fresh, strict=True)]
    _, turn, shift, drawn = max(kept, key=lambda one: one[0])
    turn, shift, zoom = _fit_outline(mesh, crop, turn, shift, drawn, free_focal=not camera_given)
    crop = dataclasses.replace(crop, matrix=crop.matrix @ np.diag([zoom, zoom, 1]))
    last = _draw(mesh, crop, turn[None], shift[None], templates, encoder, backend)[0]
    # With another focal length the object is still where it is in the photo, but along another ray.
    matrix = matrix @ np.diag([zoom, zoom, 1])
    photo_from_crop = look_at(matrix, crop.middle)
    pose = Similarity(photo_from_crop @ turn, photo_from_crop @ shift, np.ones(()))
    return LocatedPhoto(pose, matrix, last.overlap, last.fit)


def _cut(rgb, mask, matrix, templates, encoder, resolution, fill) -> _Crop:
    """The photo's crop around its mask, from a camera that is turned to the mask's middle, and its patches."""
    rows, columns = np.nonzero(mask)
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
    photo_from_crop = look_at(matrix, (low + high) / 2)
    edge = np.stack([columns, rows], axis=-1).astype(np.float64)
    rays = unproject(matrix, edge, np.ones(len(edge))) @ photo_from_crop
    rays = rays[:, :2] / rays[:, 2:]
    focal = fill * resolution / max(np.ptp(rays, axis=0).max(), 1e-6)
    cx, cy = middle(resolution, resolution) - focal * (rays.min(0) + rays.max(0)) / 2
    lens = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])
    still = Similarity(np.eye(3), np.zeros(3), np.ones(()))
    turned = dataclasses.replace(still, rotation=photo_from_crop.T)
    small, inside = turn_photo(PhotoSource(rgb, mask, still, matrix), turned, lens, resolution)
    patches = _describe_features(encoder, small, inside.astype(np.float32), lens, templates)
    points = np.asarray(patches.points, np.float64)
    return _Crop(small, inside, lens, (low + high) / 2, patches, points[:, :2] / np.maximum(points[:, 2:], 1e-6))


def _describe_features(encoder, rgb, depth, matrix, templates) -> Patches:
    """Patches of a picture with the features that the templates hold; points in its camera."""
    view = View(
        rgb=jnp.asarray(rgb.astype(np.float32) / 255),
        depth=jnp.asarray(depth, jnp.float32),
        mask=jnp.asarray(depth > 0),
        camera=Camera.from_matrix(matrix),
    )
    patches = _describe(encoder, view, DescribeConfig())
    return eqx.tree_at(lambda p: p.features, patches, object_features(patches.features, templates))


_describe = jax.jit(describe)


def _diagonal(crop: _Crop) -> float:
    """Of the box around the photo's outline, rays."""
    rows, columns = np.nonzero(crop.mask)
    return float(np.hypot(np.ptp(rows), np.ptp(columns)) / crop.matrix[0, 0])


def _find_candidates(crop: _Crop, templates: Templates) -> Resections:
    """Poses of the crop's camera from the mesh, by matches with the templates that are most like the photo."""
    config = ResectConfig(views=VIEWS, drawn=DRAWN)
    area = float(crop.mask.sum()) / crop.matrix[0, 0] ** 2
    return _resect(crop.patches, templates, jnp.float32(_diagonal(crop)), jnp.float32(area**0.5), config)


@jax.jit
def _resect(
    patches: Patches, templates: Templates, diagonal: Float[Array, ""], extent: Float[Array, ""], config: ResectConfig
) -> Resections:
    matches = match(patches, templates, MatchConfig(views=config.views, pairs=config.pairs))
    pairs = select(matches, patches, templates, MatchConfig(views=config.views, pairs=config.pairs))
    rays = pairs.camera[..., :2] / jnp.maximum(pairs.camera[..., 2:], 1e-6)
    squared = jnp.sum((pairs.object[:, :, None] - templates.surface.points) ** 2, axis=-1)
    normals = templates.surface.normals[jnp.argmin(squared, axis=-1)]
    # How large the object is in the templates that were matched.
    poses, valid = jax.tree.map(lambda x: x[matches.view], (templates.camera_from_object, templates.patches.valid))
    points = templates.patches.points[matches.view]
    ahead = jnp.sum(points * poses.rotation[:, None, 2], axis=-1) + poses.translation[:, None, 2]
    side = valid.shape[1] ** 0.5
    patch = 2 * (templates.camera.centre[0, 0] + 0.5) / side / templates.camera.focal[matches.view, 0]
    shown = jnp.mean(jnp.sum(jnp.where(valid, ahead**2, 0), axis=1) * patch**2)
    sight = Sight(diagonal, extent, jnp.maximum(jnp.sqrt(shown), 1e-6))
    return resect(
        Sightings(matches.ranking, pairs.object, rays, normals, pairs.weight), sight, jax.random.key(0), config
    )


@dataclasses.dataclass(frozen=True)
class _Drawing:
    """The mesh as the crop's camera sees it from a candidate, compared with the photo."""

    overlap: float
    fit: float
    colour: float  # correlation, in [-1, 1]
    points: Float[np.ndarray, "p 3"]  # of the mesh, behind each patch that is drawn
    rays: Float[np.ndarray, "p 2"]  # where the photo shows what is drawn there
    weight: Float[np.ndarray, " p"]

    @property
    def score(self) -> float:
        """What candidates are ranked by."""
        return self.overlap * self.fit * float(np.exp(ScoreConfig().colour_weight * (self.colour - 1)))


def compare_outlines(drawn: Bool[np.ndarray, "h w"], photo: Bool[np.ndarray, "h w"]) -> float:
    """How well a drawing of the whole object fits the photo's mask, in [0, 1]: A. Tversky's index, 1977.

    What is drawn beyond the mask costs `SPILL` of what is missing in it: something may hide the object in the photo.
    """
    both = (drawn & photo).sum()
    cost = both + SPILL * (drawn & ~photo).sum() + (photo & ~drawn).sum()
    return float(both / max(cost, 1))


def _draw(mesh, crop, turns, shifts, templates, encoder, backend) -> list[_Drawing]:
    """Draw the mesh from every candidate, describe it, and match it with the photo nearby."""
    shifts = np.where(shifts[:, 2:] > 0.05, shifts, [[0, 0, 3.0]])  # what is behind the camera cannot be drawn
    side = crop.mask.shape[0]
    poses = Similarity(turns, shifts, np.ones(len(turns))).to_jax()
    views = render(mesh, poses, Camera.from_matrix(crop.matrix), side, side, backend=backend)
    return [
        _compare(crop, views.rgb[i], views.depth[i], turns[i], shifts[i], templates, encoder) for i in range(len(turns))
    ]


def _compare(crop, rgb, depth, turn, shift, templates, encoder) -> _Drawing:
    config = ResectConfig()
    drawn = _describe_features(encoder, rgb, depth, crop.matrix, templates)
    shown, photo = depth > 0, crop.mask
    rows = round(len(crop.rays) ** 0.5)
    step = photo.shape[0] // rows
    cover, outline = (x.reshape(rows, step, rows, step).mean(axis=(1, 3)).reshape(-1) for x in (shown, photo))
    features, wanted = (np.asarray(p.features, np.float64) for p in (drawn, crop.patches))
    there, valid = np.asarray(drawn.valid), np.asarray(crop.patches.valid)
    pool = lambda image: image.reshape(rows, step, rows, step, -1).sum(axis=(1, 3)).reshape(rows * rows, -1)
    colour = lambda image, where: pool(image * where[..., None] / 255) / np.maximum(pool(where[..., None]), 1)
    shared = np.where(there & valid, np.minimum(cover, outline), 0)
    alike = features @ wanted.T
    overlap = float((np.diagonal(alike) * shared).sum() / max(shared.sum(), 1e-6))
    first, second, share = (jnp.asarray(x, jnp.float32) for x in (colour(rgb, shown), colour(crop.rgb, photo), shared))
    grid = np.indices((rows, rows)).reshape(2, -1)
    apart = np.abs(grid[:, :, None] - grid[:, None]).max(axis=0)
    alike = np.where((apart <= WINDOW) & valid[None], alike, -np.inf)
    best = alike.max(axis=1)
    found = np.isfinite(best)
    pull = np.exp((alike - np.where(found, best, 0)[:, None]) / config.softness)
    rays = pull @ crop.rays / np.maximum(pull.sum(axis=1, keepdims=True), 1e-9)
    return _Drawing(
        overlap=float(np.clip(overlap, 0, 1)),
        fit=compare_outlines(shown, photo),
        colour=float(chroma_correlation(first, second, share)),
        points=(np.asarray(drawn.points, np.float64) - shift) @ turn,
        rays=rays,
        weight=np.where(found & there & (cover > config.cover), np.maximum(best, 0), 0),
    )


def _refine(turn, shift, drawn: _Drawing, width: float) -> tuple[np.ndarray, np.ndarray]:
    turn, shift, points, rays, weight = (
        jnp.asarray(x, jnp.float32) for x in (turn, shift, drawn.points, drawn.rays, drawn.weight)
    )
    fit = refine_resection(turn, shift, points, rays, weight, width)
    return np.asarray(fit.rotation, np.float64), np.asarray(fit.translation, np.float64)


def _fit_outline(
    mesh: Mesh, crop: _Crop, turn: np.ndarray, shift: np.ndarray, drawn: _Drawing, *, free_focal: bool
) -> tuple[np.ndarray, np.ndarray, float]:
    """The pose, moved until the outlines lie on one another and the matches agree; and a factor of the focal length.

    Both outlines are compared with one another, each point with the nearest of the other, by Geman and McClure's loss:
    where something hides the object in the photo, the outlines differ, and that must not move it.
    """
    side = crop.mask.shape[0]
    points = sample_appearance(mesh, POINTS)[0]
    zoom = SIDE / side
    lens = resize(crop.matrix, (side, side), (SIDE, SIDE))
    cover = ndimage.zoom(crop.mask.astype(np.float32), zoom, order=1, grid_mode=True, mode="nearest")
    photo = np.asarray(cover > 0.5)
    border = lambda shape: shape & np.logical_not(ndimage.binary_erosion(shape))
    edge = border(photo)
    distance_to = lambda line: np.asarray(ndimage.distance_transform_edt(np.logical_not(line)))
    away = distance_to(edge)
    width = WIDTH * np.hypot(*np.ptp(np.argwhere(photo), axis=0))
    robust = lambda distance: float((distance**2 / (distance**2 + width**2)).mean()) if len(distance) else 1.0
    pair_width = ResectConfig().width * _diagonal(crop)
    share = drawn.weight / max(drawn.weight.sum(), 1e-9)

    def move(step):
        return rotation_from_vector(step[:3]) @ turn, shift + shift[2] * step[3:6], np.exp(step[6])

    def cost(step):
        step = np.append(step, 0.0) if len(step) == 6 else step
        new_turn, new_shift, factor = move(step)
        placed = points @ new_turn.T + new_shift
        if placed[:, 2].min() < 1e-2:
            return 10.0
        rays = placed[:, :2] / placed[:, 2:]
        pixel = np.round(factor * lens[0, 0] * rays + lens[:2, 2]).astype(int)
        inside = ((pixel >= 0) & (pixel < SIDE)).all(axis=1)
        image = np.zeros((SIDE, SIDE), bool)
        image[pixel[inside, 1], pixel[inside, 0]] = True
        image = np.asarray(ndimage.binary_closing(np.pad(image, 2), np.ones((3, 3))))[2:-2, 2:-2]
        rim = border(image)
        if not rim.any():
            return 10.0
        outline = robust(away[rim]) + robust(distance_to(rim)[edge])
        seen = drawn.points @ new_turn.T + new_shift
        offset = factor * seen[:, :2] / np.maximum(seen[:, 2:], 1e-6) - drawn.rays
        squared = (offset**2).sum(axis=1) / pair_width**2
        return OUTLINE * outline + (share * squared / (1 + squared)).sum() + PRIOR * (step[6] / FOCAL) ** 2

    size = 7 if free_focal else 6
    start = np.zeros(size)
    steps = np.array([0.05, 0.05, 0.05, 0.01, 0.01, 0.03, 0.05])[:size]
    simplex = np.concatenate([start[None], np.diag(steps)])
    options = {"initial_simplex": simplex, "maxfev": 500, "xatol": 1e-4, "fatol": 1e-4}
    found = optimize.minimize(cost, start, method="Nelder-Mead", options=options).x
    new_turn, new_shift, factor = move(found if size == 7 else np.append(found, 0.0))
    return new_turn, new_shift, float(factor)

"""How well a hypothesis explains the query: its depth, its mask, and its features.

Depth comes from splatting the object's surface points; features from the templates of the nearest viewpoints, whose
3-D points are projected into the query's feature map. The best few hypotheses can be drawn and described at their exact
pose, which distinguishes a bottle's front from its back where a template 15° away does not.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from ipjax_kernels.positive import root
from ipjax_kernels.rasterize import splat_colours, splat_depth
from jax import lax
from jaxtyping import Array, Bool, Float

from ipjax.cameras import project, resize_pixels
from ipjax.config import ScoreConfig
from ipjax.estimation.features import object_features
from ipjax.metrics.poses import turn_angle
from ipjax.records import Agreement, Camera, Patches, Query, Similarity, Surface, Templates


def score(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]] | None,
    templates: Templates,
    query: Query,
    depth: Float[Array, "g g"],
    mask: Bool[Array, "g g"],
    camera: Camera,
    camera_from_object: Similarity,
    config: ScoreConfig = ScoreConfig(),
) -> tuple[Float[Array, ""], Agreement]:
    """The score in [0, 1] of one hypothesis, and its parts; the caller vmaps.

    Where the hypothesis is drawn, colours count, too, and depth counts less than features: with errors of the mesh a
    wrong rotation often fits the depth better.

    Args:
      encoder: with it the hypothesis is drawn and described, too; None = it is not.
      query: its patches centred on the templates' mean, as the templates' are.
      depth, mask, camera: the query's crop on a coarse grid (metres, 0 = unknown; one pixel per cell).
    """
    geometry = depth_agreement(templates.surface, depth, mask, camera, camera_from_object, config)
    features = feature_agreement(templates, query, camera_from_object, config)
    one, later = jnp.ones_like(geometry), jnp.zeros_like(geometry)  # only the chosen one needs what comes later
    undrawn = Agreement(geometry, features, drawn=one, colour=later, seen=later, rival=later)
    if encoder is None:
        if templates.photo_centre is not None:
            trust = trusted_share(templates, camera_from_object, config)
            features = trust * features + (1 - trust) * config.guess
        return geometry * features**config.power, undrawn
    return score_drawn(encoder, templates, query, camera_from_object, undrawn, config)


def score_drawn(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    templates: Templates,
    query: Query,
    camera_from_object: Similarity,
    undrawn: Agreement,
    config: ScoreConfig = ScoreConfig(),
) -> tuple[Float[Array, ""], Agreement]:
    """:func:`score` with the encoder, where the agreement without it is known.

    Args:
      undrawn: of the same hypothesis, as :func:`score` without an encoder returns it.
    """
    drawn, colour = drawn_agreement(encoder, templates, query, camera_from_object, config)
    # What a guessed surface looks like says little, be it like the photo or unlike it.
    trust = trusted_share(templates, camera_from_object, config)
    known = lambda agreement: trust * agreement + (1 - trust) * config.guess
    looks = known(undrawn.features) ** config.power * known(drawn)
    total = undrawn.depth**config.depth_power * looks * jnp.exp(config.colour_weight * (trust * colour - 1))
    return total, dataclasses.replace(undrawn, drawn=drawn, colour=colour)


@jax.jit  # so that it is traced once
def depth_agreement(
    surface: Surface,
    depth: Float[Array, "g g"],
    mask: Bool[Array, "g g"],
    camera: Camera,
    camera_from_object: Similarity,
    config: ScoreConfig = ScoreConfig(),
) -> Float[Array, ""]:
    """The share of the union of mask and visible surface where predicted and measured depth agree.

    Where a measurement outside the mask is nearer than predicted, an occluder hides the object: the place is left out.
    A measurement that is farther is a disagreement.
    """
    height, width = depth.shape
    placed = camera_from_object @ surface.points
    facing = _facing(placed, surface.normals, camera_from_object)
    predicted = splat_depth(placed, facing, camera.focal, camera.centre, height, width)
    known = depth > 0
    seen = predicted > 0
    tolerance = config.tolerance * camera_from_object.scale
    gap = depth - predicted
    agree = seen & known & mask & (jnp.abs(gap) <= tolerance)
    occluded = seen & ~mask & (~known | (gap < tolerance))
    union = (seen & ~occluded) | (mask & known)
    return jnp.sum(agree, dtype=depth.dtype) / jnp.maximum(jnp.sum(union, dtype=depth.dtype), 1)


def seen_share(surface: Surface, camera_from_object: Similarity) -> Float[Array, ""]:
    """The share of the surface facing the camera at a hypothesis that its reconstruction saw; the rest is guessed.

    By area in the image; surface that other parts of the object hide counts, too.
    """
    placed = camera_from_object @ surface.points
    facing = -jnp.sum(_turn_normals(camera_from_object, surface.normals) * placed, axis=-1)
    area = jnp.maximum(facing, 0) / jnp.maximum(jnp.sum(placed * placed, axis=-1), 1e-12) ** 1.5
    return jnp.sum(area * surface.seen) / jnp.maximum(jnp.sum(area), 1e-12)


def trusted_share(
    templates: Templates, camera_from_object: Similarity, config: ScoreConfig = ScoreConfig()
) -> Float[Array, ""]:
    """How much of what the object looks like at a hypothesis counts when candidates are compared; the rest is assumed.

    What was guessed from a photo counts nothing. What an image-to-3D model invented does, but for ``config.invented``:
    it often looks as the object does.
    """
    seen = seen_share(templates.surface, camera_from_object)
    return seen if templates.photo_centre is None else 1 - config.invented * (1 - seen)


def closeness(templates: Templates, camera_from_object: Similarity) -> Float[Array, "v"]:
    """The angle (rad) between the hypothesis and the viewpoint of every template.

    The hypothesis is turned to the optical axis first: what an off-axis object looks like depends on its ray.
    """
    distance = root(jnp.sum(camera_from_object.translation**2))
    ray = camera_from_object.translation / jnp.maximum(distance, 1e-9)
    turned = jnp.sum(look_along(ray)[:, :, None] * camera_from_object.rotation[None], axis=1)
    trace = jnp.sum(templates.camera_from_object.rotation * turned, axis=(-2, -1))
    return turn_angle(trace)


def look_along(ray: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The smallest rotation that turns a unit ray onto the optical axis; rays behind the camera stay finite."""
    x, y, z = ray
    factor = 1 / jnp.maximum(1 + z, 1e-6)
    return jnp.stack(
        [
            jnp.stack([1 - x * x * factor, -x * y * factor, -x]),
            jnp.stack([-x * y * factor, 1 - y * y * factor, -y]),
            jnp.stack([x, y, z]),
        ]
    )


@jax.jit  # so that it is traced once
def feature_agreement(
    templates: Templates,
    query: Query,
    camera_from_object: Similarity,
    config: ScoreConfig = ScoreConfig(),
) -> Float[Array, ""]:
    """Cosine in [0, 1] between the patches of the nearest templates and the query's where the hypothesis puts them.

    Patches behind an occluder are left out; those that fall outside the mask count as zero. Templates are weighted by
    the angle between their viewpoint and the hypothesis'.
    """
    has_patches = jnp.any(templates.patches.valid, axis=1)
    nearness = jnp.where(has_patches, -closeness(templates, camera_from_object), -10)
    angle, views = lax.top_k(nearness, min(config.views, templates.norm.shape[0]))
    weight = jnp.where(has_patches[views], jnp.exp(-jnp.square(angle / config.spread)), 0)
    near = jax.tree.map(lambda x: x[views], templates.patches)
    cosines = jax.vmap(lambda patches: _carried_cosine(patches, query, camera_from_object, config))(near)
    return jnp.clip(jnp.sum(weight * cosines) / jnp.maximum(jnp.sum(weight), 1e-9), 0, 1)


def drawn_agreement(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    templates: Templates,
    query: Query,
    camera_from_object: Similarity,
    config: ScoreConfig = ScoreConfig(),
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How similar the object, drawn at the hypothesis, is to the query: in features and in colours.

    Surface behind an occluder is not drawn.

    Args:
      templates: of the object, with its appearance.
      query: its patches centred on the templates' mean, as the templates' are.

    Returns:
      The cosine of the features in [0, 1], averaged over the union of what is drawn and the mask, where what is in only
      one of them counts as zero. And the :func:`chroma_correlation` of the patches' mean colours.

    Raises:
      ValueError: the templates have no appearance.
    """
    appearance, view = templates.appearance, query.view
    if appearance is None:
        raise ValueError("these templates have no appearance to draw: onboard the object with appearance > 0")
    height, width = view.depth.shape
    placed = camera_from_object @ appearance.points
    facing = _facing(placed, appearance.normals, camera_from_object)
    tolerance = config.tolerance * camera_from_object.scale
    image, depth = splat_colours(
        placed, appearance.colours, facing, view.camera.focal, view.camera.centre, height, width, tolerance / 2
    )
    hidden = ~view.mask & (view.depth > 0) & (view.depth < depth - tolerance)
    shown = (depth > 0) & ~hidden
    features = object_features(encoder(jnp.where(shown[..., None], image, 0)), templates)
    rows, columns, _ = features.shape
    drawn, seen = _patch_cover(shown, rows, columns), _patch_cover(view.mask, rows, columns)
    cosine = jnp.sum(features.reshape(query.patches.features.shape) * query.patches.features, axis=-1)
    either = jnp.sum(jnp.maximum(drawn, seen))
    shared = jnp.minimum(drawn, seen)
    agreement = jnp.clip(jnp.sum(cosine * shared) / jnp.maximum(either, 1e-9), 0, 1)
    drawn_colours = _patch_colour(image, shown, rows, columns)
    seen_colours = _patch_colour(view.rgb, view.mask, rows, columns)
    return agreement, chroma_correlation(drawn_colours, seen_colours, shared)


def chroma_correlation(
    first: Float[Array, "p 3"], second: Float[Array, "p 3"], weight: Float[Array, "p"]
) -> Float[Array, ""]:
    """Correlation of the colours of two images, independent of light, shade and tint: in [-1, 1], 0 if one is grey.

    The encoder's features hardly depend on colour, and a reconstruction with a blurred texture still has its colours.
    Colours are divided by their brightness: else the chroma of an object of one colour would vary with the light, which
    was another when it was reconstructed.

    Args:
      first, second: mean colours of the patches, in [0, 1].
      weight: of each patch.
    """

    def deviation(colours):
        brightness = jnp.mean(colours, axis=-1, keepdims=True)
        chroma = (colours - brightness) / (brightness + _DARK)
        return chroma - mean(chroma)

    mean = lambda x: jnp.sum(x * weight[:, None], axis=0) / jnp.maximum(jnp.sum(weight), 1e-6)
    a, b = deviation(first), deviation(second)
    variance = jnp.sqrt(jnp.sum(mean(a * a)) * jnp.sum(mean(b * b)) + 1e-12)
    return jnp.sum(mean(a * b)) / (variance + _GREY)


_DARK = 0.3  # brightness below which chroma is reduced, for it is mostly noise
_GREY = 1.5e-3  # variance of chroma that is attributed to the camera's noise


def _patch_colour(
    image: Float[Array, "h w 3"], mask: Bool[Array, "h w"], rows: int, columns: int
) -> Float[Array, "p 3"]:
    """Mean colour of the pixels of each patch that are in the mask."""
    height, width = mask.shape
    shape = rows, height // rows, columns, width // columns, -1
    total = lambda x: jnp.sum(x.reshape(shape), axis=(1, 3)).reshape(rows * columns, -1)
    set_here = mask[..., None].astype(image.dtype)
    return total(image * set_here) / jnp.maximum(total(set_here), 1)


def _carried_cosine(
    patches: Patches, query: Query, camera_from_object: Similarity, config: ScoreConfig
) -> Float[Array, ""]:
    """Mean cosine of one template's patches with the query's features where the hypothesis puts them."""
    height, width = query.view.depth.shape
    rows, columns = _grid_shape(query)
    placed = camera_from_object @ patches.points
    pixel = project(query.view.camera, placed)
    cell = resize_pixels(pixel, (width, height), (columns, rows))
    # Patches of the mask without a depth have no point, but their features are as good.
    inside = _patch_cover(query.view.mask, rows, columns) > 0.25
    sampled, share = _sample(query.patches.features, inside, cell, rows, columns)
    norm = jnp.sqrt(jnp.sum(sampled * sampled, axis=-1) + 1e-12)
    features = jnp.where(patches.valid[:, None], patches.features, 0)  # invalid ones may hold NaN
    cosine = jnp.sum(sampled * features.astype(sampled.dtype), axis=-1) / norm
    column = jnp.clip(jnp.round(pixel[:, 0]).astype(jnp.int32), 0, width - 1)
    row = jnp.clip(jnp.round(pixel[:, 1]).astype(jnp.int32), 0, height - 1)
    measured = query.view.depth[row, column]
    nearer = (measured > 0) & (measured < placed[:, 2] - config.tolerance * camera_from_object.scale)
    counted = patches.valid & ~(nearer & ~query.view.mask[row, column])
    value = jnp.where(counted & (share > 0.25), cosine, 0)
    return jnp.sum(value) / jnp.maximum(jnp.sum(counted, dtype=value.dtype), 1)


def _facing(
    placed: Float[Array, "n 3"], normals: Float[Array, "n 3"], camera_from_object: Similarity
) -> Bool[Array, "n"]:
    """Which of the points in the camera frame face the camera."""
    return jnp.sum(_turn_normals(camera_from_object, normals) * placed, axis=-1) < 0


def _turn_normals(camera_from_object: Similarity, normals: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return jnp.sum(camera_from_object.rotation[None] * normals[:, None, :], axis=-1)


def _patch_cover(pixels: Bool[Array, "h w"], rows: int, columns: int) -> Float[Array, "p"]:
    """The share of each patch's pixels that are set."""
    height, width = pixels.shape
    patches = pixels.astype(jnp.float32).reshape(rows, height // rows, columns, width // columns)
    return jnp.mean(patches, axis=(1, 3)).reshape(-1)


def _grid_shape(query: Query) -> tuple[int, int]:
    """Rows and columns of the query's patches, from the shape of its image: patches are square."""
    height, width = query.view.depth.shape
    size = round((height * width / query.patches.valid.shape[0]) ** 0.5)
    return height // size, width // size


def _sample(
    features: Float[Array, "p c"], valid: Bool[Array, "p"], cell: Float[Array, "n 2"], rows: int, columns: int
) -> tuple[Float[Array, "n c"], Float[Array, "n"]]:
    """Bilinear features at grid coordinates (column, row), of valid patches only, and the share that they make up."""
    base = jnp.floor(cell)
    fraction = cell - base
    total = jnp.zeros((cell.shape[0], features.shape[-1]), features.dtype)
    share = jnp.zeros(cell.shape[0], features.dtype)
    corner = base.astype(jnp.int32)
    for right in (0, 1):
        for down in (0, 1):
            column, row = corner[:, 0] + right, corner[:, 1] + down
            inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            index = jnp.clip(row, 0, rows - 1) * columns + jnp.clip(column, 0, columns - 1)
            weight = jnp.abs(1 - right - fraction[:, 0]) * jnp.abs(1 - down - fraction[:, 1])
            weight = jnp.where(inside & valid[index], weight, 0)
            total = total + weight[:, None] * features[index]
            share = share + weight
    return total, share

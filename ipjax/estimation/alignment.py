"""From pairs to similarities: minimal sets, Umeyama, consensus, refits (Algorithm 1, corrected)."""

import jax
import jax.numpy as jnp
from ipjax_kernels.consensus import consensus
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ipjax.config import AlignConfig
from ipjax.records import Pairs, Similarity


def align(
    pairs: Pairs,
    size: Float[Array, "v"],
    key: PRNGKeyArray,
    config: AlignConfig = AlignConfig(),
    diameter: Float[Array, ""] | None = None,
) -> tuple[Similarity, Float[Array, "h"], Bool[Array, "h k"], Bool[Array, "h"]]:
    """The best similarities ``camera_from_object`` of each view's pairs.

    Args:
      pairs: ``v k`` correspondences; weight 0 = absent.
      size: an estimate of the object's diameter from mask and depth, metres; centre of the scale gate.
      diameter: the true diameter, metres, where it is known: then only rotation and translation are free.

    Returns:
      ``h = v · config.keep`` similarities, their scores (share of the pairs' weight that is explained), which pairs
      are inliers, and whether each is determined at all.
    """
    keys = jax.random.split(key, pairs.weight.shape[0])
    low, high = config.scale_gate
    bounds = (size * low, size * high)
    if diameter is not None:
        bounds = (jnp.broadcast_to(0.8 * diameter, size.shape), jnp.broadcast_to(1.25 * diameter, size.shape))

    def one(key, source, target, weight, low, high):
        return consensus(
            key,
            source,
            target,
            weight,
            config.threshold,
            count=config.count,
            size=config.size,
            keep=config.keep,
            refits=config.refits,
            rank=config.rank,
            scale_bounds=(low, high),
            edge_ratio=config.edge_ratio,
            relative=True,
        )

    found = jax.vmap(one)(keys, pairs.object, pairs.camera, pairs.weight, *bounds)
    pose = Similarity(found.rotation, found.translation, found.scale)
    if diameter is not None:
        pose = jax.vmap(jax.vmap(_rescale, (0, 0, None, None, None)), (0, 0, 0, 0, None))(
            pose, found.inliers, pairs.object, pairs.weight, diameter
        )
    flat = lambda x: x.reshape(-1, *x.shape[2:])
    return jax.tree.map(flat, pose), flat(found.score), flat(found.inliers), flat(found.success)


def _rescale(
    pose: Similarity,
    inliers: Bool[Array, "k"],
    points: Float[Array, "k 3"],
    weight: Float[Array, "k"],
    diameter: Float[Array, ""],
) -> Similarity:
    """The pose with the given scale and the same rotation; the centroid of the inliers stays in place."""
    share = jnp.where(inliers, weight, 0)
    centroid = jnp.sum(share[:, None] * points, axis=0) / jnp.maximum(jnp.sum(share), 1e-9)
    moved = jnp.sum(pose.rotation * centroid[None], axis=-1)
    return Similarity(pose.rotation, pose.translation + (pose.scale - diameter) * moved, diameter)

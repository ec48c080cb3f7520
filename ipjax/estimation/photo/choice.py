"""Which of several poses is right, told by a photo with depth: what was guessed behind what it saw has no vote.

Drawing the object into the query, and how well it fits the query's depth, would let the guessed back vote: among poses
that refinement fitted to the depth, a wrong one often fits it best.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ipjax.config import Config
from ipjax.estimation.photo.drawing import draw_query
from ipjax.estimation.photo.resection import measure_sight
from ipjax.records import Query, ReferenceView, Similarity, Templates


def judge_by_photo(
    encoder: Callable[[Float[Array, "h w 3"]], Float[Array, "gh gw c"]],
    templates: Templates,
    query: Query,
    poses: Similarity,
    config: Config = Config(),
) -> tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, "n"]]:
    """The query's measured surface drawn into the photo's camera from each pose, compared where both show the object.

    Args:
      templates: with the reference view of a photo whose depth was measured.
      query: its patches centred on the templates' mean, as the templates' are.
      poses: ``camera_from_object``, n of them, metres.

    Returns:
      The score of each pose in [0, 1], the mean cosine of the patches that both cover, and the correlation of their
      colours in [-1, 1].
    """
    reference = templates.reference
    assert reference is not None
    sight = measure_sight(reference, query)

    @jax.jit  # compiled for one platform, but traced for both
    def compare(pose):
        drawing = draw_query(encoder, templates, query, *photo_camera(reference, pose), sight, config.resect)
        return drawing.overlap, drawing.colour

    # One image at a time is fastest on a CPU; accelerators want them all.
    overlap, colour = lax.platform_dependent(
        poses, cpu=lambda poses: lax.map(compare, poses), default=jax.vmap(compare)
    )
    return overlap * jnp.exp(config.score.colour_weight * (colour - 1)), overlap, colour


def photo_camera(
    reference: ReferenceView, camera_from_object: Similarity
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """The photo's camera from the query's, rotation and translation in metres, by the object's pose in the query's."""
    photo, pose = reference.camera_from_object, camera_from_object
    turn = jnp.matmul(photo.rotation, pose.rotation.T, precision="highest")
    return turn, pose.scale * photo.translation - jnp.matmul(turn, pose.translation, precision="highest")

"""An estimate of a method that is certain of one pose."""

import jax.numpy as jnp

from ipjax.records import Agreement, Hypotheses, PoseEstimate, Similarity


def make_estimate(pose: Similarity, *, success: bool = True, present: bool = True, turn: float = 0.0) -> PoseEstimate:
    """``turn``: standard deviation about the object's z axis, rad."""
    return PoseEstimate(
        camera_from_object=pose,
        diameter=pose.scale,
        box=jnp.asarray([[-0.5, -0.4, -0.3], [0.5, 0.4, 0.3]]),
        confidence=jnp.asarray(0.8),
        present=jnp.asarray(present),
        covariance=jnp.diag(jnp.asarray([4e-4, 1e-4, 1e-4, 1e-6, 1e-6, 4e-6])),
        scale_std=jnp.asarray(0.002),
        ambiguity=jnp.asarray([0.0, 0.0, turn]),
        agreement=Agreement(*(jnp.asarray(x) for x in (0.9, 0.8, 0.7, 0.5, 1.0, 0.6))),
        hypotheses=Hypotheses(pose.take(None), jnp.asarray([0.5])),
        view=jnp.asarray(1),
        view_score=jnp.zeros(5),
        inliers=jnp.asarray(12),
        rmse=jnp.asarray(0.004),
        success=jnp.asarray(success),
    )

"""The crop of the scene on a coarse grid: what refinement fits and what scores compare with."""

import equinox as eqx
import jax
import jax.numpy as jnp
from ipjax_kernels.positive import root
from jaxtyping import Array, Bool, Float

from ipjax.cameras import mask_from_coverage, resize
from ipjax.estimation.contour import trace_contour
from ipjax.estimation.features import lift
from ipjax.estimation.residuals import Cloud
from ipjax.records import Camera, Query


class SceneGrid(eqx.Module):
    """The crop on a coarse grid: what refinement fits and what scores compare with."""

    cloud: Cloud
    depth: Float[Array, "g g"]  # background included: it shows what occludes
    mask: Bool[Array, "g g"]

    def __init__(self, query: Query, grid: int, contour: int):
        view, side = query.view, query.view.depth.shape[0]
        if side % grid:
            raise ValueError(f"score.resolution must divide the {side} pixels of a crop's side; {grid} does not")
        camera = resize(view.camera, (side, side), (grid, grid))
        covered = jnp.mean(view.mask.astype(view.depth.dtype).reshape(grid, side // grid, grid, -1), axis=(1, 3))
        self.mask = mask_from_coverage(covered)
        # A cell at the object's border has the depth of the object, or of what is beside it, never their mean.
        of_both = lambda mask: lift(eqx.tree_at(lambda v: v.mask, view, mask), grid, grid, 0.05)
        points, share = jax.vmap(of_both)(jnp.stack([view.mask, ~view.mask]))
        known = (share > 0.3).reshape(2, grid, grid)
        depth = jnp.where(known, points[..., 2].reshape(2, grid, grid), 0)
        self.depth = jnp.where(self.mask, depth[0], depth[1])
        self.cloud = Cloud(
            points[0].reshape(grid, grid, 3),
            known[0],
            camera,
            self.mask,
            self.depth,
            trace_contour(covered, self.depth, 0.1 * _extent(self.mask, self.depth, camera), contour),
        )


def _extent(mask: Bool[Array, "h w"], depth: Float[Array, "h w"], camera: Camera) -> Float[Array, ""]:
    """The square root of the area that the mask covers, metres: a rough size of the object."""
    return root(jnp.sum(jnp.where(mask, depth, 0) ** 2) / (camera.focal[0] * camera.focal[1]))

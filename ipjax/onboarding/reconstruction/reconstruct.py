"""From one photo to a mesh, and where the photo's camera stood: the method that fits what is known of the photo."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ipjax.files.weights.catalogue import WeightsError
from ipjax.onboarding.reconstruction.methods import CHOICES
from ipjax.onboarding.reconstruction.result import Progress, Reconstruction
from ipjax.records import Camera

if TYPE_CHECKING:
    from ipjax.networks.triposr.model import TripoSR
    from ipjax.onboarding.foreground import Foreground


def reconstruct(
    foreground: "Foreground",
    *,
    method: str = "auto",
    depth: Float[np.ndarray, "h w"] | None = None,
    camera: Camera | None = None,
    model: "TripoSR | None" = None,
    resolution: int = 256,
    progress: Progress | None = None,
) -> Reconstruction:
    """A mesh of the object in a photo.

    Args:
        method: "triposr" (needs ``model``), "inflate" (no weights), or "auto": the measured surface where there is
            depth, else TripoSR where there is a model, else inflation.
        depth: along z, metres, 0 = unknown, as large as the photo; needs ``camera``. Used without weights only.
        camera: of the photo; None = unknown.
        resolution: of the grid in which TripoSR's surface is found.

    Raises ValueError in words: unknown method, depth without camera, TripoSR without its weights, unusable depth.
    """
    from ipjax.onboarding.reconstruction.completion import complete_depth
    from ipjax.onboarding.reconstruction.inflation import inflate_photo
    from ipjax.onboarding.reconstruction.triposr import reconstruct_with_triposr

    if method not in CHOICES:
        raise ValueError(f"the method is 'auto', 'triposr' or 'inflate', not {method!r}")
    if depth is not None and camera is None:
        raise ValueError("depth without its camera has no metric points: give the camera too")
    if method == "auto":
        method = "triposr" if depth is None and model is not None else "inflate"
    notes = foreground.notes
    if method == "triposr":
        if model is None:
            raise ValueError("TripoSR needs its weights: `load_triposr` finds them, method 'inflate' needs none")
        made = reconstruct_with_triposr(model, foreground, resolution=resolution, progress=progress)
    elif depth is not None:
        assert camera is not None
        made = complete_depth(foreground.rgb, foreground.mask, depth, camera)
    else:
        made = inflate_photo(foreground.rgb, foreground.mask, camera=camera)
    return dataclasses.replace(made, report=notes + made.report)


def reconstruct_with_weights(
    foreground: "Foreground",
    *,
    method: str = "auto",
    weights: str | Path | None = None,
    depth: Float[np.ndarray, "h w"] | None = None,
    camera: Camera | None = None,
    progress: Progress | None = None,
) -> tuple[Reconstruction, str]:
    """`reconstruct` with the model that the method needs, and the name in `METHODS` of the one that made the mesh.

    Args:
        weights: the checkpoint; default: the one that is here. Where "auto" finds none, the mesh is made without.

    Raises ValueError as `reconstruct`; WeightsError where weights were asked for and are not here.
    """
    from ipjax.onboarding.reconstruction.triposr import load_triposr, resolve_triposr

    if method not in CHOICES:
        raise ValueError(f"the reconstruction is 'auto', 'triposr' or 'inflate', not {method!r}")
    model, missing = None, ""
    if method == "triposr" or (method == "auto" and depth is None):
        try:
            model = load_triposr(resolve_triposr(weights).path)
        except WeightsError:
            if method == "triposr" or weights is not None:
                raise
            missing = "TripoSR's weights are not here, so the mesh was made without learned weights"
    made = reconstruct(foreground, method=method, depth=depth, camera=camera, model=model, progress=progress)
    if missing:
        made = dataclasses.replace(made, report=(*made.report, missing))
    return made, "triposr" if model is not None else "depth" if depth is not None else "inflate"

"""The query as the camera of the reference photo sees it, by an estimate of the object."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from ipjax.estimation.photo.drawing import splat_query
from ipjax.estimation.photo.resection import measure_sight
from ipjax.records import PoseEstimate, Query, ReferenceView, Similarity, Templates

_RATIOS = np.linspace(np.log(0.6), np.log(1.6), 41)  # of the photo's distance, where only a given size is known
_FINER = np.linspace(-0.025, 0.025, 11)  # about the best of them


@dataclasses.dataclass(frozen=True)
class PhotoDrawing:
    """The query's measured surface in the pixels of the reference view."""

    rgb: Float[np.ndarray, "h w 3"]  # [0, 1]; black where nothing was measured
    points: Float[np.ndarray, "h w 3"]  # mean of what a pixel shows, metres in the photo's camera; 0 = nothing
    shown: Bool[np.ndarray, "h w"]
    reference_from_query: Similarity[np.ndarray]  # metres
    behind: float  # metres that the posed object is moved away from the photo's camera; 0 unless its size was given


def reference_from_query(reference: ReferenceView, camera_from_object: Similarity) -> Similarity[np.ndarray]:
    """The photo's camera in metres, from the query's: the inverse of `resection.query_from_object`, in doubles.

    It is what was estimated where the size was found, too. A given size moves the object along the photo's axis until
    its guessed front is where the query measured it, and with it this camera; :func:`draw_query_into_photo` undoes it.
    """
    pose, photo = camera_from_object.to_numpy(), reference.camera_from_object.to_numpy()
    unit = pose.scale
    return Similarity(photo.rotation, unit * photo.translation, unit) @ pose.inverse()


def draw_query_into_photo(templates: Templates, query: Query, estimate: PoseEstimate) -> PhotoDrawing:
    """The query's measured, coloured surface, splatted into the camera of the photo that the object was made from.

    Args:
        templates: with a reference view.
        query: the crop that was estimated.
        estimate: of it, in the crop's camera (`Estimator.Result.crop_estimate`).

    Raises:
        ValueError: the object has no reference view, or no pose was found.
    """
    reference = templates.reference
    if reference is None:
        raise ValueError("the object keeps no photo that it was made from: there is none to draw the query into")
    if not bool(estimate.success):
        raise ValueError("no pose was found, so the query cannot be drawn into the photo's view")
    camera = reference_from_query(reference, estimate.camera_from_object)
    # Only a given size has no deviation; what was measured is where it was measured whatever the size.
    kept = float(estimate.scale_std) > 0 or reference.measured
    behind = 0.0 if kept else _find_distance(reference, query, camera, estimate)
    camera = _ahead(camera, behind)
    paint, depth = _draw(reference, query, camera)
    shown = depth > 0
    points = np.where(shown[..., None], (camera @ paint[..., 3:].reshape(-1, 3)).reshape(*shown.shape, 3), 0)
    return PhotoDrawing(np.where(shown[..., None], paint[..., :3], 0), points, shown, camera, behind)


@jax.jit
def _splat(reference, query, rotation, translation):
    return splat_query(reference, query, rotation, translation, measure_sight(reference, query))


def _draw(reference: ReferenceView, query: Query, camera: Similarity[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Colour and place (metres, the query's camera) of each pixel, and its depth."""
    turn, shift = (jnp.asarray(x, jnp.float32) for x in (camera.rotation, camera.translation))
    paint, depth = _splat(reference, query, turn, shift)
    return np.asarray(paint, np.float64), np.asarray(depth)


def _ahead(camera: Similarity[np.ndarray], behind: float) -> Similarity[np.ndarray]:
    return Similarity(camera.rotation, camera.translation + np.array([0, 0, behind]), camera.scale)


def _find_distance(
    reference: ReferenceView, query: Query, camera: Similarity[np.ndarray], estimate: PoseEstimate
) -> float:
    """How much farther away the photo's camera is than the given size says: where drawing and photo look most alike.

    The given size says nothing of how far the photo was taken from; colours and outline, drawn, do.
    """
    photo, mask = np.asarray(reference.view.rgb, np.float64), np.asarray(reference.view.mask)
    distance = float(estimate.camera_from_object.scale) * float(reference.camera_from_object.translation[2])

    def alike(ratio: float) -> float:
        paint, depth = _draw(reference, query, _ahead(camera, (np.exp(ratio) - 1) * distance))
        shown = depth > 0
        near = np.exp(-np.abs(paint[..., :3] - photo).max(axis=-1) / 0.2)
        return float((near * (shown & mask)).sum() / max((shown | mask).sum(), 1))

    best = max(_RATIOS, key=alike)
    best = max(best + _FINER, key=alike)
    return float((np.exp(best) - 1) * distance)


def fill_from_nearest(image: np.ndarray, known: Bool[np.ndarray, "h w"]) -> np.ndarray:
    """The image with the value or colour of the nearest known pixel at all others."""
    if not known.any():
        return image
    row, column = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    return image[row, column]

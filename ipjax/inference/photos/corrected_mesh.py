"""The mesh at its pose; of an object from a photo without depth, with the front that the query measured."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from ipjax.cameras import project, unproject
from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.estimator import Result
from ipjax.inference.photos.drawing import draw_query_into_photo, fill_from_nearest
from ipjax.records import PoseEstimate, Query, Templates

FARTHEST = 0.35  # diameters between guess and measurement, beyond which it was something else that was measured
OUTLIER = 0.05  # diameters from the median of its neighbours, beyond which a measurement is left out
STIFFNESS = 1.0  # how much neighbouring corrections are held together; their reach is its root, in pixels


def pose_mesh(result: Result) -> Mesh:
    """The object's mesh in the frame of the image's camera, metres.

    Of an object that was made from a photo without depth, what the photo shows and the query measured too is moved
    along the photo's rays to where it was measured. The correction is smooth, ends at the photo's outline, and leaves
    everything else as it was guessed. A mesh of any other object is moved as it is.

    Raises:
        ValueError: no pose was found, or the object file keeps no mesh.
    """
    info, pose = result.info, result.crop_estimate.camera_from_object.to_numpy()
    if not bool(result.estimate.success):
        raise ValueError(f"{info.name}: no pose was found, so there is no mesh to pose")
    if info.vertices is None or info.faces is None or not len(info.faces):
        raise ValueError(f"{info.name}: the object file keeps no mesh")
    vertices = np.asarray(info.vertices, np.float64)
    reference = result.templates.reference
    if reference is None or reference.measured:
        placed = pose @ vertices
    else:
        placed = correct_front(vertices, result.templates, result.query, result.crop_estimate)
    # The crop's camera is only turned.
    turn = result.estimate.camera_from_object.to_numpy().rotation @ pose.rotation.T
    return make_mesh(placed @ turn.T, info.faces, colours=info.colours)


def correct_info(result: Result) -> ObjectInfo:
    """What is known about the object, with the mesh that `pose_mesh` poses in place of the guessed one; model units.

    The same where there is nothing to correct: no pose, no mesh, or no guess.
    """
    info, reference = result.info, result.templates.reference
    guessed = reference is not None and not reference.measured
    if not guessed or not bool(result.estimate.success) or info.vertices is None or info.faces is None:
        return info
    if not len(info.faces):
        return info
    vertices = result.estimate.camera_from_object.to_numpy().inverse() @ pose_mesh(result).vertices
    return dataclasses.replace(info, vertices=vertices)


def correct_front(
    vertices: Float[np.ndarray, "n 3"], templates: Templates, query: Query, estimate: PoseEstimate
) -> Float[np.ndarray, "n 3"]:
    """Vertices of the object frame in the query's camera, the photo's front where the query measured it, metres.

    Args:
        vertices: of the guessed mesh, model units.
        templates: with a reference view.
        query: the crop that was estimated.
        estimate: of it, in the crop's camera.

    Raises:
        ValueError: the object has no reference view, or no pose was found.
    """
    drawing = draw_query_into_photo(templates, query, estimate)
    reference = templates.reference
    assert reference is not None
    photo, unit = reference.camera_from_object.to_numpy(), float(estimate.camera_from_object.scale)
    matrix, mask = reference.view.camera.to_matrix(), np.asarray(reference.view.mask)
    guess = np.where(mask, np.asarray(reference.view.depth, np.float64), 0)
    seen = photo @ vertices
    # Where the guess puts what the photo's pixels show, and how far it is from what was measured there.
    pixels = project(matrix, np.where(drawing.shown[..., None], drawing.points, [0, 0, 1]).reshape(-1, 3))
    there = _sample(guess, pixels).reshape(mask.shape)
    posed = unit * unproject(matrix, pixels, there.reshape(-1)).reshape(*mask.shape, 3)
    offset = drawing.points - (posed + np.array([0, 0, drawing.behind]))
    known = drawing.shown & mask & (there > 0)
    known &= np.linalg.norm(offset, axis=-1) < FARTHEST * unit
    known &= _is_smooth(offset[..., 2], known, OUTLIER * unit)
    if known.any():
        field = _spread(offset, known, mask)
        at = project(matrix, seen)
        moved = np.stack([ndimage.map_coordinates(field[..., i], at[:, ::-1].T, order=1) for i in range(3)], axis=-1)
        moved = np.where(_is_front(seen, at, guess)[:, None], moved, 0)
    else:
        moved = 0.0
    in_photo = unit * seen + np.array([0, 0, drawing.behind]) + moved
    return drawing.reference_from_query.inverse() @ in_photo


def _sample(image: Float[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """A depth image between its pixels; where it has none, that of the nearest pixel which has."""
    return ndimage.map_coordinates(fill_from_nearest(image, image > 0), pixels[:, ::-1].T, order=1, mode="nearest")


def _is_smooth(image: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], most: float) -> Bool[np.ndarray, "h w"]:
    """Where an image is within ``most`` of the median of its neighbourhood: not at flying pixels."""
    return np.abs(image - ndimage.median_filter(fill_from_nearest(image, known), 5)) < most


def _spread(
    offset: Float[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """A smooth field over the mask that follows the offsets where they are known, and is zero at the outline.

    The membrane Σ w |field − offset|² + stiffness · Σ |differences|², solved exactly. Towards the outline, where depth
    is measured worst, the offsets weigh less.
    """
    height, width = mask.shape
    rim = 0.04 * np.sqrt(mask.sum())
    inside = np.asarray(ndimage.distance_transform_edt(np.pad(mask, 1)))[1:-1, 1:-1]
    weight = np.where(known, np.clip((inside - 1) / rim, 0, 1), 0)[mask]
    number = np.full((height + 2, width + 2), -1)
    number[1:-1, 1:-1][mask] = np.arange(mask.sum())
    own = number[1:-1, 1:-1][mask]
    rows, columns = [], []
    for shifted in (number[2:, 1:-1], number[:-2, 1:-1], number[1:-1, 2:], number[1:-1, :-2]):
        neighbour = shifted[mask]
        rows.append(own[neighbour >= 0])
        columns.append(neighbour[neighbour >= 0])
    row, column = np.concatenate(rows), np.concatenate(columns)
    links = sparse.csc_matrix((np.full(len(row), -STIFFNESS), (row, column)), shape=(len(own), len(own)))
    solved = splu((sparse.diags(weight + 4 * STIFFNESS) + links).tocsc()).solve(weight[:, None] * offset[mask])
    field = np.zeros_like(offset)
    field[mask] = solved
    return field


def _is_front(
    seen: Float[np.ndarray, "n 3"],
    pixels: Float[np.ndarray, "n 2"],
    guess: Float[np.ndarray, "h w"],
    slack: float = 0.01,
) -> Bool[np.ndarray, " n"]:
    """Which vertices the photo shows: none of the surface is before them, in a square of three pixels."""
    height, width = guess.shape
    place = np.round(np.clip(pixels, -1, [width, height])).astype(int)
    inside = np.asarray(((place >= 0) & (place < [width, height])).all(axis=1))
    column, row = np.where(inside[:, None], place, 0).T
    behind = ndimage.maximum_filter(guess, 3)[row, column]
    return inside & (guess[row, column] > 0) & (seen[:, 2] <= behind + slack)

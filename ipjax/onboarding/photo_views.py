"""A photo without depth as templates: turned in the image plane, and what its guessed surface shows from beside.

The photo itself is the best image there is of the object: turned in the plane it stays exact. From beside, only the
reconstruction can say what it looks like; each patch still knows which part of the photo it shows.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.cameras import look_at, project, resize, turn
from ipjax.files.meshes.mesh import Mesh
from ipjax.records import Camera, Similarity
from ipjax.rendering.job import Renders
from ipjax.transforms import rotation_from_vector

ROLLS = 12  # of the photo, a full turn
TILT = np.deg2rad(40.0)  # of the views from beside
TILTS, TILT_ROLLS = 6, 8  # directions of the tilt, and rolls of each


@dataclasses.dataclass(frozen=True)
class PhotoSource:
    """A masked photo, and where its camera stood."""

    rgb: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    camera_from_object: Similarity[np.ndarray]  # the normalised object, scale 1
    matrix: Float[np.ndarray, "3 3"]  # K of the photo


@dataclasses.dataclass(frozen=True)
class ReferencePhoto:
    """A masked photo, and where its camera stood before the mesh that was made from it is normalised."""

    rgb: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    camera_from_mesh: Similarity
    camera: Camera

    def of_normalised(self, mesh: Mesh) -> PhotoSource:
        """The photo seen from the object frame of a mesh, normalised since."""
        centre = np.asarray(mesh.centre, np.float64)
        object_from_mesh = Similarity(np.eye(3), -mesh.scale * centre, np.asarray(mesh.scale))
        pose = self.camera_from_mesh.to_numpy() @ object_from_mesh.inverse()
        # A similarity seen by a pinhole is a rigid motion seen from 1 / scale as far.
        rigid = Similarity(pose.rotation, pose.translation / pose.scale, np.ones(()))
        return PhotoSource(self.rgb, self.mask, rigid, self.camera.to_matrix())


def photo_poses(photo: PhotoSource) -> Similarity[np.ndarray]:
    """Poses of the photo's views [v], the camera always looking at the object's centre: first the photo, upright and
    then rolled (``ROLLS`` in all), then from beside."""
    where = photo.camera_from_object.translation
    camera_from_turned = look_at(photo.matrix, project(photo.matrix, where[None])[0])
    upright = camera_from_turned.T @ photo.camera_from_object.rotation
    about = lambda axis, angles: np.stack([rotation_from_vector(angle * np.array(axis)) for angle in angles])
    rolls = about([0.0, 0.0, 1.0], 2 * np.pi * np.arange(ROLLS) / ROLLS) @ upright
    directions = 2 * np.pi * np.arange(TILTS) / TILTS
    tilted = np.stack([rotation_from_vector(TILT * np.array([np.cos(a), np.sin(a), 0.0])) for a in directions])
    tilt_rolls = about([0.0, 0.0, 1.0], 2 * np.pi * np.arange(TILT_ROLLS) / TILT_ROLLS)
    beside = (tilt_rolls[None] @ tilted[:, None] @ upright).reshape(-1, 3, 3)
    rotation = np.concatenate([rolls, beside])
    distance = float(np.linalg.norm(where))
    translation = np.broadcast_to([0.0, 0.0, distance], (len(rotation), 3)).copy()
    return Similarity(rotation, translation, np.ones(len(rotation)))


def turn_photo(
    photo: PhotoSource, pose: Similarity[np.ndarray], matrix: Float[np.ndarray, "3 3"], resolution: int
) -> tuple[UInt8[np.ndarray, "s s 3"], Bool[np.ndarray, "s s"]]:
    """The photo as a camera in its place sees it that was turned: colours, black outside the mask, and the mask.

    Args:
      pose: of the object in the turned camera, from the same place.
      matrix: K of the turned one, of ``resolution`` pixels on a side.
    """
    import cv2

    fine = 3  # samples on a side of each pixel
    camera_from_turned = photo.camera_from_object.rotation @ pose.rotation.T
    size = (resolution, resolution)
    matrix = resize(matrix, size, (fine * resolution, fine * resolution))
    homography = turn(photo.matrix, camera_from_turned, matrix)
    warp = lambda image: cv2.resize(
        cv2.warpPerspective(
            image,
            homography,
            (fine * resolution, fine * resolution),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
        ),
        size,
        interpolation=cv2.INTER_AREA,
    )
    # Colours are averaged over the object only: its rim would be dark, else.
    share = warp(photo.mask.astype(np.float32))
    colour = warp(np.where(photo.mask[..., None], photo.rgb, 0).astype(np.float32))
    mask = share > 0.5
    rgb = np.where(mask[..., None], colour / np.maximum(share, 1e-6)[..., None], 0)
    return np.round(np.clip(rgb, 0, 255)).astype(np.uint8), mask


def put_photo(views: Renders, photo: PhotoSource, poses: Similarity[np.ndarray]) -> Renders:
    """The drawings with the photo itself in place of the first ``ROLLS``; depth stays the mesh's."""
    rgb, depth = np.array(views.rgb), np.array(views.depth)
    resolution, matrices = rgb.shape[1], views.camera.to_matrix()
    for index in range(ROLLS):
        pose = Similarity(poses.rotation[index], poses.translation[index], poses.scale[index])
        image, mask = turn_photo(photo, pose, matrices[index], resolution)
        depth[index] = np.where(mask, depth[index], 0)
        rgb[index] = np.where(depth[index][..., None] > 0, image, 0)
    return dataclasses.replace(views, rgb=rgb, depth=depth)

"""Structure from motion: incremental mapping by COLMAP, through pycolmap (the extra ``capture``), on our matches.

J. Schönberger and J.-M. Frahm, "Structure-from-motion revisited", CVPR 2016. The calibration stays as it is given. One
thread and a seed: the same matches give the same poses.
"""

import dataclasses
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ipjax.cameras import crop, crop_pixels
from ipjax.capture.poses.features import Features, Match
from ipjax.capture.records import CaptureError
from ipjax.transforms import Similarity

CORNER = (-0.5, -0.5)  # COLMAP measures from the corner of the first pixel
MISSING = "structure from motion needs the package pycolmap: pip install 'ipjax[capture]'"


@dataclasses.dataclass(frozen=True)
class Structure:
    """Poses and points in a unit of their own."""

    world_from_camera: Similarity[np.ndarray]  # of all frames, rigid; identity where not registered
    registered: Bool[np.ndarray, " n"]
    points: Float[np.ndarray, "p 3"]  # in the world
    frame: Int[np.ndarray, " m"]  # of each observation
    point: Int[np.ndarray, " m"]  # index of what is observed
    pixel: Float[np.ndarray, "m 2"]
    depth: Float[np.ndarray, " m"]  # measured there, metres; 0 = unknown


def is_available() -> bool:
    """Whether pycolmap is installed."""
    return find_spec("pycolmap") is not None


def map_incrementally(
    names: Sequence[str],
    features: Sequence[Features],
    matches: Sequence[Match],
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    *,
    seed: int = 0,
) -> Structure:
    """The largest reconstruction that COLMAP finds.

    Args:
      names: of the frames.
      features: of each.
      matches: verified, of pairs of frames.
      K: of all of them; pixels.
      size: of the images: width, height.

    Raises:
      CaptureError: pycolmap is missing, or it finds nothing that three frames agree on.
    """
    if not is_available():
        raise CaptureError(MISSING)
    with tempfile.TemporaryDirectory(prefix="ipjax-structure-") as folder:
        path = Path(folder) / "database.db"
        _write_database(path, names, features, matches, K, size)
        found = _map(path, Path(folder), seed)
    if found is None:
        raise CaptureError(
            "structure from motion found no two frames to begin with: they have too little in common, or the camera "
            "hardly moved; take more frames, closer to one another, of a scene with more texture"
        )
    return _read(found, names, features)


def _write_database(
    path: Path,
    names: Sequence[str],
    features: Sequence[Features],
    matches: Sequence[Match],
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
) -> None:
    import pycolmap

    shifted = crop(K, CORNER)
    parameters = shifted[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    camera = pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=parameters)
    camera.has_prior_focal_length = True
    with pycolmap.Database.open(path) as database:
        camera.camera_id = database.write_camera(camera)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(camera.sensor_id)
        rig.rig_id = database.write_rig(rig)
        for index, one in enumerate(features):
            # Image n + 1 is frame n of the capture.
            image = pycolmap.Image(name=f"{index:06d}", camera_id=camera.camera_id, image_id=index + 1)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=index + 1, rig_id=rig.rig_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(index + 1, crop_pixels(one.pixel, CORNER).astype(np.float32))
        for found in matches:
            pair = found.first + 1, found.second + 1
            points = found.points.astype(np.uint32)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config, geometry.inlier_matches = pycolmap.TwoViewGeometryConfiguration.CALIBRATED, points
            database.write_matches(*pair, points)
            database.write_two_view_geometry(*pair, geometry)


def _map(database: Path, folder: Path, seed: int) -> Any:
    """The model with the most frames; None where there is none."""
    import pycolmap

    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, pycolmap.logging.Level.FATAL.value
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=seed,
        extract_colors=False,
        min_model_size=3,
        max_num_models=3,
        ba_refine_focal_length=False,
        ba_refine_extra_params=False,
    )
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    try:
        models = pycolmap.incremental_mapping(database, folder, folder, options)
    finally:
        pycolmap.logging.minloglevel = level
    ordered = sorted(models.items(), key=lambda item: (-item[1].num_reg_images(), item[0]))
    return ordered[0][1] if ordered else None


def _read(model: Any, names: Sequence[str], features: Sequence[Features]) -> Structure:
    """What a model of pycolmap holds, as arrays."""
    count = len(names)
    rotation, translation, registered = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count, bool)
    for number in model.reg_image_ids():
        camera_from_world = model.image(number).cam_from_world().matrix()
        index, turn = int(model.image(number).name), camera_from_world[:, :3]
        rotation[index], translation[index], registered[index] = turn.T, -turn.T @ camera_from_world[:, 3], True
    points, frame, point, feature = [], [], [], []
    for number in sorted(model.points3D):
        one = model.points3D[number]
        for element in one.track.elements:
            frame.append(element.image_id - 1)
            point.append(len(points))
            feature.append(element.point2D_idx)
        points.append(one.xyz)
    start = np.concatenate([[0], np.cumsum([len(one) for one in features])])
    places = start[frame] + np.array(feature, int) if frame else np.zeros(0, int)
    return Structure(
        Similarity(rotation, translation, np.ones(count)),
        registered,
        np.array(points).reshape(-1, 3),
        np.array(frame, int),
        np.array(point, int),
        np.concatenate([one.pixel for one in features])[places],
        np.concatenate([one.depth for one in features])[places],
    )

"""An object from one exact image without depth, and a query of it whose true place in the photo is known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from builders.estimates import make_estimate

from ipjax.config import OnboardConfig
from ipjax.estimation.features import observe
from ipjax.estimation.photo.drawing import splat_query
from ipjax.estimation.photo.resection import measure_sight, metres_per_unit, query_from_object
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.frames import frame_turned
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.photo import onboard_photo
from ipjax.records import PoseEstimate, Query, ReferenceView, Similarity, Templates
from ipjax.synthetic import problems
from ipjax.transforms import rotation_from_vector

ONBOARD = OnboardConfig(directions=1, rolls=1, resolution=112, surface=512, appearance=0)
ENCODER = problems.make_encoder()
_look = jax.jit(observe)


@dataclasses.dataclass(frozen=True)
class PhotoPair:
    """The object, the query, and the truth: the ellipsoid is the same in both, in metres of the query."""

    templates: Templates
    info: ObjectInfo
    query: Query
    frame: problems.Frame  # that the query was cut from
    crop_from_ellipsoid: Similarity[np.ndarray]  # in the query's camera
    photo_from_ellipsoid: Similarity[np.ndarray]  # in the camera of the reference view

    @property
    def reference(self) -> ReferenceView:
        assert self.templates.reference is not None
        return self.templates.reference

    @property
    def reference_from_query(self) -> Similarity[np.ndarray]:
        """True; of scale 1."""
        return self.photo_from_ellipsoid @ self.crop_from_ellipsoid.inverse()


def make_photo_pair(seed: int, angle: float) -> PhotoPair:
    """The object of this seed, and the query turned from its photo by so many degrees about a random axis."""
    photo = problems.make_frame(seed)
    made = onboard_photo(
        Photo(photo.rgb), ENCODER, ONBOARD, mask=photo.mask, camera=photo.matrix, lrm="inflate", progress=False
    )
    axis = np.random.default_rng(1000 + seed).normal(size=3)
    in_photo = photo.camera_from_object.to_numpy()
    turned = rotation_from_vector(np.deg2rad(angle) * axis / np.linalg.norm(axis)) @ in_photo.rotation
    frame = problems.make_frame(1000 + seed, rotation=turned)
    view, camera_from_crop = frame_turned(frame.rgb, frame.depth, frame.mask, frame.matrix, resolution=112)
    truth = frame.camera_from_object.to_numpy()
    # The photo's reference view looks at the object, and its unit is taken from the query: it is of the same object.
    reference, record = made.templates.reference, made.info.reference
    assert reference is not None and record is not None
    turn = np.asarray(reference.camera_from_object.rotation, np.float64) @ record.rotation.T
    larger = truth.scale / in_photo.scale
    seen = Similarity(turn @ in_photo.rotation, larger * (turn @ in_photo.translation), truth.scale)
    return PhotoPair(
        made.templates,
        made.info,
        _look(ENCODER, view),
        frame,
        camera_from_crop.to_numpy().inverse() @ truth,
        seen,
    )


def estimate_at_the_truth(pair: PhotoPair, larger: float | None = None) -> tuple[PoseEstimate, float]:
    """What is estimated by the true camera of the photo, and how far behind its guessed place the object then is (m).

    ``larger``: a size is given, so many times that which fits.
    """
    camera = pair.reference_from_query
    turn, shift = (jnp.asarray(x, jnp.float32) for x in (camera.rotation, camera.translation))
    depth = splat_query(pair.reference, pair.query, turn, shift, measure_sight(pair.reference, pair.query))[1]
    unit, front, _ = metres_per_unit(pair.reference, depth)
    if larger is None:
        return make_estimate(query_from_object(pair.reference, turn, shift, unit)), 0.0
    behind = (1 - larger) * unit * front
    pose = query_from_object(pair.reference, turn, shift, larger * unit, behind)
    return dataclasses.replace(make_estimate(pose), scale_std=jnp.asarray(0.0)), float(behind)

"""The records that flow through ipjax, in the order in which they arise.

Every record is an Equinox module: a pytree of arrays, so it can be jitted, vmapped and donated. ``*b`` stands for
whatever was vmapped over. Frames: ``object`` is the normalised mesh (bounding-box centre at the origin, diameter 1),
``camera`` has OpenCV axes (x right, y down, z ahead) and metres.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ipjax.transforms import Similarity

UNNAMED = "unnamed"  # the identity of an encoder that was given none


class Camera(eqx.Module):
    """A pinhole camera without distortion; the centre of the first pixel is at (0, 0), as in OpenCV and BOP."""

    focal: Float[Array, "*b 2"]  # pixels, (x, y)
    centre: Float[Array, "*b 2"]  # pixels, (x, y)

    @staticmethod
    def from_matrix(K: Float[Array, "*b 3 3"] | Float[np.ndarray, "*b 3 3"]) -> "Camera":
        """Of ``[fx 0 cx; 0 fy cy; 0 0 1]``, pixels; in float32. A skew is left out."""
        return Camera(
            focal=jnp.stack([jnp.asarray(K[..., i, i], jnp.float32) for i in (0, 1)], axis=-1),
            centre=jnp.asarray(K[..., :2, 2], jnp.float32),
        )

    def to_matrix(self) -> Float[np.ndarray, "*b 3 3"]:
        """``K = [fx 0 cx; 0 fy cy; 0 0 1]`` in pixels and NumPy's doubles, for the host."""
        focal, centre = np.asarray(self.focal, np.float64), np.asarray(self.centre, np.float64)
        K = np.zeros((*focal.shape[:-1], 3, 3))
        K[..., [0, 1], [0, 1]], K[..., :2, 2], K[..., 2, 2] = focal, centre, 1
        return K


class View(eqx.Module):
    """One RGB-D image: a rendered template or a crop of the scene."""

    rgb: Float[Array, "*b h w 3"]  # [0, 1]
    depth: Float[Array, "*b h w"]  # along z; metres (query) or model units (template); 0 = unknown
    mask: Bool[Array, "*b h w"]  # the object
    camera: Camera


class Patches(eqx.Module):
    """What the encoder made of a view: a feature and a 3-D point for each patch."""

    features: Float[Array, "*b p c"]  # unit norm
    points: Float[Array, "*b p 3"]  # in the owner's frame: object (model units) or camera (metres)
    grid: Float[Array, "*b p 2"]  # (column, row), in patches
    valid: Bool[Array, "*b p"]  # on the object, with a depth
    # The ``identity`` of the encoder that described the view, with its weights' hash; None = not known, not compared.
    encoder: str | None = eqx.field(static=True, default=None)


class Surface(eqx.Module):
    """Points sampled evenly on the object's surface."""

    points: Float[Array, "*b n 3"]  # model units
    normals: Float[Array, "*b n 3"]  # unit, outwards
    seen: Float[Array, "*b n"]  # 1 = measured or observed, 0 = guessed by the reconstruction
    # Of an object from a photo, how far the point may be off along the photo's ray and across it: standard deviations,
    # model units, as measured for the way it was made (`ipjax.files.objects.deviations`). None = a scan.
    along_std: Float[Array, "*b n"] | None = None
    across_std: Float[Array, "*b n"] | None = None


class Appearance(eqx.Module):
    """A dense sample of the surface with its colours, from which the object is drawn at any pose."""

    points: Float[Array, "*b m 3"]  # model units
    normals: Float[Array, "*b m 3"]  # unit, outwards
    colours: Float[Array, "*b m 3"]  # [0, 1]


class ReferenceView(eqx.Module):
    """The photo that an object was made from: its colours and directions are true.

    Where its depth is a guess, a patch of it and a patch of the query, whose depth was measured, are a ray of the
    photo's camera and a point in space: with enough of them the photo's camera is found, and with it the object,
    whatever its guessed shape. Where its depth was measured, poses are found by the object's surface, and the photo
    tells which is right: of the surface that both saw, not of what was guessed behind it.
    """

    view: View  # a crop that looks at the object, the rest black; depth of the reconstruction's front, model units
    patches: Patches  # of that view: features centred as the templates' are, points in the object frame
    camera_from_object: Similarity  # scale 1, model units
    measured: bool = eqx.field(static=True, default=False)  # the depth, not guessed


class Templates(eqx.Module):
    """An onboarded object: rendered views as patches, their poses, and its surface.

    Points are in the normalised object frame, so one model unit is one diameter and the scale of an estimated
    ``camera_from_object`` is the object's diameter in metres.
    """

    patches: Patches  # leading axes *b v; features centred: see ``ipjax.estimation.features.centre``
    mean: Float[Array, "*b c"]  # of the object's features, subtracted from each of them
    norm: Float[Array, "*b v p"]  # of each remainder; raw feature = norm · feature (@ basis) + mean
    seen: Float[Array, "*b v p"]  # share of the patch's surface that was seen, not guessed
    camera_from_object: Similarity  # leading axes *b v; scale 1, model units
    camera: Camera  # of each template, leading axes *b v; pixels of the rendered image
    surface: Surface
    extents: Float[Array, "*b 3"]  # sides of the axis-aligned bounding box, model units
    axes: Float[Array, "*b 3 3"]  # rows: unit axes of the smallest box around the object, about which it may look alike
    basis: Float[Array, "*b f c"] | None = None  # rows: the principal directions that features were cut to
    appearance: Appearance | None = None  # with it and the encoder, candidates are drawn and compared
    reference: ReferenceView | None = None  # of an object from a photo: its pose is found, or chosen, through it
    # Where the camera stood of the photo that a mesh from elsewhere was made from, model units; what it did not see, an
    # image-to-3D model invented.
    photo_centre: Float[Array, "*b 3"] | None = None


class Query(eqx.Module):
    """The crop of the scene, ready to be matched."""

    patches: Patches
    view: View  # the crop itself: its depth and mask serve refinement and scoring


class Matches(eqx.Module):
    """Patch correspondences between the query and its best templates; templates and pairs both best first."""

    ranking: Float[Array, "*b m"]  # of all templates; higher is better
    view: Int[Array, "*b v"]  # the templates kept
    query: Int[Array, "*b v k"]  # patch index
    template: Int[Array, "*b v k"]
    distance: Float[Array, "*b v k"]  # cyclic distance in patches (Eq. 4); inf = no match
    similarity: Float[Array, "*b v k"]  # cosine


class Pairs(eqx.Module):
    """3-D to 3-D correspondences."""

    object: Float[Array, "*b k 3"]  # model units
    camera: Float[Array, "*b k 3"]  # metres
    weight: Float[Array, "*b k"]  # [0, 1]; 0 = absent


class Hypotheses(eqx.Module):
    """Candidate poses, best first."""

    camera_from_object: Similarity  # leading axes *b h
    score: Float[Array, "*b h"]  # higher is better; [0, 1]


class Agreement(eqx.Module):
    """How well a pose explains the query, part by part; each but `colour` in [0, 1], 0 where nothing is scored."""

    depth: Float[Array, "*b"]  # share of what is seen whose depth agrees
    features: Float[Array, "*b"]  # cosine of the nearest templates' patches, carried into the query
    drawn: Float[Array, "*b"]  # cosine of the features of the object drawn at the pose; 1 where it was not drawn
    colour: Float[Array, "*b"]  # correlation of colours drawn and observed, in [-1, 1]; 0 where it was not drawn
    seen: Float[Array, "*b"]  # share of the visible surface that its reconstruction saw, not guessed; 1 for scans
    rival: Float[Array, "*b"]  # score of the best pose that differs from this one, as a share of this one's


class PoseEstimate(eqx.Module):
    """The answer, and what it rests on."""

    camera_from_object: Similarity  # metres from model units; the scale is the object's diameter in metres
    confidence: Float[Array, "*b"]  # [0, 1]: the probability that the pose is right (``confidence.probability``);
    # where candidates are not scored (the paper's method) the share of pairs that agree
    present: Bool[Array, "*b"]  # confident enough that the object is here; without it the pose is a guess
    covariance: Float[Array, "*b 6 6"]  # of rotation (rad, about the object's centre) and translation (m), camera axes
    # The object's diameter, metres, and lowest and highest corner of its box along the object's axes, model units: the
    # scale and the templates' own; of an object from a photo without depth with what the query measured of it.
    diameter: Float[Array, "*b"]
    box: Float[Array, "*b 2 3"]
    scale_std: Float[Array, "*b"]  # standard deviation of the diameter, metres; 0 where the size was given
    ambiguity: Float[Array, "*b 3"]  # the object's axis about which the rotation is least certain; length = std in rad
    agreement: Agreement  # what the confidence rests on
    hypotheses: Hypotheses  # the alternatives, the answer first
    view: Int[Array, "*b"]  # the template whose pairs agree best with the answer
    view_score: Float[Array, "*b v"]  # of every template; higher is better
    inliers: Int[Array, "*b"]  # pairs of that view within the threshold
    rmse: Float[Array, "*b"]  # of those pairs, metres
    success: Bool[Array, "*b"]  # a pose was found at all: enough pairs, not degenerate

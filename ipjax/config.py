"""Every default once, with its unit and where it comes from.

A field marked ``static`` fixes a shape or picks a code path; changing it compiles again. All others are traced and can
be swept without a second trace. ``Config()`` is the best known so far, ``Config.paper()`` the paper's method.
"""

import dataclasses
from typing import Literal

import equinox as eqx


def _static(default, least: int = 0):
    """A field that fixes a shape or picks a code path; a whole number is at least ``least``."""
    return eqx.field(static=True, default=default, metadata={"least": least})


class DescribeConfig(eqx.Module):
    """From a view to its patches."""

    cover: float = 0.2  # least share of a patch that must be object with a depth
    spread: float = 0.05  # depths that differ from their patch's median by a larger share of it are left out


class MatchConfig(eqx.Module):
    """From patches to pairs (Eq. 1–5)."""

    ranking: Literal["cyclic", "cosine"] = _static("cosine")  # views by Eq. 5, or by the cosines of short cycles
    centred: bool = _static(True)  # compare features without the object's mean feature; the paper does not
    views: int = _static(8, least=1)  # templates whose pairs are kept
    pairs: int = _static(256, least=3)  # most pairs of each (the paper's K)
    cycle: float = 1.5  # longest cycle of a pair, patches; inf in the paper
    memory_bytes: int = _static(64 * 2**20, least=1)  # bound on the similarities held at once
    shortlist: int | None = _static(
        None, least=1
    )  # templates that are searched patch by patch, those most similar by pooled features; None = all


class AlignConfig(eqx.Module):
    """From pairs to similarities (Algorithm 1, corrected)."""

    count: int = _static(1024, least=1)  # minimal sets per view
    size: int = _static(3, least=3)  # pairs in one
    rank: Literal["msac", "count"] = _static("msac")
    keep: int = _static(1, least=1)  # hypotheses kept per view
    refits: int = _static(3)
    threshold: float = 0.08  # residual of an inlier, in diameters: about one patch
    scale_gate: tuple[float, float] = (0.5, 2.0)  # around the size seen in the mask and depth
    edge_ratio: float = 0.5  # least ratio of a sample's edge lengths after the scale prior


class RefineConfig(eqx.Module):
    """From a coarse similarity to one that fits the depth image."""

    steps: int = _static(12)  # of Levenberg and Marquardt; 0 = no refinement, as in the paper
    points: int = _static(256, least=1)  # surface points per direction of the association
    reach: float = 0.06  # associations farther than this are dropped, in diameters
    width: float = 0.03  # of the robust loss, in diameters
    silhouette: int = _static(96)  # points on the mask's border that the silhouette is fitted to
    silhouette_reach: float = 0.1  # silhouettes farther from the border than this are dropped, in diameters
    silhouette_width: float = 0.02  # of the robust loss on the distance between them, in diameters
    silhouette_weight: float = 1.6  # relative to 1 for each direction of the depth association
    settle: bool = _static(True)  # at the end refine once more, for errors of the mesh (``refinement.settle``)
    strain: float = 0.05  # standard deviation of errors in the mesh's proportions, a share
    gain: float = 0.2  # least share of the cost that changed proportions must save, else they are kept
    forgiveness: float = 4.0  # width of the losses relative to the standard deviation of the mesh's surface
    pairs: int = _static(64)  # best pairs of each view, which constrain the pose of an uneven surface
    pair_width: float = 0.08  # of the robust loss on their distance, in diameters: about one patch
    pair_weight: float = 4.0  # of all pairs together, relative to 1 for each direction of the depth association


class ScoreConfig(eqx.Module):
    """Which hypothesis explains the query best."""

    ranking: Literal["inliers", "render"] = _static("render")
    resolution: int = _static(56, least=1)  # pixels on a side of the depth comparison
    views: int = _static(5)  # templates, nearest in viewpoint, whose features are compared
    spread: float = 0.52  # how fast their weight falls with the angle to the hypothesis, rad (30°)
    power: float = 2.0  # of the agreement with the templates' features; that of the object drawn has 1
    tolerance: float = 0.05  # depth difference that still agrees, in diameters
    drawn: int = _static(6)  # best candidates that are drawn and compared again, if there is an encoder; 0 = none
    depth_power: float = 0.5  # of the depth agreement of a drawn candidate
    colour_weight: float = 0.5  # a drawn candidate's score is multiplied by exp(this · (correlation − 1))
    guess: float = 0.5  # agreement in features assumed of surface that is guessed, for drawn candidates
    # The share by which that replaces what surface shows that an image-to-3D model invented. Of made objects more
    # right poses were lost the more it was (``python -m benchmarks.reconstructions made``): it often looks right.
    invented: float = 0.0
    apart: float = 0.09  # candidates closer than this angle (rad) and 0.03 diameters count as one
    alternates: int = _static(2)  # best hypotheses that are also tried turned by 90° and 180° about the box's axes


class ResectConfig(eqx.Module):
    """From a photo without depth to its camera among the query's points (``estimation.photo.resection``)."""

    views: int = _static(12, least=1)  # of the object whose pairs are kept
    pairs: int = _static(256, least=3)  # most pairs of each
    beside: int = _static(6)  # directions beside its own from which the query is drawn to be matched, too
    tilt: float = 0.7  # rad (40°): by which they are turned
    count: int = _static(1024, least=1)  # minimal sets of each
    keep: int = _static(4, least=1)  # hypotheses of each
    apart: float = 0.21  # rad (12°): hypotheses closer than this count as one
    threshold: float = 0.06  # of an inlier, in diagonals of the photo's outline
    width: float = 0.03  # of the robust loss, likewise
    scale_gate: tuple[float, float] = (0.45, 2.2)  # around the size that the areas of both outlines tell
    steps: int = _static(10)  # of Gauss and Newton
    drawn: int = _static(12, least=1)  # hypotheses of all views that are drawn; of photos with depth, poses
    polished: int = _static(4)  # best of them that are refined on what their drawings match, and on their colours
    rounds: int = _static(2)  # of it
    starts: int = _static(4)  # poses beside each from which colours are aligned with the photo's, too
    away: float = 0.2  # rad (11°): by which they are turned
    patches: float = 0.1  # weight of what patches matched while colours are aligned
    unlike: float = 2.0  # a drawing's score is multiplied by exp(−this · how unlike its contrasts are)
    window: float = 2.0  # patches in which it is
    softness: float = 0.05  # cosine by which a patch nearby must be less alike to count 1/e as much
    cover: float = 0.3  # least share of a patch that must be drawn
    # Standard deviation of the guessed distance from the front to the centre, in diameters, where the surface does not
    # say how far its points may be off.
    guess: float = 0.1
    # By which share of that of its points the whole back may be off; fitted to sizes of rendered pairs (seeds 1 and 7).
    reach: float = 0.8
    independent: float = 20.0  # number of independent pairs; not fitted to real images
    noise: float = 0.15  # standard deviation of a match that fits perfectly, patches


class ConfidenceConfig(eqx.Module):
    """From agreement to a probability and a covariance; most of it fitted by ``python -m benchmarks.calibration``."""

    drawn: tuple[float, ...] = (2.04, 0.94, 1.15, 2.37, 5.92, 0.0, -2.04)  # see ``confidence.probability``
    undrawn: tuple[float, ...] = (7.84, 1.51, 6.84, 0.0, 0.0, 1.23, -3.77)  # where no candidate was drawn
    photo: tuple[float, ...] = (6.7, 0.0, 2.59, 1.95, 7.69, 0.0, -4.81)  # of objects from a photo without depth
    # By how much the logit falls where an image-to-3D model invented all that is in view: the least at which no wrong
    # pose of made objects was called present (``python -m benchmarks.reconstructions made``).
    invented: float = 1.0
    least: float = 0.5  # confidence below which ``present`` is False
    independent: float = 9.84  # number of independent residuals of refinement
    pair_share: float = 0.0239  # share of the pairs that are independent
    tie: float = 0.05  # how fast an alternative's weight falls with the share by which its score is lower; not fitted


class Config(eqx.Module):
    """The settings of :func:`ipjax.estimate`."""

    match: MatchConfig = MatchConfig()
    align: AlignConfig = AlignConfig()
    refine: RefineConfig = RefineConfig()
    resect: ResectConfig = ResectConfig()
    score: ScoreConfig = ScoreConfig()
    confidence: ConfidenceConfig = ConfidenceConfig()

    @staticmethod
    def fast() -> "Config":
        """Fewer hypotheses, none of them turned, few drawn, no ``settle``: confuses front and back more often."""
        return Config(
            match=MatchConfig(views=6),
            refine=RefineConfig(steps=8, settle=False),
            resect=ResectConfig(beside=4, views=8, count=512, drawn=4, polished=1, rounds=1),
            score=ScoreConfig(alternates=0, drawn=3),
        )

    @staticmethod
    def named(name: str) -> "Config":
        """One of the presets: ``default``, ``fast`` or ``paper``.

        Raises ValueError: another name.
        """
        if name not in PRESETS:
            raise ValueError(f"there are no settings {name!r}; there are {', '.join(PRESETS)}")
        return {"default": Config, "fast": Config.fast, "paper": Config.paper}[name]()

    @staticmethod
    def paper() -> "Config":
        """The paper's choices, its misprints corrected: K = 50, Eq. 5, one view, four-point samples, no gate."""
        return Config(
            match=MatchConfig(ranking="cyclic", centred=False, views=1, pairs=50, cycle=float("inf")),
            align=AlignConfig(
                count=1000,
                size=4,
                rank="count",
                keep=1,
                refits=1,
                threshold=0.08,
                scale_gate=(0.0, float("inf")),
                edge_ratio=0.0,
            ),
            refine=RefineConfig(steps=0),
            score=ScoreConfig(ranking="inliers"),
        )


class DetectConfig(eqx.Module):
    """Finding objects without a mask (`ipjax.Detector`)."""

    views: int = _static(128, least=1)  # templates of each object, the farthest apart, that poses are sought with
    zoom: int = _static(2, least=1)  # all proposals are first described at 1 / this of a crop's size
    shortlist: int = _static(8, least=1)  # proposals that are then described in whole crops and ranked again
    alike: int = _static(3, least=1)  # templates whose similarity to a crop is averaged
    colour: float = 0.5  # weight of colours beside whole features and features by cells, which have 1 each
    verified: int = _static(4, least=1)  # proposals whose pose is estimated, of each object; two more for each instance
    clicked: int = _static(8, least=1)  # the same of those at a click, which are much alike
    mended: int = _static(2, least=1)  # of their poses that give a mask, in which it is estimated again; likewise
    same: float = 0.1  # poses whose surfaces lie on average within this, in diameters, are of one instance
    tolerance: float = 0.05  # depth off the posed object's by more than this is not the object's; diameters
    least_tolerance: float = 0.008  # metres: the same, for small objects
    guessed_tolerance: float = 0.15  # diameters: the same, for shapes guessed from a photo
    taken: float = 0.5  # share of the smaller of two masks beyond which they are of one thing
    size_deviation: float = 0.08  # of the logarithm of a size that was found, where the true one is known
    # In the place of `ConfidenceConfig.drawn`: most of what is sought is not there, and masks of poses are rougher than
    # given ones (``python -m benchmarks.detection_confidence``).
    drawn: tuple[float, ...] = (1.36, 0.85, 1.91, 3.08, 6.07, 0.0, -1.76)
    instances: int = _static(8, least=1)  # most instances of an object where all are asked for

    def with_confidence(self, config: Config) -> Config:
        """Settings of estimates in masks that were found, with the confidence of detections."""
        return dataclasses.replace(config, confidence=dataclasses.replace(config.confidence, drawn=self.drawn))


class GraspConfig(eqx.Module):
    """From a pose and a surface to grasps (`ipjax.plan_grasps`)."""

    grasps: int = _static(32, least=1)  # that are handed out, best first
    anchors: int = _static(512, least=1)  # surface points at which a partner on the other side is sought
    pairs: int = _static(128, least=1)  # of those found that are kept
    approaches: int = _static(12, least=1)  # directions about the closing axis from which each is tried
    tried: int = _static(768, least=1)  # hands that are closed on the object
    distinct: int = _static(64, least=1)  # best of them, unlike each other, that are tried at other poses, too
    poses: int = _static(16)  # within the estimate's uncertainty; 0 = the estimate alone
    cone: float = 0.45  # rad (26°): largest angle between a surface and a pad that does not slip: friction 0.48
    facing: float = 0.7  # least cosine between a pad and surface that supports it
    depth: float = 0.003  # m: by which a pad gives way; surface farther behind does not support it
    support: float = 0.5  # share of a pad that is surface which faces it, above which more is no better
    least_support: float = 0.2  # below which it is no grasp: the lip of a can
    least_spare: float = 0.002  # m, each finger: below which it is no grasp
    # m, each finger: below which a grasp is penalised where the estimate is certain: what hand-eye calibration and the
    # arm are off. Of simulated picks with less, 4 of 11 failed.
    spare: float = 0.016
    spare_deviations: float = 3.0  # of the estimate along the closing axis, by which more is wanted
    tight: float = 0.2  # a score is multiplied by this where nothing is to spare
    unseen: float = 0.3  # and by 1 − this where the pads touch surface that was guessed
    unknown: float = 0.5  # and by 1 − this where a tenth of the hand's way is out of sight behind something else
    aslant: float = 0.3  # and by 1 − this at an approach against the wanted one
    arm: float = 0.08  # m from the centre of the surface, sideways, at which it is multiplied by exp(−½)
    tilt: float = 3.2  # rad: largest angle between the approach and straight down; above π there is no limit
    clearance: float = 0.003  # m between the hand and the table
    retreat: float = 0.1  # m: the straight way of the hand to the object, which is free
    margin: float = 0.01  # m by which the hand may lie behind measured depth: noise
    behind: float = 0.1  # m behind measured depth up to which the hand collides: things are about as thick
    apart: tuple[float, float] = (0.01, 0.26)  # m and rad: grasps closer than both are one


class DecisionConfig(eqx.Module):
    """When a planned grasp is tried (`ipjax.robot.grasps.decision`); made by ``python -m benchmarks.grasp_rule``."""

    # The logarithm of the odds of success of a grasp: a constant, and what is added for each feature (`FEATURES`).
    weights: tuple[float, ...] = (-2.806, 1.743, 0.076, 0.0, 2.597, -0.591)
    grasp: float = 0.5  # least probability of success at which it is tried: more likely than not
    least_elevation: float = 0.4  # rad above the table, from which another look may be had
    most_elevation: float = 1.4  # rad
    away: float = 0.35  # rad: least turn about the object from the present view to another look
    reach: float = 0.85  # m from the robot's base, farther than which it holds no camera
    rough: float = 0.25  # of the variance that a look does not lower: how much of what is guessed it leaves


PRESETS = ("default", "fast", "paper")


class OnboardConfig(eqx.Module):
    """From a mesh to templates; one from a photo without depth has the photo's views (`onboarding.photo_views`)."""

    directions: int = _static(40, least=1)  # viewpoints on the Fibonacci sphere
    rolls: int = _static(10, least=1)  # in-plane rotations of each; 40 × 10 is the paper's 400
    resolution: int = _static(224, least=1)  # pixels on a side
    fill: float = _static(0.83)  # share of the image that the object's box takes: 20 % of padding around it
    distance: float = _static(3.0)  # diameters from the camera to the object's centre
    surface: int = _static(2048, least=1)  # points sampled on the surface
    channels: int = _static(0)  # principal directions that features are cut to; 0 = whole features
    appearance: int = _static(65536)  # coloured points to draw candidates from; 0 = none
    describe: DescribeConfig = DescribeConfig()

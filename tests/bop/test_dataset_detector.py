"""A detector over the frames of a data set: as many as the targets name are sought, and files of masks are written."""

import dataclasses
import shutil

import equinox as eqx
import jaxtyping
import numpy as np
import pytest
from builders import detections
from builders.tiny_pipeline import TINY

from ipjax.bop.detections import read_detections
from ipjax.bop.detector import DatasetDetector, join_detections
from ipjax.bop.objects import OnboardedObject
from ipjax.bop.records import Frame, Target
from ipjax.config import DetectConfig
from ipjax.detection.assignment import overlap
from ipjax.files.objects.saving import save
from ipjax.synthetic.problems import CoordinateEncoder, make_encoder


class Named(CoordinateEncoder):
    """The tests' encoder with an identity, as object files want it."""

    identity: str = eqx.field(static=True, default="coordinates")


@pytest.fixture(scope="module")
def sought(tmp_path_factory):
    """A detector of the ellipsoid as object 4, whose mesh file is in millimetres, and the folder it writes to."""
    folder = tmp_path_factory.mktemp("sought")
    plain = make_encoder()
    templates, info = detections.ellipsoid()
    # Its mesh is 200 mm long.
    save(folder / "four.ipjax", templates, dataclasses.replace(info, encoder="coordinates", mesh_scale=1 / 200))
    encoder = Named(plain.frequencies, plain.phases)
    settings = DetectConfig(views=80, verified=3)
    objects = {4: OnboardedObject(4, folder / "four.ipjax")}
    jaxtyping.config.update("jaxtyping_disable", True)  # its encoder is none of DINOv2's
    try:
        made = DatasetDetector(objects, encoder, TINY, detection=settings, folder=folder / "masks")
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    return made, folder


def as_frame(made: detections.MadeFrame, image: int) -> Frame:
    return Frame(made.rgb, made.depth, detections.MATRIX, 7, image)


def test_as_many_are_found_as_there_are_targets(sought):
    estimator, folder = sought
    made = detections.make_frame(detections.place(-0.12, 0.0, seed=1), detections.place(0.12, 0.02, seed=2))
    found = estimator(as_frame(made, 0), [Target(4), Target(4)])
    assert [one.obj_id for one in found] == [4, 4] and found[0].score >= found[1].score
    for pose in made.poses:
        distances = [np.linalg.norm(one.translation_m - np.asarray(pose.translation)) for one in found]
        assert min(distances) < 0.02
    # Metres per metre of the model, which is as long as the made one.
    assert all(abs(one.scale - 1) < 0.15 for one in found)
    assert len(estimator(as_frame(made, 1), [Target(4)])) == 1
    shutil.copy(folder / "masks" / "000007_000001.json", folder / "masks" / "000008_000001.json")  # of a run before
    path = join_detections(folder / "masks", folder / "all.json", [(7, 1), (7, 0), (7, 5)])
    written = read_detections(path)
    assert [(one.scene_id, one.im_id, one.obj_id) for one in written] == [(7, 0, 4), (7, 0, 4), (7, 1, 4)]
    for mask in made.masks:
        assert max(overlap(one.mask, mask) for one in written[:2]) > 0.8
    assert all(one.time > 0 for one in written)


def test_what_is_not_found_is_told_and_settings_name_the_detection(sought):
    estimator, _ = sought
    bare = detections.make_frame()
    before = len(estimator.refused)
    estimator(dataclasses.replace(as_frame(bare, 2), depth=None), [Target(4)])
    assert estimator.refused[before:] == ["scene 7, image 2: no depth image"]
    settings = estimator.settings()
    assert settings["detection"]["verified"] == 3 and not settings["everything"]
    assert settings["objects"]["4"]["notes"] == [] and "masks were not given but found" in estimator.notes

"""The page of a search says of every object what became of it, and of every proposal that was tried why."""

import base64
import dataclasses
import re

import cv2
import numpy as np
import pytest
from builders.detections import MATRIX, ellipsoid, make_frame, place
from builders.estimates import make_estimate

import ipjax
from ipjax.detection.crops import Scene
from ipjax.detection.explanation.page import explain
from ipjax.detection.explanation.pictures import draw_crop, draw_found, draw_proposals
from ipjax.detection.proposals.propose import Proposals
from ipjax.detection.records import Detection, Detections, Ranking, Reason, Rejected, Rival, Step
from ipjax.inference.estimator import Result
from ipjax.records import Query
from ipjax.synthetic import problems

FRAME = make_frame(place(-0.12, 0.0, seed=1), place(0.12, 0.02, seed=2))


def step(mask, confidence: float, posed=None) -> Step:
    return Step("a proposal", mask, confidence > 0, confidence, confidence / 2, 0.2, FRAME.poses[0], posed)


def detection(number: int, name: str, *, present: bool = True, index: int = 0) -> Detection:
    templates, info = ellipsoid()
    estimate = make_estimate(FRAME.poses[number], present=present)
    query = Query(templates.patches, problems.make_view(place(0.0, 0.0), 32))
    result = Result(estimate, estimate, query, templates, dataclasses.replace(info, name=name), {})
    mask = FRAME.masks[number]
    return Detection(index, name, mask, (10, 20, 30, 40), 0.4, result, number, 1.9, 0.81, (step(mask, 0.8, mask),))


def search() -> Detections:
    """Two objects and a third that no proposal was like; a name that is no HTML."""
    name = "<b>tin & co"
    proposals = Proposals(
        np.stack([*FRAME.masks, FRAME.masks[0] & np.tri(*FRAME.masks[0].shape, dtype=bool)]), np.ones(3)
    )
    found = detection(0, name), detection(1, name, present=False), detection(1, "mug", present=False, index=1)
    rival = Rival(1, "mug", 1, 0.66)
    words, mask = "its pixels are taken by mug, which is surer", proposals.masks[2]
    lost = Rejected(0, name, 2, 1.2, words, Reason.CLAIMED, rival, 0.3, 0.1, mask, (step(mask, 0.3),))
    nowhere = Rejected(
        1,
        "mug",
        0,
        1.1,
        "no pose was found",
        Reason.NO_POSE,
        None,
        0.0,
        0.0,
        FRAME.masks[0],
        (step(FRAME.masks[0], 0.0),),
    )
    rankings = (
        Ranking(0, name, np.array([0, 1, 2]), np.array([1.9, 1.5, 1.2]), 2, 2),
        Ranking(1, "mug", np.array([1, 0]), np.array([1.4, 1.1]), 2, 2),
    )
    scene = Scene(FRAME.rgb, FRAME.depth, MATRIX)
    about = proposals, np.zeros((3, 3)), scene, {"propose": 1.5, "verify": 4.5}, (name, "mug", "pan"), rankings
    return Detections(found, (lost, nowhere), *about, clicks=((160.0, 120.0),))


def test_a_page_says_what_became_of_everything(tmp_path):
    found = search()
    ipjax.explain(tmp_path / "why.html", found, "frame 7")
    page = (tmp_path / "why.html").read_text()
    assert "<b>tin" not in page and "&lt;b&gt;tin &amp; co" in page
    for words in (
        "<title>frame 7",
        "3 objects sought without a mask, 1 instance found; 3 proposals, 3 of them tried, 6.0 s",
        "found, with a confidence of 0.80",
        "its pixels are taken by mug, which is surer (proposal 1, confidence 0.66)",
        ">claimed<",
        ">no pose<",
        ">unsure<",  # the second, unsure instance of the first object
        "not here, or not seen well enough: the best guess has a confidence of 0.80",
        "estimate poses in proposals</td><td>4.50 s",
        "Click: 160, 120.",
    ):
        assert words in page, words
    assert page.index("<h2>pan") < page.index("There was no proposal to compare it with")
    assert page.count('class="accepted"') == 1  # of all pictures of rankings: a guess is not accepted
    pictures = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    assert len(pictures) == page.count("<img ")
    shapes = [cv2.imdecode(np.frombuffer(base64.b64decode(one), np.uint8), 1).shape for one in pictures]
    assert shapes[:2] == [(900, 1200, 3)] * 2 and set(shapes[2:]) == {(160, 160, 3)}
    with pytest.raises(OSError, match="nowhere"):
        explain(tmp_path / "nowhere" / "why.html", found)


def test_what_is_told_keeps_one_guess_of_each_object():
    told, rejected = search().told()
    assert [(one.name, one.present) for one in told] == [("<b>tin & co", True), ("mug", False)]
    assert [one.why for one in rejected] == [Reason.CLAIMED, Reason.NO_POSE, Reason.UNSURE]
    rival = rejected[-1].rival
    assert rival is not None and (rival.index, rival.proposal) == (0, 0) and rival.confidence == pytest.approx(0.8)


def test_pictures_show_what_they_are_of():
    found = search()
    plain = draw_found(found.scene, [])
    shown = draw_found(found.scene, found.told()[0])
    assert shown.shape == plain.shape == (900, 1200, 3)
    assert draw_found(found.scene, [detection(0, "a name\nof two lines")]).shape == plain.shape
    inside = cv2.dilate(cv2.resize(FRAME.masks[0].astype(np.uint8), (1200, 900)), np.ones((9, 9))) > 0
    assert np.abs(shown.astype(int) - plain)[inside].mean() > 5
    masks = found.proposals.masks
    without, with_click = draw_proposals(FRAME.rgb, masks, [0]), draw_proposals(FRAME.rgb, masks, [0], [(5.0, 5.0)])
    changed = np.argwhere((without != with_click).any(-1))
    assert np.abs(changed - (20, 20)).max() < 20
    corner = np.zeros(FRAME.masks[0].shape, bool)
    corner[:9, -7:] = True  # what lies beyond the frame is black
    crop = draw_crop(FRAME.rgb, corner)
    assert crop.shape == (160, 160, 3) and not crop[2, -2].max() > 30

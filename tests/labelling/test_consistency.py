"""Poses that cannot be right, and the frames to look at."""

import dataclasses

import numpy as np
import pytest

from ipjax.labelling.merging.consistency import find_collisions, find_jumps
from ipjax.labelling.merging.poses import Poses
from ipjax.labelling.merging.sampling import APART, choose_frames
from ipjax.synthetic.problems import AXES
from ipjax.transforms import Similarity, rotation_from_vector


def ball(count: int = 300) -> np.ndarray:
    unit = np.random.default_rng(0).normal(size=(count, 3))
    return unit / np.linalg.norm(unit, axis=-1, keepdims=True)


SURFACES = {1: ball() * AXES, 2: 0.5 * ball()}  # an ellipsoid, and a ball


def make_poses(turns, places, *, number=1, scene=0, slot=0, present=True) -> Poses:
    """One object, a frame for each turn (rotation vector) and place (metres); 200 mm long."""
    count = len(turns)
    fill = lambda value, dtype: np.full(count, value, dtype)
    return Poses(
        place=np.arange(count),
        scene=fill(scene, int),
        image=np.arange(count),
        number=fill(number, int),
        slot=fill(slot, int),
        present=fill(present, bool),
        confidence=fill(0.9, float),
        margin=fill(0.8, float),
        overlap=fill(np.nan, float),
        camera_from_object=Similarity(
            rotation_from_vector(np.array(turns, float)), np.array(places, float), fill(0.2, float)
        ),
    )


def join(*parts: Poses) -> Poses:
    poses = [part.camera_from_object for part in parts]
    columns = {
        f.name: np.concatenate([getattr(part, f.name) for part in parts])
        for f in dataclasses.fields(Poses)
        if f.name != "camera_from_object"
    }
    turned = (np.concatenate([getattr(pose, name) for pose in poses]) for name in ("rotation", "translation", "scale"))
    return Poses(**columns, camera_from_object=Similarity(*turned))


def led(count: int, speed: float = 0.03):
    """A camera that is led past: turns and places of an object, smooth."""
    steps = np.arange(count)
    return 0.05 * steps[:, None] * [0.0, 1, 0.3], [0, 0, 0.7] + speed * steps[:, None] * [1.0, 0.2, 0]


def test_a_camera_that_moves_makes_no_jumps_however_fast():
    for speed in (0.0, 0.03, 0.3):
        assert find_jumps(make_poses(*led(20, speed)), SURFACES) == ([], [])


@pytest.mark.parametrize("number", [1, 2])
def test_a_pose_that_is_off_its_neighbours_jumps(number):
    turns, places = led(20)
    places[7] += [0.1, 0, 0]
    turns[12] += [2.0, 0, 0]
    jumps, unrelated = find_jumps(make_poses(turns, places, number=number), SURFACES)
    assert unrelated == []
    # A ball that is turned looks as before.
    assert [one.row for one in jumps] == ([7, 12] if number == 1 else [7])
    assert jumps[0].moved == pytest.approx(0.5, abs=1e-6)
    if number == 1:
        assert jumps[1].turned == pytest.approx(2.0, abs=0.1)


def test_only_neighbours_of_one_object_in_one_scene_are_compared():
    turns, places = led(20)
    places[7] += [0.1, 0, 0]
    whole = make_poses(turns, places)
    apart = dataclasses.replace(whole, scene=np.arange(20) // 8, image=whole.image)  # frame 7 is the last of its scene
    assert find_jumps(apart, SURFACES) == ([], [])
    unsure = dataclasses.replace(whole, present=whole.place != 7)
    assert find_jumps(unsure, SURFACES) == ([], [])
    rare = dataclasses.replace(whole, image=10 * whole.image)
    assert find_jumps(rare, SURFACES) == ([], [])
    assert find_jumps(make_poses(*led(2)), SURFACES) == ([], [])


def test_frames_that_do_not_follow_one_another_are_not_judged():
    """Single photos of one scene beside a sequence of another, in which one pose jumps."""
    rng = np.random.default_rng(0)
    photos = make_poses(rng.normal(size=(20, 3)), rng.uniform((-0.3, -0.3, 0.4), (0.3, 0.3, 1), (20, 3)), scene=4)
    turns, places = led(20)
    places[7] += [0.1, 0, 0]
    jumps, unrelated = find_jumps(join(photos, make_poses(turns, places, scene=5)), SURFACES)
    assert unrelated == [4] and [one.row for one in jumps] == [27]


def test_two_objects_in_one_place_collide_and_those_that_touch_do_not():
    turns, places = led(3)
    first = make_poses(turns, places)
    shift = np.array([[0.02, 0, 0], [0.16, 0, 0], [0.5, 0, 0]])
    second = make_poses(turns, places + shift, number=2)
    collisions = find_collisions(join(first, second), SURFACES)
    assert [(one.first, one.second) for one in collisions] == [(0, 3)] and collisions[0].share > 0.3
    guesses = dataclasses.replace(second, present=np.zeros(3, bool))
    assert find_collisions(join(first, guesses), SURFACES) == []


def test_the_frames_to_look_at_are_the_telling_ones():
    count = 60
    turns, places = led(count)
    places[30] += [0.1, 0, 0]
    poses = make_poses(turns, places)
    margin, confidence = poses.margin.copy(), poses.confidence.copy()
    margin[[10, 11, 50]] = 0.02, 0.01, 0.1
    confidence[40] = 0.55
    poses = dataclasses.replace(poses, margin=margin, confidence=confidence)
    jumps, _ = find_jumps(poses, SURFACES)
    chosen = choose_frames(poses, jumps, [], 12)
    reasons = {one.place: one.reason for one in chosen}
    assert len(reasons) == len(chosen) == 12
    assert reasons[30].startswith("jumps") and "margin" in reasons[11] and "margin" in reasons[50]
    assert "confidence 0.55" in reasons[40]
    assert 10 not in reasons or "chance" in reasons[10]  # it is beside frame 11, which says the same
    assert sum("chance" in reason for reason in reasons.values()) == 8
    by_chance = sorted(place for place, reason in reasons.items() if "chance" in reason)
    assert (np.diff(by_chance) >= APART).all()
    assert chosen == choose_frames(poses, jumps, [], 12) and choose_frames(make_poses(*led(0)), [], [], 5) == []

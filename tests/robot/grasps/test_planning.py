"""Grasps of objects of known measures: what must hold whatever the object, and the cases that people ask about."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from builders.graspable import (
    HEIGHT,
    approaches,
    closing_axes,
    estimate_of,
    from_above,
    make_bowl,
    make_can,
    make_finned,
    make_graspable,
    on_table,
    pads,
    plan,
    plan_from_above,
)

from ipjax.config import GraspConfig
from ipjax.records import Camera
from ipjax.robot.grasps.planning import box_grasps, plan_grasps
from ipjax.robot.grippers import FRANKA_HAND
from ipjax.robot.records import Workspace, place_grasps
from ipjax.transforms import Similarity, rotation_from_vector

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def box():
    """6 × 12 × 10 cm: only its 6 cm fit into a hand of 8 cm."""
    return make_graspable(trimesh.creation.box((0.06, 0.12, 0.10)))


@pytest.fixture(scope="module")
def cylinder():
    return make_graspable(trimesh.creation.cylinder(0.025, 0.12, sections=96))


def test_a_box_is_grasped_across_its_short_side_only(box):
    found = plan_from_above(box)
    assert len(found.score) == GraspConfig().grasps
    assert (np.abs(closing_axes(found)[:, 0]) > 0.97).all()
    np.testing.assert_allclose(np.asarray(found.width), 0.06, atol=2e-4)
    np.testing.assert_allclose(np.asarray(found.spare), 0.01, atol=2e-4)
    # The pads touch the two faces.
    np.testing.assert_allclose(np.abs(np.asarray(found.contacts)[..., 0]), 0.03, atol=2e-4)
    assert (np.diff(np.asarray(found.score)) <= 0).all()


def test_no_hand_goes_below_the_table(box):
    found = plan_from_above(box)
    assert (approaches(found)[:, 2] <= 1e-3).all()  # none from below
    reach = FRANKA_HAND.finger[0]
    for back in (0.0, 0.1):  # nor on its way
        tips = pads(found) + approaches(found) * (FRANKA_HAND.pad[0] / 2 - back)
        assert (tips[:, 2] > box.low).all() and (tips[:, 2] - approaches(found)[:, 2] * reach > box.low).all()


def test_without_a_table_it_may_come_from_below(box):
    found = plan_with_depth(box, np.zeros((240, 320)), GraspConfig(aslant=0.0))  # no depth is known
    assert (approaches(found)[:, 2] > 0.3).any()


@pytest.mark.parametrize("sides", [(0.2, 0.2, 0.2), (0.078, 0.1, 0.1)])
def test_nothing_wider_than_the_opening(sides):
    # 78 mm fit between pads that are 80 apart, but with less than is asked for on either side.
    assert len(plan_from_above(make_graspable(trimesh.creation.box(sides))).score) == 0


def test_the_width_is_that_of_the_object():
    """Signed errors, for a bias: sampled points lie on the surface, and a curved one's last point not at its end."""
    errors = []
    for radius in (0.008, 0.015, 0.025, 0.035):
        found = plan_from_above(make_graspable(trimesh.creation.cylinder(radius, 0.12, sections=96)))
        upright = np.abs(closing_axes(found)[:, 2]) < 0.1
        assert upright.sum() > 10
        errors.append(np.asarray(found.width)[upright] - 2 * radius)
    together = np.concatenate(errors)
    assert abs(together.mean()) < 3e-4 and np.abs(together).max() < 1.5e-3


def test_a_cylinder_is_the_same_from_all_sides(cylinder):
    found = plan_from_above(cylinder)
    across = closing_axes(found)
    turned = np.arctan2(across[:, 1], across[:, 0]) % np.pi
    assert np.ptp(turned) > 2.4  # of π
    best = np.asarray(found.score)
    assert best[0] - best[10] < 0.05 * best[0]
    # And an uncertain turn about its axis does no harm.
    spun = plan_from_above(cylinder, axis_std=3.0)
    assert (np.asarray(spun.safe) > 0.9).all()
    assert abs(np.asarray(spun.score)[:10].mean() - best[:10].mean()) < 0.05


def test_a_bowl_is_grasped_by_its_rim():
    bowl = make_graspable(make_bowl())
    found = plan_from_above(bowl)
    assert len(found.score) > 10
    assert (np.asarray(found.width) < 0.012).all()  # its wall is 4 mm; across it are 14 cm
    where = pads(found)
    around = np.linalg.norm(where[:, :2], axis=-1)
    assert (around > 0.04).all() and (approaches(found)[:, 2] < -0.5).all()
    # One finger inside, one outside.
    ends = np.linalg.norm(np.asarray(found.contacts)[..., :2], axis=-1)
    assert (np.abs(ends[:, 0] - ends[:, 1]) > 2e-3).all()


def test_the_lip_of_a_can_is_not_enough_for_a_pad():
    # 10 cm wide, so that the lip, 3 mm high, is all that fits between the fingers.
    assert len(plan_from_above(make_graspable(make_can())).score) == 0
    # Of a deeper one there is enough.
    assert len(plan_from_above(make_graspable(make_can(lip=0.03))).score) > 5


def test_the_fingers_clear_a_thin_thing_on_the_table():
    flat = make_graspable(trimesh.creation.box((0.03, 0.12, 0.012)))
    found = plan_from_above(flat)
    assert len(found.score) > 5
    tips = pads(found) + approaches(found) * FRANKA_HAND.pad[0] / 2
    assert (tips[:, 2] > flat.low + 2e-3).all() and (tips[:, 2] < 0.007).all()


def test_what_only_a_fin_offers_is_unsafe_where_the_turn_is_uncertain():
    """The paper's mug: its body is too wide, and where its handle is, is not known."""
    handle = make_graspable(make_finned(0.05))
    sure, unsure = plan_from_above(handle), plan_from_above(handle, axis_std=1.5)
    assert (pads(sure)[:, 0] > 0.045).all() and np.asarray(sure.safe)[:5].min() > 0.8
    assert np.asarray(unsure.safe).max(initial=0) < 0.4
    assert np.asarray(unsure.score).max(initial=0) < 0.5 * np.asarray(sure.score)[0]


def test_a_body_is_grasped_where_the_turn_of_its_fin_is_uncertain():
    mug = make_graspable(make_finned(0.028))
    sure, unsure = plan_from_above(mug), plan_from_above(mug, axis_std=1.5)
    assert (pads(sure)[:, 0] > 0.03).any()  # the fin was among the good ones
    assert (pads(unsure)[:5, 0] < 0.02).all() and (np.asarray(unsure.safe)[:5] > 0.9).all()
    # About another axis nothing is safe.
    tipped = plan_from_above(mug, axis_std=1.0, axis=(1.0, 0.0, 0.0))
    assert np.asarray(tipped.score)[:5].mean() < 0.6 * np.asarray(unsure.score)[:5].mean()


def test_uncertainty_costs_what_is_tight(box):
    slim = make_graspable(trimesh.creation.box((0.03, 0.12, 0.10)))
    best = lambda one, **off: float(np.asarray(plan_from_above(one, **off).score)[:5].mean())
    certain, uncertain = dict(place_std=0.0005), dict(place_std=0.006)
    loss_tight, loss_slim = (best(one, **uncertain) / best(one, **certain) for one in (box, slim))
    assert loss_tight < 0.85 * loss_slim < 0.95
    # With nothing uncertain what has less than 16 mm to spare is penalised, too.
    assert best(box, **certain) < 0.8 * best(slim, **certain)


def test_an_uncertain_size_counts(box):
    sure, unsure = (plan_from_above(box, size_std=std) for std in (0.0, 0.02))
    assert np.asarray(unsure.score)[0] < 0.92 * np.asarray(sure.score)[0]


def test_seen_surface_is_preferred(box):
    # Of a cube both pairs of sides fit; one of them was seen.
    cube = make_graspable(trimesh.creation.box((0.05, 0.05, 0.05)))
    seen = (jnp.abs(cube.surface.normals[:, 0]) > 0.5).astype(jnp.float32)
    half = dataclasses.replace(cube, surface=dataclasses.replace(cube.surface, seen=seen))
    assert (np.abs(closing_axes(plan_from_above(half))[:8, 0]) > 0.97).all()
    # All of it guessed is still grasped, at a lower score.
    none = dataclasses.replace(cube, surface=dataclasses.replace(cube.surface, seen=0 * seen))
    guessed, known = (np.asarray(plan_from_above(one).score)[0] for one in (none, cube))
    assert guessed == pytest.approx(0.7 * known, rel=0.05)


def test_the_scale_is_divided_out(box):
    """The same object in metres or in models' units, on the same table."""
    pose = from_above(box.diameter)
    larger = dataclasses.replace(box.surface, points=box.surface.points * 2)
    smaller = Similarity(pose.rotation, pose.translation, pose.scale / 2)
    args = on_table(box), KEY, GraspConfig()
    first = plan(FRANKA_HAND, box.surface, estimate_of(pose), *args)
    estimate = dataclasses.replace(estimate_of(smaller), diameter=pose.scale)
    second = plan(FRANKA_HAND, larger, estimate, *args)
    np.testing.assert_allclose(np.asarray(first.width), np.asarray(second.width), atol=1e-6)
    np.testing.assert_allclose(np.asarray(first.object_from_gripper.scale), 1)
    placed = place_grasps(first.object_from_gripper, estimate_of(pose))
    np.testing.assert_allclose(np.asarray(placed.scale), 1)
    tips = np.asarray(placed.translation + placed.rotation[..., 2] * FRANKA_HAND.reach)
    assert (np.abs(tips[:, 2] - HEIGHT) < 0.07).all()


def test_object_and_table_move_together(box):
    """A rigid motion of object, table and camera's view changes nothing in the object's frame."""
    motion = Similarity(
        rotation_from_vector(jnp.asarray([0.4, -0.3, 0.2])), jnp.asarray([0.1, -0.05, 0.2]), jnp.asarray(1.0)
    )
    pose, table = from_above(box.diameter), on_table(box).table
    normal = motion.rotation @ table[:3]
    moved_table = jnp.concatenate([normal, table[3:] + jnp.sum(normal * motion.translation)])
    # Nearly exact, for the draws of the uncertainty are in the camera's axes.
    certain = dict(turn_std=1e-5, place_std=1e-6, size_std=1e-6)
    run = lambda pose, table: plan(
        FRANKA_HAND, box.surface, estimate_of(pose, **certain), Workspace(table=table), KEY, GraspConfig()
    )
    first, second = run(pose, table), run(motion @ pose, moved_table)
    # To rounding: the last digits decide between equal grasps, so the sets are compared by what they are worth.
    np.testing.assert_allclose(np.asarray(first.score), np.asarray(second.score), atol=0.02)
    np.testing.assert_allclose(np.asarray(first.width), np.asarray(second.width), atol=1e-4)
    base = place_grasps(first.object_from_gripper, pose), place_grasps(second.object_from_gripper, motion @ pose)
    up = [np.asarray(p.rotation[..., 2]) @ np.asarray(n) for p, n in zip(base, (table[:3], normal), strict=True)]
    assert np.mean(up[0] < -0.99) == pytest.approx(np.mean(up[1] < -0.99), abs=0.15)


def plan_with_depth(one, depth, config=GraspConfig()):
    """The valid grasps of an object seen from above, by a measured depth and without a table."""
    camera = Camera(jnp.asarray([300.0, 300.0]), jnp.asarray([160.0, 120.0]))
    there = Workspace(depth=jnp.asarray(depth, jnp.float32), camera=camera)
    found = plan(FRANKA_HAND, one.surface, estimate_of(from_above(one.diameter)), there, KEY, config)
    return found.take(np.flatnonzero(np.asarray(found.valid)))


def test_what_was_measured_is_in_the_way(cylinder):
    """A wall beside the object: no hand comes from there, or reaches into it; nor from below the floor."""
    floor = np.full((240, 320), HEIGHT - cylinder.low)
    beside = np.arange(320) > 160 + 300 * 0.035 / (HEIGHT - 0.06)  # x > 35 mm
    half = FRANKA_HAND.opening / 2 + FRANKA_HAND.finger[1]
    reaches = lambda found: pads(found)[:, 0] + half * np.abs(closing_axes(found)[:, 0]) > 0.045
    free = plan_with_depth(cylinder, 0 * floor, GraspConfig(aslant=0.0))
    assert (approaches(free)[:, 0] < -0.5).any() and reaches(free).any()
    walled = plan_with_depth(cylinder, np.where(beside, HEIGHT - 0.08, floor), GraspConfig(aslant=0.0))
    assert len(walled.score) > 5 and not reaches(walled).any()
    assert (approaches(walled)[:, 0] > -0.5).all() and (approaches(walled)[:, 2] < 0.3).all()
    # Far behind a high one may be something or nothing: allowed, and worth less.
    high = plan_with_depth(cylinder, np.where(beside, HEIGHT - 0.3, floor), GraspConfig(aslant=0.0))
    hidden = reaches(high)
    assert not hidden[:5].any()
    assert np.asarray(high.score)[hidden].max(initial=0) < 0.85 * np.asarray(high.score)[0]


def test_the_objects_own_depth_is_not_in_the_way(box):
    depth = np.full((240, 320), HEIGHT - box.low)
    rows, columns = np.abs(np.arange(240) - 120)[:, None], np.abs(np.arange(320) - 160)
    depth[(rows < 300 * 0.06 / 0.75) & (columns < 300 * 0.03 / 0.75)] = HEIGHT - 0.05
    found = plan_with_depth(box, depth)
    assert len(found.score) > 20
    assert np.asarray(found.score)[0] == pytest.approx(float(plan_from_above(box).score[0]), rel=0.1)


def test_a_tilt_keeps_the_approach_steep(cylinder):
    pose = estimate_of(from_above(cylinder.diameter))
    found = plan(FRANKA_HAND, cylinder.surface, pose, on_table(cylinder), KEY, GraspConfig(tilt=0.26))
    steep = approaches(found)[np.asarray(found.valid)]
    assert len(steep) > 5 and (steep[:, 2] < -np.cos(0.261)).all()


def test_a_wider_hand_takes_what_another_cannot():
    wide = make_graspable(trimesh.creation.box((0.079, 0.12, 0.10)))
    pose = estimate_of(from_above(wide.diameter))
    for opening, fits in ((0.08, False), (0.09, True)):
        hand = dataclasses.replace(FRANKA_HAND, opening=opening)
        found = plan(hand, wide.surface, pose, on_table(wide), KEY, GraspConfig())
        assert np.asarray(found.valid).any() == fits


def test_what_is_not_finite_is_not_valid(box):
    broken = dataclasses.replace(from_above(box.diameter), translation=jnp.asarray([jnp.nan] * 3))
    found = plan(FRANKA_HAND, box.surface, estimate_of(broken), on_table(box), KEY, GraspConfig())
    assert not np.asarray(found.valid).any()
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(found))


def test_an_estimate_that_failed_or_knows_not_how_sure_it_is_gives_no_grasp(box):
    sure = estimate_of(from_above(box.diameter))
    unknown = dataclasses.replace(sure, covariance=sure.covariance * jnp.nan)
    failed = dataclasses.replace(sure, success=jnp.asarray(False))
    for estimate, count in ((sure, GraspConfig().grasps), (unknown, 0), (failed, 0)):
        found = plan(FRANKA_HAND, box.surface, estimate, on_table(box), KEY, GraspConfig())
        assert np.asarray(found.valid).sum() == count


def test_vmapped_the_papers_are_the_same(box):
    poses = [estimate_of(from_above(box.diameter), turn_std=std) for std in (0.01, 0.05)]
    many, keys = jax.tree.map(lambda *x: jnp.stack(x), *poses), jax.random.split(KEY, 2)
    by_box = jax.jit(jax.vmap(lambda e, k: box_grasps(FRANKA_HAND, box.surface, e, on_table(box), k)))(many, keys)
    alone = TestBox.run(FRANKA_HAND, box.surface, poses[1], on_table(box), keys[1])
    np.testing.assert_allclose(np.asarray(by_box.score[1]), np.asarray(alone.score), atol=1e-4)
    np.testing.assert_allclose(np.asarray(by_box.width[1]), np.asarray(alone.width), atol=1e-5)
    assert np.asarray(by_box.valid).any(axis=1).all()


def test_in_doubles(x64, box):
    """All of it stays in doubles, by strict promotion, and can be vmapped."""
    wide = lambda tree: jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, tree)
    depth, camera = jnp.ones((24, 32)), Camera(jnp.asarray([30.0, 30.0]), jnp.asarray([16.0, 12.0]))
    there = Workspace(table=on_table(box).table, depth=depth, camera=camera)
    pose = estimate_of(from_above(box.diameter))
    # For several keys at once: its shapes are found without compiling it.
    run = jax.vmap(lambda s, e, w, k: plan_grasps(FRANKA_HAND, s, e, w, k), (None, None, None, 0))
    found = jax.eval_shape(run, *wide((box.surface, pose, there)), jax.random.split(jax.random.key(0), 2))
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype(jnp.float64), jnp.dtype(bool)}
    assert found.contacts.shape == (2, GraspConfig().grasps, 2, 3)


def test_too_little_surface_is_refused(box):
    few = jax.tree.map(lambda x: x[:8], box.surface)
    pose = estimate_of(from_above(0.1))
    with pytest.raises(ValueError, match="8 points is too little"):
        plan_grasps(FRANKA_HAND, few, pose, Workspace(), KEY)
    with pytest.raises(ValueError, match="needs its camera"):
        plan_grasps(FRANKA_HAND, box.surface, pose, Workspace(depth=jnp.ones((4, 4))), KEY)


class TestBox:
    """The paper's grasps."""

    run = staticmethod(jax.jit(box_grasps))

    def find(self, one, **off):
        found = self.run(FRANKA_HAND, one.surface, estimate_of(from_above(one.diameter), **off), on_table(one), KEY)
        return found.take(np.flatnonzero(np.asarray(found.valid)))

    def test_closes_on_the_side_that_fits(self, box):
        found = self.find(box)
        assert 2 <= len(found.score) <= 4
        np.testing.assert_allclose(np.abs(closing_axes(found)[:, 0]), 1, atol=1e-5)
        np.testing.assert_allclose(np.asarray(found.width), 0.06, atol=1e-3)
        assert (approaches(found)[:, 2] < 0.01).all()

    def test_goes_as_deep_as_the_fingers_are_long(self):
        tall = make_graspable(trimesh.creation.box((0.04, 0.12, 0.2)))
        found = self.find(tall)
        down = approaches(found)[:, 2] < -0.9
        assert down.any()
        top, palm = 0.1, pads(found)[down, 2] + FRANKA_HAND.reach - 0.0659
        assert (palm > top).all() and (pads(found)[down, 2] < top).all()

    def test_knows_nothing_of_the_shape(self):
        assert len(self.find(make_graspable(make_bowl())).score) == 0

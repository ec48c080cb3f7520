"""An object from a photo without depth is found through the photo: rotation, place and size, without bias.

The whole way of a user: one exact image becomes the object, another the query. The encoder is the stand-in that knows
what it sees from its colours, so that what is measured is geometry.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.compilation import QUICKLY
from builders.photo_objects import CONFIG, encoder, estimate, known, photograph, see

import ipjax
from benchmarks.bias import summary
from ipjax.config import Config
from ipjax.inference.reports import relative_pose
from ipjax.transforms import vector_from_rotation


def errors(made, reference, found, truth, camera_from_crop):
    """Turn (degrees, about the camera's axes), shift of the centre (% of the size) and size (%)."""
    pose = relative_pose(camera_from_crop @ found.camera_from_object.to_numpy(), made.info) @ reference
    turned = np.degrees(np.asarray(vector_from_rotation(pose.rotation @ truth.rotation.T)))
    shift = 100 * (pose.translation - truth.translation) / truth.scale
    return np.array([*turned, *shift, 100 * (pose.scale / truth.scale - 1)])


def run(templates, query, diameter=None, used=encoder, config=CONFIG):
    return estimate(used, templates, query, jax.random.key(0), config, diameter)


def assert_same(one, other, tolerance=1e-3):
    """Every field; depth agrees or not pixel by pixel, and rounding decides some."""
    for name in (field.name for field in dataclasses.fields(one)):
        fields = getattr(one, name), getattr(other, name)
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=tolerance, atol=tolerance), *fields)


def assert_finite(tree):
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        assert np.isfinite(np.asarray(leaf, np.float64)).all(), jax.tree_util.keystr(path)


@dataclasses.dataclass
class Answer:
    """Of one query: what was off, about and along the axes of the photo's ray (x, y across it, z along it)."""

    turn: np.ndarray  # degrees
    shift: np.ndarray  # % of the size
    size: float  # %
    surprise: np.ndarray  # squared Mahalanobis distance of rotation, shift across the ray, shift along it
    spread: np.ndarray


@pytest.fixture(scope="module")
def answers():
    """Forty queries of ten objects, 5° to 30° from the photo."""
    rows = []
    for seed in range(10):
        made, reference, whole = photograph(seed)
        place = whole.camera_from_object.to_numpy()
        photo_from_true = ray_axes(place.translation)
        for number, angle in enumerate((5, 12, 20, 30)):
            query, truth, camera_from_crop = see(10 * seed + number, place.rotation, angle)
            estimated = run(made.templates, query)
            assert bool(estimated.success)
            off = errors(made, reference, estimated, truth, camera_from_crop)
            from_query = photo_from_true @ (truth.rotation @ place.rotation.T).T
            from_crop = np.kron(np.eye(2), from_query @ camera_from_crop.rotation)
            turn, shift = from_query @ off[:3], from_query @ off[3:6]
            spread = from_crop @ np.asarray(estimated.covariance, np.float64) @ from_crop.T
            told = np.concatenate([np.radians(turn), shift / 100 * truth.scale])
            surprise = [told[part] @ np.linalg.solve(spread[part, part], told[part]) for part in PARTS]
            rows.append(Answer(turn, shift, off[6], np.array(surprise), np.asarray(estimated.covariance)))
    return rows


PARTS = slice(0, 3), slice(3, 5), slice(5, 6)


def ray_axes(ray):
    """Axes of which the third is a ray."""
    ahead = ray / np.linalg.norm(ray)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def test_rotations_are_found_whatever_was_guessed(answers):
    """On eight by eight patches."""
    angle = np.array([np.linalg.norm(one.turn) for one in answers])
    assert np.mean(angle < 15) >= 0.9
    assert np.median(angle) < 7
    found = [one for one, turned in zip(answers, angle, strict=True) if turned < 20]
    assert np.median([np.linalg.norm(one.shift[:2]) for one in found]) < 4  # % of the size
    assert np.median([abs(one.shift[2]) for one in found]) < 10  # along the ray: as good as the guess
    assert np.median([abs(one.size) for one in found]) < 5


def test_errors_lean_to_no_side(answers):
    """Turns and shifts across the ray within three standard errors of zero; along it, the guess decides."""
    found = [np.concatenate([one.turn, one.shift[:2]]) for one in answers if np.linalg.norm(one.turn) < 20]
    assert len(found) >= 35
    mean, error = summary(found)
    assert (np.abs(mean) <= 3 * error).all(), (mean, error)


def test_the_covariance_is_that_of_the_errors(answers):
    """A mean squared Mahalanobis distance about as large as there are numbers, within a factor of three."""
    for one in answers:
        np.testing.assert_array_equal(one.spread, one.spread.T)
        assert np.linalg.eigvalsh(one.spread.astype(np.float64)).min() > 0
    mean = np.mean([one.surprise for one in answers if np.linalg.norm(one.turn) < 20], axis=0)
    numbers = np.array([3, 2, 1])
    assert (numbers / 3 < mean).all() and (mean < 3 * numbers).all(), mean


def test_of_a_known_size_the_front_stays_where_it_was_measured():
    """The size is exact, and what the photo showed is where the query measured it, be the object thick or flat."""
    off = []
    for seed in range(4):
        templates, query = known(seed)
        free = run(templates, query)
        photo = templates.reference
        front = np.median(np.asarray(photo.view.depth)[np.asarray(photo.view.mask)])
        centre = photo.camera_from_object.to_numpy().inverse() @ np.array([[0.0, 0.0, front]])
        place = free.camera_from_object.to_numpy() @ centre
        for factor in (0.7, 1.0, 1.4):
            size = free.camera_from_object.scale * factor
            found = run(templates, query, size)
            assert float(found.camera_from_object.scale) == float(size) and float(found.scale_std) == 0
            moved = found.camera_from_object.to_numpy() @ centre - place
            off.append(moved[0] / float(size))
            np.testing.assert_allclose(found.camera_from_object.rotation, free.camera_from_object.rotation, atol=1e-3)
    assert np.abs(off).max() < 0.03


def test_without_an_encoder_pairs_alone_rank():
    turns = []
    for seed in range(4):
        made, reference, whole = photograph(seed)
        query, truth, camera_from_crop = see(10 * seed + 1, whole.camera_from_object.to_numpy().rotation, 15)
        found = run(made.templates, query, used=None)
        assert bool(found.success) and found.hypotheses.score.shape == (CONFIG.resect.drawn,)
        assert_finite(found)
        assert float(found.agreement.drawn) == 1
        turns.append(np.linalg.norm(errors(made, reference, found, truth, camera_from_crop)[:3]))
    assert np.median(turns) < 30


def test_the_paper_knows_no_photo():
    templates, query = known()
    found, bare = (
        run(one, query, config=Config.paper()) for one in (templates, dataclasses.replace(templates, reference=None))
    )
    jax.tree.map(np.testing.assert_array_equal, found, bare)
    assert found.hypotheses.score.shape == (1,)


def test_drawings_may_be_compared_only():
    """No candidate is refined on what its drawing matches: no rounds, or none in them."""
    templates, query = known()
    bare = [dataclasses.replace(CONFIG.resect, **one) for one in ({"polished": 0}, {"rounds": 0})]
    none, also_none = (run(templates, query, config=dataclasses.replace(CONFIG, resect=one)) for one in bare)
    assert bool(none.success)
    assert_same(none, also_none)


def test_fast_draws_fewer():
    templates, query = known()
    told = jax.eval_shape(lambda: ipjax.estimate(encoder, templates, query, jax.random.key(0), Config.fast()))
    assert told.hypotheses.score.shape == (Config.fast().resect.drawn,)
    assert Config.fast().resect.drawn < Config().resect.drawn


def test_vmap_over_padded_objects_queries_and_diameters_equals_the_loop():
    """One of the objects has a view and patches less than the other."""
    (first, one), (second, other) = known(0), known(1, 20)
    views = lambda t: (t.patches, t.norm, t.seen, t.camera_from_object, t.camera)
    fewer = eqx.tree_at(views, second, jax.tree.map(lambda x: x[1:], views(second)))
    fewer = ipjax.compact(fewer, multiple=8)
    objects, queries, sizes = (first, fewer), (one, other), jnp.array([0.2, 0.15])
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *queries)
    together = jax.jit(jax.vmap(ipjax.estimate, (None, 0, 0, None, None, 0)), compiler_options=QUICKLY)
    together = together(encoder, ipjax.pad_templates(objects), stacked, jax.random.key(0), CONFIG, sizes)
    for index in range(2):
        wanted = run(objects[index], queries[index], sizes[index])
        found = jax.tree.map(lambda x, index=index: x[index], together)
        found = dataclasses.replace(found, view_score=found.view_score[: wanted.view_score.shape[0]])
        # Colours that are hardly textured are aligned to within a quarter of a degree, whatever rounding began with.
        assert_same(found, wanted, 6e-3)


def test_compact_and_files_change_nothing(tmp_path):
    made, *_ = photograph(0)
    templates, query = known()
    wanted = run(templates, query)
    assert_same(run(ipjax.compact(templates, multiple=8), query), wanted, 3e-3)
    loaded = ipjax.load(ipjax.save(tmp_path / "object.ipjax", templates, made.info))[0]
    assert_same(run(loaded, query), wanted, 3e-3)


def test_float64_elsewhere_changes_nothing():
    """Under x64 thresholds and diameters are float64 if nobody says otherwise; the records decide."""
    templates, query = known()
    size = jnp.asarray(0.2, jnp.float32)
    wanted = [run(templates, query), run(templates, query, size)]
    with jax.enable_x64(True):
        assert_same(run(templates, query), wanted[0], 3e-3)
        wide = jax.tree.map(jnp.float64, (CONFIG, 0.2))
        for used in (encoder, None):
            for diameter, one in ((None, wanted[0]), (wide[1], wanted[1])):
                whole = lambda config, size, used=used: ipjax.estimate(
                    used, templates, query, jax.random.key(0), config, size
                )
                told = jax.eval_shape(whole, wide[0], diameter)
                assert jax.tree.map(lambda x: x.dtype, told) == jax.tree.map(lambda x: x.dtype, one)


@pytest.mark.parametrize("resolution", [224])
def test_a_query_finer_than_the_photo(resolution):
    made, reference, whole = photograph(0)
    place = whole.camera_from_object.to_numpy()
    query, truth, camera_from_crop = see(1, place.rotation, 15, resolution)
    off = errors(made, reference, run(made.templates, query), truth, camera_from_crop)
    assert np.linalg.norm(off[:3]) < 10 and np.linalg.norm(off[3:6]) < 15


def change(where, record, make):
    return eqx.tree_at(where, record, make(where(record)))


def degenerate():
    """Where nothing can be found, and whether an answer may be given all the same."""
    templates, query = known()
    only = lambda x: jnp.zeros_like(x).at[27].set(True)
    alike = lambda x: jnp.broadcast_to(x[..., 27:28, :], x.shape)
    of_query = {
        "no depth": (lambda q: q.view.depth, jnp.zeros_like),
        "no mask": (lambda q: q.view.mask, jnp.zeros_like),
        "no patch": (lambda q: q.patches.valid, jnp.zeros_like),
        "one patch": (lambda q: q.patches.valid, only),
        "no features": (lambda q: q.patches.features, jnp.zeros_like),
        "equal features": (lambda q: q.patches.features, alike),
    }
    of_object = {
        "templates alike": (lambda t: t.patches.features, alike, False),
        "nothing seen": (lambda t: t.seen, jnp.zeros_like, False),
        "no outline of the photo": (lambda t: t.reference.view.mask, jnp.zeros_like, False),
        "no guessed depth": (lambda t: t.reference.view.depth, jnp.zeros_like, False),
        "no patch of the photo": (lambda t: t.reference.patches.valid, jnp.zeros_like, True),
        "one patch of the photo": (lambda t: t.reference.patches.valid, only, True),
    }
    cases = {name: (templates, change(where, query, make), False) for name, (where, make) in of_query.items()}
    return cases | {
        name: (change(where, templates, make), query, may) for name, (where, make, may) in of_object.items()
    }


@pytest.mark.parametrize("used", [encoder, None], ids=["drawn", "undrawn"])
def test_an_answer_from_nothing_says_so(used):
    for name, (templates, query, may) in degenerate().items():
        found = run(templates, query, used=used)
        assert_finite(found)
        assert not bool(found.present), name
        assert bool(found.success) == may, name
        assert may or float(found.confidence) == 0, name


def test_a_size_that_no_such_object_has_is_no_success():
    """Five times the size that was found, either way; half of it is what a badly guessed shape may need."""
    templates, query = known()
    size = run(templates, query).camera_from_object.scale
    for times, may in ((0.5, True), (2.0, True), (6.0, False), (1e9, False), (0.1, False), (1e-9, False)):
        found = run(templates, query, diameter=times * size)
        assert_finite(found)
        assert bool(found.success) == may, times
        assert may or (float(found.confidence) == 0 and not bool(found.present))


@jax.jit
def slopes(templates, query, share):
    """Of the confidence and a share of everything else that an estimate says, by every number of its records."""

    def total(records):
        found = ipjax.estimate(encoder, *eqx.combine(records, (templates, query)), jax.random.key(0), CONFIG)
        rest = sum(jnp.sum(x) for x in jax.tree.leaves(found) if jnp.issubdtype(x.dtype, jnp.floating))
        return found.confidence + share * rest

    return jax.grad(total)(eqx.filter((templates, query), eqx.is_inexact_array))


def test_slopes_are_finite_everywhere():
    """Reverse mode through drawing and refinement, where there is something to see and where there is nothing."""
    templates, query = known()
    of_object, of_query = slopes(templates, query, jnp.ones(()))
    assert_finite((of_object, of_query))
    assert all(np.asarray(x).any() for x in (of_query.view.depth, of_query.patches.points, of_object.patches.features))
    bad = {}
    for name, records in degenerate().items():
        found, _ = jax.tree_util.tree_flatten_with_path(slopes(*records[:2], jnp.ones(())))
        bad[name] = [jax.tree_util.keystr(path) for path, leaf in found if not bool(jnp.all(jnp.isfinite(leaf)))]
    bad = {name: leaves for name, leaves in bad.items() if leaves}
    assert not bad, bad


def test_the_graph_has_no_callback_no_lapack_and_no_product_of_the_devices_precision():
    templates, query = known()
    text = estimate.lower(encoder, templates, query, jax.random.key(0), CONFIG, jnp.float32(0.2)).as_text()
    assert "callback" not in text and "lapack" not in text and "cusolver" not in text
    assert text.count("stablehlo") > 100  # it is the graph that was searched
    products = [line for line in text.splitlines() if "dot_general" in line or "stablehlo.convolution" in line]
    left = [line for line in products if "HIGHEST, HIGHEST" not in line]
    assert len(products) > 2 and not left, left

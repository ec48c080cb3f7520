"""The law of numbers that are not numbers: they are absent, or the answer says that it is none; it is finite always."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.compilation import QUICKLY
from builders.objects import make_object, with_reference
from builders.photo_objects import CONFIG, encoder, known
from builders.tiny_pipeline import DRAWN, make_sized_query, two_objects
from hypothesis import given, settings
from hypothesis import strategies as st

import ipjax
from ipjax.config import MatchConfig
from ipjax.estimation.features import describe
from ipjax.estimation.matching import match, select
from ipjax.estimation.pipeline import comparable
from ipjax.estimation.validity import finite_patches, finite_query, finite_templates
from ipjax.synthetic import problems

BAD = (np.nan, np.inf, -np.inf)
KEY = jax.random.key(0)
estimate = jax.jit(ipjax.estimate, compiler_options=QUICKLY)  # compiled once for all examples
described = jax.jit(describe)

# What the poisoned places of each leaf mean: the mark that says "absent" in the same record, or that
# the answer cannot be determined ("nothing"), or that the estimate does not look there ("unused").
OF_PATCH, OF_VIEW, OF_POINT, OF_COLOURED_POINT = "patch", "view", "point", "coloured point"
MEANING = {
    "templates.patches.features": OF_PATCH,
    "templates.patches.points": OF_PATCH,
    "templates.patches.grid": OF_PATCH,
    "templates.norm": OF_PATCH,
    "templates.camera_from_object.rotation": OF_VIEW,
    "templates.camera_from_object.translation": OF_VIEW,
    "templates.camera_from_object.scale": OF_VIEW,
    "templates.camera.focal": OF_VIEW,
    "templates.camera.centre": OF_VIEW,
    "templates.surface.points": OF_POINT,
    "templates.surface.normals": OF_POINT,
    "templates.surface.seen": OF_POINT,
    "templates.appearance.points": OF_COLOURED_POINT,
    "templates.appearance.normals": OF_COLOURED_POINT,
    "templates.appearance.colours": OF_COLOURED_POINT,
    "templates.mean": "nothing",
    "templates.axes": "nothing",
    "templates.seen": "unused",
    "templates.extents": "nothing",
    "query.patches.features": "query patch",
    "query.patches.points": "query patch",
    "query.patches.grid": "query patch",
    "query.view.rgb": "colour",
    "query.view.depth": "depth",
    "query.view.camera.focal": "nothing",
    "query.view.camera.centre": "nothing",
    "diameter": "nothing",
}


@functools.cache
def problem() -> dict:
    """An object, a query of it and its size; everything an estimate is made of but the encoder and the key."""
    query, truth = make_sized_query(1, 0.12)
    return {"templates": two_objects()[0], "query": query, "diameter": truth.scale}


@functools.cache
def good() -> dict[str, np.ndarray]:
    """The same, by name."""
    return flatten(problem())


def flatten(tree) -> dict[str, np.ndarray]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {
        "".join(str(key) for key in path).replace("']", "").replace("['", ""): np.array(leaf) for path, leaf in leaves
    }


def solve(leaves: dict[str, np.ndarray]) -> ipjax.PoseEstimate:
    whole = jax.tree.unflatten(jax.tree.structure(problem()), [jnp.asarray(leaves[name]) for name in good()])
    return estimate(problems.make_encoder(), whole["templates"], whole["query"], KEY, DRAWN, whole["diameter"])


def mark_absent(leaves: dict[str, np.ndarray], name: str, places: np.ndarray) -> None:
    """Say in the record's own words that what stands at some places (rows of indices) of a leaf is not there."""
    record = name.rpartition(".")[0]
    rows = tuple(places.T)
    meaning = (THROUGH_PHOTO | MEANING)[name]
    if meaning == OF_PATCH:
        leaves["templates.patches.valid"][rows[:2]] = False
    elif meaning == OF_VIEW:
        leaves["templates.patches.valid"][rows[0]] = False
    elif meaning in (OF_POINT, OF_COLOURED_POINT):
        last = "colours" if meaning == OF_COLOURED_POINT else "seen"
        for field in ("normals", last):
            leaves[f"{record}.{field}"][rows[0]] = 0
        for field in ("along_std", "across_std"):
            if f"{record}.{field}" in leaves:
                leaves[f"{record}.{field}"][rows[0]] = 0
        kept = np.setdiff1d(np.arange(len(leaves[name])), rows[0])[0]
        leaves[f"{record}.points"][rows[0]] = leaves[f"{record}.points"][kept]
    elif meaning == "query patch":
        leaves["query.patches.valid"][rows[0]] = False
        leaves[name][rows[0]] = 0
    elif meaning == "colour":
        leaves["query.view.mask"][rows[:2]] = False
        leaves[name][rows[:2]] = 0
    elif meaning == "depth":
        leaves[name][rows] = 0


def assert_finite(found: ipjax.PoseEstimate):
    for path, leaf in jax.tree_util.tree_flatten_with_path(found)[0]:
        assert np.isfinite(np.asarray(leaf)).all(), f"{jax.tree_util.keystr(path)} is not finite"


def assert_says_so(found: ipjax.PoseEstimate):
    assert not bool(found.success) and not bool(found.present) and float(found.confidence) == 0


def test_every_leaf_has_a_meaning():
    assert {name for name, leaf in good().items() if leaf.dtype.kind == "f"} == MEANING.keys()
    assert bool(solve(good()).success) and float(solve(good()).confidence) > 0.5


@given(
    name=st.sampled_from(sorted(MEANING)), bad=st.sampled_from(BAD), count=st.integers(1, 40), seed=st.integers(0, 99)
)
@settings(max_examples=120)
def test_what_is_not_finite_is_absent_or_the_answer_says_so(name, bad, count, seed):
    """Poison random places of one leaf: the answer is the one with these places marked as absent, to the last digit."""
    rng = np.random.default_rng(seed)
    poisoned, marked = ({key: leaf.copy() for key, leaf in good().items()} for _ in range(2))
    leaf = poisoned[name]
    places = rng.choice(leaf.size, min(count, max(leaf.size // 8, 1)), replace=False)
    leaf.reshape(-1)[places] = bad
    found = solve(poisoned)
    assert_finite(found)
    if MEANING[name] == "nothing":
        assert_says_so(found)
        return
    mark_absent(marked, name, np.stack(np.unravel_index(places, leaf.shape), axis=-1))
    wanted = solve(marked)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), found, wanted)


HARMLESS = {"templates.seen", "query.view.depth", "query.view.rgb"}


@pytest.mark.parametrize("name", sorted(MEANING.keys() - HARMLESS))
def test_an_answer_from_nothing_but_poison_says_so(name):
    """A whole leaf: no patch, no point of the surface, no camera.

    Without any colours to draw a pose may be found, but nobody would trust it.
    """
    found = solve(good() | {name: np.full_like(good()[name], np.nan)})
    assert_finite(found)
    assert not bool(found.present)
    if not name.startswith("templates.appearance"):
        assert_says_so(found)


@pytest.mark.parametrize("name", ["query.view.depth", "query.view.rgb"])
def test_an_image_that_is_nowhere_a_number_is_an_empty_one(name):
    """Patches that were described before have their features and points all the same, so there may be a pose."""
    poisoned, marked = ({key: leaf.copy() for key, leaf in good().items()} for _ in range(2))
    poisoned[name][...] = np.nan
    mark_absent(marked, name, np.stack(np.unravel_index(np.arange(marked[name].size), marked[name].shape), axis=-1))
    found = solve(poisoned)
    assert_finite(found)
    jax.tree.map(np.testing.assert_array_equal, found, solve(marked))


@given(place=st.integers(0, 99), bad=st.sampled_from(BAD))
@settings(max_examples=60)
def test_thresholds_that_are_no_numbers_are_said_so(place, bad):
    """NaN is never meant. Infinity may be (no limit on the cycles, say); the answer is finite all the same."""
    leaves, structure = jax.tree.flatten(DRAWN)
    leaves[place % len(leaves)] = bad
    settings = jax.tree.unflatten(structure, leaves)
    known, query, size = problem().values()
    found = estimate(problems.make_encoder(), known, query, KEY, settings, size)
    assert_finite(found)
    if np.isnan(bad):
        assert_says_so(found)


@given(
    leaf=st.sampled_from(["rgb", "depth"]), bad=st.sampled_from(BAD), count=st.integers(1, 300), seed=st.integers(0, 99)
)
@settings(max_examples=20)
def test_describe_leaves_out_what_is_not_finite(leaf, bad, count, seed):
    view = problems.make_query(2)[0].view
    image = np.array(getattr(view, leaf))
    rows, columns = np.random.default_rng(seed).integers(0, len(image), (2, count))
    image[rows, columns] = bad
    found = described(problems.make_encoder(), dataclasses.replace(view, **{leaf: jnp.asarray(image)}))
    wanted = described(problems.make_encoder(), view)
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(found))
    untouched = np.ones((8, 8), bool)
    untouched[rows // problems.PATCH, columns // problems.PATCH] = False
    take = lambda x: np.asarray(x)[untouched.reshape(-1)]
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(take(x), take(y)), found, wanted)
    assert not (np.asarray(found.valid) & ~np.asarray(wanted.valid)).any()


@pytest.mark.parametrize("field", ["focal", "centre"])
@pytest.mark.parametrize("bad", BAD)
def test_describe_without_a_camera_has_no_valid_patch(field, bad):
    view = problems.make_query(2)[0].view
    camera = dataclasses.replace(view.camera, **{field: jnp.asarray([bad, 100.0], jnp.float32)})
    found = described(problems.make_encoder(), dataclasses.replace(view, camera=camera))
    assert not np.asarray(found.valid).any() and np.isfinite(np.asarray(found.points)).all()


def test_gradients_of_what_is_left_are_finite():
    """The poison itself has none: a masked NaN must not come back through the chain rule."""
    query, _ = make_sized_query(1, 0.12)
    templates = two_objects()[0]
    poison = lambda x: jnp.asarray(np.where(np.random.default_rng(0).random(x.shape) < 0.1, np.nan, x), x.dtype)
    poisoned = jax.tree.map(lambda x: poison(x) if x.dtype.kind == "f" else x, (templates, query))
    floats = lambda tree: [x.astype(jnp.float32) for x in jax.tree.leaves(tree) if jnp.dtype(x.dtype).kind == "f"]

    def total(records):
        known = finite_templates(records[0])[0]
        known = dataclasses.replace(known, patches=finite_patches(known.patches))
        return sum(jnp.sum(x**2) for x in floats((known, finite_query(records[1])[0])))

    slopes = jax.jit(jax.grad(total, allow_int=True))(poisoned)
    assert len(floats(slopes)) == len(MEANING) - 1  # all but the diameter
    for slope, value in zip(floats(slopes), floats(poisoned), strict=True):
        assert np.isfinite(np.asarray(slope)).all()
        assert not np.asarray(slope)[~np.isfinite(np.asarray(value))].any()


@pytest.mark.parametrize("centred", [True, False])
def test_gradients_through_matches_are_those_without_the_poison(centred):
    """Templates keep the features of patches that are not valid as they are; zero times one of them is no zero."""
    query, _ = problems.make_query(1)
    templates = problems.make_templates()
    settings = dataclasses.replace(DRAWN, match=MatchConfig(views=2, pairs=64, centred=centred))
    third = np.arange(templates.norm.shape[1]) % 3 == 0
    put = lambda **fields: dataclasses.replace(templates, patches=dataclasses.replace(templates.patches, **fields))

    def weight(patches, templates):
        patches, known = comparable(finite_templates(templates)[0], patches, settings)
        return jnp.sum(select(match(patches, known, settings.match), patches, known, settings.match).weight)

    slopes = jax.jit(jax.grad(weight, argnums=(0, 1), allow_int=True))
    found = slopes(query.patches, put(features=jnp.where(third[:, None], jnp.nan, templates.patches.features)))
    wanted = slopes(query.patches, put(valid=templates.patches.valid & ~third))
    assert np.asarray(wanted[0].features).any()
    for told in (lambda x: x[0].features, lambda x: x[1].patches.features, lambda x: x[1].norm, lambda x: x[1].mean):
        np.testing.assert_allclose(told(found), told(wanted), rtol=1e-5, atol=1e-6)


# Of a reference view: the mark that says "absent", or that the object is not usable, for its pose is found through it.
OF_REFERENCE = {
    ".view.rgb": ".view.mask",
    ".view.depth": ".view.depth",
    ".patches.features": ".patches.valid",
    ".patches.points": ".patches.valid",
    ".patches.grid": ".patches.valid",
    ".view.camera.focal": "nothing",
    ".view.camera.centre": "nothing",
    ".camera_from_object.rotation": "nothing",
    ".camera_from_object.translation": "nothing",
    ".camera_from_object.scale": "nothing",
}
finite = jax.jit(finite_templates)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("name", OF_REFERENCE)
def test_a_reference_view_is_absent_where_it_is_no_number(name, bad):
    templates = with_reference(make_object()[0])
    leaves, structure = flatten(templates.reference), jax.tree.structure(templates.reference)
    assert {key for key, leaf in leaves.items() if leaf.dtype.kind == "f"} == OF_REFERENCE.keys()
    wanted = {key: leaf.copy() for key, leaf in leaves.items()}
    mark = OF_REFERENCE[name]
    row = () if mark == "nothing" else tuple(np.argwhere(leaves[mark])[1])
    leaves[name][row] = bad
    reference = jax.tree.unflatten(structure, [jnp.asarray(x) for x in leaves.values()])
    found, usable = finite(dataclasses.replace(templates, reference=reference))
    assert bool(usable) == (mark != "nothing")
    told = flatten(found.reference)
    if mark == "nothing":
        assert all(np.isfinite(leaf).all() for leaf in told.values())
        return
    wanted[name][row] = 0
    wanted[mark][row] = 0
    for key, leaf in wanted.items():
        np.testing.assert_array_equal(told[key], leaf)
    assert finite(dataclasses.replace(templates, reference=None))[0].reference is None


# Of an estimate through the photo: as above, but where the photo showed nothing no template is matched, and the surface
# only tells how well the depth agrees.
THROUGH_PHOTO = {name: meaning for name, meaning in MEANING.items() if ".appearance" not in name}
THROUGH_PHOTO |= {"templates.seen": OF_PATCH}
THROUGH_PHOTO |= {f"templates.surface.{field}": OF_POINT for field in ("along_std", "across_std")}
THROUGH_PHOTO |= {f"templates.reference{name}": meaning for name, meaning in OF_REFERENCE.items()}
# What is absent does not depend on how many candidates are drawn, and these are run some hundred times.
FEW = dataclasses.replace(CONFIG, resect=dataclasses.replace(CONFIG.resect, drawn=4, polished=1, rounds=1))


@functools.cache
def photo_problem() -> dict:
    templates, query = known()
    return {"templates": templates, "query": query, "diameter": jnp.asarray(0.2, jnp.float32)}


def solve_through_photo(leaves: dict[str, np.ndarray], used=encoder) -> ipjax.PoseEstimate:
    names, structure = list(flatten(photo_problem())), jax.tree.structure(photo_problem())
    whole = jax.tree.unflatten(structure, [jnp.asarray(leaves[name]) for name in names])
    return estimate(used, whole["templates"], whole["query"], KEY, FEW, whole["diameter"])


def mark_absent_in_photo(leaves: dict[str, np.ndarray], name: str, places: np.ndarray) -> None:
    """As `mark_absent`, of the reference view, too."""
    rows = tuple(places.T)
    if name == "templates.seen":
        leaves["templates.patches.valid"][rows] = False
    elif name.startswith("templates.reference"):
        mark = f"templates.reference{THROUGH_PHOTO[name]}"
        leaves[name][rows] = 0
        leaves[mark][rows[: leaves[mark].ndim]] = 0
    else:
        mark_absent(leaves, name, places)


def test_every_leaf_of_an_object_from_a_photo_has_a_meaning():
    leaves = flatten(photo_problem())
    assert {name for name, leaf in leaves.items() if leaf.dtype.kind == "f"} == THROUGH_PHOTO.keys()
    found = solve_through_photo(leaves)
    assert bool(found.success) and float(found.confidence) > 0.5


@pytest.mark.parametrize("used", [encoder, None], ids=["drawn", "undrawn"])
def test_through_a_photo_what_is_not_finite_is_absent_or_the_answer_says_so(used):
    """Poison random places of each leaf in turn."""
    rng = np.random.default_rng(0)
    for name, meaning in THROUGH_PHOTO.items():
        poisoned, marked = ({key: leaf.copy() for key, leaf in flatten(photo_problem()).items()} for _ in range(2))
        leaf = poisoned[name]
        places = rng.choice(leaf.size, min(rng.integers(1, 41), max(leaf.size // 8, 1)), replace=False)
        leaf.reshape(-1)[places] = rng.choice(BAD, len(places))
        found = solve_through_photo(poisoned, used)
        assert_finite(found)
        if meaning == "nothing":
            assert_says_so(found)
            continue
        mark_absent_in_photo(marked, name, np.stack(np.unravel_index(places, leaf.shape), axis=-1))
        wanted = solve_through_photo(marked, used)
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6, err_msg=name), found, wanted)


@pytest.mark.parametrize("used", [encoder, None], ids=["drawn", "undrawn"])
@pytest.mark.parametrize("bad", BAD)
def test_through_a_photo_an_answer_from_nothing_but_poison_says_so(used, bad):
    """A whole leaf. Without the photo's patches or its guessed depth a pose may be found, but nobody would trust it."""
    of_drawing = {name for name in THROUGH_PHOTO if ".reference.patches." in name}
    for name in THROUGH_PHOTO.keys() - (set() if used else of_drawing):
        leaves = flatten(photo_problem())
        found = solve_through_photo(leaves | {name: np.full_like(leaves[name], bad)}, used)
        assert_finite(found)
        assert not bool(found.present), name
        if name not in of_drawing | {"templates.reference.view.depth"}:
            assert_says_so(found)

"""An object works only with the encoder that made it: compared by identity, whichever way the templates came."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from builders.tiny_pipeline import TINY
from flax import nnx

import ipjax
from ipjax.estimation.features import identity_of
from ipjax.files.weights.parameters import abstract_model
from ipjax.inference.exporting import to_dictionary
from ipjax.networks.dinov2 import DinoV2, DinoV2Config, Encoder
from ipjax.records import Query
from ipjax.synthetic import problems
from ipjax.synthetic.objects import make_object

PLAIN = problems.make_encoder()


class Named(problems.CoordinateEncoder):
    """The tests' encoder with an identity."""

    identity: str = eqx.field(static=True)


def called(identity: str) -> Named:
    """The tests' encoder; all of them have the same weights and as many channels."""
    return Named(PLAIN.frequencies, PLAIN.phases, identity)


def described(identity: str | None) -> Query:
    query, _ = problems.make_query(0)
    return ipjax.observe(PLAIN if identity is None else called(identity), query.view)


def onboarded(identity: str | None) -> ipjax.Templates:
    templates = dataclasses.replace(problems.make_templates(), appearance=problems.make_appearance(100))
    return dataclasses.replace(templates, patches=dataclasses.replace(templates.patches, encoder=identity))


@pytest.mark.parametrize(
    "who", [("a", "b", None), ("a", None, "b"), (None, "a", "b"), ("a", "b", "b"), ("a", "a", "b"), ("a", "b", "c")]
)
def test_encoders_that_are_known_to_differ_are_refused_by_name(who):
    with pytest.raises(ValueError, match="different encoders") as refusal:
        trace(*who)
    assert all(f"'{name}'" in str(refusal.value) for name in who if name is not None)


@pytest.mark.parametrize("who", [("a", "a", "a"), ("a", None, None), (None, "a", "a")])
def test_encoders_that_may_be_the_same_are_not_refused(who):
    assert trace(*who).success.shape == ()


def trace(object_by, query_by, drawn_by) -> ipjax.PoseEstimate:
    """The shapes of an estimate; nothing is compiled."""
    drawing = PLAIN if drawn_by is None else called(drawn_by)
    arguments = drawing, onboarded(object_by), described(query_by), jax.random.key(0), TINY
    return jax.eval_shape(lambda: ipjax.estimate(*arguments))


def test_the_ten_lines_refuse_another_encoder(tmp_path):
    """Onboarded, written, read, and a query described by an encoder of the same length of features."""
    config = ipjax.OnboardConfig(directions=4, rolls=1, resolution=56, surface=64, appearance=0)
    made = {"progress": False, "backend": "raster", "out": tmp_path / "box.ipjax"}
    model = DinoV2(DinoV2Config(width=12, depth=1, heads=3, hidden=12, grid=4), rngs=nnx.Rngs(0))
    templates, info = ipjax.onboard(make_object("carton", 0), Encoder(model, 0, "mine"), config, **made)
    loaded, _ = ipjax.load(tmp_path / "box.ipjax")
    assert templates.patches.encoder == loaded.patches.encoder == info.encoder == "mine"
    assert ipjax.compact(loaded, multiple=1).patches.encoder == "mine"
    query, _ = problems.make_query(0, grid=4)
    for identity in ("mine", "another"):
        seen = jax.jit(ipjax.observe)(Encoder(model, 0, identity), query.view)
        call = lambda seen=seen: ipjax.estimate(None, loaded, seen, jax.random.key(0), TINY)
        if identity == "mine":
            jax.eval_shape(call)
        else:
            with pytest.raises(ValueError, match=r"onboarded with 'mine'.*described by 'another'"):
                jax.eval_shape(call)


def test_queries_and_objects_of_one_encoder_are_stacked():
    queries = [described("a"), described("a")]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *queries)
    assert stacked.patches.encoder == "a"
    padded = ipjax.pad_templates([onboarded("a"), onboarded(None)])
    assert padded.patches.encoder == "a"
    keys = jax.random.split(jax.random.key(0), 2)
    mapped = jax.vmap(ipjax.estimate, (None, 0, 0, 0, None))
    found = jax.eval_shape(lambda: mapped(None, padded, stacked, keys, TINY))
    assert found.success.shape == (2,)
    with pytest.raises(ValueError, match="different encoders: 'a', 'b'"):
        ipjax.pad_templates([onboarded("a"), onboarded("b")])


def test_what_has_no_name_is_not_compared():
    model = abstract_model(DinoV2Config(width=12, depth=1, heads=3, hidden=12))
    assert identity_of(Encoder(model, 0)) is None and identity_of(Encoder(model, 0, "tiny")) == "tiny"
    assert identity_of(PLAIN) is None and identity_of(lambda image: image) is None


def test_an_exported_graph_takes_arrays_only():
    tree = {"templates": to_dictionary(onboarded("a")), "query": to_dictionary(described("a"))}
    assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(tree))

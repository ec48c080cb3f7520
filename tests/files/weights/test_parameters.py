"""Names of every scheme mean the same model, and nothing may be left over on either side."""

import dataclasses

import numpy as np
import pytest
from builders.weight_files import TINY, hugging_face, official_list, random_tensors, same

from ipjax.files.weights.catalogue import OFFICIAL, WeightsError
from ipjax.files.weights.parameters import build_model, guess_preset, official_shapes, rename
from ipjax.networks.dinov2 import find_preset

pytestmark = pytest.mark.usefixtures("weights_cache")


@pytest.mark.parametrize("name", [*OFFICIAL])
def test_names_and_shapes_of_every_preset_are_the_official_ones(name):
    assert official_shapes(find_preset(name)) == official_list(name)


@pytest.mark.parametrize("scheme", ["old", "new"])
@pytest.mark.parametrize("variant", [{}, {"registers": 4}, {"swiglu": True}])
def test_hugging_face_names_mean_the_same_model(scheme, variant):
    config = dataclasses.replace(TINY, **variant)
    tensors = random_tensors(config) | {"mask_token": np.zeros((1, 12), np.float32)}
    theirs = hugging_face(tensors, scheme)
    assert not set(theirs) & set(tensors)
    assert same(build_model(config, rename(theirs)), build_model(config, tensors))


def test_published_hugging_face_names():
    names = hugging_face(random_tensors(dataclasses.replace(TINY, swiglu=True)), "old")
    for name in (
        "embeddings.patch_embeddings.projection.weight",
        "encoder.layer.0.attention.attention.query.weight",
        "encoder.layer.1.attention.output.dense.bias",
        "encoder.layer.0.layer_scale1.lambda1",
        "encoder.layer.0.mlp.weights_in.weight",
        "layernorm.bias",
    ):
        assert name in names


def test_linear_weights_are_transposed_and_patches_keep_their_order():
    tensors = random_tensors(TINY)
    model = build_model(TINY, tensors)
    assert np.array_equal(model.blocks[1].mlp.fc1.kernel[...], tensors["blocks.1.mlp.fc1.weight"].T)
    kernel = np.asarray(model.patch_embed.proj.kernel[...]).reshape(14, 14, 3, 12)
    assert kernel[3, 5, 2, 7] == tensors["patch_embed.proj.weight"][7, 2, 3, 5]


def test_nothing_may_be_left_over_on_either_side():
    tensors = random_tensors(TINY)
    build_model(TINY, tensors | {"mask_token": np.zeros((1, 12))})  # the one exception
    with pytest.raises(WeightsError, match=r"1 missing \(norm\.bias\)"):
        build_model(TINY, {name: t for name, t in tensors.items() if name != "norm.bias"})
    with pytest.raises(WeightsError, match=r"1 unknown \(head\.weight\)"):
        build_model(TINY, tensors | {"head.weight": np.zeros(3)})
    with pytest.raises(WeightsError, match=r"1 missing \(norm\.bias\) and 1 unknown \(norm\.beta\)"):
        build_model(
            TINY,
            {name.replace("norm.bias", "norm.beta") if name == "norm.bias" else name: t for name, t in tensors.items()},
        )
    with pytest.raises(WeightsError, match=r"fc1\.weight is \(12, 16\), expected \(16, 12\)"):
        build_model(TINY, tensors | {"blocks.0.mlp.fc1.weight": tensors["blocks.0.mlp.fc1.weight"].T})
    with pytest.raises(WeightsError, match=r"norm\.bias holds values that are not finite"):
        build_model(TINY, tensors | {"norm.bias": np.full(12, np.nan)})
    with pytest.raises(WeightsError, match=r"norm\.bias holds int64, not floats"):
        build_model(TINY, tensors | {"norm.bias": np.zeros(12, np.int64)})


def test_a_parameter_given_twice_is_refused():
    theirs = hugging_face(random_tensors(TINY), "old")
    with pytest.raises(WeightsError, match="twice"):
        rename(theirs | {"norm.bias": np.zeros(12)})
    both = rename(theirs | {"blocks.0.attn.qkv.bias": np.zeros(36)})
    with pytest.raises(WeightsError, match="3 unknown"):
        build_model(TINY, both)


def test_presets_are_guessed():
    tensors = {name: np.broadcast_to(np.float32(0), shape) for name, shape in official_list("vitl14_reg").items()}
    assert guess_preset(tensors) == "vitl14_reg"
    del tensors["register_tokens"]
    assert guess_preset(tensors) == "vitl14"
    with pytest.raises(WeightsError, match="width 12, depth 2 and 0 registers"):
        guess_preset(random_tensors(TINY))
    with pytest.raises(WeightsError, match="no cls_token"):
        guess_preset({"x": np.zeros(3)})

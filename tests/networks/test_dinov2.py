"""DINOv2: parity with the official code's output, laws of the encoder, and its refusals."""

import dataclasses
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from builders.tiny_dinov2 import VARIANTS, tiny
from flax import nnx
from hypothesis import given
from hypothesis import strategies as st

from ipjax.files.weights.parameters import build_model, official_shapes
from ipjax.networks import dinov2
from ipjax.networks.dinov2 import DinoV2, DinoV2Config, Encoder, encode, tokens

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
TOLERANCE = 2e-5
SIZES = ("native70x70", "square98x98", "wide42x112")
GRIDS = ("16x16", "30x30", "32x32", "46x46", "60x60", "28x37", "37x28", "74x74")


@cache
def golden(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays}


@cache
def golden_model(path: Path, variant: str, dtype: str = "float32") -> DinoV2:
    weights = {name[2:]: array for name, array in golden(path).items() if name.startswith("w/")}
    depth = 1 + max(int(name.split(".")[1]) for name in weights if name.startswith("blocks."))
    return build_model(tiny(variant, depth, dtype=dtype), weights)


def random_model(config: DinoV2Config, seed: int = 0) -> DinoV2:
    """Random weights without compiling anything."""
    draw = np.random.default_rng(seed)
    shapes = official_shapes(config)
    return build_model(config, {name: draw.normal(0, 0.1, shape).astype(np.float32) for name, shape in shapes.items()})


@jax.jit
def every_block(model: DinoV2, images):
    blocks = tuple(range(model.config.depth))
    return tokens(model, images, blocks, normalised=True), tokens(model, images, blocks, norm=False, normalised=True)


def compare(path: Path, variant: str, size: str) -> int:
    """Compare every array of one image size; returns how many there were."""
    arrays = {name.removeprefix(f"{size}/"): a for name, a in golden(path).items() if name.startswith(f"{size}/")}
    model = golden_model(path, variant)
    config = model.config
    images = jnp.asarray(arrays.pop("image_nchw").transpose(0, 2, 3, 1))
    normed, raw = every_block(model, images)
    flat = lambda maps: np.asarray(maps).reshape(*maps.shape[:-3], -1, maps.shape[-1])
    found = {
        "x_norm_clstoken": normed[-1].class_token,
        "x_norm_regtokens": normed[-1].registers,
        "x_norm_patchtokens": flat(normed[-1].patches),
        "x_prenorm": np.concatenate([raw[-1].class_token[:, None], raw[-1].registers, flat(raw[-1].patches)], axis=1),
    }
    for block in range(config.depth):
        found[f"block{block}_norm_patch"] = flat(normed[block].patches)
        found[f"block{block}_norm_cls"] = normed[block].class_token
        found[f"block{block}_raw_patch"] = flat(raw[block].patches)
    grid = (images.shape[1] // 14, images.shape[2] // 14)
    embedding = model.pos_embed[...][0]
    where = dinov2.position_embedding(embedding[1:], grid, antialias=config.antialias, offset=config.offset)
    found["pos_embed"] = np.concatenate([embedding[:1], flat(where)])[None]
    for name, expected in arrays.items():
        assert found[name].shape == expected.shape, name
        if expected.size:
            assert np.abs(found[name] - expected).max() <= TOLERANCE, name
    return len(arrays)


@pytest.mark.parametrize("size", ["square56x56", "tall84x42"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_agrees_with_the_official_code(variant, size):
    assert compare(GOLDEN / f"dinov2_{variant}.npz", variant, size) >= 4


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("variant", VARIANTS)
def test_agrees_with_the_official_code_at_other_sizes(variant, size):
    """At the native grid, above it, and wide: every third patch of the last block that is kept."""
    arrays = golden(GOLDEN / "dinov2_sizes.npz")
    model = golden_model(GOLDEN / f"dinov2_{variant}.npz", variant)
    normed, raw = every_block(model, jnp.asarray(arrays[f"{size}/image_nchw"].transpose(0, 2, 3, 1)))
    last = model.config.depth - 1
    for maps, name in ((normed, "norm"), (raw, "raw")):
        found = np.asarray(maps[last].patches).reshape(1, -1, model.config.width)[:, ::3]
        expected = arrays[f"{variant}/{size}/block{last}_{name}_patch"]
        assert found.shape == expected.shape and expected.size
        assert np.abs(found - expected).max() <= TOLERANCE


def compare_positions(path: Path, variant: str, grid: str) -> None:
    config, (rows, columns) = tiny(variant), map(int, grid.split("x"))
    expected = golden(path)[f"{variant}/{grid}"]
    embedding = jnp.asarray(golden(path)[f"{variant}/pos_embed_37x37"][0, 1:, : expected.shape[-1]])
    resize = jax.jit(dinov2.position_embedding, static_argnums=1, static_argnames=("antialias", "offset"))
    found = resize(embedding, (rows, columns), antialias=config.antialias, offset=config.offset)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= TOLERANCE


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("variant", ["plain", "registers"])
def test_position_embedding(variant, grid):
    compare_positions(GOLDEN / "dinov2_pos_embed.npz", variant, grid)


@given(size=st.integers(2, 80), native=st.integers(4, 40))
def test_resizing_agrees_with_opencv_and_pillow(size, native):
    import cv2
    from PIL import Image

    eye = np.eye(native, dtype=np.float32)
    bicubic = cv2.resize(eye, (native, size), interpolation=cv2.INTER_CUBIC)  # a = −¾, borders repeated
    assert np.abs(dinov2.resize_weights(size, native, antialias=False, offset=0.0) - bicubic).max() < 2e-5
    smooth = np.asarray(Image.fromarray(eye).resize((native, size), Image.Resampling.BICUBIC))  # a = −½, antialiased
    assert np.abs(dinov2.resize_weights(size, native, antialias=True, offset=0.0) - smooth).max() < 2e-5


@given(size=st.integers(2, 80), native=st.integers(4, 40), antialias=st.booleans(), offset=st.sampled_from([0.0, 0.1]))
def test_resizing_keeps_constants(size, native, antialias, offset):
    weights = dinov2.resize_weights(size, native, antialias=antialias, offset=offset)
    assert weights.shape == (size, native)
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-5


# Published: README of the official repository, and dinov2/hub/backbones.py, dinov2/models/vision_transformer.py.
PUBLISHED = {"vits14": (384, 12, 6, 22.06), "vitb14": (768, 12, 12, 86.58), "vitl14": (1024, 24, 16, 304.37)}
PUBLISHED["vitg14"] = (1536, 40, 24, 1136.48)


@pytest.mark.parametrize("registers", [0, 4])
@pytest.mark.parametrize("name", PUBLISHED)
def test_presets_have_the_published_shape(name, registers):
    config = dinov2.find_preset(name + ("_reg" if registers else ""))
    width, depth, heads, millions = PUBLISHED[name]
    assert (config.width, config.depth, config.heads, config.registers) == (width, depth, heads, registers)
    assert (config.antialias, config.offset) == ((True, 0.0) if registers else (False, 0.1))
    shapes = jax.eval_shape(lambda: nnx.state(DinoV2(config)))
    count = sum(leaf.size for leaf in jax.tree.leaves(shapes)) - registers * width
    assert count / 1e6 == pytest.approx(millions, abs=0.01)


@pytest.fixture(scope="module")
def model():
    return random_model(tiny("registers"))


def pictures(seed: int, *shape: int):
    return jax.random.uniform(jax.random.key(seed), shape)


def test_one_image_is_a_batch_of_one(model):
    images = pictures(0, 2, 42, 56, 3)
    together = jax.jit(lambda m, x: tokens(m, x, (1,))[0])(model, images)
    mapped = jax.jit(jax.vmap(lambda m, x: tokens(m, x, (1,))[0], in_axes=(None, 0)))(model, images)
    alone = jax.jit(lambda m, x: tokens(m, x, (1,))[0])(model, images[1])
    assert alone.patches.shape == (3, 4, 48) and alone.registers.shape == (4, 48) and alone.class_token.shape == (48,)
    for batch, vmapped, one in zip(together, mapped, alone, strict=True):
        np.testing.assert_allclose(batch, vmapped, atol=1e-5)
        np.testing.assert_allclose(batch[1], one, atol=1e-5)


def test_eager_equals_jit():
    model = DinoV2(tiny("swiglu", 1), rngs=nnx.Rngs(0))
    image = pictures(1, 28, 28, 3)
    np.testing.assert_allclose(model(image).patches, jax.jit(lambda m, x: m(x))(model, image).patches, atol=1e-5)


def test_blocks_come_in_the_order_asked_for(model):
    image = pictures(2, 28, 28, 3)
    first, last, again = jax.jit(lambda m, x: tokens(m, x, (0, -1, 2)))(model, image)
    assert np.array_equal(last.patches, again.patches) and not np.allclose(first.patches, last.patches)
    assert tokens(model, image, ()) == ()


def test_no_block_beyond_the_last_wanted_is_computed(model):
    count = lambda blocks: str(jax.make_jaxpr(lambda m, x: tokens(m, x, blocks))(model, pictures(3, 28, 28, 3))).count(
        "dot_general"
    )
    one, two, three = count((0,)), count((1,)), count((2, 0))
    assert two - one == three - two > 0


def test_the_white_of_an_image_is_normalised_as_imagenet():
    grey = jnp.full((2, 2, 3), 0.5)
    np.testing.assert_allclose(
        dinov2.normalise(grey)[0, 0], [(0.5 - 0.485) / 0.229, (0.5 - 0.456) / 0.224, (0.5 - 0.406) / 0.225], rtol=1e-5
    )
    model = random_model(tiny("plain", 1))
    image = pictures(4, 28, 28, 3)
    both = jax.jit(lambda m, x: (tokens(m, x, (0,))[0], tokens(m, dinov2.normalise(x), (0,), normalised=True)[0]))(
        model, image
    )
    np.testing.assert_allclose(both[0].patches, both[1].patches, atol=1e-6)


def test_features_are_unit_and_weights_are_arguments(model):
    encoder = Encoder(model, 1, "tiny")
    images = pictures(5, 2, 28, 42, 3)
    lowered = jax.jit(encode).lower(encoder, images)
    assert len(lowered.as_text()) < 2e5  # 48-channel weights alone would be a megabyte of text
    assert "callback" not in lowered.as_text()
    features = lowered.compile()(encoder, images)
    assert features.shape == (2, 2, 3, 48) and features.dtype == jnp.float32
    np.testing.assert_allclose(np.linalg.norm(features, axis=-1), 1.0, atol=1e-5)
    assert np.array_equal(features, jax.jit(lambda e, x: e(x))(encoder, images))
    assert (encoder.patch, encoder.channels, encoder.block, encoder.identity) == (14, 48, 1, "tiny")


def test_a_second_encoder_of_the_same_shape_needs_no_second_trace():
    traces = []

    def counted(encoder, images):
        traces.append(1)
        return encode(encoder, images)

    compiled = jax.jit(counted)
    for seed in (0, 1):
        compiled(Encoder(random_model(tiny("plain", 1), seed), 0, "same"), pictures(6, 28, 28, 3))
    assert len(traces) == 1


def test_split_and_merge_bring_the_encoder_back(model):
    encoder = Encoder(model, 0, "tiny")
    graph, state = nnx.split(encoder)
    image = pictures(7, 28, 28, 3)
    again = jax.jit(lambda s, x: encode(nnx.merge(graph, s), x))(state, image)
    np.testing.assert_allclose(again, jax.jit(encode)(encoder, image), atol=1e-6)


def test_bfloat16_is_near_float32():
    path = GOLDEN / "dinov2_plain.npz"
    images = jnp.asarray(golden(path)["tall84x42/image_nchw"].transpose(0, 2, 3, 1))
    small = golden_model(path, "plain", "bfloat16")
    run = jax.jit(lambda m, x: tokens(m, x, (1,), normalised=True)[0].patches)
    full, half = run(golden_model(path, "plain"), images), run(small, images)
    assert half.dtype == jnp.float32 and "bf16" in run.lower(small, images).as_text()
    assert small.blocks[0].attn.qkv.kernel[...].dtype == jnp.bfloat16
    assert 1e-6 < np.abs(full - half).max() < 0.1


def test_x64_changes_nothing(x64):
    model = random_model(tiny("plain", 1))
    image = pictures(8, 28, 28, 3).astype(jnp.float32)
    assert jax.jit(encode)(Encoder(model, 0), image).dtype == jnp.float32


@pytest.fixture
def no_shape_checker():
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def test_refusals(model, no_shape_checker):
    with pytest.raises(ValueError, match="28 × 30; its sides must be multiples of 14"):
        tokens(model, jnp.zeros((28, 30, 3)), (0,))
    with pytest.raises(ValueError, match="multiples of 14"):
        encode(Encoder(model, 0), jnp.zeros((2, 0, 28, 3)))
    with pytest.raises(ValueError, match="3 channels"):
        tokens(model, jnp.zeros((28, 28, 4)), (0,))
    with pytest.raises(ValueError, match="no block 3: the model has 3"):
        tokens(model, jnp.zeros((28, 28, 3)), (3,))
    with pytest.raises(ValueError, match="no block -1"):
        Encoder(model, -1)
    with pytest.raises(ValueError, match="unknown DINOv2 preset 'vith14'; known: vits14"):
        dinov2.find_preset("vith14")
    with pytest.raises(ValueError, match="float32 or bfloat16, not 'float16'"):
        dinov2.find_preset("vits14", "float16")
    with pytest.raises(ValueError, match="not a multiple of the 5 heads"):
        dataclasses.replace(dinov2.find_preset("vits14"), heads=5)
    with pytest.raises(ValueError, match="7 patches, which is not a square number"):
        dinov2.position_embedding(jnp.zeros((7, 4)), (2, 2), antialias=False, offset=0.1)

"""TripoSR against the official code's numbers (a tiny random configuration), and the laws of its field."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.golden import GOLDEN
from builders.tiny_triposr import TINY, make_model, read_golden, read_weights
from flax import nnx
from golden.make_triposr import cut

from ipjax.networks.dinov2 import normalise
from ipjax.networks.triposr.config import TripoSRConfig, VisionConfig
from ipjax.networks.triposr.field import density_grid, query, sample_planes
from ipjax.networks.triposr.model import prepare_image
from ipjax.networks.triposr.renderer import Rays, meet_cube, orbit_rays, render
from ipjax.networks.triposr.vision import interpolate_positions
from ipjax.networks.triposr.weights import load_model, official_shapes


@functools.cache
def _photos() -> np.ndarray:
    """What the model reads: both pictures, prepared by us (`test_image_preparation_is_the_official_one`)."""
    golden = read_golden()
    pictures = (golden[name].astype(np.float32) / 255 for name in ("pre/composite_u8", "in/image1_u8"))
    return np.stack([prepare_image(jnp.asarray(picture), 128) for picture in pictures])


@functools.cache
def _stages() -> dict[str, np.ndarray]:
    """Every array of the golden file up to the scene codes, as our modules make it, compiled once."""
    model = make_model()

    @nnx.jit
    @functools.partial(nnx.vmap, in_axes=(None, 0))
    def run(model, image):
        out = {}
        tokenizer, backbone = model.tokenizer, model.backbone
        x = out["vit/embeddings"] = tokenizer.embed(image)
        first = tokenizer.blocks[0]
        normed = first.norm1(x)
        out["vit/layer0_attention"] = first.attention(normed, normed)
        x = out["vit/layer0"] = first(x)
        x = out["vit/layer1"] = tokenizer.blocks[1](x)
        photo = out["vit/last_hidden_state"] = tokenizer.norm(x)
        out["tok/image_tokens_BNvCNt"] = tokenizer(image).T[None]
        tokens = model.tokens()
        out["tok/tokens_in"] = tokens.T
        normed = backbone.norm(tokens)
        out["bb/groupnorm"] = normed.T
        x = out["bb/proj_in"] = backbone.enter(normed)
        block = backbone.blocks[0]
        normed = out["bb/block0_norm1"] = block.norm1(x)
        x = x + (out := out | {"bb/block0_attn1": block.attention1(normed, normed)})["bb/block0_attn1"]
        normed = out["bb/block0_norm2"] = block.norm2(x)
        x = x + (out := out | {"bb/block0_attn2": block.attention2(normed, photo)})["bb/block0_attn2"]
        normed = out["bb/block0_norm3"] = block.norm3(x)
        gated = out["bb/block0_geglu"] = block.gate(normed)
        out["bb/block0_ff"] = block.narrow(gated)
        x = out["bb/block0"] = block(out["bb/proj_in"], photo)
        x = out["bb/block1"] = backbone.blocks[1](x, photo)
        x = out["bb/proj_out"] = backbone.leave(x)
        out["bb/tokens_out"] = (x + tokens).T
        out["pp/triplane_detokenized"] = (x + tokens).reshape(3, 8, 8, -1).transpose(0, 3, 1, 2)
        out["scene_codes"] = model(image)
        return out

    return jax.tree.map(np.asarray, run(model, jnp.asarray(_photos())))


def _close(ours, theirs, relative=2e-4):
    """Largest difference over largest value."""
    assert ours.shape == theirs.shape
    assert np.isfinite(ours).all()
    assert np.abs(np.asarray(ours, np.float64) - theirs).max() <= relative * np.abs(theirs).max()


@pytest.mark.parametrize(
    "name",
    [
        "vit/embeddings",
        "vit/layer0_attention",
        "vit/layer0",
        "vit/layer1",
        "vit/last_hidden_state",
        "tok/image_tokens_BNvCNt",
        "tok/tokens_in",
        "bb/groupnorm",
        "bb/proj_in",
        "bb/block0_norm1",
        "bb/block0_attn1",
        "bb/block0_norm2",
        "bb/block0_attn2",
        "bb/block0_norm3",
        "bb/block0_geglu",
        "bb/block0_ff",
        "bb/block0",
        "bb/block1",
        "bb/proj_out",
        "bb/tokens_out",
        "pp/triplane_detokenized",
        "scene_codes",
    ],
)
def test_stages_are_the_official_ones(name):
    _close(cut(name, _stages()[name]), read_golden()[name], 2e-5)


def test_image_preparation_is_the_official_one():
    golden = read_golden()
    _close(cut("in/rgb_cond", _photos()), golden["in/rgb_cond"], 2e-5)
    _close(cut("pre/model_input_128", _photos()[:1]), golden["pre/model_input_128"], 2e-5)
    noise = np.repeat(golden["pre/resize_aa_in_u8"].astype(np.float32) / 255, 3, axis=2)
    _close(prepare_image(jnp.asarray(noise), 64)[..., :1], golden["pre/resize_aa_out_64"][0], 2e-5)
    normed = normalise(jnp.asarray(_photos())).transpose(0, 3, 1, 2)
    _close(cut("vit/pixel_values_normalized", normed), golden["vit/pixel_values_normalized"], 2e-5)


def test_patches_are_the_official_ones():
    golden, model = read_golden(), make_model()
    positions = interpolate_positions(model.tokenizer.positions[...], 8)
    patches = _stages()["vit/embeddings"] - np.asarray(positions)
    _close(cut("vit/patch_embeddings", patches[:, 1:]), golden["vit/patch_embeddings"])


def test_positions_follow_the_rule_of_the_checkpoint_and_not_the_newer_one():
    golden = read_golden()
    stored = read_weights(golden)["image_tokenizer.model.embeddings.position_embeddings"][0]
    for source, side, old, new in (
        (stored, 8, "vit/pos_embed_interpolated", "vit/pos_embed_interpolated_NEW_ge_4_45_for_contrast"),
        (golden["posembed14to32/in"][0], 32, "posembed14to32/out", "posembed14to32/out_NEW_ge_4_45_for_contrast"),
    ):
        ours = interpolate_positions(jnp.asarray(source), side)[None]
        _close(ours, golden[old], 2e-5)
        assert np.abs(np.asarray(ours) - golden[new]).max() > 0.01


def test_queries_are_the_official_ones():
    golden, model = read_golden(), make_model()
    points = jnp.asarray(golden["query/points"])

    @nnx.jit
    @functools.partial(nnx.vmap, in_axes=(None, 0))
    def run(model, codes):
        features = sample_planes(codes, points, model.config.radius)
        return features, model.decoder(features), *query(model, codes, points, chunk=300)

    features, raw, density, colour = run(model, jnp.asarray(golden["scene_codes"]))
    _close(features, golden["query/triplane_features"])
    _close(raw[..., :1], golden["query/density"])
    _close(raw[..., 1:], golden["query/features"])
    np.testing.assert_allclose(density, golden["query/density_act"][..., 0], rtol=2e-4)
    _close(colour, golden["query/color"])
    # Every kind of point: inside, near a face, on it, outside the cube, special ones.
    for kind in range(5):
        chosen = golden["query/kind"] == kind
        assert chosen.any()
        _close(features[:, chosen], golden["query/triplane_features"][:, chosen])


@functools.cache
def _grid():
    codes = jnp.asarray(read_golden()["scene_codes"])
    run = nnx.jit(nnx.vmap(lambda model, codes: density_grid(model, codes, 32), in_axes=(None, 0)))
    return run(make_model(), codes)


def test_grid_is_the_official_one():
    golden = read_golden()
    np.testing.assert_allclose(cut("grid32/density_act", _grid()), golden["grid32/density_act"], rtol=2e-4)
    axis = np.linspace(-TINY.radius, TINY.radius, 32)
    first = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)[:40]
    np.testing.assert_allclose(first, golden["grid32/first_points"], atol=1e-6)


def test_grid_is_the_field_at_its_points_slab_by_slab():
    """The grid's shortcut (planes first, points later) against the plain query; slabs against the whole."""
    model, codes = make_model(), jnp.asarray(read_golden()["scene_codes"][0])
    axis = np.linspace(-TINY.radius, TINY.radius, 32, dtype=np.float32)
    points = np.stack(np.meshgrid(axis[5:9], axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    density, _ = nnx.jit(query)(model, codes, jnp.asarray(points))
    slabs = nnx.jit(lambda model, codes: density_grid(model, codes, 32, start=5, count=4))(model, codes)
    np.testing.assert_allclose(slabs.reshape(-1), density, rtol=2e-4)
    np.testing.assert_allclose(slabs, _grid()[0][5:9], rtol=1e-5)
    with pytest.raises(ValueError, match="do not lie in a grid of 32"):
        density_grid(model, codes, 32, start=30, count=4)


ORBITS = {
    "render_default": (4, {}),
    "render_elev25": (2, {"elevation": 25.0, "distance": 1.8, "fov": 44.0}),
    "rays_wide_with_misses": (1, {"elevation": 25.0, "distance": 1.9, "fov": 85.0}),
}


def _rays(name: str) -> Rays:
    views, options = ORBITS[name]
    return orbit_rays(views, 16, 16, **options)


@functools.cache
def _renders() -> dict:
    """All views of both triplanes in one call; images x views x 16 x 16 for each orbit."""
    codes = jnp.asarray(read_golden()["scene_codes"])
    rays = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *map(_rays, ORBITS))
    run = nnx.jit(nnx.vmap(lambda model, codes, rays: render(model, codes, rays, chunk=500), in_axes=(None, 0, None)))
    seen = run(make_model(), codes, rays)
    cuts = np.cumsum([0, *(views for views, _ in ORBITS.values())])
    return {
        name: jax.tree.map(lambda leaf, a=a, b=b: np.asarray(leaf)[:, a:b], seen)
        for name, a, b in zip(ORBITS, cuts[:-1], cuts[1:], strict=True)
    }


@pytest.mark.parametrize("name", ORBITS)
def test_rays_and_renders_are_the_official_ones(name):
    golden = read_golden()
    rays = _rays(name)
    _close(rays.origins, golden[f"{name}/rays_o"], 2e-6)
    _close(rays.directions, golden[f"{name}/rays_d"], 2e-6)
    near, far, valid = map(np.asarray, meet_cube(rays, TINY.radius))
    np.testing.assert_array_equal(valid, golden[f"{name}/valid"])
    _close(near, golden[f"{name}/t_near"], 2e-5)
    _close(far, golden[f"{name}/t_far"], 2e-5)
    seen = _renders()[name]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(seen))
    if f"{name}/rgb" in golden:
        np.testing.assert_allclose(seen.rgb, golden[f"{name}/rgb"], atol=2e-5)
    if name == "render_default":
        # The official code truncates; a value a rounding error below a step may fall one lower.
        truncated = (seen.rgb[0, 0] * 255).astype(np.uint8).astype(int)
        assert np.abs(truncated - golden["render_default/pil_view0_image0_u8"]).max() <= 1
    assert (~valid).any() == (name == "rays_wide_with_misses")
    assert (seen.rgb[:, ~valid] == 1.0).all()  # white where a ray misses
    assert (seen.distance[:, ~valid] == 0.0).all()
    assert (seen.opacity[:, ~valid] == 0.0).all()


def test_distance_is_where_the_light_stops():
    """The renderer's distance and opacity against an open sum in float64 over the plain query, ray by ray."""
    model, codes = make_model(), jnp.asarray(read_golden()["scene_codes"][0])
    rays, seen = _rays("render_default"), _renders()["render_default"]
    pick = [(0, 7, 7), (1, 8, 6), (2, 5, 9), (3, 10, 8)]
    near, far, _ = map(np.asarray, meet_cube(rays, TINY.radius))
    middle = (np.arange(128) + 0.5) / 128
    at = np.stack([near[spot] * (1 - middle) + far[spot] * middle for spot in pick])
    origins, directions = (
        np.stack([np.asarray(leaf)[spot] for spot in pick]) for leaf in (rays.origins, rays.directions)
    )
    points = (origins[:, None] + at[..., None] * directions[:, None]).reshape(-1, 3).astype(np.float32)
    density, _ = nnx.jit(query)(model, codes, jnp.asarray(points))
    for spot, distance, sigma in zip(pick, at, np.asarray(density, np.float64).reshape(4, 128), strict=True):
        light, opacity, mean = 1.0, 0.0, 0.0
        for z, s in zip(distance, sigma, strict=True):
            stopped = light * (1 - np.exp(-s / 128))
            opacity, mean, light = opacity + stopped, mean + stopped * z, light - stopped
        np.testing.assert_allclose(seen.opacity[0][spot], opacity, atol=1e-4)
        np.testing.assert_allclose(seen.distance[0][spot], mean / opacity if opacity > 0.5 else 0.0, atol=1e-3)


# --- weights ----------------------------------------------------------------------------------------------------------


def test_names_and_shapes_of_the_published_checkpoint():
    """A bijection with the published list, at the published size, without allocating it."""
    published = json.loads((GOLDEN / "triposr_published.json").read_text())
    ours = official_shapes(TripoSRConfig())
    assert ours == {name: tuple(shape) for name, shape in published["state_dict"].items()}
    assert len(ours) == 549
    assert sum(int(np.prod(shape)) for shape in ours.values()) == published["num_params"]


def test_defaults_are_the_published_configuration():
    published = json.loads((GOLDEN / "triposr_published.json").read_text())
    values, vit = published["config"], published["vit"]
    ours = TripoSRConfig()
    assert ours.image_size == values["cond_image_size"]
    assert (ours.plane_size, ours.width) == (values["tokenizer"]["plane_size"], values["tokenizer"]["num_channels"])
    assert (ours.layers, ours.heads) == (values["backbone"]["num_layers"], values["backbone"]["num_attention_heads"])
    assert ours.width == ours.heads * values["backbone"]["attention_head_dim"]
    assert ours.groups == published["code_defaults"]["backbone"]["norm_num_groups"]
    assert ours.plane_channels == values["post_processor"]["out_channels"]
    assert ours.decoder_width == values["decoder"]["n_neurons"]
    assert ours.decoder_layers == values["decoder"]["n_hidden_layers"]
    renderer = values["renderer"]
    assert (ours.radius, ours.density_bias) == (renderer["radius"], renderer["density_bias"])
    assert ours.samples == renderer["num_samples_per_ray"]
    vision = VisionConfig(
        width=vit["hidden_size"],
        layers=vit["num_hidden_layers"],
        heads=vit["num_attention_heads"],
        hidden=vit["intermediate_size"],
        patch=vit["patch_size"],
        grid=vit["image_size"] // vit["patch_size"],
        epsilon=vit["layer_norm_eps"],
    )
    assert ours.vision == vision


def test_wrong_weights_are_named():
    weights = read_weights(read_golden())
    short = {name: array for name, array in weights.items() if name != "backbone.proj_in.bias"}
    with pytest.raises(ValueError, match=r"1 missing \(backbone\.proj_in\.bias\)"):
        load_model(TINY, short)
    with pytest.raises(ValueError, match=r"1 not known \(more\)"):
        load_model(TINY, weights | {"more": np.zeros(3)})
    with pytest.raises(ValueError, match=r"1 of another shape \(tokenizer\.embeddings\)"):
        load_model(TINY, weights | {"tokenizer.embeddings": np.zeros((3, 32, 8, 9))})


def test_every_weight_arrives_where_it_belongs():
    """Official arrays, each filled with a number of its own, fill exactly one of ours each, or are known as unused."""
    names = list(read_weights(read_golden()))
    numbered = {
        name: np.full(array.shape, i, np.float32) for i, (name, array) in enumerate(read_weights(read_golden()).items())
    }
    found = []
    for leaf in map(np.asarray, _leaves(load_model(TINY, numbered)).values()):
        assert (leaf == leaf.flat[0]).all()
        found.append(int(leaf.flat[0]))
    assert len(set(found)) == len(found)
    assert [names[i] for i in sorted(set(range(len(names))) - set(found))] == [
        "image_tokenizer.model.pooler.dense.weight",
        "image_tokenizer.model.pooler.dense.bias",
    ]


def _leaves(model):
    return {path: leaf.get_value() for path, leaf in nnx.to_flat_state(nnx.state(model, nnx.Param))}


def test_half_precision_stays_close_and_keeps_half_the_memory():
    golden = read_golden()
    half = load_model(dataclasses.replace(TINY, dtype="bfloat16"), read_weights(golden))
    assert {leaf.dtype for path, leaf in _leaves(half).items() if path[0] != "decoder"} == {jnp.dtype("bfloat16")}
    codes = nnx.jit(lambda model, image: model(image))(half, jnp.asarray(_photos()[0]))
    assert codes.dtype == jnp.float32
    error = np.abs(np.asarray(codes) - golden["scene_codes"][0]).max() / np.abs(golden["scene_codes"][0]).max()
    assert 1e-5 < error < 0.03


def test_a_photo_of_another_size_is_refused():
    with pytest.raises(ValueError, match="reads 128 × 128 photos, not 64 × 64"):
        make_model()(jnp.zeros((64, 64, 3), jnp.float32))
    with pytest.raises(ValueError, match="not a multiple of the patch"):
        make_model().tokenizer.embed(jnp.zeros((100, 100, 3), jnp.float32))

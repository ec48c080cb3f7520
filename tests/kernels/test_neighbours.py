"""Nearest neighbours: golden files, the slow twin, laws, the bound on memory, the fused kernel."""

import os
import re
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ipjax_kernels import reference
from ipjax_kernels.neighbours import NO_MATCH, cycle_distance, nearest
from ipjax_kernels.neighbours_mosaic import search
from jaxtyping import config as jaxtyping_config

VIEWS, PATCHES, OTHERS, CHANNELS = 3, 20, 17, 8
SMALL = 4 * 2 * PATCHES * 5  # room for five template patches: four parts, the last one padded


@pytest.fixture
def unchecked_shapes():
    """Our own messages: the shape checker would speak first."""
    jaxtyping_config.update("jaxtyping_disable", True)
    yield
    jaxtyping_config.update("jaxtyping_disable", False)


def lattice(seed, high=2, *, views=VIEWS, patches=PATCHES, others=OTHERS, channels=CHANNELS):
    """Small integers: products are exact in every order of summation, and ties abound unless ``high`` is large."""
    rng = np.random.default_rng(seed)
    query = rng.integers(-high, high + 1, (patches, channels)).astype(np.float32)
    templates = rng.integers(-high, high + 1, (views, others, channels)).astype(np.float32)
    return tuple(
        jnp.asarray(x) for x in (query, templates, rng.random(patches) < 0.7, rng.random((views, others)) < 0.7)
    )


def assert_equal(ours, theirs):
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(mine, other)


def load(path):
    with np.load(path, allow_pickle=False) as file:
        data = dict(file)
    height, width, channels = data["feat_q"].shape

    def unit(features):
        features = features.reshape(*features.shape[:-3], -1, channels)
        return jnp.asarray(features / np.linalg.norm(features, axis=-1, keepdims=True))

    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    grid = jnp.asarray(np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float32))
    return data, unit, grid


def check_pair(path, memory_bytes):
    data, unit, grid = load(path)
    query, template = unit(data["feat_q"]), unit(data["feat_r"])[None]
    mask_q, mask_r = data["mask_q"].reshape(-1), data["mask_r"].reshape(-1)
    everywhere = jnp.ones(len(query), bool), jnp.ones((1, template.shape[1]), bool)
    found = nearest(query, template, *everywhere, memory_bytes=memory_bytes)
    np.testing.assert_array_equal(found.query_to_template[0], data["spec_nn_qr"])
    np.testing.assert_array_equal(found.template_to_query[0], data["spec_nn_rq"])
    np.testing.assert_allclose(found.query_similarity[0], data["ref_sim_qr"], atol=2e-6)
    np.testing.assert_allclose(found.template_similarity[0], data["ref_sim_rq"], atol=2e-6)
    cycle = cycle_distance(
        found.query_to_template[0], found.template_to_query[0], grid, everywhere[0], everywhere[1][0]
    )
    np.testing.assert_allclose(cycle, data["spec_cyc_dist"].reshape(-1), atol=1e-6)

    masked = nearest(query, template, jnp.asarray(mask_q), jnp.asarray(mask_r)[None], memory_bytes=memory_bytes)
    np.testing.assert_array_equal(masked.query_to_template[0][mask_q], data["spec_masked_nn_qr"][mask_q])
    np.testing.assert_array_equal(masked.template_to_query[0][mask_r], data["spec_masked_nn_rq"][mask_r])
    cycle = cycle_distance(
        masked.query_to_template[0], masked.template_to_query[0], grid, jnp.asarray(mask_q), jnp.asarray(mask_r)
    )
    np.testing.assert_allclose(cycle, data["spec_masked_cyc_dist"].reshape(-1), atol=1e-6)


@pytest.mark.parametrize("memory_bytes", [64 * 2**20, 2 * 4 * 256 * 100])
@pytest.mark.parametrize("name", ["zsp_pair16", "zsp_rand16"])
def test_golden(name, memory_bytes, request):
    check_pair(request.path.parents[1] / "golden" / f"{name}.npz", memory_bytes)


def specify(query, template, query_valid, template_valid):
    """Both nearest neighbours by cosine in float64, masked before the maximum, and by how much each wins."""
    cosine = np.where(query_valid[:, None] & template_valid, query @ template.T, -2.0)
    answers = []
    for table in (cosine, cosine.T):
        best = np.sort(np.partition(table, -2, axis=1)[:, -2:], axis=1)
        answers.append((table.argmax(axis=1), best[:, 1] - best[:, 0]))
    return answers


@pytest.mark.parametrize(("height", "width", "views"), [(32, 32, 1), (37, 28, 1), (16, 16, 16), (9, 21, 5)])
def test_problems_of_real_sizes_equal_the_specification(height, width, views):
    """Square and not, one view and many; features related by a shift, as an object's are, with noise."""
    rng = np.random.default_rng(height * width + views)
    count, channels = height * width, 384
    plain = rng.normal(size=(count, channels))
    query, *templates = (
        np.roll(plain, shift, axis=0) + rng.normal(0, 1.5, plain.shape) for shift in range(0, 3 * (views + 1), 3)
    )
    unit = lambda x: (x / np.linalg.norm(x, axis=-1, keepdims=True)).astype(np.float32)
    query, templates = unit(query), unit(np.stack(templates))
    valid, there = rng.random(count) < 0.6, rng.random((views, count)) < 0.6
    found = nearest(jnp.asarray(query), jnp.asarray(templates), jnp.asarray(valid), jnp.asarray(there))
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(np.float32)
    cycle = jax.vmap(cycle_distance, in_axes=(0, 0, None, None, 0))(
        found.query_to_template, found.template_to_query, jnp.asarray(grid), jnp.asarray(valid), jnp.asarray(there)
    )
    for view in range(views):
        (forth, margin), (back, other) = specify(query.astype(np.float64), templates[view], valid, there[view])
        sure, sure_back = valid & (margin > 1e-6), there[view] & (other > 1e-6)
        assert sure.sum() > 0.99 * valid.sum()
        np.testing.assert_array_equal(found.query_to_template[view][sure], forth[sure])
        np.testing.assert_array_equal(found.template_to_query[view][sure_back], back[sure_back])
        expected = np.linalg.norm(grid - grid[back[forth]], axis=-1)
        closed = sure & sure_back[forth]
        np.testing.assert_allclose(cycle[view][closed], expected[closed], atol=1e-6)
        assert np.isinf(np.asarray(cycle[view])[~valid]).all()


@given(seed=st.integers(0, 2**31), high=st.sampled_from((2, 100)))
def test_twin_with_ties_and_masks(seed, high):
    arguments = lattice(seed, high)
    expected = reference.nearest(*arguments)
    assert_equal(nearest(*arguments), expected)
    assert_equal(nearest(*arguments, memory_bytes=SMALL), expected)
    query_valid, template_valid = (np.asarray(x) for x in arguments[2:])
    found = nearest(*arguments)
    assert np.all(query_valid[np.asarray(found.template_to_query)][template_valid])
    grid = jnp.asarray(np.random.default_rng(seed).normal(size=(PATCHES, 2)).astype(np.float32))
    for view in range(VIEWS):
        forth, back = found.query_to_template[view], found.template_to_query[view]
        cycle = cycle_distance(forth, back, grid, arguments[2], arguments[3][view])
        twin = reference.cycle_distance(
            np.asarray(forth), np.asarray(back), np.asarray(grid), query_valid, template_valid[view]
        )
        np.testing.assert_allclose(cycle, twin, atol=1e-5)


@given(seed=st.integers(0, 2**31))
def test_views_permute_and_queries_batch(seed):
    query, templates, query_valid, template_valid = lattice(seed)
    order = np.random.default_rng(seed).permutation(VIEWS)
    found = nearest(query, templates, query_valid, template_valid)
    assert_equal(nearest(query, templates[order], query_valid, template_valid[order]), (x[order] for x in found))
    queries, flags = jnp.stack([query, query[::-1]]), jnp.stack([query_valid, query_valid[::-1]])
    batched = jax.vmap(nearest, in_axes=(0, None, 0, None))(queries, templates, flags, template_valid)
    assert_equal((x[0] for x in batched), found)
    assert_equal((x[1] for x in batched), nearest(queries[1], templates, flags[1], template_valid))


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16])
def test_narrow_storage_and_products(dtype):
    query, templates, *flags = lattice(3)  # small integers are exact in every dtype
    expected = nearest(query, templates, *flags)
    assert_equal(nearest(query.astype(dtype), templates.astype(dtype), *flags), expected)
    assert_equal(nearest(query.astype(dtype), templates.astype(dtype), *flags, dtype="bfloat16"), expected)


def test_nothing_valid():
    query, templates, query_valid, template_valid = lattice(0)
    found = nearest(query, templates, jnp.zeros_like(query_valid), template_valid)
    for index, similarity in (found[:2], found[2:]):
        assert not np.any(index)
        assert np.all(similarity == NO_MATCH)
    empty = nearest(query, templates, query_valid, template_valid.at[1].set(False))
    assert np.all(empty.query_similarity[1] == NO_MATCH)
    cycle = cycle_distance(
        empty.query_to_template[1],
        empty.template_to_query[1],
        jnp.zeros((PATCHES, 2)),
        query_valid,
        jnp.zeros(OTHERS, bool),
    )
    assert np.all(np.isinf(cycle))


# Two tiles each way, the last ones padded, and three pieces of 64 channels, the last one of masks and padding.
FUSED = {"views": 2, "patches": 140, "others": 150, "channels": 127}


def simulation():
    """Pallas' simulation of a GPU, which also looks for races between threads and copies."""
    try:
        from jax.experimental.pallas.mosaic_gpu import InterpretGPUParams
    except ImportError:  # JAX 0.10 has it under another name
        from jax._src.pallas.mosaic_gpu.interpret.params import InterpretGPUParams
    return InterpretGPUParams(detect_races=True)


@pytest.fixture(scope="module")
def simulated():
    """The fused kernel on a simulated GPU."""
    if jax.default_backend() != "cpu":
        pytest.skip("the simulation runs on a CPU; on a device there is the device")
    return jax.jit(lambda *arguments: search(*arguments, interpret=simulation()))


@pytest.mark.parametrize(("seed", "high"), [(0, 1), (1, 1), (2, 100)])
def test_fused_kernel_equals_twin(simulated, seed, high):
    """With ties in plenty (small integers) and few; products of integers below 2**8 are exact in bfloat16."""
    from jax._src.pallas.mosaic_gpu.interpret.interpret_pallas_call import get_races

    query, templates, query_valid, template_valid = lattice(seed, high, **FUSED)
    query = jnp.where(query_valid[:, None], query, jnp.nan)  # what is invalid may hold anything
    expected = reference.nearest(jnp.nan_to_num(query), templates, query_valid, template_valid)
    found = simulated(query, templates, query_valid, template_valid)
    assert not get_races().races_found
    mine, theirs = np.asarray(query_valid), np.asarray(template_valid)
    for ours, wanted in zip(found[:2], expected[:2], strict=True):
        np.testing.assert_array_equal(np.asarray(ours)[:, mine], wanted[:, mine])
    for ours, wanted in zip(found[2:], expected[2:], strict=True):
        np.testing.assert_array_equal(np.asarray(ours)[theirs], wanted[theirs])


def fused_text(platform, batch=False):
    """The lowered text of ``nearest`` with the fused kernel asked for."""
    arguments = lattice(0)
    function = lambda *a: nearest(*a, dtype="bfloat16", implementation="pallas")
    if batch:
        function = jax.vmap(function, in_axes=(0, None, 0, None))
        arguments = [x[None] if i in (0, 2) else x for i, x in enumerate(arguments)]
    return jax.jit(function).trace(*arguments).lower(lowering_platforms=(platform,)).as_text()


def test_fused_kernel_lowers_for_cuda_and_falls_back():
    assert "mosaic_gpu" in fused_text("cuda") and "mosaic_gpu" in fused_text("cuda", batch=True)
    assert "mosaic_gpu" not in fused_text("cpu")
    found = nearest(*lattice(1), dtype="bfloat16", implementation="pallas")
    assert_equal(found, nearest(*lattice(1), dtype="bfloat16"))
    with pytest.raises(ValueError, match='pass dtype="bfloat16"'):
        nearest(*lattice(1), implementation="pallas")


def test_other_gpus_than_hopper_get_the_blocked_form(monkeypatch):
    try:
        for capability, fused in (("8.6", False), ("9.0", True), ("12.0", False)):
            nearest.clear_cache()  # or it is not traced again
            device = SimpleNamespace(compute_capability=capability)
            monkeypatch.setattr(jax, "devices", lambda *_, device=device: [device])
            assert ("mosaic_gpu" in fused_text("cuda")) is fused
    finally:
        nearest.clear_cache()


# What the compiler asks about a GPU, here an H100: so that it compiles for one that is not there.
HOPPER = """
gpu_device_info {
  threads_per_block_limit: 1024  threads_per_warp: 32  core_count: 132  fpus_per_core: 128
  shared_memory_per_block: 49152  shared_memory_per_core: 233472  shared_memory_per_block_optin: 232448
  threads_per_core_limit: 2048  registers_per_core_limit: 65536  registers_per_block_limit: 65536
  block_dim_limit_x: 2147483647  block_dim_limit_y: 65535  block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000  l2_cache_size: 52428800  clock_rate_ghz: 1.98  device_memory_size: 84978434048
  cuda_compute_capability { major: 9 }
}
platform_name: "CUDA"
dnn_version_info { major: 9  minor: 10 }
device_description_str: "an H100"
"""
COMPILE = """
import sys
import jax, jax.numpy as jnp, numpy as np
from jax.experimental import topologies
from ipjax_kernels.neighbours_mosaic import search

try:
    jax.devices()  # registers the plugin, which finds no GPU
except RuntimeError:
    pass
found = topologies.get_topology_desc(platform="cuda", topology_name="one", topology="1x1x1", target_config=sys.argv[1])
sharding = jax.sharding.NamedSharding(jax.sharding.Mesh(np.array(found.devices), "x"), jax.sharding.PartitionSpec())
shape = lambda *size, dtype=jnp.float32: jax.ShapeDtypeStruct(size, dtype, sharding=sharding)
flags = shape(900, dtype=bool), shape(8, 900, dtype=bool)
jax.jit(search).lower(shape(900, 384), shape(8, 900, 384), *flags).compile()
"""


def test_fused_kernel_compiles_for_hopper():
    """To machine code, by NVIDIA's assembler, with all similarities in registers. No GPU is needed, but the plugin."""
    pytest.importorskip("jax_plugins.xla_cuda13", reason="pip install --no-deps jax-cuda13-plugin jax-cuda13-pjrt")
    environment = os.environ | {"JAX_SKIP_CUDA_CONSTRAINTS_CHECK": "1", "MOSAIC_GPU_DUMP_PTXAS": "1"}
    environment.pop("JAX_PLATFORMS", None)
    done = subprocess.run([sys.executable, "-c", COMPILE, HOPPER], env=environment, capture_output=True, text=True)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert re.search("Compiling entry function '\\w+' for 'sm_90a'", said)
    print(*re.findall(r"\d+ bytes stack frame.*|Used \d+ registers.*", said), sep="\n")
    assert "0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads" in said


def test_fused_kernel_on_a_device():
    device = jax.devices()[0]
    if device.platform != "gpu" or device.compute_capability != "9.0":
        pytest.skip("needs a Hopper GPU, and JAX_PLATFORMS=cuda")
    for seed, high in ((0, 1), (1, 100)):
        arguments = lattice(seed, high, views=5, patches=900, others=900, channels=384)
        found = nearest(*arguments, dtype="bfloat16", implementation="pallas")
        assert_equal(found, nearest(*arguments, dtype="bfloat16"))


@pytest.mark.parametrize(("patches", "memory_bytes"), [(256, 64 * 2**20), (900, 64 * 2**20), (900, 2**20)])
def test_temporary_memory_is_bounded(patches, memory_bytes):
    if jax.default_backend() != "cpu":
        pytest.skip("a CPU takes one template at a time; GPUs take several, and their libraries want a workspace")

    # Besides the similarities: the query, one template and what is returned, a few times over; views enter nowhere.
    def shapes(views, *batch):
        return (
            jax.ShapeDtypeStruct((*batch, patches, 384), jnp.float32),
            jax.ShapeDtypeStruct((views, patches, 384), jnp.float32),
            jax.ShapeDtypeStruct((*batch, patches), bool),
            jax.ShapeDtypeStruct((views, patches), bool),
        )

    one = jax.jit(lambda *a: nearest(*a, memory_bytes=memory_bytes)).lower(*shapes(40)).compile().memory_analysis()
    allowed = min(memory_bytes, 8 * patches**2) + 4 * 4 * patches * 384 + 2 * 40 * 16 * patches
    assert one.temp_size_in_bytes <= allowed
    if patches == 900:
        assert one.temp_size_in_bytes + one.output_size_in_bytes < 200e6
    batch = jax.jit(jax.vmap(lambda *a: nearest(*a, memory_bytes=memory_bytes), in_axes=(0, None, 0, None)))
    eight = batch.lower(*shapes(40, 8)).compile().memory_analysis()
    assert eight.temp_size_in_bytes <= allowed + 8 * (4 * patches * 384 + 2 * 40 * 16 * patches)


def test_no_callback_and_exportable():
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), lattice(0))
    exported = jax.export.export(jax.jit(lambda *a: tuple(nearest(*a))), platforms=("cpu", "cuda", "tpu"))(*shapes)
    assert not re.findall(r"custom_call @\w*(?:callback|lapack|cusolver)", exported.mlir_module())
    restored = jax.export.deserialize(exported.serialize())  # and an outer jit changes nothing
    assert_equal(restored.call(*lattice(5)), nearest(*lattice(5)))


def test_refuses_wrong_shapes_in_words(unchecked_shapes):
    query, templates, query_valid, template_valid = lattice(0)
    with pytest.raises(ValueError, match="same c"):
        nearest(query[:, :-1], templates, query_valid, template_valid)
    with pytest.raises(ValueError, match="one flag per patch"):
        nearest(query, templates, query_valid[:-1], template_valid)
    with pytest.raises(ValueError, match="at least one"):
        nearest(query, templates[:0], query_valid, template_valid[:0])
    with pytest.raises(ValueError, match="memory_bytes"):
        nearest(query, templates, query_valid, template_valid, memory_bytes=10)
    with pytest.raises(ValueError, match="cycle_distance needs"):
        cycle_distance(jnp.zeros(4, int), jnp.zeros(5, int), jnp.zeros((3, 2)), jnp.ones(4, bool), jnp.ones(5, bool))


@pytest.mark.parametrize("share", [0.0, 0.2, 0.45, 0.6, 0.7, 0.9, 1.0])
def test_compaction_changes_nothing(share):
    """Every size that valid patches are cut to, with ties: what the whole search finds, at the same indices."""
    rng = np.random.default_rng(0)
    patches = 100
    query, templates = (rng.integers(-1, 2, (*n, CHANNELS)).astype(np.float32) for n in ((patches,), (3, 90)))
    valid = np.zeros(patches, bool)
    valid[rng.permutation(patches)[: round(share * patches)]] = True
    arguments = [jnp.asarray(x) for x in (query, templates, valid, rng.random((3, 90)) < 0.7)]
    expected = reference.nearest(*arguments)
    for memory_bytes in (2**20, 2 * 4 * patches * 20):
        for compact in (True, False):
            assert_equal(nearest(*arguments, memory_bytes=memory_bytes, compact=compact), expected)


def test_compaction_saves_products():
    """Counted by the compiler: a search for half of the patches costs half."""
    shapes = [jax.ShapeDtypeStruct(*x) for x in (((128, 64), jnp.float32), ((4, 128, 64), jnp.float32))]
    flags = [jax.ShapeDtypeStruct(shape, bool) for shape in ((128,), (4, 128))]
    text = nearest.trace(*shapes, *flags).lower(lowering_platforms=("cpu",)).as_text()
    rows = {int(n) for n in re.findall(r"dot_general.*-> tensor<(\d+)x128xf32>", text)}
    assert rows == {48, 64, 80, 96, 128}

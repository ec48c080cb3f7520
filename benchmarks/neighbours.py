"""Nearest neighbours: views × patches × channels × dtype × implementation, against the bare product."""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels import reference
from ipjax_kernels.neighbours import nearest

from benchmarks.measure import compile_fresh, summarise, time_in_turns

# views, patches, channels, dtype of the product
SIZES = [
    (400, 256, 384, "float32"),
    (100, 256, 384, "bfloat16"),
    (50, 576, 384, "float32"),
    (25, 900, 384, "float32"),
    (50, 576, 256, "float32"),
    (10, 1369, 384, "float32"),
    (20, 900, 1024, "float32"),
]
ROUNDED = {(50, 576), (25, 900)}  # views and patches at which a bf16 product's indices are compared too
QUICK = [(20, 256, 384, "float32"), (5, 576, 384, "float32"), (5, 900, 384, "float32")]
BASELINES = [(25, 256, 384), (400, 256, 384), (50, 576, 384), (25, 900, 384)]  # compared with NumPy
REST = 0.1  # seconds between the calls of two libraries, each with threads of its own
ACCELERATOR = [
    (400, 256, 384, "bfloat16"),
    (400, 900, 384, "float32"),
    (400, 900, 384, "bfloat16"),
    (400, 1024, 384, "bfloat16"),
]


def rows(quick: bool):
    """One dictionary per measured thing."""
    on_cpu = jax.default_backend() == "cpu"
    for size in QUICK if quick else SIZES if on_cpu else ACCELERATOR:
        yield from measure(*size, repeats=5 if quick else 15)


def baseline_rows(quick: bool):
    """The kernel against the obvious forms in NumPy, each with the machine to itself."""
    for size in [(5, 256, 384)] if quick else BASELINES:
        yield from baselines(*size, repeats=3 if quick else 9)
    yield from loops(*(QUICK if quick else BASELINES)[0][:3], repeats=3 if quick else 7)


def measure(views, patches, channels, dtype, repeats):
    """The kernel's forms against the bare product, and the disagreement of a bf16 product."""
    arguments = problem(views, patches, channels)
    on_cpu = jax.default_backend() == "cpu"
    forms = {
        "product, view by view": partial(bare_product, dtype=dtype),
        "one large product": partial(large_product, dtype=dtype),
        "nearest (xla)": partial(nearest, dtype=dtype, compact=False),
        "nearest (xla), a third of the query's patches invalid": partial(nearest, dtype=dtype),
    }
    if on_cpu and views * patches**2 <= 25 * 900**2:
        forms["einsum + argmax"] = partial(einsum_argmax, dtype=dtype)
    if not on_cpu and dtype == "bfloat16":
        forms["nearest (pallas)"] = partial(nearest, dtype=dtype, implementation="pallas")
    built = {name: compile_fresh(form, *arguments) for name, form in forms.items()}
    calls = {name: partial(compiled, *arguments) for name, (compiled, _, _) in built.items()}
    times = time_in_turns(calls, repeats, seconds=12)
    base = np.median(times["product, view by view"])
    large = np.median(times["one large product"])
    for name, (_, seconds, temporary) in built.items():
        median = np.median(times[name])
        yield {
            "name": "neighbours",
            "implementation": name,
            "size": f"{views} × {patches}² × {channels}",
            "dtype": dtype,
            "compile_s": seconds,
            "temporary_bytes": temporary,
            "gflop_per_s": 2 * views * patches**2 * channels / median / 1e9,
            "ratio_to_product": median / base,
            "ratio_to_large_product": median / large,
            **summarise(times[name]),
        }
    if dtype == "bfloat16" or (views, patches) in ROUNDED:
        exact, rounded = nearest(*arguments), nearest(*arguments, dtype="bfloat16")
        differs = np.mean(np.asarray(exact.query_to_template != rounded.query_to_template))
        yield {
            "name": "neighbours",
            "implementation": "bf16 against float32: share of indices that differ",
            "size": f"{views} × {patches}² × {channels}",
            "dtype": "bfloat16",
            "disagreement": float(differs),
        }


def baselines(views, patches, channels, repeats):
    """The kernel and the same in NumPy, and the product that is in each of them."""
    arguments = problem(views, patches, channels)
    plain = [np.asarray(x) for x in arguments]
    kernel, *_ = compile_fresh(partial(nearest, compact=False), *arguments)
    product, *_ = compile_fresh(partial(bare_product, dtype="float32"), *arguments)
    calls = {
        "nearest (xla)": lambda: kernel(*arguments),
        "NumPy + BLAS": lambda: numpy_blas(*plain),
        "its product alone, XLA": lambda: product(*arguments),
        "its product alone, BLAS": lambda: [plain[0] @ template.T for template in plain[1]],
    }
    times = time_in_turns(calls, repeats, rest=REST)
    base = np.median(times["nearest (xla)"])
    for name, seconds in times.items():
        yield {
            "name": "neighbours, baselines",
            "size": f"{views} × {patches}² × {channels}",
            "dtype": "float32",
            "implementation": name,
            "gflop_per_s": 2 * views * patches**2 * channels / np.median(seconds) / 1e9,
            "ratio_to_kernel": np.median(seconds) / base,
            **summarise(seconds),
        }


def loops(views, patches, channels, repeats):
    """One token after another, and the slow twin: both at few views or patches, scaled up, and said so."""
    arguments = problem(views, patches, channels)
    query, templates, query_valid, template_valid = (np.asarray(x) for x in arguments)
    kernel, *_ = compile_fresh(partial(nearest, compact=False), *arguments)
    tokens, *_ = compile_fresh(token_loop, query, templates[0])
    times = time_in_turns(
        {"kernel": lambda: kernel(*arguments), "tokens": lambda: tokens(query, templates[0])}, repeats
    )
    few = 16
    start = time.perf_counter()
    reference.nearest(query[:few], templates[:1, :few], query_valid[:few], template_valid[:1, :few])
    twin = (time.perf_counter() - start) * views * (patches / few) ** 2
    loop = np.median(times["tokens"]) * views
    for name, seconds in {
        "cosine token by token (one view, extrapolated)": loop,
        f"slow twin ({few} patches, extrapolated)": twin,
    }.items():
        yield {
            "name": "neighbours, baselines",
            "size": f"{views} × {patches}² × {channels}",
            "dtype": "float32",
            "implementation": name,
            "median_ms": seconds * 1e3,
            "ratio_to_kernel": seconds / np.median(times["kernel"]),
        }


def problem(views, patches, channels):
    """Random unit features and masks that keep two thirds of the patches."""
    rng = np.random.default_rng(0)

    def unit(*shape):
        features = rng.standard_normal(shape, dtype=np.float32)
        return jnp.asarray(features / np.linalg.norm(features, axis=-1, keepdims=True))

    return (
        unit(patches, channels),
        unit(views, patches, channels),
        jnp.asarray(rng.random(patches) < 0.67),
        jnp.asarray(rng.random((views, patches)) < 0.67),
    )


def multiply(query, template, dtype):
    return jax.lax.dot_general(
        query.astype(dtype),
        template.astype(dtype),
        (((1,), (1,)), ((), ())),
        precision=jax.lax.Precision.HIGHEST,
        preferred_element_type=jnp.float32,
    )


def bare_product(query, templates, query_valid, template_valid, *, dtype):
    """Only the product, as the kernel does it: a view at a time, behind a barrier or it would be optimised away."""

    def one(template):
        return jax.lax.optimization_barrier(multiply(query, template, dtype))[0, 0]

    return jax.lax.map(one, templates)


def large_product(query, templates, query_valid, template_valid, *, dtype):
    """All similarities, written to memory by one product."""
    return multiply(query, templates.reshape(-1, templates.shape[-1]), dtype)


def einsum_argmax(query, templates, query_valid, template_valid, *, dtype):
    """The obvious form."""
    similarity = jnp.einsum(
        "pc,vqc->vpq",
        query.astype(dtype),
        templates.astype(dtype),
        precision="highest",
        preferred_element_type=jnp.float32,
    )
    similarity = jnp.where(query_valid[None, :, None] & template_valid[:, None, :], similarity, -jnp.inf)
    return similarity.argmax(2), similarity.max(2), similarity.argmax(1), similarity.max(1)


def token_loop(query, template):
    """A cosine against every other token, normalised anew, for one token after another (no product is ever formed)."""

    def one(token):
        norms = jnp.linalg.norm(token) * jnp.linalg.norm(template, axis=-1)
        return jnp.sum(token * template, axis=-1) / jnp.maximum(norms, 1e-8)

    similarity = jax.lax.map(one, query)
    return similarity.argmax(1), similarity.argmax(0)


def numpy_blas(query, templates, query_valid, template_valid):
    """NumPy with its BLAS, view by view."""
    found = []
    for template, valid in zip(templates, template_valid, strict=True):
        similarity = np.where(query_valid[:, None] & valid, query @ template.T, -np.inf)
        found.append((similarity.argmax(1), similarity.max(1), similarity.argmax(0), similarity.max(0)))
    return found

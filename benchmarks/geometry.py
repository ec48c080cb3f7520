"""Umeyama against LAPACK's decomposition, and the consensus against scikit-image's."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.consensus import consensus, draw_minimal_sets
from ipjax_kernels.similarity import umeyama

from benchmarks.measure import compile_fresh, summarise, time_in_turns


def umeyama_rows(quick: bool):
    """4096 sets of three points (closed form) and of four (an iteration)."""
    count = 512 if quick else 4096
    for points in (3, 4):
        source, target = np.random.default_rng(0).standard_normal((2, count, points, 3), dtype=np.float32)
        arguments = jnp.asarray(source), jnp.asarray(target), jnp.ones((count, points))
        forms = {"umeyama": umeyama, "vmapped jnp.linalg.svd": jax.vmap(library_svd)}
        yield from compare("umeyama", f"{count} × {points} points", forms, arguments, repeats=7 if quick else 25)


def consensus_rows(quick: bool):
    """4096 hypotheses × 512 pairs, half of them wrong; scikit-image at 1000 trials × 100 pairs."""
    count, pairs = (512, 128) if quick else (4096, 512)
    arguments = problem(pairs)
    options = dict(count=count, keep=16, relative=False)
    key = jax.random.key(0)
    forms = {
        "consensus, 3 refits of 16": lambda s, t, w: consensus(key, s, t, w, 0.01, refits=3, **options),
        "consensus, no refit": lambda s, t, w: consensus(key, s, t, w, 0.01, refits=0, **options),
        "draw_minimal_sets alone": lambda s, t, w: draw_minimal_sets(key, w, count, 3),
    }
    yield from compare("consensus", f"{count} × {pairs} pairs", forms, arguments, repeats=7 if quick else 25)

    trials, pairs = (100, 50) if quick else (1000, 100)
    source, target, weight = problem(pairs)
    ours, *_ = compile_fresh(
        lambda s, t, w: consensus(key, s, t, w, 0.01, count=trials, size=4, refits=1, keep=1, rank="count"),
        source, target, weight,
    )  # fmt: skip
    calls = {
        "consensus": lambda: ours(source, target, weight),
        "skimage.measure.ransac": partial(library_ransac, np.asarray(source), np.asarray(target), trials),
    }
    times = time_in_turns(calls, repeats=3 if quick else 5)
    for name, seconds in times.items():
        yield {
            "name": "consensus, baseline",
            "implementation": name,
            "size": f"{trials} × {pairs} pairs",
            "dtype": "float32",
            "ratio_to_kernel": np.median(seconds) / np.median(times["consensus"]),
            **summarise(seconds),
        }


def compare(name, size, forms, arguments, repeats):
    """Rows of several forms of one thing, the first being the kernel."""
    built = {form: compile_fresh(function, *arguments) for form, function in forms.items()}
    times = time_in_turns({form: partial(compiled, *arguments) for form, (compiled, *_) in built.items()}, repeats)
    first = np.median(times[next(iter(forms))])
    for form, (_, seconds, temporary) in built.items():
        yield {
            "name": name,
            "implementation": form,
            "size": size,
            "dtype": "float32",
            "compile_s": seconds,
            "temporary_bytes": temporary,
            "ratio_to_kernel": np.median(times[form]) / first,
            **summarise(times[form]),
        }


def problem(pairs):
    """Half the pairs agree to a millimetre on an object 0.2 m across, half are wrong."""
    rng = np.random.default_rng(0)
    source = rng.uniform(-0.5, 0.5, (pairs, 3))
    target = 0.2 * source[:, [1, 2, 0]] + [0.1, 0.0, 1.0] + 0.001 * rng.normal(size=source.shape)
    target[::2] += rng.uniform(-0.1, 0.1, target[::2].shape)
    return (*(jnp.asarray(x.astype(np.float32)) for x in (source, target)), jnp.ones(pairs))


def library_svd(source, target, weight):
    """One set as the textbook has it."""
    share = weight / jnp.sum(weight)
    source_mean, target_mean = share @ source, share @ target
    source, target = source - source_mean, target - target_mean
    u, s, vt = jnp.linalg.svd((share[:, None] * target).T @ source)
    signs = jnp.ones(3).at[2].set(jnp.sign(jnp.linalg.det(u) * jnp.linalg.det(vt)))
    rotation = (u * signs) @ vt
    scale = jnp.sum(s * signs) / jnp.sum(share[:, None] * source**2)
    return rotation, target_mean - scale * rotation @ source_mean, scale


def library_ransac(source, target, trials):
    """scikit-image with its similarity transform and four points a sample."""
    from skimage.measure import ransac
    from skimage.transform import SimilarityTransform

    class Spatial(SimilarityTransform):
        def __init__(self, matrix=None):
            super().__init__(matrix, dimensionality=3)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model, inliers = ransac(
            (source.astype(float), target.astype(float)),
            Spatial,
            min_samples=4,
            residual_threshold=0.01,
            max_trials=trials,
            rng=0,
        )
    if model is None:
        raise RuntimeError("scikit-image found no model")
    return np.asarray(inliers)

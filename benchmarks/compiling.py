"""What the first answer costs before it is computed: ``python -m benchmarks.compiling [--page FILE]``.

`ipjax.estimate` is traced, lowered and compiled with one stage more from row to row, at the defaults and with drawing
by DINOv2 S/14 in the end; then as a whole once more with each of ``OPTIONS``, and timed. Nothing comes from a cache.
Seconds of the process on all cores: a machine that is shared takes longer on the clock, hardly in these.
"""

import argparse
import dataclasses
import statistics
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from flax import nnx

from benchmarks.measure import commit, describe_device
from benchmarks.queries import BLOCK, PRESET, StandInWithDinov2
from benchmarks.stages import front, match_only
from ipjax.config import Config, RefineConfig, ScoreConfig
from ipjax.estimation.pipeline import estimate
from ipjax.files.storage.writing import write_text
from ipjax.inference.batching import compact
from ipjax.inference.estimator import MULTIPLE, QUICK
from ipjax.networks.dinov2 import DinoV2, Encoder, find_preset
from ipjax.synthetic import problems

CHANNELS = 384
OPTIONS: dict[str, dict[str, Any]] = {
    "as they are": {},
    "`inference.estimator.QUICK`": QUICK,
    "the same, LLVM at -O0": {**QUICK, "xla_backend_optimization_level": 0},
}


def forms():
    """Name, function and arguments of each row: the estimate with ever more stages."""
    templates = problems.make_templates(40, 10, grid=16, channels=CHANNELS)
    half = eqx.tree_at(lambda p: p.features, templates.patches, templates.patches.features.astype(jnp.float16))
    surface, appearance = problems.make_surface(2048), problems.make_appearance(65536)
    templates = dataclasses.replace(templates, patches=half, surface=surface, appearance=appearance)
    templates = compact(templates, multiple=MULTIPLE)
    query, _ = problems.make_query(0, grid=16, channels=CHANNELS, noise=0.3)
    key = jax.random.key(0)
    dinov2 = Encoder(DinoV2(find_preset(PRESET), rngs=nnx.Rngs(0)), BLOCK)
    encoder = StandInWithDinov2(problems.make_encoder(CHANNELS), dinov2)
    plain = RefineConfig(steps=0, settle=False)
    yield "match", match_only, (templates, query, Config())
    yield "+ select, align", front, (templates, query, key, Config())
    for name, seer, config in (
        ("+ grid, certainty", None, Config(refine=plain, score=ScoreConfig(ranking="inliers"))),
        ("+ scores", None, Config(refine=plain, score=ScoreConfig(alternates=0))),
        ("+ turned alternates", None, Config(refine=plain)),
        ("+ refine", None, Config(refine=RefineConfig(settle=False))),
        ("+ settle", None, Config()),
        ("+ draw: the whole", encoder, Config()),
    ):
        yield name, estimate, (seer, templates, query, key, config)


def measure(function, arguments, options):
    """Seconds of the process for tracing and lowering, for XLA, and of the clock for both; and what was compiled."""
    jax.clear_caches()
    start, clock = time.process_time(), time.perf_counter()
    lowered = jax.jit(function).lower(*arguments)
    traced = time.process_time()
    compiled = lowered.compile(compiler_options=options)
    done = time.process_time()
    return {"trace": traced - start, "xla": done - traced, "clock": time.perf_counter() - clock}, compiled


def time_query(compiled, arguments, repeats=12):
    """Median seconds of the process, and of the clock."""
    took = []
    for _ in range(repeats + 1):
        start, clock = time.process_time(), time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        took.append((time.process_time() - start, time.perf_counter() - clock))
    return tuple(statistics.median(x) for x in zip(*took[1:], strict=True))


def far(first, second):
    """The largest difference between two estimates' poses: of a rotation's entries, and in diameters."""
    a, b = first.camera_from_object, second.camera_from_object
    turned = jnp.max(jnp.abs(a.rotation - b.rotation))
    moved = jnp.max(jnp.abs(jnp.append(a.translation - b.translation, a.scale - b.scale))) / a.scale
    return float(jnp.maximum(turned, moved))


def tables() -> str:
    """Both tables as Markdown."""
    lines = ["| estimate with | trace, lower | XLA | both | this stage adds | XLA, quick | both | this stage adds |"]
    lines.append("|" + " --- |" * 8)
    before = [0.0, 0.0]
    jax.block_until_ready(jax.jit(jnp.sort)(jnp.arange(3)))  # what is done once in a process
    all_forms = list(forms())
    for name, function, arguments in all_forms:
        cells = [name]
        for i, options in enumerate((None, QUICK)):
            took = measure(function, arguments, options)[0]
            both = took["trace"] + took["xla"]
            cells += [] if i else [f"{took['trace']:.1f} s"]
            cells += [f"{took['xla']:.1f} s", f"{both:.1f} s", f"{both - before[i]:.1f} s"]
            before[i] = both
        lines.append("| " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    lines += ["", "| the whole, XLA's options | both | clock | query | its clock | pose differs by |"]
    lines.append("|" + " --- |" * 6)
    _, function, arguments = all_forms[-1]
    reference = None
    for name, options in OPTIONS.items():
        took, compiled = measure(function, arguments, options or None)
        found = compiled(*arguments)
        reference = found if reference is None else reference
        query, clock = time_query(compiled, arguments)
        lines.append(
            f"| {name} | {took['trace'] + took['xla']:.1f} s | {took['clock']:.1f} s | {query:.2f} s | {clock:.2f} s "
            f"| {far(reference, found):.1e} |"
        )
        print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compiling", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the tables here")
    options = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    device = describe_device()
    head = (
        f"What compiling `ipjax.estimate` costs, by `python -m benchmarks.compiling --page FILE`: "
        f"{device['device']}, {device['cores']} cores, jax {device['jax']}, {time.strftime('%Y-%m-%d')}, "
        f"commit {commit()}. Seconds of the process on all cores, but for the columns of the clock, which other work "
        "on the machine lengthens; nothing came from a cache.\n\n"
    )
    page = head + tables()
    if options.page:
        write_text(options.page, page, parents=True)


if __name__ == "__main__":
    main()

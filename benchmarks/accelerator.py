"""``python -m benchmarks.accelerator [--page FILE] [--json FILE] [--answers FILE]``: the estimate on this device.

Runs on any device; written for GPUs. Five parts, of which ``--only`` chooses:

* answers: poses of problems with known answers, one query at a time and all at once, and features of DINOv2 S/14.
  ``--answers FILE`` writes them there, or, where the file is there already, compares them with those in it: write
  it on a CPU (``--only answers``), compare on a GPU.
* queries: seconds of `estimate`, of one query and of many at once.
* stages: how those seconds divide among the stages.
* encoder: seconds of `observe` and of whole queries with DINOv2 S/14 in float32 and bfloat16.
* neighbours: the forms of the matching kernel against the bare product.

DINOv2's weights are random unless ``--weights`` names a file. A device takes work before it has done the last: "one by
one" waits for every answer, "in a row" only for the last.
"""

import argparse
import dataclasses
import json
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from ipjax_kernels.neighbours import nearest
from scipy.spatial.transform import Rotation

from benchmarks import neighbours, stages
from benchmarks.measure import commit, compile_fresh, describe_device, summarise
from benchmarks.queries import BLOCK, PRESET, StandInWithDinov2, whole
from ipjax.config import Config
from ipjax.estimation.features import observe
from ipjax.estimation.pipeline import estimate
from ipjax.files.storage.writing import write_text, writing
from ipjax.files.weights.encoder import load_encoder
from ipjax.inference.batching import compact
from ipjax.networks.dinov2 import DinoV2, DinoV2Config, Encoder, find_preset
from ipjax.synthetic import problems

PARTS = ("answers", "queries", "stages", "encoder", "neighbours")
BATCHES = (8, 32, 128)
STAGED = 32  # queries at once whose stages are timed
ANSWERS = 16
SIZES = [(views, 256, 384, dtype) for dtype in ("float32", "bfloat16") for views in (25, 100, 400)]
SIZES += [(400, 900, 384, "float32"), (400, 900, 384, "bfloat16")]
NOISE = 0.3  # of the answers' features, whose norm is 1


class Session:
    """What the parts have in common: sizes, the object, the queries, and the file of answers."""

    def __init__(self, quick: bool, answers: Path | None, weights: str | None, trace: Path | None, batches=()):
        self.quick, self.answers, self.weights, self.trace = quick, answers, weights, trace
        self.grid, self.channels = (8, 32) if quick else (16, 384)
        self.seconds = 0.2 if quick else 1.0
        self.batches = batches or ((2,) if quick else BATCHES)
        self.staged = min(STAGED, max(self.batches))
        with jax.default_device(jax.devices("cpu")[0]):
            views = (8, 1) if quick else (40, 10)
            templates = problems.make_templates(*views, grid=self.grid, channels=self.channels)
            narrow = templates.patches.features.astype(jnp.float16)
            templates = eqx.tree_at(lambda t: t.patches.features, templates, narrow)
            surface, appearance = problems.make_surface(2048), problems.make_appearance(4096 if quick else 65536)
            self.templates = compact(dataclasses.replace(templates, surface=surface, appearance=appearance))
            self.encoder = problems.make_encoder(self.channels)
            count = 3 if quick else ANSWERS
            made = [problems.make_query(seed, self.grid, self.channels, noise=NOISE) for seed in range(count)]
        stack = lambda *x: jnp.stack([np.asarray(part) for part in x])
        self.queries, self.truth = (jax.tree.map(stack, *part) for part in zip(*made, strict=True))
        self.keys = jax.random.split(jax.random.key(0), count)
        # Made on the CPU, for it takes thousands of tiny programs, each slow to start on an accelerator.
        on_host = jax.tree.map(np.asarray, (self.templates, self.encoder))
        self.templates, self.encoder = jax.tree.map(jnp.asarray, on_host)

    def compile(self, forms: "Forms") -> dict[Any, tuple[Callable, float, int]]:
        """Compile every function, in as many threads as there are processors.

        Returns for each the compiled function, the seconds of tracing and compiling it (while others were compiled),
        and the bytes of its temporary arrays.
        """

        def build(lowered, seconds):
            start = time.perf_counter()
            compiled = lowered.compile()
            seconds += time.perf_counter() - start
            memory = compiled.memory_analysis()
            return compiled, seconds, int(memory.temp_size_in_bytes) if memory is not None else -1

        jobs = {}
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for key, (function, arguments) in forms.items():
                start = time.perf_counter()
                # A new function each time, or JAX would find one that was compiled before.
                lowered = jax.jit(lambda *a, function=function: function(*a)).lower(*arguments)
                jobs[key] = pool.submit(build, lowered, time.perf_counter() - start)
        return {key: job.result() for key, job in jobs.items()}

    def load_dinov2(self, dtype: str) -> Encoder:
        """The encoder of the given weights, or of random ones."""
        if self.weights:
            return load_encoder(self.weights, dtype=dtype)
        tiny = DinoV2Config(width=32, depth=2, heads=2, hidden=64, grid=4, dtype=dtype)
        shape = tiny if self.quick else find_preset(PRESET, dtype)
        return Encoder(DinoV2(shape, rngs=nnx.Rngs(0)), min(BLOCK, shape.depth - 1))

    def take_batch(self, count: int):
        """So many queries and their keys, repeated if need be; a single one has no batch axis."""
        if count == 1:
            return take(self.queries, 0), self.keys[0]
        resize = lambda x: jnp.resize(x, (count, *x.shape[1:]))
        return jax.tree.map(resize, self.queries), self.keys[np.arange(count) % len(self.keys)]


Forms = dict[Any, tuple[Callable, tuple]]


def answers(session: Session) -> Iterator[dict[str, Any]]:
    """How far the poses found here are from the truth, and from those of the answers' file."""
    truth, keys = session.truth, session.keys
    arguments = session.encoder, session.templates, session.queries, keys, Config()
    calls = [(*arguments[:2], take(session.queries, i), keys[i], Config()) for i in range(len(keys))]
    single, seconds, temporary = compile_fresh(estimate, *calls[0])
    yield {"what": "estimate, compiled alone", "seconds": seconds, "temporary_bytes": temporary}
    found = jax.tree.map(lambda *x: np.stack(x), *[single(*call) for call in calls])
    again = single(*calls[0])
    same = all(np.array_equal(x[0], y) for x, y in zip(*map(jax.tree.leaves, (found, again)), strict=True))
    yield {"what": "the same call once more", "identical": same}
    yield {"what": "estimate"} | time_call(lambda: single(*calls[0]), session.seconds, 1)
    confidence = {"one by one": found.confidence}
    poses = {"one by one": found.camera_from_object, "truth": truth}
    if session.answers and session.answers.exists():
        with np.load(session.answers, allow_pickle=False) as file:
            if "rotation" in file:
                poses["the file's"] = dataclasses.replace(truth, **{name: file[name] for name in POSE})
                confidence["the file's"] = file["confidence"]
                yield {"what": f"the file's answers are of {file['made']}"}
    elif session.answers:
        arrays = {name: getattr(found.camera_from_object, name) for name in POSE}
        keep(session.answers, confidence=found.confidence, **arrays)

    def compare(*names: str) -> Iterator[dict[str, Any]]:
        for name, other in PAIRS:
            if name in poses and other in poses and name in names:
                differ = differences(poses[name], poses[other], confidence, name, other)
                yield {"what": f"{name}, from {other}", **differ}

    yield from compare("one by one", "the file's")
    yield from features(session, session.queries.view.rgb[:4])
    function, *_ = compile_fresh(jax.vmap(estimate, MAPPED), *arguments)
    together = function(*arguments)
    poses["all at once"], confidence["all at once"] = together.camera_from_object, together.confidence
    yield from compare("all at once")


def features(session: Session, images) -> Iterator[dict[str, Any]]:
    """DINOv2's features of a few images: float32 against those of the file, and bfloat16 against float32."""
    encode = jax.jit(lambda encoder, images: encoder(images))
    found = {dtype: np.asarray(encode(session.load_dinov2(dtype), images)) for dtype in ("float32", "bfloat16")}
    if session.answers:
        with np.load(session.answers, allow_pickle=False) as file:
            known = file.get("features")
        if known is None:
            keep(session.answers, features=found["float32"])
        else:
            found["the file's"] = known
    for name, other in (("float32", "the file's"), ("bfloat16", "float32")):
        if other in found:
            one, two = (np.asarray(found[x], np.float64) for x in (name, other))
            error = float(np.linalg.norm(one - two) / np.linalg.norm(two))
            least = float(np.min(np.sum(one * two, axis=-1)))
            yield {"what": f"features in {name}, from {other}", "error": error, "least_cosine": least}


POSE = ("rotation", "translation", "scale")
PAIRS = [
    ("one by one", "truth"),
    ("the file's", "truth"),
    ("one by one", "the file's"),
    ("all at once", "one by one"),
]
MAPPED = (None, None, 0, 0, None)


def take(tree, index: int):
    """One of a stack."""
    return jax.tree.map(lambda x: x[index], tree)


def keep(path: Path, **arrays) -> None:
    """Add arrays to a file of them, and what they were made on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    known = dict(np.load(path, allow_pickle=False)) if path.exists() else {}
    device = describe_device()
    made = f"{device['device']} ({device['platform']}), jax {device['jax']}, commit {commit()}"
    with writing(path) as temporary:
        np.savez_compressed(temporary, **known | {name: np.asarray(x) for name, x in arrays.items()} | {"made": made})


def differences(poses, others, confidence, name, other) -> dict[str, float]:
    """Median and largest: degrees, up to the ellipsoid's half-turns, and place and size in % of the size."""
    one, two = (np.asarray(x.rotation, np.float64) for x in (poses, others))
    turns = [np.diag(s) for s in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
    # By the chord, which is accurate for small angles, where the trace is not.
    chords = np.min([np.linalg.norm(one @ t - two, axis=(1, 2)) for t in turns], axis=0)
    angle = np.degrees(2 * np.arcsin(np.clip(chords / 8**0.5, 0, 1)))
    scale = np.asarray(others.scale, np.float64)
    place = 100 * np.linalg.norm(np.asarray(poses.translation, np.float64) - others.translation, axis=1) / scale
    size = 100 * np.abs(np.asarray(poses.scale) / scale - 1)
    found = {}
    for kind, values in {"rotation_deg": angle, "place_percent": place, "size_percent": size}.items():
        found |= {f"{kind}_median": float(np.median(values)), f"{kind}_most": float(np.max(values))}
    if name in confidence and other in confidence:
        found["confidence_most"] = float(np.max(np.abs(np.asarray(confidence[name]) - confidence[other])))
    return found


def queries(session: Session) -> Iterator[dict[str, Any]]:
    """Estimates of one query and of many; without an encoder nothing is drawn."""
    forms = {}
    for batch in (1, *session.batches):
        made = session.take_batch(batch)
        for name, config, encoder in (
            ("Config(), candidates drawn", Config(), session.encoder),
            ("Config()", Config(), None),
            ("Config.fast()", Config.fast(), None),
            ("Config.paper()", Config.paper(), None),
        ):
            # One form is timed at every size, the others alone.
            if encoder is not None or batch == 1:
                function = estimate if batch == 1 else jax.vmap(estimate, MAPPED)
                forms[f"estimate, {name}", batch] = function, (encoder, session.templates, *made, config)
    yield from time_forms(session, forms)
    if session.trace:
        call = next(iter(forms.values()))
        compiled = jax.jit(call[0]).lower(*call[1]).compile()
        jax.block_until_ready(compiled(*call[1]))
        with jax.profiler.trace(str(session.trace), create_perfetto_trace=True):
            for _ in range(2):
                jax.block_until_ready(compiled(*call[1]))


def staged(session: Session) -> Iterator[dict[str, Any]]:
    """The stages of `Config()`, each compiled alone; `estimate` refines and scores two rounds of hypotheses."""
    templates, config, forms = session.templates, Config(), {}
    shapes = jax.eval_shape(stages.hypotheses, templates, *session.take_batch(1))
    rng, count = np.random.default_rng(0), shapes.scale.shape[0]
    near = jax.tree.map(lambda x, like: jnp.broadcast_to(x, like.shape), take(session.truth, 0), shapes)
    turned = Rotation.from_rotvec(rng.normal(0, 0.1, (count, 3))).as_matrix() @ np.asarray(near.rotation)
    moved = near.translation + 0.03 * near.scale[:, None] * rng.normal(size=(count, 3))
    poses = dataclasses.replace(
        near, rotation=jnp.asarray(turned, jnp.float32), translation=jnp.asarray(moved, jnp.float32)
    )
    for batch in (1, session.staged):
        made, keys = session.take_batch(batch)
        start = poses
        if batch > 1:
            start = jax.tree.map(lambda x, batch=batch: jnp.broadcast_to(x, (batch, *x.shape)), poses)
        for name, stage, arguments in (
            ("match", stages.match_only, (templates, made, config)),
            ("match + select + align", stages.front, (templates, made, keys, config)),
            ("refine, one round", stages.refine_all, (templates, made, start, config)),
            ("score, one round", stages.score_all, (templates, made, start, config)),
        ):
            axes = tuple(None if x is templates or x is config else 0 for x in arguments)
            forms[name, batch] = stage if batch == 1 else jax.vmap(stage, axes), arguments
    yield from time_forms(session, forms)


def encoders(session: Session) -> Iterator[dict[str, Any]]:
    """DINOv2 alone and in whole queries, which describe the crop and draw six candidates with it."""
    forms = {}
    for dtype in ("float32", "bfloat16"):
        encoder = session.load_dinov2(dtype)
        both = StandInWithDinov2(session.encoder, encoder)
        for batch in (1, session.staged):
            made, keys = session.take_batch(batch)
            one = observe if batch == 1 else jax.vmap(observe, (None, 0))
            forms[f"observe, {dtype} encoder", batch] = one, (encoder, made.view)
            one = whole if batch == 1 else jax.vmap(whole, (None, None, 0, 0, None, None))
            arguments = both, session.templates, made.view, keys, Config(), None
            forms[f"whole query, Config(), {dtype} encoder", batch] = one, arguments
    yield from time_forms(session, forms)


def time_forms(session: Session, forms: Forms) -> Iterator[dict[str, Any]]:
    """A row of each, by its name and the number of its queries; those of one number are compiled together."""
    for many in sorted({batch for _, batch in forms}):
        group = {key: form for key, form in forms.items() if key[1] == many}
        for (name, batch), (compiled, seconds, temporary) in session.compile(group).items():
            row = {"what": name, "batch": batch, "compile_s": seconds, "temporary_bytes": temporary}
            yield row | time_call(partial(compiled, *forms[name, batch][1]), session.seconds, batch)


def searches(session: Session) -> Iterator[dict[str, Any]]:
    """The kernel's forms; GFLOP/s count the product of all patches."""
    sizes = [(5, 64, 32, "bfloat16")] if session.quick else SIZES
    for views, patches, channels, dtype in sizes:
        arguments, found, base = neighbours.problem(views, patches, channels), {}, 1.0
        where = {"size": f"{views} × {patches}² × {channels}", "dtype": dtype}
        forms = {
            "nearest (xla)": partial(nearest, dtype=dtype, compact=False),
            "one large product": partial(neighbours.large_product, dtype=dtype),
        }
        if dtype == "bfloat16":
            forms["nearest (pallas)"] = partial(nearest, dtype=dtype, implementation="pallas")
        built = session.compile({name: (form, arguments) for name, form in forms.items()})
        for name, (compiled, seconds, temporary) in built.items():
            call = partial(compiled, *arguments)
            row = {"what": name, **where, "compile_s": seconds, "temporary_bytes": temporary}
            row |= time_call(call, session.seconds / 4, 1)
            row["gflop_per_s"] = 2e-6 * views * patches**2 * channels / row["in_a_row_ms"]
            base = row["in_a_row_ms"] if name == "nearest (xla)" else base
            if name in ("nearest (xla)", "nearest (pallas)"):
                found[name] = call()
            yield row | {"ratio": row["in_a_row_ms"] / base}
        if len(found) == 2:
            plain, fused = found.values()
            for index, similarity, side in ((0, 1, "to templates"), (2, 3, "to the query")):
                differ = float(np.mean(np.asarray(plain[index] != fused[index])))
                most = float(np.max(np.abs(np.asarray(plain[similarity] - fused[similarity]))))
                row = {"what": f"pallas beside xla, {side}", **where, "indices_differ": differ}
                yield row | {"similarity_most": most}


def time_call(call: Callable[[], Any], seconds: float, batch: int) -> dict[str, float]:
    """Milliseconds of a call that is waited for, and of each of several of which only the last is."""
    jax.block_until_ready(call())
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < 3 or (time.perf_counter() - begin < seconds and len(times) < 1000):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    count = max(3, min(int(seconds / np.median(times)), 1000))
    start = time.perf_counter()
    for _ in range(count - 1):
        call()
    jax.block_until_ready(call())
    each = (time.perf_counter() - start) / count
    return summarise(times) | {"in_a_row_ms": 1e3 * each, "queries_per_s": batch / each}


RUN = {"answers": answers, "queries": queries, "stages": staged, "encoder": encoders, "neighbours": searches}
TITLES = {
    "answers": "The same answers?",
    "queries": "Estimates",
    "stages": "Stages of `Config()`",
    "encoder": "With DINOv2 S/14",
    "neighbours": "Nearest neighbours",
}
MEGABYTES = lambda x: f"{x / 2**20:.3g} MiB"
CELLS = {  # column → field, how it is written
    "what": ("what", str),
    "size": ("size", str),
    "dtype": ("dtype", str),
    "at once": ("batch", str),
    "one by one": ("median_ms", lambda x: f"{x:.3g} ms"),
    "in a row": ("in_a_row_ms", lambda x: f"{x:.3g} ms"),
    "queries/s": ("queries_per_s", lambda x: f"{x:.3g}"),
    "GFLOP/s": ("gflop_per_s", lambda x: f"{x:.0f}"),
    "beside xla": ("ratio", lambda x: f"{x:.2f} ×"),
    "indices that differ": ("indices_differ", lambda x: f"{100 * x:.2g} %"),
    "similarities differ by": ("similarity_most", lambda x: f"{x:.1g}"),
    "rotation, median": ("rotation_deg_median", lambda x: f"{x:.3g}°"),
    "most": ("rotation_deg_most", lambda x: f"{x:.3g}°"),
    "place, median": ("place_percent_median", lambda x: f"{x:.3g} %"),
    "most ": ("place_percent_most", lambda x: f"{x:.3g} %"),
    "size, median": ("size_percent_median", lambda x: f"{x:.3g} %"),
    " most": ("size_percent_most", lambda x: f"{x:.3g} %"),
    "confidence, most": ("confidence_most", lambda x: f"{x:.2g}"),
    "identical": ("identical", lambda x: "yes" if x else "no"),
    "error": ("error", lambda x: f"{x:.2g}"),
    "least cosine": ("least_cosine", lambda x: f"{x:.6f}"),
    "seconds": ("seconds", lambda x: f"{x:.3g}"),
    "compiled": ("compile_s", lambda x: f"{x:.2g} s"),
    "temporary": ("temporary_bytes", MEGABYTES),
}


def render(results: dict[str, Any]) -> str:
    """The page: a heading that says what was measured on what, and a table for each part."""
    lines = [
        f"**{results['device']}** ({results['platform']}, {results['cores']} processor cores), jax {results['jax']}, "
        f"Python {results['python']}, {results['date']}, commit {results['commit']}"
        + (" — quick run, small sizes" if results["quick"] else ""),
        "",
        f"Measured by `{results['command']}`, in {results['seconds']:.0f} s. "
        "Forms of one part and one number of queries were compiled in parallel; the seconds of compiling are of each "
        "beside the others. "
        "“One by one” is the median of calls each of which is waited for, “in a row” the mean of calls of which only "
        "the last is.",
    ]
    for part, rows in results["parts"].items():
        columns = [c for c, (field, _) in CELLS.items() if any(field in row for row in rows)]
        if part == "neighbours":
            columns.remove("queries/s")
        lines += ["", f"## {TITLES[part]}", "", "| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
        for row in rows:
            cells = [CELLS[c][1](row[CELLS[c][0]]) if CELLS[c][0] in row else "" for c in columns]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print as it goes, and write what was asked for after every row: a run cut short keeps its rows."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.accelerator",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", choices=PARTS, action="append", help="measure this part; may be repeated")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write a page of Markdown here")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results here")
    parser.add_argument("--answers", type=Path, metavar="FILE", help="npz: write answers here, or compare with those")
    parser.add_argument("--weights", help="of the encoder (default: random ones)")
    parser.add_argument("--trace", type=Path, metavar="FOLDER", help="write a profile of two estimates here")
    parser.add_argument("--batches", type=int, nargs="+", help="queries at once (default: 8 32 128)")
    parser.add_argument("--commit", help="what to call the code where there is no git (default: ask git)")
    parser.add_argument("--quick", action="store_true", help="small sizes, few runs: does it work?")
    options = parser.parse_args()
    if options.answers and options.answers.suffix != ".npz":
        parser.error(f"{options.answers}: answers are an npz file")
    begin = time.perf_counter()
    only = "".join(f" --only {part}" for part in options.only or [])
    results: dict[str, Any] = {**describe_device(), "date": time.strftime("%Y-%m-%d"), "quick": options.quick}
    results |= {"commit": options.commit or commit(), "parts": {}}
    flags = f"XLA_FLAGS={os.environ['XLA_FLAGS']} " if os.environ.get("XLA_FLAGS") else ""
    given = " --answers FILE" * bool(options.answers) + " --weights FILE" * bool(options.weights)
    results["command"] = f"{flags}python -m benchmarks.accelerator{only}{given}"
    session = Session(options.quick, options.answers, options.weights, options.trace, options.batches)
    print(
        f"{results['device']}, jax {results['jax']}; problems made in {time.perf_counter() - begin:.0f} s", flush=True
    )
    for part in PARTS:
        if part not in (options.only or PARTS):
            continue
        for row in RUN[part](session):
            results["parts"].setdefault(part, []).append(row)
            results["seconds"] = time.perf_counter() - begin
            values = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items() if k != "what"}
            print(f"[{results['seconds']:4.0f} s] {part}: {row['what']}: {values}", flush=True)
            if options.json:
                write_text(options.json, json.dumps(results, indent=1, ensure_ascii=False) + "\n", parents=True)
            if options.page:
                write_text(options.page, render(results), parents=True)
    print("\n" + render(results))


if __name__ == "__main__":
    main()

"""What labelling a frame costs, stage by stage, what bounds it, and what follows for many frames and devices.

    python -m benchmarks.labelling_costs [--page benchmarks/results/labelling_costs.md]

FLOP and bytes are XLA's (`cost_analysis` of the compiled stages), but with loops counted as often as they are run
(`benchmarks.counting`).
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from flax import nnx

from benchmarks.counting import NOTHING, Cost, counted
from benchmarks.measure import commit, describe_device
from benchmarks.queries import BLOCK, PRESET, StandInWithDinov2, whole
from benchmarks.stages import match_only, refine_all, score_all
from ipjax.config import Config
from ipjax.detection.masks import mask_from_pose
from ipjax.estimation.alignment import align
from ipjax.estimation.features import describe
from ipjax.estimation.matching import select
from ipjax.estimation.pipeline import apparent_diameter
from ipjax.estimation.scene import SceneGrid
from ipjax.estimation.scoring import score, score_drawn
from ipjax.files.images.run_lengths import encode_rle
from ipjax.files.storage.writing import write_text
from ipjax.inference.batching import compact
from ipjax.inference.frames import frame_turned
from ipjax.networks.dinov2 import DinoV2, Encoder, find_preset
from ipjax.records import Query
from ipjax.synthetic import problems

PAGE = Path(__file__).with_name("results") / "labelling_costs.md"
SHORTLIST = 50
PAPER_DAYS = 45  # days of one GPU for a million frames of one object, as the paper says
DEVICES = (1, 8, 64)


def spent(call: Callable[[], Any], least: float = 1.0, most: int = 12) -> float:
    """Median seconds that the process works for one call, on all cores together: other work does not lengthen them."""
    jax.block_until_ready(call())
    took: list[float] = []
    while len(took) < 3 or (sum(took) < least and len(took) < most):
        start = time.process_time()
        jax.block_until_ready(call())
        took.append(time.process_time() - start)
    return statistics.median(took)


@dataclasses.dataclass(frozen=True)
class Row:
    """A stage: what it costs for one object in one frame, and the seconds of a core that it took."""

    name: str
    cost: Cost | None  # None = not compiled by XLA, or by several programs
    seconds: float


def measure(name: str, function: Callable, *arguments: Any, repeats: int = 1) -> Row:
    """A compiled stage; ``repeats`` of it are done for one object in one frame."""
    lowered = jax.jit(function).lower(*arguments)
    compiled = lowered.compile()
    cost = counted(function, *arguments, programs=(lowered, compiled)).times(repeats)
    seconds = repeats * spent(lambda: compiled(*arguments))
    print(f"{name}: {cost.flop / 1e9:.3g} GFLOP, {cost.bytes / 1e6:.3g} MB, {seconds:.3g} s", flush=True)
    return Row(name, cost, seconds)


def make_object(views: int, channels: int):
    """Templates of the ellipsoid, compacted; features do not change what they cost."""
    templates = problems.make_templates(max(views // 10, 1), min(views, 10), grid=16, channels=channels)
    features = templates.patches.features.astype(jnp.float16)
    templates = dataclasses.replace(
        templates,
        patches=eqx.tree_at(lambda p: p.features, templates.patches, features),
        surface=problems.make_surface(2048),
        appearance=problems.make_appearance(65536),
    )
    return compact(templates, multiple=64)


def describe_and_draw(templates: Any, query: Query, pose: Any, encoder: Any, config: Config) -> list[Row]:
    """The stages in which the encoder runs."""
    rows = [measure("describe: DINOv2 S/14 of 224² pixels", lambda e, v: describe(e, v), encoder, query.view)]
    scene = SceneGrid(query, config.score.resolution, config.refine.silhouette)
    undrawn = jax.jit(partial(_rate, config=config))(templates, query, scene, pose)
    name = f"draw and describe again, {config.score.drawn} candidates"
    drawn = lambda e, t, q, p, u: score_drawn(e, t, q, p, u, config.score)
    return [*rows, measure(name, drawn, encoder, templates, query, pose, undrawn, repeats=config.score.drawn)]


def _rate(templates: Any, query: Query, scene: SceneGrid, pose: Any, *, config: Config) -> Any:
    camera = scene.cloud.camera
    return score(None, templates, query, scene.depth, scene.mask, camera, pose, config.score)[1]


def measure_stages(encoder: Any, views: int, channels: int, config: Config) -> list[Row]:
    """All that is done for one object in one frame, with a shortlist of templates."""
    frame = problems.make_frame(0, 480, 640)
    templates = make_object(views, channels)
    query, truth = problems.make_query(0, grid=16, channels=channels, noise=0.3)
    key = jax.random.key(0)
    cut = lambda: frame_turned(frame.rgb, frame.depth, frame.mask, frame.matrix, resolution=224)[0]
    rows = [Row("crop of 640 × 480 pixels (host)", None, spent(cut))]
    described, *drawn = describe_and_draw(templates, query, truth, encoder, config)
    rows += [described, measure(_match_name(views, config), partial(match_only, config=config), templates, query)]
    matches = jax.jit(partial(match_only, config=config))(templates, query)
    pick = lambda m, q, t: select(m, q, t, config.match)
    rows.append(measure("select pairs", pick, matches, query.patches, templates))
    pairs = jax.jit(pick)(matches, query.patches, templates)
    size = apparent_diameter(templates, query)[matches.view]
    fit = lambda p, s, k: align(p, s, k, config.align)
    rows.append(measure(f"align, {config.match.views} templates × {config.align.count} samples", fit, pairs, size, key))
    poses = jax.jit(fit)(pairs, size, key)[0]
    refined = f"refine, {poses.scale.shape[0]} hypotheses × {config.refine.steps} steps"
    rows.append(measure(refined, partial(refine_all, config=config), templates, query, poses))
    rated = f"score, {poses.scale.shape[0]} hypotheses"
    rows += [measure(rated, partial(score_all, config=config), templates, query, poses), *drawn]

    def tell():
        visible, _ = mask_from_pose(templates, frame.camera_from_object, frame.matrix, frame.depth)
        return encode_rle(visible)["counts"]

    return [*rows, Row("visible mask in 640 × 480 pixels, run lengths", None, spent(tell))]


def measure_whole(encoder: Any, views: int, channels: int, config: Config) -> float:
    """Seconds of a core for describing a crop and estimating, as one program."""
    query, _ = problems.make_query(0, grid=16, channels=channels, noise=0.3)
    arguments = encoder, make_object(views, channels), query.view, jax.random.key(0), config, None
    compiled = jax.jit(whole).lower(*arguments).compile()
    seconds = spent(lambda: compiled(*arguments))
    print(f"as one program: {seconds:.3g} s", flush=True)
    return seconds


def _match_name(views: int, config: Config) -> str:
    among = views if config.match.shortlist is None else f"{config.match.shortlist} of {views}"
    return f"match, {among} templates"


def measure_growth(counts: tuple[int, ...], channels: int) -> list[tuple[int, Row, Row]]:
    """Matching against more and more templates: all of them, and a shortlist."""
    query, _ = problems.make_query(0, grid=16, channels=channels, noise=0.3)
    found = []
    for views in counts:
        templates = make_object(views, channels)
        rows = []
        for shortlist in (None, SHORTLIST):
            config = with_shortlist(Config.fast(), shortlist)
            rows.append(measure(_match_name(views, config), partial(match_only, config=config), templates, query))
        found.append((views, *rows))
    return found


def with_shortlist(config: Config, shortlist: int | None) -> Config:
    """The settings, with so many templates searched patch by patch."""
    return dataclasses.replace(config, match=dataclasses.replace(config.match, shortlist=shortlist))


def measure_roof() -> tuple[float, float]:
    """FLOP/s and bytes/s of one core at work: a product of 2048² float32 matrices, and 1 added to 256 MB in place."""
    matrix, place = jnp.ones((2048, 2048)), [jnp.ones(2**26)]
    product, add = jax.jit(lambda x: x @ x), jax.jit(lambda x: x + 1, donate_argnums=0)

    def step() -> Any:
        place[0] = add(place[0])
        return place[0]

    moved = 2 * place[0].nbytes
    return 2 * 2048**3 / spent(lambda: product(matrix)), moved / spent(step)


def bound(row: Row, flop_rate: float, byte_rate: float) -> str:
    """What bounds a stage: arithmetic, memory, or neither, and how much of what that allows it reaches."""
    if row.cost is None or not row.cost.bytes:
        return "–"
    arithmetic, memory = row.cost.flop / flop_rate, row.cost.bytes / byte_rate
    share = max(arithmetic, memory) / row.seconds
    what = "arithmetic" if arithmetic > memory else "memory"
    return f"{what}, {100 * share:.0f} %" if share >= 0.2 else f"neither ({what}, {100 * share:.1f} %): small steps"


def table(heads: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of Markdown."""
    return ["| " + " | ".join(row) + " |" for row in (heads, ["---"] * len(heads), *rows)]


def stage_lines(rows: list[Row], flop_rate: float, byte_rate: float) -> list[str]:
    """The table of stages, and their sum."""
    cells = []
    for row in rows:
        cost = row.cost
        known = ["–"] * 3 if cost is None else [f"{cost.flop / 1e9:.3g}", f"{cost.bytes / 1e6:.3g}", _intensity(cost)]
        cells.append([row.name, *known, f"{1e3 * row.seconds:.3g}", bound(row, flop_rate, byte_rate)])
    costs = [row.cost for row in rows if row.cost is not None]
    total, seconds = sum(costs, NOTHING), sum(row.seconds for row in rows)
    known = [f"{total.flop / 1e9:.3g}", f"{total.bytes / 1e6:.3g}", _intensity(total)]
    cells.append(["**all**", *known, f"{1e3 * seconds:.3g}", ""])
    return table(["stage", "GFLOP", "MB", "FLOP per byte", "ms of a core", "bound by, share of it reached"], cells)


def _intensity(cost: Cost) -> str:
    return f"{cost.flop / cost.bytes:.2g}" if cost.bytes else "–"


def growth_lines(growth: list[tuple[int, Row, Row]]) -> list[str]:
    """The table of matching against more templates."""
    cells = []
    for views, *rows in growth:
        cells.append([str(views)])
        for row in rows:
            cells[-1] += [f"{row.cost.flop / 1e9:.3g}", f"{row.cost.bytes / 1e6:.3g}", f"{1e3 * row.seconds:.3g}"]
    kinds = [f"{what}, {kind}" for kind in ("all", f"shortlist of {SHORTLIST}") for what in ("GFLOP", "MB", "ms")]
    return table(["templates", *kinds], cells)


def hour_lines(seconds: float, cores: int, objects: tuple[int, ...] = (1, 3, 10)) -> list[str]:
    """Frames an hour by objects in a frame and devices: arithmetic, from the seconds of a core for each object."""
    cells = []
    for count in objects:
        per_hour = 3600 * cores / (count * seconds)
        days = 1e6 / per_hour / 24
        cells.append([str(count), *[f"{number * per_hour:,.0f}" for number in DEVICES], f"{days:.3g}"])
    heads = ["objects in a frame", *[f"{n} device{'s' if n > 1 else ''}" for n in DEVICES]]
    return table([*heads, "days of one device for a million frames"], cells)


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.labelling_costs", description=__doc__.split("\n")[0])
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--quick", action="store_true", help="few templates: does it work?")
    options = parser.parse_args()
    channels, views, counts = (384, 400, (50, 100, 200, 400, 800)) if not options.quick else (384, 60, (60,))
    device = describe_device()
    config = with_shortlist(Config.fast(), SHORTLIST)
    flop_rate, byte_rate = measure_roof()
    model = DinoV2(find_preset(PRESET, "float32"), rngs=nnx.Rngs(0))
    encoder = StandInWithDinov2(problems.make_encoder(channels), Encoder(model, BLOCK))
    rows = measure_stages(encoder, views, channels, config)
    growth = measure_growth(counts, channels)
    together = measure_whole(encoder, views, channels, config)
    apart = sum(row.seconds for row in rows if row.cost is not None)
    seconds = together + sum(row.seconds for row in rows if row.cost is None)
    lines = [
        "# What labelling costs",
        "",
        f"Made by `python -m benchmarks.labelling_costs`; do not edit by hand. {device['device']}, {device['cores']} "
        f"cores, jax {device['jax']}, Python {device['python']}, {time.strftime('%Y-%m-%d')}, commit {commit()}.",
        "",
        "## One object in one frame",
        "",
        f"`Config.fast()` with a shortlist of {SHORTLIST}, {views} templates, {channels} channels, an ellipsoid, masks "
        "given, random weights of DINOv2 S/14. Milliseconds are of one core at work, those of all threads added up: "
        "other work on the machine does not lengthen them as it does the clock's. GFLOP and MB are XLA's "
        "`cost_analysis` (of the traced and of the compiled program), with the body of each loop as often as it is "
        "run; the drawing's loop, whose end depends on the data, counts once, and of the sizes that matching is "
        "compiled for the one that this query takes. What bounds a stage: a product of "
        f"2048² matrices does {flop_rate / 1e9:.3g} GFLOP/s for each core at work, and adding to 256 MB in place "
        f"moves {byte_rate / 1e9:.3g} GB/s: {flop_rate / byte_rate:.2g} FLOP per byte is where the two meet. What the "
        "caches hold goes faster than that, and its share can exceed 100 %.",
        "",
        *stage_lines(rows, flop_rate, byte_rate),
        "",
        f"The stages were compiled apart, so that they can be told apart: {1e3 * apart:.3g} ms without crop and "
        "visible mask. As one program, as labels are made, with confidence and covariance, they take "
        f"{1e3 * together:.3g} ms.",
        "",
        "## More templates, more objects",
        "",
        "Only matching grows with the number of templates:",
        "",
        *growth_lines(growth),
        "",
        "Where masks are given, every object in a frame costs what the first one does, its crop and its description "
        "included, and objects that are not in the frame cost nothing. They share one compiled program.",
        "",
        "## Frames an hour",
        "",
        f"Arithmetic, not measured: {seconds:.3g} s of a core for each object in a frame, all "
        f"{device['cores']} cores of the device always at work, and devices that exchange nothing (frames do not "
        "depend on one another). A device is this machine. The paper's rate, "
        f"{PAPER_DAYS} days of one GPU for a million frames of one object, is {1e6 / PAPER_DAYS / 24:,.0f} frames an "
        f"hour, {PAPER_DAYS * 86400 / 1e6:.2g} s each, on another machine and with other settings.",
        "",
        *hour_lines(seconds, int(device["cores"])),
    ]
    write_text(options.page, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()

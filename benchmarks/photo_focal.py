"""What a wrong focal length of the photo costs, for objects from a photo without depth.

    python -m benchmarks.photo_focal [--data FOLDER] [--pairs 20] [--page benchmarks/results/focal.md]
    python -m benchmarks.photo_focal --table [--page benchmarks/results/focal.md]

The references and queries of `benchmarks.photo_pairs`, of another seed than its page, seen less than 60° apart. Each
object is made several times from the same photo, whose camera is said to have so many times its true focal length, and
once with none given, so that it is guessed.

A camera with k times the focal length shows the same object from k times as far, along another ray. The truth that
poses are compared with is moved and turned so: what has no meaning without the true camera (where the photo's camera
stood, and the angle between its axis and the object) is no error. Sizes are compared in metres.

Results are lines of JSON, written as they come: run again to go on.
"""

import argparse
import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from benchmarks.pairs import Group, rigid, synthetic_groups, view_angle
from benchmarks.photo_pairs import judge, states
from ipjax.cameras import look_at, project
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines, write_text

FACTORS = (0.6, 0.8, 1.0, 1.25, 1.6)
GUESSED = "none"  # no camera is given
SEED = 7  # the page of pairs has 0
WIDEST = 60.0  # degrees between the two views
QUERIES = 6  # made for each reference; those seen from farther away are left out


def choose(groups: Iterable[Group], pairs: int) -> list[Group]:
    """The first groups with ``pairs`` queries seen less than `WIDEST` from their reference; other queries left out."""
    chosen, left = [], pairs
    for group in groups:
        near = [query for query in group.queries if view_angle(group.reference, query) < WIDEST][:left]
        if near:
            chosen.append(dataclasses.replace(group, queries=near))
        left -= len(near)
        if left <= 0:
            break
    return chosen


def refocus(matrix: np.ndarray, factor: float) -> np.ndarray:
    """K with ``factor`` times the focal lengths, and the same centre."""
    return np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]]) * matrix


def in_told_camera(group: Group, told: np.ndarray) -> Group:
    """The group with its reference's true pose as a camera of another focal length would have seen the same photo."""
    pose, matrix = group.reference.camera_from_object, group.reference.K
    factor = told[0, 0] / matrix[0, 0]
    pixel = project(matrix, pose.translation[None])[0]
    turn = look_at(told, pixel) @ look_at(matrix, pixel).T
    # As wide in pixels: k times as far, and as far beside the axis.
    moved = rigid(turn @ pose.rotation, pose.translation * [1, 1, factor])
    return dataclasses.replace(group, reference=dataclasses.replace(group.reference, camera_from_object=moved, K=told))


def run(groups: list[Group], output: Path, weights: str | None = None) -> None:
    """Try every pair with every focal length; lines already in ``output`` are not tried again."""
    from benchmarks.measure import commit
    from ipjax.files.weights.encoder import load_encoder
    from ipjax.inference.compilation_cache import use_compilation_cache
    from ipjax.inference.estimator import Estimator
    from ipjax.onboarding.foreground import Photo
    from ipjax.onboarding.photo import onboard_photo
    from ipjax.records import Camera

    done = {tuple(parse_json(line)["key"]) for line in read_lines(output, repair=True)} if output.exists() else set()
    use_compilation_cache()
    encoder = load_encoder(weights)
    estimator = Estimator([], encoder)
    state = commit()
    for group in groups:
        ref = group.reference
        for told in (*FACTORS, GUESSED):
            keys = [(str(told), group.object, query.name) for query in group.queries]
            if all(key in done for key in keys):
                continue
            camera = None if told == GUESSED else Camera.from_matrix(refocus(ref.K, float(told)))
            made = onboard_photo(Photo(ref.rgb), encoder, mask=ref.mask, lrm="inflate", progress=False, camera=camera)
            assert made.reconstruction.camera is not None
            matrix = made.reconstruction.camera.to_matrix()
            estimator.objects = [(made.templates, made.info)]
            seen = in_told_camera(group, matrix)
            for key, query in zip(keys, group.queries, strict=True):
                if key in done:
                    continue
                row = {"key": key, "factor": matrix[0, 0] / ref.K[0, 0], "angle": view_angle(ref, query)}
                row |= {"commit": state} | judge(seen, "rgb", estimator, query)
                append_json(output, row)
                text = f"{row['rotation']:.0f}°, size {row['scale']:.2f}" if "scale" in row else row["failure"]
                print(f"{' '.join(key)} at {row['angle']:.0f}°: {text}", flush=True)


def table(rows: list[dict]) -> str:
    """Markdown, a row for each focal length; what was not found counts as a miss, medians are of what was found."""
    lines = [
        "| told × true focal length | pairs | rotation < 15° | median rotation | ADD-S < 10 % | median shift "
        "| median size | size within 10 % | median size error | size error ≤ 2 `scale_std` | ADD-S < 10 %, called "
        "present |",
        "|---|" + "---:|" * 10,
    ]
    for told in (*map(str, FACTORS), GUESSED):
        chosen = [row for row in rows if row["key"][0] == told]
        if not chosen:
            continue
        good = [row for row in chosen if "scale" in row]
        share = lambda test, good=good, chosen=chosen: f"{sum(map(test, good)) / len(chosen):.0%}"
        middle = lambda value, good=good: float(np.median([value(row) for row in good])) if good else np.nan
        sure = [row for row in good if row["confidence"] >= 0.5]
        right = f"{sum(row['add_s'] < 0.1 for row in sure)} of {len(sure)}"
        factors = sorted({round(row["factor"], 2) for row in chosen})
        name = told if told != GUESSED else f"guessed: {factors[0]:.2f} to {factors[-1]:.2f}"
        lines.append(
            f"| {name} | {len(chosen)} | {share(lambda r: r['rotation'] < 15)} "
            f"| {middle(lambda r: r['rotation']):.1f}° | {share(lambda r: r['add_s'] < 0.1)} "
            f"| {middle(lambda r: r['translation_mm']):.0f} mm | {middle(lambda r: r['scale']):.3f} "
            f"| {share(lambda r: abs(r['scale'] - 1) < 0.1)} | {middle(lambda r: abs(r['scale'] - 1)):.1%} "
            f"| {share(lambda r: abs(r['scale_deviations']) <= 2)} | {right} |"
        )
    return "\n".join(lines)


def compare(rows: list[dict]) -> str:
    """Markdown: by how much size and place change with the focal length, pair by pair against the true one."""
    true = {tuple(row["key"][1:]): row for row in rows if float(row["factor"]) == 1.0 and row["key"][0] == "1.0"}
    lines = [
        "| told × true focal length | pairs right to 15° with both | median change of rotation error | median ratio of "
        "sizes | middle half of the ratios | median of `scale_std` / size |",
        "|---|" + "---:|" * 5,
    ]
    for told in (*map(str, FACTORS), GUESSED):
        chosen = [(row, true.get(tuple(row["key"][1:]))) for row in rows if row["key"][0] == told and "scale" in row]
        both = [(a, b) for a, b in chosen if b and "scale" in b and max(a["rotation"], b["rotation"]) < 15]
        if not both:
            continue
        ratio = np.array([a["scale"] / b["scale"] for a, b in both])
        change = np.median([a["rotation"] - b["rotation"] for a, b in both])
        # The truth of a pair in units of the deviation that was told: their quotient is that deviation.
        said = np.median([abs((a["scale"] - 1) / a["scale"] / a["scale_deviations"]) for a, _ in both])
        low, high = np.percentile(ratio, [25, 75])
        lines.append(
            f"| {told if told != GUESSED else 'guessed'} | {len(both)} | {change:+.1f}° | {np.median(ratio):.3f} "
            f"| {low:.3f} to {high:.3f} | {said:.3f} |"
        )
    return "\n".join(lines)


def write_page(path: Path, rows: list[dict]) -> None:
    """The tables with what they rest on."""
    from benchmarks.measure import describe_device

    device = describe_device()
    head = [
        "# A wrong focal length of the photo",
        "",
        "Made by `python -m benchmarks.photo_focal`; do not edit by hand. Rendered pairs of `benchmarks.photo_pairs` "
        f"(seed {SEED}) seen less than {WIDEST:.0f}° apart, the photo without depth and its outline inflated, given "
        "masks. The photo's camera is said to have so many times its true focal length; `guessed` is what is assumed "
        "where none is given. The true pose is taken as that camera would have seen the photo (k times as far along "
        "the same pixel's ray), so that only what a user could notice is an error; sizes are in metres, relative to "
        "the true one. Pairs where nothing was found count as misses; medians are of those found.",
        "",
        f"{device['device']}, {device['cores']} cores, jax {device['jax']}, Python {device['python']}, "
        f"commit {states(rows)}.",
        "",
        table(rows),
        "",
        "Pair by pair, against the true focal length:",
        "",
        compare(rows),
    ]
    write_text(path, "\n".join(head) + "\n", parents=True)


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="a BOP data set, whose scans are used beside objects made in code")
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("build/photo_focal.jsonl"), help="lines of JSON")
    parser.add_argument("--page", type=Path, help="write the tables here, too, with what they rest on")
    parser.add_argument("--table", action="store_true", help="measure nothing, show the lines that are there")
    parser.add_argument("--weights", help="of the encoder (default: the best that is here)")
    options = parser.parse_args()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    if not options.table:
        made = synthetic_groups(10 * QUERIES * options.pairs, options.data, SEED, QUERIES)
        run(choose(made, options.pairs), options.output, options.weights)
    rows = [parse_json(line) for line in read_lines(options.output)]
    print(f"\n{table(rows)}\n\n{compare(rows)}")
    if options.page:
        write_page(options.page, rows)


if __name__ == "__main__":
    main()

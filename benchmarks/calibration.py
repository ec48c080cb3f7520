"""``python -m benchmarks.calibration RESULTS.jsonl``: is a confidence of 0.8 right in 80 of 100 cases?

Reads what `benchmarks.photo_pairs synthetic` wrote: objects made in code on cluttered tables, known from their mesh,
from degraded copies of it, from one RGB-D photo and from one photo, sought where they are and behind another object's
mask. Half of the objects fit the numbers of `ConfidenceConfig`, the other half judge those that the code has now. No
object of the real data is among them. Those known from one photo without depth are fitted and judged apart, and printed
only.

    python -m benchmarks.photo_pairs synthetic --queries 5 --pairs 100 --methods rgbd rgb scan level2 level3 \
        --output out/pairs.jsonl
    python -m benchmarks.calibration out/pairs.jsonl --page benchmarks/results/confidence

prints what fits best; with --page it also writes the held-out figures and the reliability diagram.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import optimize, stats

from benchmarks.measure import commit
from benchmarks.photo_pairs import states
from ipjax.config import ConfidenceConfig
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import read_lines, write_text, writing
from ipjax.records import Agreement

PARTS = len(dataclasses.fields(Agreement))
SOURCES = {"scan": "their mesh", "rgbd": "one RGB-D photo", "rgb": "one photo"}
SOURCES |= {f"level{k}": f"their mesh degraded to level {k}" for k in range(1, 5)}
RIGHT = 0.1  # of the diameter: the mean distance of surface points below which a pose counts as right
TURNED = 15.0  # degrees below which it does where the shape is guessed from a photo, and surface points say little


def read(paths: list[Path]) -> list[dict]:
    """The lines of objects made in code, in the order in which they were written."""
    rows = [parse_json(line) for path in paths for line in read_lines(path)]
    rows = [row for row in rows if "agreement" in row and " obj_" not in row["key"][1]]
    if any(len(row["agreement"]) != PARTS or "squared_mahalanobis" not in row for row in rows):
        raise SystemExit("some lines are of an earlier version: run benchmarks.photo_pairs again")
    if not rows:
        raise SystemExit("no line is of an object made in code with an agreement: run benchmarks.photo_pairs synthetic")
    return rows


def split(rows: list[dict]) -> tuple[list[dict], list[dict]]:
    """By object, every other one: those to fit, and those held out."""
    names = sorted({row["key"][1] for row in rows})
    fit = set(names[::2])
    return [row for row in rows if row["key"][1] in fit], [row for row in rows if row["key"][1] not in fit]


def from_photo(row: dict) -> bool:
    """Whether the object was known from a photo without depth, and so found through the photo."""
    return row["key"][0] == "rgb"


def is_right(row: dict) -> bool:
    """Whether the pose is right, for what was known of the object."""
    return row["rotation"] < TURNED if from_photo(row) else row["add"] < RIGHT


def cases(rows: list[dict], *, drawn: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The features of the regression [n 7], whether the pose is right [n], and whether the object was present [n]."""
    found = [(row["agreement"], is_right(row), True) for row in rows]
    found += [(row["absent"]["agreement"], False, False) for row in rows if "agreement" in row.get("absent", {})]
    parts = np.array([agreement for agreement, _, _ in found])
    logs = np.log(np.clip(parts[:, :3], 1e-3, 1))
    others = parts[:, 3:].copy()
    if not drawn:
        logs[:, 2] = others[:, 0] = 0
    features = np.concatenate([np.ones((len(parts), 1)), logs, others], axis=1)
    return features, np.array([right for _, right, _ in found]), np.array([present for _, _, present in found])


# More agreement must not lower a confidence, nor a better rival raise it, however few cases say otherwise.
SIGNS = (0, 1, 1, 1, 1, 1, -1)  # of the weights; 0 = either


def fit_logistic(
    features: np.ndarray, right: np.ndarray, ridge: float = 0.03, signs: Sequence[int] | None = None
) -> np.ndarray:
    """The likeliest weights, with a little shrinkage of all but the first."""
    shrink = ridge * np.array([0.0] + [1.0] * (features.shape[1] - 1))
    sign = np.where(right, -1.0, 1.0)

    def cost(weights):
        logits = np.clip(sign * (features @ weights), -500, 500)
        slope = features.T @ (sign / (1 + np.exp(-logits))) + shrink * weights
        return np.logaddexp(0, logits).sum() + 0.5 * (shrink * weights**2).sum(), slope

    free = {0: (None, None), 1: (0, None), -1: (None, 0)}
    bounds = [free[int(s)] for s in (signs if signs is not None else [0] * features.shape[1])]
    found = optimize.minimize(cost, np.zeros(features.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds)
    return found.x + 0.0  # no −0


RIDGES = (0.03, 0.1, 0.3, 1.0, 3.0)


def choose_ridge(rows: list[dict], *, drawn: bool = True) -> float:
    """The shrinkage of the least log loss, each object predicted from the others."""

    def log_loss(ridge: float) -> float:
        total = 0.0
        for name in sorted({row["key"][1] for row in rows}):
            others = cases([row for row in rows if row["key"][1] != name], drawn=drawn)
            features, right, _ = cases([row for row in rows if row["key"][1] == name], drawn=drawn)
            chance = chances(features, fit_logistic(*others[:2], ridge, SIGNS))
            total -= np.log(np.maximum(np.where(right, chance, 1 - chance), 1e-9)).sum()
        return total

    return min(RIDGES, key=log_loss)


def chances(features: np.ndarray, weights) -> np.ndarray:
    """As `ipjax.estimation.confidence.probability`."""
    return 1 / (1 + np.exp(-np.clip(features @ np.asarray(weights), -30, 30)))


def reliability(chance: np.ndarray, right: np.ndarray, bins: int = 10) -> tuple[float, list[tuple[float, float, int]]]:
    """The expected calibration error, and for each tenth of the scale: mean confidence, share right, count."""
    index = np.minimum((chance * bins).astype(int), bins - 1)
    filled = [index == k for k in range(bins) if (index == k).any()]
    rows = [(float(chance[inside].mean()), float(right[inside].mean()), int(inside.sum())) for inside in filled]
    return sum(abs(said - was) * count for said, was, count in rows) / len(chance), rows


def mahalanobis_lengths(rows: list[dict], config: ConfidenceConfig) -> tuple[np.ndarray, np.ndarray]:
    """Squared Mahalanobis lengths of right poses, and their errors of scale in standard deviations (free scales)."""
    good = [row for row in rows if is_right(row)]
    factor = [config.independent / row["independent"] for row in good]
    squared = np.array([row["squared_mahalanobis"] * f for row, f in zip(good, factor, strict=True)])
    free = [row["scale_deviations"] * f**0.5 for row, f in zip(good, factor, strict=True) if row["scale_free"]]
    return squared, np.array(free)


def main() -> None:
    """Fit, judge, print, and write the page where asked to."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration", description=__doc__.split("\n")[0])
    parser.add_argument("results", type=Path, nargs="+", metavar="RESULTS.jsonl")
    parser.add_argument("--page", type=Path, help="write the page here, without .md and .png")
    options = parser.parse_args()
    rows = read(options.results)
    photos = [row for row in rows if from_photo(row)]
    if photos:
        judge_photos(*split(photos))
    rows = [row for row in rows if not from_photo(row)]
    if not rows:
        if options.page:
            parser.error("the page judges objects that were not known from one photo alone, and no line is of any")
        return
    fit, held = split(rows)
    now = ConfidenceConfig()
    as_text = lambda weights: "(" + ", ".join(f"{w:.2f}" for w in weights) + ")"
    print(f"best for the {len({r['key'][1] for r in fit})} objects to fit:")
    for name, drawn in (("drawn", True), ("undrawn", False)):
        ridge = choose_ridge(fit, drawn=drawn)
        print(f"  {name} = {as_text(fit_logistic(*cases(fit, drawn=drawn)[:2], ridge, SIGNS))}, shrunk by {ridge:g}")
    squared, _ = mahalanobis_lengths(fit, now)
    # By the 90 % ellipsoid: errors have longer tails than a Gaussian, and the tails are what a covariance is asked for.
    factor = stats.chi2.ppf(0.9, 6) / max(float(np.quantile(squared, 0.9)), 1e-9)
    print(f"  independent = {now.independent * factor:.3g}, pair_share = {now.pair_share * factor:.3g}\n")
    text, picture = page(held, now)
    print(text)
    if options.page:
        options.page.parent.mkdir(parents=True, exist_ok=True)
        diagram = f"\n![reliability diagram]({options.page.name}.png)\n"
        write_text(options.page.with_suffix(".md"), text + diagram)
        draw(picture, options.page.with_suffix(".png"))


def judge_photos(fit: list[dict], held: list[dict]) -> None:
    """Print what fits objects from photos without depth best, and how far the present numbers can be trusted."""
    ridge = choose_ridge(fit)
    weights = fit_logistic(*cases(fit)[:2], ridge, SIGNS)
    print(f"best for the {len({r['key'][1] for r in fit})} objects from photos to fit:")
    print(f"  photo = ({', '.join(f'{w:.2f}' for w in weights)}), shrunk by {ridge:g}")
    for name, chosen in (("now", ConfidenceConfig().photo), ("as fitted", weights)):
        features, right, present = cases(held)
        chance = chances(features, chosen)
        called = present & (chance >= ConfidenceConfig().least)
        print(
            f"  {name}: {called.sum()} of {present.sum()} called present, {(called & right).sum()} of them turned by "
            f"less than {TURNED:g}°; absent ones called present: {(chance[~present] >= 0.5).sum()} of "
            f"{(~present).sum()}; expected calibration error {reliability(chance, right)[0]:.3f}"
        )
    print()


def page(held: list[dict], config: ConfidenceConfig) -> tuple[str, list[tuple[float, float, int]]]:
    """The held-out figures in Markdown, and the reliability rows."""
    features, right, present = cases(held)
    chance = chances(features, config.drawn)
    error, rows = reliability(chance, right)
    squared, scales = mahalanobis_lengths(held, config)
    objects = len({row["key"][1] for row in held})
    known = ", ".join(words for method, words in SOURCES.items() if any(row["key"][0] == method for row in held))
    share = lambda chosen: f"{np.mean(chance[chosen] >= config.least):.1%}"
    inside = np.mean(squared < stats.chi2.ppf(0.9, 6))
    lines = [
        "# How far the confidence can be trusted",
        "",
        f"Made by `python -m benchmarks.calibration`, commit {commit()}, from searches by commit {states(held)}: "
        f"{objects} objects made in code "
        f"that fitted nothing, known from {known}; {present.sum()} searches where the object was "
        f"and {(~present).sum()} behind another object's mask. A pose is right if surface "
        f"points are off by less than a tenth of the diameter on average (ADD).",
        "",
        "| what | figure |",
        "|---|---|",
        f"| right among poses of objects that were there | {right[present].mean():.0%} |",
        f"| expected calibration error, ten bins | {error:.3f} |",
        f"| absent objects reported as present (confidence ≥ {config.least:g}) | {share(~present)} |",
        f"| right poses reported as present | {share(right)} |",
        f"| wrong poses of present objects reported as present | {share(present & ~right)} |",
        f"| right poses inside the covariance's 90 % ellipsoid | {inside:.0%} of {len(squared)} |",
    ]
    if len(scales):
        lines.append(
            f"| sizes of right poses within 1.64 standard deviations (90 %) | {np.mean(np.abs(scales) < 1.645):.0%} "
            f"of {len(scales)} |"
        )
    lines += ["", "| confidence said | were right | cases |", "|---|---|---|"]
    lines += [f"| {said:.2f} | {was:.2f} | {count} |" for said, was, count in rows]
    return "\n".join(lines) + "\n", rows


def draw(rows: list[tuple[float, float, int]], path: Path) -> None:
    """The reliability diagram: a well-calibrated confidence lies on the diagonal."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(4.6, 4.2))
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    said, was, count = np.array(rows).T
    axes.scatter(said, was, s=20 + 200 * count / count.max(), color="#2563eb", zorder=3)
    for x, y, n in rows:
        axes.annotate(str(n), (x, y), xytext=(7, -10), textcoords="offset points", fontsize=8, color="0.4")
    axes.set(xlabel="confidence said", ylabel="share right", xlim=(-0.02, 1.05), ylim=(-0.05, 1.05))
    axes.set_title("held-out synthetic scenes; numbers are cases", fontsize=9)
    figure.tight_layout()
    with writing(path) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()

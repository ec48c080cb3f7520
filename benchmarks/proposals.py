"""How well masks that are proposed without knowing any object cover the objects of data sets.

    python -m benchmarks.proposals DATA [DATA …] [--page benchmarks/results/proposals.md]
    python -m benchmarks.proposals --fit 24 [--scans FOLDER]

Each DATA is a data set in BOP's layout. Every instance of an object among its targets is one; its mask is what is
visible of it. Of the best 10, 40, 64, 120 proposals and of all that differ the one that overlaps it best counts.

With `--fit`, the weights of objectness are fitted to made scenes, which hold none of the objects of the data sets, and
printed: `ipjax.detection.proposals.objectness.WEIGHTS` has them.
"""

import argparse
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ipjax.bop.dataset import Dataset
from ipjax.detection.proposals.propose import ProposalConfig, make_all, pool, propose
from ipjax.files.storage.writing import write_text

FIRST = (10, 40, 64, 120)
ALL = 10**6


@dataclasses.dataclass(frozen=True)
class Coverage:
    """One data set."""

    name: str
    best: np.ndarray  # targets × (FIRST and all): the IoU of the best of so many
    frames: int
    proposals: float  # a frame, all that differ
    seconds: float  # of the processor, a frame, for as many proposals as are made by default


def list_frames(dataset: Dataset) -> Iterator[tuple]:
    """Each frame that has targets, with the masks of all instances of them."""
    sought: dict[tuple[int, int], set[int]] = {}
    for target in dataset.targets:
        sought.setdefault((target.scene_id, target.im_id), set()).add(target.obj_id)
    for (scene, image), objects in sought.items():
        truths = dataset.truths(scene, image)
        masks = [dataset.mask(scene, image, truth.index) for truth in truths if truth.obj_id in objects]
        yield dataset.frame(scene, image), [mask for mask in masks if mask.any()]


def overlaps(masks: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """IoU of each of n masks with one."""
    common = (masks & truth).sum((1, 2))
    return common / np.maximum(masks.sum((1, 2)) + truth.sum() - common, 1)


def measure(name: str, dataset: Dataset, config: ProposalConfig) -> Coverage:
    """Propose in every frame and compare."""
    best, times, counts = [], [], []
    for frame, truths in list_frames(dataset):
        depth = np.zeros(frame.rgb.shape[:2], np.float32) if frame.depth is None else frame.depth
        if not times:
            propose(frame.rgb, depth, frame.camera, config)  # what is loaded on the first use is not of a frame
        begin = time.process_time()
        propose(frame.rgb, depth, frame.camera, config)
        times.append(time.process_time() - begin)
        every = propose(frame.rgb, depth, frame.camera, dataclasses.replace(config, most=ALL))
        counts.append(len(every.masks))
        for truth in truths:
            found = overlaps(every.masks, truth)
            best.append([found[:first].max(initial=0) for first in (*FIRST, ALL)])
        print(f"{name} {frame.name}: {' '.join(f'{row[2]:.2f}' for row in best[-len(truths) :])}", flush=True)
    return Coverage(name, np.array(best), len(times), float(np.mean(counts)), float(np.mean(times)))


def table(rows: list[Coverage]) -> str:
    """Markdown: recall at IoU ≥ .5 / mean IoU."""
    head = " | ".join(f"best of {first}" for first in FIRST)
    lines = [
        f"| data set | frames | targets | {head} | of all | all, a frame | CPU seconds a frame |",
        "|---|" + "---:|" * (len(FIRST) + 5),
    ]
    for row in rows:
        cells = " | ".join(
            f"{r:.2f} / {m:.2f}" for r, m in zip((row.best >= 0.5).mean(0), row.best.mean(0), strict=True)
        )
        lines.append(
            f"| {row.name} | {row.frames} | {len(row.best)} | {cells} | {row.proposals:.0f} | {row.seconds:.1f} |"
        )
    return "\n".join(lines)


def write_page(path: Path, rows: list[Coverage]) -> None:
    """The table with what it rests on."""
    from benchmarks.measure import commit, describe_device

    device = describe_device()
    head = [
        "# Proposals of masks",
        "",
        "Made by `python -m benchmarks.proposals`; do not edit by hand. `ipjax.detection.proposals.propose` with its "
        "default settings knows no object and no size. Cells: share of targets of which the best proposal overlaps "
        "the visible mask by an IoU of at least 0.5 / mean IoU of the best proposal. Settings were chosen on these "
        "same data sets, so expect somewhat less on others; the weights of objectness were fitted to made scenes "
        "(`--fit`).",
        "",
        f"{device['device']}, {device['cores']} cores, NumPy {np.__version__}, Python {device['python']}, "
        f"commit {commit()}.",
        "",
        table(rows),
    ]
    write_text(path, "\n".join(head) + "\n", parents=True)


def make_scenes(count: int, scans: Path | None) -> Iterator[tuple]:
    """Tables with 4 to 9 things of 6 to 30 cm, with what the sensor adds: rgb, depth, K, the visible masks.

    Half of the things are among the PLY files of ``scans``, if there is such a folder; the others are made in code.
    """
    from ipjax.files.meshes.loading import load_mesh
    from ipjax.files.meshes.mesh import normalise
    from ipjax.synthetic.objects import KINDS, make_object
    from ipjax.synthetic.scenes import make_scene

    scanned = [normalise(load_mesh(path)) for path in sorted(scans.glob("*.ply"))] if scans else []
    for seed in range(count):
        rng = np.random.default_rng([seed, 77])
        many, objects = int(rng.integers(4, 10)), []
        for _ in range(many):
            if scanned and rng.uniform() < 0.5:
                objects.append(scanned[rng.integers(len(scanned))])
            else:
                objects.append(make_object(KINDS[rng.integers(len(KINDS))], int(rng.integers(10**6))))
        sizes = np.exp(rng.uniform(np.log(0.06), np.log(0.3), many))
        scene = make_scene(objects, seed, sizes=sizes.tolist(), clutter=0, oversample=1)
        seen = scene.masks[(scene.visible > 0.1) & (scene.masks.sum((1, 2)) > 300)]
        yield scene.rgb, scene.depth, scene.matrix, seen


def fit(scenes: Iterator[tuple], config: ProposalConfig) -> np.ndarray:
    """Weights by logistic regression of how well a candidate overlaps the object it overlaps most.

    Twice as many candidates as usual are kept, so that those that the weights in use dislike take part.
    """
    more = [dataclasses.replace(cutting, most=2 * cutting.most) for cutting in config.cuttings]
    config = dataclasses.replace(config, cuttings=tuple(more))
    features, wanted = [], []
    for rgb, depth, matrix, truths in scenes:
        made = make_all(rgb, depth, matrix, config)
        masks, measures, _ = pool(made)
        small = np.stack([_shrink(truth, *masks.shape[1:]) for truth in truths])
        features.append(np.concatenate([m.stack() for m in measures]))
        wanted.append(target(np.stack([overlaps(masks, truth) for truth in small]).max(0)))
    return regress(np.concatenate(features), np.concatenate(wanted))


def target(overlap: np.ndarray) -> np.ndarray:
    """What the score should say of a candidate: nothing below an IoU of 0.4, all from 0.85."""
    return np.clip((overlap - 0.4) / 0.45, 0, 1)


def regress(features: np.ndarray, wanted: np.ndarray, ridge: float = 1e-3) -> np.ndarray:
    """Newton's method for soft labels; both classes weigh the same."""
    weight = np.where(wanted > 0, 0.5 / max(wanted.sum(), 1), 0) * wanted
    weight = weight + (1 - wanted) * 0.5 / max((1 - wanted).sum(), 1)
    goal = wanted * 0.5 / max(wanted.sum(), 1) / np.maximum(weight, 1e-12)
    weights = np.zeros(features.shape[1])
    penalty = ridge * features.var(0)
    for _ in range(30):
        said = 1 / (1 + np.exp(-features @ weights))
        slope = features.T @ (weight * (said - goal)) + penalty * weights
        curve = (features * (weight * said * (1 - said))[:, None]).T @ features + np.diag(penalty + 1e-9)
        weights = weights - np.linalg.solve(curve, slope)
    return weights


def _shrink(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    rows = ((np.arange(height) + 0.5) * mask.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * mask.shape[1] / width).astype(int)
    return mask[rows[:, None], columns]


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="*", help="data sets in BOP's layout")
    parser.add_argument("--page", type=Path, help="write the table here, too, with what it rests on")
    parser.add_argument("--fit", type=int, metavar="SCENES", help="fit the weights of objectness to so many scenes")
    parser.add_argument("--scans", type=Path, help="a folder of meshes (PLY) that half of the things in them are of")
    options = parser.parse_args()
    if options.fit:
        print(
            np.array2string(
                fit(make_scenes(options.fit, options.scans), ProposalConfig()),
                precision=3,
                separator=", ",
                max_line_width=100,
            )
        )
        return
    if not options.data:
        parser.error("give data sets, or --fit")
    rows = [measure(path.name, Dataset(path), ProposalConfig()) for path in options.data]
    print(f"\n{table(rows)}")
    if options.page:
        write_page(options.page, rows)


if __name__ == "__main__":
    main()

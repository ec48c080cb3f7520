"""``python -m benchmarks.retrieval DATA --objects FOLDER``: what a shortlist of templates or fewer channels would lose.

For targets of a data set in BOP layout, with their annotated masks: how often the template that the exhaustive search
ranks first is on a shortlist of N, which share of its best eight is, and the seconds of the match; and the same figures
for features cut to their first principal components, fitted to the object's own templates.
"""

import argparse
import json
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import describe_device
from ipjax.bop.dataset import Dataset
from ipjax.config import MatchConfig
from ipjax.estimation.features import cut, describe, object_features, principal_basis
from ipjax.estimation.matching import match
from ipjax.files.objects.loading import load
from ipjax.files.storage.writing import write_text
from ipjax.files.weights.encoder import load_encoder
from ipjax.inference.batching import compact
from ipjax.inference.estimator import Estimator
from ipjax.records import Patches, Templates

BEST = 8  # templates that the estimate goes on with


def queries(dataset: Dataset, folder: Path, encoder, most: int):
    """Of every object that has a file: its number, its templates, and up to ``most`` described crops of it."""
    images: dict[int, list] = {}
    for image, rows in dataset.targets_by_image().items():
        for row in rows:
            images.setdefault(row.obj_id, []).append(image)
    see = jax.jit(describe)
    for obj_id, places in sorted(images.items()):
        path = folder / f"obj_{obj_id:06d}.ipjax"
        if not path.exists():
            continue
        templates, info = load(path, encoder)
        estimator, found = Estimator([(templates, info)], encoder), []
        for place in places[:most]:
            frame = dataset.frame(*place)
            target = next((t for t in dataset.given_targets(*place) if t.obj_id == obj_id), None)
            if target is not None:
                view, _ = estimator.frame(0, frame.rgb, frame.depth, target.mask, frame.camera)
                patches = see(encoder, view)
                found.append(eqx.tree_at(lambda p: p.features, patches, object_features(patches.features, templates)))
        yield obj_id, compact(templates), found


def project(patches: Patches, basis: np.ndarray) -> Patches:
    """The patches with features cut to a basis."""
    short = cut(patches.features, jnp.asarray(basis))[0]
    return eqx.tree_at(lambda p: p.features, patches, short.astype(patches.features.dtype))


def compare(templates: Templates, query: Patches, other: tuple[Templates, Patches], run, run_other) -> dict[str, float]:
    """Whether another way of matching has the best template, and which share of the best eight; both ways' seconds."""
    reference, found = run(query, templates), run_other(other[1], other[0])
    start = time.perf_counter()
    jax.block_until_ready(run(query, templates))
    middle = time.perf_counter()
    jax.block_until_ready(run_other(other[1], other[0]))
    end = time.perf_counter()
    best, kept = np.asarray(reference.view), np.asarray(found.view)
    # A shortlist ranks what it leaves out alike, below everything else.
    searched = np.asarray(found.ranking) > np.asarray(found.ranking).min()
    return {
        "first": float(searched[best[0]]),
        "best": float(np.mean(searched[best])),
        "same_first": float(kept[0] == best[0]),
        "kept": float(np.mean(np.isin(best, kept))),
        "seconds": end - middle,
        "exhaustive_seconds": middle - start,
    }


def main() -> None:
    """Measure, print, and write the figures where asked to."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.retrieval", description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--objects", type=Path, required=True, help="folder of object files obj_000001.ipjax …")
    parser.add_argument("--weights", help="of the encoder (default: the best that is here)")
    parser.add_argument("--block", type=int, help="of the encoder, as the object files name it")
    parser.add_argument("--most", type=int, default=3, help="images of each object")
    parser.add_argument("--shortlist", type=int, nargs="*", default=[25, 50, 100, 200])
    parser.add_argument("--channels", type=int, nargs="*", default=[32, 64, 128, 256])
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    encoder = load_encoder(options.weights, block=options.block)
    run = jax.jit(lambda query, templates: match(query, templates, MatchConfig(views=BEST)))
    short = {
        n: jax.jit(lambda query, templates, n=n: match(query, templates, MatchConfig(views=BEST, shortlist=n)))
        for n in options.shortlist
    }
    found: dict[tuple[str, int], list[dict[str, float]]] = {}
    for obj_id, templates, crops in queries(Dataset(options.data), options.objects, encoder, options.most):
        print(f"object {obj_id}: {len(crops)} crops, {templates.norm.shape[1]} patches a template", flush=True)
        bases = {n: principal_basis(templates.patches, n) for n in options.channels}
        cut = {n: eqx.tree_at(lambda t: t.patches, templates, project(templates.patches, b)) for n, b in bases.items()}
        for query in crops:
            for n, run_short in short.items():
                one = compare(templates, query, (templates, query), run, run_short)
                found.setdefault(("shortlist", n), []).append(one)
            for n, basis in bases.items():
                one = compare(templates, query, (cut[n], project(query, basis)), run, run)
                found.setdefault(("channels", n), []).append(one)
    rows = []
    for (kind, n), ones in found.items():
        mean = {name: float(np.mean([one[name] for one in ones])) for name in ones[0]}
        gain = float(np.median([one["exhaustive_seconds"] / one["seconds"] for one in ones]))
        rows.append({"kind": kind, "n": n, "targets": len(ones), "gain": gain, **mean})
        listed = f"best on the list {100 * mean['first']:.1f} %, " if kind == "shortlist" else ""
        print(
            f"{kind} {n:>3}: {listed}same first template {100 * mean['same_first']:.1f} %, of the best {BEST} kept "
            f"{100 * mean['kept']:.1f} %, match {gain:.1f} × faster ({len(ones)} targets)"
        )
    if options.json:
        record = {**describe_device(), "encoder": encoder.identity, "data": options.data.name, "rows": rows}
        write_text(options.json, json.dumps(record, indent=1) + "\n", parents=True)


if __name__ == "__main__":
    main()

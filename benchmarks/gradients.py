"""``python -m benchmarks.gradients``: derivatives of pose, size and confidence against differences of whole solutions.

The cost of refinement has steps wherever a point changes what it is compared with, and its minima lie against them. So
differences over tiny changes measure the steps. Here each difference is the slope of a parabola through solutions at
many changes, with its standard error; everything in float64.
"""

import argparse

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import ipjax
from ipjax.config import AlignConfig, Config, MatchConfig, RefineConfig, ScoreConfig
from ipjax.synthetic import problems
from ipjax.transforms import difference

CONFIG = Config(
    match=MatchConfig(views=2, pairs=64),
    align=AlignConfig(count=128),
    refine=RefineConfig(points=1024),
    score=ScoreConfig(alternates=0),
)
WHAT = ("tx", "ty", "tz", "log size", "turn x", "turn y", "turn z", "confidence")


def widen(records):
    """The same numbers in float64."""
    return jax.tree.map(lambda x: x.astype(jnp.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x, records)


def change(name, amount, templates, query):
    """The records after a change of one kind: of the depth or surface in diameters, of features in their norm."""
    depth, features = query.view.depth, query.patches.features
    side = jnp.linspace(0, 1, depth.shape[0], dtype=depth.dtype)
    if name in ("depth", "depth, waves"):
        wave = 1.0 if name == "depth" else jnp.cos(6 * side)[:, None] * jnp.sin(3 * side)[None]
        depth = jnp.where(depth > 0, depth + amount * wave, 0)
        points = query.patches.points * (1 + amount / jnp.maximum(query.patches.points[:, 2:], 1e-6))
        return templates, eqx.tree_at(lambda q: (q.view.depth, q.patches.points), query, (depth, points))
    if name == "features":
        noise = jnp.asarray(np.random.default_rng(0).normal(size=features.shape), features.dtype)
        return templates, eqx.tree_at(lambda q: q.patches.features, query, features + amount * noise)
    surface = templates.surface
    if name == "surface, size":
        points = surface.points * (1 + amount)
    else:
        points = surface.points + amount * surface.normals * jnp.sin(5 * surface.points[:, :1])
    return eqx.tree_at(lambda t: t.surface.points, templates, points), query


CHANGES = {"depth": 0.01, "depth, waves": 0.01, "features": 0.02, "surface, size": 0.02, "surface, waves": 0.01}


def relative_estimate(amounts, templates, query, start):
    """Where the estimate is after changes, relative to ``start``: diameters, logarithm, rad; and its confidence."""
    for name, amount in zip(CHANGES, amounts, strict=True):
        templates, query = change(name, amount, templates, query)
    found = ipjax.estimate(None, templates, query, jax.random.key(0), CONFIG)
    pose = found.camera_from_object
    step = difference(start, pose)
    return jnp.concatenate([step[3:], step[:3], found.confidence[None]]), pose


@jax.jit
def differentiate(amounts, direction, templates, query, start):
    """:func:`relative_estimate`, its derivative, and the pose itself."""
    return jax.jvp(
        lambda amounts: relative_estimate(amounts, templates, query, start), (amounts,), (direction,), has_aux=True
    )


def rows(seed: int, count: int):
    """For each kind of change: the derivative of each output, the differences', and their standard errors."""
    templates, (query, truth) = problems.make_templates(), problems.make_query(seed, noise=0.3)
    dense = eqx.tree_at(lambda t: t.surface, templates, problems.make_surface(2048))
    templates, query, truth = widen((dense, query, truth))
    nothing = jnp.zeros(len(CHANGES))
    start = differentiate(nothing, nothing, templates, query, truth)[2]
    for index, (name, reach) in enumerate(CHANGES.items()):
        unit = float(truth.scale) if name.startswith("depth") else 1.0
        direction = jnp.zeros(len(CHANGES)).at[index].set(unit)
        steps = np.linspace(-reach, reach, count)
        derivative = np.asarray(differentiate(0 * direction, direction, templates, query, start)[1])
        values = np.stack([differentiate(step * direction, direction, templates, query, start)[0] for step in steps])
        basis = np.stack([np.ones(count), steps, steps**2], axis=1)
        fitted, *_ = np.linalg.lstsq(basis, values, rcond=None)
        variance = np.sum((values - basis @ fitted) ** 2, axis=0) / (count - 3)
        yield name, derivative, fitted[1], np.sqrt(variance / np.sum(steps**2))


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gradients", description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[4], help="scenes; default: 4")
    parser.add_argument("--count", type=int, default=24, help="solutions per difference; default: 24")
    options = parser.parse_args()
    with jax.enable_x64(True):
        print("| scene | change | | " + " | ".join(WHAT) + " |\n" + "|---" * (3 + len(WHAT)) + "|")
        for seed in options.seeds:
            for name, *numbers in rows(seed, options.count):
                for kind, line in zip(("derivative", "differences", "± standard error"), numbers, strict=True):
                    print(f"| {seed} | {name} | {kind} | " + " | ".join(f"{x:.3f}" for x in line) + " |", flush=True)


if __name__ == "__main__":
    main()

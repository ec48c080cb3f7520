"""``python -m benchmarks.grasp_rule JOURNALS``: learn when to grasp on made objects, and judge it on scanned ones.

The rule (`ipjax.robot.grasps.decision`) is learned from picks of made objects in the simulated cell, with estimates
that are drawn: an object is known as it is or degraded, at a pose that is off by a draw from a covariance, widened or
narrowed at random, with the probability that its confidence says, else by anything. So it takes the estimator's
confidence for what it says (it is: benchmarks/results/confidence.md), and no frame is drawn and no encoder needed. Of
each estimate the best grasp and one other are done; what is learned is whether they succeed. The weights, a ridge
regression of the log odds, are for `DecisionConfig`.

It is judged on the grasps that the arm did in the study ``knowledge`` of ``python -m benchmarks.grasps``, with poses by
ipjax, beside grasping where the pose is `present`.
"""

import argparse
import collections
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from benchmarks.grasp_knowledge import list_made
from benchmarks.grasps import read_journal
from benchmarks.measure import commit
from ipjax.capture.views.paths import look_from
from ipjax.config import DecisionConfig, GraspConfig
from ipjax.files.meshes.mesh import Mesh, move, normalise
from ipjax.files.meshes.sampling import sample_surface
from ipjax.files.storage.writing import append_json
from ipjax.inference.compilation_cache import use_compilation_cache
from ipjax.progress import bar
from ipjax.records import Agreement, Hypotheses, PoseEstimate, Surface
from ipjax.robot.cell.picking import PickConfig, pick
from ipjax.robot.grasps.decision import FEATURES, grasp_deviation, make_features
from ipjax.robot.grasps.judging import check_grasps
from ipjax.robot.grasps.planning import plan_grasps
from ipjax.robot.grippers import FRANKA_HAND
from ipjax.robot.records import Workspace, place_grasps, table_in_camera
from ipjax.synthetic.degradation import degrade
from ipjax.transforms import Similarity, rotation_from_vector

PLACED = 80_000  # plus the trial's number: the seed of its cell
RIDGE = 0.001  # of the mean loss, for each squared weight


def draw(seeds: list[int]) -> Iterator[dict[str, Any]]:
    """Trials with drawn estimates, as lines of a journal."""
    plan, check, deviation = jax.jit(plan_grasps), jax.jit(check_grasps), jax.jit(grasp_deviation)
    subjects = list_made()
    for seed in bar(seeds, desc="drawn", unit=" trials"):
        rng = np.random.default_rng([seed, 71])
        subject, level = subjects[seed % len(subjects)], int(rng.choice([0, 2, 3, 4]))
        known = subject.mesh
        if level:
            known, back = degrade(subject.mesh, level, seed)
            known = move(known, back.rotation, back.translation, float(back.scale))
        cell = subject.make_cell(PLACED + seed)
        base_from_thing = cell.base_from_object[0]
        azimuth, elevation = rng.uniform(-0.9, 0.9), rng.uniform(0.65, 1.0)
        away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        middle = base_from_thing.translation
        base_from_camera = look_from((middle + 0.88 * away)[None], middle, np.array([0.0, 0, 1])).take(0)
        camera_from_thing = base_from_camera.inverse() @ base_from_thing
        true_surface, thing_from_true = _surface(subject.mesh)
        surface, thing_from_object = _surface(known)
        estimate = _draw_estimate(rng, camera_from_thing @ thing_from_object, surface)
        pose = estimate.camera_from_object
        table = table_in_camera(0.0, base_from_camera.to_jax())
        given = FRANKA_HAND, surface, estimate, Workspace(table=table), jax.random.key(seed), GraspConfig()
        found = plan(*given)
        hands = place_grasps(found.object_from_gripper, pose)
        holds = check(FRANKA_HAND, true_surface, (camera_from_thing @ thing_from_true).to_jax(), hands)
        off, valid = deviation(FRANKA_HAND, found, estimate), np.asarray(found.valid)
        line: dict[str, Any] = {"seed": seed, "name": subject.name, "commit": commit()}
        line |= {"knowledge": f"level{level}" if level else "scan", "confidence": float(estimate.confidence)}
        line |= {"present": bool(estimate.present), "tried": {}}
        if valid.any():
            columns = {"score": found.score, "safe": found.safe, "spare": found.spare, "off": off}
            line["grasps"] = {key: np.asarray(x)[valid].round(5).tolist() for key, x in columns.items()}
            line["grasps"]["holds"] = np.asarray(holds)[valid].tolist()
            places = place_grasps(found.object_from_gripper.to_numpy(), pose.to_numpy(), base_from_camera)
            count = int(valid.sum())
            for order in (np.arange(count), rng.permutation(count)):
                done = pick(cell, places.take(order), config=PickConfig(frames=0))
                # What falls over by itself before it is touched tells nothing about the grasp.
                if done.grasp is not None and (done.touched or done.pushed < 0.002):
                    line["tried"][str(int(order[done.grasp]))] = done.success
        yield line


def _draw_estimate(rng: np.random.Generator, true: Similarity[np.ndarray], surface: Surface) -> PoseEstimate:
    """An estimate with its uncertainty; the pose is as wrong as that says."""
    turn, place = np.radians(rng.choice([0.5, 2, 5, 10])), rng.choice([0.001, 0.003, 0.008])
    size = rng.choice([0.002, 0.02, 0.05])
    axis = rng.normal(size=3)
    axis *= (0.0 if rng.random() < 0.8 else rng.uniform(0.1, 1.0)) / np.linalg.norm(axis)
    confidence = 1 / (1 + np.exp(-rng.normal(1.5, 2.0)))
    wide = np.exp(rng.normal(0, 0.4))
    tilt, shift = wide * turn * rng.normal(size=3), wide * place * rng.normal(size=3)
    about = wide * rng.normal() * axis
    if rng.random() > confidence:
        other = rng.normal(size=3)
        about, shift = other / np.linalg.norm(other) * rng.uniform(0.2, np.pi), 0.015 * rng.normal(size=3)
    pose = Similarity(
        rotation_from_vector(tilt) @ true.rotation @ rotation_from_vector(about),
        true.translation + shift,
        true.scale * np.exp(wide * size * rng.normal()),
    ).to_jax()
    number = lambda x: jnp.asarray(x, jnp.float32)
    zero, half = number(0.0), jnp.max(jnp.abs(surface.points), axis=0)
    return PoseEstimate(
        camera_from_object=pose,
        confidence=number(confidence),
        present=jnp.asarray(confidence > 0.5),
        covariance=jnp.diag(number([turn**2] * 3 + [place**2] * 3)),
        diameter=pose.scale,
        box=jnp.stack([-half, half]),
        scale_std=size * pose.scale,
        ambiguity=number(axis),
        agreement=Agreement(zero, zero, zero, zero, zero, zero),
        hypotheses=Hypotheses(pose.take(None), jnp.ones(1)),
        view=jnp.zeros((), jnp.int32),
        view_score=jnp.zeros(1),
        inliers=jnp.zeros((), jnp.int32),
        rmse=zero,
        success=jnp.asarray(True),
    )


def _surface(mesh: Mesh) -> tuple[Surface, Similarity[np.ndarray]]:
    """A surface of unit diameter, and its frame in the mesh's."""
    unit = normalise(mesh)
    surface = Surface(*(jnp.asarray(x, jnp.float32) for x in sample_surface(unit, 2048, seed=0)))
    return surface, Similarity(np.eye(3), np.asarray(unit.centre, np.float64), np.asarray(1 / unit.scale))


def samples(line: dict[str, Any]) -> Float[np.ndarray, "n f"]:
    """The features of every planned grasp of a trial."""
    grasps = {name: np.asarray(values, np.float64) for name, values in line["grasps"].items()}
    count = len(grasps["score"])
    one = np.ones(count)
    return np.stack(
        [
            np.asarray(x)
            for x in make_features(
                line["confidence"] * one,
                grasps["safe"],
                grasps["score"],
                grasps["spare"],
                grasps["off"],
            )
        ],
        axis=-1,
    )


def learn(lines: list[dict[str, Any]]) -> tuple[tuple[float, ...], int, int, float]:
    """The weights, how many trials and grasps they are from, and the share that succeeded."""
    mine = [line for line in lines if line.get("tried")]
    x = np.concatenate([samples(line)[[int(key) for key in line["tried"]]] for line in mine])
    y = np.concatenate([list(line["tried"].values()) for line in mine]).astype(np.float64)
    weight = np.concatenate([np.full(len(line["tried"]), 1 / len(line["tried"])) for line in mine])
    weight /= weight.sum()
    x = np.concatenate([np.ones((len(x), 1)), x], axis=-1)
    # More of these is never worse for a grasp; of the deviation, less.
    signs = np.array([0, 1, 1, 1, 1, -1])

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        odds = x @ w
        value = weight @ (np.logaddexp(0, odds) - y * odds) + RIDGE * (w[1:] @ w[1:])
        slope = x.T @ (weight * (1 / (1 + np.exp(-odds)) - y))
        slope[1:] += 2 * RIDGE * w[1:]
        return float(value), slope

    bounds = [(None, None) if s == 0 else (0, None) if s > 0 else (None, 0) for s in signs]
    found = minimize(loss, np.zeros(len(signs)), jac=True, bounds=bounds, method="L-BFGS-B")
    return tuple(round(float(w), 3) for w in found.x), len(mine), len(y), float(weight @ y)


def chance(weights: tuple[float, ...], line: dict[str, Any], grasp: int) -> float:
    """Of one grasp of a trial."""
    odds = weights[0] + samples(line)[grasp] @ np.asarray(weights[1:])
    return float(1 / (1 + np.exp(-odds)))


def judge(name: str, tried: list[bool], good: list[bool]) -> str:
    """A row: which of the good grasps are lost, which of the failures are let through."""
    lost = sum(g and not t for t, g in zip(tried, good, strict=True))
    through = sum(t and not g for t, g in zip(tried, good, strict=True))
    return f"| {name} | {sum(tried)}/{len(tried)} | {lost}/{sum(good)} | {through}/{len(good) - sum(good)} |"


def area(values: list[float], good: list[bool]) -> float:
    """Area under the curve of a score that tells good from bad: the share of pairs in the right order."""
    first, second = ([v for v, g in zip(values, good, strict=True) if g is which] for which in (True, False))
    if not first or not second:
        return float("nan")
    return float(np.mean([(a > b) + 0.5 * (a == b) for a in first for b in second]))


def report(lines: list[dict[str, Any]], made: list[dict[str, Any]]) -> list[str]:
    """The section of the page."""
    config = DecisionConfig()
    text = ["## When to grasp", ""]
    if made:
        weights, trials, count, share = learn(made)
        named = ", ".join(f"{n} {w:+.2f}" for n, w in zip(("constant", *FEATURES), weights, strict=True))
        state = "as in" if np.allclose(weights, config.weights, atol=0.01) else "**not as in**"
        text += [
            f"The rule (`ipjax.robot.grasps.decision`, `python -m benchmarks.grasp_rule`) is learned from {count} "
            f"picks of made objects in {trials} trials with drawn estimates; {share:.0%} succeeded.",
            f"Log odds: {named} ({state} `DecisionConfig`).",
            "",
        ]
    done = [line for line in lines if line.get("grasps") and line.get("grasp") is not None]
    if not done:
        return text
    good = [bool(line["success"]) for line in done]
    chances = [chance(config.weights, line, line["grasp"]) for line in done]
    present = [bool(line["present"]) for line in done]
    holds = [bool(line["grasps"]["holds"][line["grasp"]]) for line in done]
    agree = np.mean(np.array(holds) == np.array(good))
    text += [
        f"Judged on the {len(done)} picks that were done in the study above, {len(good) - sum(good)} of which failed:",
        "",
        "| tried where | tried | good grasps lost | failures let through |",
        "| --- | ---: | ---: | ---: |",
        judge("always", [True] * len(done), good),
        judge("the pose is `present`", present, good),
        judge(f"the rule says at least {config.grasp:.0%}", [c >= config.grasp for c in chances], good),
        judge("the rule says at least 75%", [c >= 0.75 for c in chances], good),
        judge("the grasp holds at the true pose, without physics (not known to a robot)", holds, good),
        "",
        f"Area under the curve: the rule {area(chances, good):.2f}, confidence "
        f"{area([line['confidence'] for line in done], good):.2f}, the planner's score "
        f"{area([line['grasps']['score'][line['grasp']] for line in done], good):.2f}. "
        f"The test without physics agrees with the simulator in {agree:.0%}.",
        "",
    ]
    if len(good) - sum(good) < 20:
        text += [f"{len(good) - sum(good)} failures are too few to tell these rules apart.", ""]
    return text


def main() -> None:
    """Print weights and the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("journals", type=Path, metavar="FOLDER", help="of python -m benchmarks.grasps")
    parser.add_argument("--trials", type=int, default=150, metavar="N", help="that are drawn")
    arguments = parser.parse_args()
    use_compilation_cache()
    path = arguments.journals / "drawn.jsonl"
    done = {line["seed"] for line in read_journal(path)}
    for line in draw([seed for seed in range(arguments.trials) if seed not in done]):
        append_json(path, line)
    drawn, judged = (read_journal(arguments.journals / f"{name}.jsonl") for name in ("drawn", "knowledge"))
    counts = collections.Counter(line["knowledge"] for line in drawn)
    print(f"learned from {dict(counts)}; weights: {learn(drawn)[0]}")
    print("\n".join(report(judged, drawn)))


if __name__ == "__main__":
    main()

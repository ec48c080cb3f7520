"""``python -m benchmarks.detection_confidence``: is a detection of confidence 0.8 right in 80 of 100 cases?

Made scenes: one to three of a few objects on a table among others, and three or four that are not there are sought,
without masks, in images of sensors from good to bad. Half of the scenes know the objects as they are, half as a scan
has them: of other colours and contrast, softer, uneven.

    python -m benchmarks.detection_confidence made --scenes 40 --output out/confidence
    python -m benchmarks.detection_confidence fit out/confidence

``made`` goes on where it was stopped. ``fit`` prints weights for `DetectConfig.drawn`, close to those of
`ConfidenceConfig.drawn`, and what they are worth on scenes that they were not fitted to; scenes of ``--from`` 1000 and
more are never fitted to, and judge the weights that the code has now.
"""

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy import optimize
from scipy.spatial import cKDTree

from ipjax.config import ConfidenceConfig, Config, DetectConfig, OnboardConfig
from ipjax.detection.detector import Detector
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.objects.loading import load
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines
from ipjax.files.weights.encoder import load_encoder
from ipjax.inference.compilation_cache import use_compilation_cache
from ipjax.onboarding.mesh import onboard
from ipjax.progress import bar
from ipjax.records import Agreement
from ipjax.synthetic.degradation import roughen
from ipjax.synthetic.objects import KINDS, make_object
from ipjax.synthetic.scenes import Scene, make_scene
from ipjax.synthetic.sensor import STRUCTURED_LIGHT, Sensor

RIGHT = 0.1  # diameters: ADD-S of a right pose
OBJECTS = [(kind, 700 + i) for i, kind in enumerate(KINDS)] + [(kind, 800 + i) for i, kind in enumerate(KINDS[:4])]
JUDGES = 1000  # scenes from this number on are never fitted to
NEAR = 1.0  # how much a squared departure from the weights of poses in given masks costs, in nats


def as_scanned(mesh: Mesh, seed: int) -> Mesh:
    """The object as a scan has it: of other white balance, saturation and contrast, softer, and uneven."""
    rng = np.random.default_rng([seed, 5])
    assert mesh.texture is not None
    image = mesh.texture.astype(np.float32) / 255
    image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.8, 3)))
    grey = image.mean(-1, keepdims=True)
    image = grey + (image - grey) * rng.uniform(0.5, 1.2)
    image = np.clip(image * rng.uniform(0.65, 1.1) * rng.normal(1, 0.08, 3), 0, 1) ** rng.uniform(0.7, 1.4)
    image = np.clip(0.5 + (image - 0.5) * rng.uniform(0.6, 1.1) + rng.normal(0, 0.05), 0, 1)
    scanned = dataclasses.replace(mesh, texture=(255 * image).astype(np.uint8))
    return roughen(scanned, float(rng.uniform(0.004, 0.012)), rng)


def draw_sensor(rng: np.random.Generator) -> Sensor:
    """From good to bad: noise, fraying, holes, blur."""
    good, noise = STRUCTURED_LIGHT, float(rng.uniform(0.7, 2.0))
    return dataclasses.replace(
        good,
        axial=good.axial * noise,
        quadratic=good.quadratic * noise,
        step=good.step * noise,
        jitter=good.jitter * rng.uniform(0.6, 2.5),
        holes=good.holes * rng.uniform(0.3, 3),
        edge=float(min(0.9, good.edge * rng.uniform(0.6, 1.6))),
        blur=good.blur * rng.uniform(0.5, 2.5),
        colour=good.colour * rng.uniform(0.5, 2),
    )


def draw_scene(meshes: Sequence[Mesh], number: int, *, hard: bool) -> tuple[Scene, np.ndarray, np.ndarray]:
    """A scene, the objects that are there, and those that are sought in it."""
    rng = np.random.default_rng([number, 77])
    order = rng.permutation(len(meshes))
    count = int(rng.integers(1, 4))
    there, sought = order[:count], order[: count + 3 + int(rng.integers(0, 2))]
    sensor = draw_sensor(rng)
    low, high = (0.06, 0.18) if hard else (0.08, 0.22)
    scene = make_scene(
        [meshes[i] for i in there],
        seed=50000 + number,
        sizes=[float(rng.uniform(low, high)) for _ in there],
        clutter=int(rng.integers(4, 9)),
        least_visible=0.35 if hard else 0.5,
        sensor=sensor,
        oversample=1,
    )
    return scene, there, sought


def make(options: argparse.Namespace) -> None:
    """A line for each scene and way of knowing the objects."""
    use_compilation_cache()
    encoder = load_encoder(options.weights)
    meshes = [make_object(*one) for one in OBJECTS]
    points = [np.asarray(mesh.vertices)[:: max(len(mesh.vertices) // 1500, 1)] for mesh in meshes]
    path = options.output / "scenes.jsonl"
    done = {(row["scene"], row["hard"]) for row in read(path)}
    for hard in (False, True):
        wanted = [i for i in range(options.first, options.first + options.scenes) if (i, hard) not in done]
        if not wanted:
            continue
        known = [as_scanned(mesh, seed) if hard else mesh for mesh, (_, seed) in zip(meshes, OBJECTS, strict=True)]
        folder = options.output / ("scanned" if hard else "true")
        detector = Detector(_onboarded(known, folder, encoder), encoder, Config.fast())
        for number in bar(wanted, desc="scenes of scans" if hard else "scenes", unit=" scenes"):
            scene, there, sought = draw_scene(meshes, number, hard=hard)
            sight = detector.look(scene.rgb, scene.depth, scene.camera)
            trials = []
            for index in map(int, sought):
                at = np.flatnonzero(there == index)
                truth = scene.camera_from_object[int(at[0])].to_numpy() if at.size else None
                for claim in detector.seek(sight, index)[0]:
                    trials.append(_tell(claim, index, points[index], truth))
            append_json(path, {"scene": number, "hard": hard, "there": list(map(int, there)), "trials": trials})


def _onboarded(meshes: Sequence[Mesh], folder: Path, encoder: Any) -> Iterator[Any]:
    folder.mkdir(parents=True, exist_ok=True)
    for number, mesh in enumerate(bar(meshes, desc="onboarding", unit=" objects"), 1):
        path = folder / f"obj_{number:06d}.ipjax"
        if not path.is_file():
            few = OnboardConfig(directions=26, rolls=5)
            onboard(mesh, encoder, few, out=path, name=f"object {number}", progress=False)
        templates, info = load(path)
        yield templates, dataclasses.replace(info, metres_per_unit=None, pictures=None)


def _tell(claim: Any, index: int, points: np.ndarray, truth: Any) -> dict[str, Any]:
    found = claim.source.result.estimate
    error = None
    if truth is not None:
        placed = found.camera_from_object.to_numpy() @ points
        error = float(cKDTree(placed).query(truth @ points)[0].mean() / truth.scale)
    agreement = [float(getattr(found.agreement, field.name)) for field in dataclasses.fields(Agreement)]
    return {"object": index, "agreement": agreement, "confidence": float(found.confidence), "error": error}


def read(path: Path) -> list[dict[str, Any]]:
    """The lines of scenes, in their order; none where there is no file yet. One that was cut short is cut off."""
    return [parse_json(line) for line in read_lines(path, repair=True)] if path.is_file() else []


def collect(rows: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the logit is linear in [n, 7], which trials are right [n], and their scenes [n]."""
    trials = [(row["scene"], trial) for row in rows for trial in row["trials"]]
    agreement = np.array([trial["agreement"] for _, trial in trials], float)
    parts = np.log(np.clip(agreement[:, :3], 1e-3, 1))
    features = np.concatenate([np.ones((len(trials), 1)), parts, agreement[:, 3:]], axis=1)
    right = np.array([trial["error"] is not None and trial["error"] < RIGHT for _, trial in trials])
    return features, right, np.array([scene for scene, _ in trials])


def fit_weights(features: np.ndarray, right: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Logistic regression that stays near ``start``; how much was seen is 1 of scans and stays out."""
    free = np.arange(len(start)) != 5
    sign = np.where(right, 1.0, -1.0)

    def cost(step: np.ndarray) -> float:
        weights = start.copy()
        weights[free] += step
        return float(np.logaddexp(0, -(features @ weights) * sign).sum() + NEAR * (step**2).sum())

    weights = start.copy()
    weights[free] += np.asarray(optimize.minimize(cost, np.zeros(free.sum())).x)
    return weights


def judge(name: str, probability: np.ndarray, right: np.ndarray) -> None:
    """Print what probabilities are worth."""
    told = np.clip(np.where(right, probability, 1 - probability), 1e-6, 1)
    least, worst = Config().confidence.least, probability[~right].max(initial=0)
    sure = probability >= least
    print(
        f"{name}: {right.sum()} of {len(right)} are right; called present: {(sure & right).sum()} right, "
        f"{(sure & ~right).sum()} wrong; right ones above all wrong: {(probability[right] > worst).mean():.0%}; "
        f"log loss {-np.log(told).mean():.3f}"
    )


def fit(options: argparse.Namespace) -> None:
    """Weights, and what they are worth where they were not fitted."""
    rows = [row for path in options.folders for row in read(path / "scenes.jsonl")]
    start, now = np.array(ConfidenceConfig().drawn), np.array(DetectConfig().drawn)
    logistic = lambda features, weights: 1 / (1 + np.exp(-features @ weights))
    mine = [row for row in rows if row["scene"] < JUDGES]
    if mine:
        features, right, scenes = collect(mine)
        left_out = np.zeros(len(right))
        for part in range(6):
            out = scenes % 6 == part
            if out.any() and not out.all():
                left_out[out] = logistic(features[out], fit_weights(features[~out], right[~out], start))
        print("weights:", np.round(fit_weights(features, right, start), 2).tolist())
        judge("fitted to other scenes", left_out, right)
        judge("of poses in given masks", logistic(features, start), right)
    apart = [row for row in rows if row["scene"] >= JUDGES]
    if apart:
        features, right, _ = collect(apart)
        judge("scenes kept apart, weights of now", logistic(features, now), right)
        judge("the same, of poses in given masks", logistic(features, start), right)


def main(arguments: list[str] | None = None) -> None:
    """Make scenes, or fit."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.detection_confidence", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    commands = parser.add_subparsers(required=True, metavar="made | fit")
    making = commands.add_parser("made", help="seek objects in made scenes")
    making.add_argument("--scenes", type=int, default=40)
    making.add_argument("--from", dest="first", type=int, default=0, metavar="NUMBER", help="of the first scene")
    making.add_argument("--output", type=Path, default=Path("out/detection_confidence"), metavar="FOLDER")
    making.add_argument("--weights", help="of the encoder")
    making.set_defaults(run=make)
    fitting = commands.add_parser("fit", help="fit the confidence, and judge it")
    fitting.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="of made")
    fitting.set_defaults(run=fit)
    options = parser.parse_args(arguments)
    options.run(options)


if __name__ == "__main__":
    main()

"""Pairs of views of one object: a reference, from which the object is made, and RGB-D frames in which it is sought.

Rendered ones, and frames of BOP data sets of the same objects, within one set or across several.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.transforms import Similarity, rotation_from_vector

BINS = (0, 15, 30, 45, 60, 90, 120, 180.1)  # degrees between the directions from which the two frames see the object
PER_REFERENCE = 10  # queries of each synthetic reference: onboarding takes most of the time
ABSENT = 2  # of them in which the object is also sought where another one stands
POINTS = 4000  # of the model that errors are measured on


@dataclasses.dataclass
class Shot:
    """One RGB-D frame of the object, and the truth."""

    name: str
    rgb: np.ndarray
    depth: np.ndarray  # metres
    mask: np.ndarray
    K: np.ndarray
    camera_from_object: Similarity[np.ndarray]  # metres from metres
    other: np.ndarray | None = None  # the mask of another object


@dataclasses.dataclass
class Group:
    """A reference and the queries it is tried on; the object's points and symmetries are metres of its own frame."""

    object: str
    mesh: Any  # ipjax.files.meshes.mesh.Mesh; its present frame is the object's
    metres_per_unit: float  # of that mesh
    model: Any  # ipjax.bop.scoring.errors.Model
    reference: Shot
    queries: list[Shot]
    synthetic: bool = True  # an object made in code: also tried with the true mesh and with degraded copies


def rigid(rotation: np.ndarray, translation: np.ndarray) -> Similarity[np.ndarray]:
    """A motion that keeps the size."""
    return Similarity(np.asarray(rotation, np.float64), np.asarray(translation, np.float64), np.ones(()))


def view_angle(first: Shot, second: Shot) -> float:
    """Degrees between the directions from the object's origin to the two cameras; roll is no part of it."""
    eyes = [shot.camera_from_object.inverse().translation for shot in (first, second)]
    cosine = eyes[0] @ eyes[1] / np.linalg.norm(eyes[0]) / np.linalg.norm(eyes[1])
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


REPEATED = (2, 3, 4, 5, 8, 10, 15)  # objects of the YCB-V mini set that are in two scenes


def dataset_groups(folders: Sequence[Path], objects: Sequence[int] | None = None) -> Iterator[Group]:
    """Every frame of an object as the reference of all its frames in other scenes; of several data sets that have the
    same objects, of all its frames in the other sets.

    Models are those of the first folder; ``objects``: some of its numbers (default: all).
    """
    from ipjax.bop.dataset import VISIBLE, Dataset
    from ipjax.bop.scoring.errors import Model

    datasets = [Dataset(folder) for folder in folders]
    objects = sorted(datasets[0].models()) if objects is None else objects
    frames: dict[int, list[tuple[int, Shot]]] = {number: [] for number in objects}
    for turn, dataset in enumerate(datasets):
        for scene in dataset.scenes():
            for image in dataset.images(scene):
                for truth in dataset.truths(scene, image):
                    if truth.obj_id in frames and not 0 <= truth.visible < VISIBLE:  # −1 = not annotated
                        group = turn if len(datasets) > 1 else scene
                        shot = _shoot(dataset, scene, image, truth)
                        if len(datasets) > 1:
                            shot = dataclasses.replace(shot, name=f"{folders[turn].name} {shot.name}")
                        frames[truth.obj_id].append((group, shot))
    # Interleaved over objects, so that a run cut short has seen several.
    turns = [(k, number) for number in objects for k in range(len(frames[number]))]
    for k, number in sorted(turns):
        where, reference = frames[number][k]
        queries = [shot for other, shot in frames[number] if other != where]
        if queries:
            mesh, model = datasets[0].mesh(number, "models"), Model.load(datasets[0], number)
            yield Group(f"obj_{number:06d}", mesh, 1.0, model, reference, queries)


def _shoot(dataset: Any, scene: int, image: int, truth: Any) -> Shot:
    frame, mask = dataset.frame(scene, image), dataset.mask(scene, image, truth.index)
    pose = rigid(truth.rotation, truth.translation)
    return Shot(f"{scene:06d}/{image:06d}", frame.rgb, frame.depth, mask, frame.camera, pose)


def synthetic_groups(pairs: int, data: Path | None, seed: int = 0, each: int = PER_REFERENCE) -> Iterator[Group]:
    """Rendered references (the object alone, lit, on grey) of objects on cluttered tables.

    The reference sees the object from an angle drawn evenly from each bin in turn, rolled by up to 20°; both frames
    have the noise of a cheap sensor. Objects are those made in code and, where ``data`` is, the scans there.
    """
    from ipjax.bop.dataset import Dataset
    from ipjax.bop.scoring.errors import Model
    from ipjax.files.meshes.mesh import normalise
    from ipjax.rendering.render import render_scene
    from ipjax.synthetic.objects import KINDS, make_object
    from ipjax.synthetic.scenes import HEIGHT, WIDTH, make_scene
    from ipjax.synthetic.sensor import Sensor, expose, sense_depth

    scans = []
    if data is not None:
        dataset = Dataset(data)
        scans = [(f"obj_{n:06d}", normalise(dataset.mesh(n, "models"))) for n in sorted(dataset.models())]
    none = Similarity(np.eye(3)[None], np.zeros((1, 3)), np.ones(1))
    for turn in range(-(-pairs // each)):
        rng = np.random.default_rng([seed, turn])
        synthetic = not (scans and turn % 2)
        if not synthetic:
            name, mesh = scans[turn // 2 % len(scans)]
        else:
            kind = KINDS[turn // 2 % len(KINDS)] if scans else KINDS[turn % len(KINDS)]
            name, mesh = f"{kind}-{turn}", make_object(kind, 100_000 * seed + 1000 + turn)
        other = make_object(KINDS[(turn + 3) % len(KINDS)], 2000 + turn)
        size, other_size = (float(x) for x in rng.uniform(0.09, 0.22, 2))
        queries = []
        for k in range(each):
            number = 10_000 * seed + each * turn + k
            scene = make_scene([mesh, other], seed=number, sizes=[size, other_size], clutter=2)
            if scene.masks[0].sum() < 400:
                continue
            pose = scene.camera_from_object[0]
            mask, other_mask = scene.masks
            truth = rigid(pose.rotation, pose.translation)
            shot = Shot(f"scene {k}", scene.rgb, scene.depth, mask, scene.matrix, truth)
            search_other = synthetic and k < ABSENT and other_mask.sum() >= 400
            queries.append(dataclasses.replace(shot, other=other_mask if search_other else None))
        if not queries:
            continue
        # One reference for several queries: its angle to the first is drawn, those to the others come of themselves.
        low, high = BINS[turn % 5], BINS[turn % 5 + 1]
        angle = np.deg2rad(rng.uniform(low, high))
        first = queries[0]
        about = rng.uniform(0, 2 * np.pi)
        axis = np.array([np.cos(about), np.sin(about), 0.0])
        turned = rotation_from_vector(angle * axis) @ first.camera_from_object.rotation
        rotation = rotation_from_vector(np.array([0, 0, np.deg2rad(rng.uniform(-20, 20))])) @ turned
        translation = np.array([*rng.uniform(-0.03, 0.03, 2), size * rng.uniform(3.0, 4.5)])
        pose = Similarity(rotation, translation, np.asarray(size)).to_jax()
        light = {"direction": [*rng.normal(size=2) * 0.5, 1.0], "ambient": 0.6, "diffuse": 0.45}
        lens = scene.camera
        drawn = render_scene([(mesh, pose)], lens, HEIGHT, WIDTH, light=light)
        mask = drawn.mask[0]
        rgb = np.where(mask[..., None], drawn.rgb[0], 128).astype(np.uint8)
        depth = sense_depth(rng, np.where(mask, drawn.depth[0], 2.0), lens, Sensor())
        reference = Shot("photo", expose(rng, rgb, Sensor()), depth, mask, scene.matrix, rigid(rotation, translation))
        points = mesh.vertices[np.unique(mesh.faces)] * size
        chosen = rng.choice(len(points), min(POINTS, len(points)), replace=False)
        model = Model(points[chosen], size, none)
        yield Group(f"{turn:04d} {name}", mesh, size, model, reference, queries, synthetic)

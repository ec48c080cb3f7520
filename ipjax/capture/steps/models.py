"""The step model: what stands on the table?"""

import dataclasses
import json

import numpy as np

from ipjax.capture.labels.pictures import draw_models
from ipjax.capture.models.making import ObjectModel, SceneModels, make_models
from ipjax.capture.models.storing import write_models
from ipjax.capture.steps.frames import open_frames
from ipjax.capture.steps.records import Figure, Job, Outcome, Step, say
from ipjax.files.meshes.mesh import corner_products
from ipjax.inference.drawing import write_image

_RISES = 0.015  # metres above the support, above which a surface is no noise of it
_APART = 0.015  # metres from the objects, beyond which a surface is none of theirs


def model(job: Job) -> Outcome:
    """Models of the objects and of the scene."""
    given = job.settings
    found = make_models(
        list(open_frames(job)), given.hints, given.models, support_at=given.support, progress=job.progress
    )
    write_models(job.work / "models", found)
    write_image(job.work / "models.png", draw_models(found.objects))
    figures = [Figure("objects", len(found.objects), "", "count them in the picture of the labels")]
    for item in found.objects:
        figures.append(Figure(item.name, *_describe(item)))
    warnings = []
    for item in found.objects:
        measured = float((item.mesh.seen > 0).mean())
        if measured < 0.5:
            warnings.append(f"Only {100 * measured:.0f} % of the surface of {item.name} was measured.")
    left = measure_left_over(found)
    if left > job.settings.models.least_area:
        warnings.append(
            f"{1e4 * left:.0f} cm² of surface above the table belong to no object: something seen from too few "
            "sides, or not down to the table; --object NAME:X,Y on it makes it one."
        )
    names = ", ".join(item.name for item in found.objects)
    notes = (f"{len(found.objects)} {'object' if len(found.objects) == 1 else 'objects'}: {names}.",)
    notes += tuple(map(say, found.notes))
    return Outcome(("models", "models.png"), tuple(figures), notes, tuple(warnings))


def measure_left_over(found: SceneModels) -> float:
    """How much of the surface that rises above the support is near none of the objects; m²."""
    from scipy.spatial import KDTree

    scene, support = found.scene, found.support
    rises = (support.heights(scene.vertices) > _RISES) & support.covers(scene.vertices)
    points = np.concatenate([item.world_from_model @ item.mesh.vertices for item in found.objects])
    alone = rises.copy()
    alone[rises] = KDTree(points).query(scene.vertices[rises])[0] > _APART
    faces = scene.faces[alone[scene.faces].all(1)]
    return float(np.linalg.norm(corner_products(scene.vertices, faces), axis=-1).sum() / 2)


def _describe(item: ObjectModel) -> tuple[str, str, str]:
    sides = sorted((1000 * float(side) for side in np.ptp(item.mesh.vertices, axis=0)), reverse=True)
    turns = len(item.symmetries.discrete) + 2 * len(item.symmetries.continuous)
    meaning = "its box, as it stands; compare it with a ruler"
    if turns:
        meaning += "; it looks the same when turned, which models_info.json says"
    return " × ".join(f"{side:.0f}" for side in sides), "mm", meaning


def _tell_hints(hints) -> list[dict]:
    return [dataclasses.asdict(hint) for hint in hints]


STEP = Step(
    name="model",
    title="What stands on the table?",
    does="Fuses the depth of all frames into one surface, takes the table away, and makes a model of each object.",
    picture="models.png",
    caption="Each object from four sides, in its colours and as a shape; red was not measured. Right if every object "
    "of the table is there once, whole, and nothing of its neighbours is on it. If not: --object NAME:X,Y on "
    "each of them.",
    needs=("pose", "refine", "depth"),
    results=("models",),
    sometimes=(),
    extras=(),
    modules=("ipjax.capture.steps.models",),
    choose=lambda of: {
        "hints": _tell_hints(of.hints),
        "support": None if of.support is None else dataclasses.asdict(of.support),
        "models": json.loads(json.dumps(dataclasses.asdict(of.models))),
        "keep_unsure": of.keep_unsure,
    },
    make=model,
)

"""The step model: what stands on the table?"""

import dataclasses
import json

import numpy as np

from ipjax.capture.labels.pictures import draw_models
from ipjax.capture.models.making import ObjectModel, make_models
from ipjax.capture.models.storing import write_models
from ipjax.capture.steps.frames import open_frames
from ipjax.capture.steps.records import Figure, Job, Outcome, Step
from ipjax.inference.drawing import write_image


def model(job: Job) -> Outcome:
    """Models of the objects and of the scene."""
    found = make_models(list(open_frames(job)), job.settings.hints, job.settings.models, progress=job.progress)
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
    notes = tuple(f"{line[0].upper()}{line[1:]}." for line in found.notes)
    return Outcome(("models", "models.png"), tuple(figures), notes, tuple(warnings))


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
    "of the table is there once, whole, and nothing of its neighbours is on it. If not: --click NAME:X,Y on "
    "each of them.",
    needs=("pose", "refine", "depth"),
    results=("models",),
    sometimes=(),
    extras=(),
    modules=("ipjax.capture.steps.models",),
    choose=lambda of: {
        "hints": _tell_hints(of.hints),
        "models": json.loads(json.dumps(dataclasses.asdict(of.models))),
        "keep_unsure": of.keep_unsure,
    },
    make=model,
)

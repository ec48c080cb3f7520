"""The step label: where is each object in each frame?"""

import os

import numpy as np

from ipjax.capture.labels.dataset import check_dataset, write_dataset
from ipjax.capture.labels.masks import label_frames
from ipjax.capture.labels.pictures import draw_labels
from ipjax.capture.models.storing import read_models
from ipjax.capture.steps.frames import open_frames
from ipjax.capture.steps.records import Figure, Job, Outcome, Step
from ipjax.inference.drawing import write_image

_SEEN = 0.1  # visible share below which BOP does not ask for an object


def label(job: Job) -> Outcome:
    """Every frame labelled, and the data set."""
    check_dataset(job.dataset)
    models = list(read_models(job.work / "models"))
    frames = list(open_frames(job))
    labels = label_frames(models, frames, progress=lambda done, total: job.progress("labelling", done, total))
    write_dataset(
        job.dataset,
        models,
        frames,
        labels,
        replace=True,
        about={"made_of": "ipjax capture run"},
        progress=lambda done, total: job.progress("writing", done, total),
    )
    write_image(job.work / "labels.png", draw_labels(frames, labels, [item.name for item in models]))
    shares = np.stack([one.shares for one in labels])
    figures = [
        Figure("frames", len(frames), "", "in the data set: those with a sure pose"),
        Figure("labels", int((shares >= _SEEN).sum()), "", "objects in frames of which a tenth or more is visible"),
    ]
    warnings = []
    for index, item in enumerate(models):
        seen = int((shares[:, index] >= _SEEN).sum())
        share = float(np.median(shares[:, index]))
        figures.append(
            Figure(item.name, round(100 * share), "% visible", f"by the median; it is labelled in {seen} frames")
        )
        if seen < max(2, len(frames) / 10):
            warnings.append(f"{item.name} is seen in {seen} of {len(frames)} frames only.")
    relative = os.path.relpath(job.dataset, job.work)
    objects = "1 object" if len(models) == 1 else f"{len(models)} objects"
    notes = (f"{len(frames)} frames with {objects}, in BOP's layout.",)
    return Outcome(("labels.png", relative), tuple(figures), notes, tuple(warnings))


STEP = Step(
    name="label",
    title="Where is each object in each frame?",
    does="Draws the models where they stand into every frame, compares with the depth measured there, and writes "
    "masks, boxes, poses and visible shares in BOP's layout.",
    picture="labels.png",
    caption="What is visible of each object, its box and its visible share. Right if outlines lie on the objects' "
    "edges in all frames; if they are off in some, those frames' poses are wrong.",
    needs=("pose", "refine", "depth", "model"),
    results=(),
    sometimes=(),
    extras=(),
    modules=("ipjax.capture.steps.labels",),
    choose=lambda of: {"keep_unsure": of.keep_unsure},
    make=label,
    into_dataset=True,
)

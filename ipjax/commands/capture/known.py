"""Objects that ipjax knows, among those that stand in a capture: their own meshes in place of the measured ones."""

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np


def place_known(
    arguments: argparse.Namespace, frames: Sequence[Any], models: Sequence[Any]
) -> tuple[list[Any], list[str]]:
    """The models with those of ``--known`` in place of what they are, and a sentence about each.

    Raises:
      ValueError: an object file keeps no mesh, or its object is not found.
    """
    from ipjax.capture.labels.known import find_known, replace_model
    from ipjax.capture.labels.masks import label_frames
    from ipjax.config import Config
    from ipjax.files.objects.loading import load
    from ipjax.files.weights.matching import load_matching_encoder
    from ipjax.inference.estimator import Estimator

    objects = [load(path) for path in arguments.known]
    for path, (_, info) in zip(arguments.known, objects, strict=True):
        if info.vertices is None or info.faces is None:
            raise ValueError(f"--known: {path} keeps no mesh, so nothing can be drawn of it")
    encoder = load_matching_encoder(arguments.known, [info.encoder for _, info in objects], arguments.weights)
    estimator = Estimator(objects, encoder, Config.fast())
    masks = [label.visible for label in label_frames(models, frames)]
    found, notes, free = list(models), [], list(range(len(models)))
    for index, (_, info) in enumerate(objects):
        size = info.measured_diameter
        if size is None and info.metres_per_unit is not None:
            size = info.metres_per_unit / info.mesh_scale

        def estimate(frame: Any, mask: np.ndarray, index: int = index, size: float | None = size) -> Any:
            try:
                crop = estimator.frame(index, frame.rgb, frame.depth, mask, frame.camera)
            except ValueError:
                return None  # too little of it is seen, or without depth
            answer = estimator.run(index, *crop, diameter=size).estimate
            if not bool(answer.success):
                return None
            return answer.camera_from_object.to_numpy(), float(answer.confidence)

        thing, fused = find_known(frames, [mask[free] for mask in masks], estimate, name=info.name)
        place = free.pop(thing)
        found[place] = replace_model(info, fused)
        notes.append(
            f"{info.name}: {fused.agreeing.sum()} of {len(fused.agreeing)} estimates agree, to "
            f"{np.rad2deg(fused.turn):.1f}° and {1000 * fused.shift:.1f} mm; it is what was called {models[place].name}"
        )
    return found, notes

"""How a reconstructed mesh lies in the annotated model's frame: ``model_from_mesh``, metres from units of the mesh.

For evaluation only: it is fitted to the model, which a method has not seen.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ipjax.bop.records import MM, DatasetError, Estimate, check_rotation
from ipjax.files.storage.parsing import read_json
from ipjax.transforms import Similarity


def read_alignment(path: str | Path) -> Similarity[np.ndarray]:
    """``model_from_mesh`` of an alignment file: JSON with ``scale``, ``R`` (3 × 3), ``t``;
    x_model [mm] = scale · R x_mesh + t. Raises DatasetError, one sentence that names the file."""
    path = Path(path)
    try:
        entry = read_json(path)
        scale, R, t = float(entry["scale"]), np.asarray(entry["R"], np.float64), np.asarray(entry["t"], np.float64)
        R, t = R.reshape(3, 3), t.reshape(3)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: an alignment is JSON with scale, R (3 × 3) and t (3) ({error})") from None
    if not (0 < scale < math.inf and np.isfinite(R).all() and np.isfinite(t).all()):
        raise DatasetError(f"{path}: the scale must be positive, R and t finite")
    try:
        check_rotation(R)
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from None
    return Similarity(R, t * MM, np.asarray(scale * MM))


def align(estimate: Estimate, model_from_mesh: Similarity[np.ndarray]) -> Estimate:
    """The estimate of a mesh's pose (scale in metres per unit of the mesh) as one of the model's pose.

    Its scale becomes a ratio, 1 where the estimated size is that of the alignment.
    """
    pose = estimate.camera_from_object @ model_from_mesh.inverse()
    return Estimate(estimate.obj_id, estimate.score, pose.rotation, pose.translation, float(pose.scale))


def describe_alignments(alignments: Mapping[int, Similarity[np.ndarray]], aligned_by: Mapping[int, str]) -> list[str]:
    """Sentences that a table of scores has under it: which objects were moved, and by what."""
    by_source: dict[str, list[int]] = {}
    for obj_id in sorted(alignments):
        by_source.setdefault(aligned_by.get(obj_id) or "an alignment", []).append(obj_id)
    return [
        f"object{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}: another mesh than the model, moved "
        f"to the model's frame by {source} (for evaluation only; the method does not see it)"
        for source, numbers in by_source.items()
    ]

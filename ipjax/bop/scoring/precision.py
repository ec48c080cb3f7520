"""BOP 2024's average precision over the images of the targets."""

from collections.abc import Sequence

import numpy as np

from ipjax import metrics
from ipjax.bop.dataset import VISIBLE
from ipjax.bop.records import TargetRow
from ipjax.bop.results import ResultRow
from ipjax.bop.scoring.protocol import Protocol, ScoredTarget

DETECTIONS = 100  # estimates per image that count (BOP 2024)


def measure_precision(protocol: Protocol, rows: Sequence[ResultRow]) -> dict[str, float]:
    """BOP 2024's average precision over the images of the targets (MSSD and MSPD)."""
    images = sorted({(t.scene_id, t.im_id) for t in protocol.targets})
    objects = {t.obj_id for t in protocol.targets}
    grouped: dict[tuple[int, int], list[ResultRow]] = {}
    for row in rows:
        grouped.setdefault((row.scene_id, row.im_id), []).append(row)
    targets: dict[int, list[ScoredTarget]] = {obj: [] for obj in objects}
    counts = dict.fromkeys(objects, 0)
    for scene, image in images:
        camera, width, truths = protocol.annotations(scene, image)
        best = sorted(grouped.get((scene, image), []), key=lambda row: -row.score)[:DETECTIONS]
        for obj in objects:
            mine = [row for row in best if row.obj_id == obj]
            annotated = [t for t in truths if t.obj_id == obj]
            valid = np.array([t.visible < 0 or t.visible >= VISIBLE for t in annotated], bool)
            counts[obj] += int(valid.sum())
            if mine and annotated:  # the toolkit drops estimates of objects that are not in the image at all
                row = TargetRow(scene, image, obj, len(annotated))
                targets[obj].append(ScoredTarget(row, camera, width, annotated, valid, mine))
    table = {"mssd": [], "mspd": []}
    for obj in sorted(objects):
        if counts[obj] == 0:
            continue
        protocol.measure(obj, targets[obj], ())
        diameter = protocol.infos[obj].diameter
        for name, unit, thresholds in (
            ("mssd", diameter, metrics.THRESHOLDS),
            ("mspd", 1.0, metrics.PIXEL_THRESHOLDS),
        ):
            detected = [
                (getattr(s, name) / unit, np.array([e.score for e in s.estimates]), s.valid) for s in targets[obj]
            ]
            table[name].append([metrics.detection_precision(detected, counts[obj], t) for t in thresholds])
    mssd, mspd = (float(np.mean(table[name])) if table[name] else 0.0 for name in ("mssd", "mspd"))
    return {"ap_mssd": mssd, "ap_mspd": mspd, "map": (mssd + mspd) / 2}

"""The average precision of 6-D detection over the images of the targets (BOP 2024 and 2025).

Protocol: https://github.com/thodan/bop_toolkit (eval_bop24_pose.py): MSSD to 0.05 … 0.5 diameters and MSPD to 5 … 50
pixels (2024), MSSD alone, in diameters and to 2 … 20 mm (2025).
"""

from collections.abc import Sequence

import numpy as np

from ipjax import metrics
from ipjax.bop.dataset import VISIBLE
from ipjax.bop.records import TargetRow
from ipjax.bop.results import ResultRow
from ipjax.bop.scoring.protocol import Protocol, ScoredTarget

DETECTIONS = 100  # estimates per image that count
OF_BINS = {"xyzibd": 200}  # data sets of crowded bins, where more of them count
LENGTHS = 0.002 * np.arange(1, 11)  # metres: MSSD's thresholds of 2025


def measure_precision(protocol: Protocol, rows: Sequence[ResultRow]) -> dict[str, float]:
    """Average precisions ``ap_mssd``, ``ap_mspd``, their mean ``map`` (BOP 2024), and ``ap_mssd_mm`` (BOP 2025)."""
    images = protocol.dataset.target_images
    most = OF_BINS.get(protocol.dataset.name, DETECTIONS)
    objects = {t.obj_id for t in protocol.targets}
    grouped: dict[tuple[int, int], list[ResultRow]] = {}
    for row in rows:
        grouped.setdefault((row.scene_id, row.im_id), []).append(row)
    targets: dict[int, list[ScoredTarget]] = {obj: [] for obj in objects}
    counts = dict.fromkeys(objects, 0)
    for scene, image in images:
        camera, width, truths = protocol.annotations(scene, image)
        best = sorted(grouped.get((scene, image), []), key=lambda row: -row.score)[:most]
        for obj in objects:
            mine = [row for row in best if row.obj_id == obj]
            annotated = [t for t in truths if t.obj_id == obj]
            valid = np.array([t.visible < 0 or t.visible >= VISIBLE for t in annotated], bool)
            counts[obj] += int(valid.sum())
            if mine and annotated:  # the toolkit drops estimates of objects that are not in the image at all
                row = TargetRow(scene, image, obj, len(annotated))
                targets[obj].append(ScoredTarget(row, camera, width, annotated, valid, mine))
    table: dict[str, list[list[float]]] = {"mssd": [], "mspd": [], "mssd_mm": []}
    for obj in sorted(objects):
        if counts[obj] == 0:
            continue
        protocol.measure(obj, targets[obj], ())
        diameter = protocol.infos[obj].diameter
        for name, unit, thresholds in (
            ("mssd", diameter, metrics.THRESHOLDS),
            ("mspd", 1.0, metrics.PIXEL_THRESHOLDS),
            ("mssd_mm", 1.0, LENGTHS),
        ):
            error = name.removesuffix("_mm")
            detected = [
                (getattr(s, error) / unit, np.array([e.score for e in s.estimates]), s.valid) for s in targets[obj]
            ]
            table[name].append([metrics.detection_precision(detected, counts[obj], t) for t in thresholds])
    found = {f"ap_{name}": float(np.mean(values)) if values else 0.0 for name, values in table.items()}
    return found | {"map": (found["ap_mssd"] + found["ap_mspd"]) / 2}

"""The score of a result file on a data set: recalls, medians, areas under curves, and every instance."""

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ipjax.files.storage.writing import write_text


@dataclass(frozen=True)
class Instance:
    """How well one annotated instance was found; errors are infinite where nothing was."""

    scene_id: int
    im_id: int
    obj_id: int
    index: int  # of the annotation in its image
    found: bool
    score: float
    mssd: float  # metres
    mspd: float  # pixels, for an image 640 wide
    vsd: float  # mean over tolerances; NaN where it was not asked for
    add: float  # metres; NaN where it was not asked for
    add_s: float  # likewise
    rotation: float  # radians, to the symmetric pose that attains MSSD
    translation: float  # metres, likewise
    scale: float  # |estimated / true − 1|; NaN where the scale is unknown
    sized_mssd: float = math.nan  # metres, with the model at its estimated size; NaN likewise
    sized_add: float = math.nan  # likewise; ADD-S for objects with symmetries
    least_turn: float = math.nan  # radians, to the symmetric pose whose rotation is nearest
    shift: float = math.nan  # metres, to the same pose


@dataclass(frozen=True)
class Summary:
    """Recalls over a set of images."""

    images: int
    targets: int
    recalls: dict[
        str, float
    ]  # average recall by metric; "ar" is the mean of MSSD's, MSPD's and VSD's, if all are there
    intervals: dict[str, tuple[float, float]]  # 95 % bootstrap over images
    # Where the estimates' sizes are known: average recalls "mssd" and "add_or_s" of the model at its estimated size, in
    # true diameters, and the shares of targets whose size is right to 2, 5 and 10 %; their intervals. Else empty.
    sized: dict[str, float] = field(default_factory=dict)
    sized_intervals: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Score:
    """The score of a result file on a data set."""

    dataset: str
    method: str
    metrics: tuple[str, ...]
    all_frames: Summary
    one_frame_per_scene: Summary  # the first target image of each scene
    without: dict[str, Summary]  # the same two, by title, without the images that the caller doubts; or empty
    curves: dict[str, list[float]]  # recall at each threshold
    # By object: targets, average recalls, medians, and ``seconds`` for an image that shows it, where that is known.
    objects: dict[int, dict[str, float]]
    medians: dict[str, float]  # rotation_deg, translation_mm, scale_percent over the instances that got an estimate
    missing: int  # instances without an estimate
    add: dict[str, float]  # add_auc, add_s_auc, add_or_s_auc, recall_01d, add_s_01d; empty unless asked for
    precision: dict[str, float]  # ap_mssd, ap_mspd, map, ap_mssd_mm; empty unless asked for
    seconds_per_image: float | None
    notes: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    against: dict[str, Any] | None = None  # the second result file: method, objects, wins, ties, losses
    instances: tuple[Instance, ...] = field(default=(), repr=False)

    def to_dict(self, *, instances: bool = True) -> dict[str, Any]:
        """Plain numbers and text; what is not finite becomes None (JSON has no infinity)."""
        record = asdict(self)
        if not instances:
            del record["instances"]
        return _finite(record)

    def write_json(self, path: str | Path) -> Path:
        """The whole score, with every instance, as JSON."""
        return write_text(path, json.dumps(self.to_dict(), indent=1), parents=True)

    def parts(self) -> dict[str, Summary]:
        """Recalls by title, the headline first."""
        return {"one frame per scene": self.one_frame_per_scene, "all frames": self.all_frames, **self.without}


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

"""How good the labels of a data set are, as one self-contained HTML page."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.files.objects.record import ObjectInfo
from ipjax.files.pages import embed_image, render_page
from ipjax.files.storage.writing import write_text
from ipjax.files.wording import abbreviate
from ipjax.labelling.entries import Entry
from ipjax.labelling.merging.consistency import Collision, Jump
from ipjax.labelling.merging.poses import Poses
from ipjax.labelling.merging.sampling import Choice
from ipjax.labelling.outputs.pictures import draw_entry
from ipjax.labelling.sources.records import SourceFrame

_TEMPLATE = Path(__file__).with_name("page.html.jinja")
_BINS = 20
_LISTED = 40  # jumps, collisions and bad frames, each; quality.json and bad_frames.json have all
_DOUBTS = 8  # kinds of them
_HEIGHT = 420  # of a picture, pixels


def write_page(
    path: Path,
    title: str,
    frames: int,
    poses: Poses,
    infos: Mapping[int, ObjectInfo],
    jumps: Sequence[Jump],
    collisions: Sequence[Collision],
    bad: Sequence[tuple[str, str]],
    sample: Sequence[tuple[Choice, Entry]],
    read: Callable[[int], SourceFrame] | None,
    names: Callable[[int], str],
    *,
    unrelated: Sequence[int] = (),
    doubts: Sequence[tuple[str, int]] = (),
) -> None:
    """Write the page of a merged data set.

    Args:
        frames: how many there are, bad ones included.
        infos: of the objects, by number.
        bad: frames that could not be used, and why.
        sample: frames to look at, with their entries.
        read: a frame by its place; None = the source is not there, and the page has no pictures.
        names: of a frame by its place.
        unrelated: scenes whose frames do not follow one another.
        doubts: what was said of instances, and how often.

    Raises:
        OSError: it cannot be written.
    """
    jumped = {one.row for one in jumps}
    values = {
        "title": title,
        "frames": f"{frames:,}",
        "labels": f"{int(poses.present.sum()):,}",
        "guesses": f"{int((~poses.present).sum()):,}",
        "bad_count": f"{len(bad):,}",
        "jump_count": f"{len(jumps):,}",
        "collision_count": f"{len(collisions):,}",
        "objects": [_tell_object(poses, number, info, jumped, frames) for number, info in infos.items()],
        "jumps": [_tell_jump(poses, one, infos, names) for one in jumps[:_LISTED]],
        "collisions": [_tell_collision(poses, one, infos, names) for one in collisions[:_LISTED]],
        "bad": [{"frame": name, "reason": reason} for name, reason in bad[:_LISTED]],
        "listed": _LISTED,
        "unrelated": abbreviate(unrelated),
        "doubts": [{"text": text, "count": f"{count:,}"} for text, count in doubts[:_DOUBTS]],
        "sample": [_show(choice, entry, infos, read, poses) for choice, entry in sample],
        "has_pictures": read is not None,
    }
    write_text(path, render_page(_TEMPLATE, **values))


def _tell_object(poses: Poses, number: int, info: ObjectInfo, jumped: set[int], frames: int) -> dict[str, Any]:
    mine = poses.number == number
    present = mine & poses.present
    confidence = poses.confidence[mine]
    counts, _ = np.histogram(confidence, _BINS, (0, 1))
    believed, _ = np.histogram(poses.confidence[present], _BINS, (0, 1))
    most = max(int(counts.max(initial=0)), 1)
    bars = [
        {
            "x": 300 * k / _BINS,
            "all": 78 * float(counts[k]) / most,
            "present": 78 * float(believed[k]) / most,
            "count": int(counts[k]),
            "low": f"{k / _BINS:.2f}",
        }
        for k in range(_BINS)
    ]
    median = lambda values: f"{np.median(values):.2f}" if values.size else "–"
    overlap = poses.overlap[present]
    return {
        "name": info.name,
        "number": number,
        "labels": f"{int(present.sum()):,}",
        "share": f"{len(np.unique(poses.place[present])) / max(frames, 1):.0%}",
        "guesses": f"{int((mine & ~poses.present).sum()):,}",
        "confidence": median(poses.confidence[present]),
        "margin": median(poses.margin[present]),
        "overlap": median(overlap[np.isfinite(overlap)]),
        "jumps": sum(int(poses.number[row]) == number for row in jumped),
        "bars": bars,
        "most": f"{most:,}",
    }


def _tell_jump(poses: Poses, one: Jump, infos: Mapping[int, ObjectInfo], names: Callable[[int], str]) -> dict[str, str]:
    return {
        "frame": names(int(poses.place[one.row])),
        "object": infos[int(poses.number[one.row])].name,
        "moved": f"{one.moved:.2f}",
        "turned": f"{np.degrees(one.turned):.0f}",
        "confidence": f"{poses.confidence[one.row]:.2f}",
    }


def _tell_collision(
    poses: Poses, one: Collision, infos: Mapping[int, ObjectInfo], names: Callable[[int], str]
) -> dict[str, str]:
    both = [infos[int(poses.number[row])].name for row in (one.first, one.second)]
    return {"frame": names(int(poses.place[one.first])), "objects": " and ".join(both), "share": f"{one.share:.0%}"}


def _show(
    choice: Choice,
    entry: Entry,
    infos: Mapping[int, ObjectInfo],
    read: Callable[[int], SourceFrame] | None,
    poses: Poses,
) -> dict[str, Any]:
    which = ", ".join(infos[int(poses.number[row])].name for row in choice.rows)
    shown = {"frame": entry["name"], "reason": choice.reason, "object": which, "picture": ""}
    if read is not None:
        try:
            picture = draw_entry(read(choice.place).rgb, entry, infos, height=_HEIGHT)
        except (ValueError, OSError) as error:
            shown["reason"] += f" (no picture: {' '.join(str(error).split())})"
        else:
            shown["picture"] = embed_image(picture, "jpg", 82)
    return shown

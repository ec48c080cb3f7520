"""What the measures of a capture mean: a sentence each, with what was measured and what to do."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ipjax.capture.checks.inspection import Inspection
from ipjax.capture.poses.features import FEWEST
from ipjax.files.cameras.intrinsics import Intrinsics, list_misfits
from ipjax.files.wording import abbreviate

UNUSABLE, WARNING, FACT = "cannot be used", "looks wrong", "is there"  # kinds of findings
_FRAMES, _GOOD_FRAMES = 3, 8  # fewer cannot be joined; fewer leave sides unseen
_NEAREST, _FARTHEST = 0.05, 20.0  # metres; a scene whose median depth lies outside has another unit
_NEAR, _FAR = 0.2, 4.0  # metres; depth cameras measure badly outside
_KNOWN = 0.4  # share of pixels with depth
_BLURRED = 0.75  # of the sharpness of the frames around
_AROUND = 4  # frames before and after that a frame is compared with
_BRIGHT, _DARK = 0.2, 0.3  # shares of pixels that are full, or empty
_OVERLAP = 0.4  # share of a frame's depth that the next frame sees, too
_SHIFT, _GAIN, _STANDS_OUT = 3.0, 3.0, 4.0  # pixels; spreads
_MISFIT = (0.01, 0.02)  # share of the distance, metres: both together are too much for poses and depth that agree
_SAME_UNIT = 0.1  # by which the ways of the camera may differ, by poses and by depth
_CLOSE = (0.01, 1.5)  # metres, degrees: less between neighbours adds nothing


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing about a capture."""

    kind: str  # UNUSABLE, WARNING or FACT
    topic: str  # frames, camera, depth, registration, blur, exposure, overlap, poses, gripper
    text: str  # one sentence: what was measured, and what to do
    frames: tuple[str, ...] = ()  # that it is about; () = all


def list_findings(inspection: Inspection) -> list[Finding]:
    """What is there, what looks wrong, and what makes the capture unusable; the worst first, then by topic."""
    found = [
        *_about_frames(inspection),
        *_about_camera(inspection),
        *_about_depth(inspection),
        *_about_registration(inspection),
        *_about_images(inspection),
        *_about_overlap(inspection),
        *_about_poses(inspection),
        *_about_gripper(inspection),
    ]
    order = (UNUSABLE, WARNING, FACT)
    return sorted(found, key=lambda finding: order.index(finding.kind))


def _about_frames(of: Inspection) -> list[Finding]:
    capture, count = of.capture, len(of.capture)
    width, height = capture.size
    text = f"{count} frames of {width} × {height} pixels, read as {capture.form!r}"
    if len(of.looked_at) < count:
        text += f"; {len(of.looked_at)} of them, spread over the capture, were looked at"
    found = [Finding(FACT, "frames", f"{text}.")]
    found += [Finding(FACT, "frames", f"{note[0].upper()}{note[1:]}.") for note in capture.notes]
    if count < _FRAMES:
        found.append(
            Finding(
                UNUSABLE, "frames", f"There are {count} frames: a capture needs {_FRAMES} or more, better 20 to 60."
            )
        )
    elif count < _GOOD_FRAMES:
        found.append(
            Finding(
                WARNING,
                "frames",
                f"There are only {count} frames: an object seen from few sides gets a model with holes; take 20 to 60.",
            )
        )
    return found


def _about_camera(of: Inspection) -> list[Finding]:
    width, height = of.capture.size
    matrix = of.capture.camera.to_matrix()
    angles = [2 * np.degrees(np.arctan(side / 2 / f)) for side, f in ((width, matrix[0, 0]), (height, matrix[1, 1]))]
    misfits = list_misfits(Intrinsics(matrix), width, height)
    return [
        Finding(FACT, "camera", f"The colour camera sees {angles[0]:.0f}° × {angles[1]:.0f}°."),
        *(Finding(WARNING, "camera", f"Of the colour camera {misfit}; check camera.json.") for misfit in misfits),
    ]


def _about_depth(of: Inspection) -> list[Finding]:
    capture = of.capture
    distance = np.array([image.distance for image in of.images])
    known = np.array([image.known for image in of.images])
    blind = tuple(name for name, share in zip(_names(of), known, strict=True) if share < 0.02)
    if not (distance > 0).any():
        return [Finding(UNUSABLE, "depth", "No frame has any depth: the depth images are empty; record them again.")]
    middle = float(np.median(distance[distance > 0]))
    has_raw = capture.depth_size is not None
    kind = "in the pixels of the colours" if of.registered else "of the depth camera alone"
    found = [
        Finding(
            FACT,
            "depth",
            f"Depth {kind} is known on {100 * np.median(known):.0f} % of the pixels; the scene is {middle:.2f} m away "
            "in the median.",
        )
    ]
    if has_raw and capture.depth_size is not None:
        place = "with" if capture.colour_from_depth is not None else "without"
        text = (
            f"Raw depth of {capture.depth_size[0]} × {capture.depth_size[1]} pixels is there, {place} its place beside"
        )
        found.append(Finding(FACT, "depth", f"{text} the colours (colour_from_depth)."))
    if not _NEAREST <= middle <= _FARTHEST:
        found.append(
            Finding(
                UNUSABLE,
                "depth",
                f"The scene is {middle:.3g} m away in the median: the unit of depth is wrong; give --depth-scale, the "
                "metres per number of the depth images (0.001 for millimetres).",
            )
        )
    elif not _NEAR <= middle <= _FAR:
        found.append(
            Finding(
                WARNING,
                "depth",
                f"The scene is {middle:.2f} m away in the median: if that is not so, give --depth-scale; if it is, "
                "depth cameras measure badly there: 0.4 to 1 m is good.",
            )
        )
    if np.median(known) < _KNOWN:
        found.append(
            Finding(
                WARNING,
                "depth",
                f"Depth is known on {100 * np.median(known):.0f} % of the pixels only: models will have holes; "
                + ("raw/ may hold more." if has_raw and of.registered else "shiny, black and near things give none."),
            )
        )
    if blind and len(blind) < len(of.images):
        text = (
            f"{_count(blind, 'frame has', 'frames have')} next to no depth ({abbreviate(blind)}): remove what is empty."
        )
        found.append(Finding(WARNING, "depth", text, blind))
    return found


def _about_registration(of: Inspection) -> list[Finding]:
    shift = of.shift
    if shift is None:
        return []
    topic = "registration"
    if shift.certain and shift.length > _SHIFT and shift.gain > _GAIN:
        sides = [
            f"{abs(value):.0f} px too far {word[value > 0]}"
            for value, word in ((shift.across, ("right", "left")), (shift.down, ("down", "up")))
            if abs(value) >= 1
        ]
        text = (
            f"Depth does not lie on the colours: its outlines are {' and '.join(sides)}; register depth to the colours "
            "with the right calibration, or keep raw/ and let `ipjax capture depth` find it."
        )
        return [Finding(WARNING, topic, text)]
    if not shift.certain and shift.here < _STANDS_OUT:
        text = (
            "The outlines of depth fall on no edges of the photos, wherever depth is moved to within 40 px: it looks "
            "as if depth were not registered to the colours; if it is the depth camera's own image, put it into raw/ "
            "with depth_camera.json."
        )
        return [Finding(WARNING, topic, text)]
    if shift.certain and shift.length <= _SHIFT:
        text = f"Outlines of depth lie on edges of the photos, {shift.length:.1f} px apart."
        return [Finding(FACT, topic, text)]
    return [Finding(FACT, topic, "Whether depth lies on the colours cannot be told from its outlines.")]


def _about_images(of: Inspection) -> list[Finding]:
    names = _names(of)
    found = []
    blurred = tuple(name for name, bad in zip(names, find_blurred(of), strict=True) if bad)
    if blurred:
        text = (
            f"{_count(blurred, 'frame is', 'frames are')} blurred against those around ({abbreviate(blurred)}): remove "
            "them, and move the camera slower or give it more light."
        )
        found.append(Finding(WARNING, "blur", text, blurred))
    for what, limit, share, advice in (
        ("overexposed", _BRIGHT, [image.bright for image in of.images], "expose less, and keep lamps out of the image"),
        ("underexposed", _DARK, [image.dark for image in of.images], "add light, or expose longer"),
    ):
        bad = tuple(name for name, value in zip(names, share, strict=True) if value > limit)
        if bad:
            most = 100 * max(share)
            text = (
                f"{_count(bad, 'frame is', 'frames are')} {what} ({abbreviate(bad)}; up to {most:.0f} % of the pixels)"
                f": {advice}."
            )
            found.append(Finding(WARNING, "exposure", text, bad))
    return found


def find_blurred(of: Inspection) -> np.ndarray:
    """Which of the frames that were looked at are blurred against those around them."""
    sharpness = np.array([image.sharpness for image in of.images])
    around = [
        np.median(np.delete(sharpness[max(i - _AROUND, 0) : i + _AROUND + 1], min(i, _AROUND)))
        if len(sharpness) > 1
        else sharpness[i]
        for i in range(len(sharpness))
    ]
    return sharpness < _BLURRED * np.array(around)


def _about_overlap(of: Inspection) -> list[Finding]:
    if not of.pairs:
        return []
    found = []
    apart = [pair for pair in of.pairs if pair.overlap is not None and pair.overlap < _OVERLAP]
    if apart:
        frames = tuple(f"{pair.first}–{pair.second}" for pair in apart)
        least = 100 * min(pair.overlap for pair in apart if pair.overlap is not None)
        text = (
            f"{_count(frames, 'pair of neighbours shares', 'pairs of neighbours share')} less than "
            f"{100 * _OVERLAP:.0f} % of what they see, down to {least:.0f} % ({abbreviate(frames)}): take more frames "
            "there."
        )
        found.append(Finding(WARNING, "overlap", text, frames))
    poor = [pair for pair in of.pairs if pair.matches < FEWEST]
    usual = int(np.median([pair.matches for pair in of.pairs]))
    if poor:
        frames = tuple(f"{pair.first}–{pair.second}" for pair in poor)
        needed = (
            "the poses that are given are needed there"
            if of.readings
            else "their poses may not be found; take more frames, lay something printed on the table, or give poses"
        )
        text = (
            f"{len(poor)} of {len(of.pairs)} pairs of neighbours have fewer than {FEWEST} features in common "
            f"({abbreviate(frames)}; {usual} in the median): {needed}."
        )
        found.append(Finding(WARNING, "overlap", text, frames))
    shares = [pair.overlap for pair in of.pairs if pair.overlap is not None]
    text = f"Neighbours have {usual} features in common"
    if shares:
        text += f" and share {100 * np.median(shares):.0f} % of what they see"
    found.append(Finding(FACT, "overlap", f"{text}, in the median."))
    steps = np.array([pair.moved for pair in of.pairs if pair.moved is not None]).reshape(-1, 2)
    if len(steps) >= 5 and np.median(steps[:, 0]) < _CLOSE[0] and np.degrees(np.median(steps[:, 1])) < _CLOSE[1]:
        step, turn = np.median(steps[:, 0]), np.degrees(np.median(steps[:, 1]))
        most = max(2, int(min(0.03 / max(step, 1e-3), 5 / max(turn, 0.1), len(of.capture) / _GOOD_FRAMES)))
        text = (
            f"Neighbours are {1000 * step:.0f} mm and {turn:.1f}° apart, as in a video: --every {most} is as good, and "
            "faster."
        )
        found.append(Finding(FACT, "overlap", text))
    return found


def _about_poses(of: Inspection) -> list[Finding]:
    if not of.readings or of.capture.world_from_camera is None:
        return [Finding(FACT, "poses", "No poses are given: they have to be found (`ipjax capture pose`).")]
    places = of.capture.world_from_camera.translation
    way = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    found = [Finding(FACT, "poses", f"Poses of all frames are given; the camera goes {way:.2f} m.")]
    table = [pair.differences for pair in of.pairs if pair.differences and pair.differences[0] is not None]
    distance = float(np.median([image.distance for image in of.images if image.distance > 0] or [0]))
    off = np.array([[np.nan if x is None else x for x in row] for row in table]).reshape(-1, len(of.readings))
    if not len(off) or not distance:
        return found
    plain = float(np.median(off[:, 0]))
    known = np.isfinite(off).mean(0) > 0.5
    others = [float(np.nanmedian(off[:, k])) if known[k] else np.inf for k in range(len(of.readings))]
    best = int(np.argmin(others))
    measured = f"under the given poses the depth of neighbours differs by {1000 * plain:.1f} mm in the median"
    if best and others[best] < 0.5 * plain and plain > _MISFIT[1]:
        text = (
            f"{measured[0].upper()}{measured[1:]}, and by {1000 * others[best]:.1f} mm when they are read as "
            f"{of.readings[best]}: write world_from_camera, with x right, y down, z ahead."
        )
        return [*found, Finding(UNUSABLE, "poses", text)]
    if plain > _MISFIT[0] * distance and plain > _MISFIT[1]:
        text = (
            f"{measured[0].upper()}{measured[1:]}, at {distance:.2f} m: they do not belong together; check that they "
            "are of these frames, in metres and world_from_camera, or take them away and let them be found."
        )
        found.append(Finding(UNUSABLE if plain > 0.05 * distance else WARNING, "poses", text))
    else:
        found.append(Finding(FACT, "poses", f"{measured[0].upper()}{measured[1:]}."))
    return found + _compare_ways(of)


def _compare_ways(of: Inspection) -> list[Finding]:
    """Whether the camera goes as far by the given poses as by features and depth."""
    poses = of.capture.world_from_camera
    assert poses is not None
    index = {name: i for i, name in enumerate(of.capture.names)}
    ratios = []
    for pair in of.pairs:
        if pair.moved is None:
            continue
        given = np.linalg.norm(poses.translation[index[pair.second]] - poses.translation[index[pair.first]])
        if min(given, pair.moved[0]) > 0.01:
            ratios.append(pair.moved[0] / given)
    if len(ratios) < 4 or abs(np.median(ratios) - 1) < _SAME_UNIT:
        return []
    text = (
        f"By features and depth the camera goes {np.median(ratios):.3g} times as far as by the given poses: the unit "
        "of one of them is wrong (--depth-scale, or poses that are not in metres)."
    )
    return [Finding(WARNING, "poses", text)]


def _about_gripper(of: Inspection) -> list[Finding]:
    found = []
    if of.masked > 0:
        found.append(Finding(FACT, "gripper", f"Masks hide {100 * of.masked:.0f} % of the image."))
    if of.still.any():
        rows, columns = np.nonzero(of.still)
        text = (
            f"Something moves with the camera, on {100 * of.still.mean():.0f} % of the image (within columns "
            f"{columns.min()} to {columns.max()}, rows {rows.min()} to {rows.max()}): `ipjax capture pose` leaves out "
            "what it finds of it; where it finds too little, mask it with ignore.png."
        )
        found.append(Finding(WARNING, "gripper", text))
    return found


def _names(of: Inspection) -> list[str]:
    return [of.capture.names[i] for i in of.looked_at]


def _count(things: Sequence[str], one: str, many: str) -> str:
    return f"{len(things)} {one if len(things) == 1 else many}"

"""The report as one self-contained HTML page: the values that its template shows."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ipjax.files.meshes.mesh import Mesh
from ipjax.files.objects.deviations import deviations_of
from ipjax.files.objects.record import ObjectInfo, Reference
from ipjax.files.pages import embed_image, render_page
from ipjax.files.storage.writing import write_text
from ipjax.onboarding.reconstruction.methods import METHODS
from ipjax.onboarding.report.findings import STEPS, Findings, name_axis
from ipjax.onboarding.report.pictures import (
    GUESSED,
    MESH_FRONT,
    MESH_SIDES,
    SEEN,
    SIDES,
    draw_mask,
    draw_sides,
    tint_guessed,
)
from ipjax.records import Templates

if TYPE_CHECKING:
    from ipjax.onboarding.photo import PhotoObject

_TEMPLATE = Path(__file__).with_name("page.html.jinja")
_DOT, _DOT_SEEN = "#5b8dc9", np.array([91, 141, 201])  # a viewpoint where nothing is guessed
_CURVES = ("#d1495b", "#2e933c", "#3066be")  # of the three axes
_FEWEST_PIXELS = 112  # on a side of a template's picture in the page
_MOST_TEMPLATES = 24  # in the page


def write_report(
    path: str | Path,
    templates: Templates,
    info: ObjectInfo,
    mesh: Mesh,
    found: Findings,
    photo: "PhotoObject | None" = None,
    *,
    backend: str = "auto",
) -> None:
    """Write the page: photo and mask, the mesh from six sides, what is guessed, coverage, size, weights, warnings.

    ``mesh`` is the normalised mesh that was rendered, ``found`` from `examine`. Raises OSError where it cannot be
    written, RenderError where nothing can draw.
    """
    reference = info.reference
    from_photo = reference is not None
    front = MESH_FRONT if reference is None else np.asarray(reference.rotation, np.float64)
    captions = MESH_SIDES if reference is None else {name: name for name in SIDES} | {"front": "front (the photo)"}
    guessed_shape = reference is not None and not reference.metric
    views = [("The guessed shape, with the photo’s colours" if guessed_shape else "The mesh", mesh, False)]
    if from_photo:
        views.append(("What was seen and what was guessed", tint_guessed(mesh), True))
    page = render_page(
        _TEMPLATE,
        name=info.name,
        lead=_describe_source(info),
        warnings=found.warnings,
        facts=_list_facts(templates, info, found),
        photo=None if photo is None else embed_image(draw_mask(photo.foreground.rgb, photo.foreground.mask), "jpg"),
        views=[
            {
                "title": title,
                "key": key,
                "figures": [
                    {"caption": captions[side], "image": embed_image(image)}
                    for side, image in draw_sides(shown, front, backend=backend).items()
                ],
            }
            for title, shown, key in views
        ],
        seen_colour=_in_hexadecimal(SEEN),
        guessed_colour=_in_hexadecimal(GUESSED),
        knowledge=[] if reference is None else list_knowledge(reference),
        guessed_shape=guessed_shape,
        from_photo=from_photo,
        hemispheres=_list_viewpoints(templates, front, from_photo),
        turns=_plot_turns(found),
        pictures=None if info.pictures is None else _list_pictures(templates, info, front, from_photo),
        notes=info.notes,
        licences=_list_licences(info),
    )
    write_text(path, page)


def _in_hexadecimal(colour: Float[np.ndarray, "3"] | np.ndarray) -> str:
    return "#" + "".join(f"{round(float(channel)):02x}" for channel in colour)


def _describe_source(info: ObjectInfo) -> str:
    source = info.mesh_file or "a mesh"
    if info.reference is None:
        return f"made from {source}"
    method = METHODS.get(info.reference.method)
    if info.reference.method == "elsewhere":
        return f"made from {source}, {METHODS['elsewhere'].description}, {info.reference.file or 'in memory'}"
    return f"made from one photo, {source}: {method.description if method else info.reference.method}"


def _list_facts(templates: Templates, info: ObjectInfo, found: Findings) -> list[tuple[str, str]]:
    """Names and values."""
    size = 1 / info.mesh_scale
    unit = info.metres_per_unit
    sides = " × ".join(f"{1e3 * size * unit * side if unit else side:.3g}" for side in sorted(found.sides)[::-1])
    rows = []
    if unit:
        measured = " (measured)" if info.measured_diameter is not None else ""
        rows += [("diameter", f"{1e3 * size * unit:.1f} mm{measured}"), ("smallest box", f"{sides} mm")]
    else:
        rows += [("diameter", "unknown; found with the pose"), ("smallest box", f"{sides} of the diameter")]
    covered = np.asarray(templates.patches.valid).sum(-1)
    rows.append(("templates", f"{len(covered)}, of {int(covered.min())} to {int(covered.max())} patches"))
    if info.reference is not None:
        guess = "" if info.reference.metric else " as it was guessed"
        rows.append(("seen in the photo", f"{info.reference.seen:.0%} of the surface{guess}"))
        rows.append(("camera of the photo", info.reference.describe_camera()))
        off = deviations_of(info.reference.method)
        rows.append(
            (
                "off along the photo’s ray",
                f"by {off.front:.0%} of the diameter where the photo shows it, {off.back:.0%} behind; across it "
                f"{off.across:.0%} (standard deviations, measured for objects made like this one)",
            )
        )
    rows.append(("texture", f"{found.texture:.1f} CIELAB units within small windows"))
    return rows


def list_knowledge(reference: Reference) -> list[tuple[str, list[tuple[str, str]]]]:
    """What a photo tells of an object and what was guessed: two headings, under each names and what is to be said."""
    method = METHODS.get(reference.method)
    learned = f" by {method.network}" if method and method.network else ""
    known = [
        ("colours", "of the side that the photo shows"),
        ("outline", "as good as the mask above: where that is wrong, give another (--mask, --box)"),
    ]
    focal = f"{reference.describe_camera()}"
    back = ("back", f"what the photo does not show{learned or ': its front mirrored'}; trusted less, or not at all")
    if reference.metric:
        known += [
            ("front and size", "measured by the depth image, in metres"),
            ("camera", focal),
        ]
        return [("Known", known), ("Guessed", [back])]
    known.append(("directions", "the ray of every pixel of it: rotation and sight line rest on these"))
    guessed = [
        (
            "depth",
            f"how far along its ray each point lies{learned or ', from the outline alone'}: easily off by a third of "
            "the object’s size. It moves the place along the photo’s sight line, and turns nothing",
        ),
        back,
        ("size", "not told by a photo at all: found with the pose, from the query’s depth"),
    ]
    if reference.camera_given:
        known.append(("camera", focal))
    else:
        guessed.append(("camera", f"{focal}; a wrong one costs little"))
    return [("Known", known), ("Guessed", guessed)]


def _list_licences(info: ObjectInfo) -> list[tuple[str, str]]:
    """Names and values, of the weights that made the object."""
    from ipjax.files.weights.catalogue import CATALOGUE

    digest = info.encoder.rpartition("sha256:")[2]
    source = next((one for one in CATALOGUE.values() if one.sha256 == digest), None)
    licence = source.licence if source else "licence unknown: not a file of the catalogue (DINOv2 itself is Apache-2.0)"
    rows = [("encoder", f"{source.name + ', ' if source else ''}{licence}"), ("", info.encoder)]
    if info.reference is not None:
        method = METHODS.get(info.reference.method)
        rows.append(("reconstruction", method.describe_weights() if method else "no learned weights"))
    return rows


def _group_by_direction(
    templates: Templates, front: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "v 3"], list[np.ndarray]]:
    """Where every template looks from (unit vectors in the front camera's axes, which itself is at −z), and the
    templates of each direction.
    """
    rotation = np.asarray(templates.camera_from_object.rotation, np.float64)
    eye = -rotation[:, 2] @ front.T
    direction = np.unique(np.round(eye, 3), axis=0, return_inverse=True)[1].reshape(-1)
    return eye, [np.flatnonzero(direction == number) for number in range(direction.max() + 1)]


def _list_viewpoints(templates: Templates, front: Float[np.ndarray, "3 3"], from_photo: bool) -> list[dict[str, Any]]:
    """Two hemispheres of viewpoints as dots: area is how many patches, colour how much of them was seen."""
    eye, directions = _group_by_direction(templates, front)
    valid, seen = np.asarray(templates.patches.valid), np.asarray(templates.seen)
    count = valid.sum(-1)
    share = (seen * valid).sum(-1) / np.maximum(count, 1)
    names = ("photo’s side", "back") if from_photo else ("+z side", "−z side")
    hemispheres = []
    for side, (name, sign) in enumerate(zip(names, (-1, 1), strict=True)):
        middle, dots = 130 + 270 * side, []
        for members in directions:
            x, y, z = eye[members[0]]
            if sign * z < -1e-9:
                continue
            patches, mean = count[members].mean(), share[members].mean()
            dots.append(
                {
                    "x": f"{middle - sign * 105 * x:.1f}",  # the back is seen from behind
                    "y": f"{130 + 105 * y:.1f}",
                    "radius": f"{2.5 + 0.75 * np.sqrt(patches):.1f}",
                    "colour": _in_hexadecimal(mean * _DOT_SEEN + (1 - mean) * GUESSED) if from_photo else _DOT,
                    "title": f"{patches:.0f} patches" + (f", {mean:.0%} seen" if from_photo else ""),
                }
            )
        hemispheres.append({"x": middle, "name": name, "dots": dots})
    return hemispheres


def _plot_turns(found: Findings) -> dict[str, list]:
    """Likeness to itself over the turn about each axis: rules, ticks and curves of a plot, SVG units."""
    half = STEPS // 2
    across, up = lambda k: 44 + 400 * k / half, lambda value: 150 - 120 * max(0.0, value)
    return {
        "rules": [{"y": up(value), "label": f"{value:g}"} for value in (0, 0.5, 1)],
        "ticks": [{"x": across(k), "label": f"{k * 360 // STEPS}°"} for k in range(half + 1)],
        "curves": [
            {
                "points": " ".join(f"{across(k):.0f},{up(row[k]):.1f}" for k in range(half + 1)),
                "colour": _CURVES[axis],
                "key_x": 60 + 135 * axis,
                "name": name_axis(axis, found.sides),
            }
            for axis, row in enumerate(found.turns)
        ],
    }


def _list_pictures(
    templates: Templates, info: ObjectInfo, front: Float[np.ndarray, "3 3"], from_photo: bool
) -> list[dict[str, str]]:
    """Templates, one roll of each direction, nearest to the front first."""
    eye, directions = _group_by_direction(templates, front)
    rotation = np.asarray(templates.camera_from_object.rotation, np.float64)
    upright = (rotation @ front.T)[:, 1, 1]  # how far down stays down
    valid, seen = np.asarray(templates.patches.valid), np.asarray(templates.seen)
    chosen = [int(members[np.argmax(upright[members])]) for members in directions]
    chosen.sort(key=lambda view: eye[view, 2])
    if len(chosen) > _MOST_TEMPLATES:
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, _MOST_TEMPLATES).astype(int)]
    figures = []
    for view in chosen:
        picture = info.picture(view)
        if picture is None:
            continue
        picture = np.asarray(picture)
        steps = [max(1, side // _FEWEST_PIXELS) for side in picture.shape[:2]]
        patches = int(valid[view].sum())
        share = float((seen[view] * valid[view]).sum() / max(patches, 1))
        figures.append(
            {
                "image": embed_image(picture[:: steps[0], :: steps[1]], "jpg"),
                "alt": f"template {view}",
                "caption": f"{patches} patches" + (f" · {share:.0%} seen" if from_photo else ""),
            }
        )
    return figures

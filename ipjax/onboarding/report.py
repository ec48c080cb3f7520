"""What onboarding made of a mesh or a photo, as one HTML page that needs nothing beside it."""

import base64
import dataclasses
import html
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.config import OnboardConfig
from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.storage.writing import write_text
from ipjax.networks.dinov2 import Encoder
from ipjax.records import Similarity, Templates

if TYPE_CHECKING:
    from ipjax.onboarding.photo import PhotoObject

STEPS = 12  # turns about each axis
TILT = 25.0  # degrees from which the turns are watched, above and below the equator: neither end alone can hide
THIN = 0.12  # shortest side of the smallest box over its middle one
PLAIN = 2.0  # CIELAB units: median spread of lightness and colour within small windows; below, there is no texture
ALIKE = 0.8  # of the likeness of neighbouring views, below which turned views are told apart
_GUESSED = np.array([255, 120, 30])
_SIDE = 320  # pixels of each view of the mesh

# Each side's camera from the front's (rows are its axes there); OpenCV axes, so "top" looks along +y.
_SIDES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "top": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "bottom": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}
_MESH_SIDES = {"front": "+z", "right": "+x", "back": "−z", "left": "−x", "top": "+y", "bottom": "−y"}
_MESH_FRONT = np.diag([1.0, -1, -1])  # a camera at +z with +y up


@dataclasses.dataclass(frozen=True)
class Findings:
    """What was measured of an object before anyone relies on it."""

    turns: Float[np.ndarray, "3 k"]  # likeness of views turned by k · 360° / STEPS about each box axis; at 0 it is 1
    ambiguous: tuple[tuple[int, ...], ...]  # for each axis the turns, degrees, that look the same
    sides: Float[np.ndarray, "3"]  # of the smallest box, along the axes; model units
    texture: float  # CIELAB units
    warnings: tuple[str, ...]  # sentences


# --- measuring --------------------------------------------------------------------------------------------------------


def examine(
    templates: Templates,
    info: ObjectInfo,
    mesh: Mesh,
    encoder: Encoder,
    config: OnboardConfig,
    *,
    backend: str = "auto",
) -> Findings:
    """Look for what will make poses ambiguous: symmetry, thinness, no texture, much that is guessed.

    ``mesh`` is the normalised mesh the templates were rendered from, ``encoder`` the one that described them. Renders
    and describes 2 · 3 · STEPS views.
    """
    axes = np.asarray(templates.axes, np.float64)
    points = mesh.vertices[np.unique(mesh.faces)]
    sides = np.ptp(points @ axes.T, axis=0)
    turns = measure_turns(mesh, encoder, np.asarray(templates.mean), axes, config, backend=backend)
    ambiguous = find_ambiguous(turns)
    texture = measure_texture(info)
    return Findings(turns, ambiguous, sides, texture, tuple(_warn(templates, info, sides, ambiguous, texture)))


def measure_turns(
    mesh: Mesh,
    encoder: Encoder,
    mean: Float[np.ndarray, "c"],
    axes: Float[np.ndarray, "3 3"],
    config: OnboardConfig,
    *,
    backend: str = "auto",
) -> Float[np.ndarray, "3 k"]:
    """How much an object looks like itself turned about each axis (rows of ``axes``), as the matching will see it.

    Mean cosine of the centred features at the same place in the image, over the patches that either view covers, for
    all pairs of views whose turn differs by k · 360° / STEPS; the lower of the values seen from above and from below.
    """
    import jax
    import jax.numpy as jnp

    from ipjax.estimation.features import centre_on, describe
    from ipjax.onboarding.mesh import framing_cameras
    from ipjax.rendering.render import render

    poses = _circling(axes, config.distance)
    cameras = framing_cameras(mesh.vertices, poses, config.resolution, config.fill)
    views = render(mesh, poses, cameras, config.resolution, config.resolution, backend=backend)

    @jax.jit
    def see(encoder, view, mean):
        patches = describe(encoder, view, config.describe)
        return centre_on(patches.features.astype(jnp.float32), mean)[0], patches.valid

    seen = [see(encoder, views[i], jnp.asarray(mean)) for i in range(len(views))]
    features = np.stack([np.asarray(one) for one, _ in seen]).reshape(3, 2, STEPS, *seen[0][0].shape)
    valid = np.stack([np.asarray(one) for _, one in seen]).reshape(3, 2, STEPS, -1)
    found = np.ones((3, STEPS))
    for axis in range(3):
        for k in range(1, STEPS):
            ends = []
            for end in range(2):
                f, v = features[axis, end], valid[axis, end]
                other, there = np.roll(f, -k, axis=0), np.roll(v, -k, axis=0)
                both, either = v & there, v | there
                cosine = np.where(both, (f * other).sum(-1), 0)
                ends.append(cosine.sum(-1) / np.maximum(either.sum(-1), 1))
            # Views from one end that tell the turn are enough not to call the object symmetric.
            found[axis, k] = min(np.mean(one) for one in ends)
    return found


def _circling(axes: np.ndarray, distance: float) -> Similarity:
    """Views around each axis, from TILT above and below its equator: axis-major, then end, then turn."""
    import jax.numpy as jnp

    rotations = []
    for axis in range(3):
        up, first, second = axes[axis], axes[(axis + 1) % 3], axes[(axis + 2) % 3]
        for tilt in np.deg2rad([TILT, -TILT]):
            for angle in 2 * np.pi * np.arange(STEPS) / STEPS:
                eye = np.cos(tilt) * (np.cos(angle) * first + np.sin(angle) * second) + np.sin(tilt) * up
                right = np.cross(-eye, up)
                right /= np.linalg.norm(right)
                rotations.append(np.stack([right, np.cross(-eye, right), -eye]))
    count = len(rotations)
    return Similarity(
        rotation=jnp.asarray(np.stack(rotations), jnp.float32),
        translation=jnp.asarray(np.tile([0.0, 0.0, distance], (count, 1)), jnp.float32),
        scale=jnp.ones(count, jnp.float32),
    )


def find_ambiguous(turns: Float[np.ndarray, "3 k"]) -> tuple[tuple[int, ...], ...]:
    """For each axis the turns in degrees, 60 … 180, after which the object looks as much like itself as after one step.

    A small step changes any view little; what looks no more different after a large one is ambiguous.
    """
    steps = turns.shape[1]
    step = 360 // steps
    found = []
    for row in turns:
        near = max(row[1], 0.5)
        found.append(tuple(k * step for k in range(2, steps // 2 + 1) if row[k] >= ALIKE * near and row[k] > 0.5))
    return tuple(found)


def measure_texture(info: ObjectInfo) -> float:
    """Median spread of lightness and colour within windows of a 20th of a template, CIELAB units; 0 if no pictures."""
    import cv2

    if info.pictures is None:
        return 0.0
    spreads = []
    for view in np.linspace(0, len(info.pictures) - 1, 24).astype(int):
        picture = info.picture(int(view))
        if picture is None:
            continue
        inside = cv2.erode((picture.max(-1) > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        lab = cv2.cvtColor(picture.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
        size = (max(3, picture.shape[0] // 20),) * 2
        spread = cv2.blur(lab**2, size) - cv2.blur(lab, size) ** 2
        spreads.append(np.sqrt(np.maximum(spread.sum(-1), 0))[inside])
    values = np.concatenate(spreads) if spreads else np.zeros(0)
    return float(np.median(values)) if values.size else 0.0


def _warn(templates: Templates, info: ObjectInfo, sides: np.ndarray, ambiguous: tuple, texture: float) -> list[str]:
    warnings = []
    small, middle, long = np.sort(sides)
    if small < THIN * middle:
        warnings.append(
            f"thin: {small / long:.0%} as thick as it is long; seen on edge it has hardly any surface to match"
        )
    for axis, turns in enumerate(ambiguous):
        if not turns:
            continue
        name = _name_axis(axis, sides)
        if len(turns) >= STEPS // 2 - 1:
            warnings.append(
                f"symmetric: turned about its {name} it always looks alike; pose about the axis will be ambiguous"
            )
        else:
            told = ", ".join(f"{turn}°" for turn in turns)
            warnings.append(
                f"symmetric: turned by {told} about its {name} it looks alike; pose about the axis will be ambiguous"
            )
    if info.pictures is not None and texture < PLAIN:
        warnings.append(
            f"textureless: colours vary by {texture:.1f} CIELAB units in small windows; only the shape tells the pose"
        )
    if info.reference is not None and info.reference.seen < 0.35:
        warnings.append(
            f"only {info.reference.seen:.0%} of the surface was seen: queries from behind rest on what was guessed"
        )
    covered = np.asarray(templates.patches.valid).sum(-1)
    if np.median(covered) < 25:
        warnings.append(f"small in its templates: half of them have fewer than {int(np.median(covered)) + 1} patches")
    warnings += [f"{note}" for note in info.notes if "border: it may be cut off" in note or "separate parts" in note]
    return warnings


def _name_axis(axis: int, sides: np.ndarray) -> str:
    order = np.argsort(np.argsort(sides))[axis]
    return ("shortest axis", "middle axis", "longest axis")[order]


# --- pictures ---------------------------------------------------------------------------------------------------------


def draw_sides(
    mesh: Mesh, front: Float[np.ndarray, "3 3"], *, backend: str = "auto"
) -> dict[str, UInt8[np.ndarray, "h w 4"]]:
    """A normalised mesh from six sides, lit and on transparent ground; ``front`` is the front camera's rotation."""
    import jax.numpy as jnp

    from ipjax.records import Camera
    from ipjax.rendering.render import render

    rotation = np.stack([np.array(side, float) @ front for side in _SIDES.values()])
    count, distance = len(rotation), 4.0
    poses = Similarity(
        rotation=jnp.asarray(rotation, jnp.float32),
        translation=jnp.asarray(np.tile([0, 0, distance], (count, 1)), jnp.float32),
        scale=jnp.ones(count, jnp.float32),
    )
    # One scale for all six, so that sides can be compared.
    reach = max(np.abs((mesh.vertices @ one.T)[:, :2]).max() for one in rotation)
    focal = 0.47 * _SIDE * (distance - 0.5) / max(reach, 1e-3)
    camera = Camera(focal=jnp.full(2, focal, jnp.float32), centre=jnp.full(2, (_SIDE - 1) / 2, jnp.float32))
    light = {"direction": [0.35, 0.6, 1.0], "ambient": 0.6, "diffuse": 0.5}
    views = render(mesh, poses, camera, _SIDE, _SIDE, backend=backend, oversample=3, light=light)
    alpha = np.uint8(255) * views.mask.astype(np.uint8)
    return {name: np.dstack([views.rgb[i], alpha[i]]) for i, name in enumerate(_SIDES)}


def tint_guessed(mesh: Mesh) -> Mesh:
    """The mesh with its guessed part in orange, its seen part in grey-blue, and a trace of its own colours."""
    from ipjax.files.meshes.textures import sample_texture

    colours = mesh.colours if mesh.texture is None or mesh.uv is None else sample_texture(mesh.texture, mesh.uv)
    grey = colours.mean(1, keepdims=True)
    seen = mesh.seen[:, None]
    base = (1 - seen) * _GUESSED + seen * np.array([110, 150, 200])
    return make_mesh(
        mesh.vertices, mesh.faces, colours=np.rint(0.65 * base + 0.35 * grey).astype(np.uint8), seen=mesh.seen
    )


def draw_mask(rgb: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], side: int = 720) -> np.ndarray:
    """The photo around the object, what is not the object dimmed, the outline drawn."""
    import cv2

    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    size = max(np.ptp(rows), np.ptp(columns)) + 1
    pad = max(8, size // 4)
    crop = np.s_[
        max(rows[0] - pad, 0) : rows[-1] + pad + 1,
        max(columns[0] - pad, 0) : columns[-1] + pad + 1,
    ]
    image, inside = rgb[crop], mask[crop]
    zoom = min(side / max(image.shape[:2]), 6.0)
    to = (max(1, round(image.shape[1] * zoom)), max(1, round(image.shape[0] * zoom)))
    image = cv2.resize(image, to, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC)
    inside = cv2.resize(inside.astype(np.float32), to, interpolation=cv2.INTER_LINEAR) > 0.5
    picture = np.where(inside[..., None], image, image // 3 + 24).astype(np.uint8)
    outline, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.ascontiguousarray(picture), outline, -1, (255, 190, 0), 2, cv2.LINE_AA)


def _embed(image: np.ndarray, alt: str, kind: str = "png") -> str:
    import cv2

    channels = image[..., [2, 1, 0, 3]] if image.shape[-1] == 4 else image[..., ::-1]
    options = [cv2.IMWRITE_JPEG_QUALITY, 88] if kind == "jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    _, code = cv2.imencode(f".{kind}", np.ascontiguousarray(channels), options)
    mime = "jpeg" if kind == "jpg" else "png"
    text = base64.b64encode(code.tobytes()).decode()
    return f'<img alt="{html.escape(alt)}" src="data:image/{mime};base64,{text}">'


def _globes(templates: Templates, front: np.ndarray, names: tuple[str, str], told: bool) -> str:
    """Where templates look from, two hemispheres as SVG: area is how many patches, colour how much of them was seen."""
    rotation = np.asarray(templates.camera_from_object.rotation, np.float64)
    eye = -rotation[:, 2] @ front.T  # unit, in the front camera's axes; the front camera itself is at −z
    valid, seen = np.asarray(templates.patches.valid), np.asarray(templates.seen)
    count = valid.sum(-1)
    share = (seen * valid).sum(-1) / np.maximum(count, 1)
    place = np.unique(np.round(eye, 3), axis=0, return_inverse=True)[1].reshape(-1)
    parts = []
    for side, name in enumerate(names):
        x0, sign = 130 + 270 * side, (-1 if side == 0 else 1)
        parts.append(
            f'<circle cx="{x0}" cy="130" r="112" class="globe"/>'
            f'<text x="{x0}" y="268" text-anchor="middle">from the {html.escape(name)}</text>'
        )
        for number in range(place.max() + 1):
            members = np.flatnonzero(place == number)
            x, y, z = eye[members[0]]
            if sign * z < -1e-9:
                continue
            if side == 1:
                x = -x
            radius = 2.5 + 0.75 * np.sqrt(count[members].mean())
            colour = "#5b8dc9"
            if told:
                mix = share[members].mean() * np.array([91, 141, 201]) + (1 - share[members].mean()) * _GUESSED
                colour = "#" + "".join(f"{round(v):02x}" for v in mix)
            parts.append(
                f'<circle cx="{x0 + 105 * x:.1f}" cy="{130 + 105 * y:.1f}" r="{radius:.1f}" fill="{colour}" '
                f'fill-opacity="0.85"><title>{count[members].mean():.0f} patches'
                + (f", {share[members].mean():.0%} seen" if told else "")
                + "</title></circle>"
            )
    return f'<svg viewBox="0 0 530 280" role="img" aria-label="template coverage">{"".join(parts)}</svg>'


def _curves(found: Findings) -> str:
    """Likeness to itself over the turn about each axis, as SVG."""
    colours, parts = ("#d1495b", "#2e933c", "#3066be"), []
    across, up = lambda k: 44 + 400 * k / (STEPS // 2), lambda value: 150 - 120 * max(0.0, value)
    for value in (0, 0.5, 1):
        parts.append(
            f'<line x1="44" x2="444" y1="{up(value)}" y2="{up(value)}" class="rule"/>'
            f'<text x="38" y="{up(value) + 4}" text-anchor="end">{value:g}</text>'
        )
    for k in range(STEPS // 2 + 1):
        parts.append(f'<text x="{across(k)}" y="170" text-anchor="middle">{k * 360 // STEPS}°</text>')
    for axis, row in enumerate(found.turns):
        points = " ".join(f"{across(k):.0f},{up(row[k]):.1f}" for k in range(STEPS // 2 + 1))
        name = _name_axis(axis, found.sides)
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colours[axis]}" stroke-width="2.5"/>')
        parts.append(f'<text x="{60 + 135 * axis}" y="192" style="fill:{colours[axis]}" class="key">— {name}</text>')
    return f'<svg viewBox="0 0 470 200" role="img" aria-label="likeness over turns">{"".join(parts)}</svg>'


def _sheet(templates: Templates, info: ObjectInfo, front: np.ndarray, told: bool, most: int = 24) -> str:
    """Templates, one roll of each direction, nearest to the front first."""
    rotation = np.asarray(templates.camera_from_object.rotation, np.float64)
    eye = -rotation[:, 2] @ front.T
    upright = (rotation @ front.T)[:, 1, 1]  # how far down stays down
    valid, seen = np.asarray(templates.patches.valid), np.asarray(templates.seen)
    place = np.unique(np.round(eye, 3), axis=0, return_inverse=True)[1].reshape(-1)
    chosen = []
    for number in range(place.max() + 1):
        members = np.flatnonzero(place == number)
        chosen.append(int(members[np.argmax(upright[members])]))
    chosen.sort(key=lambda view: eye[view, 2])
    if len(chosen) > most:
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, most).astype(int)]
    figures = []
    for view in chosen:
        picture = info.picture(view)
        if picture is None:
            continue
        picture = np.asarray(picture)[:: max(1, picture.shape[0] // 112), :: max(1, picture.shape[1] // 112)]
        patches = int(valid[view].sum())
        share = float((seen[view] * valid[view]).sum() / max(patches, 1))
        caption = f"{patches} patches" + (f" · {share:.0%} seen" if told else "")
        figures.append(
            f"<figure>{_embed(picture, f'template {view}', 'jpg')}<figcaption>{caption}</figcaption></figure>"
        )
    return f'<div class="sheet">{"".join(figures)}</div>'


# --- the page ---------------------------------------------------------------------------------------------------------

_STYLE = """
:root{color-scheme:light dark;
--ink:#1c2430;
--soft:#5d6a7a;
--line:#d9dee5;
--card:#fff;
--ground:#f4f6f8;
--warn:#fff4e5;
--edge:#e08a1e;
--good:#e8f5ec;
--fine:#2e8b57}
@media(prefers-color-scheme:dark){
:root{

--ink:#e6eaf0;
--soft:#9aa7b6;
--line:#333c48;
--card:#1b222b;
--ground:#12171d;
--warn:#33260f;
--edge:#e0a04a;
--good:#13291c;
--fine:#5cc489}}
*{box-sizing:border-box}
body{margin:0;background:var(--ground);color:var(--ink);font:15px/1.5 system-ui,sans-serif}
main{max-width:1080px;margin:0 auto;padding:28px 20px 60px}
h1{font-size:26px;margin:0}
h2{font-size:17px;margin:0 0 10px}
.lead{color:var(--soft);margin:4px 0 18px}
section{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:18px;margin:0 0 16px}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(320px,1fr));gap:16px}
.pair section{margin:0}
.stack{margin:0 0 16px}
img,svg{max-width:100%;height:auto;display:block}
.photo img{max-height:420px;margin:0 auto;border-radius:6px}
table{border-collapse:collapse;width:100%}
td{padding:5px 8px 5px 0;border-top:1px solid var(--line);vertical-align:top}
tr:first-child td{border-top:0}
td:first-child{color:var(--soft);white-space:nowrap;padding-right:18px}
.warn,.good{border-left:4px solid var(--edge);background:var(--warn);padding:9px 14px;margin:0 0 8px;
border-radius:4px}
.good{border-color:var(--fine);background:var(--good)}
.sides{display:grid;grid-template-columns:repeat(6,1fr);gap:8px}
.sides figure,.sheet figure{margin:0;text-align:center}
.sides img{background:repeating-conic-gradient(#8883 0 25%,#0000 0 50%) 0 0/16px 16px;border-radius:6px;width:100%}
figcaption{font-size:12px;color:var(--soft)}
.sheet{display:grid;grid-template-columns:repeat(auto-fill,minmax(104px,1fr));gap:8px}
.sheet img{width:100%;border-radius:4px}
.key{margin:8px 0 0}
.key i{display:inline-block;width:12px;height:12px;border-radius:3px;margin:0 5px 0 0;vertical-align:-1px}
svg text{font-size:11px;fill:var(--soft)}
svg .key{font-weight:600}
.globe{fill:none;stroke:var(--line);stroke-width:1.5}
.rule{stroke:var(--line)}
ul{margin:0;padding-left:20px}
small{color:var(--soft)}
code{font-size:12px;word-break:break-all}
@media(max-width:700px){.sides{grid-template-columns:repeat(3,1fr)}}
"""


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
    front = _MESH_FRONT if reference is None else np.asarray(reference.rotation, np.float64)
    captions = _MESH_SIDES if reference is None else {name: name for name in _SIDES} | {"front": "front (the photo)"}
    told = reference is not None
    body = [f"<h1>{html.escape(info.name)}</h1>", f'<p class="lead">{html.escape(_lead(info))}</p>']
    body += [f'<p class="warn">{html.escape(warning)}</p>' for warning in found.warnings]
    if not found.warnings:
        body.append('<p class="good">Nothing found that would make its pose ambiguous.</p>')
    facts = f"<section><h2>Facts</h2>{_table(_facts(templates, info, found))}</section>"
    if photo is not None:
        seen = photo.foreground
        picture = _embed(draw_mask(seen.rgb, seen.mask), "the photo and its mask", "jpg")
        body.append(
            '<div class="pair stack"><section class="photo"><h2>The photo and its mask</h2>'
            f"{picture}</section>{facts}</div>"
        )
    else:
        body.append(facts)
    rows = [("The mesh", draw_sides(mesh, front, backend=backend), "")]
    if told:
        key = (
            '<p class="key"><small><i style="background:#6e96c8"></i>seen in the photo &emsp;'
            '<i style="background:#ff781e"></i>guessed</small></p>'
        )
        rows.append(("What was seen and what was guessed", draw_sides(tint_guessed(mesh), front, backend=backend), key))
    for title, views, key in rows:
        figures = "".join(
            f"<figure>{_embed(image, captions[name])}<figcaption>{html.escape(captions[name])}</figcaption></figure>"
            for name, image in views.items()
        )
        body.append(f'<section><h2>{title}</h2><div class="sides">{figures}</div>{key}</section>')
    names = ("photo’s side", "back") if told else ("+z side", "−z side")
    body.append(
        '<div class="pair stack"><section><h2>Template coverage</h2>'
        + _globes(templates, front, names, told)
        + "<small>Each dot is a viewpoint; the larger, the more patches it has"
        + ("; the more orange, the more of them lie on guessed surface." if told else ".")
        + "</small></section><section><h2>How much it looks like itself when turned</h2>"
        + _curves(found)
        + "<small>Mean cosine of the features, view against turned view, about the axes of its smallest box. "
        "A curve that stays up, or comes up again, is a turn that the features hardly tell.</small></section></div>"
    )
    if info.pictures is not None:
        body.append(f"<section><h2>Templates</h2>{_sheet(templates, info, front, told)}</section>")
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in info.notes)
    body.append(f"<section><h2>What was done</h2><ul>{notes}</ul></section>")
    body.append(f"<section><h2>Weights and licences</h2>{_table(_licences(info))}</section>")
    write_text(
        path,
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{html.escape(info.name)}: onboarding</title><style>{_STYLE}</style></head>"
        f"<body><main>{''.join(body)}</main></body></html>\n",
    )


def _lead(info: ObjectInfo) -> str:
    source = info.mesh_file or "a mesh"
    if info.reference is None:
        return f"made from {source}"
    how = {
        "depth": "its front measured by the depth image, its back guessed",
        "inflate": "its outline inflated without learned weights",
        "triposr": "reconstructed by TripoSR",
    }
    return f"made from one photo, {source}: {how.get(info.reference.method, info.reference.method)}"


def _table(rows: list[tuple[str, str]]) -> str:
    cells = (f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{''.join(cells)}</table>"


def _facts(templates: Templates, info: ObjectInfo, found: Findings) -> list[tuple[str, str]]:
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
        rows.append(("seen in the photo", f"{info.reference.seen:.0%} of the surface"))
        given = "given" if info.reference.camera_given else "assumed"
        focal = info.reference.focal
        rows.append(("camera of the photo", f"{given}, focal length {focal[0]:.0f} px"))
    rows.append(("texture", f"{found.texture:.1f} CIELAB units within small windows"))
    return rows


def _licences(info: ObjectInfo) -> list[tuple[str, str]]:
    from ipjax.files.weights.catalogue import CATALOGUE
    from ipjax.onboarding.reconstruction import TRIPOSR

    digest = info.encoder.rpartition("sha256:")[2]
    source = next((one for one in CATALOGUE.values() if one.sha256 == digest), None)
    licence = source.licence if source else "licence unknown: not a file of the catalogue (DINOv2 itself is Apache-2.0)"
    rows = [("encoder", f"{source.name + ', ' if source else ''}{licence}"), ("", info.encoder)]
    if info.reference is not None:
        made = f"TripoSR, {TRIPOSR.licence}" if info.reference.method == "triposr" else "no learned weights"
        rows.append(("reconstruction", made))
    return rows

"""What will make an object's poses ambiguous, measured when it is onboarded."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ipjax.config import OnboardConfig
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.objects.record import ObjectInfo
from ipjax.networks.dinov2 import Encoder
from ipjax.records import Similarity, Templates

STEPS = 12  # turns about each axis
TILT = 25.0  # degrees above and below the equator of the views: from one end alone a turn may not show
THIN = 0.12  # shortest side of the smallest box over its middle one
TEXTURELESS = 2.0  # CIELAB units: median spread of colour in small windows, below which there is no texture
ALIKE = 0.8  # share of the similarity of neighbouring views; turned views below it are distinguishable


@dataclasses.dataclass(frozen=True)
class Findings:
    """Properties of an onboarded object that make its poses ambiguous or uncertain."""

    turns: Float[np.ndarray, "3 k"]  # likeness of views turned by k · 360° / STEPS about each box axis; at 0 it is 1
    ambiguous: tuple[tuple[int, ...], ...]  # for each axis the turns, degrees, that look the same
    sides: Float[np.ndarray, "3"]  # of the smallest box, along the axes; model units
    texture: float  # CIELAB units
    warnings: tuple[str, ...]  # sentences


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
    return Findings(turns, ambiguous, sides, texture, tuple(list_warnings(templates, info, sides, ambiguous, texture)))


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

    poses = poses_around_axes(axes, config.distance)
    cameras = framing_cameras(mesh.vertices, poses, config.resolution, config.fill)
    views = render(mesh, poses, cameras, config.resolution, config.resolution, backend=backend)

    @jax.jit
    def describe_centred(encoder, view, mean):
        patches = describe(encoder, view, config.describe)
        return centre_on(patches.features.astype(jnp.float32), mean)[0], patches.valid

    seen = [describe_centred(encoder, views[i], jnp.asarray(mean)) for i in range(len(views))]
    features = np.stack([np.asarray(one) for one, _ in seen]).reshape(3, 2, STEPS, *seen[0][0].shape)
    valid = np.stack([np.asarray(one) for _, one in seen]).reshape(3, 2, STEPS, -1)
    found = np.ones((3, STEPS))
    for axis in range(3):
        for k in range(1, STEPS):
            ends = []
            for end in range(2):
                f, v = features[axis, end], valid[axis, end]
                other, other_valid = np.roll(f, -k, axis=0), np.roll(v, -k, axis=0)
                both, either = v & other_valid, v | other_valid
                cosine = np.where(both, (f * other).sum(-1), 0)
                ends.append(cosine.sum(-1) / np.maximum(either.sum(-1), 1))
            # The lower of the two: where a turn shows from either end, the object is not symmetric.
            found[axis, k] = min(np.mean(one) for one in ends)
    return found


def poses_around_axes(axes: Float[np.ndarray, "3 3"], distance: float) -> Similarity:
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


def list_warnings(
    templates: Templates,
    info: ObjectInfo,
    sides: Float[np.ndarray, "3"],
    ambiguous: tuple[tuple[int, ...], ...],
    texture: float,
) -> list[str]:
    """A sentence for each finding that a user must know of; the arguments are those of `Findings`."""
    warnings = []
    small, middle, long = np.sort(sides)
    if small < THIN * middle:
        warnings.append(
            f"thin: {small / long:.0%} as thick as it is long; seen on edge it has hardly any surface to match"
        )
    # A guessed back looks as its front does; whether the object does, a photo without depth does not tell.
    without_depth = info.reference is not None and not info.reference.metric
    for axis, turns in enumerate(ambiguous):
        if not turns or without_depth:
            continue
        name = name_axis(axis, sides)
        if len(turns) >= STEPS // 2 - 1:
            warnings.append(
                f"symmetric: turned about its {name} it always looks alike; pose about the axis will be ambiguous"
            )
        else:
            listed = ", ".join(f"{turn}°" for turn in turns)
            warnings.append(
                f"symmetric: turned by {listed} about its {name} it looks alike; pose about the axis will be ambiguous"
            )
    if info.pictures is not None and texture < TEXTURELESS:
        warnings.append(
            f"textureless: colours vary by {texture:.1f} CIELAB units in small windows; only the shape tells the pose"
        )
    if without_depth:
        warnings.append(
            "one photo, no depth: queries seen from beside (beyond some 60°) or from behind rest on what was guessed"
        )
    elif info.reference is not None and info.reference.seen < 0.35:
        warnings.append(
            f"only {info.reference.seen:.0%} of the surface was seen: queries from behind rest on what was guessed"
        )
    covered = np.asarray(templates.patches.valid).sum(-1)
    if np.median(covered) < 25:
        warnings.append(f"small in its templates: half of them have fewer than {int(np.median(covered)) + 1} patches")
    warnings += [f"{note}" for note in info.notes if "border: it may be cut off" in note or "separate parts" in note]
    return warnings


def name_axis(axis: int, sides: Float[np.ndarray, "3"]) -> str:
    """An axis of the smallest box in words, by the length of its side."""
    order = np.argsort(np.argsort(sides))[axis]
    return ("shortest axis", "middle axis", "longest axis")[order]

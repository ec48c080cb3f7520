"""Pictures of a report: the mesh from six sides, what of it is guessed, and the photo with its mask."""

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.files.meshes.mesh import Mesh, make_mesh
from ipjax.records import Similarity

GUESSED, SEEN = np.array([255, 120, 30]), np.array([110, 150, 200])  # colours of what is guessed and what was seen
_SIDE = 320  # pixels of each view of the mesh

# Each side's camera from the front's (rows are its axes there); OpenCV axes, so "top" looks along +y.
SIDES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "top": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "bottom": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}
MESH_SIDES = {"front": "+z", "right": "+x", "back": "−z", "left": "−x", "top": "+y", "bottom": "−y"}
MESH_FRONT = np.diag([1.0, -1, -1])  # a camera at +z with +y up


def draw_sides(
    mesh: Mesh, front: Float[np.ndarray, "3 3"], *, backend: str = "auto"
) -> dict[str, UInt8[np.ndarray, "h w 4"]]:
    """A normalised mesh from six sides, lit and on transparent ground; ``front`` is the front camera's rotation."""
    import jax.numpy as jnp

    from ipjax.records import Camera
    from ipjax.rendering.render import render

    rotation = np.stack([np.array(side, float) @ front for side in SIDES.values()])
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
    return {name: np.dstack([views.rgb[i], alpha[i]]) for i, name in enumerate(SIDES)}


def tint_guessed(mesh: Mesh) -> Mesh:
    """The mesh with its guessed part in orange, its seen part in grey-blue, and a trace of its own colours."""
    from ipjax.files.meshes.textures import sample_texture

    colours = mesh.colours if mesh.texture is None or mesh.uv is None else sample_texture(mesh.texture, mesh.uv)
    grey = colours.mean(1, keepdims=True)
    seen = mesh.seen[:, None]
    base = (1 - seen) * GUESSED + seen * SEEN
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

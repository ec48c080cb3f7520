"""Two sheets over the photo's pixels, front and back, joined along the outline into one closed, textured mesh."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ipjax.files.meshes.mesh import make_mesh
from ipjax.onboarding.reconstruction.outline import Outline, find_nearest_inside
from ipjax.onboarding.reconstruction.result import Reconstruction
from ipjax.records import Camera, Similarity


def join_sheets(
    outline: Outline,
    front: np.ndarray,
    back: np.ndarray,
    back_pixels: np.ndarray,
    seen: np.ndarray,
    rgb: np.ndarray,
    mask: np.ndarray,
    camera: tuple[np.ndarray, np.ndarray],
    *,
    metric: bool,
    report: list[str],
) -> Reconstruction:
    """The closed mesh of a front and a back [r c 3] over the same outline, in the camera's frame, as a reconstruction.

    ``back_pixels`` [r c 2] are the places of the photo whose colours the back takes; ``seen`` [r c] is 1 where the
    front was seen; ``camera`` is the photo's focal lengths and centre, pixels.
    """
    used, faces = _stitch(outline.cells)
    vertices = np.concatenate([front.reshape(-1, 3)[used], back.reshape(-1, 3)[used]])
    texture, (left, top) = _continue_texture(rgb, mask)
    height, width = texture.shape[:2]
    at = np.concatenate([outline.pixels.reshape(-1, 2)[used], back_pixels.reshape(-1, 2)[used]])
    uv = np.stack([(at[:, 0] - left + 0.5) / width, 1 - (at[:, 1] - top + 0.5) / height], -1)
    centre = (vertices.min(0) + vertices.max(0)) / 2
    mesh = make_mesh(
        vertices - centre,
        faces,
        uv=np.clip(uv, 0.0, 1.0),
        texture=texture,
        seen=np.concatenate([seen.reshape(-1)[used], np.zeros(len(used))]),
    )
    pose = Similarity(
        rotation=jnp.eye(3, dtype=jnp.float32),
        translation=jnp.asarray(centre, jnp.float32),
        scale=jnp.float32(1.0),
    )
    return Reconstruction(
        mesh=mesh,
        camera_from_mesh=pose,
        camera=Camera(focal=jnp.asarray(camera[0], jnp.float32), centre=jnp.asarray(camera[1], jnp.float32)),
        metric=metric,
        report=tuple(report),
    )


def _stitch(cells: np.ndarray) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, "m 3"]]:
    """Indices of the used nodes, and faces over front (0 … k − 1) and back (k … 2k − 1) vertices, outwards."""
    height, width = cells.shape[0] + 1, cells.shape[1] + 1
    node = np.arange(height * width).reshape(height, width)
    a, b, c, d = (node[i : i + height - 1, j : j + width - 1][cells] for i in (0, 1) for j in (0, 1))
    front = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    used, front = np.unique(front, return_inverse=True)
    front = front.reshape(-1, 3)
    count = len(used)
    edges = np.concatenate([front[:, [0, 1]], front[:, [1, 2]], front[:, [2, 0]]])
    forward, reverse = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    u, v = edges[~np.isin(forward, reverse)].T
    wall = np.concatenate([np.stack([v, u, u + count], -1), np.stack([v, u + count, v + count], -1)])
    return used, np.concatenate([front, front[:, ::-1] + count, wall])


def _continue_texture(rgb: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """The photo around the object, its colours continued beyond the outline, and its first (column, row)."""
    from scipy.ndimage import binary_erosion

    rows, columns = np.nonzero(mask)
    top, left = max(rows.min() - 4, 0), max(columns.min() - 4, 0)
    crop = np.s_[top : rows.max() + 5, left : columns.max() + 5]
    interior = np.asarray(binary_erosion(mask[crop], iterations=1))  # pixels at the edge mix object and background
    interior = interior if interior.any() else mask[crop]
    return rgb[crop][find_nearest_inside(interior)], (int(left), int(top))


def focal_and_centre(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Focal lengths [2] and centre [2] of a camera as doubles, pixels."""
    return np.asarray(camera.focal, np.float64), np.asarray(camera.centre, np.float64)

"""The depth of all frames in one volume: blocks of voxels wherever a surface was measured, and nowhere else."""

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import jax.numpy as jnp
import numpy as np
from ipjax_kernels.distances import Sums, add_frame
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from ipjax.cameras import unproject
from ipjax.capture.models.frames import PosedFrame, trust_depth
from ipjax.capture.records import CaptureError

SIDE = 8  # voxels on a side of a block
_FEWEST = 0.15  # of the points that a well seen block has, below which those in it are noise
_NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
_CHUNK = 2**17  # voxels that are looked up at a time
_FACING = 1.0  # exponent of how much more a frame counts that looks straight at a surface
_MOST = 40_000_000  # voxels: more than a table top of 1 m at 1.5 mm has near its surfaces
_LARGEST = 120_000_000  # voxels of a box


@dataclasses.dataclass(frozen=True)
class Volume:
    """Signed distances in blocks of ``SIDE``³ voxels; world = grid @ (index × voxel) for the axes of ``axes``."""

    voxel: float  # metres
    axes: Float[np.ndarray, "3 3"]  # columns: the grid's axes in world
    blocks: Int[np.ndarray, "b 3"]  # index of each block in the grid
    distance: Float[np.ndarray, "b s s s"]  # metres, positive outside; 0 where the weight is
    weight: Float[np.ndarray, "b s s s"]  # of all frames together; 0 = never seen
    colour: Float[np.ndarray, "b s s s 3"]  # 0 … 255

    def pieces(self) -> list[Bool[np.ndarray, " b"]]:
        """The blocks that hang together, piece by piece: each can be looked at in a box of its own."""
        low = self.blocks.min(0)
        occupied = np.zeros(np.ptp(self.blocks, axis=0) + 1, bool)
        places = tuple((self.blocks - low).T)
        occupied[places] = True
        labels, count = ndimage.label(occupied, np.ones((3, 3, 3)))  # pyright: ignore
        return [labels[places] == number for number in range(1, count + 1)]

    def dense(self, chosen: Bool[np.ndarray, " b"]) -> tuple[Int[np.ndarray, "3"], np.ndarray, np.ndarray, np.ndarray]:
        """The first voxel of the box of these blocks, and its distance, weight and colour as whole arrays.

        Raises:
          CaptureError: the box is too large.
        """
        blocks = self.blocks[chosen]
        low = blocks.min(0)
        shape = blocks.max(0) + 1 - low
        if np.prod(shape) * SIDE**3 > _LARGEST:
            raise CaptureError(
                f"a surface takes {' × '.join(f'{s * SIDE * self.voxel:.2f}' for s in shape)} m; at voxels of "
                f"{1000 * self.voxel:.3g} mm that is too much: take larger ones"
            )
        filled = []
        for values in (self.distance, self.weight, self.colour):
            whole = np.zeros((*shape, *values.shape[1:]), np.float32)
            whole[tuple((blocks - low).T)] = values[chosen]
            whole = whole.transpose(0, 3, 1, 4, 2, 5, *range(6, whole.ndim))
            filled.append(whole.reshape(*(shape * SIDE), *values.shape[4:]))
        return low * SIDE, filled[0], filled[1], filled[2]


def choose_blocks(
    points: Float[np.ndarray, "n 3"], voxel: float, axes: Float[np.ndarray, "3 3"]
) -> Int[np.ndarray, "b 3"]:
    """Blocks with measured points in them, and those beside them.

    Raises:
      CaptureError: there are none, or more than memory should be spent on.
    """
    cell = np.floor(points @ axes / (voxel * SIDE)).astype(np.int64)
    found, count = np.unique(cell, axis=0, return_counts=True)
    found = found[count >= max(_FEWEST * np.quantile(count, 0.75), 3)] if len(found) else found
    if not len(found):
        raise CaptureError("no surface was measured here often enough to model it")
    around = np.unique((found[:, None] + _NEIGHBOURS).reshape(-1, 3), axis=0)
    if len(around) * SIDE**3 > _MOST:
        raise CaptureError(
            f"a volume of {len(around) * SIDE**3 / 1e6:.0f} million voxels of {1000 * voxel:.3g} mm is asked for, and "
            f"{_MOST // 10**6} million are the most; take larger voxels"
        )
    return around


def fuse(
    frames: Sequence[PosedFrame],
    blocks: Int[np.ndarray, "b 3"],
    voxel: float,
    axes: Float[np.ndarray, "3 3"],
    *,
    reach: float | None = None,
    gains: Float[np.ndarray, "v 3"] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Volume:
    """All frames in one volume.

    Args:
      blocks: of the grid, as `choose_blocks` has them.
      voxel: metres.
      axes: columns: the grid's axes in world.
      reach: metres that a frame speaks of behind the surface that it sees; 2.5 voxels by default. More makes edges
        and thin things thicker, less than three times the noise of the depth leaves holes.
      gains: by which every frame's colours are multiplied.
    """
    reach = 2.5 * voxel if reach is None else reach
    offsets = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1).reshape(-1, 3)
    index = (blocks[:, None] * SIDE + offsets).reshape(-1, 3)
    count = len(index)
    points = np.zeros((-(-count // _CHUNK) * _CHUNK, 3), np.float32)
    points[:count] = index * voxel @ axes.T
    # Chunks of one size, for which one program is compiled however many blocks there are.
    chunks = [jnp.asarray(chunk) for chunk in points.reshape(-1, _CHUNK, 3)]
    nothing = Sums(jnp.zeros(_CHUNK), jnp.zeros(_CHUNK), jnp.zeros((_CHUNK, 3)), jnp.zeros(_CHUNK))
    sums = [nothing] * len(chunks)
    for number, frame in enumerate(frames):
        pose = frame.camera_from_world
        weight = trust_depth(frame)
        lean = find_lean(frame, weight > 0)
        weight = weight * lean**_FACING
        rgb = frame.rgb.astype(np.float32) * (1 if gains is None else gains[number].astype(np.float32))
        images = (frame.depth, weight, lean, rgb, frame.camera[[0, 1], [0, 1]], frame.camera[:2, 2])
        arrays = [jnp.asarray(x, jnp.float32) for x in (*images, pose.rotation, pose.translation, np.asarray(reach))]
        sums = [add_frame(mine, chunk, *arrays) for mine, chunk in zip(sums, chunks, strict=True)]
        if progress is not None:
            progress(number + 1, len(frames))
    distance, total, colour, near = (
        np.concatenate([np.asarray(x) for x in parts])[:count] for parts in zip(*sums, strict=True)
    )
    shape = (len(blocks), SIDE, SIDE, SIDE)
    return Volume(
        voxel,
        axes,
        blocks,
        (distance / np.maximum(total, 1e-9)).reshape(shape),
        total.reshape(shape),
        (colour / np.maximum(near, 1e-9)[:, None]).reshape(*shape, 3),
    )


def find_lean(frame: PosedFrame, known: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """How far along the normal the surface is from a point that is 1 nearer along z, from 0.1 to 1."""
    height, width = frame.depth.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    depth = frame.depth.astype(np.float32)
    share = cv2.GaussianBlur(known.astype(np.float32), (0, 0), 2.0)
    smooth = cv2.GaussianBlur(np.where(known, depth, 0), (0, 0), 2.0) / np.maximum(share, 1e-6)
    pixels = np.stack([columns, rows], -1).reshape(-1, 2)
    rays = unproject(frame.camera, pixels, np.ones(height * width)).reshape(height, width, 3).astype(np.float32)
    points = rays * smooth[..., None]
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    lean = np.abs((normal * rays).sum(-1))
    # Near a border the slope is that of the step from one thing to another: say what an average surface would.
    return np.where(cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0, np.clip(lean, 0.1, 1), 0.7)

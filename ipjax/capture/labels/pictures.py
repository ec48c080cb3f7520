"""Pictures that show whether models and labels are right."""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from ipjax.capture.labels.masks import FrameLabels
from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.making import ObjectModel
from ipjax.files.meshes.mesh import Mesh, diameter
from ipjax.inference.drawing import PALETTE
from ipjax.records import Camera
from ipjax.rendering.render import render_each
from ipjax.transforms import Similarity, rotation_from_vector

_MOST = 24  # frames on a sheet
_TILE = 320  # pixels wide
_INK = (30, 30, 30)


def draw_labels(
    frames: Sequence[PosedFrame], labels: Sequence[FrameLabels], names: Sequence[str]
) -> UInt8[np.ndarray, "h w 3"]:
    """A sheet of frames, evenly picked, with outlines of what is visible, boxes and names."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_MOST, len(frames))).round().astype(int))
    return lay_out([_draw_frame(frames[int(i)], labels[int(i)], names) for i in chosen], 4)


def _draw_frame(frame: PosedFrame, label: FrameLabels, names: Sequence[str]) -> np.ndarray:
    zoom = _TILE / frame.size[0]
    size = (_TILE, round(zoom * frame.size[1]))
    image = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
    for index, mask in enumerate(label.visible):
        colour = PALETTE[index % len(PALETTE)]
        small = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
        image[small] = (0.75 * image[small] + 0.25 * np.array(colour)).astype(np.uint8)
        outline, _ = cv2.findContours(small.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, outline, -1, colour, 1, cv2.LINE_AA)
        x, y, width, height = (round(v * zoom) for v in label.visible_boxes[index])
        if width > 0:
            cv2.rectangle(image, (x, y), (x + width, y + height), colour, 1)
            text = f"{names[index]} {100 * label.shares[index]:.0f} %"
            write_label(image, text, (x, max(y - 4, 10)), colour)
    write_label(image, frame.name, (4, size[1] - 6))
    return image


def draw_models(models: Sequence[ObjectModel], *, backend: str = "auto") -> UInt8[np.ndarray, "h w 3"]:
    """Every model from four sides, in its colours and as a shape; what was not measured is red in the shape."""
    side = 220
    camera = Camera.from_matrix(np.array([[side * 1.9, 0, side / 2 - 0.5], [0, side * 1.9, side / 2 - 0.5], [0, 0, 1]]))
    directions = [(azimuth, 0.55) for azimuth in (0.4, 2.0, 3.6)] + [(0.4, -0.6)]
    meshes = [mesh for model in models for mesh in (model.mesh, _as_shape(model.mesh))]
    poses = [_look_from(directions, 2.3 * diameter(model.mesh)) for model in models for _ in range(2)]
    drawn = render_each(
        meshes,
        np.repeat(np.arange(len(meshes)), len(directions)).tolist(),
        Similarity(
            np.concatenate([pose.rotation for pose in poses]),
            np.concatenate([pose.translation for pose in poses]),
            np.ones(len(meshes) * len(directions)),
        ).to_jax(),
        camera,
        side,
        side,
        backend=backend,
    )
    views = np.where(drawn.mask[..., None], drawn.rgb, 255).astype(np.uint8)
    views = views.reshape(len(models), 2, len(directions), side, side, 3)
    tiles = []
    for model, shown in zip(models, views, strict=True):
        tile = np.ascontiguousarray(shown.transpose(0, 2, 1, 3, 4).reshape(2 * side, len(directions) * side, 3))
        size = 1000 * np.ptp(model.mesh.vertices, axis=0)
        write_label(tile, f"{model.name}  {size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm", (6, 16))
        tiles.append(tile)
    return lay_out(tiles, 2)


def _as_shape(mesh: Mesh) -> Mesh:
    """Grey, lit from above and from one side; red where it was not measured."""
    lamp = np.array([0.5, -0.4, 0.77])
    shade = 0.45 + 0.55 * np.clip(0.5 + 0.5 * mesh.normals @ lamp, 0, 1)
    grey = np.where(mesh.seen[:, None] > 0, np.array([225, 225, 225]), np.array([240, 110, 100])) * shade[:, None]
    return dataclasses.replace(mesh, colours=grey.astype(np.uint8), uv=None, texture=None)


def _look_from(directions: Sequence[tuple[float, float]], away: float) -> Similarity[np.ndarray]:
    """``camera_from_model`` of cameras around the origin, z of the model up in their images."""
    turns = []
    for azimuth, elevation in directions:
        # The camera looks along +z with y down; first it stands in front of the model, then it climbs.
        upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        climb = rotation_from_vector(np.array([elevation, 0.0, 0.0]))
        turns.append(climb @ upright @ rotation_from_vector(np.array([0.0, 0.0, azimuth])))
    return Similarity(np.stack(turns), np.tile([0.0, 0.0, away], (len(turns), 1)), np.ones(len(turns)))


def lay_out(tiles: Sequence[np.ndarray], columns: int, gap: int = 6) -> UInt8[np.ndarray, "h w 3"]:
    """Pictures in rows, so many side by side."""
    height, width = max(t.shape[0] for t in tiles), max(t.shape[1] for t in tiles)
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for index, tile in enumerate(tiles):
        y, x = (index // columns) * (height + gap), (index % columns) * (width + gap)
        sheet[y : y + tile.shape[0], x : x + tile.shape[1]] = tile
    return sheet


def write_label(image: np.ndarray, text: str, place: tuple[int, int], colour: Sequence[int] = (255, 255, 255)) -> None:
    """A line on a dark ground."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.38, 1)
    x, y = place
    cv2.rectangle(image, (x - 2, y - height - 2), (x + width + 1, y + below - 1), _INK, -1)
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.38, tuple(colour), 1, cv2.LINE_AA)

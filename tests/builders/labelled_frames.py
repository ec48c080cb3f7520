"""Frames to be labelled, with two objects and the stand-in encoder: the ellipsoid alone before a wall."""

import dataclasses
import functools
import io
import json
import tarfile
from pathlib import Path

import equinox as eqx
import numpy as np
from builders.tiny_pipeline import TINY, two_objects
from PIL import Image

from ipjax.config import Config, ScoreConfig
from ipjax.files.images.run_lengths import decode_rle, encode_rle
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.objects.saving import save
from ipjax.files.settings import describe_config
from ipjax.labelling.batch import Labeller
from ipjax.labelling.records import Batch, LabelSettings
from ipjax.synthetic import problems

# Poses from pairs, refined once and neither scored nor drawn: a third of the graph to be compiled.
CONFIG = Config(
    match=TINY.match,
    align=TINY.align,
    refine=TINY.refine,
    score=ScoreConfig(resolution=28, ranking="inliers", alternates=0, drawn=0),
)
HEIGHT, WIDTH = 96, 128


class NamedEncoder(problems.CoordinateEncoder):
    """The encoder with an identity, as object files want it."""

    identity: str = eqx.field(static=True, default="coordinates")


@functools.cache
def named_encoder() -> NamedEncoder:
    plain = problems.make_encoder()
    return NamedEncoder(plain.frequencies, plain.phases)


@functools.cache
def labelled_objects() -> tuple:
    """The ellipsoid twice, with more and fewer templates; both of 200 mm in the unit of their files."""
    found = []
    for index, templates in enumerate(two_objects()):
        patches = dataclasses.replace(templates.patches, encoder="coordinates")
        info = ObjectInfo(
            name=f"obj_{index + 1:06d}",
            encoder="coordinates",
            mesh_scale=1 / 200,
            mesh_centre=(10.0, -5.0, 3.0 * index),
            mesh_file="ellipsoid.ply",
            resolution=8 * problems.PATCH,
        )
        found.append((dataclasses.replace(templates, patches=patches), info))
    return tuple(found)


@functools.cache
def make_frames(count: int) -> tuple[problems.Frame, ...]:
    return tuple(problems.make_frame(seed, HEIGHT, WIDTH, share=(0.5, 0.6)) for seed in range(count))


def as_batch(frames, ids=None, object_of=lambda number: number % 2) -> Batch:
    """The frames as a batch; each shows one object, whose mask is given."""
    ids = [f"frame {number}" for number in range(len(frames))] if ids is None else ids
    return {
        "id": ids,
        "rgb": np.stack([one.rgb for one in frames]),
        "depth": np.stack([one.depth for one in frames]),
        "camera": np.stack([one.matrix for one in frames]),
        "mask": np.stack([one.mask for one in frames])[:, None],
        "object": np.array([[object_of(number)] for number in range(len(frames))]),
    }


@functools.cache
def labeller(**settings) -> Labeller:
    """One for each settings; what it compiles is kept for all tests."""
    return Labeller(named_encoder(), labelled_objects(), CONFIG, LabelSettings(**settings))


def write_objects(folder: Path) -> Path:
    """The objects as files, obj_000001.ipjax and obj_000002.ipjax."""
    folder.mkdir(parents=True, exist_ok=True)
    for templates, info in labelled_objects():
        save(folder / f"{info.name}.ipjax", templates, info)
    return folder


def write_settings(path: Path) -> Path:
    """`CONFIG` as a file of settings."""
    path.write_text(json.dumps(describe_config(CONFIG)))
    return path


def write_parts(frames) -> dict[str, bytes]:
    """Frames in BOP's image-wise form: the content of every file, by its name; object 1 and 2 in turn."""
    found = {}
    for number, one in enumerate(frames):
        key = f"{number // 100:06d}_{number % 100:06d}"
        rgb, depth = io.BytesIO(), io.BytesIO()
        Image.fromarray(one.rgb).save(rgb, "PNG", compress_level=1)
        Image.fromarray(np.round(one.depth * 10_000).astype(np.uint16)).save(depth, "PNG", compress_level=1)
        pose = one.camera_from_object.to_numpy()
        truth = {"cam_R_m2c": pose.rotation.ravel().tolist(), "cam_t_m2c": (1000 * pose.translation).tolist()}
        found |= {
            f"{key}.rgb.png": rgb.getvalue(),
            f"{key}.depth.png": depth.getvalue(),
            f"{key}.camera.json": _json({"cam_K": one.matrix.ravel().tolist(), "depth_scale": 0.1}),
            f"{key}.gt.json": _json([{"obj_id": 9, **truth}, {"obj_id": 1 + number % 2, **truth}]),
            f"{key}.mask_visib.json": _json({"0": encode_rle(one.mask), "1": encode_rle(one.mask, compressed=False)}),
        }
    return found


def write_image_wise(folder: Path, frames) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in write_parts(frames).items():
        (folder / name).write_bytes(content)
    return folder


def write_tars(folder: Path, frames, per_tar: int) -> Path:
    """Webdataset shards."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = list(write_parts(frames).items())
    for start in range(0, len(frames), per_tar):
        with tarfile.open(folder / f"shard-{start // per_tar:06d}.tar", "w") as file:
            for name, content in parts[5 * start : 5 * (start + per_tar)]:
                member = tarfile.TarInfo(name)
                member.size = len(content)
                file.addfile(member, io.BytesIO(content))
    return folder


def write_scenes(root: Path, frames) -> Path:
    """A BOP data set of scenes of a hundred images, without models."""
    documents: dict[Path, dict] = {}
    for name, content in write_parts(frames).items():
        key, _, part = name.partition(".")
        scene, image = key.split("_")
        place = root / "test" / scene
        if part in ("rgb.png", "depth.png"):
            kind = place / part.partition(".")[0]
            kind.mkdir(parents=True, exist_ok=True)
            (kind / f"{image}.png").write_bytes(content)
            continue
        file = {"camera.json": "scene_camera.json", "gt.json": "scene_gt.json"}.get(part)
        if file is not None:
            documents.setdefault(place / file, {})[str(int(image))] = json.loads(content)
            continue
        (place / "mask_visib").mkdir(exist_ok=True)
        for index, run in json.loads(content).items():
            mask = Image.fromarray(decode_rle(run).astype(np.uint8) * 255)
            mask.save(place / "mask_visib" / f"{image}_{int(index):06d}.png")
    for path, document in documents.items():
        path.write_text(json.dumps(document))
    return root


def write_frame_folder(folder: Path, frames) -> Path:
    """A folder of frames that show object 1, with its masks."""
    for kind in ("rgb", "depth", "mask"):
        (folder / kind).mkdir(parents=True)
    for number, one in enumerate(frames):
        name = f"{number:06d}"
        Image.fromarray(one.rgb).save(folder / "rgb" / f"{name}.png")
        Image.fromarray(np.round(one.depth * 10_000).astype(np.uint16)).save(folder / "depth" / f"{name}.png")
        Image.fromarray(one.mask.astype(np.uint8) * 255).save(folder / "mask" / f"{name}.png")
    cameras = {str(n): {"cam_K": one.matrix.ravel().tolist(), "depth_scale": 0.1} for n, one in enumerate(frames)}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def _json(document) -> bytes:
    return json.dumps(document).encode()

"""From one photo to an onboarded object: mask, mesh, templates, and the pose of the photo's camera."""

import dataclasses
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipjax.cameras import middle, resize, resize_pixels
from ipjax.config import OnboardConfig
from ipjax.files.cameras.exif import ExifFocal
from ipjax.files.cameras.intrinsics import Intrinsics, list_misfits
from ipjax.files.cameras.reading import as_intrinsics, read_camera
from ipjax.files.images.arrays import as_native
from ipjax.files.images.depth import read_depth, remove_sentinel
from ipjax.files.images.masks import read_mask
from ipjax.files.objects.deviations import with_deviations
from ipjax.files.objects.record import GUESS_DEVIATION, ObjectInfo, Reference
from ipjax.files.objects.saving import save
from ipjax.files.weights.encoder import load_encoder
from ipjax.files.weights.hashes import hash_file
from ipjax.inference.cutting import undistort_frame
from ipjax.inference.depth import check_depth_unit, find_depth_scale, sample_depth, to_metres
from ipjax.onboarding.foreground import Foreground, Photo, find_foreground, read_photo
from ipjax.onboarding.measured_photo import describe_measured_photo
from ipjax.onboarding.mesh import onboard
from ipjax.onboarding.photo_views import ReferencePhoto
from ipjax.onboarding.reconstruction.methods import METHODS
from ipjax.onboarding.reconstruction.reconstruct import reconstruct_with_weights
from ipjax.onboarding.reconstruction.result import Reconstruction
from ipjax.records import Camera, Templates

log = logging.getLogger("ipjax")

_PICTURE = 320  # pixels, longest side of the kept photo


@dataclasses.dataclass(frozen=True)
class PhotoObject:
    """An object made from a photo, and what it came from."""

    templates: Templates
    info: ObjectInfo
    foreground: Foreground
    reconstruction: Reconstruction


@dataclasses.dataclass(frozen=True)
class PreparedPhoto:
    """A photo with its mask, and its depth and camera where they are known: all of one size, the lens undone."""

    foreground: Foreground
    depth: np.ndarray | None  # along z, metres, 0 = unknown
    camera: Camera | None  # None = to be guessed
    camera_source: str = "guessed"  # or "given", or "exif"
    focal_deviation: float = GUESS_DEVIATION  # relative standard deviation


def onboard_photo(
    source: str | Path | Photo,
    encoder: Callable[..., Any] | None = None,
    config: OnboardConfig = OnboardConfig(),
    *,
    mask: Any = None,
    box: Sequence[int | float] | None = None,
    click: Sequence[int | float] | None = None,
    depth: Any = None,
    camera: Any = None,
    depth_scale: float | None = None,
    lrm: str = "auto",
    lrm_weights: str | Path | None = None,
    tried: str | Path | None = None,
    out: str | Path | None = None,
    name: str | None = None,
    progress: bool = True,
    backend: str = "auto",
) -> PhotoObject:
    """Onboard an object from one photo of it: reconstruct a mesh, then make its templates.

    Args:
      source: a photo's file, or a `Photo`.
      encoder: default: the best weights on this machine.
      mask: file, or height × width: the object. Default: transparency, ``box``, ``click``, a plain background, or rembg
        where that package and a model of it are installed.
      box: (x, y, width, height) around the object, pixels of the photo's file as it is shown upright.
      click: (x, y) on the object, likewise.
      depth: file, or height × width along z, aligned to the photo; needs ``camera``. The object is then in metres.
      camera: anything that `read_camera` or `as_intrinsics` of `ipjax.files.cameras.reading` takes. Default: a focal
        length by the file's EXIF where it has one, else a guess.
      depth_scale: metres per unit of depth; default: the camera file's, else 1 for floats.
      lrm: "triposr" (needs its weights), "inflate" (needs none), or "auto": what was measured where there is depth,
        else TripoSR where its weights are, else inflation. Nothing is downloaded.
      lrm_weights: TripoSR's checkpoint; default: IPJAX_TRIPOSR, or the cache.
      tried: where a picture goes when no mask is found.
      out: also write the object file.
      name: default: the file's.

    Raises:
      ValueError: no usable photo, mask, depth, camera or weights; one sentence.
    """
    prepared = prepare_photo(
        source, mask=mask, box=box, click=click, depth=depth, camera=camera, depth_scale=depth_scale, tried=tried
    )
    made, method = reconstruct_with_weights(
        prepared.foreground,
        method=lrm,
        weights=lrm_weights,
        depth=prepared.depth,
        camera=prepared.camera,
        progress=_print_progress if progress else None,
    )
    path = None if isinstance(source, Photo) else Path(source)
    name = name or (path.stem if path else "object")
    encoder = load_encoder() if encoder is None else encoder
    shown, reference = prepared.foreground, None
    if made.camera_from_mesh is not None and made.camera is not None:
        reference = ReferencePhoto(shown.rgb, shown.mask, made.camera_from_mesh, made.camera)
    measured = prepared.depth is not None
    templates, info = onboard(
        made.mesh,
        encoder,
        config,
        name=name,
        reference=None if measured else reference,
        progress=progress,
        backend=backend,
    )
    templates = dataclasses.replace(templates, surface=with_deviations(templates.surface, method))
    if measured and reference is not None:
        view = describe_measured_photo(reference, made.mesh, templates, encoder, config, backend=backend)
        templates = dataclasses.replace(templates, reference=view)
    info = dataclasses.replace(
        info,
        mesh_file=path.name if path else "",
        mesh_sha256=hash_file(path) if path else "",
        metres_per_unit=1.0 if made.metric else None,
        notes=(*made.report, *info.notes),
        reference=describe_reference(path, prepared, made, method, info, templates),
    )
    if out is not None:
        save(out, templates, info)
    return PhotoObject(templates, info, prepared.foreground, made)


def prepare_photo(
    source: str | Path | Photo,
    *,
    mask: Any = None,
    box: Sequence[int | float] | None = None,
    click: Sequence[int | float] | None = None,
    depth: Any = None,
    camera: Any = None,
    depth_scale: float | None = None,
    tried: str | Path | None = None,
) -> PreparedPhoto:
    """Read a photo with all that belongs to it, find the object in it, and undo the lens; see `onboard_photo`.

    Raises ValueError in one sentence: whatever is unreadable, does not fit, or has no unit.
    """
    if depth is not None and camera is None:
        raise ValueError("depth without its camera has no metric points: give the camera too")
    if sum(option is not None for option in (mask, box, click)) > 1:
        raise ValueError("give one of mask, box and click, not several")
    photo = source if isinstance(source, Photo) else read_photo(source)
    companions = [name for name, value in (("mask", mask), ("depth", depth), ("camera", camera)) if value is not None]
    if photo.orientation != 1 and companions and not isinstance(source, Photo):
        raise ValueError(
            f"{source}: its EXIF orientation ({photo.orientation}) says that it is to be shown turned, and nothing "
            f"says whether {' and '.join(companions)} belong to it as stored or as shown; save all of them the same "
            "way up"
        )
    mask = read_mask(mask) if isinstance(mask, str | Path) else mask
    depth = read_depth(depth) if isinstance(depth, str | Path) else depth
    intrinsics = None
    if camera is not None:
        intrinsics = read_camera(camera) if isinstance(camera, str | Path | dict) else as_intrinsics(camera)
    height, width = photo.rgb.shape[:2]
    if intrinsics is not None and intrinsics.size is not None:
        full = (width / photo.scale, height / photo.scale)
        if any(abs(a - b) > 1.5 / photo.scale for a, b in zip(intrinsics.size, full, strict=True)):
            raise ValueError(
                f"the camera belongs to images of {intrinsics.size[0]} × {intrinsics.size[1]} pixels, "
                f"but the photo has {full[0]:.0f} × {full[1]:.0f}"
            )
    if box is not None:
        if len(box) != 4 or not (box[2] > 0 and box[3] > 0):
            raise ValueError("a box is x, y, width, height in pixels, with a positive size")
        box = (box[0], box[1], box[0] + box[2], box[1] + box[3])
    if click is not None and len(click) != 2:
        raise ValueError("a click is x, y in pixels")
    foreground = find_foreground(photo, mask=mask, box=box, click=click, tried=tried)
    if intrinsics is not None:
        for misfit in list_misfits(intrinsics, round(width / photo.scale), round(height / photo.scale)):
            log.warning("camera: %s", misfit)
    metres = None
    if depth is not None:
        assert intrinsics is not None
        metres = _to_metres(np.asarray(depth), foreground.mask, photo.scale, depth_scale, intrinsics)
    whole = photo.full_size or (width / photo.scale, height / photo.scale)
    found = {"camera_source": "given", "focal_deviation": 0.0}
    if intrinsics is None:
        told = photo.focal or ExifFocal()
        if told.note:
            foreground = dataclasses.replace(foreground, notes=(*foreground.notes, told.note))
        if told.pixels is None:
            return PreparedPhoto(foreground, None, None)
        found = {"camera_source": "exif", "focal_deviation": told.deviation}
        x, y = middle(*whole)
        intrinsics = Intrinsics(np.array([[told.pixels, 0, x], [0, told.pixels, y], [0, 0, 1]]))
    intrinsics = dataclasses.replace(intrinsics, matrix=resize(intrinsics.matrix, whole, (width, height)))
    if intrinsics.distortion:
        nothing = np.zeros((height, width), np.float32)
        rgb, metres_, kept, _ = undistort_frame(
            foreground.rgb, nothing if metres is None else metres, foreground.mask, None, intrinsics
        )
        metres = None if depth is None else metres_
        foreground = dataclasses.replace(
            foreground,
            rgb=rgb,
            mask=np.asarray(kept),
            alpha=np.uint8(255) * np.asarray(kept, np.uint8),
            notes=(*foreground.notes, "the lens's distortion was undone"),
        )
    return PreparedPhoto(foreground, metres, intrinsics.camera, **found)


def _to_metres(
    depth: np.ndarray, mask: np.ndarray, scale: float, depth_scale: float | None, intrinsics: Intrinsics
) -> np.ndarray:
    """The depth image in metres, as large as the photo as it was read (which may have been reduced)."""
    depth = as_native(depth)
    if depth.ndim != 2:
        raise ValueError(f"depth has one number per pixel, not the shape {list(depth.shape)}")
    depth, unknown = remove_sentinel(depth)
    if unknown:
        log.info("%s", unknown)
    height, width = mask.shape
    unit = find_depth_scale(depth, depth_scale, intrinsics)
    if depth.shape != mask.shape:
        if any(abs(d * scale - p) > 1.0 for d, p in zip(depth.shape, mask.shape, strict=True)):
            raise ValueError(
                f"the photo has {width / scale:.0f} × {height / scale:.0f} pixels, the depth image "
                f"{depth.shape[1]} × {depth.shape[0]}: align the depth to the photo first"
            )
        wide, high = (
            resize_pixels(np.arange(after, dtype=float)[:, None], (after, after), (before, before))[:, 0]
            for before, after in zip(depth.shape[::-1], (width, height), strict=True)
        )
        known = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        depth = sample_depth(known, wide[None, :], high[:, None])
    check_depth_unit(depth, mask, (0, 0, width, height), unit)
    return to_metres(depth, unit)


def _print_progress(stage: str, share: float) -> None:
    print(f"\rreconstructing: {stage} {share:.0%}  ", end="\n" if share >= 1 else "", flush=True)


def describe_reference(
    path: Path | None,
    prepared: PreparedPhoto,
    made: Reconstruction,
    method: str,
    info: ObjectInfo,
    templates: Templates,
) -> Reference | None:
    """The photo and its camera as the object file keeps them; None where the camera is not known."""
    import cv2

    if made.camera_from_mesh is None or made.camera is None:
        return None
    pose, lens = made.camera_from_mesh, made.camera
    image = prepared.foreground.rgb
    kept = METHODS[method].keeps_camera  # else the network's own is as good as a guess
    height, width = image.shape[:2]
    zoom = min(1.0, _PICTURE / max(height, width))
    small = cv2.resize(image, (max(1, round(width * zoom)), max(1, round(height * zoom))), interpolation=cv2.INTER_AREA)
    _, code = cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])
    focal, centre = (np.asarray(x, np.float64) for x in (lens.focal, lens.centre))
    return Reference(
        file=path.name if path else "",
        sha256=hash_file(path) if path else "",
        rotation=np.asarray(pose.rotation, np.float64),
        translation=np.asarray(pose.translation, np.float64),
        scale=float(pose.scale),
        focal=(float(focal[0]), float(focal[1])),
        centre=(float(centre[0]), float(centre[1])),
        size=(int(width), int(height)),
        camera_source=prepared.camera_source if kept else "guessed",
        focal_deviation=prepared.focal_deviation if kept else GUESS_DEVIATION,
        metric=made.metric,
        method=method,
        seen=float(np.asarray(templates.surface.seen).mean()),
        picture=code.tobytes(),
    )

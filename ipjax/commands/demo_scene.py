"""What ``ipjax demo`` runs: an object on a table is found, known from a degraded mesh, and from one RGB photo.

The scene is synthetic, so nothing is needed but an encoder. The files written are those of a real case: a mesh like one
of a reconstruction model, a photo of the object with its camera, and of the scene an image, its depth, a mask and a
camera.
"""

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from ipjax.config import Config
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.meshes.sampling import sample_surface
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.objects.layout import SUFFIX
from ipjax.files.objects.record import ObjectInfo
from ipjax.files.storage.writing import write_text
from ipjax.inference.drawing import draw, gather_evidence, write_image
from ipjax.inference.estimator import Estimator
from ipjax.inference.photos.corrected_mesh import correct_info
from ipjax.inference.reports import relative_pose
from ipjax.networks.dinov2 import Encoder
from ipjax.onboarding.foreground import ForegroundError
from ipjax.onboarding.mesh import onboard
from ipjax.onboarding.photo import onboard_photo
from ipjax.records import Similarity
from ipjax.robot.cell.camera import Sight
from ipjax.synthetic.degradation import degrade
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.photos import MadePhoto, make_photo
from ipjax.synthetic.scenes import Scene, make_scene

TARGETS = ("mug", "bottle", "corner", "wedge", "tee", "pot")  # the object to find, by seed
LEVEL = 2  # of degradation: smoothed, bumpy, its texture blurred
FOUND = 0.1  # ADD-S below this share of the diameter counts as found


@dataclasses.dataclass(frozen=True)
class Comparison:
    """How far an estimate is from the truth."""

    rotation: float  # degrees
    translation: float  # of the object's centre, metres
    true_size: float  # diameter, metres
    size: float
    add: float  # ADD: mean distance of corresponding surface points, share of the true diameter
    adds: float  # ADD-S: the same to the nearest point, which ignores turns that a symmetric shape does not show

    @property
    def good(self) -> bool:
        """Whether the estimated surface lies where the object is."""
        return self.adds < FOUND

    def as_json(self) -> dict[str, float]:
        """The same with names that end in their unit; ``_diameters``: shares of the true diameter."""
        return {
            "rotation_deg": self.rotation,
            "translation_mm": 1e3 * self.translation,
            "true_diameter_mm": 1e3 * self.true_size,
            "diameter_mm": 1e3 * self.size,
            "add_diameters": self.add,
            "adds_diameters": self.adds,
        }


@dataclasses.dataclass(frozen=True)
class PhotoComparison:
    """What an RGB photo of the object was worth: the same comparison, and what only a photo without depth has."""

    comparison: Comparison
    angle: float  # degrees between the directions from which the photo and the scene's camera see the object
    mask: float  # intersection over union of the photo's mask, as it was found, with the true one
    told_size: float  # diameter that `ipjax estimate` tells: of the guessed shape with what was measured of it, metres
    size_std: float  # its standard deviation as the estimate says, metres
    confidence: float
    present: bool  # as the estimate says

    def as_json(self) -> dict[str, float | bool]:
        """The same with names that end in their unit."""
        return {
            "found": self.comparison.good,
            **self.comparison.as_json(),
            "angle_deg": self.angle,
            "mask_iou": self.mask,
            "told_diameter_mm": 1e3 * self.told_size,
            "told_diameter_std_mm": 1e3 * self.size_std,
            "confidence": self.confidence,
            "present": self.present,
        }


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What the demo compared with the truth; None where no pose was found."""

    mesh: Comparison | None
    photo: PhotoComparison | None


def run_demo(folder: str | Path, encoder: Encoder, *, seed: int = 0, config: Config = Config()) -> Outcome:
    """Find an object of a made scene by a distorted mesh of it and by an RGB photo of it; compare with the truth.

    Args:
      folder: gets the inputs, the object files, ``overlay.png`` and ``photo_overlay.png``.
      encoder: from ``load_encoder``.
      seed: of the scene and of the photo.

    Returns:
      How far either estimate is from the truth.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()

    def say(text: str) -> None:
        print(f"[{time.perf_counter() - start:5.1f} s] {text}", flush=True)

    kind = TARGETS[seed % len(TARGETS)]
    others = [name for name in ("carton", "drum", "prism") if name != kind]
    original = make_object(kind, seed)
    scene = make_scene([original, *(make_object(name, seed) for name in others)], seed)
    inputs = write_inputs(folder, scene, 0)
    true = scene.camera_from_object[0]
    say(f"a table with {len(scene.masks)} objects and clutter, drawn by {scene.backend}; the {kind} is to be found")

    copy, original_from_copy = degrade(original, LEVEL, seed)
    mesh_file, mesh_object = folder / f"{kind}.glb", folder / f"{kind}{SUFFIX}"
    save_mesh(copy, mesh_file)
    say(f"a copy of the {kind} as a reconstruction model might make it: bumpy, blurred, of another size, turned")
    templates, info = onboard(mesh_file, encoder, out=mesh_object)
    say(f"onboarded: {len(templates.camera_from_object.scale)} templates")
    objects = [(templates, info)]

    photo = make_photo(original, true, scene.camera, seed)
    photo_file, photo_camera, photo_object = (
        folder / name for name in ("photo.png", "photo_camera.json", f"{kind}_photo{SUFFIX}")
    )
    write_image(photo_file, photo.rgb)
    write_camera(photo_camera, photo.matrix)
    say(f"an RGB photo of the {kind} alone, seen from {photo.angle:.0f}° beside the scene's camera; no depth, no mask")
    try:
        made = onboard_photo(photo_file, encoder, camera=photo_camera, lrm="inflate", out=photo_object)
        objects.append((made.templates, made.info))
        say(f"onboarded: {len(made.templates.camera_from_object.scale)} templates; only the photo's side is known")
    except ForegroundError as error:
        made = None
        say(f"the photo was refused: {error}")

    estimator = Estimator(objects, encoder, config, quick=True)
    crop = estimator.frame(0, scene.rgb, scene.depth, scene.masks[0], scene.matrix)
    pictures = [folder / name for name in ("overlay.png", "photo_overlay.png")]
    estimates = []
    for index, (picture, label) in enumerate(zip(pictures[: len(objects)], ("mesh", "photo"), strict=False)):
        result = estimator.run(index, *crop)
        seconds = ", ".join(f"{name} {value:.2f} s" for name, value in result.seconds.items())
        say(f"estimated by the {label} ({seconds})")
        evidence = gather_evidence(result.templates, result.query, result.crop_estimate, result.info, config)
        write_image(picture, draw(scene.rgb, scene.matrix, result.estimate, correct_info(result), evidence))
        estimates.append(result.estimate)
    found: list[Similarity | None] = [None, None]
    mesh_compared, photo_compared = None, None
    # The copy's place in the original is known to demos and evaluations only, never to the estimate; so is the photo's
    # true pose.
    if bool(estimates[0].success):
        camera_from_copy = estimates[0].camera_from_object.to_numpy() @ info.object_from_mesh.to_numpy()
        found[0] = (camera_from_copy @ original_from_copy.inverse()).to_jax()
        mesh_compared = compare(found[0], true, original)
    if made is not None and bool(estimates[1].success):
        estimate = estimates[1]
        found[1] = place_through_photo(estimate.camera_from_object, made.info, photo)
        photo_compared = PhotoComparison(
            compare(found[1], true, original),
            photo.angle,
            float((made.foreground.mask & photo.mask).sum() / (made.foreground.mask | photo.mask).sum()),
            float(estimate.diameter),
            float(estimate.scale_std),
            float(estimate.confidence),
            bool(estimate.present),
        )
    outcome = Outcome(mesh_compared, photo_compared)
    _print_outcome(true, found, outcome, float(estimates[0].confidence))
    say(f"the pictures: {' and '.join(str(path) for path in pictures[: len(objects)])}")
    print("\nThe same from the command line:\n")
    print(f"  ipjax onboard {mesh_file} -o {mesh_object}")
    print(f"  ipjax estimate {mesh_object} {inputs} --overlay {folder / 'again.png'}\n")
    print(f"  ipjax onboard {photo_file} --camera {photo_camera} --lrm inflate -o {photo_object}")
    print(f"  ipjax estimate {photo_object} {inputs} --overlay {folder / 'photo_again.png'}\n")
    return outcome


def place_through_photo(camera_from_object: Similarity, info: ObjectInfo, photo: MadePhoto) -> Similarity:
    """``camera_from_object`` of the photographed mesh, by the photo's true pose: an estimate tells where the photo's
    camera was, in units of the distance from it to the middle of the guessed shape, which stands for the true one. The
    size is that only where the photo's camera was given: with a longer lens than the true one it would seem larger.
    """
    there = photo.camera_from_object.to_numpy()
    distance = there.translation[2]
    reference_from_object = Similarity(there.rotation, there.translation / distance, there.scale / distance)
    return (relative_pose(camera_from_object, info) @ reference_from_object).to_jax()


def write_inputs(folder: Path, scene: Scene | Sight, index: int) -> str:
    """Write photo, depth (16 bits, tenths of a millimetre), mask of one object, and camera; returns their options."""
    write_image(folder / "rgb.png", scene.rgb)
    write_image(folder / "depth.png", np.round(scene.depth * 1e4).astype(np.uint16))
    write_image(folder / "mask.png", scene.masks[index].astype(np.uint8) * 255)
    write_camera(folder / "camera.json", scene.matrix, depth_scale=0.1)
    names = {name: folder / f"{name}.png" for name in ("rgb", "depth", "mask")} | {"camera": folder / "camera.json"}
    return " ".join(f"--{name} {path}" for name, path in names.items())


def write_camera(path: Path, matrix: Float[np.ndarray, "3 3"], **more: float) -> None:
    """A camera file as BOP spells it."""
    write_text(path, json.dumps({"cam_K": [round(float(x), 4) for x in matrix.ravel()], **more}) + "\n")


def compare(found: Similarity, true: Similarity, mesh: Mesh) -> Comparison:
    """Two ``camera_from_object`` of one mesh of unit diameter, whose origin is its box's centre."""
    here, there = found.to_numpy(), true.to_numpy()
    cosine = (np.trace(here.rotation @ there.rotation.T) - 1) / 2
    points = sample_surface(mesh, 2000, seed=0)[0]
    a, b = here @ points, there @ points
    size = float(there.scale)
    return Comparison(
        rotation=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        translation=float(np.linalg.norm(here.translation - there.translation)),
        true_size=size,
        size=float(here.scale),
        add=float(np.linalg.norm(a - b, axis=-1).mean() / size),
        adds=float(KDTree(a).query(b)[0].mean() / size),
    )


def _print_outcome(
    true: Similarity, found: Sequence[Similarity | None], outcome: Outcome, mesh_confidence: float
) -> None:
    """True pose and both estimates side by side, and a few lines on each."""

    def numbers(values) -> str:
        return " ".join(f"{float(x):8.3f}" for x in values)

    def row(label: str, pick: Callable[[Similarity], str]) -> str:
        cells = ["none found" if pose is None else pick(pose) for pose in (true, *found)]
        return f"  {label:16s} " + "  ".join(f"{cell:26s}" for cell in cells).rstrip()

    titles = (f"{title:26s}" for title in ("true", "by the distorted mesh", "by the RGB photo"))
    print(f"\n  {'':16s} " + "  ".join(titles).rstrip())
    for index in range(3):
        print(row("rotation" if index == 0 else "", lambda pose, i=index: numbers(pose.rotation[i])))
    print(row("translation, mm", lambda pose: numbers(pose.translation * 1000)))
    print(row("size, mm", lambda pose: f"{float(pose.scale) * 1000:8.1f}") + "\n")
    photo = outcome.photo
    both = (("mesh", outcome.mesh), ("photo", None if photo is None else photo.comparison))
    for label, comparison in both:
        if comparison is None:
            print(f"  by the {label}: no pose was found")
            continue
        growth = comparison.size / comparison.true_size - 1
        confidence = mesh_confidence if photo is None or label == "mesh" else photo.confidence
        print(
            f"  by the {label}: off by {comparison.rotation:.1f}°, {comparison.translation * 1000:.1f} mm and "
            f"{growth:+.1%} in size;"
        )
        print(
            f"    surface points by {comparison.add:.1%} of the diameter, {comparison.adds:.1%} to the nearest point; "
            f"confidence {confidence:.2f}; {'found' if comparison.good else 'NOT found'}"
        )
    if photo is not None:
        if not photo.present:
            print("    the estimate itself calls this pose a guess (present is False)")
        print(
            f"    the shape is guessed: with what the scene shows of it, it measures {photo.told_size * 1000:.1f} mm ± "
            f"{photo.size_std * 1000:.0f} (scale_std); its mask covers the true one by {photo.mask:.0%} (IoU)"
        )
    print()

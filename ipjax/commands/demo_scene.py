"""What ``ipjax demo`` runs: an object on a table, of which only a degraded mesh is known, is found.

The scene is synthetic, so nothing is needed but an encoder. The files written are those of a real case: a mesh like one
of a reconstruction model, a photo, a depth image, a mask and a camera.
"""

import dataclasses
import json
import time
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ipjax.config import Config
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.meshes.sampling import sample_surface
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.objects.layout import SUFFIX
from ipjax.files.storage.writing import write_text
from ipjax.inference.drawing import draw, gather_evidence, write_image
from ipjax.inference.estimator import Estimator
from ipjax.networks.dinov2 import Encoder
from ipjax.onboarding.mesh import onboard
from ipjax.records import Similarity
from ipjax.synthetic.degradation import degrade
from ipjax.synthetic.objects import make_object
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


def run_demo(folder: str | Path, encoder: Encoder, *, seed: int = 0, config: Config = Config()) -> Comparison | None:
    """Make a scene, onboard a distorted and rescaled copy of one of its objects, find it, compare with the truth.

    Args:
      folder: gets the inputs, the object file and ``overlay.png``.
      encoder: from ``load_encoder``.
      seed: of the scene.

    Returns:
      How far the estimate is from the truth; None where there is none.
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
    say(f"a table with {len(scene.masks)} objects and clutter, drawn by {scene.backend}; the {kind} is to be found")

    copy, original_from_copy = degrade(original, LEVEL, seed)
    mesh_file = folder / f"{kind}.glb"
    save_mesh(copy, mesh_file)
    say(f"a copy of the {kind} as a reconstruction model might make it: bumpy, blurred, of another size, turned")

    templates, info = onboard(mesh_file, encoder, out=folder / f"{kind}{SUFFIX}")
    say(f"onboarded: {len(templates.camera_from_object.scale)} templates")

    estimator = Estimator([(templates, info)], encoder, config, quick=True)
    result = estimator.run(0, *estimator.frame(0, scene.rgb, scene.depth, scene.masks[0], scene.matrix))
    seconds = ", ".join(f"{name} {value:.2f} s" for name, value in result.seconds.items())
    say(f"estimated ({seconds})")

    evidence = gather_evidence(templates, result.query, result.crop_estimate, info, config)
    picture = draw(scene.rgb, scene.matrix, result.estimate, info, evidence)
    write_image(folder / "overlay.png", picture)
    if not bool(result.estimate.success):
        say("no pose was found")
        return None
    # The copy's place in the original is known to demos and evaluations only, never to the estimate.
    camera_from_copy = result.estimate.camera_from_object.to_numpy() @ info.object_from_mesh.to_numpy()
    found = (camera_from_copy @ original_from_copy.inverse()).to_jax()
    comparison = compare(found, scene.camera_from_object[0], original)
    _print_comparison(found, scene.camera_from_object[0], comparison, float(result.estimate.confidence))
    say(f"the picture: {folder / 'overlay.png'}")
    print("\nThe same from the command line:\n")
    print(f"  ipjax estimate {folder / (kind + SUFFIX)} {inputs} --overlay {folder / 'again.png'}\n")
    return comparison


def write_inputs(folder: Path, scene: Scene, index: int) -> str:
    """Write photo, depth (16 bits, tenths of a millimetre), mask of one object, and camera; returns their options."""
    write_image(folder / "rgb.png", scene.rgb)
    write_image(folder / "depth.png", np.round(scene.depth * 1e4).astype(np.uint16))
    write_image(folder / "mask.png", scene.masks[index].astype(np.uint8) * 255)
    camera = {"cam_K": [round(float(x), 4) for x in scene.matrix.ravel()], "depth_scale": 0.1}
    write_text(folder / "camera.json", json.dumps(camera) + "\n")
    names = {name: folder / f"{name}.png" for name in ("rgb", "depth", "mask")} | {"camera": folder / "camera.json"}
    return " ".join(f"--{name} {path}" for name, path in names.items())


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


def _print_comparison(found: Similarity, true: Similarity, comparison: Comparison, confidence: float) -> None:
    def numbers(values) -> str:
        return " ".join(f"{float(x):8.3f}" for x in values)

    print("\n                      true                        estimated")
    for row in range(3):
        label = "rotation" if row == 0 else ""
        print(f"  {label:16s} {numbers(true.rotation[row])}  {numbers(found.rotation[row])}")
    print(f"  {'translation, mm':16s} {numbers(true.translation * 1000)}  {numbers(found.translation * 1000)}")
    print(f"  {'size, mm':16s} {comparison.true_size * 1000:8.1f}{'':20s}{comparison.size * 1000:8.1f}")
    growth = comparison.size / comparison.true_size - 1
    print(f"\n  off by {comparison.rotation:.1f}°, {comparison.translation * 1000:.1f} mm and {growth:+.1%} in size;")
    print(f"  surface points by {comparison.add:.1%} of the diameter, {comparison.adds:.1%} to the nearest point")
    print(f"  confidence {confidence:.2f}; {'found' if comparison.good else 'NOT found'}\n")

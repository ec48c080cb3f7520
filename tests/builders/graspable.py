"""Objects of known measures to be grasped, poses of them on a table below a camera, and estimates of what is known."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from builders.estimates import make_estimate
from builders.objects import make_object
from PIL import Image

from ipjax.config import GraspConfig
from ipjax.files.meshes.mesh import make_mesh
from ipjax.files.meshes.sampling import sample_surface
from ipjax.files.objects.saving import save
from ipjax.files.storage.writing import write_text
from ipjax.inference.reports import estimate_as_json, to_json
from ipjax.records import PoseEstimate, Surface
from ipjax.robot.grasps.planning import plan_grasps
from ipjax.robot.grippers import FRANKA_HAND
from ipjax.robot.records import Grasps, Workspace
from ipjax.transforms import Similarity

HEIGHT = 0.8  # m from the camera, which looks straight down, to the middle of the object
POINTS = 2048  # as onboarding takes
BOX = 0.06, 0.12, 0.10  # m: of the case for the command; only its 6 cm fit into Franka's hand
plan = jax.jit(plan_grasps)  # one program for all tests whose inputs have the same shapes


@dataclasses.dataclass(frozen=True)
class Graspable:
    """An object as onboarding has it."""

    surface: Surface  # model units
    diameter: float  # m
    low: float  # m: of its lowest point, object frame


def make_graspable(mesh: trimesh.Trimesh) -> Graspable:
    """The surface of a mesh in metres; its box is moved to the origin."""
    vertices = mesh.vertices - mesh.bounds.mean(0)
    diameter = float(np.linalg.norm(mesh.extents))
    sampled = sample_surface(make_mesh(vertices / diameter, np.asarray(mesh.faces)), POINTS)
    surface = Surface(*(jnp.asarray(x, jnp.float32) for x in sampled))
    return Graspable(surface, diameter, float(vertices[:, 2].min()))


def make_bowl(radius=0.07, wall=0.004) -> trimesh.Trimesh:
    """A hemisphere with a wall, open at the top."""
    angle = np.linspace(-np.pi / 2, -0.05, 24)
    outside = radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    inside = (radius - wall) * np.stack([np.cos(angle), np.sin(angle)], -1)
    return trimesh.creation.revolve(np.concatenate([outside, inside[::-1]]), sections=64)


def make_can(radius=0.05, height=0.1, lip=0.003, wall=0.002) -> trimesh.Trimesh:
    """A closed can whose top lies a little below its rim."""
    profile = [[0, 0], [radius, 0], [radius, height], [radius - wall, height], [radius - wall, height - lip]]
    return trimesh.creation.revolve(np.array([*profile, [0, height - lip]]), sections=64)


def make_finned(radius, height=0.1) -> trimesh.Trimesh:
    """An upright cylinder with a fin along +x in the middle of its height: a mug's body and handle."""
    body = trimesh.creation.cylinder(radius, height, sections=96)
    fin = trimesh.creation.box((0.035, 0.012, 0.4 * height))
    fin.apply_translation([radius + 0.0165, 0, 0])
    # The box is moved to the origin, and turns are about it: a second fin's end balances the first.
    knob = trimesh.creation.box((1e-3, 1e-3, 1e-3))
    knob.apply_translation([-radius - 0.0335, 0, -height / 2 + 5e-4])
    return trimesh.util.concatenate([body, fin, knob])


def from_above(diameter: float) -> Similarity:
    """``camera_from_object`` of a camera that looks straight down on an object whose z is up."""
    turn = np.diag([1.0, -1.0, -1.0])
    return Similarity(*(jnp.asarray(x, jnp.float32) for x in (turn, [0, 0, HEIGHT], diameter)))


def estimate_of(
    pose: Similarity, turn_std=0.01, place_std=0.001, size_std=0.0005, axis_std=0.0, axis=(0.0, 0.0, 1.0)
) -> PoseEstimate:
    """An estimate with deviations: rad, m, m, and rad about an axis of the object."""
    known = jnp.diag(jnp.asarray([turn_std**2] * 3 + [place_std**2] * 3, jnp.float32))
    about = max(axis_std, turn_std) * jnp.asarray(axis, jnp.float32)
    estimate = make_estimate(pose)
    return dataclasses.replace(
        estimate, covariance=known, scale_std=jnp.asarray(size_std, jnp.float32), ambiguity=about
    )


def on_table(one: Graspable) -> Workspace:
    """The table on which an object stands that is seen `from_above`."""
    return Workspace(table=jnp.asarray([0, 0, -1, -(HEIGHT - one.low)], jnp.float32))


def plan_from_above(one: Graspable, seed=0, **estimate) -> Grasps:
    """Its grasps with the default settings and Franka's hand; those that are valid."""
    known = estimate_of(from_above(one.diameter), **estimate)
    found = plan(FRANKA_HAND, one.surface, known, on_table(one), jax.random.key(seed), GraspConfig())
    return found.take(np.flatnonzero(np.asarray(found.valid)))


def closing_axes(grasps: Grasps) -> np.ndarray:
    """Along which they close, object frame: Franka's hand closes along y."""
    return np.asarray(grasps.object_from_gripper.rotation[..., 1])


def approaches(grasps: Grasps) -> np.ndarray:
    """From which side they come, object frame."""
    return np.asarray(grasps.object_from_gripper.rotation[..., 2])


def pads(grasps: Grasps) -> np.ndarray:
    """The middle between the pads, object frame, m."""
    return np.asarray(grasps.object_from_gripper.translation) + FRANKA_HAND.reach * approaches(grasps)


def write_grasp_case(folder: Path) -> None:
    """An object file of a box on a table below a camera, its pose as ``ipjax estimate`` writes it, and its frame."""
    one = make_graspable(trimesh.creation.box(BOX))
    templates, info = make_object()
    box = trimesh.creation.box(np.array(BOX) / one.diameter)
    templates = dataclasses.replace(
        templates,
        surface=one.surface,
        extents=jnp.asarray(np.array(BOX) / one.diameter, jnp.float32),
        axes=jnp.eye(3),
    )
    info = dataclasses.replace(
        info,
        mesh_scale=1e-3 / one.diameter,  # the mesh is in millimetres
        vertices=np.asarray(box.vertices, np.float32),
        faces=np.asarray(box.faces, np.int32),
        colours=np.full((len(box.vertices), 3), 90, np.uint8),
    )
    save(folder / "box.ipjax", templates, info)
    extents = templates.extents
    estimate = dataclasses.replace(
        estimate_of(from_above(one.diameter)), box=jnp.stack([-extents / 2, extents / 2]), confidence=jnp.asarray(0.9)
    )
    frame = {"frame": "000001", "rgb": "rgb.png", "objects": [estimate_as_json(estimate, templates, info)]}
    write_text(folder / "pose.json", to_json({"format": "ipjax poses 1", "frames": [frame]}))
    base_from_camera = np.diag([1.0, -1.0, -1.0, 1.0])  # above the origin of the base, on the table
    base_from_camera[2, 3] = HEIGHT - one.low
    write_text(folder / "hand_eye.json", to_json({"base_from_camera": base_from_camera.tolist()}))
    write_text(folder / "camera.json", to_json({"fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5}))
    Image.fromarray(np.full((240, 320, 3), 70, np.uint8)).save(folder / "rgb.png")
    Image.fromarray(np.full((240, 320), round(1e3 * (HEIGHT - one.low)), np.uint16)).save(folder / "depth.png")

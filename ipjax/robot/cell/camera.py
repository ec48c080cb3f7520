"""What the cell's camera sees: colours and depth as a cheap sensor has them, exact masks and poses."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ipjax.cameras import middle
from ipjax.capture.views.paths import look_from
from ipjax.records import Camera
from ipjax.rendering.render import render_scene
from ipjax.robot.cell.appearance import list_shown, surroundings
from ipjax.robot.cell.arms import HAND
from ipjax.robot.cell.cell import MIDDLE, Cell, body_pose
from ipjax.robot.cell.motion import solve
from ipjax.synthetic.sensor import STRUCTURED_LIGHT, Sensor, expose, sense_depth
from ipjax.transforms import Similarity, rotation_from_vector

WIDTH, HEIGHT = 640, 480
CAMERAS = ("fixed", "wrist")
_AWAY = 0.88  # metres of the fixed camera from the table's middle
_ABOVE = 0.55  # metres of the hand above the table, from where a camera on the wrist looks
# On the hand, beside the fingers, looking ahead and a little towards them: gripper's frame.
_GRIPPER_FROM_CAMERA = Similarity(
    np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ rotation_from_vector(np.array([-0.12, 0, 0])),
    np.array([0.07, 0.0, 0.02]),
    np.ones(()),
)


@dataclasses.dataclass(frozen=True)
class Sight:
    """One RGB-D frame of the cell, and the truth about it."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # along z, metres; 0 = unknown
    masks: Bool[np.ndarray, "n h w"]  # where each thing is seen
    camera: Camera
    base_from_camera: Similarity[np.ndarray]
    camera_from_object: tuple[Similarity[np.ndarray], ...]  # of each thing: rigid, metres, its mesh's frame
    backend: str  # of the renderer

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K, pixels."""
        return self.camera.to_matrix()


def look(
    cell: Cell,
    place: str = "fixed",
    *,
    sensor: Sensor = STRUCTURED_LIGHT,
    oversample: int = 3,
    backend: str = "auto",
) -> Sight:
    """What the camera sees before the pick: the robot, too. Place, light and noise follow from the cell's seed.

    Args:
      place: "fixed": 0.88 m from the table's middle, opposite to the robot; "wrist": on the hand, which is held above
        the table to look.
      sensor: what the camera adds; `PERFECT` adds nothing.
      oversample: odd; samples on a side of each pixel.

    Raises:
      ValueError: no such place; or the arm cannot hold the camera above the table.
      RenderError: nothing can draw, with a given `backend`.
    """
    if place not in CAMERAS:
        raise ValueError(f"unknown place of the camera {place!r}: one of {', '.join(CAMERAS)}")
    rng = np.random.default_rng([cell.seed, 101])
    data = cell.state()
    if place == "fixed":
        azimuth, elevation = rng.uniform(-0.9, 0.9), rng.uniform(0.65, 1.0)
        away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        at = np.array([*MIDDLE, 0.04])
        base_from_camera = look_from((at + _AWAY * away)[None], at, np.array([0.0, 0, 1])).take(0)
    else:
        looking = Similarity(np.diag([1.0, -1, -1]), np.array([*MIDDLE, _ABOVE]), np.ones(()))
        joints = solve(cell, looking)
        if joints is None:
            raise ValueError(f"the {cell.arm.name} cannot hold its camera above the table")
        data = cell.state_at(joints)
        base_from_camera = body_pose(data, HAND) @ _GRIPPER_FROM_CAMERA
    focal = rng.uniform(590, 610) * np.ones(2)
    centre = middle(WIDTH, HEIGHT) + rng.normal(0, 4, 2)
    camera = Camera(focal=jnp.asarray(focal, jnp.float32), centre=jnp.asarray(centre, jnp.float32))
    camera_from_base = base_from_camera.inverse()

    shown = [(mesh, camera_from_base @ numbered_pose(data, body)) for mesh, body in list_shown(cell)]
    shown += [(mesh, camera_from_base) for mesh in surroundings(cell)]
    light = {
        "direction": camera_from_base.rotation @ (np.array([0.0, 0, -1]) + 0.5 * rng.normal(size=3) * [1, 1, 0.4]),
        "ambient": float(rng.uniform(0.5, 0.65)),
        "diffuse": float(rng.uniform(0.4, 0.55)),
    }
    placed = [(mesh, pose.to_jax()) for mesh, pose in shown]
    drawn = render_scene(placed, camera, HEIGHT, WIDTH, light=light, oversample=oversample, backend=backend)
    if drawn.ids is None:
        raise RuntimeError("the renderer returned no segmentation")
    masks = np.stack([drawn.ids[0] == number for number in range(len(cell.things))])
    return Sight(
        rgb=expose(rng, drawn.rgb[0], sensor),
        depth=sense_depth(rng, drawn.depth[0], camera, sensor),
        masks=masks,
        camera=camera,
        base_from_camera=base_from_camera,
        camera_from_object=tuple(pose for _, pose in shown[: len(cell.things)]),
        backend=drawn.backend,
    )


def numbered_pose(data, body: int) -> Similarity[np.ndarray]:
    """``base_from_body`` of a body by its number in the model."""
    return Similarity(data.xmat[body].reshape(3, 3).copy(), data.xpos[body].copy(), np.ones(()))

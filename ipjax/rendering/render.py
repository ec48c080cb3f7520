"""Images of meshes: MuJoCo in a child process, or our own z-buffer where no GL library works.

Depth is along z in the units of the poses, 0 where there is nothing; pixel centres are integers. Colours are unlit
unless a light is asked for: what is in the texture is what is in the image.
"""

import dataclasses
import json
import logging
import math
import os
import platform
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ipjax.cameras import borders, resize
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.meshes.textures import sample_texture
from ipjax.progress import bar
from ipjax.records import Camera, Similarity, View

log = logging.getLogger("ipjax")

BACKENDS = ("egl", "osmesa", "native", "raster")
_HELP = {
    "egl": "install libegl1 (Debian, Ubuntu: apt install libegl1 libgl1-mesa-dri) or the GPU's driver",
    "osmesa": "install libosmesa6 (Debian, Ubuntu: apt install libosmesa6)",
    "native": "a desktop session is needed for the native GL of this system",
}
_CHILD = Path(__file__).with_name("child.py")
_TIMEOUT = 180.0  # seconds without a word from a child that does not use the processor either
_LONGEST = 3600.0  # seconds without a word, whatever it does
_REST = 600.0  # seconds for which a backend that could not be had is left alone
_LAST = 2  # failures in a row, each before a context was there, after which it is
_failed: dict[str, list[tuple[float, str]]] = {}  # such failures in a row, by backend: when, and why


class RenderError(RuntimeError):
    """A backend could not draw; the message names it and what to install."""


class _MeshRefusedError(RenderError):
    """MuJoCo did not take the mesh; no fault of the GL backend."""


class _NoContextError(RenderError):
    """The backend failed before it could draw anything: it may not work on this system."""

    silent = False


@dataclasses.dataclass(frozen=True)
class Renders:
    """Rendered views on the host: NumPy arrays, colours as bytes; `renders[i]` is view i as a `View`."""

    rgb: UInt8[np.ndarray, "v h w 3"]  # 0 where nothing is
    depth: Float[np.ndarray, "v h w"]  # along z, units of the poses; 0 = nothing
    camera: Camera  # focal and centre [v 2]
    backend: str  # who drew
    ids: Int[np.ndarray, "v h w"] | None = None  # which mesh, −1 = none; only for scenes

    @property
    def mask(self) -> Bool[np.ndarray, "v h w"]:
        """Where something is."""
        return self.depth > 0

    def __len__(self) -> int:
        return len(self.depth)

    def __getitem__(self, index: int) -> View:
        """View `index` (no batch axis) as the record that `describe` takes: float32 colours in [0, 1]."""
        import jax.numpy as jnp

        return View(
            rgb=jnp.asarray(self.rgb[index].astype(np.float32) / 255),
            depth=jnp.asarray(self.depth[index]),
            mask=jnp.asarray(self.depth[index] > 0),
            camera=Camera(focal=self.camera.focal[index], centre=self.camera.centre[index]),
        )


def render(
    mesh: Mesh,
    camera_from_object: Similarity,
    camera: Camera,
    height: int,
    width: int,
    *,
    backend: str = "auto",
    oversample: int = 1,
    light: dict | None = None,
    progress: bool | Callable[[int, int], None] = False,
) -> Renders:
    """Images of one mesh at the poses ``camera_from_object`` [v] (or one pose without an axis), height × width pixels.

    Vertices are taken as they are: give a normalised mesh and template poses for templates (depth in model units), or
    a mesh and poses in metres for a scene. `camera` has one focal and centre [2], or one per view [v 2].
    `oversample` is odd: 3 averages the colours of 3 × 3 samples per pixel and takes the depth of the middle one.
    `progress`: True shows a bar; a function is called as `progress(done, total)` after every view. Raises RenderError
    naming the backend and the package to install; ValueError for wrong arguments.
    """
    rotation, translation, scale = (
        np.asarray(x, np.float64)
        for x in (camera_from_object.rotation, camera_from_object.translation, camera_from_object.scale)
    )
    if rotation.ndim == 2:
        rotation, translation, scale = rotation[None], translation[None], scale[None]
    if not (np.isfinite(scale) & (scale > 0)).all():
        raise ValueError("the scale of a pose to render is not positive")
    # A similarity seen by a pinhole is a rigid motion seen from 1/scale as far, with depths times the scale.
    poses = np.concatenate([rotation, (translation / scale[:, None])[..., None]], axis=-1)[:, None]
    job = _Job([mesh], poses, scale, camera, height, width, oversample, light, False)
    if progress is not True:
        return _draw(job, backend, progress or None)
    with bar(total=len(poses), desc="rendering", unit="view") as shown:

        def advance(done: int, total: int) -> None:
            shown.update(done - shown.n)

        return _draw(job, backend, advance)


def render_scene(
    objects: Sequence[tuple[Mesh, Similarity]],
    camera: Camera,
    height: int,
    width: int,
    *,
    backend: str = "auto",
    oversample: int = 3,
    light: dict | None = None,
) -> Renders:
    """One image of several meshes, each at its own ``camera_from_object``; `ids` says which mesh is at each pixel.

    `light` is None (unlit) or ``{"direction": [3] in the camera frame, "ambient": a, "diffuse": d}``. Otherwise as
    `render`; the result has one view.
    """
    if not objects:
        raise ValueError("a scene needs at least one object")
    meshes, poses = [], []
    for mesh, camera_from_object in objects:
        scale = float(np.asarray(camera_from_object.scale))
        meshes.append(dataclasses.replace(mesh, vertices=mesh.vertices * scale))
        rotation = np.asarray(camera_from_object.rotation, np.float64)
        translation = np.asarray(camera_from_object.translation, np.float64)
        poses.append(np.concatenate([rotation, translation[:, None]], axis=-1))
    job = _Job(meshes, np.stack(poses)[None], np.ones(1), camera, height, width, oversample, light, True)
    return _draw(job, backend, None)


def render_each(
    meshes: Sequence[Mesh],
    which: Sequence[int],
    camera_from_object: Similarity,
    camera: Camera,
    height: int,
    width: int,
    *,
    backend: str = "auto",
) -> Renders:
    """Images of several meshes, one in each: image i shows ``meshes[which[i]]`` alone, at pose i; all of them drawn by
    one child process, because starting one takes longer than drawing twenty images.

    Poses [v] and camera as in `render`, scales of 1. Raises as `render` does.
    """
    rotation, translation = (
        np.asarray(x, np.float64) for x in (camera_from_object.rotation, camera_from_object.translation)
    )
    # The meshes that an image does not show shrink to the point where the one that it shows has its origin; the child
    # leaves them out.
    poses = np.zeros((len(which), len(meshes), 3, 4))
    poses[..., 3] = translation[:, None]
    poses[np.arange(len(which)), np.asarray(which), :, :3] = rotation
    job = _Job(list(meshes), poses, np.ones(len(which)), camera, height, width, 1, None, False)
    return _draw(job, backend, None)


def available_backends() -> dict[str, str]:
    """What each backend of this system says when asked to draw a triangle: "ok" or the reason it cannot."""
    import jax.numpy as jnp

    from ipjax.files.meshes.mesh import make_mesh

    triangle = make_mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    pose = np.concatenate([np.eye(3), [[0.0], [0.0], [2.0]]], axis=-1)[None, None]
    camera = Camera(focal=jnp.full(2, 8.0, jnp.float32), centre=jnp.full(2, 3.5, jnp.float32))
    job = _Job([triangle], pose, np.ones(1), camera, 8, 8, 1, None, False)
    report = {}
    for name in [*_candidates(), "raster"]:
        try:
            drawn = _draw_raster(job, None) if name == "raster" else _run_child(job, name, None)
            report[name] = "ok" if drawn.mask.any() else "drew nothing"
        except RenderError as error:
            report[name] = str(error)
    return report


@dataclasses.dataclass(frozen=True)
class _Job:
    meshes: list[Mesh]
    poses: np.ndarray  # frame, mesh, 3, 4: rigid
    scales: np.ndarray  # frame: depths are multiplied by it
    camera: Camera
    height: int
    width: int
    oversample: int
    light: dict | None
    segment: bool

    def __post_init__(self):
        if self.height < 1 or self.width < 1:
            raise ValueError(f"an image needs pixels, got {self.height} × {self.width}")
        if max(self.height, self.width) * self.oversample > 16384:
            raise ValueError(f"{self.height} × {self.width}, {self.oversample} samples a side, is more than 16384")
        if self.oversample < 1 or self.oversample % 2 == 0:
            raise ValueError(f"oversample must be odd, so that a sample lies at the pixel's centre; {self.oversample}")
        if not np.isfinite(self.poses).all() or not (np.isfinite(self.scales) & (self.scales > 0)).all():
            raise ValueError("a pose to render is not finite, or its scale is not positive")
        if not (np.isfinite(self.intrinsics).all() and (self.intrinsics[:, :2] > 0).all()):
            raise ValueError("the camera to render with has a focal length that is not positive")

    @property
    def intrinsics(self) -> np.ndarray:
        """fx, fy, cx, cy of every frame."""
        focal, centre = np.asarray(self.camera.focal, np.float64), np.asarray(self.camera.centre, np.float64)
        return np.broadcast_to(np.concatenate([focal, centre], axis=-1), (len(self.poses), 4))

    @property
    def cameras(self) -> Camera:
        import jax.numpy as jnp

        table = self.intrinsics
        return Camera(focal=jnp.asarray(table[:, :2], jnp.float32), centre=jnp.asarray(table[:, 2:], jnp.float32))

    def near_far(self) -> np.ndarray:
        """Clipping distances that hold everything in front of the camera, [frame 2]."""
        low, high = np.full(len(self.poses), np.inf), np.zeros(len(self.poses))
        for i, mesh in enumerate(self.meshes):
            middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
            reach = np.linalg.norm(mesh.vertices - middle, axis=-1).max()
            depth = self.poses[:, i, 2, :3] @ middle + self.poses[:, i, 2, 3]
            low, high = np.minimum(low, depth - reach), np.maximum(high, depth + reach)
        far = np.where(high > 0, high * 1.01, 1.0)
        return np.stack([np.clip(low * 0.99, far * 1e-3, far * 0.999), far], axis=-1)


def _candidates() -> list[str]:
    """GL backends worth trying here, best first."""
    if platform.system() != "Linux":
        return ["native"]
    wish = os.environ.get("MUJOCO_GL", "").lower().strip()
    names = ["egl", "osmesa"]
    return sorted(names, key=lambda name: name != wish)


def _draw(job: _Job, backend: str, progress: Callable[[int, int], None] | None) -> Renders:
    if backend == "raster":
        return _draw_raster(job, progress)
    if backend != "auto":
        if backend not in BACKENDS:
            raise ValueError(f"unknown rendering backend {backend!r}: one of auto, {', '.join(BACKENDS)}")
        return _draw_mujoco(job, backend, progress)
    reasons = []
    for name in _candidates():
        failures = _failed.get(name, [])
        if len(failures) >= _LAST and time.monotonic() - failures[-1][0] < _REST:
            reasons.append(failures[-1][1])
            continue
        try:
            return _draw_mujoco(job, name, progress)
        except _MeshRefusedError as error:
            log.warning("%s; rendering with the z-buffer rasteriser", error)
            return _draw_raster(job, progress)
        except RenderError as error:
            reasons.append(str(error))
    log.warning("no GL library works, rendering with the z-buffer rasteriser: %s", "; ".join(reasons))
    return _draw_raster(job, progress)


# --- MuJoCo --------------------------------------------------------------------------------------------------------


def _face_atlas(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex colours as a texture: 2 × 2 texels per face, whose bilinear blend is the gradient over the triangle.

    Returns uv [3m 2] (v = 0 is row 0), their faces [m 3], and the texture.
    """
    count = len(mesh.faces)
    columns = math.ceil(math.sqrt(count))
    rows = -(-count // columns)
    corner = mesh.colours[mesh.faces].astype(np.int16)
    fourth = np.clip(corner[:, 1] + corner[:, 2] - corner[:, 0], 0, 255)  # makes the blend linear
    blocks = np.zeros((rows * columns, 2, 2, 3), np.uint8)
    blocks[:count] = np.stack([corner[:, 0], corner[:, 1], corner[:, 2], fourth], axis=1).reshape(-1, 2, 2, 3)
    texture = blocks.reshape(rows, columns, 2, 2, 3).transpose(0, 2, 1, 3, 4).reshape(rows * 2, columns * 2, 3)
    index = np.arange(count)
    first = np.stack([index % columns * 2 + 0.5, index // columns * 2 + 0.5], axis=-1)
    texels = first[:, None] + np.array([[0, 0], [1, 0], [0, 1]])
    uv = texels.reshape(-1, 2) / [columns * 2, rows * 2]
    return uv, np.arange(3 * count, dtype=np.int32).reshape(-1, 3), np.ascontiguousarray(texture)


def _write_job(job: _Job, folder: Path) -> None:
    atlases = []
    for i, mesh in enumerate(job.meshes):
        if mesh.texture is not None and mesh.uv is not None:
            # MuJoCo's first texture row is v = 0, an image's is v = 1.
            uv, uv_faces, texture = mesh.uv, mesh.faces, np.ascontiguousarray(mesh.texture[::-1])
        else:
            uv, uv_faces, texture = _face_atlas(mesh)
            atlases.append(i)
        normals = np.where(np.abs(mesh.normals).sum(-1, keepdims=True) > 0, mesh.normals, [0.0, 0.0, 1.0])
        spare = np.zeros(max(4 - len(normals), 0), np.int64)  # MuJoCo takes four vertices or more
        vertices, normals = (np.concatenate([x, x[spare]]) for x in (mesh.vertices, normals))
        np.savez(
            folder / f"mesh{i}.npz",
            vertices=vertices.astype(np.float32),
            faces=mesh.faces.astype(np.int32),
            normals=normals.astype(np.float32),
            uv=uv.astype(np.float32),
            uv_faces=uv_faces.astype(np.int32),
            texture=texture,
        )
    near, far = job.near_far().T
    sides = borders(np.broadcast_to(job.camera.to_matrix(), (len(near), 3, 3)), job.width, job.height)
    frusta = np.concatenate([sides * near[:, None], near[:, None], far[:, None]], axis=-1)
    np.save(folder / "poses.npy", job.poses)
    np.save(folder / "frusta.npy", frusta)
    light = None
    if job.light is not None:
        direction = np.asarray(job.light["direction"], np.float64)
        light = {
            "direction": (direction / np.linalg.norm(direction)).tolist(),
            "ambient": float(job.light.get("ambient", 0.5)),
            "diffuse": float(job.light.get("diffuse", 0.5)),
        }
    settings = {
        "meshes": len(job.meshes),
        "height": job.height,
        "width": job.width,
        "oversample": job.oversample,
        "light": light,
        "segment": job.segment,
        "atlases": atlases,
    }
    (folder / "job.json").write_text(json.dumps(settings))


def _draw_mujoco(job: _Job, backend: str, progress: Callable[[int, int], None] | None) -> Renders:
    """Draw with MuJoCo, once more where it fails, for what fails once may be the machine's state and not the backend.

    Only failures in a row before anything could be drawn are remembered, and those only for a while. RenderError in
    one sentence if it fails.
    """
    for last in (False, True):
        try:
            drawn = _run_child(job, backend, progress)
        except _MeshRefusedError:
            raise
        except _NoContextError as error:
            failures = _failed.setdefault(backend, [])
            failures.append((time.monotonic(), str(error)))
            # Silence has taken long enough; and after its rest a backend gets one chance, not two.
            if last or error.silent or len(failures) > _LAST:
                raise
        except RenderError as error:
            if last:
                raise
            log.info("%s; once more", error)
        else:
            _failed.pop(backend, None)
            return drawn
    raise AssertionError


def _run_child(job: _Job, backend: str, progress: Callable[[int, int], None] | None) -> Renders:
    """Run the child and collect its frames; RenderError in one sentence if it fails."""
    environment = dict(os.environ)
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM"):
        environment.pop(name, None)
    if backend != "native":
        environment["MUJOCO_GL"] = backend
    with tempfile.TemporaryDirectory(prefix="ipjax-render-") as name:
        folder = Path(name)
        _write_job(job, folder)
        with open(folder / "stderr.txt", "wb") as stderr:
            # -P: the child's own folder must not shadow other packages' names.
            process = subprocess.Popen(
                [sys.executable, "-P", str(_CHILD), str(folder)],
                stdout=subprocess.PIPE,
                stderr=stderr,
                stdin=subprocess.DEVNULL,
                env=environment,
                text=True,
            )
            try:
                said = _listen(process, len(job.poses), progress)
            finally:
                if process.poll() is None:
                    process.kill()
                process.wait()
                if process.stdout is not None:
                    process.stdout.close()
        if said.end == "refused":
            raise _MeshRefusedError(f"MuJoCo refuses the mesh ({said.reason[:300]})")
        if said.end != "done":
            lines = (folder / "stderr.txt").read_text(errors="replace").strip().splitlines()
            detail = said.reason or (lines[-1] if lines else f"the process ended with status {process.returncode}")
            if said.ready:
                raise RenderError(f"MuJoCo with {backend} stopped drawing ({detail[:300]})")
            error = _NoContextError(f"MuJoCo cannot draw with {backend} ({detail[:300]}); {_HELP[backend]}")
            error.silent = said.end == "silent"
            raise error
        depth = np.load(folder / "depth.npy")
        depth *= job.scales[:, None, None].astype(np.float32)
        return Renders(
            rgb=np.load(folder / "rgb.npy"),
            depth=depth,
            camera=job.cameras,
            backend=backend,
            ids=np.load(folder / "ids.npy") if job.segment else None,
        )


@dataclasses.dataclass(frozen=True)
class _Said:
    """How a child ended."""

    end: str  # done, refused, error, died, silent
    reason: str
    ready: bool  # whether it had a context to draw in


def _listen(process: subprocess.Popen, total: int, progress: Callable[[int, int], None] | None) -> _Said:
    """Follow the child's lines to its end, or until it is neither heard nor working."""
    lines: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        if process.stdout is not None:
            for line in process.stdout:
                lines.put(line)
        lines.put(None)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    ready = False
    heard, worked = time.monotonic(), _processor_seconds(process.pid)
    try:
        while True:
            try:
                line = lines.get(timeout=_TIMEOUT)
            except queue.Empty:
                silence, now = time.monotonic() - heard, _processor_seconds(process.pid)
                # A large mesh, or a processor that draws what a GPU should, takes long without a word.
                if now - worked > 0.01 * _TIMEOUT and silence < _LONGEST:
                    worked = now
                    continue
                return _Said("silent", f"no answer for {silence:.0f} s", ready)
            heard, worked = time.monotonic(), _processor_seconds(process.pid)
            if line is None:
                return _Said("died", "", ready)
            word, _, rest = line.strip().partition(" ")
            if word == "ready":
                ready = True
            elif word == "frame" and progress is not None:
                progress(int(rest), total)
            elif word in ("refused", "error", "done"):
                return _Said(word, rest, ready)
    finally:
        if process.poll() is None and process.stdout is not None:
            # The child says "done" last; give it a moment to leave by itself.
            try:
                process.wait(timeout=min(10, _TIMEOUT))
            except subprocess.TimeoutExpired:
                process.kill()
        reader.join(timeout=10)


def _processor_seconds(pid: int) -> float:
    """What a process has used of the processor; 0 where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):
        return 0.0


# --- our own z-buffer ----------------------------------------------------------------------------------------------


def _draw_raster(job: _Job, progress: Callable[[int, int], None] | None) -> Renders:
    import jax
    import jax.numpy as jnp
    from ipjax_kernels.rasterize import rasterize

    factor = job.oversample
    height, width = job.height * factor, job.width * factor
    vertices = np.concatenate([mesh.vertices for mesh in job.meshes])
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in job.meshes])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(job.meshes, starts[:-1], strict=True)])
    owner_vertex = np.repeat(np.arange(len(job.meshes)), np.diff(starts))
    owner = owner_vertex[faces[:, 0]]
    textured = np.array([mesh.texture is not None for mesh in job.meshes])
    near = job.near_far()[:, 0]
    shape = (len(job.poses), job.height, job.width)
    rgb, depth, ids = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32), np.full(shape, -1, np.int16)
    middle = slice(factor // 2, None, factor)
    device_faces = jnp.asarray(faces, jnp.int32)
    for frame, (pose, intrinsics) in enumerate(zip(job.poses, job.intrinsics, strict=True)):
        moved = np.einsum("nij,nj->ni", pose[owner_vertex, :, :3], vertices) + pose[owner_vertex, :, 3]
        camera = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
        camera = resize(camera, (job.width, job.height), (width, height))
        drawn = rasterize(
            jnp.asarray(moved, jnp.float32),
            device_faces,
            jnp.asarray(camera[[0, 1], [0, 1]], jnp.float32),
            jnp.asarray(camera[:2, 2], jnp.float32),
            height,
            width,
            near=jnp.asarray(near[frame], jnp.float32),
        )
        metric, index, weights = (np.asarray(x) for x in jax.block_until_ready(drawn))
        covered = index >= 0
        face, weight = index[covered], weights[covered].astype(np.float64)
        corners = faces[face]
        pixels = np.zeros((len(face), 3), np.float64)
        for i, mesh in enumerate(job.meshes):
            mine = owner[face] == i
            local = corners[mine] - starts[i]
            if textured[i] and mesh.uv is not None and mesh.texture is not None:
                pixels[mine] = sample_texture(mesh.texture, np.einsum("kc,kci->ki", weight[mine], mesh.uv[local]))
            else:
                pixels[mine] = np.einsum("kc,kci->ki", weight[mine], mesh.colours[local].astype(np.float64))
            if job.light is not None:
                normals = np.einsum("kc,kci->ki", weight[mine], mesh.normals[local]) @ pose[i, :, :3].T
                direction = np.asarray(job.light["direction"], np.float64)
                direction = direction / np.linalg.norm(direction)
                length = np.maximum(np.linalg.norm(normals, axis=-1), 1e-12)
                shade = job.light.get("diffuse", 0.5) * np.maximum(-(normals @ direction) / length, 0)
                pixels[mine] *= np.minimum(job.light.get("ambient", 0.5) + shade, 1)[:, None]
        colours = np.zeros((height, width, 3), np.float32)
        colours[covered] = pixels
        total = colours.reshape(job.height, factor, job.width, factor, 3).sum((1, 3))
        count = covered.reshape(job.height, factor, job.width, factor).sum((1, 3))
        depth[frame] = metric[middle, middle] * job.scales[frame]
        seen = depth[frame] > 0
        rgb[frame] = np.round(total / np.maximum(count, 1)[..., None]) * seen[..., None]
        ids[frame] = np.where(seen, owner[np.maximum(index[middle, middle], 0)], -1)
        if progress is not None:
            progress(frame + 1, len(job.poses))
    return Renders(rgb=rgb, depth=depth, camera=job.cameras, backend="raster", ids=ids if job.segment else None)

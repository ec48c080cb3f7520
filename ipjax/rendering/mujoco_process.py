"""MuJoCo draws a job in a child process: writing the job, reading the child's output, and explaining its failures.

MuJoCo reads MUJOCO_GL when it is imported, and a GL library that does not work can end the process that tries it. So
every job is drawn by a child (`child.py`), which runs with the backend that its parent chose.
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
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ipjax.cameras import borders
from ipjax.files.meshes.mesh import Mesh
from ipjax.rendering.job import Job, RenderError, Renders

log = logging.getLogger("ipjax")

_REMEDIES = {
    "egl": "install libegl1 (Debian, Ubuntu: apt install libegl1 libgl1-mesa-dri) or the GPU's driver",
    "osmesa": "install libosmesa6 (Debian, Ubuntu: apt install libosmesa6)",
    "native": "a desktop session is needed for the native GL of this system",
}
_CHILD = Path(__file__).with_name("child.py")
_TIMEOUT = 180.0  # seconds without output, after which a child that uses no processor time is ended
_LONGEST_SILENCE = 3600.0  # seconds without output, after which any child is ended
_FAILURES_ALLOWED = 2  # failures in a row to create a context, after which a backend is not tried for a while
_RETRY_AFTER = 600.0  # seconds after which it is tried again
_failures: dict[str, list[tuple[float, str]]] = {}  # such failures in a row, by backend: when, and why


class MeshRefusedError(RenderError):
    """MuJoCo did not take the mesh; no fault of the GL backend."""


class NoContextError(RenderError):
    """The backend failed before it could draw anything: it may not work on this system."""

    silent = False


def gl_backends() -> list[str]:
    """GL backends worth trying here, best first."""
    if platform.system() != "Linux":
        return ["native"]
    preferred = os.environ.get("MUJOCO_GL", "").lower().strip()
    names = ["egl", "osmesa"]
    return sorted(names, key=lambda name: name != preferred)


def recent_failure(backend: str) -> str | None:
    """Why a backend is not tried for now: it failed repeatedly, and not long ago; None where it may be tried."""
    failures = _failures.get(backend, [])
    if len(failures) >= _FAILURES_ALLOWED and time.monotonic() - failures[-1][0] < _RETRY_AFTER:
        return failures[-1][1]
    return None


def draw_mujoco(job: Job, backend: str, progress: Callable[[int, int], None] | None) -> Renders:
    """Draw with MuJoCo, with a second try if the first fails, for instance on a busy machine.

    Only failures in a row before anything could be drawn are remembered, and those only for a while. RenderError in
    one sentence if it fails.
    """
    for last in (False, True):
        try:
            drawn = run_child(job, backend, progress)
        except MeshRefusedError:
            raise
        except NoContextError as error:
            failures = _failures.setdefault(backend, [])
            failures.append((time.monotonic(), str(error)))
            # No second try after a timeout, which would take as long again, nor for a backend that failed not long ago.
            if last or error.silent or len(failures) > _FAILURES_ALLOWED:
                raise
        except RenderError as error:
            if last:
                raise
            log.info("%s; once more", error)
        else:
            _failures.pop(backend, None)
            return drawn
    raise AssertionError


def run_child(job: Job, backend: str, progress: Callable[[int, int], None] | None) -> Renders:
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
                ending = _listen(process, len(job.poses), progress)
            finally:
                if process.poll() is None:
                    process.kill()
                process.wait()
                if process.stdout is not None:
                    process.stdout.close()
        if ending.end == "refused":
            raise MeshRefusedError(f"MuJoCo refuses the mesh ({ending.reason[:300]})")
        if ending.end != "done":
            lines = (folder / "stderr.txt").read_text(errors="replace").strip().splitlines()
            detail = ending.reason or (lines[-1] if lines else f"the process ended with status {process.returncode}")
            if ending.ready:
                raise RenderError(f"MuJoCo with {backend} stopped drawing ({detail[:300]})")
            error = NoContextError(f"MuJoCo cannot draw with {backend} ({detail[:300]}); {_REMEDIES[backend]}")
            error.silent = ending.end == "silent"
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


def _write_job(job: Job, folder: Path) -> None:
    atlases = []
    for i, mesh in enumerate(job.meshes):
        if mesh.texture is not None and mesh.uv is not None:
            # MuJoCo's first texture row is v = 0, an image's is v = 1.
            uv, uv_faces, texture = mesh.uv, mesh.faces, np.ascontiguousarray(mesh.texture[::-1])
        else:
            uv, uv_faces, texture = _face_atlas(mesh)
            atlases.append(i)
        normals = np.where(np.abs(mesh.normals).sum(-1, keepdims=True) > 0, mesh.normals, [0.0, 0.0, 1.0])
        filler = np.zeros(max(4 - len(normals), 0), np.int64)  # MuJoCo takes four vertices or more
        vertices, normals = (np.concatenate([x, x[filler]]) for x in (mesh.vertices, normals))
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
        light = {
            "directions": job.light_directions.tolist(),
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


@dataclasses.dataclass(frozen=True)
class _Ending:
    """How a child ended."""

    end: str  # done, refused, error, died, silent
    reason: str
    ready: bool  # whether it had a context to draw in


def _listen(process: subprocess.Popen, total: int, progress: Callable[[int, int], None] | None) -> _Ending:
    """Read the child's output to its end, or until the child neither prints nor uses the processor."""
    lines: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        if process.stdout is not None:
            for line in process.stdout:
                lines.put(line)
        lines.put(None)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    ready = False
    last_line, processor_used = time.monotonic(), _processor_seconds(process.pid)
    try:
        while True:
            try:
                line = lines.get(timeout=_TIMEOUT)
            except queue.Empty:
                silence, now = time.monotonic() - last_line, _processor_seconds(process.pid)
                # Compiling a large mesh and drawing without a GPU take long, with nothing printed meanwhile.
                if now - processor_used > 0.01 * _TIMEOUT and silence < _LONGEST_SILENCE:
                    processor_used = now
                    continue
                return _Ending("silent", f"no answer for {silence:.0f} s", ready)
            last_line, processor_used = time.monotonic(), _processor_seconds(process.pid)
            if line is None:
                return _Ending("died", "", ready)
            word, _, rest = line.strip().partition(" ")
            if word == "ready":
                ready = True
            elif word == "frame" and progress is not None:
                progress(int(rest), total)
            elif word in ("refused", "error", "done"):
                return _Ending(word, rest, ready)
    finally:
        if process.poll() is None and process.stdout is not None:
            # The child says "done" last; give it a moment to leave by itself.
            try:
                process.wait(timeout=min(10, _TIMEOUT))
            except subprocess.TimeoutExpired:
                process.kill()
        reader.join(timeout=10)


def _processor_seconds(pid: int) -> float:
    """Seconds of the processor that a process has used; 0 where the system does not count them."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):
        return 0.0

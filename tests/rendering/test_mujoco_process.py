"""The child process that draws: what is done when it is silent, refuses, dies, or cannot have a context at all."""

import logging
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from ipjax.files.meshes.mesh import make_mesh
from ipjax.records import Camera, Similarity
from ipjax.rendering import mujoco_process
from ipjax.rendering import render as rendering
from ipjax.rendering.job import RenderError
from ipjax.rendering.render import available_backends, render

TRIANGLE = make_mesh(np.eye(3), np.array([[0, 1, 2]]))
POSE = Similarity(jnp.eye(3), jnp.array([0.0, 0, 3]), jnp.float32(1))
CAMERA = Camera(jnp.full(2, 10.0), jnp.full(2, 7.5))


def test_a_process_that_fixed_another_backend_can_render():
    report = available_backends()
    if report.get("egl") != "ok":
        pytest.skip(f"no EGL: {report}")
    code = """
import os
os.environ["MUJOCO_GL"] = "disable"
import mujoco, numpy as np, jax.numpy as jnp
from ipjax.files.meshes.mesh import make_mesh
from ipjax.rendering.render import render
from ipjax.records import Camera, Similarity
mesh = make_mesh(np.eye(3), np.array([[0, 1, 2]]))
pose = Similarity(jnp.eye(3), jnp.array([0.0, 0, 3]), jnp.float32(1))
image = render(mesh, pose, Camera(jnp.full(2, 10.0), jnp.full(2, 7.5)), 16, 16)
assert image.backend == "egl" and image.mask.any()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_failure_is_a_sentence_and_the_rasteriser_takes_over(monkeypatch, caplog):
    monkeypatch.setattr(rendering, "gl_backends", lambda: ["nonsense"])
    monkeypatch.setitem(mujoco_process._REMEDIES, "nonsense", "install libnonsense1")
    monkeypatch.setattr(mujoco_process, "_failures", {})
    monkeypatch.setattr(rendering, "BACKENDS", (*rendering.BACKENDS, "nonsense"))
    with pytest.raises(RenderError, match=r"nonsense.*install libnonsense1") as caught:
        render(TRIANGLE, POSE, CAMERA, 16, 16, backend="nonsense")
    assert "\n" not in str(caught.value)
    with caplog.at_level(logging.WARNING, "ipjax"):
        image = render(TRIANGLE, POSE, CAMERA, 16, 16)
    assert image.backend == "raster" and image.mask.any() and "libnonsense1" in caplog.text


CHILD = """
import json, sys, time
from pathlib import Path
import numpy as np
folder, count = Path(sys.argv[1]), Path(COUNT)
runs = len(count.read_text()) if count.exists() else 0
count.write_text("x" * (runs + 1))
def draw(frames=1):
    print("ready", flush=True)
    np.save(folder / "rgb.npy", np.zeros((1, 16, 16, 3), np.uint8))
    np.save(folder / "depth.npy", np.ones((1, 16, 16), np.float32))
    print("frame 1", flush=True)
    print("done", flush=True)
def work(seconds):
    begin = time.process_time()
    while time.process_time() - begin < seconds:
        pass
"""


@pytest.fixture
def child(tmp_path, monkeypatch):
    """Renders by a child of the test's own, one backend, a short patience; the number of children started so far."""
    count = tmp_path / "count"
    monkeypatch.setattr(rendering, "gl_backends", lambda: ["egl"])
    monkeypatch.setattr(mujoco_process, "_failures", {})
    monkeypatch.setattr(mujoco_process, "_TIMEOUT", 0.5)
    monkeypatch.setattr(mujoco_process, "_CHILD", tmp_path / "child.py")

    def draw(does: str) -> tuple[str, int]:
        (tmp_path / "child.py").write_text(CHILD.replace("COUNT", repr(str(count))) + does)
        count.write_text("")
        backend = render(TRIANGLE, POSE, CAMERA, 16, 16).backend
        return backend, len(count.read_text())

    return draw


def test_who_is_silent_but_works_is_waited_for(child):
    assert child("work(1.5)\ndraw()") == ("egl", 1)


@pytest.mark.parametrize(
    ("fault", "runs"),
    [
        ("time.sleep(60)", 1),  # it never had a context
        ("print('ready', flush=True)\ntime.sleep(60)", 2),
        ("print('ready', flush=True)\nsys.exit(9)", 2),
        ("print('ready', flush=True)\nprint('error MemoryError: too many', flush=True)", 2),
    ],
)
def test_a_fault_that_passes_is_forgotten(child, fault, runs):
    """Whatever goes wrong, this job is drawn by the rasteriser and the next one by MuJoCo again."""
    assert child(fault) == ("raster", runs)
    assert child("draw()") == ("egl", 1)
    assert mujoco_process._failures == {}


@pytest.mark.parametrize("fault", ["sys.exit(1)", "print('ready', flush=True)\nsys.exit(1)"])
def test_what_fails_once_is_done_again_at_once(child, fault):
    assert child(f"if runs == 0:\n    {fault.replace(chr(10), chr(10) + '    ')}\ndraw()") == ("egl", 2)


def test_who_cannot_be_had_is_left_alone_for_a_while(child, monkeypatch):
    missing = "print('error ImportError: no EGL', flush=True)"
    assert child(missing) == ("raster", 2)
    assert child("draw()") == ("raster", 0)
    monkeypatch.setattr(mujoco_process, "_RETRY_AFTER", 0.0)
    assert child(missing) == ("raster", 1)
    assert child("draw()") == ("egl", 1)

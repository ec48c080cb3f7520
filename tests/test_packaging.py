"""What is installed: two packages and nothing else, with their types, from files that name no registry."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import ipjax

ROOT = Path(__file__).resolve().parent.parent
CONSTRAINTS = "constraints.txt", "constraints-newest.txt"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def list_sources() -> set[str]:
    """The files that a wheel must hold, as they are named in it."""
    files = {f"ipjax/{path.relative_to(ROOT / 'ipjax')}" for path in (ROOT / "ipjax").rglob("*") if path.is_file()}
    kernels = ROOT / "kernels" / "ipjax_kernels"
    files |= {f"ipjax_kernels/{path.relative_to(kernels)}" for path in kernels.rglob("*") if path.is_file()}
    return {name for name in files if "__pycache__" not in name}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> zipfile.ZipFile:
    """The wheel, built here and now, without the network."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield archive


def test_wheel_holds_both_packages_and_nothing_else(wheel):
    names = set(wheel.namelist())
    packed = {name for name in names if ".dist-info/" not in name}
    assert {name.split("/")[0] for name in packed} == {"ipjax", "ipjax_kernels"}
    assert packed == list_sources()
    assert {"ipjax/py.typed", "ipjax_kernels/py.typed"} <= packed


def test_wheel_says_who_it_is(wheel):
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    text = wheel.read(name).decode()
    assert f"\nVersion: {ipjax.__version__}\n" in text
    assert "\nRequires-Python: >=3.11\n" in text
    assert "\nLicense-Expression: Apache-2.0\n" in text
    assert any("licenses/LICENSE" in name for name in wheel.namelist())
    (entry,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "ipjax = ipjax.cli:main" in wheel.read(entry).decode()


def test_wheel_runs_where_it_lies(wheel, tmp_path):
    wheel.extractall(tmp_path)
    code = "import ipjax, ipjax_kernels; print(ipjax.__file__, ipjax_kernels.__file__)"
    path = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); "
    done = subprocess.run([sys.executable, "-c", path + code], capture_output=True, text=True, cwd="/", timeout=120)
    assert done.returncode == 0, done.stderr
    assert all(Path(name).is_relative_to(tmp_path) for name in done.stdout.split())


@pytest.mark.parametrize("file", CONSTRAINTS)
def test_constraints_pin_and_name_no_address(file):
    lines = [line for line in (ROOT / file).read_text().splitlines() if line and not line.startswith("#")]
    assert len(lines) > 50
    for line in lines:
        assert re.fullmatch(r"[a-z0-9][a-z0-9-]*==[0-9][0-9a-z.]*( ; [a-z_]+ .+)?", line), line
    names = [line.partition("==")[0] for line in lines]
    assert len(set(names)) == len(names)


def read_requirements() -> list[str]:
    project = PROJECT["project"]
    groups = [project["dependencies"], *(v for k, v in project["optional-dependencies"].items() if k != "cuda")]
    return [re.match(r"[A-Za-z0-9-]+", item).group().lower() for group in groups for item in group]


@pytest.mark.parametrize("file", CONSTRAINTS)
def test_every_requirement_is_pinned(file):
    text = (ROOT / file).read_text()
    pinned = set(re.findall(r"^([a-z0-9-]+)==", text, re.MULTILINE))
    assert {name for name in read_requirements() if name != "ipjax"} <= pinned


def test_nothing_needs_one_system():
    classifiers = PROJECT["project"]["classifiers"]
    assert any("MacOS" in line for line in classifiers) and any("Linux" in line for line in classifiers)
    for requirement in PROJECT["project"]["dependencies"]:
        assert not re.search(r"torch|onnx|open3d|cuda|pyopengl", requirement, re.IGNORECASE), requirement


def test_files_of_the_house_are_there():
    for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff", "LICENSE", "Makefile", ".ci/run"):
        assert (ROOT / name).stat().st_size > 0, name
    assert f"version: {ipjax.__version__}" in (ROOT / "CITATION.cff").read_text()
    assert "Apache License" in (ROOT / "LICENSE").read_text()
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o100

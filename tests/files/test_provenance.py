"""What an object file and a result hang on: the source that made them, the files that were read, and nothing else."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.layers import MODULES
from builders.objects import make_object
from PIL import Image

from ipjax.bop.estimator import DatasetEstimator, hash_code
from ipjax.bop.objects import ONBOARDING, OnboardedObject, hash_origin
from ipjax.config import OnboardConfig
from ipjax.files.meshes.mesh import make_mesh
from ipjax.files.meshes.saving import save_mesh
from ipjax.files.objects.loading import load
from ipjax.files.objects.saving import save
from ipjax.files.provenance import PACKAGES, find_packages, hash_executed, list_executed
from ipjax.files.weights.parameters import abstract_model
from ipjax.networks.dinov2 import DinoV2Config, Encoder


def encoder_called(identity: str) -> Encoder:
    """An encoder that nobody will run."""
    return Encoder(abstract_model(DinoV2Config(width=12, depth=1, heads=3, hidden=12)), 0, identity)


@pytest.fixture(scope="module")
def copies(tmp_path_factory) -> dict[str, Path]:
    """The running packages' source, where a test may change it."""
    folder = tmp_path_factory.mktemp("source")
    for name, path in find_packages().items():
        shutil.copytree(path, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return {name: folder / name for name in PACKAGES}


def changed(copies, module: str, *roots: str) -> bool:
    """Whether one more byte in a module's source changes the hash of what the roots execute."""
    path = next(p for p in copies.values()).parent.joinpath(*module.split(".")).with_suffix(".py")
    whole = path.read_bytes()
    before = hash_executed(*roots, packages=copies)
    try:
        path.write_bytes(whole + b"\n")
        return hash_executed(*roots, packages=copies) != before
    finally:
        path.write_bytes(whole)


def test_one_byte_of_any_module_that_onboarding_executes_changes_the_key_and_of_no_other(copies):
    executed = list_executed(*ONBOARDING)
    assert {
        "ipjax.estimation.features",
        "ipjax.networks.dinov2",
        "ipjax.files.meshes.mesh",
        "ipjax_kernels.rasterize",
    } <= executed.keys()
    assert (
        not {"ipjax.estimation.matching", "ipjax.estimation.refinement", "ipjax.cli", "ipjax.bop.scoring.scores"}
        & executed.keys()
    )
    modules = [name for name, path in MODULES.items() if path.name != "__init__.py"]
    assert {name for name in modules if changed(copies, name, *ONBOARDING)} == executed.keys()


def test_what_is_loaded_is_what_is_listed():
    """The listing reads source; a process that imports it all says whether it reads it right."""
    for root in ("ipjax.onboarding.mesh", "ipjax.inference.estimator"):
        program = f"import sys, json, {root}; print(json.dumps(sorted(sys.modules)))"
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        loaded = {name for name in json.loads(done.stdout) if name.split(".")[0] in PACKAGES}
        loaded -= {name for name in loaded if MODULES[name].name == "__init__.py"}
        assert loaded <= list_executed(root).keys()
    with pytest.raises(ValueError, match=r"no module ipjax\.none"):
        list_executed("ipjax.none")


def test_imports_inside_functions_count_and_those_of_type_checkers_do_not(tmp_path):
    package = tmp_path / "ipjax"
    package.mkdir()
    (package / "a.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ipjax import d\nelse:\n    import ipjax.e\n"
        "def f():\n    from ipjax.b import x\nimport numpy\n"
    )
    (package / "b.py").write_text("from ipjax import c\nx = 1\n")
    for name in "cde":
        (package / f"{name}.py").write_text("from ipjax import a\n")
    assert list(list_executed("ipjax.a", packages={"ipjax": package})) == [f"ipjax.{name}" for name in "abce"]


def test_a_package_that_offers_names_counts_with_their_modules(tmp_path):
    package = tmp_path / "ipjax"
    (package / "m").mkdir(parents=True)
    (package / "__init__.py").write_text("from ipjax.c import z\n")
    (package / "m" / "__init__.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ipjax.m.x import f as f\n"
    )
    (package / "m" / "x.py").write_text("f = 1\n")
    (package / "a.py").write_text("from ipjax import m\n")
    (package / "b.py").write_text("from ipjax.m import f\n")
    (package / "c.py").write_text("z = 1\n")
    packages = {"ipjax": package}
    for name in ("a", "b"):
        assert list(list_executed(f"ipjax.{name}", packages=packages)) == [f"ipjax.{name}", "ipjax.m", "ipjax.m.x"]
    assert list(list_executed("ipjax.m.x", packages=packages)) == ["ipjax.m.x"]
    named = {name for name in list_executed("ipjax.bop.scoring.recalls") if name.startswith("ipjax.metrics.")}
    assert {"ipjax.metrics.surface", "ipjax.metrics.visible", "ipjax.metrics.recalls"} <= named


def test_results_hang_on_the_estimate(copies):
    executed = list_executed("ipjax.inference.estimator").keys()
    assert {
        "ipjax.estimation.features",
        "ipjax.estimation.matching",
        "ipjax.estimation.refinement",
        "ipjax_kernels.consensus",
    } <= executed
    assert not {"ipjax.cli", "ipjax.networks.triposr.model", "ipjax.bop.scoring.scores"} & executed


def test_the_key_of_an_object_file(tmp_path):
    triangle = make_mesh(np.eye(3), np.array([[0, 1, 2]]))
    mesh = dataclasses.replace(triangle, uv=np.eye(3)[:, :2], texture=np.full((4, 4, 3), 90, np.uint8))
    save_mesh(mesh, tmp_path / "a.obj")
    source, config, encoder = tmp_path / "a.obj", OnboardConfig(), encoder_called("an encoder")
    key = lambda **more: hash_origin(source, encoder, more.pop("config", config), **{"quality": 0, "seed": 0, **more})
    first = key()
    assert first == key() and len(first) == 16
    assert key(hash_code=lambda *_: "other") != first
    assert key(config=OnboardConfig(directions=20)) != first and key(quality=2) != first
    # The degradation is executed only where a mesh is degraded.
    told = []
    for quality in (0, 2):
        key(quality=quality, hash_code=lambda *modules: told.append(modules) or "")
    assert told == [ONBOARDING, (*ONBOARDING, "ipjax.synthetic.degradation")]
    # Textures count by whatever name the material gives them; what lies there besides does not.
    (tmp_path / "unrelated.png").write_bytes(b"x")
    assert key() == first
    shutil.move(tmp_path / "a.png", tmp_path / "skin two.png")
    text = (tmp_path / "a.mtl").read_text()
    assert "a.png" in text
    (tmp_path / "a.mtl").write_text(text.replace("a.png", "skin two.png"))
    renamed = key()
    assert renamed != first
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "skin two.png")
    assert key() != renamed


def test_other_content_of_an_object_file_is_another_setting(tmp_path):
    templates, info = make_object()
    settings = []
    for name in ("mug", "mug", "cup"):
        save(tmp_path / "a.ipjax", templates, dataclasses.replace(info, name=name))
        estimator = DatasetEstimator({1: OnboardedObject(1, tmp_path / "a.ipjax")}, encoder_called(info.encoder))
        settings.append(estimator.settings())
        assert settings[-1]["objects"]["1"]["content"] == load(tmp_path / "a.ipjax")[1].content_sha256
    assert settings[0] == settings[1] != settings[2]
    assert settings[0]["code"] == hash_code()

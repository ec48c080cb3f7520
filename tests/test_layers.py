"""Data goes one way: every module imports only from the layers before its own, and importing ipjax costs nothing."""

import ast
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import ipjax

ROOT = Path(__file__).resolve().parent.parent

# Where a name stands: a module may import from lower numbers only. The stages of layer 3 do not import one another.
LAYERS = {
    "ipjax_kernels": 0,
    "ipjax.types": 1,
    "ipjax.config": 1,
    "ipjax.cameras": 2,
    "ipjax.dinov2": 2,
    "ipjax.metrics": 2,
    "ipjax.triposr": 2,
    "ipjax.validity": 2,
    "ipjax.features": 3,
    "ipjax.matching": 3,
    "ipjax.alignment": 3,
    "ipjax.refinement": 3,
    "ipjax.scoring": 3,
    "ipjax.confidence": 3,
    "ipjax.pipeline": 4,
    "ipjax.host": 5,
    "ipjax.cli": 6,
    "ipjax.__main__": 7,
    "ipjax": 8,  # the public names
}
MAY_SHARE = {  # modules of one layer that may import their neighbours, and why
    "ipjax.triposr": {"ipjax.dinov2"},  # two vision transformers of one family share their blocks
    "ipjax.scoring": {"ipjax.features"},  # what it draws is described as the templates were
}
HEAVY = {"mujoco", "cv2", "trimesh", "torch", "scipy", "skimage", "PIL", "matplotlib", "safetensors", "tqdm"}
OF_KERNELS = {"jax", "jaxtyping", "numpy", "ipjax_kernels", *sys.stdlib_module_names}


def find_modules() -> dict[str, Path]:
    """Every module of both packages, by its dotted name."""
    found = {}
    for package in (ROOT / "ipjax", ROOT / "kernels" / "ipjax_kernels"):
        for path in sorted(package.rglob("*.py")):
            parts = list(path.relative_to(package.parent).with_suffix("").parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = find_modules()


def layer_of(name: str) -> int:
    """The layer of a module, or of the nearest package above it that has one."""
    while name not in LAYERS:
        name, _, _ = name.rpartition(".")
        assert name, "a module outside ipjax and ipjax_kernels"
    return LAYERS[name]


def is_for_types(node: ast.AST) -> bool:
    """Whether this is ``if TYPE_CHECKING:``, which never runs."""
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def list_imports(source: str, module: str, known: set[str]) -> list[tuple[int, str, bool]]:
    """What a module imports: line, dotted name (a submodule's where that is what is meant), and if at its top level."""
    tree = ast.parse(source)
    inner = {
        child
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) or is_for_types(node)
        for child in ast.walk(node)
    }
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}:{node.lineno}: a relative import"
            full = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in known else str(node.module) for name in full if name != "ipjax.__version__"]
        else:
            continue
        found.extend((node.lineno, name, node not in inner) for name in names)
    return found


def find_faults(source: str, module: str, known: set[str]) -> list[str]:
    """The imports of a module that go the wrong way."""
    mine = layer_of(module)
    faults = []
    for line, name, _ in list_imports(source, module, known):
        if name.split(".")[0] not in ("ipjax", "ipjax_kernels"):
            continue
        if module == name or (mine == layer_of(name) and mine in (0, 1, 5)):
            continue  # kernels, records and host modules stand side by side
        if name == "ipjax" and module != "ipjax":
            faults.append(f"{module}:{line} imports the public names; import the module that has them")
        elif layer_of(name) >= mine and name not in MAY_SHARE.get(module, ()):
            faults.append(f"{module}:{line} imports {name}, which stands after it")
    return faults


@pytest.mark.parametrize("module", MODULES)
def test_imports_only_from_layers_before(module):
    assert find_faults(MODULES[module].read_text(), module, set(MODULES)) == []


def test_public_names_are_lazy_and_typed_as_they_are_found():
    source = MODULES["ipjax"].read_text()
    top = [name for _, name, top in list_imports(source, "ipjax", set(MODULES)) if top]
    assert not [name for name in top if name.split(".")[0] not in sys.stdlib_module_names]
    typed = {
        alias.name: node.module
        for block in ast.walk(ast.parse(source))
        if is_for_types(block)
        for node in ast.walk(block)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert typed == ipjax._HOME and sorted(typed) == ipjax.__all__
    for name, module in typed.items():
        assert getattr(ipjax, name) is getattr(importlib.import_module(module), name)
    assert ipjax.matching.match and set(ipjax.__all__) <= set(dir(ipjax))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ipjax.nothing


@pytest.mark.parametrize("module", [name for name in MODULES if layer_of(name) < LAYERS["ipjax.host"]])
def test_pure_layers_do_without_heavy_packages(module):
    for line, name, _ in list_imports(MODULES[module].read_text(), module, set(MODULES)):
        assert name.split(".")[0] not in HEAVY, f"{module}:{line} imports {name}"


@pytest.mark.parametrize("module", [name for name in MODULES if layer_of(name) == 0])
def test_kernels_need_only_jax(module):
    for line, name, _ in list_imports(MODULES[module].read_text(), module, set(MODULES)):
        assert name.split(".")[0] in OF_KERNELS, f"{module}:{line} imports {name}"


def test_no_postponed_annotations():
    # jaxtyping reads annotations when a function is made; as strings they would check nothing.
    for module, path in MODULES.items():
        assert "__future__" not in path.read_text(), module


def test_finds_what_goes_back():
    known = set(MODULES)
    assert find_faults("from ipjax.types import Camera", "ipjax.cameras", known) == []
    assert find_faults("from ipjax.pipeline import estimate", "ipjax.matching", known)
    assert find_faults("from ipjax.alignment import align", "ipjax.matching", known)
    assert find_faults("from ipjax import host", "ipjax.scoring", known)
    assert find_faults("def f():\n    import ipjax.host.meshes", "ipjax.features", known)
    assert find_faults("from ipjax import __version__", "ipjax.host.objects", known) == []
    assert find_faults("from ipjax import estimate", "ipjax.host.objects", known)
    assert find_faults("import ipjax", "ipjax.types", known)
    assert find_faults("from ipjax.types import Camera", "ipjax_kernels.similarity", known)


def test_import_is_light():
    """``import ipjax`` loads the standard library at most; the pure names start no backend and load no host module."""
    code = """
import sys, json
before = set(sys.modules)
import ipjax
first = sorted(set(sys.modules) - before)
ipjax.Config, ipjax.estimate, ipjax.describe, ipjax.View
from jax._src import xla_bridge
print(json.dumps([first, sorted(sys.modules), xla_bridge.backends_are_initialized()]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd="/", timeout=120)
    assert done.returncode == 0, done.stderr
    first, loaded, started = json.loads(done.stdout)
    assert {name.split(".")[0] for name in first} - set(sys.stdlib_module_names) == {"ipjax"} and "ipjax" in first
    heavy = {"mujoco", "cv2", "trimesh", "torch", "matplotlib", "onnx", "onnxruntime"}
    assert not heavy & {name.split(".")[0] for name in loaded}
    assert not started, "importing ipjax started a JAX backend"
    assert not [name for name in loaded if name.startswith("ipjax.host.")]

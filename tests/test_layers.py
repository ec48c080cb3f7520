"""Data goes one way: every module imports only from the layers before its own, and importing ipjax costs nothing."""

import ast
import importlib
import json
import subprocess
import sys

import pytest
from builders.layers import FIRST_IMPURE, LAYERS, MODULES, layer_of, package_of

import ipjax

MAY_SHARE = {  # modules of one row that may import their neighbours, and why
    "ipjax.estimation.scoring": {"ipjax.estimation.features"},  # what it draws is described as the templates were
}
HEAVY = {"mujoco", "cv2", "trimesh", "torch", "scipy", "skimage", "PIL", "matplotlib", "safetensors", "tqdm"}
OF_KERNELS = {"jax", "jaxtyping", "numpy", "ipjax_kernels", *sys.stdlib_module_names}


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
        if (
            module == name
            or package_of(module) == package_of(name)
            or mine == layer_of(name) == LAYERS["ipjax.records"]
        ):
            continue
        if name == "ipjax" and module != "ipjax":
            faults.append(f"{module}:{line} imports the public names; import the module that has them")
        elif layer_of(name) >= mine and name not in MAY_SHARE.get(module, ()):
            faults.append(f"{module}:{line} imports {name}, which stands after it")
    return faults


@pytest.mark.parametrize("module", MODULES)
def test_imports_only_from_layers_before(module):
    assert find_faults(MODULES[module].read_text(), module, set(MODULES)) == []


def find_circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that need one another, directly or not."""
    reached = {}
    for start in imports:
        seen, waiting = set(), [start]
        while waiting:
            for name in imports.get(waiting.pop(), ()):
                if name not in seen:
                    seen.add(name)
                    waiting.append(name)
        reached[start] = seen
    return sorted({tuple(sorted(b for b in imports if b in reached[a] and a in reached[b])) for a in imports} - {()})


def test_nothing_goes_in_a_circle():
    imports = {
        module: {name for _, name, _ in list_imports(path.read_text(), module, set(MODULES)) if name in MODULES}
        for module, path in MODULES.items()
        if module != "ipjax"  # its names are those of all modules, and only what is asked for is imported
    }
    assert find_circles({m: names - {"ipjax", m} for m, names in imports.items()}) == []
    assert find_circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [("a", "b", "c")]


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
    assert ipjax.estimation.matching.match and set(ipjax.__all__) <= set(dir(ipjax))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ipjax.nothing


@pytest.mark.parametrize("module", [name for name in MODULES if layer_of(name) < FIRST_IMPURE])
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
    assert find_faults("from ipjax.records import Camera", "ipjax.cameras", known) == []
    assert find_faults("from ipjax.estimation.pipeline import estimate", "ipjax.estimation.matching", known)
    assert find_faults("from ipjax.estimation.alignment import align", "ipjax.estimation.matching", known)
    assert find_faults("from ipjax import files", "ipjax.estimation.scoring", known)
    assert find_faults("def f():\n    import ipjax.files.meshes.mesh", "ipjax.estimation.features", known)
    assert find_faults("from ipjax import __version__", "ipjax.files.objects.loading", known) == []
    assert find_faults("from ipjax import estimate", "ipjax.files.objects.loading", known)
    assert find_faults("import ipjax", "ipjax.records", known)
    assert find_faults("from ipjax.records import Camera", "ipjax_kernels.similarity", known)


def test_import_is_light():
    """``import ipjax`` loads the standard library at most; the pure names load pure modules, and start no backend."""
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
    impure = {name for name in MODULES if layer_of(name) >= FIRST_IMPURE and name != "ipjax"}
    assert not impure & set(loaded)

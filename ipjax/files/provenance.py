"""A hash of the source code that made a file, so that files of another state of the code are not mistaken for current.

Modules are found by reading their imports, at any depth and also inside functions; nothing is imported for it.
"""

import ast
import hashlib
import importlib.util
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path

PACKAGES = ("ipjax", "ipjax_kernels")


def find_packages() -> dict[str, Path]:
    """The folders of ipjax and its kernels, by name."""
    found = {"ipjax": Path(__file__).resolve().parent.parent}
    for name in PACKAGES[1:]:
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.submodule_search_locations:
            found[name] = Path(next(iter(spec.submodule_search_locations)))
    return found


def list_executed(*modules: str, packages: Mapping[str, Path] | None = None) -> dict[str, Path]:
    """The files of modules and of all that they import, directly or not, within our packages; by module name.

    A package that offers names of its modules, such as `ipjax.metrics`, counts with all of those modules where it is
    imported itself; ``import ipjax`` does not, because no module may import the public names.

    Args:
        modules: dotted names, such as "ipjax.onboarding.mesh".
        packages: folders by package name; default: those that are running.

    Raises:
        ValueError: one of ``modules`` does not exist.
    """
    packages = find_packages() if packages is None else packages
    found: dict[str, Path] = {}
    waiting = list(modules)
    for name in modules:
        if _file_of(name, packages) is None:
            raise ValueError(f"there is no module {name}")
    while waiting:
        name = waiting.pop()
        path = _file_of(name, packages)
        if name in found or path is None:
            continue
        if path.name != "__init__.py":
            found[name] = path
            waiting += _read_imports(path.read_bytes())
        elif name not in packages:
            # Its names come from modules that it imports when they are asked for; any of them may be.
            homes = _read_imports(path.read_bytes(), for_types=True)
            if homes:
                found[name] = path
                waiting += homes
    return dict(sorted(found.items()))


def hash_executed(*modules: str, also: tuple[str, ...] = (), packages: Mapping[str, Path] | None = None) -> str:
    """Sixteen digits of the source of `list_executed`; ``also`` are modules that count without what they import."""
    folders = find_packages() if packages is None else packages
    files = list_executed(*modules, packages=folders)
    files |= {name: path for name in also if (path := _file_of(name, folders)) is not None}
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(f"{name} {hashlib.sha256(files[name].read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()[:16]


def _file_of(name: str, packages: Mapping[str, Path]) -> Path | None:
    package, _, rest = name.partition(".")
    if package not in packages:
        return None
    path = packages[package].joinpath(*rest.split(".")) if rest else packages[package]
    for candidate in (path / "__init__.py", path.with_name(path.name + ".py")):
        if candidate.is_file():
            return candidate
    return None


@cache
def _read_imports(source: bytes, *, for_types: bool = False) -> tuple[str, ...]:
    """Every name that may be a module which this source imports; what only type checkers see if ``for_types``."""
    found: list[str] = []

    def visit(node: ast.AST) -> None:
        is_for_types = isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        if isinstance(node, ast.If) and is_for_types and not for_types:
            for other in node.orelse:
                visit(other)
            return
        if isinstance(node, ast.Import):
            found.extend(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found.append(node.module)
            found.extend(f"{node.module}.{alias.name}" for alias in node.names)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(source))
    return tuple(name for name in found if name.split(".")[0] not in sys.stdlib_module_names)

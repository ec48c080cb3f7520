"""One way to call everything: what is fixed, what is new, key, config; the rest by keyword. And all of it is told."""

import collections.abc
import importlib
import inspect
import re
import typing

import equinox as eqx
import jax
import numpy as np
import pytest
from builders.layers import FIRST_COMMAND, FIRST_IMPURE, MODULES, layer_of
from jaxtyping import Array, Float

import ipjax

FIXED = {"encoder", "templates", "surface", "estimator", "model"}  # made once per object, or once
NEW = {"query", "view", "cloud", "pairs", "patches", "rgb", "depth", "mask", "image", "photo"}  # once per frame
LAST = ("key", "config", "diameter")  # the last is known of some objects only, and None by default
# Where the arrow starts comes first: both directions are searched, and the cycle starts at the query.
AS_KERNEL = {"match", "select", "nearest", "search", "cycle_distance"}
KEY_FIRST = {"draw_minimal_sets", "consensus"}  # samplers, as in jax.random


def is_public(name: str) -> bool:
    return not any(part.startswith("_") for part in name.split("."))


PURE = [name for name in MODULES if layer_of(name) < FIRST_IMPURE and is_public(name)]
REST = [name for name in MODULES if FIRST_IMPURE <= layer_of(name) < FIRST_COMMAND and is_public(name)]


def list_functions(modules: list[str]) -> dict[str, typing.Any]:
    """The public functions of modules, and the public methods of their public classes, by their full names."""
    found = {}
    for name in modules:
        module = importlib.import_module(name)
        for key, value in vars(module).items():
            if key.startswith("_") or getattr(value, "__module__", None) != name:
                continue
            if inspect.isclass(value):
                if issubclass(value, BaseException):
                    continue
                for inner, method in vars(value).items():
                    plain = inspect.unwrap(getattr(method, "__func__", method))
                    if any(hasattr(base, inner) for base in value.__mro__[1:]):
                        continue  # told where it is declared
                    if inspect.isfunction(plain) and not inner.startswith("_") and plain.__module__ == name:
                        found[f"{name}.{key}.{inner}"] = plain
            elif callable(value) and inspect.isfunction(inspect.unwrap(value)):
                found[f"{name}.{key}"] = inspect.unwrap(value)
    return found


def positional(function) -> list[str]:
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return [p.name for p in inspect.signature(function).parameters.values() if p.kind in kinds and p.name != "self"]


def is_architecture(annotation) -> bool:
    return inspect.isclass(annotation) and annotation.__module__ in (
        "ipjax.networks.dinov2",
        "ipjax.networks.triposr.config",
    )


def find_disorder(name: str, function) -> list[str]:
    """What is out of order among the arguments of a function."""
    names = positional(function)
    short = name.rpartition(".")[2]
    faults = []
    parameters = inspect.signature(function).parameters
    # A network's own record says what it is made of, and belongs to what is fixed.
    last = [n for n in LAST if n != "config" or n not in parameters or not is_architecture(parameters[n].annotation)]
    if "config" not in names:
        last.remove("diameter")  # then it is one of what is given, as in a metric
    tail = [n for n in names if n in last]
    if short not in KEY_FIRST and tail and names[-len(tail) :] != [n for n in last if n in tail]:
        faults.append(f"{name}({', '.join(names)}): key, config, diameter come last; what follows is keyword-only")
    ranks = [0 if n in FIXED else 1 for n in names if n in FIXED | NEW]
    if short not in AS_KERNEL and ranks != sorted(ranks):
        faults.append(f"{name}({', '.join(names)}): what is fixed comes before what is new")
    return faults


def holds_arrays(annotation) -> bool:
    """Whether what is annotated so may hold arrays: an array, a record or a network, or one of several such."""
    if hasattr(annotation, "array_type") or typing.get_origin(annotation) is collections.abc.Callable:
        return True
    if inspect.isclass(annotation) and issubclass(annotation, eqx.Module):
        return True
    return any(holds_arrays(inner) for inner in typing.get_args(annotation))


def find_unmappable(name: str, function) -> list[str]:
    """What `jax.vmap` cannot map one by one, for it gives every keyword's arrays the first axis."""
    parameters = inspect.signature(function).parameters.values()
    return [
        f"{name}: {p.name} holds arrays" for p in parameters if p.kind is p.KEYWORD_ONLY and holds_arrays(p.annotation)
    ]


@pytest.mark.parametrize("module", [m for m in PURE if m.startswith("ipjax.")])
def test_what_vmap_maps_is_positional(module):
    faults = [f for name, function in list_functions([module]).items() for f in find_unmappable(name, function)]
    assert faults == []


def test_finds_what_cannot_be_mapped():
    def size(query, *, diameter: Float[Array, ""] | None = None): ...

    def record(query, *, camera: ipjax.Camera): ...

    def network(query, *, encoder: collections.abc.Callable[[Float[Array, "h"]], Float[Array, "c"]] | None = None): ...

    def options(query, diameter: Float[Array, ""] | None = None, *, block: int = 3, known: bool = False): ...

    assert all(find_unmappable("f", function) for function in (size, record, network))
    assert find_unmappable("f", options) == []


@pytest.mark.parametrize("module", [*PURE, *REST])
def test_arguments_are_in_order(module):
    faults = [fault for name, function in list_functions([module]).items() for fault in find_disorder(name, function)]
    assert faults == []


def test_finds_disorder():
    def late(view, config, key): ...

    def swapped(query, templates): ...

    def early(templates, query, diameter, key, config): ...

    def behind(templates, query, encoder, key, config, diameter): ...

    def good(encoder, templates, query, key, config, diameter): ...

    assert all(find_disorder("f", function) for function in (late, swapped, early, behind))
    assert find_disorder("good", good) == []


@pytest.mark.parametrize("module", [*PURE, *REST])
def test_everything_public_is_told(module):
    assert (importlib.import_module(module).__doc__ or "").strip(), f"{module} does not say what it is"
    for name, function in list_functions([module]).items():
        if name.startswith("ipjax_kernels.reference"):
            continue  # the loops are the text
        assert len((function.__doc__ or "").strip()) > 15, f"{name} has no docstring"


def has_bare_array(annotation) -> bool:
    """Whether an annotation says array and not which shape; of tensors by name, the names say it."""
    if annotation in (jax.Array, np.ndarray):
        return True
    if hasattr(annotation, "array_type") or hasattr(annotation, "dim_str"):
        return False  # jaxtyping's
    if typing.get_origin(annotation) in (dict, collections.abc.Mapping):
        return False
    return any(has_bare_array(inner) for inner in typing.get_args(annotation))


@pytest.mark.parametrize("module", PURE)
def test_shapes_are_in_the_signatures(module):
    for name, function in list_functions([module]).items():
        if name.startswith("ipjax_kernels.reference"):
            continue  # loops over whatever they are given; the kernels' signatures are theirs
        signature = inspect.signature(function)
        for parameter in signature.parameters.values():
            if parameter.name in ("self", "cls"):
                continue
            assert parameter.annotation is not inspect.Parameter.empty, f"{name}: {parameter.name} has no type"
            assert not has_bare_array(parameter.annotation), f"{name}: {parameter.name} is an array of no stated shape"
        assert signature.return_annotation is not inspect.Signature.empty, f"{name} does not say what it returns"
        assert not has_bare_array(signature.return_annotation), f"{name} returns an array of no stated shape"


def test_public_names_exist_and_are_told():
    for name in getattr(ipjax, "__all__", ()):
        value = getattr(ipjax, name)
        if callable(value) and not inspect.isclass(value):
            assert (value.__doc__ or "").strip(), name
            assert find_disorder(name, inspect.unwrap(value)) == []


def test_version_is_a_version():
    assert re.fullmatch(r"\d+\.\d+\.\d+([a-z]+\d+)?(\.dev\d+)?", ipjax.__version__)

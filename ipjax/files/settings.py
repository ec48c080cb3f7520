"""Configurations from presets, files and assignments such as ``match.views=4``, checked, and back to plain JSON."""

import dataclasses
import difflib
import json
import math
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx

from ipjax.config import PRESETS, Config
from ipjax.files.storage.parsing import read_json

ConfigT = TypeVar("ConfigT", bound=eqx.Module)
_INVALID = object()  # returned for a value that a field cannot hold
_YES, _NO = ("true", "yes", "on"), ("false", "no", "off")


def read_config(name: str | Path, changes: Iterable[str] = ()) -> Config:
    """``default``, ``fast``, ``paper``, or a JSON file of what differs from the default, for instance
    ``{"from": "paper", "match": {"views": 4}}``; then ``changes`` as `override` takes them.

    Raises ValueError, in a sentence, for a setting that does not exist or is of the wrong kind.
    """
    if str(name) in PRESETS:
        return override(changes, Config.named(str(name)))
    path = Path(name)
    if not path.is_file():
        raise ValueError(f"{name}: neither {', '.join(PRESETS)} nor a file of settings")
    entry = read_json(path, "file of settings")
    if not isinstance(entry, dict):
        raise ValueError(f'{path}: settings are a JSON object, like {{"match": {{"views": 4}}}}')
    start = entry.pop("from", "default")
    if start not in PRESETS:
        raise ValueError(f"{path}: 'from' is one of {', '.join(PRESETS)}, not {start!r}")
    return override(changes, _replace_fields(Config.named(start), entry, str(path)))


def override(changes: Iterable[str], config: ConfigT) -> ConfigT:
    """A configuration with some fields changed, each named by its path: ``match.views=4``, ``align.scale_gate=0.5,2``.

    Args:
        changes: ``FIELD=VALUE``; of two of the same field the last counts. ``true`` and ``false``, ``none`` where a
            field may be absent, ``inf``, and commas between the numbers of a list.
        config: any of the configurations.

    Raises:
        ValueError: there is no such field (the message names those that are spelled alike), or the value is of another
            kind (the message says which is expected).
    """
    for change in changes:
        name, equals, text = change.partition("=")
        name, text = name.strip(), text.strip()
        if not (name and equals and text):
            raise ValueError(f"{change!r}: give FIELD=VALUE, for instance {_example(config)}")
        config = _replace_field(config, name.split("."), name, text)
    return config


def list_fields(config: eqx.Module, *, before: str = "") -> Iterator[tuple[str, Any]]:
    """The path of every field of a configuration, such as ``match.views``, and its value."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, eqx.Module):
            yield from list_fields(value, before=f"{before}{field.name}.")
        else:
            yield f"{before}{field.name}", value


def describe_config(config: Any) -> Any:
    """A configuration as plain JSON; what is not finite as text."""
    if isinstance(config, eqx.Module):
        return {f.name: describe_config(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, tuple):
        return [describe_config(x) for x in config]
    return config if not isinstance(config, float) or math.isfinite(config) else str(config)


def _example(config: eqx.Module) -> str:
    names = dict(list_fields(config))
    name = "match.views" if "match.views" in names else next(iter(names))
    return f"{name}={names[name]}"


def _replace_field(config: Any, path: list[str], whole: str, text: str) -> Any:
    """The configuration with the field at the end of ``path`` replaced by what ``text`` says."""
    known = {field.name: field for field in dataclasses.fields(config)}
    if path[0] not in known:
        raise ValueError(_unknown(config, path, whole))
    old = getattr(config, path[0])
    if isinstance(old, eqx.Module):
        if len(path) == 1:
            raise ValueError(f"{whole} is a group of settings: name one of them, for instance {whole}.{_example(old)}")
        new = _replace_field(old, path[1:], whole, text)
    elif len(path) > 1:
        raise ValueError(f"{whole}: {whole.removesuffix('.' + '.'.join(path[1:]))} is one value, not a group")
    else:
        field = known[path[0]]
        new = _convert(_parse_value(text, field.type), field, old)
        if new is _INVALID:
            raise ValueError(
                f"{whole}: {_describe_kind(field, old)} is expected, for instance {_as_text(old)}, not {text!r}"
            )
    return dataclasses.replace(config, **{path[0]: new})


def _unknown(config: eqx.Module, path: list[str], whole: str) -> str:
    """The message for a field that does not exist, with those of similar names, in this group or another."""
    before = whole.removesuffix(".".join(path))
    groups = [f.name for f in dataclasses.fields(config) if isinstance(getattr(config, f.name), eqx.Module)]
    here = [name for name, _ in list_fields(config)]
    spelled = ".".join(path)
    near = [name for name in here if name.rpartition(".")[2] == path[-1]]  # the right name, without its group
    near += [name for name in difflib.get_close_matches(spelled, here, 4, 0.7) if name not in near]
    if not near and len(path) == 1:
        short = {name.rpartition(".")[2]: name for name in reversed(here)}
        near = [short[name] for name in difflib.get_close_matches(spelled, short, 3, 0.7)]
        near += difflib.get_close_matches(spelled, groups, 1, 0.7)
    if not near:
        near = [f.name for f in dataclasses.fields(config)]
        return f"there is no setting {whole!r}; there are {', '.join(before + name for name in near)}"
    return f"there is no setting {whole!r}; near it: {', '.join(before + name for name in near)}"


def _parse_value(text: str, hint: Any) -> Any:
    """The value that a text stands for, or the text itself where it cannot be parsed as this type."""
    kinds = _kinds(hint)
    if type(None) in kinds and text.lower() == "none":
        return None
    if bool in kinds and text.lower() in (*_YES, *_NO):
        return text.lower() in _YES
    if any(typing.get_origin(kind) is tuple for kind in kinds):
        return [_parse_value(part.strip(), float) for part in text.strip("[]()").split(",")]
    for kind in (int, float):
        if kind in kinds:
            try:
                return kind(text)
            except ValueError:
                continue
    return text


def _replace_fields(config: Any, entry: Mapping[str, Any], where: str) -> Any:
    """The configuration with the fields of a JSON object replaced; ``where`` begins messages."""
    known = {field.name: field for field in dataclasses.fields(config)}
    changed = {}
    for name, value in entry.items():
        if name not in known:
            raise ValueError(f"{where}: no setting {name!r}; there are {', '.join(sorted(known))}")
        old = getattr(config, name)
        if isinstance(old, eqx.Module):
            if not isinstance(value, Mapping):
                raise ValueError(f"{where}: {name} holds settings of its own")
            changed[name] = _replace_fields(old, value, f"{where}, {name}")
        else:
            changed[name] = _convert(value, known[name], old)
            if changed[name] is _INVALID:
                raise ValueError(
                    f"{where}: {name} is {_as_text(old)} by default; {json.dumps(value)} is of another kind: "
                    f"{_describe_kind(known[name], old)} is expected"
                )
    return dataclasses.replace(config, **changed)


def _kinds(hint: Any) -> tuple[Any, ...]:
    """What a field may be: the members of a union, or the one type it has."""
    return typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)


def _number(value: Any) -> float | None:
    """A number, finite or not, or "inf" and "-inf" as `describe_config` writes them; None for anything else."""
    if value in ("inf", "-inf"):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if abs(value) < 1e300 or value in (math.inf, -math.inf) else None


def _convert(value: Any, field: dataclasses.Field, old: Any) -> Any:
    """The value in the type of this field, or `_INVALID`."""
    for kind in _kinds(field.type):
        if typing.get_origin(kind) is tuple:
            numbers = [_number(x) for x in value] if isinstance(value, list) else [None]
            if len(numbers) == len(old) and None not in numbers:
                return tuple(numbers)
        elif typing.get_origin(kind) is typing.Literal:
            if value in typing.get_args(kind):
                return value
        elif kind is float:
            if (number := _number(value)) is not None:
                return number
        elif kind is int:
            if isinstance(value, int) and not isinstance(value, bool) and value >= _least(field):
                return value
        elif type(value) is kind:
            return value
    return _INVALID


def _as_text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple | list) else repr(value)


def _least(field: dataclasses.Field) -> int:
    """The smallest whole number that the field takes."""
    return field.metadata.get("least", 0)


def _describe_kind(field: dataclasses.Field, old: Any) -> str:
    """What a field holds, in words."""
    names = {bool: "true or false", int: f"a whole number from {_least(field)}", float: "a number", type(None): "none"}
    kinds = []
    for kind in _kinds(field.type):
        if typing.get_origin(kind) is tuple:
            kinds.append(f"a list of {len(old)} numbers")
        elif typing.get_origin(kind) is typing.Literal:
            kinds.append(" or ".join(map(repr, typing.get_args(kind))))
        else:
            kinds.append(names[kind])
    return " or ".join(kinds)

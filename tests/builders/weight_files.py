"""Files of weights: tiny models, and files written byte by byte."""

import struct
import zipfile
from pathlib import Path

import jax
import numpy as np
from flax import nnx

from ipjax.files.weights.parameters import official_shapes
from ipjax.networks.dinov2 import DinoV2Config

TINY = DinoV2Config(width=12, depth=2, heads=2, hidden=16, grid=3)


def random_tensors(config: DinoV2Config, seed: int = 0) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    return {name: draw.normal(size=shape).astype(np.float32) for name, shape in official_shapes(config).items()}


def same(first, second) -> bool:
    leaves, others = jax.tree.leaves(nnx.state(first)), jax.tree.leaves(nnx.state(second))
    return len(leaves) == len(others) and all(np.array_equal(a, b) for a, b in zip(leaves, others, strict=True))


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

"""Trim the full TripoSR goldens to what is committed here: python tests/golden/make_triposr.py FULL_FOLDER

The full files were made by running the official code (https://github.com/VAST-AI-Research/TripoSR, commit d26e331, CPU,
PyTorch 2.13.0, transformers 4.35.0, float32, one thread) on seeded random weights and pictures of ours, in a tiny
configuration: photos of 128 pixels, ViT of width 24 with 2 layers and 3 heads, planes of 8, backbone of width 32 with
2 layers and 2 heads, norms of 8 groups, 10 channels to a plane, decoder of 3 layers of 16. They hold all weights by
official name (``w/…``) and every array on the way; no trained weight is in them.

Kept here: the weights, the pictures, and of what comes out a part that a wrong port could not meet by chance: every
eighth token of the backbone (its last axis but one, or the last where channels come first), every third of the ViT, the
first photo's mesh, 40 query points of each kind, every second point of the grid, every fourth pixel of large pictures.
Vertices and colours are rounded to 16 and 8 bits (1.3e-5 of the cube, 1/510), and of the three bit-exact crops the
SHA-256 is kept. `CUTS` says how an array was cut, so that a test cuts ours alike.
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np

RADIUS = 0.87
EIGHTH = ("bb/", "tok/tokens_in", "pp/triplane_detokenized")
THIRD = ("vit/patch_embeddings", "vit/embeddings", "vit/layer", "vit/last_hidden_state", "tok/image_tokens_BNvCNt")
PIXELS = ("in/rgb_cond", "pre/model_input_128", "vit/pixel_values_normalized")
WHOLE = (
    "w/",
    "pre/rgba_in",
    "pre/composite_u8",
    "pre/resize_aa",
    "in/image1_u8",
    "vit/pos_embed",
    "posembed14to32/",
    "scene_codes",
    "grid32/first_points",
    "render",
    "rays_",
)


def cut(name: str, array: np.ndarray) -> np.ndarray:
    """What is kept of one of the official arrays, ours or theirs."""
    if name.startswith(PIXELS):
        first = name.startswith("vit/")  # channels first
        return array[:, :, ::4, ::4] if first else array[:, ::4, ::4]
    if name == "pp/triplane_detokenized":
        return array[..., ::4, ::2]
    if name.startswith(EIGHTH):
        last = name in ("tok/tokens_in", "bb/groupnorm", "bb/tokens_out")  # tokens last
        return array[..., ::8] if last else array[:, ::8]
    if name.startswith(THIRD):
        return array[..., ::3] if name.startswith("tok/") else array[:, ::3]
    if name == "grid32/density_act":
        return array[:, ::2, ::2, ::2]
    return array


def digest(array: np.ndarray) -> str:
    """Of its shape and its bytes."""
    return hashlib.sha256(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes()).hexdigest()


def pack(vertices: np.ndarray) -> np.ndarray:
    """Coordinates in the cube as 16 bits."""
    return np.rint((vertices / RADIUS + 1) / 2 * 65535).astype(np.uint16)


def unpack(vertices: np.ndarray) -> np.ndarray:
    """What `pack` packed."""
    return (vertices / 65535 * 2 - 1) * RADIUS


def main(full: Path) -> None:
    """Write triposr_tiny.npz, triposr_surface.npz and triposr_published.json."""
    here = Path(__file__).parent
    with np.load(full / "golden_tiny.npz") as arrays:
        names = arrays.files
        kept = {n: cut(n, arrays[n]) for n in names if n.startswith((*WHOLE, *PIXELS, *EIGHTH, *THIRD, "grid32/"))}
        kind = arrays["query/kind"]
        few = np.sort(np.concatenate([np.flatnonzero(kind == k)[:40] for k in range(5)]))
        kept |= {n: arrays[n][few] if n in ("query/points", "query/kind") else arrays[n][:, few] for n in names
                 if n.startswith("query/")}  # fmt: skip
        kept["mesh0/vertices_u16"] = pack(arrays["mesh0/vertices"])
        kept["mesh0/colour_u8"] = np.rint(255 * arrays["mesh0/vertex_color_float"]).astype(np.uint8)
        for part in ("085", "05", "10"):
            kept[f"pre/resize_foreground_{part}_sha256"] = np.array(digest(arrays[f"pre/resize_foreground_{part}"]))
    np.savez_compressed(here / "triposr_tiny.npz", **kept)
    with np.load(full / "golden_marching_cubes.npz") as arrays:
        surface = {"vertices_u16": pack(arrays["mc/trimesh_vertices"]), "faces": np.array(len(arrays["mc/faces"]))}
    np.savez_compressed(here / "triposr_surface.npz", **surface)
    published = json.loads((full / "state_dict_published.json").read_text())
    shapes = {name: entry["shape"] for name, entry in published["state_dict"].items()}
    config = json.loads((full / "config_published.json").read_text())
    lines = ",\n".join(f"{json.dumps(n)}: {json.dumps(s)}" for n, s in shapes.items())
    told = {"num_params": published["num_params"], "config": config["values"], "vit": config["vit"]["values"]}
    told["code_defaults"] = config["code_defaults_not_in_file"]
    (here / "triposr_published.json").write_text(
        json.dumps(told, indent=1)[:-2] + ',\n "state_dict": {\n' + lines + "\n}\n}\n"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))

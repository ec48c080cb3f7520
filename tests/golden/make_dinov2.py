"""Trim the full DINOv2 goldens to what is committed here: python tests/golden/make_dinov2.py FULL_FOLDER

The full files were made by running the official code (https://github.com/facebookresearch/dinov2, commit b8931f7,
CPU, PyTorch 2.13.0, float32) on seeded random weights: embed 48, depth 3, 3 heads, patch 14, native grid 5 × 5. They
hold, by official name, the weights (``w/…``) and, for each image size (height × width), the normalised input and what
``get_intermediate_layers`` returned for each block, normed and raw. Kept here: one image of the two, the first blocks;
of one square and one tall size all patches, of the other sizes (``dinov2_sizes.npz``, whose images all variants share)
every third patch of the last of these blocks. Position embeddings are resized channel by channel, so two channels
stand for all, and one for the other grids.
"""

import sys
from pathlib import Path

import numpy as np

BLOCKS = {"plain": 2, "registers": 1, "swiglu": 1}
SIZES = ("square56x56", "tall84x42")
ARRAYS = ("image_nchw", "pos_embed", "norm_patch", "norm_cls", "raw_patch")
GRIDS = ("16x16", "32x32", "37x28", "60x60")
OTHER_SIZES = ("native70x70", "square98x98", "wide42x112")
OTHER_GRIDS = ("30x30", "46x46", "28x37", "74x74")


def keep(name: str, blocks: int) -> bool:
    """Whether an array of the full file stays."""
    group, _, rest = name.partition("/")
    if group == "w":
        return not rest.startswith("blocks.") or int(rest.split(".")[1]) < blocks
    if group not in SIZES or not rest.endswith(ARRAYS):
        return False
    return not rest.startswith("block") or int(rest.removeprefix("block").split("_")[0]) < blocks


def main(full: Path) -> None:
    here = Path(__file__).parent
    sizes: dict[str, np.ndarray] = {}
    for variant, blocks in BLOCKS.items():
        with np.load(full / f"dinov2_{variant}.npz") as arrays:
            kept = {k: arrays[k] if k.startswith("w/") else arrays[k][:1] for k in arrays if keep(k, blocks)}
            for size in OTHER_SIZES:
                sizes[f"{size}/image_nchw"] = arrays[f"{size}/image_nchw"][:1]
                for name in (f"block{blocks - 1}_norm_patch", f"block{blocks - 1}_raw_patch"):
                    sizes[f"{variant}/{size}/{name}"] = arrays[f"{size}/{name}"][:1, ::3]
        np.savez_compressed(here / f"dinov2_{variant}.npz", **kept)
    np.savez_compressed(here / "dinov2_sizes.npz", **sizes)
    with np.load(full / "dinov2_pos_embed.npz") as arrays:
        names = [k for k in arrays if k.endswith(("pos_embed_37x37", *GRIDS))]
        kept = {k: arrays[k][..., :2] for k in names}
        kept |= {k: arrays[k][..., :1] for k in arrays if k.endswith(OTHER_GRIDS)}
        np.savez_compressed(here / "dinov2_pos_embed.npz", **kept)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

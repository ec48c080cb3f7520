"""Tiny configurations of DINOv2, one for each kind of checkpoint."""

from ipjax.networks.dinov2 import DinoV2Config

VARIANTS = {
    "plain": {},
    "registers": {"registers": 4, "antialias": True, "offset": 0.0},
    "swiglu": {"swiglu": True, "hidden": 128},
}


def tiny(variant: str, depth: int = 3, **others) -> DinoV2Config:
    """The configuration of a variant, with other fields on request."""
    shape = {"width": 48, "depth": depth, "heads": 3, "hidden": 192, "grid": 5, **VARIANTS[variant], **others}
    return DinoV2Config(**shape)

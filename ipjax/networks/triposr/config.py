"""The sizes of the network; the defaults are the published model's."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class VisionConfig:
    """The image tokenizer; the defaults are facebook/dino-vitb16."""

    width: int = 768
    layers: int = 12
    heads: int = 12
    hidden: int = 3072
    patch: int = 16  # pixels
    grid: int = 14  # stored positions per side
    epsilon: float = 1e-12


@dataclass(frozen=True)
class TripoSRConfig:
    """The network; the defaults are the published size (419 275 628 parameters)."""

    vision: VisionConfig = field(default_factory=VisionConfig)
    image_size: int = 512  # pixels; what the photo is resized to
    plane_size: int = 32  # tokens per side of a plane
    width: int = 1024
    layers: int = 16
    heads: int = 16
    groups: int = 32  # of the group norm at the backbone's entry
    plane_channels: int = 40  # after up-sampling
    decoder_width: int = 64
    decoder_layers: int = 9  # hidden ones
    radius: float = 0.87  # half side of the cube, mesh units
    density_bias: float = -1.0
    samples: int = 128  # per ray
    threshold: float = 25.0  # density of the surface
    dtype: str = "float32"  # of the weights and of the products' inputs; "bfloat16" halves the memory

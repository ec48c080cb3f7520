"""The encoder that made some object files, found by the identity in them."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipjax.files.weights.encoder import load_encoder
from ipjax.files.weights.finding import find_by_hash
from ipjax.files.weights.local import list_weights


def load_matching_encoder(
    paths: Sequence[str | Path], identities: Sequence[str], weights: str | Path | None = None
) -> Any:
    """The encoder that made the objects; what does not fit is refused before it is built.

    Args:
        paths: the object files, for the messages.
        identities: of the encoders that made them (``ObjectInfo.encoder``).
        weights: a name or a file; None: found by the checksum in the identity.

    Raises:
        ValueError: they were made by different encoders, or by one that is not here; the message names the object file.
    """
    wanted = identities[0]
    for path, identity in zip(paths, identities, strict=True):
        if identity != wanted:
            raise ValueError(
                f"{path}: made with the encoder '{identity}', but {paths[0]} with '{wanted}'; onboard one of them again"
            )
    options: dict[str, Any] = {"dtype": "bfloat16" if " bfloat16 " in wanted else "float32"}
    if block := re.search(r"\bblock=(\d+)\b", wanted):
        options["block"] = int(block[1])
    checksum = re.search(r"\bsha256:([0-9a-f]{64})\b", wanted)
    if weights is None and checksum is not None:
        weights = find_by_hash(checksum[1])
        if weights is None:
            here = ", ".join(row.name for row in list_weights() if row.path is not None)
            raise ValueError(
                f"{paths[0]}: made with the encoder '{wanted}', whose weights are not here "
                f"({f'here are: {here}' if here else 'none are: see ipjax weights fetch --help'}); onboard the object "
                "again, or give the weights it was made with"
            )
    encoder = load_encoder(weights, **options)
    if encoder.identity != wanted:
        raise ValueError(
            f"{paths[0]}: made with the encoder '{wanted}', but the one at hand is '{encoder.identity}'; "
            "onboard the object again, or give the weights it was made with"
        )
    return encoder

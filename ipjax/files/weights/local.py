"""Weights that are here, in the cache or in an installed package, compared with what was published."""

import dataclasses
import importlib.metadata
from pathlib import Path

from ipjax.files.storage.cache import cache_folder
from ipjax.files.weights.catalogue import CATALOGUE, Source, WeightsError
from ipjax.files.weights.hashes import cached_hash


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


def checksum_path(path: Path) -> Path:
    """Where the checksum of weights without a published one is recorded at their first download: next to them."""
    return path.with_name(path.name + ".sha256")


def check_published(path: Path, source: Source, how: str) -> Resolved:
    """Compare a file's sum with the published one, else with the one recorded at its first download."""
    found, expected = cached_hash(path), source.sha256
    if expected is None and checksum_path(path).is_file():
        expected = checksum_path(path).read_text().split()[0]
    if expected is not None and found != expected:
        raise WeightsError(
            f"{path} is not the file that was published as {source.name}: its sha256 is {found}, expected {expected}; "
            "remove it and fetch it again"
        )
    return Resolved(path, how, source.name, source.preset, found, source.sha256 is not None)


def find_installed(source: Source) -> Path | None:
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


def find_cached(source: Source) -> Resolved | None:
    """The file in the cache, compared with what was published; None where there is none."""
    cached = cache_folder("weights") / source.file
    return check_published(cached, source, "cache") if cached.is_file() else None


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
        where, origin = (cached, "cache") if cached.is_file() else (find_installed(source), "package")
        rows.append(
            Listing(source.name, source.preset, where, origin if where else "none", source.licence, bool(source.sha256))
        )
    return rows

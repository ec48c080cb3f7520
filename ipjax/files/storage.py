"""Files: one parser of JSON, one of YAML, one budget of memory for a file that is read; one writer whose files appear
whole or not at all, and one lock between processes.

What a file takes is estimated from its first bytes or its text before anything is allocated, for a file of a few bytes
can promise gigabytes.
"""

import contextlib
import errno
import json
import os
import re
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_MB = 2**20
_DEFAULT_BUDGET = 640 * _MB
_YAML_NODES = 50_000  # PyYAML keeps about a kilobyte for each of them while it reads
_HEADER = 8 * _MB  # of description in a safetensors file; a thousand tensors take 0.1 MB
_DEPTH = 64  # levels of nesting; NumPy has no more axes either


def budget() -> int:
    """Bytes of memory that one file may take: 640 MB, or the environment's IPJAX_FILE_BUDGET in MB.

    Raises:
        ValueError: IPJAX_FILE_BUDGET is no positive number.
    """
    given = os.environ.get("IPJAX_FILE_BUDGET", "").strip()
    if not given:
        return _DEFAULT_BUDGET
    if not given.isdigit() or int(given) == 0:
        raise ValueError(f"IPJAX_FILE_BUDGET is a whole number of MB, not {given!r}")
    return int(given) * _MB


def check_budget(needed: int, what: str) -> None:
    """Refuse what would take more memory than one file may.

    Args:
        needed: bytes, estimated before they are allocated.
        what: begins the sentence, such as "mug.png: an image of 60000 × 60000 pixels".

    Raises:
        ValueError: too much; names the budget and how to raise it.
    """
    allowed = budget()
    if needed > allowed:
        raise ValueError(
            f"{what} would take {-(-needed // _MB):,} MB of memory, more than the {allowed // _MB:,} MB allowed for "
            "one file; reduce it, or set IPJAX_FILE_BUDGET (MB) if you trust it"
        )


def check_tensors(path: str | Path, needed: int) -> None:
    """Refuse tensors that would take more memory than their file could fill: many of them may lie in one place of it.

    Files of weights may be larger than the budget of other files; what they say is true takes at most their own size,
    and twice where two names share a tensor.

    Args:
        needed: bytes of all tensors.

    Raises:
        ValueError: too much; names the file.
    """
    size = Path(path).stat().st_size
    if needed > 2 * size + _MB:
        raise ValueError(
            f"{path}: its tensors would take {-(-needed // _MB):,} MB of memory, but the file has only "
            f"{-(-size // _MB):,} MB"
        )


def read_safetensors_header(path: str | Path) -> int:
    """The length of the description at the head of a safetensors file, bytes, before anything parses it.

    Raises:
        ValueError: a length that the file has not, or that no honest file needs; does not name the file.
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
    if length > min(_HEADER, max(Path(path).stat().st_size - 8, 0)):
        raise ValueError(f"it would begin with {length:,} bytes of description")
    return length


def read_text(path: str | Path, what: str = "file") -> str:
    """The text of a UTF-8 file, with or without a byte order mark.

    Raises:
        ValueError: missing, unreadable, no text, or past the budget; names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such {what}")
    try:
        check_budget(2 * path.stat().st_size, f"{path}: its text")
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None


def parse_json(text: str | bytes) -> Any:
    """What a JSON text holds.

    Raises:
        ValueError: not JSON (with the line), nested too deeply, or past the budget.
    """
    if isinstance(text, bytes):
        try:
            text = text.decode("utf-8-sig")
        except UnicodeDecodeError:
            raise ValueError("not valid JSON: it is not UTF-8") from None
    # Bytes that CPython takes for a list, a dictionary, and a member with the number or the string that it is.
    needed = 2 * len(text) + 88 * text.count("[") + 232 * text.count("{") + 48 * text.count(",")
    check_budget(needed, "JSON of this size")
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"not valid JSON: line {error.lineno}, column {error.colno}: {error.msg}") from None
    except RecursionError:
        raise ValueError("not valid JSON: it is nested too deeply") from None
    except ValueError as error:  # a number of thousands of digits
        raise ValueError(f"not valid JSON: {_first_line(error)}") from None


def read_json(path: str | Path, what: str = "file") -> Any:
    """What a JSON file holds.

    Raises:
        ValueError: as `read_text` and `parse_json`; names the file.
    """
    text = read_text(path, what)
    try:
        return parse_json(text)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def parse_yaml(text: str) -> Any:
    """The first document of a YAML text, with plain types only: nothing in it can construct an object.

    OpenCV's header (``%YAML:1.0``) and its matrices (``!!opencv-matrix``: a dictionary of rows, cols, dt, data) are
    read too. Any other tag that YAML itself does not know is refused, as are documents that aliases blow up.

    Raises:
        ValueError: not YAML (with the line), nested too deeply, or too large.
    """
    import yaml

    text = re.sub(r"\A\s*%YAML:\d+\.\d+[^\n]*\n?", "", text)
    try:
        loader = _yaml_loader()(text)
        try:
            return loader.get_data() if loader.check_data() else None
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
        raise ValueError(f"not valid YAML: {where}{_first_line(error.problem or error.context or '')}") from None
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML: {_first_line(error)}") from None
    except RecursionError:
        raise ValueError("not valid YAML: it is nested too deeply") from None
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:  # of a malformed scalar or tag
        raise ValueError(f"not valid YAML: {_first_line(error)}") from None


def parse(text: str) -> Any:
    """JSON where the text begins like it, else YAML; see `parse_json` and `parse_yaml`."""
    if text.lstrip()[:1] not in ("{", "["):
        return parse_yaml(text)
    try:
        return parse_json(text)
    except ValueError as error:
        if len(text) > _MB:
            raise
        try:
            return parse_yaml(text)  # whose flow style begins like JSON, with names that are not quoted
        except ValueError:
            raise error from None


def _first_line(said: object) -> str:
    return (str(said).strip().splitlines() or ["unreadable"])[0]


def _yaml_loader() -> type:
    import yaml

    class Loader(yaml.SafeLoader):
        """The safe loader, with a budget of nodes in which an alias counts as much as what it stands for."""

        def __init__(self, stream):
            super().__init__(stream)
            self.count = 0
            self.depth = 0
            self.counted: dict[int, int] = {}

        def compose_node(self, parent, index):
            if self.check_event(yaml.AliasEvent):
                mark = self.peek_event().start_mark
                node = super().compose_node(parent, index)
                if id(node) not in self.counted:
                    raise yaml.MarkedYAMLError(None, None, "an alias stands inside what it names", mark)
                self.count += self.counted[id(node)]
                self._check(mark)
                return node
            mark = self.peek_event().start_mark
            before = self.count
            self.count += 1
            self.depth += 1
            self._check(mark)
            node = super().compose_node(parent, index)
            self.depth -= 1
            self.counted[id(node)] = self.count - before
            return node

        def _check(self, mark):
            if self.depth > _DEPTH:
                raise yaml.MarkedYAMLError(None, None, "it is nested too deeply", mark)
            if self.count > _YAML_NODES:
                said = f"more than {_YAML_NODES:,} values, aliases counted as what they stand for"
                raise yaml.MarkedYAMLError(None, None, said, mark)

    # YAML 1.1 takes 1e-3 for a word; whoever writes it means a number.
    number = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+\Z")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, list("-+0123456789."))
    for kind in ("opencv-matrix", "opencv-nd-matrix"):
        Loader.add_constructor(f"tag:yaml.org,2002:{kind}", _construct_matrix)
    return Loader


def _construct_matrix(loader: Any, node: Any) -> dict[str, Any]:
    return loader.construct_mapping(node, deep=True)


# --- writing ----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def writing(path: str | Path, *, parents: bool = False) -> Iterator[Path]:
    """Write a file that appears whole or not at all, also after a crash and whoever else writes it.

    Yields a name of its own in the same folder, with the same ending, where an empty file lies. When the block ends,
    what was written there is flushed to disc and gets the name ``path``; when the block fails, it is removed.

    Args:
        path: an existing file is replaced.
        parents: make the folder, too, if it is missing.

    Raises:
        OSError: it cannot be written; the error names ``path``.
    """
    path = Path(path)
    if parents:
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem[:48]}.{secrets.token_hex(6)}.part{path.suffix[:16]}")
    try:
        # Opened by hand so that the system's umask decides who may read the file, as for any other.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from None
    try:
        yield temporary
        publish(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def publish(temporary: str | Path, path: str | Path) -> None:
    """Flush a finished file to disc and give it its name, replacing what had it; both lie in the same folder.

    Raises:
        OSError: it cannot be done.
    """
    with open(temporary, "rb+") as file:
        os.fsync(file.fileno())
    try:
        os.replace(temporary, path)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from None
    with contextlib.suppress(OSError):  # the name, too; not every system lets a folder be flushed
        folder = os.open(Path(path).parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_bytes(path: str | Path, data: bytes, *, parents: bool = False) -> Path:
    """Write a file through `writing`; returns its path. Raises OSError."""
    with writing(path, parents=parents) as temporary:
        temporary.write_bytes(data)
    return Path(path)


def write_text(path: str | Path, text: str, *, parents: bool = False) -> Path:
    """Write UTF-8 text through `writing`, line ends as they are; returns its path. Raises OSError."""
    return write_bytes(path, text.encode("utf-8"), parents=parents)


# --- one at a time ----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def locked(path: str | Path, *, wait: bool = True) -> Iterator[None]:
    """Hold the lock file ``path`` while the block runs: one process, or thread, at a time.

    The lock is the operating system's, so it ends with the process that holds it, however that ends; the file itself
    is removed by the last holder and means nothing. Where the file system knows no locks, there is none.

    Args:
        wait: for as long as another holds it; else BlockingIOError.
    """
    path = Path(path)
    while True:
        handle = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        try:
            _take(handle, wait)
            # Whoever held it before may have removed the file while we waited: then the name belongs to another.
            held = _is_same(handle, path)
        except BaseException:
            os.close(handle)
            raise
        if held:
            break
        os.close(handle)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows does not remove open files
            path.unlink()
        os.close(handle)


def _take(handle: int, wait: bool) -> None:
    try:
        import fcntl
    except ImportError:
        return _take_on_windows(handle, wait)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL):
            raise


def _take_on_windows(handle: int, wait: bool) -> None:
    import msvcrt  # pyright: ignore
    import time

    while True:
        try:
            return msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # pyright: ignore
        except OSError:
            if not wait:
                raise BlockingIOError(errno.EWOULDBLOCK, "another process holds the lock") from None
            time.sleep(0.1)


def _is_same(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False

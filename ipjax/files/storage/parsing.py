"""JSON and YAML: no text can construct an object, recurse without end or take more memory than its budget."""

import gzip
import json
import re
import zlib
from pathlib import Path
from typing import Any

from ipjax.files.storage.budget import budget, check_budget

_MAX_YAML_FROM_BRACE = 2**20  # characters; PyYAML takes seconds for more
_MAX_YAML_NODES = 50_000  # PyYAML keeps about a kilobyte for each of them while it reads
_MAX_DEPTH = 64  # levels of nesting; NumPy has no more axes either


def read_text(path: str | Path, what: str = "file") -> str:
    """The text of a UTF-8 file, with or without a byte order mark; unpacked where its name ends in .gz.

    Raises:
        ValueError: missing, unreadable, no text, or past the budget; names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such {what}")
    try:
        if path.suffix.lower() == ".gz":
            return _unpack(path).decode("utf-8-sig")
        check_budget(2 * path.stat().st_size, f"{path}: its text")
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file") from None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ValueError(f"{path}: not a readable gzip file ({_first_line(error)})") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None


def _unpack(path: Path) -> bytes:
    """What a gzip file holds; what unpacks to more than the budget is refused where it passes it."""
    with gzip.open(path) as file:
        data = file.read(budget() // 2 + 1)
    check_budget(2 * len(data), f"{path}: its text")
    return data


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
        if len(text) > _MAX_YAML_FROM_BRACE:
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
            if self.depth > _MAX_DEPTH:
                raise yaml.MarkedYAMLError(None, None, "it is nested too deeply", mark)
            if self.count > _MAX_YAML_NODES:
                said = f"more than {_MAX_YAML_NODES:,} values, aliases counted as what they stand for"
                raise yaml.MarkedYAMLError(None, None, said, mark)

    # YAML 1.1 takes 1e-3 for a word; in the files that are read here it is a number.
    number = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+\Z")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, list("-+0123456789."))
    for kind in ("opencv-matrix", "opencv-nd-matrix"):
        Loader.add_constructor(f"tag:yaml.org,2002:{kind}", _construct_matrix)
    return Loader


def _construct_matrix(loader: Any, node: Any) -> dict[str, Any]:
    return loader.construct_mapping(node, deep=True)

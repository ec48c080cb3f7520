"""The header and the rows of PLY files, ASCII and binary of either byte order."""

import dataclasses
from collections.abc import Iterator

import numpy as np

KINDS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("int64", "long"), "i8"),
    **dict.fromkeys(("uint64", "ulong"), "u8"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
BLOCK = 1 << 23  # bytes of text that are split at a time


@dataclasses.dataclass
class Property:
    """One property of an element: its type, and that of its length where it is a list."""

    name: str
    kind: str
    length: str | None = None


@dataclasses.dataclass
class Element:
    """One kind of row: its name, how many there are, and its properties."""

    name: str
    count: int
    properties: list[Property]


# Rows of one element that have lists of the same lengths: their numbers, and columns by name (lists are [rows k]).
Group = tuple[np.ndarray, dict[str, np.ndarray]]


def read_header(data: bytes, size: int) -> tuple[str | None, list[Element], list[str], int]:
    """Byte order (None = text), elements, names of textures, and where the rows begin."""
    head = data[:65536]
    end = head.find(b"end_header")
    if not head.startswith(b"ply") or end < 0:
        raise ValueError("has no PLY header")
    start = end + len(b"end_header")
    start += 2 if data[start : start + 2] == b"\r\n" else 1
    order: str | None = ""
    elements: list[Element] = []
    images = []
    for line in head[:end].decode("utf-8", "replace").replace("\r", "\n").split("\n"):
        words = line.split()
        if not words:
            continue
        if words[0] == "format" and len(words) > 1:
            names = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
            if words[1] not in names:
                raise ValueError(f"has the PLY format {words[1][:40]}, which is not one")
            order = names[words[1]]
        elif words[0] == "element" and len(words) == 3:
            count = int(words[2]) if words[2].isdigit() and len(words[2]) < 16 else -1
            # A row takes two bytes at least, in text as in binary; one without properties takes none.
            if count < 0 or 2 * count > size:
                raise ValueError(f"promises {words[2][:40]} of {words[1][:40]} in {size} bytes")
            elements.append(Element(words[1], count, []))
        elif words[0] == "property" and elements:
            if words[1:2] == ["list"] and len(words) == 5 and words[2] in KINDS and words[3] in KINDS:
                if KINDS[words[2]][0] == "f":
                    raise ValueError("has a PLY list whose length is no whole number")
                elements[-1].properties.append(Property(words[4], KINDS[words[3]], KINDS[words[2]]))
            elif len(words) == 3 and words[1] in KINDS:
                elements[-1].properties.append(Property(words[2], KINDS[words[1]]))
            else:
                raise ValueError(f"has a PLY property that is not understood: {line.strip()[:80]}")
        elif (
            words[0] in ("comment", "obj_info")
            and len(words) > 2
            and words[1].lower() in ("texturefile", "texture_file")
        ):
            images.append(line.strip().split(None, 2)[2])
    if order == "":
        raise ValueError("has a PLY header without a format")
    if sum(len(element.properties) for element in elements) > 4096:
        raise ValueError("has a PLY header of thousands of properties")
    return order, elements, images, start


def iterate_lines(data: bytes, start: int) -> Iterator[bytes]:
    """Lines that are not blank, split a block at a time."""
    while start < len(data):
        stop = min(start + BLOCK, len(data))
        if stop < len(data):
            cut = max(data.rfind(b"\n", start, stop), data.rfind(b"\r", start, stop))
            stop = cut + 1 if cut >= start else stop
            if cut < start:
                raise ValueError("has a line of more than eight million characters")
        for line in data[start:stop].split(b"\n" if b"\n" in data[start:stop] else b"\r"):
            if line and not line.isspace():
                yield line
        start = stop


def read_text_rows(rows: Iterator[bytes], element: Element, wanted: bool) -> Iterator[Group]:
    """Rows of text, grouped by how long they and their lists are."""
    done = 0
    pieces: dict[tuple[int, ...], list[Group]] = {}
    while done < element.count:
        by_width: dict[int, tuple[list[int], list[list[bytes]]]] = {}
        for number in range(done, min(done + 100_000, element.count)):
            line = next(rows, None)
            if line is None:
                raise ValueError(f"ends after {number} of {element.count} rows of {element.name}")
            if wanted:
                words = line.split()
                numbers, lines = by_width.setdefault(len(words), ([], []))
                numbers.append(number)
                lines.append(words)
        for numbers, lines in by_width.values():
            try:
                table = np.array(lines).astype(np.float64)
            except ValueError:
                raise ValueError(f"has rows of {element.name} that are not numbers") from None
            for lengths, group in split_rows(np.array(numbers), table, element):
                pieces.setdefault(lengths, []).append(group)
        done += 100_000
    for groups in pieces.values():
        names = groups[0][1].keys()
        yield (
            np.concatenate([numbers for numbers, _ in groups]),
            {name: np.concatenate([columns[name] for _, columns in groups]) for name in names},
        )


def split_rows(numbers: np.ndarray, table: np.ndarray, element: Element) -> Iterator[tuple[tuple[int, ...], Group]]:
    """Rows of as many words, taken apart by their lists' lengths."""
    waiting: list[tuple[np.ndarray, np.ndarray, int, int, tuple[int, ...], dict[str, np.ndarray]]]
    waiting = [(numbers, table, 0, 0, (), {})]
    while waiting:
        numbers, table, at, index, lengths, columns = waiting.pop()
        while index < len(element.properties) and element.properties[index].length is None:
            if at >= table.shape[1]:
                raise ValueError(f"has rows of {element.name} that are too short")
            item = element.properties[index]
            columns[item.name] = cast(table[:, at], item.kind)
            at, index = at + 1, index + 1
        if index == len(element.properties):
            yield lengths, (numbers, columns)
            continue
        if at >= table.shape[1]:
            raise ValueError(f"has rows of {element.name} that are too short")
        item = element.properties[index]
        for length in np.unique(table[:, at]):
            if not (0 <= length <= table.shape[1] - at - 1):
                raise ValueError(f"has a list of {length:.0f} in a row of {table.shape[1]} words")
            mine = table[:, at] == length
            stop = at + 1 + int(length)
            part = table[mine, at + 1 : stop]
            found = {name: value[mine] for name, value in columns.items()}
            found[item.name] = cast(part, item.kind)
            waiting.append((numbers[mine], table[mine], stop, index + 1, (*lengths, int(length)), found))


def cast(values: np.ndarray, kind: str) -> np.ndarray:
    """Numbers of a text in their property's type; what is out of its range is at its end."""
    if kind[0] == "f":
        return values
    limits = np.iinfo(kind)
    return np.clip(np.nan_to_num(values), float(limits.min), float(limits.max)).astype(
        kind if limits.max < 2**53 else np.int64
    )


def read_binary_rows(data: bytes, start: int, order: str, element: Element, wanted: bool) -> tuple[list[Group], int]:
    """Binary rows grouped by how long their lists are, and where the next element begins."""
    if not element.properties or element.count == 0:
        return [], start
    lists = [item for item in element.properties if item.length is not None]
    groups = []
    if not lists:
        layout = row_layout(element, (), order)
        stop = start + layout.itemsize * element.count
        if stop > len(data):
            raise ValueError(f"ends before its {element.count} rows of {element.name} do")
        if wanted:
            rows = np.frombuffer(data, layout, element.count, start)
            groups = [(np.arange(element.count), {item.name: rows[item.name] for item in element.properties})]
        return groups, stop
    # The usual case first: all rows alike.
    lengths = measure_row(data, start, order, element)
    layout = row_layout(element, lengths, order)
    stop = start + layout.itemsize * element.count
    if stop <= len(data):
        rows = np.frombuffer(data, layout, element.count, start)
        if all((rows[f"{item.name} length"] == n).all() for item, n in zip(lists, lengths, strict=True)):
            names = [item.name for item in element.properties]
            return ([(np.arange(element.count), {n: rows[n] for n in names})] if wanted else []), stop
    places: dict[tuple[int, ...], tuple[list[int], list[int]]] = {}
    sizes: dict[tuple[int, ...], int] = {}
    at = start
    for number in range(element.count):
        lengths = measure_row(data, at, order, element)
        if lengths not in sizes:
            sizes[lengths] = row_layout(element, lengths, order).itemsize
            places[lengths] = ([], [])
            if len(sizes) > 4096:
                raise ValueError(f"has rows of {element.name} of thousands of lengths")
        places[lengths][0].append(number)
        places[lengths][1].append(at)
        at += sizes[lengths]
        if at > len(data):
            raise ValueError(f"ends after {number} of {element.count} rows of {element.name}")
    if wanted:
        whole = np.frombuffer(data, np.uint8)
        for lengths, (numbers, offsets) in places.items():
            layout = row_layout(element, lengths, order)
            index = np.array(offsets)[:, None] + np.arange(layout.itemsize)
            rows = whole[index].view(layout)[:, 0]
            groups.append((np.array(numbers), {item.name: rows[item.name] for item in element.properties}))
    return groups, at


def measure_row(data: bytes, at: int, order: str, element: Element) -> tuple[int, ...]:
    """The lengths of the lists of one binary row."""
    lengths = []
    little = "little" if order == "<" else "big"
    for item in element.properties:
        if item.length is None:
            at += int(item.kind[1])
            continue
        size = int(item.length[1])
        length = int.from_bytes(data[at : at + size], little, signed=item.length[0] == "i")
        at += size + length * int(item.kind[1])
        if length < 0 or at > len(data):
            raise ValueError(f"has a list of {length} numbers in a row of {element.name}, which do not fit")
        lengths.append(length)
    return tuple(lengths)


def row_layout(element: Element, lengths: tuple[int, ...], order: str) -> np.dtype:
    """The NumPy type of a row whose lists have these lengths."""
    fields: list[tuple] = []
    left = list(lengths)
    for item in element.properties:
        if item.length is None:
            fields.append((item.name, order + item.kind))
        else:
            fields.append((f"{item.name} length", order + item.length))
            fields.append((item.name, order + item.kind, (left.pop(0),)))
    try:
        return np.dtype(fields)
    except ValueError:
        raise ValueError(f"has two properties of {element.name} with one name") from None


def order_rows(groups: list[Group]) -> dict[str, np.ndarray]:
    """The columns of all rows in the order of the file, without lists, which differ in length between groups."""
    names = [name for name, column in groups[0][1].items() if column.ndim == 1]
    if len(groups) == 1 and (np.diff(groups[0][0]) > 0).all():
        return {name: groups[0][1][name] for name in names}
    order = np.argsort(np.concatenate([numbers for numbers, _ in groups]))
    return {name: np.concatenate([columns[name] for _, columns in groups])[order] for name in names}

"""Vertices of .ply files: read from text or binary of either byte order, written as binary.

The size that a header states is checked before anything of that size is allocated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.colors import colors_of
from beags_plugin.system.reading.stand_ins import stand_in, starts_as
from beags_plugin.system.reading.text import number_of, reason

_HEADER_BYTES = 1 << 20  # no real header is longer
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
_NAMES |= {"f4": "float", "f8": "double"}


@dataclass(frozen=True)
class _Property:
    """A column of an element. length: the type of a list's length; None for single numbers."""

    name: str
    type: str
    length: str | None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]

    def has_lists(self) -> bool:
        return any(column.length is not None for column in self.properties)

    def numbers(self, order: str) -> np.dtype:
        """Return the type of a row without its lists."""
        return np.dtype([(column.name, order + column.type) for column in self.properties if column.length is None])


@dataclass(frozen=True)
class _Header:
    """order: byte order, "" for text. body: offset of the first byte after the header."""

    order: str
    elements: list[_Element]
    body: int


def read_vertices(path: Path) -> np.ndarray:
    """Read the element ``vertex`` of a .ply as a structured array; columns of lists are dropped.

    The array of a binary file may be a read-only view of the file. Raises ``OSError`` if the file cannot be read,
    ``UserError`` if it is shorter than its header says, and ``ValueError`` with the reason if it is no .ply.
    """
    vertices = read_element(path, "vertex")
    if vertices is None:
        raise ValueError("'vertex' is missing")
    return vertices


def read_element(path: Path, name: str) -> np.ndarray | None:
    """Read any element of a .ply as ``read_vertices`` does; None if it has no such element."""
    header = _read_header(path)
    _check_size(path, header)
    before: list[_Element] = []
    for element in header.elements:
        if element.name == name:
            break
        before.append(element)
    else:
        return None
    if header.order == "":
        return _from_text(path, header, before, element)
    if not element.has_lists() and not any(other.has_lists() for other in before):
        dtype = element.numbers(header.order)
        skipped = sum(other.count * other.numbers(header.order).itemsize for other in before)
        if element.count == 0 or dtype.itemsize == 0:
            return np.empty(0, dtype)
        return np.memmap(path, dtype, "r", header.body + skipped, (element.count,))
    with open(path, "rb") as file:
        file.seek(header.body)
        for other in before:
            _rows(file, other, header.order)
        return _rows(file, element, header.order)


def write_vertices(file: BinaryIO, table: np.ndarray, comment: str = "") -> None:
    """Write a structured array [N] of little-endian numbers as the vertices of a binary .ply."""
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    lines.append(f"element vertex {len(table)}")
    lines += [f"property {_NAMES[table.dtype[name].str[1:]]} {name}" for name in table.dtype.names or ()]
    file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
    file.write(np.ascontiguousarray(table).data)


def read_ply_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions [N, 3] float64 and colours [N, 3] uint8 (mid-grey if there are none) of a .ply's vertices.

    Positions may be infinite or nan. Raises ``UserError`` if the file is absent or has no x, y, z.
    """
    if not path.is_file():
        raise UserError(f"the seed points {path} (ply_file_path) do not exist: restore the file or remove the key.")
    try:
        vertices = read_vertices(path)
        named = {name.casefold(): name for name in vertices.dtype.names or ()}
        points = np.stack([vertices[named.get(axis, axis)] for axis in "xyz"], axis=1).astype(np.float64)
    except OSError as error:
        raise UserError(f"the seed points {path} cannot be read ({error.strerror}): restore the file.") from error
    except (ValueError, MemoryError) as error:
        todo = "export them again" if stand_in(path) is None else "then try again"
        raise UserError(
            f"the seed points {path} cannot be read as a .ply with x, y, z ({reason(error)}): {todo}."
        ) from error
    return points, colors_of(vertices)


def _check_size(path: Path, header: _Header) -> None:
    """Raise ``UserError`` if the elements of the header do not fit into the file."""
    promised = 0
    for element in header.elements:
        for column in element.properties:
            # A list takes at least its length; a number in text takes a digit and a separator.
            promised += element.count * (int((column.length or column.type)[1]) if header.order else 2)
    rest = path.stat().st_size - header.body
    if promised > rest + (0 if header.order else 1):  # text may end without a line feed
        raise UserError(
            f"{path} is cut off or damaged: its header promises {promised} bytes, but {rest} follow: get it again."
        )


def _read_header(path: Path) -> _Header:
    with open(path, "rb") as file:
        head = file.read(_HEADER_BYTES)
    feed = next((end for end in (b"\r\n", b"\n", b"\r") if head.startswith(b"ply" + end)), None)
    if feed is None or (feed + b"end_header") not in head:
        other = None if head.startswith(b"ply") else starts_as(path)
        raise ValueError(stand_in(path) or other or "it does not start with a .ply header")
    text, mark, rest = head.partition(feed + b"end_header")
    body = len(text) + len(mark) + (len(feed) if rest.startswith(feed) else 0)
    order, elements = None, []
    for line in text.decode("ascii", "replace").splitlines():
        match line.split():
            case ["format", kind, "1.0"] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
                if elements[-1].count < 0:
                    raise ValueError(f"it promises {count} {name} elements")
            case ["property", "list", length, kind, name] if elements and _TYPES.get(length, "f")[0] != "f":
                elements[-1].properties.append(_Property(name, _type(kind), _type(length)))
            case ["property", kind, name] if elements:
                elements[-1].properties.append(_Property(name, _type(kind), None))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header has the line {line!r}")
    if order is None:
        raise ValueError("its header names no format")
    return _Header(order, elements, body)


def _type(name: str) -> str:
    if name not in _TYPES:
        raise ValueError(f"its header has the unknown type {name!r}")
    return _TYPES[name]


def _from_text(path: Path, header: _Header, before: list[_Element], element: _Element) -> np.ndarray:
    lines = path.read_bytes()[header.body :].decode("ascii", "replace").splitlines()
    start = sum(other.count for other in before)
    rows = [line.split() for line in lines[start : start + element.count]]
    if len(rows) < element.count:
        raise ValueError(f"it has {len(rows)} of {element.count} vertices")
    columns: dict[str, list[str]] = {name: [] for name in element.numbers("").names or ()}
    for number, row in enumerate(rows):
        at = 0
        for column in element.properties:
            if column.length is None:
                columns[column.name] += row[at : at + 1]
                at += 1
            else:
                at += 1 + _length(row[at] if at < len(row) else "none")
        if at != len(row):
            raise ValueError(f"vertex {number} has {len(row)} words instead of {at}")
    table = np.empty(element.count, element.numbers("<"))
    for name, words in columns.items():
        try:
            numbers = words if table.dtype[name].kind in "iu" else [number_of(word) for word in words]
            table[name] = np.array(numbers, object).astype(table.dtype[name])
        except (ValueError, OverflowError) as error:
            raise ValueError(f"column {name}: {reason(error)}") from None
    return table


def _rows(file: BinaryIO, element: _Element, order: str) -> np.ndarray:
    """Read an element whose rows have different lengths because of lists, and drop the lists."""
    table = np.empty(element.count, element.numbers(order))
    for row in range(element.count):
        for column in element.properties:
            if column.length is None:
                table[column.name][row] = _number(file, order + column.type)
            else:
                skipped = _length(_number(file, order + column.length)) * np.dtype(column.type).itemsize
                if len(file.read(skipped)) < skipped:
                    raise ValueError("it ends within a list")
    return table


def _number(file: BinaryIO, kind: str) -> np.generic:
    dtype = np.dtype(kind)
    content = file.read(dtype.itemsize)
    if len(content) < dtype.itemsize:
        raise ValueError("it ends within a number")
    return np.frombuffer(content, dtype)[0]


def _length(word: str | np.generic) -> int:
    length = int(word)  # type: ignore[call-overload]
    if length < 0:
        raise ValueError(f"it has a list of {length} elements")
    return length

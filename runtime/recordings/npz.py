"""npz and npy files: arrays t, x, y, p, or one array of events: structured, or with a row or a column for each of the four.

Read a packet at a time, without unpacking the whole of an array. Names, orders and units are those of `runtime.recordings.columns`.
"""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from runtime.recordings.columns import Block, check_lengths, columns_of, length_of, table_packets
from runtime.recordings.packet import PACKET_EVENTS, Notes, RecordingError, damaged_at, read_or_refused

WANTED = "an npz file with arrays t, x, y, p"


@dataclass(frozen=True)
class Array:
    """What an npy file's header says: shape, order and type of its numbers, and the byte where they start."""

    name: str
    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]
    start: int


@dataclass(frozen=True)
class Part:
    """Numbers in a row in an array, `width` for an event, from its number `first` on."""

    array: Array
    first: int = 0
    width: int = 1


def sensor_shape(path: Path) -> None:  # noqa: ARG001  every reader has the same signature
    """These files tell no size."""
    return


def packets(path: Path, notes: Notes) -> Iterator[NDArray[Any]]:
    """The file's events. Raises `RecordingError`: at once for arrays that are not events, while reading where it is damaged."""
    with read_or_refused(path, WANTED), contextlib.ExitStack() as stack:
        arrays = [_header(stack, path, name) for name in _names(path)]
    columns, unit = columns_of(array.name for array in arrays)
    if len(columns) == 4:
        found = {column: next(array for array in arrays if array.name == name) for column, name in columns.items()}
        lengths = {name: length_of(path, name, array.dtype, array.shape) for name, array in found.items()}
        check_lengths(path, lengths)
        return table_packets(path, _blocks(path, {name: Part(array) for name, array in found.items()}, lengths["t"]), unit, notes)
    tables = [array for array in arrays if array.dtype.names or (len(array.shape) == 2 and 4 in array.shape)]
    if len(tables) != 1:
        missing = ", ".join(name for name in "txyp" if name not in columns)
        held = ", ".join(array.name or f"one array of shape {array.shape}" for array in arrays) or "nothing"
        raise RecordingError(f"{path}: no array {missing}; the arrays t, x, y, p are needed, found {held}")
    return _table_packets(path, tables[0], notes)


def _table_packets(path: Path, array: Array, notes: Notes) -> Iterator[NDArray[Any]]:
    """Events of one array, structured or of four columns."""
    if array.dtype.names:
        columns, unit = columns_of(array.dtype.names)
        if len(columns) < 4 or len(array.shape) != 1:
            fields = ", ".join(array.dtype.names)
            raise RecordingError(f"{path}: found fields {fields}, of shape {array.shape}; one row of t, x, y, p an event is needed")
        for column, name in columns.items():
            length_of(path, column, array.dtype[name], array.shape)
        rows = _blocks(path, {"rows": Part(array)}, array.shape[0])
        named = ((start, {column: block["rows"][name] for column, name in columns.items()}) for start, block in rows)
        return table_packets(path, named, unit, notes)
    columns_first = array.shape[1] != 4
    length = length_of(path, array.name or "the array", array.dtype, array.shape[columns_first:][:1])
    if columns_first == array.fortran:
        rows = _blocks(path, {"rows": Part(array, width=4)}, length)
        return table_packets(path, ((start, block["rows"].reshape(-1, 4)) for start, block in rows), "", notes)
    parts = _blocks(path, {str(place): Part(array, first=place * length) for place in range(4)}, length)
    return table_packets(path, ((start, np.stack(list(block.values()), axis=1)) for start, block in parts), "", notes)


def _names(path: Path) -> list[str]:
    """Names of the arrays in the file; "" for the one in an npy file."""
    if path.suffix.lower() == ".npy":
        return [""]
    with zipfile.ZipFile(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]


def _open(stack: contextlib.ExitStack, path: Path, name: str) -> IO[bytes]:
    if not name:
        return stack.enter_context(path.open("rb"))
    return stack.enter_context(stack.enter_context(zipfile.ZipFile(path)).open(f"{name}.npy"))


def _header(stack: contextlib.ExitStack, path: Path, name: str) -> Array:
    read = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
    file = _open(stack, path, name)
    major, _ = np.lib.format.read_magic(file)
    if major not in read:
        raise ValueError(f"npy format {major}")
    shape, fortran, dtype = read[major](file)
    return Array(name, shape, fortran, dtype, file.tell())


def _blocks(path: Path, parts: dict[str, Part], length: int) -> Iterator[tuple[int, Block]]:
    """The parts, side by side, a packet's events at a time. Raises `RecordingError` where one is damaged."""
    with contextlib.ExitStack() as stack:
        files = {}
        for start in range(0, length, PACKET_EVENTS):
            stop = min(start + PACKET_EVENTS, length)
            try:
                files = files or {name: _at(stack, path, part) for name, part in parts.items()}
                block = {name: _read(files[name], part, stop - start) for name, part in parts.items()}
            except Exception as error:  # a damaged file fails in zipfile or zlib, with classes of their own
                raise damaged_at(path, start, stop, error) from error
            yield start, block


def _at(stack: contextlib.ExitStack, path: Path, part: Part) -> IO[bytes]:
    file = _open(stack, path, part.array.name)
    file.seek(part.array.start + part.first * part.array.dtype.itemsize)
    return file


def _read(file: IO[bytes], part: Part, events: int) -> NDArray[Any]:
    wanted = events * part.width * part.array.dtype.itemsize
    numbers = file.read(wanted)
    if len(numbers) < wanted:
        raise EOFError(f"{part.array.name or 'the array'} ends early")
    return np.frombuffer(numbers, dtype=part.array.dtype)

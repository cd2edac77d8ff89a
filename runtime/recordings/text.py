"""Text files: a line an event, four numbers parted by commas, semicolons, tabs or spaces.

Above the events there may be:

- comments, lines that start with `#` or `%`: a size in one of them (`%geometry:640,480`) is the sensor's; one that names all four columns
  tells their order;
- a line of two whole numbers, the sensor's width and height;
- a line of names, of which others than the four are passed over; `x@640` and `y@480`, as faery writes them, tell the size.

Names and numbers may be quoted, polarities be True and False; a byte-order mark, empty lines and line ends of any system do not matter.
Without names the order of the columns, and without a unit that of the times, are told from the numbers (`runtime.recordings.columns`).
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.recordings.columns import columns_of, order_of, packet_from, unit_of
from runtime.recordings.header import shape_of
from runtime.recordings.packet import EVENT, PACKET_EVENTS, Notes, RecordingError

COMMENTS = ("#", "%")
DELIMITERS = (";", "\t", ",")
"""Tried in this order; a line that has none is parted by spaces."""
MOST_LINES_ABOVE = 1000
UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
SIZE = re.compile(r"(?:geometry|size|resolution)\D{1,3}(?P<width>\d+)\s*[x, ]\s*(?P<height>\d+)", re.IGNORECASE)

Line = tuple[int, str]
"""A line's number, from 1, and its text."""


@dataclass(frozen=True)
class Layout:
    """What the lines above the events tell: places of t, x, y, p (none if not told), unit, size, delimiter, and how many they are."""

    columns: tuple[int, ...] = ()
    unit: str = ""
    shape: tuple[int, int] | None = None
    delimiter: str | None = None
    lines_above: int = 0


def sensor_shape(path: Path) -> tuple[int, int] | None:
    """(height, width) that the lines above the events tell."""
    return _layout(path).shape


def packets(path: Path, notes: Notes) -> Iterator[NDArray[Any]]:
    """The file's events. Raises `RecordingError`: at once where its first lines do not fit, while reading at the first faulty line."""
    return _packets(path, _layout(path), notes)


def _layout(path: Path) -> Layout:
    with path.open("rb") as file:
        if file.read(2) in UTF16_MARKS:
            raise RecordingError(f"{path}: found text in UTF-16; save it as UTF-8")
    order: tuple[int, ...] = ()
    shape: tuple[int, int] | None = None
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(itertools.islice(file, MOST_LINES_ABOVE)):
            if line.startswith(COMMENTS):
                size = SIZE.search(line)
                shape = shape_of(size["height"], size["width"]) if size else shape
                order = _named_order(line) or order
            elif line.strip():
                fields, delimiter = _fields(line)
                if not NUMBER.fullmatch(fields[0]):
                    return _named(path, fields, delimiter, shape, number + 1)
                if len(fields) == 2 and shape_of(fields[1], fields[0]):
                    shape = shape_of(fields[1], fields[0])
                elif len(fields) == 4:
                    return Layout(order, "", shape, delimiter, number)
                else:
                    raise RecordingError(f"{path}: found {len(fields)} columns without names; give a first line that names t, x, y, p")
    raise RecordingError(f"{path}: no line of numbers or names within {MOST_LINES_ABOVE} lines; give a line an event, t, x, y, p")


def _fields(line: str) -> tuple[list[str], str | None]:
    """A line's fields without quotes, and what parts them, None for spaces."""
    delimiter = next((mark for mark in DELIMITERS if mark in line), None)
    fields = [field.strip(" \t\r\n\"'") for field in line.strip().split(delimiter)]
    return fields[:-1] if len(fields) > 1 and not fields[-1] else fields, delimiter


def _named_order(comment: str) -> tuple[int, ...]:
    """Places of t, x, y, p among the four, in a comment that names them all; else none."""
    words = re.split(r"[\s,;:()]+", comment.lstrip("#% "))
    found, _ = columns_of(words)
    ranked = sorted(found.values(), key=words.index)
    return tuple(ranked.index(found[name]) for name in "txyp") if len(found) == 4 else ()


def _named(path: Path, names: list[str], delimiter: str | None, shape: tuple[int, int] | None, lines_above: int) -> Layout:
    plain = [name.partition("@")[0] for name in names]
    found, unit = columns_of(plain)
    if missing := [name for name in "txyp" if name not in found]:
        raise RecordingError(f"{path}: no column {', '.join(missing)} in the first line; give a header that names t, x, y, p, or numbers")
    columns = tuple(plain.index(found[name]) for name in "txyp")
    width, height = (names[columns["txyp".index(name)]].partition("@")[2] for name in "xy")
    return Layout(columns, unit, shape_of(height, width) or shape, delimiter, lines_above)


def _packets(path: Path, layout: Layout, notes: Notes) -> Iterator[NDArray[Any]]:
    reader = _Reader(layout, notes)
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        numbered = itertools.islice(enumerate(file, start=1), layout.lines_above, None)
        while chunk := list(itertools.islice(numbered, PACKET_EVENTS)):
            lines = [(number, line) for number, line in chunk if line.strip() and not line.startswith(COMMENTS)]
            packet, fault = reader.read(lines)
            yield packet
            if fault:
                raise RecordingError(f"{path}: {fault}")


class _Reader:
    """Takes lines, gives their events. What the lines above them do not tell, the first lines do."""

    def __init__(self, layout: Layout, notes: Notes) -> None:
        self._layout, self._notes = layout, notes
        self._order = "txyp" if layout.columns else ""
        self._unit = layout.unit

    def read(self, lines: list[Line]) -> tuple[NDArray[Any], str]:
        """The events of the lines before the first faulty one, and what is wrong with that; "" if none is faulty."""
        rows, good, reason = _tried(len(lines), lambda count: _parsed(lines[:count], self._layout))
        try:
            if good:
                self._tell(rows)
        except ValueError as error:
            return np.empty(0, dtype=EVENT), f"from line {lines[0][0]} on: {error}"
        columns = {name: rows[:, place] for place, name in enumerate(self._order or "txyp")}
        packet, good, wrong = _tried(good, lambda count: self._events(columns, count))
        if good == len(lines):
            return packet, ""
        number, line = lines[good]
        why = f" ({wrong or reason})" if wrong or reason else ""
        return packet, f"line {number}: found {line.strip():.60}; give whole numbers t (us), x, y, p{why}"

    def _tell(self, rows: NDArray[Any]) -> None:
        """Finds out the columns' order and the times' unit, where they are not known. Raises ValueError."""
        self._order = self._order or order_of(rows)
        self._unit = self._unit or unit_of(rows[:, self._order.index("t")])
        self._notes.order, self._notes.unit = "" if self._layout.columns else self._order, self._unit

    def _events(self, columns: dict[str, NDArray[Any]], count: int) -> NDArray[Any]:
        return packet_from({name: column[:count] for name, column in columns.items()}, self._unit or "us")


def _tried(count: int, attempt: Callable[[int], NDArray[Any]]) -> tuple[NDArray[Any], int, str]:
    """The attempt's result on as many of the first `count` lines as it can take, how many these are, and why it takes no more.

    The attempt raises ValueError if one of the first lines is faulty: halving finds how many are good.
    """
    good, faulty, reason = 0, count + 1, ""
    given: NDArray[Any] | None = None
    trial = count
    while faulty - good > 1:
        try:
            given = attempt(trial)
            good = trial
        except ValueError as error:
            faulty, reason = trial, str(error)
        trial = (good + faulty) // 2
    return attempt(0) if given is None else given, good, reason


def _parsed(lines: list[Line], layout: Layout) -> NDArray[Any]:
    """The lines' numbers, (n, 4): int64 if no line has a fraction, else float64. Raises ValueError."""
    if not lines:
        return np.empty((0, 4), dtype=np.int64)
    text = "".join(line for _, line in lines)
    if re.search("[\"'TtFf]", text):
        text = re.sub("(?i)true", "1", re.sub("(?i)false", "0", re.sub("[\"']", "", text)))
    kind = np.float64 if re.search("[.eE]", text) else np.int64
    places = layout.columns or range(4)
    try:
        return np.loadtxt(text.split("\n"), kind, comments=None, delimiter=layout.delimiter, usecols=places, ndmin=2)
    except ValueError:
        raise ValueError from None

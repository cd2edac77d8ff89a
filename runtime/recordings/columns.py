"""Columns of numbers as events: which column is which, in what unit the times are, and what no event can be.

Text, npz and HDF5 files hold the same four columns under many names, in many orders and units. What a file names is believed. What it
does not name is told from its numbers, and refused where they fit nothing:

- The order of four unnamed columns is the first of `ORDERS` that its numbers allow: a polarity is -1, 0 or 1, a pixel a whole number
  of up to `LARGEST_PIXEL`. An order whose times often go back gives way to one whose times hardly do.
- Times are us if they are whole, or ns if they would lie beyond the year 5000; if most have fractions they are seconds.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.frames import LARGEST_TIME_US
from runtime.recordings.packet import EVENT, Notes, RecordingError, packet_of

ORDERS = ("txyp", "xypt", "xytp")
"""By our own files and most others; by Prophesee's converter; by MVSEC."""
LARGEST_PIXEL = 16_384
FEW_EVENTS = 100
"""With so few events, the order of times says nothing of the order of columns."""
NUMBERS = "iufb"
"""Kinds of types that a column can have."""
Block = dict[str, NDArray[Any]]
"""Columns by name."""
UNITS_US = {"ns": 1e-3, "us": 1.0, "ms": 1e3, "s": 1e6}
LARGEST_WHOLE_US = 1e17
"""Whole times beyond this are ns: as us they would be the year 5138, as ns it was reached in 1973."""

UNIT_NAMES = {
    "ns": ("ns", "nsec", "nanosecond", "nanoseconds"),
    "us": ("us", "µs", "usec", "microsecond", "microseconds"),
    "ms": ("ms", "msec", "millisecond", "milliseconds"),
    "s": ("s", "sec", "second", "seconds"),
}
_UNIT_OF_NAME = {name: unit for unit, names in UNIT_NAMES.items() for name in names}
_OF_A_PIXEL = r"(?:[ _(\[]*(?:px|pixels?|pos|coord|addr|address)[)\]]?)"
_COLUMNS = {
    "t": rf"(?:t|ts|times?|timestamps?)(?:[ _(\[]+(?P<unit>{'|'.join(_UNIT_OF_NAME)})[)\]]?)?",
    "x": rf"xs?|x{_OF_A_PIXEL}",
    "y": rf"ys?|y{_OF_A_PIXEL}",
    "p": "p|ps|pols?|polarity|polarities|on",
}


def column_of(name: str) -> tuple[str, str] | None:
    """Which of t, x, y, p a column of that name is, with the unit that its name tells or ""; None for any other column."""
    plain = re.sub(r"^events?_", "", name.strip(" \t\"'").lower())
    for column, pattern in _COLUMNS.items():
        if match := re.fullmatch(pattern, plain):
            return column, _UNIT_OF_NAME.get(match.groupdict().get("unit") or "", "")
    return None


def columns_of(names: Iterable[str]) -> tuple[dict[str, str], str]:
    """The first name of each of t, x, y, p among these, and the unit of the times that it tells, or ""."""
    found: dict[str, str] = {}
    unit = ""
    for name in names:
        column, named = column_of(name) or ("", "")
        if column and column not in found:
            found[column] = name
            unit = named or unit
    return found, unit


def order_of(rows: NDArray[Any]) -> str:
    """The order of unnamed columns, (n, 4), such as "txyp". Raises ValueError if the numbers fit none."""
    fitting = [order for order in ORDERS if _fits(rows, order)]
    if not fitting:
        numbers = ", ".join(f"{value:.10g}" for value in rows[0].tolist())
        raise ValueError(f"no order of the columns t, x, y, p fits {numbers} and what follows; name the columns")
    often_back = {order: float(np.mean(np.diff(rows[:, order.index("t")]) < 0)) for order in fitting} if len(rows) >= FEW_EVENTS else {}
    if often_back and often_back[fitting[0]] > 0.1:
        fitting = [order for order in fitting if often_back[order] < 0.01] or fitting
    return fitting[0]


def _fits(rows: NDArray[Any], order: str) -> bool:
    if _no_polarity(rows[:, order.index("p")]).any():
        return False
    pixels = rows[:, [order.index("x"), order.index("y")]]
    return bool((pixels == np.rint(pixels)).all() and (pixels >= -LARGEST_PIXEL).all() and (pixels <= LARGEST_PIXEL).all())


def _signed(p: NDArray[Any]) -> NDArray[Any]:
    """Polarities of an unsigned type as signed ones: the largest number is a -1 that was stored there."""
    return p.astype(f"i{p.dtype.itemsize}") if p.dtype.kind == "u" else p


def _no_polarity(p: NDArray[Any]) -> NDArray[np.bool_]:
    """True for numbers that are no polarity: other than -1, 0 and 1."""
    p = _signed(p)
    outside = (p < -1) | (p > 1)
    return outside | (p != np.rint(p)) if p.dtype.kind == "f" else outside


def unit_of(times: NDArray[Any]) -> str:
    """The unit that most of these times tell. Raises ValueError where they have fractions and are no seconds of a camera."""
    times = times[np.isfinite(times)]
    if len(times) == 0:
        return "us"
    low, middle, high = np.percentile(times, [25, 50, 75])
    if times.dtype.kind == "f" and 2 * int(np.count_nonzero(times != np.rint(times))) > len(times):
        if 2 * (high - low) > len(times):
            raise ValueError("t has fractions, and as seconds these would be fewer than one event a second; name its unit, as in t_us")
        return "s"
    return "ns" if abs(middle) > LARGEST_WHOLE_US else "us"


def packet_from(columns: dict[str, NDArray[Any]], unit: str, offset: int = 0) -> NDArray[Any]:
    """The events of four columns of numbers; to times, in `unit`, `offset` of it is added. Raises ValueError where one is no event."""
    for name in "xy":
        _check_whole(name, columns[name])
    p = columns["p"]
    if (wrong := _no_polarity(p)).any():
        raise ValueError(f"polarity {p[wrong][0]:g} is not -1, 0 or 1; are the columns in another order?")
    return packet_of(_microseconds(columns["t"], unit, offset), columns["x"], columns["y"], _signed(p))


def _check_whole(name: str, values: NDArray[Any]) -> None:
    if values.dtype.kind == "f" and not (values == np.rint(values)).all():
        raise ValueError(f"{name} has {values[values != np.rint(values)][0]:g}; give whole numbers")
    limits = np.iinfo(EVENT[name])
    if len(values) and not (limits.min <= int(values.min()) and int(values.max()) <= limits.max):
        raise ValueError(f"{name} runs from {values.min()} to {values.max()}, beyond {EVENT[name]}")


def _microseconds(times: NDArray[Any], unit: str, offset: int) -> NDArray[np.int64]:
    """Times as whole us. Raises ValueError where they are not numbers, beyond what windows can hold, or us with a fraction."""
    if times.dtype.kind != "f" and unit == "us":
        whole = times
    elif times.dtype.kind != "f" and unit == "ns":
        whole, offset = times // 1000, offset // 1000
    else:
        scaled = times * UNITS_US[unit]
        if not np.isfinite(scaled).all():
            raise ValueError("t is not a number")
        whole, offset = np.rint(scaled), round(offset * UNITS_US[unit])
        if unit == "us" and not (whole == scaled).all():
            raise ValueError(f"t has {times[whole != scaled][0]:g} among whole us; give whole numbers, or name its unit")
    if len(whole) and not (int(whole.min()) + offset >= -LARGEST_TIME_US and int(whole.max()) + offset <= LARGEST_TIME_US):
        raise ValueError(f"t runs from {whole.min()} to {whole.max()} us, beyond plus-minus 2**61")
    return whole.astype(np.int64) + offset


def length_of(path: Path, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> int:
    """Length of a column. Raises `RecordingError` unless it is one of numbers."""
    if len(shape) != 1 or dtype.kind not in NUMBERS:
        raise RecordingError(f"{path}: {name} is {dtype} of shape {shape}; give one column of numbers")
    return shape[0]


def check_lengths(path: Path, lengths: dict[str, int]) -> None:
    """Raises `RecordingError` unless all columns are equally long."""
    if len(set(lengths.values())) > 1:
        raise RecordingError(f"{path}: arrays of different lengths {lengths}; give one value an event")


def table_packets(
    path: Path, blocks: Iterator[tuple[int, Block | NDArray[Any]]], unit: str, notes: Notes, offset: int = 0
) -> Iterator[NDArray[Any]]:
    """Packets of blocks of numbers: (number of the first event, columns by name or (n, 4) rows of unnamed ones).

    `unit` of the times: "" if the file does not tell it. Raises `RecordingError` where a block holds what no event can be.
    """
    order = ""
    for start, block in blocks:
        try:
            if isinstance(block, dict):
                columns = block
            else:
                order = order or order_of(block)
                columns = {name: block[:, place] for place, name in enumerate(order)}
            unit = unit or unit_of(columns["t"])
            notes.order, notes.unit = order, unit
            packet = packet_from(columns, unit, offset)
        except ValueError as error:
            raise RecordingError(f"{path}: events from {start} on: {error}") from error
        yield packet

"""Events from a recording, packet by packet, for the scripts and commands.

| suffix | by | sensor size |
|---|---|---|
| `.raw` (Prophesee EVT2, EVT3), `.dat` | faery | from the header's text |
| `.es`, `.aedat4` | faery | in the file |
| `.csv`: a header that names t, x, y, p or none, then whole numbers | numpy | none, or a header `t,x@640,y@480,p` |
| `.npz`: arrays t, x, y, p | numpy | none |

Times are in us, x is the column and y the row from the top left. faery comes with the extra `recordings`, is imported only
when one of its formats is read, and raises a time that runs backwards to the latest one before it; numpy's formats keep such
times, so that `runtime.frames` can count them.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

EVENT = np.dtype([("t", np.int64), ("x", np.int32), ("y", np.int32), ("p", np.int8)])
"""What a packet holds: time (us), column, row, polarity."""

PACKET_EVENTS = 65_536
"""Events in a packet of a CSV or npz file; faery's packets have their own length."""

FAERY_SUFFIXES = (".raw", ".dat", ".es", ".aedat4")
COLUMN_NAMES = {"t": "t", "x": "x", "y": "y", "p": "p", "on": "p", "polarity": "p"}
EVT_VERSIONS = {"2.0": "evt2", "EVT2": "evt2", "3.0": "evt3", "EVT3": "evt3"}
LONGEST_HEADER_BYTES = 65_536


class RecordingError(ValueError):
    """A recording that cannot be read. One line: the file, what was found, what to do."""


def read_events(path: str | Path, shape: tuple[int, int] | None = None) -> Iterator[NDArray[Any]]:
    """The recording's events as packets, arrays of dtype `EVENT`, in the file's order.

    `shape`: the (height, width) that is expected; needed for a RAW or DAT file whose header does not tell it. Where the file
    tells no size, events outside `shape` are left to `runtime.frames`, which counts them.

    Raises `RecordingError`, at once, if the file is missing, of an unknown kind or for another sensor size than `shape`, or if
    faery is needed and missing; and while reading, where the data break off or are not numbers.
    """
    path = Path(path)
    declared = sensor_shape(path)
    if declared is not None and shape is not None and declared != tuple(shape):
        sizes = f"recorded by a sensor of {declared[1]}x{declared[0]} px, expected {shape[1]}x{shape[0]}"
        raise RecordingError(f"{path}: {sizes}; take a recording of that size, or a scene of this one")
    if path.suffix == ".npz":
        return _npz_packets(path)
    if path.suffix == ".csv":
        return _csv_packets(path)
    return _faery_packets(path, declared or shape)


def sensor_shape(path: str | Path) -> tuple[int, int] | None:
    """The sensor's (height, width) as the file tells it, or None if it does not. Raises `RecordingError`."""
    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file; give the path of a recording")
    if path.suffix in (".raw", ".dat"):
        return _header_shape(_header(path))
    if path.suffix in FAERY_SUFFIXES:
        width, height = _decoder(path).dimensions()
        return height, width
    if path.suffix == ".csv":
        return _csv_columns(path)[1]
    if path.suffix == ".npz":
        return None
    raise RecordingError(f"{path}: unknown kind {path.suffix!r}; known are {', '.join((*FAERY_SUFFIXES, '.csv', '.npz'))}")


def _header(path: Path) -> dict[str, str]:
    """The lines `% keyword value` at the start of a RAW or DAT file, keywords in lower case."""
    with path.open("rb") as file:
        start = file.read(LONGEST_HEADER_BYTES)
    header = {}
    for line in start.decode("latin-1").split("\n"):
        keyword, _, value = line.removeprefix("%").strip().partition(" ")
        if not line.startswith("%") or keyword == "end":
            break
        header[keyword.lower()] = value.strip()
    return header


def _header_shape(header: dict[str, str]) -> tuple[int, int] | None:
    """(height, width) from `geometry 640x480`, from `format EVT3;height=480;width=640` or from `Width` and `Height`."""
    if match := re.fullmatch(r"(\d+)x(\d+)", header.get("geometry", "")):
        return int(match[2]), int(match[1])
    settings = header | dict(re.findall(r"(height|width)=(\d+)", header.get("format", "")))
    return _shape(settings.get("height", ""), settings.get("width", ""))


def _shape(height: str, width: str) -> tuple[int, int] | None:
    return (int(height), int(width)) if height.isdecimal() and width.isdecimal() else None


def _faery_packets(path: Path, shape: tuple[int, int] | None) -> Iterator[NDArray[Any]]:
    if shape is None:
        raise RecordingError(f"{path}: the header tells no sensor size; give the (height, width)")
    version = None
    if path.suffix == ".raw":
        header = _header(path)
        name = header.get("evt") or header.get("format", "").split(";")[0]
        version = EVT_VERSIONS.get(name)
        if version is None:
            raise RecordingError(f"{path}: found {f'format {name}' if name else 'no format'} in the header; convert it to EVT2 or EVT3")
    return _converted(path, _decoder(path, dimensions_fallback=(shape[1], shape[0]), version_fallback=version))


def _decoder(path: Path, **options: Any) -> Any:
    """faery's stream of the file."""
    try:
        import faery
    except ModuleNotFoundError as error:
        raise RecordingError(f"{path}: {path.suffix} needs faery, which is not installed: pip install glideproof[recordings]") from error
    try:
        return faery.events_stream_from_file(path, **options)
    except Exception as error:  # faery raises bare Exception for a damaged file
        raise RecordingError(f"{path}: {error}") from error


def _converted(path: Path, packets: Any) -> Iterator[NDArray[Any]]:
    try:
        for packet in packets:
            yield _packet(packet["t"], packet["x"], packet["y"], packet["p"])
    except RuntimeError as error:
        raise RecordingError(f"{path}: {error}") from error


def _packet(t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> NDArray[Any]:
    packet = np.empty(len(t), dtype=EVENT)
    packet["t"], packet["x"], packet["y"], packet["p"] = t, x, y, p
    return packet


def _npz_packets(path: Path) -> Iterator[NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            columns = {name: archive[name] for name in "txyp" if name in archive}
    except Exception as error:  # a damaged archive fails in zipfile, zlib or numpy
        raise RecordingError(f"{path}: cannot be read ({error}); give an npz file with arrays t, x, y, p") from error
    if missing := set("txyp") - set(columns):
        raise RecordingError(f"{path}: no array {', '.join(sorted(missing))}; the arrays t, x, y, p are needed")
    for name, column in columns.items():
        if column.ndim != 1 or column.dtype.kind not in ("iub" if name == "p" else "iu"):
            raise RecordingError(f"{path}: {name} is {column.dtype} of shape {column.shape}; give one column of whole numbers (t in us)")
        limits = np.iinfo(EVENT[name])
        if len(column) and not (limits.min <= int(column.min()) and int(column.max()) <= limits.max):
            raise RecordingError(f"{path}: {name} runs from {column.min()} to {column.max()}, beyond {EVENT[name]}; is it damaged?")
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise RecordingError(f"{path}: arrays of different lengths {lengths}; give one value an event")
    starts = range(0, lengths["t"], PACKET_EVENTS)
    return (_packet(*(columns[name][start : start + PACKET_EVENTS] for name in "txyp")) for start in starts)


def _csv_columns(path: Path) -> tuple[tuple[int, ...], tuple[int, int] | None, bool]:
    """Positions of t, x, y, p in a line, the sensor's (height, width) if the header tells it, and whether there is a header."""
    with path.open(encoding="utf-8", errors="replace") as file:
        names = [name.strip() for name in next(file, "").split(",")]
    if re.fullmatch(r"[+-]?\d+", names[0]):
        return (0, 1, 2, 3), None, False
    plain = [COLUMN_NAMES.get(name.partition("@")[0].lower(), "") for name in names]
    if missing := [name for name in "txyp" if name not in plain]:
        raise RecordingError(f"{path}: no column {', '.join(missing)} in the first line; give a header that names t, x, y, p, or numbers")
    width, height = (names[plain.index(name)].partition("@")[2] for name in "xy")
    return tuple(plain.index(name) for name in "txyp"), _shape(height, width), True


def _csv_packets(path: Path) -> Iterator[NDArray[Any]]:
    columns, _, has_header = _csv_columns(path)
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = enumerate(file, start=1)
        if has_header:
            next(lines)
        while chunk := list(itertools.islice(lines, PACKET_EVENTS)):
            first, last = chunk[0][0], chunk[-1][0]
            filled = [line for _, line in chunk if line.strip()]
            if not filled:
                continue
            try:
                yield np.loadtxt(filled, dtype=EVENT, delimiter=",", usecols=columns, comments=None, ndmin=1)
            except ValueError as error:
                raise RecordingError(f"{path}: lines {first} to {last}: {error}; give whole numbers t (us), x, y, p") from error

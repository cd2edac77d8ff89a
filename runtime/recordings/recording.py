"""Events from a recording, packet by packet, for the scripts and commands.

| suffix | by | sensor size |
|---|---|---|
| `.raw` (Prophesee EVT2, EVT3), `.dat` | faery | from the header's text |
| `.es`, `.aedat4` | faery | in the file |
| `.csv`: a header that names t, x, y, p or none, then whole numbers | numpy | none, or a header `t,x@640,y@480,p` |
| `.npz`: arrays t, x, y, p | numpy | none |
| `.h5`, `.hdf5`: columns t, x, y, p at the top or in a group `events` | h5py | attributes `width` and `height` there, or none |

Times are in us, x is the column and y the row from the top left. faery and h5py come with the extra `recordings` and are imported
only when one of their formats is read. Every kind is read in constant memory.

No event is lost without a word. What was good before a fault is given before the fault is raised:

- A RAW or DAT file that ends inside an event is an error at its end. One cut between two events cannot be told from a shorter
  recording; of an ES file that is cut, the last event goes without a word, as the format does not say how many there are.
- faery refuses a RAW or DAT file at the first event outside the geometry in its header. Such a file is read again without the
  geometry, and `runtime.frames` counts the events outside the sensor.
- faery ends the whole process on some damaged AEDAT4 files: they are read by a process of their own, whose end is an error like another.
- faery raises a time that runs backwards to the latest one before it; the other formats keep such times, and `runtime.frames`
  counts them.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import types
import zipfile
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import one_line

EVENT = np.dtype([("t", np.int64), ("x", np.int32), ("y", np.int32), ("p", np.int8)])
"""What a packet holds: time (us), column, row, polarity."""

PACKET_EVENTS = 65_536
"""Events in a packet of a CSV, npz or HDF5 file; faery's packets have their own length."""

FAERY_SUFFIXES = (".raw", ".dat", ".es", ".aedat4")
HDF5_SUFFIXES = (".h5", ".hdf5")
HDF5_GROUPS = ("", "events", "CD/events")
"""Where an HDF5 file may hold the columns: at the top, as DSEC does, or as Prophesee does."""
EVENT_BYTES = {"evt2": 4, "evt3": 2, "dat": 8}
"""Size of a word: a file ends with a whole one."""
READER = "import sys; from runtime.recordings.recording import write_packets; write_packets(sys.argv[1])"
"""What the process that reads an AEDAT4 file runs."""
BINARY_DAT_HEADER_BYTES = 2
"""A DAT file's header is followed by the type and the size of its events."""
COLUMN_NAMES = {"t": "t", "x": "x", "y": "y", "p": "p", "on": "p", "polarity": "p"}
EVT_VERSIONS = {"2.0": "evt2", "EVT2": "evt2", "3.0": "evt3", "EVT3": "evt3"}
LONGEST_HEADER_BYTES = 65_536
LONGEST_SIDE_DIGITS = 9
"""Digits of a height or width in a header; more are no size."""
NPZ_WANTED, HDF5_WANTED = "an npz file with arrays t, x, y, p", "an HDF5 file with columns t, x, y, p"


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
    if path.suffix in HDF5_SUFFIXES:
        return _hdf5_packets(path)
    return _faery_packets(path, declared or shape)


def sensor_shape(path: str | Path) -> tuple[int, int] | None:
    """The sensor's (height, width) as the file tells it, or None if it does not. Raises `RecordingError`."""
    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file; give the path of a recording")
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty; record or copy it again")
    if path.suffix in (".raw", ".dat"):
        return _header_shape(_header(path)[0])
    if path.suffix == ".aedat4":
        with contextlib.closing(_read_apart(path)) as arrays:
            height, width = next(arrays).tolist()
        return height, width
    if path.suffix in FAERY_SUFFIXES:
        width, height = _decoder(path).dimensions()
        return height, width
    if path.suffix == ".csv":
        return _csv_columns(path)[1]
    if path.suffix == ".npz":
        return None
    if path.suffix in HDF5_SUFFIXES:
        with _read_or_refused(path, HDF5_WANTED), _hdf5_file(path) as file:
            holder, _ = _hdf5_columns(path, file)
            return _shape(*(str(holder.attrs.get(name, "")) for name in ("height", "width")))
    known = ", ".join((*FAERY_SUFFIXES, ".csv", ".npz", *HDF5_SUFFIXES))
    raise RecordingError(f"{path}: unknown kind {path.suffix!r}; known are {known}")


def _header(path: Path) -> tuple[dict[str, str], int]:
    """The lines `% keyword value` at the start of a RAW or DAT file, keywords in lower case, and how many bytes they take."""
    with path.open("rb") as file:
        start = file.read(LONGEST_HEADER_BYTES)
    header, size = {}, 0
    for line in start.decode("latin-1").split("\n"):
        keyword, _, value = line.removeprefix("%").strip().partition(" ")
        if not line.startswith("%"):
            break
        size += len(line) + 1
        if keyword == "end":
            break
        header[keyword.lower()] = value.strip()
    return header, size


def _header_shape(header: dict[str, str]) -> tuple[int, int] | None:
    """(height, width) from `geometry 640x480`, from `format EVT3;height=480;width=640` or from `Width` and `Height`."""
    if match := re.fullmatch(r"(\d+)x(\d+)", header.get("geometry", "")):
        return int(match[2]), int(match[1])
    settings = header | dict(re.findall(r"(height|width)=(\d+)", header.get("format", "")))
    return _shape(settings.get("height", ""), settings.get("width", ""))


def _shape(height: str, width: str) -> tuple[int, int] | None:
    usable = all(side.isdecimal() and len(side) <= LONGEST_SIDE_DIGITS for side in (height, width))
    return (int(height), int(width)) if usable else None


def _faery_packets(path: Path, shape: tuple[int, int] | None) -> Iterator[NDArray[Any]]:
    if shape is None:
        raise RecordingError(f"{path}: the header tells no sensor size; give the (height, width)")
    if path.suffix == ".aedat4":
        return itertools.islice(_read_apart(path), 1, None)
    if path.suffix == ".es":
        return _converted(path, _decoder(path))
    version = _raw_version(path) if path.suffix == ".raw" else None
    stream = _decoder(path, dimensions_fallback=(shape[1], shape[0]), version_fallback=version)
    return _checked_to_the_end(path, version, _with_events_outside(path, version, stream))


def _raw_version(path: Path) -> str:
    """ "evt2" or "evt3". Raises `RecordingError` for any other RAW file."""
    header, _ = _header(path)
    name = header.get("evt") or header.get("format", "").split(";")[0]
    if name not in EVT_VERSIONS:
        raise RecordingError(f"{path}: found {f'format {name}' if name else 'no format'} in the header; convert it to EVT2 or EVT3")
    return EVT_VERSIONS[name]


def _with_events_outside(path: Path, version: str | None, stream: Any) -> Iterator[NDArray[Any]]:
    """The stream's packets; where faery stops at an event outside the header's geometry, the rest as read without the geometry."""
    given = 0
    try:
        for packet in _converted(path, stream):
            yield packet
            given += len(packet)
        return
    except RecordingError as error:
        if "overflow" not in str(error):
            raise
    with tempfile.TemporaryDirectory(prefix="glideproof-") as folder:
        bare = _without_geometry(path, Path(folder))
        largest = 2**16 - 1
        for packet in _converted(path, _decoder(bare, dimensions_fallback=(largest, largest), version_fallback=version)):
            yield packet[given:]
            given = max(given - len(packet), 0)


def _without_geometry(path: Path, folder: Path) -> Path:
    """A copy of a RAW or DAT file in `folder` whose header tells no sensor size."""
    bare = folder / path.name
    _, size = _header(path)
    with path.open("rb") as source, bare.open("wb") as copy:
        for line in source.read(size).splitlines(keepends=True):
            if not re.search(rb"geometry|height|width", line, re.IGNORECASE):
                copy.write(line)
        shutil.copyfileobj(source, copy)
    return bare


def _checked_to_the_end(path: Path, version: str | None, packets: Iterator[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """The packets, then an error if the file ends inside a word, which faery drops without saying so."""
    yield from packets
    size = path.stat().st_size - _header(path)[1] - (0 if version else BINARY_DAT_HEADER_BYTES)
    if left := size % EVENT_BYTES[version or "dat"]:
        raise RecordingError(f"{path}: the file ends inside an event ({left} bytes of it); it was cut short, all events before it are kept")


def _decoder(path: Path, **options: Any) -> Any:
    """faery's stream of the file."""
    try:
        import faery
    except ModuleNotFoundError as error:
        raise RecordingError(f"{path}: {path.suffix} needs faery, which is not installed: pip install glideproof[recordings]") from error
    try:
        return faery.events_stream_from_file(path, **options)
    except Exception as error:  # faery raises bare Exception for a damaged file
        raise RecordingError(f"{path}: {one_line(error)}; it is damaged, or not of this kind") from error


def _converted(path: Path, packets: Any) -> Iterator[NDArray[Any]]:
    try:
        for packet in packets:
            yield _packet(packet["t"], packet["x"], packet["y"], packet["p"])
    except RuntimeError as error:
        raise RecordingError(f"{path}: damaged here: {one_line(error)}; all events before it are kept") from error


def write_packets(path: str) -> None:
    """Writes a faery file to stdout as npy arrays: its (height, width), its packets, then the bytes of an error's text or none."""
    # numpy takes a file of the operating system by its position, which a pipe has not: it is shown the methods alone.
    out: Any = types.SimpleNamespace(write=sys.stdout.buffer.write)
    text = ""
    try:
        stream = _decoder(Path(path))
        np.lib.format.write_array(out, np.array(stream.dimensions()[::-1]))
        for packet in _converted(Path(path), stream):
            np.lib.format.write_array(out, packet)
    except RecordingError as error:
        text = str(error)
    np.lib.format.write_array(out, np.frombuffer(text.encode(), dtype=np.uint8))


def _read_apart(path: Path) -> Generator[NDArray[Any], None, None]:
    """The arrays that `write_packets` writes in a process of its own. Raises `RecordingError` with its text, or if it breaks down."""
    folders = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(folders)}
    command = [sys.executable, "-c", READER, str(path.resolve())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment) as reader:
        pipe: Any = types.SimpleNamespace(read=reader.stdout.read if reader.stdout else None)
        try:
            while True:
                array = np.lib.format.read_array(pipe)
                if array.dtype == np.uint8:
                    break
                yield array
        except (ValueError, EOFError) as error:
            raise RecordingError(f"{path}: damaged here: faery broke down on it; all events before it are kept") from error
        finally:
            reader.kill()
    if len(array):
        raise RecordingError(array.tobytes().decode())


def _packet(t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> NDArray[Any]:
    packet = np.empty(len(t), dtype=EVENT)
    packet["t"], packet["x"], packet["y"], packet["p"] = t, x, y, p
    return packet


@contextlib.contextmanager
def _read_or_refused(path: Path, wanted: str) -> Iterator[None]:
    """Makes a `RecordingError` of whatever a damaged file makes zipfile, zlib or HDF5 raise: classes of their own, and built-in ones."""
    try:
        yield
    except RecordingError:
        raise
    except Exception as error:
        raise RecordingError(f"{path}: cannot be read ({one_line(error)}); give {wanted}") from error


def _npz_packets(path: Path) -> Iterator[NDArray[Any]]:
    """Reads the four arrays side by side, a packet at a time, without unpacking the whole of one."""
    with _read_or_refused(path, NPZ_WANTED), zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        missing = [name for name in "txyp" if f"{name}.npy" not in names]
        lengths, dtypes = {}, {}
        for name in (name for name in "txyp" if name not in missing):
            with archive.open(f"{name}.npy") as file:
                shape, _, dtypes[name] = _npy_header(file)
            lengths[name] = _column_length(path, name, dtypes[name], shape)
    if missing:
        raise RecordingError(f"{path}: no array {', '.join(missing)}; the arrays t, x, y, p are needed")
    _check_lengths(path, lengths)
    return _npz_read(path, lengths["t"], dtypes)


def _npy_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and dtype of an npy file, which is read to the start of its numbers."""
    read = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
    major, _ = np.lib.format.read_magic(file)
    if major not in read:
        raise ValueError(f"npy format {major}")
    return read[major](file)


def _npz_read(path: Path, length: int, dtypes: dict[str, np.dtype[Any]]) -> Iterator[NDArray[Any]]:
    with contextlib.ExitStack() as stack:
        archive = stack.enter_context(zipfile.ZipFile(path))
        files = {name: stack.enter_context(archive.open(f"{name}.npy")) for name in dtypes}
        for file in files.values():
            _npy_header(file)

        def part(name: str, start: int, stop: int) -> NDArray[Any]:
            wanted = (stop - start) * dtypes[name].itemsize
            numbers = files[name].read(wanted)
            if len(numbers) < wanted:
                raise EOFError(f"{name} ends early")
            return np.frombuffer(numbers, dtype=dtypes[name])

        yield from _column_packets(path, length, part)


def _hdf5_file(path: Path) -> Any:
    """The open HDF5 file. Raises `RecordingError`."""
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise RecordingError(f"{path}: {path.suffix} needs h5py, which is not installed: pip install glideproof[recordings]") from error
    with _read_or_refused(path, HDF5_WANTED):
        return h5py.File(path, "r")


def _hdf5_columns(path: Path, file: Any) -> tuple[Any, dict[str, Any]]:
    """The group, table or file that holds the columns, and the columns t, x, y, p. Raises `RecordingError`."""
    for place in HDF5_GROUPS:
        holder = file if place == "" else file.get(place)
        if hasattr(holder, "dtype") and holder.dtype.names:
            names, column = holder.dtype.names, holder.fields
        elif hasattr(holder, "keys"):
            names, column = tuple(holder), holder.get
        else:
            continue
        if set("txyp") <= set(names):
            columns = {name: column(name) for name in "txyp"}
            if damaged := [name for name in columns if not hasattr(columns[name], "__getitem__")]:
                raise RecordingError(f"{path}: {', '.join(damaged)} cannot be read; the file is damaged")
            return holder, columns
    raise RecordingError(f"{path}: no columns t, x, y, p at the top or in a group 'events'; found {', '.join(file) or 'nothing'}")


def _hdf5_packets(path: Path) -> Iterator[NDArray[Any]]:
    with _read_or_refused(path, HDF5_WANTED), _hdf5_file(path) as file:
        holder, columns = _hdf5_columns(path, file)
        if hasattr(holder, "dtype"):
            lengths = {name: _column_length(path, name, holder.dtype[name], holder.shape) for name in columns}
        else:
            lengths = {name: _column_length(path, name, column.dtype, column.shape) for name, column in columns.items()}
    _check_lengths(path, lengths)
    return _hdf5_read(path, lengths["t"])


def _hdf5_read(path: Path, length: int) -> Iterator[NDArray[Any]]:
    with _hdf5_file(path) as file:
        _, columns = _hdf5_columns(path, file)
        yield from _column_packets(path, length, lambda name, start, stop: columns[name][start:stop])


def _column_length(path: Path, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> int:
    """Length of a column. Raises `RecordingError` unless it is one of whole numbers."""
    if len(shape) != 1 or dtype.kind not in ("iub" if name == "p" else "iu"):
        raise RecordingError(f"{path}: {name} is {dtype} of shape {shape}; give one column of whole numbers (t in us)")
    return math.prod(shape)


def _check_lengths(path: Path, lengths: dict[str, int]) -> None:
    if len(set(lengths.values())) > 1:
        raise RecordingError(f"{path}: arrays of different lengths {lengths}; give one value an event")


def _column_packets(path: Path, length: int, part: Callable[[str, int, int], NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Packets of four columns; `part(name, start, stop)` reads a piece of one. Raises `RecordingError` where a piece is damaged."""
    for start in range(0, length, PACKET_EVENTS):
        stop = min(start + PACKET_EVENTS, length)
        try:
            columns = {name: part(name, start, stop) for name in "txyp"}
        except Exception as error:  # a damaged file fails in zipfile, zlib or HDF5, with classes of their own
            raise RecordingError(
                f"{path}: events {start} to {stop}: {one_line(error)}; damaged, all events before them are kept"
            ) from error
        for name, column in columns.items():
            limits = np.iinfo(EVENT[name])
            if not (limits.min <= int(column.min()) and int(column.max()) <= limits.max):
                found = f"{name} runs from {column.min()} to {column.max()}, beyond {EVENT[name]}"
                raise RecordingError(f"{path}: events {start} to {stop}: {found}; is it damaged?")
        yield _packet(*columns.values())


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
            filled = [(number, line) for number, line in chunk if line.strip()]
            try:
                packet = _csv_parsed([line for _, line in filled], columns)
            except ValueError:
                good = _good_lines(filled, columns)
                yield _csv_parsed([line for _, line in filled[:good]], columns)
                number, line = filled[good]
                found = f"found {line.strip():.60}"
                raise RecordingError(f"{path}: line {number}: {found}; give whole numbers t (us), x, y, p") from None
            yield packet


def _csv_parsed(lines: list[str], columns: tuple[int, ...]) -> NDArray[Any]:
    if not lines:
        return np.empty(0, dtype=EVENT)
    return np.loadtxt(lines, dtype=EVENT, delimiter=",", usecols=columns, comments=None, ndmin=1)


def _good_lines(lines: list[tuple[int, str]], columns: tuple[int, ...]) -> int:
    """How many lines stand before the first faulty one: the largest part of the lines that can be parsed, found by halving."""
    good, faulty = 0, len(lines)
    while faulty - good > 1:
        middle = (good + faulty) // 2
        try:
            _csv_parsed([line for _, line in lines[:middle]], columns)
            good = middle
        except ValueError:
            faulty = middle
    return good

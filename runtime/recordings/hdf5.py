"""HDF5 files: columns t, x, y, p in some group, or a table of them, compound or with four columns.

Where a file holds more than one such group, as those of stereo rigs do, one at the top, in `events` or in `CD` is taken before others, and
else the first by name; `Notes` tells which. Links are not followed. Names, orders and units are those of `runtime.recordings.columns`. A
scalar `t_offset` beside the columns, or in a group above them, is added to the times (DSEC).

A column may be compressed by any filter that h5py or hdf5plugin brings. One that is missing is named before anything is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401  registers its filters
import numpy as np
from numpy.typing import NDArray

from runtime.recordings.columns import Block, check_lengths, columns_of, length_of, table_packets
from runtime.recordings.header import header_shape
from runtime.recordings.packet import PACKET_EVENTS, Notes, RecordingError, damaged_at, read_or_refused

WANTED = "an HDF5 file with columns t, x, y, p"
PREFERRED = ("/", "/events", "/CD/events")
"""Where events are looked for first: at the top, as DSEC has them, as Prophesee has them."""
MOST_OBJECTS, DEEPEST = 10_000, 8
"""Groups and columns that are looked at, and how deep."""
KNOWN_FILTERS = {36_559: "Prophesee's ECF; metavision_file_to_csv converts the file, or install the hdf5_ecf plugin"}


@dataclass(frozen=True)
class Events:
    """Where in an open file the events are: a group with columns, or a table; its columns by name, none if they have no names."""

    holder: Any
    columns: dict[str, str]
    unit: str

    def column(self, name: str) -> Any:
        """A column, or a view of one."""
        return self.holder.fields(self.columns[name]) if isinstance(self.holder, h5py.Dataset) else self.holder[self.columns[name]]

    @property
    def stored(self) -> list[Any]:
        """The datasets that are read."""
        return [self.holder] if isinstance(self.holder, h5py.Dataset) else [self.holder[name] for name in self.columns.values()]


def sensor_shape(path: Path) -> tuple[int, int] | None:
    """(height, width) from attributes of those names, or `geometry` 640x480, beside the events or at the top."""
    with read_or_refused(path, WANTED), h5py.File(path, "r") as file:
        for holder in (_events(path, file).holder, file):
            said = {name: str(holder.attrs[name]) for name in ("height", "width", "geometry") if name in holder.attrs}
            if shape := header_shape(said):
                return shape
    return None


def packets(path: Path, notes: Notes) -> Iterator[NDArray[Any]]:
    """The file's events. Raises `RecordingError`: at once for columns that are not events, while reading where it is damaged."""
    with read_or_refused(path, WANTED), h5py.File(path, "r") as file:
        events = _events(path, file)
        for dataset in events.stored:
            _check_filters(path, dataset)
        length, offset = _length(path, events), _offset(path, events.holder)
        notes.place = events.holder.name
    return _packets(path, length, offset, events.unit, notes)


def _packets(path: Path, length: int, offset: int, unit: str, notes: Notes) -> Iterator[NDArray[Any]]:
    with h5py.File(path, "r") as file:
        yield from table_packets(path, _blocks(path, _events(path, file), length), unit, notes, offset)


def _blocks(path: Path, events: Events, length: int) -> Iterator[tuple[int, Block | NDArray[Any]]]:
    for start in range(0, length, PACKET_EVENTS):
        stop = min(start + PACKET_EVENTS, length)
        try:
            if events.columns:
                block = {name: events.column(name)[start:stop] for name in "txyp"}
            else:
                block = events.holder[start:stop] if events.holder.shape[1] == 4 else events.holder[:, start:stop].T
        except Exception as error:  # a damaged file fails in HDF5, with built-in classes
            raise damaged_at(path, start, stop, error) from error
        yield start, block


def _events(path: Path, file: Any) -> Events:
    """Where the events are. Raises `RecordingError` if there are none."""
    found = {events.holder.name: events for events in _candidates(file, [MOST_OBJECTS], DEEPEST)}
    if not found:
        held = ", ".join(file) or "nothing"
        raise RecordingError(f"{path}: no columns t, x, y, p at the top or in a group 'events'; found {held}")
    return found[next((name for name in PREFERRED if name in found), min(found))]


def _candidates(group: Any, objects_left: list[int], depth: int) -> Iterator[Events]:
    """All groups and tables in a group that hold events."""
    members = {name: group[name] for name in group if isinstance(group.get(name, getlink=True), h5py.HardLink)}
    columns, unit = columns_of(name for name, member in members.items() if isinstance(member, h5py.Dataset))
    if len(columns) == 4:
        yield Events(group, columns, unit)
    for name, member in members.items():
        objects_left[0] -= 1
        if isinstance(member, h5py.Group) and depth and objects_left[0] > 0:
            yield from _candidates(member, objects_left, depth - 1)
        if isinstance(member, h5py.Dataset):
            columns, unit = columns_of(member.dtype.names or ())
            if len(columns) == 4:
                yield Events(member, columns, unit)
            elif name.startswith("event") and len(member.shape or ()) == 2 and 4 in member.shape:
                yield Events(member, {}, "")


def _length(path: Path, events: Events) -> int:
    """Number of events. Raises `RecordingError` unless there are four columns of numbers, equally long."""
    if not events.columns:
        columns_first = events.holder.shape[1] != 4
        return length_of(path, events.holder.name, events.holder.dtype, events.holder.shape[columns_first:][:1])
    if isinstance(events.holder, h5py.Dataset):
        types = {name: events.holder.dtype[column] for name, column in events.columns.items()}
        lengths = {name: length_of(path, name, types[name], events.holder.shape) for name in "txyp"}
    else:
        stored = {name: events.holder[column] for name, column in events.columns.items()}
        lengths = {name: length_of(path, name, stored[name].dtype, stored[name].shape) for name in "txyp"}
    check_lengths(path, lengths)
    return lengths["t"]


def _check_filters(path: Path, dataset: Any) -> None:
    """Raises `RecordingError` if a filter that the dataset was written with is missing."""
    settings = dataset.id.get_create_plist()
    for place in range(settings.get_nfilters()):
        code, _, _, name = settings.get_filter(place)
        if not h5py.h5z.filter_avail(code):
            known = KNOWN_FILTERS.get(code, f"{name.decode(errors='replace') or 'no name'}; install the HDF5 plugin that brings it")
            raise RecordingError(f"{path}: {dataset.name} is compressed by the HDF5 filter {code}, which is missing: {known}")


def _offset(path: Path, holder: Any) -> int:
    """What `t_offset` beside the events or above them says must be added to their times, in their unit; 0 if there is none."""
    group: Any = holder.parent if isinstance(holder, h5py.Dataset) else holder
    while True:
        value = group["t_offset"][()] if "t_offset" in group else group.attrs.get("t_offset")
        if value is not None:
            numbers = np.atleast_1d(value)
            if len(numbers) != 1 or numbers.dtype.kind not in "iuf" or numbers[0] != np.rint(numbers[0]):
                raise RecordingError(f"{path}: t_offset is {value!r}; give one whole number")
            return int(numbers[0])
        if group.name == "/":
            return 0
        group = group.parent

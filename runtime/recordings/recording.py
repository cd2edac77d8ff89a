"""Events from a recording, packet by packet, for the scripts and commands. A file's suffix names its reader in `runtime.recordings`:

| suffix | reader | sensor size |
|---|---|---|
| `.raw` | `raw`: Prophesee EVT2, EVT2.1, EVT3 | from the header |
| `.dat` | `dat`: Prophesee | from the header |
| `.aedat4` | `aedat4`: iniVation | in the file |
| `.es` | `es`, by faery | in the file |
| `.h5`, `.hdf5` | `hdf5`, by h5py | attributes, or none |
| `.npz`, `.npy` | `npz` | none |
| `.csv`, `.txt`, `.tsv` | `text` | in a line above the events, or none |

Every reader has the functions `sensor_shape(path)` and `packets(path, notes)`. Times are in us, x is the column and y the row from the top
left. What the readers need comes with the extra `recordings`; a package that is missing keeps out its own formats alone. Every kind is
read in constant memory, in the file's order; times that go back or jump are left to `runtime.runs`, which says what they mean.

No event is lost without a word: what was good before a fault is given before the fault is raised, and what a reader drops or doubts is
counted in `Notes`. A RAW or DAT file that ends inside an event is an error at its end; one cut between two events cannot be told from a
shorter recording. Events outside the sensor are given, and `runtime.frames` counts them.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from runtime.recordings.packet import EVENT, PACKET_EVENTS, Notes, RecordingError

__all__ = ["EVENT", "PACKET_EVENTS", "READERS", "Notes", "RecordingError", "read_events", "sensor_shape"]

READERS = {
    ".raw": "raw",
    ".dat": "dat",
    ".aedat4": "aedat4",
    ".es": "es",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".npz": "npz",
    ".npy": "npz",
    ".csv": "text",
    ".txt": "text",
    ".tsv": "text",
}
"""Modules of `runtime.recordings`, by suffix in small letters."""
SIZE_IN_HEADER = (".raw", ".dat")
"""A camera's own files: without a size in the header or from the caller, their events cannot be judged."""
OTHER_KINDS = {
    ".aedat": "iniVation's DV converts older AEDAT files to AEDAT4",
    **dict.fromkeys((".bag", ".db3", ".mcap"), "event_camera_py reads the events of ROS bags: save them as npz"),
    **dict.fromkeys((".zip", ".gz", ".7z"), "unpack it"),
    ".mat": "save its columns as npz or CSV",
}
"""What to do with a file of some other kinds."""


def read_events(path: str | Path, shape: tuple[int, int] | None = None, notes: Notes | None = None) -> Iterator[NDArray[Any]]:
    """The recording's events as packets, arrays of dtype `EVENT`, in the file's order.

    `shape`: the (height, width) that is expected; needed for a RAW or DAT file whose header does not tell it. Where the file
    tells no size, events outside `shape` are left to `runtime.frames`, which counts them. `notes` is filled while reading.

    Raises `RecordingError`, at once, if the file is missing, of an unknown kind or for another sensor size than `shape`, or if
    a package is needed and missing; and while reading, where the data break off or are not numbers.
    """
    path = Path(path)
    declared = sensor_shape(path)
    if declared is not None and shape is not None and declared != tuple(shape):
        sizes = f"recorded by a sensor of {declared[1]}x{declared[0]} px, expected {shape[1]}x{shape[0]}"
        raise RecordingError(f"{path}: {sizes}; take a recording of that size, or a scene of this one")
    if declared is None and shape is None and path.suffix.lower() in SIZE_IN_HEADER:
        raise RecordingError(f"{path}: the header tells no sensor size; give the (height, width)")
    return _reader(path).packets(path, Notes() if notes is None else notes)


def sensor_shape(path: str | Path) -> tuple[int, int] | None:
    """The sensor's (height, width) as the file tells it, or None if it does not. Raises `RecordingError`."""
    path = Path(path)
    if not path.is_file():
        found = "is no file but a folder, a device or a pipe" if path.exists() else "no such file"
        raise RecordingError(f"{path}: {found}; give the path of a recording")
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty; record or copy it again")
    return _reader(path).sensor_shape(path)


def _reader(path: Path) -> Any:
    """The module that reads files of this suffix. Raises `RecordingError` if there is none, or if a package that it needs is missing."""
    suffix = path.suffix.lower()
    if suffix not in READERS:
        converted = f"; {OTHER_KINDS[suffix]}" if suffix in OTHER_KINDS else ""
        raise RecordingError(f"{path}: unknown kind {path.suffix!r}; known are {', '.join(READERS)}{converted}")
    try:
        return importlib.import_module(f"runtime.recordings.{READERS[suffix]}")
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        raise RecordingError(f"{path}: {suffix} needs {missing}, which is not installed: pip install glideproof[recordings]") from error

"""What every reader of recordings gives and raises: packets of events, notes, and errors of one line."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import one_line

EVENT = np.dtype([("t", np.int64), ("x", np.int32), ("y", np.int32), ("p", np.int8)])
"""What a packet holds: time (us), column, row, polarity."""

PACKET_EVENTS = 65_536
"""Events in a packet of a file of columns; other kinds have packets of their own length."""


class RecordingError(ValueError):
    """A recording that cannot be read. One line: the file, what was found, what to do."""


@dataclass
class Notes:
    """What a reader has to tell of a recording that it could read."""

    place: str = ""
    """Where in the file the events are, if it could hold several."""
    order: str = ""
    """The order of its columns, if they have no names."""
    unit: str = "us"
    """The unit that its times were taken to be in."""
    counts: Counter[str] = field(default_factory=Counter)
    """What was found wrong with it, and how often."""

    @property
    def layout(self) -> str:
        """How the file was understood: "/davis/left/events, columns x, y, t, p, t in s"."""
        order = f"columns {', '.join(self.order)}" if self.order else ""
        return ", ".join(filter(None, [self.place, order, f"t in {self.unit}"]))


def packet_of(t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> NDArray[Any]:
    """The events as one array of dtype `EVENT`."""
    packet = np.empty(len(t), dtype=EVENT)
    packet["t"], packet["x"], packet["y"], packet["p"] = t, x, y, p
    return packet


def damaged_at(path: Path, start: int, stop: int, error: Exception) -> RecordingError:
    """The error to raise where the columns of these events cannot be read."""
    return RecordingError(f"{path}: events {start} to {stop}: {one_line(error)}; damaged, all events before them are kept")


@contextlib.contextmanager
def read_or_refused(path: Path, wanted: str) -> Iterator[None]:
    """Makes a `RecordingError` of whatever a damaged file makes zipfile, zlib or HDF5 raise: classes of their own, and built-in ones."""
    try:
        yield
    except RecordingError:
        raise
    except Exception as error:
        raise RecordingError(f"{path}: cannot be read ({one_line(error)}); give {wanted}") from error

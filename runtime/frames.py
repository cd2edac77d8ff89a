"""Binary frames at a constant rate from a stream of events.

An event is a row of a structured array with the fields `t` (us), `x` (column), `y` (row) and `p` (polarity). The frame of the
window [start, start + window_us) lights every pixel in which at least one event of either polarity fell. Windows start at
the first event and then every step_us, whether anything happens in them or not.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]

LARGEST_TIME_US = 2**61
"""Times and windows beyond this are refused, so that the end of a window is always an int64."""

LARGEST_SIDE_PX = 16384
"""Largest height and width of a frame, as in `runtime.scene`: a frame is memory, whatever a recording's header says."""

LARGEST_RESULT_BYTES = 2**32
"""What `events_to_frames` may hold at once; `FrameStream` has no such limit, as it holds one frame at a time."""


class EventError(ValueError):
    """Events, or the size of a window, that cannot be used. One line: the field, what was found, what to do."""


class FrameStream:
    """Windows of events as frames, in order of time.

    `shape`: (height, width) px. `window_us`: length of a window. `step_us`: from one window's start to the next one's, by
    default `window_us`; less makes windows overlap; more is refused, since the events between two windows would be lost.

    `feed` takes a packet and gives an iterator over the frames that it completes: those whose window ends at or before the
    latest event so far. Sorted events give the same frames however they are divided into packets. The first window starts
    at the earliest event of the first packet that has one. What an iterator has not yet given, the next one gives.

    No event is lost without being counted:

    - `outside_events`: x or y lies outside the sensor. Such an event lights nothing and its time is not looked at.
    - `unsorted_events`: older than one that came before it. It is used if some window that holds it is still to come.
    - `late_events`: no window that holds it is still to come, so it could not be used.

    Memory: the events of the windows still open, and one frame; a gap in time, however long, costs none.
    Raises `EventError` for a size that is not positive, and from `feed` for events without the fields above.
    """

    def __init__(self, shape: tuple[int, int], window_us: int, step_us: int | None = None) -> None:
        """Checks the sizes: raises `EventError`."""
        height, width = (_positive(f"shape[{place}]", side, LARGEST_SIDE_PX) for place, side in enumerate(shape))
        self.shape = height, width
        self.window_us = _positive("window_us", window_us)
        self.step_us = self.window_us if step_us is None else _positive("step_us", step_us)
        if self.step_us > self.window_us:
            raise EventError(
                f"step_us: found {self.step_us}, above window_us {self.window_us}; "
                "events between windows would be lost: take a smaller step and skip frames"
            )
        self.late_events = 0
        self.unsorted_events = 0
        self.outside_events = 0
        self._next_start_us: int | None = None
        self._latest_us = 0
        self._pending: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []

    def feed(self, events: NDArray[Any]) -> Iterator[tuple[int, Frame]]:
        """Takes a packet at once and gives the frames that are now complete, as (start_us, frame). Raises `EventError`.

        frame: uint8 (height, width) of {0, 1}, the caller's own.
        """
        self._take(*self._inside(events))
        return self._frames(lambda start: start + self.window_us <= self._latest_us)

    def flush(self) -> Iterator[tuple[int, Frame]]:
        """Gives every remaining frame whose window starts at or before the latest event; the stream may be fed further."""
        return self._frames(lambda start: start <= self._latest_us)

    def frames(self, packets: Iterable[NDArray[Any]]) -> Iterator[tuple[int, Frame]]:
        """Feeds every packet, then flushes: all frames of a recording, one at a time."""
        for packet in packets:
            yield from self.feed(packet)
        yield from self.flush()

    def _inside(self, events: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Times and flat pixel numbers of the events on the sensor; counts the others."""
        t, x, y = _checked(events)
        height, width = self.shape
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        self.outside_events += int(len(inside) - np.count_nonzero(inside))
        return t[inside], y[inside] * width + x[inside]

    def _take(self, t: NDArray[np.int64], pixels: NDArray[np.int64]) -> None:
        """Counts and keeps the events that some window still to come can hold."""
        if len(t) == 0:
            return
        if self._next_start_us is None:
            self._next_start_us, self._latest_us = int(t.min()), int(t[0])
        latest_before = np.maximum.accumulate(np.concatenate([[self._latest_us], t]))
        self.unsorted_events += int(np.count_nonzero(t < latest_before[:-1]))
        self._latest_us = int(latest_before[-1])
        usable = t >= self._next_start_us
        self.late_events += int(len(t) - np.count_nonzero(usable))
        self._pending.append((t[usable], pixels[usable]))

    def _frames(self, due: Callable[[int], bool]) -> Iterator[tuple[int, Frame]]:
        # The stream moves on before each yield, so that an iterator may be left at any point and another one go on.
        while self._next_start_us is not None and due(self._next_start_us):
            start = self._next_start_us
            t, pixels = self._sorted_pending()
            first, past, kept = np.searchsorted(t, [start, start + self.window_us, start + self.step_us])
            frame = np.zeros(self.shape, dtype=np.uint8)
            frame.reshape(-1)[pixels[first:past]] = 1
            self._next_start_us = start + self.step_us
            self._pending = [(t[kept:], pixels[kept:])]
            yield start, frame

    def _sorted_pending(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The events kept, in order of time."""
        if len(self._pending) == 1 and np.all(self._pending[0][0][:-1] <= self._pending[0][0][1:]):
            return self._pending[0]
        t, pixels = (np.concatenate(columns) for columns in zip(*self._pending, strict=True))
        order = np.argsort(t, kind="stable")
        return t[order], pixels[order]


def events_to_frames(
    events: NDArray[Any], shape: tuple[int, int], window_us: int, step_us: int | None = None
) -> tuple[NDArray[np.int64], Frame]:
    """All frames of one array of events, sorted or not: `FrameStream` in one call.

    Returns the windows' starts, (frames,) us, and the frames, uint8 (frames, height, width). Every event is used: one outside
    the sensor is an `EventError`, as is a recording whose frames would need more than `LARGEST_RESULT_BYTES`.
    """
    stream = FrameStream(shape, window_us, step_us)
    complete = stream.feed(events)
    if stream.outside_events:
        outside = stream.outside_events
        raise EventError(f"x, y: found {outside} events outside a sensor of shape {shape}; give the recording's (height, width)")
    t = events["t"]
    count = (int(t.max()) - int(t.min())) // stream.step_us + 1 if len(t) else 0
    height, width = stream.shape
    if count * height * width > LARGEST_RESULT_BYTES:
        raise EventError(f"t: found events over {count} windows, too many to hold at once; use FrameStream, which gives them one by one")
    starts = np.empty(count, dtype=np.int64)
    frames = np.empty((count, height, width), dtype=np.uint8)
    for position, (start, frame) in enumerate(itertools.chain(complete, stream.flush())):
        starts[position], frames[position] = start, frame
    return starts, frames


def _positive(name: str, value: int, largest: int = LARGEST_TIME_US) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if not 0 < number <= largest:
        raise EventError(f"{name}: found {value!r}; give a whole number above 0, at most {largest}")
    return number


def _checked(events: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """t, x and y as int64. Raises `EventError` unless the four fields are there and hold whole numbers."""
    fields: Any = events.dtype.fields if isinstance(events, np.ndarray) and events.ndim == 1 else None
    if fields is None:
        raise EventError(f"events: found {type(events).__name__}; give a one-dimensional structured array with fields t, x, y, p")
    for name, kinds in (("t", "iu"), ("x", "iu"), ("y", "iu"), ("p", "iub")):
        # A field may also go by its title, as the polarity of faery's events does.
        if name not in fields:
            raise EventError(f"events: no field {name!r} among {', '.join(fields)}; the fields t, x, y, p are needed")
        if fields[name][0].kind not in kinds:
            raise EventError(f"{name}: found {fields[name][0]}; give whole numbers (t in us, x and y in px)")
    t = events["t"]
    if len(t) and max(abs(int(t.min())), abs(int(t.max()))) > LARGEST_TIME_US:
        raise EventError(f"t: found {t.min()} to {t.max()}; give microseconds within plus-minus 2**61")
    return t.astype(np.int64), events["x"].astype(np.int64), events["y"].astype(np.int64)

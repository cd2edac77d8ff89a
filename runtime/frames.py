"""Binary frames at a constant rate from a stream of events.

An event is a row of a structured array with the fields `t` (us), `x` (column), `y` (row) and `p` (polarity). The frame of the
window [start, start + window_us) lights every pixel in which at least one event of either polarity fell. Windows start at
the first event and then every step_us, whether anything happens in them or not, for as long as the camera's clock runs on: where it
breaks, a new run of windows starts at the first event after the break (`runtime.runs` has the rule).
"""

from __future__ import annotations

import operator
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.runs import STRETCH_STEP_BACK_US, ClockRuns, Piece, Place

Frame = NDArray[np.uint8]

LARGEST_TIME_US = 2**61
"""Times and windows beyond this are refused, so that the end of a window is always an int64."""

LARGEST_GAP_US = 5_000_000
"""Default of the longest pause that is filled with empty windows: well below half of the shortest clock that cameras have, EVT3's of
24 bits or 16.8 s, so that a pause and a clock that wraps or goes back are never confused; 125 windows of 40 ms at most."""

MOST_BREAKS = 100
"""Breaks of the clock that a stream remembers; it counts all."""

LARGEST_SIDE_PX = 16384
"""Largest height and width of a frame, as in `runtime.scene`: a frame is memory, whatever a recording's header says."""

LARGEST_RESULT_BYTES = 2**32
"""What `events_to_frames` may hold at once; `FrameStream` has no such limit, as it holds one frame at a time."""


class EventError(ValueError):
    """Events, or the size of a window, that cannot be used. One line: the field, what was found, what to do."""


@dataclass(frozen=True)
class Break:
    """Where the clock broke: the latest time before it and the first one after it, us."""

    before_us: int
    after_us: int


@dataclass
class _Run:
    """The windows of one run of the clock: its number, where the next window starts, the latest event (us), and the events kept."""

    number: int
    next_start_us: int
    latest_us: int
    given: bool = False
    events: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = field(default_factory=list)

    def sorted_events(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The events kept, in order of time."""
        if len(self.events) == 1 and np.all(self.events[0][0][:-1] <= self.events[0][0][1:]):
            return self.events[0]
        t, pixels = (np.concatenate(columns) for columns in zip(*self.events, strict=True))
        order = np.argsort(t, kind="stable")
        return t[order], pixels[order]


class FrameStream:
    """Windows of events as frames, in order of arrival, and within a run of the clock in order of time.

    `shape`: (height, width) px. `window_us`: length of a window. `step_us`: from one window's start to the next one's, by
    default `window_us`; less makes windows overlap; more is refused, since the events between two windows would be lost.
    `largest_gap_us`: a pause up to this is filled with empty windows; after a longer one, as after a clock that goes back, a new run
    of windows begins.

    `feed` takes a packet and gives an iterator over the frames that it completes: those whose window ends at or before the
    run's latest event, and at a break of the clock all that the run has left. Events sorted within their run give the same frames
    however they are divided into packets. The first window of a run starts at the earliest event of the first packet that has one of
    it. What an iterator has not yet given, the next one gives.

    No event is lost without being counted:

    - `outside_events`: x or y lies outside the sensor. Such an event lights nothing and its time is not looked at.
    - `unsorted_events`: older than one of its run that came before it. It is used if some window that holds it is still to come.
    - `late_events`: no window that holds it is still to come, so it could not be used.
    - `misdated_events`: its time is contradicted by the events around it; it is in no window. A doubtful time delays no frame by more
      than `runtime.runs` says, and no single event brings more than `largest_gap_us` of empty windows.

    `run` is the number, from 0, of the run of the frame given last: a tracker starts anew when it changes. `runs` counts those begun;
    `breaks` tells where the first `MOST_BREAKS` of the others began.

    Memory: the events of the windows still open and those whose times are doubtful, and one frame; a gap in time costs none.
    Raises `EventError` for a size that is not positive, and from `feed` for events without the fields above.
    """

    def __init__(self, shape: tuple[int, int], window_us: int, step_us: int | None = None, *, largest_gap_us: int = LARGEST_GAP_US) -> None:
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
        self.largest_gap_us = _positive("largest_gap_us", largest_gap_us)
        self.late_events = 0
        self.unsorted_events = 0
        self.outside_events = 0
        self.run = 0
        self.breaks: list[Break] = []
        self._clock = ClockRuns(self.largest_gap_us)
        self._open: deque[_Run] = deque()

    @property
    def runs(self) -> int:
        """Runs of the clock so far: 1 as long as it has not broken, 0 before the first event."""
        return self._open[-1].number + 1 if self._open else 0

    @property
    def misdated_events(self) -> int:
        """Events whose times are contradicted by those around them."""
        return self._clock.misdated_events

    def feed(self, events: NDArray[Any]) -> Iterator[tuple[int, Frame]]:
        """Takes a packet at once and gives the frames that are now complete, as (start_us, frame). Raises `EventError`.

        frame: uint8 (height, width) of {0, 1}, the caller's own.
        """
        t, pixels = self._inside(events)
        if len(t):
            self._take(self._clock.feed(t, pixels))
        return self._frames(lambda run: run.next_start_us + self.window_us <= run.latest_us)

    def flush(self) -> Iterator[tuple[int, Frame]]:
        """Gives every remaining frame whose window starts at or before the latest event; the stream may be fed further."""
        self._take(self._clock.flush())
        return self._frames(lambda run: run.next_start_us <= run.latest_us)

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

    def _take(self, pieces: list[Piece]) -> None:
        """Sorts the believed pieces of a packet into runs. A run that begins in it starts at its earliest event in the packet."""
        begun: _Run | None = None
        for place, t, pixels in pieces:
            if place is not Place.CONTINUES:
                begun = self._begin(place, t)
            run = self._open[-1]
            if run is begun:
                run.next_start_us = min(run.next_start_us, int(t.min()))
            self._keep(run, t, pixels)

    def _begin(self, place: Place, t: NDArray[np.int64]) -> _Run:
        first_us, number = int(t[0]), self.runs
        if place is Place.REPLACES:
            # The windows that the wrong run has not given are withdrawn; if it gave none, it never was.
            wrong = self._open.pop()
            number -= not wrong.given
            before_us = wrong.latest_us if wrong.given else None
        else:
            before_us = self._open[-1].latest_us if self._open else None
        if before_us is not None and len(self.breaks) < MOST_BREAKS:
            self.breaks.append(Break(before_us, first_us))
        self._open.append(_Run(number, first_us, first_us))
        return self._open[-1]

    def _keep(self, run: _Run, t: NDArray[np.int64], pixels: NDArray[np.int64]) -> None:
        """Counts and keeps the events that some window still to come can hold."""
        latest_before = np.maximum.accumulate(np.concatenate([[run.latest_us], t]))
        self.unsorted_events += int(np.count_nonzero(t < latest_before[:-1]))
        run.latest_us = int(latest_before[-1])
        usable = t >= run.next_start_us
        self.late_events += int(len(t) - np.count_nonzero(usable))
        run.events.append((t[usable], pixels[usable]))

    def _frames(self, due: Callable[[_Run], bool]) -> Iterator[tuple[int, Frame]]:
        # The stream moves on before each yield, so that an iterator may be left at any point and another one go on.
        while self._open:
            run = self._open[0]
            ended = len(self._open) > 1
            if run.next_start_us <= run.latest_us if ended else due(run):
                yield self._next_frame(run)
            elif ended:
                self._open.popleft()
            else:
                return

    def _next_frame(self, run: _Run) -> tuple[int, Frame]:
        start = run.next_start_us
        t, pixels = run.sorted_events()
        first, past, kept = np.searchsorted(t, [start, start + self.window_us, start + self.step_us])
        frame = np.zeros(self.shape, dtype=np.uint8)
        frame.reshape(-1)[pixels[first:past]] = 1
        run.next_start_us, run.events, run.given = start + self.step_us, [(t[kept:], pixels[kept:])], True
        self.run = run.number
        return start, frame

    def windows_left(self) -> int:
        """How many frames `flush` would give now, apart from doubtful events."""
        return sum(max(0, (run.latest_us - run.next_start_us) // self.step_us + 1) for run in self._open)


def events_to_frames(
    events: NDArray[Any], shape: tuple[int, int], window_us: int, step_us: int | None = None, *, largest_gap_us: int = LARGEST_GAP_US
) -> tuple[NDArray[np.int64], Frame]:
    """All frames of one array of events, sorted or not: `FrameStream` in one call.

    Returns the windows' starts, (frames,) us, and the frames, uint8 (frames, height, width). Every event is used: one outside
    the sensor is an `EventError`, as is one whose time its neighbours contradict, a clock that breaks, and a recording whose frames
    would need more than `LARGEST_RESULT_BYTES`.
    """
    stream = FrameStream(shape, window_us, step_us, largest_gap_us=largest_gap_us)
    t = _checked(events)[0]
    stream.feed(events[np.argsort(t, kind="stable")] if _in_no_order(t) else events)
    frames_left = stream.flush()
    _check_all_used(stream)
    count = stream.windows_left()
    height, width = stream.shape
    if count * height * width > LARGEST_RESULT_BYTES:
        raise EventError(f"t: found events over {count} windows, too many to hold at once; use FrameStream, which gives them one by one")
    starts = np.empty(count, dtype=np.int64)
    frames = np.empty((count, height, width), dtype=np.uint8)
    for position, (start, frame) in enumerate(frames_left):
        starts[position], frames[position] = start, frame
    return starts, frames


def _in_no_order(t: NDArray[np.int64]) -> bool:
    """Whether time goes back so far so often that the order is not one of arrival: a clock breaks now and then, not every tenth event."""
    return 10 * int(np.count_nonzero(np.diff(t) < -STRETCH_STEP_BACK_US)) >= len(t) > 1


def _check_all_used(stream: FrameStream) -> None:
    if stream.outside_events:
        outside = stream.outside_events
        raise EventError(f"x, y: found {outside} events outside a sensor of shape {stream.shape}; give the recording's (height, width)")
    if stream.misdated_events or stream.runs > 1:
        found = f"{stream.misdated_events} events at times that their neighbours contradict, and {stream.runs} runs of the clock"
        reason = f"apart by more than largest_gap_us {stream.largest_gap_us}, or going back"
        raise EventError(f"t: found {found}, {reason}; use FrameStream, which counts and parts them, or sort the events")


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

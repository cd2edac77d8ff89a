"""Runs of a camera's clock: which times of a stream of events are believed, and where the clock breaks.

Cameras deliver wrong times: single events (0 before microseconds since 1970, a flipped bit), short blocks of them, clocks that go back
to 0 when the camera restarts, and pauses. In the order of arrival, a step of time ahead by more than `LARGEST_STEP_AHEAD_US`, or back by
more than half of that, begins a new *stretch* of events. A stretch whose first event is near the run's latest one, ahead by no more than
`LARGEST_STEP_AHEAD_US` or back by no more than `LARGEST_STEP_BACK_US`, belongs to the run. Any other is doubtful, and kept back until
later events judge it:

- A stretch near the run's latest event contradicts it: all its events are misdated, counted and dropped.
- Once it is as long as `CONFIRMING_EVENTS` and `CONFIRMING_US` it is believed. If it lies ahead of the run by no more than
  `largest_gap_us`, that was a pause, and the run goes on after it. Else the clock broke, and a new run begins. A run that was itself
  never that long is then the wrong one: what is left of it is dropped, and all its events are misdated.

So no single event moves the clock, and what is doubtful waits for `CONFIRMING_EVENTS` events or `CONFIRMING_US`, whichever comes last,
and never for more than `MOST_DOUBTFUL_EVENTS`. A stretch that begins near a doubtful one, or after it within the gap, is counted with it:
events that are sparse, or come in groups, confirm each other. The first events of a stream are a run at once, as nothing contradicts
them.
"""

from __future__ import annotations

import enum
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

LARGEST_STEP_AHEAD_US = 40_000
"""A longer step ahead is doubted: it would end windows and make what follows late, on the word of one event. Events that a simulator
stamps with the times of video frames, 25 or more a second, step by less."""

LARGEST_STEP_BACK_US = 100_000
"""A shorter step back is disorder, not a restart: a driver's packets, 1 to 33 ms long, that come out of their turn."""

STRETCH_STEP_BACK_US = LARGEST_STEP_AHEAD_US // 2
"""A longer step back begins a stretch: the run's next event after a doubtful one must not pass for one of its kind."""

CONFIRMING_EVENTS = 16
"""A stretch with fewer events is not believed against the run: wrong times come one by one, or in short blocks."""

CONFIRMING_US = 10_000
"""Nor is a shorter one: a wrong TIME_HIGH word of a Prophesee sensor misdates up to 4096 us of events."""

MOST_DOUBTFUL_EVENTS = 2**20
"""A stretch with so many events is believed even if its time stands still: memory is bounded."""

Times = NDArray[np.int64]
Pixels = NDArray[np.int64]


class Place(enum.Enum):
    """Where a piece of the stream belongs."""

    CONTINUES = enum.auto()
    """To the run so far."""
    BEGINS = enum.auto()
    """To a new run: the clock broke before it."""
    REPLACES = enum.auto()
    """To a new run, and the run so far was the wrong one."""


Piece = tuple[Place, Times, Pixels]


@dataclass
class Stretch:
    """Events in a row whose times agree: their number, earliest and latest time (us), first and latest arrivals."""

    first_us: int
    earliest_us: int
    latest_us: int
    count: int
    pieces: list[tuple[Times, Pixels]] = field(default_factory=list)

    def extend(self, other: Stretch) -> None:
        """Takes the events of a stretch that follows."""
        self.earliest_us = min(self.earliest_us, other.earliest_us)
        self.latest_us = max(self.latest_us, other.latest_us)
        self.count += other.count
        self.pieces += other.pieces

    @property
    def believed(self) -> bool:
        """Long enough to be believed whatever came before."""
        spans = self.latest_us - self.earliest_us >= CONFIRMING_US
        return (self.count >= CONFIRMING_EVENTS and spans) or self.count >= MOST_DOUBTFUL_EVENTS

    def near(self, time_us: int) -> bool:
        """Whether an event of that time agrees with the latest one."""
        return self.latest_us - LARGEST_STEP_BACK_US <= time_us <= self.latest_us + LARGEST_STEP_AHEAD_US


class ClockRuns:
    """Parts a stream of events, packet by packet, into runs of the camera's clock. `misdated_events` counts what no run has.

    `feed` and `flush` give the pieces of the stream that are now believed, in order of arrival.
    """

    def __init__(self, largest_gap_us: int) -> None:
        self.misdated_events = 0
        self._largest_gap_us = largest_gap_us
        self._run: Stretch | None = None
        self._doubtful: Stretch | None = None
        self._last_us = 0
        self._given: list[Piece] = []

    def feed(self, t: Times, pixels: Pixels) -> list[Piece]:
        """Takes a packet that has events."""
        steps = t[1:] - t[:-1]
        follows = _agrees(int(t[0]) - self._last_us)
        if len(steps) == 0 or (_agrees(int(steps.max())) and _agrees(int(steps.min()))):
            self._judge(Stretch(int(t[0]), int(t.min()), int(t.max()), len(t), [(t, pixels)]), follows)
        else:
            for number, stretch in enumerate(_stretches(t, pixels, steps)):
                self._judge(stretch, follows and number == 0)
        self._last_us = int(t[-1])
        return self._taken()

    def flush(self) -> list[Piece]:
        """At the end of the stream: what is doubtful is believed if it lies after the run, or is longer than a run not believed."""
        run, doubtful, self._doubtful = self._run, self._doubtful, None
        if run is not None and doubtful is not None:
            if self._is_pause(run, doubtful) or (not run.believed and doubtful.count > run.count):
                self._believe(run, doubtful)
            else:
                self.misdated_events += doubtful.count
                self._last_us = run.latest_us
        return self._taken()

    def _judge(self, stretch: Stretch, follows: bool) -> None:
        """Takes the next stretch, which may follow on the event before it."""
        run = self._run
        if run is None:
            self._run = stretch
            self._give(stretch, Place.BEGINS)
        elif (follows and self._doubtful is None) or (not follows and run.near(stretch.first_us)):
            self._drop_doubtful()
            run.extend(stretch)
            self._give(run, Place.CONTINUES)
        else:
            doubtful = self._doubted(stretch, follows)
            if doubtful.believed:
                self._doubtful = None
                self._believe(run, doubtful)

    def _doubted(self, stretch: Stretch, follows: bool) -> Stretch:
        """What is doubtful, with this stretch."""
        doubtful = self._doubtful
        if doubtful is not None and (follows or -LARGEST_STEP_BACK_US <= stretch.first_us - doubtful.latest_us <= self._largest_gap_us):
            doubtful.extend(stretch)
            return doubtful
        self._drop_doubtful()
        self._doubtful = stretch
        return stretch

    def _drop_doubtful(self) -> None:
        if self._doubtful is not None:
            self.misdated_events += self._doubtful.count
            self._doubtful = None

    def _believe(self, run: Stretch, stretch: Stretch) -> None:
        """The stretch becomes part of the run after a pause, or a new run."""
        if self._is_pause(run, stretch):
            run.extend(stretch)
            self._give(run, Place.CONTINUES)
        elif run.believed:
            self._run = stretch
            self._give(stretch, Place.BEGINS)
        else:
            self.misdated_events += run.count
            self._run = stretch
            self._give(stretch, Place.REPLACES)

    def _is_pause(self, run: Stretch, stretch: Stretch) -> bool:
        return 0 < stretch.first_us - run.latest_us <= self._largest_gap_us

    def _give(self, run: Stretch, place: Place) -> None:
        """Moves the events that a run has taken to what is given next."""
        for t, pixels in run.pieces:
            self._given.append((place, t, pixels))
            place = Place.CONTINUES
        run.pieces = []

    def _taken(self) -> list[Piece]:
        """What is to be given, each run's events in one piece."""
        given, self._given = self._given, []
        if len(given) < 2:
            return given
        borders = [number for number, (place, _, _) in enumerate(given) if number == 0 or place is not Place.CONTINUES]
        parts = [given[start:stop] for start, stop in itertools.pairwise([*borders, len(given)])]
        return [(part[0][0], np.concatenate([t for _, t, _ in part]), np.concatenate([pixels for _, _, pixels in part])) for part in parts]


def _agrees(step_us: int) -> bool:
    return -STRETCH_STEP_BACK_US <= step_us <= LARGEST_STEP_AHEAD_US


def _stretches(t: Times, pixels: Pixels, steps: Times) -> Iterator[Stretch]:
    """A packet, cut where the steps between its events go too far."""
    cuts = np.flatnonzero((steps > LARGEST_STEP_AHEAD_US) | (steps < -STRETCH_STEP_BACK_US)) + 1
    borders = [0, *cuts.tolist(), len(t)]
    earliest, latest = (ufunc.reduceat(t, borders[:-1]).tolist() for ufunc in (np.minimum, np.maximum))
    for number, (start, stop) in enumerate(itertools.pairwise(borders)):
        yield Stretch(int(t[start]), earliest[number], latest[number], stop - start, [(t[start:stop], pixels[start:stop])])

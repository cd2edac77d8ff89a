"""Times of Prophesee's files, whose clocks wrap: a RAW file's TIME_HIGH words, and the low bits that events add to them.

A TIME_HIGH word counts in units of 64 us (EVT2, EVT2.1: 28 bits, the clock wraps after 4.8 h) or 4096 us (EVT3: 12 bits, 16.8 s); what
follows up to the next one is its *block*. Sensors repeat the word every 16 us; files that programs write have one where it changes.

What a step between two words can be:

| step | is |
|---|---|
| ahead, or from near the clock's end to near its start | time that passed |
| back by no more than `LARGEST_STEP_BACK_US` | an event that the sensor sent late; counted, its time is right |
| back by more | the clock broke: times go on as the words say, and `runtime.runs` begins a new run of windows |

Words are lost on the way, too. Where the low bits go back within a block, a word is missing. The word after the block says whether
exactly so many are: then all times are right. Else the rest of the block has no certain time. And in a file whose words are repeated, a
step of more than one unit means that words were lost in the block before it: when in the block is not known, so it has no certain time.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from runtime.runs import LARGEST_STEP_BACK_US

Times = NDArray[np.int64]

LARGEST_STEP_OVER_THE_END_US = 100_000
"""A longer step from a high time to a lower one is no wrap but a clock that went back."""

REPEATS_OF_A_SENSOR = 64
"""Words that came again, and most of all words so far, of a file in which every word is to be expected."""

UNKNOWN = np.iinfo(np.int64).min
"""Step after the last block of a file."""


class Unwrapped:
    """Times of a clock that wraps after `period_us`, as times that do not. The first keeps its value."""

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._last: tuple[int, int] | None = None

    def __call__(self, wrapped: Times) -> Times:
        """The next times in the file's order, which must not be none."""
        last, last_time = self._last or (int(wrapped[0]), int(wrapped[0]))
        steps = np.diff(wrapped, prepend=last)
        steps[(steps < 0) & (steps + self._period_us <= LARGEST_STEP_OVER_THE_END_US)] += self._period_us
        steps[(steps > 0) & (self._period_us - steps <= LARGEST_STEP_BACK_US)] -= self._period_us
        times = last_time + np.cumsum(steps)
        self._last = int(wrapped[-1]), int(times[-1])
        return times


class Blocks:
    """The blocks of a RAW file, a batch at a time: `begin` takes the batch's TIME_HIGH words, `dated` the low bits within it.

    `unit_us`, `bits`: of the word. `counts` gets "time words lost" and "time words that step back".
    """

    def __init__(self, unit_us: int, bits: int, counts: Counter[str]) -> None:
        self._unit_us, self._counts = unit_us, counts
        self._unwrapped = Unwrapped(unit_us << bits)
        self._last_us: int | None = None
        self._repeats = self._blocks = 0
        self._times = self._steps = np.empty(0, dtype=np.int64)
        self._broken = np.empty(0, dtype=np.bool_)
        self.changed = np.empty(0, dtype=np.bool_)
        """Whether a block's time is another one than the block's before it."""

    def begin(self, words: Times, more: bool) -> None:
        """The next batch. If there is `more`, its last word only ends the last block, and is the first word of the next batch."""
        times = self._unwrapped(words * self._unit_us) if len(words) else words
        self._times = times[: len(times) - more]
        self._steps = np.diff(times) if more else np.append(np.diff(times), UNKNOWN)[: len(times)]
        self.changed = np.diff(self._times, prepend=UNKNOWN if self._last_us is None else self._last_us) != 0
        self._last_us = int(self._times[-1]) if len(self._times) else self._last_us
        back = (self._steps < 0) & (self._steps >= -LARGEST_STEP_BACK_US)
        self._counts["time words that step back"] += int(np.count_nonzero(back))
        self._broken = self._by_a_sensor() & (self._steps > self._unit_us)
        self._count_lost(self._steps[self._broken])

    def _by_a_sensor(self) -> NDArray[np.bool_]:
        """After which blocks the file is known to repeat its words."""
        repeats = self._repeats + np.cumsum(self._steps == 0)
        blocks = self._blocks + np.arange(1, len(self._steps) + 1)
        if len(blocks):
            self._repeats, self._blocks = int(repeats[-1]), int(blocks[-1])
        return (repeats >= REPEATS_OF_A_SENSOR) & (2 * repeats > blocks)

    def dated(self, block: NDArray[np.intp], low: Times) -> tuple[Times, NDArray[np.bool_]]:
        """Times (n,) us of what has these low bits in these blocks of the batch, both in the file's order, and which are certain.

        Block -1, before a file's first word, has no time.
        """
        if len(self._times) == 0:
            return low, np.zeros(len(low), dtype=np.bool_)
        times, certain = self._times[block] + low, (block >= 0) & ~self._broken[block]
        if ((block[1:] == block[:-1]) & (low[1:] < low[:-1])).any():
            self._carry_over(block, low, times, certain)
        return times, certain

    def _carry_over(self, block: NDArray[np.intp], low: Times, times: Times, certain: NDArray[np.bool_]) -> None:
        """Corrects times and certainty in blocks whose low bits go back: words are lost or late there, or events are not in order.

        If the word after the block comes as many units on as the low bits went back, and one, these words are lost, and all is certain.
        If it comes no later, only what went back by more than half of the range passed an end: its word came late.
        """
        unit, steps = self._unit_us, self._steps[block]
        lost, all_lost = _in_blocks(block, (block[1:] == block[:-1]) & (low[1:] < low[:-1]))
        late, all_late = _in_blocks(block, (block[1:] == block[:-1]) & (low[1:] < low[:-1] - unit // 2))
        no_later = (steps <= all_lost * unit) & (steps != UNKNOWN)
        passed = np.where(no_later, late, lost)
        explained = np.where(no_later, (steps == all_late * unit) | (steps == (all_late + 1) * unit), steps == (all_lost + 1) * unit)
        times += passed * unit
        certain &= explained | (passed == 0)
        last = (np.diff(block, append=len(self._times)) > 0) & (block >= 0)
        ends = np.flatnonzero(last & (all_lost > 0) & ~self._broken[block])
        self._count_lost(np.where(steps[ends] == UNKNOWN, (all_lost[ends] + 1) * unit, steps[ends]))

    def _count_lost(self, steps: Times) -> None:
        """The words that are missing in steps that should have been of one unit."""
        self._counts["time words lost"] += int(np.maximum(steps // self._unit_us - 1, 0).sum())


def _in_blocks(block: NDArray[np.intp], marks: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """How many marks each has before it in its block, and how many its block has; `marks` has none for the first of all."""
    count = np.concatenate([[0], np.cumsum(marks)])
    count -= count[np.searchsorted(block, block)]
    return count, count[np.searchsorted(block, block, side="right") - 1]

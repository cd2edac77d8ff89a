"""A frame, ready to be asked for the lit pixels of many stretches of rows at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from runtime.refine.interval import Bits, Floats, Interval

Rows = NDArray[np.int64]
NO_COLUMN = np.int16(2**15 - 1)
"""Stands for a column that no frame has: a frame is at most 16384 px wide (`runtime.scene.Camera`)."""


@dataclass(frozen=True)
class LitPixels:
    """A window of a frame, ready to be asked for the lit pixels of a stretch of a row. What lies beyond it is lit, or all dark.

    `canvas` (rows + 2, columns + 2) holds the window within a border that stands for all beyond it; `top` and `left` are the border's.
    """

    canvas: Bits
    top: int
    left: int
    beyond: bool

    @staticmethod
    def of(frame: Bits, window: tuple[slice, slice], beyond: bool) -> LitPixels:
        """The pixels of `window`; `beyond`: are those outside of it lit?"""
        seen = frame[window]
        canvas = np.full((seen.shape[0] + 2, seen.shape[1] + 2), beyond)
        canvas[1:-1, 1:-1] = seen
        return LitPixels(canvas, (window[0].start or 0) - 1, (window[1].start or 0) - 1, beyond)

    @property
    def bottom(self) -> int:
        """Row of the border below the window."""
        return self.top + len(self.canvas) - 1

    @cached_property
    def following(self) -> Floats:
        """The nearest lit column at or after each pixel, flat; without bound beyond the window."""
        column = np.where(self.canvas, np.arange(self.canvas.shape[1], dtype=np.int16), NO_COLUMN)
        for step in _doubling(column.shape[1]):
            np.minimum(column[:, :-step], column[:, step:], out=column[:, :-step])
        return self._unbounded(column, -np.inf)

    @cached_property
    def preceding(self) -> Floats:
        """The nearest lit column at or before each pixel, flat; without bound beyond the window."""
        column = np.where(self.canvas, np.arange(self.canvas.shape[1], dtype=np.int16), -NO_COLUMN)
        for step in _doubling(column.shape[1]):
            np.maximum(column[:, step:], column[:, :-step], out=column[:, step:])
        return self._unbounded(column, np.inf)

    @cached_property
    def counted(self) -> Rows:
        """How many pixels of its row are lit up to each pixel, flat."""
        return np.cumsum(self.canvas, axis=1, dtype=np.int64).ravel()

    def nearest(self, row: Floats, stretch: Interval) -> Interval:
        """First and last lit column of the columns from stretch[0] to stretch[1]; the last is before the first where none is lit.

        Where a stretch reaches beyond the window it has no bound on that side, if what lies there is lit.
        """
        start = self._start(row)
        return self.following.take(self._place(start, stretch[0])), self.preceding.take(self._place(start, stretch[1]))

    def count(self, row: Floats, stretch: Interval) -> Rows:
        """How many columns from stretch[0] to stretch[1] are lit."""
        start = self._start(row)
        return self.counted.take(self._place(start, stretch[1])) - self.counted.take(self._place(start, stretch[0] - 1))

    def _start(self, row: Floats) -> Floats:
        """Where a row starts in the flat tables."""
        return np.minimum(np.maximum(row - self.top, 0), self.canvas.shape[0] - 1) * self.canvas.shape[1]

    def _place(self, start: Floats, column: Floats) -> Rows:
        return (start + np.minimum(np.maximum(column - self.left, 0), self.canvas.shape[1] - 1)).astype(np.int64)

    def _unbounded(self, column: NDArray[np.int16], value: float) -> Floats:
        """As columns of the frame, flat, with `value` on the border if what lies there is lit."""
        columns = column.astype(np.float64) + self.left
        if self.beyond:
            columns[0] = columns[-1] = value
            columns[:, 0] = columns[:, -1] = value
        return columns.ravel()


def _doubling(count: int) -> list[int]:
    """1, 2, 4, ... below `count`: steps that carry a value over any distance."""
    return [1 << power for power in range((count - 1).bit_length())]

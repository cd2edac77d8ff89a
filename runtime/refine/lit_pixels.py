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

    `canvas` (columns + 2, rows + 2) holds the window within a border that stands for all beyond it; `top` and `left` are the border's.
    Columns come first, as in all tables: what lies along a row is then found for all rows at once.
    """

    canvas: Bits
    top: int
    left: int
    beyond: bool

    @staticmethod
    def of(frame: Bits, window: tuple[slice, slice], beyond: bool) -> LitPixels:
        """The pixels of `window`; `beyond`: are those outside of it lit?"""
        seen = frame[window]
        canvas = np.full((seen.shape[1] + 2, seen.shape[0] + 2), beyond)
        canvas[1:-1, 1:-1] = seen.T
        return LitPixels(canvas, (window[0].start or 0) - 1, (window[1].start or 0) - 1, beyond)

    @property
    def rows(self) -> int:
        """Rows of the window and of its border."""
        return self.canvas.shape[1]

    @property
    def bottom(self) -> int:
        """Row of the border below the window."""
        return self.top + self.rows - 1

    @cached_property
    def following(self) -> Floats:
        """The nearest lit column at or after each pixel, column by column, flat; without bound beyond the window."""
        column = np.where(self.canvas, self._numbers, NO_COLUMN)
        for step in _doubling(len(column)):
            column[:-step] = np.minimum(column[:-step], column[step:])
        return self._unbounded(column, -np.inf)

    @cached_property
    def preceding(self) -> Floats:
        """The nearest lit column at or before each pixel, column by column, flat; without bound beyond the window."""
        column = np.where(self.canvas, self._numbers, -NO_COLUMN)
        for step in _doubling(len(column)):
            column[step:] = np.maximum(column[step:], column[:-step])
        return self._unbounded(column, np.inf)

    @cached_property
    def counted(self) -> Rows:
        """How many pixels of its row are lit up to each pixel, column by column, flat."""
        return np.cumsum(self.canvas, axis=0, dtype=np.int64).ravel()

    def nearest(self, row: Floats, stretch: Interval) -> Interval:
        """First and last lit column of the columns from stretch[0] to stretch[1]; the last is before the first where none is lit.

        Where a stretch reaches beyond the window it has no bound on that side, if what lies there is lit.
        """
        place = self.row_place(row)
        return self.following.take(place + self.column_place(stretch[0])), self.preceding.take(place + self.column_place(stretch[1]))

    def count(self, row: Floats, stretch: Interval) -> Rows:
        """How many columns from stretch[0] to stretch[1] are lit."""
        place = self.row_place(row)
        before, up_to = (self.counted.take(place + self.column_place(column)) for column in (stretch[0] - 1, stretch[1]))
        return up_to - before

    def row_place(self, row: Floats) -> Rows:
        """What a row adds to the place of a pixel in the flat tables; rows beyond the window are one."""
        return (np.minimum(np.maximum(row, self.top), self.bottom) - (self.top + self.left * self.rows)).astype(np.int64)

    def column_place(self, column: Floats) -> Rows:
        """What a column adds to it; columns beyond the window are one, on either side."""
        inside = np.maximum(column, self.left)
        np.minimum(inside, self.left + len(self.canvas) - 1, out=inside)
        inside *= self.rows
        return inside.astype(np.int64)

    @property
    def _numbers(self) -> NDArray[np.int16]:
        """The columns of the canvas, (columns, 1)."""
        return np.arange(len(self.canvas), dtype=np.int16)[:, None]

    def _unbounded(self, column: NDArray[np.int16], value: float) -> Floats:
        """As columns of the frame, flat, with `value` on the border if what lies there is lit. `column`: (columns, rows)."""
        columns = column.astype(np.float64)
        columns += self.left
        if self.beyond:
            columns[0] = columns[-1] = value
            columns[:, 0] = columns[:, -1] = value
        return columns.ravel()


def _doubling(count: int) -> list[int]:
    """1, 2, 4, ... below `count`: steps that carry a value over any distance."""
    return [1 << power for power in range((count - 1).bit_length())]

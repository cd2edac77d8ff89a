"""What a frame shows where markings may be: of each row's whole window, and of its half-windows at its two borders.

The *window* of a row is every column that a marking of the set may meet in it; a *half-window* is every column in which it may meet one
border of the row, whose pixel on the row's side of the border each state then lights (theory: must-hit windows). The window is what lies
between the outer ends of both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.refine.borders import Borders
from runtime.refine.interval import Bits, Floats
from runtime.refine.lit_pixels import LitPixels
from runtime.refine.sensor_borders import SensorBorders


@dataclass(frozen=True)
class LitColumns:
    """First and last lit column of windows; they mean nothing where none is lit: `dark`. All of one shape."""

    first: Floats
    last: Floats
    dark: Bits

    @staticmethod
    def of(pixels: LitPixels, borders: Borders | SensorBorders) -> tuple[LitColumns, LitColumns]:
        """Of the half-windows at the upper (0) and the lower (1) border of each row, (2, markings, rows, sets), and of the rows' windows.

        The first lit column from the outer one of two columns on is the outer one of the first lit ones from either on: no more look-ups.
        """
        row = pixels.row_place(borders.row[:-1])
        start, stop = (pixels.column_place(side) for side in borders.columns)
        first = pixels.following.take(at_both_borders(start) + row)
        last = pixels.preceding.take(at_both_borders(stop) + row)
        return LitColumns.found(first, last), LitColumns.found(np.minimum(first[0], first[1]), np.maximum(last[0], last[1]))

    @staticmethod
    def found(first: Floats, last: Floats) -> LitColumns:
        """With `first` behind `last` where no pixel is lit."""
        return LitColumns(first, last, last < first)


def at_both_borders(side: NDArray[Any]) -> NDArray[Any]:
    """What stands at the borders, (markings, rows + 1, sets), at the upper and the lower one of each row, (2, markings, rows, sets)."""
    both = np.empty((2, len(side), side.shape[1] - 1, side.shape[2]), dtype=side.dtype)
    both[0], both[1] = side[:, :-1], side[:, 1:]
    return both


def flat_rows(row: Floats, rows: int) -> NDArray[np.int64]:
    """Where the rows (ends, markings, sets) of each marking and set stand in arrays (markings, rows, sets), flat."""
    _, markings, sets = row.shape
    first = np.arange(0, markings * rows * sets, rows * sets)[:, None] + np.arange(sets)
    return row.astype(np.int64) * sets + first

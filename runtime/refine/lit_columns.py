"""What a frame shows where markings may be: of each row's whole window, and of its half-windows at its two borders.

The *window* of a row is every column that a marking of the set may meet in it; a *half-window* is every column in which it may meet one
border of the row, whose pixel on the row's side of the border each state then lights (theory: must-hit windows).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.refine.borders import Borders
from runtime.refine.interval import Bits, Floats, Interval
from runtime.refine.lit_pixels import LitPixels


@dataclass(frozen=True)
class LitColumns:
    """First and last lit column of windows, with bounds that no state meets where none is lit: `dark`. All of one shape."""

    window: Interval
    first: Floats
    last: Floats
    dark: Bits

    @staticmethod
    def of_rows(pixels: LitPixels, borders: Borders) -> LitColumns:
        """Of the rows' windows, (markings, rows, sets)."""
        return LitColumns.found(pixels, borders, borders.across_rows())

    @staticmethod
    def of_halves(pixels: LitPixels, borders: Borders) -> LitColumns:
        """Of the half-windows at the upper (0) and the lower (1) border of each row, (2, markings, rows, sets)."""
        low, high = (np.stack([side[:, :-1], side[:, 1:]]) for side in borders.columns)
        return LitColumns.found(pixels, borders, (low, high))

    @staticmethod
    def found(pixels: LitPixels, borders: Borders, window: Interval) -> LitColumns:
        """Looks the windows of the rows up in the frame."""
        return LitColumns.marked(*pixels.nearest(borders.row[:-1], window), window)

    @staticmethod
    def marked(first: Floats, last: Floats, window: Interval) -> LitColumns:
        """With `first` behind `last` where no pixel is lit, which are overwritten."""
        dark = last < first
        np.copyto(first, np.inf, where=dark)
        np.copyto(last, -np.inf, where=dark)
        return LitColumns(window, first, last, dark)

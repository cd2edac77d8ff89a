"""Sets of pixels: from columns a row to bits in a window, and from bits to runs.

A marking that is steeper than 45 degrees in the image covers each column in a single run of rows, and a mask is a few such runs.
With sums of the frame down its columns, a mask's lit pixels are counted by two look-ups a run (`build_model.run_table`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from build_model.enclosure import Columns
from build_model.window import Bits, Window
from runtime.scene import Scene


@dataclass(frozen=True)
class VerticalRuns:
    """Masks as vertical runs: mask `mask[k]` holds rows [start[k], stop[k]) of column `column[k]`. Sorted by mask."""

    mask: NDArray[np.int64]
    column: NDArray[np.int64]
    start: NDArray[np.int64]
    stop: NDArray[np.int64]

    def bits(self, masks: int, window: Window) -> Bits:
        """The masks as bits, (masks, rows, columns) of the window, which must hold them."""
        rows, columns = window.shape
        steps = np.zeros((masks, rows + 1, columns), dtype=np.int8)
        steps[self.mask, self.start - window.top, self.column - window.left] = 1
        np.subtract.at(steps, (self.mask, self.stop - window.top, self.column - window.left), 1)
        return np.cumsum(steps, axis=1, dtype=np.int8)[:, :-1].astype(bool)

    def chosen(self, which: NDArray[np.bool_]) -> VerticalRuns:
        """The masks marked in `which`, (masks,), renumbered in their order."""
        kept, number = which[self.mask], np.cumsum(which) - 1
        return VerticalRuns(number[self.mask[kept]], self.column[kept], self.start[kept], self.stop[kept])

    @staticmethod
    def joined(parts: Sequence[VerticalRuns], masks: Sequence[int]) -> VerticalRuns:
        """All masks of several parts, of so many each, in one order."""
        first = np.cumsum([0, *masks[:-1]])
        mask = np.concatenate([part.mask + number for part, number in zip(parts, first, strict=True)])
        return VerticalRuns(mask, *(np.concatenate([getattr(part, name) for part in parts]) for name in ("column", "start", "stop")))

    def sizes(self, masks: int) -> NDArray[np.int64]:
        """Pixels of each mask, (masks,)."""
        return np.bincount(self.mask, weights=self.stop - self.start, minlength=masks).astype(np.int64)


def widened(scene: Scene, columns: Columns, by_px: int) -> Columns:
    """Columns of the frame's rows and `by_px` more on both sides, widened by `by_px` in the sup norm, then clipped to the frame.

    What lies outside the frame counts as well, since widening may bring it in. Rows of a marking touch each other, so the widened mask
    is again one run of columns a row.
    """
    first, last = columns
    width = scene.camera.width
    empty = last < first
    span = 2 * by_px + 1
    first = sliding_window_view(np.where(empty, width, first - by_px), span, axis=2).min(axis=-1)
    last = sliding_window_view(np.where(empty, -1, last + by_px), span, axis=2).max(axis=-1)
    return _only(first <= last, np.maximum(first, 0), np.minimum(last, width - 1), width)


def inset(scene: Scene, columns: Columns, by_px: int) -> Columns:
    """Columns of the frame's rows, without the pixels that are less than `by_px` pixels away from the frame's border."""
    height, width = scene.camera.shape
    row = np.arange(height)
    first, last = np.maximum(columns[0], by_px), np.minimum(columns[1], width - 1 - by_px)
    return _only((row >= by_px) & (row < height - by_px), first, last, width)


def _only(where: Bits, first: NDArray[np.int64], last: NDArray[np.int64], width: int) -> Columns:
    """The columns where `where` holds and some remain; elsewhere the empty run from `width` to -1."""
    kept = where & (first <= last)
    return np.where(kept, first, width), np.where(kept, last, -1)


def window_of(columns: Columns) -> Window:
    """The smallest window that holds the columns; 0 by 0 if there are none."""
    first, last = columns
    rows = np.flatnonzero((first <= last).any(axis=(0, 1)))
    if len(rows) == 0:
        return Window(0, 0, 0, 0)
    return Window(int(rows[0]), int(rows[-1]) + 1, int(first.min()), int(last.max()) + 1)


def paint(columns: Columns, window: Window) -> Bits:
    """All markings of each set joined by OR, as bits in the window: (sets, rows, columns)."""
    first, last = (part[:, :, window.top : window.bottom, None] for part in columns)
    across = np.arange(window.left, window.right)
    bits = np.zeros((len(first), *window.shape), dtype=bool)
    for marking in range(first.shape[1]):
        bits |= (across >= first[:, marking]) & (across <= last[:, marking])
    return bits


def runs_of(bits: Bits, window: Window) -> VerticalRuns:
    """The vertical runs of masks given as bits (masks, rows, columns) in a window."""
    upright = np.swapaxes(bits, 1, 2)
    padded = np.zeros((*upright.shape[:2], upright.shape[2] + 2), dtype=np.int8)
    padded[:, :, 1:-1] = upright
    steps = np.diff(padded, axis=2)
    mask, column, start = np.nonzero(steps == 1)
    stop = np.nonzero(steps == -1)[2]
    return VerticalRuns(mask, column + window.left, start + window.top, stop + window.top)

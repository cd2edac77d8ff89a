"""Windows and S of all cells as look-ups (`build_model.window_graph`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from build_model.filter_tables import WindowTable
from build_model.window import Window
from build_model.window_bank import CellWindows, Spans, Windows


def window_table(banks: Sequence[CellWindows], window: Window) -> WindowTable:
    """The windows of all cells, in their order, as places in the sums along the rows of `window`."""
    parts = banks[0].exists.shape[1]
    gate_start, gate_columns = _places(Windows.joined([bank.gate for bank in banks]), window)
    start, columns = _places(Windows.joined([bank.windows for bank in banks]), window)
    first, stop = _spans([bank.spans for bank in banks], window)
    return WindowTable(
        gate_size=np.concatenate([bank.gate.sizes for bank in banks]).astype(np.int32),
        gate_start=gate_start.astype(np.int32),
        gate_stop=(gate_start + gate_columns * window.shape[0]).astype(np.int32),
        start=start.astype(np.int32).reshape(len(gate_start), parts, -1),
        columns=columns.astype(np.uint8).reshape(len(gate_start), parts, -1),
        span_first=first.astype(np.int16),
        span_stop=stop.astype(np.int16),
    )


def window_of_spans(spans: Sequence[Spans]) -> Window:
    """The smallest window that holds all."""
    first, last = (np.stack([getattr(span, side) for span in spans]) for side in ("first", "last"))
    rows = np.flatnonzero((first <= last).any(axis=(0, 1)))
    return Window(int(rows[0]), int(rows[-1]) + 1, int(first.min()), int(last.max()) + 1)


def _places(windows: Windows, window: Window) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Place of each window's start, and how many columns it has; 0 and 0 of unused ones."""
    used = windows.first <= windows.last
    start = (windows.first - window.left) * window.shape[0] + windows.border - 1 - window.top
    return np.where(used, start, 0), np.where(used, windows.last - windows.first + 1, 0)


def _spans(spans: Sequence[Spans], window: Window) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First column and the one behind the last of each marking in each row of the window, counted from its left; all and 0 if none."""
    rows = slice(window.top, window.bottom)
    first, last = (np.stack([getattr(span, side)[:, rows] for span in spans]) for side in ("first", "last"))
    some = first <= last
    columns = window.shape[1]
    return np.where(some, first - window.left, columns), np.where(some, last + 1 - window.left, 0)

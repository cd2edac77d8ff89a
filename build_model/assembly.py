"""Lays the banks of all cells out as the tables of NN_F (`build_model.filter_tables`)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from build_model.filter_tables import FilterTables, WindowTables
from build_model.hough_bank import CellBank
from build_model.partition import partition
from build_model.run_table import run_table, spatial_runs
from build_model.window_bank import CellWindows
from build_model.window_table import window_of_spans, window_table
from runtime.model.format import PADDING_SIZE
from runtime.rounding import float32_above, float32_below
from runtime.scene import Scene

ROW_COST, SECOND_REDUCTION_COST = 8, 2000
"""What a row costs beside its entries, and what it costs to gather rows by cell and reduce them again, in entries scored and reduced."""


def assemble(scene: Scene, banks: Sequence[CellBank] | Sequence[CellWindows]) -> FilterTables | WindowTables:
    """Lays out the banks of all cells, in the order of the partition."""
    windowed = [bank for bank in banks if isinstance(bank, CellWindows)]
    return _of_windows(scene, windowed) if windowed else _of_masks(scene, [bank for bank in banks if isinstance(bank, CellBank)])


def _of_windows(scene: Scene, banks: Sequence[CellWindows]) -> WindowTables:
    """A row of the tables is a group."""
    window, cells = window_of_spans([bank.spans for bank in banks]), partition(scene)
    table, parts = window_table(banks, window), banks[0].exists.shape[1]
    exists = np.concatenate([bank.exists for bank in banks])
    sizes = np.concatenate([bank.windows.sizes for bank in banks]).reshape(-1, parts)

    def of_lines(name: str) -> NDArray[np.float64]:
        values = np.concatenate([getattr(bank.lines, name) for bank in banks])
        return values.reshape(-1, parts, *values.shape[1:])

    return WindowTables(
        window=window,
        cells=cells,
        cell_lower=float32_below(cells.lower),
        cell_upper=float32_above(cells.upper),
        row_cell=np.repeat(np.arange(len(banks), dtype=np.int32), [len(bank.exists) for bank in banks]),
        must_light_size=np.where(exists, sizes, PADDING_SIZE).astype(np.int32),
        state_lower=np.concatenate([bank.state_lower for bank in banks]),
        state_upper=np.concatenate([bank.state_upper for bank in banks]),
        line_lower=of_lines("lower"),
        line_upper=of_lines("upper"),
        reference_row=of_lines("reference_row"),
        windows=table,
    )


def _of_masks(scene: Scene, banks: Sequence[CellBank]) -> FilterTables:
    """A cell's entries fill rows of one width."""
    window = banks[0].window
    for bank in banks[1:]:
        window = window.union(bank.window)
    entries = [len(bank) for bank in banks]
    width = row_width(entries)
    rows = rows_filled(entries, width)

    def padded(parts: Iterable[NDArray], padding: int = 0) -> NDArray:
        fitted = [
            np.pad(part, [(0, count * width - len(part))] + [(0, 0)] * (part.ndim - 1), constant_values=padding)
            for part, count in zip(parts, rows, strict=True)
        ]
        return np.concatenate(fitted).reshape(-1, width, *fitted[0].shape[1:])

    cells = partition(scene)
    return FilterTables(
        window=window,
        cells=cells,
        cell_lower=float32_below(cells.lower),
        cell_upper=float32_above(cells.upper),
        row_cell=np.repeat(np.arange(len(banks), dtype=np.int32), rows),
        runs=run_table(banks, window, scene.tolerance.line_px > 0, width),
        spatial_runs=spatial_runs(banks, window),
        must_light_size=padded((bank.must_light_sizes for bank in banks), PADDING_SIZE).astype(np.int32),
        state_lower=padded(bank.state_lower for bank in banks),
        state_upper=padded(bank.state_upper for bank in banks),
        line_lower=padded(bank.lines.lower for bank in banks),
        line_upper=padded(bank.lines.upper for bank in banks),
        reference_row=padded(bank.lines.reference_row for bank in banks),
    )


def rows_filled(entries: Sequence[int], width: int) -> NDArray[np.int64]:
    """Rows of that width which each cell's entries take."""
    return -(-np.asarray(entries) // width)


def row_width(entries: Sequence[int]) -> int:
    """The width of rows that makes a frame cheapest: every place in a row is scored and reduced, padding too.

    One row a cell needs no second reduction; a narrower one has less padding where cells have unlike numbers of entries.
    """

    def cost(width: int) -> float:
        rows = rows_filled(entries, width)
        again = SECOND_REDUCTION_COST + len(entries) * rows.max() if rows.max() > 1 else 0
        return float(rows.sum() * (width + ROW_COST) + again)

    most = max(entries)
    return min(dict.fromkeys(-(-most // parts) for parts in range(1, most + 1)), key=cost)

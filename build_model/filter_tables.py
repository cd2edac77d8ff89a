"""The tables of NN_F: what its graph is made of, and what a verifier reads back from the graph. Data alone: `assembly` makes them.

A cell's bank is laid out in rows of one width, ready for a static graph. In a bank of masks (`build_model.filter_graph`) it is a row for a
cell where the cells have about as many entries each, several rows for the larger ones where they have not; in one of windows
(`build_model.window_graph`) a row is a group of entries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from build_model.partition import Partition
from build_model.window import Window
from runtime.model.format import PADDING_SIZE


@dataclass(frozen=True)
class RunTable:
    """All masks, sorted by their number of runs, most first.

    A block (2, runs, masks) int32 adds that many runs to each of the first `masks` masks: the lit pixels of the mask at place p are the
    sum, over all blocks that reach it and over k, of sums[block[0, k, p]] - sums[block[1, k, p]]. The sums are (rows + 1, `columns`),
    flat: down the columns of the window, or of the window folded along its middle. With a tolerance the sums of the dilated frame follow,
    which K is counted in. Unused runs are (0, 0).
    """

    blocks: tuple[NDArray[np.int32], ...]
    columns: int
    folded: bool
    spatial: NDArray[np.int32]
    """The place of S_i, (cells,)."""
    must_light: NDArray[np.int32]
    """The place of K_ij, (rows, width) as in `FilterTables`; that of another mask of the cell in the padding."""
    may_light: NDArray[np.int32]
    """The place of O_ij, likewise."""

    @property
    def look_ups(self) -> int:
        """Sums that are looked up in a frame."""
        return sum(block.size for block in self.blocks)


@dataclass(frozen=True)
class SpatialRuns:
    """Where the runs of all S_i start and stop, to paint them, (ends,) each."""

    cell: NDArray[np.int32]
    index: NDArray[np.int32]
    """The first pixel of a run, or the first one below it, flat in the window. A run down to the last row has no stop."""
    step: NDArray[np.int32]
    """1 at a start, -1 at a stop."""


@dataclass(frozen=True)
class WindowTable:
    """Windows as look-ups into the sums of the frame along its rows, (columns + 1, rows) of the window, flat, under a column of zeros.

    A window is lit where the sum at its end exceeds that at its start. Unused ones are (0, 0), and never lit.
    """

    gate_size: NDArray[np.int32]
    """Number of each group's windows, (rows,)."""
    gate_start: NDArray[np.int32]
    gate_stop: NDArray[np.int32]
    """(rows, windows)."""
    start: NDArray[np.int32]
    """Of the entries' windows, (rows, width, windows)."""
    columns: NDArray[np.uint8]
    """How many columns each has, as `start`: an end lies as many times the window's rows behind."""
    span_first: NDArray[np.int16]
    span_stop: NDArray[np.int16]
    """S: each marking's first column in each row, and the one behind its last, (cells, markings, rows of the window).

    Where there is none, the first is behind the window's last and the other 0, so that neither is an extreme among cells that have some.
    """


@dataclass(frozen=True)
class BankTables:
    """What the tables of both kinds of bank have. A cell's entries fill one row or several, (rows, width), with padding among them."""

    window: Window
    cells: Partition
    cell_lower: NDArray[np.float32]
    cell_upper: NDArray[np.float32]
    """Each cell, rounded outward, (cells, 4)."""
    row_cell: NDArray[np.int32]
    """The cell of each row, (rows,), ascending."""
    must_light_size: NDArray[np.int32]
    """|K_ij|, or the number of an entry's windows, (rows, width); `PADDING_SIZE` in the padding."""
    state_lower: NDArray[np.float32]
    state_upper: NDArray[np.float32]
    """Each entry in state coordinates, (rows, width, 4)."""
    line_lower: NDArray[np.float64]
    line_upper: NDArray[np.float64]
    """Each entry's box in theta, x, scale, z, (rows, width, 4): what a verifier must prove the masks for."""
    reference_row: NDArray[np.float64]
    """The row of the frame that each entry's scale refers to, (rows, width) px."""

    @property
    def rows_of_cell(self) -> NDArray[np.int32]:
        """Every cell's rows, (rows of the largest cell, cells); a smaller cell's last one again where it has no more."""
        first, last = (np.searchsorted(self.row_cell, np.arange(len(self.cells)), side) for side in ("left", "right"))
        return np.minimum(first + np.arange((last - first).max())[:, None], last - 1).astype(np.int32)

    @property
    def smallest_must_light(self) -> int:
        """Smallest |K_ij|, or number of windows, of all entries."""
        return int(self.must_light_size.min())

    @property
    def entries(self) -> int:
        """Number of all entries."""
        return int((self.must_light_size != PADDING_SIZE).sum())


@dataclass(frozen=True)
class FilterTables(BankTables):
    """Constants of an NN_F of masks."""

    runs: RunTable
    spatial_runs: SpatialRuns


@dataclass(frozen=True)
class WindowTables(BankTables):
    """Constants of an NN_F of windows. Each row is a group."""

    windows: WindowTable

    @property
    def smallest_must_light(self) -> int:
        """Smallest number of windows of all entries and groups."""
        return min(super().smallest_must_light, int(self.windows.gate_size.min()))

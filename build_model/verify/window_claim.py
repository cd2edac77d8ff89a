"""What a model with a bank of windows states of one cell, taken from its tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from build_model.filter_tables import WindowTables
from build_model.verify.cell_claim import BankClaim, bank_claim
from build_model.verify.counterexample import demand
from build_model.window import Bits, Window
from runtime.scene import Scene


@dataclass(frozen=True)
class WindowPlaces:
    """Windows of sets as the model's look-ups: flat places of their starts and ends in the sums, (sets, windows) each."""

    start: NDArray[np.int64]
    stop: NDArray[np.int64]

    def windows(self, window: Window, cell: int, name: str) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Border, first and last column of each, (sets, windows) each; an unused one has last < first.

        Raises `Refuted` unless each look-up counts pixels of one row of the window, and those of unused ones find a sum too.
        """
        rows, columns = window.shape
        used = self.start != self.stop
        row, first, last = self.start % rows, self.start // rows, self.stop // rows - 1
        inside = (self.start >= 0) & (first <= last) & (last < columns) & (self.stop % rows == row)
        wrong = (used & ~inside).any(axis=1)
        demand(not wrong.any(), f"{name}: an index does not count pixels of one row of the window", cell, int(wrong.argmax()))
        beyond = ((self.start < 0) | (self.start >= rows * (columns + 1))).any(axis=1)
        demand(not beyond.any(), f"{name}: an index of an unused place lies outside the sums", cell, int(beyond.argmax()))
        return np.where(used, row + window.top + 1, 0), np.where(used, first + window.left, 1), np.where(used, last + window.left, 0)


@dataclass(frozen=True, kw_only=True)
class WindowClaim(BankClaim):
    """What a model states of one cell: windows of its groups and of its entries, `parts` entries a group; S row by row."""

    parts: int
    gate_size: NDArray[np.int32]
    gate: WindowPlaces
    windows: WindowPlaces
    span_first: NDArray[np.int16]
    span_stop: NDArray[np.int16]

    def spatial(self) -> Bits:
        """S in the window. Raises `Refuted` for a column outside of it."""
        inside = bool((self.span_first >= 0).all() and (self.span_stop <= self.window.shape[1]).all())
        demand(inside, "S: a span reaches out of the window", self.cell)
        column = np.arange(self.window.shape[1])
        first, stop = self.span_first[:, :, None], self.span_stop[:, :, None]
        return np.logical_or.reduce((column >= first) & (column < stop), axis=0)


def window_claims(scene: Scene, tables: WindowTables) -> Iterator[WindowClaim]:
    """What the tables state of each cell."""
    table, parts = tables.windows, tables.must_light_size.shape[1]
    stop = table.start.astype(np.int64) + table.columns.astype(np.int64) * tables.window.shape[0]
    for cell in range(len(tables.cells)):
        rows = tables.row_cell == cell
        yield WindowClaim(
            **bank_claim(scene, tables, cell),
            parts=parts,
            gate_size=table.gate_size[rows],
            gate=WindowPlaces(table.gate_start[rows].astype(np.int64), table.gate_stop[rows].astype(np.int64)),
            windows=WindowPlaces(
                table.start[rows].reshape(-1, table.start.shape[2]).astype(np.int64), stop[rows].reshape(-1, stop.shape[2])
            ),
            span_first=table.span_first[cell],
            span_stop=table.span_stop[cell],
        )

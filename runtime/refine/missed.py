"""Missed pixels are counted jointly: how many a set of states surely misses, and where what the frame shows may be due to them.

If all states of a set cross a border, each lights a pixel of the half-windows on both sides of it. One that is dark costs each state a
missed pixel; in a row the markings together cost as many as there are pairwise disjoint dark ones. Let k be the sum over the rows.
More than m refute the set. Otherwise at most m' = m - k pixels are missed beside those k, over all markings together; a pixel that is one
of the k lies in a dark half-window, so what a marking shows in a row is not due to it unless its own window there meets a dark one.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.refine.borders import Borders
from runtime.refine.interval import Bits, Floats
from runtime.refine.lit_columns import LitColumns
from runtime.refine.sensor_borders import SensorBorders


@dataclass(frozen=True)
class Missed:
    """The budget m of missed pixels as each set spends it."""

    budget: int
    left: NDArray[np.int64]
    """m' = m - k, (sets,); below 0 where the set is refuted."""
    halves: Bits
    """True for half-windows that meet a dark one in their row, itself among them, (2, markings, rows, sets): they bound nothing."""
    rows: Bits
    """The same of the rows' whole windows, (markings, rows, sets)."""

    @staticmethod
    def count(budget: int, borders: Borders | SensorBorders, halves: LitColumns, crossed: Bits) -> Missed:
        """`crossed`: half-windows whose border all states cross; `halves`: what the frame shows of them (`lit_columns`)."""
        dark: Bits = halves.dark & crossed
        sets, bound_nothing = dark.shape[-1], np.zeros(dark.shape[1:], dtype=bool)
        if budget == 0 or not dark.any():
            refuted: Bits = np.logical_or.reduce(dark, axis=(0, 1, 2))
            return Missed(budget, budget - refuted.astype(np.int64), dark, bound_nothing)
        markings = len(borders.crossed)
        row = np.flatnonzero(np.logical_or.reduce(dark, axis=(0, 1)))  # row and set in one number, the row's upper border's too
        columns = [side.reshape(markings, -1) for side in borders.columns]
        low, high = (np.array([side.take(row, axis=1), side.take(row + sets, axis=1)]) for side in columns)
        windows = HalfWindows(low, high, dark.reshape(2, markings, -1).take(row, axis=2))
        left = budget - np.bincount(row % sets, windows.cost(), sets).astype(np.int64)
        kept = np.flatnonzero(left[row % sets] >= 0)
        spoiled: Bits = np.zeros(dark.shape, dtype=bool)
        of_halves, of_rows = windows.of_rows(kept).that_meet_dark_ones()
        spoiled.reshape(2, markings, -1)[..., row[kept]], bound_nothing.reshape(markings, -1)[:, row[kept]] = of_halves, of_rows
        return Missed(budget, left, spoiled, bound_nothing)


@dataclass(frozen=True)
class HalfWindows:
    """First and last column of the half-windows at the upper (0) and the lower (1) border of rows, (2, markings, rows) each."""

    low: Floats
    high: Floats
    dark: Bits
    """True where all states of a set light a pixel of it, and the frame shows none."""

    def of_rows(self, numbers: NDArray[np.int64]) -> HalfWindows:
        """Those of some of the rows."""
        return HalfWindows(self.low.take(numbers, axis=2), self.high.take(numbers, axis=2), self.dark.take(numbers, axis=2))

    def cost(self) -> NDArray[np.int64]:
        """How many pairwise disjoint ones are dark in each row, (rows,).

        It is the largest number of them where their order from left to right is marking by marking, upper before lower.
        """
        _, markings, rows = self.dark.shape
        taken, end = np.zeros(rows, dtype=np.int64), np.full(rows, -np.inf)
        for marking, half in itertools.product(range(markings), range(2)):
            disjoint = self.dark[half, marking] & (self.low[half, marking] > end)
            taken += disjoint
            np.copyto(end, self.high[half, marking], where=disjoint)
        return taken

    def that_meet_dark_ones(self) -> tuple[Bits, Bits]:
        """True for those that meet a dark one of their row, itself too, and the same of the rows' whole windows, (markings, rows)."""
        _, markings, rows = self.dark.shape
        start, stop = (side.reshape(2 * markings, rows) for side in (self.low, self.high))
        dark: Bits = self.dark.reshape(2 * markings, rows)

        def meet(first: Floats, last: Floats) -> Bits:
            return np.logical_or.reduce(dark & (first[:, None] <= stop) & (start <= last[:, None]), axis=1)

        return meet(start, stop).reshape(self.dark.shape), meet(self.low.min(axis=0), self.high.max(axis=0))

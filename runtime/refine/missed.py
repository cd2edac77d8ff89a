"""Missed pixels are counted jointly: how many a set of states surely misses, and where what the frame shows may be due to them.

If all states of a set cross a border, each lights a pixel of the half-windows on both sides of it. One that is dark costs each state a
missed pixel; in a row the markings together cost as many as there are pairwise disjoint dark ones. Let k be the sum over the rows.
More than m refute the set. Otherwise at most m' = m - k pixels are missed beside those k, over all markings together; a pixel that is one
of the k lies in a dark half-window, so what a marking shows in a row is not due to it unless its own window there meets a dark one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.refine.borders import Borders
from runtime.refine.interval import Bits, Floats
from runtime.refine.lit_columns import LitColumns


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
    def count(budget: int, borders: Borders, halves: LitColumns, crossed: Bits) -> Missed:
        """`crossed`: half-windows whose border all states cross; `halves`: what the frame shows of them (`lit_columns`)."""
        dark: Bits = halves.dark & crossed
        sets, bound_nothing = dark.shape[-1], np.zeros(dark.shape[1:], dtype=bool)
        if budget == 0 or not dark.any():
            refuted: Bits = np.logical_or.reduce(dark, axis=(0, 1, 2))
            return Missed(budget, budget - refuted.astype(np.int64), dark, bound_nothing)
        row = np.flatnonzero(np.logical_or.reduce(dark, axis=(0, 1)))  # of a set, in one number: the row's upper border has the same
        flat = [side.reshape(len(side), -1) for side in borders.columns]
        low, high = (np.array([side.take(row, axis=1), side.take(row + sets, axis=1)]) for side in flat)
        taken, of_halves, of_rows = charged_windows(low, high, dark.reshape(2, len(flat[0]), -1).take(row, axis=2))
        spoiled: Bits = np.zeros(dark.shape, dtype=bool)
        spoiled.reshape(2, len(flat[0]), -1)[..., row], bound_nothing.reshape(len(flat[0]), -1)[:, row] = of_halves, of_rows
        left = budget - np.bincount(row % sets, taken, sets).astype(np.int64)
        return Missed(budget, left, spoiled, bound_nothing)


def charged_windows(low: Floats, high: Floats, dark: Bits) -> tuple[NDArray[np.int64], Bits, Bits]:
    """How many pixels the dark half-windows of a row cost, and which windows of the row meet a dark one.

    `low`, `high`: first and last column of the half-windows at the upper (0) and the lower (1) border of rows, (2, markings, rows). Returns
    (rows,), and of the half-windows, (2, markings, rows), and of the whole windows, (markings, rows). The cost is that of pairwise disjoint
    ones: the largest number of them where upper before lower, marking by marking, is their order from left to right.
    """
    markings, rows = dark.shape[1:]
    start, stop = (np.swapaxes(side, 0, 1).reshape(-1, rows) for side in (low, high))  # marking by marking
    charged: Bits = np.swapaxes(dark, 0, 1).reshape(-1, rows)
    taken, end = np.zeros(rows, dtype=np.int64), np.full(rows, -np.inf)
    for first, last, costs in zip(start, stop, charged, strict=True):
        disjoint = costs & (first > end)
        taken += disjoint
        end = np.where(disjoint, last, end)

    def meets(first: Floats, last: Floats) -> Bits:
        return np.logical_or.reduce(charged & (first[:, None] <= stop) & (start <= last[:, None]), axis=1)

    of_halves = np.swapaxes(meets(start, stop).reshape(markings, 2, rows), 0, 1)
    return taken, of_halves, meets(low.min(axis=0), high.max(axis=0))

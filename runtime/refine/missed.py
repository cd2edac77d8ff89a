"""Missed pixels are counted jointly: how many a set of states surely misses, and where what the frame shows may be due to them.

If all states of a set cross a border, each lights a pixel of the half-windows on both sides of it. One that is dark costs each state a
missed pixel; in a row the markings together cost the largest number of pairwise disjoint dark half-windows. Let k be the sum over the rows.
More than m refute the set. Otherwise at most m' = m - k pixels are missed beside those k, over all markings together; a pixel that is one
of the k lies in a dark half-window, so what a marking shows in a row is not due to it unless its own window there meets a dark one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.refine.interval import Bits
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
    def count(budget: int, halves: LitColumns, crossed: Bits, rows: LitColumns) -> Missed:
        """`crossed`: half-windows whose border all states cross; `halves` and `rows`: what the frame shows (`lit_columns`)."""
        dark = halves.dark & crossed
        shape = (-1, *dark.shape[2:])  # all half-windows of a row, those at the left first where markings rise from left to right
        low, high = (np.swapaxes(side, 0, 1).reshape(shape) for side in halves.window)
        charged: Bits = np.swapaxes(dark, 0, 1).reshape(shape)
        if budget == 0 or not charged.any():
            refuted: Bits = np.logical_or.reduce(charged, axis=(0, 1))
            return Missed(budget, budget - refuted.astype(np.int64), dark, np.zeros(rows.dark.shape, dtype=bool))
        taken, end = np.zeros(shape[1:], dtype=np.int64), np.full(shape[1:], -np.inf)
        for first, last, costs in zip(low, high, charged, strict=True):
            disjoint = costs & (first > end)
            taken += disjoint
            end = np.where(disjoint, last, end)
        of_halves: Bits = np.logical_or.reduce(charged & (low[:, None] <= high) & (low <= high[:, None]), axis=1)
        of_rows: Bits = np.logical_or.reduce(charged & (rows.window[0][:, None] <= high) & (low <= rows.window[1][:, None]), axis=1)
        left: NDArray[np.int64] = budget - taken.sum(axis=0)
        return Missed(budget, left, np.swapaxes(of_halves.reshape(dark.shape[1], 2, *dark.shape[2:]), 0, 1), of_rows)

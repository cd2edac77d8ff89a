"""Theorem B apart from Theorem A: S, whose lit pixels are vouched for, differs from cell to cell, so each cell is refined by itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from runtime.model.entries import Entries
from runtime.refine.refiner import Refiner, joined
from runtime.state_set import StateSet

LEAST_SEARCH = 2**7
"""A cell's search costs at least as much as so many entries: with many cells, fewer entries are refined (`Refiner.too_many`)."""


def refined_by_cell(
    refiner: Refiner,
    entries: Entries,
    passes: NDArray[np.bool_],
    frame: NDArray[np.bool_],
    known: Callable[[StateSet], StateSet] | None,
) -> StateSet:
    """What is left of the entries that pass, (rows, width), if the lit pixels of the true cell's S are the runway's, all but e of them.

    `frame`: (height, width). It is its own witness: pixels are vouched for at tolerance 0 only. e is the refiner's `extra_budget`.
    `known` cuts a cell's entries to what is known besides the frame.
    """
    alone = entries.row_cell[:, None]
    cells = {int(cell): entries.sets(passes & (alone == cell)) for cell in np.unique(entries.row_cell[passes.any(axis=1)])}
    if known is not None:
        cells = {cell: known(sets) for cell, sets in cells.items()}
    cells = {cell: sets for cell, sets in cells.items() if len(sets)}
    if refiner.too_many(sum(len(sets) + LEAST_SEARCH for sets in cells.values()), frame):
        return joined(*cells.values())
    left = (refiner.refine(frame, sets, entries.within(cell, frame), known is not None) for cell, sets in cells.items())
    return joined(entries.all[:0], *left)

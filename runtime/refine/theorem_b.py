"""Theorem B apart from Theorem A: what it claims differs from cell to cell, so that each cell's entries are refined by themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.model.entries import Entries
from runtime.refine.refiner import Refiner, joined
from runtime.state_set import StateSet


def refined_by_cell(refiner: Refiner, entries: Entries, passes: NDArray[np.bool_], frame: NDArray[np.bool_]) -> StateSet:
    """What is left of the entries that pass, (rows, width), where the lit pixels of a cell's S are claimed to be the runway's.

    But for the refiner's `extra_budget` of them. At tolerance 0, where each pixel of the frame, (height, width), is its own witness.
    """
    cells = np.unique(entries.row_cell[passes.any(axis=1)])
    alone = entries.row_cell[:, None]
    return joined(*(refiner.refine(frame, entries.sets(passes & (alone == cell)), entries.within(int(cell), frame)) for cell in cells))

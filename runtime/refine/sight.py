"""What a frame shows of some sets of states: all that a contractor may use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.refine.borders import Borders
from runtime.refine.interval import Bits
from runtime.refine.lit_columns import LitColumns
from runtime.refine.lit_pixels import LitPixels
from runtime.refine.missed import Missed
from runtime.scene import Scene
from runtime.state_set import StateSet


@dataclass(frozen=True)
class Vouched:
    """Theorem B: the lit pixels of S are the runway's, but for `extra_budget` of them."""

    pixels: LitPixels
    extra_budget: int


@dataclass(frozen=True)
class Sight:
    """The sets' borders, and what the frame's witnesses show at them; bounds made for the sets hold for all their subsets too."""

    scene: Scene
    borders: Borders
    halves: LitColumns
    crossed: Bits
    """Half-windows whose border the marking crosses in all states of the set, (2, markings, rows, sets)."""
    rows: LitColumns
    missed: Missed
    vouched: Vouched | None

    @staticmethod
    def of(scene: Scene, sets: StateSet, witnesses: LitPixels, missed_budget: int, vouched: Vouched | None) -> Sight:
        """Looks at the frame where the sets' markings may be."""
        borders = Borders.of(scene, sets, witnesses)
        halves, rows = LitColumns.of_halves(witnesses, borders), LitColumns.of_rows(witnesses, borders)
        crossed = np.stack([borders.crossed[:, :-1], borders.crossed[:, 1:]])
        return Sight(scene, borders, halves, crossed, rows, Missed.count(missed_budget, halves, crossed, rows), vouched)

"""What a frame shows of some sets of states: all that a contractor may use."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.refine.borders import Borders
from runtime.refine.interval import Bits
from runtime.refine.lit_columns import LitColumns, at_both_borders
from runtime.refine.lit_pixels import LitPixels
from runtime.refine.missed import Missed
from runtime.refine.optics import Optics
from runtime.refine.sensor_borders import SensorBorders
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
    borders: Borders | SensorBorders
    halves: LitColumns
    crossed: Bits
    """Half-windows whose border the marking crosses in all states of the set, (2, markings, rows, sets)."""
    rows: LitColumns
    missed: Missed
    vouched: Vouched | None

    @staticmethod
    def of(
        scene: Scene, sets: StateSet, witnesses: LitPixels, missed_budget: int, vouched: Vouched | None, optics: Optics | None = None
    ) -> Sight:
        """Looks at the frame where the sets' markings may be; behind a lens, whose `optics` these are, the frame is the sensor's own."""
        ideal = sets.roll is None and optics is None
        borders = Borders.of(scene, sets, witnesses) if ideal else SensorBorders.of(scene, sets, witnesses, optics)
        halves, rows = LitColumns.of(witnesses, borders)
        crossed = at_both_borders(borders.crossed)
        return Sight(scene, borders, halves, crossed, rows, Missed.count(missed_budget, borders, halves, crossed), vouched)

    def of_sets(self, numbers: NDArray[np.int64]) -> Sight:
        """What is shown of some of the sets."""
        borders, halves, rows, missed = (_of_sets(part, numbers) for part in (self.borders, self.halves, self.rows, self.missed))
        return Sight(self.scene, borders, halves, self.crossed.take(numbers, axis=-1), rows, missed, self.vouched)


def _of_sets(part: Any, numbers: NDArray[np.int64]) -> Any:
    """Some of the sets of an array, whose last axis they are, and of a pair or a dataclass of such arrays."""
    if isinstance(part, np.ndarray):
        return part.take(numbers, axis=-1)
    if isinstance(part, tuple):
        return tuple(_of_sets(side, numbers) for side in part)
    if is_dataclass(part) and not isinstance(part, Optics):
        return type(part)(*(_of_sets(getattr(part, field.name), numbers) for field in fields(part)))
    return part

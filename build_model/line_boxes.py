"""Entries of a bank as boxes in line coordinates: theta, x, scale and z.

theta fixes the row in which all markings' lines vanish, and the scale (px per metre of the ground at a reference row) and x fix where each
crosses that row; z places the ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.scene import Camera
from runtime.state_set import StateSet, tangent_of_row

LINE_COORDINATES = ("theta", "x", "scale", "z")
HALVINGS, HALVING_ORDER = 12, ("scale", "x", "theta", "z")
"""How often an entry that would pass on any frame is halved, along which coordinates by turns, before the scene is refused."""
MOST_WEAK = 4096
"""More weak entries than this in a cell are not halved: the scene asks for more than a bank of sensible size can give."""


@dataclass(frozen=True)
class LineBoxes:
    """Entries as boxes in line coordinates: `lower` and `upper` (entries, 4) hold theta, x, scale, z; `reference_row` (entries,) px.

    An entry is the set of states of its cell inside its box.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    reference_row: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.lower)

    def __getitem__(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> LineBoxes:
        return LineBoxes(self.lower[chosen], self.upper[chosen], self.reference_row[chosen])

    @staticmethod
    def joined(parts: list[LineBoxes]) -> LineBoxes:
        """All boxes in one list."""
        return LineBoxes(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("lower", "upper", "reference_row")))

    def states(self, camera: Camera, cell_lower: NDArray[np.float64], cell_upper: NDArray[np.float64]) -> StateSet:
        """The entries of the cell [cell_lower, cell_upper], (4,) each, as sets of states, not yet contracted."""
        theta, x, scale, z = (np.stack([self.lower[:, axis], self.upper[:, axis]], axis=-1) for axis in range(4))
        y = np.broadcast_to([cell_lower[2], cell_upper[2]], theta.shape)
        return StateSet(theta, x, y, z, scale, tangent_of_row(camera, self.reference_row))

    def halved(self, coordinate: str) -> LineBoxes:
        """Each box as two halves along one line coordinate, the lower halves first; along the scale where that coordinate is fixed."""
        axis = LINE_COORDINATES.index(coordinate)
        axes = np.where(self.upper[:, axis] > self.lower[:, axis], axis, LINE_COORDINATES.index("scale"))
        each = np.arange(len(self))
        middle = (self.lower[each, axes] + self.upper[each, axes]) / 2
        lower, upper = np.concatenate([self.lower] * 2), np.concatenate([self.upper] * 2)
        upper[each, axes] = lower[len(self) + each, axes] = middle
        return LineBoxes(lower, upper, np.concatenate([self.reference_row] * 2))

"""How a drawn domain is divided into cells: equally, at unlike edges, by a ratio, or along a glide."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from random_scenes.sights import Floats, Rng
from runtime.domain import AnyAxis, Axis, Domain, Edges, Glide, Growth

KINDS = {"equal": 0.5, "edges": 0.3, "ratio": 0.2}
"""Kinds of axes, and how often they are drawn."""
GLIDES = 0.25
"""How often altitudes are given by a glide, where altitude is free."""
MOST_SHIFTED = 0.35
"""Largest shift of an inner edge, in cells."""
SPARE_CELLS = 0.3
"""By how much a ratio may miss the number of cells that it is drawn for."""


@dataclass(frozen=True)
class Division:
    """What the axes of a domain are divided by. Arrays are by theta, x, y, z."""

    kinds: tuple[str, str, str, str] = ("equal", "equal", "equal", "equal")
    shifts: Floats | None = None
    """Of the inner edges, in cells, (4, edges)."""
    spare: float = 0.0
    """Cells more than an axis has by its ratio."""
    glide: float | None = None
    """The steps of the staircase, in heights of the domain; None: no glide."""

    def domain(self, centres: tuple[float, ...], widths: list[float], counts: list[int]) -> Domain:
        """The domain about a state (4,), with so many cells about as wide as these."""
        parts = zip(itertools.count(), centres, widths, counts)
        axes = [self._axis(*each) for each in parts]
        if self.glide is None or widths[2] == 0:
            return Domain(*axes)
        return Domain(axes[0], axes[1], None, axes[3], glide=self._glide(centres, widths, counts, axes[3]))

    def _axis(self, number: int, centre: float, width: float, count: int) -> AnyAxis:
        kind, low, high = self.kinds[number], centre - width * count / 2, centre + width * count / 2
        if width == 0 or kind == "equal":
            return axis_about(centre, width, count)
        if kind == "ratio" and low > width:
            return Growth(low, high, (high / low) ** (1 / (count - self.spare)))
        shifts = [0.0] * (count - 1) if self.shifts is None else self.shifts[number, : count - 1].tolist()
        return Edges((low, *(low + width * (place + shift) for place, shift in enumerate(shifts, start=1)), high))

    def _glide(self, centres: tuple[float, ...], widths: list[float], counts: list[int], z: AnyAxis) -> Glide:
        """A glide whose altitudes at the middle distance are those asked for, and whose steps are `glide` times as high, or lower."""
        assert self.glide is not None
        y, height, borders = centres[2], widths[2] * counts[2], z.borders
        span, step = float(borders[-1] - borders[0]), float(np.diff(borders).max())
        beyond = max(2 * span, y, step * y / (self.glide * height))
        angles = math.atan((y - height / 2) / beyond), math.atan((y + height / 2) / beyond)
        return Glide(angles, beyond - float(borders[0] + borders[-1]) / 2, counts[2])


EQUAL = Division()


def axis_about(centre: float, width: float, count: int) -> Axis:
    """Cells about a centre; one if they have no width."""
    count = count if width > 0 else 1
    return Axis(tuple(centre + width * (place - (count - 1) / 2) for place in range(count)), width)


def draw_division(rng: Rng, most_cells: int) -> Division:
    """Half of all axes equally divided, and a glide now and then."""
    kinds = rng.choice(list(KINDS), 4, p=list(KINDS.values())).tolist()
    shifts = rng.uniform(-MOST_SHIFTED, MOST_SHIFTED, (4, most_cells - 1))
    glide = float(rng.uniform(0.3, 3)) if rng.random() < GLIDES else None
    return Division((kinds[0], kinds[1], kinds[2], kinds[3]), shifts, float(rng.uniform(-SPARE_CELLS, SPARE_CELLS)), glide)


def stretch_of(domain: Domain, widths: Floats) -> float:
    """How many times larger than these widths the largest cell is, over the axes together; 1 or more."""
    lower, upper = domain.cells()
    wide = np.where(widths > 0, (upper - lower) / np.where(widths > 0, widths, 1), 1)
    return float(np.maximum(wide, 1).prod(axis=1).max())

"""Numbers known up to a distance from a middle, of many sets at once: sums, products and quotients, outward but for rounding.

What rounds is not followed: who uses a result adds a share of its terms (`runtime.rounding`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.refine.interval import Bits, Floats


@dataclass(frozen=True)
class Around:
    """A number within `off` of `middle`, arrays of any shapes that go together."""

    middle: Floats
    off: Floats

    @staticmethod
    def between(low: Floats, high: Floats, more: Floats) -> Around:
        """Between two numbers in either order, or `more` beyond."""
        return Around((low + high) / 2, np.abs(high - low) / 2 + more)

    def __add__(self, other: Around) -> Around:
        return Around(self.middle + other.middle, self.off + other.off)

    def __sub__(self, other: Around) -> Around:
        return Around(self.middle - other.middle, self.off + other.off)

    def __mul__(self, other: Around) -> Around:
        off = np.abs(self.middle) * other.off + self.off * (np.abs(other.middle) + other.off)
        return Around(self.middle * other.middle, off)

    def over(self, other: Around) -> tuple[Around, Bits]:
        """The quotient, and True where the divisor is far enough above 0 for it to mean anything."""
        known = other.middle > 2 * other.off
        middle, off = np.where(known, other.middle, 1.0), np.where(known, other.off, 0.0)
        per = 1 / middle
        return self * Around(per, off * per / (middle - off)), known

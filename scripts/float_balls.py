"""Arrays of balls in float64: a middle and a radius that holds whatever the exact result may be, as Arb's balls but of a whole array.

Sums, products, quotients and square roots are rounded to nearest by IEEE 754, within 2^-53 of themselves; `atan` is taken to be right
within 2^-50 of itself, which is several units in the last place. Radii are computed in float64 too, and raised by more than that loses.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

ROUNDING, OF_ATAN = 2.0**-52, 2.0**-50
"""Shares of a result that its rounding is taken to be off by: twice what it is, so that a radius's own rounding is held too."""
RAISED, TINY = 1 + 2.0**-48, 2.0**-1000
"""What a radius is multiplied by and what is added to it, for its own rounding and for results that underflow."""


@dataclass(frozen=True)
class FloatBalls:
    """All numbers within `radius` of `middle`; arrays of one shape, or of shapes that go together."""

    middle: Floats
    radius: Floats

    @staticmethod
    def of(number: Fraction | float) -> FloatBalls:
        """A number, exactly held: the nearest float64 and how far that is from it."""
        middle = float(number)
        return FloatBalls(np.array(middle), np.array(abs(float(Fraction(number) - Fraction(middle))) * RAISED + TINY))

    def __add__(self, other: FloatBalls) -> FloatBalls:
        return _rounded(self.middle + other.middle, self.radius + other.radius)

    def __sub__(self, other: FloatBalls) -> FloatBalls:
        return _rounded(self.middle - other.middle, self.radius + other.radius)

    def __mul__(self, other: FloatBalls) -> FloatBalls:
        size, other_size = np.abs(self.middle), np.abs(other.middle) + other.radius
        return _rounded(self.middle * other.middle, size * other.radius + self.radius * other_size)

    def __truediv__(self, other: FloatBalls) -> FloatBalls:
        """The quotient; where the divisor may be 0, a ball without bound."""
        least = np.abs(other.middle) - other.radius
        sure = least > 0
        quotient = self.middle / np.where(sure, other.middle, 1.0)
        radius = (self.radius + np.abs(quotient) * other.radius) / np.where(sure, least, 1.0)
        return _rounded(quotient, np.where(sure, radius, np.inf))

    def sqrt(self) -> FloatBalls:
        """The square root of what is not below 0."""
        low, high = np.sqrt(np.maximum(self.middle - self.radius, 0)), np.sqrt(np.maximum(self.middle + self.radius, 0))
        return _rounded((low + high) / 2, (high - low) / 2 + ROUNDING * high)

    def atan(self) -> FloatBalls:
        """The arctangent, whose derivative is 1 at most."""
        middle = np.arctan(self.middle)
        return FloatBalls(middle, (self.radius + OF_ATAN * np.abs(middle)) * RAISED + TINY)

    @property
    def low(self) -> Floats:
        """Not above any number of a ball."""
        return self.middle - (self.radius + ROUNDING * np.abs(self.middle)) * RAISED

    @property
    def high(self) -> Floats:
        """Not below any number of a ball."""
        return self.middle + (self.radius + ROUNDING * np.abs(self.middle)) * RAISED


def _rounded(middle: Floats, radius: Floats) -> FloatBalls:
    return FloatBalls(middle, (radius + ROUNDING * np.abs(middle)) * RAISED + TINY)

"""Interval arithmetic in float64: every operation of a `RoundedInterval` rounds outward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from runtime.refine.interval import Floats

TRIGONOMETRIC_ERROR = 2.0**-50
"""Bound on the error of numpy's sin and cos: 4 units in the last place, the largest that numpy allows its vector code."""


@dataclass(frozen=True)
class RoundedInterval:
    """An array of intervals; every operation rounds outward, so that results contain all real results."""

    lower: Floats
    upper: Floats

    @staticmethod
    def of(value: ArrayLike) -> RoundedInterval:
        """The number itself."""
        return RoundedInterval(np.asarray(value, dtype=np.float64), np.asarray(value, dtype=np.float64))

    def __neg__(self) -> RoundedInterval:
        return RoundedInterval(-self.upper, -self.lower)

    def __add__(self, other: RoundedInterval) -> RoundedInterval:
        return _outward(self.lower + other.lower, self.upper + other.upper)

    def __sub__(self, other: RoundedInterval) -> RoundedInterval:
        return self + -other

    def __mul__(self, other: RoundedInterval) -> RoundedInterval:
        products = [a * b for a in (self.lower, self.upper) for b in (other.lower, other.upper)]
        return _outward(np.minimum.reduce(products), np.maximum.reduce(products))

    def __truediv__(self, other: RoundedInterval) -> RoundedInterval:
        """Raises `ValueError` unless the divisor is positive."""
        if np.any(other.lower <= 0):
            raise ValueError(f"box: a depth Z of {other.lower.min():.3g} m is not excluded by intervals; divide the box into narrower ones")
        return self * _outward(1 / other.upper, 1 / other.lower)

    def square(self) -> RoundedInterval:
        """The square, which is not negative."""
        largest = np.maximum(np.abs(self.lower), np.abs(self.upper))
        smallest = np.where((self.lower <= 0) & (self.upper >= 0), 0, np.minimum(np.abs(self.lower), np.abs(self.upper)))
        squares = _outward(smallest**2, largest**2)
        return RoundedInterval(np.maximum(squares.lower, 0), squares.upper)

    def sin(self) -> RoundedInterval:
        """The sine of angles within -pi/2 and pi/2, where it rises."""
        return RoundedInterval(np.sin(self.lower) - TRIGONOMETRIC_ERROR, np.sin(self.upper) + TRIGONOMETRIC_ERROR)

    def cos(self) -> RoundedInterval:
        """The cosine of angles within -pi/2 and pi/2, where it rises up to 0 and falls from there."""
        low, high = np.cos(self.lower), np.cos(self.upper)
        peak = np.where((self.lower <= 0) & (self.upper >= 0), 1.0, np.maximum(low, high))
        return RoundedInterval(np.minimum(low, high) - TRIGONOMETRIC_ERROR, peak + TRIGONOMETRIC_ERROR)


def _outward(lower: Floats, upper: Floats) -> RoundedInterval:
    return RoundedInterval(np.nextafter(lower, -np.inf), np.nextafter(upper, np.inf))

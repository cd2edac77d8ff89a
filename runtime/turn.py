"""Cosine and sine in sums and products alone, which IEEE 754 fixes to the last bit.

Those of numpy and libm do not have the same digits everywhere: glibc takes others with fused multiply-adds than without, and every other
libm its own. A certified box would then depend on the processor by its last digits.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DEGREE = 12
"""Power of the angle's square that the series end with: what is left out is below 2^-70 up to pi/2."""
COEFFICIENTS = [np.array([[(-1) ** power / math.factorial(2 * power + odd)] for odd in (0, 1)]) for power in range(DEGREE, -1, -1)]
"""Of the series of cos(a) and of sin(a)/a in the square of a, the last ones first; a quotient of integers is rounded once."""


def cosine_and_sine(angle: Floats) -> tuple[Floats, Floats]:
    """Cosine and sine of angles of any shape from -pi/2 to pi/2, rad, with the same digits on every machine.

    Off by 4 x 2^-53 at most, the sine relative to itself: the last three roundings, and what the ones before them leave.
    """
    flat = angle.ravel()
    square = np.empty((2, flat.size))
    square[:] = flat * flat
    series = square * COEFFICIENTS[0]
    for coefficient in COEFFICIENTS[1:-1]:
        series += coefficient
        series *= square
    series += COEFFICIENTS[-1]
    series[1] *= flat
    cosine, sine = series.reshape(2, *angle.shape)
    return cosine, sine

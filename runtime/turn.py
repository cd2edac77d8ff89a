"""Cosine, sine and arctangent in sums, products, quotients and square roots alone, which IEEE 754 fixes to the last bit.

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
HALVINGS = 3
"""How often an arctangent's angle is halved before its series: to pi/16 at most."""
ARCTANGENT_DEGREE = 13
"""Power of the tangent's square that the series ends with: what is left out is below 2^-60 of the first term for such an angle."""
ARCTANGENT_COEFFICIENTS = [(-1) ** power / (2 * power + 1) for power in range(ARCTANGENT_DEGREE, -1, -1)]
"""Of the series of atan(t)/t in the square of t, the last ones first."""


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


def arctangent(tangent: Floats) -> Floats:
    """Angles within (-pi/2, pi/2), rad, of tangents of any shape up to 2^500, with the same digits on every machine.

    Off by 2^-48 of itself at most: atan(t) = 2 atan(t / (1 + sqrt(1 + t^2))) thrice, then its series.
    """
    half = tangent
    for _ in range(HALVINGS):
        half = half / (1 + np.sqrt(1 + half * half))
    square = half * half
    series = np.full_like(square, ARCTANGENT_COEFFICIENTS[0])
    for coefficient in ARCTANGENT_COEFFICIENTS[1:]:
        series *= square
        series += coefficient
    return 2**HALVINGS * (half * series)

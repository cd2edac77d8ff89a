"""Intervals of many sets at once: a pair of arrays, lower and upper bounds; an infinity of the right sign where there is no bound."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from runtime.rounding import lowered, raised

Floats = NDArray[np.float64]
Bits = NDArray[np.bool_]
Interval = tuple[Floats, Floats]


def intersected(first: Interval, second: Interval) -> Interval:
    """The numbers that lie in both intervals; inverted where there are none."""
    return np.maximum(first[0], second[0]), np.minimum(first[1], second[1])


def quotient(dividend: Interval, divisor: Interval) -> Interval:
    """Range of a quotient where the divisor has one sign, rounded outward; no bound where it has not."""
    (low, high), (near, far) = dividend, divisor
    usable = near * far > 0
    if not usable.all():
        near, far = np.where(usable, near, 1.0), np.where(usable, far, 1.0)
        low, high = np.where(usable, low, -np.inf), np.where(usable, high, np.inf)
    sides = low / near, low / far, high / near, high / far
    smallest, largest = functools.reduce(np.minimum, sides), functools.reduce(np.maximum, sides)
    return lowered(smallest, np.abs(smallest)), raised(largest, np.abs(largest))


def relaxed_intersection(low: Floats, high: Floats, spoiled: NDArray[np.int64], most: int) -> Interval:
    """Bounds on a number that lies in all but `spoiled` of the intervals along axis 1: the q-relaxed intersection of Jaulin.

    `low`, `high`: (markings, intervals, sets); `spoiled`: (sets,), from 0 to `most`. Returns (markings, sets) each: the lower bound is the
    largest of `low` but for `spoiled` larger ones. No bound where there are no more intervals than that.
    """
    most = min(most, low.shape[1])
    if most == 0:
        return np.maximum.reduce(low, axis=1, initial=-np.inf), np.minimum.reduce(high, axis=1, initial=np.inf)
    return _largest_but(low, np.minimum(spoiled, most), most), -_largest_but(-high, np.minimum(spoiled, most), most)


def _largest_but(values: Floats, spoiled: NDArray[np.int64], most: int) -> Floats:
    if most == values.shape[1]:
        values = np.concatenate([np.full((len(values), 1, values.shape[2]), -np.inf), values], axis=1)
    largest = np.sort(np.partition(values, -most - 1, axis=1)[:, -most - 1 :], axis=1)
    return np.take_along_axis(largest, (most - spoiled)[None, None], axis=1)[:, 0]

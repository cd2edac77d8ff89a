"""What bounds on the offsets (p_x - x) scale of markings say of scale and x, by each marking, and by differences, which are free of x."""

from __future__ import annotations

import itertools

import numpy as np

from runtime.refine.interval import Floats, Interval, intersected, quotient
from runtime.rounding import lowered, raised


def scale_and_x(x_m: Floats, offset: Interval, scale: Interval, x: Interval) -> tuple[Interval, Interval | None]:
    """The scale, and x where it is not known, (sets,), contracted by bounds on the offsets (markings, sets) of markings at x_m."""
    markings_x, (low, high), (x_low, x_high) = x_m[:, None], offset, x
    slow, fast = quotient(offset, (markings_x - x_high, markings_x - x_low))
    scale = intersected((np.maximum.reduce(slow, axis=0), np.minimum.reduce(fast, axis=0)), scale)
    if (x_high <= x_low).all():
        return scale, None
    for left, right in itertools.combinations(range(len(x_m)), 2):
        apart = np.full(low.shape[1], x_m[right] - x_m[left])
        scale = intersected(scale, quotient((low[right] - high[left], high[right] - low[left]), (apart, apart)))
    across_low, across_high = quotient(offset, scale)
    x_low, x_high = markings_x - across_high, markings_x - across_low
    x_low, x_high = lowered(x_low, np.abs(markings_x) + np.abs(x_low)), raised(x_high, np.abs(markings_x) + np.abs(x_high))
    return scale, (np.maximum.reduce(x_low, axis=0), np.minimum.reduce(x_high, axis=0))

"""Contractor of scale and x by the offsets (p_x - x) scale of the markings."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable

import numpy as np

from runtime.refine.crossings import offsets_at_crossings
from runtime.refine.end_pixels import offsets_at_ends
from runtime.refine.interval import Interval, intersected, quotient
from runtime.refine.sight import Sight
from runtime.refine.vouched import offsets_by_vouched
from runtime.rounding import lowered, raised
from runtime.state_set import StateSet

SOURCES: tuple[Callable[[StateSet, Sight], Interval], ...] = (offsets_at_crossings, offsets_at_ends, offsets_by_vouched)
"""Each gives bounds on the offset of each marking, (markings, sets), px, that hold for all states which the frame allows."""


def contract_by_offsets(sets: StateSet, sight: Sight) -> StateSet:
    """The sets with scale and x contracted, marking by marking and by the differences of markings, which are free of x.

    Sets whose offsets the frame contradicts, or whose states miss too many pixels, come out empty.
    """
    low, high = functools.reduce(intersected, (source(sets, sight) for source in SOURCES if sight.vouched or source != offsets_by_vouched))
    refuted = np.logical_or.reduce(low > high, axis=0) | (sight.missed.left < 0)
    offset = low, high = np.where(refuted, 0.0, low), np.where(refuted, 0.0, high)
    x_low, x_high = sight.borders.seen_x(sets)
    markings_x = sight.scene.runway.x_m[:, None]
    slow, fast = quotient(offset, (markings_x - x_high, markings_x - x_low))
    scale = intersected((np.maximum.reduce(slow, axis=0), np.minimum.reduce(fast, axis=0)), (sets.scale[:, 0], sets.scale[:, 1]))
    if (x_high <= x_low).all():
        return sets.contracted(scale=scale).emptied(refuted | (scale[0] > scale[1]))
    x_m = sight.scene.runway.x_m
    for left, right in itertools.combinations(range(len(x_m)), 2):
        apart = np.full(len(sets), x_m[right] - x_m[left])
        scale = intersected(scale, quotient((low[right] - high[left], high[right] - low[left]), (apart, apart)))
    across_low, across_high = quotient(offset, scale)
    x_low, x_high = markings_x - across_high, markings_x - across_low
    x_low, x_high = lowered(x_low, np.abs(markings_x) + np.abs(x_low)), raised(x_high, np.abs(markings_x) + np.abs(x_high))
    x = sight.borders.true_x(sets, np.maximum.reduce(x_low, axis=0), np.minimum.reduce(x_high, axis=0))
    return sets.contracted(scale=scale, x=x).emptied(refuted | (scale[0] > scale[1]))

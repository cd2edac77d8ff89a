"""Contractor of scale and x by the offsets (p_x - x) scale of the markings."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from runtime.refine.borders import Borders
from runtime.refine.crossings import offsets_at_crossings
from runtime.refine.end_pixels import offsets_at_ends
from runtime.refine.interval import Interval, intersected
from runtime.refine.lateral import scale_and_x
from runtime.refine.sensor_borders import SensorBorders
from runtime.refine.sheared import contract_by_sheared_offsets
from runtime.refine.sight import Sight
from runtime.refine.vouched import offsets_by_vouched
from runtime.state_set import StateSet

SOURCES: tuple[Callable[[StateSet, Sight], Interval], ...] = (offsets_at_crossings, offsets_at_ends, offsets_by_vouched)
"""Each gives bounds on the offset of each marking, (markings, sets), px, that hold for all states which the frame allows."""


def contract_by_offsets(sets: StateSet, sight: Sight) -> StateSet:
    """The sets with scale and x contracted, marking by marking and by the differences of markings, which are free of x.

    Sets whose offsets the frame contradicts, or whose states miss too many pixels, come out empty. Of a camera of which something is
    unknown, the offsets that are seen are not the states' own (`sheared`).
    """
    if isinstance(sight.borders, SensorBorders) and sight.borders.unknowns is not None:
        return contract_by_sheared_offsets(sets, sight)
    low, high = functools.reduce(intersected, (source(sets, sight) for source in SOURCES if _may_tell(source, sets, sight)))
    refuted = np.logical_or.reduce(low > high, axis=0) | (sight.missed.left < 0)
    offset = np.where(refuted, 0.0, low), np.where(refuted, 0.0, high)
    x = sight.borders.seen_x(sets)
    scale, seen_x = scale_and_x(sight.scene.runway.x_m, offset, (sets.scale[:, 0], sets.scale[:, 1]), x)
    if seen_x is None:
        return sets.contracted(scale=scale).emptied(refuted | (scale[0] > scale[1]))
    return sets.contracted(scale=scale, x=sight.borders.true_x(sets, *seen_x)).emptied(refuted | (scale[0] > scale[1]))


def _may_tell(source: Callable[[StateSet, Sight], Interval], sets: StateSet, sight: Sight) -> bool:
    """Does the source tell what no other contractor does? With x known and none missed, what crossings tell is in the scales (`scales`)."""
    if source == offsets_at_crossings:
        return not (isinstance(sight.borders, Borders) and sets.x_known and (sight.missed.left <= 0).all())
    return source != offsets_by_vouched or sight.vouched is not None

"""Contractor of scale and x by the offsets (p_x - x) scale of the markings."""

from __future__ import annotations

import functools

import numpy as np

from runtime.refine.crossings import offsets_at_crossings
from runtime.refine.end_pixels import offsets_at_ends
from runtime.refine.interval import intersected, quotient
from runtime.refine.sight import Sight
from runtime.refine.vouched import offsets_by_vouched
from runtime.rounding import lowered, raised
from runtime.state_set import StateSet


def contract_by_offsets(sets: StateSet, sight: Sight) -> StateSet:
    """The sets with scale and x contracted, marking by marking and by the differences of markings, which are free of x.

    Sets whose offsets the frame contradicts, or whose states miss too many pixels, come out empty.
    """
    bounds = [offsets_at_crossings(sight), offsets_at_ends(sets, sight)]
    if sight.vouched is not None:
        bounds.append(offsets_by_vouched(sets, sight, sight.vouched))
    low, high = functools.reduce(intersected, bounds)
    refuted = (low > high).any(axis=0) | (sight.missed.left < 0)
    low, high = (np.where(refuted, 0.0, side).T for side in (low, high))
    x_m = sight.scene.runway.x_m
    scale_low, scale_high = quotient(low, high, x_m[:, None] - sets.x[:, None, ::-1])
    scale = intersected((scale_low.max(axis=1), scale_high.min(axis=1)), (sets.scale[:, 0], sets.scale[:, 1]))
    if (sets.x[:, 1] <= sets.x[:, 0]).all():
        return sets.contracted(scale=scale).emptied(refuted | (scale[0] > scale[1]))
    for left, right in zip(*np.triu_indices(len(x_m), 1), strict=True):
        apart = np.full(2, x_m[right] - x_m[left])
        scale = intersected(scale, quotient(low[:, right] - high[:, left], high[:, right] - low[:, left], apart))
    across_low, across_high = quotient(low, high, np.stack(scale, axis=-1)[:, None, :])
    x_low, x_high = x_m - across_high, x_m - across_low
    x_low, x_high = lowered(x_low, np.abs(x_m) + np.abs(x_low)), raised(x_high, np.abs(x_m) + np.abs(x_high))
    x = x_low.max(axis=1), x_high.min(axis=1)
    return sets.contracted(scale=scale, x=x).emptied(refuted | (scale[0] > scale[1]))

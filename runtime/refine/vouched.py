"""Theorem B: the lit pixels of S, here *vouched* pixels, are the runway's but for `extra_budget` of them: the user vouches for it.

A vouched pixel that only one marking of the set could light bounds that marking's offset by the pixel's other side, and pulls its ends
out to the pixel's row.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from runtime.refine.borders import Borders, across
from runtime.refine.ground import z_of_rows
from runtime.refine.interval import Interval, relaxed_intersection
from runtime.refine.lit_columns import LitColumns
from runtime.refine.sight import Sight, Vouched
from runtime.state_set import StateSet


def offsets_by_vouched(sets: StateSet, sight: Sight) -> Interval:
    """Bounds on the offset (p_x - x) scale of each marking, (markings, sets), px; without bounds under Theorem A, and on a turned sensor.

    Inverted where more than `extra_budget` vouched pixels lie where no marking of the set can be.
    """
    vouched, borders, u0 = sight.vouched, sight.borders, sight.scene.camera.u0
    if vouched is None or not isinstance(borders, Borders):
        return np.full(borders.near[0].shape, -np.inf), np.full(borders.near[0].shape, np.inf)
    own = _of_one_marking(vouched, sight)
    across_low, across_high = across(sight.scene, sets)
    rises, falls = across_low[:, None] >= 0, across_high[:, None] <= 0
    high, low = own.first + (1 - u0 + borders.margin_px), own.last - (u0 + borders.margin_px)
    per_low, per_high = borders.per_ratio
    high_start, high_stop = (np.maximum(high * per_low[side], high * per_high[side]) for side in (slice(-1), slice(1, None)))
    low_start, low_stop = (np.minimum(low * per_low[side], low * per_high[side]) for side in (slice(-1), slice(1, None)))
    usable = sight.crossed.all(axis=0) & ~own.dark & (rises | falls)
    high = np.where(usable, np.where(rises, high_start, high_stop), np.inf)
    low = np.where(usable, np.where(rises, low_stop, low_start), -np.inf)
    bounds = relaxed_intersection(low, high, _all_of(vouched, sets), vouched.extra_budget)
    explained = vouched.pixels.count(borders.row[:-1], borders.across_rows()).sum(axis=(0, 1))
    unexplained = vouched.pixels.canvas.sum() - explained > vouched.extra_budget
    return np.where(unexplained, np.inf, bounds[0]), np.where(unexplained, -np.inf, bounds[1])


def contract_by_vouched(sets: StateSet, sight: Sight) -> StateSet:
    """The sets with z contracted: markings reach the rows of the pixels that only they could have lit.

    Without vouched pixels, under Theorem A, the sets are returned unchanged.
    """
    vouched = sight.vouched
    if vouched is None:
        return sets
    borders, camera, ends_z_m = sight.borders, sight.scene.camera, sight.scene.runway.ends_z_m
    found, row = ~_of_one_marking(vouched, sight).dark, borders.row[:-1]
    last, first = relaxed_intersection(
        np.where(found, row, -np.inf), np.where(found, row + 1, np.inf), _all_of(vouched, sets), vouched.extra_budget
    )
    last, first = (np.clip(side, borders.far[0], borders.near[1]) for side in (last, first))
    return sets.contracted(z=z_of_rows(camera, sets, first, ends_z_m[:, 1], last, ends_z_m[:, 0]))


def _all_of(vouched: Vouched, sets: StateSet) -> NDArray[np.int64]:
    """For every set, how many vouched pixels may be none of the runway's."""
    return np.full(len(sets), vouched.extra_budget, dtype=np.int64)


def _of_one_marking(vouched: Vouched, sight: Sight) -> LitColumns:
    """The vouched pixels of the rows' windows, without the rows in which another marking could light one of a marking's columns."""
    low, high = window = sight.borders.across_rows()
    shared = np.zeros(low.shape, dtype=bool)
    for left, right in itertools.permutations(range(len(low)), 2):
        shared[left] |= (low[left] <= high[right]) & (low[right] <= high[left])
    first, last = vouched.pixels.nearest(sight.borders.row[:-1], window)
    return LitColumns.found(np.where(shared, np.inf, first), np.where(shared, -np.inf, last))

"""Contractor of scale and theta by the ground's scales at the borders that all states of a set cross.

What two markings show at a border, or one whose side of the camera is known, bounds the ground's scale g there. The set's own scale is
g / R. Two borders tell the row of the horizon besides, and that row tells theta: the scale g of a state rises along the frame from 0 at
the horizon, g(v) is (v - v0) + T times a positive number, T = F_v tan(theta). Let low <= g(v1) at a border and g(v2) <= high at another
one, both below the horizon. Then low ((v2 - v0) + T) <= high ((v1 - v0) + T), so

    T >= low (v2 - v1) / (high - low) - (v1 - v0)  if low < high,  and T <= that  if low > high

Every pair gives such a bound. The pair that a T contradicts most is the border of the largest low / ((v - v0) + T) with that of the
smallest high / ((v - v0) + T). Taken at either end of theta it is one step of Newton's method toward what all pairs allow.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from runtime.refine.borders import Borders, across
from runtime.refine.crossings import columns_at_borders
from runtime.refine.interval import Floats, Interval
from runtime.refine.sight import Sight
from runtime.rounding import OUTWARD_PX, lowered, raised
from runtime.state_set import StateSet


def contract_by_scales(sets: StateSet, sight: Sight) -> StateSet:
    """The sets with scale and theta contracted by the borders that all states of a set cross; those with missed pixels left as they were.

    So are all on a turned sensor, whose borders are no rows of the ideal frame. Sets that the frame contradicts come out empty.
    """
    borders, complete = sight.borders, sight.missed.left == 0
    if not isinstance(borders, Borders) or not complete.any():
        return sets
    camera = sight.scene.camera
    low, high = scales_at_borders(sets, sight, borders)
    per_low, per_high = borders.per_ratio
    least, most = np.maximum.reduce(low * per_high, axis=0), np.minimum.reduce(high * per_low, axis=0)
    contradicted = np.logical_or.reduce(low > high, axis=0)
    cosine, sine = (side.T for side in sets.turn)
    tangent = sine / cosine
    lowest, highest = horizon_bounds(borders.row, camera.v0, low, high, camera.focal_v_px * tangent)
    if not complete.all():
        least, most = np.where(complete, least, -np.inf), np.where(complete, most, np.inf)
        lowest, highest = np.where(complete, lowest, -np.inf), np.where(complete, highest, np.inf)
        contradicted &= complete
    inward = np.array([[1.0], [-1.0]])  # up from the lower end of theta, down from the upper one
    turn = _least_turn(inward * tangent, inward * np.array([lowest, highest]) / camera.focal_v_px)
    low_end, high_end = sets.theta.T + inward * lowered(turn, np.abs(sets.theta.T) + turn)
    closer = sets.contracted(scale=(lowered(least, np.abs(least)), raised(most, np.abs(most)))).emptied(contradicted)
    return replace(closer, theta=np.array([np.maximum(low_end, sets.theta[:, 0]), np.minimum(high_end, sets.theta[:, 1])]).T)


def scales_at_borders(sets: StateSet, sight: Sight, borders: Borders) -> Interval:
    """Bounds on g at each border, (rows + 1, sets), px/m: 0 and infinity where the markings tell none.

    From each marking by itself where all states have it on one side, and from the differences of markings, which are free of x.
    """
    first, last = columns_at_borders(sight)
    edge = sight.scene.camera.u0 + borders.margin_px
    first -= edge
    last += 1 + 2 * borders.margin_px - edge
    left, right = across(sight.scene, sets)
    low, high = np.zeros_like(borders.row), np.full_like(borders.row, np.inf)
    for number, mirrored in enumerate(right < 0):
        near, far, offset_low, offset_high = left[number], right[number], first[number], last[number]
        if mirrored.any():
            near, far = np.where(mirrored, -far, near), np.where(mirrored, -near, far)
            offset_low, offset_high = np.where(mirrored, -offset_high, offset_low), np.where(mirrored, -offset_low, offset_high)
        one_side = near > 0
        if not one_side.all():
            near, far = np.where(one_side, near, 1.0), np.where(one_side, far, 1.0)
            offset_low, offset_high = np.where(one_side, offset_low, 0.0), np.where(one_side, offset_high, np.inf)
        np.maximum(low, offset_low / far, out=low)
        np.minimum(high, offset_high / near, out=high)
    if not sets.x_known:
        x_m = sight.scene.runway.x_m
        for one, other in itertools.permutations(range(len(x_m)), 2):
            if x_m[one] < x_m[other]:
                apart = x_m[other] - x_m[one]
                np.maximum(low, (first[other] - last[one]) / apart, out=low)
                np.minimum(high, (last[other] - first[one]) / apart, out=high)
    return np.maximum(lowered(low, low), 0), raised(high, np.abs(high))


def horizon_bounds(row: Floats, v0: float, low: Floats, high: Floats, horizon: Floats) -> Interval:
    """Bounds on T, (sets,) each, of states with g between `low` and `high`, (rows, sets), at rows v; inverted where there are none.

    `horizon`: bounds on T, (2, sets), that leave all rows below the horizon at which g is bounded.
    """
    numbers = np.arange(len(horizon[0]))
    depth = row - v0 + horizon[:, None]
    np.maximum(depth, OUTWARD_PX, out=depth)  # above the horizon, where nothing is known; it chooses the pairs, and bounds nothing
    one, other = (low / depth).argmax(axis=1), (high / depth).argmin(axis=1)
    under, over, start, stop = low[one, numbers], high[other, numbers], row[one, numbers], row[other, numbers]
    apart, start_depth = over - under, start - v0  # the difference of two rows is exact, that of two depths is not
    usable = (under > 0) & (over < np.inf) & (apart != 0)
    turn = under * (stop - start) / np.where(usable, apart, 1.0)
    terms = np.abs(turn) + np.abs(start_depth)
    least = np.where(usable & (apart > 0), lowered(turn - start_depth, terms), -np.inf)
    most = np.where(usable & (apart < 0), raised(turn - start_depth, terms), np.inf)
    return np.maximum(*least), np.minimum(*most)


def _least_turn(tangent: Floats, bound: Floats) -> Floats:
    """Lower bound on how far angles lie above that of `tangent`, if their tangents are at least `bound`; 0 where they may lie below.

    atan(b) - atan(t) = atan((b - t) / (1 + b t)), and atan(s) >= s - s^3 / 3, which rises up to 1. From s = 1 on, and where 1 + b t is not
    above 0, so that the angle is a right one or more, that of s = 1 is taken, 2/3.
    """
    ahead = np.maximum(bound, tangent)
    rise, run = lowered(ahead - tangent, np.abs(ahead) + np.abs(tangent)), 1 + ahead * tangent
    slope = np.where(rise < run, np.maximum(rise, 0) / np.where(rise < run, run, 1.0), 1.0)
    return slope - slope**3 / 3

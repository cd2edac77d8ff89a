"""Contractor of theta by pairs of borders: the ground's scales at two of them tell the row of the horizon, and that row tells theta.

The scale g of a state rises along the frame from 0 at the horizon: g(v) is (v - v0) + T times a positive number, T = F_v tan(theta).
Let low <= g(v1) at a border and g(v2) <= high at another one, both below the horizon. Then low ((v2 - v0) + T) <= high ((v1 - v0) + T), so

    T >= low (v2 - v1) / (high - low) - (v1 - v0)  if low < high,  and T <= that  if low > high

Every pair gives such a bound. The pair that a T contradicts most is the border of the largest low / ((v - v0) + T) with that of the
smallest high / ((v - v0) + T). Taken at either end of theta it is one step of Newton's method toward what all pairs allow.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from runtime.refine.borders import Borders, across
from runtime.refine.crossings import at_borders
from runtime.refine.interval import Floats, Interval
from runtime.refine.sight import Sight
from runtime.rounding import OUTWARD_PX, lowered, raised
from runtime.state_set import StateSet


def contract_by_border_pairs(sets: StateSet, sight: Sight) -> StateSet:
    """The sets with theta contracted by the borders that all states of a set cross; those with missed pixels left are as they were.

    So are all on a turned sensor, whose borders are no rows of the ideal frame.
    """
    borders, complete = sight.borders, sight.missed.left == 0
    if not isinstance(borders, Borders) or not complete.any():
        return sets
    camera = sight.scene.camera
    cosine, sine = (side.T for side in sets.turn)
    tangent = sine / cosine
    low, high = scales_at_borders(sets, sight, borders)
    least, most = horizon_bounds(borders.row - camera.v0, low, high, camera.focal_v_px * tangent)
    least, most = np.where(complete, least, -np.inf) / camera.focal_v_px, np.where(complete, most, np.inf) / camera.focal_v_px
    rise, drop = _least_turn(tangent[0], least), _least_turn(-tangent[1], -most)
    start, stop = sets.theta.T
    theta = np.array([lowered(start + rise, np.abs(start) + rise), raised(stop - drop, np.abs(stop) + drop)])
    return replace(sets, theta=np.array([np.maximum(start, theta[0]), np.minimum(stop, theta[1])]).T)


def scales_at_borders(sets: StateSet, sight: Sight, borders: Borders) -> Interval:
    """Bounds on g at each border, (rows + 1, sets), px/m: 0 and infinity where the markings tell none.

    From each marking by itself where all states have it on one side, and from the differences of markings, which are free of x.
    """
    usable = sight.crossed & ~sight.missed.halves
    first = at_borders(np.where(usable, sight.halves.first, -np.inf), np.maximum)
    last = at_borders(np.where(usable, sight.halves.last, np.inf), np.minimum)
    edge = sight.scene.camera.u0 + borders.margin_px
    offset_low, offset_high = first - edge, last + (1 + 2 * borders.margin_px - edge)
    left, right = across(sight.scene, sets)
    mirrored = right < 0
    nearest, farthest = np.where(mirrored, -right, left), np.where(mirrored, -left, right)
    one_side, mirrored = (nearest > 0)[:, None], mirrored[:, None]
    low = np.where(mirrored, -offset_high, offset_low) / np.where(one_side, farthest[:, None], 1.0)
    high = np.where(mirrored, -offset_low, offset_high) / np.where(one_side, nearest[:, None], 1.0)
    low = np.maximum.reduce(np.where(one_side, low, 0.0), axis=0)
    high = np.minimum.reduce(np.where(one_side, high, np.inf), axis=0)
    if (sets.x[:, 0] < sets.x[:, 1]).any():
        x_m = sight.scene.runway.x_m
        for one, other in itertools.permutations(range(len(x_m)), 2):
            if x_m[one] < x_m[other]:
                apart = x_m[other] - x_m[one]
                np.maximum(low, (offset_low[other] - offset_high[one]) / apart, out=low)
                np.minimum(high, (offset_high[other] - offset_low[one]) / apart, out=high)
    return np.maximum(lowered(low, np.abs(low)), 0), raised(high, np.abs(high))


def horizon_bounds(row: Floats, low: Floats, high: Floats, horizon: Floats) -> Interval:
    """Bounds on T, (sets,) each, of states with g between `low` and `high`, (rows, sets), at rows v - v0; inverted where there are none.

    `horizon`: bounds on T, (2, sets), that leave all rows below the horizon at which g is bounded.
    """
    numbers = np.arange(len(horizon[0]))
    depth = np.where((low > 0) | (high < np.inf), row, 1 - horizon[0]) + horizon[:, None]
    np.maximum(depth, OUTWARD_PX, out=depth)  # it chooses the pairs, and bounds nothing
    one, other = (low / depth).argmax(axis=1), (high / depth).argmin(axis=1)
    under, over, start, stop = low[one, numbers], high[other, numbers], row[one, numbers], row[other, numbers]
    usable = (under > 0) & (over < np.inf) & (under != over)
    apart = np.where(usable, over - under, 1.0)
    turn = under * (stop - start) / apart
    terms = np.abs(turn) + np.abs(start)
    least = np.where(usable & (apart > 0), lowered(turn - start, terms), -np.inf)
    most = np.where(usable & (apart < 0), raised(turn - start, terms), np.inf)
    return np.maximum(*least), np.minimum(*most)


def _least_turn(tangent: Floats, bound: Floats) -> Floats:
    """Lower bound on how far angles lie above that of `tangent`, if their tangents are at least `bound`; 0 where they may lie below.

    atan(b) - atan(t) = atan((b - t) / (1 + b t)), and atan(s) >= s - s^3 / 3, which rises up to 1.
    """
    ahead = np.maximum(bound, tangent)
    rise, run = lowered(ahead - tangent, np.abs(ahead) + np.abs(tangent)), 1 + ahead * tangent
    slope = np.where(rise < run, np.maximum(rise, 0) / np.where(rise < run, run, 1.0), 1.0)
    return slope - slope**3 / 3

"""Offsets from the lit pixels at the ends of markings, where no more pixels can have been missed: the missed ones may be just there."""

from __future__ import annotations

import numpy as np

from runtime.refine.interval import Floats, Interval
from runtime.refine.lit_columns import flat_rows
from runtime.refine.sensor_borders import SensorBorders
from runtime.refine.sensor_end_pixels import sheared_at_ends
from runtime.refine.sight import Sight
from runtime.state_set import StateSet, scale_ratio, tangent_of_row


def offsets_at_ends(sets: StateSet, sight: Sight) -> Interval:
    """Bounds on the offset (p_x - x) scale of each marking, (markings, sets), px; none for sets with missed pixels left.

    With row b the last one that the far end may lie in, the marking has a point in it, at the end or on the border above it, whichever
    is lower; and likewise in the first row that the near end may lie in.
    """
    borders, u0 = sight.borders, sight.scene.camera.u0
    complete = sight.missed.left == 0
    if isinstance(borders, SensorBorders) and complete.any():
        seen = sheared_at_ends(borders, sight)
        if seen is not None:
            return np.maximum.reduce(seen[0], axis=1), np.minimum.reduce(seen[1], axis=1)
    if isinstance(borders, SensorBorders) or not complete.any():
        return np.full(borders.near[0].shape, -np.inf), np.full(borders.near[0].shape, np.inf)
    row = np.floor(np.array([borders.far[1], borders.near[0]]))  # (ends, markings, sets), as all that follows
    slow, fast = _ratios(sets, sight, row)
    place = row - borders.row[0]
    inside = np.minimum(np.maximum(place, 0), len(borders.row) - 2)
    at = flat_rows(inside, len(borders.row) - 1)
    dark = sight.rows.dark.take(at)
    known = (borders.near[0] > borders.far[1]) & (place == inside) & (slow > 0) & ~sight.missed.rows.take(at) & complete
    slow, fast = np.where(known, slow, 1.0), np.where(known, fast, 1.0)
    low = np.where(dark, np.inf, sight.rows.first.take(at)) - (u0 + borders.margin_px)
    high = np.where(dark, -np.inf, sight.rows.last.take(at)) + (1 - u0 + borders.margin_px)
    low = np.where(known, np.minimum(low / slow, low / fast), -np.inf)
    high = np.where(known, np.maximum(high / slow, high / fast), np.inf)
    return np.maximum(low[0], low[1]), np.minimum(high[0], high[1])


def _ratios(sets: StateSet, sight: Sight, row: Floats) -> Interval:
    """Range of R where the marking is in the last row of its far end (0), and in the first one of its near end (1)."""
    borders = sight.borders
    start, stop = (np.maximum(row[0], borders.far[0]), borders.near[0]), (borders.far[1], np.minimum(row[1] + 1, borders.near[1]))
    low, high = scale_ratio(sets, tangent_of_row(sight.scene.camera, np.array([start, stop])))
    return low[0], high[1]

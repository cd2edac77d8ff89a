"""Offsets from the lit pixels at the ends of markings, where no more pixels can have been missed: the missed ones may be just there."""

from __future__ import annotations

import numpy as np

from runtime.refine.interval import Interval
from runtime.refine.sight import Sight
from runtime.state_set import StateSet, scale_ratio, tangent_of_row


def offsets_at_ends(sets: StateSet, sight: Sight) -> Interval:
    """Bounds on the offset (p_x - x) scale of each marking, (markings, sets), px; none for sets with missed pixels left.

    With row b the last one that the far end may lie in, the marking has a point in it, at the end or on the border above it, whichever
    is lower; and likewise in the first row that the near end may lie in.
    """
    borders, camera = sight.borders, sight.scene.camera
    shape = borders.near[0].shape
    if not (sight.missed.left == 0).any():
        return np.full(shape, -np.inf), np.full(shape, np.inf)
    far, near = np.floor(borders.far[1]), np.floor(borders.near[0])
    start = tangent_of_row(camera, np.stack([np.maximum(far, borders.far[0]), borders.near[0]], axis=1))
    stop = tangent_of_row(camera, np.stack([borders.far[1], np.minimum(near + 1, borders.near[1])], axis=1))
    slow, fast = scale_ratio(sets, start)[0], scale_ratio(sets, stop)[1]
    place = np.stack([far, near], axis=1) - borders.row[0]
    inside = np.clip(place, 0, len(borders.row) - 2)
    row = inside.astype(np.int64)
    first, last = (np.take_along_axis(side, row, axis=1) for side in (sight.rows.first, sight.rows.last))
    spoiled = np.take_along_axis(sight.missed.rows, row, axis=1)
    apart = (borders.near[0] > borders.far[1])[:, None]
    known = apart & (place == inside) & (slow > 0) & ~spoiled & (sight.missed.left == 0)
    slow, fast = np.where(known, slow, 1.0), np.where(known, fast, 1.0)
    low, high = first - (camera.u0 + borders.margin_px), last + (1 - camera.u0 + borders.margin_px)
    low = np.where(known, np.minimum(low / slow, low / fast), -np.inf).max(axis=1)
    high = np.where(known, np.maximum(high / slow, high / fast), np.inf).min(axis=1)
    return low, high

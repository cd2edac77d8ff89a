"""Offsets from the lit pixels at the ends of markings on the sensor, where no more pixels can have been missed (`end_pixels`)."""

from __future__ import annotations

import numpy as np

from runtime.refine.interval import Floats
from runtime.refine.lit_columns import flat_rows
from runtime.refine.sensor_borders import SensorBorders
from runtime.refine.sight import Sight
from runtime.refine.unknowns import Moves


def sheared_at_ends(borders: SensorBorders, sight: Sight) -> tuple[Floats, Floats, Floats] | None:
    """Bounds on the offset of each marking as it is seen, and w - w* (`SensorBorders.sheared_offsets`), at both ends: (markings, 2, sets).

    None without a lens or plus-minus. A marking has a point in the last row in which its far end may lie, between what bounds that end and
    the border above it; it lies in a lit pixel of the row. Offsets grow along the row, and are monotone along the patch's edges.
    """
    optics, met = borders.view.optics, borders.met
    if optics is None or met is None:
        return None
    row = np.floor(np.stack([borders.far[1], borders.near[0]]))  # (ends, markings, sets), as all that follows
    start, stop = (
        np.stack([np.maximum(row[0], borders.far[0]), borders.near[0]]),
        np.stack([borders.far[1], np.minimum(row[1] + 1, borders.near[1])]),
    )
    place = np.where(np.isfinite(row), row - borders.row[0], -1.0)
    inside = np.minimum(np.maximum(place, 0), len(borders.row) - 2)
    at = flat_rows(inside, len(borders.row) - 1)
    spans = (met.spans[:, :-1] & met.spans[:, 1:]).take(at)
    known = (borders.near[0] > borders.far[1]) & (place == inside) & spans & (sight.missed.left == 0)
    known &= ~sight.missed.rows.take(at) & (start <= stop)
    first, last = (np.where(known, side.take(at), 0.0) for side in (sight.rows.first, sight.rows.last))
    dark = known & sight.rows.dark.take(at)
    known &= np.isfinite(first) & np.isfinite(last) & ~dark
    start, stop = (np.where(known, side, 0.0) for side in (start, stop))
    first, last = np.where(known, first, 0.0), np.where(known, last + 1, 0.0)
    patch = optics.patch((first, last), (start, stop))
    view, focal = borders.view, optics.camera.focal_u_px
    margin = borders.margin_px / focal + patch.off
    low = view.quotient(*patch.left, -margin, np.minimum, patch.off).min(axis=0) * focal
    high = view.quotient(*patch.right, margin, np.maximum, patch.off).max(axis=0) * focal
    known &= patch.known & view.rises_along(optics, patch)
    w = np.zeros(low.shape)
    if borders.unknowns is not None:
        w, rest, certain = borders.unknowns.sheared_at(view, Moves.at(view, optics, *patch.middle, patch.reach, patch.down))
        low, high, known = low - rest, high + rest, known & certain
    else:
        sway = borders.beside_point(optics.camera, *patch.middle, patch.reach)
        low, high = low - sway, high + sway
    known &= np.isfinite(low) & np.isfinite(high)
    low, high = np.where(known, low, -np.inf), np.where(known, high, np.inf)
    low, high = np.where(dark, np.inf, low), np.where(dark, -np.inf, high)
    low, high, w = (np.moveaxis(side, 0, 1) for side in (low, high, np.where(known, w, 0.0)))
    return low, high, w

"""Where the markings of sets of states cross the borders between rows, as data for the contractors.

A border of a row of pixels is a line v = r here. All that a contractor asks of it is the range of the ground's scale on it, relative to the
set's own (`ratio`), the columns in which a marking may meet it, and whether the markings of all states of a set cross it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from runtime.refine.interval import Bits, Floats, Interval
from runtime.refine.lit_pixels import LitPixels
from runtime.rounding import above, below, column_margin_px, lowered, raised
from runtime.scene import Scene
from runtime.state_set import StateSet, end_rows, scale_ratio, tangent_of_row


@dataclass(frozen=True)
class Borders:
    """The borders of the rows that each set can show in the window; row i of pixels lies between borders i and i + 1."""

    row: Floats
    """v of each border, (rows + 1, sets), px."""
    ratio: Interval
    """Range of R = g(row) / scale there, (rows + 1, sets)."""
    near: Interval
    far: Interval
    """Ranges of the rows of each marking's near and far end, (markings, sets), px."""
    crossed: Bits
    """True where the marking crosses the border, below the horizon, in all states of the set: (markings, rows + 1, sets)."""
    columns: Interval
    """First and last column of the pixels in whose closed columns the marking may meet the border, (markings, rows + 1, sets)."""
    margin_px: Floats
    """Covers what rounding does to a column, (sets,)."""

    @staticmethod
    def of(scene: Scene, sets: StateSet, pixels: LitPixels) -> Borders:
        """The borders between the farthest and the nearest ends; one row on either side stands for all rows out of the window."""
        near, far = ends_in_rows(scene, sets)
        first, last = (
            np.minimum(np.maximum(np.floor(row), pixels.top), pixels.bottom)
            for row in (np.minimum.reduce(far[0], axis=0), np.maximum.reduce(near[1], axis=0))
        )
        row = first + np.arange(int(np.maximum.reduce(last - first)) + 2, dtype=np.float64)[:, None]
        ratio = scale_ratio(sets, tangent_of_row(scene.camera, row))
        crossed = row > far[1][:, None]
        crossed &= row < near[0][:, None]
        crossed &= ratio[0] > 0
        margin_px = _column_margins_px(scene, sets)
        return Borders(row, ratio, near, far, crossed, _columns(scene, sets, ratio, margin_px), margin_px)

    @cached_property
    def per_ratio(self) -> Interval:
        """1 / R at both ends of its range, (rows + 1, sets); 1 above the horizon, where no border is crossed."""
        low, high = self.ratio
        return 1 / np.where(low > 0, low, 1.0), 1 / np.where(high > 0, high, 1.0)

    def offsets(self, scene: Scene, first: Floats, last: Floats, rows: slice = slice(None)) -> Interval:
        """Bounds on (p_x - x) scale of markings that cross the borders `rows` in the closed columns `first` to `last`; of that shape.

        They mean nothing where a border is not crossed.
        """
        per_low, per_high = (side[rows] for side in self.per_ratio)
        low, high = first - (scene.camera.u0 + self.margin_px), last + (1 - scene.camera.u0 + self.margin_px)
        return np.minimum(low * per_low, low * per_high), np.maximum(high * per_low, high * per_high)

    def seen_x(self, sets: StateSet) -> Interval:
        """Range of the x that offsets refer to, (sets,), m: here the sets' own."""
        return sets.x[:, 0], sets.x[:, 1]

    def true_x(self, _: StateSet, low: Floats, high: Floats) -> Interval:
        """Bounds on the states' x, (sets,), by bounds on the x that offsets refer to."""
        return low, high

    def ideal_rows(self, _: Scene, __: StateSet, lowest: Floats, highest: Floats) -> Interval:
        """Rows of the ideal frame that near ends lie no lower, and far ends no higher in than in these of the sensor, (markings, sets)."""
        return lowest, highest

    def across_rows(self) -> Interval:
        """First and last column that each marking may light in each row, (markings, rows, sets)."""
        low, high = self.columns
        return np.minimum(low[:, :-1], low[:, 1:]), np.maximum(high[:, :-1], high[:, 1:])


def across(scene: Scene, sets: StateSet) -> Interval:
    """Range of p_x - x, (markings, sets), m."""
    x_m = scene.runway.x_m[:, None]
    return x_m - sets.x[:, 1], x_m - sets.x[:, 0]


def _columns(scene: Scene, sets: StateSet, ratio: Interval, margin_px: Floats) -> Interval:
    across_low, across_high = (side[:, None] for side in across(scene, sets))
    slow, fast = sets.scale[:, 0] * ratio[0], sets.scale[:, 1] * ratio[1]
    first, last = across_low * slow, across_low * fast
    low = np.minimum(first, last)
    if not sets.x_known:
        first, last = across_high * slow, across_high * fast
    high = np.maximum(first, last, out=first)
    low += scene.camera.u0 - margin_px
    high += scene.camera.u0 + margin_px
    return np.floor(low, out=low), np.floor(high, out=high)


def ends_in_rows(scene: Scene, sets: StateSet) -> tuple[Interval, Interval]:
    """Ranges of the rows of each marking's near and far end, (markings, sets) each; equal distances are computed once.

    v - v0 = F_v tan(beta - theta), so an error of an angle grows by 1 + tan^2: that of rounding, of the altitude that a scale stands for,
    and of the distance as a sum of coordinates.
    """
    distances = scene.runway.distances_z_m
    focal, v0 = scene.camera.focal_v_px, scene.camera.v0
    along = distances[:, None]
    angle = sets.condition + np.abs(along) / (sets.z[:, 0] + along)
    low, high = (side.T for side in end_rows(scene.camera, sets, distances))
    low = below(lowered(low, angle * (focal + (low - v0) ** 2 / focal)))
    high = above(raised(high, angle * (focal + (high - v0) ** 2 / focal)))
    near, far = scene.runway.place_of_ends.T
    return (low[near], high[near]), (low[far], high[far])


def _column_margins_px(scene: Scene, sets: StateSet) -> Floats:
    """What a column u0 + (p_x - x) scale R that is in the frame may be off by, (sets,): R is as uncertain as s(theta, t_ref)."""
    across_low, across_high = across(scene, sets)
    offset = np.maximum.reduce(np.maximum(-across_low, across_high), axis=0) * sets.scale[:, 1]
    return column_margin_px(sets.condition * (offset + max(abs(scene.camera.u0), abs(scene.camera.width - scene.camera.u0))))

"""A frame of the sensor painted outward onto the ideal frame, for NN_F (docs/guarantee.md, "A lens").

A pixel of the sensor shows, of the ideal frame, what lies within the quadrilateral of its corners' images, which may each lie anywhere
in an interval (`runtime.sensor_map`), its edges bowed by `bow_px` at most. *Painted* is every ideal pixel that meets what some lit pixel
shows, and every one that is not certainly shown as a whole by the sensor.

Claim. Let a point of the runway lie in the ideal frame. If it lies in an ideal pixel that the sensor shows as a whole, the sensor's pixel
which shows it is in the frame; and if that one is lit, the ideal pixel is painted. So where at most m pixels of the sensor's image of the
runway are dark, at most c m pixels of the ideal image are, `c` being a bound on how many ideal pixels all markings together meet within
what one sensor's pixel shows: Theorem A holds of the painted frame with budget c m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.outline import Outline, Window
from runtime.refine.interval import Floats, Interval
from runtime.rounding import OUTWARD_PX, ROUNDING_SHARE
from runtime.scene import Scene
from runtime.sensor_map import SensorMap

Bits = NDArray[np.bool_]
Integers = NDArray[np.int64]

DOWN, RIGHT = np.array([[0], [0], [1], [1]]), np.array([[0], [1], [1], [0]])
"""Rows and columns of a pixel's corners, in turn around it."""
BLOCK_PX = 16
"""Sides of the blocks of the ideal frame that are looked at before their pixels are."""
MOST_PAINTED = 64
"""Ideal pixels that one pixel of the sensor may show: where there are more, it paints all of the ideal frame."""
PARCEL = 2**16
"""Pixels of the sensor of which tables are made at a time."""


@dataclass(frozen=True)
class Painting:
    """What every pixel of one sensor paints, for maps that do not change from frame to frame."""

    shape: tuple[int, int]
    """(height, width) of the ideal frame."""
    window: tuple[slice, slice]
    """Rows and columns of the sensor of which some may show something of the ideal frame."""
    table: NDArray[np.int32]
    """(pixels of the window, most): flat numbers of the ideal pixels that each paints, filled up with that of none, height * width."""
    everything: Bits
    """Pixels of the window that paint everything, (pixels,)."""
    unseen: Bits
    """Ideal pixels that the sensor does not certainly show as a whole, (height * width,)."""

    @staticmethod
    def of(sensor: SensorMap) -> Painting:
        """The painting of a map."""
        view = View.of(sensor)
        rows, columns = (side.ravel() for side in np.mgrid[view.window])
        parcels = [what_pixels_show(sensor, rows[at : at + PARCEL], columns[at : at + PARCEL]) for at in range(0, len(rows), PARCEL)]
        none = sensor.ideal.height * sensor.ideal.width
        tables = [part.table(none) for part in parcels]
        most = max((part.shape[1] for part in tables), default=1)
        table = np.full((len(rows), most), none, dtype=np.int32)
        for at, part in enumerate(tables):
            table[at * PARCEL : at * PARCEL + len(part), : part.shape[1]] = part
        everything = np.concatenate([part.everything for part in parcels]) if parcels else np.zeros(0, dtype=bool)
        return Painting(sensor.ideal.shape, view.window, table, everything, ~view.shown.ravel())

    def painted(self, frame: Bits) -> NDArray[np.uint8]:
        """The ideal frame, uint8 of {0, 1}, of a frame of the sensor."""
        lit = np.flatnonzero(frame[self.window])
        canvas = np.zeros(len(self.unseen) + 1, dtype=np.uint8)
        canvas[:-1] = self.unseen
        canvas[self.table[lit]] = 1
        if self.everything[lit].any():
            canvas[:] = 1
        return canvas[:-1].reshape(self.shape)

    def within(self, mask: Bits, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What a frame of the sensor has lit that shows some pixel of a mask of the ideal frame: uint8 of {0, 1}."""
        rows, columns = np.nonzero(frame[self.window])
        lit = rows * (self.window[1].stop - self.window[1].start) + columns
        shows = np.append(mask.ravel(), False)[self.table[lit]].any(axis=1) | self.everything[lit]
        within = np.zeros_like(frame)
        within[self.window][rows[shows], columns[shows]] = 1
        return within


@dataclass(frozen=True)
class Painted:
    """One frame of the sensor painted by a map that is this frame's own, within a window of the ideal frame; beyond it all is lit."""

    ideal: NDArray[np.uint8]
    """The ideal frame, (height, width) of {0, 1}."""
    rows: Integers
    columns: Integers
    """Of the sensor's lit pixels, (lit,), of those that may show something of the window."""
    shown: Shown

    @staticmethod
    def of(frame: Bits, sensor: SensorMap, outline: Outline, window: Window | None = None) -> Painted:
        """Of a frame (height, width) of the sensor, whose outline this is; by default all of the ideal frame is painted."""
        view = View.of(sensor, outline, window)
        rows, columns = np.nonzero(frame[view.window])
        rows, columns = rows + view.window[0].start, columns + view.window[1].start
        canvas = np.ones(sensor.ideal.height * sensor.ideal.width + 1, dtype=np.uint8)
        ideal = canvas[:-1].reshape(sensor.ideal.shape)
        ideal[view.shown_in] = ~view.shown
        shown = what_pixels_show(sensor, rows, columns)
        canvas[shown.pixels] = 1
        if shown.everything.any():
            canvas[:] = 1
        return Painted(ideal, rows, columns, shown)

    def within(self, mask: Bits, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What a frame of the sensor has lit that shows some pixel of a mask of the ideal frame: uint8 of {0, 1}."""
        shows = np.append(mask.ravel(), False)[self.shown.pixels].any(axis=0) | (self.shown.everything & mask.any())
        within, rows, columns = np.zeros_like(frame), self.rows[shows], self.columns[shows]
        within[rows, columns] = frame[rows, columns]
        return within


@dataclass(frozen=True)
class View:
    """What the sensor shows of the ideal frame, or of a window of it: `window`, the rows and columns of the sensor outside which it shows
    nothing of that, and `shown`, the pixels in rows and columns `shown_in` of the ideal frame, all of those that are looked at, that the
    sensor shows as a whole, whatever the rotation and calibration.
    """

    window: Window
    shown: Bits
    shown_in: Window

    @staticmethod
    def of(sensor: SensorMap, outline: Outline | None = None, window: Window | None = None) -> View:
        """By the sensor's outline; where that does not tell, of blocks of the ideal frame, and of the pixels of those that the sensor's
        border may cut.
        """
        height, width = sensor.ideal.shape
        rows, columns = window or (slice(0, height), slice(0, width))
        shown_in = slice(rows.start, min(rows.stop, height)), slice(columns.start, min(columns.stop, width))
        seen = None
        if outline is not None:
            seen, whole = outline.seen(sensor, shown_in)
            if whole:
                return View(seen, np.ones([side.stop - side.start for side in shown_in], dtype=bool), shown_in)
        tops, lefts = (np.arange(side.start, side.stop, BLOCK_PX) for side in shown_in)
        column, row = _shown_squares(sensor, tops[:, None], lefts[None, :], BLOCK_PX)
        seen = seen or (_within(row, sensor.camera.height), _within(column, sensor.camera.width))
        inside = _inside(sensor, column, row)
        shown = inside.repeat(BLOCK_PX, axis=0).repeat(BLOCK_PX, axis=1)[
            : shown_in[0].stop - rows.start, : shown_in[1].stop - columns.start
        ]
        out = (column[1] <= 0) | (column[0] >= sensor.camera.width) | (row[1] <= 0) | (row[0] >= sensor.camera.height)
        unsure = np.nonzero(~inside & ~out)
        if len(unsure[0]):
            offsets = np.arange(BLOCK_PX)
            down, aside = tops[unsure[0], None, None] + offsets[:, None], lefts[unsure[1], None, None] + offsets
            down, aside = (side.ravel() for side in np.broadcast_arrays(down, aside))
            kept = (down < shown_in[0].stop) & (aside < shown_in[1].stop)
            down, aside = down[kept], aside[kept]
            shown[down - rows.start, aside - columns.start] = _inside(sensor, *_shown_squares(sensor, down, aside, 1))
        return View(seen, shown, shown_in)


def _shown_squares(sensor: SensorMap, rows: Integers, columns: Integers, size: int) -> tuple[Interval, Interval]:
    """(column, row) of the sensor that squares of the ideal frame, cut off at its border, are shown in."""
    height, width = sensor.ideal.shape
    u, v = (side.astype(np.float64) for side in np.broadcast_arrays(columns, rows))
    return sensor.to_sensor((u, np.minimum(u + size, width)), (v, np.minimum(v + size, height)))


def _inside(sensor: SensorMap, column: Interval, row: Interval) -> Bits:
    """True for what lies within the sensor's frame."""
    return (column[0] >= 0) & (column[1] <= sensor.camera.width) & (row[0] >= 0) & (row[1] <= sensor.camera.height)


def _within(side: Interval, size: int) -> slice:
    low, high = np.clip([side[0].min(), side[1].max()], 0, size)
    return slice(math.floor(low), math.ceil(high))


@dataclass(frozen=True)
class Shown:
    """What pixels of the sensor show: `pixels`, flat numbers of the ideal pixels that each paints, (most, pixels), that of none, height *
    width, among them, and `everything`, those that paint everything.
    """

    pixels: Integers
    everything: Bits

    def table(self, none: int) -> NDArray[np.int32]:
        """The numbers of each, (pixels, most), ascending, as few columns as they need."""
        ordered = np.sort(self.pixels.astype(np.int32), axis=0)
        most = int((ordered < none).sum(axis=0).max(initial=1))
        return ordered[: max(most, 1)].T


def what_pixels_show(sensor: SensorMap, rows: Integers, columns: Integers) -> Shown:
    """What some pixels of the sensor show.

    Ideal pixels of the box around the quadrilateral are left out where one of its edges, moved outward, has them on its other side.
    """
    height, width = sensor.ideal.shape
    u, v = sensor.corners(rows + DOWN, columns + RIGHT)
    seen = np.isfinite(u[1]).all(axis=0) & np.isfinite(v[1]).all(axis=0)
    u, v = ((np.where(seen, side[0], 0.0), np.where(seen, side[1], 0.0)) for side in (u, v))
    bow = sensor.bow_px
    left, right = (np.floor(side).astype(np.int64) for side in (u[0].min(axis=0) - bow, u[1].max(axis=0) + bow))
    top, bottom = (np.floor(side).astype(np.int64) for side in (v[0].min(axis=0) - bow, v[1].max(axis=0) + bow))
    far = (right - left >= MOST_PAINTED) | (bottom - top >= MOST_PAINTED)
    out = (right < 0) | (left >= width) | (bottom < 0) | (top >= height)
    everything = ~seen | (far & ~out)
    none = everything | out
    right, bottom = np.where(none, left, right), np.where(none, top, bottom)
    limits = _limits((u[0] - left, u[1] - left), (v[0] - top, v[1] - top), bow)
    down, aside = (
        side.reshape(-1, 1) for side in np.mgrid[: int((bottom - top).max(initial=0)) + 1, : int((right - left).max(initial=0)) + 1]
    )
    row, column = top + down, left + aside
    met = (row <= bottom) & (column <= right) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    for across, along, limit in limits:
        met &= across * aside + along * down <= limit
    return Shown(np.where(met & ~none, row * width + column, height * width), everything)


def _limits(u: Interval, v: Interval, bow: float) -> list[tuple[Floats, Floats, Floats]]:
    """For each edge its outward normal (across, along), and what its product with the near corner of a pixel that is met is at most."""
    middle_u, middle_v = (u[0] + u[1]) / 2, (v[0] + v[1]) / 2
    half_u, half_v = (u[1] - u[0]) / 2, (v[1] - v[0]) / 2
    limits = []
    for corner in range(len(DOWN)):
        following = (corner + 1) % len(DOWN)
        across, along = middle_v[following] - middle_v[corner], middle_u[corner] - middle_u[following]
        size_across, size_along = np.abs(across), np.abs(along)
        reach = (across * middle_u + along * middle_v + size_across * half_u + size_along * half_v).max(axis=0)
        nearest = np.minimum(across, 0) + np.minimum(along, 0)
        limits.append((across, along, reach + (bow + OUTWARD_PX) * (size_across + size_along) - nearest))
    return limits


def ideal_pixels_a_pixel(scene: Scene, sensor: SensorMap, painting: Painting) -> int:
    """c: how many ideal pixels all markings together can meet within what one pixel of the sensor shows, at most.

    A straight line meets no more pixels than 1 and the borders of columns and of rows that it crosses; where it is w wide and h tall
    those are floor(w) + 1 and floor(h) + 1. A marking's line is never flatter than the domain allows, and lines of unlike p_x are as far
    apart as their p_x at the farthest distance; so many of them as may meet one pixel are counted.
    """
    rows, columns = (side.ravel() for side in np.mgrid[painting.window])
    used = (painting.table < len(painting.unseen)).any(axis=1) & ~painting.everything
    wide, tall = _extents(sensor, rows[used], columns[used])
    of_others = _extents_of_unbounded(sensor, painting)
    wide, tall = np.append(wide, of_others[0]), np.append(tall, of_others[1])
    if len(wide) == 0:
        return 1
    flattest, px_per_m = _flattest(scene, sensor), _least_scale(scene, sensor)
    across = np.minimum(wide, flattest * tall)
    a_line = 1 + np.floor(across * (1 + ROUNDING_SHARE)) + 1 + np.floor(tall * (1 + ROUNDING_SHARE)) + 1
    lines = _most_within(scene.runway.x_m, float(((wide + flattest * tall) / px_per_m).max() * (1 + ROUNDING_SHARE)))
    return lines * int(a_line.max())


def _extents(sensor: SensorMap, rows: Integers, columns: Integers) -> tuple[Floats, Floats]:
    """Width and height, px of the ideal frame, of what pixels show."""
    u, v = sensor.corners(rows + DOWN, columns + RIGHT)
    wide, tall = ((high.max(axis=0) - low.min(axis=0)) + 2 * (sensor.bow_px + OUTWARD_PX) for low, high in (u, v))
    return wide, tall


def _extents_of_unbounded(sensor: SensorMap, painting: Painting) -> tuple[Floats, Floats]:
    """The same of the pixels that paint everything, by where the sensor may show the ideal pixels that are not lit always."""
    height, width = sensor.camera.shape
    unbounded = np.zeros((height, width), dtype=bool)
    unbounded[painting.window] = painting.everything.reshape(unbounded[painting.window].shape)
    first, last = np.full((2, height, width), np.inf), np.full((2, height, width), -np.inf)
    if unbounded.any():
        places = np.argwhere(~painting.unseen.reshape(painting.shape))
        shown = _shown_squares(sensor, places[:, 0], places[:, 1], 1)
        sides = [
            (np.maximum(np.ceil(low) - 1, 0), np.minimum(np.floor(high) + 1, size))
            for (low, high), size in zip(shown, (width, height), strict=True)
        ]
        blocks = np.stack([sides[1][0], sides[1][1], sides[0][0], sides[0][1]], axis=-1).astype(np.int64)
        for place, (top, bottom, left, right) in zip(places, blocks.tolist(), strict=True):
            block = np.s_[:, top:bottom, left:right]
            first[block] = np.minimum(first[block], place[:, None, None])
            last[block] = np.maximum(last[block], place[:, None, None] + 1)
    tall, wide = (last - first)[:, unbounded & (last[0] > first[0])]
    return wide, tall


def _flattest(scene: Scene, sensor: SensorMap) -> float:
    """Most columns a row that a marking runs across: |p_x - x| (F_u/F_v) cos(theta)/y."""
    lower, upper = scene.domain.lower, scene.domain.upper
    lever_m = max(float(scene.runway.x_m.max() - lower[1]), float(upper[1] - scene.runway.x_m.min()), 0.0)
    return lever_m * sensor.ideal.focal_u_px / sensor.ideal.focal_v_px / float(lower[2]) * (1 + ROUNDING_SHARE)


def _least_scale(scene: Scene, sensor: SensorMap) -> float:
    """Fewest px per metre across the runway at any point of a marking: F_u/Z, Z no more than the distance."""
    farthest = math.hypot(float(scene.domain.upper[2]), float(scene.domain.upper[3] + scene.runway.ends_z_m.max()))
    return sensor.ideal.focal_u_px / farthest * (1 - ROUNDING_SHARE)


def _most_within(x_m: Floats, span_m: float) -> int:
    """How many of the unlike p_x lie within a span at most."""
    places = np.unique(x_m)
    return int(max(np.searchsorted(places, place + span_m, side="right") - at for at, place in enumerate(places)))

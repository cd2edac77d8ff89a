"""From the entries that pass to the states that one image cannot tell apart: the certified box at its limit.

Every passing entry (`build_model.hough_bank`) is a set of states. It is cut into thin slices of theta, and each slice is contracted by
what the frame shows. A state whose markings cross the border r of two rows lights a pixel on both sides of it (Theorem A), so

    u(r) = u0 + (p_x - x) scale R(theta, r)  lies in the closed columns of a lit pixel above r, and of one below r

up to the missed pixels. In a thin slice R is all but a number, and every border bounds each marking's offset (p_x - x) scale on both
sides; so does, if none may be missed, the lit pixel of an end. Beyond the rows that all states of the slice cross, the first
row without a usable lit pixel ends a marking, and so bounds its distance. Slices that contradict the frame are dropped; the others are cut
finer, in the end only those that carry a face of the box.

Under Theorem B the lit pixels of S (here: claimed pixels) are the runway's, but for `extra_budget` of them. A claimed pixel that only one
marking of the slice could light bounds that marking's offset by the pixel's other side, and pulls its ends out to the pixel's row.

Guarantee: each state of the given entries that is consistent with the frame stays in some slice. Pixels outside the frame count as
lit. A dark pixel of the runway spoils at most the two borders of its row and one row of an end, for each marking that shares it.

Every bound is rounded outward where it is made (`runtime.rounding`), by a margin that grows with the terms it is the sum or quotient of.
So a set is empty exactly where an interval is inverted. "No bound" is an infinity of the right sign; a marking that the frame contradicts
is a mask. Rows that no pixel of the window lies in are not looked at.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from runtime.rounding import above, below, column_margin_px, lowered, raised
from runtime.scene import Scene
from runtime.state_set import Floats, StateSet, end_rows, reference_fall_range, scale_ratio, tangent_of_row

Bits = NDArray[np.bool_]
Rows = NDArray[np.int64]
Interval = tuple[Floats, Floats]
"""Lower and upper bounds."""

CUTS = (2, 4)
"""Slices of theta that every piece is cut into, round after round."""
FACE_PIECES, FACE_CUTS = 2, (4, 3)
"""Then the pieces that carry a face of the box are cut: how many a face, and into how many slices of theta and of z each."""
FACE_ROUNDS, FACE_GAIN = 6, 0.05
"""At most so many times, and until a round takes less than this share from every side of the box."""
LARGEST_START = 512
"""More passing entries than this say that the frame tells next to nothing: they are left as they are, at a bounded cost."""
LARGEST_BLOCK = 2**19
"""Sets are contracted so many at once that their markings have no more rows than this between them: memory is bounded."""
NO_COLUMN = np.int16(2**15 - 1)
"""Stands for a column that no frame has: a frame is at most 16384 px wide (`runtime.scene.Camera`)."""


@dataclass(frozen=True)
class Refiner:
    """Refines the entries of one model. `missed_budget` is m, `extra_budget` is e."""

    scene: Scene
    missed_budget: int
    extra_budget: int
    window: tuple[slice, slice] = (slice(None), slice(None))
    """Rows and columns outside of which pixels count as lit, whatever the frame shows there."""

    def refine(self, frame: Bits, entries: StateSet, claimed: Bits | None = None) -> StateSet:
        """Slices that hold all states of `entries` which are consistent with `frame`, (height, width); none if there is none.

        `frame` is dilated by the tolerance. `claimed`: the lit pixels of S, for Theorem B at tolerance 0; the entries are of one cell then.
        """
        if len(entries) > LARGEST_START:
            return entries
        witnesses = _Pixels.of(frame, self.window, beyond=True)
        claims = None if claimed is None else _Pixels.of(claimed, self.window, beyond=False)
        pieces = entries
        for cuts in CUTS:
            pieces = self._contracted(witnesses, claims, _cut(pieces, theta=cuts))
        extent = _extent(pieces)
        for _ in range(FACE_ROUNDS if len(pieces) else 0):
            outer = _carries_a_face(pieces, FACE_PIECES)
            finer = self._contracted(witnesses, claims, _cut(pieces[outer], theta=FACE_CUTS[0], z=FACE_CUTS[1]))
            pieces, before = joined(finer, pieces[~outer]), extent
            extent = _extent(pieces)
            if (extent > (1 - FACE_GAIN) * before).all():
                break
        return pieces

    def _contracted(self, witnesses: _Pixels, claims: _Pixels | None, sets: StateSet) -> StateSet:
        """The sets, whose arrays are overwritten, without most of the states that the frame contradicts, and without empty sets."""
        if len(sets) == 0:
            return sets
        size = max(LARGEST_BLOCK // (len(self.scene.runway.markings) * len(witnesses.canvas)), 1)
        blocks = (sets[first : first + size] for first in range(0, len(sets), size))
        return joined(*(self._contracted_block(witnesses, claims, block) for block in blocks))

    def _contracted_block(self, witnesses: _Pixels, claims: _Pixels | None, sets: StateSet) -> StateSet:
        """`_contracted` for some sets at once."""
        self._by_altitude(sets)
        grid = _Grid.of(self.scene, sets, witnesses)
        lit = _LitColumns.of(self.scene, witnesses, sets, grid)
        offset = self._by_end_pixels(sets, grid, lit, self._offsets(grid, lit))
        if claims is not None:
            offset = self._by_claims(sets, grid, claims, offset)
        refuted = (offset[0] > offset[1]).any(axis=0)
        for side in offset:
            side[:, refuted] = 0.0  # any number: these sets are dropped below
        self._by_offset(sets, offset)
        refuted |= _empty(sets)
        sets.scale[refuted] = 1.0  # likewise, above 0
        self._by_ends(sets, grid, lit)
        self._by_altitude(sets)
        return sets[~(refuted | _empty(sets))]

    def _by_altitude(self, sets: StateSet) -> None:
        """Contracts y and scale by y = F s(theta, t_ref) / scale."""
        fall_low, fall_high = reference_fall_range(sets)
        product_low = lowered(self.scene.camera.focal_px * fall_low, self.scene.camera.focal_px * fall_low * sets.condition)
        product_high = raised(self.scene.camera.focal_px * fall_high, self.scene.camera.focal_px * fall_high * sets.condition)
        _draw_in(sets.scale, product_low / sets.y[:, 1], product_high / sets.y[:, 0])
        _draw_in(sets.y, product_low / sets.scale[:, 1], product_high / sets.scale[:, 0])

    def _offsets(self, grid: _Grid, lit: _LitColumns) -> Interval:
        """Bounds on the offset (p_x - x) scale of each marking, (markings, sets), from the row borders that all states cross."""
        u0, spoiled = self.scene.camera.u0, 2 * self.missed_budget
        low = np.maximum(lit.first[:, :-1], lit.first[:, 1:]) - (u0 + grid.margin_px)
        high = np.minimum(lit.last[:, :-1], lit.last[:, 1:]) + (1 - u0 + grid.margin_px)
        slow, fast = (1 / np.where(grid.ground, ratio[1:-1], 1.0) for ratio in grid.ratio)
        low, high = np.minimum(low * slow, low * fast), np.maximum(high * slow, high * fast)
        return _largest_but(np.where(grid.crossed, low, -np.inf), spoiled), _smallest_but(np.where(grid.crossed, high, np.inf), spoiled)

    def _by_end_pixels(self, sets: StateSet, grid: _Grid, lit: _LitColumns, offset: Interval) -> Interval:
        """The offset's bounds, contracted by the lit pixels at the ends of markings; only without missed pixels, which may be just there.

        With row b the last one that the far end may lie in, the marking has a point in it, at the end or on the border above it, whichever
        is lower; and likewise in the first row that the near end may lie in.
        """
        if self.missed_budget > 0:
            return offset
        far, near = np.floor(grid.far[1]), np.floor(grid.near[0])
        start = tangent_of_row(self.scene.camera, np.stack([np.maximum(far, grid.far[0]), grid.near[0]], axis=1))
        stop = tangent_of_row(self.scene.camera, np.stack([grid.far[1], np.minimum(near + 1, grid.near[1])], axis=1))
        slow, fast = scale_ratio(sets, start)[0], scale_ratio(sets, stop)[1]
        place = np.stack([far, near], axis=1) - grid.rows[0]
        inside = np.clip(place, 0, lit.first.shape[1] - 1)
        apart = (grid.near[0] > grid.far[1])[:, None]
        known = apart & (place == inside) & (slow > 0)
        slow, fast = np.where(known, slow, 1.0), np.where(known, fast, 1.0)
        u0, row = self.scene.camera.u0, inside.astype(np.int64)
        low = np.take_along_axis(lit.first, row, axis=1) - (u0 + grid.margin_px)
        high = np.take_along_axis(lit.last, row, axis=1) + (1 - u0 + grid.margin_px)
        low = np.where(known, np.minimum(low / slow, low / fast), -np.inf).max(axis=1)
        high = np.where(known, np.maximum(high / slow, high / fast), np.inf).min(axis=1)
        return np.maximum(offset[0], low), np.minimum(offset[1], high)

    def _by_offset(self, sets: StateSet, offset: Interval) -> None:
        """Contracts scale and x by offset = (p_x - x) scale: marking by marking, and by the differences of markings, free of x."""
        x_m = self.scene.runway.x_m
        low, high = offset[0].T, offset[1].T
        scale_low, scale_high = _quotient(low, high, x_m[:, None] - sets.x[:, None, ::-1])
        _draw_in(sets.scale, scale_low.max(axis=1), scale_high.min(axis=1))
        if (sets.x[:, 1] <= sets.x[:, 0]).all():
            return
        for left, right in zip(*np.triu_indices(len(x_m), 1), strict=True):
            apart = np.full(2, x_m[right] - x_m[left])
            _draw_in(sets.scale, *_quotient(low[:, right] - high[:, left], high[:, right] - low[:, left], apart))
        across_low, across_high = _quotient(low, high, sets.scale[:, None, :])
        x_low, x_high = (x_m - across for across in (across_high, across_low))
        x_low, x_high = lowered(x_low, np.abs(x_m) + np.abs(x_low)), raised(x_high, np.abs(x_m) + np.abs(x_high))
        _draw_in(sets.x, x_low.max(axis=1), x_high.min(axis=1))

    def _by_ends(self, sets: StateSet, grid: _Grid, lit: _LitColumns) -> None:
        """Contracts z: a marking does not go on past the (m + 1)-th row that shows no pixel it could light."""
        row = grid.rows[:-1]
        before_near, behind_far = row + 1 <= grid.near[0][:, None], row >= grid.far[1][:, None]
        stops, starts = lit.dark & behind_far & ~before_near, lit.dark & before_near & ~behind_far
        budget = self.missed_budget + 1
        if budget > 1:
            stops &= stops.cumsum(axis=1) == budget
            starts &= starts[:, ::-1].cumsum(axis=1)[:, ::-1] == budget
        last = np.minimum(np.where(stops, row, np.inf).min(axis=1), grid.near[1])
        first = np.maximum(np.where(starts, row + 1, -np.inf).max(axis=1), grid.far[0])
        self._by_distance(sets, nearest_row=last, farthest_row=first)

    def _by_distance(self, sets: StateSet, nearest_row: Floats, farthest_row: Floats) -> None:
        """Contracts z: near ends lie no nearer than the ground at one row, far ends no farther than at the other, (markings, sets) each."""
        near_end, far_end = self.scene.runway.ends_z_m.T[:, :, None]
        nearest, farthest = self._distances(sets, nearest_row)[0], self._distances(sets, farthest_row)[1]
        least = lowered(nearest - near_end, np.abs(nearest) + np.abs(near_end))
        most = raised(farthest - far_end, np.abs(farthest) + np.abs(far_end))
        _draw_in(sets.z, least.max(axis=0), most.min(axis=0))

    def _by_claims(self, sets: StateSet, grid: _Grid, claims: _Pixels, offset: Interval) -> Interval:
        """Contracts z by claimed pixels, and returns the offset's bounds, contracted by them too."""
        claimed = _LitColumns.of(self.scene, claims, sets, grid).of_one_marking()
        row, spoiled = grid.rows[:-1], self.extra_budget
        found = ~claimed.dark
        whole = np.zeros_like(found)
        whole[:, 1:-1] = grid.crossed[:, :-1] & grid.crossed[:, 1:] & found[:, 1:-1]
        across_low, across_high = _across(self.scene, sets)
        rises, falls = across_low[:, None] >= 0, across_high[:, None] <= 0
        high = claimed.first + (1 - self.scene.camera.u0 + grid.margin_px)
        low = claimed.last - (self.scene.camera.u0 + grid.margin_px)
        start, stop = ([1 / np.where(ratio[side] > 0, ratio[side], 1.0) for ratio in grid.ratio] for side in (slice(-1), slice(1, None)))
        high = np.where(rises, np.maximum(high * start[0], high * start[1]), np.maximum(high * stop[0], high * stop[1]))
        low = np.where(rises, np.minimum(low * stop[0], low * stop[1]), np.minimum(low * start[0], low * start[1]))
        usable = whole & (rises | falls)
        offset_high = _smallest_but(np.where(usable, high, np.inf), spoiled)
        offset_low = _largest_but(np.where(usable, low, -np.inf), spoiled)
        last = _largest_but(np.where(found, row, -np.inf), spoiled)
        first = _smallest_but(np.where(found, row + 1, np.inf), spoiled)
        self._by_reach(sets, grid, last, first)
        explained = claims.count(row, claimed.window).sum(axis=(0, 1))
        unexplained = claims.canvas.sum() - explained > self.extra_budget
        offset_low[:, unexplained], offset_high[:, unexplained] = np.inf, -np.inf
        return np.maximum(offset[0], offset_low), np.minimum(offset[1], offset_high)

    def _by_reach(self, sets: StateSet, grid: _Grid, last: Floats, first: Floats) -> None:
        """Contracts z: near ends come at least as near as the ground at row `last`, (markings, sets), far ends reach row `first`."""
        near_end, far_end = self.scene.runway.ends_z_m.T[:, :, None]
        farthest = self._distances(sets, np.clip(last, grid.far[0], grid.near[1]))[1]
        nearest = self._distances(sets, np.clip(first, grid.far[0], grid.near[1]))[0]
        most = raised(farthest - near_end, np.abs(farthest) + np.abs(near_end))
        least = lowered(nearest - far_end, np.abs(nearest) + np.abs(far_end))
        _draw_in(sets.z, least.max(axis=0), most.min(axis=0))

    def _distances(self, sets: StateSet, row: Floats) -> Interval:
        """Range of the distance d = F (cos(theta) - t sin(theta)) / (scale R) of the ground at rows (rows, sets).

        It has no upper bound where some state of the set may see the horizon there.
        """
        tangent = tangent_of_row(self.scene.camera, row)
        low, high = scale_ratio(sets, tangent)
        terms = sets.condition * (1 + np.abs(tangent) + high)
        slow, fast = sets.scale[:, 0] * lowered(low, terms), sets.scale[:, 1] * raised(high, terms)
        (cosine_low, cosine_high), (sine_low, sine_high) = sets.turn[0].T, sets.turn[1].T
        far = raised(cosine_low - sine_low * tangent, 1 + np.abs(tangent))
        near = lowered(cosine_high - sine_high * tangent, 1 + np.abs(tangent))
        nearest, farthest = np.maximum(near, 0) / fast, np.maximum(far, 0) / np.where(slow > 0, slow, 1.0)
        return self.scene.camera.focal_px * nearest, self.scene.camera.focal_px * np.where(slow > 0, farthest, np.inf)


@dataclass(frozen=True)
class _Grid:
    """The rows that each set can show in the window: `rows` (n + 1, sets) are borders; row i lies between borders i and i + 1.

    `ratio` bounds R there; `ground` (n - 1, sets) says which of the inner borders lie below the horizon in all states of the set, and
    `crossed` (markings, n - 1, sets) which of them each marking crosses in all states; `near` and `far` bound the ends of each marking,
    (markings, sets), px; `margin_px` (sets,) covers what rounding does to a column.
    """

    rows: Floats
    ratio: Interval
    near: Interval
    far: Interval
    ground: Bits
    crossed: Bits
    margin_px: Floats

    @staticmethod
    def of(scene: Scene, sets: StateSet, pixels: _Pixels) -> _Grid:
        """The rows of `pixels` between the farthest and the nearest ends; of all rows beyond its border one stands for the others."""
        near, far = _ends(scene, sets)
        top, bottom = pixels.top, pixels.top + len(pixels.canvas) - 1
        first = np.clip(np.floor(far[0].min(axis=0)), top, bottom)
        last = np.clip(np.floor(near[1].max(axis=0)), top, bottom)
        rows = first + np.arange(int((last - first).max()) + 2, dtype=np.float64)[:, None]
        ratio = scale_ratio(sets, tangent_of_row(scene.camera, rows))
        ground = ratio[0][1:-1] > 0
        crossed = (rows[1:-1] > far[1][:, None]) & (rows[1:-1] < near[0][:, None]) & ground
        return _Grid(rows, ratio, near, far, ground, crossed, _column_margins_px(scene, sets))


def _ends(scene: Scene, sets: StateSet) -> tuple[Interval, Interval]:
    """Ranges of the rows of each marking's near and far end, (markings, sets) each; equal distances are computed once.

    v - v0 = F tan(beta - theta), so an error of an angle grows by 1 + tan^2: that of rounding, of the altitude that a scale stands for, and
    of the distance as a sum of coordinates.
    """
    distances = np.array(sorted(set(scene.runway.ends_z_m.flat)))
    focal, v0 = scene.camera.focal_px, scene.camera.v0
    angle = sets.condition[:, None] + np.abs(distances) / (sets.z[:, :1] + distances)
    low, high = end_rows(scene.camera, sets, distances)
    low = below(lowered(low, angle * (focal + (low - v0) ** 2 / focal))).T
    high = above(raised(high, angle * (focal + (high - v0) ** 2 / focal))).T
    near, far = np.searchsorted(distances, scene.runway.ends_z_m.T)
    return (low[near], high[near]), (low[far], high[far])


def _column_margins_px(scene: Scene, sets: StateSet) -> Floats:
    """What a column u0 + (p_x - x) scale R that is in the frame may be off by, (sets,): R is as uncertain as s(theta, t_ref)."""
    across_low, across_high = _across(scene, sets)
    offset = np.maximum(-across_low, across_high).max(axis=0) * sets.scale[:, 1]
    return column_margin_px(sets.condition * (offset + max(abs(scene.camera.u0), abs(scene.camera.width - scene.camera.u0))))


def _across(scene: Scene, sets: StateSet) -> Interval:
    """Range of p_x - x, (markings, sets)."""
    x_m = scene.runway.x_m[:, None]
    return x_m - sets.x[:, 1], x_m - sets.x[:, 0]


@dataclass(frozen=True)
class _LitColumns:
    """First and last lit column among those a marking could light in a row, (markings, rows, sets); where none is, `dark`.

    `window` bounds the columns that could be lit at all.
    """

    first: Floats
    last: Floats
    dark: Bits
    window: Interval

    @staticmethod
    def of(scene: Scene, pixels: _Pixels, sets: StateSet, grid: _Grid) -> _LitColumns:
        """Looks the usable columns up in the frame."""
        u0 = scene.camera.u0
        across_low, across_high = (across[:, None] for across in _across(scene, sets))
        slow, fast = sets.scale[:, 0] * grid.ratio[0], sets.scale[:, 1] * grid.ratio[1]
        low, high = np.minimum(across_low * slow, across_low * fast), np.maximum(across_high * slow, across_high * fast)
        window = (
            np.floor(np.minimum(low[:, :-1], low[:, 1:]) + (u0 - grid.margin_px)),
            np.floor(np.maximum(high[:, :-1], high[:, 1:]) + (u0 + grid.margin_px)),
        )
        return _LitColumns._marked(*pixels.nearest(grid.rows[:-1], window), window)

    @staticmethod
    def _marked(first: Floats, last: Floats, window: Interval) -> _LitColumns:
        """With bounds that no state meets, where no pixel is lit."""
        dark = last < first
        np.copyto(first, np.inf, where=dark)
        np.copyto(last, -np.inf, where=dark)
        return _LitColumns(first, last, dark, window)

    def of_one_marking(self) -> _LitColumns:
        """The same without the rows in which another marking could light one of a marking's columns."""
        low, high = self.window
        shared = np.zeros(low.shape, dtype=bool)
        for left, right in itertools.permutations(range(len(low)), 2):
            shared[left] |= (low[left] <= high[right]) & (low[right] <= high[left])
        return self._marked(np.where(shared, np.inf, self.first), np.where(shared, -np.inf, self.last), self.window)


@dataclass(frozen=True)
class _Pixels:
    """A window of a frame, ready to be asked for the lit pixels of a stretch of a row. What lies beyond it is lit, or all dark.

    `canvas` (rows + 2, columns + 2) holds the window within a border that stands for all beyond it; `top` and `left` are the border's.
    """

    canvas: Bits
    top: int
    left: int
    beyond: bool

    @staticmethod
    def of(frame: Bits, window: tuple[slice, slice], beyond: bool) -> _Pixels:
        """The pixels of `window`; `beyond`: are those outside of it lit?"""
        seen = frame[window]
        canvas = np.full((seen.shape[0] + 2, seen.shape[1] + 2), beyond)
        canvas[1:-1, 1:-1] = seen
        return _Pixels(canvas, (window[0].start or 0) - 1, (window[1].start or 0) - 1, beyond)

    @cached_property
    def following(self) -> Floats:
        """The nearest lit column at or after each pixel, flat; without bound beyond the window."""
        column = np.where(self.canvas, np.arange(self.canvas.shape[1], dtype=np.int16), NO_COLUMN)
        for step in _doubling(column.shape[1]):
            np.minimum(column[:, :-step], column[:, step:], out=column[:, :-step])
        return self._unbounded(column, -np.inf)

    @cached_property
    def preceding(self) -> Floats:
        """The nearest lit column at or before each pixel, flat; without bound beyond the window."""
        column = np.where(self.canvas, np.arange(self.canvas.shape[1], dtype=np.int16), -NO_COLUMN)
        for step in _doubling(column.shape[1]):
            np.maximum(column[:, step:], column[:, :-step], out=column[:, step:])
        return self._unbounded(column, np.inf)

    @cached_property
    def counted(self) -> Rows:
        """How many pixels of its row are lit up to each pixel, flat."""
        return np.cumsum(self.canvas, axis=1, dtype=np.int64).ravel()

    def nearest(self, row: Floats, stretch: Interval) -> Interval:
        """First and last lit column of the columns from stretch[0] to stretch[1]; the last is before the first where none is lit.

        Where a stretch reaches beyond the window it has no bound on that side, if what lies there is lit.
        """
        start = self._start(row)
        return self.following.take(self._place(start, stretch[0])), self.preceding.take(self._place(start, stretch[1]))

    def count(self, row: Floats, stretch: Interval) -> Rows:
        """How many columns from stretch[0] to stretch[1] are lit."""
        start = self._start(row)
        return self.counted.take(self._place(start, stretch[1])) - self.counted.take(self._place(start, stretch[0] - 1))

    def _start(self, row: Floats) -> Floats:
        """Where a row starts in the flat tables."""
        return np.minimum(np.maximum(row - self.top, 0), self.canvas.shape[0] - 1) * self.canvas.shape[1]

    def _place(self, start: Floats, column: Floats) -> Rows:
        return (start + np.minimum(np.maximum(column - self.left, 0), self.canvas.shape[1] - 1)).astype(np.int64)

    def _unbounded(self, column: NDArray[np.int16], value: float) -> Floats:
        """As columns of the frame, flat, with `value` on the border if what lies there is lit."""
        columns = column.astype(np.float64) + self.left
        if self.beyond:
            columns[0] = columns[-1] = value
            columns[:, 0] = columns[:, -1] = value
        return columns.ravel()


def _doubling(count: int) -> list[int]:
    """1, 2, 4, ... below `count`: steps that carry a value over any distance."""
    return [1 << power for power in range((count - 1).bit_length())]


def _largest_but(values: Floats, count: int) -> Floats:
    """The largest value along axis 1 but for `count` larger ones; no bound where there are no more than that."""
    if count == 0:
        return values.max(axis=1, initial=-np.inf)
    if count >= values.shape[1]:
        return np.full((len(values), *values.shape[2:]), -np.inf)
    return np.partition(values, -count - 1, axis=1)[:, -count - 1]


def _smallest_but(values: Floats, count: int) -> Floats:
    """The smallest value along axis 1 but for `count` smaller ones; no bound where there are no more than that."""
    return -_largest_but(-values, count)


def _draw_in(interval: Floats, low: Floats, high: Floats) -> None:
    """Intersects intervals (sets, 2) with [low, high] in place."""
    np.maximum(interval[:, 0], low, out=interval[:, 0])
    np.minimum(interval[:, 1], high, out=interval[:, 1])


def _empty(sets: StateSet) -> Bits:
    """True for sets without a state: some interval is inverted, each bound of which is rounded outward."""
    return np.logical_or.reduce([side[:, 0] > side[:, 1] for side in (sets.x, sets.y, sets.z, sets.scale)])


def _quotient(low: Floats, high: Floats, divisor: Floats) -> tuple[Floats, Floats]:
    """Range of [low, high] / divisor (..., 2) where the divisor has one sign, rounded outward; no bound where it has not."""
    near, far = divisor[..., 0], divisor[..., 1]
    usable = near * far > 0
    if not usable.all():
        near, far = np.where(usable, near, 1.0), np.where(usable, far, 1.0)
        low, high = np.where(usable, low, -np.inf), np.where(usable, high, np.inf)
    smallest = np.minimum(np.minimum(low / near, low / far), np.minimum(high / near, high / far))
    largest = np.maximum(np.maximum(low / near, low / far), np.maximum(high / near, high / far))
    return lowered(smallest, np.abs(smallest)), raised(largest, np.abs(largest))


def _cut(sets: StateSet, **parts: int) -> StateSet:
    """A copy with every set cut into equal parts along the named axes; neighbours share their borders to the last bit."""
    for axis, count in parts.items():
        which = np.repeat(np.arange(len(sets)), count)
        interval = getattr(sets, axis)
        edges = interval[:, :1] + (interval[:, 1:] - interval[:, :1]) * (np.arange(count + 1) / count)
        edges[:, -1] = interval[:, 1]
        sides = np.stack([edges[:, :-1].ravel(), edges[:, 1:].ravel()], axis=-1)
        sets = replace(sets[which], **{axis: sides})
    return sets


def joined(*parts: StateSet) -> StateSet:
    """All sets of the given batches in one."""
    if len(parts) == 1:
        return parts[0]
    names = ("theta", "x", "y", "z", "scale", "tangent")
    return StateSet(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _carries_a_face(sets: StateSet, pieces: int) -> Bits:
    """True for the `pieces` sets that reach farthest on each side of theta, y and z."""
    chosen = np.zeros(len(sets), dtype=bool)
    if len(sets) <= pieces:
        return ~chosen
    for bound in (sets.theta, sets.y, sets.z):
        chosen[np.argsort(bound[:, 0], kind="stable")[:pieces]] = True  # ties are broken alike on every machine
        chosen[np.argsort(-bound[:, 1], kind="stable")[:pieces]] = True
    return chosen


def _extent(sets: StateSet) -> Floats:
    """Sides of the box around all sets, along theta, y and z; of no sets, 0."""
    intervals = np.stack([sets.theta, sets.y, sets.z])
    return intervals[..., 1].max(axis=1, initial=-np.inf) - intervals[..., 0].min(axis=1, initial=np.inf)

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
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from runtime.rounding import OUTWARD_PX, above, below, inverted
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
MOST_TO_JOIN = 1024
"""More pieces than this are taken for one connected part, whose hull is the same, at a bounded cost."""
STATE_MARGIN = 2.0**-30
"""Margin on every side of a refined set, rad or m: far above the error of float64, far below anything an image tells."""
NO_BOUND = 2.0**40
"""Stands for an infinite bound on a column or an offset, px."""
NO_ROW = 2**20
"""Stands for a row that no frame has."""
NO_COLUMN = np.int16(2**15 - 1)
"""Stands for a column that no frame has."""


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
        for _ in range(FACE_ROUNDS):
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
        self._by_altitude(sets)
        grid = _Grid.of(self.scene, sets)
        lit = _LitColumns.of(self.scene, witnesses, sets, grid)
        offset = self._by_end_pixels(sets, grid, lit, self._offsets(grid, lit))
        if claims is not None:
            offset = self._by_claims(sets, grid, claims, offset)
        self._by_offset(sets, offset)
        self._by_ends(sets, grid, lit)
        self._by_altitude(sets)
        low = np.concatenate([offset[0], [sets.x[:, 0], sets.y[:, 0], sets.z[:, 0], sets.scale[:, 0]]])
        high = np.concatenate([offset[1], [sets.x[:, 1], sets.y[:, 1], sets.z[:, 1], sets.scale[:, 1]]])
        return sets[~np.logical_or.reduce(inverted(low, high), axis=0)]

    def _by_altitude(self, sets: StateSet) -> None:
        """Draws y and scale in by y = F s(theta, t_ref) / scale."""
        focal = self.scene.camera.focal_px
        fall_low, fall_high = reference_fall_range(sets)
        _draw_in(sets.scale, focal * fall_low / sets.y[:, 1], focal * fall_high / sets.y[:, 0])
        _draw_in(sets.y, focal * fall_low / sets.scale[:, 1], focal * fall_high / sets.scale[:, 0])

    def _offsets(self, grid: _Grid, lit: _LitColumns) -> Interval:
        """Bounds on the offset (p_x - x) scale of each marking, (markings, sets), from the row borders that all states cross."""
        u0, spoiled = self.scene.camera.u0, 2 * self.missed_budget
        low = np.maximum(lit.first[:, :-1], lit.first[:, 1:]) - (u0 + OUTWARD_PX)
        high = np.minimum(lit.last[:, :-1], lit.last[:, 1:]) + (1 - u0 + OUTWARD_PX)
        slow, fast = (1 / ratio[1:-1] for ratio in grid.ratio)
        low, high = np.minimum(low * slow, low * fast), np.maximum(high * slow, high * fast)
        return _largest_but(np.where(grid.crossed, low, -NO_BOUND), spoiled), _smallest_but(np.where(grid.crossed, high, NO_BOUND), spoiled)

    def _by_end_pixels(self, sets: StateSet, grid: _Grid, lit: _LitColumns, offset: Interval) -> Interval:
        """The offset's bounds, drawn in by the lit pixels at the ends of markings; only without missed pixels, which may be just there.

        With row b the last one that the far end may lie in, the marking has a point in it, at the end or on the border above it, whichever
        is lower; and likewise in the first row that the near end may lie in.
        """
        if self.missed_budget > 0:
            return offset
        far, near = np.floor(above(grid.far[1])), np.floor(below(grid.near[0]))
        start = tangent_of_row(self.scene.camera, np.stack([np.maximum(far, below(grid.far[0])), below(grid.near[0])], axis=1))
        stop = tangent_of_row(self.scene.camera, np.stack([above(grid.far[1]), np.minimum(near + 1, above(grid.near[1]))], axis=1))
        slow, fast = scale_ratio(sets, start)[0], scale_ratio(sets, stop)[1]
        place = (np.stack([far, near], axis=1) - grid.rows[0]).astype(np.int64)
        inside = np.clip(place, 0, lit.first.shape[1] - 1)
        apart = (below(grid.near[0]) > above(grid.far[1]))[:, None]
        known = apart & (place == inside) & (slow > 0)
        slow, fast = np.maximum(slow, 1 / NO_BOUND), np.maximum(fast, 1 / NO_BOUND)
        u0 = self.scene.camera.u0
        low = np.take_along_axis(lit.first, inside, axis=1) - (u0 + OUTWARD_PX)
        high = np.take_along_axis(lit.last, inside, axis=1) + (1 - u0 + OUTWARD_PX)
        low = np.where(known, np.minimum(low / slow, low / fast), -NO_BOUND).max(axis=1)
        high = np.where(known, np.maximum(high / slow, high / fast), NO_BOUND).min(axis=1)
        return np.maximum(offset[0], low), np.minimum(offset[1], high)

    def _by_offset(self, sets: StateSet, offset: Interval) -> None:
        """Draws scale and x in by offset = (p_x - x) scale: marking by marking, and by the differences of markings, free of x."""
        x_m = self.scene.runway.x_m
        low, high = offset[0].T, offset[1].T
        scale_low, scale_high = _quotient(low, high, x_m[:, None] - sets.x[:, None, ::-1])
        _draw_in(sets.scale, scale_low.max(axis=1), scale_high.min(axis=1))
        if (sets.x[:, 1] <= sets.x[:, 0]).all():
            return
        for left, right in zip(*np.triu_indices(len(x_m), 1), strict=True):
            apart = np.full(2, x_m[right] - x_m[left])
            _draw_in(sets.scale, *_quotient(low[:, right] - high[:, left], high[:, right] - low[:, left], apart))
        across_low, across_high = _quotient(low, high, np.maximum(sets.scale, 1 / NO_BOUND)[:, None, :])
        _draw_in(sets.x, (x_m - across_high).max(axis=1), (x_m - across_low).min(axis=1))

    def _by_ends(self, sets: StateSet, grid: _Grid, lit: _LitColumns) -> None:
        """Draws z in: a marking does not go on past the (m + 1)-th row that shows no pixel it could light."""
        row = grid.rows[:-1]
        before_near, behind_far = row + 1 <= grid.near[0][:, None], row >= grid.far[1][:, None]
        stops, starts = lit.dark & behind_far & ~before_near, lit.dark & before_near & ~behind_far
        budget = self.missed_budget + 1
        if budget > 1:
            stops &= stops.cumsum(axis=1) == budget
            starts &= starts[:, ::-1].cumsum(axis=1)[:, ::-1] == budget
        last = np.minimum(np.where(stops, row, NO_ROW).min(axis=1), above(grid.near[1]))
        first = np.maximum(np.where(starts, row + 1, -NO_ROW).max(axis=1), below(grid.far[0]))
        self._by_distance(sets, nearest_row=last, farthest_row=first)

    def _by_distance(self, sets: StateSet, nearest_row: Floats, farthest_row: Floats) -> None:
        """Draws z in: near ends lie no nearer than the ground at `nearest_row`, (markings, sets), far ends no farther than at the other."""
        ends_z = self.scene.runway.ends_z_m
        least = self._distances(sets, nearest_row)[0] - ends_z[:, :1]
        most = self._distances(sets, farthest_row)[1] - ends_z[:, 1:]
        _draw_in(sets.z, least.max(axis=0), most.min(axis=0))

    def _by_claims(self, sets: StateSet, grid: _Grid, claims: _Pixels, offset: Interval) -> Interval:
        """Draws z in, and returns the offset's bounds drawn in, by claimed pixels."""
        claimed = _LitColumns.of(self.scene, claims, sets, grid).of_one_marking()
        row, spoiled = grid.rows[:-1], self.extra_budget
        found = ~claimed.dark
        whole = np.zeros_like(found)
        whole[:, 1:-1] = grid.crossed[:, :-1] & grid.crossed[:, 1:] & found[:, 1:-1]
        across_low, across_high = _across(self.scene, sets)
        rises, falls = across_low[:, None] >= 0, across_high[:, None] <= 0
        high = claimed.first + 1 - self.scene.camera.u0 + OUTWARD_PX
        low = claimed.last - self.scene.camera.u0 - OUTWARD_PX
        start = [1 / np.maximum(ratio[:-1], 1 / NO_BOUND) for ratio in grid.ratio]
        stop = [1 / np.maximum(ratio[1:], 1 / NO_BOUND) for ratio in grid.ratio]
        high = np.where(rises, np.maximum(high * start[0], high * start[1]), np.maximum(high * stop[0], high * stop[1]))
        low = np.where(rises, np.minimum(low * stop[0], low * stop[1]), np.minimum(low * start[0], low * start[1]))
        usable = whole & (rises | falls)
        offset_high = _smallest_but(np.where(usable, high, NO_BOUND), spoiled)
        offset_low = _largest_but(np.where(usable, low, -NO_BOUND), spoiled)
        last = _largest_but(np.where(found, row, -NO_ROW), spoiled)
        first = _smallest_but(np.where(found, row + 1, NO_ROW), spoiled)
        self._by_reach(sets, grid, last, first)
        explained = claims.count(row, claimed.window).sum(axis=(0, 1))
        offset_low[:, claims.canvas.sum() - explained > self.extra_budget] = NO_BOUND
        return np.maximum(offset[0], offset_low), np.minimum(offset[1], offset_high)

    def _by_reach(self, sets: StateSet, grid: _Grid, last: Floats, first: Floats) -> None:
        """Draws z in: near ends come at least as near as the ground at row `last`, (markings, sets), far ends reach row `first`."""
        ends_z = self.scene.runway.ends_z_m
        reach_low, reach_high = below(grid.far[0]), above(grid.near[1])
        most = self._distances(sets, np.clip(last, reach_low, reach_high))[1] - ends_z[:, :1]
        least = self._distances(sets, np.clip(first, reach_low, reach_high))[0] - ends_z[:, 1:]
        _draw_in(sets.z, least.max(axis=0), most.min(axis=0))

    def _distances(self, sets: StateSet, row: Floats) -> Interval:
        """Range of the distance d = F (cos(theta) - t sin(theta)) / (scale R) of the ground at rows (rows, sets)."""
        tangent = tangent_of_row(self.scene.camera, row)
        low, high = scale_ratio(sets, tangent)
        (cosine_low, cosine_high), (sine_low, sine_high) = sets.turn[0].T, sets.turn[1].T
        far, near = cosine_low - sine_low * tangent, cosine_high - sine_high * tangent
        focal, tiny = self.scene.camera.focal_px, 1 / NO_BOUND
        slow, fast = np.maximum(sets.scale[:, 0] * low, tiny), np.maximum(sets.scale[:, 1] * high, tiny)
        return focal * np.minimum(near / fast, near / slow), focal * np.maximum(far / slow, far / fast)


@dataclass(frozen=True)
class _Grid:
    """The rows that each set can show: `rows` (n + 1, sets) are borders; row i lies between borders i and i + 1.

    `ratio` bounds R there; `near` and `far` bound the ends of each marking, (markings, sets), px; `crossed` (markings, n - 1, sets) says
    which of the inner borders all states of the set cross.
    """

    rows: Floats
    ratio: Interval
    near: Interval
    far: Interval
    crossed: Bits

    @staticmethod
    def of(scene: Scene, sets: StateSet) -> _Grid:
        near, far = _ends(scene, sets)
        first = np.floor(below(far[0].min(axis=0)))
        count = int((np.floor(above(near[1].max(axis=0))) - first).max()) + 1
        rows = first + np.arange(count + 1, dtype=np.float64)[:, None]
        ratio = scale_ratio(sets, tangent_of_row(scene.camera, rows))
        crossed = (rows[1:-1] > above(far[1])[:, None]) & (rows[1:-1] < below(near[0])[:, None])
        if ratio[0].min() <= 0:
            crossed &= ratio[0][1:-1] > 0
            ratio = np.maximum(ratio[0], 1 / NO_BOUND), np.maximum(ratio[1], 1 / NO_BOUND)
        return _Grid(rows, ratio, near, far, crossed)


def _ends(scene: Scene, sets: StateSet) -> tuple[Interval, Interval]:
    """Ranges of the rows of each marking's near and far end, (markings, sets) each; equal distances are computed once."""
    distances = sorted(set(scene.runway.ends_z_m.flat))
    low, high = (rows.T for rows in end_rows(scene.camera, sets, distances))
    near, far = ([distances.index(end) for end in ends] for ends in scene.runway.ends_z_m.T)
    return (low[near], high[near]), (low[far], high[far])


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
            np.floor(np.minimum(low[:, :-1], low[:, 1:]) + (u0 - OUTWARD_PX)),
            np.floor(np.maximum(high[:, :-1], high[:, 1:]) + (u0 + OUTWARD_PX)),
        )
        return _LitColumns._marked(*pixels.nearest(grid.rows[:-1], window), window)

    @staticmethod
    def _marked(first: Floats, last: Floats, window: Interval) -> _LitColumns:
        """With bounds that no state meets, where no pixel is lit."""
        dark = last < first
        np.copyto(first, NO_BOUND, where=dark)
        np.copyto(last, -NO_BOUND, where=dark)
        return _LitColumns(first, last, dark, window)

    def of_one_marking(self) -> _LitColumns:
        """The same without the rows in which another marking could light one of a marking's columns."""
        low, high = self.window
        shared = np.zeros(low.shape, dtype=bool)
        for left, right in itertools.permutations(range(len(low)), 2):
            shared[left] |= (low[left] <= high[right]) & (low[right] <= high[left])
        return self._marked(np.where(shared, NO_BOUND, self.first), np.where(shared, -NO_BOUND, self.last), self.window)


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
        return self._unbounded(column, -NO_BOUND)

    @cached_property
    def preceding(self) -> Floats:
        """The nearest lit column at or before each pixel, flat; without bound beyond the window."""
        column = np.where(self.canvas, np.arange(self.canvas.shape[1], dtype=np.int16), -NO_COLUMN)
        for step in _doubling(column.shape[1]):
            np.maximum(column[:, step:], column[:, :-step], out=column[:, step:])
        return self._unbounded(column, NO_BOUND)

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
    """The largest value along axis 1 but for `count` larger ones."""
    if count == 0:
        return values.max(axis=1)
    if count >= values.shape[1]:
        return np.full((len(values), *values.shape[2:]), -NO_BOUND)
    return np.partition(values, -count - 1, axis=1)[:, -count - 1]


def _smallest_but(values: Floats, count: int) -> Floats:
    """The smallest value along axis 1 but for `count` smaller ones."""
    return -_largest_but(-values, count) if count else values.min(axis=1)


def _draw_in(interval: Floats, low: Floats, high: Floats) -> None:
    """Intersects intervals (sets, 2) with [low, high] in place."""
    np.maximum(interval[:, 0], low, out=interval[:, 0])
    np.minimum(interval[:, 1], high, out=interval[:, 1])


def _quotient(low: Floats, high: Floats, divisor: Floats) -> tuple[Floats, Floats]:
    """Range of [low, high] / divisor (..., 2) where the divisor has one sign; no bound where it has not."""
    near, far = divisor[..., 0], divisor[..., 1]
    usable = near * far > 0
    if not usable.all():
        near, far = np.where(usable, near, 1.0), np.where(usable, far, 1.0)
        low, high = np.where(usable, low, -NO_BOUND), np.where(usable, high, NO_BOUND)
    near, far = 1 / near, 1 / far
    smallest = np.minimum(np.minimum(low * near, low * far), np.minimum(high * near, high * far))
    return smallest, np.maximum(np.maximum(low * near, low * far), np.maximum(high * near, high * far))


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
    names = ("theta", "x", "y", "z", "scale", "tangent")
    return StateSet(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _carries_a_face(sets: StateSet, pieces: int) -> Bits:
    """True for the `pieces` sets that reach farthest on each side of theta, y and z."""
    chosen = np.zeros(len(sets), dtype=bool)
    if len(sets) <= pieces:
        return ~chosen
    for bound in (sets.theta, sets.y, sets.z):
        chosen[np.argpartition(bound[:, 0], pieces)[:pieces]] = True
        chosen[np.argpartition(-bound[:, 1], pieces)[:pieces]] = True
    return chosen


def _extent(sets: StateSet) -> Floats:
    """Sides of the box around all sets, along theta, y and z; of no sets, 0."""
    intervals = np.stack([sets.theta, sets.y, sets.z])
    return intervals[..., 1].max(axis=1, initial=-np.inf) - intervals[..., 0].min(axis=1, initial=np.inf)


def connected_parts(sets: StateSet) -> list[NDArray[np.int64]]:
    """Numbers of the sets in each connected part of their union: parts are joined where boxes (theta, x, y, z) touch."""
    if len(sets) > MOST_TO_JOIN:
        return [np.arange(len(sets))]
    bounds = np.stack([sets.theta, sets.x, sets.y, sets.z])  # axes first, so that numpy compares whole rows of pairs
    lower, upper = bounds[..., 0] - STATE_MARGIN, bounds[..., 1] + STATE_MARGIN
    starts_before_end = np.logical_and.reduce(lower[:, :, None] <= upper[:, None], axis=0)
    touch = starts_before_end & starts_before_end.T
    left: Bits = np.ones(len(sets), dtype=bool)
    parts: list[NDArray[np.int64]] = []
    while left.any():
        size, reached = 0, np.array([np.argmax(left)])
        while len(reached) > size:
            size, reached = len(reached), np.flatnonzero(touch[reached].any(axis=0))
        parts.append(reached)
        left[reached] = False
    return parts

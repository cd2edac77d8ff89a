"""From the entries that pass to the states that one image cannot tell apart: the certified box at its limit.

Every passing entry (`build_model.hough_bank`) is a set of states. It is cut into thin slices of theta, and each slice is contracted by
what the frame shows. A state whose markings cross the border r of two rows lights a pixel on both sides of it (Theorem A), so

    u(r) = u0 + (p_x - x) scale R(theta, r)  lies in the closed columns of a lit pixel above r, and of one below r

up to the missed pixels. In a thin slice R is all but a number, and every border bounds each marking's offset (p_x - x) scale on both
sides. Beyond the rows that all states of the slice cross, the first row without a usable lit pixel ends a marking, and so bounds its
distance. Slices that contradict the frame are dropped; the others are cut finer, in the end only those that carry a face of the box.

Under Theorem B the lit pixels of S (here: claimed pixels) are the runway's, but for `extra_budget` of them. A claimed pixel that only one
marking of the slice could light bounds that marking's offset by the pixel's other side, and pulls its ends out to the pixel's row.

Guarantee: each state of the given entries that is consistent with the frame stays in some slice. Pixels outside the frame count as
lit. A dark pixel of the runway spoils at most the two borders of its row and one row of an end, for each marking that shares it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from runtime.rounding import OUTWARD_PX, above, below, inverted
from runtime.scene import Scene
from runtime.state_set import Floats, StateSet, column_range, end_rows, reference_fall_range, scale_ratio, tangent_of_row

Bits = NDArray[np.bool_]
Rows = NDArray[np.int64]

CUTS = (2, 4)
"""Slices of theta that every piece is cut into, round after round."""
FACE_ROUNDS, FACE_PIECES, FACE_CUTS = 2, 2, (4, 3)
"""Last rounds: how many, how many pieces a face of the box, and into how many slices of theta and of z each is cut."""
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


@dataclass(frozen=True)
class Refiner:
    """Refines the entries of one model. `missed_budget` is m, `extra_budget` is e."""

    scene: Scene
    missed_budget: int
    extra_budget: int

    def refine(self, frame: Bits, entries: StateSet, claimed: Bits | None = None) -> StateSet:
        """Slices that hold all states of `entries` which are consistent with `frame`, (height, width); none if there is none.

        `frame` is dilated by the tolerance. `claimed`: the lit pixels of S, for Theorem B at tolerance 0; the entries are of one cell then.
        """
        if len(entries) > LARGEST_START:
            return entries
        canvas = np.pad(frame, 1, constant_values=True)
        claims = None if claimed is None else np.pad(claimed, 1)
        pieces = entries
        for cuts in CUTS:
            pieces = self._contracted(canvas, claims, _cut(pieces, theta=cuts))
        for _ in range(FACE_ROUNDS):
            outer = _carries_a_face(pieces, FACE_PIECES)
            finer = self._contracted(canvas, claims, _cut(pieces[outer], theta=FACE_CUTS[0], z=FACE_CUTS[1]))
            pieces = joined(finer, pieces[~outer])
        return pieces

    def _contracted(self, canvas: Bits, claims: Bits | None, sets: StateSet) -> StateSet:
        """The sets, whose arrays are overwritten, without most of the states that the frame contradicts, and without empty sets."""
        if len(sets) == 0:
            return sets
        self._by_altitude(sets)
        grid = _Grid.of(self.scene, sets)
        lit = _lit_columns(self.scene, canvas, sets, grid)
        offset = self._offsets(grid, lit)
        if claims is not None:
            offset = self._by_claims(sets, grid, _lit_columns(self.scene, claims, sets, grid), int(claims.sum()), offset)
        self._by_offset(sets, offset)
        self._by_ends(sets, grid, lit)
        self._by_altitude(sets)
        low = np.concatenate([offset[0].T, [sets.x[:, 0], sets.y[:, 0], sets.z[:, 0], sets.scale[:, 0]]])
        high = np.concatenate([offset[1].T, [sets.x[:, 1], sets.y[:, 1], sets.z[:, 1], sets.scale[:, 1]]])
        return sets[~np.logical_or.reduce(inverted(low, high), axis=0)]

    def _by_altitude(self, sets: StateSet) -> None:
        """Draws y and scale in by y = F s(theta, t_ref) / scale."""
        focal = self.scene.camera.focal_px
        fall_low, fall_high = reference_fall_range(sets)
        _draw_in(sets.scale, focal * fall_low / sets.y[:, 1], focal * fall_high / sets.y[:, 0])
        _draw_in(sets.y, focal * fall_low / sets.scale[:, 1], focal * fall_high / sets.scale[:, 0])

    def _offsets(self, grid: _Grid, lit: _LitColumns) -> tuple[Floats, Floats]:
        """Bounds on the offset (p_x - x) scale of each marking, (sets, markings), from the row borders that all states cross."""
        u0 = self.scene.camera.u0
        low = np.maximum(lit.first[..., :-1], lit.first[..., 1:]) - (u0 + OUTWARD_PX)
        high = np.minimum(lit.last[..., :-1], lit.last[..., 1:]) + (1 - u0 + OUTWARD_PX)
        slow, fast = (1 / ratio[:, None, 1:-1] for ratio in grid.ratio)
        low = np.where(grid.crossed, np.minimum(low * slow, low * fast), -NO_BOUND)
        high = np.where(grid.crossed, np.maximum(high * slow, high * fast), NO_BOUND)
        spoiled = 2 * self.missed_budget
        return _largest_but(low, spoiled), -_largest_but(-high, spoiled)

    def _by_offset(self, sets: StateSet, offset: tuple[Floats, Floats]) -> None:
        """Draws scale and x in by offset = (p_x - x) scale: marking by marking, and by the differences of markings, free of x."""
        x_m = self.scene.runway.x_m
        low, high = offset
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
        row = grid.rows[:, None, :-1]
        near_low, far_high = grid.near[0][..., None], grid.far[1][..., None]
        dark = lit.last < lit.first
        before_near, behind_far = row + 1 <= near_low, row >= far_high
        stops, starts = dark & behind_far & ~before_near, dark & before_near & ~behind_far
        budget = self.missed_budget + 1
        if budget > 1:
            stops &= stops.cumsum(axis=2) == budget
            starts &= starts[..., ::-1].cumsum(axis=2)[..., ::-1] == budget
        last = np.minimum(np.where(stops, row, NO_ROW).min(axis=2), above(grid.near[1]))
        first = np.maximum(np.where(starts, row + 1, -NO_ROW).max(axis=2), below(grid.far[0]))
        distance_low, distance_high = self._distances(sets, np.concatenate([last, first], axis=1))
        ends_z, markings = self.scene.runway.ends_z_m, last.shape[1]
        _draw_in(sets.z, (distance_low[:, :markings] - ends_z[:, 0]).max(axis=1), (distance_high[:, markings:] - ends_z[:, 1]).min(axis=1))

    def _by_claims(
        self, sets: StateSet, grid: _Grid, claimed: _LitColumns, in_all: int, offset: tuple[Floats, Floats]
    ) -> tuple[Floats, Floats]:
        """Draws z in, and returns the offset's bounds drawn in, by claimed pixels; `in_all` is their number in the frame."""
        claimed = claimed.of_one_marking()
        row, spoiled = grid.rows[:, None, :-1], self.extra_budget
        found = claimed.last >= claimed.first
        whole = np.zeros_like(found)
        whole[..., 1:-1] = grid.crossed[..., :-1] & grid.crossed[..., 1:] & found[..., 1:-1]
        across = self.scene.runway.x_m[:, None] - sets.x[:, None, ::-1]
        rises, falls = across[..., :1] >= 0, across[..., 1:] <= 0
        ratios = [ratio[:, None, :] for ratio in grid.ratio]
        high = claimed.first + 1 - self.scene.camera.u0 + OUTWARD_PX
        low = claimed.last - self.scene.camera.u0 - OUTWARD_PX
        start = [1 / np.maximum(ratio[..., :-1], 1 / NO_BOUND) for ratio in ratios]
        stop = [1 / np.maximum(ratio[..., 1:], 1 / NO_BOUND) for ratio in ratios]
        high = np.where(rises, np.maximum(high * start[0], high * start[1]), np.maximum(high * stop[0], high * stop[1]))
        low = np.where(rises, np.minimum(low * stop[0], low * stop[1]), np.minimum(low * start[0], low * start[1]))
        usable = whole & (rises | falls)
        offset_high = -_largest_but(np.where(usable, -high, -NO_BOUND), spoiled)
        offset_low = _largest_but(np.where(usable, low, -NO_BOUND), spoiled)
        last = _largest_but(np.where(found, row, -NO_ROW).astype(np.float64), spoiled)
        first = -_largest_but(np.where(found, -row - 1, -NO_ROW).astype(np.float64), spoiled)
        reach_low, reach_high = below(grid.far[0]), above(grid.near[1])
        near, far = np.clip(last, reach_low, reach_high), np.clip(first, reach_low, reach_high)
        distance_low, distance_high = self._distances(sets, np.concatenate([near, far], axis=1))
        ends_z, markings = self.scene.runway.ends_z_m, last.shape[1]
        _draw_in(sets.z, (distance_low[:, markings:] - ends_z[:, 1]).max(axis=1), (distance_high[:, :markings] - ends_z[:, 0]).min(axis=1))
        unexplained = in_all - claimed.count.sum(axis=(1, 2)) > self.extra_budget
        offset_low[unexplained] = NO_BOUND
        return np.maximum(offset[0], offset_low), np.minimum(offset[1], offset_high)

    def _distances(self, sets: StateSet, row: Floats) -> tuple[Floats, Floats]:
        """Range of the distance d = F (cos(theta) - t sin(theta)) / (scale R) of the ground at rows (sets, rows)."""
        tangent = tangent_of_row(self.scene.camera, row)
        low, high = scale_ratio(sets, tangent)
        cosine, sine = sets.turn
        far, near = cosine[:, :1] - sine[:, :1] * tangent, cosine[:, 1:] - sine[:, 1:] * tangent
        focal, tiny = self.scene.camera.focal_px, 1 / NO_BOUND
        slow, fast = np.maximum(sets.scale[:, :1] * low, tiny), np.maximum(sets.scale[:, 1:] * high, tiny)
        return focal * np.minimum(near / fast, near / slow), focal * np.maximum(far / slow, far / fast)


@dataclass(frozen=True)
class _Grid:
    """The rows that each set can show: `rows` (sets, n + 1) are borders; row i lies between borders i and i + 1.

    `ratio` bounds R there; `near` and `far` bound the ends of each marking, (sets, markings), px; `crossed` (sets, markings, n - 1) says
    which of the inner borders all states of the set cross.
    """

    rows: Rows
    ratio: tuple[Floats, Floats]
    near: tuple[Floats, Floats]
    far: tuple[Floats, Floats]
    crossed: Bits

    @staticmethod
    def of(scene: Scene, sets: StateSet) -> _Grid:
        near, far = _ends(scene, sets)
        first = np.floor(below(far[0].min(axis=1))).astype(np.int64)
        count = int((np.floor(above(near[1].max(axis=1))) - first).max()) + 1
        rows = first[:, None] + np.arange(count + 1)
        ratio = scale_ratio(sets, tangent_of_row(scene.camera, rows))
        inner = rows[:, None, 1:-1]
        crossed = (inner > above(far[1])[..., None]) & (inner < below(near[0])[..., None])
        if not (ratio[0] > 0).all():
            crossed &= (ratio[0] > 0)[:, None, 1:-1]
            ratio = np.maximum(ratio[0], 1 / NO_BOUND), np.maximum(ratio[1], 1 / NO_BOUND)
        return _Grid(rows, ratio, near, far, crossed)


def _ends(scene: Scene, sets: StateSet) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Ranges of the rows of each marking's near and far end, (sets, markings) each; equal distances are computed once."""
    distances = sorted(set(scene.runway.ends_z_m.flat))
    low, high = end_rows(scene.camera, sets, distances)
    near, far = ([distances.index(end) for end in ends] for ends in scene.runway.ends_z_m.T)
    return (low[:, near], high[:, near]), (low[:, far], high[:, far])


@dataclass(frozen=True)
class _LitColumns:
    """First and last lit column among those a marking could light in a row, (sets, markings, rows); last < first where none is.

    `window` bounds the columns that could be lit at all, `count` is how many of them are.
    """

    first: Floats
    last: Floats
    window: tuple[Rows, Rows]
    count: Rows

    def of_one_marking(self) -> _LitColumns:
        """The same without the rows in which another marking could light one of a marking's columns."""
        low, high = self.window
        shared = np.zeros(low.shape, dtype=bool)
        for left, right in itertools.permutations(range(low.shape[1]), 2):
            shared[:, left] |= (low[:, left] <= high[:, right]) & (low[:, right] <= high[:, left])
        return replace(self, first=np.where(shared, NO_BOUND, self.first), last=np.where(shared, -NO_BOUND, self.last))


def _lit_columns(scene: Scene, canvas: Bits, sets: StateSet, grid: _Grid) -> _LitColumns:
    """Looks the usable columns up in the frame; `canvas` is the frame within a border of lit pixels."""
    across = scene.runway.x_m[:, None] - sets.x[:, None, ::-1]
    slow, fast = sets.scale[:, :1] * grid.ratio[0], sets.scale[:, 1:] * grid.ratio[1]
    low, high = column_range(scene.camera, across, (slow[:, None, :], fast[:, None, :]))
    first = np.floor(below(np.minimum(low[..., :-1], low[..., 1:]))).astype(np.int64)
    last = np.floor(above(np.maximum(high[..., :-1], high[..., 1:]))).astype(np.int64)
    height, width = scene.camera.shape
    row_start = (np.clip(grid.rows[:, None, :-1], -1, height) + 1) * (width + 2) + 1
    pixels = canvas.ravel()
    lowest, highest = np.full(first.shape, NO_BOUND), np.full(first.shape, -NO_BOUND)
    count = np.zeros(first.shape, dtype=np.int64)
    for step in range(int((last - first).max()) + 1):
        column = first + step
        lit = pixels.take(row_start + np.clip(column, -1, width)) & (column <= last)
        np.minimum(lowest, column, out=lowest, where=lit)
        np.copyto(highest, column, where=lit)
        count += lit
    return _LitColumns(lowest, highest, (first, last), count)


def _largest_but(values: Floats, count: int) -> Floats:
    """The largest value along the last axis but for `count` larger ones."""
    if count == 0:
        return values.max(axis=-1)
    if count >= values.shape[-1]:
        return np.full(values.shape[:-1], -NO_BOUND)
    return np.partition(values, -count - 1, axis=-1)[..., -count - 1]


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


def connected_parts(sets: StateSet) -> list[NDArray[np.int64]]:
    """Numbers of the sets in each connected part of their union: parts are joined where boxes (theta, x, y, z) touch."""
    if len(sets) > MOST_TO_JOIN:
        return [np.arange(len(sets))]
    lower, upper = sets.lower - STATE_MARGIN, sets.upper + STATE_MARGIN
    touch = np.logical_and.reduce((lower[:, None] <= upper[None]) & (lower[None] <= upper[:, None]), axis=-1)
    left: Bits = np.ones(len(sets), dtype=bool)
    parts: list[NDArray[np.int64]] = []
    while left.any():
        size, reached = 0, np.array([np.argmax(left)])
        while len(reached) > size:
            size, reached = len(reached), np.flatnonzero(touch[reached].any(axis=0))
        parts.append(reached)
        left[reached] = False
    return parts

"""From the entries that pass to the states that one image cannot tell apart: the certified box at its limit.

Every passing entry (`build_model.hough_bank`) is a set of states. It is cut into thin slices of theta, and each slice is contracted by
what the frame shows. A state whose markings cross the border r of two rows lights a pixel on both sides of it (Theorem A), so

    u(r) = u0 + (p_x - x) scale R(theta, r)  lies in the closed columns of a lit pixel above r, and of one below r

up to the missed pixels. In a thin slice R is all but a number, and every border bounds each marking's offset (p_x - x) scale on both
sides. Beyond the rows that all states of the slice cross, the first row without a usable lit pixel ends a marking, and so bounds its
distance. Slices that contradict the frame are dropped; the others are cut finer, in the end only those that carry a face of the box.

Guarantee: each state of the given entries that is consistent with the frame stays in some slice. Pixels outside the frame count as
lit. A dark pixel of the runway spoils at most the two borders of its row and one row of an end, for each marking that shares it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from runtime.rounding import OUTWARD_PX, above, below, inverted
from runtime.scene import Scene
from runtime.state_set import Floats, StateSet, altitude_range, column_range, end_rows, fall_range, reach, scale_ratio, tangent_of_row

Bits = NDArray[np.bool_]
Rows = NDArray[np.int64]

CUTS = (2, 4, 4)
"""Slices of theta that every piece is cut into, round after round."""
FACE_ROUNDS, FACE_PIECES, FACE_CUTS = 2, 3, (2, 3)
"""Last rounds: how many, how many pieces a face of the box, and into how many slices of theta and of z each is cut."""
LARGEST_START = 512
"""More passing entries than this say that the frame tells next to nothing: they are left as they are, at a bounded cost."""
STATE_MARGIN = 2.0**-30
"""Margin on every side of a refined set, rad or m: far above the error of float64, far below anything an image tells."""
NO_BOUND = 2.0**40
"""Stands for an infinite bound on a column or an offset, px."""
NO_ROW = 2**20
"""Stands for a row that no frame has."""


@dataclass(frozen=True)
class Refiner:
    """Refines the entries of one model. `missed_budget` is m; `frame` arguments are the frame dilated by the tolerance."""

    scene: Scene
    missed_budget: int

    def refine(self, frame: Bits, entries: StateSet) -> StateSet:
        """Slices that hold all states of `entries` which are consistent with `frame`, (height, width); none if there is none."""
        if len(entries) > LARGEST_START:
            return entries
        canvas = np.pad(frame, 1, constant_values=True)
        pieces = entries
        for cuts in CUTS:
            pieces = self._contract(canvas, _cut(pieces, "theta", cuts))
        for _ in range(FACE_ROUNDS):
            outer = _carries_a_face(pieces, FACE_PIECES)
            finer = _cut(_cut(pieces[outer], "theta", FACE_CUTS[0]), "z", FACE_CUTS[1])
            pieces = _joined(self._contract(canvas, finer), pieces[~outer])
        return pieces

    def _contract(self, canvas: Bits, sets: StateSet) -> StateSet:
        """The sets without most of the states that the frame contradicts; sets that are left empty are dropped."""
        if len(sets) == 0:
            return sets
        sets = self._within_altitudes(sets)
        grid = _Grid.of(self.scene, sets)
        lit = _lit_columns(self.scene, canvas, sets, grid)
        offset = self._offsets(grid, lit)
        narrowed = self._within_offsets(sets, offset)
        narrowed = self._within_ends(narrowed, grid, lit)
        narrowed = self._within_altitudes(narrowed)
        empty = inverted(*offset).any(axis=1)
        for name in ("x", "y", "z", "scale"):
            empty |= inverted(*getattr(narrowed, name).T)
        return narrowed[~empty]

    def _within_altitudes(self, sets: StateSet) -> StateSet:
        """Draws y and scale in by y = F s(theta, t_ref) / scale."""
        focal = self.scene.camera.focal_px
        fall_low, fall_high = fall_range(sets.theta, sets.tangent)
        scale = _intersection(sets.scale, focal * fall_low / sets.y[:, 1], focal * fall_high / sets.y[:, 0])
        sets = replace(sets, scale=scale)
        return replace(sets, y=_intersection(sets.y, *altitude_range(self.scene.camera, sets)))

    def _offsets(self, grid: _Grid, lit: _LitColumns) -> tuple[Floats, Floats]:
        """Bounds on the offset (p_x - x) scale of each marking, (sets, markings), from the row borders that all states cross."""
        u0 = self.scene.camera.u0
        ratio_low, ratio_high = (part[:, None, :] for part in grid.ratio)
        low = np.full(grid.crossed.shape, -NO_BOUND)
        high = np.full(grid.crossed.shape, NO_BOUND)
        low[..., 1:-1] = np.maximum(lit.first[..., :-1], lit.first[..., 1:]) - u0 - OUTWARD_PX
        high[..., 1:-1] = np.minimum(lit.last[..., :-1], lit.last[..., 1:]) + 1 - u0 + OUTWARD_PX
        safe_low, safe_high = np.where(grid.crossed, ratio_low, 1.0), np.where(grid.crossed, ratio_high, 1.0)
        low = np.where(grid.crossed, np.minimum(low / safe_low, low / safe_high), -NO_BOUND)
        high = np.where(grid.crossed, np.maximum(high / safe_low, high / safe_high), NO_BOUND)
        spoiled = 2 * self.missed_budget
        return _largest_but(low, spoiled), -_largest_but(-high, spoiled)

    def _within_offsets(self, sets: StateSet, offset: tuple[Floats, Floats]) -> StateSet:
        """Draws scale and x in by offset = (p_x - x) scale: marking by marking, and by the differences of markings, free of x."""
        x_m = self.scene.runway.x_m
        low, high = offset
        scale, x = sets.scale, sets.x
        for marking, position in enumerate(x_m):
            across = position - x[:, ::-1]
            scale = _intersection(scale, *_quotient(low[:, marking], high[:, marking], across))
        free = bool((x[:, 1] > x[:, 0]).any())
        if free:
            for left, right in zip(*np.triu_indices(len(x_m), 1), strict=True):
                apart = np.full(2, x_m[right] - x_m[left])
                scale = _intersection(scale, *_quotient(low[:, right] - high[:, left], high[:, right] - low[:, left], apart))
            positive = np.maximum(scale, 1 / NO_BOUND)
            for marking, position in enumerate(x_m):
                across_low, across_high = _quotient(low[:, marking], high[:, marking], positive)
                x = _intersection(x, position - across_high, position - across_low)
        return replace(sets, scale=scale, x=x)

    def _within_ends(self, sets: StateSet, grid: _Grid, lit: _LitColumns) -> StateSet:
        """Draws z in: a marking does not go on past the (m + 1)-th row that shows no pixel it could light."""
        dark = lit.last < lit.first
        row = grid.rows[:, None, :-1]
        below_near = dark & (row + 1 > grid.near[0][..., None]) & (row >= grid.far[1][..., None])
        beyond_far = dark & (row < grid.far[1][..., None]) & (row + 1 <= grid.near[0][..., None])
        budget = self.missed_budget + 1
        stop = np.where(below_near & (below_near.cumsum(axis=2) == budget), row, NO_ROW).min(axis=2)
        start = np.where(beyond_far & (beyond_far[..., ::-1].cumsum(axis=2)[..., ::-1] == budget), row + 1, -NO_ROW).max(axis=2)
        z = sets.z
        for marking, (near_z, far_z) in enumerate(self.scene.runway.ends_z_m):
            last = np.minimum(stop[:, marking], above(grid.near[1][:, marking]))
            first = np.maximum(start[:, marking], below(grid.far[0][:, marking]))
            z = _intersection(z, self._distances(sets, last)[0] - near_z, self._distances(sets, first)[1] - far_z)
        return replace(sets, z=z)

    def _distances(self, sets: StateSet, row: Floats) -> tuple[Floats, Floats]:
        """Range of the distance d = F (cos(theta) - t sin(theta)) / (scale R) of the ground at a row, (sets,) each."""
        tangent = tangent_of_row(self.scene.camera, row)
        low, high = scale_ratio(sets, tangent[:, None])
        far, near = reach(sets.theta[:, 0], tangent), reach(sets.theta[:, 1], tangent)
        focal, tiny = self.scene.camera.focal_px, 1 / NO_BOUND
        slow, fast = np.maximum(sets.scale[:, 0] * low[:, 0], tiny), np.maximum(sets.scale[:, 1] * high[:, 0], tiny)
        return focal * np.minimum(near / fast, near / slow), focal * np.maximum(far / slow, far / fast)


@dataclass(frozen=True)
class _Grid:
    """The rows that each set can show: `rows` (sets, n + 1) are borders; row i lies between borders i and i + 1.

    `ratio` bounds R there; `near` and `far` bound the ends of each marking, (sets, markings), px; `crossed` (sets, markings, n + 1) says
    where all states of the set cross the border.
    """

    rows: Rows
    ratio: tuple[Floats, Floats]
    near: tuple[Floats, Floats]
    far: tuple[Floats, Floats]
    crossed: Bits

    @staticmethod
    def of(scene: Scene, sets: StateSet) -> _Grid:
        near, far = (_ends(scene, sets, end) for end in (0, 1))
        first = np.floor(below(far[0].min(axis=1))).astype(np.int64)
        count = int((np.floor(above(near[1].max(axis=1))) - first).max()) + 1
        rows = first[:, None] + np.arange(count + 1)
        ratio = scale_ratio(sets, tangent_of_row(scene.camera, rows))
        border = rows[:, None, :]
        crossed = (border > above(far[1])[..., None]) & (border < below(near[0])[..., None])
        crossed &= (ratio[0] > 0)[:, None, :]
        crossed[..., 0] = crossed[..., -1] = False
        return _Grid(rows, ratio, near, far, crossed)


def _ends(scene: Scene, sets: StateSet, end: int) -> tuple[Floats, Floats]:
    """Range of the row of each marking's near (0) or far (1) end, (sets, markings) each; equal distances are computed once."""
    distances, which = np.unique(scene.runway.ends_z_m[:, end], return_inverse=True)
    low, high = zip(*(end_rows(scene.camera, sets, float(distance)) for distance in distances), strict=True)
    return np.stack(low, axis=1)[:, which], np.stack(high, axis=1)[:, which]


@dataclass(frozen=True)
class _LitColumns:
    """First and last lit column among those a marking could light in a row, (sets, markings, rows); last < first where none is."""

    first: Floats
    last: Floats


def _lit_columns(scene: Scene, canvas: Bits, sets: StateSet, grid: _Grid) -> _LitColumns:
    """Looks the usable columns up in the frame; `canvas` is the frame within a border of lit pixels."""
    across = scene.runway.x_m[:, None] - sets.x[:, None, ::-1]
    slow, fast = sets.scale[:, :1] * grid.ratio[0], sets.scale[:, 1:] * grid.ratio[1]
    low, high = column_range(scene.camera, across, (slow[:, None, :], fast[:, None, :]))
    first = np.floor(below(np.minimum(low[..., :-1], low[..., 1:]))).astype(np.int64)
    last = np.floor(above(np.maximum(high[..., :-1], high[..., 1:]))).astype(np.int64)
    height, width = scene.camera.shape
    row = np.clip(grid.rows[:, None, :-1], -1, height) + 1
    lowest, highest = np.full(first.shape, NO_BOUND), np.full(first.shape, -NO_BOUND)
    for step in range(int((last - first).max()), -1, -1):
        column = first + step
        lit = canvas[row, np.clip(column, -1, width) + 1] & (column <= last)
        lowest = np.where(lit, column, lowest)
        highest = np.where(lit & (highest < 0), column, highest)
    return _LitColumns(lowest, highest)


def _largest_but(values: Floats, count: int) -> Floats:
    """The largest value along the last axis but for `count` larger ones."""
    if count == 0:
        return values.max(axis=-1)
    if count >= values.shape[-1]:
        return np.full(values.shape[:-1], -NO_BOUND)
    return np.partition(values, -count - 1, axis=-1)[..., -count - 1]


def _intersection(interval: Floats, low: Floats, high: Floats) -> Floats:
    return np.stack([np.maximum(interval[:, 0], low), np.minimum(interval[:, 1], high)], axis=-1)


def _quotient(low: Floats, high: Floats, divisor: Floats) -> tuple[Floats, Floats]:
    """Range of [low, high] / divisor (..., 2) where the divisor has one sign; no bound where it has not."""
    near, far = divisor[..., 0], divisor[..., 1]
    usable = near * far > 0
    near, far = np.where(usable, near, 1.0), np.where(usable, far, 1.0)
    corners = np.stack([low / near, low / far, high / near, high / far])
    return np.where(usable, corners.min(axis=0), -NO_BOUND), np.where(usable, corners.max(axis=0), NO_BOUND)


def _cut(sets: StateSet, axis: str, parts: int) -> StateSet:
    """Every set as `parts` sets of equal extent along theta or z; neighbours share their borders to the last bit."""
    which = np.repeat(np.arange(len(sets)), parts)
    interval = getattr(sets, axis)
    edges = interval[:, :1] + (interval[:, 1:] - interval[:, :1]) * (np.arange(parts + 1) / parts)
    edges[:, -1] = interval[:, 1]
    sides = np.stack([edges[:, :-1].ravel(), edges[:, 1:].ravel()], axis=-1)
    return replace(sets[which], **{axis: sides})


def _joined(first: StateSet, second: StateSet) -> StateSet:
    names = ("theta", "x", "y", "z", "scale", "tangent")
    return StateSet(*(np.concatenate([getattr(first, name), getattr(second, name)]) for name in names))


def _carries_a_face(sets: StateSet, pieces: int) -> Bits:
    """True for the `pieces` sets that reach farthest on each side of theta, y and z."""
    chosen = np.zeros(len(sets), dtype=bool)
    for bound in (sets.theta, sets.y, sets.z):
        for values in (bound[:, 0], -bound[:, 1]):
            chosen[np.argsort(values)[:pieces]] = True
    return chosen


def connected_parts(sets: StateSet) -> list[NDArray[np.int64]]:
    """Numbers of the sets in each connected part of their union: parts are joined where boxes (theta, x, y, z) touch."""
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

"""What is proved of one entry: its box of states, O and K hold what they claim, over slices of theta.

For each row, the columns that the entry's states light are enclosed by `build_model.verify.ball_camera`; a slice is halved until the claim
holds in each half or a state refutes it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from flint import arb  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray

from build_model.verify.ball_camera import BallEntry, BallInterval, Ends, Slice, columns, columns_crossed
from build_model.verify.cell_claim import BankClaim
from build_model.verify.counterexample import Counterexample, Refuted
from build_model.window import Bits

ColumnIntervals = list[tuple[float, float]]
"""Intervals [left, right) of columns in one row."""
FINEST_SHARE = 2.0**-44
"""A slice of theta this share of its entry's, or two steps of float64 wide, is not halved again: what is not proved there is refuted."""
NEAR_FACES = (2.0**-30, 1 - 2.0**-30)
"""Where between the least and the greatest altitude of a slice states are tried."""
SEARCH_SHARE = 2.0**-5
"""From slices this share of their entry's on, a state is sought that refutes the claim."""


@dataclass(frozen=True)
class _Seen:
    """A marking as the states of an entry see it: its ends' distances, and the range of X = p_x - x."""

    ends: Ends
    across: BallInterval


class EntryProver:
    """The proofs of one entry, over slices of its theta."""

    def __init__(self, claim: BankClaim, number: int, entry: BallEntry) -> None:
        self.claim, self.number, self.camera = claim, number, entry.camera
        self.line_px = claim.scene.tolerance.line_px
        self.margin = arb("inf")  # the least margin of the bounds that were proved, px
        self.root = Slice(entry, *entry.theta)
        self.markings = self._seen(entry)
        width = self.root.high - self.root.low
        step = max(math.ulp(self.root.low), math.ulp(self.root.high))
        self.search_width, self.finest_width = SEARCH_SHARE * width, max(FINEST_SHARE * width, 2 * step)

    def _seen(self, entry: BallEntry) -> list[_Seen]:
        shared: dict[tuple[float, float], Ends] = {}
        for marking in self.claim.scene.runway.markings:
            near = entry.z[0] + arb(marking.start_z_m), entry.z[1] + arb(marking.start_z_m)
            far = near[0] + arb(marking.length_m), near[1] + arb(marking.length_m)
            shared.setdefault((marking.start_z_m, marking.length_m), Ends(near, far))
        markings = self.claim.scene.runway.markings
        positions = ((shared[marking.start_z_m, marking.length_m], arb(marking.x_m)) for marking in markings)
        return [_Seen(ends, (x_m - entry.x[1], x_m - entry.x[0])) for ends, x_m in positions]

    def _refuted(self, claim: str, pixel: tuple[int, int] | None, state: tuple[float, ...] | None) -> Refuted:
        return Refuted(Counterexample(claim, self.claim.cell, self.number, pixel, state))

    def _some_state(self, part: Slice) -> tuple[float, ...] | None:
        return next(states_of(part), None)

    def check_state_box(self, lower: NDArray[np.float32], upper: NDArray[np.float32]) -> None:
        """The entry's box of states holds every state of the entry. Raises `Refuted`."""
        root, entry = self.root, self.root.entry
        low, high = (side.astype(np.float64).tolist() for side in (lower, upper))
        holds = all(low[axis] <= side[0] and high[axis] >= side[1] for axis, side in ((1, entry.x), (2, root.y), (3, entry.z)))
        holds = holds and (low[0] <= root.low or Slice(entry, root.low, min(low[0], root.high)).empty)
        holds = holds and (high[0] >= root.high or Slice(entry, max(high[0], root.low), root.high).empty)
        if not (holds or root.empty):
            states = itertools.chain.from_iterable(states_of(part) for part in _parts(root, 8))
            outside = (state for state in states if any(not a <= value <= b for a, value, b in zip(low, state, high, strict=True)))
            raise self._refuted("a state of the entry lies outside its box of states", None, next(outside, None))

    def prove_may_light(self, bits: Bits) -> None:
        """O: whatever a state lights lies inside `bits`, with all within `line_px`. Raises `Refuted`."""
        first, stop = self._rows()
        allowed = _allowed_columns(self.claim, bits, first, stop)
        for row, marking in itertools.product(range(first, stop), range(len(self.markings))):
            open_slices = [self.root]
            while open_slices:
                part = open_slices.pop()
                if not (part.empty or self._within(allowed[row - first], part, row, marking)):
                    self._seek_lit_outside(allowed[row - first], part, row, marking)
                    open_slices += part.halves()

    def _rows(self) -> tuple[int, int]:
        """First row that a marking of the entry may show, and the row behind the last, no more than `line_px` out of view."""
        lowest, highest = [], []
        for ends in {seen.ends for seen in self.markings}:
            open_slices = [self.root]
            while open_slices:
                part = open_slices.pop()
                rows = part.rows(ends)
                if rows is not None:
                    lowest.append(math.floor(float(rows[1][0].lower()) - 1))
                    highest.append(math.ceil(float(rows[0][1].upper()) + 1))
                elif not part.empty:
                    if part.high - part.low <= self.finest_width:
                        raise self._refuted("a marking is not certainly in front of the camera", None, self._some_state(part))
                    open_slices += part.halves()
        line_px = self.line_px
        first, stop = max(min(lowest, default=0), -line_px), min(max(highest, default=0), self.claim.scene.camera.height + line_px)
        return first, max(first, stop)

    def _within(self, allowed: ColumnIntervals, part: Slice, row: int, marking: int) -> bool:
        """True if the slice's columns in the row are proved to lie in one of the allowed intervals; keeps the margin."""
        seen = self.markings[marking]
        if part.rows(seen.ends) is None:
            return False
        scales = part.scales_seen_in(row, seen.ends)
        if scales is None:
            return True
        low, high = columns(self.camera, seen.across, scales)
        middle = float(low + high) / 2
        left, right = min(allowed, key=lambda interval: max(interval[0] - middle, middle - interval[1]))
        if not (low >= left and high < right):
            return False
        self.keep_margin(low - left, right - high)
        return True

    def _seek_lit_outside(self, allowed: ColumnIntervals, part: Slice, row: int, marking: int) -> None:
        """Raises `Refuted` if a state of the slice lights a pixel outside the allowed intervals, or if the slice is as narrow as any."""
        width = part.high - part.low
        if width > max(self.search_width, self.finest_width):
            return
        for state in states_of(part):
            point = point_of(part.entry, state)
            seen = self._seen(point.entry)[marking]
            scales = None if point.rows(seen.ends) is None else point.scales_crossed_in(row, seen.ends)
            if scales is None:
                continue
            smaller, greater = columns_crossed(self.camera, seen.across, scales)
            for column in {math.floor(float(side)) for side in (smaller, greater)}:
                lit = smaller < column + 1 and greater > column
                if lit and not any(left <= column < right for left, right in allowed):
                    near = f", with all within {self.line_px} px," if self.line_px else ""
                    raise self._refuted(f"a state of the entry lights a pixel that{near} is not in O", (row, column), state)
        if width <= self.finest_width:
            claim = f"row {row}: what a state of the entry may light is not certainly in O"
            raise self._refuted(claim, None, self._some_state(part))

    def prove_must_light(self, bits: Bits) -> None:
        """K: every state lights each pixel of `bits`. Raises `Refuted`."""
        window = self.claim.window
        for row in np.flatnonzero(bits.any(axis=1)).tolist():
            open_slices = [(self.root, (np.flatnonzero(bits[row]) + window.left).tolist())]
            while open_slices:
                part, pixels = open_slices.pop()
                pixels = [] if part.empty else self._not_certainly_lit(part, row + window.top, pixels)
                if pixels:
                    self._seek_dark(part, row + window.top, pixels)
                    open_slices += ((half, pixels) for half in part.halves())

    def _not_certainly_lit(self, part: Slice, row: int, pixels: list[int]) -> list[int]:
        """Those columns that no marking is proved to light in every state of the slice; keeps the margin of the others."""
        for seen in self.markings:
            scales = None if part.rows(seen.ends) is None else part.scales_crossed_in(row, seen.ends)
            if scales is None:
                continue
            smaller, greater = columns_crossed(self.camera, seen.across, scales)
            lit = [column for column in pixels if smaller < column + 1 and greater > column]
            for column in lit:
                self.keep_margin(column + 1 - smaller, greater - column)
            pixels = [column for column in pixels if column not in lit]
        return pixels

    def _seek_dark(self, part: Slice, row: int, pixels: list[int]) -> None:
        """Raises `Refuted` if a state of the slice leaves one of the pixels dark, or if the slice is as narrow as any."""
        width = part.high - part.low
        if width > max(self.search_width, self.finest_width):
            return
        for state in states_of(part):
            spans = list(self._columns_seen(point_of(part.entry, state), row))
            for column in pixels:
                if all(high < column or low >= column + 1 for low, high in spans):
                    raise self._refuted("a state of the entry does not light a pixel of K", (row, column), state)
        if width <= self.finest_width:
            claim = "a pixel of K is not certainly lit by every state of the entry"
            raise self._refuted(claim, (row, pixels[0]), self._some_state(part))

    def _columns_seen(self, point: Slice, row: int) -> Iterator[BallInterval]:
        """Ranges of columns that hold whatever the markings light in the row in one state."""
        for seen in self._seen(point.entry):
            if point.rows(seen.ends) is None:
                yield arb("-inf"), arb("inf")
            elif (scales := point.scales_seen_in(row, seen.ends)) is not None:
                yield columns(self.camera, seen.across, scales)

    def keep_margin(self, *margins: arb) -> None:
        """Notes by how much a bound was proved, px, if it is the closest so far."""
        for margin in margins:
            if margin < self.margin:
                self.margin = margin


def _allowed_columns(claim: BankClaim, bits: Bits, first: int, stop: int) -> list[ColumnIntervals]:
    """For rows first, ..., stop - 1: the intervals [left, right) of columns where a pixel's neighbourhood, as far as it is in the frame,
    is inside `bits`. One that leaves the frame has an infinite side.
    """
    line_px, window, (height, width) = claim.scene.tolerance.line_px, claim.window, claim.scene.camera.shape
    canvas = np.ones((height + 4 * line_px, width + 4 * line_px), dtype=bool)
    canvas[2 * line_px : 2 * line_px + height, 2 * line_px : 2 * line_px + width] = False
    top, left = window.top + 2 * line_px, window.left + 2 * line_px
    canvas[top : top + bits.shape[0], left : left + bits.shape[1]] = bits
    band, span = canvas[first + line_px : stop + 3 * line_px], 2 * line_px + 1
    rows = np.logical_and.reduce([band[shift : shift + stop - first] for shift in range(span)])
    clear = np.logical_and.reduce([rows[:, shift : shift + width + 2 * line_px] for shift in range(span)])
    steps = np.diff(np.pad(clear, ((0, 0), (1, 1)), constant_values=True).astype(np.int8), axis=1)
    columns_of_rows = []
    for row in steps:
        left, right = ((np.flatnonzero(row == step) - line_px).tolist() for step in (1, -1))
        columns_of_rows.append(list(zip([-math.inf, *left], [*right, math.inf], strict=True)))
    return columns_of_rows


def _parts(root: Slice, count: int) -> Iterator[Slice]:
    """`count` slices of the same width that cover the root."""
    edges = np.linspace(root.low, root.high, count + 1).tolist()
    return (Slice(root.entry, low, high) for low, high in itertools.pairwise(edges))


def states_of(part: Slice) -> Iterator[tuple[float, ...]]:
    """States of the entry at the slice's middle theta: near the faces of its altitudes, at those of its x and z."""
    entry = part.entry
    low, high = (float(side) for side in Slice(entry, part.middle, part.middle).y)
    if not low < high:
        return
    altitudes = (low + share * (high - low) for share in (0.5, *NEAR_FACES))
    lateral, ahead = ({float(side) for side in sides} for sides in (entry.x, entry.z))
    for y, x, z in itertools.product(altitudes, lateral, ahead):
        yield part.middle, x, y, z


def point_of(entry: BallEntry, state: tuple[float, ...]) -> Slice:
    """One state as a slice: every range is that of a single number."""
    theta, x, y, z = state[0], *(arb(value) for value in state[1:])
    scale = entry.camera.focal_u_px * entry.camera.ray(theta, entry.reference_row)[0] / y
    single = replace(entry, theta=(theta, theta), x=(x, x), y=(y, y), z=(z, z), scale=(scale, scale))
    return Slice(single, theta, theta)

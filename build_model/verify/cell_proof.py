"""What is proved of one cell: its entries cover it, and S, O, K and the entries' boxes hold what they claim.

For each entry and each row, the columns that its states light are enclosed by `build_model.verify.ball_camera` over slices of theta, halved
until the claim holds in each or a state refutes it:

    O  the image of every state, widened by the tolerance and clipped to the frame, is inside O; and O is inside S
    K  every state of the entry lights each of its pixels, by a marking that may be another one in another slice

As the entries cover the cell, S then contains whatever any state of the cell lights. A point of a marking just out of view counts
in the widening, as a camera that is off by its calibration can show it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray

from build_model.pixel_mask import Bits, Window
from build_model.verify.ball_camera import PRECISION_BITS, BallCamera, BallEntry, Ends, Range, Slice, columns, columns_crossed
from runtime.scene import STATE_NAMES, Scene

Runs = list[tuple[float, float]]
"""Intervals [left, right) of columns in one row."""
PADDING_SIZE = 2**20
"""|K| that marks a place in the tables as padding: more pixels than a window can hold lit."""
FINEST_SHARE = 2.0**-44
"""A slice of theta this share of its entry's, or two steps of float64 wide, is not halved again: what is not proved there is refuted."""
NEAR_FACES = (2.0**-30, 1 - 2.0**-30)
"""Where between the least and the greatest altitude of a slice states are tried."""
SEARCH_SHARE = 2.0**-5
"""From slices this share of their entry's on, a state is sought that refutes the claim."""


@dataclass(frozen=True)
class Counterexample:
    """The first claim that does not hold: where, and a state that shows it, [theta, x, y, z] in rad and m."""

    claim: str
    cell: int | None = None
    entry: int | None = None
    pixel: tuple[int, int] | None = None
    """(row, column)."""
    state: tuple[float, ...] | None = None

    def __str__(self) -> str:
        """One line."""
        parts = [self.claim]
        if self.cell is not None:
            parts.append(f"cell {self.cell}")
        if self.entry is not None:
            parts.append(f"entry {self.entry}")
        if self.pixel is not None:
            parts.append(f"pixel (row {self.pixel[0]}, column {self.pixel[1]})")
        if self.state is not None:
            parts.append("state " + ", ".join(f"{name} {value!r}" for name, value in zip(STATE_NAMES, self.state, strict=True)))
        return "; ".join(parts)


class Refuted(Exception):  # noqa: N818 - it reports what the file is, not an error
    """Carries a counterexample to where it is reported."""

    def __init__(self, counterexample: Counterexample) -> None:
        super().__init__(str(counterexample))
        self.counterexample = counterexample


def demand(holds: bool, claim: str, cell: int | None = None, entry: int | None = None) -> None:
    """Raises `Refuted` with the claim that does not hold."""
    if not holds:
        raise Refuted(Counterexample(claim, cell, entry))


@dataclass(frozen=True)
class MaskRuns:
    """Masks of a cell as the model's look-ups: both (runs, masks), flat indices into the (rows + 1, columns) sums down the window's
    columns. `folded`: the sums are those of the window folded along its middle, so that a mask has each pixel's mirror image too.
    """

    start: NDArray[np.int32]
    stop: NDArray[np.int32]
    folded: bool

    def bits(self, window: Window, cell: int, name: str) -> Bits:
        """The masks, (masks, rows, columns). Raises `Refuted` unless each look-up counts a run of its own down one column."""
        rows, columns = window.shape
        across = columns // 2 if self.folded else columns
        run, mask = np.nonzero(self.start != self.stop)
        start, stop = self.start[run, mask].astype(np.int64), self.stop[run, mask].astype(np.int64)
        inside = (start >= 0) & (stop > start) & (stop < (rows + 1) * across) & (start % across == stop % across)
        if not inside.all():
            demand(False, f"{name}: an index does not count a run of pixels down one column", cell, int(mask[~inside][0]))
        counts = np.zeros((self.start.shape[1], rows + 1, across), dtype=np.int32)
        np.add.at(counts, (mask, start // across, start % across), 1)
        np.subtract.at(counts, (mask, stop // across, stop % across), 1)
        counts = np.cumsum(counts, axis=1)[:, :-1]
        if counts.max(initial=0) > 1:
            demand(False, f"{name}: a pixel is counted twice", cell, int(np.argwhere(counts > 1)[0, 0]))
        return np.concatenate([counts, counts[..., ::-1]], axis=2) > 0 if self.folded else counts > 0


@dataclass(frozen=True)
class PaintedRuns:
    """A cell's S as it is painted: `step` is added at the flat pixel `index` of the window and summed down the columns."""

    index: NDArray[np.int32]
    step: NDArray[np.int32]

    def cover(self, window: Window, cell: int) -> NDArray[np.int64]:
        """What is painted on each pixel, (rows, columns). Raises `Refuted` for an index outside the window."""
        inside = (self.index >= 0) & (self.index < math.prod(window.shape))
        demand(bool(inside.all()), "S as painted: an index lies outside the window", cell)
        steps = np.zeros(math.prod(window.shape), dtype=np.int64)
        np.add.at(steps, self.index, self.step)
        return np.cumsum(steps.reshape(window.shape), axis=0)


@dataclass(frozen=True)
class CellClaim:
    """What the model states of one cell: box [lower, upper] (4,), and its entries' boxes, masks and sizes as the file has them."""

    scene: Scene
    cell: int
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    window: Window
    spatial: MaskRuns
    painted: PaintedRuns
    must_light: MaskRuns
    may_light: MaskRuns
    must_light_size: NDArray[np.int32]
    line_lower: NDArray[np.float64]
    line_upper: NDArray[np.float64]
    reference_row: NDArray[np.float64]
    state_lower: NDArray[np.float32]
    state_upper: NDArray[np.float32]


@dataclass
class CellProof:
    """What was proved of a cell: numbers of entries and of pixels in S, all O, all K, and the least margin of a column's bound, px."""

    entries: int = 0
    spatial_pixels: int = 0
    may_light_pixels: int = 0
    must_light_pixels: int = 0
    margin_px: float = field(default=float("inf"))


def prove_cell(claim: CellClaim) -> CellProof | Counterexample:
    """Proves all of a cell's claims, or returns the first that does not hold."""
    with ctx.workprec(PRECISION_BITS):
        try:
            return _CellProver(claim).prove()
        except Refuted as refuted:
            return refuted.counterexample


class _CellProver:
    """One cell's masks, decoded, and the camera they are judged by."""

    def __init__(self, claim: CellClaim) -> None:
        self.claim, self.scene = claim, claim.scene
        self.camera = BallCamera(claim.scene.camera)
        self.reach_px = claim.scene.tolerance.line_px
        self.spatial = claim.spatial.bits(claim.window, claim.cell, "S")[0]
        self.must_light = claim.must_light.bits(claim.window, claim.cell, "K")
        self.may_light = claim.may_light.bits(claim.window, claim.cell, "O")
        self.proof = CellProof(spatial_pixels=int(self.spatial.sum()))
        self.margin = arb("inf")

    def prove(self) -> CellProof:
        """All claims, the cheap ones first. Raises `Refuted`."""
        entries = np.flatnonzero(self.claim.must_light_size != PADDING_SIZE)
        self._check_masks()
        self._check_cover(entries)
        for entry in entries.tolist():
            self._prove_entry(entry)
        self.proof.entries = len(entries)
        self.proof.may_light_pixels, self.proof.must_light_pixels = int(self.may_light.sum()), int(self.must_light.sum())
        self.proof.margin_px = float(self.margin.lower())
        return self.proof

    def _check_masks(self) -> None:
        """|K| is what is stated and exceeds the budget, padding never passes, O is inside S, K keeps its witnesses in the window.

        And what is painted of the cell in the filtered frame is S.
        """
        painted = self.claim.painted.cover(self.claim.window, self.claim.cell)
        demand(bool((painted == self.spatial).all()), "S as painted is not S as counted", self.claim.cell)
        claim, missed = self.claim, self.scene.tolerance.missed_budget
        padding = claim.must_light_size == PADDING_SIZE
        sizes = self.must_light.sum(axis=(1, 2))
        inner = self.must_light.copy()
        if self.reach_px > 0:
            inner[:, self.reach_px : -self.reach_px, self.reach_px : -self.reach_px] = False
        else:
            inner[:] = False
        faults = {
            "must_light_size is not |K|": ~padding & (sizes != claim.must_light_size),
            "padding could be the least mismatch": padding & (2 * sizes.max() + self.spatial.sum() >= PADDING_SIZE),
            f"|K| does not exceed the missed budget {missed}": ~padding & (sizes <= missed),
            "O has a pixel outside S": (self.may_light & ~self.spatial).any(axis=(1, 2)),
            "K has a pixel within line_px of the window's border": inner.any(axis=(1, 2)),
        }
        for text, where in faults.items():
            demand(not where.any(), text, claim.cell, int(where.argmax()))

    def _check_cover(self, entries: NDArray[np.int64]) -> None:
        """Every state of the cell is in an entry: the boxes tile theta, x and z, and where they do their scales cover g's range."""
        claim, axes = self.claim, (0, 1, 3)
        lower, upper = claim.line_lower[entries], claim.line_upper[entries]
        for sides in itertools.product(*(_elementary(claim, lower, upper, axis) for axis in axes)):
            covers = np.ones(len(entries), dtype=bool)
            for axis, (low, high) in zip(axes, sides, strict=True):
                covers &= (lower[:, axis] <= low) & (upper[:, axis] >= high)
            rows = np.unique(claim.reference_row[entries[covers]])
            if not any(self._scales_cover(sides[0], row, entries[covers & (claim.reference_row[entries] == row)]) for row in rows):
                theta, x, z = ((low + high) / 2 for low, high in sides)
                state = self._uncovered(sides[0], float(theta), entries[covers])
                found = (state[0], float(x), state[1], float(z))
                raise Refuted(Counterexample("the entries do not cover the cell", claim.cell, state=found))

    def _scales_cover(self, theta: tuple[float, float], row: float, entries: NDArray[np.int64]) -> bool:
        """True if every g at `row` that theta and the cell's altitudes allow lies in an entry's bin."""
        fall = self.camera.fall_range(*theta, row)
        lowest = self.camera.focal_px * fall[0] / arb(self.claim.upper[2])
        highest = self.camera.focal_px * fall[1] / arb(self.claim.lower[2])
        if not lowest > 0:
            return False
        reached = lowest
        for low, high in sorted(zip(self.claim.line_lower[entries, 2].tolist(), self.claim.line_upper[entries, 2].tolist(), strict=True)):
            if reached >= low and reached < high:
                reached = arb(high)
        return bool(reached >= highest)

    def _uncovered(self, theta: tuple[float, float], middle: float, entries: NDArray[np.int64]) -> tuple[float, float]:
        """A theta and an altitude of the cell in no bin of the given entries; the middle if a search finds none."""
        altitudes = np.linspace(self.claim.lower[2], self.claim.upper[2], 65).tolist()
        for angle, y in itertools.product((middle, *theta), altitudes):
            scales = (self._scale(angle, y, float(row)) for row in self.claim.reference_row[entries])
            bins = zip(scales, self.claim.line_lower[entries, 2].tolist(), self.claim.line_upper[entries, 2].tolist(), strict=True)
            if all(scale < low or scale > high for scale, low, high in bins):
                return angle, y
        return middle, float((self.claim.lower[2] + self.claim.upper[2]) / 2)

    def _scale(self, theta: float, y: float, row: float) -> arb:
        return self.camera.focal_px * self.camera.ray(theta, row)[0] / arb(y)

    def _prove_entry(self, number: int) -> None:
        """The state box, O and K of one entry."""
        entry = self._entry(number)
        if entry is None:
            return
        prover = _EntryProver(self, number, entry)
        prover.check_state_box(self.claim.state_lower[number], self.claim.state_upper[number])
        prover.prove_may_light(self.may_light[number])
        prover.prove_must_light(self.must_light[number])

    def _entry(self, number: int) -> BallEntry | None:
        """The entry as a set of states; None if its box misses the cell altogether."""
        claim = self.claim
        theta, x, z = (
            (max(claim.line_lower[number, axis], claim.lower[axis]), min(claim.line_upper[number, axis], claim.upper[axis]))
            for axis in (0, 1, 3)
        )
        if any(low > high for low, high in (theta, x, z)):
            return None
        return BallEntry(
            camera=self.camera,
            theta=(float(theta[0]), float(theta[1])),
            x=(arb(x[0]), arb(x[1])),
            y=(arb(claim.lower[2]), arb(claim.upper[2])),
            z=(arb(z[0]), arb(z[1])),
            scale=(arb(claim.line_lower[number, 2]), arb(claim.line_upper[number, 2])),
            reference_row=float(claim.reference_row[number]),
        )

    def allowed_runs(self, bits: Bits, first: int, stop: int) -> list[Runs]:
        """For rows first, ..., stop - 1: the runs [left, right) of columns where a pixel's neighbourhood, as far as it is in the frame,
        is inside `bits`. A run that leaves the frame has an infinite side.
        """
        reach, window, (height, width) = self.reach_px, self.claim.window, self.scene.camera.shape
        canvas = np.ones((height + 4 * reach, width + 4 * reach), dtype=bool)
        canvas[2 * reach : 2 * reach + height, 2 * reach : 2 * reach + width] = False
        top, left = window.top + 2 * reach, window.left + 2 * reach
        canvas[top : top + bits.shape[0], left : left + bits.shape[1]] = bits
        band, span = canvas[first + reach : stop + 3 * reach], 2 * reach + 1
        rows = np.logical_and.reduce([band[shift : shift + stop - first] for shift in range(span)])
        allowed = np.logical_and.reduce([rows[:, shift : shift + width + 2 * reach] for shift in range(span)])
        steps = np.diff(np.pad(allowed, ((0, 0), (1, 1)), constant_values=True).astype(np.int8), axis=1)
        runs = []
        for row in steps:
            left, right = ((np.flatnonzero(row == step) - reach).tolist() for step in (1, -1))
            runs.append(list(zip([-math.inf, *left], [*right, math.inf], strict=True)))
        return runs

    def keep_margin(self, *margins: arb) -> None:
        """Remembers the least margin of all bounds that were proved."""
        for margin in margins:
            if margin < self.margin:
                self.margin = margin


@dataclass(frozen=True)
class _Seen:
    """A marking as the states of an entry see it: its ends' distances, and the range of X = p_x - x."""

    ends: Ends
    across: Range


class _EntryProver:
    """The proofs of one entry, over slices of its theta."""

    def __init__(self, cell: _CellProver, number: int, entry: BallEntry) -> None:
        self.cell, self.camera = cell, cell.camera
        self.number = number
        self.root = Slice(entry, *entry.theta)
        self.markings = self._seen(entry)
        width = self.root.high - self.root.low
        step = max(math.ulp(self.root.low), math.ulp(self.root.high))
        self.search_width, self.finest_width = SEARCH_SHARE * width, max(FINEST_SHARE * width, 2 * step)

    def _seen(self, entry: BallEntry) -> list[_Seen]:
        shared: dict[tuple[float, float], Ends] = {}
        for marking in self.cell.scene.runway.markings:
            near = entry.z[0] + arb(marking.start_z_m), entry.z[1] + arb(marking.start_z_m)
            far = near[0] + arb(marking.length_m), near[1] + arb(marking.length_m)
            shared.setdefault((marking.start_z_m, marking.length_m), Ends(near, far))
        markings = self.cell.scene.runway.markings
        positions = ((shared[marking.start_z_m, marking.length_m], arb(marking.x_m)) for marking in markings)
        return [_Seen(ends, (x_m - entry.x[1], x_m - entry.x[0])) for ends, x_m in positions]

    def _refuted(self, claim: str, pixel: tuple[int, int] | None, state: tuple[float, ...] | None) -> Refuted:
        return Refuted(Counterexample(claim, self.cell.claim.cell, self.number, pixel, state))

    def _some_state(self, part: Slice) -> tuple[float, ...] | None:
        return next(_states(part), None)

    def check_state_box(self, lower: NDArray[np.float32], upper: NDArray[np.float32]) -> None:
        """The entry's box of states holds every state of the entry. Raises `Refuted`."""
        root, entry = self.root, self.root.entry
        low, high = (side.astype(np.float64).tolist() for side in (lower, upper))
        holds = all(low[axis] <= side[0] and high[axis] >= side[1] for axis, side in ((1, entry.x), (2, root.y), (3, entry.z)))
        holds = holds and (low[0] <= root.low or Slice(entry, root.low, min(low[0], root.high)).empty)
        holds = holds and (high[0] >= root.high or Slice(entry, max(high[0], root.low), root.high).empty)
        if not (holds or root.empty):
            states = itertools.chain.from_iterable(_states(part) for part in _parts(root, 8))
            outside = (state for state in states if any(not a <= value <= b for a, value, b in zip(low, state, high, strict=True)))
            raise self._refuted("a state of the entry lies outside its box of states", None, next(outside, None))

    def prove_may_light(self, bits: Bits) -> None:
        """O: whatever a state lights lies inside `bits`, with all within `line_px`. Raises `Refuted`."""
        first, stop = self._rows()
        runs = self.cell.allowed_runs(bits, first, stop)
        for row, marking in itertools.product(range(first, stop), range(len(self.markings))):
            open_slices = [self.root]
            while open_slices:
                part = open_slices.pop()
                if not (part.empty or self._within(runs[row - first], part, row, marking)):
                    self._seek_lit_outside(runs[row - first], part, row, marking)
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
        reach = self.cell.reach_px
        first, stop = max(min(lowest, default=0), -reach), min(max(highest, default=0), self.cell.scene.camera.height + reach)
        return first, max(first, stop)

    def _within(self, runs: Runs, part: Slice, row: int, marking: int) -> bool:
        """True if the slice's columns in the row are proved to lie in one of the runs; keeps the margin."""
        seen = self.markings[marking]
        if part.rows(seen.ends) is None:
            return False
        scales = part.scales_seen_in(row, seen.ends)
        if scales is None:
            return True
        low, high = columns(self.camera, seen.across, scales)
        middle = float(low + high) / 2
        left, right = min(runs, key=lambda run: max(run[0] - middle, middle - run[1]))
        if not (low >= left and high < right):
            return False
        self.cell.keep_margin(low - left, right - high)
        return True

    def _seek_lit_outside(self, runs: Runs, part: Slice, row: int, marking: int) -> None:
        """Raises `Refuted` if a state of the slice lights a pixel outside the runs, or if the slice is as narrow as any."""
        width = part.high - part.low
        if width > max(self.search_width, self.finest_width):
            return
        for state in _states(part):
            point = _point(part.entry, state)
            seen = self._seen(point.entry)[marking]
            scales = None if point.rows(seen.ends) is None else point.scales_crossed_in(row, seen.ends)
            if scales is None:
                continue
            smaller, greater = columns_crossed(self.camera, seen.across, scales)
            for column in {math.floor(float(side)) for side in (smaller, greater)}:
                lit = smaller < column + 1 and greater > column
                if lit and not any(left <= column < right for left, right in runs):
                    near = f", with all within {self.cell.reach_px} px," if self.cell.reach_px else ""
                    raise self._refuted(f"a state of the entry lights a pixel that{near} is not in O", (row, column), state)
        if width <= self.finest_width:
            claim = f"row {row}: what a state of the entry may light is not certainly in O"
            raise self._refuted(claim, None, self._some_state(part))

    def prove_must_light(self, bits: Bits) -> None:
        """K: every state lights each pixel of `bits`. Raises `Refuted`."""
        window = self.cell.claim.window
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
                self.cell.keep_margin(column + 1 - smaller, greater - column)
            pixels = [column for column in pixels if column not in lit]
        return pixels

    def _seek_dark(self, part: Slice, row: int, pixels: list[int]) -> None:
        """Raises `Refuted` if a state of the slice leaves one of the pixels dark, or if the slice is as narrow as any."""
        width = part.high - part.low
        if width > max(self.search_width, self.finest_width):
            return
        for state in _states(part):
            spans = list(self._columns_seen(_point(part.entry, state), row))
            for column in pixels:
                if all(high < column or low >= column + 1 for low, high in spans):
                    raise self._refuted("a state of the entry does not light a pixel of K", (row, column), state)
        if width <= self.finest_width:
            claim = "a pixel of K is not certainly lit by every state of the entry"
            raise self._refuted(claim, (row, pixels[0]), self._some_state(part))

    def _columns_seen(self, point: Slice, row: int) -> Iterator[Range]:
        """Ranges of columns that hold whatever the markings light in the row in one state."""
        for seen in self._seen(point.entry):
            if point.rows(seen.ends) is None:
                yield arb("-inf"), arb("inf")
            elif (scales := point.scales_seen_in(row, seen.ends)) is not None:
                yield columns(self.camera, seen.across, scales)


def _elementary(claim: CellClaim, lower: NDArray[np.float64], upper: NDArray[np.float64], axis: int) -> list[tuple[float, float]]:
    """The cell's interval of an axis, cut at every border of a box; one interval of width 0 if the axis is fixed."""
    low, high = float(claim.lower[axis]), float(claim.upper[axis])
    borders = np.concatenate([lower[:, axis], upper[:, axis]])
    inner = np.unique(borders[(borders > low) & (borders < high)]).tolist()
    return list(itertools.pairwise([low, *inner, high]))


def _parts(root: Slice, count: int) -> Iterator[Slice]:
    """`count` slices of the same width that cover the root."""
    edges = np.linspace(root.low, root.high, count + 1).tolist()
    return (Slice(root.entry, low, high) for low, high in itertools.pairwise(edges))


def _states(part: Slice) -> Iterator[tuple[float, ...]]:
    """States of the entry at the slice's middle theta: near the faces of its altitudes, at those of its x and z."""
    entry = part.entry
    low, high = (float(side) for side in Slice(entry, part.middle, part.middle).y)
    if not low < high:
        return
    altitudes = (low + share * (high - low) for share in (0.5, *NEAR_FACES))
    lateral, ahead = ({float(side) for side in sides} for sides in (entry.x, entry.z))
    for y, x, z in itertools.product(altitudes, lateral, ahead):
        yield part.middle, x, y, z


def _point(entry: BallEntry, state: tuple[float, ...]) -> Slice:
    """One state as a slice: every range is that of a single number."""
    theta, x, y, z = state[0], *(arb(value) for value in state[1:])
    scale = entry.camera.focal_px * entry.camera.ray(theta, entry.reference_row)[0] / y
    single = replace(entry, theta=(theta, theta), x=(x, x), y=(y, y), z=(z, z), scale=(scale, scale))
    return Slice(single, theta, theta)

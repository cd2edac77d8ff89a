"""A bank for a whole approach: entries that move the image by tens of px, tested by must-hit windows.

A bank of masks asks of an entry that it move a line by less than a pixel, so it grows with every free axis as (range / pixel). A window
asks less. If all states of a set cross the border between two rows of pixels with a marking, each lights, in one column of

    the border's window: every column in which the marking of some state of the set meets it

the pixel above the border and one below it: the one beneath, or beside that if the marking goes through a pixel's corner. So

    J(r) = I(r - 1) and (I(r), or I(r) a column to the left or to the right)

is lit in the window, however wide that is, and far sparser than I under clutter. A window in which the frame lights nothing of J costs each
state of the set a missed pixel, in one of its two rows; windows of a set that have no pixel of these rows in common cost one each. If more
are dark than `missed_budget`, no state of the set is consistent with the frame. Many borders, each of which must show something, are strong
evidence even where each window is wide; `bank.rows` of them, spread over those that can be used, do.

Entries come in *groups*, the parts that one box in line coordinates is halved into. A group has windows of its own, which hold for all
of its states: the *gate*. Only a group that passes its gate need be looked at further.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from build_model.enclosure import columns_at_borders
from build_model.line_boxes import HALVING_ORDER, HALVINGS, MOST_WEAK, LineBoxes
from build_model.spatial_filter import FEW_CELLS, reference_row, sliced, spatial_spans
from build_model.window import Bits
from runtime.camera import row_of_point
from runtime.model.limits import SCALE_STEP, SMALLEST_LEVER_M
from runtime.rounding import float32_above, float32_below, inverted
from runtime.scene import STATE_NAMES, Scene, SceneError, WindowedBank
from runtime.state_set import StateSet, contract, scale_range, tangent_of_row

WIDEST_WINDOW = 255
"""A wider window is not used: it says next to nothing, and the file keeps widths as bytes."""
ROWS_A_STEP = 3
"""An entry moves the image by no more than this part of the rows that the runway spans: rows that all of its states cross must remain."""
FINEST_PX = 1.0
"""Steps are no smaller, however few rows the runway spans."""
HALVED_AXES = 3
"""A group is halved along as many line coordinates, the scale first, into its entries."""
MOST_AT_ONCE = 2**19
"""Columns of markings at borders that are bounded at once, about: memory is bounded."""
MOST_GROUPS = 2**16
"""Groups of a cell; the scene that asks for more is refused."""

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Windows:
    """Windows of sets, (sets, places) each: the border, which lies above the row of its number, the first and the last column.

    An unused place has last < first.
    """

    border: Integers
    first: Integers
    last: Integers

    def __len__(self) -> int:
        return len(self.border)

    def __getitem__(self, chosen: NDArray[np.bool_] | Integers) -> Windows:
        return Windows(self.border[chosen], self.first[chosen], self.last[chosen])

    @staticmethod
    def joined(parts: list[Windows]) -> Windows:
        """The windows of all sets in one batch."""
        return Windows(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("border", "first", "last")))

    @property
    def sizes(self) -> Integers:
        """Number of each set's windows, (sets,)."""
        return (self.first <= self.last).sum(axis=1)


@dataclass(frozen=True)
class Spans:
    """S of a cell, row by row: first and last column of each marking, (markings, height) each; none where last < first."""

    first: Integers
    last: Integers
    unseen: Bits | None = None
    """Pixels of the frame that are lit in any, and so in no window, (height, width)."""

    @property
    def pixels(self) -> int:
        """Pixels of S; those that two markings share count for each."""
        return int(np.maximum(self.last - self.first + 1, 0).sum())


@dataclass(frozen=True)
class CellWindows:
    """One cell's share of NN_F: `parts` entries a group, entry k of group g at [g, k].

    `lines` holds all boxes, group by group. Where `exists` is False no state of the cell lies in the box. `state_lower` and
    `state_upper` (groups, parts, 4) float32 hold each entry in state coordinates, rounded outward.
    """

    lines: LineBoxes
    exists: NDArray[np.bool_]
    gate: Windows
    windows: Windows
    spans: Spans
    state_lower: NDArray[np.float32]
    state_upper: NDArray[np.float32]

    def __len__(self) -> int:
        return int(self.exists.sum())

    @property
    def spatial_pixels(self) -> int:
        """Pixels of S."""
        return self.spans.pixels


def windowed_bank(scene: Scene) -> WindowedBank:
    """The scene's bank, which is one of windows."""
    assert isinstance(scene.bank, WindowedBank)
    return scene.bank


def cell_windows(
    scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], unseen: Bits | None = None, boxes: LineBoxes | None = None
) -> CellWindows:
    """Groups, entries, windows and S of the cell [lower, upper], both (4,). Pixels lit in any frame, (height, width), are in no window.

    `boxes`: of some of its `group_boxes` alone.

    A group that would pass on any frame, since it or one of its entries has no more windows than `missed_budget`, is halved until its
    parts are stronger. Raises `SceneError` where `HALVINGS` do not get there.
    """
    spans, missed = _spans(scene, lower, upper, unseen), scene.tolerance.missed_budget
    parts = [_groups(scene, group_boxes(scene, lower, upper) if boxes is None else boxes, lower, upper, spans)]
    for halving in range(HALVINGS):
        weak = parts[-1].weak(missed)
        if not 0 < weak.sum() <= MOST_WEAK:
            break
        halves = parts[-1].lines[weak].halved(HALVING_ORDER[halving % len(HALVING_ORDER)])
        parts[-1:] = [parts[-1][~weak], _groups(scene, halves, lower, upper, spans)]
    _demand_strong(parts[-1], missed)
    exists, state_lower, state_upper = (np.concatenate([getattr(part, name) for part in parts]) for name in ("exists", "lower", "upper"))
    return CellWindows(
        lines=LineBoxes.joined([part.entries for part in parts]),
        exists=exists,
        gate=Windows.joined([part.gate for part in parts]),
        windows=Windows.joined([part.windows for part in parts]),
        spans=spans,
        state_lower=float32_below(state_lower),
        state_upper=float32_above(state_upper),
    )


@dataclass(frozen=True)
class _Groups:
    """Groups with their entries: `lines` one a group, `entries` and `windows` one an entry, `exists` and bounds (groups, parts)."""

    lines: LineBoxes
    gate: Windows
    entries: LineBoxes
    exists: NDArray[np.bool_]
    windows: Windows
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> _Groups:
        each = np.repeat(chosen, self.exists.shape[1])
        of_entries = self.entries[each], self.exists[chosen], self.windows[each], self.lower[chosen], self.upper[chosen]
        return _Groups(self.lines[chosen], self.gate[chosen], *of_entries)

    def weakest(self) -> Integers:
        """The least number of windows that a group or one of its entries has, (groups,)."""
        sizes = self.windows.sizes.reshape(self.exists.shape)
        return np.minimum(self.gate.sizes, np.where(self.exists, sizes, np.iinfo(np.int64).max).min(axis=1))

    def weak(self, missed_budget: int) -> NDArray[np.bool_]:
        """True for groups that would pass on any frame, (groups,)."""
        return self.weakest() <= missed_budget


def halved_axes(scene: Scene) -> tuple[str, ...]:
    """The line coordinates that a group is halved along into its entries: the first few that are free."""
    fixed = [name for name, is_fixed in zip(STATE_NAMES, scene.domain.fixed, strict=True) if is_fixed]
    return tuple(axis for axis in ("scale", "theta", "x", "z") if axis not in fixed)[:HALVED_AXES]


def group_boxes(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> LineBoxes:
    """Boxes that together cover the cell [lower, upper], both (4,): bins of theta, z, x and the scale that move the image by a step each.

    The step is `set_px`, or less where the runway spans few rows; twice as much along an axis that the group is halved along.
    """
    boxes = []
    for theta, z, row, lateral, scales in _columns_of_boxes(scene, lower, upper):
        boxes += [(theta, x, bin_, z, row) for x in lateral for bin_ in scales]
        _demand_few(scene, len(boxes))
    sides = np.array([[theta, x, scale, z] for theta, x, scale, z, _ in boxes])
    return LineBoxes(sides[:, :, 0], sides[:, :, 1], np.array([row for *_, row in boxes]))


def group_count(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], most: int = MOST_GROUPS) -> int:
    """Number of the cell's `group_boxes`, without making them; any number above `most` if they are more."""
    count = 0
    for _, _, _, lateral, scales in _columns_of_boxes(scene, lower, upper):
        count += len(lateral) * len(scales)
        if count > most:
            break
    return count


def _columns_of_boxes(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> Iterator[tuple[Any, Any, float, Any, Any]]:
    """For each bin of theta and z of a cell: both, (2,) each, the reference row, and bins of x and of the scale, (bins, 2) each."""
    step = step_px(scene, lower, upper)
    steps = {axis: 2 * step if axis in halved_axes(scene) else step for axis in ("theta", "x", "scale", "z")}
    camera, near_m = scene.camera, scene.runway.ends_z_m.min()
    moved_by_z = camera.focal_v_px * upper[2] * (1 / (lower[3] + near_m) - 1 / (upper[3] + near_m))
    z_bins, theta_bins = _bins(moved_by_z, steps["z"]), _bins(camera.focal_v_px * (upper[0] - lower[0]), steps["theta"])
    _demand_few(scene, theta_bins * z_bins)
    for theta, z in itertools.product(sliced(lower[0], upper[0], theta_bins), sliced(lower[3], upper[3], z_bins)):
        low, high = lower.copy(), upper.copy()
        (low[0], high[0]), (low[3], high[3]) = theta, z
        row = reference_row(camera, low, high, near_m, FEW_CELLS)
        scale = np.array(scale_range(camera, theta, np.array([lower[2], upper[2]]), tangent_of_row(camera, row)))
        x_bins = _bins((upper[1] - lower[1]) * scale.mean(), steps["x"])
        below_horizon_px = row - (camera.v0 - camera.focal_v_px * math.tan(theta.mean()))
        scales = _scale_bins(scene, scale, steps["scale"], below_horizon_px)
        _demand_few(scene, x_bins * len(scales))
        yield theta, z, row, sliced(lower[1], upper[1], x_bins), scales


def step_px(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> float:
    """How far an entry of the cell may move the image along each line coordinate, px."""
    theta, _, y, _ = (lower + upper) / 2
    near, far = (row_of_point(scene.camera, theta, y, upper[3] + end) for end in scene.runway.ends_z_m.T)
    return min(windowed_bank(scene).set_px, max(float((near - far).max()) / ROWS_A_STEP, FINEST_PX))


def _demand_few(scene: Scene, groups: int) -> None:
    if groups > MOST_GROUPS:
        set_px, most = windowed_bank(scene).set_px, f"more than the {MOST_GROUPS} that are built"
        raise SceneError(f"bank.set_px: found {set_px}, with which a cell has {groups} groups or more, {most}; give more, or smaller cells")


def _bins(moved_px: float, step: float) -> int:
    return max(1, math.ceil(moved_px / step))


def _scale_bins(scene: Scene, scale: NDArray[np.float64], step: float, below_horizon_px: float) -> NDArray[np.float64]:
    """Intervals that cover the scales `scale` (2,), above 0: (bins, 2), growing by a ratio that moves near rows and columns by a step."""
    lever_m = max(float(np.abs(scene.runway.x_m).max()), SMALLEST_LEVER_M)
    share = step / max(lever_m * scale.mean(), below_horizon_px)
    bins = _bins(math.log(scale[1] / scale[0]), share)
    _demand_few(scene, bins)
    edges = np.round(np.geomspace(scale[0], scale[1], bins + 1) / SCALE_STEP) * SCALE_STEP
    edges[0], edges[-1] = edges[0] - SCALE_STEP, edges[-1] + SCALE_STEP
    edges[0] = max(
        edges[0], 2.0 ** (math.frexp(scale[0])[1] - 2)
    )  # a quarter to a half of the smallest scale, where the edge is 0 or below
    edges = np.unique(edges)
    return np.stack([edges[:-1], edges[1:]], axis=-1)


def _groups(scene: Scene, lines: LineBoxes, lower: NDArray[np.float64], upper: NDArray[np.float64], spans: Spans) -> _Groups:
    """The groups of these boxes, without those that are proved to have no state, with their entries."""
    states = contract(scene.camera, lines.states(scene.camera, lower, upper))
    kept = ~_without_states(states)
    lines, states = lines[kept], states[kept]
    entries, groups = lines, len(lines)
    for axis in halved_axes(scene):
        entries = entries.halved(axis)
    entries = entries[np.arange(len(entries)).reshape(-1, groups).T.ravel()]
    parts = contract(scene.camera, entries.states(scene.camera, lower, upper))
    exists = ~_without_states(parts)
    windows = must_hit_windows(scene, parts, spans)
    windows = Windows(windows.border, windows.first, np.where(exists[:, None], windows.last, windows.first - 1))
    shape = groups, -1
    bounds = (np.where(exists[:, None], side, 0).reshape(*shape, 4) for side in (parts.lower, parts.upper))
    return _Groups(lines, must_hit_windows(scene, states, spans), entries, exists.reshape(shape), windows, *bounds)


def _without_states(sets: StateSet) -> Bits:
    """True for sets that are proved to have no state."""
    return inverted(*sets.theta.T) | inverted(*sets.y.T)


def sets_at_once(scene: Scene) -> int:
    """How many sets' columns are bounded at once."""
    return max(MOST_AT_ONCE // (len(scene.runway.markings) * scene.camera.height), 1)


def must_hit_windows(scene: Scene, sets: StateSet, spans: Spans) -> Windows:
    """Windows of every set at `bank.rows` borders, spread over every other one of those that all of its states cross.

    The pixels by their two rows, a column more on both sides, lie in the frame, `line_px` from its border, beyond which a witness could
    lie; no two windows of a set share one. Where those of two markings meet, the left one is kept.
    """
    size = sets_at_once(scene)
    blocks = [sets[first : first + size] for first in range(0, len(sets), size)]
    if not blocks:
        places = windowed_bank(scene).rows * len(scene.runway.markings)
        return Windows(*(np.zeros((0, places), dtype=np.int64) for _ in range(3)))
    return Windows.joined([_windows_of_block(scene, block, spans) for block in blocks])


def _windows_of_block(scene: Scene, sets: StateSet, spans: Spans) -> Windows:
    rows, margin, (height, width) = windowed_bank(scene).rows, scene.tolerance.line_px, scene.camera.shape
    (first, last), usable = columns_at_borders(scene, sets)
    first, last = np.maximum(first, spans.first[:, :-1]), np.minimum(last, spans.last[:, :-1])
    border = np.arange(1, height)
    usable &= (border % 2 == 0) & (border > margin) & (border < height - margin)
    usable &= (first > margin) & (last < width - 1 - margin) & (first <= last) & (last - first < WIDEST_WINDOW)
    if spans.unseen is not None:
        usable &= ~_meets(spans.unseen, border, first, last, usable)
    usable = _apart(usable, first, last, np.argsort(scene.runway.x_m, kind="stable"))
    seen = usable.any(axis=1)
    rank, count = seen.cumsum(axis=1), np.maximum(seen.sum(axis=1, keepdims=True), rows)
    number, at = np.nonzero(seen & (rank * rows // count > (rank - 1) * rows // count))
    place = np.arange(len(number)) - np.searchsorted(number, number)
    shape = len(sets), rows, first.shape[1]
    borders, firsts, lasts = np.zeros(shape, dtype=np.int64), np.ones(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    kept = usable[number, :, at]
    borders[number, place] = np.where(kept, border[at, None], 0)
    firsts[number, place] = np.where(kept, first[number, :, at], 1)
    lasts[number, place] = np.where(kept, last[number, :, at], 0)
    return Windows(*(part.reshape(len(sets), -1) for part in (borders, firsts, lasts)))


def _meets(pixels: Bits, border: Integers, first: Integers, last: Integers, which: Bits) -> Bits:
    """True for those windows, of which `which` is True, that have one of the pixels, (sets, markings, borders)."""
    sums = np.pad(np.cumsum(pixels[:-1] | pixels[1:], axis=1), ((0, 0), (1, 0)))  # of both rows of each border
    number, marking, at = np.nonzero(which)
    left, right = first[number, marking, at] - 1, last[number, marking, at] + 2
    met = np.zeros_like(which)
    met[number, marking, at] = sums[border[at] - 1, right] > sums[border[at] - 1, left]
    return met


def _apart(usable: Bits, first: Integers, last: Integers, order: Integers) -> Bits:
    """`usable` (sets, markings, borders) without the windows that share a pixel with one to their left, in the order given."""
    kept, end = np.zeros_like(usable), np.full(usable[:, 0].shape, -2)
    for marking in order:
        kept[:, marking] = usable[:, marking] & (first[:, marking] - 1 > end + 1)
        end = np.where(kept[:, marking], last[:, marking], end)
    return kept


def _spans(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], unseen: Bits | None) -> Spans:
    """S of the cell: in each row, all columns between the first and the last that some state's marking can light, and `line_px` more."""
    return Spans(*spatial_spans(scene, lower, upper), unseen)


def _demand_strong(groups: _Groups, missed_budget: int) -> None:
    weakest = groups.weakest()
    weak = np.flatnonzero(weakest <= missed_budget)
    if len(weak):
        low, high = (side[weak[0]][groups.exists[weak[0]]] for side in (groups.lower, groups.upper))
        where = ", ".join(f"{name} {a:.4g}..{b:.4g}" for name, a, b in zip(STATE_NAMES, low.min(axis=0), high.max(axis=0), strict=True))
        raise SceneError(
            f"bank: in {where}, all states of a small part cross {weakest[weak[0]]} windows in view, which does not exceed missed_budget "
            f"{missed_budget}; keep the runway in view there, or raise bank.rows{', or lower the budget' if missed_budget else ''}"
        )

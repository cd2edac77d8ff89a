"""The bank of a cell: entries B_ij that cover it, each with an outer mask O_ij and an inner mask K_ij (paper, section III.C).

An entry is the set of states of the cell whose line coordinates lie in a stored box. Line coordinates are (theta, x, scale, z):
theta fixes the row in which all markings' lines vanish, and the scale (px per metre of the ground at a reference row) and x fix
where each crosses that row; z places the ends. In place of the paper's infinite lines R(rho_j, theta_j), which no segment can
match, an entry carries

    O_ij  contains every pixel that some state of B_ij lights
    K_ij  contains only pixels that every state of B_ij lights

so that missed_ij(I) = |K_ij without I| and extra_ij(I) = |(I and S_i) without O_ij| bound what Theorems A and B speak of.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from build_model.enclosure import columns_that_may_be_lit, columns_that_must_be_lit
from build_model.line_boxes import HALVING_ORDER, HALVINGS, MOST_WEAK, LineBoxes
from build_model.pixel_mask import VerticalRuns, inset, paint, runs_of, widened
from build_model.spatial_filter import reference_row, sliced, spatial_filter
from build_model.window import Bits, Window
from runtime.model.limits import SCALE_STEP, SMALLEST_LEVER_M
from runtime.refine.refiner import joined
from runtime.rounding import float32_above, float32_below, inverted
from runtime.scene import STATE_NAMES, Bank, Scene, SceneError
from runtime.state_set import StateSet, contract, scale_range, tangent_of_row

MOST_LATERAL_BINS = 10**6
"""More bins of x in a cell are not made, nor counted."""
BATCH_BYTES = 2**26
"""What the masks of the entries that are made together take at most, or those of one entry."""
BYTES_A_ROW, BYTES_A_PIXEL = 64, 8
"""Of an entry while its masks are made: what a row takes for each marking and once more, and what a pixel of the window takes."""


@dataclass(frozen=True)
class CellBank:
    """One cell's share of NN_F.

    `spatial` is S_i (one mask), `must_light` and `may_light` are K_ij and O_ij, one mask an entry. `state_lower` and
    `state_upper` (entries, 4) float32 hold each entry in state coordinates, rounded outward.
    """

    lines: LineBoxes
    spatial: VerticalRuns
    must_light: VerticalRuns
    may_light: VerticalRuns
    window: Window
    state_lower: NDArray[np.float32]
    state_upper: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def spatial_pixels(self) -> int:
        """Pixels of S."""
        return int(self.spatial.sizes(1)[0])

    @property
    def must_light_sizes(self) -> NDArray[np.int64]:
        """|K_ij| of every entry, (entries,)."""
        return self.must_light.sizes(len(self))


def mask_bank(scene: Scene) -> Bank:
    """The scene's bank, which is one of masks."""
    assert isinstance(scene.bank, Bank)
    return scene.bank


def line_boxes(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> LineBoxes:
    """Boxes that together cover the cell [lower, upper], both (4,): equal bins of theta, z and x, and of the scale as fine as needed."""
    boxes = []
    for theta, z, row, scale, lateral in _columns_of_boxes(scene, lower, upper):
        for x in lateral:
            bins = _scale_bins(scene, x, scale)
            sides = np.empty((len(bins), 4, 2))
            sides[:, 0], sides[:, 1], sides[:, 2], sides[:, 3] = theta, x, bins, z
            boxes.append((sides, np.full(len(bins), row)))
    sides, rows = (np.concatenate(part) for part in zip(*boxes, strict=True))
    return LineBoxes(sides[:, :, 0], sides[:, :, 1], rows)


def box_count(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> int:
    """Number of the cell's `line_boxes`, without making them."""
    counts = 0
    for _, _, _, scale, lateral in _columns_of_boxes(scene, lower, upper):
        first, last = _scale_borders(scene, lateral, scale)[1:]
        counts += int((last - first).sum())
    return counts


def some_boxes(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], numbers: NDArray[np.int64]) -> LineBoxes:
    """Those of the cell's `line_boxes` that have these numbers, ascending, without making the others."""
    sides, rows, before = [], [], 0
    for theta, z, row, scale, lateral in _columns_of_boxes(scene, lower, upper):
        step, first, last = _scale_borders(scene, lateral, scale)
        ends = before + np.cumsum(last - first).astype(np.int64)
        here = numbers[(numbers >= before) & (numbers < ends[-1])]
        at = np.searchsorted(ends, here, "right")
        edge = last[at] - (ends[at] - here)
        box = np.empty((len(here), 4, 2))
        box[:, 0], box[:, 1], box[:, 3] = theta, lateral[at], z
        lowest = np.where(edge == first[at], _lowest_scale(scale), 0)
        box[:, 2] = np.stack([np.maximum(edge * step[at], lowest), (edge + 1) * step[at]], axis=-1)
        sides.append(box)
        rows.append(np.full(len(here), row))
        before = int(ends[-1])
    joined = np.concatenate(sides)
    return LineBoxes(joined[:, :, 0], joined[:, :, 1], np.concatenate(rows))


def _columns_of_boxes(
    scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], float, NDArray[np.float64], NDArray[np.float64]]]:
    """For each bin of theta and z of a cell: both, (2,) each, the reference row, the scale's range there, (2,), and bins of x (bins, 2)."""
    bank = mask_bank(scene)
    for theta, z in itertools.product(sliced(lower[0], upper[0], bank.pitch_bins), sliced(lower[3], upper[3], bank.distance_bins)):
        low, high = lower.copy(), upper.copy()
        (low[0], high[0]), (low[3], high[3]) = theta, z
        row = reference_row(scene.camera, low, high, scene.runway.ends_z_m.mean())
        scale = np.array(scale_range(scene.camera, theta, np.array([lower[2], upper[2]]), tangent_of_row(scene.camera, row)))
        lateral_bins = max(1, math.ceil((upper[1] - lower[1]) * scale[1] / bank.lateral_px))
        if lateral_bins > MOST_LATERAL_BINS:
            found = f"found {bank.lateral_px}, which cuts x into {lateral_bins} bins a cell"
            raise SceneError(f"bank.lateral_px: {found}; give more, or narrow domain.x_m, for {MOST_LATERAL_BINS} or fewer")
        yield theta, z, row, scale, sliced(lower[1], upper[1], lateral_bins)


def _scale_borders(scene: Scene, x: NDArray[np.float64], scale: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
    """For each bin of x, (bins, 2): the step of the scale that moves the outermost marking by at most `column_px`, and the numbers of the
    first and the last step that cover `scale` (2,), above 0; (bins,) each.
    """
    lever_m = np.maximum(np.abs(scene.runway.x_m[:, None] - x[:, None, :]).max(axis=(1, 2)), SMALLEST_LEVER_M)
    step = np.maximum(np.floor(mask_bank(scene).column_px / lever_m / SCALE_STEP), 1) * SCALE_STEP
    return step, np.floor(scale[0] / step), np.ceil(scale[1] / step)


def _lowest_scale(scale: NDArray[np.float64]) -> float:
    """A quarter to a half of the smallest scale, where the first edge is 0."""
    return 2.0 ** (math.frexp(scale[0])[1] - 2)


def _scale_bins(scene: Scene, x: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intervals of the scale that cover `scale` (2,), above 0, for x in a bin (2,), as `_scale_borders` has them: (bins, 2)."""
    (step,), (first,), (last,) = _scale_borders(scene, x[None], scale)
    edges = np.arange(int(first), int(last) + 1) * step
    edges[0] = max(edges[0], _lowest_scale(scale))
    return np.stack([edges[:-1], edges[1:]], axis=-1)


@dataclass(frozen=True)
class Entries:
    """Entries of a cell as sets of states, with their masks."""

    lines: LineBoxes
    states: StateSet
    must_light: VerticalRuns
    may_light: VerticalRuns

    def __len__(self) -> int:
        return len(self.lines)

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Entries:
        return Entries(self.lines[chosen], self.states[chosen], self.must_light.chosen(chosen), self.may_light.chosen(chosen))

    @staticmethod
    def joined(parts: Sequence[Entries]) -> Entries:
        """All entries of one part or more, in order."""
        sizes, states = [len(part) for part in parts], [part.states for part in parts]
        return Entries(
            LineBoxes.joined([part.lines for part in parts]),
            joined(*states),
            VerticalRuns.joined([part.must_light for part in parts], sizes),
            VerticalRuns.joined([part.may_light for part in parts], sizes),
        )

    def weak(self, missed_budget: int) -> NDArray[np.bool_]:
        """True for entries with |K| <= missed_budget, which would pass on any frame."""
        return self.must_light.sizes(len(self)) <= missed_budget

    def hopeless(self, missed_budget: int) -> bool:
        """True if some entry has |O| <= missed_budget: no part of it will ever have a larger |K|."""
        return bool((self.may_light.sizes(len(self)) <= missed_budget).any())


@dataclass(frozen=True)
class CellMasks:
    """A cell [lower, upper], (4,) each, its S as bits in a window, and what makes its entries' masks."""

    scene: Scene
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    spatial: Bits
    window: Window
    unseen: Bits | None
    """Pixels of the frame that are lit in any, and so in no K."""

    @staticmethod
    def of(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], unseen: Bits | None = None) -> CellMasks:
        """The cell [lower, upper] and its S."""
        return CellMasks(scene, lower, upper, *spatial_filter(scene, lower, upper), unseen)

    def strong_entries(self, lines: LineBoxes) -> Entries:
        """The entries of some boxes, those that would pass on any frame halved until their parts are stronger.

        Raises `SceneError` where `HALVINGS` do not get there.
        """
        missed_budget = self.scene.tolerance.missed_budget
        parts = [self.entries(lines)]
        for halving in range(HALVINGS):
            weak = parts[-1].weak(missed_budget)
            if not 0 < weak.sum() <= MOST_WEAK or parts[-1].hopeless(missed_budget):
                break
            halves = parts[-1].lines[weak].halved(HALVING_ORDER[halving % len(HALVING_ORDER)])
            parts[-1:] = [parts[-1][~weak], self.entries(halves)]
        _demand_strong(self.scene, parts[-1])
        return Entries.joined(parts)

    def entries(self, lines: LineBoxes) -> Entries:
        """The entries of the boxes that are not proved empty, made a few at a time: masks as bits take `BATCH_BYTES` at most."""
        states = contract(self.scene.camera, lines.states(self.scene.camera, self.lower, self.upper))
        kept = ~(inverted(*states.theta.T) | inverted(*states.y.T))
        lines, states = lines[kept], states[kept]
        most = max(1, BATCH_BYTES // self.bytes_an_entry)
        batches = [self._masks(states[first : first + most]) for first in range(0, max(len(lines), 1), most)]
        sizes = [len(states[first : first + most]) for first in range(0, max(len(lines), 1), most)]
        must_light, may_light = (VerticalRuns.joined(masks, sizes) for masks in zip(*batches, strict=True))
        return Entries(lines, states, must_light, may_light)

    @property
    def bytes_an_entry(self) -> int:
        """About what the masks of an entry take while they are made: bounds a row and a marking, and bits in the window."""
        rows, pixels = self.scene.camera.height + 2 * self.scene.tolerance.line_px, math.prod(self.window.shape)
        return BYTES_A_ROW * rows * (1 + len(self.scene.runway.markings)) + BYTES_A_PIXEL * pixels

    def _masks(self, states: StateSet) -> tuple[VerticalRuns, VerticalRuns]:
        """K and O of sets of states."""
        scene, line_px = self.scene, self.scene.tolerance.line_px
        may_light = widened(scene, columns_that_may_be_lit(scene, states, line_px), line_px)
        may_light = runs_of(paint(may_light, self.window) & self.spatial, self.window)
        must_light = paint(inset(scene, columns_that_must_be_lit(scene, states), line_px), self.window)
        if self.unseen is not None:
            must_light &= ~self.unseen[self.window.slices]
        return runs_of(must_light, self.window), may_light


def cell_bank(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], unseen: Bits | None = None) -> CellBank:
    """S, entries, O and K of the cell [lower, upper], both (4,). Of K are left out the pixels, (height, width), that are lit in any frame.

    Boxes without a state of the cell are dropped, if proved so. An entry with |K| <= missed_budget would pass on any frame: it is halved
    until its parts are stronger. Raises `SceneError` where `HALVINGS` do not get there.
    """
    cell = CellMasks.of(scene, lower, upper, unseen)
    entries = cell.strong_entries(line_boxes(scene, lower, upper))
    return CellBank(
        lines=entries.lines,
        spatial=runs_of(cell.spatial[None], cell.window),
        must_light=entries.must_light,
        may_light=entries.may_light,
        window=cell.window,
        state_lower=float32_below(entries.states.lower),
        state_upper=float32_above(entries.states.upper),
    )


def _demand_strong(scene: Scene, entries: Entries) -> None:
    weak = np.flatnonzero(entries.weak(scene.tolerance.missed_budget))
    if len(weak):
        low, high = entries.states.lower[weak[0]], entries.states.upper[weak[0]]
        pixels = int(entries.must_light.sizes(len(entries))[weak[0]])
        where = ", ".join(f"{name} {a:.4g}..{b:.4g}" for name, a, b in zip(STATE_NAMES, low, high, strict=True))
        budget = scene.tolerance.missed_budget
        raise SceneError(
            f"bank: in {where}, only {pixels} pixels are lit by all states of a small part, which does not exceed missed_budget "
            f"{budget}; keep the runway in view there{', or lower the budget' if budget else ''}"
        )

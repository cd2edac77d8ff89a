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
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from build_model.enclosure import columns_that_may_be_lit, columns_that_must_be_lit
from build_model.pixel_mask import VerticalRuns, inset, paint, runs_of, widened
from build_model.spatial_filter import reference_row, sliced, spatial_filter
from build_model.window import Bits, Window
from runtime.model.limits import SCALE_STEP, SMALLEST_LEVER_M
from runtime.rounding import float32_above, float32_below, inverted
from runtime.scene import STATE_NAMES, Camera, Scene, SceneError
from runtime.state_set import StateSet, contract, scale_range, tangent_of_row

LINE_COORDINATES = ("theta", "x", "scale", "z")
HALVINGS, HALVING_ORDER = 12, ("scale", "x", "theta", "z")
"""How often an entry that would pass on any frame is halved, along which coordinates by turns, before the scene is refused."""
MOST_WEAK = 4096
"""More weak entries than this in a cell are not halved: the scene asks for more than a bank of sensible size can give."""


@dataclass(frozen=True)
class LineBoxes:
    """Entries as boxes in line coordinates: `lower` and `upper` (entries, 4) hold theta, x, scale, z; `reference_row` (entries,) px.

    An entry is the set of states of its cell inside its box.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    reference_row: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.lower)

    def __getitem__(self, chosen: NDArray[np.bool_]) -> LineBoxes:
        return LineBoxes(self.lower[chosen], self.upper[chosen], self.reference_row[chosen])

    def states(self, camera: Camera, cell_lower: NDArray[np.float64], cell_upper: NDArray[np.float64]) -> StateSet:
        """The entries of the cell [cell_lower, cell_upper], (4,) each, as sets of states, not yet contracted."""
        theta, x, scale, z = (np.stack([self.lower[:, axis], self.upper[:, axis]], axis=-1) for axis in range(4))
        y = np.broadcast_to([cell_lower[2], cell_upper[2]], theta.shape)
        return StateSet(theta, x, y, z, scale, tangent_of_row(camera, self.reference_row))


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
    def must_light_sizes(self) -> NDArray[np.int64]:
        """|K_ij| of every entry, (entries,)."""
        return self.must_light.sizes(len(self))


def line_boxes(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> LineBoxes:
    """Boxes that together cover the cell [lower, upper], both (4,): equal bins of theta, z and x, and of the scale as fine as needed."""
    bank = scene.bank
    boxes = []
    for theta, z in itertools.product(sliced(lower[0], upper[0], bank.pitch_bins), sliced(lower[3], upper[3], bank.distance_bins)):
        low, high = lower.copy(), upper.copy()
        (low[0], high[0]), (low[3], high[3]) = theta, z
        row = reference_row(scene.camera, low, high, scene.runway.ends_z_m.mean())
        scale = np.array(scale_range(scene.camera, theta, np.array([lower[2], upper[2]]), tangent_of_row(scene.camera, row)))
        lateral_bins = max(1, math.ceil((upper[1] - lower[1]) * scale[1] / bank.lateral_px))
        for x in sliced(lower[1], upper[1], lateral_bins):
            boxes += [(theta, x, bin_, z, row) for bin_ in _scale_bins(scene, x, scale)]
    sides = np.array([[theta, x, scale, z] for theta, x, scale, z, _ in boxes])
    return LineBoxes(sides[:, :, 0], sides[:, :, 1], np.array([row for *_, row in boxes]))


def _scale_bins(scene: Scene, x: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intervals of the scale that cover `scale` (2,), above 0, each moving the outermost marking by at most `column_px`: (bins, 2)."""
    lever_m = max(np.abs(scene.runway.x_m[:, None] - x).max(), SMALLEST_LEVER_M)
    step = max(math.floor(scene.bank.column_px / lever_m / SCALE_STEP), 1) * SCALE_STEP
    edges = np.arange(math.floor(scale[0] / step), math.ceil(scale[1] / step) + 1) * step
    edges[0] = max(edges[0], 2.0 ** (math.frexp(scale[0])[1] - 2))  # a quarter to a half of the smallest scale, where the edge is 0
    return np.stack([edges[:-1], edges[1:]], axis=-1)


@dataclass(frozen=True)
class _Entries:
    """Entries with their masks as bits in the cell's window, (entries, rows, columns)."""

    lines: LineBoxes
    states: StateSet
    must_light: Bits
    may_light: Bits

    def __getitem__(self, chosen: NDArray[np.bool_]) -> _Entries:
        return _Entries(self.lines[chosen], self.states[chosen], self.must_light[chosen], self.may_light[chosen])

    def weak(self, missed_budget: int) -> NDArray[np.bool_]:
        """True for entries with |K| <= missed_budget, which would pass on any frame."""
        return self.must_light.sum(axis=(1, 2)) <= missed_budget

    def hopeless(self, missed_budget: int) -> bool:
        """True if some entry has |O| <= missed_budget: no part of it will ever have a larger |K|."""
        return bool((self.may_light.sum(axis=(1, 2)) <= missed_budget).any())


def cell_bank(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], unseen: Bits | None = None) -> CellBank:
    """S, entries, O and K of the cell [lower, upper], both (4,). Of K are left out the pixels, (height, width), that are lit in any frame.

    Boxes without a state of the cell are dropped, if proved so. An entry with |K| <= missed_budget would pass on any frame: it is halved
    until its parts are stronger. Raises `SceneError` where `HALVINGS` do not get there.
    """
    spatial, window = spatial_filter(scene, lower, upper)
    parts = [_entries(scene, line_boxes(scene, lower, upper), lower, upper, spatial, window, unseen)]
    for halving in range(HALVINGS):
        weak = parts[-1].weak(scene.tolerance.missed_budget)
        if not 0 < weak.sum() <= MOST_WEAK or parts[-1].hopeless(scene.tolerance.missed_budget):
            break
        halves = _halved(parts[-1].lines[weak], HALVING_ORDER[halving % len(HALVING_ORDER)])
        parts[-1:] = [parts[-1][~weak], _entries(scene, halves, lower, upper, spatial, window, unseen)]
    _demand_strong(scene, parts[-1])
    state_lower, state_upper = (np.concatenate([getattr(part.states, side) for part in parts]) for side in ("lower", "upper"))
    return CellBank(
        lines=LineBoxes(*(np.concatenate([getattr(part.lines, name) for part in parts]) for name in ("lower", "upper", "reference_row"))),
        spatial=runs_of(spatial[None], window),
        must_light=runs_of(np.concatenate([part.must_light for part in parts]), window),
        may_light=runs_of(np.concatenate([part.may_light for part in parts]), window),
        window=window,
        state_lower=float32_below(state_lower),
        state_upper=float32_above(state_upper),
    )


def _entries(
    scene: Scene,
    lines: LineBoxes,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    spatial: Bits,
    window: Window,
    unseen: Bits | None,
) -> _Entries:
    """The masks of the boxes that are not proved empty."""
    states = contract(scene.camera, lines.states(scene.camera, lower, upper))
    kept = ~(inverted(*states.theta.T) | inverted(*states.y.T))
    lines, states = lines[kept], states[kept]
    line_px = scene.tolerance.line_px
    may_light = paint(widened(scene, columns_that_may_be_lit(scene, states, line_px), line_px), window) & spatial
    must_light = paint(inset(scene, columns_that_must_be_lit(scene, states), line_px), window)
    if unseen is not None:
        must_light &= ~unseen[window.slices]
    return _Entries(lines, states, must_light, may_light)


def _halved(lines: LineBoxes, coordinate: str) -> LineBoxes:
    """Each box as two halves along one line coordinate; along the scale where that coordinate is fixed."""
    axis = LINE_COORDINATES.index(coordinate)
    axes = np.where(lines.upper[:, axis] > lines.lower[:, axis], axis, LINE_COORDINATES.index("scale"))
    each = np.arange(len(lines))
    middle = (lines.lower[each, axes] + lines.upper[each, axes]) / 2
    lower, upper = np.concatenate([lines.lower] * 2), np.concatenate([lines.upper] * 2)
    upper[each, axes] = lower[len(lines) + each, axes] = middle
    return LineBoxes(lower, upper, np.concatenate([lines.reference_row] * 2))


def _demand_strong(scene: Scene, entries: _Entries) -> None:
    weak = np.flatnonzero(entries.weak(scene.tolerance.missed_budget))
    if len(weak):
        low, high = entries.states.lower[weak[0]], entries.states.upper[weak[0]]
        where = ", ".join(f"{name} {a:.4g}..{b:.4g}" for name, a, b in zip(STATE_NAMES, low, high, strict=True))
        raise SceneError(
            f"bank: in {where}, only {entries.must_light[weak[0]].sum()} pixels are lit by all states of a small part, which does "
            f"not exceed missed_budget {scene.tolerance.missed_budget}; keep the runway in view there, or lower the budget"
        )

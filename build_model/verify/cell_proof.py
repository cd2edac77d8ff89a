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
from dataclasses import dataclass, field

import numpy as np
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray

from build_model.verify.ball_camera import PRECISION_BITS, BallCamera, BallEntry
from build_model.verify.cell_claim import CellClaim
from build_model.verify.counterexample import Counterexample, Refuted, demand
from build_model.verify.entry_proof import EntryProver
from runtime.model.format import PADDING_SIZE


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
        self.line_px = claim.scene.tolerance.line_px
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
        if self.line_px > 0:
            inner[:, self.line_px : -self.line_px, self.line_px : -self.line_px] = False
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
        lowest = self.camera.focal_u_px * fall[0] / arb(self.claim.upper[2])
        highest = self.camera.focal_u_px * fall[1] / arb(self.claim.lower[2])
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
        return self.camera.focal_u_px * self.camera.ray(theta, row)[0] / arb(y)

    def _prove_entry(self, number: int) -> None:
        """The state box, O and K of one entry."""
        entry = self._entry(number)
        if entry is None:
            return
        prover = EntryProver(self.claim, number, entry)
        prover.check_state_box(self.claim.state_lower[number], self.claim.state_upper[number])
        prover.prove_may_light(self.may_light[number])
        prover.prove_must_light(self.must_light[number])
        if prover.margin < self.margin:
            self.margin = prover.margin

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


def _elementary(claim: CellClaim, lower: NDArray[np.float64], upper: NDArray[np.float64], axis: int) -> list[tuple[float, float]]:
    """The cell's interval of an axis, cut at every border of a box; one interval of width 0 if the axis is fixed."""
    low, high = float(claim.lower[axis]), float(claim.upper[axis])
    borders = np.concatenate([lower[:, axis], upper[:, axis]])
    inner = np.unique(borders[(borders > low) & (borders < high)]).tolist()
    return list(itertools.pairwise([low, *inner, high]))

"""What is proved of one cell: its entries cover it, and S, O, K and the entries' boxes hold what they claim.

For each entry and each row, the columns that its states light are enclosed by `build_model.verify.ball_camera` over slices of theta, halved
until the claim holds in each or a state refutes it:

    O  the image of every state, widened by the tolerance and clipped to the frame, is inside O; and O is inside S
    K  every state of the entry lights each of its pixels, by a marking that may be another one in another slice

As the entries cover the cell, S then contains whatever any state of the cell lights. A point of a marking just out of view counts
in the widening, as a camera that is off by its calibration can show it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]

from build_model.verify.ball_camera import PRECISION_BITS, BallCamera
from build_model.verify.cell_claim import CellClaim
from build_model.verify.counterexample import Counterexample, Refuted, demand
from build_model.verify.cover_proof import ball_entry, check_cover
from build_model.verify.entry_proof import EntryProver
from runtime.model.format import PADDING_SIZE


@dataclass
class CellProof:
    """What was proved of a cell: numbers of entries, pixels in S, all O and all K, windows; and a column's least margin, px."""

    entries: int = 0
    spatial_pixels: int = 0
    may_light_pixels: int = 0
    must_light_pixels: int = 0
    windows: int = 0
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
        check_cover(self.claim, self.camera, entries)
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

    def _prove_entry(self, number: int) -> None:
        """The state box, O and K of one entry."""
        entry = ball_entry(self.claim, self.camera, number)
        if entry is None:
            return
        prover = EntryProver(self.claim, number, entry)
        prover.check_state_box(self.claim.state_lower[number], self.claim.state_upper[number])
        prover.prove_may_light(self.may_light[number])
        prover.prove_must_light(self.must_light[number])
        if prover.margin < self.margin:
            self.margin = prover.margin

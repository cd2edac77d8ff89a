"""What is proved of one cell of a bank of windows: its entries cover it, and windows, S and the entries' boxes hold what they claim.

For each window, over slices of theta that are halved until the claim holds in each or a state refutes it:

    windows  every state of the set crosses the border with the marking, strictly between the window's first column and the one behind its
             last; so it lights a pixel of the window above the border, and one below it or below and beside
    apart    no two windows of a set have a pixel of their two rows in common; they keep clear of the frame's border by the tolerance
    gates    are windows of the set that holds all entries of their group
    S        whatever a state of a group lights, widened by the tolerance, is in S
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray

from build_model.verify.ball_camera import PRECISION_BITS, BallCamera, BallEntry, BallInterval, Slice, columns
from build_model.verify.cell_proof import CellProof
from build_model.verify.counterexample import Counterexample, Refuted, demand
from build_model.verify.cover_proof import ball_entry, check_cover
from build_model.verify.entry_proof import EntryProver, point_of, states_of
from build_model.verify.window_claim import WindowClaim
from runtime.model.format import PADDING_SIZE

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Claimed:
    """A window of a set: the marking that crosses the border there, and the columns that it does so between."""

    marking: int
    border: int
    first: int
    last: int


def prove_windows(claim: WindowClaim) -> CellProof | Counterexample:
    """Proves all of a cell's claims, or returns the first that does not hold."""
    with ctx.workprec(PRECISION_BITS):
        try:
            return _WindowProver(claim).prove()
        except Refuted as refuted:
            return refuted.counterexample


class _WindowProver:
    """One cell's windows, decoded, and the camera they are judged by."""

    def __init__(self, claim: WindowClaim) -> None:
        self.claim = claim
        self.camera = BallCamera(claim.scene.camera)
        self.spatial = claim.spatial()
        self.gate = claim.gate.windows(claim.window, claim.cell, "gate")
        self.windows = claim.windows.windows(claim.window, claim.cell, "window")
        self.proof = CellProof(spatial_pixels=int(self.spatial.sum()))
        self.margin = arb("inf")

    def prove(self) -> CellProof:
        """All claims, the cheap ones first. Raises `Refuted`."""
        entries = np.flatnonzero(self.claim.must_light_size != PADDING_SIZE)
        self._check_sizes()
        for windows in (self.gate, self.windows):
            self._check_apart(*windows)
        check_cover(self.claim, self.camera, entries)
        for group in range(len(self.claim.gate_size)):
            self._prove_group(group)
        self.proof.entries = len(entries)
        self.proof.windows = sum(int((first <= last).sum()) for _, first, last in (self.gate, self.windows))
        self.proof.margin_px = float(self.margin.lower())
        return self.proof

    def _check_sizes(self) -> None:
        """Numbers of windows are what is stated and exceed the budget; padding never passes."""
        claim, missed = self.claim, self.claim.scene.tolerance.missed_budget
        padding = claim.must_light_size == PADDING_SIZE
        counts, gates = ((first <= last).sum(axis=1) for _, first, last in (self.windows, self.gate))
        faults = {
            "must_light_size is not the number of windows": ~padding & (counts != claim.must_light_size),
            f"the number of windows does not exceed the missed budget {missed}": ~padding & (counts <= missed),
            "gate_size is not the number of windows": np.repeat(gates != claim.gate_size, claim.parts),
            f"the number of a gate's windows does not exceed the missed budget {missed}": np.repeat(gates <= missed, claim.parts),
        }
        for text, where in faults.items():
            demand(not where.any(), text, claim.cell, int(where.argmax()))

    def _check_apart(self, border: Integers, first: Integers, last: Integers) -> None:
        """Windows keep `line_px` from the frame's border, with a column more on both sides, and share no pixel."""
        line_px, (height, width) = self.claim.scene.tolerance.line_px, self.claim.scene.camera.shape
        used = first <= last
        within = (border > line_px) & (border < height - line_px) & (first > line_px) & (last < width - 1 - line_px)
        wrong = (used & ~within).any(axis=1)
        demand(not wrong.any(), "a window's pixels reach the frame's border", self.claim.cell, int(wrong.argmax()))
        for one, other in itertools.combinations(range(border.shape[1]), 2):
            near = used[:, one] & used[:, other] & (abs(border[:, one] - border[:, other]) <= 1)
            near &= (first[:, one] - 1 <= last[:, other] + 1) & (first[:, other] - 1 <= last[:, one] + 1)
            demand(not near.any(), "two windows of a set have a pixel in common", self.claim.cell, int(near.argmax()))

    def _prove_group(self, group: int) -> None:
        """Gate, S, and the entries of one group."""
        claim, parts = self.claim, self.claim.parts
        numbers = group * parts + np.flatnonzero(claim.must_light_size[group * parts : (group + 1) * parts] != PADDING_SIZE)
        whole = self._hull(numbers)
        if whole is not None:
            prover = EntryProver(claim, int(numbers[0]), whole)
            prover.prove_may_light(self.spatial)
            self._prove_crossings(prover, self._claimed(self.gate, group))
            self._keep(prover)
        for number in numbers.tolist():
            entry = ball_entry(claim, self.camera, number)
            if entry is not None:
                prover = EntryProver(claim, number, entry)
                prover.check_state_box(claim.state_lower[number], claim.state_upper[number])
                self._prove_crossings(prover, self._claimed(self.windows, number))
                self._keep(prover)

    def _hull(self, numbers: Integers) -> BallEntry | None:
        """The set that holds all of a group's entries; None if there is none that meets the cell."""
        claim = self.claim
        if len(numbers) == 0:
            return None
        rows = claim.reference_row[numbers]
        demand(bool((rows == rows[0]).all()), "entries of a group have different reference rows", claim.cell, int(numbers[0]))
        lower, upper = claim.line_lower.copy(), claim.line_upper.copy()
        lower[numbers[0]], upper[numbers[0]] = claim.line_lower[numbers].min(axis=0), claim.line_upper[numbers].max(axis=0)
        return ball_entry(replace(claim, line_lower=lower, line_upper=upper), self.camera, int(numbers[0]))

    def _claimed(self, windows: tuple[Integers, Integers, Integers], number: int) -> list[Claimed]:
        border, first, last = (part[number] for part in windows)
        markings = len(self.claim.scene.runway.markings)
        return [
            Claimed(int(place) % markings, int(border[place]), int(first[place]), int(last[place]))
            for place in np.flatnonzero(first <= last)
        ]

    def _prove_crossings(self, prover: EntryProver, claimed: list[Claimed]) -> None:
        """Every state of the set crosses each border within its window. Raises `Refuted`."""
        open_slices = [(prover.root, claimed)]
        while open_slices:
            part, left = open_slices.pop()
            left = [] if part.empty else [window for window in left if not self._crosses(prover, part, window)]
            if left:
                self._seek_elsewhere(prover, part, left)
                open_slices += ((half, left) for half in part.halves())

    def _crosses(self, prover: EntryProver, part: Slice, window: Claimed) -> bool:
        """True if all states of the slice are proved to cross the border within the window; keeps the margin."""
        across = self._columns(prover, part, window)
        if across is None or not (across[0] > window.first and across[1] < window.last + 1):
            return False
        prover.keep_margin(across[0] - window.first, window.last + 1 - across[1])
        return True

    def _columns(self, prover: EntryProver, part: Slice, window: Claimed) -> BallInterval | None:
        """Where the states of a slice cross the border; None unless all certainly do."""
        seen = prover.markings[window.marking]
        rows = part.rows(seen.ends)
        if rows is None or not (rows[0][0] > window.border and rows[1][1] < window.border):
            return None
        return columns(self.camera, seen.across, part.scale_at(window.border))

    def _seek_elsewhere(self, prover: EntryProver, part: Slice, left: list[Claimed]) -> None:
        """Raises `Refuted` if a state of the slice does not cross a border within its window, or if the slice is as narrow as any."""
        width = part.high - part.low
        if width > max(prover.search_width, prover.finest_width):
            return
        for state in states_of(part):
            point = point_of(part.entry, state)
            for window in left:
                across = self._columns(EntryProver(self.claim, prover.number, point.entry), point, window)
                if across is None or across[1] < window.first or across[0] > window.last + 1:
                    pixel = window.border, window.first
                    raise Refuted(
                        Counterexample("a state does not cross the border within the window", self.claim.cell, prover.number, pixel, state)
                    )
        if width <= prover.finest_width:
            pixel = left[0].border, left[0].first
            raise Refuted(Counterexample("a state may cross the border outside the window", self.claim.cell, prover.number, pixel))

    def _keep(self, prover: EntryProver) -> None:
        if prover.margin < self.margin:
            self.margin = prover.margin

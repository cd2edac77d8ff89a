"""Proofs of a cell that are the same for both kinds of bank: its entries as sets of states, and that they cover it."""

from __future__ import annotations

import itertools

import numpy as np
from flint import arb  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray

from build_model.verify.ball_camera import BallCamera, BallEntry
from build_model.verify.cell_claim import BankClaim
from build_model.verify.counterexample import Counterexample, Refuted


def check_cover(claim: BankClaim, camera: BallCamera, entries: NDArray[np.int64]) -> None:
    """Every state of the cell is in an entry: the boxes tile theta, x and z, and where they do their scales cover g's range.

    Raises `Refuted`.
    """
    axes = (0, 1, 3)
    lower, upper = claim.line_lower[entries], claim.line_upper[entries]
    for sides in itertools.product(*(_elementary(claim, lower, upper, axis) for axis in axes)):
        covers = np.ones(len(entries), dtype=bool)
        for axis, (low, high) in zip(axes, sides, strict=True):
            covers &= (lower[:, axis] <= low) & (upper[:, axis] >= high)
        rows = np.unique(claim.reference_row[entries[covers]])
        if not any(_scales_cover(claim, camera, sides[0], row, entries[covers & (claim.reference_row[entries] == row)]) for row in rows):
            theta, x, z = ((low + high) / 2 for low, high in sides)
            state = _uncovered(claim, camera, sides[0], float(theta), entries[covers])
            found = (state[0], float(x), state[1], float(z))
            raise Refuted(Counterexample("the entries do not cover the cell", claim.cell, state=found))


def _scales_cover(claim: BankClaim, camera: BallCamera, theta: tuple[float, float], row: float, entries: NDArray[np.int64]) -> bool:
    """True if every g at `row` that theta and the cell's altitudes allow lies in an entry's bin."""
    fall = camera.fall_range(*theta, row)
    lowest = camera.focal_u_px * fall[0] / arb(claim.upper[2])
    highest = camera.focal_u_px * fall[1] / arb(claim.lower[2])
    if not lowest > 0:
        return False
    reached = lowest
    for low, high in sorted(zip(claim.line_lower[entries, 2].tolist(), claim.line_upper[entries, 2].tolist(), strict=True)):
        if reached >= low and reached < high:
            reached = arb(high)
    return bool(reached >= highest)


def _uncovered(
    claim: BankClaim, camera: BallCamera, theta: tuple[float, float], middle: float, entries: NDArray[np.int64]
) -> tuple[float, float]:
    """A theta and an altitude of the cell in no bin of the given entries; the middle if a search finds none."""
    altitudes = np.linspace(claim.lower[2], claim.upper[2], 65).tolist()
    for angle, y in itertools.product((middle, *theta), altitudes):
        scales = (_scale(camera, angle, y, float(row)) for row in claim.reference_row[entries])
        bins = zip(scales, claim.line_lower[entries, 2].tolist(), claim.line_upper[entries, 2].tolist(), strict=True)
        if all(scale < low or scale > high for scale, low, high in bins):
            return angle, y
    return middle, float((claim.lower[2] + claim.upper[2]) / 2)


def _scale(camera: BallCamera, theta: float, y: float, row: float) -> arb:
    return camera.focal_u_px * camera.ray(theta, row)[0] / arb(y)


def ball_entry(claim: BankClaim, camera: BallCamera, number: int) -> BallEntry | None:
    """The entry as a set of states; None if its box misses the cell altogether."""
    theta, x, z = (
        (max(claim.line_lower[number, axis], claim.lower[axis]), min(claim.line_upper[number, axis], claim.upper[axis]))
        for axis in (0, 1, 3)
    )
    if any(low > high for low, high in (theta, x, z)):
        return None
    return BallEntry(
        camera=camera,
        theta=(float(theta[0]), float(theta[1])),
        x=(arb(x[0]), arb(x[1])),
        y=(arb(claim.lower[2]), arb(claim.upper[2])),
        z=(arb(z[0]), arb(z[1])),
        scale=(arb(claim.line_lower[number, 2]), arb(claim.line_upper[number, 2])),
        reference_row=float(claim.reference_row[number]),
    )


def _elementary(claim: BankClaim, lower: NDArray[np.float64], upper: NDArray[np.float64], axis: int) -> list[tuple[float, float]]:
    """The cell's interval of an axis, cut at every border of a box; one interval of width 0 if the axis is fixed."""
    low, high = float(claim.lower[axis]), float(claim.upper[axis])
    borders = np.concatenate([lower[:, axis], upper[:, axis]])
    inner = np.unique(borders[(borders > low) & (borders < high)]).tolist()
    return list(itertools.pairwise([low, *inner, high]))

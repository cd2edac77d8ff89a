"""What the refinement takes for granted of the entries' boxes (`runtime.model.entries`), proved of the file's own tensors.

Order, domain and frame are comparisons of the file's numbers. That a reference row is below the horizon, and that a box of scales is
within a step of what the states allow, is proved in Arb's balls of 64 bits.
"""

from __future__ import annotations

import numpy as np
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray

from build_model.filter_tables import BankTables
from build_model.verify.ball_camera import PRECISION_BITS, BallCamera
from build_model.verify.counterexample import demand
from runtime.model.format import PADDING_SIZE
from runtime.model.limits import BELOW_HORIZON_PX, ROWS_BELOW_FRAME, largest_steps
from runtime.scene import Scene

FARTHEST_PADDING = 2.0**64
"""The largest number in a box of states where there is no entry: the largest float32 moves it out of the way of every hull."""


def check_boxes(scene: Scene, tables: BankTables) -> None:
    """Boxes of states, scales and reference rows are such as the loader demands. Raises `Refuted` with the first that is not."""
    _check_numbers(scene, tables)
    with ctx.workprec(PRECISION_BITS):
        camera = BallCamera(scene.camera)
        for row, place in np.argwhere(tables.must_light_size != PADDING_SIZE).tolist():
            _check_entry(scene, camera, tables, row, place)


def entry_at(tables: BankTables, row: int, place: int) -> tuple[int, int]:
    """Cell and number of the entry at a place of a row."""
    cell = tables.row_cell[row]
    before = row - int(np.searchsorted(tables.row_cell, cell))
    return int(cell), before * tables.must_light_size.shape[1] + place


def demand_of_all(holds: NDArray[np.bool_], claim: str, tables: BankTables) -> None:
    """Raises `Refuted` with the claim and the first place of the bank, (rows, width), where it does not hold."""
    if not holds.all():
        row, place = np.argwhere(~holds)[0].tolist()
        demand(False, claim, *entry_at(tables, row, place))


def _check_numbers(scene: Scene, tables: BankTables) -> None:
    """Boxes are ordered and within the domain, but for float32's rounding; scales are above 0; reference rows are near the frame."""
    padding = tables.must_light_size == PADDING_SIZE
    lower, upper = tables.state_lower, tables.state_upper
    least = np.nextafter(scene.domain.lower.astype(np.float32), np.float32(-np.inf))
    most = np.nextafter(scene.domain.upper.astype(np.float32), np.float32(np.inf))
    slow, fast, row = tables.line_lower[..., 2], tables.line_upper[..., 2], tables.reference_row
    for claim, holds in (
        ("an entry's box of states is inverted", (lower <= upper).all(axis=2)),
        ("an entry's box of states reaches out of the domain", ((lower >= least) & (upper <= most)).all(axis=2)),
        ("an entry's scales are inverted, or not above 0 and finite", (slow > 0) & (slow <= fast) & np.isfinite(fast)),
        ("an entry's reference_row is not near the frame", (row >= 0) & (row <= scene.camera.height + ROWS_BELOW_FRAME)),
    ):
        demand_of_all(padding | holds, claim, tables)
    for name in ("state_lower", "state_upper", "line_lower", "line_upper", "reference_row"):
        demand_of_all(np.isfinite(getattr(tables, name)).reshape(*padding.shape, -1).all(axis=2), f"{name} is not finite", tables)
    near = (np.maximum(np.abs(lower), np.abs(upper)) <= FARTHEST_PADDING).all(axis=2)
    demand_of_all(~padding | near, "a box of states in the padding does not stay out of the hulls' way", tables)


def _check_entry(scene: Scene, camera: BallCamera, tables: BankTables, row: int, place: int) -> None:
    """An entry's reference row is below the horizon of its states, its scales within a step of those that they have."""
    lower, upper = tables.state_lower[row, place].astype(np.float64), tables.state_upper[row, place].astype(np.float64)
    lower, upper = np.maximum(lower, scene.domain.lower).tolist(), np.minimum(upper, scene.domain.upper).tolist()
    reference_row = float(tables.reference_row[row, place])
    sine, cosine = camera.turn(lower[0])
    below_horizon = arb(reference_row) - camera.v0 + camera.focal_v_px * sine / cosine
    where = entry_at(tables, row, place)
    demand(bool(below_horizon >= BELOW_HORIZON_PX), "an entry's reference_row is not certainly below the horizon of its states", *where)
    fall = camera.fall_range(lower[0], upper[0], reference_row)
    scale = np.array([[tables.line_lower[row, place, 2], tables.line_upper[row, place, 2]]])
    step = arb(float(largest_steps(scene, np.array([[lower[1], upper[1]]]), scale)[0]))
    slowest, fastest = camera.focal_u_px * fall[0] / arb(upper[2]) - step, camera.focal_u_px * fall[1] / arb(lower[2]) + step
    binds = slowest <= float(tables.line_lower[row, place, 2]) and fastest >= float(tables.line_upper[row, place, 2])
    demand(binds, "an entry's scales reach beyond those of its states by more than a step", *where)

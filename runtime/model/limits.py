"""What a model may claim of its entries: limits that the build keeps, the loader demands and the verifier proves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.scene import Scene

BELOW_HORIZON_PX = 0.5
"""Least distance of an entry's reference row from the horizon of each of its states; the build keeps twice that."""
SCALE_STEP = 2.0**-10
"""Bins of the scale have borders on multiples of this, px per metre, so that they do not depend on the machine's libm."""
SMALLEST_LEVER_M = 1e-3
"""A marking's distance from the camera's vertical plane counts as at least this when the bins of the scale are sized."""
ROWS_BELOW_FRAME = 1
"""How far below the frame a reference row may lie: it must, where some state has its horizon in the frame's last row."""


def largest_steps(scene: Scene, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Px per metre, (entries,), that a bin of the scale spans at most where x is in a range of `x`, (entries, 2): `column_px` of the bank
    at the outermost marking.
    """
    lever_m = np.abs(scene.runway.x_m[:, None, None] - x).min(axis=2).max(axis=0)
    return np.maximum(scene.bank.column_px / np.maximum(lever_m, SMALLEST_LEVER_M), SCALE_STEP)

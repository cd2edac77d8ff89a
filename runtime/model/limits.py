"""What a model may claim of its entries: limits that the build keeps, the loader demands and the verifier proves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.scene import Scene, WindowedBank

BELOW_HORIZON_PX = 0.5
"""Least distance of an entry's reference row from the horizon of each of its states; the build keeps twice that."""
SCALE_STEP = 2.0**-10
"""Bins of the scale have borders on multiples of this, px per metre, so that they do not depend on the machine's libm."""
SMALLEST_LEVER_M = 1e-3
"""A marking's distance from the camera's vertical plane counts as at least this when the bins of the scale are sized."""
ROWS_BELOW_FRAME = 1
"""How far below the frame a reference row may lie: it must, where some state has its horizon in the frame's last row."""


def largest_steps(scene: Scene, x: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Px per metre, (entries,), by which a bin of the scale may reach beyond what its states allow, where x is in a range of `x` and the
    bin is `scale`, (entries, 2) each.

    In a bank of masks it spans at most `column_px` at the outermost marking; one of windows has bins of any width, which must only reach
    into what is allowed.
    """
    if isinstance(scene.bank, WindowedBank):
        return np.maximum(scale[:, 1] - scale[:, 0], 0)
    lever_m = np.abs(scene.runway.x_m[:, None, None] - x).min(axis=2).max(axis=0)
    return np.maximum(scene.bank.column_px / np.maximum(lever_m, SMALLEST_LEVER_M), SCALE_STEP)

"""Witnesses: what may stand for a pixel of the runway under the tolerance of a scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.image import dilated


def witnesses(frame: NDArray[np.bool_], line_px: int) -> NDArray[np.bool_]:
    """True where a lit pixel of the frame lies within `line_px` in the sup norm, or the frame's border does; shape as the frame's.

    What belongs there may be seen outside of the frame.
    """
    if line_px == 0:
        return frame
    wide = dilated(np.pad(frame, line_px, constant_values=True), line_px)
    return wide[line_px : line_px + len(frame), line_px : line_px + frame.shape[1]]

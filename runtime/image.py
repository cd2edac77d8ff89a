"""I_r(xi), the image of a state: the supercover of the projected markings, clipped to the frame.

A pixel is lit if some point of a marking falls into it by the floor of Eq. (2); pixels are half-open (`runtime.camera`), so
a point on the border of two belongs to the right or the lower one. Markings are joined by OR (theory of section 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.camera import project
from runtime.scene import Scene

Integers = NDArray[np.int64]


def lit_columns(scene: Scene, states: ArrayLike) -> tuple[Integers, Integers]:
    """First and last column that each marking lights in each row of the frame; last < first where it lights none.

    `states`: (..., 4). Returns two arrays (..., markings, height), not yet clipped to the frame's width. Exact for the
    float64 ends that `project` gives, apart from the rounding of one interpolation.
    """
    (u_near, v_near), (u_far, v_far) = np.moveaxis(project(scene, states), (-2, -1), (0, 1))[..., None]
    top = np.arange(scene.camera.height, dtype=np.float64)
    start, stop = np.maximum(top, v_far), np.minimum(top + 1, v_near)
    slope = (u_near - u_far) / (v_near - v_far)
    u_start, u_stop = u_far + slope * (start - v_far), u_far + slope * (stop - v_far)
    first = np.floor(np.minimum(u_start, u_stop))
    last = np.floor(np.maximum(u_start, u_stop))
    # The row's lower border belongs to the next row: a column that is reached only there is not lit in this one.
    reached_only_below = (stop == top + 1) & (u_stop > u_start) & (u_stop == last)
    last -= reached_only_below
    present = (start < stop) | ((start == stop) & (stop < top + 1))
    return first.astype(np.int64), np.where(present, last, first - 1).astype(np.int64)


def runway_image(scene: Scene, states: ArrayLike) -> NDArray[np.uint8]:
    """I_r of every state, uint8 of {0, 1}. `states`: (..., 4); returns (..., height, width)."""
    wide = np.asarray(states, dtype=np.float64)
    first, last = lit_columns(scene, wide.reshape(-1, 4))
    height, width = scene.camera.shape
    frames = np.zeros((len(first), height, width), dtype=np.uint8)
    first, last = np.maximum(first, 0), np.minimum(last, width - 1)
    state, marking, row = np.nonzero(first <= last)
    column, end = first[state, marking, row], last[state, marking, row]
    while len(column):
        frames[state, row, column] = 1
        more = column < end
        state, row, column, end = state[more], row[more], column[more] + 1, end[more]
    return frames.reshape(*wide.shape[:-1], height, width)

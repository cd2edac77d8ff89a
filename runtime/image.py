"""I_r(xi), the image of a state: the supercover of the projected markings, clipped to the frame.

A pixel is lit if some point of a marking falls into it by the floor of Eq. (2); pixels are half-open (`runtime.camera`), so
a point on the border of two belongs to the right or the lower one. Markings are joined by OR.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.camera import project
from runtime.scene import Scene
from runtime.sensor_image import sensor_images

Integers = NDArray[np.int64]


def columns_of_ends(ends: ArrayLike, height: int) -> tuple[Integers, Integers]:
    """First and last column that each marking lights in each row of a frame; last < first where it lights none.

    `ends`: (..., markings, 2, 2) px, the near (lower) and far end, last axis (u, v), as `runtime.camera.project` gives them. Returns
    two arrays (..., markings, height), not yet clipped to the frame's width. Exact for these float64 ends, apart from the
    rounding of one interpolation.
    """
    (u_near, v_near), (u_far, v_far) = np.moveaxis(np.asarray(ends, dtype=np.float64), (-2, -1), (0, 1))[..., None]
    top = np.arange(height, dtype=np.float64)
    start, stop = np.maximum(top, v_far), np.minimum(top + 1, v_near)
    slope = (u_near - u_far) / (v_near - v_far)
    u_start = np.where(start == v_far, u_far, u_far + slope * (start - v_far))
    u_stop = np.where(stop == v_near, u_near, u_far + slope * (stop - v_far))
    first = np.floor(np.minimum(u_start, u_stop))
    last = np.floor(np.maximum(u_start, u_stop))
    # The row's lower border belongs to the next row: a column that is reached only there is not lit in this one.
    reached_only_below = (stop == top + 1) & (u_stop > u_start) & (u_stop == last)
    last -= reached_only_below
    present = (start < stop) | ((start == stop) & (stop < top + 1))
    return first.astype(np.int64), np.where(present, last, first - 1).astype(np.int64)


def image_of_ends(ends: ArrayLike, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Frames (..., height, width), uint8 of {0, 1}, in which the markings with the given ends (..., markings, 2, 2) are lit."""
    height, width = shape
    first, last = columns_of_ends(ends, height)
    outer = first.shape[:-2]
    first, last = (part.reshape(-1, *part.shape[-2:]) for part in (np.maximum(first, 0), np.minimum(last, width - 1)))
    frames = np.zeros((len(first), height, width), dtype=np.uint8)
    frame, marking, row = np.nonzero(first <= last)
    column, end = first[frame, marking, row], last[frame, marking, row]
    while len(column):
        frames[frame, row, column] = 1
        more = column < end
        frame, row, column, end = frame[more], row[more], column[more] + 1, end[more]
    return frames.reshape(*outer, height, width)


def lit_columns(scene: Scene, states: ArrayLike) -> tuple[Integers, Integers]:
    """`columns_of_ends` of the projected markings. `states`: (..., 4); returns two arrays (..., markings, height)."""
    return columns_of_ends(project(scene, states), scene.camera.height)


def runway_image(scene: Scene, states: ArrayLike) -> NDArray[np.uint8]:
    """I_r of every state in the sensor's frame, uint8 of {0, 1}. `states`: (..., 4); returns (..., height, width).

    Exact for a pinhole; behind a lens outward by up to a 16th of a pixel (`runtime.sensor_image`).
    """
    if scene.camera.pinhole:
        return image_of_ends(project(scene, states), scene.camera.shape)
    return np.maximum.reduce(sensor_images(scene, states), axis=-3)


def marking_images(scene: Scene, state: ArrayLike) -> NDArray[np.bool_]:
    """What each marking lights of `runway_image`. `state`: (4,); returns (markings, height, width)."""
    if scene.camera.pinhole:
        return image_of_ends(project(scene, state)[:, None], scene.camera.shape) != 0
    return sensor_images(scene, state) != 0


def dilated(frame: NDArray[np.bool_], radius_px: int) -> NDArray[np.bool_]:
    """The frame (height, width) with every pixel lit that has a lit one within `radius_px` in the sup norm."""
    if radius_px == 0:
        return frame
    wide = np.pad(frame, radius_px)
    span = 2 * radius_px + 1
    rows = np.logical_or.reduce([wide[shift : shift + len(frame)] for shift in range(span)])
    return np.logical_or.reduce([rows[:, shift : shift + frame.shape[1]] for shift in range(span)])

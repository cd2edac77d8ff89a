"""The spatial filters S_i: every pixel that some state of cell i lights (paper, Eq. (9) with the union it needs, erratum E3).

The cell is sliced finely in theta; within a slice, `build_model.enclosure` bounds what each row can show. S is the union over
the slices, widened by the tolerance and clipped to the frame.
"""

from __future__ import annotations

from functools import reduce

import numpy as np
from numpy.typing import NDArray

from build_model.enclosure import Columns, columns_that_may_be_lit, in_parts
from build_model.partition import partition
from build_model.pixel_mask import paint, widened, window_of
from build_model.window import Bits, Window
from runtime.camera import row_of_point
from runtime.scene import Bank, Camera, Scene, SceneError
from runtime.state_set import StateSet, contract, scale_range, tangent_of_row

BELOW_HORIZON_PX = 1
"""Least distance of a reference row from the horizon, px: twice what a loaded model must keep (`runtime.model.limits`)."""
FEW_BINS, FEW_CELLS = "bank.pitch_bins: too few", "domain.theta_rad: too few cells"
"""What is wrong where a box of states is too wide in theta: in a bank of masks, and in one of windows."""
SLICES = 32
"""Slices of theta a cell. Eight times as many take less than one pixel in 100 from S of the paper's cells."""


def sliced(lower: float, upper: float, bins: int) -> NDArray[np.float64]:
    """`bins` equal intervals that cover [lower, upper], (bins, 2); neighbours share their borders to the last bit."""
    edges = np.linspace(lower, upper, bins + 1)
    return np.stack([edges[:-1], edges[1:]], axis=-1)


def reference_row(camera: Camera, lower: NDArray[np.float64], upper: NDArray[np.float64], middle_z_m: float, few: str = FEW_BINS) -> float:
    """The row, rounded, where the box's middle state sees the middle of the runway, or the nearest one that bounds the scale well.

    It lies in the frame, where the scale says what a pixel sees, and `BELOW_HORIZON_PX` or more below the horizon of every theta of the
    box, so that no ratio of scales has a small divisor; on a frame that shows some theta no ground, that takes it below the frame. Raises
    `SceneError`, by `few` of what divides theta, where the box is too wide for that.
    """
    theta, _, y, z = (lower + upper) / 2
    row = float(row_of_point(camera, theta, y, z + middle_z_m))
    horizon = camera.v0 - camera.focal_v_px * np.tan(lower[0])
    if row <= horizon:
        raise SceneError(f"{few} for theta in [{lower[0]:.4g}, {upper[0]:.4g}]; give more, or narrower cells")
    return max(float(np.clip(np.round(row), 0, camera.height)), float(np.ceil(horizon)) + BELOW_HORIZON_PX)


def slice_cell(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], slices: int = SLICES) -> StateSet:
    """The box [lower, upper], both (4,), as `slices` thin sets along theta, with no bound on the scale of their own."""
    camera = scene.camera
    theta = sliced(lower[0], upper[0], slices)
    rest = [np.broadcast_to([low, high], (slices, 2)) for low, high in zip(lower[1:], upper[1:], strict=True)]
    few = FEW_BINS if isinstance(scene.bank, Bank) else FEW_CELLS
    row = reference_row(camera, lower, upper, scene.runway.ends_z_m.mean(), few)
    tangent = np.full(slices, tangent_of_row(camera, row))
    scale = np.stack(scale_range(camera, theta, rest[1], tangent), axis=-1)
    return contract(camera, StateSet(theta, rest[0], rest[1], rest[2], scale, tangent))


def spatial_filter(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> tuple[Bits, Window]:
    """S of the cell [lower, upper], both (4,): bits (rows, columns) in the window that is returned with them."""
    columns = _spatial_columns(scene, slice_cell(scene, lower, upper))
    window = window_of(columns)
    return np.logical_or.reduce(paint(columns, window), axis=0), window


def spatial_window(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> Window:
    """The window of the cell's S, at a small part of what it costs to paint it."""
    slices = slice_cell(scene, lower, upper)
    windows = [window_of(_spatial_columns(part, slices)) for part in in_parts(scene)]
    return reduce(Window.union, [window for window in windows if window.bottom] or windows[:1])


def spatial_spans(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> Columns:
    """First and last column of S that each marking can light in a row, (markings, height) each; none where last < first."""
    slices = slice_cell(scene, lower, upper)
    firsts, lasts = [], []
    for part in in_parts(scene):
        first, last = _spatial_columns(part, slices)
        firsts.append(first.min(axis=0))
        lasts.append(last.max(axis=0))
    return np.concatenate(firsts), np.concatenate(lasts)


def _spatial_columns(scene: Scene, slices: StateSet) -> Columns:
    """The columns of S in each slice of a cell, a marking and a row."""
    line_px = scene.tolerance.line_px
    return widened(scene, columns_that_may_be_lit(scene, slices, line_px), line_px)


def spatial_filters(scene: Scene) -> Bits:
    """S of every cell, (cells, height, width)."""
    cells = partition(scene)
    filters = np.zeros((len(cells), *scene.camera.shape), dtype=bool)
    for cell, (lower, upper) in enumerate(zip(cells.lower, cells.upper, strict=True)):
        bits, window = spatial_filter(scene, lower, upper)
        filters[(cell, *window.slices)] = bits
    return filters

"""S of every cell, as a model file has it: as runs down the columns of its window, or as spans of columns, row by row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.model.format import ModelError
from runtime.scene import Scene

Bits = NDArray[np.bool_]


@dataclass(frozen=True)
class SpatialRuns:
    """Ends of the runs of S: their cell, flat index in the window, and 1 at a start or -1 below a stop, (ends,) each."""

    cell: NDArray[np.int32]
    index: NDArray[np.int32]
    step: NDArray[np.int32]

    @staticmethod
    def of(scene: Scene, tensors: dict[str, NDArray[Any]], shape: tuple[int, int], name: str) -> SpatialRuns:
        """From the initialisers, copied so as not to keep the file. Raises `ModelError` for an index outside the window's `shape`."""
        limits = {"cell": (0, scene.domain.cell_count - 1), "index": (0, shape[0] * shape[1] - 1), "step": (-1, 1)}
        parts = [tensors[f"spatial_run_{part}"].copy() for part in limits]
        for part, (low, high) in zip(parts, limits.values(), strict=True):
            if part.min() < low or part.max() > high:
                raise ModelError(f"{name}: its window or its spatial masks lie outside the frame; export it again with export-model")
        return SpatialRuns(*parts)

    def bits(self, cell: int, shape: tuple[int, int]) -> Bits:
        """S of a cell in the window of this shape."""
        steps, own = np.zeros(shape, dtype=np.int32), self.cell == cell
        steps.ravel()[self.index[own]] = self.step[own]  # a run's stop lies below it, and so never on another one's start
        return steps.cumsum(axis=0) > 0


@dataclass(frozen=True)
class SpatialSpans:
    """The first column of each marking in each row of the window, and the one behind the last, (cells, markings, rows)."""

    first: NDArray[np.int16]
    stop: NDArray[np.int16]

    @staticmethod
    def of(tensors: dict[str, NDArray[Any]], shape: tuple[int, int], name: str) -> SpatialSpans:
        """From the initialisers, copied so as not to keep the file. Raises `ModelError` for a column outside the window's `shape`."""
        first, stop = (tensors[f"span_{side}"].copy() for side in ("first", "stop"))
        if first.min() < 0 or stop.max() > shape[1]:
            raise ModelError(f"{name}: its window or its spatial masks lie outside the frame; export it again with export-model")
        return SpatialSpans(first, stop)

    def bits(self, cell: int, shape: tuple[int, int]) -> Bits:
        """S of a cell in the window of this shape."""
        column = np.arange(shape[1])
        first, stop = (side[cell][:, :, None] for side in (self.first, self.stop))
        return ((column >= first) & (column < stop)).any(axis=0)

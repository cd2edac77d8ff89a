"""The partition of the domain into cells Xi_1 ... Xi_L (paper, section III.B): boxes in xi, tiling the domain."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.scene import Scene


@dataclass(frozen=True)
class Partition:
    """Cells as boxes: `lower` and `upper` are (cells, 4), row-major over (theta, x, y, z) in the order of the scene's centres."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.lower)


def partition(scene: Scene) -> Partition:
    """The scene's cells. Neighbours share their borders to the last bit, so that together they cover the domain."""
    intervals = [list(itertools.pairwise(axis.edges)) for axis in scene.domain.axes]
    boxes = np.array(list(itertools.product(*intervals)))
    return Partition(lower=boxes[:, :, 0], upper=boxes[:, :, 1])

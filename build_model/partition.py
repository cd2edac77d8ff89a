"""The partition of the domain into cells Xi_1 ... Xi_L (paper, section III.B): boxes in xi, whose union is the domain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.scene import Scene


@dataclass(frozen=True)
class Partition:
    """Cells as boxes: `lower` and `upper` are (cells, 4), numbered as `runtime.domain` says."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.lower)


def partition(scene: Scene) -> Partition:
    """The scene's cells. Neighbours share their borders to the last bit, so that together they cover the domain."""
    return Partition(*scene.domain.cells())

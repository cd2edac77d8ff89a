"""Pairs of bounds, and the methods by which they are found."""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bounds = tuple[Floats, Floats]
"""Lower and upper bounds, two arrays of one shape."""


class Method(StrEnum):
    """How a cell's pixels are bounded. All are sound; they differ in what they forget."""

    MIXED_MONOTONICITY = "mixed monotonicity"
    """The paper's: Proposition 2 on h, and on NN_r with all its partial networks."""
    INTERVALS = "intervals"
    """Interval arithmetic on the equations of h; then layer by layer, each layer's range over the box of its inputs."""
    CLOSED_FORM = "closed form"
    """Exact ranges of zeta and of phi_Lin; then layer by layer."""

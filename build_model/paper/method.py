"""The methods by which a cell's pixels are bounded, for the comparison of spatial filters."""

from __future__ import annotations

from enum import StrEnum


class Method(StrEnum):
    """How a cell's pixels are bounded. All are sound; they differ in what they forget."""

    MIXED_MONOTONICITY = "mixed monotonicity"
    """The paper's: Proposition 2 on h, and on NN_r with all its partial networks."""
    INTERVALS = "intervals"
    """Interval arithmetic on the equations of h; then layer by layer, each layer's range over the box of its inputs."""
    CLOSED_FORM = "closed form"
    """Exact ranges of zeta and of phi_Lin; then layer by layer."""

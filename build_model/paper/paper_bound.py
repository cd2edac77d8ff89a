"""The paper's bound on the estimate's error, 4 L_h delta (Theorem 1, Eq. (3))."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from build_model.enclosure import in_parts
from build_model.paper.method import Method
from build_model.paper.projection_bounds import projection_jacobian, zeta_bounds
from runtime.refine.interval import Floats, Interval
from runtime.rounding import above
from runtime.scene import Scene

NORM_INFLATION = 1 + 2.0**-40
"""Factor on norms of small matrices, far above the rounding of their evaluation and of the products within."""

KEPT_BITS = 24
"""Bits that are kept of a bound that LAPACK has a part in."""

DOT_PRODUCT_ERROR = 2.0**-48
"""Error of a dot product of four terms in float64 as a share of the sum of the terms' sizes; the bound on it is 4 x 2^-53."""

MOST_PIECES = 4096
"""Pieces of the cell, equal in number along each free axis, on which `paper_bound` bounds the Jacobian of h."""


@dataclass(frozen=True)
class PaperBound:
    """The paper's bound 4 L_h delta on an estimate's error (Theorem 1, Eq. (3)); not a certificate.

    It says only how far two states of one cell can be apart. It does not say that the aircraft is in that cell.
    """

    zeta_half_extent_px: float
    """delta: half the extent of h(cell), in px, along the coordinate of zeta where it is widest."""
    inverse_lipschitz_per_px: float
    """L_h: |xi - xi'| <= L_h |h(xi) - h(xi')| in the cell, Euclidean norms; state in rad and m, so 1/px."""

    def __post_init__(self) -> None:
        for name in ("zeta_half_extent_px", "inverse_lipschitz_per_px"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name}: found {getattr(self, name)}; a bound is positive and finite")

    @property
    def state_error(self) -> float:
        """4 L_h delta: Euclidean norm over (theta, x, y, z), rad and m alike, as the paper has it."""
        return 4 * self.inverse_lipschitz_per_px * self.zeta_half_extent_px


def paper_bound(scene: Scene, lower: ArrayLike, upper: ArrayLike) -> PaperBound | None:
    """The paper's 4 L_h delta for the cell [lower, upper], both (4,), from the marking that makes it smallest.

    delta is exact (closed forms, rounded outward). L_h bounds the inverse of h's mean-value Jacobian over the cell's free axes;
    zeta of one marking has four coordinates, as in the paper, which makes |h(xi) - h(xi')| <= 2 * 2 delta. None if no finite L_h
    could be proved: zeta then hardly depends on some axis, or the cell is wide. Raises `ValueError` as `zeta_bounds` does, and
    for a box of one state.
    """
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    bounds = [bound for part in in_parts(scene) for bound in _of_markings(part, low, high)]
    return min(bounds, key=lambda bound: bound.state_error, default=None)


def _of_markings(scene: Scene, lower: Floats, upper: Floats) -> list[PaperBound]:
    """The bounds of all markings that have one."""
    zeta_low, zeta_high = zeta_bounds(scene, lower, upper, Method.CLOSED_FORM)
    half_extent_px = above((zeta_high - zeta_low).max(axis=-1) / 2)
    constants = _inverse_lipschitz_per_px(scene, lower, upper)
    return [PaperBound(float(delta), L) for delta, L in zip(half_extent_px, constants, strict=True) if L is not None]


def _inverse_lipschitz_per_px(scene: Scene, lower: Floats, upper: Floats) -> list[float | None]:
    """L_h of each marking over a box (4,): |xi - xi'| <= L_h |h(xi) - h(xi')| for all states in it.

    h(xi) - h(xi') = A (xi - xi'), A the mean of the Jacobian J along the segment, which lies in the box. With any C, here the
    pseudo-inverse of J at the centre, I - C A is the mean of I - C J, so its norm is at most e = max |I - C J| over pieces of the
    box, and where e < 1: |xi - xi'| <= |C| |h(xi) - h(xi')| / (1 - e). J is interval-valued: |I - C J| <= |I - C mid| + |C| rad.
    """
    free = upper > lower
    if not free.any():
        raise ValueError(f"box: found the single state {lower}; give a box with a free axis")
    centre = (lower + upper) / 2
    inverse = np.linalg.pinv(projection_jacobian(scene, centre, centre)[0][..., free])
    low, high = (bound[..., free] for bound in projection_jacobian(scene, *_pieces(lower, upper)))
    middle, radius = (low + high) / 2, (high - low) / 2
    rounding = DOT_PRODUCT_ERROR * (np.abs(inverse) @ (np.abs(middle) + radius))
    deviation = np.abs(np.eye(free.sum()) - inverse @ middle) + np.abs(inverse) @ radius + rounding
    contraction = NORM_INFLATION * np.linalg.norm(deviation, 2, axis=(-2, -1)).max(axis=0)
    norms = NORM_INFLATION * np.linalg.norm(inverse, 2, axis=(-2, -1))
    return [_rounded_up(float(norm / (1 - e))) if e < 1 else None for norm, e in zip(norms, contraction, strict=True)]


def _rounded_up(value: float) -> float:
    """The next number of KEPT_BITS bits: LAPACK's last bits are not the same in every process, and should not be in a model's file."""
    mantissa, exponent = math.frexp(value)
    return math.ldexp(math.ceil(math.ldexp(mantissa, KEPT_BITS)), exponent - KEPT_BITS)


def _pieces(lower: Floats, upper: Floats) -> Interval:
    """The box [lower, upper], both (4,), cut into up to MOST_PIECES pieces along its free axes: two arrays (pieces, 4)."""
    cuts = round(MOST_PIECES ** (1 / (upper > lower).sum()))
    edges = [np.linspace(low, high, cuts + 1 if high > low else 2) for low, high in zip(lower, upper, strict=True)]
    pieces = np.array(list(itertools.product(*(itertools.pairwise(axis) for axis in edges))))
    return pieces[..., 0], pieces[..., 1]

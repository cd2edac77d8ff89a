"""Mixed monotonicity: the range of a map over a box from bounds on its Jacobian (paper, Proposition 2).

Proposition 2 is used as it was proved by Meyer (Reachability analysis of neural networks using mixed monotonicity, 2022): the
terms with alpha stand outside the map, not in its argument as printed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from runtime.refine.interval import Floats, Interval


def mixed_monotone_bounds(
    f: Callable[[Floats], Floats], jacobian_lower: Floats, jacobian_upper: Floats, lower: Floats, upper: Floats
) -> Interval:
    """Range of a vector map over boxes, from bounds on its Jacobian there (paper, Proposition 2, corrected).

    With row i of the Jacobian centred at J*: psi_lo_j, psi_hi_j, alpha_j = lower_j, upper_j, min(0, J_lo) where J*_j >= 0, else
    upper_j, lower_j, max(0, J_hi). Then f_i - alpha x rises from psi_lo to psi_hi, so that

        f_i(psi_lo) - alpha (psi_lo - psi_hi)  <=  f_i  <=  f_i(psi_hi) + alpha (psi_lo - psi_hi)

    `f`: (..., inputs) to (..., outputs), called with (..., outputs, inputs); Jacobian bounds (..., outputs, inputs), valid on the
    whole box; `lower`, `upper` (..., inputs). Returns two arrays (..., outputs). Exact wherever all signs of the Jacobian are
    known. Holds up to the rounding of f and of the sum above: the caller widens the result, or has f exact.
    """
    rising = jacobian_lower + jacobian_upper >= 0
    alpha = np.where(rising, np.minimum(0, jacobian_lower), np.maximum(0, jacobian_upper))
    low, high = lower[..., None, :], upper[..., None, :]
    psi_low, psi_high = np.where(rising, low, high), np.where(rising, high, low)
    slack = (alpha * (psi_low - psi_high)).sum(axis=-1)
    return _own_output(f(psi_low)) - slack, _own_output(f(psi_high)) + slack


def _own_output(values: Floats) -> Floats:
    """Output i at the point made for output i. (..., outputs, outputs) to (..., outputs)."""
    return np.diagonal(values, axis1=-2, axis2=-1)

"""Reachability of h and NN_r by mixed monotonicity (paper, Proposition 2 and Appendix B), beside plain intervals and closed forms.

This is the paper's road to the spatial filters S: bound zeta = h(xi) over a cell, then NN_r over the box of zeta; a pixel whose
upper bound is 0 is dark in every image of the cell. `build_model.spatial_filter` takes a closer one, because a box of zeta
forgets that all four coordinates belong to one state; `scripts/compare_spatial_filters.py` prints what that costs.

Bounds of h are in `projection_bounds`, those of NN_r in `network_bounds`, Proposition 2 in `mixed_monotonicity`.

Soundness. Boxes of zeta are rounded outward, then snapped outward to a dyadic grid so coarse that NN_r, its Jacobian and the
terms of Proposition 2 are exact in float64 over them: a bound of 0 is 0. The outward margin also covers ties: a marking that
lights a half-open pixel by touching its border crosses the pixel's inside after a shift within the margin, and NN_r lights it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from build_model.paper.method import Method
from build_model.paper.network_bounds import network_upper_bounds
from build_model.paper.projection_bounds import zeta_bounds
from build_model.window import Bits, Window
from runtime.refine.interval import Floats
from runtime.scene import Scene


def possible_pixels(
    scene: Scene, lower: ArrayLike, upper: ArrayLike, method: Method, window: Window | None = None, *, between_ends: bool = True
) -> Bits:
    """Pixels of the window, by default the frame, that some state of the box [lower, upper], both (4,), may light: (rows, columns).

    The paper's S (Eq. (9), with the union it needs) by reachability of NN_r(h(xi)). Contains I_r of every state of the box,
    ties included; markings are joined by OR. With `between_ends` a marking's pixels outside the rectangle that its box of zeta
    spans are dark without asking the network: a marking lies between its ends. Without it this is the paper's method as it
    stands. Where the bounds of v1 and v2 overlap it then lights whole rows of the frame, because it does not see that both
    corners of a far edge lie on one side of the line: they are bounded one by one. Raises `ValueError` as `zeta_bounds` does.
    """
    height, width = scene.camera.shape
    window = window or Window(0, height, 0, width)
    bits = np.zeros((height, width), dtype=bool)
    for low, high in zip(*zeta_bounds(scene, lower, upper, method), strict=True):
        part = _within(window, low, high) if between_ends else window
        bits[part.slices] |= network_upper_bounds(part, low, high, method) > 0
    return bits[window.slices]


def _within(window: Window, lower: Floats, upper: Floats) -> Window:
    """The part of the window that both ends, and so the marking between them, stay in for a box of zeta; may be empty."""
    left, top = np.floor(lower.reshape(2, 2).min(axis=0)).astype(int)
    right, bottom = np.floor(upper.reshape(2, 2).max(axis=0)).astype(int) + 1
    top, left = int(np.clip(top, window.top, window.bottom)), int(np.clip(left, window.left, window.right))
    return Window(top, int(np.clip(bottom, top, window.bottom)), left, int(np.clip(right, left, window.right)))

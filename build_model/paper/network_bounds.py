"""Bounds of NN_r at every pixel over a box of zeta, by any of the methods. Those of partial networks are intersected, as Meyer does.

Soundness. Boxes of zeta are snapped outward to a dyadic grid so coarse that NN_r, its Jacobian and the terms of Proposition 2 are exact
in float64 over them: a bound of 0 is 0.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from build_model.paper.method import Method
from build_model.paper.mixed_monotonicity import mixed_monotone_bounds
from build_model.paper.network_layers import Layer, determinant, layers, pairs_of
from build_model.paper.runway_network import ABS_PAIRS, MIN_PAIRS, pixel_weights
from build_model.window import Window
from runtime.refine.interval import Floats, Interval, intersected

ZETA_BITS = 22
"""Bits of a snapped coordinate of zeta. A product takes 44, Proposition 2 up to 9 more: float64's 53 hold them all."""

PIXELS_AT_ONCE = 128
"""Pixels whose Jacobians are held in memory together."""


def _interval_product(left: Interval, right: Interval) -> Interval:
    """Bounds of the product of two matrices between bounds, (pixels, n, m) and (pixels, m, p)."""
    factors = (left[0][..., None], left[1][..., None])
    from_low, from_high = [(a * right[0][:, None], a * right[1][:, None]) for a in factors]
    low = np.minimum(np.minimum(*from_low), np.minimum(*from_high))
    high = np.maximum(np.maximum(*from_low), np.maximum(*from_high))
    return low.sum(axis=-2), high.sum(axis=-2)


@dataclass(frozen=True)
class _PartialNetwork:
    """The layers from one source on, over the box of that source's values; `reached` holds all that they make of the box."""

    source: Interval
    maps: tuple[Callable[[Floats], Floats], ...]
    jacobian: Interval
    reached: Interval

    @staticmethod
    def start(box: Interval) -> _PartialNetwork:
        identity = np.broadcast_to(np.eye(box[0].shape[-1]), (*box[0].shape, box[0].shape[-1]))
        return _PartialNetwork(box, (), (identity, identity), box)

    def then(self, layer: Layer) -> _PartialNetwork:
        """One layer more. Its Jacobian is bounded over `reached`, which holds every value that the Jacobian's product is taken at."""
        maps, own = (*self.maps, layer.apply), layer.jacobian(*self.reached)
        jacobian = own if not self.maps else _interval_product(own, self.jacobian)

        def whole(values: Floats) -> Floats:
            for step in maps:
                values = step(values)
            return values

        from_source = mixed_monotone_bounds(whole, *jacobian, *self.source)
        from_before = mixed_monotone_bounds(layer.apply, *own, *self.reached) if self.maps else from_source
        return _PartialNetwork(self.source, maps, jacobian, intersected(from_source, from_before))


def mixed_monotone_layers(network: Sequence[Layer], lower: Floats, upper: Floats) -> list[Interval]:
    """Bounds of every layer's outputs over boxes of zeta, by Proposition 2 on all partial networks, intersected (Meyer 2022).

    `lower`, `upper`: (pixels, 4) px. Returns one pair of arrays (pixels, outputs) a layer. Exact arithmetic on snapped boxes.
    """
    boxes, partials = [(lower, upper)], list[_PartialNetwork]()
    for layer in network:
        partials = [partial.then(layer) for partial in [*partials, _PartialNetwork.start(boxes[-1])]]
        boxes.append(functools.reduce(intersected, (partial.reached for partial in partials)))
    return boxes[1:]


def linear_layer_by_intervals(weights: Floats, lower: Floats, upper: Floats) -> Interval:
    """Bounds of phi_Lin over a box of zeta (4,) by interval arithmetic on det and on W. Returns two arrays (pixels, 16)."""
    (u1_v2, v1_u2) = (np.outer([lower[a], upper[a]], [lower[b], upper[b]]) for a, b in ((0, 3), (1, 2)))
    low = np.array([*lower, u1_v2.min() - v1_u2.max(), 1.0])
    high = np.array([*upper, u1_v2.max() - v1_u2.min(), 1.0])
    ends = weights * low, weights * high
    return np.minimum(*ends).sum(axis=-1), np.maximum(*ends).sum(axis=-1)


def linear_layer_range(weights: Floats, lower: Floats, upper: Floats) -> Interval:
    """Exact range of phi_Lin over a box of zeta (4,): it is affine in each coordinate, so its extremes lie at the 16 corners."""
    corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
    inputs = np.concatenate([determinant(corners), np.ones((16, 1))], axis=-1)
    values = inputs @ weights.swapaxes(-1, -2)
    return values.min(axis=-2), values.max(axis=-2)


def _upper_bound_of_image(linear: Interval) -> Floats:
    """Upper bound of NN_r (pixels,) from bounds of phi_Lin: the exact ranges of phi_Abs, phi_Min and ReLU over their boxes.

    |a| + |b| - |a + b| = 2 max(0, min(a, -b), min(-a, b)), so its largest value lies at (a_high, b_low) or (a_low, b_high).
    """
    (a_low, b_low), (a_high, b_high) = pairs_of(linear[0], ABS_PAIRS), pairs_of(linear[1], ABS_PAIRS)
    crossing = 2 * np.maximum(np.maximum(np.minimum(a_high, -b_low), np.minimum(-a_low, b_high)), 0)
    return np.minimum(*pairs_of(crossing, MIN_PAIRS)).sum(axis=-1)


def snap_outward(lower: Floats, upper: Floats, window: Window) -> Interval:
    """Boxes of zeta widened to multiples of 2^(e - ZETA_BITS) px, where 2^e exceeds every coordinate of boxes and window."""
    largest = max(np.abs(lower).max(), np.abs(upper).max(), window.bottom, window.right) + 1
    grid = 2.0 ** (np.ceil(np.log2(largest)) - ZETA_BITS)
    return np.floor(lower / grid) * grid, np.ceil(upper / grid) * grid


def network_upper_bounds(window: Window, lower: Floats, upper: Floats, method: Method, *, printed_jacobians: bool = False) -> Floats:
    """Upper bound of NN_r at every pixel of the window over one box of zeta (4,): (rows, columns). 0: dark, and free of rounding.

    `printed_jacobians` as in `layers`; only `Method.MIXED_MONOTONICITY` uses Jacobians.
    """
    if 0 in window.shape:
        return np.zeros(window.shape)
    low, high = snap_outward(lower, upper, window)
    weights = pixel_weights(window).reshape(-1, 16, 6)
    if method is Method.INTERVALS:
        return _upper_bound_of_image(linear_layer_by_intervals(weights, low, high)).reshape(window.shape)
    if method is Method.CLOSED_FORM:
        return _upper_bound_of_image(linear_layer_range(weights, low, high)).reshape(window.shape)
    parts = []
    for start in range(0, len(weights), PIXELS_AT_ONCE):
        part = weights[start : start + PIXELS_AT_ONCE]
        boxes = (np.broadcast_to(bound, (len(part), 4)) for bound in (low, high))
        parts.append(mixed_monotone_layers(layers(part, printed_jacobians=printed_jacobians), *boxes)[-1][1])
    return np.concatenate(parts).reshape(window.shape)

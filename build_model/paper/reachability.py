"""Reachability of h and NN_r by mixed monotonicity (paper, Proposition 2 and Appendix B), beside plain intervals and closed forms.

This is the paper's road to the spatial filters S: bound zeta = h(xi) over a cell, then NN_r over the box of zeta; a pixel whose
upper bound is 0 is dark in every image of the cell. `build_model.spatial_filter` takes a closer one, because a box of zeta
forgets that all four coordinates belong to one state; `scripts/compare_spatial_filters.py` prints what that costs.

Proposition 2 is used as it was proved by Meyer (Reachability analysis of neural networks using mixed monotonicity, 2022): the
terms with alpha stand outside the network, not in its argument as printed, and bounds of partial networks are intersected.

Soundness. Boxes of zeta are rounded outward, then snapped outward to a dyadic grid so coarse that NN_r, its Jacobian and the
terms of Proposition 2 are exact in float64 over them: a bound of 0 is 0. The outward margin also covers ties: a marking that
lights a half-open pixel by touching its border crosses the pixel's inside after a shift within the margin, and NN_r lights it.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from build_model.paper.runway_network import ABS_PAIRS, MIN_PAIRS, pixel_weights
from build_model.pixel_mask import Bits, Window
from runtime.camera import project, row_of_point
from runtime.rounding import above, below
from runtime.scene import Scene

Floats = NDArray[np.float64]
Bounds = tuple[Floats, Floats]
"""Lower and upper bounds, two arrays of one shape."""

TRIGONOMETRIC_ERROR = 2.0**-50
"""Bound on the error of numpy's sin and cos: 4 units in the last place, the largest that numpy allows its vector code."""

NORM_INFLATION = 1 + 2.0**-40
"""Factor on norms of small matrices, far above the rounding of their evaluation and of the products within."""

KEPT_BITS = 24
"""Bits that are kept of a bound that LAPACK has a part in."""

DOT_PRODUCT_ERROR = 2.0**-48
"""Error of a dot product of four terms in float64 as a share of the sum of the terms' sizes; the bound on it is 4 x 2^-53."""

ZETA_BITS = 22
"""Bits of a snapped coordinate of zeta. A product takes 44, Proposition 2 up to 9 more: float64's 53 hold them all."""

PIXELS_AT_ONCE = 128
"""Pixels whose Jacobians are held in memory together."""

MOST_PIECES = 4096
"""Pieces of the cell, equal in number along each free axis, on which `paper_bound` bounds the Jacobian of h."""


class Method(StrEnum):
    """How a cell's pixels are bounded. All are sound; they differ in what they forget."""

    MIXED_MONOTONICITY = "mixed monotonicity"
    """The paper's: Proposition 2 on h, and on NN_r with all its partial networks."""
    INTERVALS = "intervals"
    """Interval arithmetic on the equations of h; then layer by layer, each layer's range over the box of its inputs."""
    CLOSED_FORM = "closed form"
    """Exact ranges of zeta and of phi_Lin; then layer by layer."""


# Proposition 2


def mixed_monotone_bounds(
    f: Callable[[Floats], Floats], jacobian_lower: Floats, jacobian_upper: Floats, lower: Floats, upper: Floats
) -> Bounds:
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


# Interval arithmetic


@dataclass(frozen=True)
class Interval:
    """An array of intervals; every operation rounds outward, so that results contain all real results."""

    lower: Floats
    upper: Floats

    @staticmethod
    def of(value: ArrayLike) -> Interval:
        """The number itself."""
        return Interval(np.asarray(value, dtype=np.float64), np.asarray(value, dtype=np.float64))

    def __neg__(self) -> Interval:
        return Interval(-self.upper, -self.lower)

    def __add__(self, other: Interval) -> Interval:
        return _outward(self.lower + other.lower, self.upper + other.upper)

    def __sub__(self, other: Interval) -> Interval:
        return self + -other

    def __mul__(self, other: Interval) -> Interval:
        products = [a * b for a in (self.lower, self.upper) for b in (other.lower, other.upper)]
        return _outward(np.minimum.reduce(products), np.maximum.reduce(products))

    def __truediv__(self, other: Interval) -> Interval:
        """Raises `ValueError` unless the divisor is positive."""
        if np.any(other.lower <= 0):
            raise ValueError(f"box: a depth Z of {other.lower.min():.3g} m is not excluded by intervals; divide the box into narrower ones")
        return self * _outward(1 / other.upper, 1 / other.lower)

    def square(self) -> Interval:
        """The square, which is not negative."""
        largest = np.maximum(np.abs(self.lower), np.abs(self.upper))
        smallest = np.where((self.lower <= 0) & (self.upper >= 0), 0, np.minimum(np.abs(self.lower), np.abs(self.upper)))
        squares = _outward(smallest**2, largest**2)
        return Interval(np.maximum(squares.lower, 0), squares.upper)

    def sin(self) -> Interval:
        """The sine of angles within -pi/2 and pi/2, where it rises."""
        return Interval(np.sin(self.lower) - TRIGONOMETRIC_ERROR, np.sin(self.upper) + TRIGONOMETRIC_ERROR)

    def cos(self) -> Interval:
        """The cosine of angles within -pi/2 and pi/2, where it rises up to 0 and falls from there."""
        low, high = np.cos(self.lower), np.cos(self.upper)
        peak = np.where((self.lower <= 0) & (self.upper >= 0), 1.0, np.maximum(low, high))
        return Interval(np.minimum(low, high) - TRIGONOMETRIC_ERROR, peak + TRIGONOMETRIC_ERROR)


def _outward(lower: Floats, upper: Floats) -> Interval:
    return Interval(np.nextafter(lower, -np.inf), np.nextafter(upper, np.inf))


# The change of coordinates h


@dataclass(frozen=True)
class _EndGeometry:
    """The camera's equations (`runtime.camera`) for every end of every marking over boxes of states; fields (..., markings, 2)."""

    sine: Interval
    cosine: Interval
    across: Interval  # X = p_x - x
    altitude: Interval  # y
    ahead: Interval  # d = p_z + z
    upward: Interval  # Y
    depth: Interval  # Z


def _end_geometry(scene: Scene, lower: Floats, upper: Floats) -> _EndGeometry:
    theta, x, y, z = (Interval(lower[..., axis, None, None], upper[..., axis, None, None]) for axis in range(4))
    sine, cosine = theta.sin(), theta.cos()
    across, ahead = Interval.of(scene.runway.x_m[:, None]) - x, Interval.of(scene.runway.ends_z_m) + z
    return _EndGeometry(sine, cosine, across, y, ahead, ahead * sine - y * cosine, y * sine + ahead * cosine)


def _stack(parts: Sequence[Interval], axis: int) -> Interval:
    lowers = np.broadcast_arrays(*(part.lower for part in parts))
    uppers = np.broadcast_arrays(*(part.upper for part in parts))
    return Interval(np.stack(lowers, axis=axis), np.stack(uppers, axis=axis))


def projection_jacobian(scene: Scene, lower: ArrayLike, upper: ArrayLike) -> Bounds:
    """Bounds of the Jacobian of zeta = (u1, v1, u2, v2) by (theta, x, y, z), by interval arithmetic.

        du = F (X Y / Z^2, -1 / Z, -X sin(theta) / Z^2, -X cos(theta) / Z^2)
        dv = F (-1 - (Y / Z)^2, 0, d / Z^2, -y / Z^2)

    `lower`, `upper`: boxes of states, (..., 4). Returns two arrays (..., markings, 4, 4), px per rad or m, rounded outward.
    Raises `ValueError` if intervals cannot exclude Z <= 0.
    """
    geometry = _end_geometry(scene, np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64))
    one, focal, squared = Interval.of(1.0), Interval.of(scene.camera.focal_px), geometry.depth.square()
    side, rise = geometry.across / geometry.depth, geometry.upward / geometry.depth
    shrink = side / geometry.depth
    u = _stack([side * rise, -(one / geometry.depth), -(shrink * geometry.sine), -(shrink * geometry.cosine)], axis=-1)
    v = _stack([-(one + rise.square()), Interval.of(0.0), geometry.ahead / squared, -(geometry.altitude / squared)], axis=-1)
    jacobian = focal * _stack([u, v], axis=-2)
    shape = (*jacobian.lower.shape[:-3], 4, 4)
    return jacobian.lower.reshape(shape), jacobian.upper.reshape(shape)


def zeta_bounds(scene: Scene, lower: ArrayLike, upper: ArrayLike, method: Method) -> Bounds:
    """Bounds of zeta = h(xi) over boxes of states.

    `lower`, `upper`: (..., 4) with y > 0 and all ends ahead of the camera. Returns two arrays (..., markings, 4) px, order
    (u1, v1, u2, v2), rounded outward. `Method.CLOSED_FORM` gives the exact range of each coordinate. Raises `ValueError` if a
    method cannot exclude an end beside or behind the camera.
    """
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    bound = {Method.MIXED_MONOTONICITY: _zeta_mixed, Method.INTERVALS: _zeta_intervals, Method.CLOSED_FORM: _zeta_closed_form}[method]
    zeta_low, zeta_high = bound(scene, low, high)
    return below(zeta_low), above(zeta_high)


def _zeta_mixed(scene: Scene, lower: Floats, upper: Floats) -> Bounds:
    jacobian_low, jacobian_high = projection_jacobian(scene, lower, upper)
    bounds = []
    for marking in range(len(scene.runway.markings)):

        def h(states: Floats, marking: int = marking) -> Floats:
            return project(scene, states)[..., marking, :, :].reshape(states.shape)

        bounds.append(mixed_monotone_bounds(h, jacobian_low[..., marking, :, :], jacobian_high[..., marking, :, :], lower, upper))
    return np.stack([low for low, _ in bounds], axis=-2), np.stack([high for _, high in bounds], axis=-2)


def _zeta_intervals(scene: Scene, lower: Floats, upper: Floats) -> Bounds:
    geometry, camera = _end_geometry(scene, lower, upper), scene.camera
    focal = Interval.of(camera.focal_px)
    u = Interval.of(camera.u0) + focal * (geometry.across / geometry.depth)
    v = Interval.of(camera.v0) - focal * (geometry.upward / geometry.depth)
    zeta = _stack([u, v], axis=-1)
    shape = (*zeta.lower.shape[:-2], 4)
    return zeta.lower.reshape(shape), zeta.upper.reshape(shape)


def _zeta_closed_form(scene: Scene, lower: Floats, upper: Floats) -> Bounds:
    """Row of an end: up in y, down in z and theta. Column: X/Z, where X depends on x only and Z on all but x: both ranges are met."""
    camera = scene.camera
    theta, y = ((lower[..., axis, None, None], upper[..., axis, None, None]) for axis in (0, 2))
    ahead = [scene.runway.ends_z_m + bound[..., 3, None, None] for bound in (lower, upper)]
    across = [scene.runway.x_m[:, None] - bound[..., 1, None, None] for bound in (upper, lower)]
    depths = _depth_range(theta, y, (ahead[0], ahead[1]))
    if np.any(depths[0] <= 0):
        raise ValueError(f"box: an end has a depth Z of {depths[0].min():.3g} m; narrow the box to states with the runway ahead")
    quotients = [x / depth for x in across for depth in depths]
    u = [camera.u0 + camera.focal_px * extreme.reduce(quotients) for extreme in (np.minimum, np.maximum)]
    v = row_of_point(camera, theta[1], y[0], ahead[1]), row_of_point(camera, theta[0], y[1], ahead[0])
    low, high = (np.stack(np.broadcast_arrays(*pair), axis=-1) for pair in zip(u, v, strict=True))
    return low.reshape(*low.shape[:-2], 4), high.reshape(*high.shape[:-2], 4)


def _depth_range(theta: Bounds, y: Bounds, ahead: Bounds) -> Bounds:
    """Exact range of Z = y sin(theta) + d cos(theta) > 0: linear in y and d, and concave in theta with its top at atan2(y, d)."""
    depths = []
    for altitude, distance in itertools.product(y, ahead):
        top = np.clip(np.arctan2(altitude, distance), *theta)
        depths += [altitude * np.sin(angle) + distance * np.cos(angle) for angle in (*theta, top)]
    return np.minimum.reduce(depths), np.maximum.reduce(depths)


# The network NN_r


@dataclass(frozen=True)
class Layer:
    """A layer of NN_r at a batch of pixels: the map (pixels, ..., inputs) to (pixels, ..., outputs), and bounds of its Jacobian.

    `jacobian` takes a box of inputs, two arrays (pixels, inputs), and returns bounds valid on all of it, (pixels, outputs, inputs).
    """

    apply: Callable[[Floats], Floats]
    jacobian: Callable[[Floats, Floats], Bounds]


def layers(weights: Floats, *, printed_jacobians: bool = False) -> list[Layer]:
    """phi_Det, phi_Lin, phi_Abs, phi_Min and ReLU at pixels with W = `weights`, (pixels, 16, 6).

    The Jacobians of phi_Abs and phi_Min are bounded over the box of their inputs; with `printed_jacobians` by the constants
    [-2, 2] and [0, 1] of Appendix B. Those are true bounds, but with them every pixel has a positive upper bound.
    """
    abs_jacobian = _constant_jacobian(ABS_PAIRS, 16, -2.0, 2.0) if printed_jacobians else _abs_jacobian
    min_jacobian = _constant_jacobian(MIN_PAIRS, 12, 0.0, 1.0) if printed_jacobians else _min_jacobian
    linear = weights[:, :, :5]
    return [
        Layer(_det, _det_jacobian),
        Layer(lambda inputs: _at_pixels(linear, inputs) + _beside(weights[:, :, 5], inputs), lambda _low, _high: (linear, linear)),
        Layer(_abs, abs_jacobian),
        Layer(lambda inputs: np.minimum(*_pairs(inputs, MIN_PAIRS)), min_jacobian),
        Layer(lambda inputs: np.maximum(inputs.sum(axis=-1, keepdims=True), 0), _relu_jacobian),
    ]


def _at_pixels(matrices: Floats, inputs: Floats) -> Floats:
    """Each pixel's matrix on its inputs: (pixels, outputs, inputs), (pixels, ..., inputs) to (pixels, ..., outputs)."""
    flat = inputs.reshape(len(inputs), -1, inputs.shape[-1])
    return (flat @ matrices.swapaxes(-1, -2)).reshape(*inputs.shape[:-1], -1)


def _beside(bias: Floats, inputs: Floats) -> Floats:
    return bias.reshape(len(bias), *(1,) * (inputs.ndim - 2), -1)


def _pairs(values: Floats, pairs: tuple[tuple[int, int], ...]) -> tuple[Floats, Floats]:
    first, second = zip(*pairs, strict=True)
    return values[..., list(first)], values[..., list(second)]


def _det(zeta: Floats) -> Floats:
    u1, v1, u2, v2 = np.moveaxis(zeta, -1, 0)
    return np.concatenate([zeta, (u1 * v2 - v1 * u2)[..., None]], axis=-1)


def _det_jacobian(lower: Floats, upper: Floats) -> Bounds:
    identity = np.broadcast_to(np.eye(4), (len(lower), 4, 4))
    rows = [np.stack([a[:, 3], -b[:, 2], -b[:, 1], a[:, 0]], axis=-1)[:, None] for a, b in ((lower, upper), (upper, lower))]
    return np.concatenate([identity, rows[0]], axis=1), np.concatenate([identity, rows[1]], axis=1)


def _abs(values: Floats) -> Floats:
    first, second = _pairs(values, ABS_PAIRS)
    return np.abs(first) + np.abs(second) - np.abs(first + second)


def _place(pairs: tuple[tuple[int, int], ...], inputs: int, first: Floats, second: Floats) -> Floats:
    """The Jacobian (pixels, pairs, inputs) whose row k holds `first[:, k]` and `second[:, k]` at the inputs of pair k."""
    jacobian = np.zeros((len(first), len(pairs), inputs))
    output = np.arange(len(pairs))
    jacobian[:, output, [pair[0] for pair in pairs]] = first
    jacobian[:, output, [pair[1] for pair in pairs]] = second
    return jacobian


def _constant_jacobian(pairs: tuple[tuple[int, int], ...], inputs: int, low: float, high: float) -> Callable[[Floats, Floats], Bounds]:
    def jacobian(lower: Floats, _upper: Floats) -> Bounds:
        ones = np.ones((len(lower), len(pairs)))
        return _place(pairs, inputs, low * ones, low * ones), _place(pairs, inputs, high * ones, high * ones)

    return jacobian


def _abs_jacobian(lower: Floats, upper: Floats) -> Bounds:
    """d/da (|a| + |b| - |a + b|) is 2 where a > 0 > a + b, -2 where a < 0 < a + b, else 0; likewise for b."""
    (a_low, b_low), (a_high, b_high) = _pairs(lower, ABS_PAIRS), _pairs(upper, ABS_PAIRS)

    def derivative(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> Bounds:
        falls = (low < 0) & (np.minimum(high, 0) + other_high > 0)
        rises = (high > 0) & (np.maximum(low, 0) + other_low < 0)
        return np.where(falls, -2.0, 0.0), np.where(rises, 2.0, 0.0)

    first, second = derivative(a_low, a_high, b_low, b_high), derivative(b_low, b_high, a_low, a_high)
    return _place(ABS_PAIRS, 16, first[0], second[0]), _place(ABS_PAIRS, 16, first[1], second[1])


def _min_jacobian(lower: Floats, upper: Floats) -> Bounds:
    """d/da min(a, b) is 1 where a < b and 0 where a > b."""
    (a_low, b_low), (a_high, b_high) = _pairs(lower, MIN_PAIRS), _pairs(upper, MIN_PAIRS)
    low = _place(MIN_PAIRS, 12, (a_high < b_low).astype(np.float64), (b_high < a_low).astype(np.float64))
    high = _place(MIN_PAIRS, 12, (a_low <= b_high).astype(np.float64), (b_low <= a_high).astype(np.float64))
    return low, high


def _relu_jacobian(lower: Floats, upper: Floats) -> Bounds:
    """d ReLU(sum) is 1 where the sum is positive and 0 where it is negative."""
    low, high = lower.sum(axis=-1) > 0, upper.sum(axis=-1) > 0
    wide = np.ones((len(lower), 1, lower.shape[-1]))
    return low[:, None, None] * wide, high[:, None, None] * wide


def _interval_product(left: Bounds, right: Bounds) -> Bounds:
    """Bounds of the product of two matrices between bounds, (pixels, n, m) and (pixels, m, p)."""
    factors = (left[0][..., None], left[1][..., None])
    from_low, from_high = [(a * right[0][:, None], a * right[1][:, None]) for a in factors]
    low = np.minimum(np.minimum(*from_low), np.minimum(*from_high))
    high = np.maximum(np.maximum(*from_low), np.maximum(*from_high))
    return low.sum(axis=-2), high.sum(axis=-2)


def _intersect(first: Bounds, second: Bounds) -> Bounds:
    return np.maximum(first[0], second[0]), np.minimum(first[1], second[1])


@dataclass(frozen=True)
class _PartialNetwork:
    """The layers from one source on, over the box of that source's values; `reached` holds all that they make of the box."""

    source: Bounds
    maps: tuple[Callable[[Floats], Floats], ...]
    jacobian: Bounds
    reached: Bounds

    @staticmethod
    def start(box: Bounds) -> _PartialNetwork:
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
        return _PartialNetwork(self.source, maps, jacobian, _intersect(from_source, from_before))


def mixed_monotone_layers(network: Sequence[Layer], lower: Floats, upper: Floats) -> list[Bounds]:
    """Bounds of every layer's outputs over boxes of zeta, by Proposition 2 on all partial networks, intersected (Meyer 2022).

    `lower`, `upper`: (pixels, 4) px. Returns one pair of arrays (pixels, outputs) a layer. Exact arithmetic on snapped boxes.
    """
    boxes, partials = [(lower, upper)], list[_PartialNetwork]()
    for layer in network:
        partials = [partial.then(layer) for partial in [*partials, _PartialNetwork.start(boxes[-1])]]
        boxes.append(functools.reduce(_intersect, (partial.reached for partial in partials)))
    return boxes[1:]


def linear_layer_by_intervals(weights: Floats, lower: Floats, upper: Floats) -> Bounds:
    """Bounds of phi_Lin over a box of zeta (4,) by interval arithmetic on det and on W. Returns two arrays (pixels, 16)."""
    (u1_v2, v1_u2) = (np.outer([lower[a], upper[a]], [lower[b], upper[b]]) for a, b in ((0, 3), (1, 2)))
    low = np.array([*lower, u1_v2.min() - v1_u2.max(), 1.0])
    high = np.array([*upper, u1_v2.max() - v1_u2.min(), 1.0])
    ends = weights * low, weights * high
    return np.minimum(*ends).sum(axis=-1), np.maximum(*ends).sum(axis=-1)


def linear_layer_range(weights: Floats, lower: Floats, upper: Floats) -> Bounds:
    """Exact range of phi_Lin over a box of zeta (4,): it is affine in each coordinate, so its extremes lie at the 16 corners."""
    corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
    inputs = np.concatenate([_det(corners), np.ones((16, 1))], axis=-1)
    values = inputs @ weights.swapaxes(-1, -2)
    return values.min(axis=-2), values.max(axis=-2)


def _upper_bound_of_image(linear: Bounds) -> Floats:
    """Upper bound of NN_r (pixels,) from bounds of phi_Lin: the exact ranges of phi_Abs, phi_Min and ReLU over their boxes.

    |a| + |b| - |a + b| = 2 max(0, min(a, -b), min(-a, b)), so its largest value lies at (a_high, b_low) or (a_low, b_high).
    """
    (a_low, b_low), (a_high, b_high) = _pairs(linear[0], ABS_PAIRS), _pairs(linear[1], ABS_PAIRS)
    crossing = 2 * np.maximum(np.maximum(np.minimum(a_high, -b_low), np.minimum(-a_low, b_high)), 0)
    return np.minimum(*_pairs(crossing, MIN_PAIRS)).sum(axis=-1)


def snap_outward(lower: Floats, upper: Floats, window: Window) -> Bounds:
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


# The paper's bound on the estimate


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
    zeta_low, zeta_high = zeta_bounds(scene, low, high, Method.CLOSED_FORM)
    half_extent_px = above((zeta_high - zeta_low).max(axis=-1) / 2)
    constants = _inverse_lipschitz_per_px(scene, low, high)
    bounds = [PaperBound(float(delta), L) for delta, L in zip(half_extent_px, constants, strict=True) if L is not None]
    return min(bounds, key=lambda bound: bound.state_error, default=None)


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


def _pieces(lower: Floats, upper: Floats) -> Bounds:
    """The box [lower, upper], both (4,), cut into up to MOST_PIECES pieces along its free axes: two arrays (pieces, 4)."""
    cuts = round(MOST_PIECES ** (1 / (upper > lower).sum()))
    edges = [np.linspace(low, high, cuts + 1 if high > low else 2) for low, high in zip(lower, upper, strict=True)]
    pieces = np.array(list(itertools.product(*(itertools.pairwise(axis) for axis in edges))))
    return pieces[..., 0], pieces[..., 1]

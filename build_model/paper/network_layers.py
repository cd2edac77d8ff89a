"""The layers of NN_r with bounds of their Jacobians (paper, Appendix B)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from build_model.paper.runway_network import ABS_PAIRS, MIN_PAIRS
from runtime.refine.interval import Floats, Interval


@dataclass(frozen=True)
class Layer:
    """A layer of NN_r at a batch of pixels: the map (pixels, ..., inputs) to (pixels, ..., outputs), and bounds of its Jacobian.

    `jacobian` takes a box of inputs, two arrays (pixels, inputs), and returns bounds valid on all of it, (pixels, outputs, inputs).
    """

    apply: Callable[[Floats], Floats]
    jacobian: Callable[[Floats, Floats], Interval]


def layers(weights: Floats, *, printed_jacobians: bool = False) -> list[Layer]:
    """phi_Det, phi_Lin, phi_Abs, phi_Min and ReLU at pixels with W = `weights`, (pixels, 16, 6).

    The Jacobians of phi_Abs and phi_Min are bounded over the box of their inputs; with `printed_jacobians` by the constants
    [-2, 2] and [0, 1] of Appendix B. Those are true bounds, but with them every pixel has a positive upper bound.
    """
    abs_jacobian = _constant_jacobian(ABS_PAIRS, 16, -2.0, 2.0) if printed_jacobians else _abs_jacobian
    min_jacobian = _constant_jacobian(MIN_PAIRS, 12, 0.0, 1.0) if printed_jacobians else _min_jacobian
    linear = weights[:, :, :5]
    return [
        Layer(determinant, _det_jacobian),
        Layer(lambda inputs: _at_pixels(linear, inputs) + _beside(weights[:, :, 5], inputs), lambda _low, _high: (linear, linear)),
        Layer(_abs, abs_jacobian),
        Layer(lambda inputs: np.minimum(*pairs_of(inputs, MIN_PAIRS)), min_jacobian),
        Layer(lambda inputs: np.maximum(inputs.sum(axis=-1, keepdims=True), 0), _relu_jacobian),
    ]


def _at_pixels(matrices: Floats, inputs: Floats) -> Floats:
    """Each pixel's matrix on its inputs: (pixels, outputs, inputs), (pixels, ..., inputs) to (pixels, ..., outputs)."""
    flat = inputs.reshape(len(inputs), -1, inputs.shape[-1])
    return (flat @ matrices.swapaxes(-1, -2)).reshape(*inputs.shape[:-1], -1)


def _beside(bias: Floats, inputs: Floats) -> Floats:
    return bias.reshape(len(bias), *(1,) * (inputs.ndim - 2), -1)


def pairs_of(values: Floats, pairs: tuple[tuple[int, int], ...]) -> tuple[Floats, Floats]:
    """The first and the second value of each pair, (..., pairs) both."""
    first, second = zip(*pairs, strict=True)
    return values[..., list(first)], values[..., list(second)]


def determinant(zeta: Floats) -> Floats:
    """phi_Det: zeta and u1 v2 - v1 u2, (..., 4) to (..., 5)."""
    u1, v1, u2, v2 = np.moveaxis(zeta, -1, 0)
    return np.concatenate([zeta, (u1 * v2 - v1 * u2)[..., None]], axis=-1)


def _det_jacobian(lower: Floats, upper: Floats) -> Interval:
    identity = np.broadcast_to(np.eye(4), (len(lower), 4, 4))
    rows = [np.stack([a[:, 3], -b[:, 2], -b[:, 1], a[:, 0]], axis=-1)[:, None] for a, b in ((lower, upper), (upper, lower))]
    return np.concatenate([identity, rows[0]], axis=1), np.concatenate([identity, rows[1]], axis=1)


def _abs(values: Floats) -> Floats:
    first, second = pairs_of(values, ABS_PAIRS)
    return np.abs(first) + np.abs(second) - np.abs(first + second)


def _place(pairs: tuple[tuple[int, int], ...], inputs: int, first: Floats, second: Floats) -> Floats:
    """The Jacobian (pixels, pairs, inputs) whose row k holds `first[:, k]` and `second[:, k]` at the inputs of pair k."""
    jacobian = np.zeros((len(first), len(pairs), inputs))
    output = np.arange(len(pairs))
    jacobian[:, output, [pair[0] for pair in pairs]] = first
    jacobian[:, output, [pair[1] for pair in pairs]] = second
    return jacobian


def _constant_jacobian(pairs: tuple[tuple[int, int], ...], inputs: int, low: float, high: float) -> Callable[[Floats, Floats], Interval]:
    def jacobian(lower: Floats, _upper: Floats) -> Interval:
        ones = np.ones((len(lower), len(pairs)))
        return _place(pairs, inputs, low * ones, low * ones), _place(pairs, inputs, high * ones, high * ones)

    return jacobian


def _abs_jacobian(lower: Floats, upper: Floats) -> Interval:
    """d/da (|a| + |b| - |a + b|) is 2 where a > 0 > a + b, -2 where a < 0 < a + b, else 0; likewise for b."""
    (a_low, b_low), (a_high, b_high) = pairs_of(lower, ABS_PAIRS), pairs_of(upper, ABS_PAIRS)

    def derivative(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> Interval:
        falls = (low < 0) & (np.minimum(high, 0) + other_high > 0)
        rises = (high > 0) & (np.maximum(low, 0) + other_low < 0)
        return np.where(falls, -2.0, 0.0), np.where(rises, 2.0, 0.0)

    first, second = derivative(a_low, a_high, b_low, b_high), derivative(b_low, b_high, a_low, a_high)
    return _place(ABS_PAIRS, 16, first[0], second[0]), _place(ABS_PAIRS, 16, first[1], second[1])


def _min_jacobian(lower: Floats, upper: Floats) -> Interval:
    """d/da min(a, b) is 1 where a < b and 0 where a > b."""
    (a_low, b_low), (a_high, b_high) = pairs_of(lower, MIN_PAIRS), pairs_of(upper, MIN_PAIRS)
    low = _place(MIN_PAIRS, 12, (a_high < b_low).astype(np.float64), (b_high < a_low).astype(np.float64))
    high = _place(MIN_PAIRS, 12, (a_low <= b_high).astype(np.float64), (b_low <= a_high).astype(np.float64))
    return low, high


def _relu_jacobian(lower: Floats, upper: Floats) -> Interval:
    """d ReLU(sum) is 1 where the sum is positive and 0 where it is negative."""
    low, high = lower.sum(axis=-1) > 0, upper.sum(axis=-1) > 0
    wide = np.ones((len(lower), 1, lower.shape[-1]))
    return low[:, None, None] * wide, high[:, None, None] * wide

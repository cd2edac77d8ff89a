"""What float32 may add to NN_e's answer, in any order of its sums: a bound that is derived, for the tests that compare evaluators."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from build_model.state_network import BLOCK_ROWS, StateNetwork

FLOAT32_ROUNDING = 2.0**-24


@torch.no_grad()
def exact_state_and_bound(network: StateNetwork, frame: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """NN_e's answer to one filtered frame, uint8 (1, 1, height, width), in float64, and how far float32 may be off, (4,) each.

    A sum of n terms that are not 0, in any order, is off by gamma_n = n u / (1 - n u) times the sum of their sizes at most (Higham,
    Accuracy and Stability of Numerical Algorithms, section 3.1). Each such error is a number in [-1, 1] times its bound; how all of them
    together move the later values is linear but for the ReLU, which passes an error on, drops it, or, where the sign of its argument is
    open, gives one no larger than its argument's. The bounds of one layer at a time multiplied by |W| would be a million times wider.
    """
    layers: list[tuple[Any, Any]] = [(network.first.halves, lambda x, w, b: _row_convolution(x, w, b).unsqueeze(2))]
    layers += [(layer, lambda x, w, b: functional.conv2d(x, w, b, stride=(1, 2))) for layer in network.convolutions]
    layers += [(layer, lambda x, w, b: functional.linear(x.flatten(1), w, b)) for layer in (network.hidden, network.last)]
    rows, columns = network.window.slices
    exact = functional.pad(frame[:, 0, rows, columns].double(), (0, 0, 0, network.padding))
    errors = torch.zeros_like(exact)  # the frame is exact
    for layer, apply in layers:
        weight, bias = layer.weight.double(), layer.bias.double()
        largest = exact.abs() + _size(errors)
        terms = apply((largest > 0).double(), torch.ones_like(weight), torch.ones_like(bias)) + 1
        gamma = terms * FLOAT32_ROUNDING / (1 - terms * FLOAT32_ROUNDING)
        rounding = gamma * apply(largest, weight.abs(), bias.abs())
        exact = apply(exact, weight, bias)
        errors = torch.cat([apply(errors, weight, torch.zeros_like(bias)), _one_each(rounding)])
        if layer is not network.last:
            size = _size(errors)
            errors = torch.cat([errors * (exact > size), _one_each(size * (exact.abs() <= size))])
            errors = errors[errors.flatten(1).any(dim=1)]
            exact = exact.relu()
    middle, half_width = network.middle.double(), network.half_width.double()
    error = half_width * _size(errors)
    # Two roundings, and a third for what is lost by underflow and by float64 here.
    bound = error + 3 * FLOAT32_ROUNDING * (middle.abs() + half_width * exact.abs() + error)
    return (middle + half_width * exact)[0].numpy(), bound[0].numpy()


def _size(errors: Tensor) -> Tensor:
    """The largest sum of the errors, (1, ...)."""
    return errors.abs().sum(dim=0, keepdim=True)


def _one_each(bounds: Tensor) -> Tensor:
    """An error of its own for every bound that is not 0, (n, ...)."""
    flat = bounds.flatten()
    return torch.diag(flat)[flat > 0].reshape(-1, *bounds.shape[1:])


def _row_convolution(image: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    halves = functional.linear(image.reshape(len(image), image.shape[1] // BLOCK_ROWS, -1), weight, bias)
    channels = len(bias) // 2
    return (halves[:, :-1, :channels] + halves[:, 1:, channels:]).transpose(1, 2)

"""Operators that sum products or numbers: convolutions and pools, windows that move over an image; and matrix products."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from runtime.model.operators.tensor import (
    INT32,
    INT64,
    Call,
    Shape,
    Tensor,
    demand_quantised,
)

POINTER_BYTES = 8
"""Convolutions of integers list where each factor of each output lies."""


def convolution(call: Call) -> Sequence[Tensor]:
    """Conv: data (n, channels, sizes...), weights (outputs, channels / group, kernel...), and a bias for each output."""
    data, weights, *bias = call.operands()
    call.common_dtype([data, weights, *bias])
    result = _convolved(call, data, weights, data.dtype)
    call.demand_shape(2, weights.shape[:1])
    return [result]


def integer_convolution(call: Call) -> Sequence[Tensor]:
    """ConvInteger: of quantised data and weights, each with its zero point."""
    data, weights = call.operand(0), call.operand(1)
    demand_quantised(call, (0, 2), (1, 3))
    call.demand_shape(2, (), (1,))
    call.demand_shape(3, (), (1,), weights.shape[:1])
    return [_convolved(call, data, weights, INT32)]


def quantised_convolution(call: Call) -> Sequence[Tensor]:
    """QLinearConv: data, weights and result, each with scale and zero point, and an int32 bias."""
    data, weights, zero = call.operand(0), call.operand(3), call.operand(7)
    demand_quantised(call, (0, 2), (3, 5), (7,), scales=(1, 4, 6))
    for place in (1, 2, 6, 7):
        call.demand_shape(place, (), (1,))
    for place in (4, 5):
        call.demand_shape(place, (), (1,), weights.shape[:1])
    call.demand_shape(8, weights.shape[:1])
    bias = call.optional(8)
    call.demand(bias is None or bias.dtype == INT32, "with a bias that is not int32")
    return [_convolved(call, data, weights, zero.dtype)]


def pooling(call: Call) -> Sequence[Tensor]:
    """MaxPool, AveragePool and LpPool: over each channel for itself. A second output of MaxPool holds places."""
    data, kernel = call.operand(0), call.attributes["kernel_shape"]
    call.demand(3 <= data.rank <= 5 and len(kernel) == data.rank - 2, f"by {kernel} over shape {data.shape}")
    sizes = _window_places(call, data.shape[2:], kernel, least_part=True)
    result = Tensor(data.dtype, data.shape[:2] + sizes, math.prod(kernel))
    return [result, Tensor(INT64, result.shape)][: call.outputs]


def global_pooling(call: Call) -> Sequence[Tensor]:
    """One number a channel."""
    data = call.operand(0)
    call.demand(data.rank >= 3, f"over shape {data.shape}")
    return [Tensor(data.dtype, data.shape[:2] + (1,) * (data.rank - 2), math.prod(data.shape[2:]))]


def _convolved(call: Call, data: Tensor, weights: Tensor, dtype: np.dtype) -> Tensor:
    group, kernel = call.attributes["group"], weights.shape[2:]
    fits = 3 <= data.rank <= 5 and weights.rank == data.rank
    fits = fits and data.shape[1] == weights.shape[1] * group and weights.shape[0] % group == 0
    call.demand(fits and call.attributes["kernel_shape"] in (None, kernel), f"of shapes {data.shape}, {weights.shape} in {group} groups")
    sizes, terms = _window_places(call, data.shape[2:], kernel), math.prod(weights.shape[1:])
    gathered = 0 if dtype.kind == "f" else POINTER_BYTES * terms * math.prod(sizes)
    return Tensor(dtype, (data.shape[0], weights.shape[0], *sizes), terms, gathered)


def _window_places(call: Call, sizes: Shape, kernel: Shape, least_part: bool = False) -> Shape:
    """How often a kernel fits along each axis, with the node's strides, dilations and padding.

    `least_part`: padding is smaller than the kernel, so that some part of it always lies on the data.
    """
    axes = len(sizes)
    strides, dilations = (call.attributes[name] or (1,) * axes for name in ("strides", "dilations"))
    pads, automatic = call.attributes["pads"] or (0,) * (2 * axes), call.attributes["auto_pad"]
    call.demand(len(strides) == len(dilations) == axes and len(pads) == 2 * axes, f"with strides {strides}, pads {pads} on {axes} axes")
    call.demand(automatic == "NOTSET" or not any(pads), f"with pads {pads} and {automatic}")
    places = []
    for axis, (size, part, stride, dilation) in enumerate(zip(sizes, kernel, strides, dilations, strict=True)):
        span, before, behind = (part - 1) * dilation + 1, pads[axis], pads[axis + axes]
        if automatic.startswith("SAME"):
            places.append(-(-size // stride))
            continue
        padded = size + before + behind
        fits = span <= padded and (not least_part or max(before, behind) < part)
        call.demand(fits, f"by a kernel of {part} every {dilation} over {size} with pads {before}, {behind}")
        count = (padded - span) // stride + 1
        if call.attributes.get("ceil_mode") and (padded - span) % stride:
            call.demand(count * stride < size + before, "with a last place in the padding alone")  # which some versions leave out
            count += 1
        places.append(count)
    return tuple(places)


def matrix_product(call: Call) -> Sequence[Tensor]:
    """MatMul, of stacks of matrices that are broadcast; a vector is a matrix of one row, or column, which is then left out."""
    first, second = call.operands()
    return [_product(call, first, second, call.common_dtype([first, second]))]


def integer_matrix_product(call: Call) -> Sequence[Tensor]:
    """MatMulInteger: of quantised matrices, each with its zero point, which may differ from column to column of the second."""
    first, second = call.operand(0), call.operand(1)
    demand_quantised(call, (0, 2), (1, 3))
    call.demand_shape(2, (), (1,))
    call.demand_shape(3, (), (1,), second.shape[-1:])
    return [_product(call, first, second, INT32)]


def quantised_matrix_product(call: Call) -> Sequence[Tensor]:
    """QLinearMatMul: two matrices and their product, each with scale and zero point."""
    first, second, zero = call.operand(0), call.operand(3), call.operand(7)
    demand_quantised(call, (0, 2), (3, 5), (7,), scales=(1, 4, 6))
    for place in (1, 2, 4, 5, 6, 7):
        call.demand_shape(place, (), (1,))
    return [_product(call, first, second, zero.dtype)]


def general_matrix_product(call: Call) -> Sequence[Tensor]:
    """Gemm: of two matrices, each transposed if it says so, plus what is broadcast to it."""
    operands = call.operands()
    call.demand(all(matrix.rank == 2 for matrix in operands[:2]), f"of shapes {', '.join(str(each.shape) for each in operands)}")
    first, second = (
        matrix.shape[::-1] if call.attributes[name] else matrix.shape for matrix, name in zip(operands, ("transA", "transB"), strict=False)
    )
    shape = first[0], second[1]
    fits = first[1] == second[0] and call.broadcast(shape, *(added.shape for added in operands[2:])) == shape
    call.demand(fits, f"of shapes {', '.join(str(each.shape) for each in operands)}")
    return [Tensor(call.common_dtype(operands), shape, first[1])]


def _product(call: Call, first: Tensor, second: Tensor, dtype: np.dtype) -> Tensor:
    fits = first.rank > 0 and second.rank > 0
    rows = first.shape if first.rank > 1 else (1, *first.shape)
    columns = second.shape if second.rank > 1 else (*second.shape, 1)
    call.demand(fits and rows[-1] == columns[-2], f"of shapes {first.shape}, {second.shape}")
    matrix = (rows[-2:-1] if first.rank > 1 else ()) + (columns[-1:] if second.rank > 1 else ())
    return Tensor(dtype, call.broadcast(rows[:-2], columns[:-2]) + matrix, rows[-1])

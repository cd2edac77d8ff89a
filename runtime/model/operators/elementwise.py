"""Operators that take each element, each axis or each channel for itself: arithmetic, reductions, norms, quantised numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from runtime.model.operators.tensor import (
    BOOL,
    BYTES,
    DTYPES,
    FLOAT32,
    INT32,
    INT64,
    UINT8,
    Call,
    Tensor,
    same,
    without,
)


def elementwise(call: Call) -> Sequence[Tensor]:
    """Inputs of one type, broadcast."""
    operands = call.operands()
    return [Tensor(call.common_dtype(operands), call.broadcast(*(operand.shape for operand in operands)))]


def comparison(call: Call) -> Sequence[Tensor]:
    """Inputs of one type, broadcast, to booleans."""
    (result,) = elementwise(call)
    return [Tensor(BOOL, result.shape)]


def division(call: Call) -> Sequence[Tensor]:
    """Div and Mod. Integers are divided by constants alone, without 0 and -1: a processor traps at x / 0 and at the smallest x / -1."""
    (result,) = elementwise(call)
    divisor = call.operand(1).values
    if result.dtype.kind != "f":
        if divisor is None:
            call.refuse("of integers by what is computed", "only floats, or integers by constants, are divided")
        traps = (divisor == 0).any() or (divisor.dtype.kind == "i" and (divisor == -1).any())
        call.demand(not traps, "of integers by 0 or -1")
    call.demand(result.dtype.kind != "f" or call.attributes.get("fmod", 1) == 1, "of floats with fmod 0")
    return [result]


def power(call: Call) -> Sequence[Tensor]:
    """Pow: of the base's type, whatever the exponent's is."""
    base, exponent = call.operands()
    call.demand(exponent.dtype.kind in "fi", f"of types {base.dtype}, {exponent.dtype}")
    return [Tensor(base.dtype, call.broadcast(base.shape, exponent.shape))]


def slope(call: Call) -> Sequence[Tensor]:
    """PRelu: the slope is broadcast to the shape of the first input."""
    (result,) = elementwise(call)
    call.demand(result.shape == call.operand(0).shape, f"with a slope of shape {call.operand(1).shape}")
    return [result]


def choice(call: Call) -> Sequence[Tensor]:
    """Where: a boolean chooses between two of one type."""
    condition, *chosen = call.operands()
    return [Tensor(call.common_dtype(chosen), call.broadcast(condition.shape, *(tensor.shape for tensor in chosen)))]


def clip(call: Call) -> Sequence[Tensor]:
    """Limits are single numbers of the first input's type."""
    limits = [limit for limit in call.inputs[1:] if limit is not None]
    call.demand(all(limit.shape == () for limit in limits), "with limits that are no single numbers")
    call.common_dtype([call.operand(0), *limits])
    return same(call)


def cast(call: Call) -> Sequence[Tensor]:
    """To the type that `to` numbers."""
    number = call.attributes["to"]
    if number not in DTYPES:
        call.refuse(f"to the type {number}")
    return [Tensor(np.dtype(DTYPES[number]), call.operand(0).shape)]


def along_axis(call: Call) -> Sequence[Tensor]:
    """Type and shape of the first input, which has the axis named."""
    call.axis(call.operand(0).rank)
    return same(call)


def dropout(call: Call) -> Sequence[Tensor]:
    """Dropout does nothing outside of training, for which it would need a third input."""
    call.demand_shape(1, ())
    return same(call)


def reduction(call: Call) -> Sequence[Tensor]:
    """Over constant axes, or over all."""
    data, numbers = call.operand(0), call.whole_numbers(1)
    call.demand(numbers != [], "along no axes")
    if numbers is None and call.attributes["noop_with_empty_axes"]:
        return same(call)
    axes = range(data.rank) if numbers is None else call.axes(numbers, data.rank)
    return [Tensor(data.dtype, without(data.shape, axes, call.attributes["keepdims"]), math.prod(data.shape[axis] for axis in axes))]


def place_of_extreme(call: Call) -> Sequence[Tensor]:
    """ArgMax and ArgMin."""
    data = call.operand(0)
    axis = call.axis(data.rank)
    return [Tensor(INT64, without(data.shape, [axis], call.attributes["keepdims"]), data.shape[axis])]


def running_sum(call: Call) -> Sequence[Tensor]:
    """CumSum along one constant axis."""
    numbers = call.whole_numbers(1, ranks=(0, 1)) or []
    call.demand(len(numbers) == 1, f"along axes {numbers}")
    call.axes(numbers, call.operand(0).rank)
    return same(call)


def batch_normalisation(call: Call) -> Sequence[Tensor]:
    """BatchNormalization, outside of training, and InstanceNormalization: parameters for each channel."""
    data, *parameters = call.operands()
    fits = data.rank >= 2 and all(parameter.shape == data.shape[1:2] for parameter in parameters)
    call.demand(fits, f"of shapes {', '.join(str(each.shape) for each in call.operands())}")
    call.common_dtype([data, *parameters])
    return same(call)


def layer_normalisation(call: Call) -> Sequence[Tensor]:
    """Over all axes from `axis` on, with parameters for each of their elements."""
    data, *parameters = call.operands()
    normalised = data.shape[call.axis(data.rank) :]
    fits = all(parameter.shape == normalised for parameter in parameters)
    call.demand(fits, f"of shapes {', '.join(str(each.shape) for each in call.operands())}")
    call.common_dtype([data, *parameters])
    return same(call)


def local_normalisation(call: Call) -> Sequence[Tensor]:
    """LRN, over an odd number of channels of an image."""
    data, size = call.operand(0), call.attributes["size"]
    call.demand(data.rank == 4 and size % 2 == 1, f"of {size} channels over shape {data.shape}")
    return [Tensor(data.dtype, data.shape, min(size, data.shape[1]))]


def quantisation(call: Call) -> Sequence[Tensor]:
    """QuantizeLinear, to the zero point's type, by default uint8; scale and zero point are numbers, or one for each place of the axis."""
    data, zero = call.operand(0), call.optional(2)
    _demand_scale(call, data)
    call.demand(call.operand(1).dtype == data.dtype and (zero is None or zero.dtype in BYTES), "of types that do not fit")
    return [Tensor(UINT8 if zero is None else zero.dtype, data.shape)]


def dequantisation(call: Call) -> Sequence[Tensor]:
    """DequantizeLinear, to the scale's type; the zero point has the data's."""
    data, scale = call.operand(0), call.operand(1)
    _demand_scale(call, data)
    call.common_dtype([data, *filter(None, [call.optional(2)])])
    call.demand(scale.dtype == FLOAT32 and data.dtype in (*BYTES, INT32), f"of types {data.dtype}, {scale.dtype}")
    return [Tensor(scale.dtype, data.shape)]


def dynamic_quantisation(call: Call) -> Sequence[Tensor]:
    """DynamicQuantizeLinear: quantised data, scale, zero point."""
    return [Tensor(UINT8, call.operand(0).shape), Tensor(FLOAT32, ()), Tensor(UINT8, ())]


def _demand_scale(call: Call, data: Tensor) -> None:
    """Scale and zero point have one shape: that of a number, or of the axis."""
    scale, zero = call.operand(1), call.optional(2)
    if scale.shape not in ((), (1,)):
        call.demand(scale.shape == (data.shape[call.axis(data.rank)],), f"of shape {data.shape} by scales of {scale.shape}")
    call.demand(zero is None or zero.shape == scale.shape, f"with a zero point unlike the scale's shape {scale.shape}")

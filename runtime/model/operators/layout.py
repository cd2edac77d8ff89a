"""Operators that move elements: joined, cut, gathered, reshaped. What decides a shape is a constant."""

from __future__ import annotations

import math
from collections.abc import Sequence

from runtime.model.operators.tensor import (
    INT32,
    INT64,
    Call,
    Tensor,
    replaced,
    same,
    without,
)


def concatenation(call: Call) -> Sequence[Tensor]:
    """Along one axis; all other sizes are equal."""
    parts = call.operands()
    axis = call.axis(parts[0].rank)
    others = {replaced(part.shape, axis, 0) for part in parts if part.rank == parts[0].rank}
    call.demand(len({part.rank for part in parts}) == 1 and len(others) == 1, f"of shapes {', '.join(str(part.shape) for part in parts)}")
    return [Tensor(call.common_dtype(parts), replaced(parts[0].shape, axis, sum(part.shape[axis] for part in parts)))]


def depth_to_space(call: Call) -> Sequence[Tensor]:
    """Channels become blocks of pixels."""
    data, block = call.operand(0), call.attributes["blocksize"]
    call.demand(data.rank == 4 and data.shape[1] % block**2 == 0, f"of blocks of {block} from shape {data.shape}")
    batch, channels, height, width = data.shape
    return [Tensor(data.dtype, (batch, channels // block**2, height * block, width * block))]


def space_to_depth(call: Call) -> Sequence[Tensor]:
    """Blocks of pixels become channels."""
    data, block = call.operand(0), call.attributes["blocksize"]
    fits = data.rank == 4 and data.shape[2] % block == 0 and data.shape[3] % block == 0
    call.demand(fits, f"of blocks of {block} from shape {data.shape}")
    batch, channels, height, width = data.shape
    return [Tensor(data.dtype, (batch, channels * block**2, height // block, width // block))]


def flattening(call: Call) -> Sequence[Tensor]:
    """To two axes, the second starting at `axis`, which may be behind the last."""
    data, axis = call.operand(0), call.attributes["axis"]
    call.demand(-data.rank <= axis <= data.rank, f"at axis {axis} of {data.rank}")
    axis += data.rank if axis < 0 else 0
    return [Tensor(data.dtype, (math.prod(data.shape[:axis]), math.prod(data.shape[axis:])))]


def gather(call: Call) -> Sequence[Tensor]:
    """Slices at any indices along one axis; onnxruntime looks at each index before it reads there."""
    data, indices = call.operands()
    axis = call.axis(data.rank)
    _demand_indices(call, indices)
    return [Tensor(data.dtype, data.shape[:axis] + indices.shape + data.shape[axis + 1 :])]


def gather_elements(call: Call) -> Sequence[Tensor]:
    """Elements at any indices along one axis; on the other axes the indices lie beside the data."""
    data, indices = call.operands()
    _demand_beside(call, data, indices)
    return [Tensor(data.dtype, indices.shape)]


def gather_nd(call: Call) -> Sequence[Tensor]:
    """Slices at tuples of indices."""
    data, indices = call.operands()
    batch, fits = call.attributes["batch_dims"], data.rank > 0 and indices.rank > 0
    last = indices.shape[-1] if fits else 0
    fits &= batch < min(data.rank, indices.rank) and data.shape[:batch] == indices.shape[:batch] and last <= data.rank - batch
    call.demand(fits, f"of shapes {data.shape}, {indices.shape} with {batch} axes in common")
    call.demand(indices.dtype == INT64, f"at indices of type {indices.dtype}")
    return [Tensor(data.dtype, indices.shape[:-1] + data.shape[batch + last :])]


def padding(call: Call) -> Sequence[Tensor]:
    """Pad, by constant amounts before and behind. Negative amounts must leave something, and what is mirrored or repeated must exist."""
    data, pads = call.operand(0), call.whole_numbers(1) or []
    axes = call.axes(range(data.rank) if (numbers := call.whole_numbers(3)) is None else numbers, data.rank)
    call.demand(len(pads) == 2 * len(axes), f"of {len(axes)} axes by {pads}")
    call.demand_shape(2, ())
    call.common_dtype([data, *filter(None, [call.optional(2)])])
    shape = data.shape
    for axis, before, behind in zip(axes, pads, pads[len(axes) :], strict=False):
        size = shape[axis]
        low, high = {"constant": (1 - size, math.inf), "reflect": (0, size - 1), "edge": (0, math.inf), "wrap": (0, size)}[
            call.attributes["mode"]
        ]
        call.demand(all(low <= pad <= high for pad in (before, behind)), f"of {size} by {before} and {behind}")
        shape = replaced(shape, axis, size + before + behind)
    return [Tensor(data.dtype, shape)]


def reshape(call: Call) -> Sequence[Tensor]:
    """To a constant shape, in which 0 keeps the input's size at its place, unless `allowzero`, and one -1 takes what is left."""
    data, numbers = call.operand(0), call.whole_numbers(1) or []
    copied = not call.attributes["allowzero"]
    wanted = [data.shape[axis] if copied and size == 0 and axis < data.rank else size for axis, size in enumerate(numbers)]
    known = math.prod(size for size in wanted if size != -1)
    if wanted.count(-1) == 1 and known > 0:
        wanted[wanted.index(-1)] = data.size // known
    call.demand(all(size > 0 for size in wanted) and math.prod(wanted) == data.size, f"of shape {data.shape} to {numbers}")
    return [Tensor(data.dtype, tuple(wanted))]


def scatter_elements(call: Call) -> Sequence[Tensor]:
    """The data with elements put in at any indices along one axis; onnxruntime looks at each index before it writes there."""
    data, indices, updates = call.operands()
    _demand_beside(call, data, indices)
    call.demand(updates.shape == indices.shape, f"of shapes {data.shape}, {indices.shape}, {updates.shape}")
    call.common_dtype([data, updates])
    return same(call)


def cut(call: Call) -> Sequence[Tensor]:
    """Slice, between constant starts and ends along constant axes, by constant steps."""
    data, starts, ends = call.operand(0), call.whole_numbers(1) or [], call.whole_numbers(2) or []
    numbers, steps = call.whole_numbers(3), call.whole_numbers(4)
    axes = call.axes(range(len(starts)) if numbers is None else numbers, data.rank)
    steps = [1] * len(axes) if steps is None else steps
    call.demand(len(starts) == len(ends) == len(axes) == len(steps) and 0 not in steps, f"from {starts} to {ends} by {steps}")
    call.common_dtype([tensor for tensor in call.inputs[1:] if tensor is not None])
    shape = data.shape
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        shape = replaced(shape, axis, len(range(*slice(start, end, step).indices(shape[axis]))))
    return [Tensor(data.dtype, shape)]


def split(call: Call) -> Sequence[Tensor]:
    """Into parts of constant sizes, or into `num_outputs` equal ones, the last of which may be smaller."""
    data, sizes, count = call.operand(0), call.whole_numbers(1), call.attributes["num_outputs"]
    axis = call.axis(data.rank)
    whole = data.shape[axis]
    call.demand((sizes is None) != (count is None), "with sizes and a number of outputs, or with neither")
    if sizes is None:
        part = -(-whole // count)
        sizes = [part] * (count - 1) + [whole - part * (count - 1)]
    fits = len(sizes) == call.outputs and min(sizes) > 0 and sum(sizes) == whole
    call.demand(fits, f"of {whole} into {sizes} with {call.outputs} outputs")
    return [Tensor(data.dtype, replaced(data.shape, axis, size)) for size in sizes]


def squeeze(call: Call) -> Sequence[Tensor]:
    """Takes out constant axes, or all, of size 1."""
    data, numbers = call.operand(0), call.whole_numbers(1)
    axes = [axis for axis, size in enumerate(data.shape) if size == 1] if numbers is None else call.axes(numbers, data.rank)
    call.demand(all(data.shape[axis] == 1 for axis in axes), f"of axes {axes} of shape {data.shape}")
    return [Tensor(data.dtype, without(data.shape, axes, keep=0))]


def unsqueeze(call: Call) -> Sequence[Tensor]:
    """Puts in axes of size 1 at constant places."""
    data, numbers = call.operand(0), call.whole_numbers(1) or []
    rank = data.rank + len(numbers)
    axes, sizes = call.axes(numbers, rank), iter(data.shape)
    return [Tensor(data.dtype, tuple(1 if axis in axes else next(sizes) for axis in range(rank)))]


def transpose(call: Call) -> Sequence[Tensor]:
    """By a permutation of the axes, by default their reverse."""
    data, order = call.operand(0), call.attributes["perm"]
    order = tuple(reversed(range(data.rank))) if order is None else order
    call.demand(sorted(order) == list(range(data.rank)), f"by {order} of {data.rank} axes")
    return [Tensor(data.dtype, tuple(data.shape[axis] for axis in order))]


def _demand_indices(call: Call, indices: Tensor) -> None:
    call.demand(indices.dtype in (INT32, INT64), f"at indices of type {indices.dtype}")


def _demand_beside(call: Call, data: Tensor, indices: Tensor) -> None:
    """Indices of the data's rank, no larger than it but along the axis."""
    _demand_indices(call, indices)
    axis = call.axis(data.rank)
    fits = indices.rank == data.rank and all(
        place == axis or size <= whole for place, (size, whole) in enumerate(zip(indices.shape, data.shape, strict=True))
    )
    call.demand(fits, f"of shapes {data.shape}, {indices.shape}")

"""Types and shapes of what operators give, from those of what they are given: a rule for each family of the ONNX standard's operators.

A rule checks all that an operator asks of its inputs and attributes together, and raises `ModelError` where they do not fit. Ranks are at
most `LARGEST_RANK` and no tensor is empty. What decides a shape must be a constant, and so must the divisor of integers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from runtime.model.format import ModelError

DTYPES = {1: "<f4", 2: "|u1", 3: "|i1", 4: "<u2", 5: "<i2", 6: "<i4", 7: "<i8", 9: "|b1", 10: "<f2", 11: "<f8", 12: "<u4", 13: "<u8"}
"""onnx's numbers of the element types that a tensor may have: numbers of a fixed size."""
LARGEST_RANK = 8
LONGEST_FOUND = 160
"""Characters of shapes and numbers that an error quotes."""
BOOL, INT32, INT64, UINT8, FLOAT32 = (np.dtype(kind) for kind in ("|b1", "<i4", "<i8", "|u1", "<f4"))
BYTES = (np.dtype("|u1"), np.dtype("|i1"))
"""Types of quantised numbers."""

Shape = tuple[int, ...]


@dataclass(frozen=True)
class Tensor:
    """What is known of a tensor before anything is run."""

    dtype: np.dtype
    shape: Shape
    terms: int = field(default=1, compare=False)
    """How many products or numbers each element is the sum of."""
    working_bytes: int = field(default=0, compare=False)
    """What its operator needs besides while it runs."""
    values: NDArray[Any] | None = field(default=None, compare=False)
    """The numbers themselves, where they are a constant's."""

    def __str__(self) -> str:
        """Type and shape."""
        return f"{self.dtype} {list(self.shape)}"

    @property
    def rank(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)


@dataclass(frozen=True)
class Call:
    """A node as its rule sees it: what it is given, by place, None where an optional input is left out; attributes with defaults."""

    operator: str
    inputs: tuple[Tensor | None, ...]
    outputs: int
    attributes: Mapping[str, Any]

    def refuse(self, found: str, advice: str = "a network whose operators fit their inputs is taken") -> NoReturn:
        """Raises `ModelError`."""
        raise ModelError(f"found {self.operator} {found:.{LONGEST_FOUND}}; {advice}: export it again")

    def demand(self, holds: bool, found: str) -> None:
        """Raises `ModelError` with what was found."""
        if not holds:
            self.refuse(found)

    def optional(self, place: int) -> Tensor | None:
        """The input at a place, None if it is left out."""
        return self.inputs[place] if place < len(self.inputs) else None

    def operand(self, place: int) -> Tensor:
        """The input at a place, which has elements."""
        tensor = self.optional(place)
        if tensor is None:
            self.refuse(f"without its input {place}")
        self.demand(tensor.size > 0, "of an empty tensor")
        return tensor

    def operands(self) -> list[Tensor]:
        """All inputs, none of them left out."""
        return [self.operand(place) for place in range(len(self.inputs))]

    def whole_numbers(self, place: int, ranks: tuple[int, ...] = (1,)) -> list[int] | None:
        """The numbers of a constant list, or None if it is left out. A shape that is computed is refused."""
        tensor = self.optional(place)
        if tensor is None:
            return None
        if tensor.values is None:
            self.refuse("with a shape that is computed", "only constant shapes are taken")
        self.demand(tensor.dtype in (INT32, INT64) and tensor.rank in ranks and tensor.size <= 2 * LARGEST_RANK, f"by numbers {tensor}")
        return [int(number) for number in tensor.values.ravel()]

    def axes(self, numbers: Sequence[int], rank: int) -> list[int]:
        """Numbers of axes counted from 0, each within the rank and none of them twice."""
        self.demand(all(-rank <= number < rank for number in numbers), f"along axes {list(numbers)} of {rank}")
        axes = [number % rank for number in numbers]
        self.demand(len(set(axes)) == len(axes), f"along axes {list(numbers)} of {rank}")
        return axes

    def axis(self, rank: int) -> int:
        """The attribute `axis`, counted from 0."""
        return self.axes([self.attributes["axis"]], rank)[0]

    def common_dtype(self, tensors: Sequence[Tensor]) -> np.dtype:
        """The one element type of all the tensors."""
        types = list(dict.fromkeys(tensor.dtype for tensor in tensors))
        self.demand(len(types) == 1, f"of types {', '.join(map(str, types))}")
        return types[0]

    def broadcast(self, *shapes: Shape) -> Shape:
        """The shape that all the shapes are broadcast to."""
        rank = max(map(len, shapes))
        columns = zip(*((1,) * (rank - len(shape)) + shape for shape in shapes), strict=True)
        result = tuple(max(sizes) for sizes in columns)
        fits = all(size in (1, whole) for shape in shapes for size, whole in zip(reversed(shape), reversed(result), strict=False))
        self.demand(fits, f"of shapes {', '.join(map(str, shapes))}")
        return result

    def demand_shape(self, place: int, *shapes: Shape) -> None:
        """The input at a place, if it is given, has one of the shapes."""
        tensor = self.optional(place)
        if tensor is not None:
            self.demand(tensor.shape in shapes, f"with input {place} of shape {tensor.shape}")


Rule = Callable[[Call], Sequence[Tensor]]


def same(call: Call) -> Sequence[Tensor]:
    """Each element for itself: type and shape of the first input."""
    first = call.operand(0)
    return [Tensor(first.dtype, first.shape)]


def without(shape: Shape, axes: Sequence[int], keep: int) -> Shape:
    """The shape with the axes taken out, or of size 1."""
    return tuple(1 if axis in axes else size for axis, size in enumerate(shape) if keep or axis not in axes)


def replaced(shape: Shape, axis: int, size: int) -> Shape:
    """The shape with another size of an axis."""
    return (*shape[:axis], size, *shape[axis + 1 :])


def demand_quantised(call: Call, *places: tuple[int, ...], scales: tuple[int, ...] = ()) -> None:
    """The inputs of each tuple are quantised and of one type, as far as they are given; those of `scales` are float32."""
    for group in places:
        tensors = [tensor for place in group if (tensor := call.optional(place)) is not None]
        call.demand(call.common_dtype(tensors) in BYTES, f"of type {tensors[0].dtype}")
    call.demand(all(call.operand(place).dtype == FLOAT32 for place in scales), "with scales that are not float32")

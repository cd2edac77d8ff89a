"""The operators that a model may use: their inputs, outputs and attributes, as the ONNX standard has them in operator set `format.OPSET`.

An attribute that is not listed, a required one that is missing, or a value out of its range is refused; what must fit the inputs is
checked by the operator's rule.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from runtime.model.format import ModelError
from runtime.model.operators import elementwise, layout, products
from runtime.model.operators.tensor import LARGEST_RANK, Call, Rule, Tensor, same
from runtime.model.protobuf import shown

MOST_INPUTS = 2**10
LARGEST_STEP = 2**14
"""Largest kernel, stride, dilation, block or padding of a window: a side of the largest frame."""
REQUIRED = object()
"""Stands for the default of an attribute that has none."""


@dataclass(frozen=True)
class Attribute:
    """What a node may say of itself: the kind of value, its default, the least and the largest number, or the texts to choose from."""

    kind: type
    default: Any
    low: float = -math.inf
    high: float = math.inf
    texts: tuple[str, ...] = ()

    def takes(self, value: Any) -> bool:
        """True for a value of this kind within its range."""
        if type(value) is not self.kind:
            return False
        if self.kind is str:
            return value in self.texts
        numbers = value if isinstance(value, tuple) else (value,)
        return len(numbers) <= 2 * LARGEST_RANK and all(self.low <= number <= self.high and math.isfinite(number) for number in numbers)


@dataclass(frozen=True)
class Operator:
    """What an operator takes, and the rule for what it gives."""

    rule: Rule
    kinds: str
    """Element types of the first input, as numpy's letters for kinds of numbers."""
    inputs: tuple[int, int] = (1, 1)
    outputs: tuple[int, int] = (1, 1)
    """Their least and largest number."""
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    left_out: tuple[int, ...] = ()
    """Places of inputs in whose stead a node may have an empty name."""


def _flag(default: int = 0) -> Attribute:
    return Attribute(int, default, 0, 1)


def _axis(default: Any) -> Attribute:
    return Attribute(int, default, -LARGEST_RANK, LARGEST_RANK)


def _real(default: float) -> Attribute:
    return Attribute(float, default)


def _whole(default: Any, low: int, high: int = LARGEST_STEP) -> Attribute:
    return Attribute(int, default, low, high)


def _wholes(low: int, default: Any = None) -> Attribute:
    return Attribute(tuple, default, low, LARGEST_STEP)


def _text(*texts: str) -> Attribute:
    """One of the texts, by default the first."""
    return Attribute(str, texts[0], texts=texts)


TWO, THREE, MANY = (2, 2), (3, 3), (1, MOST_INPUTS)
FLOATS, NUMBERS, SIGNED, ANY = "f", "fiu", "fi", "fiub"
WINDOW = {
    "auto_pad": _text("NOTSET", "SAME_UPPER", "SAME_LOWER", "VALID"),
    "dilations": _wholes(1),
    "kernel_shape": _wholes(1),
    "pads": _wholes(0),
    "strides": _wholes(1),
}
CONVOLUTION = {**WINDOW, "group": _whole(1, 1)}
POOL = {**WINDOW, "kernel_shape": _wholes(1, REQUIRED), "ceil_mode": _flag()}
REDUCED = {"keepdims": _flag(1), "noop_with_empty_axes": _flag()}
EXTREME = {"axis": _axis(0), "keepdims": _flag(1), "select_last_index": _flag()}
EPSILON = {"epsilon": _real(1e-5)}

OPERATORS: dict[str, Operator] = {
    **{name: Operator(same, SIGNED) for name in ("Abs", "Neg", "Relu", "Sign")},
    **{name: Operator(same, FLOATS) for name in ["Ceil", "Cos", "Erf", "Exp", "Floor", "Log", "Reciprocal", "Round", "Sin", "Sqrt"]},
    **{name: Operator(same, FLOATS) for name in ["HardSwish", "Mish", "Sigmoid", "Softplus", "Softsign", "Tanh"]},
    **{name: Operator(same, FLOATS, attributes={"alpha": _real(1.0)}) for name in ("Celu", "Elu", "ThresholdedRelu")},
    **{name: Operator(elementwise.elementwise, NUMBERS, TWO) for name in ("Add", "Mul", "Sub")},
    **{name: Operator(elementwise.elementwise, NUMBERS, MANY) for name in ("Max", "Min")},
    **{name: Operator(elementwise.elementwise, FLOATS, MANY) for name in ("Mean", "Sum")},
    **{name: Operator(elementwise.elementwise, "b", TWO) for name in ("And", "Or", "Xor")},
    **{name: Operator(elementwise.comparison, NUMBERS, TWO) for name in ("Greater", "GreaterOrEqual", "Less", "LessOrEqual")},
    **{name: Operator(elementwise.along_axis, FLOATS, attributes={"axis": _axis(-1)}) for name in ("LogSoftmax", "Softmax")},
    **{
        f"Reduce{name}": Operator(elementwise.reduction, NUMBERS, (1, 2), attributes=REDUCED)
        for name in ["L1", "L2", "LogSum", "LogSumExp", "Max", "Mean", "Min", "Prod", "Sum", "SumSquare"]
    },
    **{name: Operator(elementwise.place_of_extreme, NUMBERS, attributes=EXTREME) for name in ("ArgMax", "ArgMin")},
    **{name: Operator(products.global_pooling, FLOATS) for name in ("GlobalAveragePool", "GlobalMaxPool")},
    "AveragePool": Operator(products.pooling, FLOATS, attributes={**POOL, "count_include_pad": _flag()}),
    "BatchNormalization": Operator(
        elementwise.batch_normalisation,
        FLOATS,
        (5, 5),
        attributes={**EPSILON, "momentum": _real(0.9), "training_mode": _whole(0, 0, 0)},
    ),
    "Cast": Operator(elementwise.cast, ANY, attributes={"to": _whole(REQUIRED, 1), "saturate": _flag(1)}),
    "Clip": Operator(elementwise.clip, NUMBERS, (1, 3), left_out=(1, 2)),
    "Concat": Operator(layout.concatenation, ANY, MANY, attributes={"axis": _axis(REQUIRED)}),
    "Conv": Operator(products.convolution, FLOATS, (2, 3), attributes=CONVOLUTION),
    "ConvInteger": Operator(products.integer_convolution, "iu", (2, 4), attributes=CONVOLUTION),
    "CumSum": Operator(elementwise.running_sum, NUMBERS, TWO, attributes={"exclusive": _flag(), "reverse": _flag()}),
    "DepthToSpace": Operator(layout.depth_to_space, ANY, attributes={"blocksize": _whole(REQUIRED, 1), "mode": _text("DCR", "CRD")}),
    "DequantizeLinear": Operator(elementwise.dequantisation, "iu", (2, 3), attributes={"axis": _axis(1)}),
    "Div": Operator(elementwise.division, NUMBERS, TWO),
    "Dropout": Operator(elementwise.dropout, FLOATS, (1, 2), attributes={"seed": _whole(0, 0)}),
    "DynamicQuantizeLinear": Operator(elementwise.dynamic_quantisation, FLOATS, outputs=THREE),
    "Equal": Operator(elementwise.comparison, ANY, TWO),
    "Flatten": Operator(layout.flattening, ANY, attributes={"axis": _axis(1)}),
    "Gather": Operator(layout.gather, ANY, TWO, attributes={"axis": _axis(0)}),
    "GatherElements": Operator(layout.gather_elements, ANY, TWO, attributes={"axis": _axis(0)}),
    "GatherND": Operator(layout.gather_nd, ANY, TWO, attributes={"batch_dims": _whole(0, 0)}),
    "Gelu": Operator(same, FLOATS, attributes={"approximate": _text("none", "tanh")}),
    "Gemm": Operator(
        products.general_matrix_product,
        FLOATS,
        (2, 3),
        attributes={"alpha": _real(1.0), "beta": _real(1.0), "transA": _flag(), "transB": _flag()},
    ),
    "HardSigmoid": Operator(same, FLOATS, attributes={"alpha": _real(0.2), "beta": _real(0.5)}),
    "Identity": Operator(same, ANY),
    "InstanceNormalization": Operator(elementwise.batch_normalisation, FLOATS, THREE, attributes=EPSILON),
    "LRN": Operator(
        elementwise.local_normalisation,
        FLOATS,
        attributes={"alpha": _real(1e-4), "beta": _real(0.75), "bias": _real(1.0), "size": _whole(REQUIRED, 1)},
    ),
    "LayerNormalization": Operator(
        elementwise.layer_normalisation, FLOATS, (2, 3), attributes={**EPSILON, "axis": _axis(-1), "stash_type": _whole(1, 1, 1)}
    ),
    "LeakyRelu": Operator(same, FLOATS, attributes={"alpha": _real(0.01)}),
    "LpNormalization": Operator(elementwise.along_axis, FLOATS, attributes={"axis": _axis(-1), "p": _whole(2, 1, 2)}),
    "LpPool": Operator(products.pooling, FLOATS, attributes={**POOL, "p": _whole(2, 1)}),
    "MatMul": Operator(products.matrix_product, NUMBERS, TWO),
    "MatMulInteger": Operator(products.integer_matrix_product, "iu", (2, 4)),
    "MaxPool": Operator(products.pooling, NUMBERS, outputs=(1, 2), attributes={**POOL, "storage_order": _flag()}),
    "Mod": Operator(elementwise.division, NUMBERS, TWO, attributes={"fmod": _flag()}),
    "Not": Operator(same, "b"),
    "PRelu": Operator(elementwise.slope, FLOATS, TWO),
    "Pad": Operator(layout.padding, ANY, (2, 4), attributes={"mode": _text("constant", "reflect", "edge", "wrap")}, left_out=(2,)),
    "Pow": Operator(elementwise.power, SIGNED, TWO),
    "QLinearConv": Operator(products.quantised_convolution, "iu", (8, 9), attributes=CONVOLUTION),
    "QLinearMatMul": Operator(products.quantised_matrix_product, "iu", (8, 8)),
    "QuantizeLinear": Operator(elementwise.quantisation, FLOATS, (2, 3), attributes={"axis": _axis(1), "saturate": _flag(1)}),
    "Reshape": Operator(layout.reshape, ANY, TWO, attributes={"allowzero": _flag()}),
    "ScatterElements": Operator(
        layout.scatter_elements, ANY, THREE, attributes={"axis": _axis(0), "reduction": _text("none", "add", "mul", "min", "max")}
    ),
    "Selu": Operator(same, FLOATS, attributes={"alpha": _real(1.6732632), "gamma": _real(1.050701)}),
    "Slice": Operator(layout.cut, ANY, (3, 5), left_out=(3,)),
    "SpaceToDepth": Operator(layout.space_to_depth, ANY, attributes={"blocksize": _whole(REQUIRED, 1)}),
    "Split": Operator(layout.split, ANY, (1, 2), MANY, {"axis": _axis(0), "num_outputs": _whole(None, 1)}),
    "Squeeze": Operator(layout.squeeze, ANY, (1, 2)),
    "Transpose": Operator(layout.transpose, ANY, attributes={"perm": Attribute(tuple, None, 0, LARGEST_RANK - 1)}),
    "Unsqueeze": Operator(layout.unsqueeze, ANY, TWO),
    "Where": Operator(elementwise.choice, "b", THREE),
}
"""Operators of the default domain that a model may use: those of NN_F, and those of feed-forward networks.

Left out on purpose: control flow; operators that make a tensor of a given size (ConstantOfShape, Expand, OneHot, Range, Resize, Tile);
whose output's size depends on values (Compress, NonZero, Unique); that are random, or work on texts and sequences.
"""


def standard_operator(name: str, domain: str) -> Operator:
    """The operator of a name in a domain, "" the standard one. Raises `ModelError` if a model may not use it."""
    if name not in OPERATORS or domain:
        found = f"operator {shown(name)}" + (f" of {shown(domain)}" if domain else "")
        raise ModelError(f"found the {found}; a model has static, standard operators only, without control flow")
    return OPERATORS[name]


def results(operator: str, inputs: Sequence[Tensor | None], outputs: int, stated: Mapping[str, Any]) -> Sequence[Tensor]:
    """Type and shape of what a node gives. `stated`: its attributes. Raises `ModelError` for a node that the operator does not take."""
    taken = standard_operator(operator, "")
    for count, (least, most), name in ((len(inputs), taken.inputs, "inputs"), (outputs, taken.outputs, "outputs")):
        if not least <= count <= most:
            raise ModelError(f"found {operator} with {count} {name}; it takes {least} to {most}: export the network again")
    for name, value in stated.items():
        if name not in taken.attributes or not taken.attributes[name].takes(value):
            found = f"{operator} with the attribute {shown(name)} = {shown(str(value))}"
            raise ModelError(f"found {found}, which the operator does not take; export the network again")
    attributes = {name: stated.get(name, attribute.default) for name, attribute in taken.attributes.items()}
    missing = [name for name, value in attributes.items() if value is REQUIRED]
    if missing:
        raise ModelError(f"found {operator} without its attribute {missing[0]}; export the network again")
    call = Call(operator, tuple(inputs), outputs, attributes)
    for place, tensor in enumerate(inputs):
        call.demand(tensor is not None or place in taken.left_out, f"without its input {place}")
    first = call.operand(0)
    call.demand(first.dtype.kind in taken.kinds, f"of type {first.dtype}")
    return taken.rule(call)

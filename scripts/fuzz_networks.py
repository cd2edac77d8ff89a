"""Random networks for `scripts/fuzz.py`: nodes of every operator that a model may use, with attributes, types and shapes of all kinds.

A node starts from an example of its operator that is taken (`EXAMPLES`), of which some is then changed as an attacker would. What it
reads is made of the frame, or a constant; nodes follow each other where shapes allow. A network is taken or refused like a user's, and
like NN_e in a model; what is taken must run, or fail, as `runtime.model.operators` says: with these types and shapes, and without a crash.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.compose
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from build_model.user_network import user_network
from runtime.model.format import IR_VERSION, NETWORK_OUTPUT, NETWORK_PREFIX, OPSET, ModelError
from runtime.model.onnx_subset import check_graph
from runtime.model.operators.table import OPERATORS
from runtime.model.operators.tensor import DTYPES, Tensor
from runtime.model.session import open_session
from runtime.scene import Axis, Bank, Camera, Domain, Marking, Runway, Scene

Random = np.random.Generator
SHAPE = (12, 16)
"""Of the frame that a network is made for."""
SCENE = Scene(
    Camera(SHAPE[1], SHAPE[0], 1e-3, 1e-5),
    Runway((Marking("m", 0.0, 0.0, 1.0),)),
    Domain(*(Axis((centre,), 0.0) for centre in (0.5, 0.0, 1.0, 2.0))),
    Bank(1, 1, 1.0),
)
POSITIVE = (1, 2, 3, 4, 5, 7, 8, 16, 63, 64, 65, 127, 128, 255, 2**14, 2**15, 2**31 - 1, 2**31, 2**32, 2**33, 2**62, 2**63 - 1)
HOSTILE = (0, *POSITIVE, *(-number for number in POSITIVE), -(2**63))
FACTORS = (1.0, -1.0, 0.5, 3.0, 255.0, -(2.0**31), 2.0**31, 2.0**63, -(2.0**63), 1e-40, 1e38, 3e38, np.inf, np.nan)
TYPES = {np.dtype(kind): number for number, kind in DTYPES.items()}
CHAINS = (10, 300, 1500, 20_000)
"""Lengths of nodes in a row, the last of which is more than are taken."""
CHAINED = ("Add", "Mul", "Relu", "Identity", "Mish", "Transpose", "Sqrt")


@dataclass(frozen=True)
class Computed:
    """An input that is made of the frame: its element type and shape."""

    dtype: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Example:
    """A node that is taken: its inputs, computed or constant, by place, its number of outputs and its attributes."""

    operator: str
    inputs: tuple[Computed | NDArray[Any] | None, ...]
    outputs: int = 1
    attributes: dict[str, Any] = field(default_factory=dict)


def _float(*shape: int) -> Computed:
    return Computed("<f4", shape)


def _constant(*shape: int) -> NDArray[np.float32]:
    return np.linspace(0.5, 1.5, int(np.prod(shape)), dtype=np.float32).reshape(shape)


def _whole(*numbers: int) -> NDArray[np.int64]:
    return np.array(numbers, dtype=np.int64)


def _bytes(*shape: int) -> NDArray[np.uint8]:
    return (np.arange(int(np.prod(shape))) % 251).astype(np.uint8).reshape(shape)


IMAGE, MATRIX = _float(1, 4, 6, 8), _float(4, 6)
INTEGERS, QUANTISED = Computed("<i4", (4, 6)), Computed("|u1", (1, 4, 6, 8))
SCALE, ZERO = np.array(0.5, dtype=np.float32), np.array(3, dtype=np.uint8)
WINDOW = {"auto_pad": "NOTSET", "kernel_shape": [3, 2], "strides": [2, 1], "dilations": [1, 2], "pads": [1, 0, 1, 1]}
SAME = {"auto_pad": "SAME_UPPER", "kernel_shape": [3, 2], "strides": [1, 1]}


def _examples() -> list[Example]:
    """At least one of every operator."""
    alpha = {"alpha": 0.5}
    unary = "Abs Neg Relu Sign Ceil Cos Erf Exp Floor Log Reciprocal Round Sin Sqrt HardSwish Mish Sigmoid Softplus Softsign Tanh Identity"
    found = [Example(name, (IMAGE,)) for name in unary.split()]
    found += [Example(name, (INTEGERS,)) for name in ("Abs", "Neg", "Relu", "Sign", "Identity")]
    found += [Example(name, (MATRIX,), attributes=alpha) for name in ("Celu", "Elu", "ThresholdedRelu", "LeakyRelu")]
    found += [
        Example("Selu", (MATRIX,), attributes={"alpha": 1.5, "gamma": 1.1}),
        Example("HardSigmoid", (MATRIX,), 1, alpha | {"beta": 0.4}),
    ]
    found += [Example("Gelu", (MATRIX,), attributes={"approximate": text}) for text in ("none", "tanh")]
    for kind in ("<f4", "<i4", "<i8"):
        pair = Computed(kind, (4, 6)), Computed(kind, (6,))
        found += [Example(name, pair) for name in ("Add", "Mul", "Sub", "Max", "Min", "Equal", "Less", "LessOrEqual", "Greater")]
        found += [Example("GreaterOrEqual", pair), Example("Where", (Computed("|b1", (6,)), *pair))]
        found += [Example(name, (pair[0], np.full(6, 7, dtype=kind))) for name in ("Div", "Pow")]
        found += [Example("Mod", (pair[0], np.full(6, 7, dtype=kind)), attributes={"fmod": int(kind == "<f4")})]
        found += [Example("Clip", (pair[0], np.array(0, dtype=kind), np.array(3, dtype=kind)))]
        reduced = {"keepdims": 1, "noop_with_empty_axes": 0}
        for name in ["L1", "L2", "LogSum", "LogSumExp", "Max", "Mean", "Min", "Prod", "Sum", "SumSquare"]:
            found += [Example(f"Reduce{name}", (pair[0], _whole(1)), 1, reduced), Example(f"Reduce{name}", (pair[0],))]
        extreme = {"axis": 1, "keepdims": 0, "select_last_index": 0}
        found += [Example(name, (pair[0],), attributes=extreme) for name in ("ArgMax", "ArgMin")]
        found += [Example("CumSum", (pair[0], np.array(1)), attributes={"exclusive": 1, "reverse": 1})]
        found += [Example("MatMul", (pair[0], Computed(kind, (2, 6, 3)))), Example("MatMul", pair)]
    found += [Example("Div", (MATRIX, _float(6))), Example("Pow", (MATRIX, _float(6))), Example("PRelu", (IMAGE, _constant(4, 1, 1)))]
    found += [Example(name, (MATRIX, _float(6), _float(4, 1))) for name in ("Mean", "Sum")]
    found += [Example(name, (Computed("|b1", (4, 6)), Computed("|b1", (6,)))) for name in ("And", "Or", "Xor")]
    found += [Example("Not", (Computed("|b1", (4, 6)),)), Example("Dropout", (IMAGE, SCALE), attributes={"seed": 1})]
    found += [Example("Cast", (Computed(kind, (4, 6)),), 1, {"to": to}) for kind in ("<f4", "<i4", "|u1") for to in (1, 2, 6, 7, 9, 10, 11)]
    found += [Example(name, (IMAGE,), attributes={"axis": -2}) for name in ("Softmax", "LogSoftmax")]
    found += [Example("LpNormalization", (IMAGE,), attributes={"axis": 1, "p": p}) for p in (1, 2)]
    return found + _layouts() + _windows() + _products()


def _layouts() -> list[Example]:
    indices, beside = Computed("<i8", (2, 2)), Computed("<i8", (3, 6))
    found = [Example("Concat", (IMAGE, _float(1, 2, 6, 8), _constant(1, 1, 6, 8)), attributes={"axis": 1})]
    found += [Example("DepthToSpace", (IMAGE,), attributes={"blocksize": 2, "mode": mode}) for mode in ("DCR", "CRD")]
    found += [Example("SpaceToDepth", (IMAGE,), attributes={"blocksize": 2}), Example("Flatten", (IMAGE,), attributes={"axis": 2})]
    found += [Example("Gather", (IMAGE, which), attributes={"axis": 1}) for which in (indices, _whole(3, 0, -1))]
    found += [Example("GatherElements", (MATRIX, which), attributes={"axis": 0}) for which in (beside, _whole(*range(4)).reshape(2, 2))]
    found += [
        Example("GatherND", (_float(2, 3, 4), which), attributes={"batch_dims": 1}) for which in (indices, _whole(1, 2).reshape(2, 1))
    ]
    for reduction in ("none", "add", "mul", "min", "max"):
        found += [Example("ScatterElements", (MATRIX, beside, _float(3, 6)), attributes={"axis": 0, "reduction": reduction})]
    for mode in ("constant", "reflect", "edge", "wrap"):
        found += [Example("Pad", (MATRIX, _whole(1, 0, 2, 1)), attributes={"mode": mode})]
    found += [Example("Pad", (IMAGE, _whole(-1, 2, 3, 0), SCALE, _whole(3, -2)))]
    found += [Example("Reshape", (IMAGE, _whole(0, 2, -1, 6)), 1, {"allowzero": 0}), Example("Reshape", (IMAGE, _whole(24, 8)))]
    found += [Example("Reshape", (_float(1, 1), _whole()))]
    found += [Example("Slice", (IMAGE, _whole(5, 0), _whole(-(2**63), 4), _whole(-1, 1), _whole(-2, 1)))]
    found += [Example("Slice", (MATRIX, _whole(1), _whole(2**62)))]
    found += [Example("Split", (IMAGE, _whole(1, 3)), 2, {"axis": 1}), Example("Split", (IMAGE,), 3, {"axis": 3, "num_outputs": 3})]
    found += [Example("Squeeze", (_float(1, 4, 1, 6), _whole(-2))), Example("Squeeze", (_float(1, 4, 1, 6),))]
    found += [Example("Unsqueeze", (MATRIX, _whole(0, -1))), Example("Transpose", (IMAGE,), attributes={"perm": [0, 2, 3, 1]})]
    return [*found, Example("Transpose", (MATRIX,))]


def _windows() -> list[Example]:
    grouped = {"group": 2}
    found = [Example("Conv", (IMAGE, _constant(6, 2, 3, 2), _constant(6)), 1, kind | grouped) for kind in (WINDOW, SAME)]
    found += [Example("Conv", (_float(1, 4, 9), _constant(3, 4, 3))), Example("Conv", (_float(1, 2, 5, 5, 5), _constant(3, 2, 3, 3, 3)))]
    found += [Example("ConvInteger", (QUANTISED, _bytes(6, 2, 3, 2), ZERO, ZERO), 1, kind | grouped) for kind in (WINDOW, SAME)]
    operands = QUANTISED, SCALE, ZERO, _bytes(6, 2, 3, 2), SCALE, ZERO, SCALE, ZERO, np.arange(6, dtype=np.int32)
    found += [Example("QLinearConv", operands, 1, kind | grouped) for kind in (WINDOW, SAME)]
    pool = {**WINDOW, "pads": [1, 0, 1, 1], "ceil_mode": 1}
    found += [Example("MaxPool", (IMAGE,), outputs, pool | {"storage_order": 1}) for outputs in (1, 2)]
    found += [Example("MaxPool", (QUANTISED,), 1, SAME), Example("MaxPool", (_float(1, 4, 9),), 2, {"kernel_shape": [2]})]
    found += [Example("AveragePool", (IMAGE,), 1, pool | {"count_include_pad": 1}), Example("AveragePool", (IMAGE,), 1, SAME)]
    found += [Example("LpPool", (IMAGE,), 1, pool | {"p": 3}), Example("LpPool", (IMAGE,), 1, SAME)]
    found += [Example(name, (IMAGE,)) for name in ("GlobalAveragePool", "GlobalMaxPool")]
    channels = tuple(_constant(4) for _ in range(4))
    found += [Example("BatchNormalization", (IMAGE, *channels), 1, {"epsilon": 1e-5, "momentum": 0.9, "training_mode": 0})]
    found += [Example("InstanceNormalization", (IMAGE, *channels[:2]), attributes={"epsilon": 1e-5})]
    found += [Example("LayerNormalization", (IMAGE, _constant(8), _constant(8)), 1, {"axis": -1, "epsilon": 1e-5, "stash_type": 1})]
    return [*found, Example("LRN", (IMAGE,), attributes={"alpha": 1e-4, "beta": 0.75, "bias": 1.0, "size": 3})]


def _products() -> list[Example]:
    found = [Example("Gemm", (MATRIX, _constant(3, 6), _constant(3)), 1, {"alpha": 0.5, "beta": 2.0, "transA": 0, "transB": 1})]
    quantised, column = Computed("|u1", (4, 6)), np.array([1, 2, 3], dtype=np.uint8)
    found += [Example("MatMulInteger", (quantised, _bytes(6, 3), ZERO, column)), Example("MatMulInteger", (quantised, _bytes(6, 3)))]
    found += [Example("QLinearMatMul", (quantised, SCALE, ZERO, _bytes(6, 3), SCALE, ZERO, SCALE, ZERO))]
    scales, zeros = _constant(4), np.arange(4, dtype=np.uint8)
    found += [
        Example("QuantizeLinear", (IMAGE, scales, zeros), 1, {"axis": 1, "saturate": 1}),
        Example("QuantizeLinear", (MATRIX, SCALE, ZERO)),
    ]
    found += [
        Example("DequantizeLinear", (QUANTISED, scales, zeros), 1, {"axis": 1}),
        Example("DequantizeLinear", (QUANTISED, SCALE, ZERO)),
    ]
    return [*found, Example("DynamicQuantizeLinear", (MATRIX,), 3)]


EXAMPLES = _examples()


def _pick(rng: Random, values: Any) -> Any:
    return values[int(rng.integers(len(values)))]


# --- what an attacker changes ---


def _changed_attribute(rng: Random, example: Example) -> Example:
    """A number or text of an attribute replaced, or a list cut or drawn out; an attribute taken away, added, or of another type."""
    attributes = dict(example.attributes)
    kind = rng.integers(10)
    if kind == 0 and attributes:
        del attributes[_pick(rng, list(attributes))]
    elif kind == 1:
        name = _pick(rng, [name for operator in OPERATORS.values() for name in operator.attributes])
        attributes[name] = _pick(rng, (0, 1, 2, -1, 1.5, "NOTSET", [1, 1]))
    elif attributes:
        name = _pick(rng, list(attributes))
        value = attributes[name]
        if isinstance(value, int):
            attributes[name] = int(_pick(rng, HOSTILE))
        elif isinstance(value, float):
            attributes[name] = float(_pick(rng, FACTORS))
        elif isinstance(value, str):
            attributes[name] = _pick(rng, ("NOTSET", "VALID", "SAME_LOWER", "add", "wrap", "CRD", "", "x" * 300))
        else:
            value = [int(_pick(rng, HOSTILE[:16])) if rng.random() < 0.4 else number for number in value]
            attributes[name] = value[: int(rng.integers(len(value) + 1))] if rng.random() < 0.2 else value + [1] * int(rng.random() < 0.1)
    return replace(example, attributes=attributes)


def _changed_input(rng: Random, example: Example) -> Example:
    """Another type, size, rank or value of an input; a constant in place of what is computed, or none."""
    inputs = list(example.inputs)
    place = int(rng.integers(len(inputs)))
    given = inputs[place]
    kind = rng.integers(6)
    if kind == 0:
        inputs[place] = None
    elif kind == 1:
        inputs.append(_pick(rng, [*inputs, SCALE, _whole(0, 1)]))
    elif isinstance(given, Computed):
        if kind == 2:
            inputs[place] = replace(given, dtype=_pick(rng, list(DTYPES.values())))
        elif kind == 3:
            inputs[place] = np.ones(given.shape, dtype=given.dtype)
        else:
            inputs[place] = replace(given, shape=_changed_shape(rng, given.shape))
    elif given is not None:
        with np.errstate(all="ignore"):
            if kind == 2:
                inputs[place] = given.astype(_pick(rng, list(DTYPES.values())))
            elif kind == 3:
                inputs[place] = np.resize(given, _changed_shape(rng, given.shape))
            else:
                values = given.ravel().copy()
                if values.size:
                    value = _pick(rng, HOSTILE if values.dtype.kind in "iu" else FACTORS)
                    values[int(rng.integers(values.size))] = np.array(value, dtype=object if isinstance(value, int) else None).astype(
                        values.dtype
                    )
                inputs[place] = values.reshape(given.shape)
    return replace(example, inputs=tuple(inputs))


def _changed_shape(rng: Random, shape: tuple[int, ...]) -> tuple[int, ...]:
    sizes = list(shape)
    kind = rng.integers(4)
    if kind == 0 and sizes:
        sizes.pop(int(rng.integers(len(sizes))))
    elif kind == 1:
        sizes.insert(int(rng.integers(len(sizes) + 1)), int(_pick(rng, (1, 1, 2, 3))))
    elif sizes:
        sizes[int(rng.integers(len(sizes)))] = int(_pick(rng, (0, 1, 1, 2, 3, 5, 7, 9, 16, 33, 64)))
    return tuple(sizes)


def changed(rng: Random, example: Example) -> Example:
    """The example as it is, or with a few changes."""
    for _ in range(int(rng.choice(4, p=[0.2, 0.4, 0.25, 0.15]))):
        example = _changed_attribute(rng, example) if rng.random() < 0.5 else _changed_input(rng, example)
    if rng.random() < 0.03:
        example = replace(example, outputs=int(_pick(rng, (0, 1, 2, 3, 40))))
    if rng.random() < 0.03:
        example = replace(example, operator=_pick(rng, list(OPERATORS)))
    return example


# --- networks ---


@dataclass
class Network:
    """A graph under construction, from `image` on."""

    rng: Random
    nodes: list[onnx.NodeProto] = field(default_factory=list)
    constants: list[onnx.TensorProto] = field(default_factory=list)

    def constant(self, values: NDArray[Any]) -> str:
        """The name of a new constant."""
        self.constants.append(numpy_helper.from_array(np.asarray(values), name := f"c{len(self.constants)}"))
        return name

    def node(self, operator: str, inputs: list[str], outputs: int = 1, **attributes: Any) -> list[str]:
        """The names of a new node's outputs."""
        names = [f"t{len(self.nodes)}_{place}" for place in range(outputs)]
        self.nodes.append(helper.make_node(operator, inputs, names, name=f"n{len(self.nodes)}", **attributes))
        return names

    def computed(self, wanted: Computed) -> str:
        """Pixels of the frame times some number, as often as needed, with the type and shape that are wanted."""
        size, pixels = int(np.prod(wanted.shape)), SHAPE[0] * SHAPE[1]
        times = -(-size // pixels)
        (flat,) = self.node("Reshape", ["image", self.constant(_whole(-1))])
        (flat,) = self.node("Concat", [flat] * times, axis=0) if times > 1 else [flat]
        (flat,) = self.node("Slice", [flat, self.constant(_whole(0)), self.constant(_whole(size))])
        if self.rng.random() < 0.7:
            factor = np.array(_pick(self.rng, FACTORS), dtype=np.float32)
            (flat,) = self.node("Mul", [flat, self.constant(factor)])
        (flat,) = self.node("Cast", [flat], to=TYPES[np.dtype(wanted.dtype)])
        return self.node("Reshape", [flat, self.constant(_whole(*wanted.shape))])[0]

    def example(self, example: Example, first: str | None = None) -> list[str]:
        """The example's node; `first`: in place of its first input."""
        names = [
            "" if given is None else self.computed(given) if isinstance(given, Computed) else self.constant(given)
            for given in example.inputs
        ]
        names[:1] = [first or names[0]] if names else []
        return self.node(example.operator, names, example.outputs, **example.attributes)

    def model(self, name: str) -> onnx.ModelProto:
        """The whole, whose answer is made of a tensor of any type and shape."""
        (numbers,) = self.node("Cast", [name], to=TensorProto.FLOAT)
        (largest,) = self.node("ReduceMax", [numbers], keepdims=0)
        self.nodes.append(helper.make_node("Mul", [largest, self.constant(np.ones((1, 4), dtype=np.float32))], ["state"], name="last"))
        image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, *SHAPE])
        state = helper.make_tensor_value_info("state", TensorProto.FLOAT, [1, 4])
        graph = helper.make_graph(self.nodes, "network", [image], [state], self.constants)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)


FOLLOWERS = [example for example in EXAMPLES if any(example.inputs[0] is given for given in (IMAGE, MATRIX))]
"""Examples that may follow another node."""


def fuzzed_network(rng: Random) -> onnx.ModelProto:
    """A network from `image`, float32 (1, 1, height, width), to `state`, float32 (1, 4), of a few nodes that may not fit each other."""
    while True:
        with contextlib.suppress(ValueError, OverflowError):  # onnx has no form for some numbers, numpy for some constants
            return _fuzzed_network(rng)


def _fuzzed_network(rng: Random) -> onnx.ModelProto:
    network = Network(rng)
    outputs = network.example(changed(rng, _pick(rng, EXAMPLES)))
    while outputs and rng.random() < 0.4:
        following = _pick(rng, FOLLOWERS)
        outputs = network.example(following if rng.random() < 0.7 else changed(rng, following), _pick(rng, outputs))
    return network.model(_pick(rng, outputs) if outputs else "image")


def with_network(model: onnx.ModelProto, network: onnx.ModelProto) -> None:
    """Puts a network in the place of a model's NN_e; it sees the upper left corner of the filtered frame."""
    graph, own = model.graph, onnx.compose.add_prefix(network, NETWORK_PREFIX).graph
    last = next(node for node in graph.node if node.output[0] == NETWORK_OUTPUT)
    kept = [node for node in graph.node if not (node.output[0].startswith(NETWORK_PREFIX) or node is last)]
    sizes = {"start": _whole(0, 0), "stop": _whole(*SHAPE), "axes": _whole(2, 3)}
    graph.initializer.extend(numpy_helper.from_array(values, f"{NETWORK_PREFIX}{name}") for name, values in sizes.items())
    graph.initializer.extend(own.initializer)
    cut = helper.make_node("Slice", ["filtered_image", *(f"{NETWORK_PREFIX}{name}" for name in sizes)], [f"{NETWORK_PREFIX}cut"])
    image = helper.make_node("Cast", [cut.output[0]], [own.input[0].name], to=TensorProto.FLOAT)
    answer = helper.make_node("Reshape", [own.output[0].name, last.input[1]], [NETWORK_OUTPUT])
    del graph.node[:]
    graph.node.extend([*kept, cut, image, *own.node, answer])


def with_chain(model: onnx.ModelProto, operator: str, length: int) -> None:
    """Puts nodes in a row before the answer of a model's NN_e."""
    graph = model.graph
    name = graph.node[-1].input[0]
    for number in range(length):
        inputs = [name, name] if operator in ("Add", "Mul") else [name]
        name = f"{NETWORK_PREFIX}chain_{number}"
        graph.node.insert(len(graph.node) - 1, helper.make_node(operator, inputs, [name]))
    graph.node[-1].input[0] = name


# --- the target ---


def run_network(path: Path) -> None:
    """Takes a network as a user's, and runs it on three frames.

    Raises `EstimatorError` and `ModelError` where it is refused or fails, and RuntimeError if a type or shape is not what
    `runtime.model.operators` says.
    """
    graph = user_network(SCENE, path)
    known = check_graph(graph.SerializeToString())
    names = [name for node in graph.node for name in node.output if name]
    del graph.output[:]
    graph.output.extend(helper.make_tensor_value_info(name, TYPES[known[name].dtype], known[name].shape) for name in names)
    opsets = [helper.make_opsetid("", OPSET)]
    session = open_session(helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION).SerializeToString(), path.name, 1)
    for frame in np.stack([np.zeros(SHAPE), np.ones(SHAPE), np.arange(SHAPE[0] * SHAPE[1]).reshape(SHAPE) % 3 == 0]):
        try:
            values = session.run(names, {"image": frame[None, None].astype(np.float32)})
        except Exception as error:  # onnxruntime raises classes of its own that share only this one
            raise ModelError(f"it fails when it runs ({' '.join(str(error).split())})") from error
        for name, value in zip(names, map(np.asarray, values), strict=True):
            if Tensor(value.dtype, value.shape) != known[name]:
                raise RuntimeError(f"{name} is {value.dtype} {value.shape}, not {known[name]}")

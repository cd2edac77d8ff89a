"""The ONNX that a model file may hold: its messages, operators and constants; and the check of a graph against them.

An ONNX file is a Protocol Buffers message, `ModelProto`. Only the fields that export-model writes are known here, and whatever else a
file holds is refused by name: weights in other files, sparse or typed tensors, functions, graphs within nodes, operators of other
domains. So everything that a file declares is there: a constant has the bytes that its shape and type ask for, and no operator makes a
tensor from a mere number.

What a graph may hold, all of it checked before onnxruntime sees the file:

- operators of `OPERATORS`: the output's shape follows from shapes and constants, and no value is made from a shape;
- their shape operands (`SHAPE_OPERANDS`) are constants, so that every shape is known before a frame is;
- attributes are numbers and texts, and constants are raw bytes of the types in `DTYPES`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.model.format import ModelError
from runtime.model.protobuf import Fields, Message, Reader, only_of, packed, parts_of, shown, text_of

LARGEST_RANK = 8
OLDEST_OPSET = 13
"""Oldest version of the standard operators that is taken: since then what decides a shape is an input, not an attribute."""
LARGEST_PADDING = 2**28
"""Largest factor by which the constants of a Pad may enlarge a tensor: a frame of the largest camera around a single pixel."""
DTYPES = {1: "<f4", 2: "|u1", 3: "|i1", 4: "<u2", 5: "<i2", 6: "<i4", 7: "<i8", 9: "|b1", 10: "<f2", 11: "<f8", 12: "<u4", 13: "<u8"}
"""onnx's numbers of the element types that a constant may have: numbers of a fixed size."""

ARITHMETIC = (
    "Abs Add Ceil Clip Cos Div Erf Exp Floor Log Max Mean Min Mod Mul Neg Pow Reciprocal Round Sign Sin Sqrt Sub Sum "
    "And Equal Greater GreaterOrEqual Less LessOrEqual Not Or Where Xor Cast Identity"
)
REDUCTIONS = (
    "ArgMax ArgMin CumSum "
    "ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare"
)
LAYOUT = (
    "Concat DepthToSpace Flatten Gather GatherElements GatherND Pad Reshape ScatterElements Slice SpaceToDepth Split Squeeze "
    "Transpose Unsqueeze"
)
LAYERS = (
    "AveragePool BatchNormalization Celu Conv Dropout Elu Gelu Gemm GlobalAveragePool GlobalMaxPool HardSigmoid "
    "HardSwish InstanceNormalization LRN LayerNormalization LeakyRelu LogSoftmax LpNormalization LpPool MatMul MaxPool Mish PRelu Relu "
    "Selu Sigmoid Softmax Softplus Softsign Tanh ThresholdedRelu "
    "ConvInteger DequantizeLinear DynamicQuantizeLinear MatMulInteger QLinearConv QLinearMatMul QuantizeLinear"
)
OPERATORS = frozenset(" ".join((ARITHMETIC, REDUCTIONS, LAYOUT, LAYERS)).split())
"""Operators of the default domain that a model may use: those of NN_F, and those of feed-forward networks.

Left out on purpose: control flow; operators that make a tensor of a given size (ConstantOfShape, Expand, OneHot, Range, Resize, Tile);
whose output's size depends on values (Compress, NonZero, Unique); that are random, or work on texts and sequences.
"""
SHAPE_OPERANDS = {"Pad": (1, 3), "Reshape": (1,), "Slice": (1, 2, 3, 4), "Split": (1,), "Squeeze": (1,), "Unsqueeze": (1,)}
SHAPE_OPERANDS |= {name: (1,) for name in REDUCTIONS.split() if name.startswith("Reduce")}
"""Places of the inputs that decide the shape of an operator's output."""

MODEL = Message(
    "a file",
    {1: "ir_version", 2: "producer_name", 7: "graph"},
    {8: "opset_import", 14: "metadata_props"},
    {20: "training_info", 25: "functions"},
)
GRAPH = Message(
    "a graph",
    {2: "name"},
    {1: "node", 5: "initializer", 11: "input", 12: "output"},
    {13: "value_info", 14: "quantization_annotation", 15: "sparse_initializer"},
)
NODE = Message("a node", {3: "name", 4: "op_type", 7: "domain", 8: "overload"}, {1: "input", 2: "output", 5: "attribute"}, {})
ATTRIBUTE = Message(
    "an attribute",
    {1: "name", 2: "f", 3: "i", 4: "s", 20: "type"},
    {7: "floats", 8: "ints", 9: "strings"},
    {5: "a tensor", 6: "a graph", 10: "tensors", 11: "graphs", 21: "ref_attr_name", 22: "a sparse tensor", 23: "sparse tensors"},
)
TENSOR = Message(
    "a constant",
    {2: "data_type", 8: "name", 9: "raw_data"},
    {1: "dims"},
    {4: "float_data", 5: "int32_data", 6: "string_data", 7: "int64_data", 10: "double_data", 11: "uint64_data", 13: "external_data"}
    | {14: "data_location"},
)
PROPERTY = Message("metadata_props", {1: "key", 2: "value"}, {}, {})
OPSET = Message("opset_import", {1: "domain", 2: "version"}, {}, {})


def check_graph(graph: bytes) -> None:
    """Raises `ModelError` unless a serialised GraphProto holds nothing but what a model may hold (see above)."""
    try:
        checked_graph(Reader(), memoryview(graph))
    except (IndexError, ValueError) as error:
        raise error if isinstance(error, ModelError) else ModelError("found a graph that cannot be read; export it again") from error


def file_parts(reader: Reader, model: memoryview) -> tuple[memoryview, dict[str, bytes], list[str]]:
    """The graph, the metadata by key, and the names of fields that no model has. Raises ValueError and IndexError too."""
    fields, rest = reader.read(model, MODEL)
    properties: dict[str, bytes] = {}
    for entry in parts_of(fields["metadata_props"]):
        pair = reader.known(entry, PROPERTY)
        properties[text_of(pair["key"])] = bytes(only_of(pair["value"]))
    opsets = [reader.known(entry, OPSET) for entry in parts_of(fields["opset_import"])]
    versions = [(text_of(opset["domain"]), *(int(part) for part in opset["version"] if isinstance(part, int))) for opset in opsets]
    if not (len(versions) == 1 and versions[0][0] == "" and versions[0][1:] >= (OLDEST_OPSET,)):
        rest.append(f"operator sets {shown(str(versions))}")
    return only_of(fields["graph"]), properties, rest


def checked_graph(reader: Reader, graph: memoryview) -> dict[str, NDArray[Any]]:
    """The constants of a graph that holds nothing but what a model may hold. Raises ValueError and IndexError too."""
    fields = reader.known(graph, GRAPH)
    constants: dict[str, NDArray[Any]] = {}
    for message in parts_of(fields["initializer"]):
        tensor = reader.known(message, TENSOR)
        label = text_of(tensor["name"])
        if label in constants:
            raise ModelError(f"found two constants {shown(label)}; export it again with export-model")
        constants[label] = _array(label, tensor)
    for message in parts_of(fields["node"]):
        _check_node(reader, reader.known(message, NODE), constants)
    return constants


def _check_node(reader: Reader, node: Fields, constants: dict[str, NDArray[Any]]) -> None:
    operator, domain = text_of(node["op_type"]), text_of(node["domain"]) + text_of(node["overload"])
    if operator not in OPERATORS or domain:
        found = f"operator {shown(operator)}" + (f" of {shown(domain)}" if domain else "")
        raise ModelError(f"found the {found}; a model has static, standard operators only, without control flow")
    attributes = [reader.known(attribute, ATTRIBUTE) for attribute in parts_of(node["attribute"])]
    inputs = [bytes(part).decode() for part in parts_of(node["input"])]
    for place in SHAPE_OPERANDS.get(operator, ()):
        if place < len(inputs) and inputs[place] and inputs[place] not in constants:
            raise ModelError(f"found {operator} with a shape that is computed, {shown(inputs[place])}; only constant shapes are taken")
    if operator == "Split":
        _check_split(len(node["output"]), attributes, constants.get(inputs[1]) if len(inputs) > 1 else None)
    if operator == "Pad":
        _check_padding(constants.get(inputs[1] if len(inputs) > 1 else "", np.zeros(0)))


def _array(label: str, tensor: Fields) -> NDArray[Any]:
    """The array of a TensorProto's fields, its data in place; its dims come one by one or packed. Raises `ModelError`."""
    dims = [number for part in tensor["dims"] for number in ([part] if isinstance(part, int) else packed(part, LARGEST_RANK))]
    (kind,), raw = tensor["data_type"] or (0,), only_of(tensor["raw_data"])
    dtype = np.dtype(DTYPES.get(kind, "V")) if isinstance(kind, int) else np.dtype("V")
    size = math.prod(dims) * dtype.itemsize
    if dtype.kind == "V" or len(dims) > LARGEST_RANK or len(raw) != size or max(dims, default=0) >= 2**31:
        found = f"shape {shown(str(dims))}, type {kind}, {len(raw)} bytes of data"
        raise ModelError(f"found the constant {shown(label)} with {found}, which do not fit or are not taken; export it again")
    return np.frombuffer(raw, dtype=dtype).reshape(dims)


def _check_padding(pads: NDArray[Any]) -> None:
    """Raises `ModelError` if a Pad by these numbers, all befores and then all afters, can enlarge a tensor beyond the limit."""
    axes = pads.astype(object).reshape(2, -1).T if pads.size <= 2 * LARGEST_RANK else []
    if len(axes) == 0 or math.prod(1 + abs(before) + abs(after) for before, after in axes) > LARGEST_PADDING:
        raise ModelError(f"found a Pad by {shown(str(pads))}; at most {LARGEST_PADDING} times the size is taken")


def _check_split(outputs: int, attributes: list[Fields], sizes: NDArray[Any] | None) -> None:
    """Raises `ModelError` unless a Split has as many outputs as it says: onnxruntime ends the process where it has more."""
    stated = [part["i"][0] for part in attributes if text_of(part["name"]) == "num_outputs" and part["i"]]
    if sizes is not None:
        stated.append(sizes.size)
    if any(number != outputs for number in stated):
        raise ModelError(f"found a Split into {stated[0]} parts with {outputs} outputs; export it again with export-model")

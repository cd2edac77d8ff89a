"""The ONNX that a model file may hold: its messages, and the check of a graph before onnxruntime sees it.

An ONNX file is a Protocol Buffers message, `ModelProto`. Only the fields that export-model writes are known here, and whatever else a
file holds is refused by name: weights in other files, sparse or typed tensors, functions, graphs within nodes, operators of other
domains. So everything that a file declares is there: a constant has the bytes that its shape and type ask for, and no operator makes a
tensor from a mere number. What operators do with them, and how large the whole may be, is said and checked in `runtime.model.operators`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from runtime.model.format import OPSET, ModelError
from runtime.model.operators.graph import MOST_NODES, Node, check_nodes
from runtime.model.operators.table import standard_operator
from runtime.model.operators.tensor import DTYPES, LARGEST_RANK, Tensor
from runtime.model.protobuf import Message, Reader, number_of, numbers_of, only_of, parts_of, shown, text_of

MOST_VALUES = 2**13
"""Most constants, most inputs and most outputs that a graph may have."""
MOST_NUMBERS = 4 * LARGEST_RANK
"""Most numbers that are read of a shape or an attribute: twice as many as one may have."""

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
OPSET_IMPORT = Message("opset_import", {1: "domain", 2: "version"}, {}, {})
VALUE = Message("an input or output", {1: "name", 2: "type"}, {}, {})
TYPE = Message("a type", {1: "tensor_type"}, {}, {4: "a sequence", 5: "a map", 8: "a sparse tensor", 9: "an optional value"})
TENSOR_TYPE = Message("a tensor's type", {1: "elem_type", 2: "shape"}, {}, {})
SHAPE = Message("a shape", {}, {1: "dim"}, {})
DIMENSION = Message("a dimension", {1: "dim_value"}, {}, {2: "a name for any size", 3: "a denotation"})
VALUE_FIELDS = {1: "f", 2: "i", 3: "s", 7: "ints"}
"""The field of an attribute that holds its value, by onnx's number of the attribute's type."""

Named = TypeVar("Named")


def check_graph(graph: bytes) -> dict[str, Tensor]:
    """What is known of every tensor of a serialised GraphProto, by name. Raises `ModelError` if it holds what a model may not hold."""
    try:
        return checked_graph(Reader(), memoryview(graph))[1]
    except (IndexError, ValueError) as error:
        raise error if isinstance(error, ModelError) else ModelError("found a graph that cannot be read; export it again") from error


def file_parts(reader: Reader, model: memoryview) -> tuple[memoryview, dict[str, bytes], list[str]]:
    """The graph, the metadata by key, and the names of fields that no model has. Raises ValueError and IndexError too."""
    fields, rest = reader.read(model, MODEL)
    properties: dict[str, bytes] = {}
    for entry in parts_of(fields["metadata_props"]):
        pair = reader.known(entry, PROPERTY)
        properties[text_of(pair["key"])] = bytes(only_of(pair["value"]))
    opsets = [reader.known(entry, OPSET_IMPORT) for entry in parts_of(fields["opset_import"])]
    versions = [(text_of(opset["domain"]), *(int(part) for part in opset["version"] if isinstance(part, int))) for opset in opsets]
    if versions != [("", OPSET)]:
        rest.append(f"operator sets {shown(str(versions))}, not the standard one, version {OPSET}")
    return only_of(fields["graph"]), properties, rest


def checked_graph(reader: Reader, graph: memoryview) -> tuple[dict[str, NDArray[Any]], dict[str, Tensor]]:
    """The constants of a graph that holds nothing but what a model may hold, and what is known of all its tensors.

    Raises ValueError and IndexError too.
    """
    fields = reader.known(graph, GRAPH)
    for part, most in (("node", MOST_NODES), ("initializer", MOST_VALUES), ("input", MOST_VALUES), ("output", MOST_VALUES)):
        if (count := len(fields[part])) > most:
            raise ModelError(f"found a graph with {count} fields {part}; at most {most} are taken: use a smaller network")
    constants = dict(_unique("constants", (_constant(reader, message) for message in parts_of(fields["initializer"]))))
    given = {label: Tensor(array.dtype, array.shape, values=array) for label, array in constants.items()}
    for label, stated in _unique("inputs", (_value(reader, message) for message in parts_of(fields["input"]))):
        _check_stated("input", label, stated, given.get(label, stated))
        given[label] = stated  # without values, which are the caller's even where a constant is their default
    known = check_nodes([_node(reader, message) for message in parts_of(fields["node"])], given)
    for message in parts_of(fields["output"]):
        label, stated = _value(reader, message)
        _check_stated("output", label, stated, known.get(label))
    return constants, known


def _unique(kind: str, named: Iterable[tuple[str, Named]]) -> list[tuple[str, Named]]:
    """The pairs. Raises `ModelError` if two have one name."""
    pairs, names = [], set()
    for name, value in named:
        if name in names:
            raise ModelError(f"found two {kind} {shown(name)}; export it again with export-model")
        names.add(name)
        pairs.append((name, value))
    return pairs


def _check_stated(kind: str, name: str, stated: Tensor, known: Tensor | None) -> None:
    """Raises `ModelError` unless an input's or output's type and shape are those that are known."""
    if stated != known:
        found = f"{shown(name)} stated as {stated} where it is {'missing' if known is None else known}"
        raise ModelError(f"found the {kind} {found}; export it again with export-model")


def _node(reader: Reader, message: memoryview) -> Node:
    """A node with its attributes' values."""
    node = reader.known(message, NODE)
    operator = text_of(node["op_type"])
    standard_operator(operator, text_of(node["domain"]) + text_of(node["overload"]))
    attributes = _unique(f"attributes of {shown(operator)}", (_attribute(reader, attribute) for attribute in parts_of(node["attribute"])))
    inputs, outputs = ([bytes(part).decode() for part in parts_of(node[side])] for side in ("input", "output"))
    while outputs and not outputs[-1]:
        outputs.pop()  # one that is left out
    return Node(operator, tuple(inputs), tuple(outputs), dict(attributes))


def _attribute(reader: Reader, message: memoryview) -> tuple[str, int | float | str | tuple[int, ...]]:
    """Name and value of an attribute, which has one value, of the type that it states."""
    attribute = reader.known(message, ATTRIBUTE)
    name, kind = text_of(attribute["name"]), number_of(attribute["type"])
    field = VALUE_FIELDS.get(kind, "")
    if not field or any(attribute[other] for other in ("floats", "strings", *VALUE_FIELDS.values()) if other != field):
        raise ModelError(f"found the attribute {shown(name)} of type {kind} with other values; export it again with export-model")
    values = attribute[field]
    if field == "s":
        return name, text_of(values)
    if field == "f":
        return name, float(np.frombuffer(only_of(values) or bytes(4), "<f4").item())
    return name, number_of(values) if field == "i" else tuple(numbers_of(values, MOST_NUMBERS))


def _value(reader: Reader, message: memoryview) -> tuple[str, Tensor]:
    """Name, type and shape of an input or output."""
    value = reader.known(message, VALUE)
    tensor = reader.known(only_of(reader.known(only_of(value["type"]), TYPE)["tensor_type"]), TENSOR_TYPE)
    name, kind = text_of(value["name"]), number_of(tensor["elem_type"])
    dims = [number_of(reader.known(dim, DIMENSION)["dim_value"]) for dim in parts_of(reader.known(only_of(tensor["shape"]), SHAPE)["dim"])]
    if not tensor["shape"] or kind not in DTYPES or len(dims) > LARGEST_RANK or min(dims, default=1) < 1:
        raise ModelError(f"found {shown(name)} of type {kind} and shape {shown(str(dims))}; export it again with fixed shapes throughout")
    return name, Tensor(np.dtype(DTYPES[kind]), tuple(dims))


def _constant(reader: Reader, message: memoryview) -> tuple[str, NDArray[Any]]:
    """Name and array of a constant, its data in place. Raises `ModelError`."""
    tensor = reader.known(message, TENSOR)
    label, kind = text_of(tensor["name"]), number_of(tensor["data_type"])
    dims, raw = numbers_of(tensor["dims"], MOST_NUMBERS), only_of(tensor["raw_data"])
    dtype = np.dtype(DTYPES.get(kind, "V"))
    size = math.prod(dims) * dtype.itemsize
    if dtype.kind == "V" or len(dims) > LARGEST_RANK or len(raw) != size or not all(0 <= dim < 2**31 for dim in dims):
        found = f"shape {shown(str(dims))}, type {kind}, {len(raw)} bytes of data"
        raise ModelError(f"found the constant {shown(label)} with {found}, which do not fit or are not taken; export it again")
    return label, np.frombuffer(raw, dtype=dtype).reshape(dims)

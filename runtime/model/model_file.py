"""Reads a model file that nobody has vouched for: metadata, digests, constants, and a check of everything that onnxruntime would be given.

An ONNX file is a Protocol Buffers message, `ModelProto`. It is read from the wire format directly, so that the runtime needs no onnx
package. Only the fields that export-model writes are known here, and whatever else a file holds is refused by name: weights in other
files, sparse or typed tensors, functions, graphs within nodes, operators of other domains. So the file is read once, in time
proportional to its size, and everything it declares is there: a constant has the bytes that its shape and type ask for, and no
operator makes a tensor from a mere number.

What a graph may hold, all of it checked before onnxruntime sees the file:

- operators of `OPERATORS`: the output's shape follows from shapes and constants, and no value is made from a shape;
- their shape operands (`SHAPE_OPERANDS`) are constants, so that every shape is known before a frame is;
- attributes are numbers and texts, and constants are raw bytes of the types in `DTYPES`.
"""

from __future__ import annotations

import hashlib
import json
import math
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

PACKAGED_MODELS = (Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "models")
"""Where the paper's model lies: in a wheel inside the package, in a checkout at the top."""
FORMAT_VERSION = 1
METADATA_KEY = "glideproof"

LARGEST_FILE_BYTES = 2**28
"""Size of the largest file that is read, 200 times the paper's model."""
LARGEST_METADATA_BYTES = 2**24
"""Size of the largest metadata that are parsed: JSON takes up to 20 times as much memory."""
LARGEST_FIELDS = 2**20
"""Fields that are read of one file, a second's work."""
LARGEST_RANK = 8
OLDEST_OPSET = 13
"""Oldest version of the standard operators that is taken: since then what decides a shape is an input, not an attribute."""
LARGEST_PADDING = 2**28
"""Largest factor by which the constants of a Pad may enlarge a tensor: a frame of the largest camera around a single pixel."""
LONGEST_VARINT = 10
LONGEST_SHOWN = 60
"""Characters of a name from the file that an error quotes."""

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


class ModelError(ValueError):
    """A model file that is not ours, damaged, of another version, or does not match what the caller demands."""


@dataclass(frozen=True)
class Message:
    """Fields of a Protocol Buffers message that a model may hold, by number: `once` at most once, `often` any number of times.

    `never`: names of some of the others, for messages.
    """

    name: str
    once: dict[int, str]
    often: dict[int, str]
    never: dict[int, str]

    def name_of(self, number: int) -> str:
        """What an error calls a field that a model must not hold."""
        return self.never.get(number, f"field {number}")


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

Value = int | memoryview
Fields = dict[str, list[Value]]


@dataclass(frozen=True)
class ModelFile:
    """The bytes of a model with its metadata; exists only if graph and metadata have the digests that the metadata state."""

    content: bytes
    metadata: dict[str, Any]
    tensors: dict[str, NDArray[Any]]
    """The initialisers that were asked for, read-only."""

    @property
    def sha256(self) -> str:
        """Digest of the whole file, hexadecimal."""
        return hashlib.sha256(self.content).hexdigest()


def read_model(path: Path) -> bytes:
    """The file's bytes. Raises `ModelError` if it cannot be read, is none, or is too large to be a model."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > LARGEST_FILE_BYTES:
            limit = f"files of up to {LARGEST_FILE_BYTES >> 20} MiB are read"
            raise ModelError(
                f"{path}: cannot be read (not a file, or of {status.st_size} bytes); {limit}: give a model that export-model wrote"
            )
        return path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror}); give the path of a model that export-model wrote") from error
    except ValueError as error:  # a null character in the path
        raise ModelError(f"{str(path)!r}: cannot be read ({error}); give the path of a model that export-model wrote") from error


def packaged_model() -> Path:
    """The paper's model that comes with the package. Raises `ModelError` if it is missing."""
    for folder in PACKAGED_MODELS:
        if (folder / "paper.onnx").is_file():
            return folder / "paper.onnx"
    raise ModelError("paper.onnx: comes with the package but is missing; give the path of a model, or reinstall glideproof")


def parse_model(content: bytes, name: str, wanted: Sequence[str] = ()) -> ModelFile:
    """Checks format, version, digests and graph, and reads the initialisers `wanted`. `name` is for messages. Raises `ModelError`."""
    try:
        reader = _Reader()
        graph, properties, rest = reader.parts(memoryview(content))
        metadata = _checked_metadata(properties, graph)
        if rest:
            raise ModelError(f"found {rest[0]}, which export-model does not write; export it again")
        constants = reader.checked_graph(graph)
    except ModelError as error:
        raise ModelError(f"{name}: {error}") from error
    except (IndexError, ValueError) as error:
        raise ModelError(f"{name}: not an ONNX model, or cut short; export it again with export-model") from error
    if missing := sorted(set(wanted) - set(constants)):
        raise ModelError(f"{name}: it lacks the initialisers {missing}; export it again with export-model")
    return ModelFile(content, metadata, {label: constants[label] for label in wanted})


def check_graph(graph: bytes) -> None:
    """Raises `ModelError` unless a serialised GraphProto holds nothing but what a model may hold (see above)."""
    try:
        _Reader().checked_graph(memoryview(graph))
    except (IndexError, ValueError) as error:
        raise error if isinstance(error, ModelError) else ModelError("found a graph that cannot be read; export it again") from error


def metadata_digest(metadata: dict[str, Any]) -> str:
    """sha256 of the metadata as JSON with sorted keys, but for `metadata_sha256`, which holds it."""
    others = {key: value for key, value in metadata.items() if key != "metadata_sha256"}
    return hashlib.sha256(json.dumps(others, sort_keys=True).encode()).hexdigest()


def _checked_metadata(properties: dict[str, bytes], graph: memoryview) -> dict[str, Any]:
    """The metadata, if they and the graph have the digests that they state."""
    if METADATA_KEY not in properties:
        raise ModelError(f"no metadata {METADATA_KEY!r}: an ONNX model, but not one that export-model wrote")
    metadata, own_digest = _parsed_metadata(properties[METADATA_KEY])
    if metadata.get("format_version") != FORMAT_VERSION:
        found = _shown(repr(metadata.get("format_version")))
        raise ModelError(f"format version {found}, this runtime reads {FORMAT_VERSION}; export again or change versions")
    digest = hashlib.sha256(graph).hexdigest()
    if metadata.get("graph_sha256") != digest:
        raise ModelError(f"damaged: its graph has sha256 {digest[:16]}..., its metadata say otherwise; get it again")
    if metadata.get("metadata_sha256") != own_digest:
        raise ModelError("damaged: its metadata do not have the sha256 that they state; get it again")
    return metadata


def _parsed_metadata(text: bytes) -> tuple[dict[str, Any], str]:
    """The metadata and their digest."""
    if len(text) > LARGEST_METADATA_BYTES:
        raise ModelError(f"found metadata of {len(text)} bytes; at most {LARGEST_METADATA_BYTES} are read: use a scene of fewer cells")
    try:
        metadata = json.loads(text.decode("utf-8"))
        if isinstance(metadata, dict):
            return metadata, metadata_digest(metadata)
    except (ValueError, RecursionError) as error:
        raise ModelError("its metadata are not JSON; export it again with export-model") from error
    raise ModelError("its metadata are not a JSON object; export it again with export-model")


class _Reader:
    """Reads the messages of one file, up to `LARGEST_FIELDS` fields in all."""

    def __init__(self) -> None:
        self.fields_left = LARGEST_FIELDS

    def parts(self, model: memoryview) -> tuple[memoryview, dict[str, bytes], list[str]]:
        """The graph, the metadata by key, and the names of fields that no model has. Raises ValueError and IndexError too."""
        fields, rest = self.read(model, MODEL)
        properties: dict[str, bytes] = {}
        for entry in _bytes(fields["metadata_props"]):
            pair = self.known(entry, PROPERTY)
            properties[_text(pair["key"])] = bytes(_only(pair["value"]))
        opsets = [self.known(entry, OPSET) for entry in _bytes(fields["opset_import"])]
        versions = [(_text(opset["domain"]), *(int(part) for part in opset["version"] if isinstance(part, int))) for opset in opsets]
        if not (len(versions) == 1 and versions[0][0] == "" and versions[0][1:] >= (OLDEST_OPSET,)):
            rest.append(f"operator sets {_shown(str(versions))}")
        return _only(fields["graph"]), properties, rest

    def checked_graph(self, graph: memoryview) -> dict[str, NDArray[Any]]:
        """The constants of a graph that holds nothing but what a model may hold. Raises ValueError and IndexError too."""
        fields = self.known(graph, GRAPH)
        constants: dict[str, NDArray[Any]] = {}
        for message in _bytes(fields["initializer"]):
            tensor = self.known(message, TENSOR)
            label = _text(tensor["name"])
            if label in constants:
                raise ModelError(f"found two constants {_shown(label)}; export it again with export-model")
            constants[label] = _array(label, tensor)
        for message in _bytes(fields["node"]):
            self._check_node(self.known(message, NODE), constants)
        return constants

    def _check_node(self, node: Fields, constants: dict[str, NDArray[Any]]) -> None:
        operator, domain = _text(node["op_type"]), _text(node["domain"]) + _text(node["overload"])
        if operator not in OPERATORS or domain:
            found = f"operator {_shown(operator)}" + (f" of {_shown(domain)}" if domain else "")
            raise ModelError(f"found the {found}; a model has static, standard operators only, without control flow")
        attributes = [self.known(attribute, ATTRIBUTE) for attribute in _bytes(node["attribute"])]
        inputs = [bytes(part).decode() for part in _bytes(node["input"])]
        for place in SHAPE_OPERANDS.get(operator, ()):
            if place < len(inputs) and inputs[place] and inputs[place] not in constants:
                raise ModelError(f"found {operator} with a shape that is computed, {_shown(inputs[place])}; only constant shapes are taken")
        if operator == "Split":
            _check_split(len(node["output"]), attributes, constants.get(inputs[1]) if len(inputs) > 1 else None)
        if operator == "Pad":
            _check_padding(constants.get(inputs[1] if len(inputs) > 1 else "", np.zeros(0)))

    def known(self, message: memoryview, kind: Message) -> Fields:
        """`read` for a message that may hold nothing else."""
        fields, rest = self.read(message, kind)
        if rest:
            raise ModelError(f"found {rest[0]} in {kind.name}, which export-model does not write; export it again")
        return fields

    def read(self, message: memoryview, kind: Message) -> tuple[Fields, list[str]]:
        """The values of a message by field, and what else it holds. Raises `ModelError`, ValueError or IndexError."""
        names = kind.once | kind.often
        found: Fields = {name: [] for name in names.values()}
        rest = []
        for number, value in _wire_fields(message):
            self.fields_left -= 1
            if self.fields_left < 0:
                raise ModelError(f"found more than {LARGEST_FIELDS} fields; a model has fewer")
            if number not in names:
                rest.append(kind.name_of(number))
                continue
            if number in kind.once and found[names[number]]:
                raise ModelError(f"found {names[number]} twice in {kind.name}; export it again with export-model")
            found[names[number]].append(value)
        return found, rest


def _array(label: str, tensor: Fields) -> NDArray[Any]:
    """The array of a TensorProto's fields, its data in place; its dims come one by one or packed. Raises `ModelError`."""
    dims = [number for part in tensor["dims"] for number in ([part] if isinstance(part, int) else _packed(part))]
    (kind,), raw = tensor["data_type"] or (0,), _only(tensor["raw_data"])
    dtype = np.dtype(DTYPES.get(kind, "V")) if isinstance(kind, int) else np.dtype("V")
    size = math.prod(dims) * dtype.itemsize
    if dtype.kind == "V" or len(dims) > LARGEST_RANK or len(raw) != size or max(dims, default=0) >= 2**31:
        found = f"shape {_shown(str(dims))}, type {kind}, {len(raw)} bytes of data"
        raise ModelError(f"found the constant {_shown(label)} with {found}, which do not fit or are not taken; export it again")
    return np.frombuffer(raw, dtype=dtype).reshape(dims)


def _check_padding(pads: NDArray[Any]) -> None:
    """Raises `ModelError` if a Pad by these numbers, all befores and then all afters, can enlarge a tensor beyond the limit."""
    axes = pads.astype(object).reshape(2, -1).T if pads.size <= 2 * LARGEST_RANK else []
    if len(axes) == 0 or math.prod(1 + abs(before) + abs(after) for before, after in axes) > LARGEST_PADDING:
        raise ModelError(f"found a Pad by {_shown(str(pads))}; at most {LARGEST_PADDING} times the size is taken")


def _check_split(outputs: int, attributes: list[Fields], sizes: NDArray[Any] | None) -> None:
    """Raises `ModelError` unless a Split has as many outputs as it says: onnxruntime ends the process where it has more."""
    stated = [part["i"][0] for part in attributes if _text(part["name"]) == "num_outputs" and part["i"]]
    if sizes is not None:
        stated.append(sizes.size)
    if any(number != outputs for number in stated):
        raise ModelError(f"found a Split into {stated[0]} parts with {outputs} outputs; export it again with export-model")


def _packed(part: memoryview) -> list[int]:
    values, position = [], 0
    while position < len(part):
        if len(values) > LARGEST_RANK:
            raise ValueError("a shape of too many axes")
        value, position = _varint(part, position)
        values.append(value)
    return values


def _only(values: list[Value]) -> memoryview:
    """The value of a field of bytes that occurs at most once, empty without it."""
    (value,) = _bytes(values) or [memoryview(b"")]
    return value


def _bytes(values: list[Value]) -> list[memoryview]:
    """The values of a field of bytes. Raises ValueError if one is a number."""
    parts = [value for value in values if isinstance(value, memoryview)]
    if len(parts) < len(values):
        raise ValueError("a number in place of bytes")
    return parts


def _text(values: list[Value]) -> str:
    return bytes(_only(values)).decode("utf-8")


def _shown(text: str) -> str:
    """A text from the file as an error quotes it: printable, and not too long."""
    plain = text if text.isprintable() else ascii(text)
    return plain if len(plain) <= LONGEST_SHOWN else f"{plain[:LONGEST_SHOWN]}..."


def _wire_fields(message: memoryview) -> Iterator[tuple[int, Value]]:
    """Number and value of every field: a varint as a number, anything else as its bytes. Raises ValueError or IndexError."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        field, wire_type = key >> 3, key & 7
        if wire_type == 0:
            value, position = _varint(message, position)
            yield field, value
            continue
        if wire_type == 2:
            length, position = _varint(message, position)
        elif wire_type in (1, 5):
            length = 8 if wire_type == 1 else 4
        else:
            raise ValueError("unknown wire type")
        if position + length > len(message):
            raise ValueError("field beyond the end")
        yield field, message[position : position + length]
        position += length


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for offset in range(LONGEST_VARINT):
        byte = message[position + offset]
        value |= (byte & 0x7F) << (7 * offset)
        if byte < 0x80:
            return value, position + offset + 1
    raise ValueError("varint too long")

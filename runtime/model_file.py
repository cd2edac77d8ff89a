"""Reads what the runtime must know of a model file before it trusts it: metadata and the digest of the graph.

An ONNX file is a Protocol Buffers message, `ModelProto`. What is needed is read from the wire format directly, so that the runtime needs
no onnx package: field 7, the graph, whose field 5 lists its initialisers, and field 14, the metadata, a list of (key 1, value 2) texts.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMAT_VERSION = 1
METADATA_KEY = "glideproof"
GRAPH_FIELD, METADATA_FIELD = 7, 14
INITIALISER_FIELD = 5
DIMS_FIELD, TYPE_FIELD, NAME_FIELD, RAW_FIELD = 1, 2, 8, 9
DTYPES = {1: "<f4", 6: "<i4", 7: "<i8", 11: "<f8"}
"""onnx's numbers of the element types that the runtime reads."""
LONGEST_VARINT = 10


class ModelError(ValueError):
    """A model file that is not ours, damaged, of another version, or does not match what the caller demands."""


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


def parse_model(content: bytes, name: str, wanted: Sequence[str] = ()) -> ModelFile:
    """Checks format, version and digest, and reads the initialisers `wanted`. `name` is for messages. Raises `ModelError`."""
    try:
        graph, properties = _graph_and_properties(memoryview(content))
    except (IndexError, ValueError) as error:
        raise ModelError(f"{name}: not an ONNX model, or cut short; export it again with export-model") from error
    if METADATA_KEY not in properties:
        raise ModelError(f"{name}: no metadata {METADATA_KEY!r}: an ONNX model, but not one that export-model wrote")
    metadata = _metadata(properties[METADATA_KEY], name)
    if metadata.get("format_version") != FORMAT_VERSION:
        found = metadata.get("format_version")
        raise ModelError(f"{name}: format version {found!r}, this runtime reads {FORMAT_VERSION}; export again or change versions")
    digest = hashlib.sha256(graph).hexdigest()
    if metadata.get("graph_sha256") != digest:
        raise ModelError(f"{name}: damaged: its graph has sha256 {digest[:16]}..., its metadata say otherwise; get it again")
    if metadata.get("metadata_sha256") != metadata_digest(metadata):
        raise ModelError(f"{name}: damaged: its metadata do not have the sha256 that they state; get it again")
    return ModelFile(content, metadata, _tensors(graph, name, wanted))


def metadata_digest(metadata: dict[str, Any]) -> str:
    """sha256 of the metadata as JSON with sorted keys, but for `metadata_sha256`, which holds it."""
    others = {key: value for key, value in metadata.items() if key != "metadata_sha256"}
    return hashlib.sha256(json.dumps(others, sort_keys=True).encode()).hexdigest()


def _tensors(graph: memoryview, name: str, wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The wanted initialisers. Raises `ModelError` if one is missing or its size is not what its shape says."""
    found = {}
    try:
        for field, value in _fields(graph):
            if field == INITIALISER_FIELD and isinstance(value, memoryview):
                parts = list(_fields(value))
                label = b"".join(part for number, part in parts if number == NAME_FIELD and isinstance(part, memoryview)).decode("utf-8")
                if label in wanted:
                    found[label] = _array(parts)
    except (IndexError, KeyError, ValueError) as error:
        raise ModelError(f"{name}: an initialiser cannot be read; export it again with export-model") from error
    if missing := sorted(set(wanted) - set(found)):
        raise ModelError(f"{name}: it lacks the initialisers {missing}; export it again with export-model")
    return found


def _array(parts: list[tuple[int, int | memoryview]]) -> NDArray[Any]:
    """The array of a TensorProto's fields; its dims come one by one or packed."""
    dims: list[int] = []
    dtype, raw = "", memoryview(b"")
    for number, part in parts:
        if number == DIMS_FIELD:
            dims += [part] if isinstance(part, int) else _packed(part)
        elif number == TYPE_FIELD and isinstance(part, int):
            dtype = DTYPES[part]
        elif number == RAW_FIELD and isinstance(part, memoryview):
            raw = part
    return np.frombuffer(raw, dtype=dtype).reshape(dims)


def _packed(part: memoryview) -> list[int]:
    values, position = [], 0
    while position < len(part):
        value, position = _varint(part, position)
        values.append(value)
    return values


def _metadata(text: bytes, name: str) -> dict[str, Any]:
    try:
        metadata = json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{name}: its metadata are not JSON; export it again with export-model") from error
    if not isinstance(metadata, dict):
        raise ModelError(f"{name}: its metadata are not a JSON object; export it again with export-model")
    return metadata


def _graph_and_properties(message: memoryview) -> tuple[memoryview, dict[str, bytes]]:
    graph, properties = memoryview(b""), {}
    for field, value in _fields(message):
        if isinstance(value, int):
            continue
        if field == GRAPH_FIELD:
            graph = value
        elif field == METADATA_FIELD:
            entry = {number: bytes(part) for number, part in _fields(value) if isinstance(part, memoryview)}
            properties[entry.get(1, b"").decode("utf-8")] = entry.get(2, b"")
    return graph, properties


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Number and value of every field that is a varint or length-delimited; others are skipped. Raises ValueError or IndexError."""
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
        if wire_type == 2:
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

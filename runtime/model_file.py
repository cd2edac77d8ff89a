"""Reads what the runtime must know of a model file before it trusts it: metadata and the digest of the graph.

An ONNX file is a Protocol Buffers message, `ModelProto`. Two of its fields are read from the wire format directly, so that the
runtime needs no onnx package: 7, the graph, and 14, the metadata, a list of (key 1, value 2) texts.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

FORMAT_VERSION = 1
METADATA_KEY = "glideproof"
GRAPH_FIELD, METADATA_FIELD = 7, 14
LONGEST_VARINT = 10


class ModelError(ValueError):
    """A model file that is not ours, damaged, of another version, or does not match what the caller demands."""


@dataclass(frozen=True)
class ModelFile:
    """The bytes of a model with its metadata; exists only if the graph's digest is the one that the metadata states."""

    content: bytes
    metadata: dict[str, Any]

    @property
    def sha256(self) -> str:
        """Digest of the whole file, hexadecimal."""
        return hashlib.sha256(self.content).hexdigest()


def parse_model(content: bytes, name: str) -> ModelFile:
    """Checks format, version and digest. `name` is for messages. Raises `ModelError`."""
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
        raise ModelError(f"{name}: damaged: its graph has sha256 {digest[:16]}..., its metadata say {metadata.get('graph_sha256')!s:.16}...")
    return ModelFile(content, metadata)


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
        if field == GRAPH_FIELD:
            graph = value
        elif field == METADATA_FIELD:
            entry = dict(_fields(value))
            properties[bytes(entry.get(1, b"")).decode("utf-8")] = bytes(entry.get(2, b""))
    return graph, properties


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Number and bytes of every length-delimited field; the others are skipped. Raises ValueError or IndexError."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        field, wire_type = key >> 3, key & 7
        if wire_type == 0:
            _, position = _varint(message, position)
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

"""Reads a model file that nobody has vouched for: bytes, metadata, digests, constants.

Everything that onnxruntime would be given is checked first (`runtime.model.onnx_subset`).
"""

from __future__ import annotations

import hashlib
import json
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from runtime.model.format import FORMAT_VERSION, METADATA_KEY, ModelError, metadata_digest
from runtime.model.onnx_subset import checked_graph, file_parts
from runtime.model.protobuf import Reader, shown

PACKAGED_MODELS = (Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "models")
"""Where the paper's model lies: in a wheel inside the package, in a checkout at the top."""
LARGEST_FILE_BYTES = 2**27
"""Size of the largest file that is read, 100 times the paper's model. This and the limits of `onnx_subset`, `protobuf` and
`operators.graph` are such that any file is loaded or refused within two seconds of a slow core."""
LARGEST_METADATA_BYTES = 2**22
"""Size of the largest metadata that are parsed: a scene of some 25,000 cells has as much."""


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
    """The bytes of a model file. Raises `ModelError` if there is no such file, or if it is unreadable or too large to be a model."""
    try:
        status = path.stat()
        if stat.S_ISREG(status.st_mode) and status.st_size <= LARGEST_FILE_BYTES:
            return path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror}); give the path of a model that export-model wrote") from error
    except ValueError as error:  # a null character in the path
        raise ModelError(f"{str(path)!r}: cannot be read ({error}); give the path of a model that export-model wrote") from error
    found = f"of {status.st_size} bytes" if stat.S_ISREG(status.st_mode) else "no file but a folder, a device or a pipe"
    raise ModelError(f"{path}: is {found}; give the path of a model that export-model wrote, of up to {LARGEST_FILE_BYTES >> 20} MiB")


def packaged_model() -> Path:
    """The paper's model that comes with the package. Raises `ModelError` if it is missing."""
    for folder in PACKAGED_MODELS:
        if (folder / "paper.onnx").is_file():
            return folder / "paper.onnx"
    raise ModelError("paper.onnx: comes with the package but is missing; give the path of a model, or reinstall glideproof")


def parse_model(content: bytes, name: str, wanted: Sequence[str] = (), either: Sequence[Sequence[str]] = ()) -> ModelFile:
    """Checks format, version, digests and graph, and reads the initialisers `wanted`, with those of the first group of `either` that are
    all there. `name` is for messages. Raises `ModelError`.
    """
    try:
        reader = Reader()
        graph, properties, rest = file_parts(reader, memoryview(content))
        metadata = _checked_metadata(properties, graph)
        if rest:
            raise ModelError(f"found {rest[0]}, which export-model does not write; export it again")
        constants, _ = checked_graph(reader, graph)
    except ModelError as error:
        raise ModelError(f"{name}: {error}") from error
    except (IndexError, ValueError) as error:
        raise ModelError(f"{name}: not an ONNX model, or cut short; export it again with export-model") from error
    wanted = [*wanted, *next((group for group in either if set(group) <= set(constants)), either[0] if either else ())]
    if missing := sorted(set(wanted) - set(constants)):
        raise ModelError(f"{name}: it lacks the initialisers {missing}; export it again with export-model")
    return ModelFile(content, metadata, {label: constants[label] for label in wanted})


def _checked_metadata(properties: dict[str, bytes], graph: memoryview) -> dict[str, Any]:
    """The metadata, if they and the graph have the digests that they state."""
    if METADATA_KEY not in properties:
        raise ModelError(f"no metadata {METADATA_KEY!r}: an ONNX model, but not one that export-model wrote")
    metadata, own_digest = _parsed_metadata(properties[METADATA_KEY])
    if metadata.get("format_version") != FORMAT_VERSION:
        found = shown(repr(metadata.get("format_version")))
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

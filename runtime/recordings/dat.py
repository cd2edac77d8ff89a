"""Prophesee's DAT files: a header, one byte each for the type and the size of an event, then events of 8 bytes.

An event is its time (us, 32 bits, wraps after 71.6 min) and a word of x, y and polarity, from the lowest bit: 14, 14 and 1 bits, in files
of version 1 9, 8 and 1. Types 0 and 12, the general and the specialised event of a pixel, have the same. The format is specified at
docs.prophesee.ai (DAT File Format).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.recordings.header import header_shape, read_header, start_us
from runtime.recordings.packet import PACKET_EVENTS, Notes, RecordingError, packet_of
from runtime.recordings.time_words import Unwrapped

PIXEL_TYPES = (0, 12)
BITS = {"1": (9, 8), "2": (14, 14)}
"""Bits of x and y by the version in the header; a file whose header has no version is of version 2."""
EVENT_BYTES = 8
TYPE_AND_SIZE_BYTES = 2
CLOCK_US = 2**32


def sensor_shape(path: Path) -> tuple[int, int] | None:
    """(height, width) that the header tells."""
    return header_shape(read_header(path)[0])


def packets(path: Path, notes: Notes) -> Iterator[NDArray[Any]]:  # noqa: ARG001  every reader has the same signature
    """The file's events. Raises `RecordingError`: at once for a type that is not read, at the end where the file was cut."""
    header, size = read_header(path)
    with path.open("rb") as file:
        file.seek(size)
        type_and_size = file.read(TYPE_AND_SIZE_BYTES)
    if not header or len(type_and_size) < TYPE_AND_SIZE_BYTES:
        raise RecordingError(f"{path}: found no header of lines '% keyword value'; it is cut short, or not a DAT file")
    version = header.get("version", "2").removesuffix(".0")
    if version not in BITS:
        raise RecordingError(f"{path}: found version {version} in the header; versions 1 and 2 are read: convert it anew")
    kind, length = type_and_size
    if kind not in PIXEL_TYPES or length != EVENT_BYTES:
        found = f"found events of type {kind} and {length} bytes"
        raise RecordingError(f"{path}: {found}; types 0 and 12 of 8 bytes, the events of pixels, are read: export these")
    return _packets(path, size + TYPE_AND_SIZE_BYTES, start_us(header), *BITS[version])


def _packets(path: Path, size: int, start: int, x_bits: int, y_bits: int) -> Iterator[NDArray[Any]]:
    unwrapped = Unwrapped(CLOCK_US)
    with path.open("rb") as file:
        file.seek(size)
        while content := file.read(PACKET_EVENTS * EVENT_BYTES):
            left = len(content) % EVENT_BYTES
            words = np.frombuffer(content[: len(content) - left], dtype="<u4").reshape(-1, 2)
            if len(words):
                times, places = unwrapped(words[:, 0].astype(np.int64)) + start, words[:, 1]
                x, y = places & (1 << x_bits) - 1, places >> x_bits & (1 << y_bits) - 1
                yield packet_of(times, x, y, places >> x_bits + y_bits & 1)
            if left:
                raise RecordingError(
                    f"{path}: the file ends inside an event ({left} bytes of it); it was cut short, all events before it are kept"
                )

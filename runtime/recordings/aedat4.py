"""AEDAT4 files, as iniVation's DV writes them: a description, then packets of events, frames and others, each compressed by itself.

The file is a line, a flatbuffer `IOHE` (compression, place of the index at the file's end, description in XML), and packets: 4 bytes
each for stream and length, then a flatbuffer, which for events is an `EVTS`, a vector of (t, x, y, on). Of several streams of events the
first is read. Every offset in a file is checked before it is followed, and what a packet may unpack to is bounded.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from runtime.errors import one_line
from runtime.recordings.header import shape_of
from runtime.recordings.packet import Notes, RecordingError, packet_of

FIRST_LINE = b"#!AER-DAT4.0\r\n"
LONGEST_HEADER_BYTES = 2**24
LONGEST_PACKET_BYTES = 2**28
"""Bytes of the longest packet that is read, packed or unpacked: 16 million events."""
STORED = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("on", "u1"), ("unused", "V3")])
UNPACKED, LZ4, LZ4_HIGH, ZSTD, ZSTD_HIGH = range(5)
NO_INDEX = -1


@dataclass(frozen=True)
class Header:
    """What the file says of itself: compression, where its index and its packets begin, streams of events, (height, width) of the first."""

    compression: int
    index_at: int
    packets_at: int
    streams: tuple[int, ...]
    shape: tuple[int, int] | None


def sensor_shape(path: Path) -> tuple[int, int] | None:
    """(height, width) that the description tells."""
    return _header(path).shape


def packets(path: Path, notes: Notes) -> Iterator[NDArray[Any]]:
    """The file's events. Raises `RecordingError`: at once for another file or one without events, while reading where it is damaged."""
    header = _header(path)
    if not header.streams:
        raise RecordingError(f"{path}: it has no stream of events; take a recording of an event camera's events")
    notes.place = f"stream {header.streams[0]}" if len(header.streams) > 1 else ""
    return _packets(path, header)


def _header(path: Path) -> Header:
    with path.open("rb") as file:
        if file.read(len(FIRST_LINE)) != FIRST_LINE:
            raise RecordingError(f"{path}: does not begin as AEDAT 4.0 does; iniVation's DV converts older AEDAT files to it")
        try:
            (length,) = struct.unpack("<I", file.read(4))
            if length > LONGEST_HEADER_BYTES:
                raise ValueError(f"a header of {length} bytes")
            table = Table.root(file.read(length))
            compression, index_at = table.number(0, "<i", UNPACKED), table.number(1, "<q", NO_INDEX)
            streams = _streams(table.string(2))
        except (struct.error, ValueError, ElementTree.ParseError) as error:
            raise RecordingError(f"{path}: its header cannot be read ({one_line(error)}); it is cut short or damaged") from error
        return Header(compression, index_at, file.tell(), tuple(streams), next(iter(streams.values()), None))


def _streams(description: bytes) -> dict[int, tuple[int, int] | None]:
    """The streams of events in the XML, with their (height, width), in order of their numbers."""
    streams = {}
    for node in ElementTree.fromstring(description).iter("node"):
        values = {attribute.get("key"): attribute.text or "" for attribute in node.iter("attr")}
        own = {attribute.get("key"): attribute.text for attribute in node.findall("attr")}
        if own.get("typeIdentifier") == "EVTS" and (name := node.get("name", "")).isdecimal():
            streams[int(name)] = shape_of(values.get("sizeY", ""), values.get("sizeX", ""))
    return dict(sorted(streams.items()))


@dataclass(frozen=True)
class Table:
    """A flatbuffer's table at a place in its bytes. Reading past the end raises struct.error or ValueError."""

    content: bytes
    place: int

    @classmethod
    def root(cls, content: bytes) -> Table:
        """The root table of a flatbuffer."""
        return cls(content, struct.unpack_from("<I", content)[0])

    def _field(self, number: int) -> int | None:
        """Where a field is, None if it is left out."""
        directory = self.place - struct.unpack_from("<i", self.content, self.place)[0]
        if directory < 0:
            raise ValueError("a table lies outside")
        size = struct.unpack_from("<H", self.content, directory)[0]
        entry = 4 + 2 * number
        offset = struct.unpack_from("<H", self.content, directory + entry)[0] if entry + 2 <= size else 0
        return self.place + offset if offset else None

    def number(self, number: int, kind: str, default: int) -> int:
        """A field that is a number."""
        place = self._field(number)
        return default if place is None else struct.unpack_from(kind, self.content, place)[0]

    def vector(self, number: int, item_bytes: int) -> memoryview:
        """The items of a field that is a vector of structs or bytes."""
        place = self._field(number)
        if place is None:
            return memoryview(b"")
        place += struct.unpack_from("<I", self.content, place)[0]
        size = struct.unpack_from("<I", self.content, place)[0] * item_bytes
        if place + 4 + size > len(self.content):
            raise ValueError("a vector ends outside")
        return memoryview(self.content)[place + 4 : place + 4 + size]

    def string(self, number: int) -> bytes:
        """A field that is text."""
        return bytes(self.vector(number, 1))


def _packets(path: Path, header: Header) -> Iterator[NDArray[Any]]:
    with path.open("rb") as file:
        end = os.fstat(file.fileno()).st_size
        stop = end if header.index_at == NO_INDEX else header.index_at
        file.seek(header.packets_at)
        try:
            while file.tell() < stop:
                stream, content = _packet(file)
                if stream == header.streams[0]:
                    yield _events(_unpacked(content, header.compression))
            if stop < end:
                _unpacked(file.read(LONGEST_PACKET_BYTES), header.compression)
        except (struct.error, ValueError, EOFError, RuntimeError, zstandard.ZstdError) as error:
            raise RecordingError(f"{path}: damaged here, or cut short: {one_line(error)}; all events before it are kept") from error


def _packet(file: IO[bytes]) -> tuple[int, bytes]:
    stream, length = struct.unpack("<iI", file.read(8))
    if length > LONGEST_PACKET_BYTES:
        raise ValueError(f"a packet of {length} bytes")
    content = file.read(length)
    if len(content) < length:
        raise EOFError("the file ends inside a packet")
    return stream, content


def _unpacked(content: bytes, compression: int) -> bytes:
    """A packet's bytes. Raises ValueError or what the library raises if they are damaged or too many."""
    if compression == UNPACKED:
        return content
    if compression in (LZ4, LZ4_HIGH):
        lz4_stream = lz4.frame.LZ4FrameDecompressor()
        unpacked, whole = lz4_stream.decompress(content, LONGEST_PACKET_BYTES), lz4_stream.eof
    elif compression in (ZSTD, ZSTD_HIGH):
        zstd_stream = zstandard.ZstdDecompressor().stream_reader(content)
        unpacked, whole = zstd_stream.read(LONGEST_PACKET_BYTES), not zstd_stream.read(1)
    else:
        raise ValueError(f"compression {compression} is not known")
    if not whole:
        raise ValueError(f"a packet that is cut, or of more than {LONGEST_PACKET_BYTES} bytes")
    return unpacked


def _events(content: bytes) -> NDArray[Any]:
    """The events of a flatbuffer with its size before it."""
    if content[8:12] != b"EVTS":
        raise ValueError(f"a packet of events begins with {content[8:12]!r}")
    events = np.frombuffer(Table.root(content[4:]).vector(0, STORED.itemsize), dtype=STORED)
    return packet_of(events["t"], events["x"], events["y"], events["on"] != 0)

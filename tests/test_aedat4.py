"""AEDAT4 files, built as the format says: compressed in every way, with clocks that break, damaged, and forged."""

from __future__ import annotations

import contextlib
import struct
import subprocess
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.frames import FrameStream
from runtime.recordings import aedat4
from runtime.recordings.packet import EVENT, Notes, RecordingError

SHAPE = (260, 346)
PACK = {0: bytes, 1: lz4.frame.compress, 2: lz4.frame.compress, 3: zstandard.compress, 4: zstandard.compress}


def stream_node(number: int, kind: str, height: int = SHAPE[0], width: int = SHAPE[1]) -> str:
    size = f'<attr key="sizeX" type="int">{width}</attr><attr key="sizeY" type="int">{height}</attr>'
    info = f'<node name="info" path="/{number}/info/">{size}</node>'
    return f'<node name="{number}" path="/{number}/"><attr key="typeIdentifier" type="string">{kind}</attr>{info}</node>'


def flatbuffer(identifier: bytes, fields: list[bytes | None], tails: dict[int, bytes]) -> bytes:
    """A table of inline fields; those of `tails` are offsets to what is laid behind the table."""
    offsets, table = [], b""
    for number, field in enumerate(fields):
        offsets.append(0 if field is None and number not in tails else 4 + len(table))
        table += b"" if field is None and number not in tails else field or bytes(4)
    directory = struct.pack(f"<{2 + len(fields)}H", 4 + 2 * len(fields), 4 + len(table), *offsets)
    directory += bytes(-(8 + len(directory)) % 8)
    place = 8 + len(directory)
    content = struct.pack("<I", place) + identifier + directory + struct.pack("<i", len(directory)) + table
    for number, tail in tails.items():
        content += bytes(-(len(content) + 4) % 8)
        at = place + offsets[number]
        content = content[:at] + struct.pack("<I", len(content) - at) + content[at + 4 :] + tail
    return content


def events_packet(events: NDArray) -> bytes:
    stored = np.zeros(len(events), dtype=aedat4.STORED)
    for name, own in (("t", "t"), ("x", "x"), ("y", "y"), ("on", "p")):
        stored[name] = events[own]
    content = flatbuffer(b"EVTS", [None], {0: struct.pack("<I", len(events)) + stored.tobytes()})
    return struct.pack("<I", len(content)) + content


def header(compression: int, streams: str, index_at: int | None = None) -> bytes:
    description = f'<dv version="2.0"><node name="outInfo" path="/outInfo/">{streams}</node></dv>'.encode()
    place = None if index_at is None else struct.pack("<q", index_at)
    content = flatbuffer(b"IOHE", [struct.pack("<i", compression), place, None], {2: struct.pack("<I", len(description)) + description})
    return b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(content)) + content


def packet(stream: int, content: bytes) -> bytes:
    return struct.pack("<iI", stream, len(content)) + content


def saved(path: Path, parts: list[NDArray], compression: int = 1, streams: str = stream_node(0, "EVTS"), number: int = 0) -> Path:
    packets = [packet(number, PACK[compression](events_packet(part))) for part in parts]
    path.write_bytes(header(compression, streams) + b"".join(packets))
    return path


def approach(start_us: int = 0, count: int = 4000) -> NDArray:
    drawn = np.random.default_rng(1)
    events = np.empty(count, dtype=EVENT)
    events["t"] = np.sort(drawn.integers(0, 400_000, count)) + start_us
    events["t"][0] = start_us
    for name, past in (("x", 346), ("y", 260), ("p", 2)):
        events[name] = drawn.integers(0, past, count)
    return events


def read(path: Path) -> NDArray:
    return np.concatenate([np.empty(0, dtype=EVENT), *aedat4.packets(path, Notes())])


@pytest.mark.parametrize("compression", PACK)
def test_events_are_read_packet_by_packet(tmp_path, compression):
    events = approach()
    path = saved(tmp_path / "a.aedat4", np.split(events, [1, 1, 700, 3000]), compression)
    assert [len(part) for part in aedat4.packets(path, Notes())] == [1, 0, 699, 2300, 1000]
    np.testing.assert_array_equal(read(path), events)
    assert aedat4.sensor_shape(path) == SHAPE


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_what_another_program_writes_is_read_as_it_reads_it(tmp_path, compression):
    faery = pytest.importorskip("faery", reason="the extra 'recordings' is not installed")
    events = approach(count=30_000)
    written = np.empty(len(events), dtype=faery.EVENTS_DTYPE)
    written["t"], written["x"], written["y"], written["on"] = (events[name] for name in "txyp")
    path = tmp_path / "a.aedat4"
    stream = faery.events_stream_from_array(written, dimensions=SHAPE[::-1])
    stream.to_file(path, zero_t0=False, compression=(compression, 1))
    np.testing.assert_array_equal(read(path), events)
    assert aedat4.sensor_shape(path) == SHAPE


def test_no_process_is_started_to_read(tmp_path, monkeypatch):
    """One that searched the folder one stands in for modules would run a `types.py` there."""
    monkeypatch.setattr(subprocess, "Popen", None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "types.py").write_text("raise SystemExit('this is not to be run')")
    np.testing.assert_array_equal(read(saved(tmp_path / "a.aedat4", [approach()])), approach())


def test_a_clock_that_goes_back_and_one_wrong_time_cost_no_window(tmp_path):
    """Readers that hold times back where they fall see none after either."""
    first, second = np.split(approach(5_000_000), 40), np.split(approach(), 40)
    first[20]["t"][50] = 2**40
    stream = FrameStream(SHAPE, 40_000)
    found = [start for start, _ in stream.frames(aedat4.packets(saved(tmp_path / "a.aedat4", [*first, *second]), Notes()))]
    assert found == [*range(5_000_000, 5_400_000, 40_000), *range(0, 400_000, 40_000)]
    assert (stream.runs, stream.misdated_events) == (2, 1)


def test_streams_of_other_data_are_passed_over(tmp_path):
    events = approach()
    streams = stream_node(7, "FRME") + stream_node(9, "EVTS", 99, 99) + stream_node(2, "EVTS") + stream_node(1, "IMUS")
    path = saved(tmp_path / "a.aedat4", [events], streams=streams, number=2)
    path.write_bytes(
        path.read_bytes() + packet(7, b"no events") + packet(9, b"nor these") + packet(2, lz4.frame.compress(events_packet(events)))
    )
    notes = Notes()
    np.testing.assert_array_equal(np.concatenate(list(aedat4.packets(path, notes))), np.concatenate([events, events]))
    assert notes.layout == "stream 2, t in us"
    assert aedat4.sensor_shape(path) == SHAPE


def test_without_a_stream_of_events_a_file_is_refused(tmp_path):
    path = saved(tmp_path / "a.aedat4", [], streams=stream_node(0, "FRME"))
    with pytest.raises(RecordingError, match="it has no stream of events"):
        aedat4.packets(path, Notes())


def test_an_index_at_the_end_is_no_packet(tmp_path):
    events = approach()
    packets = packet(0, lz4.frame.compress(events_packet(events)))
    start = len(header(1, stream_node(0, "EVTS"), 0))
    content = header(1, stream_node(0, "EVTS"), start + len(packets)) + packets
    (tmp_path / "a.aedat4").write_bytes(content + lz4.frame.compress(b"an index"))
    np.testing.assert_array_equal(read(tmp_path / "a.aedat4"), events)
    (tmp_path / "a.aedat4").write_bytes(content + lz4.frame.compress(b"an index")[:-3])
    with pytest.raises(RecordingError, match=r"damaged here, or cut short: .*all events before it are kept"):
        read(tmp_path / "a.aedat4")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"#!AER-DAT4.0\r\n", "its header cannot be read"),
        (b"#!AER-DAT4.0\r\n\xff\xff\xff\xff", "a header of 4294967295 bytes"),
        (header(1, "<node"), "its header cannot be read"),
        (header(9, stream_node(0, "EVTS")) + packet(0, b"x"), "compression 9 is not known"),
        (header(0, stream_node(0, "EVTS")) + packet(0, b"x"), "a packet of events begins with b''"),
        (header(0, stream_node(0, "EVTS")) + struct.pack("<iI", 0, 2**31), "a packet of 2147483648 bytes"),
        (header(0, stream_node(0, "EVTS")) + packet(0, events_packet(np.zeros(9, dtype=EVENT)))[:-1], "the file ends inside a packet"),
        (header(0, stream_node(0, "EVTS")) + packet(0, events_packet(np.zeros(9, dtype=EVENT))[:-1]), "a vector ends outside"),
        (header(1, stream_node(0, "EVTS")) + packet(0, lz4.frame.compress(bytes(2**20))[:99]), "a packet that is cut"),
        (header(1, stream_node(0, "EVTS")) + packet(0, b"no lz4"), "damaged here, or cut short"),
        (header(3, stream_node(0, "EVTS")) + packet(0, b"no zstd"), "damaged here, or cut short"),
    ],
)
def test_a_damaged_file_is_an_error_of_one_line(tmp_path, content, message):
    (tmp_path / "a.aedat4").write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        read(tmp_path / "a.aedat4")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("compression", [1, 3])
def test_what_a_packet_unpacks_to_is_bounded(tmp_path, monkeypatch, compression):
    monkeypatch.setattr(aedat4, "LONGEST_PACKET_BYTES", 10_000)
    path = saved(tmp_path / "a.aedat4", [np.zeros(1000, dtype=EVENT)], compression)
    with pytest.raises(RecordingError, match="of more than 10000 bytes"):
        read(path)


@given(place=st.integers(0, 10**6), bit=st.integers(0, 7), compression=st.sampled_from([0, 1, 3]))
def test_a_bit_changed_anywhere_is_read_or_refused(tmp_path_factory, place, bit, compression):
    path = tmp_path_factory.mktemp("changed") / "a.aedat4"
    content = bytearray(saved(path, [approach(count=40)], compression).read_bytes())
    content[place % len(content)] ^= 1 << bit
    path.write_bytes(bytes(content))
    # What is not a RecordingError fails the test.
    with contextlib.suppress(RecordingError):
        aedat4.sensor_shape(path)
        read(path)

"""Recordings: what is read is what was written; what cannot be read is an error of one line."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.frames import FrameStream
from runtime.recordings.recording import EVENT, PACKET_EVENTS, READERS, RecordingError, read_events, sensor_shape

SHAPE = (10, 20)
RECORDINGS = Path(os.environ.get("GLIDEPROOF_RECORDINGS", Path(__file__).resolve().parents[2] / "shared" / "recordings"))


def random_events(count: int) -> NDArray:
    generator = np.random.default_rng(1)
    events = np.empty(count, dtype=EVENT)
    events["t"] = np.sort(generator.integers(0, 100_000, count))
    events["x"], events["y"], events["p"] = (
        generator.integers(0, 20, count),
        generator.integers(0, 10, count),
        generator.integers(0, 2, count),
    )
    return events


def read(path: Path, shape: tuple[int, int] | None = None) -> NDArray:
    return np.concatenate([np.empty(0, dtype=EVENT), *read_events(path, shape)])


def written_by_faery(path: Path, events: NDArray, version: str | None = None) -> Path:
    faery = pytest.importorskip("faery", reason="the extra 'recordings' is not installed")
    packet = np.empty(len(events), dtype=faery.EVENTS_DTYPE)
    packet["t"], packet["x"], packet["y"], packet["on"] = events["t"], events["x"], events["y"], events["p"]
    faery.events_stream_from_array(packet, dimensions=SHAPE[::-1]).to_file(path, version=version, zero_t0=False)
    return path


@pytest.mark.parametrize(
    ("name", "version"), [("a.raw", "evt2"), ("b.raw", "evt3"), ("c.dat", "dat2"), ("d.es", None), ("e.aedat4", None), ("f.csv", None)]
)
def test_what_faery_writes_is_read(tmp_path, name, version):
    events = random_events(500)
    path = written_by_faery(tmp_path / name, events, version)
    assert sensor_shape(path) == SHAPE
    for shape in (SHAPE, None):
        back = read(path, shape)
        # EVT3 groups the events of one time by rows: the order within a time is the format's own.
        assert back.dtype == EVENT
        assert np.all(np.diff(back["t"]) >= 0)
        np.testing.assert_array_equal(np.sort(back, order=EVENT.names), np.sort(events, order=EVENT.names))


@pytest.mark.parametrize("version", ["evt2", "evt3"])
@pytest.mark.parametrize(
    ("header", "shape"),
    [
        ("% evt {v}\n% geometry 20x10\n", SHAPE),
        ("% evt {v}\r\n% format EVT{n};height=10;width=20\r\n% end\r\n", SHAPE),
        ("% format EVT{n};width=20;height=10\n% end\n", SHAPE),
        ("% evt {v}\n% Width 20\n% Height 10\n% end\n", SHAPE),
        ("% evt {v}\n% end\n", None),
    ],
)
def test_the_geometry_is_taken_from_the_header_or_from_the_caller(tmp_path, version, header, shape):
    events = random_events(200)
    data = written_by_faery(tmp_path / "written.raw", events, version).read_bytes()
    payload = data[data.index(b"% geometry 20x10\n") + len(b"% geometry 20x10\n") :]
    path = tmp_path / "header.raw"
    path.write_bytes(header.format(v=f"{version[3]}.0", n=version[3]).encode() + payload)
    assert sensor_shape(path) == shape
    assert len(read(path, SHAPE)) == len(events)
    if shape is None:
        with pytest.raises(RecordingError, match="the header tells no sensor size"):
            read_events(path)


@pytest.mark.parametrize(("name", "version"), [("a.raw", "evt3"), ("b.dat", "dat2"), ("c.es", None), ("d.aedat4", None), ("e.csv", None)])
def test_another_sensor_size_is_refused_with_both_sizes(tmp_path, name, version):
    path = written_by_faery(tmp_path / name, random_events(5), version)
    with pytest.raises(RecordingError, match=r"sensor of 20x10 px, expected 640x480"):
        read_events(path, (480, 640))


def test_npz_is_read_in_packets_and_keeps_unsorted_times(tmp_path):
    events = random_events(PACKET_EVENTS + 10)
    events["t"][[0, -1]] = events["t"][[-1, 0]]
    np.savez(
        tmp_path / "a.npz", t=events["t"].astype(np.uint64), x=events["x"].astype(np.uint16), y=events["y"], p=events["p"].astype(bool)
    )
    packets = list(read_events(tmp_path / "a.npz", SHAPE))
    assert [len(packet) for packet in packets] == [PACKET_EVENTS, 10]
    np.testing.assert_array_equal(np.concatenate(packets), events)


@pytest.mark.parametrize(
    "text", ["100,3,4,1\n50,5,6,-1\n", "t,x,y,p\n100,3,4,1\n\n50,5,6,-1", "x, y, polarity, t\r\n3, 4, 1, 100\r\n5, 6, -1, 50\r\n\r\n"]
)
def test_csv_with_and_without_a_header_keeps_every_event_and_its_time(tmp_path, text):
    (tmp_path / "a.csv").write_text(text, newline="")
    assert read(tmp_path / "a.csv").tolist() == [(100, 3, 4, 1), (50, 5, 6, -1)]


def test_csv_is_read_in_packets(tmp_path):
    events = random_events(PACKET_EVENTS + 3)
    np.savetxt(tmp_path / "a.csv", events, fmt="%d", delimiter=",")
    packets = list(read_events(tmp_path / "a.csv"))
    assert [len(packet) for packet in packets] == [PACKET_EVENTS, 3]
    np.testing.assert_array_equal(np.concatenate(packets), events)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.raw", b"", "the file is empty"),
        ("a.npz", b"", "the file is empty"),
        ("a.h5", b"", "the file is empty"),
        ("a.raw", b"MZ of another kind", "found no format in the header; convert it to EVT2 or EVT3"),
        ("a.raw", b"\0" * 4096, "found no format in the header"),
        ("a.dat", b"\0" * 4096, "a.dat: "),
        ("a.es", b"\0" * 4096, "a.es: "),
        ("a.aedat4", b"\0" * 4096, "a.aedat4: "),
        ("a.npz", b"\0" * 4096, "cannot be read"),
        ("a.csv", b"\0" * 4096, "no column t, x, y, p"),
        ("a.h5", b"\0" * 4096, "cannot be read"),
        ("a.hdf5", b"not an hdf5 file", "cannot be read"),
        ("a.raw", b"% evt 4.0\n% geometry 20x10\n% end\n", "found format 4.0"),
        ("a.raw", b"% format EVT4;height=10;width=20\n", "found format EVT4"),
        ("a.raw", b"% evt 3.0\n% geometry 20x", "the file ends in its header"),
        ("a.dat", b"% Version 2\n% Width 20\n% Height 10\n\x0e\x08", "found events of type 14 and 8 bytes; types 0 and 12 of 8 bytes"),
        ("a.dat", b"% Version 3\n% Width 20\n% Height 10\n\x0c\x08", "found version 3"),
        ("a.dat", b"% Width 20\n% Height 10\n", "it is cut short, or not a DAT file"),
        ("a.dat", b"not a dat file at all", "a.dat: "),
        ("a.es", b"not an es file at all", "a.es: "),
        ("a.aedat4", b"not an aedat file at all", "a.aedat4: "),
        ("a.npz", b"PK nothing", "cannot be read"),
        ("a.csv", b"", "the file is empty"),
        ("a.csv", b"t,x,y\n1,2,3\n", "no column p"),
        ("a.csv", b"t,x,y,p\n1,2,3,1\n1.5,2,3,0\n", "line 3: found 1.5,2,3,0; give whole numbers"),
        ("a.csv", b"1,2,3,1\n1,2\n", "line 2: found 1,2;"),
        ("a.log", b"1,2,3,1\n", "unknown kind '.log'; known are .raw, .dat, .aedat4, .es, .h5, .hdf5, .npz, .npy, .csv, .txt, .tsv$"),
        ("a.aedat", b"#!AER-DAT2.0\n", "unknown kind '.aedat'; .*; iniVation's DV converts older AEDAT files to AEDAT4"),
        ("a.bag", b"#ROSBAG V2.0\n", "unknown kind '.bag'; .*event_camera_py"),
        ("a.zip", b"PK", "unknown kind '.zip'; .*; unpack it"),
        ("a.aedat4", b"#!AER-DAT3.1\r\n", "does not begin as AEDAT 4.0 does; iniVation's DV converts"),
    ],
)
def test_an_unreadable_file_is_an_error_of_one_line_that_names_it(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        read(tmp_path / name, SHAPE)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize(
    "content", [b"", b"\0", b"\0" * 70_000, b"GIF89a" + bytes(range(256)) * 40, b"% format of something else\n" * 9], ids=len
)
def test_no_reader_takes_an_empty_a_zero_or_a_foreign_file(tmp_path, suffix, content):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        read(path, SHAPE)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    if not content:
        assert "the file is empty" in str(caught.value)


def saved(path: Path, events: NDArray) -> Path:
    """The events written in the kind that the path's suffix names."""
    columns = {name: events[name] for name in EVENT.names}
    if path.suffix == ".npz":
        np.savez_compressed(path, **columns)
    elif path.suffix in (".h5", ".hdf5"):
        h5py = pytest.importorskip("h5py", reason="the extra 'recordings' is not installed")
        with h5py.File(path, "w") as file:
            for name, column in columns.items():
                file.create_dataset(name, data=column)
    elif path.suffix == ".npy":
        np.save(path, events)
    elif path.suffix in (".csv", ".txt", ".tsv"):
        np.savetxt(path, events, fmt="%d", delimiter=",", header="t,x,y,p", comments="")
    else:
        written_by_faery(path, events, {".raw": "evt3", ".dat": "dat2"}.get(path.suffix))
    return path


@pytest.mark.parametrize("suffix", READERS)
def test_of_a_file_cut_anywhere_only_its_first_events_are_read(tmp_path, suffix):
    events = random_events(500)
    path = saved(tmp_path / f"a{suffix}", events)
    whole, content = read(path, SHAPE), path.read_bytes()
    np.testing.assert_array_equal(np.sort(whole, order=EVENT.names), np.sort(events, order=EVENT.names))
    for share in (0.01, 0.2, 0.5, 0.9, 0.999):
        path.write_bytes(content[: int(share * len(content))])
        try:
            back, message = read_until_a_fault(path)
        except RecordingError as error:
            back, message = np.empty(0, dtype=EVENT), str(error)
        np.testing.assert_array_equal(back, whole[: len(back)])
        # An AEDAT4 file ends with an index, which holds no event.
        assert len(back) < len(whole) or (suffix, share) == (".aedat4", 0.999)
        if len(back) == 0:
            assert message.startswith(f"{path}: ")


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".h5", ".hdf5"])
def test_repeated_and_unsorted_times_and_events_outside_are_counted_by_the_stream(tmp_path, suffix):
    events = random_events(400)
    events["t"][100:120] = events["t"][100]
    events["t"][[200, 300]] = events["t"][[300, 200]]
    events["x"][50], events["y"][60] = 20, -1
    stream = FrameStream(SHAPE, 10_000)
    frames = list(stream.frames(read_events(saved(tmp_path / f"a{suffix}", events), SHAPE)))
    latest = np.maximum.accumulate(np.delete(events["t"], [50, 60]))
    assert stream.unsorted_events == np.count_nonzero(np.delete(events["t"], [50, 60])[1:] < latest[:-1]) > 0
    assert stream.outside_events == 2
    assert len(frames) == (events["t"].max() - events["t"][0]) // 10_000 + 1


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"t": [1], "x": [1], "y": [1]}, "no array p"),
        ({"t": ["1"], "x": [1], "y": [1], "p": [1]}, "t is <U1 of shape"),
        ({"t": [object()], "x": [1], "y": [1], "p": [1]}, "t is object of shape"),
        ({"t": [1.0], "x": [0.5], "y": [1], "p": [1]}, "x has 0.5; give whole numbers"),
        ({"t": [np.nan], "x": [1], "y": [1], "p": [1]}, "t is not a number"),
        ({"t_us": [2**62], "x": [1], "y": [1], "p": [1]}, r"beyond plus-minus 2\*\*61"),
        ({"t": [1], "x": [[1]], "y": [1], "p": [1]}, r"x is int64 of shape \(1, 1\)"),
        ({"t": [1, 2], "x": [1], "y": [1], "p": [1]}, "arrays of different lengths"),
        ({"t": [1], "x": [2**32 + 1], "y": [1], "p": [1]}, "x runs from 4294967297 to 4294967297, beyond int32"),
        ({"t": [1], "x": [1], "y": [1], "p": [3]}, "polarity 3 is not -1, 0 or 1"),
    ],
)
def test_unusable_npz_columns_are_refused(tmp_path, columns, message):
    np.savez(tmp_path / "a.npz", **columns)
    with pytest.raises(RecordingError, match=message):
        list(read_events(tmp_path / "a.npz"))


def test_a_missing_file_and_what_is_no_file_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.raw")
    (tmp_path / "folder.raw").mkdir()
    for name, message in (("a.raw", "no such file"), ("pipe.raw", "is no file but"), ("folder.raw", "is no file but a folder")):
        with pytest.raises(RecordingError, match=rf"{name}: {message}.*; give the path of a recording"):
            read_events(tmp_path / name)


@pytest.mark.parametrize(
    ("suffix", "reader", "package"),
    [
        (".es", "es", "faery"),
        (".h5", "hdf5", "h5py"),
        (".h5", "hdf5", "hdf5plugin"),
        (".aedat4", "aedat4", "lz4"),
        (".aedat4", "aedat4", "zstandard"),
    ],
)
def test_without_a_readers_package_one_line_says_what_to_install(tmp_path, monkeypatch, suffix, reader, package):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"runtime.recordings.{reader}", raising=False)
    (tmp_path / f"a{suffix}").write_bytes(b"anything")
    with pytest.raises(RecordingError, match=rf"{suffix} needs {package}, .*pip install glideproof\[recordings\]"):
        read_events(tmp_path / f"a{suffix}")


@pytest.mark.parametrize(("name", "version"), [("a.raw", "evt2"), ("b.raw", "evt3"), ("c.dat", "dat2")])
def test_events_beyond_the_sensor_of_the_header_are_counted_and_none_is_lost(tmp_path, name, version):
    events = random_events(5000)
    path = written_by_faery(tmp_path / name, events, version)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"20x10", b"19x10").replace(b"width=20", b"width=19").replace(b"Width 20", b"Width 19"))
    assert sensor_shape(path) == (10, 19)
    back = read(path)
    np.testing.assert_array_equal(np.sort(back, order=EVENT.names), np.sort(events, order=EVENT.names))
    stream = FrameStream((10, 19), 1000)
    list(stream.frames(read_events(path, (10, 19))))
    assert stream.outside_events == np.count_nonzero(events["x"] == 19) > 0


def read_until_a_fault(path: Path) -> tuple[NDArray, str]:
    """What is read before the error, and its message; an empty one if there is none."""
    packets, message = [np.empty(0, dtype=EVENT)], ""
    try:
        for packet in read_events(path, SHAPE):
            packets.append(packet)
    except RecordingError as error:
        message = str(error)
    assert "\n" not in message
    return np.concatenate(packets), message


@pytest.mark.parametrize(
    ("name", "version", "bytes_an_event"), [("a.raw", "evt2", 4), ("b.raw", "evt3", 2), ("c.dat", "dat2", 8), ("d.es", None, 0)]
)
@pytest.mark.parametrize("cut", [1, 2, 3, 7, 50, 501])
def test_of_a_file_that_was_cut_every_whole_event_is_read_and_a_cut_event_is_told(tmp_path, name, version, bytes_an_event, cut):
    events = random_events(500)
    path = written_by_faery(tmp_path / name, events, version)
    content = path.read_bytes()
    path.write_bytes(content[:-cut])
    back, message = read_until_a_fault(path)
    assert len(events) > len(back) >= len(events) - 1 - cut / 2
    whole = read(written_by_faery(tmp_path / f"whole_{name}", events, version))
    np.testing.assert_array_equal(back, whole[: len(back)])
    assert ("ends inside an event" in message) == (bytes_an_event > 0 and cut % bytes_an_event > 0)
    if bytes_an_event == 8:
        assert len(back) == len(events) - -(-cut // 8)


@pytest.mark.parametrize(("name", "version"), [("a.raw", "evt2"), ("b.raw", "evt3"), ("c.dat", "dat2"), ("d.es", None), ("e.aedat4", None)])
def test_a_whole_file_is_not_called_cut(tmp_path, name, version):
    for count in (1, 2, 500):
        assert read_until_a_fault(written_by_faery(tmp_path / name, random_events(count), version))[1] == ""


def test_a_cut_aedat4_file_is_an_error(tmp_path):
    path = written_by_faery(tmp_path / "a.aedat4", random_events(500))
    path.write_bytes(path.read_bytes()[:-100])
    _, message = read_until_a_fault(path)
    assert message.startswith(f"{path}: ")


def test_csv_lines_before_a_fault_are_kept(tmp_path):
    lines = [f"{time},3,4,1" for time in range(PACKET_EVENTS + 100)]
    lines[PACKET_EVENTS + 37] = "12,nonsense,4,1"
    (tmp_path / "a.csv").write_text("\n".join(lines))
    back, message = read_until_a_fault(tmp_path / "a.csv")
    np.testing.assert_array_equal(back["t"], np.arange(PACKET_EVENTS + 37))
    assert f"line {PACKET_EVENTS + 38}: found 12,nonsense,4,1" in message


def test_npz_events_before_damage_are_kept(tmp_path):
    events = random_events(3 * PACKET_EVENTS)
    path = tmp_path / "a.npz"
    np.savez(path, t=events["t"], x=events["x"], y=events["y"], p=events["p"])
    content = bytearray(path.read_bytes())
    start = content.index(events["t"][2 * PACKET_EVENTS :][:100].tobytes())
    content[start : start + 8] = b"\xff" * 8
    path.write_bytes(content)
    back, message = read_until_a_fault(path)
    np.testing.assert_array_equal(back, events[: len(back)])
    assert len(back) >= PACKET_EVENTS
    assert "all events before them are kept" in message


@pytest.mark.parametrize("place", ["", "events", "table"])
@pytest.mark.parametrize("suffix", [".h5", ".hdf5"])
def test_hdf5_is_read_in_packets_with_its_size_and_unsorted_times(tmp_path, place, suffix):
    h5py = pytest.importorskip("h5py", reason="the extra 'recordings' is not installed")
    events = random_events(PACKET_EVENTS + 10)
    events["t"][[0, -1]] = events["t"][[-1, 0]]
    path = tmp_path / f"a{suffix}"
    with h5py.File(path, "w") as file:
        holder = file if place == "" else file.create_group("CD" if place == "table" else place)
        if place == "table":
            holder = holder.create_dataset("events", data=events)
        else:
            for name in "txyp":
                holder.create_dataset(name, data=events[name].astype(np.int64), chunks=True, compression="gzip")
        holder.attrs["width"], holder.attrs["height"] = 20, 10
    assert sensor_shape(path) == SHAPE
    packets = list(read_events(path, SHAPE))
    assert [len(packet) for packet in packets] == [PACKET_EVENTS, 10]
    np.testing.assert_array_equal(np.concatenate(packets), events)
    with pytest.raises(RecordingError, match="sensor of 20x10 px, expected 640x480"):
        read_events(path, (480, 640))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"t": [1], "x": [1], "y": [1]}, "no columns t, x, y, p at the top or in a group 'events'; found t, x, y"),
        ({}, "found nothing"),
        ({"t": [b"1"], "x": [1], "y": [1], "p": [1]}, r"t is \|S1 of shape"),
        ({"t": [1, 2], "x": [1], "y": [1], "p": [1]}, "arrays of different lengths"),
        ({"t": [1], "x": [2**40], "y": [1], "p": [1]}, "x runs from 1099511627776 to"),
    ],
)
def test_unusable_hdf5_columns_are_refused(tmp_path, columns, message):
    h5py = pytest.importorskip("h5py", reason="the extra 'recordings' is not installed")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=np.array(values))
    with pytest.raises(RecordingError, match=message):
        list(read_events(tmp_path / "a.h5"))


def test_the_real_recording_gives_its_events_and_frames():
    path = RECORDINGS / "ecpy_test1_640x480_evt3.raw"
    if not path.is_file():
        pytest.skip(f"{path} is missing; set GLIDEPROOF_RECORDINGS to the folder of the recordings")
    stream = FrameStream((480, 640), 40_000)
    packets = list(read_events(path, (480, 640)))
    lit = [frame.mean() for _, frame in stream.frames(packets)]
    assert sum(len(packet) for packet in packets) == 343_474
    assert len(lit) == 52  # 2.078 s of 40 ms
    assert 0.005 < np.median(lit) < 0.02
    assert (stream.late_events, stream.unsorted_events, stream.outside_events) == (0, 0, 0)


def test_an_aedat4_file_with_changed_bytes_is_read_or_refused(tmp_path):
    """Some such files end the process in which faery reads them."""
    path = written_by_faery(tmp_path / "a.aedat4", random_events(300))
    whole, drawn, faults = path.read_bytes(), np.random.default_rng(0), []
    for _ in range(6):
        content = np.frombuffer(whole, dtype=np.uint8).copy()
        content[drawn.integers(len(content), size=40)] = drawn.integers(256, size=40)
        path.write_bytes(content.tobytes())
        faults.append(read_until_a_fault(path)[1])
    assert all(fault == "" or fault.startswith(f"{path}: ") for fault in faults)
    assert any(faults)


@pytest.mark.parametrize("packed", [False, True])
def test_an_npz_file_with_changed_bytes_is_read_or_refused(tmp_path, packed):
    """Found by fuzzing: zlib's own error, where the start of an array is damaged."""
    events, drawn, faults = random_events(50), np.random.default_rng(0), set()
    path = tmp_path / "a.npz"
    (np.savez_compressed if packed else np.savez)(path, **{name: events[name] for name in EVENT.names})
    whole = path.read_bytes()
    for _ in range(300):
        content = bytearray(whole)
        content[int(drawn.integers(len(content)))] ^= 1 << int(drawn.integers(8))
        path.write_bytes(bytes(content))
        faults.add(read_until_a_fault(path)[1].replace(str(path), "")[:60])
    assert len(faults) > 2


def test_an_hdf5_file_with_changed_bytes_is_read_or_refused(tmp_path):
    """Found by fuzzing: RuntimeError for a broken group, and a name in a group that leads nowhere."""
    h5py = pytest.importorskip("h5py", reason="the extra 'recordings' is not installed")
    events, drawn, faults = random_events(50), np.random.default_rng(0), set()
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name in EVENT.names:
            file.create_dataset(name, data=events[name], chunks=True, compression="gzip")
    whole = path.read_bytes()
    for _ in range(300):
        content = bytearray(whole)
        for place in drawn.integers(len(content), size=20):
            content[int(place)] ^= 1 << int(drawn.integers(8))
        path.write_bytes(bytes(content))
        faults.add(read_until_a_fault(path)[1].replace(str(path), "")[:60])
    assert len(faults) > 2


def test_a_header_with_a_size_of_endless_digits_tells_no_size(tmp_path):
    (tmp_path / "a.raw").write_bytes(b"% evt 3.0\n% Width " + b"9" * 5000 + b"\n% Height 10\n% end\n")
    assert sensor_shape(tmp_path / "a.raw") is None

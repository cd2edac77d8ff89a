"""Text files of events: as vendors, spreadsheets and simulators write them; never misread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.recordings.recording import EVENT, PACKET_EVENTS, Notes, RecordingError, read_events, sensor_shape

SHAPE = (480, 640)


def approach(count: int = 500) -> NDArray:
    drawn = np.random.default_rng(1)
    events = np.empty(count, dtype=EVENT)
    events["t"] = np.sort(drawn.integers(0, 400_000, count))
    for name, past in (("x", 640), ("y", 480), ("p", 2)):
        events[name] = drawn.integers(0, past, count)
    return events


def lines(form: Callable[[int, int, int, int], str], events: NDArray, end: str = "\n") -> str:
    return "".join(form(*event) + end for event in events.tolist())


def read(path: Path) -> tuple[NDArray, str]:
    notes = Notes()
    packets = list(read_events(path, SHAPE, notes))
    return np.concatenate([np.empty(0, dtype=EVENT), *packets]), notes.layout


FORMS: dict[str, tuple[str, str, Callable[[int, int, int, int], str], str, tuple[int, int] | None]] = {
    "bare": ("a.csv", "", lambda t, x, y, p: f"{t},{x},{y},{p}", "columns t, x, y, p, t in us", None),
    "vendor": ("a.csv", "%geometry:640,480\n", lambda t, x, y, p: f"{x},{y},{p},{t}", "columns x, y, p, t, t in us", SHAPE),
    "vendor, bare": ("a.csv", "", lambda t, x, y, p: f"{x},{y},{p},{t}", "columns x, y, p, t, t in us", None),
    "vendor, named": ("a.csv", "%geometry:640,480\nx,y,polarity,timestamp_us\n", lambda t, x, y, p: f"{x},{y},{p},{t}", "t in us", SHAPE),
    "seconds": ("a.txt", "", lambda t, x, y, p: f"{t / 1e6:.9f} {x} {y} {p}", "columns t, x, y, p, t in s", None),
    "seconds since 1970": ("a.txt", "", lambda t, x, y, p: f"1468939802.{t:06d} {x} {y} {p}", "columns t, x, y, p, t in s", None),
    "seconds, size": ("a.txt", "640 480\n", lambda t, x, y, p: f"{t / 1e6:.6f} {x} {y} {p}", "columns t, x, y, p, t in s", SHAPE),
    "simulator": (
        "a.txt",
        "#!events.txt\n# Format: time (float s), x, y, polarity (0=off, 1=on)\n#\n",
        lambda t, x, y, p: f"{t / 1e6} {x} {y} {p}",
        "t in s",
        None,
    ),
    "tabs": ("a.tsv", "# t\tx\ty\tp\n", lambda t, x, y, p: f"{t}\t{x}\t{y}\t{p}", "t in us", None),
    "semicolons": ("a.csv", "timestamp;x;y;polarity\n", lambda t, x, y, p: f"{t};{x};{y};{2 * p - 1}", "t in us", None),
    "words": ("a.csv", "ts, xs, ys, ps\n", lambda t, x, y, p: f"{t}.0, {x}.0, {y}, {bool(p)}", "t in us", None),
    "nanoseconds": ("a.csv", "", lambda t, x, y, p: f"{1605537493718345000 + 1000 * t},{x},{y},{p}", "columns t, x, y, p, t in ns", None),
    "trailing": ("a.csv", "", lambda t, x, y, p: f"{t},{x},{y},{p},", "columns t, x, y, p, t in us", None),
    "more columns": ("a.csv", "id,x,y,p,t,camera\n", lambda t, x, y, p: f"7,{x},{y},{p},{t},left", "t in us", None),
    "DV": ("a.csv", "timestamp, x, y, polarity\n", lambda t, x, y, p: f"{t}, {x}, {y}, {p}", "t in us", None),
    "faery": ("a.csv", "t,x@640,y@480,on\n", lambda t, x, y, p: f"{t},{x},{y},{p}", "t in us", SHAPE),
    "upper case": ("A.CSV", "T,X,Y,P\n", lambda t, x, y, p: f"{t},{x},{y},{p}", "t in us", None),
}


@pytest.mark.parametrize("name", FORMS)
def test_events_are_read_as_they_are_written(tmp_path, name):
    events = approach()
    file, head, form, layout, shape = FORMS[name]
    (tmp_path / file).write_text(head + lines(form, events))
    back, found = read(tmp_path / file)
    starts = {"seconds since 1970": 1_468_939_802_000_000, "nanoseconds": 1_605_537_493_718_345}
    events["t"] += starts.get(name, 0)
    events["p"] = 2 * events["p"] - 1 if name == "semicolons" else events["p"]
    np.testing.assert_array_equal(back, events)
    assert found == layout
    assert sensor_shape(tmp_path / file) == shape


@pytest.mark.parametrize("end", ["\n", "\r\n", "\n\n"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("quote", ["", '"', "'"])
def test_byte_order_marks_quotes_and_line_ends_do_not_matter(tmp_path, end, mark, quote):
    events = approach()
    head = ",".join(f"{quote}{name}{quote}" for name in "txyp") + end
    text = head + lines(lambda *event: ",".join(f"{quote}{number}{quote}" for number in event), events, end)
    (tmp_path / "a.csv").write_bytes(mark + text.encode())
    np.testing.assert_array_equal(read(tmp_path / "a.csv")[0], events)


@pytest.mark.parametrize("name", ["bare", "vendor, bare", "seconds", "words"])
def test_more_lines_than_a_packet_are_read_as_the_first_ones_are(tmp_path, name):
    events = approach(PACKET_EVENTS + 100)
    file, head, form, layout, _ = FORMS[name]
    (tmp_path / file).write_text(head + "# a comment\n" + lines(form, events))
    back, found = read(tmp_path / file)
    np.testing.assert_array_equal(back, events)
    assert found == layout


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "1,2,3,1\n2,2,3,1\n3,2,3,7\n",
            r"line 1 on: no order of the columns t, x, y, p fits 1, 2, 3, 1 and what follows; name the columns",
        ),
        ("t,x,y,p\n1,2,3,1\n2,2,3,300\n", r"line 3: found 2,2,3,300; .*polarity 300 is not -1, 0 or 1; are the columns in another order\?"),
        ("t,x,y,p\n1,2,3,1\n2,2.5,3,1\n", r"line 3: found 2,2.5,3,1; give whole numbers.*x has 2.5"),
        ("t,x,y,p\n1,2,3,1\nnan,2,3,1\n", "line 3: found nan,2,3,1; give whole numbers"),
        ("t,x,y,p\n1,2,3,1\n2,99999999999,3,1\n", r"line 3: .*x runs from 2 to 99999999999, beyond int32"),
        ("1,2,3,4,5\n", "found 5 columns without names; give a first line that names t, x, y, p"),
        ("1,2,3\n", "found 3 columns without names"),
        ("0,5 1 2 1\n", "found 2 columns without names"),
        ("1000.25,1,2,0\n2000.75,1,2,0\n9000.25,1,2,0\n", "line 1 on: t has fractions, .*; name its unit, as in t_us"),
        ("t;x;y;p\n0,001;1;2;0\n", "line 2: found 0,001;1;2;0; give whole numbers"),
        ("# only\n% comments\n\n", "no line of numbers or names within 1000 lines"),
        ("time,x,y\n", "no column p in the first line"),
    ],
)
def test_what_is_not_clear_is_refused_with_its_line(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(RecordingError, match=message) as caught:
        list(read_events(tmp_path / "a.csv"))
    assert "\n" not in str(caught.value)


def test_a_polarity_that_is_none_later_in_the_file_ends_it_there(tmp_path):
    events = approach(PACKET_EVENTS + 100)
    text = lines(lambda t, x, y, p: f"{t},{x},{y},{p}", events) + "500000,3,4,2\n"
    (tmp_path / "a.csv").write_text(text)
    packets, message = until_a_fault(read_events(tmp_path / "a.csv"))
    np.testing.assert_array_equal(np.concatenate(packets), events)
    assert f"line {len(events) + 1}: found 500000,3,4,2; " in message
    assert "polarity 2 is not -1, 0 or 1" in message


def until_a_fault(reader: Iterator[NDArray]) -> tuple[list[NDArray], str]:
    packets = []
    try:
        for packet in reader:
            packets.append(packet)
    except RecordingError as error:
        return packets, str(error)
    return packets, ""


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be"])
def test_utf_16_is_named(tmp_path, encoding):
    text = "\ufeff" * (encoding == "utf-16-be") + "t,x,y,p\n1,2,3,1\n"
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    with pytest.raises(RecordingError, match="found text in UTF-16; save it as UTF-8"):
        read_events(tmp_path / "a.csv")

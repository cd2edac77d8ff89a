"""RAW files: against decoders that take one word after the other, however the words are divided; and what their time words tell."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.frames import FrameStream
from runtime.recordings import raw
from runtime.recordings.packet import EVENT, Notes, RecordingError
from runtime.recordings.raw import Evt2, Evt3, Evt21

Event = tuple[int, int, int, int]
HEADERS = {Evt2: "% evt 2.0\n", Evt21: "% evt 2.1\n% endianness little\n", Evt3: "% evt 3.0\n"}
GEOMETRY = "% geometry 640x480\n% end\n"
UNIT_US = {Evt2: 64, Evt21: 64, Evt3: 4096}
NEAR_US = 100_000
"""How far time words may go back, and what they may pass over at the clock's end."""


# --- words, as the formats are specified ---


def high_word(kind: type[Evt2], count: int) -> int:
    return {Evt2: 8 << 28 | count & 0xFFFFFFF, Evt21: 8 << 60 | (count & 0xFFFFFFF) << 32, Evt3: 8 << 12 | count & 0xFFF}[kind]


def evt2(low: int, x: int, y: int, p: int) -> int:
    return p << 28 | low << 22 | x << 11 | y


def evt21(low: int, x: int, y: int, p: int, mask: int) -> int:
    return p << 60 | low << 54 | x << 43 | y << 32 | mask


def low_word(low: int) -> int:
    return 6 << 12 | low


def row_word(y: int) -> int:
    return y


def pixel_word(x: int, p: int) -> int:
    return 2 << 12 | p << 11 | x


def base_word(x: int, p: int) -> int:
    return 3 << 12 | p << 11 | x


def mask_word(width: int, mask: int) -> int:
    return {12: 4, 8: 5}[width] << 12 | mask


def written(events: list[Event], kind: type[Evt2]) -> list[int]:
    """A file's words for events in order of time, a TIME_HIGH where it changes."""
    words, high, unit = [], None, UNIT_US[kind]
    for t, x, y, p in events:
        if t // unit != high:
            high = t // unit
            words.append(high_word(kind, high))
        words += words_of_event(t % unit, x, y, p, kind)
    return words


def words_of_event(low: int, x: int, y: int, p: int, kind: type[Evt2]) -> list[int]:
    if kind is Evt3:
        return [low_word(low), row_word(y), pixel_word(x, p)]
    return [evt21(low, x, y, p, 1) if kind is Evt21 else evt2(low, x, y, p)]


def saved(path: Path, words: list[int], kind: type[Evt2], header: str | None = None, order: str = "<") -> Path:
    content = np.array(words, dtype=kind.dtype).astype(kind.dtype.newbyteorder(order)).tobytes()
    path.write_bytes(((HEADERS[kind] if header is None else header) + GEOMETRY).encode() + content)
    return path


def read(path: Path) -> tuple[list[Event], Counter[str]]:
    notes = Notes()
    packets = [np.empty(0, dtype=EVENT), *raw.packets(path, notes)]
    return np.concatenate(packets).tolist(), +notes.counts


# --- decoders that take one word after the other ---


def kind_of(word: int, kind: type[Evt2]) -> int:
    return word >> 8 * kind.dtype.itemsize - 4


def naive_blocks(words: list[int], kind: type[Evt2]) -> list[tuple[int | None, list[int]]]:
    """The words after each TIME_HIGH, with what it counts; first those before any."""
    blocks: list[tuple[int | None, list[int]]] = [(None, [])]
    for word in words:
        if kind_of(word, kind) == 8:
            blocks.append((word >> 32 if kind is Evt21 else word, []))
        else:
            blocks[-1][1].append(word)
    bits = 12 if kind is Evt3 else 28
    return [(None if high is None else high % 2**bits, block) for high, block in blocks]


def naive_times(highs: list[int], kind: type[Evt2]) -> list[int]:
    """Times of TIME_HIGH words, whose clock wraps."""
    unit, times = UNIT_US[kind], []
    period = unit * 2 ** (12 if kind is Evt3 else 28)
    for number, high in enumerate(highs):
        step = 0 if number == 0 else (high - highs[number - 1]) * unit
        if step < 0 and step + period <= NEAR_US:
            step += period
        elif step > 0 and period - step <= NEAR_US:
            step -= period
        times.append(high * unit if number == 0 else times[-1] + step)
    return times


def naive_dates(start: int, lows: list[int], step: int | None, unit: int) -> tuple[list[tuple[int, bool]], int]:
    """Times of low bits in one block, and whether they are certain; and how many words its end shows to be lost."""
    goes_back = [low < before for before, low in itertools.pairwise(lows)]
    far_back = [low < before - unit // 2 for before, low in itertools.pairwise(lows)]
    no_later = step is not None and step <= unit * sum(goes_back)
    passed = far_back if no_later else goes_back
    explained = step in ([unit * sum(passed), unit * (sum(passed) + 1)] if no_later else [unit * (sum(passed) + 1)])
    counts = [0, *itertools.accumulate(int(mark) for mark in passed)][: len(lows)]
    dates = [(start + unit * count + low, explained or count == 0) for count, low in zip(counts, lows, strict=True)]
    lost = 0 if not any(goes_back) else sum(goes_back) if step is None else max(step // unit - 1, 0)
    return dates, lost


def naive_decoded(words: list[int], kind: type[Evt2]) -> tuple[list[Event], Counter[str]]:
    blocks, unit, counts = naive_blocks(words, kind), UNIT_US[kind], Counter[str]()
    times = naive_times([high for high, _ in blocks if high is not None], kind)
    steps: list[int | None] = [*(after - before for before, after in itertools.pairwise(times)), *([None] if times else [])]
    counts["time words that step back"] = sum(step is not None and -NEAR_US <= step < 0 for step in steps)
    state: dict[str, Any] = {"time": (0, False), "y": None, "x": None, "p": 0}
    events: list[Event] = []
    repeats = 0
    for number, (high, block) in enumerate(blocks):
        step = None if high is None else steps[number - 1]
        repeats += step == 0
        start = 0 if high is None else times[number - 1]
        changed = number == 1 or (number > 1 and times[number - 2] != start)
        marks = [0] if kind is Evt3 and high is not None and changed else []
        lows = [low for word in block if (low := naive_low(word, kind)) is not None]
        dates, lost = naive_dates(start, marks + lows, step, unit)
        if repeats >= 64 and 2 * repeats > number and step is not None and step > unit:
            dates, lost = [(t, False) for t, _ in dates], step // unit - 1
        counts["time words lost"] += 0 if high is None else lost
        if high is None:
            dates = [(t, False) for t, _ in dates]
        if marks:
            state["time"] = dates.pop(0)
        for (time, certain), x, y, p in naive_events(block, dates, state, kind):
            if not certain:
                counts["events without a time"] += 1
            elif x is None or y is None:
                counts["events without a place"] += 1
            else:
                events.append((time, x, y, p))
    return events, +counts


def naive_low(word: int, kind: type[Evt2]) -> int | None:
    if kind is Evt3:
        return word & 0xFFF if kind_of(word, kind) == 6 else None
    return word >> (54 if kind is Evt21 else 22) & 0x3F if kind_of(word, kind) <= 1 else None


def naive_events(block: list[int], dates: list[tuple[int, bool]], state: dict[str, Any], kind: type[Evt2]) -> Iterator[tuple]:
    """((time, certain), x or None, y or None, p) of a block's events."""
    left = iter(dates)
    for word in block:
        what, low11, bit11 = kind_of(word, kind), word & 0x7FF, word >> 11 & 1
        if kind is Evt2 and what <= 1:
            yield next(left), word >> 11 & 0x7FF, low11, what
        elif kind is Evt21 and what <= 1:
            date = next(left)
            yield from ((date, (word >> 43 & 0x7FF) + bit, word >> 32 & 0x7FF, what) for bit in range(32) if word >> bit & 1)
        elif kind is Evt3 and what == 6:
            state["time"] = next(left)
        elif kind is Evt3 and what == 0:
            state["y"] = low11
        elif kind is Evt3 and what == 2:
            yield state["time"], low11, state["y"], bit11
        elif kind is Evt3 and what == 3:
            state["x"], state["p"] = low11, bit11
        elif kind is Evt3 and what in (4, 5):
            width = 12 if what == 4 else 8
            for bit in range(width):
                if word >> bit & 1:
                    yield state["time"], None if state["x"] is None else state["x"] + bit, state["y"], state["p"]
            state["x"] = None if state["x"] is None else state["x"] + width


lows = st.one_of(st.integers(0, 63), st.sampled_from([0, 1, 62, 63]))
steps = st.one_of(st.sampled_from([0, 0, 0, 1, 1, 2, 3, -1, -2, 24, 25, -24, -25, 1000, -1000]), st.integers(-4096, 4096))
highs = st.tuples(st.just("high"), steps)
pixels = (st.integers(0, 2047), st.integers(0, 2047), st.integers(0, 1))
words_of = {
    Evt2: st.lists(st.one_of(highs, st.builds(evt2, lows, *pixels), st.just(0xA0000001)), max_size=60),
    Evt21: st.lists(st.one_of(highs, st.builds(evt21, lows, *pixels, st.integers(0, 2**32 - 1)), st.just(0xE << 60)), max_size=40),
    Evt3: st.lists(
        st.one_of(
            highs,
            st.builds(low_word, st.one_of(st.integers(0, 4095), st.sampled_from([0, 1, 2047, 2048, 4095]))),
            st.builds(row_word, pixels[0]),
            st.builds(pixel_word, pixels[0], pixels[2]),
            st.builds(base_word, pixels[0], pixels[2]),
            st.builds(mask_word, st.just(12), st.integers(0, 4095)),
            st.builds(mask_word, st.just(8), st.integers(0, 255)),
            st.just(0x9999),
        ),
        max_size=80,
    ),
}


def with_highs(drawn: list[Any], kind: type[Evt2], first: int) -> list[int]:
    words, high = [], first
    for word in drawn:
        high += word[1] if isinstance(word, tuple) else 0
        words.append(high_word(kind, high) if isinstance(word, tuple) else word)
    return words


def decoded(words: list[int], kind: type[Evt2], cuts: list[int]) -> tuple[list[Event], Counter[str]]:
    notes = Notes()
    decoder, array = kind(notes), np.array(words, dtype=kind.dtype)
    borders = [0, *sorted(cut % (len(words) + 1) for cut in cuts), len(words)]
    parts = list(itertools.pairwise(borders))
    packets = [decoder.feed(array[first:past], number < len(parts)) for number, (first, past) in enumerate(parts, start=1)]
    return np.concatenate(packets).tolist(), +notes.counts


@pytest.mark.parametrize("kind", [Evt2, Evt21, Evt3])
@given(
    data=st.data(),
    first=st.sampled_from([0, 1, 4090, 2**28 - 3, 1000]),
    repeats=st.sampled_from([0, 0, 70]),
    cuts=st.lists(st.integers(0, 99), max_size=5),
)
def test_words_are_what_the_format_says_however_they_are_divided(kind, data, first, repeats, cuts):
    words = with_highs(repeats * [("high", 0)] + data.draw(words_of[kind]), kind, first)
    assert decoded(words, kind, cuts) == naive_decoded(words, kind)


# --- files ---


def approach(start_us: int, count: int = 3000) -> list[Event]:
    """Sorted events over 0.8 s from an instant on."""
    drawn = np.random.default_rng(1)
    times = np.sort(drawn.integers(0, 800_000, count)) + start_us
    times[0] = start_us
    return list(zip(times.tolist(), *(drawn.integers(0, past, count).tolist() for past in (640, 480, 2)), strict=True))


def windows_of(events: list[Event]) -> list[tuple[int, int]]:
    array = np.array(events, dtype=EVENT)
    return [(start, int(frame.sum())) for start, frame in FrameStream((480, 640), 40_000).frames([array])]


@pytest.mark.parametrize(("kind", "version"), [(Evt2, "evt2"), (Evt3, "evt3")])
def test_what_another_program_writes_is_read_as_it_reads_it(tmp_path, kind, version):
    faery = pytest.importorskip("faery", reason="the extra 'recordings' is not installed")
    events = np.array(approach(2**24 - 300_000, 20_000), dtype=EVENT)
    events["x"] &= 31  # a few rows of neighbours: EVT3 packs them into masks
    events["y"] &= 7
    packet = np.empty(len(events), dtype=faery.EVENTS_DTYPE)
    packet["t"], packet["x"], packet["y"], packet["on"] = events["t"] // 4096 * 4096, events["x"], events["y"], events["p"]
    path = tmp_path / "a.raw"
    faery.events_stream_from_array(packet, dimensions=(640, 480)).to_file(path, version=version, zero_t0=False)
    theirs = np.concatenate(list(faery.events_stream_from_file(path)))
    back, counts = read(path)
    assert back == list(zip(*(theirs[name].tolist() for name in ("t", "x", "y")), theirs["on"].astype(int).tolist(), strict=True))
    assert counts == {}
    words = np.frombuffer(path.read_bytes(), dtype=np.uint16)
    assert kind is not Evt3 or np.isin(words >> 12, (4, 5)).sum() > 100


@pytest.mark.parametrize("kind", [Evt2, Evt21, Evt3])
def test_a_file_of_every_format_is_read(tmp_path, kind):
    events = approach(2**24 - 300_000)
    assert read(saved(tmp_path / "a.raw", written(events, kind), kind)) == (events, {})


@pytest.mark.parametrize("kind", [Evt2, Evt3])
def test_one_time_word_lost_is_found_and_costs_no_time(tmp_path, kind):
    """Also the one that tells that the clock wrapped."""
    events = approach(2**24 - 300_000, 60_000 if kind is Evt2 else 3000)
    words = written(events, kind)
    places = [place for place, word in enumerate(words) if kind_of(word, kind) == 8]
    at_the_end = next(place for place in places if words[place] & 0xFFF == 0 and place > places[20])
    for lost in (places[10], places[40], at_the_end):
        back, counts = read(saved(tmp_path / "a.raw", words[:lost] + words[lost + 1 :], kind))
        assert counts["time words lost"] == 1
        assert len(back) + counts["events without a time"] == len(events)
        assert set(back) <= set(events)


@pytest.mark.parametrize(("kind", "period_us"), [(Evt2, 2**34), (Evt21, 2**34), (Evt3, 2**24)])
def test_a_clock_that_wraps_goes_on(tmp_path, kind, period_us):
    events = approach(3 * period_us - 400_000)
    back, counts = read(saved(tmp_path / "a.raw", written(events, kind), kind))
    assert [(t - back[0][0], x, y, p) for t, x, y, p in back] == [(t - events[0][0], x, y, p) for t, x, y, p in events]
    assert counts == {}


@pytest.mark.parametrize("kind", [Evt2, Evt3])
def test_a_time_word_that_steps_back_is_counted_and_its_event_is_old(tmp_path, kind):
    """As sensors do: an event comes late, with the word of its time before it."""
    events = approach(1_000_000)
    late = [*events[:1000], events[900], *events[1000:]]
    back, counts = read(saved(tmp_path / "a.raw", written(late, kind), kind))
    assert back == late
    assert counts == {"time words that step back": 1}
    assert windows_of(back) == windows_of(events)


@pytest.mark.parametrize("kind", [Evt2, Evt21, Evt3])
def test_a_camera_that_restarts_begins_a_new_run_of_windows(tmp_path, kind):
    events = approach(7_000_000) + approach(0)
    back, _ = read(saved(tmp_path / "a.raw", written(events, kind), kind))
    assert back == events
    assert [start for start, _ in windows_of(back)] == [*range(7_000_000, 7_800_000, 40_000), *range(0, 800_000, 40_000)]


def test_a_flipped_bit_of_a_time_word_costs_its_block_and_no_more(tmp_path):
    events = approach(1_000_000)
    words = written(events, Evt3)
    places = [place for place, word in enumerate(words) if kind_of(word, Evt3) == 8]
    for bit in range(12):
        changed = list(words)
        changed[places[100]] ^= 1 << bit
        stream = FrameStream((480, 640), 40_000)
        back, _ = read(saved(tmp_path / "a.raw", changed, Evt3))
        frames = list(stream.frames([np.array(back, dtype=EVENT)]))
        assert [start for start, _ in frames] == [start for start, _ in windows_of(events)]
        assert stream.runs == 1
        wrong = set(back) - set(events)
        assert len(wrong) <= (places[101] - places[100]) // 3
        assert stream.misdated_events + stream.unsorted_events + stream.late_events >= len(wrong) or bit < 3


def test_of_a_sensor_that_repeats_its_time_words_the_block_before_lost_ones_has_no_time(tmp_path):
    """64 us of events a word of a sensor; of a stretch that was lost on the way the words are missing, and what was in it."""
    events, words = approach(1_000_000, 20_000), []
    for number, (t, x, y, p) in enumerate(events):
        if number == 0 or t // 64 != events[number - 1][0] // 64:
            words.append(high_word(Evt3, t // 4096))
        words += [low_word(t % 4096), row_word(y), pixel_word(x, p)]
    lost = range(30_000, 30_700)
    back, counts = read(saved(tmp_path / "a.raw", words[: lost.start] + words[lost.stop :], Evt3))
    assert counts["time words lost"] in (1, 2, 3)
    assert 0 < counts["events without a time"] < 30
    assert set(back) <= set(events)


def test_events_before_the_first_time_word_are_counted_and_not_dated(tmp_path):
    events = approach(3_000_000_000)
    words = [evt2(low, 1, 2, 1) for low in range(40)] + written(events, Evt2)
    assert read(saved(tmp_path / "a.raw", words, Evt2)) == (events, {"events without a time": 40})
    words = [pixel_word(1, 1), *written(events, Evt3)[:2], pixel_word(5, 0), *written(events, Evt3)]
    assert read(saved(tmp_path / "a.raw", words, Evt3))[1] == {"events without a time": 1, "events without a place": 1}


@pytest.mark.parametrize(
    ("kind", "header", "order"),
    [
        (Evt2, "% format EVT2;endianness=big;height=480;width=640\n", ">"),
        (Evt3, "% evt 3.0\n% endianness big\n", ">"),
        (Evt21, "% format EVT21;endianness=big\n", ">"),
        (Evt3, "% format evt3\n% Endianness Little\n", "<"),
        (Evt3, "% format EVT3; height=480; width=640\n% plugin_name x\n", "<"),
        (Evt21, "% evt 2.1\n", "<"),
        (Evt21, "% format EVT21;height=480;width=640\n", "legacy"),
        (Evt21, "% format EVT21;endianness=legacy\n", "legacy"),
        (Evt2, "% EVT 2.0\n", "<"),
    ],
)
def test_bytes_come_in_the_order_that_the_header_states(tmp_path, kind, header, order):
    events = approach(1_000_000)
    words = written(events, kind)
    if order == "legacy":
        words = [word >> 32 | (word & 0xFFFFFFFF) << 32 for word in words]
    path = saved(tmp_path / "a.raw", words, kind, header, "<" if order == "legacy" else order)
    assert read(path) == (events, {})
    assert raw.sensor_shape(path) == (480, 640)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            "% format HISTO3D;height=480;width=640\n",
            "found format HISTO3D in the header; convert it to EVT2.*metavision_file_to_csv",
        ),
        ("% evt 4.0\n", "found format 4.0"),
        ("% plugin_name hal_plugin_gen31\n", "found no format in the header; convert it to EVT2 or EVT3"),
        ("% evt 3.0\n% endianness middle\n", "found endianness middle in the header; known are little, big$"),
        ("% evt 3.0\n% endianness legacy\n", "found endianness legacy in the header; known are little, big$"),
    ],
)
def test_a_format_that_is_not_read_is_named(tmp_path, header, message):
    path = saved(tmp_path / "a.raw", written(approach(0), Evt3), Evt3, header)
    with pytest.raises(RecordingError, match=message):
        raw.packets(path, Notes())


def test_bytes_in_no_clear_order_are_refused(tmp_path):
    path = saved(tmp_path / "a.raw", [0x6 << 60 | 6 << 28], Evt21, "% evt 2.1\n")
    with pytest.raises(RecordingError, match="add the line `% endianness little`"):
        raw.packets(path, Notes())


def test_words_without_a_time_word_are_not_kept_for_ever(monkeypatch):
    monkeypatch.setattr(raw, "MOST_WORDS_IN_A_BLOCK", 1000)
    decoder = Evt3(Notes())
    with pytest.raises(ValueError, match="no time in 1001 words"):
        decoder.feed(np.zeros(1001, dtype=np.uint16), True)


def test_a_big_file_is_read_in_packets_that_are_bounded(tmp_path):
    events = approach(0, 60_000)
    path = saved(tmp_path / "a.raw", written(events, Evt3), Evt3)
    packets: list[NDArray] = list(raw.packets(path, Notes()))
    assert max(len(packet) for packet in packets) <= raw.CHUNK_WORDS
    assert len(packets) > 2
    assert np.concatenate(packets).tolist() == events

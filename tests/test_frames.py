"""Frames from events: against a double loop, however the events are divided into packets; what is lost is counted."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.frames import EventError, FrameStream, events_to_frames

EVENT = np.dtype([("t", np.int64), ("x", np.int16), ("y", np.int16), ("p", np.int8)])
SHAPE = (4, 6)

times = st.one_of(st.integers(0, 60), st.integers(-(10**15), 10**15).map(lambda t: t // 10**15 * 40))
inside = st.tuples(times, st.integers(0, SHAPE[1] - 1), st.integers(0, SHAPE[0] - 1), st.sampled_from([0, 1]))
anywhere = st.tuples(times, st.integers(-2, SHAPE[1] + 2), st.integers(-2, SHAPE[0] + 2), st.sampled_from([-1, 1]))
sizes = st.integers(1, 25).flatmap(lambda window: st.tuples(st.just(window), st.integers(1, window)))


def events_of(rows: list[tuple[int, int, int, int]]) -> NDArray:
    return np.array(rows, dtype=EVENT)


def naive_frame(events: NDArray, start: int, window_us: int) -> list[list[int]]:
    """One window by definition: look at every event."""
    frame = [[0] * SHAPE[1] for _ in range(SHAPE[0])]
    for event in events:
        if start <= event["t"] < start + window_us and 0 <= event["x"] < SHAPE[1] and 0 <= event["y"] < SHAPE[0]:
            frame[event["y"]][event["x"]] = 1
    return frame


def naive_frames(events: NDArray, window_us: int, step_us: int) -> list[tuple[int, list[list[int]]]]:
    """All windows that start at or before the last event."""
    if len(events) == 0:
        return []
    starts = range(min(events["t"].tolist()), max(events["t"].tolist()) + 1, step_us)
    return [(start, naive_frame(events, start, window_us)) for start in starts]


def packets(events: NDArray, cuts: list[int]) -> list[NDArray]:
    borders = [0, *sorted(cut % (len(events) + 1) for cut in cuts), len(events)]
    return [events[first:past] for first, past in itertools.pairwise(borders)]


def run(stream: FrameStream, fed: list[NDArray]) -> list[tuple[int, list[list[int]]]]:
    return [(start, frame.tolist()) for start, frame in stream.frames(fed)]


@given(rows=st.lists(inside, max_size=30), size=sizes, cuts=st.lists(st.integers(0, 40), max_size=8))
def test_sorted_events_give_the_naive_frames_whatever_the_packets(rows, size, cuts):
    events = events_of(sorted(rows))
    stream = FrameStream(SHAPE, *size)
    assert run(stream, packets(events, cuts)) == naive_frames(events, *size)
    assert (stream.late_events, stream.unsorted_events, stream.outside_events) == (0, 0, 0)


@given(rows=st.lists(anywhere, max_size=30), size=sizes, cuts=st.lists(st.integers(0, 40), max_size=8))
def test_a_frame_holds_all_that_came_before_it_and_the_rest_is_counted(rows, size, cuts):
    stream = FrameStream(SHAPE, *size)
    late, unsorted, fed, seen, next_start = 0, 0, 0, [], None
    for packet in [*packets(events_of(rows), cuts), None]:
        on_sensor = [] if packet is None else [int(t) for t, x, y, _ in packet if 0 <= x < SHAPE[1] and 0 <= y < SHAPE[0]]
        next_start = min(on_sensor, default=None) if next_start is None else next_start
        for t in on_sensor:
            late += t < next_start
            unsorted += any(t < earlier for earlier in seen)
            seen.append(t)
        fed += 0 if packet is None else len(packet)
        for start, frame in stream.flush() if packet is None else stream.feed(packet):
            assert start == next_start
            assert frame.tolist() == naive_frame(events_of(rows[:fed]), start, size[0])
            next_start += size[1]
    assert all(t < next_start for t in seen)
    assert (stream.late_events, stream.unsorted_events, stream.outside_events) == (late, unsorted, len(rows) - len(seen))


@given(rows=st.lists(inside, max_size=30), size=sizes, order=st.randoms(use_true_random=False))
def test_one_call_sorts_and_gives_the_naive_frames(rows, size, order):
    order.shuffle(rows)
    events = events_of(rows)
    starts, frames = events_to_frames(events, SHAPE, *size)
    assert list(zip(starts.tolist(), frames.tolist(), strict=True)) == naive_frames(events, *size)
    assert frames.dtype == np.uint8
    assert frames.shape[1:] == SHAPE


def test_an_unsorted_event_in_an_open_window_is_used_and_counted():
    stream = FrameStream(SHAPE, 10)
    assert list(stream.feed(events_of([(0, 0, 0, 1), (8, 1, 0, 1)]))) == []
    [(start, frame)] = stream.feed(events_of([(5, 2, 3, 0), (10, 0, 0, 1)]))
    assert start == 0
    assert frame[3, 2] == 1
    assert (stream.unsorted_events, stream.late_events) == (1, 0)


def test_a_late_event_is_counted_and_changes_nothing():
    stream = FrameStream(SHAPE, 10)
    assert len(list(stream.feed(events_of([(0, 0, 0, 1), (10, 1, 0, 1)])))) == 1
    assert list(stream.feed(events_of([(9, 5, 3, 1)]))) == []
    [(start, frame)] = stream.flush()
    assert start == 10
    assert frame.sum() == 1
    assert (stream.unsorted_events, stream.late_events) == (1, 1)


def test_the_stream_goes_on_after_a_flush():
    stream = FrameStream(SHAPE, 10)
    assert [start for start, _ in run(stream, [events_of([(0, 0, 0, 1), (12, 0, 0, 1)])])] == [0, 10]
    assert list(stream.flush()) == []
    frames = run(stream, [events_of([(19, 1, 1, 1), (31, 2, 2, 1)])])
    assert [(start, np.sum(frame)) for start, frame in frames] == [(20, 0), (30, 1)]
    assert stream.late_events == 1


def test_a_jump_in_time_gives_its_empty_windows_one_at_a_time():
    stream = FrameStream(SHAPE, 1, largest_gap_us=2**61)
    stream.feed(events_of([(0, 0, 0, 1), (2**60, 1, 1, 1)]))
    # A single event after a pause may be wrong: the stream's end, or more events, say that it is not.
    frames = stream.flush()
    assert [(start, int(frame.sum())) for start, frame in itertools.islice(frames, 3)] == [(0, 1), (1, 0), (2, 0)]
    # The next iterator goes on where this one was left.
    assert next(stream.feed(events_of([])))[0] == 3
    with pytest.raises(EventError, match="use FrameStream"):
        events_to_frames(events_of([(0, 0, 0, 1), (2**60, 1, 1, 1)]), SHAPE, 1, largest_gap_us=2**61)


def test_a_packet_is_taken_even_if_its_frames_are_not_asked_for():
    stream = FrameStream(SHAPE, 10)
    for t in range(0, 30, 5):
        stream.feed(events_of([(t, t // 5, 0, 1)]))
    assert [(start, np.flatnonzero(frame).tolist()) for start, frame in stream.flush()] == [(0, [0, 1]), (10, [2, 3]), (20, [4, 5])]


def test_frames_belong_to_the_caller():
    stream = FrameStream(SHAPE, 10, 5)
    for _, frame in stream.feed(events_of([(0, 0, 0, 1), (9, 1, 1, 1), (40, 2, 2, 1)])):
        frame[:] = 7
    assert [int(frame.sum()) for _, frame in stream.flush()] == [1, 1]


def test_a_field_that_goes_by_its_title_is_found():
    titled = np.zeros(1, dtype=[("t", "<u8"), ("x", "<u2"), ("y", "<u2"), (("p", "on"), "?")])
    starts, frames = events_to_frames(titled, SHAPE, 10)
    assert starts.tolist() == [0]
    assert frames.sum() == 1


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (np.zeros(3), "structured array with fields t, x, y, p"),
        ([(0, 0, 0, 1)], "found list"),
        (np.zeros((2, 2), dtype=EVENT), "one-dimensional"),
        (np.zeros(1, dtype=[("t", "i8"), ("x", "i2"), ("y", "i2")]), "no field 'p' among t, x, y"),
        (np.zeros(1, dtype=[("t", "f8"), ("x", "i2"), ("y", "i2"), ("p", "i1")]), "t: found float64"),
        (np.zeros(1, dtype=[("t", "i8"), ("x", "f4"), ("y", "i2"), ("p", "i1")]), "x: found float32"),
        (np.array([(2**63, 0, 0, 1)], dtype=[("t", "u8"), ("x", "i2"), ("y", "i2"), ("p", "i1")]), "t: found 9223372036854775808"),
    ],
)
def test_unusable_events_are_refused(events, message):
    with pytest.raises(EventError, match=message):
        FrameStream(SHAPE, 10).feed(events)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 6), 10), r"shape\[0\]: found 0"),
        ((SHAPE, 0), "window_us: found 0"),
        ((SHAPE, 40.0), "window_us: found 40.0"),
        ((SHAPE, 10, -1), "step_us: found -1"),
        ((SHAPE, 10, 11), "step_us: found 11, above window_us 10"),
    ],
)
def test_unusable_sizes_are_refused(arguments, message):
    with pytest.raises(EventError, match=message):
        FrameStream(*arguments)
    with pytest.raises(EventError, match="largest_gap_us: found 0"):
        FrameStream(SHAPE, 10, largest_gap_us=0)


@pytest.mark.parametrize("spread_us", [1, 500, 1_000, 2_000, 10_000, 10**6])
@pytest.mark.parametrize("count", [2, 3, 100, 1000])
def test_one_call_sorts_events_that_are_in_no_order_over_any_time(count, spread_us):
    """Also over more time than a camera's packets are out of order by."""
    drawn = np.random.default_rng(count)
    events = events_of([(int(t) * spread_us, int(x), 0, 1) for t, x in drawn.integers(0, (60, SHAPE[1]), (count, 2))])
    starts, frames = events_to_frames(events, SHAPE, 7 * spread_us, largest_gap_us=2**61)
    assert list(zip(starts.tolist(), frames.tolist(), strict=True)) == naive_frames(events, 7 * spread_us, 7 * spread_us)


@pytest.mark.parametrize("wrong_us", [0, 10**15 + 10**9])
def test_one_call_refuses_a_wrong_time_and_a_clock_that_breaks(wrong_us):
    good = events_of([(10**15 + 500 * number, 0, 0, 1) for number in range(400)])
    with pytest.raises(EventError, match=r"^t: found 1 events at times that their neighbours contradict.*largest_gap_us 5000000"):
        events_to_frames(np.insert(good, 200, np.array((wrong_us, 0, 0, 1), dtype=EVENT)), SHAPE, 40_000)
    restarted = np.concatenate([good, good])
    with pytest.raises(EventError, match=r"2 runs of the clock.*use FrameStream"):
        events_to_frames(restarted, SHAPE, 40_000)


def test_one_call_refuses_events_outside_the_sensor():
    with pytest.raises(EventError, match="found 1 events outside a sensor of shape"):
        events_to_frames(events_of([(0, 0, 0, 1), (1, SHAPE[1], 0, 1)]), SHAPE, 10)


@pytest.mark.parametrize("shape", [(2**61, 3), (10, 16385)])
def test_a_sensor_larger_than_any_camera_is_refused_before_a_frame_is_made(shape):
    """Found by fuzzing: a frame of 6 EiB."""
    with pytest.raises(EventError, match=r"^shape\[[01]\]: found \d+; give a whole number above 0, at most 16384$"):
        FrameStream(shape, 1000)

"""Runs of the clock: against a rule that looks at one event after the other, however the events are divided into packets."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime import runs
from runtime.frames import LARGEST_GAP_US, Break, FrameStream
from runtime.runs import CONFIRMING_EVENTS, CONFIRMING_US, LARGEST_STEP_AHEAD_US, LARGEST_STEP_BACK_US, ClockRuns, Place

EVENT = np.dtype([("t", np.int64), ("x", np.int16), ("y", np.int16), ("p", np.int8)])
SHAPE = (2, 3)
WINDOW_US = 40_000

BORDERS = (LARGEST_STEP_AHEAD_US, LARGEST_GAP_US, -LARGEST_STEP_BACK_US, -LARGEST_STEP_AHEAD_US // 2)
jumps = st.one_of(
    st.sampled_from([0, *(border + more for border in BORDERS for more in (-1, 0, 1)), 2**40, -(2**40), 10**15]),
    st.integers(-7_000_000, 7_000_000),
)
bursts = st.lists(st.tuples(jumps, st.integers(1, 40), st.integers(-500, 1500)), max_size=12)
"""What a clock does: it jumps, then gives so many events in such steps."""


def times_of(drawn: list[tuple[int, int, int]]) -> list[int]:
    times, now = [], 10**15
    for jump, count, step in drawn:
        now += jump
        times += [now + number * step for number in range(count)]
        now = times[-1]
    return times


def naive_runs(times: list[int], gap_us: int) -> tuple[list[int | None], int]:
    """The number of each event's run, None for a misdated one; and how many runs there are. One event at a time, as the rule says."""
    numbers: list[int | None] = [None] * len(times)
    run: list[int] = []
    doubtful: list[int] = []
    number = 0

    def latest(places: list[int]) -> int:
        return max(times[place] for place in places)

    def believed(places: list[int]) -> bool:
        span = latest(places) - min(times[place] for place in places)
        return len(places) >= CONFIRMING_EVENTS and span >= CONFIRMING_US

    def believe() -> None:
        nonlocal run, number, doubtful
        if 0 < times[doubtful[0]] - latest(run) <= gap_us:
            run += doubtful
        else:
            if believed(run):
                number += 1
            else:
                for place in run:
                    numbers[place] = None
            run = doubtful
        doubtful = []
        for place in run:
            numbers[place] = number

    for place, t in enumerate(times):
        agrees = place > 0 and -LARGEST_STEP_AHEAD_US / 2 <= t - times[place - 1] <= LARGEST_STEP_AHEAD_US
        if not run or (agrees and not doubtful):
            run.append(place)
            numbers[place] = number
        elif not agrees and -LARGEST_STEP_BACK_US <= t - latest(run) <= LARGEST_STEP_AHEAD_US:
            doubtful = []
            run.append(place)
            numbers[place] = number
        else:
            joins = agrees or (doubtful and -LARGEST_STEP_BACK_US <= t - latest(doubtful) <= gap_us)
            doubtful = [*doubtful, place] if joins else [place]
            if believed(doubtful):
                believe()
    if doubtful and (0 < times[doubtful[0]] - latest(run) <= gap_us or (not believed(run) and len(doubtful) > len(run))):
        believe()
    return numbers, number + 1 if times else 0


def parts_of(times: list[int], cuts: list[int]) -> list[list[int]]:
    borders = [0, *sorted(cut % (len(times) + 1) for cut in cuts), len(times)]
    return [list(range(first, past)) for first, past in itertools.pairwise(borders) if past > first]


def numbered(times: list[int], cuts: list[int], gap_us: int) -> tuple[list[int | None], int, int]:
    """What `ClockRuns` makes of the times: each event is told by its number in place of a pixel."""
    parted = ClockRuns(gap_us)
    found: list[int | None] = [None] * len(times)
    number, given_order = -1, []
    packets = [(np.array([times[place] for place in part]), np.array(part)) for part in parts_of(times, cuts)]
    for pieces in [*(parted.feed(t, places) for t, places in packets), parted.flush()]:
        for place, t, places in pieces:
            assert t.tolist() == [times[event] for event in places.tolist()]
            if place is Place.REPLACES:
                found = [None if event == number else event for event in found]
            number += place is Place.BEGINS
            for event in places.tolist():
                found[event] = number
            given_order += places.tolist()
    assert given_order == sorted(given_order)
    return found, number + 1, parted.misdated_events


@given(drawn=bursts, cuts=st.lists(st.integers(0, 400), max_size=6), gap_us=st.sampled_from([LARGEST_GAP_US, 1, 50_000, 2**61]))
def test_events_are_parted_as_the_rule_says_whatever_the_packets(drawn, cuts, gap_us):
    times = times_of(drawn)
    wanted, count = naive_runs(times, gap_us)
    assert numbered(times, cuts, gap_us) == (wanted, count, wanted.count(None))


def test_a_clock_that_stands_still_is_believed_after_a_bounded_number_of_events(monkeypatch):
    monkeypatch.setattr(runs, "MOST_DOUBTFUL_EVENTS", 500)
    times = [*range(0, 20_000, 100), *([-(10**9)] * 499)]
    assert numbered(times, [], LARGEST_GAP_US)[1:] == (1, 499)
    assert numbered([*times, times[-1]], [], LARGEST_GAP_US)[1:] == (2, 0)


# --- in windows ---


def events_at(times: list[int] | NDArray) -> NDArray:
    events = np.zeros(len(times), dtype=EVENT)
    events["t"] = times
    events["x"] = np.arange(len(times)) % SHAPE[1]
    return events


def second(start_us: int) -> NDArray:
    """Events every 500 us over 0.4 s: ten windows."""
    return events_at(start_us + np.arange(0, 400_000, 500))


def frames_of(*packets: NDArray, **options: int) -> tuple[list[tuple[int, int]], FrameStream]:
    stream = FrameStream(SHAPE, WINDOW_US, **options)
    return [(start, int(frame.sum())) for start, frame in stream.frames(packets)], stream


TEN = [(number * WINDOW_US, 3) for number in range(10)]


def at(start_us: int) -> list[tuple[int, int]]:
    return [(start + start_us, lit) for start, lit in TEN]


@given(drawn=bursts, cuts=st.lists(st.integers(0, 400), max_size=6), step_us=st.sampled_from([WINDOW_US, 15_000]))
def test_each_run_has_the_windows_that_its_events_alone_give(drawn, cuts, step_us):
    times = times_of([(jump, count, abs(step)) for jump, count, step in drawn])
    if len(times) == 0 or any(-LARGEST_STEP_BACK_US <= step < 0 for step in np.diff(times)):
        return
    events, (numbers, count) = events_at(times), naive_runs(times, LARGEST_GAP_US)
    stream, found = FrameStream(SHAPE, WINDOW_US, step_us), []
    for start, frame in stream.frames(events[part] for part in parts_of(times, cuts)):
        found.append((stream.run, start, frame.tolist()))
    wanted = []
    for number in range(count):
        own = events[[place for place, run in enumerate(numbers) if run == number]]
        alone = FrameStream(SHAPE, WINDOW_US, step_us, largest_gap_us=LARGEST_GAP_US)
        wanted += [(number, start, frame.tolist()) for start, frame in alone.frames([own])]
    withdrawn = [given for given in found if given not in wanted]
    assert [given for given in found if given in wanted] == wanted
    assert not withdrawn or None in numbers
    assert stream.misdated_events == numbers.count(None)


def test_a_restart_of_the_clock_begins_a_new_run_of_windows():
    found, stream = frames_of(second(5_000_000), second(0))
    assert found == at(5_000_000) + TEN
    assert (stream.runs, stream.late_events, stream.unsorted_events, stream.misdated_events) == (2, 0, 0, 0)
    assert stream.breaks == [Break(5_399_500, 0)]


def test_after_a_restart_live_windows_go_on_at_once():
    stream, given = FrameStream(SHAPE, WINDOW_US), []
    for packet in np.split(np.concatenate([second(5_000_000), second(0)]), 160):
        given.append([(stream.run, start) for start, _ in stream.feed(packet)])
    # The 81st packet of 5 ms is the first after the restart; 10 ms confirm it, and its first window is whole after 40 ms.
    assert given[82] == [(0, 5_360_000)]
    assert given[88] == [(1, 0)]
    assert [frames for frames in given[89:] if frames] == [[(1, start)] for start in range(WINDOW_US, 360_000, WINDOW_US)]


def test_one_wrong_time_moves_no_window_and_is_counted():
    good = second(10**15)
    for place, wrong in itertools.product((0, 1, 100, 799, 800), (0, 2**60, 10**15 + 10**12, 10**15 - 10**7, -5)):
        events = np.insert(good, place, np.array((wrong, 0, 1, 1), dtype=EVENT))
        for packets in ([events], np.split(events, sorted([1, 2, place, place + 1, 100, 101, 800]))):
            found, stream = frames_of(*packets)
            assert found == at(10**15), (place, wrong)
            assert (stream.runs, stream.misdated_events, stream.late_events, stream.unsorted_events) == (1, 1, 0, 0)


def test_old_times_in_the_middle_of_packets_are_skipped():
    """As a driver gave them, each about a second old."""
    events = second(10**15)
    for place in (50, 301, 302, 777):
        events["t"][place] -= 998_999
    found, stream = frames_of(*np.split(events, 40))
    assert [start for start, _ in found] == [start for start, _ in at(10**15)]
    assert (stream.runs, stream.misdated_events, stream.late_events) == (1, 4, 0)


def test_an_event_before_a_pause_within_the_gap_is_the_first():
    """What comes first is contradicted by nothing: a pause follows."""
    found, stream = frames_of(events_at([0]), second(1_000_000))
    assert found == [(0, 1), *((start, 0) for start in range(WINDOW_US, 1_000_000, WINDOW_US)), *at(1_000_000)]
    assert (stream.runs, stream.misdated_events) == (1, 0)


def test_a_wrong_time_within_the_gap_neither_ends_windows_nor_makes_what_follows_late():
    events = second(0)
    for ahead in (LARGEST_STEP_AHEAD_US + 1, 1_000_000, LARGEST_GAP_US):
        changed = np.insert(events, 300, np.array((int(events["t"][300]) + ahead, 0, 1, 1), dtype=EVENT))
        found, stream = frames_of(*np.split(changed, [299, 301, 302]))
        assert found == TEN
        assert (stream.misdated_events, stream.late_events) == (1, 0)


def test_a_short_block_of_wrong_times_is_skipped_and_counted():
    """As one wrong TIME_HIGH word makes: 4 ms of events at another time."""
    events = second(0)
    changed = np.concatenate([events, np.repeat(events[400:410], 20)])
    changed["t"][-200:] += 2**23
    order = np.argsort(np.concatenate([np.arange(800), np.full(200, 400.5)]), kind="stable")
    found, stream = frames_of(changed[order])
    assert found == TEN
    assert stream.misdated_events == 200


def test_a_pause_is_empty_windows_up_to_the_largest_gap_and_a_new_run_beyond():
    later = 400_000 + 1_000_000
    found, stream = frames_of(second(0), second(later))
    assert found == TEN + [(start, 0) for start in range(400_000, later, WINDOW_US)] + at(later)
    assert stream.runs == 1
    found, stream = frames_of(second(0), second(later), largest_gap_us=1_000_000)
    assert found == TEN + at(later)
    assert stream.breaks == [Break(399_500, later)]


def test_what_a_driver_had_left_over_from_its_last_run_is_skipped():
    found, stream = frames_of(events_at([7_000_000 + number for number in range(300)]), second(0))
    assert found == TEN
    assert (stream.runs, stream.misdated_events) == (1, 300)


def test_a_packet_out_of_its_turn_is_late_and_no_restart():
    packets = np.split(second(0), 20)
    found, stream = frames_of(*packets[:9], packets[10], packets[9], *packets[11:])
    assert [start for start, _ in found] == [start for start, _ in TEN]
    assert (stream.runs, stream.misdated_events) == (1, 0)
    assert stream.unsorted_events == len(packets[9])


def test_sparse_events_confirm_each_other():
    found, stream = frames_of(*(events_at([time]) for time in range(0, 4_000_000, 200_000)))
    assert [start for start, lit in found if lit] == list(range(0, 4_000_000, 200_000))
    assert (stream.runs, stream.misdated_events) == (1, 0)


def test_breaks_are_remembered_up_to_a_number_and_all_counted():
    found, stream = frames_of(*(second(5_000_000 * (number % 2)) for number in range(120)), largest_gap_us=100_000)
    assert len(found) == 1200
    assert stream.runs == 120
    assert len(stream.breaks) == 100

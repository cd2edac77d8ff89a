"""Body rates become bounds on how far the pitch has turned: sound between readings, in gaps and with a roll, and no wider than said."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import Floats, examples

from runtime import Motion
from runtime.recordings.gyroscope import COLUMNS, LONGEST_GAP_US, GyroscopeError, GyroscopeReadings

SLOW = Motion([-0.5, 0, 0, 0], [0.3, 0, 0, 0])
UNKNOWN = Motion([-np.inf] * 4, [np.inf] * 4)


def file_of(path: Path, rows: list | Floats) -> Path:
    """A file with the rows: time, roll, pitch and yaw rates, and their plus-minus."""
    np.savetxt(path, rows, delimiter=",", header=",".join(COLUMNS), comments="", fmt="%.17g")
    return path


def pitching(times: Floats, rates: Floats, plus_minus: float) -> Floats:
    """Rows of pitch rates alone."""
    none = np.zeros(len(times))
    return np.column_stack([times, none, rates, none, none, none + plus_minus, none])


def test_a_steady_rate_is_integrated_between_any_two_instants(tmp_path: Path) -> None:
    readings = GyroscopeReadings.load(file_of(tmp_path / "g.csv", pitching(np.arange(0, 1e6, 1e4), np.full(100, 0.2), 0.01)))
    for since, until in ((0, 40_000), (3_333.5, 43_333.5), (12_000, 12_001), (100_000, 900_000)):
        seconds = (until - since) / 1e6
        low, high = readings.turned(since, until, SLOW)
        assert low == pytest.approx(-0.21 * seconds, rel=1e-9)
        assert high == pytest.approx(-0.19 * seconds, rel=1e-9)
        assert low <= -0.21 * seconds
        assert high >= -0.19 * seconds
    assert readings.turned(500_000, 500_000, UNKNOWN) == (0.0, 0.0)


def test_between_two_readings_either_may_be_right(tmp_path: Path) -> None:
    readings = GyroscopeReadings.load(file_of(tmp_path / "g.csv", pitching(np.array([0, 1e4, 2e4]), np.array([0.1, 0.3, 0.3]), 0.0)))
    low, high = readings.turned(5_000, 15_000, SLOW)
    assert low == pytest.approx(-0.3 * 0.01, rel=1e-9)
    assert high == pytest.approx(-0.1 * 0.005 - 0.3 * 0.005, rel=1e-9)


def test_where_nothing_is_read_the_motion_bounds_stand(tmp_path: Path) -> None:
    times = np.array([100_000, 110_000, 110_000 + LONGEST_GAP_US + 1, 170_000])
    readings = GyroscopeReadings.load(file_of(tmp_path / "g.csv", pitching(times, np.zeros(4), 0.0)))
    gap = (LONGEST_GAP_US + 1) / 1e6
    for since, until, unknown in ((100_000, 110_000, 0.0), (90_000, 105_000, 0.01), (165_000, 190_000, 0.02), (105_000, 165_000, gap)):
        low, high = readings.turned(since, until, SLOW)
        assert low == pytest.approx(-0.5 * unknown, abs=1e-12)
        assert high == pytest.approx(0.3 * unknown, abs=1e-12)
    assert readings.turned(0, 10, UNKNOWN) == (-np.inf, np.inf)
    assert readings.turned(100_000, 110_001, UNKNOWN) == (-np.inf, np.inf)
    alone = GyroscopeReadings.load(file_of(tmp_path / "g.csv", pitching(times[:1], np.zeros(1), 0.0)))
    assert alone.turned(100_000, 110_000, SLOW) == pytest.approx((-0.005, 0.003))


@examples(60)
@given(seed=st.integers(0, 10**9))
def test_a_turn_within_the_readings_is_held(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """Rates of a turning, rolling aircraft that lie anywhere in what is read, often at its bounds; summed up in short steps."""
    rng = np.random.default_rng(seed)
    most_roll = float(rng.choice([0.0, 0.01, 0.4]))
    count = int(rng.integers(2, 12))
    times = np.cumsum(rng.choice([1_000, 7_500.5, 40_000], count))
    rows = np.column_stack([times, rng.normal(0, 0.3, (count, 3)), rng.choice([0.0, 0.02], (count, 3))])
    readings = GyroscopeReadings.load(file_of(tmp_path_factory.mktemp("g") / "g.csv", rows), most_roll)
    since, until = np.sort(rng.uniform(times[0], times[-1], 2))
    fine = np.union1d(np.linspace(since, until, 50), times[(times > since) & (times < until)])
    total = 0.0
    for start, stop in itertools.pairwise(fine):
        before = int(np.searchsorted(times, (start + stop) / 2)) - 1
        near = rows[rng.integers(before, before + 2)]
        share = rng.choice([-1.0, 1.0, rng.uniform(-1, 1)], 2)
        pitch_rate, yaw_rate = near[2] + share[0] * near[5], near[3] + share[1] * near[6]
        roll = rng.choice([-1.0, 1.0, rng.uniform(-1, 1)]) * most_roll
        total -= (pitch_rate * np.cos(roll) - yaw_rate * np.sin(roll)) * (stop - start) / 1e6
    low, high = readings.turned(since, until, SLOW)
    assert low - 1e-14 <= total <= high + 1e-14


def test_a_roll_mixes_the_axes(tmp_path: Path) -> None:
    rows = [[0, 9, 0.1, 0.5, 9, 0.0, 0.1], [1e4, 9, 0.1, -0.5, 9, 0.0, 0.1]]
    path = file_of(tmp_path / "g.csv", rows)
    assert GyroscopeReadings.load(path).turned(0, 1e4, SLOW) == pytest.approx((-0.001, -0.001), abs=1e-12)
    low, high = GyroscopeReadings.load(path, 0.01).turned(0, 1e4, SLOW)
    assert (low, high) == pytest.approx((-0.001 - 6e-5, -0.001 + 6e-5), abs=1e-6)


@pytest.mark.parametrize(
    ("rows", "found"),
    [
        ([[0, 0, 0, 0, 0, -1, 0]], r"a plus-minus below 0 in row 1 of its numbers; give 0 or more$"),
        ([[0] * 7, [0] * 7], r"found a time that is not after the line's before in row 2 of its numbers; give them in order$"),
        ([[0, 0, np.nan, 0, 0, 0, 0]], r"found a number that is not finite in row 1 of its numbers; give finite ones$"),
    ],
)
def test_files_that_cannot_be_used_are_refused(tmp_path: Path, rows: list, found: str) -> None:
    path = file_of(tmp_path / "g.csv", rows)
    with pytest.raises(GyroscopeError, match=found):
        GyroscopeReadings.load(path)
    path.write_text("time_us,pitch_rad\n1,2\n")
    with pytest.raises(GyroscopeError, match=r"g.csv: no column roll_rate_rad_s, .*; give a CSV file with the columns time_us, roll_rate"):
        GyroscopeReadings.load(path)

"""What run-model tells of a recording's clock and layout, on the screen and in summary.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("cv2", reason="the extra 'recordings' is not installed")
pytest.importorskip("typer", reason="the extra 'recordings' is not installed")

import typer
from typer.testing import CliRunner

from runtime.recordings.cli import run_model
from runtime.recordings.packet import EVENT

MODEL = Path(__file__).parents[1] / "models" / "paper.onnx"
WINDOWS = 10


def approach(start_us: int = 0) -> NDArray:
    """Ten windows of 40 ms with 50 events each."""
    drawn = np.random.default_rng(1)
    events = np.zeros(50 * WINDOWS, dtype=EVENT)
    events["t"] = start_us + 40_000 * np.repeat(np.arange(WINDOWS), 50) + np.sort(drawn.integers(0, 40_000, (WINDOWS, 50))).reshape(-1)
    events["t"][0] = start_us
    events["x"], events["y"] = drawn.integers(0, 640, len(events)), drawn.integers(0, 480, len(events))
    return events


def run(path: Path, *options: object) -> tuple[str, str, dict[str, Any]]:
    """What is printed, what is complained of, and the summary."""
    app = typer.Typer()
    app.command()(run_model)
    output = path.parent / "out"
    done = CliRunner().invoke(app, [str(part) for part in (MODEL, path, "-o", output, "--no-video", "--no-refine", *options)])
    assert done.exit_code == 0, done.stderr
    return done.stdout, done.stderr, json.loads((output / "summary.json").read_text())


def saved(path: Path, events: NDArray) -> Path:
    np.savez(path, **{name: events[name] for name in EVENT.names})
    return path


def test_a_sound_recording_has_nothing_to_note(tmp_path):
    printed, complained, summary = run(saved(tmp_path / "a.npz", approach()))
    assert complained == ""
    assert "recording read as" in printed
    assert (summary["windows"], summary["layout"], summary["runs"], summary["breaks"]) == (WINDOWS, "t in us", 1, [])
    assert summary["largest_gap_us"] == 5_000_000
    assert set(summary["events_to_note"].values()) == {0}
    assert summary["recording_to_note"] == {}


def test_a_restart_is_told_with_both_times_and_all_windows(tmp_path):
    events = np.concatenate([approach(5_000_000), approach()])
    _, complained, summary = run(saved(tmp_path / "a.npz", events))
    before = int(approach(5_000_000)["t"][-1])
    assert f"clock to note: 2 runs of windows (after {before / 1e6:.6f} s comes 0.000000 s)" in complained
    assert summary["windows"] == 2 * WINDOWS
    assert summary["breaks"] == [{"before_us": before, "after_us": 0}]


@pytest.mark.parametrize("wrong_us", [0, 2**60])
def test_a_wrong_time_is_told_with_the_limit_and_costs_no_window(tmp_path, wrong_us):
    events = np.insert(approach(10**15), 20, np.array((wrong_us, 1, 1, 1), dtype=EVENT))
    _, complained, summary = run(saved(tmp_path / "a.npz", events))
    assert "events to note: 1 misdated; " in complained
    assert "at times that their neighbours contradict, largest_gap_us 5000000" in complained
    assert (summary["windows"], summary["runs"]) == (WINDOWS, 1)


def test_the_largest_gap_can_be_given(tmp_path):
    path = saved(tmp_path / "a.npz", np.concatenate([approach(), approach(1_400_000)]))
    assert run(path)[2]["windows"] == 45
    _, complained, summary = run(path, "--largest-gap-ms", 500)
    assert (summary["windows"], summary["runs"]) == (2 * WINDOWS, 2)
    assert "on by more than largest_gap_us 500000" in complained


def test_many_breaks_are_told_in_one_line(tmp_path):
    path = saved(tmp_path / "a.npz", np.concatenate([approach(number * 10**7) for number in (5, 4, 3, 2, 1)]))
    _, complained, summary = run(path)
    assert complained.count("\n") == 1
    assert "5 runs of windows" in complained
    assert "; ...)" in complained
    assert len(summary["breaks"]) == 4


def test_what_a_reader_finds_is_told(tmp_path):
    """One TIME_HIGH word lost: the clock's 24 bits wrap in the middle."""
    words, high = [], None
    for t, x, y, _ in approach(2**24 - 200_000).tolist():
        if t // 4096 != high:
            high = t // 4096
            words += [] if high == 4096 else [8 << 12 | high & 0xFFF]
        words += [6 << 12 | t & 0xFFF, y, 2 << 12 | x]
    path = tmp_path / "a.raw"
    path.write_bytes(b"% evt 3.0\n% geometry 640x480\n% end\n" + np.array(words, dtype="<u2").tobytes())
    _, complained, summary = run(path)
    assert complained == f"{path}: recording to note: time words lost: 1\n"
    assert (summary["windows"], summary["recording_to_note"]) == (WINDOWS, {"time words lost": 1})

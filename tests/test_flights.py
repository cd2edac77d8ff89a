"""The flights that judge a certificate over time: sound ones hold, faults are found, and the judge is not blind."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import flights
import pytest
import typer
from typer.testing import CliRunner

from runtime import tracker

MODEL = str(Path(__file__).parents[1] / "models" / "paper.onnx")


def test_sound_flights_have_no_violation():
    counts = sum((flights.fly_soundly(MODEL, (1, number)) for number in range(4)), Counter())
    assert counts["frames"] > 100
    assert counts["late"] > 0
    assert (counts["certified"], counts["violations"]) == (counts["frames"], 0)


def test_a_tracker_that_forgets_the_motion_is_caught(monkeypatch):
    """The box of the last frame taken for the next one's prior as it is."""
    monkeypatch.setattr(tracker.Seen, "later", lambda seen, _: seen)
    assert sum(flights.fly_soundly(MODEL, (1, number))["violations"] for number in range(4)) > 0


@pytest.mark.parametrize("fault", flights.FAULTS)
def test_a_fault_is_found_or_harmless(fault: str):
    counts = sum((flights.fly_with_fault(MODEL, fault, (2, number)) for number in range(2)), Counter())
    assert counts["violations"] == counts["silent"] == 0
    assert counts["found"] + counts["harmless"] == 2


def test_the_command_prints_and_writes_its_counts(tmp_path):
    app = typer.Typer()
    app.command()(flights.main)
    done = CliRunner().invoke(app, [MODEL, "--flights", "1", "--jobs", "1", "--seed", "5", "-o", str(tmp_path / "flights.json")])
    assert done.exit_code == 0, done.output
    assert "0 violations" in " ".join(done.output.split())
    found = json.loads((tmp_path / "flights.json").read_text())
    assert found["seed"] == 5
    assert set(found["models"]["paper"]) == {"sound", *flights.FAULTS}
    missing = CliRunner().invoke(app, [str(tmp_path / "none.onnx")])
    assert missing.exit_code == 2

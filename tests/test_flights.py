"""The flights that judge a certificate over time: sound ones hold, faults are found, and the judge is not blind."""

from __future__ import annotations

import functools
import json
from fractions import Fraction
from pathlib import Path

import flint
import numpy as np
import pytest
import typer
from coverage.states import Stage, uniform
from flights import campaign
from flights.course import Course, bounds, draw_motion, theta_ball, theta_bounds, turned
from flights.faulty import FAULTS, FaultyFlight
from flights.sound import SoundFlight
from flights.turned import TurnedFlight
from random_scenes.outcomes import Outcomes
from typer.testing import CliRunner

from runtime import Box, Tracker, estimator, tracker

MODEL = str(Path(__file__).parents[1] / "models" / "paper.onnx")


def flown(count: int, frames: int = 12) -> Outcomes:
    """Sound flights of the paper's model."""
    outcomes = Outcomes()
    for number in range(count):
        outcomes.add(SoundFlight(MODEL, str(number), np.random.default_rng([1, number]), frames).run())
    return outcomes


def test_sound_flights_have_no_finding() -> None:
    outcomes = flown(8, 10)
    counts = outcomes.counts["sound"]
    assert outcomes.findings == []
    assert counts["frames"] == counts["certified"] == 80
    for kind in ("late", "broken", "priors", "told", "predicted"):
        assert counts[kind] > 2


def turned_flight(number: int) -> Outcomes:
    """A flight of a camera that rolls and yaws."""
    return TurnedFlight(MODEL, str(number), np.random.default_rng([7, number])).run()


def test_a_flight_with_roll_and_yaw_has_no_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flights.turned.FRAMES", 5)
    outcomes = turned_flight(2)
    counts = outcomes.counts["turned"]
    assert outcomes.findings == []
    assert counts["frames"] == counts["certified"] == 5
    monkeypatch.setattr(tracker.Seen, "later", lambda seen, _: seen)  # a tracker that forgets the motion
    assert {"not certified"} <= {finding.fault for finding in turned_flight(2).findings}


def test_a_tracker_that_forgets_the_motion_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """The box of the last frame taken for the next one's prior as it is."""
    monkeypatch.setattr(tracker.Seen, "later", lambda seen, _: seen)
    assert {"not certified"} <= {finding.fault for finding in flown(6).findings}


def test_a_prediction_that_stands_still_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tracker, "box_at", lambda own, _: None if own._latest is None else own._latest[0])
    assert "a predicted box without the state" in {finding.fault for finding in flown(6).findings}


def test_boxes_that_are_cut_are_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimator, "regions_of", lambda sets, *_: (Box(sets.lower.min(axis=0), sets.lower.max(axis=0)),))
    assert "a box without the state" in {finding.fault for finding in flown(6).findings}


def test_exceptions_are_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tracker, "_held", lambda _: 1 / 0)
    assert "ZeroDivisionError" in {finding.fault for finding in flown(6).findings}


def test_a_course_keeps_its_motions_bounds_and_the_domain() -> None:
    stage, reached = Stage.of(MODEL, None), 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        course = Course(stage, draw_motion(rng, stage), rng, uniform(rng, stage), Fraction(0))
        for _ in range(10):
            before, then_us = course.state, course.time_us
            course.go()
            elapsed = (course.time_us - then_us) / 10**6
            assert stage.contains(course.state)
            assert Fraction(float(course.instant_us)) == course.time_us
            for axis, name in enumerate("xyz", start=1):
                moved, rates = getattr(course.state, name) - getattr(before, name), (course.motion.rate_lower, course.motion.rate_upper)
                low, high = (None if np.isinf(rate[axis]) else Fraction(float(rate[axis])) * elapsed for rate in rates)
                assert low is None or low <= moved
                assert high is None or moved <= high
                reached += elapsed > 0 and moved in (low, high) and low != high
            low, high = turned(before, course.state)
            with flint.ctx.workprec(300):
                turn = theta_ball(course.state) - theta_ball(before)
                assert not turn < low
                assert not turn > high
            if elapsed:
                assert course.motion.rate_lower[0] * float(elapsed) <= low <= high <= course.motion.rate_upper[0] * float(elapsed)
    assert reached > 50


def test_what_is_known_has_the_truth_on_its_face() -> None:
    stage, rng = Stage.of(MODEL, None), np.random.default_rng(3)
    course = Course(stage, draw_motion(rng, stage), rng, uniform(rng, stage), Fraction(0))
    for number in (Fraction(1, 3), Fraction(-1, 3), Fraction(1, 4)):
        low, high = bounds(number)
        assert Fraction(low) <= number <= Fraction(high)
        assert (low == high) == (number == Fraction(1, 4))
    on_faces = 0
    for _ in range(20):
        prior = course.prior(course.state)
        assert course.state.within(prior.lower, prior.upper)
        on_faces += bool(prior.lower[0] == theta_bounds(course.state)[0])
    assert on_faces > 2


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found_or_harmless(fault: str) -> None:
    outcomes = Outcomes()
    for number in range(2):
        outcomes.add(FaultyFlight(MODEL, fault, str(number), np.random.default_rng([2, number])).run())
    assert outcomes.findings == []
    assert outcomes.counts[fault]["found"] + outcomes.counts[fault]["harmless"] == outcomes.counts[fault]["flights"] == 2


def test_the_command_prints_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "FAULTS", dict(list(FAULTS.items())[:1]))
    monkeypatch.setattr(campaign, "SoundFlight", functools.partial(SoundFlight, frames=4))
    app = typer.Typer()
    app.command()(campaign.main)
    output = tmp_path / "flights.json"
    arguments = [MODEL, "--flights", "2", "--scenes", "0", "--jobs", "1", "-o", str(output)]
    done = CliRunner().invoke(app, [*arguments, "--seed", "5"])
    assert done.exit_code == 0, done.output
    assert "sound flights" in done.output
    counts = json.loads(output.read_text())["models"]
    journal = output.with_suffix(".flights.jsonl")
    lines = journal.read_text().splitlines()
    assert len(lines) == 3
    journal.write_text(lines[0] + "\n")
    again = CliRunner().invoke(app, arguments)  # of the same seed, as it was stopped
    assert again.exit_code == 0, again.output
    assert json.loads(output.read_text()) == {"seed": 5, "models": counts}
    assert CliRunner().invoke(app, [str(tmp_path / "none.onnx"), "-o", str(output)]).exit_code == 2


def test_a_drawn_scene_is_flown_over() -> None:
    _, outcomes = campaign.Task("", 3, campaign.SCENE, "", "", 1).run()
    assert outcomes.counts["sound"]["frames"] == campaign.FLIGHTS_OF_A_SCENE * 12
    assert outcomes.findings == []

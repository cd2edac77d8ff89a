"""States with a history lie in the tracked box, whatever the flight; and they spread nearly as far as it."""

from __future__ import annotations

from pathlib import Path

import compare_limit_over_time as compared
import consistent_states
import known_besides
import numpy as np
import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from runtime import Estimator, Motion, Tracker
from runtime.image import runway_image

SEEN = 4
"""Frames of a flight."""


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short flights, and few states: what is sampled is less, and no less sound."""
    monkeypatch.setattr(known_besides, "FLIGHT_FRAMES", SEEN)
    monkeypatch.setattr(known_besides, "COUNTED", 2)
    monkeypatch.setattr(compared, "TRIES", 2_000)
    monkeypatch.setattr(consistent_states, "STEPS", 400)
    monkeypatch.setattr(consistent_states, "MOST_ROUNDS", 6)


@pytest.mark.parametrize(("budget", "missed"), [(0, 0), (2, 2)])
def test_states_with_a_history_never_leave_the_tracked_box(repository: Path, budget: int, missed: int) -> None:
    """And with a budget and by the motion's bounds alone, where few tries find them, they spread over a quarter of it."""
    estimator = Estimator.load(repository / "models" / "paper.onnx", missed_budget=budget)
    bounds, told = compared.followed_flights(estimator, 1, missed, 0.02, 5, Console(quiet=True))
    assert (bounds.outside, told.outside) == (0, 0)
    assert min(bounds.states, told.states) > 100 * SEEN
    assert len(bounds.band) == len(told.limit) == 2
    for way in (bounds, told):
        assert (np.divide(way.band, way.limit) >= 1).all()
    assert budget == 0 or np.median(np.divide(bounds.band, bounds.limit)) < 4


def test_each_state_has_come_within_the_bounds_from_one_before(repository: Path) -> None:
    """Step by step: allowed by its frame, and no farther than the motion's bounds from some state that was kept."""
    estimator = Estimator.load(repository / "models" / "paper.onnx", missed_budget=2)
    scene, rng = estimator.scene, np.random.default_rng(2)
    histories = compared.Histories(scene, 2, rng)
    motion = Motion(-known_besides.RATES, known_besides.RATES).over(known_besides.FRAME_US)
    prior, before = estimator.domain, None
    for number, (state, _) in enumerate(known_besides.flown(scene, rng)):
        frame = known_besides.seen(estimator, state, 2, 0.02, rng)
        histories.update(frame.view(np.uint8), state, motion if number else None, prior)
        some = histories.states[:: max(1, len(histories.states) // 25)]
        missed = (runway_image(scene, some).astype(bool) & ~frame).sum(axis=(1, 2))
        assert missed.max() <= 2
        if before is not None:
            steps = some[:, None] - before
            hair = 1e-12
            assert ((steps >= motion.lower - hair) & (steps <= motion.upper + hair)).all(axis=2).any(axis=1).all()
        before = histories.states
        prior = estimator.domain.replace(theta=(state[0] - 0.004, state[0] + 0.006))
        if number:
            assert np.ptp(histories.states[:, 0]) <= 0.01 + 2 * known_besides.RATES[0] * known_besides.FRAME_US / 1e6


def test_a_box_that_lacks_a_state_with_a_history_is_found(repository: Path) -> None:
    estimator = Estimator.load(repository / "models" / "paper.onnx", missed_budget=2)
    rng = np.random.default_rng(3)
    state = estimator.scene.domain.uniform(rng, 1)[0]
    frame = known_besides.seen(estimator, state, 0, 0.02, rng).view(np.uint8)
    histories, way = compared.Histories(estimator.scene, 2, rng), compared.Compared("")
    extent = histories.update(frame, state, None, estimator.domain)
    box = Tracker(estimator, Motion(-known_besides.RATES, known_besides.RATES)).update(frame, 0).box
    assert box is not None
    way.add(box, histories, extent, counts=True)
    assert (way.outside, way.states) == (0, len(histories.states))
    narrow = box.replace(theta=(float(box.lower[0]), float(box.centre[0])))
    way.add(narrow, histories, extent, counts=False)
    assert 0 < way.outside < len(histories.states)
    way.add(None, histories, extent, counts=False)
    assert way.outside > len(histories.states)
    assert len(way.band) == 1


def test_the_exact_motion_leaves_less_than_the_last_frame_alone(repository: Path) -> None:
    estimator = Estimator.load(repository / "models" / "paper.onnx", missed_budget=2)
    rng = np.random.default_rng(4)
    states = [state for state, _ in known_besides.flown(estimator.scene, rng)]
    windows = [
        (number * 40_000.0, known_besides.seen(estimator, state, 1, 0.02, rng).view(np.uint8), state) for number, state in enumerate(states)
    ]
    alone, together = (np.array(list(compared.with_exact_motion(estimator, [windows], last, 1)))[0] for last in (1, SEEN))
    assert (together < 1.02 * alone).all()
    assert together.max() > 0


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--missed", "1"], "--missed: found 1, expected at most the budget, 0; raise --missed-budget"),
        (["--recording", "a.raw"], "--recording and --truth: found one without the other; give both, or none"),
        (["--missed-budget", "9999"], "missed_budget"),
    ],
)
def test_options_that_cannot_be_used_are_refused_in_a_line(options: list[str], expected: str) -> None:
    app = typer.Typer()
    app.command()(compared.main)
    done = CliRunner().invoke(app, options)
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert expected in done.stderr

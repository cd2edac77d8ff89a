"""The limit of boxes: pixels are counted as they are drawn, what is sampled is consistent, and the sample is not small."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from rational_image import RationalState, RationalView
from scenes import (
    CUT_BELOW,
    CUT_LEFT,
    CUT_RIGHT,
    FREE_X,
    ONE_CELL,
    PAPER,
    SCENES,
    THREE_MARKINGS,
    UNLIKE_MARKINGS,
    Floats,
    examples,
    states_of,
)
from test_comparisons import script
from typer.testing import CliRunner

from runtime.camera import project
from runtime.image import runway_image
from runtime.scene import Calibration, Marking, Runway, Scene

compare_limit, consistent_states, limit_of_calibration = map(script, ("compare_limit", "consistent_states", "limit_of_calibration"))
OVERLAPPING = replace(PAPER, runway=Runway((Marking("L", 0.0, 0.0, 0.3), Marking("C", 0.002, 0.1, 0.3), Marking("R", -0.001, 0.05, 0.05))))
"""Markings that share many of their pixels, in another order in every row."""
COUNTED = {
    "paper": PAPER,
    "three": THREE_MARKINGS,
    "unlike": UNLIKE_MARKINGS,
    "overlapping": OVERLAPPING,
    "free x": FREE_X,
    "cut left": CUT_LEFT,
    "cut right": CUT_RIGHT,
    "cut below": CUT_BELOW,
}


@pytest.mark.parametrize("scene", COUNTED.values(), ids=COUNTED)
@examples(20)
@given(data=st.data(), seed=st.integers(0, 1000), density=st.sampled_from([0.0, 0.5, 0.97, 1.0]))
def test_missed_pixels_are_those_that_the_image_lights_and_the_frame_does_not(
    scene: Scene, data: st.DataObject, seed: int, density: float
) -> None:
    states = np.array(data.draw(st.lists(states_of(scene), min_size=1, max_size=6)))
    frame = np.random.default_rng(seed).random(scene.camera.shape) < density
    naive = [int((image.astype(bool) & ~frame).sum()) for image in runway_image(scene, states)]
    assert consistent_states.DarkPixels.of(frame).missed(scene, states).tolist() == naive


@pytest.mark.parametrize("scene", [PAPER, FREE_X, ONE_CELL], ids=["paper", "free x", "x fixed at 0.1"])
def test_line_coordinates_give_the_state_back(scene: Scene, random_states: Callable[[Scene, int, int], Floats]) -> None:
    states = random_states(scene, 50, 1)
    line = consistent_states.LineCoordinates.around(scene, states[0])
    np.testing.assert_allclose(line.states(line.of(states)), states, rtol=0, atol=1e-9)
    assert line.of(states)[:, 3] == pytest.approx(project(scene, states)[..., 1].max(axis=(1, 2)), abs=1e-9)


@pytest.fixture(scope="module")
def estimator(repository: Path) -> Any:
    return compare_limit.loaded(repository / "models" / "paper.onnx", 0)


def sampled(scene: Scene, truth: Floats, frame: Any, budget: int) -> tuple[Any, Floats]:
    """The extent of a sample, and its last states."""
    sampler = consistent_states.Sampler(scene, frame.astype(bool), budget, truth, np.random.default_rng(0))
    return sampler.extent(), sampler.states


@pytest.mark.parametrize("missed", [0, 2])
def test_sampled_states_are_consistent_and_reach_the_extent(paper_scene: Scene, missed: int) -> None:
    ((truth, frame),) = compare_limit.frames_with_missed(paper_scene, 1, 0.02, missed, 4)
    extent, states = sampled(paper_scene, truth, frame, 2)
    assert extent.converged
    assert (states.min(axis=0) == extent.lower).all()
    assert (states.max(axis=0) == extent.upper).all()
    domain = paper_scene.domain
    assert ((domain.lower <= states) & (states <= domain.upper)).all()
    assert max(int(((image > 0) & (frame == 0)).sum()) for image in runway_image(paper_scene, states)) == 2


def test_the_sample_is_not_small(estimator: Any) -> None:
    """No box at m = 0 is narrower, and few are wider by a quarter; a larger budget allows more."""
    ratios = []
    for number, (truth, frame) in enumerate(compare_limit.frames_with_missed(estimator.scene, 6, 0.01, 0, 7)):
        result = compare_limit.compare(estimator, truth, frame, 0, [number])
        assert not result.violated
        assert result.extent.converged
        ratios.append(result.ratio[[0, 2, 3]])
        if number == 0:
            wider, _ = sampled(estimator.scene, truth, frame, 2)
            assert (wider.lower <= result.extent.lower).all()
            assert (wider.upper >= result.extent.upper).all()
            assert (wider.half_widths[[0, 2, 3]] > 1.2 * result.extent.half_widths[[0, 2, 3]]).all()
    assert (np.min(ratios, axis=0) >= 1).all()
    assert (np.median(ratios, axis=0) < 1.25).all()


def test_a_start_that_the_frame_contradicts_is_refused(paper_scene: Scene) -> None:
    truth = (paper_scene.domain.lower + paper_scene.domain.upper) / 2
    with pytest.raises(ValueError, match="start"):
        consistent_states.Sampler(paper_scene, np.zeros(paper_scene.camera.shape, bool), 3, truth, np.random.default_rng(0))


def test_frames_miss_as_many_pixels_as_they_shall(paper_scene: Scene) -> None:
    for missed in (0, 3, 10_000):
        for truth, frame in compare_limit.frames_with_missed(paper_scene, 3, 0.05, missed, 2):
            image = runway_image(paper_scene, truth)
            assert int(((image > 0) & (frame == 0)).sum()) == min(missed, int(image.sum()))


def test_a_scene_is_built_for_the_budget(tmp_path: Path) -> None:
    path = compare_limit.built(ONE_CELL, 3, tmp_path)
    assert compare_limit.loaded(path, 3).scene.tolerance.missed_budget == 3


def test_a_model_with_a_tolerance_is_refused(model_of: Callable[[str], Path]) -> None:
    assert SCENES["tolerant"].tolerance.line_px == 1
    with pytest.raises(ValueError, match="line_px"):
        compare_limit.loaded(model_of("tolerant"), 0)


@pytest.fixture
def command() -> typer.Typer:
    app = typer.Typer()
    app.command()(compare_limit.main)
    return app


def test_the_command_prints_the_table_and_writes_a_row_a_frame(repository: Path, tmp_path: Path, command: typer.Typer) -> None:
    output = tmp_path / "limit.csv"
    model = str(repository / "models" / "paper.onnx")
    result = CliRunner().invoke(command, [model, "--frames", "2", "--missed-budget", "2", "--missed", "1", "-o", str(output)])
    assert result.exit_code == 0, result.output
    assert "m = 2, 1 missed" in result.output
    assert "lack a consistent state: 0" in result.output
    with output.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2
    assert all(0 < float(row["limit_theta"]) <= float(row["box_theta"]) for row in rows)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["--missed", "2"], "--missed"), (["--missed-budget", "1000"], "missed_budget"), (["nowhere.toml"], "nowhere.toml")],
    ids=["more missed than the budget", "a budget that the model cannot keep", "no such file"],
)
def test_the_command_refuses_what_it_cannot_compare(repository: Path, command: typer.Typer, arguments: list[str], said: str) -> None:
    model = [] if arguments[0].endswith("toml") else [str(repository / "models" / "paper.onnx")]
    result = CliRunner().invoke(command, [*model, *arguments])
    assert result.exit_code == 2
    assert said in result.stderr
    assert "Traceback" not in result.output


# --- a camera that may be off ---


def test_what_is_sampled_of_a_camera_that_may_be_off_is_lit_and_within_its_bounds() -> None:
    """The frame of the true camera is that of fractions; the states and cameras that are tried spread on all axes."""
    scene = replace(FREE_X, calibration=Calibration(0.0009, 0.0009, 0.001, 0.3))
    bounds, rng = limit_of_calibration.bounds_of(scene.calibration), np.random.default_rng(2)
    state, unknowns = scene.domain.uniform(rng, 1)[0], bounds * [1.0, -1.0, 0.5, -1.0, 1.0]
    frame = limit_of_calibration.image_seen(scene, state, unknowns)
    view = RationalView.of(scene.to_dict())
    zoom = 1 + Fraction(unknowns[2])
    exact = replace(
        view,
        roll=Fraction(np.tan(unknowns[0] / 2)),
        yaw=Fraction(np.tan(unknowns[1] / 2)),
        focal_u=view.focal_u * zoom,
        focal_v=view.focal_v * zoom,
        u0=view.u0 + Fraction(unknowns[3]),
        v0=view.v0 + Fraction(unknowns[4]),
    )
    assert (frame == exact.image(RationalState.near(state)).frame).all()
    sampler = limit_of_calibration.OffSampler(scene, frame, np.concatenate([state, unknowns]), rng)
    for _ in range(6):
        sampler.states = sampler._kept(np.concatenate([sampler.states, sampler._tried()]))
    assert len(sampler.states) > 100
    assert (np.ptp(sampler.states, axis=0) > 0).all()
    assert (np.abs(sampler.states[:, 4:]) <= bounds).all()
    assert all(not (limit_of_calibration.image_seen(scene, each[:4], each[4:]) & ~frame).any() for each in sampler.states[::10])
    with pytest.raises(ValueError, match="start"):
        limit_of_calibration.OffSampler(scene, np.zeros_like(frame), np.concatenate([state, unknowns]), rng)

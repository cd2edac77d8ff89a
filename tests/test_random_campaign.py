"""The campaign over random scenes: its scenes and frames against what they say they are, and its judge against what must not be."""

from __future__ import annotations

import json
import math
import os
import secrets
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

pytest.importorskip("faery", reason="the extra 'recordings' is not installed")

from coverage.states import Rng
from random_scenes import campaign, frame_trial
from random_scenes.extremes import extreme_state
from random_scenes.frames import CLUTTER, ORDERS, STATES, draw_budgets, draw_frame
from random_scenes.models import BuiltScene, build_scene, forget_scenes
from random_scenes.outcomes import Finding, Outcomes
from random_scenes.pitched_state import PitchedState, half_tangent
from random_scenes.scenes import DrawnScene, Plan, Setting, draw_scene
from random_scenes.sights import FOCAL_WIDTHS, HEIGHT_PX, PLACES, WIDTH_PX, UndrawableError, draw_camera, in_view
from random_scenes.trial import Trial
from random_scenes.watch import OutOfTimeError, described, watched
from rational_image import RationalState, RationalView

from runtime import Box, Estimate, Estimator, SceneError
from runtime.scene import Axis, Bank, Camera, Domain, Marking, Runway, Scene, Tolerance

SMALL = Scene(
    Camera(width=96, height=72, focal_length_m=1e-3, pixel_pitch_m=1e-5),
    Runway((Marking("L", -2.0, 0.0, 12.0), Marking("R", 2.0, 0.0, 12.0))),
    Domain(Axis((0.4,), 0.02), Axis((0.0,), 0.0), Axis((4.0,), 0.2), Axis((5.9, 6.1), 0.2)),
    Bank(pitch_bins=1, distance_bins=1, column_px=0.5),
)
PATIENCE_S = 20.0


@pytest.fixture
def rng() -> Rng:
    return np.random.default_rng(12)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> BuiltScene:
    return build_scene(DrawnScene(SMALL, ("small",)), tmp_path_factory.mktemp("small") / "small.onnx", "1/2.3")


def judged(built: BuiltScene, frames: int = 3, patience_s: float = PATIENCE_S) -> Outcomes:
    outcomes = Outcomes()
    Trial(1, 2, frames, patience_s).judge_frames(built, range(frames), outcomes)
    forget_scenes()
    return outcomes


# --- scenes ---


def test_scenes_are_of_every_kind_and_size() -> None:
    drawn: list[DrawnScene] = []
    for number in range(300):
        try:
            drawn.append(draw_scene(np.random.default_rng([3, number])))
        except SceneError:
            continue
    assert len(drawn) > 270
    scenes = [each.scene for each in drawn]
    widths, heights = np.array([[scene.camera.width, scene.camera.height] for scene in scenes]).T
    for sides, (low, high) in ((widths, WIDTH_PX), (heights, HEIGHT_PX)):
        assert low <= sides.min() < 2 * low
        assert high / 1.5 < sides.max() <= high
    zooms = np.array([scene.camera.focal_v_px / scene.camera.width for scene in scenes])
    assert FOCAL_WIDTHS[0] <= zooms.min() < 0.7
    assert 7 < zooms.max() <= FOCAL_WIDTHS[1]
    assert {each.kinds[0] for each in drawn} == set(PLACES)
    assert {len(scene.runway.markings) for scene in scenes} == {1, 2, 3, 4}
    assert {scene.tolerance.line_px for scene in scenes} == {0, 1, 2}
    assert max(scene.domain.cell_count for scene in scenes) == 81
    assert max(np.abs(scene.domain.lower[[1, 3]]).max() for scene in scenes) > 5e4
    for axis in range(4):
        assert {bool(scene.domain.fixed[axis]) for scene in scenes} == {False, True}
    farthest = [scene.runway.ends_z_m.max() + (scene.domain.lower[3] + scene.domain.upper[3]) / 2 for scene in scenes]
    assert 2500 < max(farthest) < 3000.1


PLACED: dict[str, Callable[[np.ndarray, Camera, float], bool]] = {
    "within one row": lambda rows, _camera, _theta: len(np.unique(np.floor(rows))) == 1,
    "within two rows": lambda rows, _camera, _theta: np.floor(rows).max() - np.floor(rows).min() <= 1,
    "horizon in view": lambda _rows, camera, theta: 0 <= camera.v0 - camera.focal_v_px * math.tan(theta) <= camera.height,
    "looking straight down": lambda _rows, _camera, theta: math.pi / 2 - 0.3 <= theta < math.pi / 2,
    "near end far below": lambda rows, _camera, _theta: bool((rows[:, 1] >= 499).all()),
    "near end a million rows below": lambda rows, _camera, _theta: bool((rows[:, 1] >= 4.99e5).all()),
    "far end far above": lambda rows, _camera, _theta: bool((rows[:, 0] <= -999).all()),
}


@pytest.mark.parametrize("place", PLACED)
def test_places_are_what_they_say(place: str, rng: Rng) -> None:
    found = 0
    while found < 40:
        camera = draw_camera(rng)
        try:
            sight = PLACES[place][1](rng, camera, int(rng.integers(1, 5)))
        except UndrawableError:
            continue
        found += 1
        assert PLACED[place](np.array(sight.rows), camera, sight.outlook.theta), sight


def test_a_scene_shows_what_was_drawn(rng: Rng) -> None:
    """The markings that are made of rows and columns are seen there, whatever the shift, by the camera in fractions."""
    shown = 0
    while shown < 20:
        try:
            sight = in_view(rng, draw_camera(rng), 2)
        except UndrawableError:
            continue
        shown += 1
        plan = Plan(np.ones(4), np.ones(4), np.zeros(4), np.ones(4), np.ones(4), 0.5, 0.5)
        scene = Setting.draw(rng, sight).scene(sight, plan, Tolerance())
        segments = RationalView.of(scene.to_dict()).segments(RationalState.near(scene.domain.lower))
        for (near, far), (far_row, near_row) in zip(segments, sight.rows, strict=True):
            assert float(near[1]) == pytest.approx(near_row, rel=1e-5, abs=1e-3)
            assert float(far[1]) == pytest.approx(far_row, rel=1e-5, abs=1e-3)


# --- states and frames ---


def test_a_fixed_pitch_is_held_exactly() -> None:
    for pitch in (0.0, 0.3, -0.7, 1.57):
        state = PitchedState.at(pitch, RationalState(Fraction(5), Fraction(1), Fraction(2), Fraction(3)))
        assert state.floats.tolist() == [pitch, 1, 2, 3]
        assert state.within([pitch, 1, 2, 3], [pitch, 1, 2, 3])
        assert not state.within([np.nextafter(pitch, 2), 1, 2, 3], [2, 1, 2, 3])
        assert not state.within([pitch, 1, 2, 3], [pitch, 1, np.nextafter(2, 0), 3])
        assert replace(state, y=Fraction(7)).floats.tolist() == [pitch, 1, 7, 3]
        assert 2 * math.atan(half_tangent(pitch)) == pytest.approx(pitch, abs=1e-15)
    assert half_tangent(0.3).denominator > 2**100


def test_frames_keep_their_budgets_and_are_of_every_kind(small: BuiltScene) -> None:
    budgets, stage, kinds = draw_budgets(np.random.default_rng(1), small), small.stage, Counter[str]()
    assert (0, -1) in budgets
    assert (small.most_missed, -1) in budgets
    for number in range(150):
        frame = draw_frame(np.random.default_rng([1, number]), small, budgets)
        picture, (missed, extra) = frame.picture, frame.budgets
        assert stage.unwitnessed(stage.view.image(picture.states[0]), picture.frame) <= missed <= small.most_missed
        assert extra == -1 or "theorem B" in frame.kinds
        kinds.update(frame.kinds)
    assert {*STATES, *CLUTTER, *ORDERS, "m = 0", "m > 0", "m = |K| - 1", "theorem B"} <= set(kinds)
    forget_scenes()


def test_extreme_states_are_far_out_and_allowed_by_the_frame(small: BuiltScene, rng: Rng) -> None:
    stage, allowed, farther = small.stage, 0, 0
    for number in range(30):
        frame = draw_frame(np.random.default_rng([2, number]), small, [(0, -1)])
        extreme = extreme_state(rng, frame.picture, 0)
        assert extreme is not None
        assert stage.contains(extreme.state)
        allowed += stage.unwitnessed(stage.view.image(extreme.state), frame.picture.frame) == 0
        moved = extreme.state.floats[extreme.axis] - frame.picture.states[0].floats[extreme.axis]
        assert extreme.sign * moved >= -1e-12
        farther += extreme.sign * moved > 0.02 * (stage.upper - stage.lower)[extreme.axis]
    assert allowed > 25
    assert farther > 15
    forget_scenes()


# --- the judge ---


def test_a_sound_model_gives_no_finding(small: BuiltScene) -> None:
    outcomes = judged(small, 20)
    assert outcomes.findings == []
    counts = outcomes.counts["small"]
    assert counts["judged"] > counts["frames"] == counts["certified"] == 20
    assert counts["narrower"] > 5
    assert counts["reached"] > counts["extremes"] / 4 > 1


def changed(change: Callable[[Estimate], Estimate]) -> Callable[..., Estimate]:
    original = Estimator.estimate

    def estimate(self: Estimator, frame: Any, proposal: Any = None, refine: bool = True) -> Estimate:
        found = original(self, frame, proposal, refine)
        return change(found) if refine else found

    return estimate


def too_narrow(estimate: Estimate) -> Estimate:
    assert estimate.box is not None
    upper = estimate.box.upper - [0, 0, estimate.box.half_widths[2] * 1.2, 0]
    box = Box(estimate.box.lower, upper)
    return replace(estimate, box=box, regions=(box,), state=box.centre)


def without_a_column(estimate: Estimate) -> Estimate:
    filtered = estimate.filtered.copy()
    filtered[:, : filtered.shape[1] // 2] = 0
    return replace(estimate, filtered=filtered)


def endless(_estimate: Estimate | None = None) -> Estimate:
    while True:
        pass


def warned(estimate: Estimate) -> Estimate:
    warnings.warn("of something", RuntimeWarning, stacklevel=1)
    return estimate


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (too_narrow, "refined: a state is not in the box"),
        (lambda estimate: replace(estimate, box=None, regions=(), state=None), "refined: no runway"),
        (without_a_column, "refined: filtered lacks pixels"),
        (endless, "a frame does not end"),
        (warned, "RuntimeWarning in test_random_campaign.py"),
    ],
    ids=["narrow", "none", "filtered", "endless", "warned"],
)
def test_what_must_not_be_is_found(
    change: Callable[[Estimate], Estimate], fault: str, small: BuiltScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Estimator, "estimate", changed(change))
    findings = judged(small, 6, 0.5 if change is endless else PATIENCE_S).findings
    assert {finding.fault for finding in findings} == {fault}
    assert findings[0].place.startswith("1/2.3#")
    if change is endless:
        assert len(findings) == 2
        assert "test_random_campaign.py" in findings[0].detail


def test_a_frame_is_slow_by_the_measure_of_its_scene(small: BuiltScene, rng: Rng) -> None:
    frame = draw_frame(rng, small, [(0, -1)])
    seconds = [0.02] * 7 + [1.9, 2.1]
    trials = [frame_trial.FrameTrial(small, frame, number, seconds=taken) for number, taken in enumerate(seconds)]
    frame_trial.find_slow(trials)
    assert [trial.number for trial in trials if trial.findings] == [8]
    forget_scenes()


def test_what_is_watched_ends_in_time_and_warns_of_nothing() -> None:
    with pytest.raises(OutOfTimeError), watched(0.1):
        endless()
    with pytest.raises(RuntimeWarning, match="a sum") as caught, watched(10):
        warnings.warn("a sum", RuntimeWarning, stacklevel=1)
    assert "test_random_campaign.py" in described(caught.value)


# --- the campaign ---


def run(*arguments: object) -> Any:
    app = typer.Typer()
    app.command()(campaign.main)
    return CliRunner().invoke(app, [*map(str, arguments), "--jobs", "1"])


def test_a_stopped_campaign_goes_on_with_its_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output, kept = tmp_path / "random.json", tmp_path / "random.scenes.jsonl"
    drawn = iter((100, 101))
    monkeypatch.setattr(secrets, "randbelow", lambda _most: next(drawn))
    whole = run("--scenes", 3, "--frames", 7, "-o", output)
    assert whole.exit_code == 0, whole.output
    tables, lines = json.loads(output.read_text()), kept.read_text().splitlines()
    assert len(lines) == 3
    assert sum(counts["frames"] for kind, counts in tables["counts"].items() if kind in PLACES) == 7
    kept.write_text(lines[0] + "\n" + lines[1][:40])
    assert run("--scenes", 3, "--frames", 7, "-o", output).exit_code == 0
    assert json.loads(output.read_text()) == tables
    assert run("--scenes", 1, "--frames", 1, "-o", output).exit_code == 0
    assert (tables["seed"], json.loads(output.read_text())["seed"]) == (100, 101)


def test_a_finding_can_be_seen_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Estimator, "estimate", changed(lambda estimate: replace(estimate, box=None, regions=(), state=None)))
    output = tmp_path / "random.json"
    result = run("--scenes", 1, "--frames", 2, "--seed", 5, "-o", output)
    assert result.exit_code == 1
    place = json.loads(output.read_text())["findings"][0]["place"]
    assert f'--replay "{place}"' in result.output
    again = run("--replay", place, "-o", output)
    assert again.exit_code == 1
    assert f"{place}  refined: no runway" in again.output
    assert np.load(tmp_path / f"replayed-{place.partition('#')[2]}.npy").dtype == np.bool_
    monkeypatch.undo()
    assert run("--replay", place, "-o", output).exit_code == 0
    assert run("--replay", "no such", "-o", output).exit_code == 2


def test_a_scene_that_ends_its_process_is_a_finding_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def count_or_end(self: Trial, _path: Path, outcomes: Outcomes) -> None:
        if self.scene == 1:
            os._exit(3)
        outcomes.refused["drawn"] += self.scene

    monkeypatch.setattr(Trial, "first_built", count_or_end)
    trials = [Trial(9, scene, 1, PATIENCE_S) for scene in range(6)]
    outcomes = dict(campaign.outcomes_of(trials, 2))
    assert {trial.scene: found.refused["drawn"] for trial, found in outcomes.items() if trial.scene != 1} == {0: 0, 2: 2, 3: 3, 4: 4, 5: 5}
    assert [(finding.place, finding.fault) for finding in outcomes[trials[1]].findings] == [("9/1", "the process ends")]


def test_outcomes_are_the_same_after_json() -> None:
    outcomes = Outcomes(refused=Counter(bank=2), findings=[Finding("1/2.0#3", "a fault", "of some kind", ("one", "two"))])
    outcomes.count(("one", "two"), Counter(frames=3))
    assert Outcomes.read(json.loads(json.dumps(outcomes.tables()))) == outcomes

"""The campaign over cameras and attitudes: what it draws against what that says it is, and its judge against what must not be."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

pytest.importorskip("faery", reason="the extra 'recordings' is not installed")

from cameras import campaign
from cameras.attitudes import EXACTLY_KNOWN, KNOWN, MOST_RUNS, runs
from cameras.bases import RANDOM, named_scenes
from cameras.frames import CLUTTER, STATES
from cameras.scenes import ASPECTS, K1, OFF_CENTRE, DrawnCamera, draw_camera
from cameras.trial import CameraFrameTrial, CameraTrial
from coverage.states import estimator_of
from random_scenes.models import BuiltScene, build_scene, forget_scenes
from random_scenes.outcomes import Outcomes
from random_scenes.scenes import DrawnScene
from turned_state import TurnedState, holds

from runtime import Box, Estimate, Estimator, SceneError
from runtime.attitude import mounted
from runtime.scene import AttitudeBounds, Axis, Bank, Calibration, Camera, Distortion, Domain, Marking, Mount, Runway, Scene, Tolerance

PINHOLE = Scene(
    Camera(width=96, height=72, focal_px=(103.0, 100.0), principal_point=(51.0, 33.0), mount=Mount(0.05, 0.3, -0.1)),
    Runway((Marking("L", -2.0, 0.0, 12.0), Marking("R", 2.0, 0.0, 12.0))),
    Domain(Axis((0.4,), 0.02), Axis((0.0,), 0.05), Axis((4.0,), 0.1), Axis((6.0,), 0.1)),
    Bank(pitch_bins=1, distance_bins=1, column_px=0.5),
)
BARREL = Distortion("radial-tangential", (-0.3, 0.1, 0.001, -0.001))
SMALL = {
    "pinhole": PINHOLE,
    "lens": replace(PINHOLE, camera=replace(PINHOLE.camera, distortion=BARREL)),
    "stated": replace(PINHOLE, attitude=AttitudeBounds((0.05, 0.0505), (-0.1, -0.0998))),
    "off": replace(PINHOLE, calibration=Calibration(0.0005, 0.0005, 0.0005, 0.1), tolerance=Tolerance(line_px=1)),
    "lens, off": replace(PINHOLE, camera=replace(PINHOLE.camera, distortion=BARREL), calibration=Calibration(0.0005, 0.0005, 0.0005, 0.1)),
}
PATIENCE_S = 20.0


@pytest.fixture(scope="module", params=SMALL)
def small(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> BuiltScene:
    path = tmp_path_factory.mktemp("small") / f"{request.param}.onnx"
    return build_scene(DrawnScene(SMALL[request.param], (request.param,)), path, "1/2.3")


def judged(built: BuiltScene, frames: int) -> Outcomes:
    outcomes = Outcomes()
    CameraTrial(1, 2, frames, PATIENCE_S).judge_frames(built, range(frames), outcomes)
    forget_scenes()
    return outcomes


# --- what is drawn ---


def test_cameras_are_of_every_kind() -> None:
    drawn: list[DrawnCamera] = []
    for number in range(400):
        try:
            drawn.append(draw_camera(np.random.default_rng([5, number]), PINHOLE))
        except SceneError:
            continue
    cameras = [each.scene.camera for each in drawn]
    aspects = np.array([camera.focal_u_px / camera.focal_v_px for camera in cameras])
    offsets = np.array([[(camera.u0 - 51) / 96, (camera.v0 - 33) / 72] for camera in cameras])
    for values, (low, high) in ((aspects, ASPECTS), (offsets, (-OFF_CENTRE, OFF_CENTRE))):
        assert low <= values.min() < low + (high - low) / 50
        assert high - (high - low) / 50 < values.max() <= high
    k1 = [camera.distortion.coefficients[0] for camera in cameras if camera.distortion and camera.distortion.model != "fisheye"]
    assert K1[0] <= min(k1) < -0.38
    assert 0.18 < max(k1) <= K1[1]
    kinds = Counter(kind for each in drawn for kind in each.kinds)
    expected = {"no lens", "k1 -0.4 to -0.2", "k1 -0.2 to 0", "k1 0 to 0.2", "a fisheye lens", "tangential", "line_px 1", "camera off"}
    assert expected | {"mounted", "[attitude] stated"} <= set(kinds)
    assert {"camera off, no lens", "camera off in roll and yaw", "line_px 2 or more"} <= set(kinds)
    assert min(kinds.values()) >= 5


def test_the_campaigns_own_scenes_are_three_and_random_ones() -> None:
    assert list(named_scenes([])) == ["paper", "strip", "airport", RANDOM]


def test_frames_are_of_every_kind_and_what_is_told_of_them_holds(small: BuiltScene) -> None:
    """The true state is judged, and how often NN_F runs is bounded."""
    kinds, trial = Counter[str](), CameraTrial(3, 4, 0, PATIENCE_S)
    off: list[float] = []
    for number in range(60):
        frame = trial.frame_trial(small, number)
        kinds.update(frame.turned.kinds)
        true, told = frame.turned.sights[0].state, frame.turned.told
        assert runs(frame.estimator, told) <= MOST_RUNS
        assert told.holds(true, frame.estimator)
        if true.seen.floats[0] not in (0.39, 0.41):
            assert any(each.state is true for each in frame.judged())
        if told.attitude is not None:
            roll, _, yaw = (float(angle.mid()) for angle in true.angles)
            assert max(abs(roll), abs(yaw)) < np.radians(10.001)
            off.append(abs(told.attitude.roll_rad - roll) / max(told.attitude.roll_plus_minus_rad, 1e-9))
    stated = small.drawn.kinds == ("stated",)
    wanted = {"as the scene states"} if stated else {*KNOWN, "by the aircraft's reading"}
    assert {*wanted, *CLUTTER, *STATES, "pitch told", "m = 0", "all"} <= set(kinds)
    assert stated or max(off) > 0.9
    forget_scenes()


def test_all_may_be_told_exactly(tmp_path: Path) -> None:
    """Every kind of lens, no calibration, no plus-minus."""
    drawn = [draw_camera(np.random.default_rng([5, number]), PINHOLE, exactly=True) for number in range(60)]
    kinds = {kind for each in drawn for kind in each.kinds}
    assert {"no lens", "a fisheye lens", "k1 -0.4 to -0.2", "mounted"} <= kinds
    assert not {"camera off", "[attitude] stated"} & kinds
    built = build_scene(DrawnScene(SMALL["lens"], ("lens",)), tmp_path / "lens.onnx", "1/2.3")
    trial = CameraTrial(3, 4, 0, PATIENCE_S, exactly=True)
    told = Counter(trial.frame_trial(built, number).turned.told.kinds[0] for number in range(40))
    assert set(told) == set(EXACTLY_KNOWN)
    assert trial.key != replace(trial, exactly=False).key
    forget_scenes()


def test_an_aircrafts_angles_are_those_of_its_mount() -> None:
    """The runtime makes of them an attitude that holds the camera's, exactly told and not."""
    rng = np.random.default_rng(6)
    for _ in range(30):
        state = TurnedState.near(np.array([rng.uniform(-0.2, 0.9), 0.0, 1.0, 1.0]), *rng.uniform(-0.15, 0.15, 2))
        mount = Mount(*rng.uniform(-0.2, 0.2, 3).tolist())
        half = float(rng.choice([1e-13, 0.003]))
        sides = [(float(angle.mid()) - half, float(angle.mid()) + half) for angle in state.aircraft(mount)]
        attitude, theta = mounted(mount, sides[0], sides[1], sides[2])
        for side, angle in zip((attitude.roll, theta, attitude.yaw), state.angles, strict=True):
            assert holds(side[0], angle, side[1])
            assert side[1] - side[0] < 8 * half + 1e-12


# --- the judge ---


def test_a_sound_model_gives_no_finding(small: BuiltScene) -> None:
    outcomes = judged(small, 8)
    assert outcomes.findings == []
    counts = outcomes.counts["all"]
    assert counts["frames"] == 8
    assert counts["judged"] >= counts["certified"] == 8 - counts["refused"] > 3
    assert outcomes.counts[small.drawn.kinds[0]]["scenes"] == 1
    assert counts["refused"] == sum(outcomes.refused.values())
    if small.drawn.kinds != ("lens",):
        assert counts["refused"] == 0


def changed(change: Callable[[Estimate], Estimate]) -> Callable[..., Estimate]:
    original = Estimator.estimate
    return lambda self, frame, **told: change(original(self, frame, **told))


def its_lower_corner(estimate: Estimate) -> Estimate:
    assert estimate.box is not None
    box = Box(estimate.box.lower, estimate.box.lower)
    return replace(estimate, box=box, regions=(box,), state=box.centre)


def without_a_column(estimate: Estimate) -> Estimate:
    filtered = estimate.filtered.copy()
    filtered[:, : filtered.shape[1] // 2] = 0
    return replace(estimate, filtered=filtered)


@pytest.mark.parametrize("small", ["pinhole", "lens", "stated"], indirect=True)
@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (its_lower_corner, "a state is not in the box"),
        (lambda estimate: replace(estimate, box=None, regions=(), state=None), "no runway"),
        (without_a_column, "filtered lacks pixels"),
    ],
    ids=["narrow", "none", "filtered"],
)
def test_what_must_not_be_is_found(
    change: Callable[[Estimate], Estimate], fault: str, small: BuiltScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Estimator, "estimate", changed(change))
    findings = judged(small, 3).findings
    assert {finding.fault.partition(": ")[2] for finding in findings} == {fault}
    assert findings[0].place.startswith("1/2.3#")


def test_a_refusal_is_no_finding(tmp_path: Path) -> None:
    built = build_scene(DrawnScene(SMALL["lens"], ("lens",)), tmp_path / "lens.onnx", "1/2.3")
    trial = CameraTrial(1, 2, 0, PATIENCE_S).frame_trial(built, 0)
    assert isinstance(trial, CameraFrameTrial)
    trial.find("ValueError in estimator.py", "ValueError: attitude: found missed_budget 12 behind a lens; load the model with 0")
    trial.find("ValueError in estimator.py", "ValueError: another")
    assert trial.refusals == ["attitude: missed_budget behind a lens"]
    assert [finding.fault for finding in trial.findings] == ["ValueError in estimator.py"]
    forget_scenes()


# --- the campaign ---


def run(*arguments: object) -> Any:
    app = typer.Typer()
    app.command()(campaign.main)
    return CliRunner().invoke(app, [*map(str, arguments), "--jobs", "1"])


SCENE_FILE = """
[camera]
width = 96
height = 72
focal_px = [100.0, 100.0]

[[runway.markings]]
name = "L"
x_m = -2.0
start_z_m = 0.0
length_m = 12.0

[domain]
theta_rad = { centres = [0.4], width = 0.02 }
x_m = { centres = [0.0], width = 0.0 }
y_m = { centres = [4.0], width = 0.2 }
z_m = { centres = [6.0], width = 0.2 }

[bank]
pitch_bins = 1
distance_bins = 1
column_px = 0.5
"""


def test_a_stopped_campaign_goes_on_and_a_finding_can_be_seen_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, output, kept = tmp_path / "small.toml", tmp_path / "cameras.json", tmp_path / "cameras.scenes.jsonl"
    scene.write_text(SCENE_FILE)
    arguments = "--scene", scene, "--seed", 8, "-o", output
    two = "--cameras", 2, "--frames", 4, *arguments
    whole = run(*two)
    assert whole.exit_code == 0, whole.output
    tables, lines = json.loads(output.read_text()), kept.read_text().splitlines()
    assert tables["counts"]["all"]["frames"] == tables["counts"]["small"]["frames"] == 4
    assert "m = 0" in whole.output
    kept.write_text(lines[0] + "\n" + lines[1][:40])
    assert run(*two).exit_code == 0
    assert json.loads(output.read_text()) == tables
    monkeypatch.setattr(Estimator, "estimate", changed(lambda estimate: replace(estimate, box=None, regions=(), state=None)))
    assert run("--cameras", 1, "--frames", 1, *arguments).exit_code == 1
    place = json.loads(output.read_text())["findings"][0]["place"]
    again = run("--replay", place, "--scene", scene, "-o", output)
    assert again.exit_code == 1
    assert f"{place}  refined: no runway" in again.output
    monkeypatch.undo()
    assert run("--replay", place, "--scene", scene, "-o", output).exit_code == 0


def test_a_scene_file_that_is_none_is_told(tmp_path: Path) -> None:
    result = run("--scene", tmp_path / "none.toml", "-o", tmp_path / "cameras.json")
    assert result.exit_code == 2
    forget_scenes()
    assert estimator_of.cache_info().currsize == 0

"""Frames of a camera with roll and yaw: painted outward, read on the sensor's own pixels, and certified; judged in rational numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from compare_limit import constant_network
from rational_image import RationalState, RationalView
from scenes import AIRPORT, CUT_LEFT, FREE_X, ONE_CELL, PAPER, STRIP
from turned_state import TurnedState

from build_model.export import export_model
from build_model.user_network import NO_ESTIMATOR
from runtime import Attitude, Box, Estimator, Motion, Outcome, Scene, Tracker
from runtime.attitude import Turns
from runtime.on_sensor import grouped
from runtime.painting import Painted
from runtime.scene import AttitudeBounds, Axis, Camera, Distortion
from runtime.sensor import Sensor
from runtime.turned import Bin, bins_of, joined, met_by_one, turned_map

EstimatorOf = Callable[..., Estimator]
SCALES = {"paper": PAPER, "strip": STRIP, "airport": AIRPORT}
MIDDLE = (PAPER.domain.lower + PAPER.domain.upper) / 2
FREE = [0, 2, 3]
TEN_DEGREES = math.radians(10)


def estimator(name: str, folder: Path, paper: Estimator, missed_budget: int = 0) -> Estimator:
    """A model of that scale."""
    if name == "paper":
        return paper if missed_budget == 0 else Estimator.load(missed_budget=missed_budget)
    path = folder / f"{name}.onnx"
    if not path.exists():
        export_model(SCALES[name], path, estimator=constant_network(SCALES[name].camera.shape, folder / "constant.onnx"))
    return Estimator.load(path, missed_budget=missed_budget)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scales")


@pytest.fixture(scope="module")
def paper() -> Estimator:
    return Estimator.load()


def drawn(scene: Scene, rng: np.random.Generator, largest: float = TEN_DEGREES) -> TurnedState:
    """A state of the domain, turned by up to `largest`."""
    lower, upper = scene.domain.lower, scene.domain.upper
    return TurnedState.near(lower + rng.uniform(0.01, 0.99, 4) * (upper - lower), *rng.uniform(-largest, largest, 2))


def image(scene: Scene, state: TurnedState) -> np.ndarray:
    return state.view(scene).image(state.seen).frame.copy()


def painted(scene: Scene, frame: np.ndarray, turns: Turns) -> np.ndarray:
    """What is painted of a frame."""
    sensor = Sensor.of(scene)
    return Painted.of(frame, turned_map(sensor, turns), sensor.outline).ideal


# --- painting ---


@pytest.mark.parametrize("scene", [PAPER, STRIP, AIRPORT, CUT_LEFT], ids=["paper", "strip", "airport", "cut left"])
def test_no_pixel_of_the_runway_is_lost_in_painting(scene: Scene) -> None:
    """Every pixel that the ideal frame shows of the runway is painted, whichever of the rotations is the true one; and few others are."""
    rng = np.random.default_rng(1)
    for number in range(6):
        state, plus_minus = drawn(scene, rng), rng.choice([0.0, 0.002], 2)
        attitude = state.attitude(rng, *plus_minus)
        c = float(state.seen.floats[0])
        turns = Bin(np.array([[c - 1e-12, c + 1e-12]]), np.array([attitude.roll]), np.array([attitude.yaw])).turns
        ideal = RationalView.of(scene.to_dict()).image(state.seen).frame
        canvas = painted(scene, image(scene, state), turns).view(bool)
        assert not (ideal & ~canvas).any(), number
        unseen = painted(scene, np.zeros(scene.camera.shape, dtype=bool), turns).view(bool)
        if not plus_minus.any():
            assert (canvas & ~unseen).sum() <= 4 * ideal.sum() + 9


def test_a_missed_pixel_spoils_no_more_of_the_ideal_image_than_is_budgeted() -> None:
    rng = np.random.default_rng(2)
    for _ in range(12):
        state = drawn(PAPER, rng)
        attitude = state.attitude(rng)
        c = float(state.seen.floats[0])
        turns = Bin(np.array([[c, c]]), np.array([attitude.roll]), np.array([attitude.yaw])).turns
        ideal, seen = RationalView.of(PAPER.to_dict()).image(state.seen).frame, image(PAPER, state)
        for dark in rng.choice(np.flatnonzero(seen), 3, replace=False):
            frame = seen.copy()
            frame.ravel()[dark] = False
            assert (ideal & ~painted(PAPER, frame, turns).view(bool)).sum() <= met_by_one(PAPER, turns) <= 9


def test_bins_cover_the_attitude() -> None:
    attitude = Attitude(0.01, -0.05, 0.003, 0.004)
    bins = list(bins_of(PAPER.camera, attitude, (0.45, 0.75)))
    assert len(bins) > 4
    rng = np.random.default_rng(0)
    for pitch, roll, yaw in zip(rng.uniform(0.45, 0.75, 50), rng.uniform(*attitude.roll, 50), rng.uniform(*attitude.yaw, 50), strict=True):
        values = {"pitch": pitch, "roll": roll, "yaw": yaw}
        assert any(all(getattr(each, name)[0, 0] <= value <= getattr(each, name)[0, 1] for name, value in values.items()) for each in bins)
    assert len(list(bins_of(PAPER.camera, Attitude(0, 0), (0.45, 0.75)))) == 1


def test_hulls_of_entries_hold_them(estimator_of: EstimatorOf) -> None:
    free = estimator_of("free x")
    rng = np.random.default_rng(3)
    state = drawn(FREE_X, rng, 0.05)
    found = free.find(image(FREE_X, state), state.attitude(rng, 0.004, 0.004))
    assert found.turned is not None
    whole = joined(*found.turned.parts)
    level = replace(whole, theta=np.zeros_like(whole.theta))  # where the domain has one pitch alone
    for entries in (whole, level):
        few = grouped(entries, 20)
        assert len(few) < len(entries)
        for name in ("theta", "x", "y", "z", "roll", "yaw"):
            own, other = getattr(few, name), getattr(entries, name)
            held = (own[:, None, 0] <= other[:, 0]) & (other[:, 1] <= own[:, None, 1])
            assert held.any(axis=0).all()


# --- certificates ---


@pytest.mark.parametrize("missed_budget", [0, 2])
@pytest.mark.parametrize("name", SCALES)
def test_the_box_holds_the_state_at_every_scale(name: str, missed_budget: int, folder: Path, paper: Estimator) -> None:
    model, rng = estimator(name, folder, paper, missed_budget), np.random.default_rng([4, missed_budget])
    for number in range(5 if name == "paper" else 2):
        state = drawn(model.scene, rng)
        frame, plus_minus = image(model.scene, state), rng.choice([0.0, 0.0005, 0.002], 2)
        lit = np.flatnonzero(frame)
        frame.ravel()[rng.choice(lit, min(missed_budget, len(lit)), replace=False)] = False
        frame |= rng.random(frame.shape) < rng.choice([0.0, 0.02])
        theta = float(state.angles[1].mid())
        known = (None, model.domain.replace(theta=(theta - 0.002, theta + 0.001)))[number % 2]
        estimate = model.estimate(frame, prior=known, attitude=state.attitude(rng, *plus_minus), refine=number > 0)
        assert estimate.certified, (number, state)
        assert estimate.box is not None
        assert state.within(estimate.box.lower, estimate.box.upper), (number, state)


@pytest.mark.parametrize("lens", [None, Distortion("radial-tangential", (-0.3, 0.1, 0.0, 0.0))], ids=["pinhole", "barrel"])
def test_filtered_is_the_sensors_and_keeps_the_runway(lens: Distortion | None, folder: Path) -> None:
    """Every lit pixel of it, also where the turn brings it beyond the ideal frame; and little of the clutter where it does not."""
    for name, u0 in (("whole", 320.0), ("cut", 45.5)):
        camera = Camera(640, 480, focal_px=(533.0, 533.0), principal_point=(u0, 240.0), distortion=lens)
        scene, path = replace(ONE_CELL, camera=camera), folder / f"filtered-{name}-{lens is None}.onnx"
        scene = replace(scene, domain=replace(scene.domain, x_m=Axis((0.092,), 0.0)))  # no marking on a border of columns
        export_model(scene, path, estimator=NO_ESTIMATOR)
        model, rng = Estimator.load(path), np.random.default_rng(11)
        for _ in range(3):
            state = drawn(scene, rng)
            runway = image(scene, state)
            frame = runway | (rng.random(runway.shape) < 0.01)
            filtered = model.estimate(frame, attitude=state.attitude(rng), refine=False).filtered.view(bool)
            assert filtered.shape == frame.shape
            assert not (filtered & ~frame).any()
            assert not (runway & ~filtered).any()
            if not model.sensor.runway_beyond:
                assert (filtered & ~runway).sum() < 0.3 * (frame & ~runway).sum()
        assert model.sensor.runway_beyond is (name == "cut")


def test_a_known_attitude_costs_a_tenth(estimator_of: EstimatorOf) -> None:
    """With x free, so that the shift of the runway by the yaw does not tell the pitch; beside the level camera's boxes."""
    free, rng, ratios = estimator_of("free x"), np.random.default_rng(5), []
    for _ in range(12):
        state = drawn(FREE_X, rng, math.radians(3))
        turned = free.estimate(image(FREE_X, state), attitude=state.attitude(rng)).box
        level = free.estimate(RationalView.of(FREE_X.to_dict()).image(state.seen).frame.copy()).box
        assert turned is not None
        assert level is not None
        ratios.append(turned.half_widths[FREE] / level.half_widths[FREE])
    assert (np.median(ratios, axis=0) < 1.2).all()


def test_a_level_camera_may_say_so(paper: Estimator) -> None:
    """The box is about the one without an attitude, and the certificate says what it rests on instead."""
    frame = RationalView.of(PAPER.to_dict()).image(RationalState.near(MIDDLE)).frame.copy()
    level, told = paper.estimate(frame), paper.estimate(frame, attitude=Attitude(0.0, 0.0))
    assert level.box is not None
    assert told.box is not None
    assert (told.box.half_widths <= 1.3 * level.box.half_widths).all()
    assert level.assumed[1].startswith("No roll or yaw")
    assert told.assumed[1].startswith("The camera has a roll 0 rad +-0, yaw 0 rad +-0")
    assert told.assumed[0].endswith("in the place of theta.")
    assert told.assumed[2:] == level.assumed[2:]


def test_wrong_attitudes_and_empty_frames(paper: Estimator) -> None:
    rng = np.random.default_rng(6)
    state = TurnedState.near(MIDDLE, 0.05, -0.05)
    frame, attitude = image(PAPER, state), state.attitude(rng)
    nothing = np.zeros(PAPER.camera.shape, dtype=bool)
    assert paper.estimate(nothing, attitude=attitude).outcome is Outcome.NO_RUNWAY
    assert paper.estimate(frame, attitude=Attitude(-0.3, 0.2)).outcome is Outcome.NO_RUNWAY
    with pytest.raises(TypeError, match="attitude: found tuple; give an Attitude"):
        paper.estimate(frame, attitude=(0.05, -0.05))  # pyright: ignore[reportArgumentType]
    far = paper.domain.replace(theta=(0.72, 0.74))
    assert paper.estimate(frame, attitude=attitude, prior=far).outcome is Outcome.INCONSISTENT
    anything = Box(PAPER.domain.lower - 10, PAPER.domain.upper + 10)
    told, alone = paper.estimate(frame, attitude=attitude, prior=anything).box, paper.estimate(frame, attitude=attitude).box
    assert told is not None
    assert alone is not None
    assert (told.lower == alone.lower).all()
    assert (told.upper == alone.upper).all()
    outside = Box(PAPER.domain.lower - 1, PAPER.domain.lower - 0.5)
    assert paper.estimate(frame, attitude=attitude, prior=outside).outcome is Outcome.INCONSISTENT


def test_faces_of_the_domain_are_those_of_the_pitch_that_is_seen(paper: Estimator) -> None:
    rng, lower = np.random.default_rng(7), PAPER.domain.lower
    state = TurnedState.near(np.array([lower[0] + 1e-6, 0.0, 0.9, 1.7]), 0.0, -0.15)
    estimate = paper.estimate(image(PAPER, state), attitude=state.attitude(rng))
    assert estimate.touches_boundary
    assert estimate.box is not None
    assert estimate.box.lower[0] < lower[0] - 1e-4  # the camera's own pitch is another one
    assert state.within(estimate.box.lower, estimate.box.upper)


# --- over time ---


@pytest.mark.parametrize("settings", [{}, {"horizon": 3}, {"horizon": 4, "outliers": 1}], ids=str)
def test_a_tracked_box_holds_the_state_while_the_camera_turns(settings: dict[str, int], paper: Estimator) -> None:
    rng, rate = np.random.default_rng(8), np.array([0.05, 0.0, 0.05, 0.05])
    tracker, seen = Tracker(paper, Motion(-rate - 0.002, rate + 0.002), **settings), MIDDLE.copy()
    narrower = []
    for number in range(5):
        state = TurnedState.near(seen, 0.03 + 0.01 * number, -0.08 + 0.001 * number)
        frame, attitude = image(PAPER, state), state.attitude(rng, 0.0005, 0.0005)
        followed = tracker.update(frame, number * 40_000, attitude=attitude)
        assert followed.box is not None or settings.get("outliers")
        if followed.box is not None:
            assert state.within(followed.box.lower, followed.box.upper)
            alone = paper.estimate(frame, attitude=attitude).box
            assert alone is not None
            narrower.append(followed.box.half_widths[FREE] / alone.half_widths[FREE])
        seen = seen + np.array([0.03, 0.0, -0.04, -0.04]) * 0.04
    assert np.median(narrower[2:], axis=0).max() < (1.5 if settings else 1.0)
    assert "roll" in tracker.update(frame, 160_000, attitude=attitude).assumed[1]


# --- bounds of the scene ---


def test_a_scenes_bounds_on_roll_and_yaw_are_taken_where_nothing_is_told(folder: Path) -> None:
    bounds = AttitudeBounds((-0.004, 0.004), (-0.003, 0.003))
    scene = replace(ONE_CELL, attitude=bounds)
    path = folder / "bounds.onnx"
    export_model(scene, path, estimator=constant_network(scene.camera.shape, folder / "constant.onnx"))
    model, rng = Estimator.load(path), np.random.default_rng(9)
    assert model.scene.attitude == bounds
    assert model.assumed[1].startswith("Roll within -0.004 and 0.004 rad, yaw within -0.003 and 0.003 rad, and the camera")
    tracker = Tracker(model, Motion(-0.01 * np.ones(4), 0.01 * np.ones(4)))
    for number in range(3):
        state = drawn(scene, rng, 0.002)
        frame = image(scene, state)
        box = model.estimate(frame).box
        assert box is not None
        assert state.within(box.lower, box.upper)
        narrower = model.estimate(frame, attitude=state.attitude(rng)).box
        assert narrower is not None
        assert (narrower.half_widths <= box.half_widths + 1e-9).all()
        followed = tracker.update(frame, number * 1e9)
        assert followed.box is not None
        assert state.within(followed.box.lower, followed.box.upper)
        assert "painted frames" in followed.assumed[1]

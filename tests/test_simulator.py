"""The simulated event camera: geometry against the camera model, pixels against a loop over time, and what it is for."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="the extra 'recordings' is not installed")
pytest.importorskip("typer", reason="the extra 'recordings' is not installed")

import derive_field
import simulate_approach as simulator
from attitude_reference import attitude_text
from rich.console import Console
from scenes import AIRPORT, PAPER
from test_lens import WIDE
from test_sensor_map import seen_through

from build_model.calibration import check_calibration
from build_model.window import Window
from runtime.camera import project, project_points
from runtime.explanation import missed_pixels
from runtime.frames import FrameStream
from runtime.image import dilated, runway_image
from runtime.recordings.attitude import AttitudeReadings
from runtime.recordings.recording import read_events
from runtime.scene import Calibration, Domain, Scene, Tolerance
from runtime.sensor_map import SensorMap

STEADY = simulator.Vibration(yaw_rad=0.0, roll_rad=0.0, pitch_rad=0.0)
EXACT_TIMES = simulator.Sensor(noise_rate_hz=0.0, latency_us=0.0, latency_jitter_us=0.0)
FOCAL_PX = 8e-3 / 15e-6


def flight_of(scene: Scene, vibration: simulator.Vibration, seconds: float = 1.0) -> simulator.Flight:
    return simulator.Flight(scene, 10.0, seconds, vibration, np.random.default_rng(1))


def test_pixels_of_the_markings_ends_are_taken_to_the_ground_where_the_ends_are(paper_scene):
    flight = flight_of(paper_scene, STEADY)
    times = np.linspace(0, 1e6, 7)
    ends = project(paper_scene, flight.states(times)).reshape(7, -1, 2)
    views = flight.views(times)
    on_ground = views.to_ground @ np.concatenate([ends, np.ones((*ends.shape[:-1], 1))], axis=-1).swapaxes(1, 2)
    expected = [[marking.x_m, z_m] for marking in paper_scene.runway.markings for z_m in marking.ends_z_m]
    np.testing.assert_allclose((on_ground[:, :2] / on_ground[:, 2:]).swapaxes(1, 2), np.broadcast_to(expected, (7, 4, 2)), atol=1e-9)
    np.testing.assert_allclose(views.altitude_m, flight.states(times)[:, 2])


def test_the_vibrations_calibration_bounds_every_shift_of_the_markings_and_is_nearly_reached(paper_scene):
    vibration = simulator.Vibration(calmest=1.0)
    steady, shaken = (flight_of(paper_scene, kind) for kind in (STEADY, vibration))
    times = np.linspace(0, 1e6, 2000)
    points = project(paper_scene, steady.states(times)).reshape(2000, -1, 2)
    homogeneous = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1).swapaxes(1, 2)
    seen = np.linalg.solve(shaken.views(times).to_ground, steady.views(times).to_ground @ homogeneous)
    shift = np.abs((seen[:, :2] / seen[:, 2:]).swapaxes(1, 2) - points)
    scene = replace(paper_scene, calibration=vibration.calibration(FOCAL_PX), tolerance=Tolerance(line_px=2))
    first, last = np.floor(points.min(axis=(0, 1))).astype(int), np.ceil(points.max(axis=(0, 1))).astype(int)
    bound = check_calibration(scene, Window(first[1], last[1], first[0], last[0]))
    assert shift.max() <= bound
    assert shift.max() > 0.5 * bound


def test_a_pixel_on_a_stripe_receives_the_stripes_light_and_one_beside_it_the_grounds(paper_scene):
    target = simulator.Target(texture_spread=0.0, patch_share=0.0, stripe_width_m=0.02)
    ground = simulator.Ground(paper_scene, target, np.random.default_rng(0))
    flight = flight_of(paper_scene, STEADY)
    start = np.zeros(1)
    middles = np.asarray(project(paper_scene, flight.states(start))[0].mean(axis=1), dtype=np.float64)
    light = ground.log_light(middles[:, 0], middles[:, 1], flight.views(start))
    np.testing.assert_allclose(light, 0, atol=1e-4)
    beside = ground.log_light(middles[:, 0] + 10, middles[:, 1], flight.views(start))
    np.testing.assert_allclose(beside, math.log(target.ground_reflectance), atol=1e-4)


def test_a_row_across_a_stripe_receives_the_stripes_whole_width(paper_scene):
    target = simulator.Target(texture_spread=0.0, patch_share=0.0)
    ground = simulator.Ground(paper_scene, target, np.random.default_rng(0))
    flight = flight_of(paper_scene, STEADY)
    view = flight.views(np.zeros(1))
    row = float(np.floor(project(paper_scene, flight.states(np.zeros(1)))[0, 0, :, 1].mean())) + 0.5
    columns = np.arange(640, dtype=np.float64) + 0.5
    light = np.exp(ground.log_light(columns, np.full(640, row, dtype=np.float64), view)[0])
    covered = ((light - target.ground_reflectance) / (1 - target.ground_reflectance)).sum()
    fall = view.to_ground[0, 2] @ [320, row, 1]
    assert covered == pytest.approx(2 * target.stripe_width_m * FOCAL_PX * fall / view.altitude_m[0], rel=1e-3)


def events_of_pixel(camera: simulator.EventCamera, pixel: int, end_us: int) -> list[tuple[int, int]]:
    """Times and polarities of a pixel that is sampled all the time: the sensor's rules, one sample after the other."""
    times = np.arange(0, end_us + simulator.STEP_US, simulator.STEP_US, dtype=np.float64)
    views = camera.flight.views(times)
    light = camera.ground.log_light(camera._u[pixel : pixel + 1], camera._v[pixel : pixel + 1], views)[:, 0]
    level, blind_until, threshold, events = light[0], -math.inf, camera._threshold[pixel], []
    for before, now, time in zip(light[:-1], light[1:], times[:-1], strict=True):
        if blind_until > time:
            level = before
            continue
        if abs(now - level) >= threshold:
            crossed = level + math.copysign(threshold, now - level)
            share = min(max((crossed - before) / (now - before), 0), 1) if now != before else 0.0
            events.append((time + share * simulator.STEP_US, int(now > level)))
            blind_until, level = events[-1][0] + camera.sensor.refractory_us, now
    return events


def test_a_pixel_fires_as_one_that_is_sampled_all_the_time(paper_scene):
    camera = simulator.event_camera(paper_scene, 20.0, 0.4, 3, sensor=EXACT_TIMES)
    twin = simulator.event_camera(paper_scene, 20.0, 0.4, 3, sensor=EXACT_TIMES)
    events = np.concatenate(list(camera.blocks()))
    pixels = events["y"].astype(int) * 640 + events["x"]
    # Where footprints exceed the texture's grain the choice of pixels to sample may leave some out.
    view = camera.flight.views(np.zeros(1))
    fall = view.to_ground[0, 2, 1] * camera._v + view.to_ground[0, 2, 2]
    sharp = np.flatnonzero(view.altitude_m[0] / (FOCAL_PX * np.maximum(fall, 0.01) ** 2) < simulator.TEXTURE_GRAIN_M)
    drawn = np.random.default_rng(0)
    quiet = np.setdiff1d(np.flatnonzero(twin._alive), pixels)
    chosen = [*drawn.choice(np.intersect1d(pixels, sharp), 60, replace=False), *drawn.choice(np.intersect1d(quiet, sharp), 30)]
    for pixel in chosen:
        own = events[pixels == pixel]
        expected = events_of_pixel(twin, int(pixel), camera.flight.duration_us)
        assert len(own) == len(expected)
        np.testing.assert_allclose(own["t"], [time for time, _ in expected], atol=2)
        assert own["p"].tolist() == [polarity for _, polarity in expected]


def test_events_are_sorted_repeatable_and_on_the_sensor(paper_scene):
    runs = [list(simulator.event_camera(paper_scene, 5.0, 0.2, seed).blocks()) for seed in (1, 1, 2)]
    first, again, other = (np.concatenate(packets) for packets in runs)
    np.testing.assert_array_equal(first, again)
    assert len(other) != len(first) or (other != first).any()
    assert [len(packets) for packets in runs] == [3, 3, 3]
    assert np.all(np.diff(first["t"]) >= 0)
    assert (first["t"] >= 0).all()
    assert (first["t"] < 200_000).all()
    assert (first["x"] < 640).all()
    assert (first["y"] < 480).all()


def test_noise_comes_at_its_rate_and_never_from_dead_pixels(paper_scene):
    target = simulator.Target(texture_spread=0.0, patch_share=0.0, ground_reflectance=1.0)
    sensor = simulator.Sensor(noise_rate_hz=2.0, dead_share=0.3)
    camera = simulator.event_camera(paper_scene, 0.0, 0.4, 4, target=target, sensor=sensor)
    events = np.concatenate(list(camera.blocks()))
    alive = np.count_nonzero(camera._alive)
    expected = 2.0 * 0.4 * alive
    assert alive == pytest.approx(0.7 * 640 * 480, rel=0.01)
    assert len(events) == pytest.approx(expected, abs=6 * math.sqrt(expected))
    assert camera._alive[events["y"].astype(int) * 640 + events["x"]].all()


def test_lines_are_thicker_than_a_pixel_and_some_of_their_pixels_fail_to_fire(paper_scene):
    camera = simulator.event_camera(paper_scene, 22.0, 1.0, 6)
    frames = list(FrameStream(paper_scene.camera.shape, simulator.WINDOW_US).frames(camera.blocks()))
    instants, states = simulator.window_truths(camera.flight, frames[0][0])
    assert [start + 20_000 for start, _ in frames] == instants.tolist()
    images = [runway_image(paper_scene, state) != 0 for state in states]
    thickness = [frame[dilated(image, 3)].sum() / image.sum() for (_, frame), image in zip(frames, images, strict=True)]
    assert 2 < np.median(thickness) < 4
    missed = np.array([np.count_nonzero(image & (frame == 0)) for (_, frame), image in zip(frames, images, strict=True)])
    assert np.mean(missed > 0) > 0.2
    assert np.median(missed) < 5
    assert 0.003 < np.median([frame.mean() for _, frame in frames]) < 0.05


def test_the_files_hold_the_same_events_and_the_truth_of_every_window(paper_scene, tmp_path):
    simulator.simulate(simulator.event_camera(paper_scene, 3.0, 0.2, 5), 5, tmp_path, Console(quiet=True))
    events = np.concatenate(list(simulator.event_camera(paper_scene, 3.0, 0.2, 5).blocks()))
    for name in ("approach.raw", "approach.npz"):
        read = np.concatenate(list(read_events(tmp_path / name, (480, 640))))
        np.testing.assert_array_equal(np.sort(read, order=["t", "y", "x", "p"]), np.sort(events, order=["t", "y", "x", "p"]))
    with (tmp_path / "truth.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time_us", "theta_rad", "x_m", "y_m", "z_m"]
    frames = list(FrameStream((480, 640), 40_000).frames([events]))
    assert [int(row[0]) for row in rows[1:]] == [start + 20_000 for start, _ in frames]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["approach.npz", "approach.raw", "attitude.csv", "truth.csv"]


def test_a_part_beyond_the_approach_is_refused(paper_scene):
    with pytest.raises(ValueError, match="stay within the approach's"):
        simulator.event_camera(paper_scene, 50.0, 3.0, 0)


# --- models/field.toml ---


def test_a_budget_is_bearable_if_every_entry_has_more_pixels(repository: Path):
    field = Scene.load(repository / "models" / "field.toml")
    axes = [replace(axis, centres=axis.centres[:1]) for axis in field.domain.axes]
    one_cell = replace(field, domain=Domain(*axes))
    strong, weak, hopeless = (smallest for _, smallest in derive_field.bearable(one_cell, [0, 3, 10_000]))
    assert strong is not None
    assert weak is not None
    assert weak > 3
    assert hopeless is None


def test_a_stripe_is_two_markings_about_its_middle_or_the_middle_alone(paper_scene):
    two, one = derive_field.field_scene(paper_scene, 0.003), derive_field.field_scene(paper_scene, 0.0)
    np.testing.assert_allclose(two.runway.x_m, [-0.103, -0.097, 0.097, 0.103])
    np.testing.assert_allclose(one.runway.x_m, [-0.1, 0.1])
    np.testing.assert_allclose(two.runway.ends_z_m, np.broadcast_to([0.004, 0.296], (4, 2)))
    assert replace(two, runway=paper_scene.runway, bank=paper_scene.bank) == paper_scene


def test_missed_pixels_of_a_flight_are_those_counted_one_window_at_a_time(paper_scene):
    placed = [derive_field.field_scene(paper_scene, distance) for distance in (0.0, 0.0025)]
    missed = derive_field.missed_of_flight(paper_scene, placed, 6, 0.2, Console(quiet=True))
    camera = simulator.event_camera(paper_scene, 0.0, 0.2, 6)
    frames = list(FrameStream((480, 640), 40_000).frames(camera.blocks()))
    _, states = simulator.window_truths(camera.flight, frames[0][0])
    expected = [
        [[missed_pixels(scene, frame, state, t) for t in derive_field.TOLERANCES_PX] for scene in placed]
        for (_, frame), state in zip(frames, states, strict=True)
    ]
    np.testing.assert_array_equal(missed, expected)
    assert missed.max() > 0


def test_field_toml_is_the_papers_scene_with_markings_and_budget_of_its_own(paper_scene, repository: Path):
    field = Scene.load(repository / "models" / "field.toml")
    assert replace(field, runway=paper_scene.runway, tolerance=paper_scene.tolerance, bank=paper_scene.bank) == paper_scene
    distances = [derive_field.field_scene(paper_scene, simulator.Target().stripe_width_m / 2 + d) for d in derive_field.BESIDE_EDGES_M]
    assert field in [replace(scene, tolerance=field.tolerance) for scene in distances]


def test_a_scene_is_read_as_it_was_written(paper_scene, tmp_path: Path):
    off = Calibration(yaw_rad=1e-4, principal_px=0.25)
    for scene in (paper_scene, replace(paper_scene, calibration=off, tolerance=Tolerance(line_px=1, missed_budget=2))):
        (tmp_path / "again.toml").write_text(derive_field.scene_text(scene, "how\nit came about"))
        assert Scene.load(tmp_path / "again.toml") == scene


def test_most_windows_of_another_flight_keep_the_fields_budget(paper_scene, repository: Path):
    field = Scene.load(repository / "models" / "field.toml")
    camera = simulator.event_camera(paper_scene, 20.0, 0.8, 8)
    frames = list(FrameStream((480, 640), 40_000).frames(camera.blocks()))
    _, states = simulator.window_truths(camera.flight, frames[0][0])
    counted = [missed_pixels(field, frame, state, field.tolerance.line_px) for (_, frame), state in zip(frames, states, strict=True)]
    assert np.mean(np.array(counted) <= field.tolerance.missed_budget) >= 0.8


# --- long runways ---


def test_a_runway_of_kilometres_is_drawn_to_its_far_end():
    """Flatter than a fiftieth, too: the middle of a marking has the stripe's light, and what is beside it the ground's."""
    flight = flight_of(AIRPORT, STEADY)
    start = np.zeros(1)
    target = simulator.Target(stripe_width_m=0.9, texture_spread=0.0, patch_share=0.0)
    ground = simulator.Ground(AIRPORT, target, np.random.default_rng(0))
    state = flight.states(start)[0]
    along = np.linspace(10, 2400, 30)
    for x_m, lit in ((AIRPORT.runway.x_m[0], True), (AIRPORT.runway.x_m[0] - 15, False)):
        seen = project_points(AIRPORT.camera, state, x_m, along)
        light = np.exp(ground.log_light(seen[:, 0], seen[:, 1], flight.views(start)))[0]
        covered = (light - target.ground_reflectance) / (1 - target.ground_reflectance)
        across_m = state[2] / AIRPORT.camera.focal_v_px / (state[2] / (along + state[3]))
        assert (covered > 0.5 * np.minimum(0.9 / across_m, 1)).all() if lit else (covered < 0.01).all()
    assert state[2] / (along[-1] + state[3]) < simulator.FLATTEST_FALL


# --- the attitude reference ---


def test_the_attitude_references_plus_minus_holds_and_is_used(paper_scene, tmp_path):
    flight = flight_of(paper_scene, simulator.Vibration())
    off, plus_minus = [], 0.0
    for seed in range(40):
        path = tmp_path / "attitude.csv"
        path.write_text(attitude_text(simulator.attitudes(flight, seed)))
        readings = AttitudeReadings.load(path)
        plus_minus = readings.plus_minus[0, 1] - flight.vibration.pitch_rad
        error = -readings.angles[:, 1] - flight.states(readings.time_us)[:, 0]
        assert (np.abs(error) <= plus_minus).all()
        assert (np.abs(readings.angles[:, [0, 2]]) <= plus_minus).all()
        off.append(error.mean())
    assert np.abs(off).max() > 0.7 * plus_minus
    assert np.std(off) > 0.3 * plus_minus


def test_a_lens_bends_what_the_sensor_sees() -> None:
    """A pixel of the sensor looks where the pinhole's pixel does that the lens shows there."""
    scene = seen_through(PAPER, WIDE)
    sensor = SensorMap.of(scene)
    points = np.random.default_rng(3).uniform([0, 0], [sensor.ideal.width, sensor.ideal.height], (200, 2))
    seen = np.stack(simulator.pinhole_points(scene.camera, *sensor.project(points).T), axis=-1)
    shift = [scene.camera.u0 - sensor.ideal.u0, scene.camera.v0 - sensor.ideal.v0]
    assert np.abs(seen - shift - points).max() < 1e-6
    u, v = np.array([3.5]), np.array([7.5])
    assert simulator.pinhole_points(PAPER.camera, u, v) == (u, v)
    assert simulator.largest_stretch(PAPER.camera) == 1

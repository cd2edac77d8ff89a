"""Models of cameras with a lens, from export to estimate: the frame is the sensor's own."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from scenes import ONE_CELL, PAPER, Floats, random_clutter
from test_lens import FISHEYE, WIDE
from test_sensor_map import OFF, seen_through
from turned_state import TurnedState

from build_model.export import export_model
from build_model.verify.counterexample import Refuted
from build_model.verify.lens_proof import check_lens
from build_model.verify.proof import verify_model
from runtime import Box, Estimator, FrameError, ModelError, Motion, Outcome, Scene, SceneError, Tracker
from runtime.explanation import Reason, explain, shortfall
from runtime.image import marking_images, runway_image
from runtime.model.format import METADATA_KEY, metadata_digest
from runtime.recordings.draw import draw_estimate
from runtime.scene import Camera, Distortion, Tolerance
from runtime.sensor_image import sensor_curves
from runtime.sensor_map import lens_of

CELLS = replace(PAPER, domain=replace(ONE_CELL.domain, x_m=PAPER.domain.x_m))
SCENES = {
    "wide": seen_through(CELLS, WIDE),
    "fisheye": seen_through(CELLS, FISHEYE),
    "two missed": replace(seen_through(CELLS, WIDE), tolerance=Tolerance(missed_budget=2)),
    "off": seen_through(CELLS, WIDE, replace(OFF, roll_rad=0.0003, yaw_rad=0.0003)),
    "cut": replace(seen_through(CELLS, WIDE), camera=replace(seen_through(CELLS, WIDE).camera, principal_point=(4.0, 240.0))),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sensors")


def model_of(name: str, folder: Path) -> Path:
    path = folder / f"{name}.onnx"
    if not path.exists():
        export_model(SCENES[name], path, estimator="none")
    return path


def states(scene: Scene, count: int, seed: int) -> Floats:
    return np.random.default_rng(seed).uniform(scene.domain.lower, scene.domain.upper, (count, 4))


@pytest.mark.parametrize("name", SCENES)
def test_the_truth_is_inside(name: str, folder: Path) -> None:
    estimator, rng = Estimator.load(model_of(name, folder)), np.random.default_rng(21)
    scene = estimator.scene
    assert scene == SCENES[name]
    assert estimator.missed_budget == scene.tolerance.missed_budget
    for number, state in enumerate(states(scene, 12, 3)):
        image = runway_image(scene, state)
        frame = image.copy()
        lit = np.flatnonzero(frame)
        frame.ravel()[rng.permutation(lit)[: estimator.missed_budget]] = 0
        frame |= random_clutter(rng, frame.shape, [0.0, 0.02, 0.05][number % 3])
        estimate = estimator.estimate(frame, refine=number < 9)
        assert estimate.certified
        assert estimate.box is not None
        assert estimate.box.contains(state)
        assert not ((image & frame) > estimate.filtered).any()
        assert (estimate.filtered <= frame).all()
        assert not (image > estimator.spatial_mask(estimate.cell)).any() or name == "cut"


def test_a_lens_that_is_left_out_would_lose_the_truth(folder: Path) -> None:
    """The same frames without the map: what the lens moves is many pixels."""
    through, bare = (
        Estimator.load(model_of("wide", folder)),
        replace(SCENES["wide"], camera=replace(SCENES["wide"].camera, distortion=None)),
    )
    path = folder / "bare.onnx"
    export_model(bare, path, estimator="none")
    estimator = Estimator.load(path)
    lost = 0
    for state in states(bare, 10, 5):
        frame = runway_image(through.scene, state)
        found = estimator.estimate(frame)
        lost += found.box is None or not found.box.contains(state)
    assert lost >= 8


def test_a_frame_is_the_sensors(folder: Path) -> None:
    estimator = Estimator.load(model_of("wide", folder))
    assert estimator.scene.camera.shape == (480, 640)
    assert estimator.ideal.camera.width < 640
    with pytest.raises(FrameError):
        estimator.estimate(np.zeros(estimator.ideal.camera.shape, dtype=bool))
    outputs = estimator.run(np.zeros((480, 640), dtype=bool))
    assert outputs["filtered"].shape == estimator.ideal.camera.shape
    assert estimator.estimate(np.zeros((480, 640), dtype=bool)).outcome is Outcome.NO_RUNWAY
    everything = estimator.estimate(np.ones((480, 640), dtype=bool))
    assert everything.box is not None
    assert (everything.box.lower <= estimator.domain.lower + 1e-3).all()


def test_budgets_are_the_sensors(folder: Path) -> None:
    path = model_of("two missed", folder)
    estimator = Estimator.load(path)
    count = estimator.sensor.pixels_a_pixel
    assert estimator.metadata["smallest_must_light"] > 2 * count
    assert "At most 2 pixels of the runway's image" in " ".join(estimator.assumed)
    largest = estimator.largest_missed_budget
    assert Estimator.load(path, missed_budget=largest).missed_budget == largest
    with pytest.raises(ModelError, match=f"missed_budget {largest + 1}: must be 0 to {largest}"):
        Estimator.load(path, missed_budget=largest + 1)
    with pytest.raises(ModelError, match="extra_budget 0: behind a lens only Theorem A holds"):
        Estimator.load(path, extra_budget=0)


@pytest.mark.parametrize("name", ["two missed", "off"])
def test_an_attitude_is_taken_behind_a_lens_with_missed_pixels_and_beside_a_calibration(name: str, folder: Path) -> None:
    estimator, rng = Estimator.load(model_of(name, folder)), np.random.default_rng(5)
    scene = estimator.scene
    for number, seen in enumerate(states(scene, 1, 6), 1):
        state = TurnedState.near(seen, *rng.uniform(-0.06, 0.06, 2))
        frame = state.view(scene).image(state.seen).frame.copy()
        frame.ravel()[rng.choice(np.flatnonzero(frame), estimator.missed_budget, replace=False)] = False
        box = estimator.estimate(frame, attitude=state.attitude(rng, 0.0005 * number)).box
        assert box is not None
        assert state.within(box.lower, box.upper)


def test_a_prior_and_a_tracker_take_the_sensors_frames(folder: Path) -> None:
    estimator = Estimator.load(model_of("wide", folder))
    tracker = Tracker(estimator, Motion((-0.1, 0.0, -0.05, -0.5), (0.1, 0.0, 0.05, 0.0)))
    state = (estimator.domain.lower + estimator.domain.upper) / 2
    for number in range(4):
        now = state - np.array([0.0, 0.0, 0.0, 0.01]) * number
        estimate = tracker.update(runway_image(estimator.scene, now), number * 40_000)
        assert estimate.box is not None
        assert estimate.box.contains(now)
        alone = estimator.estimate(runway_image(estimator.scene, now)).box
        assert alone is not None
        assert (estimate.box.half_widths <= 1.02 * alone.half_widths).all()  # a search ends at a gain of so much
    prior = estimator.domain.replace(theta=(state[0] - 0.005, state[0] + 0.005))
    closer = estimator.estimate(runway_image(estimator.scene, state), prior=prior)
    assert closer.box is not None
    assert closer.box.contains(state)
    assert isinstance(closer.box, Box)
    again = copy.copy(estimator).estimate(runway_image(estimator.scene, state))
    assert again.certified


def test_why_nothing_is_certified_is_told_of_the_sensors_frame(folder: Path) -> None:
    estimator = Estimator.load(model_of("wide", folder))
    state = (estimator.domain.lower + estimator.domain.upper) / 2
    frame = runway_image(estimator.scene, state)
    rows = np.flatnonzero(frame.any(axis=1))
    frame[rows[5:12]] = 0
    estimate = estimator.estimate(frame)
    assert not estimate.certified
    explanation = explain(estimator, frame, estimate)
    assert explanation.reason in (Reason.NOT_FOUND, Reason.REFUTED)
    assert shortfall(estimator.scene, frame, state).missed >= 7
    assert explanation.nearest.missed <= shortfall(estimator.scene, frame, state).missed + 4
    picture = draw_estimate(
        estimator.scene, frame, estimate, mask=estimator.spatial_mask(estimate.cell), truth=state, explanation=explanation
    )
    assert picture.shape[2] == 3
    whole = runway_image(estimator.scene, state)
    assert draw_estimate(estimator.scene, whole, estimator.estimate(whole), truth=state).shape[2] == 3


# --- images on the sensor ---


@pytest.mark.parametrize("lens", [WIDE, FISHEYE], ids=["wide", "fisheye"])
def test_the_image_holds_the_curve_and_little_else(lens: Distortion) -> None:
    """Every point of the curves in mid-state, and no pixel without one within a sixteenth of a pixel."""
    scene = seen_through(PAPER, lens)
    for state in states(scene, 10, 7):
        images, curves = marking_images(scene, state), sensor_curves(scene, state, points=20_001)
        for image, curve in zip(images, curves, strict=True):
            inside = ((curve >= 0) & (curve < [640, 480])).all(axis=1)
            pixels = np.floor(curve[inside]).astype(int)
            assert image[pixels[:, 1], pixels[:, 0]].all()
            near = {(int(u), int(v)) for a in (-0.07, 0.07) for b in (-0.07, 0.07) for u, v in np.floor(curve + np.array([a, b]))}
            assert {(int(u), int(v)) for v, u in np.argwhere(image)} <= near


def test_what_the_lens_does_not_show_is_not_drawn() -> None:
    """A near end far below the frame, where the polynomial has folded, comes not back into it."""
    scene = seen_through(PAPER, Distortion("radial-tangential", (-0.3, 0.05, 0.0, 0.0)))
    low = np.array([0.45, 0.0, 1.05, 0.2])
    curves = sensor_curves(scene, low)
    seen = curves[np.isfinite(curves).all(axis=(1, 2))]
    assert (np.diff(seen[:, :, 1], axis=1) < 1e-9).all()  # from near to far the row falls throughout


# --- damage ---


def changed_model(folder: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> Path:
    """A model with other metadata, under a digest that agrees with them."""
    proto = onnx.load(model_of("wide", folder))
    (entry,) = [entry for entry in proto.metadata_props if entry.key == METADATA_KEY]
    stated = json.loads(entry.value)
    changed = {key: value for key, value in {**stated, **change(stated)}.items() if key != "metadata_sha256"}
    entry.value = json.dumps({**changed, "metadata_sha256": metadata_digest(changed)}, sort_keys=True)
    path = folder / f"changed-{metadata_digest(changed)[:12]}.onnx"
    onnx.save(proto, path)
    return path


def test_a_model_whose_ideal_frame_is_not_its_cameras_is_refused(folder: Path) -> None:
    narrower = changed_model(folder, lambda stated: {"ideal_camera": {**stated["ideal_camera"], "width": 75}})
    for path in (narrower, changed_model(folder, lambda _stated: {"ideal_pixels_a_pixel": 1})):
        with pytest.raises(ModelError, match="its ideal frame is not the one that its camera has; export it again"):
            Estimator.load(path)


def test_theorem_b_is_not_built_behind_a_lens(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"tolerance\.extra_budget: found 4; behind a lens only Theorem A holds"):
        export_model(replace(SCENES["wide"], tolerance=Tolerance(extra_budget=4)), tmp_path / "b.onnx", estimator="none")


# --- the proof ---


@pytest.mark.parametrize("name", ["wide", "two missed", "off", "cut"])
def test_a_model_behind_a_lens_is_proved(name: str, folder: Path) -> None:
    report = verify_model(model_of(name, folder))
    assert report.proved, report.counterexample
    assert report.cells == 1


def test_an_ideal_frame_of_another_focal_length_is_refuted(folder: Path) -> None:
    path = changed_model(folder, lambda stated: {"ideal_camera": {**stated["ideal_camera"], "focal_px": [540.0, 530.0]}})
    assert "ideal_camera is no pinhole of the camera's own focal lengths" in str(verify_model(path).counterexample)
    path = changed_model(folder, lambda _stated: {"ideal_pixels_a_pixel": 0})
    assert "ideal_pixels_a_pixel is missing" in str(verify_model(path).counterexample)


@pytest.mark.parametrize(
    ("distortion", "proved"),
    [
        (WIDE, True),
        (FISHEYE, True),
        (Distortion("fisheye", (0.0, 0.0, 0.0, 0.0)), True),
        (Distortion("radial-tangential", (-0.4, 0.0, 0.0, 0.0)), False),
        (Distortion("radial-tangential", (0.0, 0.0, 0.2, 0.2)), False),
        (Distortion("fisheye", (-0.6, 0.0, 0.0, 0.0)), False),
    ],
)
def test_folds_are_found_in_balls_too(distortion: Distortion, proved: bool) -> None:
    scene = seen_through(PAPER, distortion)
    ideal = Camera(80, 300, focal_px=(scene.camera.focal_u_px, scene.camera.focal_v_px))
    if proved:
        check_lens(scene.camera, OFF, ideal)
        assert lens_of(scene.camera, OFF).stretch > 0
        return
    with pytest.raises(Refuted, match="not proved to be free of folds"):
        check_lens(scene.camera, OFF, ideal)
    with pytest.raises(SceneError, match="folds within the frame"):
        lens_of(scene.camera, OFF)

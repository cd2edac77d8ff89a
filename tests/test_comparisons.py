"""The comparisons compare what they say: codac encloses every consistent state, the OpenCV baseline is exact on exact measurements."""

from __future__ import annotations

import csv
import dataclasses
import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from scenes import FINAL
from typer.testing import CliRunner

from runtime import Estimator, Scene
from runtime.camera import ground_scale, project, row_of_point
from runtime.image import runway_image
from runtime.scene import Axis, Camera, Distortion, Marking, Runway
from runtime.sensor import Sensor

UNKNOWNS = [0, 2, 3]
Floats = NDArray[np.float64]


def script(name: str) -> ModuleType:
    """A module of scripts/, which is no package; it finds its neighbours as when it runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[1] / "scripts"))
        return importlib.import_module(name)


compare_codac, compare_opencv, compare_rounds, comparison_frames = map(
    script, ("compare_codac", "compare_opencv", "compare_rounds", "comparison_frames")
)
PRECISION = 0.15 * compare_codac.TYPICAL_HALF_WIDTHS


@pytest.fixture(scope="module")
def estimator(repository: Path) -> Estimator:
    return Estimator.load(repository / "models" / "paper.onnx")


# --- frames ---


def test_the_frames_show_the_same_states_at_every_density_and_more_clutter_adds_pixels(paper_scene: Scene) -> None:
    for (state, clean), (again, some), (_, more) in zip(
        *(comparison_frames.draw_frames(paper_scene, 3, density, 5) for density in (0.0, 0.02, 0.05)), strict=True
    ):
        assert (state == again).all()
        assert (clean == runway_image(paper_scene, state)).all()
        assert (clean <= some).all()
        assert (some <= more).all()
        assert abs((some > clean).mean() - 0.02) < 0.002


@pytest.mark.parametrize("lens", [("radial-tangential", (-0.28, 0.07, 0.001, -0.001)), ("fisheye", (0.01, 0.02, -0.01, 0.0))])
def test_behind_a_lens_the_baseline_is_given_undistorted_frames(lens: tuple[str, tuple[float, ...]], paper_scene: Scene) -> None:
    """A frame of lit markings becomes the ideal frame's, up to a pixel beside them; a pinhole's stays as it is."""
    camera = Camera(640, 480, focal_px=(540.0, 525.0), principal_point=(300.0, 251.5), distortion=Distortion(*lens))
    sensor = Sensor.of(dataclasses.replace(paper_scene, camera=camera))
    for state in sensor.scene.domain.uniform(np.random.default_rng(3), 5):
        straight = compare_opencv.undistortion(sensor.scene, sensor.ideal)(runway_image(sensor.scene, state))
        ideal = runway_image(sensor.ideal, state)
        assert straight.shape == ideal.shape
        assert not (straight & ~cv2.dilate(ideal, np.ones((3, 3), np.uint8))).any()
        assert not (ideal & ~cv2.dilate(straight, np.ones((5, 5), np.uint8))).any()
    frame = runway_image(paper_scene, paper_scene.domain.lower)
    assert compare_opencv.undistortion(paper_scene, paper_scene)(frame) is frame


# --- codac ---


@pytest.fixture
def speckled() -> NDArray[np.uint8]:
    return (np.random.default_rng(3).random((9, 12)) < 0.4).astype(np.uint8)


def is_lit(frame: NDArray[np.uint8], row: int, column: int) -> bool:
    """A pixel of a frame outside of which all is lit."""
    inside = 0 <= row < frame.shape[0] and 0 <= column < frame.shape[1]
    return not inside or bool(frame[row, column])


def test_usable_columns_are_those_of_a_fine_search(speckled: NDArray[np.uint8]) -> None:
    """The naive twin tries every multiple of 1/8 px: closed columns, so a point between two belongs to both."""
    lit = compare_codac.LitPixels(speckled)
    rng = np.random.default_rng(4)
    for _ in range(300):
        border = int(rng.integers(0, speckled.shape[0] + 1))
        low, high = np.sort(rng.choice(np.arange(-8, 14 * 8), 2, replace=False)) / 8 + 1 / 16
        tried = np.arange(np.ceil(low * 8), np.floor(high * 8) + 1) / 8
        usable = [
            u
            for u in tried
            if all(any(is_lit(speckled, row, column) for column in {int(np.ceil(u)) - 1, int(np.floor(u))}) for row in (border - 1, border))
        ]
        (first,), (last,) = lit.usable(np.array([border]), np.array([low]), np.array([high]))
        if not usable:
            assert first > last
        else:
            assert usable[0] - 1 / 8 < first <= usable[0]
            assert usable[-1] <= last < usable[-1] + 1 / 8


def test_a_rectangle_without_a_lit_pixel_is_told(speckled: NDArray[np.uint8]) -> None:
    lit = compare_codac.LitPixels(speckled)
    rng = np.random.default_rng(5)
    for _ in range(300):
        top, bottom = np.sort(rng.uniform(-1, 10, 2))
        left, right = np.sort(rng.uniform(-1, 13, 2))
        rows, columns = range(int(np.floor(top)), int(np.floor(bottom)) + 1), range(int(np.floor(left)), int(np.floor(right)) + 1)
        naive = any(is_lit(speckled, row, column) for row in rows for column in columns)
        assert lit.any_within((top, bottom), (left, right)) == naive


def test_an_image_is_held_exactly_by_the_frames_that_contain_it(paper_scene: Scene, random_states: Any) -> None:
    for state in random_states(paper_scene, 5, 6):
        image = runway_image(paper_scene, state)
        assert compare_codac.LitPixels(image).hold_image(paper_scene, state)
        row, column = np.argwhere(image)[len(np.argwhere(image)) // 2]
        image[row, column] = 0
        assert not compare_codac.LitPixels(image).hold_image(paper_scene, state)


@pytest.mark.parametrize(("clutter", "seed"), [(0.0, 7), (0.02, 8)])
def test_codac_and_we_enclose_the_same_states(estimator: Estimator, clutter: float, seed: int) -> None:
    """Both hold the truth and all states found consistent, and neither is much wider than the other."""
    inversion = compare_codac.SetInversion(estimator.scene)
    ((truth, frame),) = comparison_frames.draw_frames(estimator.scene, 1, clutter, seed)
    result = compare_codac.compare(estimator, inversion, truth, frame, clutter, PRECISION)
    assert result.violations == 0
    assert result.codac.outer.holds(result.codac.inner)
    assert result.ours.holds(result.codac.inner)
    assert (result.codac.inner.half_widths > 0.5 * result.codac.outer.half_widths).all()
    assert (result.ratio > 0.7).all()
    assert (result.ratio < 1.6).all()
    lit = compare_codac.LitPixels(frame)
    nearby = np.random.default_rng(seed).uniform(-1, 1, (4000, 4)) * [0.004, 0, 0.006, 0.01] + truth
    inside = [state[UNKNOWNS] for state in nearby if lit.hold_image(estimator.scene, state)]
    assert len(inside) >= 5
    assert all(result.codac.outer.holds(compare_codac.Hull(state, state)) for state in inside)


def test_codac_leaves_the_processor_rounding_to_nearest(paper_scene: Scene) -> None:
    compare_codac.SetInversion(paper_scene).invert(runway_image(paper_scene, [0.6, 0.0, 0.9, 1.7]), PRECISION)
    tiny = 2.0**-60
    assert 1.0 + np.float64(tiny) == 1.0
    assert -1.0 - np.float64(tiny) == -1.0


def test_codac_finds_nothing_in_a_dark_frame_and_all_in_a_lit_one(paper_scene: Scene) -> None:
    inversion = compare_codac.SetInversion(paper_scene)
    dark = np.zeros(paper_scene.camera.shape, dtype=np.uint8)
    assert (inversion.invert(dark, PRECISION).outer.lower == np.inf).all()
    domain = paper_scene.domain
    everything = inversion.invert(dark + 1, np.full(3, 0.06)).outer
    assert np.allclose(everything.lower, domain.lower[UNKNOWNS], atol=1e-12)
    assert np.allclose(everything.upper, domain.upper[UNKNOWNS], atol=1e-12)


def test_a_scene_with_free_x_is_refused_by_codac_and_one_with_three_markings_by_the_baseline(paper_scene: Scene) -> None:
    domain = dataclasses.replace(paper_scene.domain, x_m=Axis((0.0,), 0.1))
    with pytest.raises(ValueError, match="fixed"):
        compare_codac.SetInversion(dataclasses.replace(paper_scene, domain=domain))
    markings = (*paper_scene.runway.markings, Marking("C", 0.0, 0.0, 0.3))
    with pytest.raises(ValueError, match="two markings"):
        compare_opencv.Baseline(dataclasses.replace(paper_scene, runway=Runway(markings)))


# --- OpenCV ---


@pytest.mark.parametrize("free_x", [False, True])
@pytest.mark.parametrize("solver", compare_opencv.SOLVERS)
def test_exact_measurements_give_the_exact_pose(paper_scene: Scene, random_states: Any, solver: str, free_x: bool) -> None:
    scene = with_free_x(paper_scene) if free_x else paper_scene
    baseline = compare_opencv.Baseline(scene)
    for state in random_states(scene, 20, 9):
        theta, x, y, z = state
        far, near = (float(row_of_point(scene.camera, theta, y, end + z)) for end in (0.3, 0.0))
        v = np.tile(np.linspace(far, near, 30), 2)
        lateral = np.repeat(scene.runway.x_m, 30)
        u = scene.camera.u0 + (lateral - x) * ground_scale(scene.camera, theta, y, v)
        line = baseline._fitted(u, v, lateral)
        measured = compare_opencv.Measured(u, v, lateral, near_row=near, far_row=far, line=line)
        assert np.allclose(baseline._solve(measured, solver), state, atol=1e-9 if solver == "least squares" else 1e-4)


def with_free_x(scene: Scene) -> Scene:
    return dataclasses.replace(scene, domain=dataclasses.replace(scene.domain, x_m=Axis((0.0,), 0.1)))


@pytest.mark.parametrize("detector", compare_opencv.DETECTORS)
def test_the_baseline_finds_a_runway_from_afar_and_beside_its_middle(detector: str) -> None:
    cv2.setNumThreads(1)
    baseline = compare_opencv.Baseline(FINAL)
    for truth, frame in comparison_frames.draw_frames(FINAL, 6, 0.01, 3):
        state = baseline.estimate(frame, detector, "least squares")
        assert state is not None
        assert (np.abs(state - truth) < [0.002, 2.0, 0.02 * truth[2], 0.1 * truth[3]]).all()


@pytest.mark.parametrize("clutter", [0.0, 0.02, 0.05])
def test_the_baseline_finds_the_runway(paper_scene: Scene, clutter: float) -> None:
    cv2.setNumThreads(1)
    baseline = compare_opencv.Baseline(paper_scene)
    for detector in compare_opencv.DETECTORS:
        for solver in compare_opencv.SOLVERS:
            errors = []
            for truth, frame in comparison_frames.draw_frames(paper_scene, 8, clutter, 10):
                state = baseline.estimate(frame, detector, solver)
                assert state is not None
                errors.append(float(np.linalg.norm(state - truth)))
            assert np.median(errors) < 0.025
            assert max(errors) < compare_opencv.GROSS_ERROR


def test_the_baseline_has_no_answer_without_a_runway(paper_scene: Scene) -> None:
    baseline = compare_opencv.Baseline(paper_scene)
    dark = np.zeros(paper_scene.camera.shape, dtype=np.uint8)
    level = dark.copy()
    level[100, 200:400] = 1
    for frame in (dark, level):
        assert all(baseline.estimate(frame, name, "least squares") is None for name in compare_opencv.DETECTORS)


def test_specks_are_removed_and_markings_kept(paper_scene: Scene, random_states: Any) -> None:
    (state,) = random_states(paper_scene, 1, 11)
    image = runway_image(paper_scene, state)
    near = project(paper_scene, state)[0, 0]
    assert image[int(near[1]), int(near[0])] == 1
    assert (compare_opencv.without_specks(image) == 255 * image).all()
    specks = image.copy()
    specks[400, 100] = specks[400, 102] = 1
    assert (compare_opencv.without_specks(specks) == 255 * image).all()


# --- rounds ---


def test_each_round_leaves_a_smaller_box_and_the_refinement_as_it_was(estimator: Estimator, paper_scene: Scene) -> None:
    before = [getattr(compare_rounds.refiner, name) for name in compare_rounds.SEARCHES]
    ((_, frame),) = comparison_frames.draw_frames(paper_scene, 1, 0.01, 3)
    spent, widths = compare_rounds.compared(estimator, [frame], [0, 1, 2])
    assert (np.diff(widths[1:, 0], axis=0) <= 0).all()
    assert (widths[1, 0] > 1.1 * widths[0, 0]).all()
    assert np.isfinite(spent).all()
    assert [getattr(compare_rounds.refiner, name) for name in compare_rounds.SEARCHES] == before


def test_the_table_of_rounds_has_a_row_for_each(repository: Path) -> None:
    app = typer.Typer()
    app.command()(compare_rounds.main)
    model = str(repository / "models" / "paper.onnx")
    done = CliRunner().invoke(app, [model, "--frames", "1", "--missed-budget", "2", "--rounds", "1", "--rounds", "3"])
    assert done.exit_code == 0, done.output
    assert "2 of 2 pixels missed" in done.output
    assert all(f"│ {name} " in done.output for name in ("as it is", "1", "3"))


# --- commands ---


@pytest.mark.parametrize(
    ("name", "options", "rows"),
    [("compare_codac", ["--precision", "1", "--clutter", "0"], 1), ("compare_opencv", ["--clutter", "0", "--clutter", "0.02"], 14)],
)
def test_a_comparison_prints_a_table_and_writes_every_frame(
    repository: Path, tmp_path: Path, name: str, options: list[str], rows: int
) -> None:
    app = typer.Typer()
    app.command()(script(name).main)
    output = tmp_path / "deeper" / "figures.csv"
    model = repository / "models" / "paper.onnx"
    done = CliRunner().invoke(app, ["--model", str(model), "--frames", "1", "-o", str(output), *options])
    assert done.exit_code == 0, done.output
    assert "ours" in done.output
    with output.open(encoding="utf-8", newline="") as file:
        header, *figures = csv.reader(file)
    assert len(figures) == rows
    assert all(len(row) == len(header) for row in figures)


def test_a_missing_model_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    for name in ("compare_codac", "compare_opencv"):
        app = typer.Typer()
        app.command()(script(name).main)
        done = CliRunner().invoke(app, ["--model", str(tmp_path / "none.onnx")])
        assert done.exit_code == 2
        assert "none.onnx" in done.output

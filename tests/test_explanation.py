"""Why a frame has no certificate: counts are exact, the nearest state is near, and its count is a budget that gives a certificate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import THREE_MARKINGS, random_clutter

from runtime import Estimator, Scene
from runtime.explanation import Explanation, Reason, Shortfall, explain, missed_pixels, shortfall
from runtime.image import runway_image
from runtime.scene import Tolerance

MODEL = Path(__file__).parents[1] / "models" / "paper.onnx"
STATE = np.array([0.62, 0.0, 0.93, 1.72])


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return Estimator.load(MODEL)


def with_dark_pixels(scene: Scene, state: NDArray, count: int, seed: int, clutter: float = 0.02) -> NDArray[np.uint8]:
    """The state's image under clutter, `count` of its pixels dark."""
    rng = np.random.default_rng(seed)
    image = runway_image(scene, state)
    dark = rng.choice(np.argwhere(image), count, replace=False)
    frame = image | random_clutter(rng, image.shape, clutter)
    frame[dark[:, 0], dark[:, 1]] = 0
    return frame


@pytest.mark.parametrize("line_px", [0, 1])
def test_a_shortfall_counts_what_a_double_loop_counts(line_px: int) -> None:
    scene = replace(THREE_MARKINGS, tolerance=Tolerance(line_px=line_px))
    frame = with_dark_pixels(scene, STATE, 30, seed=1, clutter=0.2)
    lit = np.pad(frame, line_px)
    rows, missed = {}, set()
    for marking in scene.runway.markings:
        alone = runway_image(replace(scene, runway=replace(scene.runway, markings=(marking,))), STATE)
        for row, column in np.argwhere(alone).tolist():
            if not lit[row : row + 2 * line_px + 1, column : column + 2 * line_px + 1].any():
                rows.setdefault(marking.name, set()).add(row)
                missed.add((row, column))
    found = shortfall(scene, frame, STATE)
    assert found.missed == len(missed) == missed_pixels(scene, frame, STATE, line_px) > 0
    assert found.pixels == np.count_nonzero(runway_image(scene, STATE))
    assert {name: set(own) for name, own in found.dark_rows.items()} == rows


def test_a_shortfalls_rows_are_told_in_runs() -> None:
    assert Shortfall(STATE, 80, 6, {"L": (3, 4, 5, 9), "R": (7,)}).rows_text() == "L rows 3-5, 9; R row 7"
    assert Shortfall(STATE, 80, 0, {}).rows_text() == ""


@pytest.mark.parametrize("dark", [2, 6, 15])
def test_the_nearest_state_is_about_as_near_as_the_true_one_and_its_count_is_a_certifying_budget(
    estimator: Estimator, random_states: Callable[..., NDArray], dark: int
) -> None:
    excess = []
    for seed, state in enumerate(random_states(estimator.scene, 12, dark)):
        frame = with_dark_pixels(estimator.scene, state, dark, seed)
        estimate = estimator.estimate(frame)
        if estimate.certified:
            continue
        found = explain(estimator, frame, estimate)
        nearest = found.nearest
        assert nearest.missed == missed_pixels(estimator.scene, frame, nearest.state, 0) > estimator.missed_budget
        assert ((estimator.scene.domain.lower <= nearest.state) & (nearest.state <= estimator.scene.domain.upper)).all()
        assert (found.reason is Reason.REFUTED) == (len(estimate.passing) > 0)
        excess.append(nearest.missed - dark)
        if nearest.missed <= estimator.largest_missed_budget:
            box = Estimator.load(MODEL, missed_budget=nearest.missed).estimate(frame).box
            assert box is not None
            assert box.contains(nearest.state)
    assert len(excess) > 4
    assert max(excess) <= 3
    assert np.mean(excess) <= 0.5


def test_both_reasons_occur_and_are_told_apart(estimator: Estimator) -> None:
    """One dark pixel may be of no entry's K; a frame without a runway has no entry at all."""
    seen = set()
    for seed in range(30):
        frame = with_dark_pixels(estimator.scene, STATE, 1, seed, clutter=0)
        estimate = estimator.estimate(frame)
        if not estimate.certified:
            seen.add(explain(estimator, frame, estimate).reason)
    empty = np.zeros(estimator.scene.camera.shape, dtype=np.uint8)
    found = explain(estimator, empty, estimator.estimate(empty))
    assert found.reason is Reason.NOT_FOUND
    assert found.nearest.missed == found.nearest.pixels > 0
    assert Reason.REFUTED in seen


def test_clutter_beyond_theorem_bs_budget_is_a_reason_of_its_own() -> None:
    bounded = Estimator.load(MODEL, extra_budget=0)
    frame = np.any([bounded.spatial_mask(cell) for cell in range(bounded.scene.domain.cell_count)], axis=0)
    estimate = bounded.estimate(frame)
    assert not estimate.certified
    found = explain(bounded, frame, estimate)
    assert (found.reason, found.nearest.missed) == (Reason.CLUTTERED, 0)


def test_an_explanation_is_the_same_every_time_and_names_all_numbers(estimator: Estimator) -> None:
    frame = with_dark_pixels(estimator.scene, STATE, 5, seed=3)
    estimate = estimator.estimate(frame)
    first, second = (explain(estimator, frame, estimate) for _ in range(2))
    assert first.text() == second.text()
    text = Explanation(Reason.REFUTED, Shortfall(STATE, 76, 3, {"L": (139, 140)}), 1).text()
    assert text == (
        "found by NN_F, refuted by the refinement; nearest state found, not certified: theta 0.6200 rad x 0.0000 m y 0.9300 m z 1.7200 m, "
        "3 of 76 pixels dark, 1 may be: L rows 139-140"
    )


def test_a_tolerant_model_and_one_with_a_free_axis_explain_too(estimator_of: Callable[..., Estimator]) -> None:
    for name in ("tolerant", "free x"):
        other = estimator_of(name)
        state = (other.scene.domain.lower + other.scene.domain.upper) / 2
        frame = with_dark_pixels(other.scene, state, 12, seed=4, clutter=0.01)
        estimate = other.estimate(frame)
        if estimate.certified:
            frame[:] = 0
            estimate = other.estimate(frame)
        nearest = explain(other, frame, estimate).nearest
        assert nearest.missed == missed_pixels(other.scene, frame, nearest.state, other.scene.tolerance.line_px) > 0

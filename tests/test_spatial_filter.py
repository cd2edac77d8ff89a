"""S of every cell: it holds each pixel that a state of the cell lights, and hardly any other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import BARELY_ABOVE, BARELY_BELOW, CUT_BELOW, CUT_LEFT, FREE_X, PAPER, SHIFTED, THREE_MARKINGS, Floats, tolerant

from build_model.partition import partition
from build_model.spatial_filter import BELOW_HORIZON_PX, reference_row, sliced, spatial_filter, spatial_filters
from build_model.window import Window
from build_model.window_bank import cell_windows
from runtime.camera import project, row_of_point
from runtime.image import image_of_ends, lit_columns, runway_image
from runtime.scene import Axis, Camera, Scene, SceneError, WindowedBank

CASES = {"paper": PAPER, "three": THREE_MARKINGS, "cut left": CUT_LEFT, "cut below": CUT_BELOW, "free x": FREE_X}


def states_of_cell(lower: Floats, upper: Floats, count: int, seed: int) -> Floats:
    """Random states of a cell, a quarter of them on its faces, edges and corners."""
    rng = np.random.default_rng(seed)
    share = rng.random((count, 4))
    share[: count // 4] = np.clip(1.5 * share[: count // 4] - 0.25, 0, 1)
    share[: count // 40] = np.round(share[: count // 40])
    return np.clip(lower + share * (upper - lower), lower, upper)


def sampled_union(scene: Scene, states: Floats) -> np.ndarray:
    """Every pixel that one of the states lights, from the columns that they light in each row."""
    height, width = scene.camera.shape
    size = height * (width + 1)
    steps = np.zeros(size, dtype=np.int64)
    for part in np.array_split(states, max(len(states) // 2000, 1)):
        first, last = lit_columns(scene, part)
        first, last = np.maximum(first, 0), np.minimum(last, width - 1)
        lit = first <= last
        row = np.broadcast_to(np.arange(height), lit.shape)[lit] * (width + 1)
        steps += np.bincount(row + first[lit], minlength=size) - np.bincount(row + last[lit] + 1, minlength=size)
    return steps.reshape(height, width + 1).cumsum(axis=1)[:, :-1] > 0


@pytest.mark.parametrize("scene", CASES.values(), ids=CASES)
def test_every_cell_holds_the_images_of_its_states(scene: Scene) -> None:
    cells = partition(scene)
    filters = spatial_filters(scene)
    assert filters.shape == (scene.domain.cell_count, *scene.camera.shape)
    for cell, (lower, upper) in enumerate(zip(cells.lower, cells.upper, strict=True)):
        union = sampled_union(scene, states_of_cell(lower, upper, 200, cell))
        assert union.any()
        assert not (union & ~filters[cell]).any()


def test_the_sampled_union_is_that_of_the_images() -> None:
    """The counting twin of the test above against the images themselves."""
    for scene in (PAPER, CUT_LEFT):
        states = states_of_cell(scene.domain.lower, scene.domain.upper, 60, 5)
        assert (sampled_union(scene, states) == runway_image(scene, states).any(axis=0)).all()


@pytest.mark.parametrize("cell", [0, 13, 26])
def test_s_is_close_to_the_sampled_union(cell: int) -> None:
    """Issue's figure: at most 1.10 times what random states of the cell light."""
    cells = partition(PAPER)
    lower, upper = cells.lower[cell], cells.upper[cell]
    bits, window = spatial_filter(PAPER, lower, upper)
    union = sampled_union(PAPER, states_of_cell(lower, upper, 25_000, cell))
    assert bits.sum() <= 1.10 * union.sum()
    assert bits[0].any()
    assert bits[-1].any()
    assert window.shape == bits.shape


@pytest.mark.parametrize("exact_scene", [CUT_LEFT, BARELY_ABOVE, BARELY_BELOW], ids=["left", "above", "below"])
def test_a_tolerance_widens_s_and_holds_a_camera_that_is_off(exact_scene: Scene) -> None:
    """That brings into view what a border of the frame hides from an exact one."""
    scene = tolerant(exact_scene, SHIFTED)
    cells = partition(scene)
    filters, exact = spatial_filters(scene), spatial_filters(exact_scene)
    assert not (exact & ~filters).any()
    for cell in range(0, len(cells), 5):
        ends = project(scene, states_of_cell(cells.lower[cell], cells.upper[cell], 200, cell))
        for shift in ((-0.99, -0.99), (-0.99, 0.99), (0.99, -0.99), (0.99, 0.99)):
            seen = image_of_ends(ends + np.array(shift), scene.camera.shape).any(axis=0)
            assert not (seen & ~filters[cell]).any()


def test_a_runway_out_of_view_has_an_empty_filter() -> None:
    scene = replace(PAPER, camera=replace(PAPER.camera, principal_point=(320.0, 3000.0)))
    bits, window = spatial_filter(scene, scene.domain.lower, scene.domain.upper)
    assert window == Window(0, 0, 0, 0)
    assert bits.shape == (0, 0)


@given(low=st.floats(-5, 5), width=st.floats(0, 3), bins=st.integers(1, 40))
def test_slices_cover_their_interval_and_share_borders(low: float, width: float, bins: int) -> None:
    parts = sliced(low, low + width, bins)
    assert (parts[0, 0], parts[-1, 1]) == (low, low + width)
    assert (parts[1:, 0] == parts[:-1, 1]).all()
    assert (parts[:, 0] <= parts[:, 1]).all()


def test_the_reference_row_is_where_the_middle_sees_the_runway() -> None:
    cells = partition(PAPER)
    for lower, upper in zip(cells.lower, cells.upper, strict=True):
        theta, _, y, z = (lower + upper) / 2
        row = reference_row(PAPER.camera, lower, upper, 0.15)
        assert row == round(float(row_of_point(PAPER.camera, theta, y, z + 0.15)))
        assert row > PAPER.camera.v0 - PAPER.camera.focal_v_px * np.tan(lower[0])


@given(theta=st.floats(-0.5, 1.4), width=st.floats(0, 0.1), y=st.floats(0.3, 300), z=st.floats(0.1, 3000), v0=st.floats(-1000, 1000))
def test_the_reference_row_keeps_to_the_frame_and_off_the_horizon(theta: float, width: float, y: float, z: float, v0: float) -> None:
    """It is the nearest row in the frame to the one where the runway is seen; a horizon there or below moves it down."""
    camera = Camera(640, 480, 0.02, 1e-5, (320.0, v0))
    lower, upper = np.array([theta, 0.0, y, z]), np.array([theta + width, 0.0, y, z])
    seen = float(row_of_point(camera, theta + width / 2, y, z + 1))
    horizon = v0 - camera.focal_v_px * np.tan(theta)
    try:
        row = reference_row(camera, lower, upper, 1.0)
    except SceneError:
        assert seen <= horizon
        return
    assert row >= 0
    assert row - horizon >= BELOW_HORIZON_PX
    assert row == np.clip(np.round(seen), 0, 480) or row - horizon < 2


def test_a_box_that_has_the_horizon_below_its_runway_is_refused() -> None:
    domain = replace(PAPER.domain, theta_rad=Axis((0.5,), 1.0), y_m=Axis((0.2,), 0.1))
    scene = replace(PAPER, domain=domain)
    with pytest.raises(SceneError, match=r"bank\.pitch_bins: too few for theta in \[0, 1\]"):
        spatial_filter(scene, scene.domain.lower, scene.domain.upper)
    with pytest.raises(SceneError, match=r"domain\.theta_rad: too few cells for theta in \[0, 1\]"):
        cell_windows(replace(scene, bank=WindowedBank()), scene.domain.lower, scene.domain.upper)

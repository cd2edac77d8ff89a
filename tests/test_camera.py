"""The rigid camera against OpenCV, its closed forms, its inverse, its ranges over boxes, and the formula as the paper prints it."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from build_model.partition import partition
from runtime.camera import (
    ground_scale,
    project,
    project_as_printed,
    project_points,
    rigid_state_of_printed,
    row_of_point,
    state_from_ends,
)
from runtime.scene import Axis, Bank, Camera, Domain, Marking, Runway, Scene

Floats = NDArray[np.float64]
RandomStates = Callable[[Scene, int, int], Floats]
ROUNDING_PX = 1e-9
"""Far above float64's error at these sizes (some 1e-13 px), far below anything that a wrong sign or axis would leave."""

GENERAL = Scene(
    camera=Camera(width=1280, height=720, focal_length_m=0.012, pixel_pitch_m=6e-6, principal_point=(611.25, 402.5)),
    runway=Runway((Marking("left edge", -1.5, 0.25, 2.0), Marking("centre line", 0.125, -0.5, 4.0), Marking("far left", -6.0, 1.0, 0.5))),
    domain=Domain(Axis((-0.05, 0.25, 0.55, 0.85), 0.3), Axis((-0.4, 0.4), 0.8), Axis((1.25,), 1.5), Axis((2.0, 4.0), 2.0)),
    bank=Bank(1, 1, 1.0),
)
"""Everything that the paper's scene has not: x free, an off-centre principal point, pitch up and down, markings unlike each other."""
OBLONG = dataclasses.replace(GENERAL, camera=Camera(1280, 720, principal_point=(611.25, 402.5), focal_px=(2100.0, 1980.0)))
"""The same with pixels that are not square."""


# --- the projection ---


def opencv_ends(scene: Scene, state: Floats) -> Floats:
    """OpenCV's projectPoints, axes right, down, forward: the pitch-down camera is a turn of +theta about its first axis."""
    theta, x, y, z = state
    rotation, _ = cv2.Rodrigues(np.array([theta, 0.0, 0.0]))
    translation = -rotation @ np.array([x, -y, -z])
    camera = scene.camera
    intrinsic = np.array([[camera.focal_u_px, 0, camera.u0], [0, camera.focal_v_px, camera.v0], [0, 0, 1]])
    points = np.array([[marking.x_m, 0.0, end] for marking in scene.runway.markings for end in marking.ends_z_m])
    pixels, _ = cv2.projectPoints(points, np.array([theta, 0.0, 0.0]), translation, intrinsic, np.zeros(4))
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2, 2)


@pytest.mark.parametrize("name", ["paper", "general", "oblong"])
def test_the_projection_is_opencvs(name: str, paper_scene: Scene, random_states: RandomStates) -> None:
    scene = {"paper": paper_scene, "general": GENERAL, "oblong": OBLONG}[name]
    states = random_states(scene, 200, 11)
    expected = np.array([opencv_ends(scene, state) for state in states])
    assert np.abs(project(scene, states) - expected).max() < ROUNDING_PX


def test_states_of_any_shape_are_projected_alike(random_states: RandomStates) -> None:
    states = random_states(GENERAL, 6, 12)
    ends = project(GENERAL, states)
    assert ends.shape == (6, 3, 2, 2)
    assert (project(GENERAL, states.reshape(2, 3, 4)) == ends.reshape(2, 3, 3, 2, 2)).all()
    assert (project(GENERAL, states[0].tolist()) == ends[0]).all()


def test_ends_are_near_then_far(paper_scene: Scene) -> None:
    """From above the threshold the near end lies lower in the image, and the left marking left of the right one."""
    (left_near, left_far), (right_near, right_far) = project(paper_scene, [0.6, 0, 0.9, 1.7])
    assert left_near[1] > left_far[1]
    assert right_near[1] > right_far[1]
    assert left_near[0] < left_far[0] < 320 < right_far[0] < right_near[0]


# --- the closed forms ---


PIXELS = pytest.mark.parametrize("scene", [GENERAL, OBLONG], ids=["square", "oblong"])


@PIXELS
def test_the_row_of_an_end_has_a_closed_form(scene: Scene, random_states: RandomStates) -> None:
    states = random_states(scene, 200, 13)
    theta, _, y, z = states.T[:, :, None, None]
    rows = row_of_point(scene.camera, theta, y, scene.runway.ends_z_m + z)
    assert np.abs(rows - project(scene, states)[..., 1]).max() < ROUNDING_PX


@PIXELS
def test_all_points_of_a_marking_lie_on_a_line_that_z_does_not_move(scene: Scene, random_states: RandomStates) -> None:
    """u = u0 + (p_x - x) g(v) at 11 points of each marking, with g from the state's theta and y alone."""
    states = random_states(scene, 200, 14)
    theta, x, y, _ = states.T[:, :, None, None]
    runway = scene.runway
    along = np.linspace(runway.ends_z_m[:, 0], runway.ends_z_m[:, 1], 11, axis=-1)
    points = project_points(scene.camera, states[:, None, None, :], runway.x_m[:, None], along)
    scale = ground_scale(scene.camera, theta, y, points[..., 1])
    assert np.abs(scene.camera.u0 + (runway.x_m[:, None] - x) * scale - points[..., 0]).max() < ROUNDING_PX


def test_the_ground_vanishes_at_one_row(random_states: RandomStates) -> None:
    camera = GENERAL.camera
    for state in random_states(GENERAL, 50, 15):
        theta, _, y, _ = state
        vanishing = camera.v0 - camera.focal_v_px * math.tan(theta)
        assert abs(ground_scale(camera, theta, y, vanishing)) < ROUNDING_PX
        u, v = project_points(camera, state, 3.0, 1e9)
        assert (u, v) == pytest.approx((camera.u0, vanishing), abs=1e-4)
        assert ground_scale(camera, theta, y, vanishing + 1) > 0 > ground_scale(camera, theta, y, vanishing - 1)


# --- the inverse ---


@given(st.floats(0.45, 0.75), st.floats(0.75, 1.05), st.floats(1.55, 1.85), st.integers(0, 1))
def test_two_ends_give_the_state_back(paper_scene: Scene, theta: float, y: float, z: float, marking: int) -> None:
    state = np.array([theta, 0.0, y, z])
    ends = project(paper_scene, state)[marking]
    assert np.abs(state_from_ends(paper_scene, ends, marking) - state).max() < 1e-11


def test_the_inverse_holds_off_centre_and_in_batches(random_states: RandomStates) -> None:
    fixed = dataclasses.replace(GENERAL, domain=dataclasses.replace(GENERAL.domain, x_m=Axis((0.6,), 0.0)))
    states = random_states(fixed, 60, 16).reshape(3, 20, 4)
    for marking in range(3):
        assert np.abs(state_from_ends(fixed, project(fixed, states)[..., marking, :, :], marking) - states).max() < 1e-10


# --- the formula as printed ---


def printed_ends(scene: Scene, state: Floats) -> Floats:
    """Eq. (1), its 4 x 4 matrix applied to homogeneous points: rotate by theta, then translate by the state; then Eq. (3)."""
    theta, x, y, z = state
    cosine, sine = math.cos(theta), math.sin(theta)
    motion = np.array([[1, 0, 0, x], [0, cosine, sine, y], [0, -sine, cosine, z], [0, 0, 0, 1]])
    camera = scene.camera
    intrinsic = np.array([[camera.focal_v_px, 0, camera.u0], [0, -camera.focal_v_px, camera.v0], [0, 0, 1]])
    homogeneous = [[[marking.x_m, 0, end, 1] for end in marking.ends_z_m] for marking in scene.runway.markings]
    q = np.array(homogeneous) @ motion.T[:, :3] @ intrinsic.T
    return q[..., :2] / q[..., 2:]


def test_the_printed_change_of_coordinates_is_equation_1(paper_scene: Scene, random_states: RandomStates) -> None:
    for scene in (paper_scene, GENERAL):
        states = random_states(scene, 100, 17)
        expected = np.array([printed_ends(scene, state) for state in states])
        assert np.abs(project_as_printed(scene, states) - expected).max() < ROUNDING_PX


def test_appendix_a_term_by_term(paper_scene: Scene) -> None:
    theta, x, y, z = 0.55, 0.04, 0.92, 1.71
    focal, p_x, p_z, length = 0.008 / 15e-6, -0.1, 0.0, 0.3
    zeta = [
        focal * (p_x + x) / (p_z * math.cos(theta) + z) + 320,
        -focal * (p_z * math.sin(theta) + y) / (p_z * math.cos(theta) + z) + 240,
        focal * (p_x + x) / ((p_z + length) * math.cos(theta) + z) + 320,
        -focal * ((p_z + length) * math.sin(theta) + y) / ((p_z + length) * math.cos(theta) + z) + 240,
    ]
    assert project_as_printed(paper_scene, [theta, x, y, z])[0].ravel().tolist() == pytest.approx(zeta, abs=ROUNDING_PX)


def test_a_printed_state_is_a_rigid_camera_elsewhere(paper_scene: Scene, random_states: RandomStates) -> None:
    for scene in (paper_scene, GENERAL):
        states = random_states(scene, 200, 18)
        rigid = rigid_state_of_printed(states)
        assert (rigid[:, 1] == -states[:, 1]).all()
        assert np.abs(project(scene, rigid) - project_as_printed(scene, states)).max() < ROUNDING_PX


def test_that_camera_stands_at_minus_r_transposed_t() -> None:
    theta, x, y, z = 0.6, 0.1, 0.9, 1.7
    rotation = np.array([[1, 0, 0], [0, math.cos(theta), math.sin(theta)], [0, -math.sin(theta), math.cos(theta)]])
    centre = -rotation.T @ np.array([x, y, z])
    _, rigid_x, rigid_y, rigid_z = rigid_state_of_printed([theta, x, y, z])
    assert [rigid_x, rigid_y, -rigid_z] == pytest.approx(centre.tolist(), abs=1e-15)


# --- what the paper's experiment shows ---


def box_corners(lower: Floats, upper: Floats) -> Floats:
    """The 16 corners of a box of states, (16, 4)."""
    return np.array(list(itertools.product(*zip(lower, upper, strict=True))))


def depth_range(lower: Floats, upper: Floats, end_z_m: float) -> tuple[float, float]:
    """Exact range of Z = y sin(theta) + d cos(theta) = sqrt(y^2 + d^2) cos(beta - theta), theta in [0, pi/2].

    Z rises in y and d. Along theta it has one maximum, at beta, and so its minimum at an end.
    """
    near, far = end_z_m + lower[3], end_z_m + upper[3]
    smallest = min(lower[2] * math.sin(theta) + near * math.cos(theta) for theta in (lower[0], upper[0]))
    theta = float(np.clip(math.atan2(upper[2], far), lower[0], upper[0]))
    return smallest, upper[2] * math.sin(theta) + far * math.cos(theta)


def in_view(camera: Camera, ends: Floats) -> NDArray[np.bool_]:
    u, v = ends[..., 0], ends[..., 1]
    return (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)


def test_depth_range_contains_every_depth_and_is_attained(paper_scene: Scene) -> None:
    rng = np.random.default_rng(19)
    cells = partition(paper_scene)
    for lower, upper in zip(cells.lower, cells.upper, strict=True):
        for end in (0.0, 0.3):
            low, high = depth_range(lower, upper, end)
            theta, _, y, z = np.concatenate([rng.uniform(lower, upper, (2000, 4)), box_corners(lower, upper)]).T
            depths = y * np.sin(theta) + (z + end) * np.cos(theta)
            assert low - 1e-12 <= depths.min()
            assert depths.max() <= high + 1e-12
            assert depths.min() < low + 1e-12
            assert depths.max() > high - 0.01


def test_the_rigid_camera_sees_the_whole_runway_from_every_state_of_all_27_cells(paper_scene: Scene) -> None:
    """Rows by the corners, columns by the smallest depth; both ends in view put the whole marking there."""
    camera, cells = paper_scene.camera, partition(paper_scene)
    visible = 0
    for lower, upper in zip(cells.lower, cells.upper, strict=True):
        rows = project(paper_scene, box_corners(lower, upper))[..., 1]
        halfwidth = camera.focal_v_px * 0.1 / min(depth_range(lower, upper, end)[0] for end in (0.0, 0.3))
        visible += rows.min() >= 0 and rows.max() < camera.height and halfwidth < camera.width / 2
    assert visible == len(cells) == 27


def test_as_printed_the_runway_is_fully_visible_throughout_no_cell_and_missing_at_24_centres(paper_scene: Scene) -> None:
    camera, cells = paper_scene.camera, partition(paper_scene)
    corners = np.array([box_corners(lower, upper) for lower, upper in zip(cells.lower, cells.upper, strict=True)])
    whole = in_view(camera, project_as_printed(paper_scene, corners)).all(axis=(1, 2, 3))
    assert whole.sum() == 0
    ends = project_as_printed(paper_scene, (cells.lower + cells.upper) / 2)
    above_the_frame = (ends[..., 1] < 0).all(axis=(1, 2))
    assert above_the_frame.sum() == 24
    assert in_view(camera, ends[~above_the_frame]).any(axis=(1, 2)).all()
    assert not in_view(camera, ends).all(axis=(1, 2)).any()


# --- ranges over boxes ---


def random_boxes(scene: Scene, count: int, seed: int) -> list[tuple[Floats, Floats]]:
    ends = np.random.default_rng(seed).uniform(scene.domain.lower, scene.domain.upper, (count, 2, 4))
    return list(zip(ends.min(axis=1), ends.max(axis=1), strict=True))


@pytest.mark.parametrize("name", ["paper", "general"])
def test_rows_rise_in_y_and_fall_in_z_and_theta(name: str, paper_scene: Scene) -> None:
    """So two corners give the exact range over a box: no sample leaves it, and they are attained."""
    scene = paper_scene if name == "paper" else GENERAL
    rng = np.random.default_rng(20)
    for lower, upper in random_boxes(scene, 100, 21):
        highest = project(scene, [lower[0], lower[1], upper[2], lower[3]])[..., 1]
        lowest = project(scene, [upper[0], lower[1], lower[2], upper[3]])[..., 1]
        rows = project(scene, np.concatenate([rng.uniform(lower, upper, (300, 4)), box_corners(lower, upper)]))[..., 1]
        assert np.abs(rows.max(axis=0) - highest).max() < ROUNDING_PX
        assert np.abs(rows.min(axis=0) - lowest).max() < ROUNDING_PX


def columns_over_pitch(scene: Scene, thetas: Floats, y: float, z: float) -> Floats:
    """u of the right marking's near and far end along theta, (thetas, 2)."""
    states = np.stack([thetas, np.zeros_like(thetas), np.full_like(thetas, y), np.full_like(thetas, z)], axis=-1)
    return project(scene, states)[:, 1, :, 0]


def test_the_column_of_an_end_turns_in_pitch_in_11_of_27_cells(paper_scene: Scene) -> None:
    """dZ/dtheta = Z (v - v0)/F changes sign where the end crosses row v0, theta = beta. A column that turns is shown for each."""
    cells = partition(paper_scene)
    turning = 0
    for lower, upper in zip(cells.lower, cells.upper, strict=True):
        thetas = np.linspace(lower[0], upper[0], 200)
        grid = list(itertools.product(np.linspace(lower[2], upper[2], 9), np.linspace(lower[3], upper[3], 9)))
        slopes = np.diff([columns_over_pitch(paper_scene, thetas, y, z) for y, z in grid], axis=1)
        turns = ((slopes < 0).any(axis=1) & (slopes > 0).any(axis=1)).any(axis=0)
        for end, turn in zip((0.0, 0.3), turns.tolist(), strict=True):
            flattest, steepest = math.atan2(lower[2], end + upper[3]), math.atan2(upper[2], end + lower[3])
            assert turn == (max(flattest, lower[0]) < min(steepest, upper[0]))
        turning += turns.any()
    assert turning == 11


def test_corners_alone_miss_up_to_0_03_px_of_an_ends_columns_in_9_of_27_cells(paper_scene: Scene) -> None:
    """The smallest column of an end over a cell, at the largest depth, lies below that of all corners where beta(y_hi, d_hi) is inside.

    No cell of width w in theta can miss more than F p_x/Z (1/cos(w/2) - 1), the gap when beta lies in the middle.
    """
    camera, cells = paper_scene.camera, partition(paper_scene)
    missed = np.zeros((len(cells), 2))
    for cell, (lower, upper) in enumerate(zip(cells.lower, cells.upper, strict=True)):
        columns = project(paper_scene, box_corners(lower, upper))[:, 1, :, 0]
        for index, end in enumerate((0.0, 0.3)):
            offset = camera.focal_v_px * 0.1 / depth_range(lower, upper, end)[1]
            missed[cell, index] = columns[:, index].min() - (camera.u0 + offset)
            beta = math.atan2(upper[2], end + upper[3])
            assert (missed[cell, index] > ROUNDING_PX) == (lower[0] < beta < upper[0])
            assert missed[cell, index] < offset * (1 / math.cos((upper[0] - lower[0]) / 2) - 1)
    assert missed.min() > -ROUNDING_PX
    assert (missed > ROUNDING_PX).any(axis=1).sum() == 9
    assert missed.max() == pytest.approx(0.0300, abs=0.0001)


def test_the_column_of_a_line_at_a_row_turns_in_pitch_where_tan_theta_tau_is_1() -> None:
    """g(v) rises in theta while tan(theta) (v - v0)/F < 1 and falls beyond, whatever the row and the altitude."""
    camera = GENERAL.camera
    for tangent, y in itertools.product((0.5, 1.0, 2.0), (0.3, 1.0, 40.0)):
        turn = math.atan(1 / tangent)
        row = camera.v0 + camera.focal_v_px * tangent
        assert (np.diff(ground_scale(camera, np.linspace(turn - 0.4, turn, 100), y, row)) > 0).all()
        assert (np.diff(ground_scale(camera, np.linspace(turn, turn + 0.4, 100), y, row)) < 0).all()

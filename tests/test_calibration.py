"""How far a camera that is off moves the image: sampled cameras stay below the bound, and nearly reach it."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import OFF_BY, PAPER, Floats

from build_model.calibration import check_calibration, displacement_px
from build_model.window import Window
from runtime.scene import Calibration, SceneError, Tolerance

WINDOW = Window(9, 316, 287, 353)
"""What the paper's runway can light."""


def cross_matrix(axis: Floats) -> Floats:
    return np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])


def rotation(axis: int, angle: float) -> Floats:
    """Rodrigues's formula about a coordinate axis."""
    K = cross_matrix(np.eye(3)[axis])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)


def seen(points: Floats, off: Calibration, signs: tuple[float, ...], roll_first: bool) -> Floats:
    """Points (n, 2) px of an ideal camera as one sees them that is turned, zoomed and shifted by shares `signs` of `off`."""
    camera = PAPER.camera
    centre = np.array([camera.u0, camera.v0])
    rays = np.concatenate([(points - centre) / camera.focal_v_px, np.ones((len(points), 1))], axis=1)
    yaw, roll = rotation(1, signs[0] * off.yaw_rad), rotation(2, signs[1] * off.roll_rad)
    turned = rays @ (yaw @ roll if roll_first else roll @ yaw).T
    zoom = camera.focal_v_px * (1 + signs[2] * off.focal_relative)
    return centre + np.array(signs[3:]) * off.principal_px + zoom * turned[:, :2] / turned[:, 2:]


def border(window: Window, count: int = 9) -> Floats:
    rows, columns = np.linspace(window.top, window.bottom, count), np.linspace(window.left, window.right, count)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


@given(
    roll=st.floats(0, 0.2),
    yaw=st.floats(0, 0.2),
    focal=st.floats(0, 0.2),
    principal=st.floats(0, 5),
    signs=st.tuples(*[st.floats(-1, 1)] * 5),
    window=st.sampled_from([WINDOW, Window(0, 480, 0, 640), Window(300, 480, 0, 100)]),
    roll_first=st.booleans(),
)
def test_no_camera_within_the_calibration_moves_a_point_farther(
    roll: float, yaw: float, focal: float, principal: float, signs: tuple[float, ...], window: Window, roll_first: bool
) -> None:
    """Whichever of the two turns comes first."""
    off = Calibration(roll_rad=roll, yaw_rad=yaw, focal_relative=focal, principal_px=principal)
    points = border(window)
    moved = np.abs(seen(points, off, signs, roll_first) - points).max()
    assert moved <= displacement_px(replace(PAPER, calibration=off), window)


@pytest.mark.parametrize("window", [WINDOW, Window(0, 480, 0, 640)], ids=["runway", "frame"])
def test_the_bound_is_nearly_reached(window: Window) -> None:
    points = border(window)
    for off in (OFF_BY, Calibration(yaw_rad=0.01), Calibration(roll_rad=0.01), Calibration(focal_relative=0.02)):
        farthest = max(
            np.abs(seen(points, off, signs, roll_first=False) - points).max() for signs in itertools.product([-1.0, 0.0, 1.0], repeat=5)
        )
        assert farthest <= displacement_px(replace(PAPER, calibration=off), window) <= 1.1 * farthest


def test_an_exact_camera_moves_nothing() -> None:
    assert displacement_px(PAPER, WINDOW) == 0.0
    assert check_calibration(PAPER, WINDOW) == 0.0


def test_the_tolerance_must_cover_the_displacement_rounded_up() -> None:
    off = Calibration(principal_px=1.2)
    for line_px in (0, 1):
        message = rf"^tolerance\.line_px: found {line_px}, but \[calibration\] can move the markings by 1\.20 px; give 2 or more"
        with pytest.raises(SceneError, match=message):
            check_calibration(replace(PAPER, calibration=off, tolerance=Tolerance(line_px=line_px)), WINDOW)
    assert check_calibration(replace(PAPER, calibration=off, tolerance=Tolerance(line_px=2)), WINDOW) == pytest.approx(1.2, abs=1e-5)


def test_a_shift_of_a_whole_pixel_needs_the_next_one() -> None:
    """The bound is rounded outward, so exactly 1 px is not proved to be covered by 1 px."""
    with pytest.raises(SceneError, match="give 2 or more"):
        check_calibration(replace(PAPER, calibration=Calibration(principal_px=1.0), tolerance=Tolerance(line_px=1)), WINDOW)


def test_a_shift_beyond_the_largest_tolerance_says_how_much_smaller_the_plus_minus_must_be() -> None:
    off = Calibration(roll_rad=0.035, yaw_rad=0.052)
    with pytest.raises(SceneError, match=r"more than the largest line_px, 16; give at most 0\.\d\d of its plus-minus") as refused:
        check_calibration(replace(PAPER, calibration=off), WINDOW)
    share = float(str(refused.value).split("at most ")[1].split()[0])
    less = Calibration(roll_rad=0.035 * share, yaw_rad=0.052 * share)
    assert check_calibration(replace(PAPER, calibration=less, tolerance=Tolerance(line_px=16)), WINDOW) <= 16


def test_a_yaw_that_turns_the_runway_behind_the_camera_is_refused() -> None:
    camera = replace(PAPER.camera, principal_point=(-4000.0, 240.0))
    with pytest.raises(SceneError, match=r"^calibration\.yaw_rad: 0\.4 can turn the runway behind"):
        displacement_px(replace(PAPER, camera=camera, calibration=Calibration(yaw_rad=0.4)), WINDOW)

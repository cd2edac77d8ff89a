"""Roll and yaw as rotations: what they are of the ideal frame, against balls and plain matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flint import arb, arb_mat, ctx
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from turned_state import TurnedState

from runtime import Attitude
from runtime.attitude import SMALLEST_RAD, Angle, Turns, camera_pitch, lead, mounted, seen_pitch
from runtime.scene import LARGEST_TURN_RAD, Mount
from runtime.turn import arctangent

Floats = NDArray[np.float64]
ANGLES = st.floats(-0.5, 0.5).filter(lambda angle: angle == 0 or abs(angle) >= SMALLEST_RAD)
WIDTHS = st.sampled_from([0.0, 0.0, 1e-6, 0.01, 0.1])


def ball_rotation(axis: int, angle: arb) -> arb_mat:
    """About axis 0 (right), 1 (down) or 2 (forward)."""
    cosine, sine = angle.cos(), angle.sin()
    first, second = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = [[arb(row == column) for column in range(3)] for row in range(3)]
    matrix[first][first], matrix[first][second], matrix[second][first], matrix[second][second] = cosine, -sine, sine, cosine
    return arb_mat(matrix)


def camera_rotation(roll: arb, pitch_down: arb, yaw: arb) -> arb_mat:
    """R_z(-roll) R_x(pitch down) R_y(-yaw)."""
    return ball_rotation(2, -roll) * ball_rotation(0, pitch_down) * ball_rotation(1, -yaw)


def around(value: float, width: float, share: float) -> Floats:
    """An interval (1, 2) of that width that holds the value."""
    return np.array([[value - share * width, value + (1 - share) * width]])


def within(value: arb, low: float, high: float) -> bool:
    return bool(value >= arb(low) and value <= arb(high))


@given(tangent=st.floats(-1e6, 1e6))
def test_arctangent_is_close(tangent: float) -> None:
    with ctx.workprec(128):
        (angle,) = arctangent(np.array([tangent]))
        assert abs(arb(angle) - arb(tangent).atan()) <= arb(2) ** -48 * abs(arb(angle)) + arb(2) ** -1000


@given(
    pitch=ANGLES.map(lambda angle: 2.4 * angle), roll=ANGLES, yaw=ANGLES, widths=st.tuples(WIDTHS, WIDTHS, WIDTHS), share=st.floats(0, 1)
)
def test_the_rotation_and_the_pitch_are_those_of_the_matrices(pitch, roll, yaw, widths, share) -> None:
    """R_z(phi) R_x(theta) R_y(-psi) = R_z(a) R_y(b) R_x(c) for a c, and a and b within their distance of the middle."""
    with ctx.workprec(128):
        matrix = camera_rotation(arb(roll), arb(pitch), arb(yaw))
        seen = (arb(pitch).tan() / arb(yaw).cos()).atan()
        rest = matrix * ball_rotation(0, -seen)  # R_z(a) R_y(b)
        a, b = arb.atan2(rest[1, 0], rest[0, 0]), -rest[2, 0].asin()
        assert abs(float(rest[2, 1].mid())) < 1e-15
        theta, rolls, yaws = (around(*each, share) for each in zip((pitch, roll, yaw), widths, strict=True))
        c = seen_pitch(np.clip(theta, -1.5, 1.5), yaws)
        assert within(seen, *c[0])
        assert within(arb(pitch), *camera_pitch(c, yaws)[0])
        ahead = (arb(pitch).cos() * seen.sin() * 2 * (arb(yaw) / 2).sin() ** 2).asin()
        assert abs(float((ahead - (seen - arb(pitch))).mid())) < 1e-30
        assert within(ahead, *lead(c, theta, yaws)[0])
        turns = Turns.of(c, rolls, yaws)
        for angle, cosine, sine, off in ((a, turns.cos_a, turns.sin_a, turns.off_a), (b, turns.cos_b, turns.sin_b, turns.off_b)):
            assert abs(angle - arb.atan2(arb(sine[0]), arb(cosine[0]))) <= arb(off[0])


def test_known_angles_are_known_of_the_rotation() -> None:
    single = np.array([[0.6, 0.6]])
    turns = Turns.of(single, np.array([[0.03, 0.03]]), np.array([[-0.05, -0.05]]))
    assert turns.off[0] < 1e-13
    assert np.ptp(camera_pitch(single, single * 0.1)) < 1e-13
    by_yaw = Turns.of(single, np.zeros((1, 2)), np.array([[-0.051, -0.049]]))
    assert by_yaw.off_b[0] == pytest.approx(0.001 * math.cos(0.6), rel=0.01)
    assert by_yaw.off_a[0] == pytest.approx(0.001 * math.sin(0.6), rel=0.01)


def test_the_angles_of_mount_and_aircraft_do_not_add() -> None:
    attitude, theta = mounted(Mount(pitch_down_rad=0.6), (math.radians(5),) * 2, (0.0, 0.0), (0.0, 0.0))
    assert math.degrees(attitude.roll_rad) == pytest.approx(6.05, abs=0.005)
    assert math.degrees(attitude.yaw_rad) == pytest.approx(-3.41, abs=0.005)
    assert theta[0] <= math.asin(math.sin(0.6) * math.cos(math.radians(5))) <= theta[1]
    assert theta[1] - theta[0] < 1e-12
    assert attitude.roll_plus_minus_rad < 1e-12


@given(
    mount=st.tuples(*(st.floats(-0.3, 0.3) for _ in range(3))),
    angles=st.tuples(*(st.floats(-0.2, 0.2) for _ in range(3))),
    widths=st.tuples(
        WIDTHS.filter(lambda width: width < 0.1), WIDTHS.filter(lambda width: width < 0.1), WIDTHS.filter(lambda width: width < 0.1)
    ),
    share=st.floats(0, 1),
)
def test_a_mounted_cameras_angles_hold_the_true_ones(mount, angles, widths, share) -> None:
    intervals: list[Angle] = [tuple(around(*each, share)[0].tolist()) for each in zip(angles, widths, strict=True)]
    attitude, theta = mounted(Mount(*mount), *intervals)
    if Mount(*mount) == Mount():  # nothing is computed, and balls cannot tell that two numbers are equal
        roll, pitch_down, yaw = intervals
        assert (attitude, theta) == (Attitude.between(roll, yaw), pitch_down)
        return
    with ctx.workprec(128):
        whole = camera_rotation(*map(arb, mount)) * camera_rotation(*map(arb, angles))
        assert within(whole[2, 1].asin(), *theta)
        assert within(-arb.atan2(-whole[0, 1], whole[1, 1]), *attitude.roll)
        assert within(arb.atan2(whole[2, 0], whole[2, 2]), *attitude.yaw)
    slack = 2.5 * sum(widths) + 1e-12
    assert max(theta[1] - theta[0], np.ptp(attitude.roll), np.ptp(attitude.yaw)) <= slack


def test_an_angle_too_small_for_products_is_taken_for_a_larger_one() -> None:
    assert (Attitude(-1e-310, 2e-150).roll, Attitude(-1e-310, 2e-150).yaw) == ((-SMALLEST_RAD, 0.0), (0.0, SMALLEST_RAD))
    assert Attitude(0.0, 1e-99).yaw == (1e-99, 1e-99)
    attitude, _ = mounted(Mount(yaw_rad=7e-243), (0.0, 0.0), (6e-69, 6e-69), (0.0, 0.0))
    assert attitude.roll[0] < -4.2588297931108925e-311 < 0 <= attitude.roll[1]
    assert np.ptp(attitude.roll) <= 2 * SMALLEST_RAD


def test_the_angles_of_a_turned_state_are_those_of_its_matrix() -> None:
    """The cases that other tests are judged by, against plain matrices."""
    state = TurnedState.near(np.array([0.6, 0.0, 1.0, 1.7]), 0.1, -0.07)
    roll, theta, yaw = state.angles
    with ctx.workprec(128):
        expected = ball_rotation(2, arb(0.1)) * ball_rotation(1, arb(-0.07)) * ball_rotation(0, arb(0.6))
        found = camera_rotation(roll, theta, yaw)
        assert all(abs(float((found[row, column] - expected[row, column]).mid())) < 1e-15 for row in range(3) for column in range(3))


TOO_FAR = rf"; give radians, of at most {LARGEST_TURN_RAD} with the plus-minus$"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((math.nan, 0.0), "roll_rad nan .*" + TOO_FAR),
        ((0.0, math.inf), "yaw_rad inf .*" + TOO_FAR),
        ((0.7, 0.0, 0.1), r"roll_rad 0.7 \+- 0.1" + TOO_FAR),
        ((0.0, -3.0), "yaw_rad -3.0 .*" + TOO_FAR),
        ((0.0, 0.0, -0.1), "roll_plus_minus_rad -0.1; give 0 or more$"),
        ((0.0, 0.0, 0.0, math.nan), "yaw_plus_minus_rad nan; give 0 or more$"),
    ],
)
def test_an_attitude_that_makes_no_sense_is_refused(values: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=f"^attitude: found {message}"):
        Attitude(*values)


def test_a_camera_that_looks_away_is_refused() -> None:
    with pytest.raises(ValueError, match="attitude: found a camera that looks a right angle away from the runway"):
        mounted(Mount(yaw_rad=1.0), (0.0, 0.0), (0.0, 0.0), (1.0, 1.0))


def test_intervals_of_an_attitude_hold_what_they_were_made_of() -> None:
    attitude = Attitude.between((-0.1, 0.3), (0.05, 0.05))
    assert attitude.roll[0] <= -0.1
    assert attitude.roll[1] >= 0.3
    assert attitude.yaw == (0.05, 0.05)
    assert Attitude(0.1, 0.0).roll == (0.1, 0.1)

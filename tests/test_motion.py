"""Where a motion takes sets of states: against ball arithmetic on single states at every scale, and on whole sets."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flint import arb
from hypothesis import assume, given
from hypothesis import strategies as st
from scenes import AIRPORT, FREE_X, PAPER, STRIP, Floats, state_sets, states_in
from test_refine_bounds import Sight, sights, spacing

from runtime import Box, Motion
from runtime.camera import ground_scale
from runtime.motion import STANDSTILL, Displacement, moved, moved_box
from runtime.refine.altitude import contract_by_altitude
from runtime.scene import MotionBounds, Scene, SceneError
from runtime.state_set import StateSet, scale_range, tangent_of_row

SCENES = pytest.mark.parametrize("scene", [PAPER, FREE_X, STRIP, AIRPORT], ids=["paper", "free x", "strip", "airport"])
EVERYWHERE = Box([-1.55, -1e6, 1e-3, -1e6], [1.55, 1e6, 1e4, 1e6])


def exactly(step: Floats) -> Displacement:
    return Displacement(step, step)


@given(sight=sights(), turn=st.floats(-0.3, 0.3), climb=st.floats(-0.5, 0.5), ahead=st.floats(-10, 10))
def test_the_scale_of_a_moved_state(sight: Sight, turn: float, climb: float, ahead: float) -> None:
    step = np.array([turn, 0.0, climb * sight.state[2], ahead])
    camera, theta = sight.scene.camera, arb(sight.state[0]) + arb(turn)
    sets = moved(camera, sight.sets(), exactly(step), EVERYWHERE)
    if len(sets) == 0:
        assert abs(float(theta.mid())) > 1.54  # out of the box of all states
        return
    tangent = arb(sets.tangent[0])
    fall = tangent * theta.cos() + theta.sin()
    altitude = arb(sight.state[2]) + arb(step[2])
    scale = sight.camera.focal_v_px * fall / altitude
    low, high = sets.scale[0].tolist()
    assert arb(low) <= scale
    assert scale <= arb(high)
    before = sight.sets()
    near_horizon = float(before.condition[0]) + float(sets.condition[0])
    assert high - low < 64 * (spacing(sight) + 2.0**-46 * near_horizon) * near_horizon * high
    for name, value in (("theta", theta), ("y", altitude), ("z", arb(sight.state[3]) + arb(ahead))):
        side = getattr(sets, name)[0].tolist()
        assert arb(side[0]) <= value <= arb(side[1])


@SCENES
@given(data=st.data())
def test_moved_states_lie_in_the_moved_sets_and_nearly_fill_them(scene: Scene, data: st.DataObject) -> None:
    sets = data.draw(state_sets(scene))
    states = states_in(scene, sets, 300, data.draw(st.integers(0, 1000)))
    assume(len(states) > 20)
    size = scene.domain.upper - scene.domain.lower
    sides = np.array([sorted(data.draw(st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)))) for _ in range(4)]) * size[:, None]
    rng = np.random.default_rng(0)
    share = rng.random((len(states), 4))
    share[::2] = np.round(share[::2])
    # Clipped, as a + (b - a) in floats may lie beyond b.
    after = states + np.clip(sides[:, 0] + share * (sides[:, 1] - sides[:, 0]), sides[:, 0], sides[:, 1])
    domain = Box(scene.domain.lower, scene.domain.upper)
    inside = ((after >= domain.lower) & (after <= domain.upper)).all(axis=1)
    found = moved(scene.camera, sets, Displacement(*sides.T), domain)
    if not inside.any():
        return
    after = after[inside]
    row = scene.camera.v0 + scene.camera.focal_v_px * found.tangent[0]
    scales = ground_scale(scene.camera, after[:, 0], after[:, 2], row)
    for values, side in zip((*after.T, scales), (found.theta, found.x, found.y, found.z, found.scale), strict=True):
        assert side[0, 0] <= values.min()
        assert values.max() <= side[0, 1]
    # Not the product of the worst of pitch and altitude: no wider than what altitude and pitch alone leave.
    alone = scale_range(scene.camera, found.theta, found.y, found.tangent)
    assert found.scale[0, 0] >= alone[0][0] * (1 - 1e-9)
    assert found.scale[0, 1] <= alone[1][0] * (1 + 1e-9)


def test_a_small_motion_keeps_pitch_and_altitude_together() -> None:
    """The scale of a set, which its box leaves open by a fifth, is known to a hundredth after a small motion."""
    camera, row = PAPER.camera, 300.0
    tangent = np.array([float(tangent_of_row(camera, row))])
    theta, y = np.array([[0.5, 0.6]]), np.array([[0.8, 1.0]])
    scale = float(ground_scale(camera, 0.55, 0.9, row))
    sets = StateSet(theta, np.zeros((1, 2)), y, np.array([[1.6, 1.8]]), np.array([[scale, scale * 1.001]]), tangent)
    step = Displacement(np.array([-0.001, 0, -0.001, -0.001]), np.array([0.001, 0, 0.001, 0.001]))
    after = moved(camera, contract_by_altitude(camera, sets), step, EVERYWHERE)
    assert after.scale[0, 1] / after.scale[0, 0] < 1.012
    assert np.divide(*scale_range(camera, theta, y, tangent)[::-1])[0] > 1.2


def test_rates_over_a_time_forth_and_back() -> None:
    motion = Motion([-0.1, 0, 1, -2], [0.2, 0, 3, -1])
    forth, back = motion.over(500_000), motion.over(-500_000)
    np.testing.assert_allclose(forth.lower, [-0.05, 0, 0.5, -1], rtol=1e-12)
    np.testing.assert_allclose(forth.upper, [0.1, 0, 1.5, -0.5], rtol=1e-12)
    np.testing.assert_allclose(back.lower, [-0.1, 0, -1.5, 0.5], rtol=1e-12)
    assert motion.over(0) is STANDSTILL
    lower, upper = moved_box(np.zeros(4), np.zeros(4), forth + back)
    assert (lower <= 0).all()
    assert (upper >= 0).all()


def test_unknown_rates_leave_the_domain() -> None:
    motion = Motion([-np.inf] * 4, [np.inf] * 4)
    domain = Box(PAPER.domain.lower, PAPER.domain.upper)
    middle = domain.centre
    tangent = np.array([0.1])
    scale = float(ground_scale(PAPER.camera, middle[0], middle[2], PAPER.camera.v0 + 0.1 * PAPER.camera.focal_v_px))
    sides = [np.array([[value, value]]) for value in middle]
    after = moved(PAPER.camera, StateSet(*sides, np.array([[scale, scale]]), tangent), motion.over(1), domain)
    np.testing.assert_allclose(after.lower[0], domain.lower, atol=1e-9)
    np.testing.assert_allclose(after.upper[0], domain.upper, atol=1e-9)


@pytest.mark.parametrize(("lower", "upper"), [([0, 0, 0], [1, 1, 1]), ([1, 0, 0, 0], [0, 0, 0, 0]), ([math.nan] * 4, [1] * 4)])
def test_rates_that_are_no_bounds_are_refused(lower: list[float], upper: list[float]) -> None:
    with pytest.raises(ValueError, match=r"^motion: found rates .*; give four ordered pairs of numbers$"):
        Motion(lower, upper)


def test_displacements_name_their_axes() -> None:
    step = STANDSTILL.replaced({"theta": (-0.1, 0.1)})
    assert (step.lower[0], step.upper[0], step.lower[2]) == (-0.1, 0.1, 0)
    with pytest.raises(ValueError, match=r"^displacement: no axis is called 'pitch'; give some of theta, x, y, z$"):
        STANDSTILL.replaced({"pitch": (0, 0)})
    with pytest.raises(ValueError, match=r"^displacement: found 1 to 0 for y; give two ordered numbers$"):
        STANDSTILL.replaced({"y": (1, 0)})


def test_a_scene_has_a_motion_and_an_instant() -> None:
    tables = PAPER.to_dict()
    assert Motion.of(PAPER) is None
    assert "motion" not in tables
    assert PAPER.instant_share == 0.5
    rates = {"theta_rad_s": [-0.1, 0.1], "x_m_s": [0, 0], "y_m_s": [-0.5, 0.0], "z_m_s": [-1, 0]}
    scene = Scene.from_dict(tables | {"motion": rates, "window": {"instant": "end"}})
    motion = Motion.of(scene)
    assert motion is not None
    assert motion.rate_lower.tolist() == [-0.1, 0, -0.5, -1]
    assert scene.instant_share == 1
    assert Scene.from_dict(scene.to_dict()) == scene
    with pytest.raises(SceneError, match=r"^motion\.y_m_s: found \[1, 0\]; give the least and the largest rate, in that order$"):
        replace(scene, motion=MotionBounds((0, 0), (0, 0), (1, 0), (0, 0)))
    with pytest.raises(SceneError, match=r"^window\.instant: found noon; give one of start, middle, end$"):
        Scene.from_dict(tables | {"window": {"instant": "noon"}})
    with pytest.raises(SceneError, match=r"^motion\.z_m_s: found nothing; this key is required$"):
        Scene.from_dict(tables | {"motion": {name: rates[name] for name in rates if name != "z_m_s"}})

"""Exact ranges over sets of states: random states must lie within them after outward rounding, and must nearly fill them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flint import arb, ctx
from hypothesis import assume, given
from hypothesis import strategies as st
from scenes import FREE_X, PAPER, Floats, state_sets, states_in

from build_model.hough_bank import line_boxes
from build_model.partition import partition
from runtime.camera import ground_scale, project, row_of_point
from runtime.rounding import OUTWARD_PX, above, below, float32_above, float32_below, inverted
from runtime.scene import Axis, Camera, Scene
from runtime.state_set import (
    StateSet,
    altitude_range,
    column_range,
    contract,
    end_rows,
    fall,
    fall_range,
    scale_between,
    scale_range,
    scale_ratio,
    tangent_of_row,
)

WIDE = replace(
    FREE_X,
    camera=Camera(width=640, height=480, focal_length_m=0.006, pixel_pitch_m=15e-6, principal_point=(300.0, 200.0)),
    domain=replace(FREE_X.domain, theta_rad=Axis((0.1, 0.4, 0.7), 0.3), x_m=Axis((0.0,), 0.6), y_m=Axis((1.0, 2.0), 1.0)),
)
"""Pitch from -0.05 to 0.85, and altitudes and offsets far beyond the paper's."""
SCENES = pytest.mark.parametrize("scene", [PAPER, FREE_X, WIDE], ids=["paper", "free x", "wide"])


def reference_scale(scene: Scene, sets: StateSet, states: Floats) -> Floats:
    row = scene.camera.v0 + scene.camera.focal_v_px * sets.tangent[0]
    return ground_scale(scene.camera, states[:, 0], states[:, 2], row)


def draw(scene: Scene, data: st.DataObject) -> tuple[StateSet, Floats]:
    """A random set with some hundred of its states."""
    sets = data.draw(state_sets(scene))
    states = states_in(scene, sets, 200, data.draw(st.integers(0, 1000)))
    assume(len(states) > 0)
    return sets, states


@SCENES
@given(data=st.data())
def test_rows_of_ends_lie_in_their_range(scene: Scene, data: st.DataObject) -> None:
    sets, states = draw(scene, data)
    for closer in (sets, contract(scene.camera, sets)):
        for end in scene.runway.ends_z_m[0]:
            low, high = end_rows(scene.camera, closer, float(end))
            rows = row_of_point(scene.camera, states[:, 0], states[:, 2], end + states[:, 3])
            assert (below(low) <= rows).all()
            assert (rows <= above(high)).all()


@SCENES
@given(data=st.data())
def test_contraction_and_altitudes_lose_no_state(scene: Scene, data: st.DataObject) -> None:
    sets, states = draw(scene, data)
    closer = contract(scene.camera, sets)
    low, high = altitude_range(scene.camera, sets)
    for bound, values in ((closer.theta[0], states[:, 0]), (closer.y[0], states[:, 2]), (np.array([low[0], high[0]]), states[:, 2])):
        assert not inverted(bound[0], values).any()
        assert not inverted(values, bound[1]).any()


@SCENES
@given(data=st.data(), shift=st.floats(-8, 8), seed=st.integers(0, 1000))
def test_a_set_that_is_called_empty_has_no_state(scene: Scene, data: st.DataObject, shift: float, seed: int) -> None:
    """The interval of the scale may leave what the box allows, wholly or in part."""
    drawn = data.draw(state_sets(scene))
    sets = replace(drawn, scale=np.maximum(drawn.scale + shift, 1.0))
    closer = contract(scene.camera, sets)
    if inverted(*closer.theta.T)[0] or inverted(*closer.y.T)[0]:
        assert len(states_in(scene, sets, 200, seed)) == 0


def test_a_set_without_states_is_called_empty() -> None:
    """One that a scale beyond what the box allows leaves nothing of."""
    lower, upper = PAPER.domain.lower, PAPER.domain.upper
    theta, x, y, z = np.stack([lower, upper], axis=-1)[:, None]
    low, high = (float(part[0]) for part in scale_range(PAPER.camera, theta, y, np.zeros(1)))
    for scale in ((low - 2, low - 1), (high + 1, high + 2)):
        closer = contract(PAPER.camera, StateSet(theta, x, y, z, np.array([scale]), np.zeros(1)))
        assert inverted(*closer.theta.T)[0] or inverted(*closer.y.T)[0]


@SCENES
@given(data=st.data())
def test_scales_and_columns_lie_in_their_ranges(scene: Scene, data: st.DataObject) -> None:
    """At single rows and between two; `scale_ratio` is claimed below the horizon only, elsewhere it stops at 0."""
    sets, states = draw(scene, data)
    camera = scene.camera
    rows = camera.v0 + camera.focal_v_px * sets.tangent[0] + np.array([-40.0, -7.5, 0.0, 3.25, 60.0])
    tangent = tangent_of_row(camera, rows)[None]
    ratio_low, ratio_high = (bound[:, 0] for bound in scale_ratio(sets, tangent.T))
    own_low, own_high = (bound[0] for bound in scale_between(camera, sets, tangent, tangent))
    span_low, span_high = (bound[0] for bound in scale_between(camera, sets, tangent[:, :1], tangent[:, -1:]))
    held_low, held_high = scale_range(camera, sets.theta[:, None, :], sets.y[:, None, :], tangent)
    for state, reference in zip(states[:50], reference_scale(scene, sets, states), strict=False):
        scale = ground_scale(camera, state[0], state[2], rows)
        seen = scale > 0
        ratio = scale / reference
        assert (~inverted(ratio_low, ratio) & ~inverted(ratio, ratio_high))[seen].all()
        assert (~inverted(own_low, scale) & ~inverted(scale, own_high))[seen].all()
        assert (~inverted(held_low[0], scale) & ~inverted(scale, held_high[0]))[seen].all()
        assert (~inverted(span_low, scale) & ~inverted(scale, span_high))[seen].all()
        across = 0.1 - sets.x[:, ::-1]
        left, right = (bound[0] for bound in column_range(camera, across, (own_low[None], own_high[None])))
        columns = camera.u0 + (0.1 - state[1]) * scale
        assert ((below(left) <= columns) & (columns <= above(right)))[seen].all()


@given(theta=st.floats(-1.2, 1.2), width=st.floats(0, 1.2), share=st.floats(0, 1), tangent=st.floats(-2, 5))
def test_the_fall_peaks_where_a_ray_points_straight_down(theta: float, width: float, share: float, tangent: float) -> None:
    """Claimed for psi = theta + atan(t) within (-pi/2, pi); Arb decides where float64 cannot."""
    stop, angle = min(theta + width, 1.5), np.arctan(tangent)
    assume(-np.pi / 2 < theta + angle and stop + angle < np.pi)
    low, high = (float(bound) for bound in fall_range(np.array([theta, stop]), np.array(tangent)))
    inside = min(theta + share * (stop - theta), stop)
    value = float(fall(inside, tangent))
    if not low <= value <= high:
        ctx.prec = 200
        exact = arb(inside).cos() * arb(tangent) + arb(inside).sin()
        assert float(abs(exact - arb(value))) < 1e-14
        assert low - 1e-14 <= value <= high + 1e-14
        assert (1 + tangent**2) ** 0.5 >= high - 1e-14


def test_the_fall_reaches_its_range() -> None:
    theta = np.linspace(0.2, 1.4, 100_001)
    for tangent in (-0.1, 0.5, 4.0):
        low, high = fall_range(np.array([0.2, 1.4]), np.array(tangent))
        values = fall(theta, tangent)
        assert values.min() == pytest.approx(float(low), abs=1e-12)
        assert values.max() == pytest.approx(float(high), abs=1e-9)


def test_rows_of_ends_nearly_fill_their_range() -> None:
    """Entries of a cell of the paper: the range of an end's row is at most 1.2 times what a thousand states of the entry span."""
    cells = partition(PAPER)
    lower, upper = cells.lower[13], cells.upper[13]
    sets = contract(PAPER.camera, line_boxes(PAPER, lower, upper).states(PAPER.camera, lower, upper))
    ratios = []
    for entry in range(0, len(sets), 3):
        one = sets[np.array([entry])]
        states = states_in(PAPER, one, 1000, entry)
        if len(states) > 300:
            rows = project(PAPER, states)[:, 0, :, 1]
            low, high = end_rows(PAPER.camera, one, PAPER.runway.ends_z_m[0])
            ratios.append((high[0] - low[0]) / np.ptp(rows, axis=0))
    assert len(ratios) > 20
    assert np.median(ratios) < 1.2


def test_a_bound_on_the_scale_draws_the_rows_in() -> None:
    """Without it the rows of an end span the whole box: what makes the entries sharp is the scale."""
    cells = partition(PAPER)
    lower, upper = cells.lower[13], cells.upper[13]
    sets = contract(PAPER.camera, line_boxes(PAPER, lower, upper).states(PAPER.camera, lower, upper))
    low, high = end_rows(PAPER.camera, sets, 0.0)
    loose = replace(sets, y=np.broadcast_to([lower[2], upper[2]], sets.y.shape), scale=np.broadcast_to([1.0, 1000.0], sets.scale.shape))
    loose_low, loose_high = end_rows(PAPER.camera, loose, 0.0)
    assert (high - low <= loose_high - loose_low + OUTWARD_PX).all()
    assert np.median(high - low) < 0.6 * np.median(loose_high - loose_low)


@given(value=st.floats(-1e6, 1e6))
def test_float32_bounds_lie_strictly_outside(value: float) -> None:
    low, high = float32_below(value), float32_above(value)
    assert low.dtype == high.dtype == np.float32
    assert float(low) < value < float(high)
    assert float(high) - float(low) <= 3 * max(float(np.spacing(np.float32(abs(value)))), 2.0**-149)

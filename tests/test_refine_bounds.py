"""The refinement's bounds on a single state, against ball arithmetic, from a drone's altitude to an airliner's, 100 km off the origin."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from flint import arb
from hypothesis import assume, given, reject
from hypothesis import strategies as st
from scenes import PAPER, Floats

from build_model.verify.ball_camera import BallCamera
from runtime.refine.altitude import contract_by_altitude
from runtime.refine.borders import Borders, _column_margins_px, ends_in_rows
from runtime.refine.ground import ground_distances
from runtime.refine.lit_pixels import LitPixels
from runtime.scene import Axis, Camera, Domain, Marking, Runway, Scene, SceneError
from runtime.state_set import StateSet, contract, scale_ratio, tangent_of_row


@dataclass(frozen=True)
class Sight:
    """One state of a scene with one marking, as a set of width 0 whose scale is known to float64's spacing."""

    scene: Scene
    state: Floats
    reference_row: float

    @property
    def camera(self) -> BallCamera:
        return BallCamera(self.scene.camera)

    @property
    def distances(self) -> tuple[arb, arb]:
        """Of the near and of the far end, m."""
        marking = self.scene.runway.markings[0]
        near = arb(self.state[3]) + arb(marking.start_z_m)
        return near, near + arb(marking.length_m)

    def scale(self, row: float) -> arb:
        """g at a row, px per metre."""
        return self.camera.focal_v_px * self.camera.ray(float(self.state[0]), row)[0] / arb(self.state[2])

    def sets(self) -> StateSet:
        scale = float(self.scale(self.reference_row).mid())
        sides = [np.array([[value, value]]) for value in self.state]
        around = np.array([[np.nextafter(scale, 0), np.nextafter(scale, np.inf)]])
        return StateSet(*sides, around, tangent_of_row(self.scene.camera, np.array([self.reference_row])))


def power(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers between two, spread over their orders of magnitude."""
    return st.floats(math.log10(low), math.log10(high)).map(lambda exponent: 10.0**exponent)


@st.composite
def sights(draw: st.DrawFn) -> Sight:
    """A marking ahead whose near end is anywhere, in the frame or far below it."""
    width, height = draw(st.integers(32, 2000)), draw(st.integers(32, 1500))
    camera = Camera(width, height, draw(power(0.6, 8)) * width * 1e-5, 1e-5)
    y, slope = draw(power(0.3, 300)), draw(power(1e-3, 30))  # of altitude over distance
    distance, length = y / slope, draw(power(0.1, 3000))
    assume(distance + length < 5000)
    tangent = draw(st.one_of(st.floats(-1.2, 1.2), st.floats(-100, 100)))
    theta = math.atan(slope) - math.atan(tangent)
    assume(abs(theta) < 1.5)
    shift_x, shift_z = draw(st.sampled_from([0.0, 1e5, -98_765.4])), draw(st.sampled_from([0.0, 1e5, -98_765.4]))
    across = draw(st.floats(-50, 50))
    state = np.array([theta, shift_x, y, shift_z + distance])
    marking = Marking("m", shift_x + across, -shift_z, length)
    axes = [Axis((value,), 0.0) for value in state.tolist()]
    try:
        scene = Scene(camera, Runway((marking,)), Domain(*axes), PAPER.bank)
    except SceneError:  # too near the horizon, or too far from the origin, to be rounded safely
        reject()
    middle = distance + draw(st.floats(0, 1)) * length
    row = float(np.round(camera.v0 + camera.focal_v_px * math.tan(math.atan2(y, middle) - theta)))
    sight = Sight(scene, state, row)
    assume(sight.camera.ray(theta, row)[0] > 1e-5)
    return sight


def spacing(sight: Sight) -> float:
    """What the state's own float64 numbers leave open, relative to angles and distances."""
    nearest = float(sight.distances[0].mid())
    return 2.0**-45 * (2 + float(sight.sets().condition[0]) + abs(sight.scene.runway.ends_z_m).max() / nearest)


@given(sight=sights())
def test_rows_of_ends(sight: Sight) -> None:
    focal, sets = sight.scene.camera.focal_v_px, sight.sets()
    for (low, high), distance in zip(ends_in_rows(sight.scene, sets), sight.distances, strict=True):
        row = sight.camera.row(float(sight.state[0]), arb(sight.state[2]), distance)
        assert arb(low[0, 0]) <= row
        assert row <= arb(high[0, 0])
        tangent = (float(row.mid()) - sight.scene.camera.v0) / focal
        assert high[0, 0] - low[0, 0] < 2.0**-18 + spacing(sight) * 2 * focal * (1 + tangent**2)


@given(sight=sights(), share=st.floats(0, 1))
def test_columns_and_distances_at_a_row_of_the_frame(sight: Sight, share: float) -> None:
    scene, sets = sight.scene, sight.sets()
    row = float(round(share * scene.camera.height))
    fall, reach = sight.camera.ray(float(sight.state[0]), row)
    assume(fall > 1e-5)
    tangent = tangent_of_row(scene.camera, np.array([[row]]))
    low, high = scale_ratio(sets, tangent)
    across = scene.runway.markings[0].x_m - sight.state[1]
    column = sight.camera.u0 + (arb(scene.runway.markings[0].x_m) - arb(sight.state[1])) * sight.scale(row)
    if 0 <= column <= scene.camera.width:
        (margin,) = _column_margins_px(scene, sets)
        sides = [scene.camera.u0 + across * sets.scale[0, side] * ratio[0, 0] for side, ratio in ((0, low), (1, high))]
        assert arb(min(sides) - margin) <= column
        assert column <= arb(max(sides) + margin)
        assert margin < 2.0**-20 + spacing(sight) * 3 * (scene.camera.width + abs(across) * sets.scale[0, 1])
    nearest, farthest = ground_distances(scene.camera, sets, np.array([[row]]), np.array([[row]]))
    distance = arb(sight.state[2]) * reach / fall
    if distance > 0:  # a marking lies ahead
        assert arb(nearest[0, 0]) * (1 - arb(2) ** -46) <= distance  # the last rounding is left to who subtracts an end from it
        assert distance <= arb(farthest[0, 0]) * (1 + arb(2) ** -46)
        terms = (1 + tangent[0, 0] ** 2) * float(arb(sight.state[2]).mid()) / float(fall.mid()) ** 2
        assert farthest[0, 0] - nearest[0, 0] < 8 * spacing(sight) * terms * (1 + abs(tangent[0, 0]))


@given(sight=sights(), share=st.floats(1e-12, 0.5))
def test_altitude_and_scale_bound_each_other(sight: Sight, share: float) -> None:
    scene = sight.scene
    for axis in ("y", "scale"):
        sets = sight.sets()
        true = arb(sight.state[2]) if axis == "y" else sight.scale(sight.reference_row)
        getattr(sets, axis)[:] *= [1 - share, 1 + share]
        low, high = getattr(contract_by_altitude(scene.camera, sets), axis)[0].tolist()
        assert arb(low) <= true
        assert true <= arb(high)
        assert high - low < 4 * spacing(sight) * high


@given(sight=sights(), share=st.floats(1e-12, 0.5))
def test_contraction_keeps_the_state_straight_down_too(sight: Sight, share: float) -> None:
    sets = sight.sets()
    sets.theta[:] += [-share, share]
    sets.y[:] *= [1 - share, 1 + share]
    assume(abs(sets.theta).max() < math.pi / 2)
    assume((np.cos(sets.theta) * sets.tangent[:, None] + np.sin(sets.theta)).min() > 1e-6)
    closer = contract(sight.scene.camera, sets)
    assert closer.theta[0, 0] <= sight.state[0] <= closer.theta[0, 1]
    assert closer.y[0, 0] <= sight.state[2] <= closer.y[0, 1]


def test_rows_out_of_the_frame_are_not_looked_at() -> None:
    """A set whose marking starts a million rows below the frame has the frame's rows, and one on either side."""
    camera = Camera(640, 480, 1646e-5, 1e-5)
    state = np.array([0.0, 0.0, 10.0, 0.0144])
    domain = Domain(*(Axis((value,), 0.0) for value in state.tolist()))
    scene = Scene(camera, Runway((Marking("m", -22.5, 0.0, 2500.0),)), domain, PAPER.bank)
    pixels = LitPixels.of(np.zeros(camera.shape, dtype=bool), (slice(None), slice(None)), beyond=True)
    borders = Borders.of(scene, Sight(scene, state, 253.0).sets(), pixels)
    assert borders.near[0][0, 0] > 1e6
    assert len(borders.row) <= camera.height + 3
    assert borders.crossed[:, 1:-1].sum() == camera.height - 246  # from the row of the far end down to the frame's lower border

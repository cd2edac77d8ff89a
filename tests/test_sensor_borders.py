"""Borders of a rolled and yawed sensor: what they say of a set holds of its exact states, at every scale, and is narrow where it can be."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import examples
from test_contractors import CONTRACTORS, WHOLE, Case, cases, clutter_of, spoiled, whole_markings
from test_optics import BARREL, PINCUSHION
from turned_state import TurnedState

from runtime.refine.lit_pixels import LitPixels
from runtime.refine.optics import STILL_PX, Optics
from runtime.refine.sensor_borders import SensorBorders
from runtime.refine.sight import Sight
from runtime.scene import Calibration, Distortion, SceneError

Frame = NDArray[np.bool_]
LARGEST_RAD = math.radians(10)


@dataclass(frozen=True)
class TurnedCase:
    """A case whose camera is rolled and yawed: its set has roll and yaw, its image is the sensor's own."""

    case: Case
    turned: TurnedState

    def seen(self, frame: Frame, budget: int, optics: Optics | None = None) -> Sight:
        """What the sensor's frame shows of the set."""
        return Sight.of(self.case.scene, self.case.sets, LitPixels.of(frame, WHOLE, beyond=True), budget, None, optics)

    @property
    def borders(self) -> SensorBorders:
        return SensorBorders.of(self.case.scene, self.case.sets, LitPixels.of(self.case.image, WHOLE, beyond=True))


@st.composite
def turned(draw: st.DrawFn, flat: st.SearchStrategy[Case], lenses: tuple[Distortion | None, ...] = (None,)) -> TurnedCase:
    """Turned by up to 10 degrees, behind one of the lenses; roll and yaw are known to a plus-minus of up to 0.6 degrees."""
    case = draw(flat)
    camera = replace(case.scene.camera, distortion=draw(st.sampled_from(lenses)))
    case = replace(case, scene=replace(case.scene, camera=camera))
    angle = st.one_of(st.just(0.0), st.floats(-LARGEST_RAD, LARGEST_RAD))
    state = TurnedState(case.state, *(Fraction(math.tan(draw(angle) / 2)) for _ in "ab"))
    plus_minus = [draw(st.sampled_from([0.0, 0.0, 1e-4, 1e-3, 1e-2])) for _ in "ab"]
    assume(abs(float(state.angles[2].mid())) < 0.7)
    attitude = state.attitude(np.random.default_rng(draw(st.integers(0, 1000))), *plus_minus)
    sets = replace(case.sets, roll=np.array([attitude.roll]), yaw=np.array([attitude.yaw]))
    return TurnedCase(replace(case, sets=sets, image=state.view(case.scene).image(case.state).frame), state)


@pytest.mark.parametrize("name", [name for name in CONTRACTORS if name != "vouched"])
@examples(150)
@given(turned=turned(cases()), data=st.data())
def test_a_contractor_keeps_the_state_whatever_the_turn(name: str, turned: TurnedCase, data: st.DataObject) -> None:
    frame, missed = spoiled(turned.case, data, 4, clutter_of(turned.case, data))
    assert turned.case.held_by(CONTRACTORS[name](turned.case.sets, turned.seen(frame, missed)))


@pytest.mark.parametrize("still_px", [STILL_PX, math.inf])
@pytest.mark.parametrize("name", [name for name in CONTRACTORS if name != "vouched"])
@examples(40)
@given(turned=turned(cases(), (None, BARREL, PINCUSHION)), data=st.data())
def test_a_contractor_keeps_the_state_behind_a_lens(name: str, still_px: float, turned: TurnedCase, data: st.DataObject) -> None:
    """Of a pinhole, too, which is read so where its attitude is known to pixels alone. Bounds on the sway hold for any plus-minus."""
    case = turned.case
    try:
        optics = Optics.of(case.scene.camera, Calibration())
    except SceneError:  # a lens that folds within the frame
        assume(False)
        raise
    frame, missed = spoiled(case, data, 4, clutter_of(case, data))
    with patch("runtime.refine.optics.STILL_PX", still_px):
        assert case.held_by(CONTRACTORS[name](case.sets, turned.seen(frame, missed, optics)))


@examples(150)
@given(turned=turned(cases()))
def test_ends_and_crossings_are_seen_where_the_borders_say(turned: TurnedCase) -> None:
    """The rows of ends, and the columns in which the markings' lines meet borders of the sensor, by exact projection."""
    case, borders = turned.case, turned.borders
    view = turned.turned.view(case.scene)
    for number, stripe in enumerate(view.stripes):
        try:
            near, far = (view.project(case.state, stripe.x, z) for z in (stripe.near_z, stripe.far_z))
        except ValueError:  # behind the camera
            continue
        for (_, row), (low, high) in ((near, borders.near), (far, borders.far)):
            assert low[number, 0] <= row <= high[number, 0]
        if near[1] == far[1]:
            continue
        for place, row in enumerate(borders.row[:, 0].tolist()):
            column = near[0] + (far[0] - near[0]) * (Fraction(row) - near[1]) / (far[1] - near[1])
            if min(near[1], far[1]) <= row <= max(near[1], far[1]):
                assert borders.columns[0][number, place, 0] <= column <= borders.columns[1][number, place, 0] + 1
            if borders.crossed[number, place, 0]:
                assert far[1] < row < near[1]


@pytest.mark.parametrize("calibration", [None, Calibration(), Calibration(roll_rad=1e-5)])
@examples(20)
@given(turned=turned(whole_markings()), share=st.floats(0, 1))
def test_a_marking_through_a_corner_of_pixels_keeps_its_state(calibration: Calibration | None, turned: TurnedCase, share: float) -> None:
    """It lights one pixel above the border and the one diagonally below; also read as behind a lens, and as of a camera that may be off."""
    case, view = turned.case, turned.turned.view(turned.case.scene)
    stripe, state = view.stripes[0], case.state
    (near, far) = (view.project(state, stripe.x, z) for z in (stripe.near_z, stripe.far_z))
    rows = range(math.floor(far[1]) + 2, math.ceil(near[1]) - 1)
    assume(len(rows) > 0)
    row = rows[int(share * (len(rows) - 1))]
    column = round(far[0] + (near[0] - far[0]) * (row - far[1]) / (near[1] - far[1]))
    aside = view.aside(state, Fraction(column), Fraction(row))
    assert aside is not None
    state = replace(state, x=stripe.x - state.y * aside)
    sets = replace(case.sets, x=float(state.x) + np.array([[-1.0, 1.0]]) * 2.0**-30)
    case = replace(case, state=state, sets=sets, image=view.image(state).frame)
    assert case.held_by(sets)
    optics = None if calibration is None else Optics.of(case.scene.camera, calibration)
    sight = Sight.of(case.scene, sets, LitPixels.of(case.image, WHOLE, beyond=True), 0, None, optics)
    for contract in CONTRACTORS.values():
        assert case.held_by(contract(sets, sight))


@examples(60)
@given(turned=turned(whole_markings()))
def test_an_exact_attitude_costs_next_to_nothing(turned: TurnedCase) -> None:
    """Where roll and yaw are known, a clean frame tells the offset of a marking in view to about a pixel, as the ideal frame does."""
    case = turned.case
    exact = turned.turned.attitude(np.random.default_rng(0))
    sets = replace(case.sets, roll=np.array([exact.roll]), yaw=np.array([exact.yaw]), scale=case.sets.scale * np.array([0.97, 1.03]))
    whole = case.image.any() and not any(side.any() for side in (case.image[0], case.image[-1], case.image[:, 0], case.image[:, -1]))
    assume(whole)
    sight = Sight.of(case.scene, sets, LitPixels.of(case.image, WHOLE, beyond=True), 0, None)
    crossed = np.flatnonzero(sight.borders.crossed[0, :, 0])
    assume(len(crossed) > 0)
    low, high = CONTRACTORS["offsets"](sets, sight).scale[0]
    across = abs(float(Fraction(case.scene.runway.x_m[0]) - case.state.x))
    widths = sight.halves.last - sight.halves.first + 1
    least = widths[:, :, :, 0][sight.crossed[..., 0]].min()
    assert (high - low) * across <= (least + 0.2) * max(1.0, 1 / sight.borders.view.fall.max() * 2) or high - low < 0.06 * high

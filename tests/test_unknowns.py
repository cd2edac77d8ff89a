"""What a camera may be off by shifts and shears offsets by the same parameters: the shift that goes with a shear, in fractions."""

from __future__ import annotations

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rational_image import RationalState, RationalView
from scenes import PAPER, examples
from test_contractors import CONTRACTORS, WHOLE, Case

from runtime.refine.lit_pixels import LitPixels
from runtime.refine.optics import Optics
from runtime.refine.sight import Sight
from runtime.refine.unknowns import Common, Unknowns
from runtime.scene import Axis, Calibration, Camera, Domain, Marking, Runway, Scene
from runtime.state_set import StateSet, tangent_of_row

FOCAL_PX = 512.0
number = st.floats(-2, 2, allow_nan=False).map(lambda value: round(value, 6))
share = st.sampled_from([-1.0, 1.0, 0.0]) | st.floats(-1, 1).map(lambda value: round(value, 3))


@st.composite
def unknowns(draw: st.DrawFn) -> Unknowns:
    """Of one set, whose w is known exactly, with five parameters of sizes far apart."""
    c, k = (tuple(np.array([draw(number) * draw(st.sampled_from([1.0, 1e-3, 0.0]))]) for _ in range(5)) for _ in range(2))
    off = tuple(np.array([draw(st.sampled_from([0.0, 1e-5, 1e-3, 2e-3]))]) for _ in range(5))
    nothing = np.zeros(1)
    return Unknowns(c, k, (nothing,) * 5, Common((nothing,) * 5, nothing, nothing, nothing), off, np.array([FOCAL_PX]))


def total(parts: tuple[np.ndarray, ...], by: list[Fraction]) -> Fraction:
    return sum((Fraction(float(part[0])) * each for part, each in zip(parts, by, strict=True)), Fraction(0)) * Fraction(FOCAL_PX)


@examples(200)
@given(unknowns=unknowns(), shares=st.tuples(*[share] * 5), grown=st.sampled_from([1.0, 0.7]), wide=st.sampled_from([0.0, 1e-6, 0.3]))
def test_the_shift_that_goes_with_a_shear_is_within_its_range(
    unknowns: Unknowns, shares: tuple[float, ...], grown: float, wide: float
) -> None:
    by = [Fraction(each) * Fraction(float(off[0])) * Fraction(grown) for each, off in zip(shares, unknowns.off, strict=True)]
    kappa, shift = total(unknowns.k, by), total(unknowns.c, by)
    least, most = np.nextafter(float(kappa), -np.inf) - wide, np.nextafter(float(kappa), np.inf) + wide
    low, high = unknowns.shifted_px(np.array([least]), np.array([most]))
    assert Fraction(float(low[0])) <= shift <= Fraction(float(high[0]))


def largest_at(unknowns: Unknowns, kappa: float) -> float:
    """The largest shift at a shear: of a linear programme with one equation, at most one parameter is not at a bound."""
    c, k, off = (np.concatenate(side) for side in (unknowns.c, unknowns.k, unknowns.off))
    c, k = c * off * FOCAL_PX, k * off * FOCAL_PX
    best = -np.inf
    for free in range(5):
        others = [number for number in range(5) if number != free]
        for signs in itertools.product((-1.0, 1.0), repeat=4):
            rest = kappa - float(np.dot(k[others], signs))
            if k[free] != 0 and abs(rest / k[free]) <= 1 + 1e-12:
                best = max(best, float(np.dot(c[others], signs)) + c[free] * rest / k[free])
    return best


def test_the_range_is_reached() -> None:
    rng = np.random.default_rng(3)
    nothing = np.zeros(1)
    for _ in range(50):
        c, k, off = (tuple(np.array([value]) for value in rng.uniform(low, high, 5)) for low, high in ((-2, 2), (-2, 2), (1e-4, 2e-3)))
        each = Unknowns(c, k, (nothing,) * 5, Common((nothing,) * 5, nothing, nothing, nothing), off, np.array([FOCAL_PX]))
        kappa = rng.uniform(-0.9, 0.9) * each.sheared_px
        low, high = each.shifted_px(kappa, kappa)
        assert abs(high[0] - largest_at(each, float(kappa[0]))) < 1e-7
        assert abs(low[0] + largest_at(each, -float(kappa[0]))) < 1e-7
        whole_low, whole_high = each.shifted_px(-each.sheared_px, each.sheared_px)
        alone = sum(abs(float(part[0])) * float(one[0]) for part, one in zip(c, off, strict=True)) * FOCAL_PX
        assert abs(whole_high[0] - alone) < 1e-7
        assert abs(whole_low[0] + alone) < 1e-7
        assert high[0] - low[0] < 2 * alone


def at_its_limits(yaw: float, aside: float) -> Case:
    """Two markings, the left one below the camera but for a share `aside` of its altitude, seen with so much of yaw.

    The left one runs through a corner of pixels near its near end, the right one through one near its far end. Of the set all but x is
    known, which is as far to one side as it may be.
    """
    camera, runway = Camera(640, 480, focal_px=(500.0, 500.0)), Runway((Marking("left", 0.0, 0.0, 30.0), Marking("right", 10.0, 0.0, 30.0)))
    about = RationalState.near([0.5, -10 * aside, 10.0, 13.0])
    scene = Scene(camera, runway, Domain(*(Axis((float(value),), 0.0) for value in about.floats)), PAPER.bank)
    view, corners = replace(RationalView.of(scene.to_dict()), yaw=-Fraction(yaw) / 2), []  # less than tan(yaw/2): within the plus-minus
    for place, (near, far) in enumerate(view.segments(about)):
        row = int(far[1]) + 6 if place else int(near[1]) - 6
        column = round(far[0] + (near[0] - far[0]) * (row - far[1]) / (near[1] - far[1]))
        corners.append(view.aside(about, Fraction(column), Fraction(row)))
    left, right = corners
    assert left is not None
    assert right is not None
    y = 10 / (right - left)
    state = replace(about, x=-left * y, y=y)
    image = view.image(state).frame
    sides = [np.array([[np.nextafter(value, -np.inf), np.nextafter(value, np.inf)]]) for value in state.floats]
    sides[0] += np.array([[-1, 1]]) * 2.0**-40
    sides[1] = abs(state.floats[1]) * np.array([[-1, 1]]) * (1 + 2.0**-13)
    case = Case(scene, state, StateSet(*sides, scale=np.zeros((1, 2)), tangent=tangent_of_row(camera, np.array([300]))), image)
    case.sets.scale[:] = float(case.scale()) * (1 + np.array([[-1, 1]]) * 2.0**-40)
    assert case.held_by(case.sets)
    return case


@pytest.mark.parametrize("yaw", [2e-3, 2e-4, 2e-5])
def test_a_stretch_holds_offsets_far_from_its_middle(yaw: float) -> None:
    """Clutter left of a marking makes stretches of its rows wide: what scales offsets moves those at their ends by another amount."""
    case = at_its_limits(yaw, 0.1)
    frame = case.image.copy()
    frame[:, :400] = np.cumsum(case.image[:, 399::-1], axis=1)[:, ::-1] > 0
    optics = Optics.of(case.scene.camera, Calibration(yaw_rad=yaw))
    sight = Sight.of(case.scene, case.sets, LitPixels.of(frame, WHOLE, beyond=True), 0, None, optics)
    for contract in CONTRACTORS.values():
        assert case.held_by(contract(case.sets, sight))

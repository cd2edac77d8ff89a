"""Refinement behind a lens, and of a camera that may be off: the true state stays, judged in balls, and what is left is narrow."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest
from flint import arb, ctx
from hypothesis import assume, given
from hypothesis import strategies as st
from rational_image import RationalState, RationalView
from scenes import FREE_X, PAPER, examples
from test_contractors import WHOLE, Case, cases, clutter_of, spoiled
from test_lens import FISHEYE, WIDE

from runtime import Box, Estimator, Scene
from runtime.motion import tilted
from runtime.on_sensor import refined
from runtime.refine.ends import contract_by_ends
from runtime.refine.lit_pixels import LitPixels
from runtime.refine.optics import Optics
from runtime.refine.refiner import Refiner
from runtime.refine.sensor_borders import SensorBorders
from runtime.refine.sight import Sight
from runtime.refine.slices import covering
from runtime.scene import Axis, Calibration, Camera, Distortion, Domain, Marking, Runway, SceneError
from runtime.state_set import StateSet

BARREL, PINCUSHION = (Distortion("radial-tangential", k) for k in ((-0.28, 0.07, 0.0, 0.0), (0.2, 0.0, -0.001, 0.001)))
LENSES = (None, BARREL, WIDE, PINCUSHION, FISHEYE)
OFF = Calibration(roll_rad=math.radians(0.05), yaw_rad=math.radians(0.05), focal_relative=0.001, principal_px=0.3)
FAR_OFF = Calibration(roll_rad=0.003, yaw_rad=0.003, focal_relative=0.01, principal_px=2.0)
CALIBRATIONS = (
    Calibration(),
    OFF,
    FAR_OFF,
    Calibration(roll_rad=0.002),
    Calibration(yaw_rad=0.002),
    Calibration(focal_relative=0.003),
    Calibration(principal_px=1.0),
)
SHARES = st.sampled_from([-1.0, 1.0, 0.0, 0.4])
FREE = [0, 2, 3]


@dataclass(frozen=True)
class OffCase:
    """A case whose camera has a lens and is off: `case.scene` states what by at most, `view` is the camera itself."""

    case: Case
    parts: tuple[Optics, ...]
    view: RationalView


def off_view(scene: Scene, shares: list[float]) -> RationalView:
    """The camera that is off by these shares of the scene's plus-minus."""
    view, off = RationalView.of(scene.to_dict()), scene.calibration
    roll, yaw, zoom, right, down = (
        Fraction(share) * Fraction(bound)
        for share, bound in zip(shares, (off.roll_rad, off.yaw_rad, off.focal_relative, off.principal_px, off.principal_px), strict=True)
    )
    # x/2 is less than tan(x/2): within the bounds
    return replace(
        view,
        roll=roll / 2,
        yaw=yaw / 2,
        focal_u=view.focal_u * (1 + zoom),
        focal_v=view.focal_v * (1 + zoom),
        u0=view.u0 + right,
        v0=view.v0 + down,
    )


@st.composite
def off(draw: st.DrawFn) -> OffCase:
    """Behind one of the lenses, off by the whole of a plus-minus or by part of it."""
    case = draw(cases())
    distortion, calibration = draw(st.sampled_from(LENSES)), draw(st.sampled_from(CALIBRATIONS))
    assume(distortion is not None or not calibration.exact)
    camera = replace(case.scene.camera, distortion=distortion)
    try:
        scene = replace(case.scene, camera=camera, calibration=calibration)
        parts = Optics.parts_of(scene)
    except SceneError:
        assume(False)
        raise
    view = off_view(scene, [draw(SHARES) for _ in range(5)])
    image = view.image(case.state).frame
    assume(image.any())
    return OffCase(replace(case, scene=scene, image=image), parts, view)


@examples(12)
@given(off=off(), data=st.data())
def test_the_refinement_keeps_the_state_whatever_the_lens_and_the_camera(off: OffCase, data: st.DataObject) -> None:
    case = off.case
    frame, missed = spoiled(case, data, 4, clutter_of(case, data))
    left = refined(Refiner(case.scene, missed, -1), off.parts, frame, case.sets, narrowed=data.draw(st.booleans()))
    assert any(case.held_by(left[np.array([number])]) for number in range(len(left)))


def test_a_tilt_may_put_an_end_behind_the_camera() -> None:
    """Low over the threshold: the plus-minus of the principal point is a pitch by which the near end would lie behind the camera."""
    for distortion, off_px in ((BARREL, 0.003), (None, 0.003), (BARREL, 0.0)):
        camera = Camera(179, 77, focal_px=(105.0, 110.0), principal_point=(92.0, 39.0), distortion=distortion)
        runway = Runway((Marking("m", 9.5, 5577.5, 319.0),))
        domain = Domain(Axis((4e-6,), 6e-6), Axis((0.0,), 0.05), Axis((4.6,), 0.1), Axis((-5577.49994,), 2e-5))
        scene = Scene(camera, runway, domain, PAPER.bank, calibration=Calibration(focal_relative=4e-6, principal_px=off_px))
        sets = covering(camera, Box(domain.lower, domain.upper), camera.v0)
        for shares in ([0.0] * 5, [0, 0, 1, 1, 1], [0, 0, -1, 1, -1]):
            state = RationalState.near((domain.lower + domain.upper) / 2)
            frame = off_view(scene, shares).image(state).frame
            assert frame.any()
            left = refined(Refiner(scene, 0, -1), Optics.parts_of(scene), frame, sets, narrowed=False)
            assert any(
                state.within(*(getattr(left[np.array([number])], side)[0] for side in ("lower", "upper"))) for number in range(len(left))
            )


@pytest.mark.parametrize(
    "calibration", [Calibration(focal_relative=f, principal_px=p) for f, p in ((0.08, 0.33), (0.03, 0.1), (0.01, 0.05))]
)
def test_ends_are_kept_where_focal_lengths_are_off_by_more_than_the_centre(calibration: Calibration) -> None:
    """A set that is thin in all but z, its near end a hair above a border: where that is met moves far, and the tilt's part with it."""
    camera, y = Camera(640, 480, focal_px=(350.0, 350.0)), 10.0
    optics, tangent = Optics.of(camera, calibration), (400 - 240) / 350
    tried = 0
    for border, column, theta in itertools.product(range(330, 479, 12), (5, 100, 635), (-0.1, 0.0, 0.1, 0.25)):
        state = RationalState.near(np.array([theta, 0.0, y, 0.0]))
        view = off_view(replace(PAPER, camera=camera, calibration=calibration), [0, 0, -1, 1, 1])
        near_m, p_x = ground_of(view, state, column, border)
        if near_m <= 0:
            continue
        start_m = math.nextafter(near_m, math.inf)
        domain = Domain(*(Axis((float(value),), 0.0) for value in state.floats))
        scene = Scene(camera, Runway((Marking("m", p_x, start_m, 3 * start_m),)), domain, PAPER.bank, calibration=calibration)
        frame = off_view(scene, [0, 0, -1, 1, 1]).image(state).frame
        pitch = float(state.floats[0]) - calibration.principal_px / (350 * (1 - calibration.focal_relative))
        scale = 350 * (math.cos(pitch) * tangent + math.sin(pitch)) / y
        if frame[border:].any() or not frame.any() or scale <= 0:
            continue
        thin = (np.array([[low, high]]) for low, high in ((0.0, 0.0), (y, y), (-start_m / 5, start_m / 5)))
        pitches, scales = pitch + 2.0**-45 * np.array([[-1, 1]]), scale * (1 + 1e-12 * np.array([[-1, 1]]))
        sets = StateSet(pitches, *thin, scales, np.array([tangent]))
        low, high = contract_by_ends(sets, Sight.of(scene, sets, LitPixels.of(frame, WHOLE, beyond=True), 0, None, optics)).z[0]
        assert low <= 0 <= high
        tried += 1
    assert tried > 50


def ground_of(view: RationalView, state: RationalState, column: int, row: int) -> tuple[float, float]:
    """How far ahead and aside of the aircraft the ground lies that a level camera shows there; 0 where it shows none, or almost none."""
    right, down = (Fraction(column) - view.u0) / view.focal_u, (Fraction(row) - view.v0) / view.focal_v
    cosine, sine = (1 - state.tangent**2) / (1 + state.tangent**2), 2 * state.tangent / (1 + state.tangent**2)
    fall, ahead = cosine * down + sine, cosine - sine * down
    if fall <= Fraction(1, 50) or ahead <= 0:
        return 0.0, 0.0
    return float(ahead * state.y / fall), float(right * state.y / fall)


def by_lens(view: RationalView, x: arb, y: arb) -> tuple[arb, arb]:
    """OpenCV's models of a lens, term by term."""
    if view.lens is None:
        return x, y
    k, square = [arb(float(value)) for value in view.lens.coefficients], x * x + y * y
    if view.lens.fisheye:
        angle = square.sqrt().atan()
        scale = angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[2] * angle**6 + k[3] * angle**8) / square.sqrt()
        return x * scale, y * scale
    k1, k2, p1, p2, k3 = [*k, arb(0)][:5]
    scale = 1 + k1 * square + k2 * square**2 + k3 * square**3
    return x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x), y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y


def shown(view: RationalView, state: RationalState, x: Fraction, z: Fraction) -> tuple[arb, arb]:
    """Column and row of a ground point, as a ball."""
    right, down, ahead = (arb(part.numerator) / part.denominator for part in view.in_camera(state, x, z))
    across, below = by_lens(view, right / ahead, down / ahead)
    column, row = (arb(side.numerator) / side.denominator for side in (view.u0, view.v0))
    focal_u, focal_v = (arb(side.numerator) / side.denominator for side in (view.focal_u, view.focal_v))
    return column + focal_u * across, row + focal_v * below


@examples(20)
@given(off=off())
def test_ends_and_borders_are_met_where_the_borders_say(off: OffCase) -> None:
    """Rows of ends, and columns in which markings meet borders of the sensor, found by halving; in the part with the true focal length."""
    case, view = off.case, off.view
    zooms = (abs(float(view.focal_u) / part.camera.focal_u_px - 1) - part.calibration.focal_relative for part in off.parts)
    optics = min(zip(zooms, off.parts, strict=True), key=lambda pair: pair[0])[1]
    zoom = optics.camera.focal_u_px / case.scene.camera.focal_u_px
    sets = replace(case.sets, scale=case.sets.scale * zoom * (1 + np.array([-1, 1]) * 2.0**-40))
    sets = tilted(optics.camera, sets, optics.tilt)
    scene = replace(case.scene, camera=optics.camera)
    borders = SensorBorders.of(scene, sets, LitPixels.of(case.image, WHOLE, beyond=True), optics)
    with ctx.workprec(100):
        for number, stripe in enumerate(view.stripes):
            assume(min(view.in_camera(case.state, stripe.x, z)[2] for z in (stripe.near_z, stripe.far_z)) > 0)
            ends = [shown(view, case.state, stripe.x, z) for z in (stripe.near_z, stripe.far_z)]
            crossed = np.flatnonzero(borders.crossed[number, :, 0])
            if len(crossed):
                for (_, row), (low, high) in zip(ends, (borders.near, borders.far), strict=True):
                    assert row > float(low[number, 0]) - 1e-9 or not math.isfinite(low[number, 0])
                    assert row < float(high[number, 0]) + 1e-9 or not math.isfinite(high[number, 0])
            for place in (*crossed[:2], *crossed[-2:]):
                row = float(borders.row[place, 0])
                assert ends[1][1] < row < ends[0][1]
                column = column_at(view, case.state, stripe.x, (stripe.near_z, stripe.far_z), row)
                assert borders.columns[0][number, place, 0] <= column <= borders.columns[1][number, place, 0] + 1


def column_at(view: RationalView, state: RationalState, x: Fraction, ends: tuple[Fraction, Fraction], row: float) -> float:
    """The column in which the marking meets a row between its ends, by halving its length."""
    near, far = ends
    for _ in range(60):
        middle = (near + far) / 2
        if shown(view, state, x, middle)[1] > row:
            near = middle
        else:
            far = middle
    return float(shown(view, state, x, (near + far) / 2)[0].mid())


# --- tightness ---


def extents(model: Estimator, scene: Scene, frames: int, shares: Callable[[np.random.Generator], list[float]]) -> np.ndarray:
    """Half-widths of what the refinement leaves for a scene with the model's domain, over those of the model's own boxes, medians."""
    rng, ratios = np.random.default_rng(4), []
    refiner, parts = Refiner(scene, 0, -1), Optics.parts_of(scene)
    lower, upper = scene.domain.lower, scene.domain.upper
    for _ in range(frames):
        state = RationalState.near(lower + rng.uniform(0.02, 0.98, 4) * (upper - lower))
        ideal = RationalView.of(model.scene.to_dict()).image(state).frame
        entries = model._entries.sets(model.find(ideal).passes)
        frame = off_view(scene, shares(rng)).image(state).frame
        left = refined(refiner, parts, frame, entries, narrowed=False)
        box = model.estimate(ideal).box
        assert box is not None
        lower_left, upper_left = left.lower.min(axis=0), left.upper.max(axis=0)
        assert state.within(lower_left, upper_left)
        ratios.append(((upper_left - lower_left) / 2, box.half_widths))
    own, level = np.median(ratios, axis=0)
    return own[FREE] / level[FREE]


def exact(_: np.random.Generator) -> list[float]:
    return [0.0] * 5


def any_camera(rng: np.random.Generator) -> list[float]:
    return rng.uniform(-1, 1, 5).tolist()


@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_a_lens_that_is_known_costs_next_to_nothing(lens: Distortion, estimator_of: Callable[..., Estimator]) -> None:
    free = estimator_of("free x")
    scene = replace(FREE_X, camera=replace(FREE_X.camera, distortion=lens))
    assert (extents(free, scene, 8, exact) < 1.3).all()


@pytest.mark.parametrize(
    ("calibration", "most"),
    [
        (Calibration(roll_rad=OFF.roll_rad, yaw_rad=OFF.yaw_rad), 1.0),
        (Calibration(principal_px=OFF.principal_px), 1.05),
        (OFF, 1.15),
    ],
    ids=["rotation", "principal", "all"],
)
def test_a_plus_minus_costs_what_it_hides(calibration: Calibration, most: float) -> None:
    """On the paper's own scene, whose x is fixed; a tolerance of a whole pixel costs five times as much.

    A camera that is not in the middle sees its two markings differently, which tells more than what is not known of it hides.
    """
    paper = Estimator.load()
    assert (extents(paper, replace(PAPER, calibration=calibration), 4, any_camera) < most).all()


def test_a_pinhole_that_is_known_has_no_optics() -> None:
    assert Optics.parts_of(PAPER) == ()
    assert len(Optics.parts_of(replace(PAPER, calibration=OFF))) == 4
    assert len(Optics.parts_of(replace(PAPER, calibration=Calibration(principal_px=0.5)))) == 1


def test_a_tilted_set_holds_its_states_at_every_pitch() -> None:
    theta, x, y, z = (np.array([[low, high]]) for low, high in ((0.5, 0.52), (0.0, 0.0), (0.9, 0.92), (1.7, 1.8)))
    sets = StateSet(theta, x, y, z, np.zeros((1, 2)), np.zeros(1))
    fall = np.sin([0.5, 0.52])
    sets = replace(sets, scale=500 * np.array([[fall[0] / 0.92, fall[1] / 0.9]]))
    camera = replace(PAPER.camera, focal_px=(500.0, 500.0), focal_length_m=None, pixel_pitch_m=None)
    more = tilted(camera, sets, 0.01)
    for theta, y, by in ((0.5, 0.92, -0.01), (0.52, 0.9, 0.01), (0.51, 0.91, 0.0)):
        scale = 500 * (math.cos(theta + by) * more.tangent[0] + math.sin(theta + by)) / y
        assert more.theta[0, 0] <= theta + by <= more.theta[0, 1]
        assert more.scale[0, 0] <= scale <= more.scale[0, 1]

"""Frames of a drawn camera: a state, how the camera is turned and what is told of it, clutter, dark pixels and budgets.

A frame is judged for its own state, and for others whose runways were drawn as clutter, some of them by a camera that is turned a little
otherwise, as what is told of it allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from coverage.frames import Picture, everything, keep_out_of_spatial_mask, longer_markings, neighbourhood, put_out, speckle
from coverage.scenarios import camera_off
from coverage.states import Stage, image_of, into_domain, nudge, uniform
from random_scenes.frames import ORDERS, DrawnFrame, faces_if_any
from random_scenes.pitched_state import as_fixed
from random_scenes.sights import Rng
from rational_image import RationalState, RationalView
from turned_state import TurnedState

from cameras.attitudes import KNOWN, Shares, Told, draw_told, draw_turn, turned_by
from runtime import Attitude, Estimator

CLUTTER = {"no clutter": 0.3, "clutter 0-2%": 0.25, "clutter 2-20%": 0.2, "second runway": 0.15, "other": 0.1}
DENSITY = {"clutter 0-2%": (0.0, 0.02), "clutter 2-20%": (0.02, 0.2), "second runway": (0.0, 0.02)}
OTHERS = (everything, longer_markings, neighbourhood)
STATES = {"state anywhere": 0.4, "state on faces": 0.2, "an end on a border of rows": 0.2, "a marking through a corner": 0.2}
TURNED_ORDERS = {name: order for name, order in ORDERS.items() if name != "dark in K"}
"""K is of the ideal frame, which a turned camera does not show."""
UNREFINED = 0.2
"""Share of the frames that are judged without refinement too."""
MOST_MISSED = 8
OFF_AND_LEVEL = 0.2
"""How much more often a camera that may be off is level, and nothing told of its attitude."""
EXTRA = (0, 1, 3, 8)
VOUCHED = {True: 0.4, False: 0.1}
"""How often a pinhole's model has a budget of Theorem B, which a level camera's frames keep; with an attitude it is not used."""
BUDGETED = {True: "Theorem B", False: "Theorem B's budget, with an attitude"}
TRIES = 20


@dataclass(frozen=True)
class Sight:
    """A state, and the camera that a frame of it is taken by: turned, and off by its calibration.

    `counted`: the camera whose image may lack no more pixels than the budget: of a level pinhole the scene's own, as its calibration is
    part of `line_px`.
    """

    state: TurnedState
    view: RationalView
    counted: RationalView


@dataclass(frozen=True)
class TurnedFrame(DrawnFrame):
    """A frame, the sights that are drawn in it, the true one first, what is told of the camera, and how it is estimated."""

    sights: tuple[Sight, ...]
    told: Told
    refine: tuple[bool, ...]


def draw_frame(rng: Rng, stage: Stage, estimator_of: Callable[[int], Estimator], shares: Shares = KNOWN) -> TurnedFrame:
    """A frame; `estimator_of` loads the model with a budget m, `shares` says how often the attitude is known how well."""
    estimator, off = estimator_of(0), stage.scene.calibration
    level = estimator.attitude is None and bool(rng.random() < shares["level"] + OFF_AND_LEVEL * (not off.exact))
    most = min(estimator.largest_missed_budget, MOST_MISSED)
    missed = int(rng.integers(1, most + 1)) if most > 0 and rng.random() < 0.35 else 0
    extra = int(rng.choice(EXTRA)) if stage.view.lens is None and rng.random() < VOUCHED[level] else -1
    kind = str(rng.choice(list(STATES), p=list(STATES.values())))
    camera = camera_off(rng, stage if level else without_turn(stage))
    seen = as_fixed(stage, (faces_if_any if kind == "state on faces" else uniform)(rng, stage))
    turned = TurnedState(seen, Fraction(0), Fraction(0)) if level else draw_turn(rng, seen, estimator.known_attitude(None))
    view = camera if level else turned.turned(camera)
    if kind in MOVED:
        turned = MOVED[kind](rng, stage, turned, view)
    told = draw_told(rng, estimator, turned, level, shares)
    sights = [Sight(turned, view, stage.counted(view) if level else view)]
    picture, clutter = drawn(rng, stage, estimator, sights, told, level)
    if level and extra >= 0:
        keep_out_of_spatial_mask(rng, picture, extra)
    order = str(rng.choice(list(TURNED_ORDERS)))
    if missed:
        put_out(picture, TURNED_ORDERS[order](rng, picture), missed)
    refine = (True, False) if rng.random() < UNREFINED else (True,)
    kinds = (kind, clutter, *told.kinds, *((order, "m > 0") if missed else ("m = 0",)), *((BUDGETED[level],) if extra >= 0 else ()))
    return TurnedFrame(picture, (missed, extra), (*kinds, "all"), None, tuple(sights), told, refine)


def without_turn(stage: Stage) -> Stage:
    """The stage of a camera that is not off in roll and yaw: of a turned one, readings are."""
    calibration = replace(stage.scene.calibration, roll_rad=0.0, yaw_rad=0.0)
    return replace(stage, scene=replace(stage.scene, calibration=calibration))


def drawn(rng: Rng, stage: Stage, estimator: Estimator, sights: list[Sight], told: Told, level: bool) -> tuple[Picture, str]:
    """The picture of the first sight with clutter over it, and the clutter's kind; adds the sight of a second runway."""
    true = sights[0]
    tolerance = stage.scene.tolerance if level else replace(stage.scene.tolerance, line_px=estimator.beside_px)
    own = replace(stage, view=true.counted, scene=replace(stage.scene, tolerance=tolerance))
    runway = image_of(true.view, true.state.seen).frame
    picture = Picture(own, true.view, [true.state.seen], runway, runway.copy())
    clutter = str(rng.choice(list(CLUTTER), p=list(CLUTTER.values())))
    if clutter == "second runway":
        sights.append(other_sight(rng, stage, true, estimator.known_attitude(told.attitude), level))
        picture.frame |= image_of(sights[1].view, sights[1].state.seen).frame
    if clutter in DENSITY:
        speckle(rng, picture, *DENSITY[clutter])
    if clutter == "other":
        OTHERS[rng.integers(len(OTHERS))](rng, picture)
    return picture, clutter


def other_sight(rng: Rng, stage: Stage, true: Sight, attitude: Attitude | None, level: bool) -> Sight:
    """Another state of the domain, a hair to all of the domain away, by a camera that is turned as may be, too."""
    spread = 10.0 ** rng.uniform(-3, 0) * (stage.upper - stage.lower)
    floats = np.clip(true.state.seen.floats + rng.uniform(-1, 1, 4) * spread, stage.lower, stage.upper)
    seen = as_fixed(stage, into_domain(stage, RationalState.near(floats)))
    if attitude is None or level:
        return Sight(replace(true.state, seen=seen), true.view, true.counted)
    state = turned_by(seen, *(float(rng.uniform(low, high)) for low, high in (attitude.roll, attitude.yaw)))
    view = state.turned(true.view)
    return Sight(state, view, view)


def on_a_border(rng: Rng, stage: Stage, state: TurnedState, view: RationalView) -> TurnedState:
    """The state with z so changed that an end of a marking comes to lie on the closest border of rows, or a hair beside it.

    With right, down and depth affine in the distance, down - tau depth is 0 there, tau = (row - v0)/F_v. Behind a lens the border is one
    of what a pinhole would show.
    """
    for _ in range(TRIES):
        stripe = view.stripes[rng.integers(len(view.stripes))]
        p_z = stripe.near_z if rng.random() < 0.5 else stripe.far_z
        points = [view.in_camera(state.seen, stripe.x, place) for place in (p_z, p_z + 1)]
        if points[0][2] <= 0:
            continue
        tau = (round(view.v0 + view.focal_v * points[0][1] / points[0][2]) - view.v0) / view.focal_v
        at, beyond = (down - tau * depth for _, down, depth in points)
        if at != beyond:
            moved = replace(state.seen, z=state.seen.z + at / (at - beyond) + nudge(rng))
            if stage.contains(moved):
                return replace(state, seen=moved)
    return state


def through_a_corner(rng: Rng, stage: Stage, state: TurnedState, view: RationalView) -> TurnedState:
    """The state with x, or y where x is known, so changed that a marking passes through the closest corner of pixels, or a hair beside it.

    Behind a lens the corner is one of what a pinhole would show.
    """
    for _ in range(TRIES):
        stripe = view.stripes[rng.integers(len(view.stripes))]
        right, down, depth = view.in_camera(state.seen, stripe.x, stripe.near_z + (stripe.far_z - stripe.near_z) * Fraction(rng.random()))
        if depth <= 0:
            continue
        column, row = round(view.u0 + view.focal_u * right / depth), round(view.v0 + view.focal_v * down / depth)
        aside = view.aside(state.seen, Fraction(column), Fraction(row))
        if aside is None or aside == 0:
            continue
        if stage.lower[1] < stage.upper[1]:
            moved = replace(state.seen, x=stripe.x - state.seen.y * aside + nudge(rng))
        else:
            moved = replace(state.seen, y=(stripe.x - state.seen.x) / aside + nudge(rng))
        if stage.contains(moved):
            return replace(state, seen=moved)
    return state


MOVED = {"an end on a border of rows": on_a_border, "a marking through a corner": through_a_corner}
"""What moves a state to where its kind says."""

"""Frames of a drawn scene: states, clutter, dark pixels and budgets put together at random, each frame another mixture.

The layers, states and orders are those of the coverage campaign, and some that a scene of any size needs: distances are shares of the
domain here, rows next to the frame's borders go dark, and an angle that the scene fixes is held exactly.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from coverage.frames import (
    Picture,
    Pixels,
    anywhere,
    everything,
    longer_markings,
    must_light,
    neighbourhood,
    one_end,
    row_band,
    speckle,
)
from coverage.scenarios import Layer, Order, Scenario, State
from coverage.states import Rng, Stage, cut_by_the_frame, image_of, into_domain, on_faces, on_pixel_borders, uniform
from rational_image import RationalState

from random_scenes.extremes import Extreme, extreme_state
from random_scenes.models import BuiltScene
from random_scenes.outcomes import Kinds
from random_scenes.pitched_state import as_fixed

Budgets = tuple[int, int]
"""m and e; e = -1 is Theorem A."""

EXTRA = (0, 1, 3, 8)
"""Budgets e of Theorem B."""


def drawn_by(states: State) -> State:
    """States of the domain, whose pitch is exactly the scene's where it is fixed."""
    return lambda rng, stage: as_fixed(stage, states(rng, stage))


def faces_if_any(rng: Rng, stage: Stage) -> RationalState:
    """On faces of cells; anywhere if no axis has a width."""
    return on_faces(rng, stage) if (stage.lower < stage.upper).any() else uniform(rng, stage)


STATES: dict[str, State] = {
    "state anywhere": drawn_by(uniform),
    "state on faces": drawn_by(faces_if_any),
    "state on pixel borders": drawn_by(on_pixel_borders),
    "state barely in view": drawn_by(cut_by_the_frame),
}


def other_runway(rng: Rng, picture: Picture) -> None:
    """The runway as another state of the domain shows it, a hair to all of the domain away."""
    stage, true = picture.stage, picture.states[0].floats
    spread = 10.0 ** rng.uniform(-3, 0) * (stage.upper - stage.lower)
    floats = np.clip(true + rng.uniform(-1, 1, 4) * spread, stage.lower, stage.upper)
    other = as_fixed(stage, into_domain(stage, RationalState.near(floats)))
    picture.states.append(other)
    picture.frame |= image_of(picture.camera, other).frame


def dense(low: float, high: float) -> Layer:
    """Speckle of a density between `low` and `high`."""
    return functools.partial(speckle, low=low, high=high)


FEW = dense(0.0, 0.05)
CLUTTER: dict[str, tuple[float, tuple[Layer, ...]]] = {
    "no clutter": (0.25, ()),
    "clutter 0-5%": (0.2, (FEW,)),
    "clutter 5-100%": (0.13, (dense(0.05, 1.0),)),
    "all lit": (0.07, (everything,)),
    "second runway": (0.12, (other_runway, FEW)),
    "markings drawn longer": (0.11, (longer_markings,)),
    "neighbourhood lit": (0.12, (neighbourhood,)),
}
"""How often each is drawn, and the layers."""


def beside_borders(_rng: Rng, picture: Picture) -> Pixels:
    """The runway's pixels, those closest to a border of the frame first."""
    image = image_of(picture.camera, picture.states[0])
    height, width = picture.frame.shape
    distance = np.minimum.reduce([image.rows, height - 1 - image.rows, image.columns, width - 1 - image.columns])
    return image.flat[np.argsort(distance, kind="stable")]


ORDERS: dict[str, Order] = {
    "dark anywhere": anywhere,
    "dark at an end of one marking": one_end,
    "dark in consecutive rows": row_band,
    "dark in K": must_light,
    "dark beside borders": beside_borders,
}


@dataclass(frozen=True)
class DrawnFrame:
    """A picture, the budgets that it keeps, and the kinds that it belongs to. `extreme` is one of the picture's states, if any."""

    picture: Picture
    budgets: Budgets
    kinds: Kinds
    extreme: Extreme | None


def draw_budgets(rng: Rng, built: BuiltScene) -> tuple[Budgets, ...]:
    """Budgets that one model is tried with: its own, none, the most that it takes, and some between, with Theorem B and without."""
    most, own = built.most_missed, built.drawn.scene.tolerance
    some = [int(rng.integers(0, min(most, 12) + 1)), int(rng.integers(0, most + 1))]
    extra = [int(each) for each in rng.choice(EXTRA, 2)]
    pairs = [(0, -1), (most, -1), (some[0], -1), (0, extra[0]), (some[1], extra[1]), (own.missed_budget, own.extra_budget)]
    return tuple(dict.fromkeys(pairs))


def draw_frame(rng: Rng, built: BuiltScene, budgets: Sequence[Budgets]) -> DrawnFrame:
    """A frame for one of the budgets; Theorem B's keeps what is lit in S beside the runway to e pixels."""
    missed, extra = chosen = budgets[int(rng.integers(len(budgets)))]
    state, order = str(rng.choice(list(STATES))), str(rng.choice(list(ORDERS)))
    clutter = str(rng.choice(list(CLUTTER), p=[share for share, _ in CLUTTER.values()]))
    scenario = Scenario("", CLUTTER[clutter][1], STATES[state], missed=(missed,), order=ORDERS[order], extra=(extra,))
    picture, *_ = scenario.draw(rng, built.stage)
    extreme = extreme_state(rng, picture, missed)
    if extreme is not None:
        picture.states.append(extreme.state)
    theorem = "theorem B" if extra >= 0 else "m = |K| - 1" if missed == built.most_missed > 0 else f"m {'>' if missed else '='} 0"
    return DrawnFrame(picture, chosen, (*built.drawn.kinds, state, clutter, *((order,) if missed else ()), theorem), extreme)

"""The scenarios of the coverage campaign: states, clutter, missed pixels and budgets put together.

A picture starts with the runway, seen by a camera that may be off by its scene's calibration (`rational_image`). Layers of clutter are
laid over it, and pixels of the runway put out until the frame lacks exactly as many as the scenario says.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from rational_image import RationalState, RationalView

from coverage.frames import (
    Picture,
    Pixels,
    anywhere,
    everything,
    keep_out_of_spatial_mask,
    longer_markings,
    must_light,
    neighbourhood,
    one_end,
    put_out,
    recorded,
    row_band,
    second_runway,
    speckle,
)
from coverage.states import (
    Rng,
    Stage,
    cut_by_the_frame,
    image_of,
    into_domain,
    on_faces,
    on_pixel_borders,
    outside,
    tangent_within,
    uniform,
)

State = Callable[[Rng, Stage], RationalState]
Layer = Callable[[Rng, Picture], None]
Order = Callable[[Rng, Picture], Pixels]


@dataclass(frozen=True)
class Scenario:
    """What is drawn. One of `missed` and one of `extra` are the budgets of a frame; extra -1 is Theorem A."""

    name: str
    layers: tuple[Layer, ...] = ()
    states: State = uniform
    model: str = "given"
    missed: tuple[int, ...] = (0,)
    order: Order = anywhere
    extra: tuple[int, ...] = (-1,)
    runway: bool = True

    def draw(self, rng: Rng, stage: Stage) -> tuple[Picture, int, int]:
        """A picture, and the budgets m and e that it keeps."""
        missed, extra = int(rng.choice(self.missed)), int(rng.choice(self.extra))
        state, camera = self.states(rng, stage), camera_off(rng, stage)
        runway = image_of(camera, state).frame if self.runway else np.zeros(stage.view.shape, dtype=np.bool_)
        picture = Picture(stage, camera, [state], runway, runway.copy())
        for layer in self.layers:
            layer(rng, picture)
        if extra >= 0:
            keep_out_of_spatial_mask(rng, picture, extra)
        put_out(picture, self.order(rng, picture) if missed and self.runway else np.array([], dtype=np.int64), missed)
        if not stage.contains(state):
            picture.states.append(into_domain(stage, state))
        return picture, missed, extra


def camera_off(rng: Rng, stage: Stage) -> RationalView:
    """A camera within the scene's calibration, every second time at its bounds."""
    off, view = stage.scene.calibration, stage.view
    if off.exact:
        return view
    shares = rng.choice([-1.0, 1.0], 5) if rng.random() < 0.5 else rng.uniform(-1, 1, 5)
    bounds = (off.roll_rad, off.yaw_rad, off.focal_relative, off.principal_px, off.principal_px)
    roll, yaw, zoom, right, down = (share * bound for share, bound in zip(shares.tolist(), bounds, strict=True))
    return replace(
        view,
        roll=tangent_within(roll, -off.roll_rad, off.roll_rad),
        yaw=tangent_within(yaw, -off.yaw_rad, off.yaw_rad),
        focal_u=view.focal_u * (1 + Fraction(zoom)),
        focal_v=view.focal_v * (1 + Fraction(zoom)),
        u0=view.u0 + Fraction(right),
        v0=view.v0 + Fraction(down),
    )


def between(low: float, high: float) -> Layer:
    """Speckle of a density between `low` and `high`."""
    return functools.partial(speckle, low=low, high=high)


def scenarios(recording: bool, largest_missed: int) -> Iterator[Scenario]:
    """All that is measured, in the order of the table; no more pixels are missed than `largest_missed`."""
    some, few, every = between(0.02, 0.02), between(0.0, 0.05), between(0.0, 1.0)
    m = tuple(count for count in (1, 3, 8) if count <= largest_missed) or (0,)
    most = m[-1:]
    near, far = functools.partial(second_runway, within=0.03), functools.partial(second_runway, within=0.3)
    for density in (0.0, 0.01, 0.02, 0.05, 0.2):
        yield Scenario(f"clutter {density:.0%}", (between(density, density),))
    if recording:
        yield Scenario("real clutter", (recorded,))
    yield Scenario(f"{most[0]} missed, clutter 2%", (some,), missed=most)
    yield Scenario("camera off, clutter 2%", (some,), model="tolerant")
    for missed in ((0,), most):
        yield Scenario(f"clutter alone 1-5%, m = {missed[0]}", (between(0.01, 0.05),), missed=missed, runway=False)
    yield Scenario("outside the domain by up to 0.05", (few,), functools.partial(outside, by=0.05))
    yield Scenario("just outside the domain", (few,), functools.partial(outside, by=1e-4))
    yield Scenario("clutter 0-100%", (every,))
    yield Scenario("on faces, edges, corners of cells", (few,), on_faces)
    yield Scenario("on pixel borders", (few,), on_pixel_borders)
    yield Scenario("a second runway, near", (near, few))
    yield Scenario("a second runway, far", (far, few))
    yield Scenario("markings drawn longer", (longer_markings, few))
    yield Scenario("neighbourhood lit", (neighbourhood,), missed=(0, *m), order=must_light)
    yield Scenario("all lit but the missed", (everything,), missed=(0, *m), order=must_light)
    yield Scenario("missed at one end", (few,), missed=m, order=one_end)
    yield Scenario("missed in neighbouring rows", (few,), missed=m, order=row_band)
    yield Scenario("missed in K", (few,), missed=m, order=must_light)
    yield Scenario("missed in K, on faces", (few,), on_faces, missed=m, order=must_light)
    yield Scenario("missed at one end, on pixel borders, second runway", (near, few), on_pixel_borders, missed=m, order=one_end)
    yield Scenario("B: clutter outside S", (few,), extra=(0,))
    yield Scenario("B: clutter 0-100% outside S, on faces", (every,), on_faces, extra=(0,))
    yield Scenario("B: e pixels in S", (few,), extra=(1, 3, 8))
    yield Scenario("B: e pixels in S, on pixel borders", (few,), on_pixel_borders, extra=(0, 1, 3, 8))
    yield Scenario("B: e pixels in S, missed at one end", (few,), missed=m, order=one_end, extra=(0, 1, 3, 8))
    yield Scenario("camera off, on faces, clutter 0-100%", (every,), on_faces, "tolerant")
    yield Scenario("camera off, missed in neighbouring rows", (few,), model="tolerant", missed=m, order=row_band)
    yield Scenario("camera off, a second runway", (near, few), model="tolerant")
    yield Scenario("camera off, B: e pixels in S", (few,), model="tolerant", extra=(0, 1, 3, 8))
    for lens in ("barrel", "wide", "pincushion", "fisheye"):
        yield Scenario(f"a {lens} lens", (few,), model=f"{lens} lens", missed=(0, 0, 1, 2))
        yield Scenario(f"a {lens} lens, on faces, clutter 0-100%", (every,), on_faces, f"{lens} lens")
    yield Scenario("a wide lens, missed at one end, a second runway", (near, few), model="wide lens", missed=(1, 2), order=one_end)
    yield Scenario("a wide lens, all lit but the missed", (everything,), model="wide lens", missed=(0, 1, 2), order=must_light)
    yield Scenario("a wide lens, camera off", (few,), model="wide lens, off", missed=(0, 0, 1))
    yield Scenario("a wide lens, camera off, on faces", (few,), on_faces, "wide lens, off")
    for side in ("left", "top", "bottom"):
        yield Scenario(f"cut by the {side} border", (few,), cut_by_the_frame, f"cut {side}")
        yield Scenario(f"cut by the {side} border, camera off", (few,), cut_by_the_frame, f"cut {side}, tolerant")
    for place in ("above", "below"):
        yield Scenario(f"a marking barely {place} the frame, camera off", (few,), cut_by_the_frame, f"barely {place}")
        yield Scenario(f"the same {place}, B: e pixels in S", (few,), cut_by_the_frame, f"barely {place}", extra=(0, 1, 3, 8))

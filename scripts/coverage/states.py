"""The states of the coverage campaign: random ones, and those where a bound is most likely to be wrong.

Faces, edges and corners of cells, ends and crossings on the borders of pixels, both also a hair beside; just outside of the domain; runways
that the frame's border cuts. All are rational (`rational_image`), and on the face or border exactly where they say so.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from rational_image import Frame, RationalState, RationalView, RunwayImage, angle_is_at_least, turn

from build_model.partition import Partition, partition
from runtime import Estimator, Scene
from runtime.camera import project

Rng = np.random.Generator
Floats = NDArray[np.float64]

NUDGES = (2.0**-60, 1e-15, 1e-12, 1e-9, 1e-6)
"""Distances from a face or a border, rad or m: below float64's spacing, just above it, and so on."""
TRIES = 60
"""Draws of a state that must meet a condition, before one that does not is taken."""


@dataclass(frozen=True)
class Stage:
    """A model, its scene as the build has it and as rational numbers, and a recording's frames if there is one."""

    path: str
    recording: str | None
    scene: Scene
    view: RationalView

    @staticmethod
    @functools.cache
    def of(path: str, recording: str | None) -> Stage:
        """The stage of a model's file, one a process."""
        scene = Estimator.load(path).scene
        return Stage(path, recording, scene, RationalView.of(scene.to_dict()))

    @functools.cached_property
    def cells(self) -> Partition:
        """The scene's cells."""
        return partition(self.scene)

    @functools.cached_property
    def lower(self) -> Floats:
        """Smallest state of the domain, (4,)."""
        return self.scene.domain.lower

    @functools.cached_property
    def upper(self) -> Floats:
        """Largest state of the domain, (4,)."""
        return self.scene.domain.upper

    def counted(self, camera: RationalView) -> RationalView:
        """The camera whose image a frame must not lack: the scene's own, up to the tolerance; behind a lens the one that took the frame."""
        return self.view if camera.lens is None else camera

    def cells_of(self, state: RationalState) -> list[int]:
        """Numbers of the cells that hold a state, borders included."""
        cells, floats = self.cells, state.floats
        nearby = ((cells.lower <= floats + 1e-9) & (floats - 1e-9 <= cells.upper)).all(axis=1)
        return [cell for cell in np.flatnonzero(nearby).tolist() if state.within(cells.lower[cell], cells.upper[cell])]

    def contains(self, state: RationalState) -> bool:
        """True if the state lies in the domain."""
        return state.within(self.lower, self.upper) and (self.scene.domain.glide is None or len(self.cells_of(state)) > 0)

    def altitudes_at(self, z: Fraction) -> tuple[float, float]:
        """Smallest and largest altitude of the domain's states at a distance, exactly."""
        domain = self.scene.domain
        borders = domain.z_m.borders.tolist()
        met = [cell for cell, (near, far) in enumerate(itertools.pairwise(borders)) if near <= z <= far]
        altitudes = domain.altitude_borders[met]
        return float(altitudes[:, 0].min()), float(altitudes[:, -1].max())

    def unwitnessed(self, image: RunwayImage, frame: Frame) -> int:
        """Number of pixels of an image without a lit pixel of the frame within the tolerance; what is out of view counts as lit."""
        line_px, (height, width) = self.scene.tolerance.line_px, frame.shape
        seen = np.zeros(len(image.rows), dtype=np.bool_)
        for down, right in itertools.product(range(-line_px, line_px + 1), repeat=2):
            rows, columns = image.rows + down, image.columns + right
            out_of_view = (rows < 0) | (rows >= height) | (columns < 0) | (columns >= width)
            seen |= out_of_view | frame[rows.clip(0, height - 1), columns.clip(0, width - 1)]
        return len(seen) - int(seen.sum())


@functools.cache
def estimator_of(path: str, missed_budget: int | None = None, extra_budget: int | None = None) -> Estimator:
    """One loaded model a process and pair of budgets."""
    return Estimator.load(path, missed_budget=missed_budget, extra_budget=extra_budget)


@functools.lru_cache(maxsize=16)
def image_of(view: RationalView, state: RationalState) -> RunwayImage:
    """The image of a state, which drawing and judging a frame ask for several times."""
    return view.image(state)


@functools.cache
def spatial_mask(path: str, cell: int) -> Frame:
    """S of a cell."""
    return estimator_of(path).spatial_mask(cell)


def uniform(rng: Rng, stage: Stage) -> RationalState:
    """A random state of the domain."""
    return into_domain(stage, RationalState.near(stage.scene.domain.uniform(rng, 1)[0]))


def tangent_within(theta: float, low: float, high: float) -> Fraction:
    """A rational tan(theta/2) within float64's spacing of theta's, of an angle in [low, high]."""
    tangent, step = Fraction(math.tan(min(max(theta, low), high) / 2)), Fraction(1, 2**54)
    while not angle_is_at_least(tangent, low):
        tangent += step
    while not angle_is_at_least(-tangent, -high):
        tangent -= step
    return tangent


def into_domain(stage: Stage, state: RationalState) -> RationalState:
    """The state of the domain that is closest, axis by axis; in altitude, of those that it has at that distance."""
    (low, *lowest), (high, *highest) = stage.lower.tolist(), stage.upper.tolist()
    z = min(max(state.z, Fraction(lowest[2])), Fraction(highest[2]))
    lowest[1], highest[1] = stage.altitudes_at(z)
    lengths = zip((state.x, state.y, z), lowest, highest, strict=True)
    clipped = [min(max(value, Fraction(least)), Fraction(most)) for value, least, most in lengths]
    inside = angle_is_at_least(state.tangent, low) and angle_is_at_least(-state.tangent, -high)
    return RationalState(state.tangent if inside else tangent_within(state.floats[0], low, high), *clipped)


def some_free_axes(rng: Rng, stage: Stage) -> list[int]:
    """One or more of the axes that have a width."""
    free = np.flatnonzero(~stage.scene.domain.fixed).tolist()
    return rng.choice(free, size=rng.integers(1, len(free) + 1), replace=False).tolist() if len(free) else []


def moved(state: RationalState, axis: int, to: Fraction) -> RationalState:
    """The state with one axis at another place; an angle is moved to within float64's spacing."""
    value = Fraction(math.tan(float(to) / 2)) if axis == 0 else to
    return replace(state, **{("tangent", "x", "y", "z")[axis]: value})


def nudge(rng: Rng) -> Fraction:
    """Nothing, every second time; else a hair to one side."""
    return Fraction(0) if rng.random() < 0.5 else Fraction(rng.choice([-1, 1]) * rng.choice(NUDGES))


def on_faces(rng: Rng, stage: Stage) -> RationalState:
    """On a face, an edge or a corner of a cell, of the domain's among them, or a hair beside it."""
    state = uniform(rng, stage)
    for axis in some_free_axes(rng, stage):
        state = moved(state, axis, Fraction(rng.choice(stage.scene.domain.borders_along(axis))) + nudge(rng))
    return into_domain(stage, state)


def on_pixel_borders(rng: Rng, stage: Stage) -> RationalState:
    """An end of a marking on a border or a corner of pixels, or a marking through a corner: exactly, or a hair beside it."""
    for _ in range(TRIES):
        state = solved_for_border(rng, stage, uniform(rng, stage))
        if state is not None:
            state = replace(state, z=state.z + nudge(rng)) if rng.random() < 0.5 else replace(state, y=state.y + nudge(rng))
            if stage.contains(state):
                return state
    return uniform(rng, stage)


def solved_for_border(rng: Rng, stage: Stage, state: RationalState) -> RationalState | None:
    """The state with y or z, or both, changed so that a point of a marking comes to lie on the closest border of pixels.

    With tau = (v - v0)/F_v and s = tau cos(theta) + sin(theta), a point at depth Z and row v has y = Z s,
    d = Z (cos(theta) - tau sin(theta)) and u = u0 + F_u (p_x - x)/Z; a marking's line crosses row v at u = u0 + F_u (p_x - x) s/y.
    """
    view = stage.view
    stripe = view.stripes[rng.integers(len(view.stripes))]
    p_z = stripe.near_z if rng.random() < 0.5 else stripe.far_z
    u, v = view.project(state, stripe.x, p_z)
    column, row = Fraction(round(u)), Fraction(round(v))
    cosine, sine = turn(state.tangent)
    tau = (row - view.v0) / view.focal_v
    steepness, reach = tau * cosine + sine, cosine - tau * sine
    kind = rng.choice(["row", "column", "corner", "line"])
    if steepness <= 0 or (kind != "row" and column == view.u0):
        return None
    if kind == "row":
        return replace(state, z=state.y * reach / steepness - p_z)
    depth = view.focal_u * (stripe.x - state.x) / (column - view.u0)
    if kind == "column":
        return replace(state, z=(depth - state.y * sine) / cosine - p_z)
    if kind == "corner":
        return replace(state, y=depth * steepness, z=depth * reach - p_z)
    return replace(state, y=depth * steepness)


def outside(rng: Rng, stage: Stage, by: float) -> RationalState:
    """Outside of one or more faces of the domain by up to `by`, often by a hair."""
    state = uniform(rng, stage)
    lowest, highest = stage.lower.tolist(), stage.upper.tolist()
    lowest[2], highest[2] = stage.altitudes_at(state.z)
    for axis in some_free_axes(rng, stage):
        distance = Fraction(rng.choice([*NUDGES, *rng.uniform(0, by, 3)]))
        below = rng.random() < 0.5
        state = moved(state, axis, Fraction(lowest[axis]) - distance if below else Fraction(highest[axis]) + distance)
    return state


def cut_by_the_frame(rng: Rng, stage: Stage) -> RationalState:
    """A state some part of whose runway is out of view, often a whole marking by a fraction of a pixel, or one on a face of a cell."""
    kind = rng.random()
    if kind < 0.2:
        return on_faces(rng, stage)
    states = stage.scene.domain.nearest(stage.lower + rng.beta(0.3, 0.3, (TRIES, 4)) * (stage.upper - stage.lower))
    ends = project(stage.scene, states)
    beyond = np.maximum(-ends, ends - [stage.view.width, stage.view.height]).max(axis=3)
    whole = beyond.min(axis=2)
    barely = np.where(whole > 0, whole, np.inf).min(axis=1).argmin()
    partly = (beyond > 0).any(axis=(1, 2)).argmax()
    return into_domain(stage, RationalState.near(states[barely if kind < 0.6 else partly]))

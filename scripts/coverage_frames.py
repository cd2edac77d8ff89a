"""The frames of the coverage campaign: states, clutter and missed pixels, random and in the worst places, with their truth.

A picture starts with the runway, seen by a camera that may be off by its scene's calibration (`rational_image`). Layers of clutter are
laid over it, and pixels of the runway put out until the frame lacks exactly as many as the scenario says.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from rational_image import Frame, RationalState, RationalView, angle_is_at_least, turn

from build_model.hough_bank import CellBank, cell_bank
from build_model.partition import partition
from runtime import Estimator, Scene
from runtime.frames import events_to_frames
from runtime.recording import read_events

Rng = np.random.Generator
Pixels = NDArray[np.int64]
"""Numbers of pixels in the flattened frame, in the order in which they go dark."""

WINDOW_US = 40_000
NUDGES = (0.0, 2.0**-60, 1e-15, 1e-12, 1e-9, 1e-6)
"""Distances from a face or a border, rad or m: on it, below float64's spacing, just above it, and so on."""
TRIES = 60
"""Draws of a state that must meet a condition, before one that does not is taken."""
LONGEST_LIST = 64
"""Pixels that are tried when some shall go dark."""


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

    def cells_of(self, state: RationalState) -> list[int]:
        """Numbers of the cells that hold a state, borders included."""
        cells, floats = partition(self.scene), state.floats
        nearby = ((cells.lower <= floats + 1e-9) & (floats - 1e-9 <= cells.upper)).all(axis=1)
        return [cell for cell in np.flatnonzero(nearby).tolist() if state.within(cells.lower[cell], cells.upper[cell])]

    def contains(self, state: RationalState) -> bool:
        """True if the state lies in the domain."""
        return state.within(self.scene.domain.lower, self.scene.domain.upper)

    def unwitnessed(self, image: Frame, frame: Frame) -> int:
        """Number of pixels of an image without a lit pixel of the frame within the tolerance; what is out of view counts as lit."""
        reach = self.scene.tolerance.line_px
        rows, columns = np.nonzero(image)
        wide = np.pad(frame, reach, constant_values=True)
        steps = range(2 * reach + 1)
        seen = np.logical_or.reduce([wide[rows + down, columns + right] for down in steps for right in steps])
        return len(rows) - int(seen.sum())


@functools.cache
def estimator_of(path: str, missed_budget: int | None = None, extra_budget: int | None = None) -> Estimator:
    """One loaded model a process and pair of budgets."""
    return Estimator.load(path, missed_budget=missed_budget, extra_budget=extra_budget)


@functools.cache
def recorded_frames(path: str, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """The recording's 40 ms frames, (frames, height, width)."""
    packets = list(read_events(path, shape))
    return events_to_frames(np.concatenate(packets), shape, WINDOW_US)[1].astype(np.bool_)


@functools.cache
def bank_of(path: str, cell: int) -> CellBank:
    """The bank of one cell, built anew: its K say which pixels hurt most."""
    scene = Stage.of(path, None).scene
    cells = partition(scene)
    return cell_bank(scene, cells.lower[cell], cells.upper[cell])


@dataclass
class Picture:
    """A frame as it is drawn. `states[0]` is the truth; further ones are states whose runways were drawn as clutter."""

    stage: Stage
    camera: RationalView
    """As the frame is taken: the scene's, or one that is off by its calibration."""
    states: list[RationalState]
    runway: Frame
    frame: Frame


State = Callable[[Rng, Stage], RationalState]
Layer = Callable[[Rng, Picture], None]
Order = Callable[[Rng, Picture], Pixels]


# --- states ---


def uniform(rng: Rng, stage: Stage) -> RationalState:
    """A random state of the domain."""
    domain = stage.scene.domain
    return into_domain(stage, RationalState.near(rng.uniform(domain.lower, domain.upper)))


def tangent_within(theta: float, low: float, high: float) -> Fraction:
    """A rational tan(theta/2) within float64's spacing of theta's, of an angle in [low, high]."""
    tangent, step = Fraction(math.tan(min(max(theta, low), high) / 2)), Fraction(1, 2**54)
    while not angle_is_at_least(tangent, low):
        tangent += step
    while not angle_is_at_least(-tangent, -high):
        tangent -= step
    return tangent


def into_domain(stage: Stage, state: RationalState) -> RationalState:
    """The state of the domain that is closest, axis by axis."""
    domain = stage.scene.domain
    lengths = zip((state.x, state.y, state.z), domain.lower[1:].tolist(), domain.upper[1:].tolist(), strict=True)
    clipped = [min(max(value, Fraction(low)), Fraction(high)) for value, low, high in lengths]
    inside = angle_is_at_least(state.tangent, domain.lower[0]) and angle_is_at_least(-state.tangent, -domain.upper[0])
    tangent = state.tangent if inside else tangent_within(state.floats[0], domain.lower[0], domain.upper[0])
    return RationalState(tangent, *clipped)


def some_free_axes(rng: Rng, stage: Stage) -> list[int]:
    """One or more of the axes that have a width."""
    free = [axis for axis, sides in enumerate(stage.scene.domain.axes) if sides.width > 0]
    return rng.choice(free, size=rng.integers(1, len(free) + 1), replace=False).tolist()


def moved(state: RationalState, axis: int, to: Fraction) -> RationalState:
    """The state with one axis at another place; an angle is moved to within float64's spacing."""
    value = Fraction(math.tan(float(to) / 2)) if axis == 0 else to
    return replace(state, **{("tangent", "x", "y", "z")[axis]: value})


def on_faces(rng: Rng, stage: Stage) -> RationalState:
    """On a face, an edge or a corner of a cell, of the domain's among them, or a hair beside it."""
    state = uniform(rng, stage)
    for axis in some_free_axes(rng, stage):
        nudge = Fraction(rng.choice([-1, 1]) * rng.choice(NUDGES))
        state = moved(state, axis, Fraction(rng.choice(stage.scene.domain.axes[axis].edges)) + nudge)
    return into_domain(stage, state)


def on_pixel_borders(rng: Rng, stage: Stage) -> RationalState:
    """An end of a marking on a border or a corner of pixels, or a marking through a corner: exactly, or a hair beside it."""
    for _ in range(TRIES):
        state = solved_for_border(rng, stage, uniform(rng, stage))
        if state is not None:
            nudge = Fraction(rng.choice([-1, 1]) * rng.choice(NUDGES))
            state = replace(state, z=state.z + nudge) if rng.random() < 0.5 else replace(state, y=state.y + nudge)
            if stage.contains(state):
                return state
    return uniform(rng, stage)


def solved_for_border(rng: Rng, stage: Stage, state: RationalState) -> RationalState | None:
    """The state with y or z, or both, changed so that a point of a marking comes to lie on the closest border of pixels.

    With tau = (v - v0)/F and s = tau cos(theta) + sin(theta): a point at depth Z and row v has y = Z s and d = Z (cos(theta) - tau sin(theta)),
    a marking's line crosses row v at u = u0 + (p_x - x) F s/y, and Z = F (p_x - x)/(u - u0).
    """
    view = stage.view
    stripe = view.stripes[rng.integers(len(view.stripes))]
    p_z = stripe.near_z if rng.random() < 0.5 else stripe.far_z
    u, v = view.project(state, stripe.x, p_z)
    column, row = Fraction(round(u)), Fraction(round(v))
    cosine, sine = turn(state.tangent)
    tau = (row - view.v0) / view.focal
    steepness, reach = tau * cosine + sine, cosine - tau * sine
    kind = rng.choice(["row", "column", "corner", "line"])
    if steepness <= 0 or (kind != "row" and column == view.u0):
        return None
    if kind == "row":
        return replace(state, z=state.y * reach / steepness - p_z)
    depth = view.focal * (stripe.x - state.x) / (column - view.u0)
    if kind == "column":
        return replace(state, z=(depth - state.y * sine) / cosine - p_z)
    if kind == "corner":
        return replace(state, y=depth * steepness, z=depth * reach - p_z)
    return replace(state, y=depth * steepness)


def outside(rng: Rng, stage: Stage, by: float) -> RationalState:
    """Outside of one or more faces of the domain by up to `by`, often by a hair."""
    state, domain = uniform(rng, stage), stage.scene.domain
    for axis in some_free_axes(rng, stage):
        distance = Fraction(rng.choice([*NUDGES[1:], *rng.uniform(0, by, 3)]))
        below = rng.random() < 0.5
        state = moved(state, axis, Fraction(domain.lower[axis]) - distance if below else Fraction(domain.upper[axis]) + distance)
    return state


def cut_by_the_frame(rng: Rng, stage: Stage) -> RationalState:
    """A state some part of whose runway is out of view, now and then on a face of a cell."""
    state = uniform(rng, stage)
    for _ in range(TRIES):
        points = [point for segment in stage.view.segments(state) for point in segment]
        if not all(0 <= u < stage.view.width and 0 <= v < stage.view.height for u, v in points):
            break
        state = uniform(rng, stage) if rng.random() < 0.8 else on_faces(rng, stage)
    return state


# --- layers of clutter ---


def speckle(rng: Rng, picture: Picture, low: float, high: float) -> None:
    """Pixels lit at random, with a density between `low` and `high`."""
    picture.frame |= rng.random(picture.frame.shape, dtype=np.float32) < rng.uniform(low, high)


def recorded(rng: Rng, picture: Picture) -> None:
    """A frame of the recording, mirrored at random."""
    frames = recorded_frames(str(picture.stage.recording), picture.frame.shape)
    picture.frame |= frames[rng.integers(len(frames)), :: rng.choice([-1, 1]), :: rng.choice([-1, 1])]


def second_runway(rng: Rng, picture: Picture, within: float) -> None:
    """The runway as another state shows it, which lies `within` of the true one on each axis that has a width."""
    domain, true = picture.stage.scene.domain, picture.states[0].floats
    floats = np.where(domain.lower < domain.upper, true + rng.uniform(-within, within, 4), true)
    other = into_domain(picture.stage, RationalState.near(floats))
    picture.states.append(other)
    picture.frame |= picture.camera.image(other)


def longer_markings(rng: Rng, picture: Picture) -> None:
    """The markings drawn on beyond their ends, along the ground, nearer or farther or both; some by a hair, some by much."""
    nearer, farther = (Fraction(part) for part in 10.0 ** rng.uniform(-4, (-0.1, 1)) * ((1, 0), (0, 1), (1, 1))[rng.integers(3)])
    stripes = tuple(replace(stripe, near_z=stripe.near_z - nearer, far_z=stripe.far_z + farther) for stripe in picture.camera.stripes)
    picture.frame |= replace(picture.camera, stripes=stripes).image(picture.states[0])


def neighbourhood(rng: Rng, picture: Picture) -> None:
    """All that lies within up to 6 px of the runway."""
    picture.frame |= thickened(picture.runway, int(rng.integers(1, 7)))


def everything(_rng: Rng, picture: Picture) -> None:
    """The whole frame."""
    picture.frame[:] = True


def thickened(frame: Frame, reach: int) -> Frame:
    """The frame with everything lit that lies within `reach` rows and columns of a lit pixel."""
    thick = np.zeros_like(frame)
    for row, column in np.argwhere(frame).tolist():
        thick[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] = True
    return thick


# --- missed pixels ---


def anywhere(rng: Rng, picture: Picture) -> Pixels:
    """The runway's pixels in random order."""
    return rng.permutation(np.flatnonzero(picture.runway))


def one_end(rng: Rng, picture: Picture) -> Pixels:
    """The pixels of one marking, from one of its ends on."""
    stripe = picture.camera.stripes[rng.integers(len(picture.camera.stripes))]
    lit = np.flatnonzero(replace(picture.camera, stripes=(stripe,)).image(picture.states[0]))
    return lit if rng.random() < 0.5 else lit[::-1]


def row_band(rng: Rng, picture: Picture) -> Pixels:
    """All pixels from some row on."""
    lit = np.flatnonzero(picture.runway)
    return np.roll(lit, -rng.integers(max(len(lit), 1)))


def must_light(rng: Rng, picture: Picture) -> Pixels:
    """Pixels of K of an entry that holds the state, which leave that entry nothing to spare."""
    stage, state = picture.stage, picture.states[0]
    bank = bank_of(stage.path, int(rng.choice(stage.cells_of(state))))
    theta, x, y, z = state.floats
    tangent = (bank.lines.reference_row - stage.scene.camera.v0) / stage.scene.camera.focal_px
    scale = stage.scene.camera.focal_px * (np.cos(theta) * tangent + np.sin(theta)) / y
    line = np.stack([np.full_like(scale, theta), np.full_like(scale, x), scale, np.full_like(scale, z)], axis=-1)
    holding = np.flatnonzero(((bank.lines.lower - 1e-9 <= line) & (line <= bank.lines.upper + 1e-9)).all(axis=1))
    masks = bank.must_light.bits(len(bank), bank.window)[rng.choice(holding)] if len(holding) else np.zeros(bank.window.shape, bool)
    must = np.zeros_like(picture.runway)
    must[bank.window.slices] = masks
    return rng.permutation(np.flatnonzero(must & picture.runway))


def put_out(picture: Picture, order: Pixels, missed: int) -> None:
    """Darkens pixels in the given order, as long as no more than `missed` pixels of the true image lack a witness."""
    stage, pixels = picture.stage, picture.frame.reshape(-1)
    ideal = stage.view.image(picture.states[0])
    for pixel in order[:LONGEST_LIST].tolist() if missed else ():
        was = pixels[pixel]
        pixels[pixel] = False
        if stage.unwitnessed(ideal, picture.frame) > missed:
            pixels[pixel] = was
            break


def keep_out_of_spatial_mask(rng: Rng, picture: Picture, extra: int) -> None:
    """Theorem B's frames: of the clutter in S of the true cell exactly `extra` pixels stay, at random places or beside the runway."""
    stage, state = picture.stage, picture.states[0]
    spatial = estimator_of(stage.path).spatial_mask(stage.cells_of(state)[0])
    ideal = stage.view.image(state)
    clutter = spatial & ~(thickened(ideal, stage.scene.tolerance.line_px) | picture.runway)
    picture.frame &= ~clutter
    beside = clutter & thickened(ideal, stage.scene.tolerance.line_px + 1)
    places = np.flatnonzero(beside if rng.random() < 0.5 else clutter)
    picture.frame.reshape(-1)[rng.choice(places, size=min(extra, len(places)), replace=False)] = True


# --- scenarios ---


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
        runway = camera.image(state) if self.runway else np.zeros(stage.view.shape, dtype=np.bool_)
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
        focal=view.focal * (1 + Fraction(zoom)),
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
    for side in ("left", "top", "bottom"):
        yield Scenario(f"cut by the {side} border", (few,), cut_by_the_frame, f"cut {side}")
        yield Scenario(f"cut by the {side} border, camera off", (few,), cut_by_the_frame, f"cut {side}, tolerant")

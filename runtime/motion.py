"""How far the aircraft can have moved between two instants, and where that takes a set of states (docs/guarantee.md, Theorem D).

    xi(t1) lies in B + D  if xi(t0) lies in B and the displacement in D;   D = (t1 - t0) [rate_lower, rate_upper] for bounded rates

The scale g at the reference row moves with pitch and altitude. With psi the angle of that row below the horizon,

    g' = g  sin(psi + delta)/sin(psi)  y/(y + epsilon)      for theta + delta, y + epsilon
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from runtime.attitude import camera_pitch, lead, seen_pitch
from runtime.estimate import Box, axis_number
from runtime.refine.altitude import contract_by_altitude
from runtime.refine.refiner import joined
from runtime.refine.slices import rereferenced, tangents_below_horizon
from runtime.rounding import lowered, raised
from runtime.scene import Camera, Scene
from runtime.state_set import StateSet
from runtime.turn import cosine_and_sine

Floats = NDArray[np.float64]

US_PER_S = 1e6
SHORTEST_US = 1e-6
"""What moves in a shorter time is bounded by what may move in up to this one: products of such times with rates have no digits left."""
LATEST_US = 2.0**63
"""Instants lie before this one, and after its negative: 300,000 years."""
STEEPEST_RAD = 1.57
"""Where a pitch is taken for a right angle."""
FLAT = 1e-9
"""A slope in delta of no more than so much of its terms counts as both up and down: far above float64's error, and sound either way."""


def instant(time_us: float) -> int | Fraction:
    """A time, of any of Python's or numpy's numbers, without rounding. Raises ValueError for one that is not finite."""
    number = time_us.item() if isinstance(time_us, np.generic) else time_us
    if not -LATEST_US < number < LATEST_US:
        raise ValueError(f"time_us: found {time_us}; give a finite number of microseconds")
    return number if isinstance(number, int) else Fraction(*number.as_integer_ratio())


@dataclass(frozen=True)
class Displacement:
    """Bounds on how far a state has moved, (4,) each, or (sets, 4) of several; infinite where nothing is known."""

    lower: Floats
    upper: Floats

    def __add__(self, other: Displacement) -> Displacement:
        """First the one, then the other: bounds rounded outward."""
        return Displacement(*moved_box(self.lower, self.upper, other))

    def of(self, which: NDArray[np.bool_]) -> Displacement:
        """Those of some of several states."""
        return Displacement(self.lower[which], self.upper[which])

    def replaced(self, intervals: Mapping[str, tuple[float, float]]) -> Displacement:
        """Other bounds on the named axes. Raises ValueError for an axis of another name, and for bounds that are not ordered numbers."""
        lower, upper = self.lower.copy(), self.upper.copy()
        for name, (low, high) in intervals.items():
            axis = axis_number(name, "displacement")
            if not (low <= high and low < np.inf and high > -np.inf):
                raise ValueError(f"displacement: found {low} to {high} for {name}; give two ordered numbers")
            lower[axis], upper[axis] = low, high
        return Displacement(lower, upper)


STANDSTILL = Displacement(np.zeros(4), np.zeros(4))


@dataclass(frozen=True)
class Motion:
    """Bounds on the rates of theta, x, y and z, (4,) each, in rad and m per second; they may be infinite, where nothing is known."""

    rate_lower: Floats
    rate_upper: Floats

    def __post_init__(self) -> None:
        for name in ("rate_lower", "rate_upper"):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))
        if self.rate_lower.shape != (4,) or self.rate_upper.shape != (4,) or not (self.rate_lower <= self.rate_upper).all():
            raise ValueError(f"motion: found rates {self.rate_lower} to {self.rate_upper}; give four ordered pairs of numbers")

    @staticmethod
    def of(scene: Scene) -> Motion | None:
        """The scene's [motion]; None if it has none."""
        return None if scene.motion is None else Motion(*np.transpose(scene.motion.rates))

    def over(self, elapsed_us: float) -> Displacement:
        """How far the state moves in a time, which may be negative: back to what was before."""
        if elapsed_us == 0:
            return STANDSTILL
        shortest = 0 < abs(elapsed_us) < SHORTEST_US
        sides = np.stack([self.rate_lower, self.rate_upper]) * (np.copysign(SHORTEST_US, elapsed_us) if shortest else elapsed_us)
        sides = np.concatenate([sides / US_PER_S, np.zeros((int(shortest), 4))])  # any part of that time, from none to all of it
        low, high = sides.min(axis=0), sides.max(axis=0)
        return Displacement(lowered(low, np.abs(low)), raised(high, np.abs(high)))

    def __str__(self) -> str:
        names = ("theta {} to {} rad/s", "x {} to {} m/s", "y {} to {} m/s", "z {} to {} m/s")
        pairs = zip(names, self.rate_lower.tolist(), self.rate_upper.tolist(), strict=True)
        return ", ".join(name.format(f"{low + 0.0:g}", f"{high + 0.0:g}") for name, low, high in pairs)  # + 0.0: a rate of -0 is shown as 0


def moved_box(lower: Floats, upper: Floats, by: Displacement) -> tuple[Floats, Floats]:
    """Where states between `lower` and `upper`, (..., 4), can have moved to: bounds of the same shape, rounded outward."""
    low, high = lower + by.lower, upper + by.upper
    return lowered(low, np.abs(lower) + np.abs(by.lower)), raised(high, np.abs(upper) + np.abs(by.upper))


def moved(camera: Camera, sets: StateSet, by: Displacement, domain: Box) -> StateSet:
    """Sets that hold every state of the domain to which a state of `sets` can have moved; those that hold none are left out."""
    return moved_each(camera, [sets], [by], domain)[0]


def moved_each(camera: Camera, unions: Sequence[StateSet], by: Sequence[Displacement], domain: Box) -> list[StateSet]:
    """`moved` of several unions of sets, each by its own displacement, at hardly more than the cost of one."""
    if not unions:
        return []
    sets, union = joined(*unions), np.arange(len(unions)).repeat([len(each) for each in unions])
    sides = (
        [np.broadcast_to(getattr(each, side), (len(own), 4)) for each, own in zip(by, unions, strict=True)] for side in ("lower", "upper")
    )
    step = Displacement(*(np.concatenate(side) for side in sides))
    low, high = moved_box(sets.lower, sets.upper, step)
    low, high = np.maximum(low, domain.lower), np.minimum(high, domain.upper)
    inside = np.all(low <= high, axis=1)
    sets, union, step, low, high = sets[inside], union[inside], step.of(inside), low[inside], high[inside]
    sets = rereferenced(sets, tangents_below_horizon(camera, sets.tangent, np.minimum(sets.theta[:, 0], low[:, 0])))
    theta, x, y, z = (np.stack([low[:, axis], high[:, axis]], axis=-1) for axis in range(4))
    after = StateSet(theta, x, y, z, _moved_scale(sets, theta, y, step), sets.tangent)
    after = contract_by_altitude(camera, after)
    left = ~after.empty
    after, borders = after[left], np.searchsorted(union[left], np.arange(len(unions) + 1))
    return [after[start:stop] for start, stop in itertools.pairwise(borders.tolist())]


def tilted(camera: Camera, sets: StateSet, most_rad: float) -> StateSet:
    """Sets, one of each, that hold all its states with the pitch changed by up to `most_rad`, at the same place; roll and yaw stay."""
    step = Displacement(*(np.tile([sign * most_rad, 0.0, 0.0, 0.0], (len(sets), 1)) for sign in (-1, 1)))
    theta = sets.theta + np.array([-most_rad, most_rad])
    theta = np.stack([lowered(theta[:, 0], np.abs(theta[:, 0])), raised(theta[:, 1], np.abs(theta[:, 1]))], axis=-1)
    sets = rereferenced(sets, tangents_below_horizon(camera, sets.tangent, theta[:, 0]))
    moved = replace(sets, theta=theta, scale=_moved_scale(sets, theta, sets.y, step))
    return contract_by_altitude(camera, moved)


def with_pitches(sets: StateSet, by: Displacement, yaw_before: tuple[float, float], yaw_after: tuple[float, float]) -> Displacement:
    """The displacement of sets whose theta is the pitch that the ideal frame shows, at one yaw before and another one after, (sets, 4).

    `by` is that of the camera's own pitch, from which the other differs by `runtime.attitude.lead`.
    """
    before, after = (np.tile(yaw, (len(sets), 1)) for yaw in (yaw_before, yaw_after))
    pitch = camera_pitch(sets.theta, before)
    ahead = lead(sets.theta, pitch, before)
    low, high = pitch[:, 0] + by.lower[0], pitch[:, 1] + by.upper[0]
    moved_to = np.stack([lowered(low, np.abs(low)), raised(high, np.abs(high))], axis=-1)
    pitch = np.clip(moved_to, -STEEPEST_RAD, STEEPEST_RAD)
    behind = lead(seen_pitch(pitch, after), pitch, after)
    beyond = np.logical_or.reduce(np.abs(moved_to) > STEEPEST_RAD, axis=1)  # towards a right angle c - theta falls to 0
    behind = np.where(beyond[:, None], np.stack([np.minimum(behind[:, 0], 0), np.maximum(behind[:, 1], 0)], axis=-1), behind)
    lower, upper = (np.tile(side, (len(sets), 1)) for side in (by.lower, by.upper))
    terms = np.abs(ahead).max(axis=1) + np.abs(behind).max(axis=1)
    lower[:, 0] += lowered(behind[:, 0] - ahead[:, 1], terms)
    upper[:, 0] += raised(behind[:, 1] - ahead[:, 0], terms)
    return Displacement(lowered(lower, np.abs(lower)), raised(upper, np.abs(upper)))


def _moved_scale(sets: StateSet, theta: Floats, y: Floats, by: Displacement) -> Floats:
    """The scales of sets whose pitch and altitude have moved into `theta` and `y`, (sets, 2) each, rounded outward. `by`: (sets, 4)."""
    slow, fast = _turn(sets, _differences(sets.theta, theta, by.lower[:, 0], by.upper[:, 0]))
    falls = _differences(sets.y, y, by.lower[:, 2], by.upper[:, 2])[:, None, :] / y[:, :, None]
    shrinks, terms = 1 - falls, 1 + np.abs(falls)  # y/(y + epsilon) = 1 - epsilon/y'
    low = sets.scale[:, 0] * slow * np.maximum(lowered(shrinks, terms).min(axis=(1, 2)), 0)
    high = sets.scale[:, 1] * fast * raised(shrinks, terms).max(axis=(1, 2))
    return np.stack([lowered(low, low), raised(high, high)], axis=-1)


def _turn(sets: StateSet, delta: Floats) -> tuple[Floats, Floats]:
    """Range of sin(psi + delta)/sin(psi) = cos(delta) + sin(delta) cot(psi), (sets,) each, where it is above 0; `delta` is (sets, 2).

    It is monotone in psi, and concave in delta where it is above 0: its extremes are at the corners, or, as the largest, 1/sin(psi) where
    psi + delta = pi/2. Of turns by more than a right angle nothing is said.
    """
    (cosine, sine), (cos_delta, sin_delta) = sets.turn, (side[:, None] for side in cosine_and_sine(delta))
    cotangent = ((cosine - sets.tangent[:, None] * sine) / sets.reference_fall)[:, :, None]
    turns, terms = cos_delta + sin_delta * cotangent, 1 + np.abs(sin_delta * cotangent) * sets.condition[:, None, None]
    slow, fast = np.maximum(lowered(turns, terms).min(axis=(1, 2)), 0), raised(turns, terms).max(axis=(1, 2))
    slopes = cos_delta * cotangent - sin_delta
    peaks = (slopes[..., 0] >= -FLAT * terms[..., 0]) & (slopes[..., 1] <= FLAT * terms[..., 1])
    peak = np.where(peaks, np.sqrt(1 + sets.tangent**2)[:, None] / sets.reference_fall, 0).max(axis=1)
    fast = np.maximum(fast, raised(peak, peak * sets.condition))
    beyond = np.abs(delta).max(axis=1) > np.pi / 2
    return np.where(beyond, 0, slow), np.where(beyond, np.inf, fast)


def _differences(before: Floats, after: Floats, low: Floats, high: Floats) -> Floats:
    """How much a coordinate can have changed, (sets, 2), from an interval into another, (sets, 2) each, between `low` and `high`."""
    least, most = after[:, 0] - before[:, 1], after[:, 1] - before[:, 0]
    terms = np.abs(before).max(axis=1) + np.abs(after).max(axis=1)
    return np.stack([np.maximum(low, lowered(least, terms)), np.minimum(high, raised(most, terms))], axis=-1)

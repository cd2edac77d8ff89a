"""The states of a flight in rational numbers: at and within the bounds of a motion, at instants of all distances.

Lengths move exactly as far as a bound of their rate says, or by a share of it; theta, whose rational states are given by tan(theta/2), up
to `HAIR` of float64's spacings short of it. What is known of a state or of a displacement is rounded outward to float64, so that the truth
lies on a face as often as it can.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import flint
import numpy as np
from coverage.states import Rng, Stage, tangent_within
from random_scenes.pitched_state import PitchedState
from rational_image import RationalState, angle_is_at_least

from runtime import Box, Motion
from runtime.scene import STATE_NAMES

HAIR = 4
BITS = 200
"""Of the balls in which a difference of two angles is taken."""
US_PER_S = 10**6
STEPS_US = ((0, 0), (1, 100), (1_000, 60_000), (40_000, 40_000), (10**6, 5 * 10**6), (10**12, 10**12))
STEP_SHARES = (0.1, 0.1, 0.3, 0.35, 0.1, 0.05)
"""From one instant to the next, least and most, and how often."""
ORIGINS_US = (0, 5, 10**9, 17 * 10**14)
"""What clocks begin with: 0, or microseconds since 1970."""
LENGTHS = ("x", "y", "z")
WIDER = (0.0, 0.0, 1e-9, 1e-3, 0.05, 1.0, 5.0)
"""By how much a prior is wider than the state, as shares of the domain, on either side of an axis."""
LOOSER = (0.0, 0.0, 1e-6, 1e-3, math.inf)
"""By how much a told displacement is looser than the true one, rad or m."""


def draw_motion(rng: Rng, stage: Stage) -> Motion:
    """Bounds from a share of the domain to some domains a second; 0 on some axes, without a bound or of one sign on others."""
    size = stage.upper - stage.lower
    low, high = size * 10 ** rng.uniform(-2.5, 0.5, (2, 4)) * rng.choice([0, 1, 1, 1], (2, 4))
    low[rng.random(4) < 0.05], high[rng.random(4) < 0.05] = math.inf, math.inf
    axis = int(rng.integers(4))
    one_sided = rng.random() < 0.2 and math.isfinite(high[axis])
    lower = np.where(np.arange(4) == axis, 0.3 * high[axis], -low) if one_sided else -low
    return Motion(lower, high)


@dataclass
class Course:
    """Where a flight is, and when."""

    stage: Stage
    motion: Motion
    rng: Rng
    state: RationalState
    time_us: Fraction

    def go(self) -> None:
        """Goes to the next instant; waits where the motion's bounds would lead out of the domain."""
        low, high = STEPS_US[self.rng.choice(len(STEPS_US), p=STEP_SHARES)]
        steps = [Fraction(int(self.rng.integers(low, high + 1)), int(self.rng.choice([1, 1, 2]))), Fraction(0)]
        limit = bool(self.rng.random() < 0.5)
        for step in steps:
            after = self._moved(step, limit)
            if after is not None:
                self.state, self.time_us = after, self.time_us + step
                return

    @property
    def instant_us(self) -> float:
        """The time, as one of the numbers that callers have: all of them are exact here."""
        floats = float(self.time_us)
        kinds = [int, np.int64, np.float64, float] if self.time_us.denominator == 1 else [np.float64, float]
        return kinds[self.rng.integers(len(kinds))](floats)

    def _moved(self, step_us: Fraction, limit: bool) -> RationalState | None:
        """The state after a time; None if every state that the motion allows then lies out of the domain, or the one that was drawn."""
        if step_us == 0:
            return self.state
        lengths = {}
        for axis, name in enumerate(LENGTHS, start=1):
            low, high = self._allowed(axis, getattr(self.state, name), step_us)
            if low > high:
                return None
            lengths[name] = self._chosen(low, high, limit)
        theta = Fraction(float(self.state.floats[0]))
        hair = Fraction(HAIR * math.ulp(abs(float(theta)) + 1e-3))
        low, high = self._allowed(0, theta, step_us)
        if self.motion.rate_lower[0] > 0 and low + hair > high - hair:
            return None
        after = replace(self.state, **lengths)
        if not isinstance(after, PitchedState) and low + hair <= high - hair:
            after = replace(after, tangent=tangent_within(float(self._chosen(low + hair, high - hair, limit)), *self._sides(0)))
        return after if self.stage.scene.domain.contains(after.floats) else None

    def _allowed(self, axis: int, before: Fraction, step_us: Fraction) -> tuple[Fraction, Fraction]:
        """Where a coordinate may be after a time, within the domain."""
        (low, high), rates = self._sides(axis), (float(self.motion.rate_lower[axis]), float(self.motion.rate_upper[axis]))
        least = Fraction(low) if math.isinf(rates[0]) else max(Fraction(low), before + Fraction(rates[0]) * step_us / US_PER_S)
        most = Fraction(high) if math.isinf(rates[1]) else min(Fraction(high), before + Fraction(rates[1]) * step_us / US_PER_S)
        return least, most

    def _sides(self, axis: int) -> tuple[float, float]:
        return float(self.stage.lower[axis]), float(self.stage.upper[axis])

    def _chosen(self, low: Fraction, high: Fraction, limit: bool) -> Fraction:
        if limit:
            return low if self.rng.random() < 0.5 else high
        return low + (high - low) * Fraction(float(self.rng.random()))

    def prior(self, state: RationalState) -> Box:
        """A box with the state in it, often on its faces."""
        lower, upper = np.transpose([theta_bounds(state), *(bounds(getattr(state, name)) for name in LENGTHS)])
        wider = (self.stage.upper - self.stage.lower) * self.rng.choice(WIDER, (2, 4))
        return Box(lower - wider[0], upper + wider[1])

    def told(self, before: RationalState) -> dict[str, tuple[float, float]]:
        """What odometry says of some axes since a state: the displacement to its last digit, or more loosely."""
        named = self.rng.random(4) < 0.3
        told = {}
        for axis in np.flatnonzero(named).tolist():
            name = STATE_NAMES[axis]
            low, high = turned(before, self.state) if axis == 0 else bounds(getattr(self.state, name) - getattr(before, name))
            loose = self.rng.choice(LOOSER, 2).tolist()
            told[name] = (low - loose[0], high + loose[1])
        return told


def bounds(number: Fraction) -> tuple[float, float]:
    """The largest float64 that is not above a number, and the smallest that is not below."""
    near = float(number)
    low = near if Fraction(near) <= number else math.nextafter(near, -math.inf)
    return low, near if Fraction(near) >= number else math.nextafter(near, math.inf)


def theta_bounds(state: RationalState) -> tuple[float, float]:
    """The same of a state's theta."""
    near = float(state.floats[0])
    if isinstance(state, PitchedState):
        return near, near
    above = angle_is_at_least(state.tangent, near)
    return (near, math.nextafter(near, math.inf)) if above else (math.nextafter(near, -math.inf), near)


def turned(before: RationalState, after: RationalState) -> tuple[float, float]:
    """Bounds on how far theta has moved, next to each other."""
    if before.tangent == after.tangent:
        return 0.0, 0.0
    with flint.ctx.workprec(BITS):
        near = float((theta_ball(after) - theta_ball(before)).mid())
    return math.nextafter(near, -math.inf), math.nextafter(near, math.inf)


def theta_ball(state: RationalState) -> flint.arb:
    """A state's theta, rad, as a ball."""
    if isinstance(state, PitchedState):
        return flint.arb(state.pitch)
    return 2 * (flint.arb(state.tangent.numerator) / state.tangent.denominator).atan()

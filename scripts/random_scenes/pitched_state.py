"""States whose pitch a scene fixes: exactly that float64, which no rational half-angle tangent gives."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import flint
import numpy as np
from coverage.states import Stage
from numpy.typing import NDArray
from rational_image import RationalState

PITCH_BITS = 160
"""A fixed pitch's half-angle tangent is right to so many bits: no pixel changes but where a border of pixels comes closer than that."""


@dataclass(frozen=True)
class PitchedState(RationalState):
    """A state whose pitch is a float64 that the scene fixes, and whose tangent is as close to that angle's as `PITCH_BITS` say.

    But for 0, no float64 has a rational tangent of its half: the state stands for the one that has exactly this pitch.
    """

    pitch: float = 0.0

    @staticmethod
    def at(pitch: float, state: RationalState) -> PitchedState:
        """The state with its pitch replaced."""
        return PitchedState(half_tangent(pitch), state.x, state.y, state.z, pitch)

    @property
    def floats(self) -> NDArray[np.float64]:
        """[theta, x, y, z], (4,), rounded to float64."""
        return np.array([self.pitch, self.x, self.y, self.z], dtype=np.float64)

    def within(self, lower: Sequence[float] | NDArray[np.float64], upper: Sequence[float] | NDArray[np.float64]) -> bool:
        """True if the state lies in the box [lower, upper], (4,) float64 each, borders included: decided exactly."""
        lengths = zip((self.x, self.y, self.z), map(float, lower[1:]), map(float, upper[1:]), strict=True)
        return float(lower[0]) <= self.pitch <= float(upper[0]) and all(low <= value <= high for value, low, high in lengths)


@functools.lru_cache(maxsize=16)
def half_tangent(pitch: float) -> Fraction:
    """tan(pitch/2), right to `PITCH_BITS` bits; exact for 0."""
    with flint.ctx.workprec(PITCH_BITS):
        mantissa, exponent = (flint.arb(pitch) / 2).tan().mid().man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


def as_fixed(stage: Stage, state: RationalState) -> RationalState:
    """The state with the pitch that the scene fixes, if it does."""
    low, high = float(stage.lower[0]), float(stage.upper[0])
    return PitchedState.at(low, state) if low == high else state

"""What a gyroscope says: a CSV file of the aircraft's body rates with their plus-minus, and how far it has pitched between two instants.

    d theta/dt = -(q cos(phi) - r sin(phi))        q, r: body rates about the pitch and the yaw axis, phi: roll

Aviation's signs: q is positive with the nose going up, r to the right. theta is the pitch down of a camera along the aircraft's axis. What
is taken for granted of the file: a rate lies within its reading's plus-minus at the reading's time, and at every time between two readings
that are no more than `LONGEST_GAP_US` apart, within the interval that holds what either of them allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runtime.motion import US_PER_S, Motion
from runtime.recordings.timed_rows import rows_with_plus_minus
from runtime.rounding import lowered, raised

AXES = ("roll", "pitch", "yaw")
COLUMNS = ("time_us", *(f"{axis}_rate_rad_s" for axis in AXES), *(f"{axis}_rate_plus_minus_rad_s" for axis in AXES))
LONGEST_GAP_US = 50_000
"""Between two readings farther apart than this nothing is known of a rate, so that what the motion's bounds say stands."""

Floats = NDArray[np.float64]


class GyroscopeError(ValueError):
    """A file of body rates that cannot be used. One line: the file, what was found, what to do."""


@dataclass(frozen=True)
class GyroscopeReadings:
    """Readings at ascending times (n,) us, and what they allow theta's rate to be from each to the next one, (n - 1,) each, rad/s.

    The rates are rounded outward; they are infinite where nothing is known.
    """

    time_us: Floats
    slowest: Floats
    fastest: Floats

    @classmethod
    def load(cls, path: str | Path, roll_rad: float = 0.0) -> GyroscopeReadings:
        """Reads a CSV file with the columns of `COLUMNS`, of an aircraft that rolls by `roll_rad` at most. Raises `GyroscopeError`."""
        try:
            rows = rows_with_plus_minus(path, COLUMNS)
        except ValueError as error:
            raise GyroscopeError(error) from error
        time_us, rates, plus_minus = rows[:, 0], rows[:, 1:4], rows[:, 4:]
        slowest, fastest = _rates_of_theta(rates[:, 1], plus_minus[:, 1], np.abs(rates[:, 2]) + plus_minus[:, 2], roll_rad)
        unknown = np.diff(time_us) > LONGEST_GAP_US
        slowest = np.where(unknown, -np.inf, np.minimum(slowest[:-1], slowest[1:]))
        return cls(time_us, slowest, np.where(unknown, np.inf, np.maximum(fastest[:-1], fastest[1:])))

    def turned(self, since_us: float, until_us: float, motion: Motion) -> tuple[float, float]:
        """Bounds on how far theta has moved from one instant to a later one, rad, rounded outward.

        Where the readings say nothing, before the first, after the last and in gaps, theta moves by the motion's bounds.
        """
        if not since_us < until_us:
            return 0.0, 0.0
        first, last = np.searchsorted(self.time_us, since_us, side="right"), np.searchsorted(self.time_us, until_us)
        edges = np.concatenate([[since_us], self.time_us[first:last], [until_us]])
        seconds = np.diff(edges) / US_PER_S
        rates = self._between(np.searchsorted(self.time_us, edges[:-1], side="right") - 1, motion)
        sums, sizes = ([math.fsum(part) for part in each] for each in (rates * seconds, np.abs(rates) * seconds))
        return float(lowered(sums[0], sizes[0])), float(raised(sums[1], sizes[1]))

    def _between(self, reading: NDArray[np.int64], motion: Motion) -> Floats:
        """Bounds on theta's rate after each of the numbered readings until the next one, (2, n); the motion's where nothing is known."""
        rates = np.repeat([[motion.rate_lower[0]], [motion.rate_upper[0]]], len(reading), axis=1)
        within = (reading >= 0) & (reading < len(self.slowest))
        read = np.stack([side[reading[within]] for side in (self.slowest, self.fastest)])
        rates[:, within] = np.where(np.isfinite(read), read, rates[:, within])
        return rates


def _rates_of_theta(pitching: Floats, plus_minus: Floats, yawing: Floats, roll_rad: float) -> tuple[Floats, Floats]:
    """Bounds on theta's rate, (n,) each, by the rate q about the pitch axis, the size of that about the yaw axis, and the largest roll.

    With |phi| at most `roll_rad`, cos(phi) lies between 1 - phi^2/2 and 1, and |sin(phi)| is no more than |phi|.
    """
    least_cosine = max(1 - roll_rad**2 / 2, -1.0)
    sides = np.stack([-pitching - plus_minus, -pitching + plus_minus])
    sides = np.concatenate([sides, sides * least_cosine])
    mixed = yawing * min(roll_rad, 1.0)
    terms = np.abs(pitching) + plus_minus + mixed
    return lowered(sides.min(axis=0) - mixed, terms), raised(sides.max(axis=0) + mixed, terms)

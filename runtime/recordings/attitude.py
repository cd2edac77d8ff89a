"""What an attitude reference says: a CSV file of the aircraft's roll, pitch and yaw with their plus-minus, and the angles at any instant.

Aviation's signs: pitch is positive with the nose up, so that a camera along the aircraft's axis looks down by theta = -pitch; how a camera
that is mounted otherwise is turned is in `runtime.attitude`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runtime.attitude import Angle, Attitude, mounted
from runtime.estimate import Box
from runtime.motion import US_PER_S, Motion
from runtime.recordings.timed_rows import rows_with_plus_minus
from runtime.rounding import lowered, raised
from runtime.scene import Mount, Scene

ANGLES = ("roll", "pitch", "yaw")
COLUMNS = ("time_us", *(f"{angle}_rad" for angle in ANGLES), *(f"{angle}_plus_minus_rad" for angle in ANGLES))


class AttitudeError(ValueError):
    """A file of attitudes that cannot be used. One line: the file, what was found, what to do."""


@dataclass(frozen=True)
class Turning:
    """The aircraft's least and largest rates of roll and yaw, rad/s; by default it does not turn between two readings."""

    roll_rad_s: Angle = (0.0, 0.0)
    yaw_rad_s: Angle = (0.0, 0.0)

    @staticmethod
    def of(scene: Scene) -> Turning:
        """The scene's [motion]."""
        rates = () if scene.motion is None else (scene.motion.roll_rad_s, scene.motion.yaw_rad_s)
        return Turning(*(rate or (0.0, 0.0) for rate in rates))


@dataclass(frozen=True)
class Angles:
    """Intervals of the aircraft's angles, rad: roll to the right wing, pitch down, yaw with the nose to the right of the runway's."""

    roll: Angle
    pitch_down: Angle
    yaw: Angle

    def of_camera(self, mount: Mount, domain: Box) -> tuple[Attitude, Box]:
        """The attitude of a camera that is mounted so, and the domain with what that tells of its theta. Raises ValueError as `mounted`."""
        attitude, theta = mounted(mount, self.roll, self.pitch_down, self.yaw)
        return attitude, _with_pitch(domain, theta)


def _with_pitch(domain: Box, theta: Angle) -> Box:
    """The domain with these bounds on theta; with its own where they are infinite."""
    low, high = theta
    return domain.replace(theta=(domain.lower[0] if np.isinf(low) else low, domain.upper[0] if np.isinf(high) else high))


def _joined(angles: list[Angle]) -> Angle:
    return min(low for low, _ in angles), max(high for _, high in angles)


def _met(angles: list[Angle]) -> Angle:
    """What all of them allow; inverted where they contradict each other."""
    return max(low for low, _ in angles), min(high for _, high in angles)


@dataclass(frozen=True)
class AttitudeReadings:
    """Readings at ascending times (n,) us: angles and plus-minus, (n, 3) each, of roll, pitch and yaw, rad."""

    time_us: NDArray[np.float64]
    angles: NDArray[np.float64]
    plus_minus: NDArray[np.float64]

    @classmethod
    def load(cls, path: str | Path) -> AttitudeReadings:
        """Reads a CSV file with the columns of `COLUMNS`. Raises `AttitudeError`."""
        try:
            rows = rows_with_plus_minus(path, COLUMNS)
        except ValueError as error:
            raise AttitudeError(error) from error
        return cls(rows[:, 0], rows[:, 1:4], rows[:, 4:])

    def at(self, time_us: float, motion: Motion, turning: Turning) -> Angles:
        """The aircraft's angles at an instant, as the readings before and after it allow them, each moved to it by the bounds on the rates.

        Each interval holds what either reading allows; it is infinite where the bounds on a rate are.
        """
        before, after = self._around(time_us)
        pitch_rates = float(motion.rate_lower[0]), float(motion.rate_upper[0])  # of the pitch down
        roll, down, yaw = (
            _joined([self._angle(row, time_us, place, sign, rates) for row in (before, after)])
            for place, sign, rates in ((0, 1, turning.roll_rad_s), (1, -1, pitch_rates), (2, 1, turning.yaw_rad_s))
        )
        return Angles(roll, down, yaw)

    def prior(
        self,
        time_us: float,
        motion: Motion,
        domain: Box,
        since_us: float | None = None,
        turned: Callable[[float, float], Angle] | None = None,
    ) -> Box:
        """The domain with theta as the readings allow it of a camera along the aircraft's axis; the domain's where they tell nothing.

        By default theta lies in what either of the readings beside the instant, before and after it, allows, moved to it by the bounds on
        its rate. With `since_us` it lies in what all readings allow from there on, the one before and the one after that time included:
        each holds what theta was at its own time, and `turned` bounds how far theta moves from one time to a later one, by default by the
        bounds on its rate. Where they contradict each other, which proves one of them wrong, those beside the instant stand.
        """
        before, after = self._around(time_us)
        pitch = _joined([self._theta(row, time_us, motion, turned) for row in (before, after)])
        if since_us is not None:
            first = self._around(min(since_us, time_us))[0]
            met = _met([self._theta(row, time_us, motion, turned) for row in range(first, after + 1)])
            pitch = met if met[0] <= met[1] else pitch
        return _with_pitch(domain, pitch)

    def _around(self, time_us: float) -> tuple[int, int]:
        """The rows of the last reading until a time and of the first one from it on; the first or last of all where there is none."""
        before = max(int(np.searchsorted(self.time_us, time_us, side="right")) - 1, 0)
        return before, min(int(np.searchsorted(self.time_us, time_us)), len(self.time_us) - 1)

    def _theta(self, row: int, time_us: float, motion: Motion, turned: Callable[[float, float], Angle] | None) -> Angle:
        """The interval of theta at an instant by one reading alone, rounded outward."""
        then_us = float(self.time_us[row])
        if turned is None or then_us == time_us:
            return self._angle(row, time_us, 1, -1, (float(motion.rate_lower[0]), float(motion.rate_upper[0])))
        low, high = turned(then_us, time_us) if then_us < time_us else tuple(-side for side in reversed(turned(time_us, then_us)))
        down, plus_minus = -self.angles[row, 1], self.plus_minus[row, 1]
        terms = abs(down) + plus_minus + max(abs(low), abs(high))
        return float(lowered(down - plus_minus + low, terms)), float(raised(down + plus_minus + high, terms))

    def _angle(self, row: int, time_us: float, place: int, sign: int, rates: Angle) -> Angle:
        """The interval of an angle, of pitch with its sign turned, at an instant by one reading alone, rounded outward."""
        angle, plus_minus = sign * self.angles[row, place], self.plus_minus[row, place]
        elapsed_s = (time_us - self.time_us[row]) / US_PER_S
        moved = sorted(rate * elapsed_s for rate in rates) if elapsed_s else [0.0, 0.0]
        terms = abs(angle) + plus_minus + 2 * max(map(abs, moved))
        exact = plus_minus == 0 and moved == [0.0, 0.0]
        sides = angle - plus_minus + moved[0], angle + plus_minus + moved[1]
        if exact or not np.isfinite(terms):
            return sides
        return float(lowered(sides[0], terms)), float(raised(sides[1], terms))

    def level(self, roll_rad: float, yaw_rad: float) -> bool:
        """True if no reading allows more roll or yaw than these."""
        most = (np.abs(self.angles) + self.plus_minus).max(axis=0)
        return bool(most[0] <= roll_rad and most[2] <= yaw_rad)

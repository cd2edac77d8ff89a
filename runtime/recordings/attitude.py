"""What an attitude reference says: a CSV file of the aircraft's roll, pitch and yaw with their plus-minus, and the pitch at any instant.

Aviation's signs: pitch is positive with the nose up, so that a camera along the aircraft's axis looks down by theta = -pitch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runtime.estimate import Box
from runtime.motion import Motion
from runtime.recordings.timed_rows import rows_with_plus_minus
from runtime.rounding import lowered, raised

ANGLES = ("roll", "pitch", "yaw")
COLUMNS = ("time_us", *(f"{angle}_rad" for angle in ANGLES), *(f"{angle}_plus_minus_rad" for angle in ANGLES))


class AttitudeError(ValueError):
    """A file of attitudes that cannot be used. One line: the file, what was found, what to do."""


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

    def prior(self, time_us: float, motion: Motion, domain: Box) -> Box:
        """The domain with theta as the readings before and after an instant allow it, each moved to that instant by the motion's bounds.

        The interval holds what either reading allows; the domain's where the motion's bounds are infinite.
        """
        before = max(int(np.searchsorted(self.time_us, time_us, side="right")) - 1, 0)
        after = min(int(np.searchsorted(self.time_us, time_us)), len(self.time_us) - 1)
        sides = [self._theta(row, time_us, motion) for row in (before, after)]
        low, high = min(low for low, _ in sides), max(high for _, high in sides)
        ends = domain.lower[0] if np.isinf(low) else low, domain.upper[0] if np.isinf(high) else high
        return domain.replace(theta=ends)

    def _theta(self, row: int, time_us: float, motion: Motion) -> tuple[float, float]:
        """The interval of theta at an instant by one reading alone, rounded outward."""
        since = motion.over(time_us - self.time_us[row])
        pitch, plus_minus = self.angles[row, 1], self.plus_minus[row, 1]
        sides = (-pitch - plus_minus + since.lower[0], -pitch + plus_minus + since.upper[0])
        terms = abs(pitch) + plus_minus + abs(since.lower[0]) + abs(since.upper[0])
        return float(lowered(sides[0], terms)), float(raised(sides[1], terms))

    def level(self, roll_rad: float, yaw_rad: float) -> bool:
        """True if no reading allows more roll or yaw than these."""
        most = (np.abs(self.angles) + self.plus_minus).max(axis=0)
        return bool(most[0] <= roll_rad and most[2] <= yaw_rad)

"""What an attitude reference of a simulated flight says: readings with a bias and noise, and a plus-minus that holds."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.recordings.attitude import COLUMNS

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class AttitudeReference:
    """A cheap reference: each angle has a bias that stays, within the plus-minus less the largest noise, and noise that is clipped.

    Half a degree, 0.0087 rad, is what small attitude and heading references promise of roll and pitch.
    """

    plus_minus_rad: float = 0.0087
    noise_rad: float = 0.0005
    """Standard deviation; no reading is off by more than three of them beside the bias."""
    rate_hz: float = 100.0

    def readings(self, theta: Callable[[Floats], Floats], duration_us: int, margin_rad: float, rng: np.random.Generator) -> Floats:
        """Rows of `COLUMNS` from 0 to `duration_us`, of an aircraft without roll and yaw whose camera looks down by `theta` of the time.

        `margin_rad` is added to the plus-minus: for what the airframe's vibration adds, which a reference does not follow.
        """
        times = np.arange(0, duration_us + 1, 1e6 / self.rate_hz)
        most = 3 * self.noise_rad
        bias = rng.uniform(-1, 1, 3) * (self.plus_minus_rad - most)
        noise = np.clip(rng.normal(0, self.noise_rad, (len(times), 3)), -most, most)
        angles = bias + noise
        angles[:, 1] -= theta(times)
        return np.column_stack([times, angles, np.full((len(times), 3), self.plus_minus_rad + margin_rad)])


def attitude_text(readings: Floats) -> str:
    """The readings as a CSV file."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([round(row[0]), *row[1:]] for row in readings.tolist())
    return text.getvalue()

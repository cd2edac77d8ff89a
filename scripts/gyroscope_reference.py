"""What a gyroscope on a simulated flight says: body rates with a bias and noise, and a plus-minus that holds."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.recordings.gyroscope import COLUMNS

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class GyroscopeReference:
    """A small gyroscope on dampers, which keep the propeller's shaking from it: each rate has a bias that stays, and noise that is clipped.

    0.01 rad/s, half a degree a second, is what is left of a cheap sensor's bias and noise once it has been calibrated on the ground.
    """

    plus_minus_rad_s: float = 0.01
    noise_rad_s: float = 0.0015
    """Standard deviation; no reading is off by more than three of them beside the bias."""
    rate_hz: float = 100.0

    def readings(self, theta: Callable[[Floats], Floats], duration_us: int, rng: np.random.Generator) -> Floats:
        """Rows of `COLUMNS` from 0 to `duration_us`, of an aircraft without roll and yaw whose camera looks down by `theta` of the time.

        A reading has the mean rate from half a step before its time to half a step after. What rates change by in two steps is added to the
        plus-minus, as a reading speaks of all times up to its neighbours.
        """
        step_us = 1e6 / self.rate_hz
        times = np.arange(0, duration_us + 1, step_us)
        before, after = (np.clip(times + side * step_us / 2, 0, duration_us) for side in (-1, 1))
        pitching = -(theta(after) - theta(before)) / (after - before) * 1e6
        changes = 2 * np.abs(np.diff(pitching)).max(initial=0.0)
        most = 3 * self.noise_rad_s
        bias = rng.uniform(-1, 1, 3) * (self.plus_minus_rad_s - most)
        rates = bias + np.clip(rng.normal(0, self.noise_rad_s, (len(times), 3)), -most, most)
        rates[:, 1] += pitching
        return np.column_stack([times, rates, np.full((len(times), 3), self.plus_minus_rad_s + changes)])


def gyroscope_text(readings: Floats) -> str:
    """The readings as a CSV file."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([round(row[0]), *row[1:]] for row in readings.tolist())
    return text.getvalue()

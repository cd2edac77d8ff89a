"""What is known of a recording from elsewhere: its true states, and how a window fares against them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runtime.estimate import Estimate
from runtime.explanation import Shortfall, shortfall
from runtime.recordings.timed_rows import timed_rows
from runtime.scene import STATE_COLUMNS, Scene


class TruthError(ValueError):
    """A truth file that cannot be used. One line: the file, what was found, what to do."""


@dataclass(frozen=True)
class Truth:
    """States (n, 4) known at ascending times (n,) us, between which is interpolated."""

    time_us: NDArray[np.float64]
    states: NDArray[np.float64]

    @classmethod
    def load(cls, path: str | Path) -> Truth:
        """Reads a CSV file with the columns time_us, theta_rad, x_m, y_m, z_m. Raises `TruthError`."""
        try:
            rows = timed_rows(path, ("time_us", *STATE_COLUMNS))
        except ValueError as error:
            raise TruthError(error) from error
        return cls(rows[:, 0], rows[:, 1:])

    def at(self, time_us: float) -> NDArray[np.float64] | None:
        """The state (4,) at a time, or None before the first and after the last."""
        if not self.time_us[0] <= time_us <= self.time_us[-1]:
            return None
        return np.array([np.interp(time_us, self.time_us, column) for column in self.states.T])


@dataclass(frozen=True)
class Judgement:
    """A window against its truth."""

    truth: NDArray[np.float64]
    shortfall: Shortfall
    """What the frame lacks of the true runway."""
    assumptions_hold: bool
    """The shortfall is within the budget and the truth lies in the domain: Theorem A promises a box with the truth in it."""
    inside: bool
    """There is a box and the truth lies in it."""
    error: NDArray[np.float64] | None
    """Estimate minus truth, (4,), rad and m; None where nothing is certified."""


def judge(scene: Scene, frame: NDArray[np.uint8], estimate: Estimate, truth: NDArray[np.float64], missed_budget: int) -> Judgement:
    """The window's frame and estimate, made with that budget, against its true state (4,)."""
    lacking = shortfall(scene, frame, truth)
    in_domain = bool(scene.domain.contains(truth))
    error = None if estimate.state is None else estimate.state - truth
    inside = estimate.box is not None and estimate.box.contains(truth)
    return Judgement(truth, lacking, in_domain and lacking.missed <= missed_budget, inside, error)

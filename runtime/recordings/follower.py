"""Certified tracking of a recording: windows, one after the other, and what attitude reference and gyroscope say of their instants."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runtime.estimate import Estimate
from runtime.estimator import Estimator
from runtime.motion import Motion
from runtime.recordings.attitude import AttitudeReadings
from runtime.recordings.gyroscope import LONGEST_GAP_US, GyroscopeReadings
from runtime.tracker import Tracker


class TrackingError(ValueError):
    """Options of tracking that cannot be used. One line: the option, what was found, what to do."""


@dataclass
class Follower:
    """A tracker, what is known of the pitch and of its rate, and the instant of the last window."""

    tracker: Tracker
    attitude: AttitudeReadings | None
    gyroscope: GyroscopeReadings | None
    description: list[str]
    """What the certificates over time assume besides those of single frames."""
    latest_us: float = -np.inf

    @staticmethod
    def of(
        estimator: Estimator, attitude: Path | None, gyroscope: Path | None, motion: str | None, horizon: int | None, outliers: int
    ) -> Follower:
        """Raises `TrackingError` for options that cannot be used, `AttitudeError` and `GyroscopeError` for such files."""
        rates = None if motion is None else _motion(motion)
        if rates is None and estimator.scene.motion is None:
            raise TrackingError("--track: the model's scene has no [motion]; give --motion, the largest rates of theta, x, y, z")
        try:
            tracker = Tracker(estimator, rates, horizon, outliers)
        except ValueError as error:
            raise TrackingError(f"--{error}") from error
        readings = None if attitude is None else AttitudeReadings.load(attitude)
        rates_read = None if gyroscope is None else GyroscopeReadings.load(gyroscope, estimator.scene.calibration.roll_rad)
        return Follower(tracker, readings, rates_read, _description(tracker, readings, attitude, gyroscope))

    def update(self, frame: NDArray[np.uint8], instant_us: float) -> Estimate:
        """The certificate over time of the next window; where the camera's clock went back, a new flight begins."""
        if instant_us < self.latest_us:
            self.tracker.reset()
            self.latest_us = -np.inf
        motion, domain = self.tracker.motion, self.tracker.estimator.domain
        prior = None if self.attitude is None else self.attitude.prior(instant_us, motion, domain)
        turned = None
        if self.gyroscope is not None and np.isfinite(self.latest_us):
            turned = {"theta": self.gyroscope.turned(self.latest_us, instant_us, motion)}
        self.latest_us = instant_us
        return self.tracker.update(frame, instant_us, prior, turned)


def _motion(text: str) -> Motion:
    """Plus-minus rates from "theta,x,y,z", rad/s and m/s. Raises `TrackingError`."""
    try:
        rates = np.array([float(part) for part in text.split(",")])
        return Motion(-rates, rates)
    except ValueError as error:
        raise TrackingError(f"--motion: found {text!r}; give four numbers from 0 on, as 0.1,0,0.3,1 (rad/s and m/s)") from error


def _description(tracker: Tracker, readings: AttitudeReadings | None, path: Path | None, gyroscope: Path | None) -> list[str]:
    lines = [f"Over time: the state moves by {tracker.motion}."]
    if gyroscope is not None:
        within = f"and between two readings up to {LONGEST_GAP_US // 1000} ms apart within what either allows"
        lines.append(f"Over time: the body's rates are within the plus-minus of {gyroscope}, {within}; elsewhere the pitch moves as above.")
    if tracker.outliers:
        lines.append(f"Over time: of any {tracker.horizon} windows all but {tracker.outliers} at most keep these assumptions.")
    if readings is None:
        return lines
    lines.append(f"Over time: the pitch is within the plus-minus of {path}, and the camera looks along the aircraft's axis.")
    calibration = tracker.estimator.scene.calibration
    if not readings.level(calibration.roll_rad, calibration.yaw_rad):
        lines.append(f"By {path}, roll or yaw may be larger than [calibration] covers; it is taken for granted that they are not.")
    return lines

"""Certified tracking of a recording: windows, one after the other, and what attitude reference and gyroscope say of their instants."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runtime.attitude import Angle, Attitude
from runtime.estimate import Box, Estimate
from runtime.estimator import Estimator
from runtime.motion import Motion
from runtime.recordings.attitude import AttitudeError, AttitudeReadings, Turning
from runtime.recordings.gyroscope import LONGEST_GAP_US, GyroscopeReadings
from runtime.scene import Mount
from runtime.tracker import Tracker


class TrackingError(ValueError):
    """Options of tracking that cannot be used. One line: the option, what was found, what to do."""


@dataclass(frozen=True)
class References:
    """Files of an attitude reference and of a gyroscope; `pitch_alone`: of the first, roll and yaw are taken for 0."""

    attitude: Path | None = None
    gyroscope: Path | None = None
    pitch_alone: bool = False


@dataclass
class Follower:
    """A tracker, what is known of the pitch and of its rate, and the instant of the last window."""

    tracker: Tracker
    readings: AttitudeReadings | None
    turned: bool
    """Are roll and yaw taken from the readings too?"""
    gyroscope: GyroscopeReadings | None
    description: list[str]
    """What the certificates over time assume besides those of single frames."""
    latest_us: float = -np.inf

    @staticmethod
    def of(estimator: Estimator, references: References, motion: str | None, horizon: int | None, outliers: int) -> Follower:
        """Raises `TrackingError` for options that cannot be used, `AttitudeError` and `GyroscopeError` for such files."""
        rates = None if motion is None else _motion(motion)
        if rates is None and estimator.scene.motion is None:
            raise TrackingError("--track: the model's scene has no [motion]; give --motion, the largest rates of theta, x, y, z")
        try:
            tracker = Tracker(estimator, rates, horizon, outliers)
        except ValueError as error:
            raise TrackingError(f"--{error}") from error
        scene = estimator.scene
        readings = None if references.attitude is None else AttitudeReadings.load(references.attitude)
        turned = readings is not None and not references.pitch_alone and not _level(estimator, readings)
        level = not turned and scene.attitude is None and scene.camera.mount in (None, Mount())
        if references.gyroscope is not None and not level:
            raise TrackingError(
                f"--gyroscope: {references.gyroscope} is of a camera that rolls or yaws; leave it out, or give --pitch-alone"
            )
        rates_read = None if references.gyroscope is None else GyroscopeReadings.load(references.gyroscope, scene.calibration.roll_rad)
        return Follower(tracker, readings, turned, rates_read, _description(tracker, readings, references, turned))

    def known(self, instant_us: float) -> tuple[Attitude | None, Box | None]:
        """What the readings say of the camera at an instant: its attitude, None where that is taken for level, and a prior.

        Raises `AttitudeError` for readings of a camera that looks away from the runway.
        """
        estimator = self.tracker.estimator
        if self.readings is None:
            return None, None
        if not self.turned:
            since_us = self.latest_us if np.isfinite(self.latest_us) else None
            turned = None if self.gyroscope is None else partial(self.gyroscope.turned, motion=self.tracker.motion)
            return None, self.readings.prior(instant_us, self.tracker.motion, estimator.domain, since_us, turned)
        angles = self.readings.at(instant_us, self.tracker.motion, Turning.of(estimator.scene))
        try:
            return angles.of_camera(estimator.scene.camera.mount or Mount(), estimator.domain)
        except ValueError as error:
            raise AttitudeError(f"--attitude: at {instant_us:.16g} us: {error}") from error

    def update(self, frame: NDArray[np.uint8], instant_us: float) -> Estimate:
        """The certificate over time of the next window; where the camera's clock went back, a new flight begins."""
        if instant_us < self.latest_us:
            self.tracker.reset()
            self.latest_us = -np.inf
        attitude, prior = self.known(instant_us)
        turned = None
        if self.gyroscope is not None and np.isfinite(self.latest_us):
            turned = {"theta": self.gyroscope.turned(self.latest_us, instant_us, self.tracker.motion)}
        self.latest_us = instant_us
        return self.tracker.update(frame, instant_us, prior, turned, attitude)


def _level(estimator: Estimator, readings: AttitudeReadings) -> bool:
    """True if no reading allows the camera more roll or yaw than the scene's calibration covers."""
    camera, calibration = estimator.scene.camera, estimator.scene.calibration
    return camera.mount in (None, Mount()) and readings.level(calibration.roll_rad, calibration.yaw_rad)


def _motion(text: str) -> Motion:
    """Plus-minus rates from "theta,x,y,z", rad/s and m/s. Raises `TrackingError`."""
    try:
        rates = np.array([float(part) for part in text.split(",")])
        return Motion(-rates, rates)
    except ValueError as error:
        raise TrackingError(f"--motion: found {text!r}; give four numbers from 0 on, as 0.1,0,0.3,1 (rad/s and m/s)") from error


def _description(tracker: Tracker, readings: AttitudeReadings | None, references: References, turned: bool) -> list[str]:
    path, gyroscope = references.attitude, references.gyroscope
    lines = [f"Over time: the state moves by {tracker.motion}."]
    if gyroscope is not None:
        within = f"and between two readings up to {LONGEST_GAP_US // 1000} ms apart within what either allows"
        lines.append(f"Over time: the body's rates are within the plus-minus of {gyroscope}, {within}; elsewhere the pitch moves as above.")
    if tracker.outliers:
        lines.append(f"Over time: of any {tracker.horizon} windows all but {tracker.outliers} at most keep these assumptions.")
    if readings is None:
        return lines
    scene = tracker.estimator.scene
    if turned:
        rates = Turning.of(scene)
        lines.append(f"Over time: roll, pitch and yaw are within the plus-minus of {path}; the camera is mounted as in the scene.")
        lines.append(f"Between two readings roll moves by {_rates(rates.roll_rad_s)}, yaw by {_rates(rates.yaw_rad_s)}.")
        return lines
    lines.append(f"Over time: the pitch is within the plus-minus of {path}, and the camera looks along the aircraft's axis.")
    if not readings.level(scene.calibration.roll_rad, scene.calibration.yaw_rad):
        lines.append(f"By {path}, roll or yaw may be larger than [calibration] covers; it is taken for granted that they are not.")
    return lines


def _rates(bounds: Angle) -> str:
    return f"{bounds[0]:g} to {bounds[1]:g} rad/s"

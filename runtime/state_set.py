"""Sets of states, and the exact ranges of what an image shows of them: rows, scales and columns.

A `StateSet` holds all states with theta, x, y and z in given intervals whose *scale* g(v_ref), the px per metre of the ground at
a reference row (`runtime.camera`), lies in an interval too. Pitch and altitude compensate each other in an image; the scale is
what the image fixes, and a box in (theta, x, scale, z) bounds the lines of all markings at once.

With phi = atan((v - v0)/F), the angle of row v below the camera's axis, and psi = theta + phi, that below the horizon:

    g(v) = F sin(psi) / (y cos(phi))                  so y = F sin(psi_ref) / (scale cos(phi_ref))
    g(v) = scale R,  R = sin(psi) cos(phi_ref) / (sin(psi_ref) cos(phi));   dR/dtheta has the sign of phi_ref - phi
    a ground point d ahead, seen at row v:  y = d tan(psi),  g(v) = F cos(psi) / (d cos(phi)),  0 < psi < pi/2

Every monotonicity that is used is one of these, or is checked over the set where it depends on it (`end_rows`). Results are
plain float64 bounds; `runtime.rounding` turns them outward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from runtime.camera import row_of_point
from runtime.scene import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class StateSet:
    """A batch of sets of states; every field is (sets, 2), lower and upper, except `reference_row`, (sets,) px.

    A set is empty where an interval is inverted; enclosures of an empty set are empty or arbitrary, never unsound.
    """

    theta: Floats
    x: Floats
    y: Floats
    z: Floats
    scale: Floats
    reference_row: Floats

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, index: NDArray) -> StateSet:
        return StateSet(*(getattr(self, name)[index] for name in ("theta", "x", "y", "z", "scale", "reference_row")))

    @property
    def lower(self) -> Floats:
        """Smallest theta, x, y, z of each set, (sets, 4)."""
        return np.stack([self.theta[:, 0], self.x[:, 0], self.y[:, 0], self.z[:, 0]], axis=-1)

    @property
    def upper(self) -> Floats:
        """Largest theta, x, y, z of each set, (sets, 4)."""
        return np.stack([self.theta[:, 1], self.x[:, 1], self.y[:, 1], self.z[:, 1]], axis=-1)


def angle_below_axis(camera: Camera, v: Floats) -> Floats:
    """phi = atan((v - v0)/F) of a row, rad."""
    return np.arctan((v - camera.v0) / camera.focal_px)


def _sine_range(lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
    """Exact range of sin over [lower, upper] within [0, pi]."""
    low, high = np.sin(lower), np.sin(upper)
    return np.minimum(low, high), np.where((lower <= np.pi / 2) & (upper >= np.pi / 2), 1.0, np.maximum(low, high))


def scale_range(camera: Camera, theta: Floats, y: Floats, row: Floats) -> tuple[Floats, Floats]:
    """Exact range of g(row) over boxes theta (..., 2) x y (..., 2) in which row lies below the horizon."""
    phi = angle_below_axis(camera, row)
    low, high = _sine_range(theta[..., 0] + phi, theta[..., 1] + phi)
    factor = camera.focal_px / np.cos(phi)
    return factor * low / y[..., 1], factor * high / y[..., 0]


def contract(camera: Camera, sets: StateSet) -> StateSet:
    """The same sets with the intervals of theta, y and scale drawn in by y = F sin(psi_ref) / (scale cos(phi_ref))."""
    phi = angle_below_axis(camera, sets.reference_row)
    unit = camera.focal_px / np.cos(phi)
    sine_low, sine_high = sets.scale[:, 0] * sets.y[:, 0] / unit, sets.scale[:, 1] * sets.y[:, 1] / unit
    theta_low = np.maximum(sets.theta[:, 0], np.arcsin(np.clip(sine_low, 0, 1)) - phi)
    rising = sets.theta[:, 1] + phi <= np.pi / 2  # below pi/2 the sine bounds the angle from above too
    theta_high = np.where(rising, np.minimum(sets.theta[:, 1], np.arcsin(np.clip(sine_high, 0, 1)) - phi), sets.theta[:, 1])
    theta = np.stack([theta_low, theta_high], axis=-1)
    low, high = _sine_range(theta_low + phi, np.maximum(theta_high, theta_low) + phi)
    y = np.stack([np.maximum(sets.y[:, 0], unit * low / sets.scale[:, 1]), np.minimum(sets.y[:, 1], unit * high / sets.scale[:, 0])], axis=-1)
    return replace(sets, theta=theta, y=y)


def end_rows(camera: Camera, sets: StateSet, end_z_m: float) -> tuple[Floats, Floats]:
    """Range of the row of a marking's end, (sets,) each, px: v0 + F tan(beta - theta), beta = atan2(y, end_z_m + z).

    Over the box (theta, y, z) the row falls in theta and z and rises in y. At one scale y follows theta, and
    d(beta - theta)/dtheta = sin(beta) cos(beta) cot(psi_ref) - 1: where that is negative on the whole set, the row falls in theta
    and in the scale, which bounds it far more closely. Both bounds hold; the closer one is returned.
    """
    near, far = end_z_m + sets.z[:, 0], end_z_m + sets.z[:, 1]
    low = row_of_point(camera, sets.theta[:, 1], sets.y[:, 0], far)
    high = row_of_point(camera, sets.theta[:, 0], sets.y[:, 1], near)
    phi = angle_below_axis(camera, sets.reference_row)
    cotangent = 1 / np.tan(sets.theta[:, 0] + phi)
    double_low, double_high = 2 * np.arctan2(sets.y[:, 0], far), 2 * np.arctan2(sets.y[:, 1], near)
    falls = 0.5 * _sine_range(double_low, double_high)[1] * np.maximum(cotangent, 0) < 1
    unit = camera.focal_px / np.cos(phi)
    y_low = unit * np.sin(sets.theta[:, 1] + phi) / sets.scale[:, 1]
    y_high = unit * np.sin(sets.theta[:, 0] + phi) / sets.scale[:, 0]
    low_on_scale, high_on_scale = row_of_point(camera, sets.theta[:, 1], y_low, far), row_of_point(camera, sets.theta[:, 0], y_high, near)
    return np.where(falls, np.maximum(low, low_on_scale), low), np.where(falls, np.minimum(high, high_on_scale), high)


def scale_on_scale(camera: Camera, sets: StateSet, row: Floats) -> tuple[Floats, Floats]:
    """Range of g(row) over each set from its scale alone; `row` (sets, rows). Below the horizon g > 0, so the bounds stop at 0."""
    phi, phi_ref = angle_below_axis(camera, row), angle_below_axis(camera, sets.reference_row)[:, None]
    ratios = [np.sin(theta[:, None] + phi) * np.cos(phi_ref) / (np.sin(theta[:, None] + phi_ref) * np.cos(phi)) for theta in sets.theta.T]
    low, high = np.minimum(*ratios), np.maximum(*ratios)
    return sets.scale[:, :1] * np.maximum(low, 0), sets.scale[:, 1:] * np.maximum(high, 0)


def scale_between(camera: Camera, sets: StateSet, y: Floats, start: Floats, stop: Floats) -> tuple[Floats, Floats]:
    """Range of g over rows [start, stop], (sets, rows) each, and altitudes y (sets, rows, 2); g rises with the row."""
    theta = sets.theta[:, None, :]
    low_on_scale, high_on_scale = scale_on_scale(camera, sets, start)[0], scale_on_scale(camera, sets, stop)[1]
    low, high = scale_range(camera, theta, y, start)[0], scale_range(camera, theta, y, stop)[1]
    return np.maximum(low_on_scale, low), np.minimum(high_on_scale, np.maximum(high, 0))


def column_range(camera: Camera, across: Floats, scale: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Range of u0 + (p_x - x) g for p_x - x in `across` (sets, 2) and g >= 0 between the two `scale` (sets, rows)."""
    low, high = across[:, :1], across[:, 1:]
    return camera.u0 + np.minimum(low * scale[0], low * scale[1]), camera.u0 + np.maximum(high * scale[0], high * scale[1])

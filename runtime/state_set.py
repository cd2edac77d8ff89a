"""Sets of states, and the exact ranges of what an image shows of them: rows, scales and columns.

A `StateSet` holds all states with theta, x, y and z in given intervals whose *scale* g(v_ref), the px per metre of the ground at
a reference row (`runtime.camera`), lies in an interval too. Pitch and altitude compensate each other in an image; the scale is
what the image fixes, and a box in (theta, x, scale, z) bounds the lines of all markings at once.

Rows enter as tangents t = (v - v0)/F = tan(phi), phi the angle below the camera's axis; psi = theta + phi is that below the horizon,
and s(theta, t) = sin(psi)/cos(phi) = t cos(theta) + sin(theta). Then

    g(v) = F s(theta, t) / y                          so y = F s(theta, t_ref) / scale
    g(v) = scale R,  R = s(theta, t) / s(theta, t_ref);   dR/dtheta has the sign of t_ref - t
    a ground point d ahead, seen at row v:  y = d tan(psi),  g(v) = F (cos(theta) - t sin(theta)) / d,  0 < psi < pi/2

Every monotonicity that is used is one of these, or is checked over the set where it depends on it (`end_rows`). Results are
plain float64 bounds; `runtime.rounding` turns them outward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.camera import row_of_point
from runtime.scene import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class StateSet:
    """A batch of sets of states; every field is (sets, 2), lower and upper, except `tangent`, (sets,): t_ref of the reference row.

    A set is empty where an interval is inverted; enclosures of an empty set are empty or arbitrary, never unsound.
    """

    theta: Floats
    x: Floats
    y: Floats
    z: Floats
    scale: Floats
    tangent: Floats

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, index: NDArray) -> StateSet:
        return StateSet(*(getattr(self, name)[index] for name in ("theta", "x", "y", "z", "scale", "tangent")))

    @property
    def lower(self) -> Floats:
        """Smallest theta, x, y, z of each set, (sets, 4)."""
        return np.stack([self.theta[:, 0], self.x[:, 0], self.y[:, 0], self.z[:, 0]], axis=-1)

    @property
    def upper(self) -> Floats:
        """Largest theta, x, y, z of each set, (sets, 4)."""
        return np.stack([self.theta[:, 1], self.x[:, 1], self.y[:, 1], self.z[:, 1]], axis=-1)


def tangent_of_row(camera: Camera, v: ArrayLike) -> Floats:
    """t = (v - v0)/F of a row."""
    return (np.asarray(v, dtype=np.float64) - camera.v0) / camera.focal_px


def fall(theta: Floats, tangent: Floats) -> Floats:
    """s(theta, t) = t cos(theta) + sin(theta): how far the ray of a row falls, per unit of depth; 0 at the horizon."""
    return np.cos(theta) * tangent + np.sin(theta)


def reach(theta: Floats, tangent: Floats) -> Floats:
    """cos(theta) - t sin(theta): how far the ray of a row reaches ahead, per unit of depth; ds/dtheta."""
    return np.cos(theta) - np.sin(theta) * tangent


def fall_range(theta: Floats, tangent: Floats) -> tuple[Floats, Floats]:
    """Exact range of s over theta in [theta[..., 0], theta[..., 1]], for psi within (-pi/2, pi): it rises up to psi = pi/2."""
    low, high = fall(theta[..., 0], tangent), fall(theta[..., 1], tangent)
    peaks = (reach(theta[..., 0], tangent) >= 0) & (reach(theta[..., 1], tangent) <= 0)
    return np.minimum(low, high), np.where(peaks, np.sqrt(1 + tangent**2), np.maximum(low, high))


def scale_range(camera: Camera, theta: Floats, y: Floats, tangent: Floats) -> tuple[Floats, Floats]:
    """Exact range of g over boxes theta (..., 2) x y (..., 2), at rows below the horizon."""
    low, high = fall_range(theta, tangent)
    return camera.focal_px * low / y[..., 1], camera.focal_px * high / y[..., 0]


def contract(camera: Camera, sets: StateSet) -> StateSet:
    """The same sets with the intervals of theta and y drawn in by y = F s(theta, t_ref) / scale."""
    tangent = sets.tangent
    phi, secant = np.arctan(tangent), np.sqrt(1 + tangent**2)
    sine_low, sine_high = (sets.scale[:, side] * sets.y[:, side] / (camera.focal_px * secant) for side in (0, 1))
    theta_low = np.maximum(sets.theta[:, 0], np.arcsin(np.clip(sine_low, 0, 1)) - phi)
    rises = reach(sets.theta[:, 1], tangent) >= 0  # up to straight down the sine bounds the angle from above too
    theta_high = np.where(rises, np.minimum(sets.theta[:, 1], np.arcsin(np.clip(sine_high, 0, 1)) - phi), sets.theta[:, 1])
    theta = np.stack([theta_low, np.maximum(theta_high, theta_low - 1)], axis=-1)
    y_low, y_high = altitude_range(camera, replace(sets, theta=theta))
    y = np.stack([np.maximum(sets.y[:, 0], y_low), np.minimum(sets.y[:, 1], y_high)], axis=-1)
    return replace(sets, theta=theta, y=y)


def altitude_range(camera: Camera, sets: StateSet) -> tuple[Floats, Floats]:
    """Range of y = F s(theta, t_ref) / scale over theta and scale alone, (sets,) each."""
    low, high = fall_range(sets.theta, sets.tangent)
    return camera.focal_px * low / sets.scale[:, 1], camera.focal_px * high / sets.scale[:, 0]


def end_rows(camera: Camera, sets: StateSet, end_z_m: float) -> tuple[Floats, Floats]:
    """Range of the row of a marking's end, (sets,) each, px: v0 + F tan(beta - theta), beta = atan2(y, end_z_m + z).

    Over the box (theta, y, z) the row falls in theta and z and rises in y. At one scale y follows theta, and
    d(beta - theta)/dtheta = sin(beta) cos(beta) cot(psi_ref) - 1: where that is negative for all altitudes that theta and scale
    allow, the row falls in theta and in the scale, which bounds it far more closely. Both bounds hold; the closer one is returned.
    """
    near, far = end_z_m + sets.z[:, 0], end_z_m + sets.z[:, 1]
    low = row_of_point(camera, sets.theta[:, 1], sets.y[:, 0], far)
    high = row_of_point(camera, sets.theta[:, 0], sets.y[:, 1], near)
    slope = np.minimum(np.maximum(sets.y[:, 1], altitude_range(camera, sets)[1]) / near, 1.0)
    # sin(beta) cos(beta) = slope / (1 + slope^2), which rises up to slope 1
    cotangent = reach(sets.theta[:, 0], sets.tangent) / fall(sets.theta[:, 0], sets.tangent)
    falls = slope / (1 + slope**2) * np.maximum(cotangent, 0) < 1
    y_steep, y_flat = (camera.focal_px * fall(sets.theta[:, side], sets.tangent) / sets.scale[:, side] for side in (1, 0))
    low_on_scale = row_of_point(camera, sets.theta[:, 1], y_steep, far)
    high_on_scale = row_of_point(camera, sets.theta[:, 0], y_flat, near)
    return np.where(falls, np.maximum(low, low_on_scale), low), np.where(falls, np.minimum(high, high_on_scale), high)


def scale_ratio(sets: StateSet, tangent: Floats) -> tuple[Floats, Floats]:
    """Range of R = s(theta, t) / s(theta, t_ref) over each set; `tangent` (sets, rows). Below the horizon R > 0: bounds stop at 0."""
    first, second = (fall(theta[:, None], tangent) / fall(theta, sets.tangent)[:, None] for theta in sets.theta.T)
    return np.maximum(np.minimum(first, second), 0), np.maximum(np.maximum(first, second), 0)


def scale_between(camera: Camera, sets: StateSet, start: Floats, stop: Floats) -> tuple[Floats, Floats]:
    """Range of g over rows with tangents [start, stop], (sets, rows) each; g rises with the row."""
    theta, y = sets.theta[:, None, :], sets.y[:, None, :]
    low_on_scale, high_on_scale = sets.scale[:, :1] * scale_ratio(sets, start)[0], sets.scale[:, 1:] * scale_ratio(sets, stop)[1]
    low, high = scale_range(camera, theta, y, start)[0], scale_range(camera, theta, y, stop)[1]
    return np.maximum(low_on_scale, low), np.minimum(high_on_scale, np.maximum(high, 0))


def column_range(camera: Camera, across: Floats, scale: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Range of u0 + (p_x - x) g for p_x - x in `across` (..., 2) and g >= 0 between the two `scale` (..., rows)."""
    low, high = across[..., :1], across[..., 1:]
    return camera.u0 + np.minimum(low * scale[0], low * scale[1]), camera.u0 + np.maximum(high * scale[0], high * scale[1])

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
plain float64 bounds, which `runtime.rounding` turns outward where they are used; `contract` alone does so itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.rounding import lowered, raised
from runtime.scene import Camera
from runtime.turn import cosine_and_sine

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

    def __getitem__(self, index: NDArray | slice) -> StateSet:
        return StateSet(self.theta[index], self.x[index], self.y[index], self.z[index], self.scale[index], self.tangent[index])

    @property
    def empty(self) -> NDArray[np.bool_]:
        """True for sets with an inverted interval, (sets,)."""
        return np.logical_or.reduce([side[:, 0] > side[:, 1] for side in (self.theta, self.x, self.y, self.z, self.scale)])

    def contracted(self, **bounds: tuple[Floats, Floats]) -> StateSet:
        """The sets with the named intervals (any but theta's) intersected with the bounds given for them, lower and upper, (sets,) each."""
        closer = {}
        for name, (low, high) in bounds.items():
            own = getattr(self, name)
            closer[name] = np.stack([np.maximum(own[:, 0], low), np.minimum(own[:, 1], high)], axis=-1)
        return self._with(**closer)

    def emptied(self, which: NDArray[np.bool_]) -> StateSet:
        """The sets, of which those marked in `which` (sets,) are made empty: their scale gets an inverted interval, above 0."""
        return self._with(scale=np.where(which[:, None], [2.0, 1.0], self.scale))

    def _with(self, **fields: Floats) -> StateSet:
        """The sets with other intervals, theta's excepted, whose sines and cosines are then not computed again."""
        sets = replace(self, **fields)
        for name in ("turn", "reference_fall", "condition"):
            if name in self.__dict__:
                sets.__dict__[name] = self.__dict__[name]
        return sets

    @cached_property
    def turn(self) -> tuple[Floats, Floats]:
        """Cosine and sine of theta, (sets, 2) each."""
        return cosine_and_sine(self.theta)

    @cached_property
    def reference_fall(self) -> Floats:
        """s(theta, t_ref) at both ends of theta, (sets, 2)."""
        return self.turn[0] * self.tangent[:, None] + self.turn[1]

    @cached_property
    def condition(self) -> Floats:
        """(1 + |t_ref|) / s(theta, t_ref), at least 1, (sets,): what one rounding of the terms of s means relative to s itself."""
        return (1 + np.abs(self.tangent)) / self.reference_fall.min(axis=1)

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
    """The same sets with the intervals of theta and y contracted by y = F s(theta, t_ref) / scale, rounded outward."""
    tangent = sets.tangent
    phi, secant = np.arctan(tangent), np.sqrt(1 + tangent**2)
    sine_low, sine_high = (sets.scale[:, side] * sets.y[:, side] / (camera.focal_px * secant) for side in (0, 1))
    psi_low = np.arcsin(np.clip(lowered(sine_low, sine_low), 0, 1))  # near 1 an arcsine makes much of its argument's rounding
    psi_high = np.arcsin(np.clip(raised(sine_high, sine_high), 0, 1))
    theta_low = np.maximum(sets.theta[:, 0], lowered(psi_low - phi, psi_low + np.abs(phi)))
    rises = reach(sets.theta[:, 1], tangent) >= 0  # up to straight down the sine bounds the angle from above too
    theta_high = np.where(rises, np.minimum(sets.theta[:, 1], raised(psi_high - phi, psi_high + np.abs(phi))), sets.theta[:, 1])
    contracted = replace(sets, theta=np.stack([theta_low, theta_high], axis=-1))
    y_low, y_high = altitude_range(camera, contracted)
    y_low, y_high = lowered(y_low, y_low * contracted.condition), raised(y_high, y_high * contracted.condition)
    return replace(contracted, y=np.stack([np.maximum(sets.y[:, 0], y_low), np.minimum(sets.y[:, 1], y_high)], axis=-1))


def reference_fall_range(sets: StateSet) -> tuple[Floats, Floats]:
    """Exact range of s(theta, t_ref) over each set, (sets,) each."""
    low, high = np.minimum(*sets.reference_fall.T), np.maximum(*sets.reference_fall.T)
    (cosine_low, cosine_high), (sine_low, sine_high) = sets.turn[0].T, sets.turn[1].T
    peaks = (cosine_low >= sine_low * sets.tangent) & (cosine_high <= sine_high * sets.tangent)
    return low, np.where(peaks, np.sqrt(1 + sets.tangent**2), high) if peaks.any() else high


def altitude_range(camera: Camera, sets: StateSet) -> tuple[Floats, Floats]:
    """Range of y = F s(theta, t_ref) / scale over theta and scale alone, (sets,) each."""
    low, high = reference_fall_range(sets)
    return camera.focal_px * low / sets.scale[:, 1], camera.focal_px * high / sets.scale[:, 0]


def end_rows(camera: Camera, sets: StateSet, end_z_m: ArrayLike) -> tuple[Floats, Floats]:
    """Range of the row of a marking's end, px: v0 + F tan(beta - theta), beta = atan2(y, end_z_m + z).

    `end_z_m`: a number, or several (ends,); returns (sets,) or (sets, ends) each. Over the box (theta, y, z) the row falls in theta and
    z and rises in y. At one scale y follows theta, and d(beta - theta)/dtheta = sin(beta) cos(beta) cot(psi_ref) - 1: where that is
    negative for all altitudes that theta and scale allow, the row falls in theta and in the scale, which bounds it far more closely.
    Both bounds hold; the closer one is returned.
    """
    end = np.asarray(end_z_m, dtype=np.float64)

    def beside(values: Floats) -> Floats:
        return values.reshape(-1, *[1] * end.ndim)

    near, far = beside(sets.z[:, 0]) + end, beside(sets.z[:, 1]) + end
    y_flat, y_steep = (camera.focal_px * sets.reference_fall[:, side] / sets.scale[:, side] for side in (0, 1))
    slope = np.minimum(beside(np.maximum(sets.y[:, 1], altitude_range(camera, sets)[1])) / near, 1.0)
    # sin(beta) cos(beta) = slope / (1 + slope^2), which rises up to slope 1
    cotangent = (sets.turn[0][:, 0] - sets.turn[1][:, 0] * sets.tangent) / sets.reference_fall[:, 0]
    falls = slope * np.maximum(beside(cotangent), 0) < 1 + slope**2
    # The row rises in y: where both bounds hold, the closer one is that of the larger or smaller of the two altitudes.
    # No farther out than the set's own altitudes go: what lies beyond them may be behind the camera.
    y_low = np.where(falls, beside(np.clip(y_steep, *sets.y.T)), beside(sets.y[:, 0]))
    y_high = np.where(falls, beside(np.clip(y_flat, *sets.y.T)), beside(sets.y[:, 1]))
    low = _row(camera, sets, 1, y_low, far, beside)
    return low, _row(camera, sets, 0, y_high, near, beside)


def _row(camera: Camera, sets: StateSet, side: int, y: Floats, d: Floats, beside: Callable[[Floats], Floats]) -> Floats:
    """`row_of_point` at the lower (0) or upper (1) theta of each set."""
    cosine, sine = beside(sets.turn[0][:, side]), beside(sets.turn[1][:, side])
    return camera.v0 + camera.focal_px * (y * cosine - d * sine) / (y * sine + d * cosine)


def scale_ratio(sets: StateSet, tangent: Floats) -> tuple[Floats, Floats]:
    """Range of R = s(theta, t) / s(theta, t_ref) over each set; `tangent` (rows, sets). Below the horizon R > 0: bounds stop at 0."""
    (cosine, sine), reference = sets.turn, sets.reference_fall
    (slope, other_slope), (start, other_start) = (cosine / reference).T, (sine / reference).T
    first, second = tangent * slope + start, tangent * other_slope + other_start
    return np.maximum(np.minimum(first, second), 0), np.maximum(np.maximum(first, second), 0)


def scale_between(camera: Camera, sets: StateSet, start: Floats, stop: Floats) -> tuple[Floats, Floats]:
    """Range of g over rows with tangents [start, stop], (sets, rows) each; g rises with the row."""
    theta, y = sets.theta[:, None, :], sets.y[:, None, :]
    slowest, fastest = scale_ratio(sets, start.T)[0].T, scale_ratio(sets, stop.T)[1].T
    low, high = scale_range(camera, theta, y, start)[0], scale_range(camera, theta, y, stop)[1]
    return np.maximum(sets.scale[:, :1] * slowest, low), np.minimum(sets.scale[:, 1:] * fastest, np.maximum(high, 0))


def column_range(camera: Camera, across: Floats, scale: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Range of u0 + (p_x - x) g for p_x - x in `across` (..., 2) and g >= 0 between the two `scale` (..., rows)."""
    low, high = across[..., :1], across[..., 1:]
    return camera.u0 + np.minimum(low * scale[0], low * scale[1]), camera.u0 + np.maximum(high * scale[0], high * scale[1])

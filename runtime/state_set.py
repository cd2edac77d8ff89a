"""Sets of states, and the exact ranges of what an image shows of them: rows, scales and columns.

A `StateSet` holds all states with theta, x, y and z in given intervals whose *scale* g(v_ref), the px per metre of the ground at
a reference row (`runtime.camera`), lies in an interval too. Pitch and altitude compensate each other in an image; the scale is
what the image fixes, and a box in (theta, x, scale, z) bounds the lines of all markings at once.

Rows enter as tangents t = (v - v0)/F_v = tan(phi), phi the angle below the camera's axis; psi = theta + phi is that below the horizon,
and s(theta, t) = sin(psi)/cos(phi) = t cos(theta) + sin(theta). Then

    g(v) = F_u s(theta, t) / y                        so y = F_u s(theta, t_ref) / scale
    g(v) = scale R,  R = s(theta, t) / s(theta, t_ref);   dR/dtheta has the sign of t_ref - t
    a ground point d ahead, seen at row v:  y = d tan(psi),  g(v) = F_u (cos(theta) - t sin(theta)) / d,  0 < psi < pi/2

Every monotonicity that is used is one of these, or is checked over the set where it depends on it (`end_rows`). Results are
plain float64 bounds, which `runtime.rounding` turns outward where they are used; `contract` alone does so itself.

Where the camera is rolled or yawed, theta is the pitch that the ideal frame shows, rows and columns are those of the ideal frame, and every
set has intervals of the camera's roll and yaw besides (`runtime.attitude`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.attitude import Turns
from runtime.rounding import lowered, raised
from runtime.scene import Camera
from runtime.turn import cosine_and_sine

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class StateSet:
    """A batch of sets of states; every field is (sets, 2), lower and upper, except `tangent`, (sets,): t_ref of the reference row.

    `roll` and `yaw` are None where the frame is the ideal one.

    A set is empty where an interval is inverted; enclosures of an empty set are empty or arbitrary, never unsound.
    """

    theta: Floats
    x: Floats
    y: Floats
    z: Floats
    scale: Floats
    tangent: Floats
    roll: Floats | None = None
    yaw: Floats | None = None

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, index: NDArray[np.int64] | NDArray[np.bool_] | slice) -> StateSet:
        if isinstance(index, slice):
            turn = (None if side is None else side[index] for side in (self.roll, self.yaw))
            return StateSet(self.theta[index], self.x[index], self.y[index], self.z[index], self.scale[index], self.tangent[index], *turn)
        numbers = np.flatnonzero(index) if index.dtype == np.bool_ else index
        theta, x, y, z, scale = (side.T.take(numbers, axis=1).T for side in (self.theta, self.x, self.y, self.z, self.scale))
        if self.roll is None or self.yaw is None:
            return StateSet(theta, x, y, z, scale, self.tangent.take(numbers))
        return StateSet(theta, x, y, z, scale, self.tangent.take(numbers), self.roll[numbers], self.yaw[numbers])

    @property
    def empty(self) -> NDArray[np.bool_]:
        """True for sets with an inverted interval, (sets,)."""
        inverted = [side[:, 0] > side[:, 1] for side in (self.theta, self.x, self.y, self.z, self.scale)]
        return inverted[0] | inverted[1] | inverted[2] | inverted[3] | inverted[4]

    @property
    def x_known(self) -> bool:
        """Is x one number in each of the sets, or none?"""
        return not (self.x[:, 0] < self.x[:, 1]).any()

    def contracted(self, **bounds: tuple[Floats, Floats]) -> StateSet:
        """The sets with the named intervals (any but theta's) intersected with the bounds given for them, lower and upper, (sets,) each."""
        closer = {}
        for name, (low, high) in bounds.items():
            own = getattr(self, name)
            sides = np.empty((2, len(own)))
            np.maximum(own[:, 0], low, out=sides[0])
            np.minimum(own[:, 1], high, out=sides[1])
            closer[name] = sides.T
        return self._with(closer)

    def emptied(self, which: NDArray[np.bool_]) -> StateSet:
        """The sets, of which those marked in `which` (sets,) are made empty: their scale gets an inverted interval, above 0."""
        return self._with({"scale": np.where(which[:, None], [2.0, 1.0], self.scale)}) if which.any() else self

    def _with(self, fields: dict[str, Floats]) -> StateSet:
        """The sets with other intervals, theta's excepted, of which nothing is then computed again."""
        sets = object.__new__(StateSet)
        sets.__dict__.update(self.__dict__)
        sets.__dict__.update(fields)
        return sets

    @cached_property
    def turns(self) -> Turns:
        """The rotations from the ideal frame to the sensor's, of sets with roll and yaw."""
        assert self.roll is not None
        assert self.yaw is not None
        return Turns.of(self.theta, self.roll, self.yaw)

    @cached_property
    def turn(self) -> tuple[Floats, Floats]:
        """Cosine and sine of theta, (sets, 2) each."""
        cosine, sine = cosine_and_sine(np.array(self.theta.T))  # lower ends side by side, then upper ones: numpy is fastest so
        return cosine.T, sine.T

    @cached_property
    def reference_fall(self) -> Floats:
        """s(theta, t_ref) at both ends of theta, (sets, 2)."""
        return self.turn[0] * self.tangent[:, None] + self.turn[1]

    @cached_property
    def condition(self) -> Floats:
        """(1 + |t_ref|) / s(theta, t_ref), at least 1, (sets,): what one rounding of the terms of s means relative to s itself."""
        return (1 + np.abs(self.tangent)) / self.reference_fall.min(axis=1)

    @cached_property
    def reference_range(self) -> tuple[Floats, Floats]:
        """Exact range of s(theta, t_ref) over each set, (sets,) each."""
        first, last = self.reference_fall.T
        (cosine_low, cosine_high), (sine_low, sine_high) = self.turn[0].T, self.turn[1].T
        peaks = (cosine_low >= sine_low * self.tangent) & (cosine_high <= sine_high * self.tangent)
        high = np.maximum(first, last)
        return np.minimum(first, last), np.where(peaks, np.sqrt(1 + self.tangent**2), high) if peaks.any() else high

    @cached_property
    def ratio_lines(self) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
        """Slope and start, (sets,) each, of R = slope t + start at the lower and at the upper end of theta."""
        slope, start = ((part / self.reference_fall).T.copy() for part in self.turn)
        return (slope[0], start[0]), (slope[1], start[1])

    @property
    def lower(self) -> Floats:
        """Smallest theta, x, y, z of each set, (sets, 4)."""
        return np.stack([self.theta[:, 0], self.x[:, 0], self.y[:, 0], self.z[:, 0]], axis=-1)

    @property
    def upper(self) -> Floats:
        """Largest theta, x, y, z of each set, (sets, 4)."""
        return np.stack([self.theta[:, 1], self.x[:, 1], self.y[:, 1], self.z[:, 1]], axis=-1)


def tangent_of_row(camera: Camera, v: ArrayLike) -> Floats:
    """t = (v - v0)/F_v of a row."""
    return (np.asarray(v, dtype=np.float64) - camera.v0) / camera.focal_v_px


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
    return camera.focal_u_px * low / y[..., 1], camera.focal_u_px * high / y[..., 0]


def contract(camera: Camera, sets: StateSet) -> StateSet:
    """The same sets with the intervals of theta and y contracted by y = F_u s(theta, t_ref) / scale, rounded outward."""
    tangent = sets.tangent
    phi, secant = np.arctan(tangent), np.sqrt(1 + tangent**2)
    sine_low, sine_high = (sets.scale[:, side] * sets.y[:, side] / (camera.focal_u_px * secant) for side in (0, 1))
    psi_low = np.arcsin(np.clip(lowered(sine_low, sine_low), 0, 1))  # near 1 an arcsine makes much of its argument's rounding
    psi_high = np.arcsin(np.clip(raised(sine_high, sine_high), 0, 1))
    theta_low = np.maximum(sets.theta[:, 0], lowered(psi_low - phi, psi_low + np.abs(phi)))
    rises = reach(sets.theta[:, 1], tangent) >= 0  # up to straight down the sine bounds the angle from above too
    theta_high = np.where(rises, np.minimum(sets.theta[:, 1], raised(psi_high - phi, psi_high + np.abs(phi))), sets.theta[:, 1])
    contracted = replace(sets, theta=np.stack([theta_low, theta_high], axis=-1))
    y_low, y_high = altitude_range(camera, contracted)
    y_low, y_high = lowered(y_low, y_low * contracted.condition), raised(y_high, y_high * contracted.condition)
    return replace(contracted, y=np.stack([np.maximum(sets.y[:, 0], y_low), np.minimum(sets.y[:, 1], y_high)], axis=-1))


def altitude_range(camera: Camera, sets: StateSet) -> tuple[Floats, Floats]:
    """Range of y = F_u s(theta, t_ref) / scale over theta and scale alone, (sets,) each."""
    low, high = sets.reference_range
    return camera.focal_u_px * low / sets.scale[:, 1], camera.focal_u_px * high / sets.scale[:, 0]


def end_rows(camera: Camera, sets: StateSet, end_z_m: ArrayLike) -> tuple[Floats, Floats]:
    """Range of the row of a marking's end, px: v0 + F_v tan(beta - theta), beta = atan2(y, end_z_m + z).

    `end_z_m`: a number, or several (ends,); returns (sets,) or (sets, ends) each. Over the box (theta, y, z) the row falls in theta and
    z and rises in y. At one scale y follows theta, and d(beta - theta)/dtheta = sin(beta) cos(beta) cot(psi_ref) - 1: where that is
    negative for all altitudes that theta and scale allow, the row falls in theta and in the scale, which bounds it far more closely.
    Both bounds hold; the closer one is returned.
    """
    end = np.asarray(end_z_m, dtype=np.float64)[..., None]  # sets come last: numpy is fastest along them
    near, far = sets.z[:, 0] + end, sets.z[:, 1] + end
    lowest, highest = sets.y.T
    (cosine, other_cosine), (sine, other_sine) = sets.turn[0].T, sets.turn[1].T
    y_flat, y_steep = (camera.focal_u_px * sets.reference_fall / sets.scale).T
    slope = np.minimum(np.maximum(highest, altitude_range(camera, sets)[1]) / near, 1.0)
    # sin(beta) cos(beta) = slope / (1 + slope^2), which rises up to slope 1
    cotangent = (cosine - sine * sets.tangent) / sets.reference_fall[:, 0]
    falls = slope * np.maximum(cotangent, 0) < 1 + slope**2
    # The row rises in y: where both bounds hold, the closer one is that of the larger or smaller of the two altitudes.
    # No farther out than the set's own altitudes go: what lies beyond them may be behind the camera.
    y_low = np.where(falls, np.minimum(np.maximum(y_steep, lowest), highest), lowest)
    y_high = np.where(falls, np.minimum(np.maximum(y_flat, lowest), highest), highest)
    return _row(camera, other_cosine, other_sine, y_low, far).T, _row(camera, cosine, sine, y_high, near).T


def _row(camera: Camera, cosine: Floats, sine: Floats, y: Floats, d: Floats) -> Floats:
    """`row_of_point` at the pitch with this cosine and sine."""
    return camera.v0 + camera.focal_v_px * (y * cosine - d * sine) / (y * sine + d * cosine)


def scale_ratio(sets: StateSet, tangent: Floats) -> tuple[Floats, Floats]:
    """Range of R = s(theta, t) / s(theta, t_ref) over each set; `tangent` (..., sets). Below the horizon R > 0: bounds stop at 0."""
    (slope, start), (other_slope, other_start) = sets.ratio_lines
    first, second = tangent * slope, tangent * other_slope
    first += start
    second += other_start
    low, high = np.minimum(first, second), np.maximum(first, second, out=first)
    return np.maximum(low, 0, out=low), np.maximum(high, 0, out=high)


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

"""The rigid camera in ball arithmetic: what a slice of states shows, proved with Arb from the plain camera equations.

This is the verifier's own camera; it shares no formula and no rounding with the masks' construction. A ground point d metres ahead,
X = p_x - x across, is seen by a camera y metres up that is pitched down by theta (conventions: `runtime.camera`):

    Y = -y cos(theta) + d sin(theta)    Z = y sin(theta) + d cos(theta)    u = u0 + F_u X/Z    v = v0 - F_v Y/Z

Turned back, with tau = (v - v0)/F_v = -Y/Z, the point that row v shows has

    y = Z fall,   fall  = sin(theta) + tau cos(theta)
    d = Z reach,  reach = cos(theta) - tau sin(theta)        u = u0 + X g,  g = F_u/Z

so that g, the px per metre across the ground, is F_u fall/y as well as F_u reach/d. With theta + atan(tau) in (-pi, pi), fall and reach
are sqrt(1 + tau^2) times its sine and cosine: their signs at the two ends of a slice of theta show where they rise and fall. And

    fall(v)/fall(r) = 1 + (tau_v - tau_r) / (tau_r + tan(theta))     is monotone in theta where row r sees the ground,
    dv/dy = F_v d/Z^2 > 0,   dv/dd = -F_v y/Z^2 < 0,   dv/dtheta = -F_v (1 + (Y/Z)^2) < 0     for y, d, Z > 0.

Everything is evaluated at points, as balls of 64 bits, and a comparison holds only if it holds for all of both balls. Within one
theta each bound is the exact one; over a slice of theta it is an outer one that tends to it as the slice narrows.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from flint import arb  # pyright: ignore[reportMissingModuleSource]

from runtime.scene import Camera

PRECISION_BITS = 64
BallInterval = tuple[arb, arb]
"""Two balls, the lower and the upper bound."""


def least(first: arb, second: arb) -> arb:
    """One of two bounds, the smaller unless their balls overlap; for bounds that both hold."""
    return first if first < second else second


def greatest(first: arb, second: arb) -> arb:
    """One of two bounds, the greater unless their balls overlap; for bounds that both hold."""
    return first if first > second else second


def focal_lengths(camera: Camera) -> tuple[arb, arb]:
    """F_u and F_v, px: those stated, or the quotient of the lengths."""
    if camera.focal_px is not None:
        return arb(camera.focal_px[0]), arb(camera.focal_px[1])
    focal = arb(camera.focal_length_m) / arb(camera.pixel_pitch_m)
    return focal, focal


class BallCamera:
    """A scene's camera; sines, cosines and rays are kept, as the slices of many entries share them."""

    def __init__(self, camera: Camera) -> None:
        self.focal_u_px, self.focal_v_px = focal_lengths(camera)
        self.u0, self.v0 = arb(camera.u0), arb(camera.v0)
        self._turns: dict[float, BallInterval] = {}
        self._rays: dict[tuple[float, float], BallInterval] = {}

    def turn(self, theta: float) -> BallInterval:
        """sin(theta) and cos(theta)."""
        turn = self._turns.get(theta)
        if turn is None:
            turn = self._turns[theta] = arb(theta).sin_cos()
        return turn

    def tangent(self, row: float) -> arb:
        """tau = (v - v0)/F_v of a row."""
        return (arb(row) - self.v0) / self.focal_v_px

    def ray(self, theta: float, row: float) -> BallInterval:
        """fall and reach of a row's ray, y/Z and d/Z."""
        ray = self._rays.get((theta, row))
        if ray is None:
            (sine, cosine), tangent = self.turn(theta), self.tangent(row)
            ray = self._rays[theta, row] = sine + tangent * cosine, cosine - tangent * sine
        return ray

    def row(self, theta: float, y: arb, d: arb) -> arb:
        """v of a ground point, from Y and Z; not finite unless Z is certainly not 0."""
        sine, cosine = self.turn(theta)
        return self.v0 - self.focal_v_px * (d * sine - y * cosine) / (y * sine + d * cosine)

    def fall_range(self, low: float, high: float, row: float) -> BallInterval:
        """Range of fall over theta in [low, high]: sqrt(1 + tau^2) times the sine of an angle in (-pi, pi)."""
        (first, ahead_first), (last, ahead_last) = self.ray(low, row), self.ray(high, row)
        if ahead_first >= 0 and ahead_last >= 0:
            return first, last
        peak = (1 + self.tangent(row) ** 2).sqrt()
        above_horizon = first > 0 and last > 0
        falling = above_horizon and ahead_first <= 0 and ahead_last <= 0
        return first.min(last) if above_horizon else -peak, first if falling else peak

    def reach_range(self, low: float, high: float, row: float) -> BallInterval:
        """Range of reach over theta in [low, high]: sqrt(1 + tau^2) times the cosine of an angle in (-pi, pi), which has one peak."""
        (fall_first, first), (fall_last, last) = self.ray(low, row), self.ray(high, row)
        if fall_first >= 0:
            highest = first
        elif fall_last <= 0:
            highest = last
        else:
            highest = (1 + self.tangent(row) ** 2).sqrt()
        return first.min(last), highest


@dataclass(frozen=True, eq=False)
class Ends:
    """Distances ahead of a marking's near and far end, each a range over the states, m. Markings with the same ends share one."""

    near: BallInterval
    far: BallInterval


@dataclass(frozen=True)
class BallEntry:
    """A bank entry: the states of a cell with `y` in the cell's range, theta, x, z and the scale at the reference row in the box's.

    `theta` are two float64 numbers, `x`, `y`, `z` (m) and `scale` (px per m) ranges.
    """

    camera: BallCamera
    theta: tuple[float, float]
    x: BallInterval
    y: BallInterval
    z: BallInterval
    scale: BallInterval
    reference_row: float


@dataclass
class Slice:
    """The states of an entry with theta in [low, high]. `sees_ground` is False where the reference row is not certainly on the ground.

    `y` is the range of altitudes that theta, the scale and the cell leave; the slice is empty where it is certainly inverted.
    """

    entry: BallEntry
    low: float
    high: float
    y: BallInterval = field(init=False)
    sees_ground: bool = field(init=False)
    _halves: tuple[Slice, Slice] | None = field(init=False, default=None)
    _rows: dict[Ends, tuple[BallInterval, BallInterval] | None] = field(init=False, default_factory=dict)
    _scales: dict[tuple[Ends, int], BallInterval | None] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        entry, camera = self.entry, self.entry.camera
        fall = camera.fall_range(self.low, self.high, entry.reference_row)
        self.sees_ground = fall[0] > 0
        self.y = entry.y
        if self.sees_ground:
            lowest = greatest(entry.y[0], camera.focal_u_px * fall[0] / entry.scale[1])
            self.y = lowest, least(entry.y[1], camera.focal_u_px * fall[1] / entry.scale[0]) if entry.scale[0] > 0 else entry.y[1]

    @property
    def empty(self) -> bool:
        """True if certainly no state of the entry has such a theta."""
        return self.y[0] > self.y[1]

    @property
    def middle(self) -> float:
        """A theta between the ends."""
        return (self.low + self.high) / 2

    def halves(self) -> tuple[Slice, Slice]:
        """Two slices that cover this one; the same two at every call."""
        if self._halves is None:
            self._halves = Slice(self.entry, self.low, self.middle), Slice(self.entry, self.middle, self.high)
        return self._halves

    def depth(self, d: BallInterval) -> BallInterval:
        """Range of Z = y sin(theta) + d cos(theta)."""
        (sine_low, cosine_first), (sine_high, cosine_last) = self.entry.camera.turn(self.low), self.entry.camera.turn(self.high)
        cosine_high = arb(1) if self.low < 0 < self.high else cosine_first.max(cosine_last)
        lowest = (self.y[0] * sine_low).min(self.y[1] * sine_low) + d[0] * cosine_first.min(cosine_last)
        highest = (self.y[0] * sine_high).max(self.y[1] * sine_high) + d[1] * cosine_high
        return lowest, highest

    def rows(self, ends: Ends) -> tuple[BallInterval, BallInterval] | None:
        """Ranges of v of the near and of the far end; None unless every state has both certainly in front of it."""
        if ends not in self._rows:
            self._rows[ends] = self._end_rows(ends)
        return self._rows[ends]

    def _end_rows(self, ends: Ends) -> tuple[BallInterval, BallInterval] | None:
        if not (self.sees_ground and self.entry.y[0] > 0 and ends.near[0] > 0 and self.depth((ends.near[0], ends.far[1]))[0] > 0):
            return None
        row = self.entry.camera.row
        near, far = ((row(self.high, self.y[0], d[1]), row(self.low, self.y[1], d[0])) for d in (ends.near, ends.far))
        return near, far

    def scale_at(self, row: int) -> BallInterval:
        """Range of g at a row: scale fall(row)/fall(reference row), and F_u fall/y within the cell's altitudes; 0 at the horizon."""
        entry, camera = self.entry, self.entry.camera
        first, last = (camera.ray(theta, row)[0] / camera.ray(theta, entry.reference_row)[0] for theta in (self.low, self.high))
        fall = camera.fall_range(self.low, self.high, row)
        low, high = first.min(last).max(0), first.max(last).max(0)
        lowest = greatest(entry.scale[0] * low, camera.focal_u_px * fall[0] / entry.y[1])
        return lowest, least(entry.scale[1] * high, camera.focal_u_px * fall[1].max(0) / entry.y[0])

    def scales_seen_in(self, row: int, ends: Ends) -> BallInterval | None:
        """Range of g over the points of a marking that lie in a row; None if no state of the slice shows any there.

        The slice must have `rows`. A point in the row is not seen below the row's lower border, nor nearer than the near end.
        """
        if (ends, row) not in self._scales:
            self._scales[ends, row] = self._scales_in(row, ends)
        return self._scales[ends, row]

    def _scales_in(self, row: int, ends: Ends) -> BallInterval | None:
        rows = self.rows(ends)
        if rows is None:
            raise ValueError("the marking is not certainly in front of the camera")
        (_, near_high), (far_low, _) = rows
        if near_high < row or far_low >= row + 1:
            return None
        camera = self.entry.camera
        upper, lower = (camera.reach_range(self.low, self.high, border) for border in (row, row + 1))
        nearest, farthest = self.depth((ends.near[0], ends.far[1]))
        low = greatest(self.scale_at(row)[0], camera.focal_u_px / farthest)
        high = least(self.scale_at(row + 1)[1], camera.focal_u_px / nearest)
        low = greatest(low, camera.focal_u_px * upper[0].min(lower[0]) / ends.far[1])
        high = least(high, camera.focal_u_px * upper[1].max(lower[1]) / ends.near[0])
        return None if low > high else (low, high)

    def scales_crossed_in(self, row: int, ends: Ends) -> BallInterval | None:
        """For a marking that every state of the slice shows in a row: each one's g starts there at or below the first number that is
        returned, and goes on to the second or above. None unless all certainly show it. The slice must have `rows`.
        """
        rows = self.rows(ends)
        if rows is None:
            raise ValueError("the marking is not certainly in front of the camera")
        (near_low, _), (_, far_high) = rows
        if not (near_low > row and far_high < row + 1):
            return None
        focal_u_px = self.entry.camera.focal_u_px
        start, stop = self.scale_at(row)[1], self.scale_at(row + 1)[0]
        if not far_high <= row:
            start = start.max(focal_u_px / self.depth(ends.far)[0])
        if not near_low >= row + 1:
            stop = stop.min(focal_u_px / self.depth(ends.near)[1])
        return start, stop


def columns(camera: BallCamera, across: BallInterval, scales: BallInterval) -> BallInterval:
    """Range of u = u0 + X g over X in `across` and g in `scales`."""
    products = [side * scale for side in across for scale in scales]
    return camera.u0 + products[0].min(products[1]), camera.u0 + products[2].max(products[3])


def columns_crossed(camera: BallCamera, across: BallInterval, scales: BallInterval) -> BallInterval:
    """A path goes from u0 + X g_start to u0 + X g_stop, g_start <= scales[0], g_stop >= scales[1], both above 0, X in `across`.

    Returns a bound above each path's smaller end and one below each path's greater end.
    """
    start, stop = (camera.u0 + across[1] * scale for scale in scales)
    smaller = start if across[1] > 0 else stop if across[1] <= 0 else start.max(stop)
    start, stop = (camera.u0 + across[0] * scale for scale in scales)
    greater = stop if across[0] > 0 else start if across[0] <= 0 else start.min(stop)
    return smaller, greater

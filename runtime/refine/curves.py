"""The markings of sets of states as a lens shows them, and where they meet the borders between the sensor's rows.

Before the lens, every marking is a straight line of rays, S = A T + B (`runtime.refine.view`); the lens shows a ray at D(S, T)
(`runtime.lens`), in the row D_y. Along a line dD_y/dT = J_yy + A J_xy, with J the lens's Jacobian. Where that is at least `rise` above 0 on
the whole stretch of all lines that may hold a marking, a marking meets a border once at most, at a T that is no farther than

    |T - T0| <= |D_y(S0, T0) - D_y of the border| / rise

from any T0 of the stretch, S0 being where its line is at T0. That bounds where all states' markings meet the border, whatever T0 is; it is
narrow for one found by Newton's steps along the line in the middle. A principal point's plus-minus shows the marking beside D, by a bound
that is another at another T: by what that grows at most a T, `rise` is less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.attitude import Turns
from runtime.refine.interval import Bits, Floats, Interval
from runtime.refine.optics import ROUNDED_DERIVATIVE, Optics
from runtime.refine.view import Lines
from runtime.rounding import ROUNDING_SHARE

PIECES = 8
"""A stretch is cut into so many, in each of which the lens's derivatives are bounded by those at its middle."""
NEWTON_STEPS = 2
"""Of two, what is left is far below a millionth of a pixel; a straight line is found at once."""


@dataclass(frozen=True)
class Met:
    """Where the markings may meet borders of the sensor, (markings, rows, sets), in rays and as the lens shows it; and if it is known."""

    s: Interval
    t: Interval
    shown: Interval
    """Of D_x."""
    known: Bits
    spans: Bits
    """True where the lines of all states meet the border within the stretch, be it beyond their markings' ends."""


@dataclass(frozen=True)
class Curves:
    """Stretches of the lines of markings between two T, (markings, sets) all."""

    optics: Optics
    lines: Lines
    start: Floats
    stop: Floats
    rise: Floats
    """A bound below dD_y/dT on the stretches of all lines, less what the tilt's bound grows by."""
    monotone: Bits
    """True where that is above 0, and the stretch within the lens's disc; else the others mean nothing."""
    margin: Floats
    """Of S, for rounding, (sets,)."""

    @staticmethod
    def of(optics: Optics, lines: Lines, start: Floats, stop: Floats, margin: Floats) -> Curves:
        """Of lines between `start` and `stop`, infinite where these are not known."""
        fine = np.isfinite(start) & np.isfinite(stop) & (start <= stop)
        start, stop = np.where(fine, start, 0.0), np.where(fine, stop, 0.0)
        step = (stop - start) / PIECES
        middle = start[:, None] + step[:, None] * (np.arange(PIECES) + 0.5)[:, None]
        (low, high), known = lines.at(middle)
        s, (least, most) = (low + high) / 2, lines.slopes
        steepest = np.maximum(np.abs(least), np.abs(most))
        reach = ((high - low) / 2 + margin + step[:, None] / 2 * (1 + steepest)) * (1 + ROUNDED_DERIVATIVE)
        _, mixed, down, off = optics.derivatives(s, middle, reach)
        rise = (down + np.minimum(least * mixed, most * mixed) - off * (1 + steepest)).min(axis=1)
        farthest = np.maximum(np.abs(low), np.abs(high)).max(axis=1) + reach.max(axis=1), np.maximum(np.abs(start), np.abs(stop))
        rise = rise - optics.tilt_growth(lines.view.turns, *farthest) * (1 + steepest[:, 0])
        fine &= (known & optics.within(s, middle, reach)).all(axis=1) & (rise > 0)
        return Curves(optics, lines, start, stop, np.where(fine, rise, 1.0), fine, margin)

    def met(self, border: Floats) -> Met:
        """Where they may meet borders that the lens shows at these D_y, (rows, sets)."""
        t, turns = self._found(border), self.lines.view.turns
        (low, high), known = self.lines.at(t)
        s, half = (low + high) / 2, ((high - low) / 2 + self.margin) * (1 + ROUNDING_SHARE)
        (shown, shown_row), (across, mixed, _) = self.optics.lens.distorted_and_jacobian(s, t)
        off_row = self.optics.border(border) + self.optics.beside_tilt(turns, s, t, half)[1]
        miss = np.abs(shown_row - border) + (np.abs(mixed) + self.optics.bent(half)) * half + off_row + self._rounding(border)
        reach = miss / self.rise[:, None] * (1 + ROUNDED_DERIVATIVE)
        steepest = np.maximum(*np.abs(self.lines.slopes))
        half = (half + steepest * reach) * (1 + ROUNDING_SHARE)
        around = half + reach
        off = self.optics.bent(around)
        known = known & self.monotone[:, None] & self.optics.within(s, t, around)
        beside = (np.abs(across) + off) * half + (np.abs(mixed) + off) * reach
        beside += self.optics.beside_tilt(turns, s, t, around)[0] + self.optics.lens.rounding + ROUNDING_SHARE * np.abs(shown)
        # Between two borders a curve leaves what lies between where it meets them by less than it bends over two rows' way.
        way = 2 * (1 + steepest) / (self.optics.camera.focal_v_px * self.rise[:, None])
        beside += self.optics.lens.largest_bend * way * way / 8
        sides = (s - half, s + half), (t - reach, t + reach), (shown - beside, shown + beside)
        return Met(*sides, known, known & self._spanned(border))

    def _spanned(self, border: Floats) -> Bits:
        """True where both ends of the stretches of all lines lie on either side of a border, (markings, rows, sets)."""
        turns, spanned = self.lines.view.turns, np.ones(1, dtype=bool)
        off = self.optics.border(border) + self._rounding(border)
        for side, below in ((self.start[:, None], True), (self.stop[:, None], False)):
            (low, high), known = self.lines.at(side)
            shown, within = shown_rows(self.optics, turns, (low - self.margin, high + self.margin), (side, side))
            spanned = spanned & known & within & (shown[1] <= border - off if below else shown[0] >= border + off)
        return spanned

    def _found(self, border: Floats) -> Floats:
        """About the T at which the line in the middle meets each border, within the stretch, (markings, rows, sets)."""
        start, stop = self.start[:, None], self.stop[:, None]
        middle = (start + stop) / 2
        (low, high), _ = self.lines.at(middle)
        s, slope = (low + high) / 2, sum(self.lines.slopes) / 2
        first, last = (self.optics.lens.distorted(s + slope * (side - middle), side)[1] for side in (start, stop))
        share = (border - first) / np.where(last > first, last - first, 1.0)
        t = start + np.clip(share, 0.0, 1.0) * (stop - start)
        for _ in range(NEWTON_STEPS if self.optics.lens.model else 0):
            at = s + slope * (t - middle)
            (_, shown), (_, mixed, down) = self.optics.lens.distorted_and_jacobian(at, t)
            rise = np.maximum(down + slope * mixed, self.rise[:, None])
            t = np.clip(t - (shown - border) / rise, start, stop)
        return t

    def _rounding(self, border: Floats) -> Floats:
        """What the place of a border, and D there, are off by."""
        return self.optics.lens.rounding + ROUNDING_SHARE * (1 + np.abs(border))


def shown_rows(optics: Optics, turns: Turns, s: Interval, t: Interval) -> tuple[Interval, Bits]:
    """Range of D_y over boxes of rays, of any shape; False where a box is not certainly within the lens's disc."""
    known = np.isfinite(s[0]) & np.isfinite(s[1]) & np.isfinite(t[0]) & np.isfinite(t[1])
    s, t = ((np.where(known, side[0], 0.0), np.where(known, side[1], 0.0)) for side in (s, t))
    middle_s, middle_t = (s[0] + s[1]) / 2, (t[0] + t[1]) / 2
    half_s, half_t = ((side[1] - side[0]) / 2 * (1 + ROUNDING_SHARE) + ROUNDING_SHARE * np.abs(side[1]) for side in (s, t))
    reach = half_s + half_t
    (_, shown), (_, mixed, down) = optics.lens.distorted_and_jacobian(middle_s, middle_t)
    off = optics.bent(reach)
    beside = (np.abs(mixed) + off) * half_s + (down + off) * half_t + optics.lens.rounding
    beside = beside + optics.beside_tilt(turns, middle_s, middle_t, reach)[1]
    return (shown - beside, shown + beside), known & optics.within(middle_s, middle_t, reach)

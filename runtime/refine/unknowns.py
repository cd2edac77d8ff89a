"""How offsets move with what is unknown of a camera: its rotation, focal lengths and principal point, up to a plus-minus each.

A point of the sensor, N from the principal point in focal lengths, is shown at D = (1 + g) N - Q by the lens, g and Q for the calibration's
plus-minus of the focal lengths and of the principal point; its ray is that point's of the lens, turned by a and b (`runtime.refine.view`).
With the parameters p in (a, b, g, Q_u, Q_v), h = F s X/D and q = X/D, w = Z/D,

    h_S / (F s) = (X_S - q D_S)/D      h_T / (F s) = (X_T - q D_T)/D           J, the lens's Jacobian, turns a step of D into one of rays
    h_b / (F s) = -(Z/D + sin(c) q^2)      h_a / (F s) = (cos(b) Y + q (cos(c) S' - sin(c) sin(b) Y))/D

where q is the same for all points of a marking, and w depends on the ideal row alone. What most parameters do is all but common to all
markings, or to all their offsets in proportion. So of every one a part c_p + k_p (w - w*) + d_p q is taken out, with numbers c, k, d of the
set; then an offset as it is seen by the parameters in the middle is

    h0 = (p_x - x'') scale'' - kappa (w - w*) - rest        scale'' = scale (1 - G),  x'' = x + C/scale''

with |G| <= sum of |d_p| off_p, and likewise C, kappa. The rest is what is left of the derivatives, times how far each parameter may be off.
c, k and d are read off four points of the set; nothing rests on how well they fit but the size of the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.refine.around import Around
from runtime.refine.interval import Bits, Floats
from runtime.refine.optics import Optics
from runtime.refine.view import ROUNDED_SWAY, View
from runtime.rounding import ROUNDING_SHARE

LEAST_APART = 2.0**-10
"""Points whose w or q differ by less tell nothing of how a derivative depends on it."""


@dataclass(frozen=True)
class Derivatives:
    """h_p / (F s) of the parameters that may be off, with how far those may be, and w and q, at points of sets, (markings, rows, sets)."""

    by: tuple[Around, ...]
    w: Around
    q: Around
    known: Bits

    @staticmethod
    def at(view: View, optics: Optics, s: Floats, t: Floats, reach: Floats) -> Derivatives:
        """At points whose rays lie, by the parameters in the middle, within `reach` of (s, t)."""
        turns, moved = view.turns, optics.moved(s, t, reach)
        away = reach + moved
        ray_s, ray_t = Around(s, away), Around(t, away)
        cos_a, sin_a = _turn(turns.cos_a, turns.sin_a, turns.off_a)
        cos_b, sin_b = _turn(turns.cos_b, turns.sin_b, turns.off_b)
        cos_c, sin_c = Around.between(*view.cosine, view.bulge), Around.between(*view.sine, view.bulge)
        aside, y = cos_a * ray_s + sin_a * ray_t, cos_a * ray_t - sin_a * ray_s
        x, z = cos_b * aside - sin_b, sin_b * aside + cos_b
        falls = cos_c * y + sin_c * z
        q, known = x.over(falls)
        w, _ = z.over(falls)
        leaning = sin_c * sin_b
        by_a, _ = (cos_b * y + q * (cos_c * aside - leaning * y)).over(falls)
        nothing = Around(np.zeros(1), np.zeros(1))
        by_b = nothing - (w + sin_c * q * q)
        by_s, _ = (cos_b * cos_a - q * (leaning * cos_a - cos_c * sin_a)).over(falls)
        by_t, _ = (cos_b * sin_a - q * (cos_c * cos_a + leaning * sin_a)).over(falls)
        across, mixed, down, off = optics.derivatives(s, t, away)
        across, mixed, down = (Around(side, off) for side in (across, mixed, down))
        share, invertible = Around(np.ones(1), np.zeros(1)).over(across * down - mixed * mixed)
        by_u, by_v = (by_s * down - by_t * mixed) * share, (by_t * across - by_s * mixed) * share
        shown_u, shown_v = optics.lens.distorted(s, t)
        beside = reach * optics.lens.largest_scale
        by_focal = by_u * Around(shown_u, beside) + by_v * Around(shown_v, beside)
        return Derivatives((by_a, by_b, by_focal, by_u, by_v), w, q, known & invertible & optics.within(s, t, away))


def _turn(cosine: Floats, sine: Floats, off: Floats) -> tuple[Around, Around]:
    """Cosine and sine of an angle that is off by so much at most."""
    square = off * off / 2
    return Around(cosine, np.abs(sine) * off + square), Around(sine, np.abs(cosine) * off + square)


@dataclass(frozen=True)
class Unknowns:
    """What is taken out of the derivatives, and how far it may move offsets; arrays are (sets,)."""

    c: tuple[Floats, ...]
    k: tuple[Floats, ...]
    d: tuple[Floats, ...]
    w: Floats
    """w*."""
    off: tuple[Floats, ...]
    """How far each parameter may be off."""
    focal: Floats
    """F s, at most."""

    @staticmethod
    def of(view: View, optics: Optics, points: tuple[Floats, Floats]) -> Unknowns:
        """By four points of each set, (4, sets): a marking's far and near end, and another's."""
        found = Derivatives.at(view, optics, *points, np.zeros(1))
        w, q = found.w.middle, found.q.middle
        apart_w, apart_q = w[1::2] - w[::2], (q[2] + q[3] - q[0] - q[1]) / 2
        c, k, d = [], [], []
        middle = w.mean(axis=0)
        for each in found.by:
            value = np.broadcast_to(each.middle, w.shape)
            slopes = (value[1::2] - value[::2]) / np.where(np.abs(apart_w) > LEAST_APART, apart_w, np.inf)
            along = slopes.mean(axis=0)
            left, right = ((value - along * (w - middle))[first : first + 2].mean(axis=0) for first in (0, 2))
            steep = (right - left) / np.where(np.abs(apart_q) > LEAST_APART, apart_q, np.inf)
            for part, number in zip((c, k, d), ((left + right) / 2 - steep * q.mean(axis=0), along, steep), strict=True):
                part.append(np.where(np.isfinite(number), number, 0.0))
        middle = np.where(np.isfinite(middle), middle, 0.0)
        return Unknowns(tuple(c), tuple(k), tuple(d), middle, optics.off(view.turns), view.largest_focal)

    def _total(self, parts: tuple[Floats, ...]) -> Floats:
        return sum((np.abs(part) * off for part, off in zip(parts, self.off, strict=True)), np.zeros(1)) * ROUNDED_SWAY

    @property
    def scaled(self) -> Floats:
        """Largest |G|, (sets,)."""
        return self._total(self.d)

    @property
    def shifted_px(self) -> Floats:
        """Largest |C|, (sets,)."""
        return self._total(self.c) * self.focal

    @property
    def sheared_px(self) -> Floats:
        """Largest |kappa|, (sets,)."""
        return self._total(self.k) * self.focal

    def rest_px(self, at: Derivatives) -> Floats:
        """Largest size of the rest at points, (markings, rows, sets); infinite where it is not known."""
        rest: Floats = np.zeros(1)
        for by, c, k, d, off in zip(at.by, self.c, self.k, self.d, self.off, strict=True):
            left = np.abs(by.middle - c - k * (at.w.middle - self.w) - d * at.q.middle)
            terms = np.abs(by.middle) + np.abs(c) + np.abs(k) * (np.abs(at.w.middle) + np.abs(self.w)) + np.abs(d * at.q.middle)
            rest = rest + off * (left + by.off + np.abs(k) * at.w.off + np.abs(d) * at.q.off + ROUNDING_SHARE * terms)
        return np.where(at.known & np.isfinite(rest), rest * self.focal * ROUNDED_SWAY, np.inf)

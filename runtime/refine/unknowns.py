"""How offsets move with what is unknown of a camera: its rotation, focal lengths and principal point, up to a plus-minus each.

A point of the sensor, N from the principal point in focal lengths, is shown at D = (1 + g) N - Q by the lens, g and Q for the calibration's
plus-minus of the focal lengths and of the principal point; its ray is that point's of the lens, turned by a and b (`runtime.refine.view`).
With the parameters p in (a, b, g, Q_u, Q_v), h = F s X/D, q = X/D, w = Z/D and xi = X/Z, each derivative is F s w m_p with

    m_S = (X_S - q D_S)/Z      m_T = (X_T - q D_T)/Z           J, the lens's Jacobian, turns a step of (g, Q) into one of rays
    m_b = -(1 + sin(c) q xi)   m_a = (cos(b) Y + q (cos(c) S' - sin(c) sin(b) Y))/Z

where q is the same for all points of a marking, and w = 1/(cos(c) t + sin(c)) depends on the ideal row t = Y/Z alone. What most parameters
do is all but common to all markings, or to all their offsets in proportion. So of w m_p a part c_p + k_p (w - w*) + d_p q is taken out,
with numbers c, k, d of the set; then an offset as it is seen by the parameters in the middle is

    h0 = (p_x - x'') scale'' - kappa (w - w*) - rest        scale'' = scale (1 - G),  x'' = x + C/scale''

with |G| <= sum of |d_p| off_p, and likewise kappa, and C for each kappa (`shifted_px`): way by way they grow in proportion to the
parameters, by a factor that they share. Parameters and pitches other than those in the middle turn 1/w into
(1 + mu)/w + nu + small, with mu and nu the same for all points: w becomes rho* (1 + eta) w, rho* = 1/(1 + mu + nu w*),

    |eta| <= (|nu| |w - w*| + small w) / (1 - |mu| - |nu| w - small w)

and rho* is the state's own, as C, kappa and G are. So the rest is only what c, k and d leave in the middle of a stretch, and what eta, the
m_p and, along the stretch, w and q may change, times how far each parameter may be off. c, k and d are read off four points; nothing rests
on how well they fit but its size.

A principal point that lies lower is all but a pitch. So the pitch of sets here is the one that is seen, c'' = c + p with Q_v = -p, and m_v
is that of both together: a pitch that is p less adds q (cos(c) - sin(c) t).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from runtime.refine.around import Around
from runtime.refine.interval import Bits, Floats, Interval
from runtime.refine.optics import Optics
from runtime.refine.view import ROUNDED_SWAY, View
from runtime.rounding import ROUNDING_SHARE

LEAST_APART = 2.0**-10
"""Points whose w or q differ by less tell nothing of how a derivative depends on it."""
LEAST_SLOPE = 2.0**-20
"""A parameter that shears less says nothing of how it shifts what it shears."""
STEEPEST_COSINE = 0.25
"""Of the pitch: for a camera that looks farther down, another pitch is not taken for a change of mu and nu."""
LARGEST_CHANGE = 0.5
"""Of 1/w: beyond, what a parameter moves counts as not known."""


@dataclass(frozen=True)
class Moves:
    """Of points by the parameters in the middle: rays, how parameters move the ideal row t, and the matrices of `View`'s notation."""

    x: Around
    z: Around
    t: Around
    aside: Around
    down: Around
    rows: tuple[Around, ...]
    """dt/dp, of each parameter; of g less t itself."""
    off: tuple[Floats, ...]
    """How far each parameter may be off."""
    inverse: tuple[Around, Around, Around]
    """dS/dD_x, dS/dD_y = dT/dD_x and dT/dD_y of the lens."""
    shown: tuple[Around, Around]
    """N."""
    reach: Floats
    """How far from that of the points the ideal rows t of others of their stretches lie, by the parameters in the middle."""
    beside: Floats
    """And how far from theirs the xi of those."""
    known: Bits

    @staticmethod
    def at(view: View, optics: Optics, s: Floats, t: Floats, reach: Floats, down: Floats | None = None) -> Moves:
        """Of points whose rays lie, by the parameters in the middle, within `reach` of (s, t), and along T within `down`.

        Without `down` the points lie along a border of the sensor.
        """
        zoom, right, below = optics.swings
        away = reach + optics.moved(s, t, reach)
        *jacobian, off = optics.derivatives(s, t, away)
        across, mixed, along = (Around(side, off) for side in jacobian)
        share, known = Around(np.ones(1), np.zeros(1)).over(across * along - mixed * mixed)
        inverse = along * share, Around(np.zeros(1), np.zeros(1)) - mixed * share, across * share
        shown_u, shown_v = optics.lens.distorted(s, t)
        beside = reach * optics.lens.largest_scale
        step_u, step_v = zoom * (np.abs(shown_u) + beside) + right, zoom * (np.abs(shown_v) + beside) + below
        size = [np.abs(each.middle) + each.off for each in inverse]
        if down is None:
            slope = (np.abs(mixed.middle) + off) / np.where(along.middle > off, along.middle - off, np.nan)
            down = np.where(slope < 1, slope, 1.0) * reach
        ray_s = Around(s, reach + size[0] * step_u + size[1] * step_v)
        ray_t = Around(t, down + size[1] * step_u + size[2] * step_v)
        cos_a, sin_a, cos_b, sin_b = _rotation(view)
        aside, y = cos_a * ray_s + sin_a * ray_t, cos_a * ray_t - sin_a * ray_s
        x, z = cos_b * aside - sin_b, sin_b * aside + cos_b
        per, ahead = Around(np.ones(1), np.zeros(1)).over(z)
        tangent = y * per
        by_s, by_t = (Around(np.zeros(1), np.zeros(1)) - sin_a - tangent * sin_b * cos_a) * per, (cos_a - tangent * sin_b * sin_a) * per
        by_u, by_v = by_s * inverse[0] + by_t * inverse[1], by_s * inverse[1] + by_t * inverse[2]
        shown = Around(shown_u, beside), Around(shown_v, beside)
        nothing = Around(np.zeros(1), np.zeros(1))
        by_a, by_b = (nothing - aside - tangent * sin_b * y) * per, (nothing - tangent * x) * per
        by_zoom = by_u * shown[0] + by_v * shown[1] - tangent
        known = known & ahead & optics.within(s, t, away)
        rows, offs = (by_a, by_b, by_zoom, by_u, by_v), optics.off(view.turns)
        reach_t = (np.abs(by_s.middle) + by_s.off) * reach + (np.abs(by_t.middle) + by_t.off) * down
        nearest = np.where(known, z.middle - z.off, 1.0)
        beside_xi = reach / (nearest * nearest)  # dxi/dS' = 1/Z^2
        return Moves(x, z, tangent, aside, y, rows, offs, inverse, shown, reach_t, beside_xi, known)


def _rotation(view: View) -> tuple[Around, Around, Around, Around]:
    """Cosines and sines of a and of b."""
    turns = view.turns
    return *_turn(turns.cos_a, turns.sin_a, turns.off_a), *_turn(turns.cos_b, turns.sin_b, turns.off_b)


def _turn(cosine: Floats, sine: Floats, off: Floats) -> tuple[Around, Around]:
    """Cosine and sine of an angle that is off by so much at most."""
    square = off * off / 2
    return Around(cosine, np.abs(sine) * off + square), Around(sine, np.abs(cosine) * off + square)


def _pitch(view: View, optics: Optics) -> tuple[Around, Around]:
    """Cosine and sine of the pitch that is seen, and of the ideal frame's."""
    tilt, square = optics.tilt, optics.tilt**2
    more_c, more_s = (np.abs(side).max(axis=0) * tilt + square for side in (view.sine, view.cosine))
    cosine, sine = view.cosine, view.sine
    return Around.between(cosine[0], cosine[1], view.bulge + more_c), Around.between(sine[0], sine[1], view.bulge + more_s)


@dataclass(frozen=True)
class Common:
    """What other parameters and pitches do to 1/w at all points of a set, (sets,)."""

    rows: tuple[Floats, ...]
    """A part of dt/dp that is taken for common, of each parameter."""
    mu: Floats
    nu: Floats
    w: Floats
    """w*."""

    @staticmethod
    def of(view: View, optics: Optics, moves: Moves, w: Floats) -> Common:
        """By some points of each set, (points, sets)."""
        cosine, sine = _pitch(view, optics)
        rows = tuple(np.broadcast_to(each.middle, w.shape).mean(axis=0) for each in moves.rows)
        rows = tuple(np.where(np.isfinite(row), row, 0.0) for row in rows)
        common = sum((off * np.abs(row) for off, row in zip(moves.off, rows, strict=True)), np.zeros(1))
        flat, zoom = cosine.middle > STEEPEST_COSINE, moves.off[2]
        steep = np.where(flat, cosine.middle, 1.0)
        largest = cosine.middle + cosine.off
        # g moves t in proportion: cos(c) g t = g (1/w - sin(c)); another pitch adds dcos t + dsin, t = (1/w - sin(c))/cos(c)
        mu = zoom * largest / steep + np.where(flat, cosine.off / steep, 0.0)
        nu = largest * common + zoom * np.abs(sine.middle) * largest / steep
        nu = nu + np.where(flat, sine.off + cosine.off * np.abs(sine.middle) / steep, 0.0)
        middle = w.mean(axis=0)
        return Common(rows, mu * ROUNDED_SWAY, nu * ROUNDED_SWAY, np.where(np.isfinite(middle), middle, 0.0))

    @property
    def growth(self) -> Floats:
        """rho* at most, where it is known."""
        return 1 / np.where(self.known, 1 - self.mu - self.nu * np.abs(self.w), 1.0)

    @property
    def known(self) -> Bits:
        """False where 1/w may change too much."""
        return 1 - self.mu - self.nu * np.abs(self.w) > LARGEST_CHANGE


@dataclass(frozen=True)
class Derivatives:
    """w m_p at points, in the middle, and what may be otherwise there: (markings, rows, sets)."""

    by: tuple[Floats, ...]
    m: tuple[Around, ...]
    w: Floats
    q: Floats
    eta: Floats
    reach: Floats
    """How far w may be from that at the point along its stretch."""
    beside: Floats
    """And how far q."""
    known: Bits

    @staticmethod
    def of(view: View, optics: Optics, moves: Moves, common: Common | None) -> Derivatives:
        """Of points, with what is common to those of a set; without that, only what they are in the middle means anything."""
        cos_c, sin_c = _pitch(view, optics)
        falls = cos_c.middle * moves.t.middle + sin_c.middle
        known = moves.known & (falls > 0)
        w = np.where(known, 1 / np.where(known, falls, 1.0), 1.0)
        eta, growth = np.zeros(1), np.ones(1)
        largest = cos_c.middle + cos_c.off
        lower = w * largest * moves.reach  # by which share 1/w may be less elsewhere on the stretch
        known = known & (lower < LARGEST_CHANGE)
        reach = w * lower / np.where(known, 1 - lower, 1.0)
        most = w + reach
        if common is not None:
            small: Floats = np.zeros(1)
            for off, row, taken in zip(moves.off, moves.rows, common.rows, strict=True):
                small = small + off * (np.abs(row.middle - taken) + row.off)
            size = np.abs(moves.t.middle) + moves.t.off
            small = largest * small + np.where(cos_c.middle > STEEPEST_COSINE, 0.0, cos_c.off * size + sin_c.off)
            small = (small + ROUNDING_SHARE * (1 + size)) * ROUNDED_SWAY
            least = 1 - common.mu - common.nu * most - small * most
            known = known & (least > LARGEST_CHANGE)
            growth = 1 / np.where(known, least, 1.0)
            eta = (common.nu * (np.abs(w - common.w) + reach) + small * most) * growth
        xi, _ = moves.x.over(moves.z)
        q = xi * Around(w, most * growth - w)
        cos_a, sin_a, cos_b, sin_b = _rotation(view)
        leaning = sin_c * sin_b
        per, _ = Around(np.ones(1), np.zeros(1)).over(moves.z)
        m_a = (cos_b * moves.down + q * (cos_c * moves.aside - leaning * moves.down)) * per
        m_b = Around(-np.ones(1), np.zeros(1)) - sin_c * q * xi
        m_s = (cos_b * cos_a - q * (leaning * cos_a - cos_c * sin_a)) * per
        beside = (cos_b - q * leaning) * sin_a * per  # m_t but for the pitch's part
        m_t = beside - q * cos_c * cos_a * per
        m_u, m_v = m_s * moves.inverse[0] + m_t * moves.inverse[1], m_s * moves.inverse[1] + m_t * moves.inverse[2]
        m_zoom = m_u * moves.shown[0] + m_v * moves.shown[1]
        if optics.lens.model is None:  # m along the ray, from which N is as far as g and Q move it
            m_zoom = (sin_b + q * sin_c * cos_b) * per
            zoom, *aside = optics.swings
            for m, n, shift in zip((m_u, m_v), moves.shown, aside, strict=True):
                beyond = (np.abs(m.middle) + m.off) * (zoom * (np.abs(n.middle) + n.off) + shift)
                m_zoom = Around(m_zoom.middle, m_zoom.off + beyond)
        if optics.tilt > 0:
            cancelled = q * cos_c * (Around(np.ones(1), np.zeros(1)) - cos_a * per * moves.inverse[2])
            m_v = m_s * moves.inverse[1] + beside * moves.inverse[2] + cancelled - q * sin_c * moves.t
        m = m_a, m_b, m_zoom, m_u, m_v
        beside = most * moves.beside + np.abs(xi.middle) * reach
        return Derivatives(tuple(w * each.middle for each in m), m, w, q.middle, eta, reach, beside, known)


@dataclass(frozen=True)
class Unknowns:
    """What is taken out of the derivatives, and how far it may move offsets; arrays are (sets,)."""

    c: tuple[Floats, ...]
    k: tuple[Floats, ...]
    d: tuple[Floats, ...]
    common: Common
    off: tuple[Floats, ...]
    """How far each parameter may be off."""
    focal: Floats
    """F s, at most."""

    @staticmethod
    def of(view: View, optics: Optics, points: tuple[Floats, Floats]) -> Unknowns:
        """By four points of each set, (4, sets): a marking's far and near end, and another's."""
        moves = Moves.at(view, optics, *points, np.zeros(1))
        found = Derivatives.of(view, optics, moves, None)
        w, q = found.w, found.q
        apart_w, apart_q = w[1::2] - w[::2], (q[2] + q[3] - q[0] - q[1]) / 2
        common = Common.of(view, optics, moves, w)
        c, k, d = [], [], []
        for each in found.by:
            value = np.broadcast_to(each, w.shape)
            slopes = (value[1::2] - value[::2]) / np.where(np.abs(apart_w) > LEAST_APART, apart_w, np.inf)
            along = slopes.mean(axis=0)
            left, right = ((value - along * (w - common.w))[first : first + 2].mean(axis=0) for first in (0, 2))
            steep = (right - left) / np.where(np.abs(apart_q) > LEAST_APART, apart_q, np.inf)
            for part, number in zip((c, k, d), ((left + right) / 2 - steep * q.mean(axis=0), along, steep), strict=True):
                part.append(np.where(np.isfinite(number), number, 0.0))
        return Unknowns(tuple(c), tuple(k), tuple(d), common, moves.off, view.largest_focal)

    def _sum(self, parts: tuple[Floats, ...]) -> Floats:
        return sum((np.abs(part) * off for part, off in zip(parts, self.off, strict=True)), np.zeros(1)) * ROUNDED_SWAY

    @cached_property
    def _growth(self) -> Floats:
        """rho* at most, times what the q that is seen may be off: as q = q0 + C/(F s) + kappa (w - w*)/(F s) + G q of the q0 seen."""
        least = 1 - self.common.growth * self._sum(self.d)
        return self.common.growth / np.where(least > LARGEST_CHANGE, least, 1.0) * ROUNDED_SWAY

    @property
    def known(self) -> Bits:
        """False where the parameters may move so much that nothing can be said, (sets,)."""
        return self.common.known & (self.common.growth * self._sum(self.d) < LARGEST_CHANGE / 2)

    def _total(self, parts: tuple[Floats, ...]) -> Floats:
        return self._sum(parts) * self._growth

    @property
    def scaled(self) -> Floats:
        """Largest |G|, (sets,)."""
        return self._total(self.d)

    def shifted_px(self, least: Floats, most: Floats) -> Interval:
        """Range of C, (sets,), where kappa lies between two numbers: both are sums over the same parameters.

        C <= sum of |c_p - l k_p| off_p + max(l least, l most) for every number l; the best l is 0 or one of the c_p/k_p.
        """
        size = self._growth * self.focal
        slopes = [np.zeros(1)]
        for c, k in zip(self.c, self.k, strict=True):
            slopes.append(c / np.where(np.abs(k) > LEAST_SLOPE, k, np.inf))
        low, high = np.full(len(least), -np.inf), np.full(len(least), np.inf)
        for slope in slopes:
            beside = self._sum(tuple(c - slope * k for c, k in zip(self.c, self.k, strict=True)))
            terms = self._sum(tuple(np.abs(c) + np.abs(slope * k) for c, k in zip(self.c, self.k, strict=True)))
            ends, beside = (slope * least, slope * most), (beside + ROUNDING_SHARE * terms) * size
            margin = ROUNDING_SHARE * np.maximum(np.abs(ends[0]), np.abs(ends[1]))
            low = np.maximum(low, np.minimum(*ends) - beside - margin)
            high = np.minimum(high, np.maximum(*ends) + beside + margin)
        return low, high

    @property
    def sheared_px(self) -> Floats:
        """Largest |kappa|, (sets,)."""
        return self._total(self.k) * self.focal

    def sheared_at(self, view: View, moves: Moves) -> tuple[Floats, Floats, Bits]:
        """w - w* and the largest size of the rest, px, at points, and where they are known."""
        assert view.optics is not None
        at = Derivatives.of(view, view.optics, moves, self.common)
        sheared, rest = at.w - self.common.w, np.zeros(1)
        for by, m, c, k, d, off in zip(at.by, at.m, self.c, self.k, self.d, self.off, strict=True):
            left = np.abs(by - c - k * sheared - d * at.q)
            changed = (at.w + at.reach) * at.eta * (np.abs(m.middle) + m.off) + at.w * m.off
            beside = (np.abs(m.middle) + m.off + np.abs(k)) * at.reach + np.abs(d) * at.beside
            terms = np.abs(by) + np.abs(c) + np.abs(k) * (np.abs(at.w) + np.abs(self.common.w)) + np.abs(d * at.q)
            rest = rest + off * (left + changed + beside + ROUNDING_SHARE * terms)
        rest = rest * self.focal * self._growth
        known = at.known & self.known & np.isfinite(rest)
        return np.where(known, sheared, 0.0), np.where(known, rest, 0.0), known

"""How a rolled and yawed sensor looks at the ground that sets of states see, and how offsets sway with what is unknown of its rotation.

Notation and claims are those of `runtime.refine.sensor_borders`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from runtime.attitude import Turns
from runtime.refine.interval import Bits, Floats, Interval
from runtime.refine.optics import Optics, Patch, Stretch
from runtime.rounding import ROUNDING_SHARE, lowered, raised
from runtime.scene import Camera
from runtime.state_set import StateSet

LEAST_DEPTH = 0.1
"""Of a ray of length about 1, or of a marking's line against a row: below it, where a marking is seen counts as not known at all."""
ROUNDED_SWAY = 1 + 2.0**-30
"""Factor on bounds of how far an offset may sway, which are sums of products of sizes: far above their rounding."""


@dataclass(frozen=True)
class Sway:
    """h_a and h_b over F s, at points: middles of their ranges, and how far these reach to either side."""

    by_a: Floats
    off_by_a: Floats
    by_b: Floats
    off_by_b: Floats
    known: Bits
    """False where D may be 0: the others mean nothing there."""

    def beside(self, point: Sway, camera: Camera, view: View) -> Floats:
        """Largest |E(p) - E(p*)|, px; infinite where it is not known."""
        by_a = np.abs(self.by_a - point.by_a) + self.off_by_a + point.off_by_a
        by_b = np.abs(self.by_b - point.by_b) + self.off_by_b + point.off_by_b
        terms = ROUNDING_SHARE * (np.abs(self.by_a) + np.abs(point.by_a) + np.abs(self.by_b) + np.abs(point.by_b))
        largest = view.total(by_a + terms, by_b + terms) * (camera.focal_u_px * ROUNDED_SWAY)
        return np.where(self.known & point.known, largest, np.inf)

    def alone(self, view: View) -> Floats:
        """Largest |E(p)| over F; infinite where it is not known."""
        return np.where(self.known, view.total(np.abs(self.by_a) + self.off_by_a, np.abs(self.by_b) + self.off_by_b), np.inf)


@dataclass(frozen=True)
class View:
    """The rotations of sets of states and what is needed of their pitch, (sets,) each, or (2, sets) at both ends of the pitch."""

    turns: Turns
    cosine: Floats
    sine: Floats
    fall: Floats
    """s(c, t_ref)."""
    condition: Floats
    focal: Floats
    """F, as an array (sets,)."""
    optics: Optics | None = None

    @staticmethod
    def of(camera: Camera, sets: StateSet, optics: Optics | None = None) -> View:
        """Of sets with roll and yaw; without, of sets whose sensor has none but the plus-minus of its calibration."""
        cosine, sine = (part.T.copy() for part in sets.turn)
        fall = sets.reference_fall.T.copy()
        turns = sets.turns if optics is None else optics.turns(sets)
        return View(turns, cosine, sine, fall, sets.condition, np.full(len(sets), camera.focal_u_px), optics)

    @property
    def largest_focal(self) -> Floats:
        """F s at most, (sets,)."""
        return self._largest_fall * self.focal

    @property
    def _largest_fall(self) -> Floats:
        return np.maximum(self.fall[0], self.fall[1]) + self.bulge * (1 + np.abs(self.condition * self.fall.min(axis=0)))

    def rays(self, tangent_u: Floats, tangent_v: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """X, Y, Z of points of the sensor in the ideal frame, by the rotation in the middle; and S'."""
        turns = self.turns
        aside = turns.cos_a * tangent_u + turns.sin_a * tangent_v
        down = turns.cos_a * tangent_v - turns.sin_a * tangent_u
        return turns.cos_b * aside - turns.sin_b, down, turns.sin_b * aside + turns.cos_b, aside

    def quotient(self, tangent_u: Floats, tangent_v: Floats, margin: Floats, extreme: np.ufunc, off: Floats | None = None) -> Floats:
        """The smallest or largest (X + margin) s/D over the set's pitches; the worst infinity where D may not be above 0.

        `off`: how far D may be off for the point's sake.
        """
        across_, down, ahead, _ = self.rays(tangent_u, tangent_v)
        across_ = across_ + margin
        terms = ROUNDING_SHARE * (np.abs(down) + np.abs(ahead)) + (0.0 if off is None else off)
        beside = np.where((across_ < 0) == (extreme is np.minimum), -terms, terms)
        bounds, known = [], np.ones(1, dtype=bool)
        for cosine, sine, fall in zip(self.cosine, self.sine, self.fall, strict=True):
            falls = cosine * down + sine * ahead
            fine = falls > terms
            known = known & fine
            bounds.append(across_ / np.where(fine, falls + beside, 1.0) * fall)
        worst = extreme(*bounds)
        rounded = ROUNDING_SHARE * self.condition * np.abs(worst)
        nothing = -np.inf if extreme is np.minimum else np.inf
        return np.where(known, worst - rounded if extreme is np.minimum else worst + rounded, nothing)

    def rises(self, tangent_v: Floats) -> Bits:
        """True where g_3 T > g_2 in all states: an offset grows along a border of the sensor, (rows, sets)."""
        turns = self.turns
        forward = turns.cos_b * tangent_v - turns.sin_a * turns.sin_b
        least = np.minimum(*(cosine * forward + sine * turns.cos_a for cosine, sine in zip(self.cosine, self.sine, strict=True)))
        # concave in c up to straight down, or else its ends are not enough: a hair's breadth is what the middle can lie lower
        return least - (1 + np.abs(tangent_v)) * (turns.off + self.bulge + ROUNDING_SHARE) > 0

    def rises_along(self, optics: Optics, stretch: Stretch | Patch) -> Bits:
        """True where an offset grows along a stretch of a border behind a lens in all states, (markings, rows, sets).

        A step to the right there is (J_yy, -J_xy) over the determinant of the lens's Jacobian in rays, and an offset grows along (ds, dt)
        while ds (g_3 T - g_2) + dt (g_1 - g_3 S) > 0.
        """
        turns, (s, t), reach = self.turns, stretch.middle, stretch.reach
        _, mixed, down, off = optics.derivatives(s, t, reach)
        forward, leaning = turns.cos_b * t - turns.sin_a * turns.sin_b, turns.cos_a * turns.sin_b - turns.cos_b * s
        grows, slack = [], (1 + np.abs(s) + np.abs(t)) * (turns.off + self.bulge + ROUNDING_SHARE) + reach
        for cosine, sine in zip(self.cosine, self.sine, strict=True):
            along, across = cosine * forward + sine * turns.cos_a, cosine * leaning + sine * turns.sin_a
            least = down * along - mixed * across - off * (np.abs(along) + np.abs(across))
            grows.append(least - (down + np.abs(mixed) + 2 * off) * slack > 0)
        return grows[0] & grows[1]

    @property
    def bulge(self) -> Floats:
        """How far cos(c) Y + sin(c) Z can leave the range of its values at both ends of c, as a share of the ray's length, (sets,)."""
        width = np.abs(self.sine[1] - self.sine[0]) + np.abs(self.cosine[1] - self.cosine[0])
        return width * width

    def sway(self, tangent_u: Floats, tangent_v: Floats, reach: Floats) -> Sway:
        """How offsets sway with a and b at points up to `reach` beside the given ones along the border; arrays (markings, rows, sets)."""
        turns = self.turns
        x, y, z, aside = self.rays(tangent_u, tangent_v)
        length = 1 + np.abs(tangent_u) + np.abs(tangent_v) + reach
        off = (turns.off + ROUNDING_SHARE) * length + reach
        cosine, sine = (self.cosine[0] + self.cosine[1]) / 2, (self.sine[0] + self.sine[1]) / 2
        off_cosine, off_sine = (
            np.abs(self.cosine[1] - self.cosine[0]) / 2 + self.bulge,
            np.abs(self.sine[1] - self.sine[0]) / 2 + self.bulge,
        )
        falls = cosine * y + sine * z
        off_falls = off_cosine * np.abs(y) + off_sine * np.abs(z) + off
        known = falls > 2 * off_falls
        falls, off_falls = np.where(known, falls, 1.0), np.where(known, off_falls, 0.0)
        per = 1 / falls
        off_per = off_falls * per / (falls - off_falls)
        ratio, off_ratio = x * per, np.abs(x) * off_per + off * (per + off_per)
        size = np.abs(ratio) + off_ratio
        steep = np.abs(sine) + off_sine
        by_b = -(z * per + sine * ratio * ratio)
        off_by_b = np.abs(z) * off_per + off * (per + off_per) + steep * off_ratio * (np.abs(ratio) + size) + off_sine * size * size
        leaning = sine * turns.sin_b
        off_leaning = steep * turns.off_b + off_sine
        inner = cosine * aside - leaning * y
        off_inner = (cosine + off_cosine + np.abs(leaning) + off_leaning) * off + off_cosine * np.abs(aside) + off_leaning * np.abs(y)
        whole = turns.cos_b * y + ratio * inner
        off_whole = off * (1 + turns.off_b) + turns.off_b * np.abs(y) + size * off_inner + off_ratio * np.abs(inner)
        by_a = whole * per
        off_by_a = np.abs(whole) * off_per + off_whole * (per + off_per)
        return Sway(by_a, off_by_a, by_b, off_by_b, known)

    def total(self, by_a: Floats, by_b: Floats) -> Floats:
        """off_a by_a + off_b by_b times the largest s, as both are over F s."""
        return (self.turns.off_a * by_a + self.turns.off_b * by_b) * self._largest_fall

    def ideal_tangents(self, left: Floats, right: Floats, tangent_v: Floats) -> tuple[Interval, Bits]:
        """Range of Y/Z over the points between two on a border of the sensor; True where they lie in front, and below the horizon."""
        turns, lows, highs, fine = self.turns, [], [], np.ones(left.shape, dtype=bool)
        for tangent_u in (left, right):
            x, y, z, aside = self.rays(tangent_u, tangent_v)
            off = (turns.off + ROUNDING_SHARE) * (1 + np.abs(tangent_u) + np.abs(tangent_v))
            falls = np.minimum(*(cosine * y + sine * z for cosine, sine in zip(self.cosine, self.sine, strict=True)))
            ahead = z - off
            fine &= (ahead > LEAST_DEPTH) & (falls > off + self.bulge * (1 + np.abs(tangent_u) + np.abs(tangent_v)))
            ahead = np.where(ahead > LEAST_DEPTH, ahead, 1.0)
            steep = (np.abs(y) + off) / ahead
            by_a = (np.abs(aside) + off) / ahead + steep * (np.abs(turns.sin_b) + turns.off_b) * (np.abs(y) + off) / ahead
            by_b = steep * (np.abs(x) + off) / ahead
            sway = (turns.off_a * by_a + turns.off_b * by_b) * ROUNDED_SWAY + ROUNDING_SHARE * (1 + steep)
            tangent = y / np.where(ahead > LEAST_DEPTH, z, 1.0)
            lows.append(tangent - sway)
            highs.append(tangent + sway)
        return (np.minimum(*lows), np.maximum(*highs)), fine


@dataclass(frozen=True)
class Lines:
    """The lines of markings on the sensor, before its lens: n.p = 0 with n = k f - e, k = offset/(F s), (markings, 1, sets) all.

    So S = (k (f_2 T + f_3) - (e_2 T + e_3))/(e_1 - k f_1), which is affine in T.
    """

    view: View
    ratio: Interval
    """Range of k s."""
    bottom: Interval
    moves: tuple[Floats, Floats, Floats]
    """How far the components of n may be from those by the rotation in the middle."""
    known: Bits

    @staticmethod
    def of(camera: Camera, view: View, offset: Interval) -> Lines:
        """Of markings with offsets in these ranges, (markings, sets)."""
        turns = view.turns
        low, high = (side[:, None] / camera.focal_u_px for side in offset)
        shares = [
            (sine * (turns.cos_a * turns.sin_b) - cosine * turns.sin_a) / fall
            for cosine, sine, fall in zip(view.cosine, view.sine, view.fall, strict=True)
        ]
        moves, slants = _line_sways(view, low, high)
        steep = np.minimum(*shares), np.maximum(*shares)
        bottom = tuple(turns.cos_a * turns.cos_b - side for side in reversed(product((low, high), steep)))
        bottom = bottom[0] - moves[0], bottom[1] + moves[0]
        return Lines(view, (low, high), bottom, moves, (bottom[0] > LEAST_DEPTH) & slants)

    def at(self, tangent: Floats) -> tuple[Interval, Bits]:
        """Range of S at some T, (rows, sets) or (markings, rows, sets), without rounding; True where it is known."""
        view, turns = self.view, self.view.turns
        shares = [
            (cosine * (turns.cos_a * tangent) + sine * (turns.sin_a * turns.sin_b * tangent + turns.cos_b)) / fall
            for cosine, sine, fall in zip(view.cosine, view.sine, view.fall, strict=True)
        ]
        level = turns.sin_a * turns.cos_b * tangent - turns.sin_b
        top = tuple(side - level for side in product(self.ratio, (np.minimum(*shares), np.maximum(*shares))))
        moved = self.moves[1] * np.abs(tangent) + self.moves[2]
        return self._quotient((top[0] - moved, top[1] + moved))

    @cached_property
    def slopes(self) -> Interval:
        """Range of dS/dT."""
        view, turns = self.view, self.view.turns
        shares = [
            (cosine * turns.cos_a + sine * (turns.sin_a * turns.sin_b)) / fall
            for cosine, sine, fall in zip(view.cosine, view.sine, view.fall, strict=True)
        ]
        level = turns.sin_a * turns.cos_b
        top = tuple(side - level for side in product(self.ratio, (np.minimum(*shares), np.maximum(*shares))))
        low, high = self._quotient((top[0] - self.moves[1], top[1] + self.moves[1]))[0]
        return lowered(low, 1 + np.abs(low)), raised(high, 1 + np.abs(high))

    def _quotient(self, top: Interval) -> tuple[Interval, Bits]:
        sides = [one / np.where(self.known, other, 1.0) for one in top for other in self.bottom]
        return (np.minimum.reduce(sides), np.maximum.reduce(sides)), self.known


def _line_sways(view: View, low: Floats, high: Floats) -> tuple[tuple[Floats, Floats, Floats], Bits]:
    """How far the components of n = k f - e may be from those by the rotation in the middle, (markings, 1, sets); True where finite.

    Before its rotation n is (-1, k cos(c), k sin(c)): one about Y moves its first and third, one about Z then the first and second.
    """
    turns, largest = view.turns, np.maximum(np.abs(low), np.abs(high))
    per = 1 / view.fall.min(axis=0)
    fore, down = (
        largest * (np.abs(view.sine).max(axis=0) + view.bulge) * per,
        largest * (np.abs(view.cosine).max(axis=0) + view.bulge) * per,
    )
    first, third = np.abs(turns.cos_b) + np.abs(turns.sin_b) * fore, np.abs(turns.sin_b) + np.abs(turns.cos_b) * fore
    by_b = turns.off_b * (third + turns.off_b * first)
    off_third = turns.off_b * (first + turns.off_b * third)
    cos_a, sin_a = np.abs(turns.cos_a), np.abs(turns.sin_a)
    one, other = cos_a * first + sin_a * down, sin_a * first + cos_a * down
    off_first = by_b * cos_a + turns.off_a * (other + by_b + turns.off_a * (one + by_b))
    off_second = by_b * sin_a + turns.off_a * (one + by_b + turns.off_a * (other + by_b))
    return (off_first, off_second, off_third), np.isfinite(off_first)


def product(first: Interval, second: Interval) -> Interval:
    """Range of a product of intervals, without rounding."""
    sides = [one * other for one in first for other in second]
    return np.minimum.reduce(sides), np.maximum.reduce(sides)

"""Where the markings of sets of states cross the borders between the *sensor's* rows, whose frame is turned from the ideal one.

A sibling of `Borders` for a camera with roll and yaw. With S = (u - u0)/F and T = (v - v0)/F, a point of the sensor is the ray (S, T, 1);
R = R_z(a) R_y(b) takes rays of the ideal frame to it (`runtime.attitude`). In the sensor's axes e = R (1, 0, 0) points across the runway,
f = R (0, cos(c), sin(c)) down and g = R (0, -sin(c), cos(c)) along it; D = f.p is how far the ray p falls. A marking is all p with

    offset = (p_x - x) scale = F s(c, t_ref) X/D,     X = e.p           (`runtime.state_set`)

so a straight line on the sensor, along which T and the ideal row are monotone in the distance while they lie in front of the camera.

a and b are known up to `Turns.off_a`, `off_b` and, through c, up to a set's width. They move all markings nearly alike, as another x would.
So offsets here are those of the rotation in the middle, less what the true one moves the offset of one point p* of the set by; that is,
they are (p_x - x'') scale with

    x'' = x + E(p*)/scale,     E(p) = h(p; a, b) - h(p; a0, b0),     h(p) = F s X/D

and E(p) - E(p*), the integral of h_a(p) - h_a(p*) and h_b(p) - h_b(p*) over the way from (a0, b0) to (a, b), is bounded and added to each:

    h_b / (F s) = -(Z/D + sin(c) q^2)                                       q = X/D
    h_a / (F s) = (cos(b) Y + q (cos(c) S' - sin(c) sin(b) Y))/D             S' = cos(a) S + sin(a) T

A rotation by an angle moves a component of a ray by at most the angle times its length: so components at other a and b are bounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.attitude import Turns
from runtime.refine.borders import across, ends_in_rows
from runtime.refine.interval import Bits, Floats, Interval
from runtime.refine.lit_pixels import LitPixels
from runtime.rounding import ROUNDING_SHARE, above, below, column_margin_px, lowered, raised
from runtime.scene import Camera, Scene
from runtime.state_set import StateSet, scale_ratio, tangent_of_row

LEAST_DEPTH = 0.1
"""Of a ray of length about 1, or of a marking's line against a row: below it, where a marking is seen counts as not known at all."""
ROUNDED_TERMS = 16.0
"""Factor on the terms of a column's margin: what `LEAST_DEPTH` lets a rounding grow to, and more."""
ROUNDED_SWAY = 1 + 2.0**-30
"""Factor on bounds of how far an offset may sway, which are sums of products of sizes: far above their rounding."""


@dataclass(frozen=True)
class SensorBorders:
    """The borders of the sensor's rows that each set can show in the window; row i of pixels lies between borders i and i + 1."""

    row: Floats
    """v of each border on the sensor, (rows + 1, sets), px."""
    near: Interval
    far: Interval
    """Ranges of the sensor's rows of each marking's near and far end, (markings, sets), px; without bounds where it may not be in front."""
    ideal_near: Interval
    ideal_far: Interval
    """The same of the ideal frame's rows."""
    crossed: Bits
    """True where the marking crosses the border in all states of the set: (markings, rows + 1, sets)."""
    columns: Interval
    """First and last column of the sensor's pixels in whose closed columns the marking may meet the border, (markings, rows + 1, sets)."""
    margin_px: Floats
    """Covers what rounding does to a column, (sets,)."""
    view: View
    point: Sway
    """How the offset of p* sways, (1, 1, sets)."""

    @staticmethod
    def of(scene: Scene, sets: StateSet, pixels: LitPixels) -> SensorBorders:
        """The borders between the farthest and the nearest ends; one row on either side stands for all rows out of the window."""
        view, offset = View.of(scene.camera, sets), _offset_range(scene, sets)
        margin_px = _column_margins_px(scene, sets, offset, pixels)
        ideal_near, ideal_far = ends_in_rows(scene, sets)
        near, far = (_on_sensor(scene.camera, sets, view, offset, rows, margin_px) for rows in (ideal_near, ideal_far))
        first, last = (
            np.minimum(np.maximum(np.floor(row), pixels.top), pixels.bottom)
            for row in (np.minimum.reduce([*far[0], *near[0]], axis=0), np.maximum.reduce([*near[1], *far[1]], axis=0))
        )  # a marking that is seen flat may be rolled so far that its near end is the upper one
        row = first + np.arange(int(np.maximum.reduce(last - first)) + 2, dtype=np.float64)[:, None]
        crossed = row > far[1][:, None]
        crossed &= row < near[0][:, None]
        columns = _columns(scene.camera, view, offset, row, margin_px)
        point = view.sway(*_middle_point(scene.camera, sets, view, offset, ideal_near, ideal_far), np.zeros(1))
        return SensorBorders(row, near, far, ideal_near, ideal_far, crossed, columns, margin_px, view, point)

    def offsets(self, scene: Scene, first: Floats, last: Floats, rows: slice = slice(None)) -> Interval:
        """Bounds on (p_x - x'') scale of markings that cross the borders `rows` in the closed columns `first` to `last`; of that shape.

        They mean nothing where a border is not crossed. Along a border an offset grows with the column while g_3 T > g_2, and lies between
        those of the columns' ends; elsewhere, and where the ray may not fall, there is no bound.
        """
        camera, view = scene.camera, self.view
        tangent_v = tangent_of_row(camera, self.row[rows])
        seen = np.isfinite(first) & np.isfinite(last)
        left = np.where(seen, first - camera.u0, 0.0) / camera.focal_u_px
        right = np.where(seen, last + (1 - camera.u0), 0.0) / camera.focal_u_px
        margin = self.margin_px / camera.focal_u_px
        rises = view.rises(tangent_v)
        sway = view.sway((left + right) / 2, tangent_v[None], np.abs(right - left) / 2).beside(self.point, camera, view)
        low = view.quotient(left, tangent_v, -margin, np.minimum) * camera.focal_u_px - sway
        high = view.quotient(right, tangent_v, margin, np.maximum) * camera.focal_u_px + sway
        bound = seen & rises & np.isfinite(low) & np.isfinite(high)
        dark = first > last
        return np.where(dark, np.inf, np.where(bound, low, -np.inf)), np.where(dark, -np.inf, np.where(bound, high, np.inf))

    def seen_x(self, sets: StateSet) -> Interval:
        """Range of x'', to which offsets refer, (sets,), m."""
        shift = self._shift(sets)
        return sets.x[:, 0] - shift, sets.x[:, 1] + shift

    def true_x(self, sets: StateSet, low: Floats, high: Floats) -> Interval:
        """Bounds on the states' x, (sets,), by bounds on x''."""
        shift = self._shift(sets)
        return lowered(low - shift, np.abs(low)), raised(high + shift, np.abs(high))

    def _shift(self, sets: StateSet) -> Floats:
        """How far x'' may be from x, (sets,), m, with the rounding of the sum."""
        shift = self.point.alone(self.view)[0, 0] * (self.view.focal / sets.scale[:, 0]) * ROUNDED_SWAY
        return shift + ROUNDING_SHARE * np.abs(sets.x).max(axis=1)

    def ideal_rows(self, scene: Scene, _: StateSet, lowest: Floats, highest: Floats) -> Interval:
        """Rows of the ideal frame that near ends lie no lower, and far ends no higher in than in these of the sensor, (markings, sets).

        An end that lies no lower than a border lies no nearer than where its marking's line meets the border, as all states of the set
        show the near end below the far one. Where a marking may not meet the border in front of the camera and below the horizon, nothing
        is learned. Returns bounds on near ends from below and on far ends from above.
        """
        monotone = self.near[0] > self.far[1]
        low = self._ideal(scene.camera, lowest, monotone & (lowest < self.near[1]))[1]
        high = self._ideal(scene.camera, highest, monotone & (highest > self.far[0]))[0]
        return np.minimum(low, self.ideal_near[1]), np.maximum(high, self.ideal_far[0])

    def _ideal(self, camera: Camera, row: Floats, usable: Bits) -> Interval:
        """Range of the ideal rows of the points in which the markings' lines meet these borders, (markings, sets); none if not usable."""
        place = np.where(usable, row - self.row[0], 0).astype(np.int64)
        usable = usable & (place >= 0) & (place < len(self.row))
        place = np.where(usable, place, 0)
        first, last = (np.take_along_axis(side, place[:, None], axis=1)[:, 0] for side in self.columns)
        usable &= np.isfinite(first) & np.isfinite(last)
        left = np.where(usable, first - camera.u0, 0.0) / camera.focal_u_px
        right = np.where(usable, last + (1 - camera.u0), 0.0) / camera.focal_u_px
        tangent = tangent_of_row(camera, np.where(usable, row, 0.0))
        (low, high), in_front = self.view.ideal_tangents(left, right, tangent)
        usable &= in_front
        low, high = (np.where(usable, camera.v0 + camera.focal_v_px * side, 0.0) for side in (low, high))
        terms = abs(camera.v0) + np.abs(low) + np.abs(high)
        return np.where(usable, below(lowered(low, terms)), -np.inf), np.where(usable, above(raised(high, terms)), np.inf)

    def across_rows(self) -> Interval:
        """First and last column that each marking may light in each row, (markings, rows, sets): its line is straight."""
        low, high = self.columns
        return np.minimum(low[:, :-1], low[:, 1:]), np.maximum(high[:, :-1], high[:, 1:])


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

    @staticmethod
    def of(camera: Camera, sets: StateSet) -> View:
        """Of sets with roll and yaw."""
        cosine, sine = (part.T.copy() for part in sets.turn)
        fall = sets.reference_fall.T.copy()
        return View(sets.turns, cosine, sine, fall, sets.condition, np.full(len(sets), camera.focal_u_px))

    def rays(self, tangent_u: Floats, tangent_v: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """X, Y, Z of points of the sensor in the ideal frame, by the rotation in the middle; and S'."""
        turns = self.turns
        aside = turns.cos_a * tangent_u + turns.sin_a * tangent_v
        down = turns.cos_a * tangent_v - turns.sin_a * tangent_u
        return turns.cos_b * aside - turns.sin_b, down, turns.sin_b * aside + turns.cos_b, aside

    def quotient(self, tangent_u: Floats, tangent_v: Floats, margin: Floats, extreme: np.ufunc) -> Floats:
        """The smallest or largest (X + margin) s/D over the set's pitches; the worst infinity where D may not be above 0."""
        across_, down, ahead, _ = self.rays(tangent_u, tangent_v)
        across_ = across_ + margin
        bounds = []
        for cosine, sine, fall in zip(self.cosine, self.sine, self.fall, strict=True):
            falls = cosine * down + sine * ahead
            terms = ROUNDING_SHARE * (np.abs(down) + np.abs(ahead))
            for side in (falls - terms, falls + terms):
                bounds.append(np.where(falls > terms, across_ / np.where(falls > terms, side, 1.0), -np.inf) * fall)
        worst = np.minimum.reduce(bounds) if extreme is np.minimum else np.maximum.reduce(bounds)
        known = np.logical_and.reduce([np.isfinite(bound) for bound in bounds])
        rounded = ROUNDING_SHARE * self.condition * np.abs(np.where(known, worst, 0.0))
        nothing = -np.inf if extreme is np.minimum else np.inf
        return np.where(known, worst - rounded if extreme is np.minimum else worst + rounded, nothing)

    def rises(self, tangent_v: Floats) -> Bits:
        """True where g_3 T > g_2 in all states: an offset grows along a border of the sensor, (rows, sets)."""
        turns = self.turns
        forward = turns.cos_b * tangent_v - turns.sin_a * turns.sin_b
        least = np.minimum(*(cosine * forward + sine * turns.cos_a for cosine, sine in zip(self.cosine, self.sine, strict=True)))
        # concave in c up to straight down, or else its ends are not enough: a hair's breadth is what the middle can lie lower
        return least - (1 + np.abs(tangent_v)) * (turns.off + self.bulge + ROUNDING_SHARE) > 0

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
        largest = np.maximum(self.fall[0], self.fall[1]) + self.bulge * (1 + np.abs(self.condition * self.fall.min(axis=0)))
        return (self.turns.off_a * by_a + self.turns.off_b * by_b) * largest

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


def _offset_range(scene: Scene, sets: StateSet) -> Interval:
    """Range of (p_x - x) scale, (markings, sets), px."""
    low, high = across(scene, sets)
    slow, fast = sets.scale.T
    low, high = np.minimum(low * slow, low * fast), np.maximum(high * slow, high * fast)
    return lowered(low, np.abs(low)), raised(high, np.abs(high))


def _column_margins_px(scene: Scene, sets: StateSet, offset: Interval, pixels: LitPixels) -> Floats:
    """What a column of a marking, or of a point in the frame, may be off by for rounding alone, (sets,)."""
    camera = scene.camera
    largest = np.maximum.reduce(np.maximum(-offset[0], offset[1]), axis=0)
    sides = abs(camera.u0), abs(camera.width - camera.u0), abs(pixels.top - camera.v0), abs(pixels.bottom + 1 - camera.v0)
    steep = 1 + max(sides) / min(camera.focal_u_px, camera.focal_v_px)
    return column_margin_px(ROUNDED_TERMS * sets.condition * steep * (largest + max(sides) + camera.focal_u_px))


def _on_sensor(camera: Camera, sets: StateSet, view: View, offset: Interval, rows: Interval, margin_px: Floats) -> Interval:
    """Rows on the sensor, (markings, sets), px, of ends in these rows of the ideal frame; without bounds where one may not be in front.

    T = (sin(a) X + cos(a) Y)/Z is a quotient of sums in u and in v: its extremes are at corners. dT/da = S, dT/db = sin(a) + T X/Z.
    """
    turns = view.turns
    down = tuple(tangent_of_row(camera, side) for side in rows)
    slow, fast = scale_ratio(sets, down[0])[0], scale_ratio(sets, down[1])[1]
    slow, fast = lowered(slow, sets.condition * (1 + slow)), raised(fast, sets.condition * (1 + fast))
    slow = np.maximum(slow, 0)
    aside = (
        (np.minimum(offset[0] * slow, offset[0] * fast) - margin_px) / camera.focal_u_px,
        (np.maximum(offset[1] * slow, offset[1] * fast) + margin_px) / camera.focal_u_px,
    )
    length = 1 + np.maximum(np.abs(aside[0]), np.abs(aside[1])) + np.maximum(np.abs(down[0]), np.abs(down[1]))
    off = (turns.off + ROUNDING_SHARE) * length
    ahead = [turns.cos_b - turns.sin_b * side for side in aside]
    across_ = [turns.cos_b * side + turns.sin_b for side in aside]
    nearest = np.minimum(*ahead) - off
    seen = nearest > LEAST_DEPTH
    nearest, ahead = np.where(seen, nearest, 1.0), [np.where(seen, side, 1.0) for side in ahead]
    corners = [(turns.sin_a * x + turns.cos_a * y) / z for x, z in zip(across_, ahead, strict=True) for y in down]
    beside = [turns.cos_a * x - turns.sin_a * y for x in across_ for y in down]
    low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
    by_a = (np.maximum.reduce(np.abs(beside)) + off) / nearest
    falls = np.maximum(np.abs(low), np.abs(high)) * np.maximum(*ahead) / nearest + off / nearest
    by_b = np.abs(turns.sin_a) + turns.off_a + falls * (np.maximum(*np.abs(across_)) + off) / nearest
    sway = (turns.off_a * by_a + turns.off_b * by_b) * ROUNDED_SWAY + ROUNDING_SHARE * length / nearest
    low, high = camera.v0 + camera.focal_v_px * (low - sway), camera.v0 + camera.focal_v_px * (high + sway)
    terms = abs(camera.v0) + np.abs(low) + np.abs(high)
    return np.where(seen, below(lowered(low, terms)), -np.inf), np.where(seen, above(raised(high, terms)), np.inf)


def _columns(camera: Camera, view: View, offset: Interval, row: Floats, margin_px: Floats) -> Interval:
    """First and last column in which a marking's line may meet each border of the sensor, (markings, rows, sets).

    A marking is n.p = 0 with n = k f - e, k = offset/(F s): S = (k (f_2 T + f_3) - (e_2 T + e_3))/(e_1 - k f_1).
    """
    turns, tangent = view.turns, tangent_of_row(camera, row)
    low, high = (side[:, None] / camera.focal_u_px for side in offset)
    shares = [
        (
            (cosine * (turns.cos_a * tangent) + sine * (turns.sin_a * turns.sin_b * tangent + turns.cos_b)) / fall,
            (sine * (turns.cos_a * turns.sin_b) - cosine * turns.sin_a) / fall,
        )
        for cosine, sine, fall in zip(view.cosine, view.sine, view.fall, strict=True)
    ]
    along, steep = ((np.minimum(*sides), np.maximum(*sides)) for sides in zip(*shares, strict=True))
    level = turns.sin_a * turns.cos_b * tangent - turns.sin_b
    top = tuple(side - level for side in _product((low, high), along))
    bottom = tuple(turns.cos_a * turns.cos_b - side for side in reversed(_product((low, high), steep)))
    moves, slants = _line_sways(view, low, high)
    moved = moves[1] * np.abs(tangent) + moves[2]
    top, bottom = (top[0] - moved, top[1] + moved), (bottom[0] - moves[0], bottom[1] + moves[0])
    known = (bottom[0] > LEAST_DEPTH) & slants
    sides = [one / np.where(known, other, 1.0) for one in top for other in bottom]
    low, high = np.minimum.reduce(sides), np.maximum.reduce(sides)
    low, high = camera.u0 + camera.focal_u_px * low - margin_px, camera.u0 + camera.focal_u_px * high + margin_px
    low, high = lowered(low, np.abs(low)), raised(high, np.abs(high))
    return np.where(known, np.floor(low), -np.inf), np.where(known, np.floor(high), np.inf)


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


def _middle_point(camera: Camera, sets: StateSet, view: View, offset: Interval, near: Interval, far: Interval) -> tuple[Floats, Floats]:
    """p* of each set, (1, 1, sets) each: about where the sensor shows the middle of the runway. Any point would do."""
    row = (np.mean(near, axis=0) + np.mean(far, axis=0)).mean(axis=0) / 2
    down = np.clip(tangent_of_row(camera, row), -2.0, 2.0)
    ratio = scale_ratio(sets, down)
    aside = np.clip(np.mean(offset, axis=(0, 1)) * (ratio[0] + ratio[1]) / 2 / camera.focal_u_px, -2.0, 2.0)
    turns = view.turns
    x, z = turns.cos_b * aside + turns.sin_b, np.maximum(turns.cos_b - turns.sin_b * aside, LEAST_DEPTH)
    return ((turns.cos_a * x - turns.sin_a * down) / z)[None, None], ((turns.sin_a * x + turns.cos_a * down) / z)[None, None]


def _product(first: Interval, second: Interval) -> Interval:
    """Range of a product of intervals, without rounding."""
    sides = [one * other for one in first for other in second]
    return np.minimum.reduce(sides), np.maximum.reduce(sides)

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.refine.borders import across, ends_in_rows
from runtime.refine.curves import Curves, Met, shown_rows
from runtime.refine.interval import Bits, Floats, Interval
from runtime.refine.lit_pixels import LitPixels
from runtime.refine.optics import Optics, Stretch
from runtime.refine.unknowns import Moves, Unknowns
from runtime.refine.view import LEAST_DEPTH, ROUNDED_SWAY, Lines, Sway, View
from runtime.rounding import ROUNDING_SHARE, above, below, column_margin_px, lowered, raised
from runtime.scene import Camera, Scene
from runtime.state_set import StateSet, scale_ratio, tangent_of_row

SHARE_OF_DISC = 0.9
"""Of the radius of a lens's disc: beyond it markings are cut off."""
ROWS_BEYOND = 2.0
"""Rows beyond their ends within which the lines of markings are followed: so rows in which one may end are seen as a whole."""
ROUNDED_TERMS = 16.0
"""Factor on the terms of a column's margin: what `LEAST_DEPTH` lets a rounding grow to, and more."""


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

    met: Met | None = None
    """Behind a lens, or of a camera that may be off: where in rays the markings may meet the borders."""
    unknowns: Unknowns | None = None
    """There: what may be off, where something may."""

    @staticmethod
    def of(scene: Scene, sets: StateSet, pixels: LitPixels, optics: Optics | None = None) -> SensorBorders:
        """The borders between the farthest and the nearest ends; one row on either side stands for all rows out of the window.

        `scene` has the sensor's camera, whose lens is in `optics`.
        """
        view, offset = View.of(scene.camera, sets, optics), _offset_range(scene, sets)
        margin_px = _column_margins_px(scene, sets, offset, pixels)
        ideal_near, ideal_far = ends_in_rows(scene, sets)
        lines, curves, unknowns = Lines.of(scene.camera, view, offset), None, None
        if optics is None:
            near, far = (_rays_of_ends(scene.camera, sets, view, offset, rows, margin_px).rows for rows in (ideal_near, ideal_far))
        else:
            near, far, curves, points = _ends_behind_lens(scene, sets, view, offset, (ideal_near, ideal_far), margin_px, lines)
            unknowns = None if optics.known(sets) else Unknowns.of(view, optics, points)
        first, last = (
            np.minimum(np.maximum(np.floor(row), pixels.top), pixels.bottom)
            for row in (np.minimum.reduce([*far[0], *near[0]], axis=0), np.maximum.reduce([*near[1], *far[1]], axis=0))
        )  # a marking that is seen flat may be rolled so far that its near end is the upper one
        row = first + np.arange(int(np.maximum.reduce(last - first)) + 2, dtype=np.float64)[:, None]
        crossed = row > far[1][:, None]
        crossed &= row < near[0][:, None]
        tangent = tangent_of_row(scene.camera, row)
        met = None if curves is None else curves.met(tangent)
        if met is None or optics is None:
            columns = _as_columns(scene.camera, *lines.at(tangent), margin_px)
        else:
            beside_px = optics.beside_px(np.maximum(np.abs(met.shown[0]), np.abs(met.shown[1])), scene.camera.focal_u_px)
            columns = _as_columns(scene.camera, met.shown, met.known, margin_px + beside_px + optics.calibration.principal_px)
        point = view.sway(*_middle_point(scene.camera, sets, view, offset, ideal_near, ideal_far), np.zeros(1))
        return SensorBorders(row, near, far, ideal_near, ideal_far, crossed, columns, margin_px, view, point, met, unknowns)

    def offsets(self, scene: Scene, first: Floats, last: Floats, rows: slice = slice(None)) -> Interval:
        """Bounds on (p_x - x'') scale of markings that cross the borders `rows` in the closed columns `first` to `last`; of that shape.

        They mean nothing where a border is not crossed. Along a border an offset grows with the column while g_3 T > g_2, and lies between
        those of the columns' ends; elsewhere, and where the ray may not fall, there is no bound.
        """
        camera, view = scene.camera, self.view
        if view.optics is not None:
            return self._offsets_behind_lens(view.optics, first, last, self.row[rows])
        tangent_v = tangent_of_row(camera, self.row[rows])
        seen = np.isfinite(first) & np.isfinite(last)
        left = np.where(seen, first - camera.u0, 0.0) / camera.focal_u_px
        right = np.where(seen, last + (1 - camera.u0), 0.0) / camera.focal_u_px
        margin = self.margin_px / camera.focal_u_px
        rises = view.rises(tangent_v)
        sway = self.beside_point(camera, (left + right) / 2, tangent_v[None], np.abs(right - left) / 2)
        low = view.quotient(left, tangent_v, -margin, np.minimum) * camera.focal_u_px - sway
        high = view.quotient(right, tangent_v, margin, np.maximum) * camera.focal_u_px + sway
        return _bounds_where(seen & rises, _no_column(first, last), low, high)

    def _offsets_behind_lens(self, optics: Optics, first: Floats, last: Floats, row: Floats) -> Interval:
        """`offsets` by the rays of the corners of pixels, of a camera of which nothing is unknown but its attitude."""
        stretch = optics.between(first, last + 1, row)
        sway = self.beside_point(optics.camera, *stretch.middle, stretch.reach)
        low, high = self._quotients(optics, stretch)
        low, high = low - sway, high + sway
        return _bounds_where(stretch.known & self.view.rises_along(optics, stretch), _no_column(first, last), low, high)

    def sheared_offsets(self, first: Floats, last: Floats, rows: slice = slice(None)) -> tuple[Floats, Floats, Floats]:
        """Bounds on (p_x - x'') scale'' - kappa w of such markings, and w, where something is unknown of the camera (`unknowns`)."""
        view, unknowns, row = self.view, self.unknowns, self.row[rows]
        optics = view.optics
        assert optics is not None
        assert unknowns is not None
        stretch = optics.between(first, last + 1, row)
        w, rest, known = unknowns.sheared_at(view, Moves.at(view, optics, *stretch.middle, stretch.reach))
        low, high = self._quotients(optics, stretch)
        known &= stretch.known & view.rises_along(optics, stretch)
        return *_bounds_where(known, _no_column(first, last), low - rest, high + rest), w

    def _quotients(self, optics: Optics, stretch: Stretch) -> Interval:
        """The smallest and the largest F s X/D at the ends of stretches."""
        focal = optics.camera.focal_u_px
        margin = self.margin_px / focal + stretch.off
        low = self.view.quotient(*stretch.left, -margin, np.minimum, stretch.off) * focal
        return low, self.view.quotient(*stretch.right, margin, np.maximum, stretch.off) * focal

    def beside_point(self, camera: Camera, tangent_u: Floats, tangent_v: Floats, reach: Floats) -> Floats:
        """Largest |E(p) - E(p*)|, px, of points up to `reach` beside these; infinite where it is not known."""
        if not self.view.turns.off.any():
            return np.zeros(1)
        return self.view.sway(tangent_u, tangent_v, reach).beside(self.point, camera, self.view)

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

        def at(side: NDArray[Any]) -> NDArray[Any]:
            return np.take_along_axis(side, place[:, None], axis=1)[:, 0]

        if self.met is None:
            first, last = (at(side) for side in self.columns)
            usable &= np.isfinite(first) & np.isfinite(last)
            left = np.where(usable, first - camera.u0, 0.0) / camera.focal_u_px
            right = np.where(usable, last + (1 - camera.u0), 0.0) / camera.focal_u_px
            tangents: tuple[Floats, ...] = (tangent_of_row(camera, np.where(usable, row, 0.0)),)
        else:
            usable &= at(self.met.known) & np.isfinite(self.near[1]) & np.isfinite(self.far[0])
            margin = self.margin_px / camera.focal_u_px
            left, right = at(self.met.s[0]) - margin, at(self.met.s[1]) + margin
            tangents = at(self.met.t[0]) - margin, at(self.met.t[1]) + margin
        ranges = [self.view.ideal_tangents(left, right, tangent) for tangent in tangents]  # a quotient of sums: extremes are at corners
        usable &= np.logical_and.reduce([in_front for _, in_front in ranges])
        low, high = np.minimum.reduce([side[0] for side, _ in ranges]), np.maximum.reduce([side[1] for side, _ in ranges])
        low, high = (np.where(usable, camera.v0 + camera.focal_v_px * side, 0.0) for side in (low, high))
        terms = abs(camera.v0) + np.abs(low) + np.abs(high)
        return np.where(usable, below(lowered(low, terms)), -np.inf), np.where(usable, above(raised(high, terms)), np.inf)

    def across_rows(self) -> Interval:
        """First and last column that each marking may light in each row, (markings, rows, sets): its line is straight."""
        low, high = self.columns
        return np.minimum(low[:, :-1], low[:, 1:]), np.maximum(high[:, :-1], high[:, 1:])


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


@dataclass(frozen=True)
class EndRays:
    """Ranges of the rays of ends on the sensor, (markings, sets); without bounds where one may not be in front."""

    s: Interval
    t: Interval
    rows: Interval
    """Those of a pinhole's frame, px."""


def _rays_of_ends(camera: Camera, sets: StateSet, view: View, offset: Interval, rows: Interval, margin_px: Floats) -> EndRays:
    """Where the sensor sees ends in these rows of the ideal frame.

    T = (sin(a) X + cos(a) Y)/Z and S = (cos(a) X - sin(a) Y)/Z are quotients of sums in u and in v: their extremes are at corners.
    dT/da = S, dT/db = sin(a) + T X/Z; dS/da = -T, dS/db = cos(a) + S X/Z.
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
    far_aside, leaning = (np.maximum.reduce(np.abs(beside)) + off) / nearest, (np.maximum(*np.abs(across_)) + off) / nearest

    def swayed(corners: list[Floats], by_a: Floats, turned: Floats) -> Interval:
        low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
        size = np.maximum(np.abs(low), np.abs(high)) * np.maximum(*ahead) / nearest + off / nearest
        by_b = np.abs(turned) + turns.off_a + size * leaning
        sway = (turns.off_a * by_a + turns.off_b * by_b) * ROUNDED_SWAY + ROUNDING_SHARE * length / nearest
        return low - sway, high + sway

    t = swayed(corners, far_aside, turns.sin_a)
    low, high = (camera.v0 + camera.focal_v_px * side for side in t)
    terms = abs(camera.v0) + np.abs(low) + np.abs(high)
    rows = np.where(seen, below(lowered(low, terms)), -np.inf), np.where(seen, above(raised(high, terms)), np.inf)
    if view.optics is None:
        return EndRays(t, t, rows)
    far_down = (np.maximum.reduce(np.abs([turns.sin_a * x + turns.cos_a * y for x in across_ for y in down])) + off) / nearest
    s = swayed([(turns.cos_a * x - turns.sin_a * y) / z for x, z in zip(across_, ahead, strict=True) for y in down], far_down, turns.cos_a)
    s, t = ((np.where(seen, side[0], -np.inf), np.where(seen, side[1], np.inf)) for side in (s, t))
    return EndRays(s, t, rows)


def _ends_behind_lens(
    scene: Scene, sets: StateSet, view: View, offset: Interval, ends: tuple[Interval, Interval], margin_px: Floats, lines: Lines
) -> tuple[Interval, Interval, Curves, tuple[Floats, Floats]]:
    """Ranges of the sensor's rows of near and far ends, the curves between them, and about the rays of four ends, (4, sets) each.

    There are no bounds where the curves may not be met once only.

    What lies beyond the lens's disc is cut off. An end that may lie there has no bound beyond, and as its other bound that of a point of
    the marking which lies within.
    """
    optics, camera = view.optics, scene.camera
    assert optics is not None
    (near_low, near_high), (far_low, far_high) = ends
    top, bottom = _rows_within_disc(camera, sets, optics, offset)
    rows = np.stack([np.minimum(near_low, bottom), near_high, far_low, np.maximum(far_high, top)])
    inside = (rows >= top) & (rows <= bottom)
    rows = np.where(np.isfinite(rows), np.clip(rows, top, bottom), np.nan)
    rays = _rays_of_ends(camera, sets, view, offset, (rows, rows), margin_px)
    (low, high), known = shown_rows(optics, view.turns, rays.s, rays.t)
    beyond = ROWS_BEYOND / camera.focal_v_px
    curves = Curves.of(optics, lines, rays.t[0][2] - beyond, rays.t[1][1] + beyond, margin_px / camera.focal_u_px)
    beside_px = optics.beside_px(np.maximum(np.abs(low), np.abs(high)), camera.focal_v_px)
    low, high = camera.v0 + camera.focal_v_px * low - beside_px, camera.v0 + camera.focal_v_px * high + beside_px
    terms = abs(camera.v0) + np.abs(low) + np.abs(high)
    low, high = below(lowered(low, terms)), above(raised(high, terms))
    known &= curves.monotone
    outer, usable = (scene.runway.x_m.argmin(), scene.runway.x_m.argmax()), np.isfinite(rays.s[0]) & np.isfinite(rays.t[0])
    rays_at = [(np.where(usable, low, 0.0) + np.where(usable, high, 0.0)) / 2 for low, high in (rays.s, rays.t)]
    s, t = (np.stack([side[place, marking] for marking in outer for place in (3, 0)]) for side in rays_at)
    return (
        (np.where(known[0], low[0], -np.inf), np.where(known[1] & inside[1], high[1], np.inf)),
        (np.where(known[2] & inside[2], low[2], -np.inf), np.where(known[3], high[3], np.inf)),
        curves,
        (s, t),
    )


def _rows_within_disc(camera: Camera, sets: StateSet, optics: Optics, offset: Interval) -> Interval:
    """Ideal rows between which the markings lie within the lens's disc, about; NaN where they do nowhere: (markings, sets) each, px."""
    (slope, start), (other_slope, other_start) = sets.ratio_lines
    side = np.mean(offset, axis=0) / camera.focal_u_px / 2
    a, b = side * (slope + other_slope), side * (start + other_start)
    within = (1 + a * a) * (SHARE_OF_DISC * optics.lens.radius) ** 2 - b * b
    root = np.sqrt(np.where(within > 0, within, np.nan))
    return tuple(camera.v0 + camera.focal_v_px * ((sign * root - a * b) / (1 + a * a)) for sign in (-1, 1))  # pyright: ignore[reportReturnType]


def _as_columns(camera: Camera, shown: Interval, known: Bits, margin_px: Floats) -> Interval:
    """Columns of pixels that hold what is shown between two tangents; without bounds where these are not known."""
    low, high = shown
    low, high = camera.u0 + camera.focal_u_px * low - margin_px, camera.u0 + camera.focal_u_px * high + margin_px
    low, high = lowered(low, np.abs(low)), raised(high, np.abs(high))
    return np.where(known, np.floor(low), -np.inf), np.where(known, np.floor(high), np.inf)


def _middle_point(camera: Camera, sets: StateSet, view: View, offset: Interval, near: Interval, far: Interval) -> tuple[Floats, Floats]:
    """p* of each set, (1, 1, sets) each: about where the sensor shows the middle of the runway. Any point would do."""
    row = (np.mean(near, axis=0) + np.mean(far, axis=0)).mean(axis=0) / 2
    down = np.clip(tangent_of_row(camera, row), -2.0, 2.0)
    ratio = scale_ratio(sets, down)
    aside = np.clip(np.mean(offset, axis=(0, 1)) * (ratio[0] + ratio[1]) / 2 / camera.focal_u_px, -2.0, 2.0)
    turns = view.turns
    x, z = turns.cos_b * aside + turns.sin_b, np.maximum(turns.cos_b - turns.sin_b * aside, LEAST_DEPTH)
    return ((turns.cos_a * x - turns.sin_a * down) / z)[None, None], ((turns.sin_a * x + turns.cos_a * down) / z)[None, None]


def _no_column(first: Floats, last: Floats) -> Bits:
    """True where the closed columns from `first` to `last` have no point in common.

    Where `first` is the one behind `last` they have one: a marking through the corner of four pixels may light two of them, diagonally.
    """
    return first > last + 1


def _bounds_where(bound: Bits, dark: Bits, low: Floats, high: Floats) -> Interval:
    """The bounds where there are some; inverted where nothing is lit."""
    bound = bound & np.isfinite(low) & np.isfinite(high)
    return np.where(dark, np.inf, np.where(bound, low, -np.inf)), np.where(dark, -np.inf, np.where(bound, high, np.inf))

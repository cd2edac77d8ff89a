"""The image of a segment behind a lens, where it is a curve: every pixel that it meets, enclosed in balls of float64 (`float_balls`).

OpenCV's models of a lens take a ray (x, y) to f(r)/r (x, y), r^2 = x^2 + y^2, and tangential terms of size |p|:

    radial-tangential   f(r) = r + k1 r^3 + k2 r^5 + k3 r^7,      plus (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y)
    fisheye             f(r) = a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9,      a = atan(r)

Along a straight line of rays the image's second derivative is at most 2 sup|f''| + 6 |p| per square of a ray's unit: its radial part is
f'' c^2 + (f/r)' s^2 and its other one 2 (f/r)' c s for some cosine and sine, and |(f/r)'| <= sup|f''|/2. So of a step h of rays the curve
stays within an eighth of that times h^2 of the chord between the step's ends.

Only the rays of a disc are followed that hold all that the frame shows: beyond it the lens either shows what lies out of the frame, or
folds, which no frame shows. Nothing here is shared with the packages that build and run a model.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from float_balls import FloatBalls
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bits = NDArray[np.bool_]
Pixels = NDArray[np.int64]
Sides = tuple[Floats, Floats, Floats, Floats]
"""Least column, largest, least row, largest of points, px."""

OUTWARD_PX = 2.0**-20
"""How far beside a pixel a curve may lie that counts as meeting it."""
BOW_PX = 2.0**-8
"""Steps are so short at first that a curve leaves its chord by no more."""
LONGEST_PX = 0.5
"""And no longer than this."""
MOST_STEPS, MOST_HALVINGS = 2**18, 24
FARTHEST, RADII = 8.0, 4096
"""Tangent of the largest angle off the axis that is followed, 83 degrees, and in how many steps of it the disc is looked for."""
A_LITTLE = 1e-6
"""By which share of itself a disc and what is cut out by it are widened."""


@dataclass(frozen=True)
class BallLens:
    """One of OpenCV's models of a lens."""

    fisheye: bool
    coefficients: tuple[float, ...]

    @staticmethod
    def of(table: dict[str, Any]) -> BallLens:
        """The lens of a scene's table `camera.distortion`."""
        return BallLens(table["model"] == "fisheye", tuple(map(float, table["coefficients"])))

    @property
    def radial(self) -> tuple[float, ...]:
        """Those of f."""
        return self.coefficients if self.fisheye else (*self.coefficients[:2], *self.coefficients[4:])

    @property
    def tangential(self) -> float:
        """|p|, and a little."""
        return 0.0 if self.fisheye else math.hypot(*self.coefficients[2:4]) * (1 + A_LITTLE)

    def shown(self, x: FloatBalls, y: FloatBalls) -> tuple[FloatBalls, FloatBalls]:
        """Where rays are shown, in focal lengths."""
        square = x * x + y * y
        k = [FloatBalls.of(value) for value in self.coefficients]
        one, two = FloatBalls.of(1), FloatBalls.of(2)
        if self.fisheye:
            r = square.sqrt()
            angle = r.atan()
            power = angle * angle
            series = one + power * (k[0] + power * (k[1] + power * (k[2] + power * k[3])))
            scale = series * _share(angle, r)
            return x * scale, y * scale
        k1, k2, p1, p2, k3 = [*k, FloatBalls.of(0)][:5]
        scale = one + square * (k1 + square * (k2 + square * k3))
        right = two * p1 * x * y + p2 * (square + two * x * x)
        down = p1 * (square + two * y * y) + two * p2 * x * y
        return x * scale + right, y * scale + down

    def _polynomial(self, powers: Floats, order: int, absolute: bool = False) -> Floats:
        """A derivative of f as a polynomial, of a for the fisheye, or a bound on its size up to there."""
        total = np.zeros_like(powers) + (powers if order == 0 else float(order == 1))
        for place, k in enumerate(self.radial):
            power = 2 * place + 3
            total = total + (abs(k) if absolute else k) * math.perm(power, order) * powers ** (power - order)
        return total

    def _argument(self, r: Floats) -> Floats:
        return np.arctan(r) if self.fisheye else r

    def disc(self, farthest: float) -> float:
        """A radius of rays beyond which the lens folds, or shows what is farther off the axis than `farthest`, and so do all beyond.

        While the lens does not fold, what is shown at a radius lies within 3 |p| r^2 of f(r), and moves outward with it.
        """
        r = FARTHEST * np.arange(1, RADII + 1) / RADII
        argument = self._argument(r)
        slope = self._polynomial(argument, 1) / ((1 + r**2) if self.fisheye else 1.0) - 6 * self.tangential * r
        out = self._polynomial(argument, 0) - 3 * self.tangential * r**2 > farthest * (1 + A_LITTLE)
        ends = out | (slope < -A_LITTLE)
        return float(r[int(np.argmax(ends))]) if ends.any() else FARTHEST

    def folds(self, x: Floats, y: Floats) -> Bits:
        """True if the lens may fold at a ray, where no frame shows it: its radial derivative is not certainly above 0."""
        return self._polynomial(self._argument(np.hypot(x, y)), 1) < 2.0**-30

    def stretch(self, radius: float) -> float:
        """By how much the lens lengthens a step of rays at most."""
        largest = self._argument(np.array(radius))
        radial = float(self._polynomial(largest, 1, absolute=True))
        return radial + 6 * self.tangential * radius

    def bend(self, radius: float) -> float:
        """The largest second derivative of the image along a line of rays. For the fisheye, f'' = (P'' - 2 r P') cos^4(a)."""
        largest = self._argument(np.array(radius))
        second = float(self._polynomial(largest, 2, absolute=True))
        if self.fisheye:
            second += 0.65 * float(self._polynomial(largest, 1, absolute=True))  # r cos^4(a) = sin(a) cos^3(a) is below 0.325
        return 2 * second + 6 * self.tangential


def _share(angle: FloatBalls, r: FloatBalls) -> FloatBalls:
    """a/r, which falls from 1 at 0; between 1 - r^2 and 1."""
    least = 1 - r.high**2
    near = r.middle < 2.0**-20
    divisor = FloatBalls(np.where(near, 1.0, r.middle), r.radius)
    quotient = angle / divisor
    return FloatBalls(np.where(near, (1 + least) / 2, quotient.middle), np.where(near, (1 - least) / 2 + 2.0**-50, quotient.radius))


@dataclass(frozen=True)
class CurvedCamera:
    """What shows rays in a frame: a lens, focal lengths and principal point, in px."""

    lens: BallLens
    width: int
    height: int
    focal: tuple[Fraction, Fraction]
    centre: tuple[Fraction, Fraction]

    @functools.cached_property
    def disc(self) -> float:
        """The radius of the rays that the frame may show."""
        sides = zip((self.width, self.height), self.centre, self.focal, strict=True)
        reach = [float(max(abs(centre), abs(size - centre)) / focal) for size, centre, focal in sides]
        return self.lens.disc(math.hypot(*reach)) * (1 + A_LITTLE)

    def met(self, start: tuple[Fraction, Fraction], stop: tuple[Fraction, Fraction]) -> tuple[Pixels, Pixels]:
        """Rows and columns of the pixels that the image of a segment of rays meets: outward by `OUTWARD_PX`, some several times."""
        if math.hypot(*map(float, stop)) < math.hypot(*map(float, start)):
            start, stop = stop, start  # from the nearer end, whose points are then as exact as they are near
        share = _within_disc(tuple(map(float, (*start, *stop))), self.disc)
        if share is None:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        curve = _Curve(self, tuple(map(FloatBalls.of, start)), tuple(map(FloatBalls.of, (stop[0] - start[0], stop[1] - start[1]))))
        return curve.followed(*share)


def _within_disc(ends: tuple[float, ...], radius: float) -> tuple[float, float] | None:
    """The least and the largest share of a segment at which it lies within a disc about 0, and a little more; None if it does nowhere."""
    x, y, far_x, far_y = ends
    way_x, way_y = far_x - x, far_y - y
    length = math.hypot(way_x, way_y)
    if length == 0:
        return (0.0, 1.0) if math.hypot(x, y) <= radius else None
    ahead_x, ahead_y = way_x / length, way_y / length
    foot, aside = -(x * ahead_x + y * ahead_y), x * ahead_y - y * ahead_x
    slack = A_LITTLE * radius + 2.0**-40 * (abs(x) + abs(y))
    if abs(aside) > radius + slack:
        return None
    half = math.sqrt(max((radius + slack) ** 2 - aside**2, 0.0)) + slack
    low, high = max((foot - half) / length, 0.0), min((foot + half) / length, 1.0)
    return (low, high) if low < high else None


@dataclass(frozen=True)
class _Curve:
    """The rays start + share way, as a camera shows them."""

    camera: CurvedCamera
    start: tuple[FloatBalls, ...]
    way: tuple[FloatBalls, ...]

    def at(self, share: Floats) -> Sides:
        """Where points are shown, a little outward; NaN where the lens may fold."""
        part = FloatBalls(share, np.zeros_like(share))
        x, y = (first + part * way for first, way in zip(self.start, self.way, strict=True))
        shown = self.camera.lens.shown(x, y)
        column, row = (
            FloatBalls.of(centre) + FloatBalls.of(focal) * side
            for side, focal, centre in zip(shown, self.camera.focal, self.camera.centre, strict=True)
        )
        gone = np.where(self.camera.lens.folds(x.middle, y.middle), np.nan, 0.0)
        more = OUTWARD_PX / 2 + gone
        return column.low - more, column.high + more, row.low - more, row.high + more

    def followed(self, low: float, high: float) -> tuple[Pixels, Pixels]:
        """Rows and columns of the pixels that the curve meets between two shares of it."""
        camera, length = self.camera, math.hypot(float(self.way[0].middle), float(self.way[1].middle)) * (high - low)
        focal, radius = float(max(camera.focal)), camera.disc
        bend = focal * camera.lens.bend(radius) * (1 + A_LITTLE)
        by_bow, by_length = length * math.sqrt(bend / 8 / BOW_PX), length * focal * camera.lens.stretch(radius) / LONGEST_PX
        steps = min(2 ** math.ceil(math.log2(max(by_bow, by_length, 1.0))), MOST_STEPS)
        shares = low + (high - low) * np.arange(steps + 1) / steps
        shares[-1] = high
        sides = self.at(shares)
        pieces = _Pieces(shares[:-1], shares[1:], tuple(side[:-1] for side in sides), tuple(side[1:] for side in sides))
        rows, columns = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
        bow = max(bend / 8 * (length / steps) ** 2, OUTWARD_PX / 2)
        for depth in range(MOST_HALVINGS + 1):
            pieces, box, decided = pieces.boxed(bow, camera)
            decided |= depth == MOST_HALVINGS
            for down, right in _filled(tuple(side[decided] for side in box), camera):
                rows.append(down)
                columns.append(right)
            pieces = pieces.of(~decided)
            if len(pieces.start) == 0:
                break
            pieces = pieces.halved(self)
            bow = max(bow / 4, OUTWARD_PX / 2)
        return np.concatenate(rows), np.concatenate(columns)


@dataclass(frozen=True)
class _Pieces:
    """Steps of a curve, (n,) each: shares and sides of both ends."""

    start: Floats
    stop: Floats
    first: tuple[Floats, ...]
    last: tuple[Floats, ...]

    def of(self, kept: Bits) -> _Pieces:
        """Some of them."""
        first, last = (tuple(side[kept] for side in sides) for sides in (self.first, self.last))
        return _Pieces(self.start[kept], self.stop[kept], first, last)

    def halved(self, curve: _Curve) -> _Pieces:
        """Each in two."""
        middle = (self.start + self.stop) / 2
        between = curve.at(middle)
        first, last = ((*zip(one, other, strict=True),) for one, other in ((self.first, between), (between, self.last)))
        joined = [tuple(np.concatenate(pair) for pair in pairs) for pairs in (first, last)]
        return _Pieces(np.concatenate([self.start, middle]), np.concatenate([middle, self.stop]), joined[0], joined[1])

    def boxed(self, bow: float, camera: CurvedCamera) -> tuple[_Pieces, tuple[Pixels, ...], Bits]:
        """Those that the frame may show, the pixels (left, right, top, bottom) of the box of each, and True where all of these are met.

        A step within one pixel meets it; one within two side by side meets both if its ends lie on either side of their border, or if
        the border is too close to tell. Others are to be halved.
        """
        known = ~np.isnan(self.first[0] + self.last[0])
        kept = self.of(known)
        (left_1, right_1, top_1, bottom_1), (left_2, right_2, top_2, bottom_2) = kept.first, kept.last
        low_u, high_u = np.minimum(left_1, left_2) - bow, np.maximum(right_1, right_2) + bow
        low_v, high_v = np.minimum(top_1, top_2) - bow, np.maximum(bottom_1, bottom_2) + bow
        seen = (high_u >= 0) & (low_u < camera.width) & (high_v >= 0) & (low_v < camera.height)
        kept = kept.of(seen)
        left, right, top, bottom = (np.floor(side[seen]).astype(np.int64) for side in (low_u, high_u, low_v, high_v))
        wide, tall = right - left, bottom - top
        beside = wide + tall == 1
        near = np.floor(np.minimum(kept.first[1], kept.last[1])) + np.floor(np.minimum(kept.first[3], kept.last[3])) == left + top
        far = np.floor(np.maximum(kept.first[0], kept.last[0])) + np.floor(np.maximum(kept.first[2], kept.last[2])) == right + bottom
        met = (wide + tall == 0) | (beside & ((near & far) | (bow <= OUTWARD_PX)))
        return kept, (left, right, top, bottom), met


def _filled(box: tuple[Pixels, ...], camera: CurvedCamera) -> list[tuple[Pixels, Pixels]]:
    """(rows, columns) of the pixels of boxes, within the frame."""
    left, right, top, bottom = box
    found = []
    for down in range(int((bottom - top).max(initial=-1)) + 1):
        for aside in range(int((right - left).max(initial=-1)) + 1):
            row, column = top + down, left + aside
            inside = (row <= bottom) & (column <= right) & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
            found.append((row[inside], column[inside]))
    return found

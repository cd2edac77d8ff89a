"""A lens: where a ray that a pinhole would show at (x, y) is shown instead, and back again, with a certified remainder.

Rays are (x, y, 1), right, down and forward, r^2 = x^2 + y^2; D(x, y) is where the lens shows one, both in units of the focal length.

    radial-tangential   D = s(r) (x, y) + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y), s = 1 + k1 r^2 + k2 r^4 + k3 r^6
    fisheye             D = (a/r) (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) (x, y),   a = atan(r)

as OpenCV has them. Both are gradients: their Jacobian is symmetric, with the eigenvalues f(r)/r and f'(r) of the radial part,
f(r) = r s(r), off by at most 6 |p| r. So where a bound `stretch` below all eigenvalues on a disc is above 0, D is the gradient of a
strongly convex function there, and for any two points of the disc

    |D(a) - D(b)| >= stretch |a - b|

which says that the lens does not fold (no two rays are shown at one place), and certifies an inverse found by iteration: whatever was
found lies within |D(found) - wanted| / stretch of the true one. Bounds on a slice of radii come from each power's own range; they are
taken over the smallest disc of which the lens fills the frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from runtime.refine.interval import Floats, Interval
from runtime.rounding import ROUNDING_SHARE
from runtime.scene import Distortion, SceneError
from runtime.turn import arctangent

SLICES = 512
"""Slices of the radius, of each of which the lens's derivatives are bounded."""
LARGEST_RADIUS = 6.0
"""Tangent of the largest angle off the axis that is looked at, 80 degrees; what a lens shows beyond counts as not seen."""
LEAST_STRETCH = 2.0**-7
"""A lens whose derivative is not proved to exceed this counts as folded: a pixel of it would span a hundred of the ideal frame."""
NEWTON_STEPS = 3
TINY = 2.0**-60
"""Of squares of a radius no larger than this no quotient is taken."""


@dataclass(frozen=True)
class Radial:
    """Bounds over slices of radii, (slices,) each: of f/r and f' from below and from above, of |f''| from above."""

    edges: Floats
    """Borders of the slices, (slices + 1,), from 0 on."""
    across: Interval
    along: Interval
    bend: Floats


@dataclass(frozen=True)
class Lens:
    """A lens, over the disc of rays within `radius` of the axis, on which it is proved not to fold.

    `tangential` is (p2, p1). A lens of model None leaves every ray as it is.
    """

    model: str | None
    radial: tuple[float, ...]
    tangential: tuple[float, float]
    radius: float
    whole: bool
    """True if whatever the frame shows lies within the disc; else rays beyond it count as not seen."""

    @staticmethod
    def of(distortion: Distortion | None, farthest: float) -> Lens:
        """The lens of a frame whose farthest corner is shown so far from the axis, over the smallest disc that fills the frame.

        Raises `SceneError` if it is not proved to be free of folds there.
        """
        if distortion is None or distortion.none:
            return Lens(None, (), (0.0, 0.0), farthest, True)
        k = distortion.coefficients
        fisheye = distortion.model == "fisheye"
        radial, tangential = (k, (0.0, 0.0)) if fisheye else ((*k[:2], *k[4:]), (k[3], k[2]))
        return Lens(distortion.model, radial, tangential, 0.0, True)._on_its_disc(farthest)

    def _on_its_disc(self, farthest: float) -> Lens:
        """The lens over the disc that it shows as a disc of radius `farthest`, or the largest that is looked at."""
        bounds = self._radial_bounds(LARGEST_RADIUS, 16 * SLICES)
        folded = self._stretches(bounds) < LEAST_STRETCH
        filled = bounds.edges[:-1] * bounds.across[0] - 3 * self._tangential_size * bounds.edges[1:] ** 2 >= farthest
        first = int(np.argmax(filled)) if filled.any() else len(filled) - 1
        if folded[: first + 1].any():
            at = float(bounds.edges[int(np.argmax(folded))])
            shown = at * float(bounds.across[0][int(np.argmax(folded))])
            raise SceneError(
                f"camera.distortion: found a lens that folds within the frame, {math.degrees(math.atan(at)):.1f} degrees off its axis, "
                f"{shown / farthest:.2f} of the way to the farthest corner; calibrate up to the corners, or with one more coefficient"
            )
        return Lens(self.model, self.radial, self.tangential, float(bounds.edges[first + 1]), bool(filled.any()))

    @property
    def _tangential_size(self) -> float:
        """|p|, rounded up."""
        return math.hypot(*self.tangential) * (1 + ROUNDING_SHARE)

    def _radial_bounds(self, radius: float, slices: int) -> Radial:
        edges = radius * (np.arange(slices + 1) / slices)
        low, high = edges[:-1], edges[1:]
        if self.model is None:
            one = np.ones(slices)
            return Radial(edges, (one, one), (one, one), np.zeros(slices))
        if self.model == "fisheye":
            return self._fisheye_bounds(edges)
        powers = [2 * place for place in range(len(self.radial) + 1)]
        terms = (1.0, *self.radial)
        across, along = _series(terms, powers, low, high), _series(_first(terms, powers), powers, low, high)
        bend = _series(
            [k * (power + 1) * power for k, power in zip(terms[1:], powers[1:], strict=True)], [p - 1 for p in powers[1:]], low, high
        )
        return Radial(edges, across, along, _size(bend))

    def _fisheye_bounds(self, edges: Floats) -> Radial:
        """With P(a) = f as a polynomial in a = atan(r): f/r = (P/a) (a/r), f' = P' cos^2(a), f'' = (P'' - 2 r P') cos^4(a)."""
        angle = arctangent(edges)
        low, high = angle[:-1] * (1 - ROUNDING_SHARE), angle[1:] * (1 + ROUNDING_SHARE)
        powers = [2 * place for place in range(len(self.radial) + 1)]
        terms = (1.0, *self.radial)
        share = np.ones(len(edges))  # a / r, which falls from 1
        share[1:] = angle[1:] / edges[1:]
        square = 1 / (1 + edges**2)  # cos^2(a), which falls from 1
        ratio, slope = _series(terms, powers, low, high), _series(_first(terms, powers), powers, low, high)
        bend = _series(
            [k * (power + 1) * power for k, power in zip(terms[1:], powers[1:], strict=True)], [p - 1 for p in powers[1:]], low, high
        )
        across = _product(ratio, (share[1:], share[:-1]))
        along = _product(slope, (square[1:], square[:-1]))
        twice = _product(slope, (2 * edges[:-1], 2 * edges[1:]))
        second = _product((bend[0] - twice[1], bend[1] - twice[0]), (square[1:] ** 2, square[:-1] ** 2))
        return Radial(edges, _outward(across), _outward(along), _size(_outward(second)))

    @cached_property
    def bounds(self) -> Radial:
        """Bounds over slices of the disc."""
        return self._radial_bounds(self.radius, SLICES)

    def _stretches(self, bounds: Radial) -> Floats:
        """A bound below the Jacobian's eigenvalues, a slice each."""
        least = np.minimum(bounds.across[0], bounds.along[0])
        return least - 6 * self._tangential_size * bounds.edges[1:]

    @cached_property
    def stretches(self) -> Floats:
        """A bound below the Jacobian's eigenvalues, a slice of the disc each, (slices,)."""
        return self._stretches(self.bounds)

    @cached_property
    def stretch(self) -> float:
        """The least of `stretches`."""
        return float(self.stretches.min())

    @property
    def curvature(self) -> float:
        """`curvature_within` on the whole disc."""
        return self.curvature_within(self.radius)

    def curvature_within(self, radius: float) -> float:
        """Bound on |x''|, |x| <= radius, where D(x(t)) runs along a straight line at speed 1: |D''| / stretch^3.

        |D''| <= 3/2 sup |f''| + 6 |p|: with g = f/r, D''[u, u] has the radial part f'' c^2 + g' s^2 and the other one 2 g' c s, for a unit
        vector u at an angle of cosine c; and g'(r), the mean of t f''(t r) over t from 0 to 1, is half of the largest |f''| up to there.
        """
        kept = max(int(np.searchsorted(self.bounds.edges, radius)), 1)
        return float((self._bends / self.stretches**3)[:kept].max() * (1 + ROUNDING_SHARE))

    @property
    def _bends(self) -> Floats:
        """Bound on |D''| up to the end of each slice, (slices,)."""
        return 1.5 * np.maximum.accumulate(self.bounds.bend) + 6 * self._tangential_size

    @cached_property
    def largest_bend(self) -> float:
        """Bound on |D''| on the disc. As D is a gradient, no entry of its Jacobian differs between two points by more per unit of way."""
        return float(self._bends[-1] * (1 + ROUNDING_SHARE))

    def stretch_within(self, radius: float) -> float:
        """The least of `stretches` up to a radius."""
        return float(self.stretches[: max(int(np.searchsorted(self.bounds.edges, radius)), 1)].min())

    @cached_property
    def largest_scale(self) -> float:
        """A bound above |D(x)|/|x| and the Jacobian's eigenvalues on the disc."""
        largest = max(float(self.bounds.across[1].max()), float(self.bounds.along[1].max()))
        return (largest + 6 * self._tangential_size * self.radius) * (1 + ROUNDING_SHARE)

    @cached_property
    def rounding(self) -> float:
        """What `distorted` is off by at most, in both coordinates together, on the disc."""
        r = self.radius
        angle = min(r, math.pi / 2) if self.model == "fisheye" else r
        series = 1 + sum(abs(k) * angle ** (2 * place + 2) for place, k in enumerate(self.radial))
        return 4 * ROUNDING_SHARE * (r * series + 3 * self._tangential_size * r**2)

    def distorted(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """D(x, y), of any shape, up to `rounding`."""
        if self.model is None:
            return x, y
        square = x * x + y * y
        scale = self._scale(square)
        if not any(self.tangential):
            return x * scale, y * scale
        p2, p1 = self.tangential
        along = 2 * (p2 * x + p1 * y)
        return x * scale + x * along + p2 * square, y * scale + y * along + p1 * square

    def _scale(self, square: Floats) -> Floats:
        """f/r of r^2."""
        if self.model != "fisheye":
            return _horner(self.radial, square)
        r = np.sqrt(square)
        return self._fisheye_scale(r, arctangent(r))

    def _fisheye_scale(self, r: Floats, angle: Floats) -> Floats:
        """The same by r and its angle."""
        return _horner(self.radial, angle * angle) * np.where(r > 0, angle / np.where(r > 0, r, 1.0), 1.0)

    def _scale_and_slope(self, square: Floats) -> tuple[Floats, Floats]:
        """f/r and f' of r^2."""
        terms = [k * (2 * place + 3) for place, k in enumerate(self.radial)]
        if self.model != "fisheye":
            return _horner(self.radial, square), _horner(terms, square)
        r = np.sqrt(square)
        angle = arctangent(r)
        return self._fisheye_scale(r, angle), _horner(terms, angle * angle) / (1 + square)

    def undistorted(self, x: Floats, y: Floats, off: Floats | float = 0.0) -> tuple[Floats, Floats, Floats]:
        """The rays of the disc that the lens shows within `off` of (x, y): a centre, and how far from it they are at most.

        Where there is none, the distance is infinite, unless some ray of the disc is so near that it may be one.
        """
        if self.model is None:
            size = np.sqrt(x * x + y * y)
            beyond = size - off > self.radius * (1 + ROUNDING_SHARE)
            return x, y, np.where(beyond, np.inf, off + ROUNDING_SHARE * size)
        found_x, found_y = self._inverted(x, y)
        shown_x, shown_y = self.distorted(found_x, found_y)
        miss = np.sqrt((shown_x - x) ** 2 + (shown_y - y) ** 2) + off + self.rounding
        radius = np.sqrt(found_x**2 + found_y**2)
        first = miss / self.stretch
        near = first < self.radius / 8  # else it is no inverse at all
        return found_x, found_y, np.where(near, miss / self._stretch_within(radius, np.where(near, first, 0.0)), np.inf)

    def _stretch_within(self, radius: Floats, distance: Floats) -> Floats:
        """A bound below the eigenvalues at all points of the disc within `distance` of one at `radius`: over runs of slices."""
        step = self.radius / SLICES
        reach = math.ceil(float(distance.max(initial=0.0)) / step) + 1
        least = self.stretches
        padded = np.pad(least, reach, constant_values=np.inf)
        run = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).min(axis=1)
        return run[np.minimum((radius / step).astype(np.int64), SLICES - 1)]

    def stretches_around(self, radius: Floats, distance: float) -> Floats:
        """A bound below the eigenvalues at all points of the disc within `distance` of one at `radius`."""
        return self._stretch_within(np.minimum(radius, self.radius), np.full(1, distance))

    def _inverted(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """About the ray of the disc that is shown at (x, y): by the radial part's table, then Newton's steps within the disc."""
        edges = self.bounds.edges
        shown = edges * self._scale(edges * edges)
        size = np.sqrt(x * x + y * y)
        share = np.interp(size, shown, edges) / np.where(size > 0, size, 1.0)
        found_x, found_y = x * share, y * share
        for _ in range(NEWTON_STEPS):
            (off_x, off_y), (a, b, d) = self.distorted_and_jacobian(found_x, found_y)
            off_x, off_y = off_x - x, off_y - y
            determinant = a * d - b * b
            found_x, found_y = found_x - (d * off_x - b * off_y) / determinant, found_y - (a * off_y - b * off_x) / determinant
            size = np.sqrt(found_x * found_x + found_y * found_y)
            back = np.minimum(1.0, self.radius / np.maximum(size, self.radius / 2))
            found_x, found_y = found_x * back, found_y * back
        return found_x, found_y

    def jacobian(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """dD_x/dx, dD_x/dy = dD_y/dx and dD_y/dy, of any shape, up to what float64 loses."""
        return self.distorted_and_jacobian(x, y)[1]

    def distorted_and_jacobian(self, x: Floats, y: Floats) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats, Floats]]:
        """D(x, y), and its `jacobian`: at less than the cost of both."""
        square = x * x + y * y
        if self.model is None:
            return (x, y), (np.ones_like(square), np.zeros_like(square), np.ones_like(square))
        scale, slope = self._scale_and_slope(square)
        gap = (slope - scale) / np.where(square > 0, square, 1.0)
        mixed = gap * x * y
        if not any(self.tangential):
            return (x * scale, y * scale), (scale + gap * x * x, mixed, scale + gap * y * y)
        p2, p1 = self.tangential
        along = 2 * (p2 * x + p1 * y)
        shown = x * scale + x * along + p2 * square, y * scale + y * along + p1 * square
        a, d = scale + gap * x * x + along + 4 * p2 * x, scale + gap * y * y + along + 4 * p1 * y
        return shown, (a, mixed + 2 * (p1 * x + p2 * y), d)

    def shown_range(self, x: Interval, y: Interval) -> tuple[Interval, Interval]:
        """Outward enclosure of D over boxes of rays in the disc: D at the middle, and the Jacobian's range times the half-widths."""
        (x_low, x_high), (y_low, y_high) = x, y
        middle_x, middle_y = (x_low + x_high) / 2, (y_low + y_high) / 2
        half_x = np.maximum(x_high - middle_x, middle_x - x_low) * (1 + ROUNDING_SHARE)
        half_y = np.maximum(y_high - middle_y, middle_y - y_low) * (1 + ROUNDING_SHARE)
        shown_x, shown_y = self.distorted(middle_x, middle_y)
        if self.model is None:
            return (shown_x - half_x, shown_x + half_x), (shown_y - half_y, shown_y + half_y)
        size_x, size_y = np.maximum(np.abs(x_low), np.abs(x_high)), np.maximum(np.abs(y_low), np.abs(y_high))
        least_x, least_y = (np.maximum(np.maximum(low, -high), 0.0) for low, high in (x, y))
        nearest, farthest = np.sqrt(least_x**2 + least_y**2), np.sqrt(size_x**2 + size_y**2)
        across, along, gap = self._largest_within(nearest, farthest)
        p2, p1 = (abs(part) for part in self.tangential)
        mixed = np.where(nearest**2 > TINY, np.minimum(0.5, size_x * size_y / np.maximum(nearest**2, TINY)), 0.5)
        mixed = gap * mixed * (1 + ROUNDING_SHARE) + 2 * (p1 * size_x + p2 * size_y)
        by_x = _between(across, along, least_x, size_x, least_y, size_y) + 2 * p1 * size_y + 6 * p2 * size_x
        by_y = _between(across, along, least_y, size_y, least_x, size_x) + 6 * p1 * size_y + 2 * p2 * size_x
        off_x, off_y = by_x * half_x + mixed * half_y, mixed * half_x + by_y * half_y
        off_x, off_y = (off * (1 + ROUNDING_SHARE) + self.rounding for off in (off_x, off_y))
        return (shown_x - off_x, shown_x + off_x), (shown_y - off_y, shown_y + off_y)

    def _largest_within(self, nearest: Floats, farthest: Floats) -> tuple[Floats, Floats, Floats]:
        """The largest f/r, the largest f' and how far the two are apart at most, over radii between two."""
        bounds, step = self.bounds, self.radius / SLICES
        gap = np.maximum(bounds.across[1] - bounds.along[0], bounds.along[1] - bounds.across[0])
        first, last = (np.clip((side / step).astype(np.int64) + more, 0, SLICES - 1) for side, more in ((nearest, -1), (farthest, 1)))
        reach = int((last - first).max(initial=0)) + 1
        values = np.stack([bounds.across[1], bounds.along[1], gap])
        padded = np.pad(values, ((0, 0), (0, reach - 1)), constant_values=-np.inf)
        across, along, apart = np.lib.stride_tricks.sliding_window_view(padded, reach, axis=1).max(axis=2)
        return across[first], along[first], apart[first]


def _between(across: Floats, along: Floats, least: Floats, most: Floats, other_least: Floats, other_most: Floats) -> Floats:
    """Largest across (1 - w) + along w, w = x^2 / (x^2 + y^2): the derivative of x's coordinate by x, |x| and |y| between bounds."""
    low = least**2 / np.maximum(least**2 + other_most**2, TINY)
    together = most**2 + other_least**2
    high = np.where(together > TINY, most**2 / np.maximum(together, TINY), 1.0)
    low, high = low * (1 - ROUNDING_SHARE), np.minimum(high * (1 + ROUNDING_SHARE), 1.0)
    return np.maximum(across * (1 - low) + along * low, across * (1 - high) + along * high)


def _first(terms: tuple[float, ...], powers: list[int]) -> list[float]:
    """Coefficients of the derivative of a f(a), f with these terms; its powers are f's."""
    return [k * (power + 1) for k, power in zip(terms, powers, strict=True)]


def _second(terms: tuple[float, ...], powers: list[int]) -> tuple[list[float], list[int]]:
    """Coefficients and powers of the second derivative of a f(a)."""
    return [k * (power + 1) * power for k, power in zip(terms[1:], powers[1:], strict=True)], [power - 1 for power in powers[1:]]


def _horner(coefficients: tuple[float, ...] | list[float], square: Floats) -> Floats:
    """1 + c1 square + c2 square^2 + ..."""
    series = np.zeros_like(square)
    for coefficient in reversed(coefficients):
        series = (series + coefficient) * square
    return series + 1.0


def _series(coefficients: tuple[float, ...] | list[float], powers: list[int], low: Floats, high: Floats) -> Interval:
    """Range of a sum of powers over intervals [low, high], low >= 0: each power's own range, rounded outward."""
    least, most, size = np.zeros_like(low), np.zeros_like(low), np.zeros_like(low)
    for coefficient, power in zip(coefficients, powers, strict=True):
        first, last = coefficient * low**power, coefficient * high**power
        least, most = least + np.minimum(first, last), most + np.maximum(first, last)
        size = size + np.abs(last) + np.abs(first)
    return least - ROUNDING_SHARE * size, most + ROUNDING_SHARE * size


def _product(first: Interval, second: Interval) -> Interval:
    """Range of a product, `second` not below 0."""
    return np.minimum(first[0] * second[0], first[0] * second[1]), np.maximum(first[1] * second[0], first[1] * second[1])


def _outward(sides: Interval) -> Interval:
    size = ROUNDING_SHARE * (1 + np.maximum(np.abs(sides[0]), np.abs(sides[1])))
    return sides[0] - size, sides[1] + size


def _size(sides: Interval) -> Floats:
    """The largest absolute value in each interval."""
    return np.maximum(np.abs(sides[0]), np.abs(sides[1]))

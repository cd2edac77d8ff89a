"""A lens in ball arithmetic: OpenCV's own formulas, their derivatives, and bounds on these over slices of the radius.

On rays (x, y, 1), r^2 = x^2 + y^2, OpenCV's models are D = f(r) (x, y)/r, besides the tangential 2 (p . x) x + r^2 p with p = (p2, p1):

    radial-tangential   f = r + k1 r^3 + k2 r^5 + k3 r^7
    fisheye             f = a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9,    a = atan(r)

The Jacobian is symmetric: s + g x^2 across, g x y mixed and s + g y^2 down, with s = f/r and g = (f' - s)/r^2, besides the tangential
part's; its eigenvalues are s and f', which that changes by 6 |p| r at most. A second derivative is 3/2 sup |f''| + 6 |p| at most, up to r.
This is the verifier's own lens; it shares no code and no rounding with `runtime.lens`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

from flint import arb  # pyright: ignore[reportMissingModuleSource]

from runtime.scene import Distortion

SMALL_SQUARE = 2.0**-20
"""Of a radius, below which no quotient by it is taken."""


@dataclass(frozen=True)
class RadialSlice:
    """What holds at all radii of a slice: a bound below the Jacobian's eigenvalues, and one above second derivatives."""

    stretch: arb
    bend: arb


@dataclass(frozen=True)
class BallLens:
    """A lens; without coefficients every ray is shown where it is."""

    radial: tuple[arb, ...] = ()
    tangential: tuple[arb, arb] = field(default_factory=lambda: (arb(0), arb(0)))
    """p1 and p2."""
    fisheye: bool = False

    @staticmethod
    def of(distortion: Distortion | None) -> BallLens:
        """The lens of a camera."""
        if distortion is None or distortion.none:
            return BallLens()
        k = tuple(arb(value) for value in distortion.coefficients)
        if distortion.model == "fisheye":
            return BallLens(k, fisheye=True)
        return BallLens((*k[:2], *k[4:]), (k[2], k[3]))

    @property
    def tangential_size(self) -> arb:
        """|p|."""
        return (self.tangential[0] ** 2 + self.tangential[1] ** 2).sqrt()

    def ratio_and_slope(self, r: arb) -> tuple[arb, arb]:
        """f/r and f' at radii in a ball."""
        angle = r.atan() if self.fisheye else r
        ratio, slope = self._series(angle * angle)
        if not self.fisheye:
            return ratio, slope
        return ratio * _angle_share(r), slope / (1 + r**2)

    def _series(self, square: arb) -> tuple[arb, arb]:
        ratio, slope, power = arb(1), arb(1), arb(1)
        for place, k in enumerate(self.radial):
            power = power * square
            ratio, slope = ratio + k * power, slope + (2 * place + 3) * k * power
        return ratio, slope

    def slice(self, low: arb, high: arb) -> RadialSlice:
        """What holds at radii between two."""
        r = low.union(high)
        ratio, slope = self.ratio_and_slope(r)
        bent = 6 * self.tangential_size
        return RadialSlice(_least((ratio, slope)) - bent * high, arb(1.5) * abs(self._second(r)).upper() + bent)

    def stretch_between(self, low: arb, high: arb, parts: int) -> arb:
        """A bound below the Jacobian's eigenvalues at radii between two, in so many slices."""
        edges = [low + (high - low) * part / parts for part in range(parts)]
        return _least([self.slice(first, last).stretch for first, last in itertools.pairwise([*edges, high])])

    def _second(self, r: arb) -> arb:
        """f'' at radii in a ball: of P(a), (P'' - 2 r P')/(1 + r^2)^2."""
        angle = r.atan() if self.fisheye else r
        second, power = arb(0), angle
        for place, k in enumerate(self.radial):
            second, power = second + (2 * place + 3) * (2 * place + 2) * k * power, power * angle * angle
        if not self.fisheye:
            return second
        return (second - 2 * r * self._series(angle * angle)[1]) / (1 + r**2) ** 2

    def shown(self, x: arb, y: arb) -> tuple[tuple[arb, arb], tuple[arb, arb, arb]]:
        """D at a ray, and dD_x/dx, dD_x/dy = dD_y/dx and dD_y/dy there."""
        square = x * x + y * y
        ratio, slope = self.ratio_and_slope(square.sqrt())
        p1, p2 = self.tangential
        if square > SMALL_SQUARE:
            gap = (slope - ratio) / square
            across, mixed, down = ratio + gap * x * x, gap * x * y, ratio + gap * y * y
        else:
            across = down = ratio.union(slope)
            mixed = arb(0, abs(slope - ratio).upper()) / 2
        by = 2 * (p1 * y + p2 * x)
        place = x * (ratio + by) + p2 * square, y * (ratio + by) + p1 * square
        return place, (across + by + 4 * p2 * x, mixed + 2 * (p1 * x + p2 * y), down + by + 4 * p1 * y)


def _angle_share(r: arb) -> arb:
    """atan(r)/r at radii in a ball, r >= 0: it falls from 1."""
    least, largest = (side.atan() / side if side > 0 else arb(1) for side in (r.upper(), r.lower()))
    return least.union(largest)


def _least(bounds: Sequence[arb]) -> arb:
    """A number below all of some balls."""
    least = bounds[0].lower()
    for bound in bounds[1:]:
        least = least.min(bound.lower())
    return least

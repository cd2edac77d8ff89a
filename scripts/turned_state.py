"""Cameras with roll and yaw, in rational numbers: by the half-angle tangents of a and b, and of the pitch c that the ideal frame shows."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from flint import arb, ctx
from numpy.typing import NDArray
from rational_image import RationalState, RationalView, turn

from runtime import Scene
from runtime.attitude import Attitude
from runtime.scene import Mount

Floats = NDArray[np.float64]
Angles = tuple[arb, arb, arb]
"""Roll, pitch down and yaw, rad, as balls."""
Matrix = list[list[arb]]

BITS = 200
HAIR = 1e-13
"""A plus-minus that holds an angle whose float64 is rounded."""


@dataclass(frozen=True)
class TurnedState:
    """A state by the pitch c that the ideal frame shows, and the tangents of half a and half b: the camera is R_z(a) R_y(b) R_x(c)."""

    seen: RationalState
    a: Fraction
    b: Fraction

    @staticmethod
    def near(seen: Floats, a: float, b: float) -> TurnedState:
        """Close to these numbers: [c, x, y, z], and a and b, rad."""
        return TurnedState(RationalState.near(seen), Fraction(np.tan(a / 2)), Fraction(np.tan(b / 2)))

    def view(self, scene: Scene) -> RationalView:
        """What the camera sees, exactly."""
        return self.turned(RationalView.of(scene.to_dict()))

    def turned(self, view: RationalView) -> RationalView:
        """A level view, turned; a view's yaw is a turn of what is seen to the left, -b."""
        return replace(view, roll=self.a, yaw=-self.b)

    @property
    def angles(self) -> Angles:
        """Roll, theta and yaw of the camera as balls."""
        with ctx.workprec(BITS):
            return _angles_of(self._rotation)

    @property
    def _rotation(self) -> Matrix:
        """R_z(a) R_y(b) R_x(c)."""
        (cos_a, sin_a), (cos_b, sin_b), (cos_c, sin_c) = (map(_ball, turn(half)) for half in (self.a, self.b, self.seen.tangent))
        return _product(_z(cos_a, sin_a), _product(_y(cos_b, sin_b), _x(cos_c, sin_c)))

    def aircraft(self, mount: Mount, roll_off: float = 0.0, yaw_off: float = 0.0) -> Angles:
        """The same of the aircraft in which the camera is mounted so: its rotation is R(mount)^T times the camera's.

        The camera may have so much more of roll and yaw than its mount says.
        """
        with ctx.workprec(BITS):
            mounted = _rotation_of((arb(mount.roll_rad), arb(mount.pitch_down_rad), arb(mount.yaw_rad)))
            (roll, pitch, yaw), own = self.angles, self._rotation
            if roll_off or yaw_off:
                own = _rotation_of((roll - arb(roll_off), pitch, yaw - arb(yaw_off)))
            return _angles_of(_product([list(column) for column in zip(*mounted, strict=True)], own))

    def attitude(self, rng: np.random.Generator, roll_plus_minus: float = 0.0, yaw_plus_minus: float = 0.0) -> Attitude:
        """A reading that is off by the plus-minus at most, which holds the true angles."""
        roll, _, yaw = self.angles
        readings = [
            float(angle.mid()) + rng.choice([-1.0, 1.0, rng.uniform(-1, 1)]) * plus_minus
            for angle, plus_minus in ((roll, roll_plus_minus), (yaw, yaw_plus_minus))
        ]
        return Attitude(readings[0], readings[1], roll_plus_minus + HAIR, yaw_plus_minus + HAIR)

    def within(self, lower: Floats, upper: Floats) -> bool:
        """Is the camera's state in this box, borders included?"""
        if self.b == 0:
            return self.seen.within(lower, upper)
        rest = zip((self.seen.x, self.seen.y, self.seen.z), map(float, lower[1:]), map(float, upper[1:]), strict=True)
        return holds(float(lower[0]), self.angles[1], float(upper[0])) and all(low <= value <= high for value, low, high in rest)


def holds(low: float, angle: arb, high: float) -> bool:
    """True if a ball lies between two float64, borders included."""
    return bool(angle >= arb(low)) and bool(angle <= arb(high))


def _rotation_of(angles: Angles) -> Matrix:
    """R_z(-roll) R_x(pitch down) R_y(-yaw)."""
    roll, pitch, yaw = ((angle.cos(), angle.sin()) for angle in (-angles[0], angles[1], -angles[2]))
    return _product(_z(*roll), _product(_x(*pitch), _y(*yaw)))


def _angles_of(rotation: Matrix) -> Angles:
    """Of R_z(-roll) R_x(pitch down) R_y(-yaw): read off its middle column and its last row."""
    (_, right, _), (_, down, _), (aside, ahead, depth) = rotation
    return arb.atan2(right, down), ahead.asin(), arb.atan2(aside, depth)


def _x(cosine: arb, sine: arb) -> Matrix:
    return [[arb(1), arb(0), arb(0)], [arb(0), cosine, -sine], [arb(0), sine, cosine]]


def _y(cosine: arb, sine: arb) -> Matrix:
    return [[cosine, arb(0), sine], [arb(0), arb(1), arb(0)], [-sine, arb(0), cosine]]


def _z(cosine: arb, sine: arb) -> Matrix:
    return [[cosine, -sine, arb(0)], [sine, cosine, arb(0)], [arb(0), arb(0), arb(1)]]


def _product(first: Matrix, second: Matrix) -> Matrix:
    columns = list(zip(*second, strict=True))
    products = [[sum((one * other for one, other in zip(row, column, strict=True)), arb(0)) for column in columns] for row in first]
    assert all(isinstance(entry, arb) for entry in itertools.chain(*products))
    return products


def _ball(value: Fraction) -> arb:
    return arb(value.numerator) / value.denominator

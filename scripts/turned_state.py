"""Cameras with roll and yaw, in rational numbers: by the half-angle tangents of a and b, and of the pitch c that the ideal frame shows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from flint import arb, ctx
from numpy.typing import NDArray
from rational_image import RationalState, RationalView, turn

from runtime import Scene
from runtime.attitude import Attitude

Floats = NDArray[np.float64]
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
        """What the camera sees, exactly; a view's yaw is a turn of what is seen to the left, -b."""
        return replace(RationalView.of(scene.to_dict()), roll=self.a, yaw=-self.b)

    @property
    def angles(self) -> tuple[arb, arb, arb]:
        """Roll, theta and yaw of the camera as balls: read off the matrix."""
        with ctx.workprec(BITS):
            (cos_a, sin_a), (cos_b, sin_b), (cos_c, sin_c) = (map(_ball, turn(half)) for half in (self.a, self.b, self.seen.tangent))
            # the middle row, and the right and the middle column, of R_z(phi) R_x(theta) R_y(-psi)
            down = cos_a * sin_b * sin_c - sin_a * cos_c, sin_a * sin_b * sin_c + cos_a * cos_c
            forward = -sin_b, cos_b * cos_c
            return -arb.atan2(-down[0], down[1]), (cos_b * sin_c).asin(), arb.atan2(*forward)

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
        theta = self.angles[1]
        rest = zip((self.seen.x, self.seen.y, self.seen.z), map(float, lower[1:]), map(float, upper[1:]), strict=True)
        return bool(theta >= arb(float(lower[0])) and theta <= arb(float(upper[0]))) and all(
            low <= value <= high for value, low, high in rest
        )


def _ball(value: Fraction) -> arb:
    return arb(value.numerator) / value.denominator

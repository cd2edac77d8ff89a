"""The camera's roll and yaw: between the frame of its sensor and the ideal frame, that of the camera without either.

Axes here point right, down and forward. A ray w of the level frame along the runway is the camera's ray

    R_z(phi) R_x(theta) R_y(-psi) w,    phi = -roll: left wing down,  theta: pitch down,  psi = yaw: nose to the right of the runway

which is R_z(a) R_y(b) R_x(c) w too, with

    tan(c) = tan(theta) / cos(psi)      tan(b) = -cos(c) tan(psi)      a = phi + atan(sin(b) tan(c))

R_x(c) w is what the *ideal frame* shows, that of a camera of pitch c without roll and yaw (`runtime.camera`); R_z(a) R_y(b) turns it to the
sensor's frame, whatever the state. So sets of states, a model's domain and its entries have c in the place of theta, and nothing else of
them changes; the camera's pitch theta is what a user gives and gets. Here alone the signs of aviation become these, and either pitch the
other. All intervals are rounded outward (`runtime.rounding`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from runtime.rounding import lowered, raised
from runtime.scene import LARGEST_TURN_RAD, Mount
from runtime.turn import arctangent, cosine_and_sine

Floats = NDArray[np.float64]
Interval = tuple[Floats, Floats]

SMALLEST_RAD = 1e-100
"""A smaller angle that is not 0 is taken for one between 0 and this: products of three such are no float64 with all its digits."""
STEEPEST_SINE = 0.9999
"""Of a camera's pitch: one that looks farther down has no roll to speak of."""


@dataclass(frozen=True)
class Attitude:
    """Roll and yaw of the camera, each known up to a plus-minus: roll is positive with the right wing down, yaw with the nose to the right
    of the runway's direction.

    Raises ValueError for angles that are not finite, a plus-minus below 0, or more than `LARGEST_TURN_RAD` in all.
    """

    roll_rad: float
    yaw_rad: float
    roll_plus_minus_rad: float = 0.0
    yaw_plus_minus_rad: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, float(getattr(self, field.name)))
        for name in ("roll", "yaw"):
            angle, plus_minus = getattr(self, f"{name}_rad"), getattr(self, f"{name}_plus_minus_rad")
            if not plus_minus >= 0:
                raise ValueError(f"attitude: found {name}_plus_minus_rad {plus_minus}; give 0 or more")
            if not abs(angle) + plus_minus <= LARGEST_TURN_RAD:
                expected = f"give radians, of at most {LARGEST_TURN_RAD} with the plus-minus"
                raise ValueError(f"attitude: found {name}_rad {angle} +- {plus_minus}; {expected}")

    @staticmethod
    def between(roll_rad: tuple[float, float], yaw_rad: tuple[float, float]) -> Attitude:
        """The attitude whose intervals hold these ones."""
        middles, halves = [], []
        for low, high in (roll_rad, yaw_rad):
            middle = (low + high) / 2
            middles.append(middle)
            halves.append(float(raised(max(high - middle, middle - low), abs(low) + abs(high))) if high > low else 0.0)
        return Attitude(middles[0], middles[1], halves[0], halves[1])

    def wider(self, roll_rad: float, yaw_rad: float) -> Attitude:
        """The same readings with so much more of a plus-minus."""
        if roll_rad == 0 and yaw_rad == 0:
            return self
        roll, yaw = self.roll_plus_minus_rad + roll_rad, self.yaw_plus_minus_rad + yaw_rad
        return Attitude(self.roll_rad, self.yaw_rad, float(raised(roll, roll)), float(raised(yaw, yaw)))

    @property
    def roll(self) -> tuple[float, float]:
        """The least and the largest roll, rad."""
        return _sized(_around(self.roll_rad, self.roll_plus_minus_rad))

    @property
    def yaw(self) -> tuple[float, float]:
        """The least and the largest yaw, rad."""
        return _sized(_around(self.yaw_rad, self.yaw_plus_minus_rad))

    def __str__(self) -> str:
        return f"roll {self.roll_rad:.6g} rad +-{self.roll_plus_minus_rad:.3g}, yaw {self.yaw_rad:.6g} rad +-{self.yaw_plus_minus_rad:.3g}"


Angle = tuple[float, float]
"""The least and the largest value of an angle, rad."""


def mounted(mount: Mount, roll: Angle, pitch_down: Angle, yaw: Angle) -> tuple[Attitude, Angle]:
    """The camera's attitude, and the interval of its theta, by its mount in an aircraft with angles in these intervals.

    Its rotation is R(mount) R(aircraft), each R_z(-roll) R_x(pitch down) R_y(-yaw). Raises ValueError as `Attitude` does.
    """
    if mount == Mount():
        return Attitude.between(roll, yaw), pitch_down
    of_mount = _rotation(*(_sized((angle, angle)) for angle in (mount.roll_rad, mount.pitch_down_rad, mount.yaw_rad)))
    whole = _times(of_mount, _rotation(*map(_sized, (roll, pitch_down, yaw))))
    # the middle column is (-sin(phi) cos(theta), cos(phi) cos(theta), sin(theta)), the last row (cos(theta) sin(psi), sin(theta), ...)
    down = whole[2][1]
    if min(whole[1][1][0], whole[2][2][0]) <= 0 or max(-down[0], down[1]) >= STEEPEST_SINE:
        raise ValueError("attitude: found a camera that looks a right angle away from the runway; correct its mount or the readings")
    ahead = tuple(math.sqrt((1 - side) * (1 + side)) for side in down)
    tangent = tuple(side / cosine for side, cosine in zip(down, ahead, strict=True))
    theta = _angle_of((float(lowered(tangent[0], abs(tangent[0]))), float(raised(tangent[1], abs(tangent[1])))), (1.0, 1.0))
    return Attitude.between(_angle_of(whole[0][1], whole[1][1]), _angle_of(whole[2][0], whole[2][2])), theta


Numbers = tuple[float, float]
Matrix = list[list[Numbers]]


def _rotation(roll: Angle, pitch_down: Angle, yaw: Angle) -> Matrix:
    """R_z(-roll) R_x(pitch down) R_y(-yaw), entry by entry, rounded outward."""
    (cos_r, sin_r), (cos_p, sin_p), (cos_y, sin_y) = (_turn_of(angle) for angle in (roll, pitch_down, yaw))
    one, none = (1.0, 1.0), (0.0, 0.0)
    first = [[cos_r, sin_r, none], [_less(sin_r), cos_r, none], [none, none, one]]
    second = [[one, none, none], [none, cos_p, _less(sin_p)], [none, sin_p, cos_p]]
    third = [[cos_y, none, _less(sin_y)], [none, one, none], [sin_y, none, cos_y]]
    return _times(first, _times(second, third))


def _turn_of(angle: Angle) -> tuple[Numbers, Numbers]:
    """Ranges of cosine and sine over an interval within -pi/2 and pi/2."""
    if not -math.pi / 2 < angle[0] <= angle[1] < math.pi / 2:
        raise ValueError(f"attitude: found an angle of {angle[0]:.6g} to {angle[1]:.6g} rad; give ordered ones within a right angle")
    sides = np.array([angle])
    low, high = (float(side[0]) for side in _cosines(sides))
    sine = cosine_and_sine(sides)[1][0]
    return (low, high), (float(lowered(sine[0], abs(sine[0]))), float(raised(sine[1], abs(sine[1]))))


def _less(number: Numbers) -> Numbers:
    return -number[1], -number[0]


def _times(first: Matrix, second: Matrix) -> Matrix:
    """The product of two matrices of intervals, rounded outward."""
    return [[_dot(row, [line[column] for line in second]) for column in range(3)] for row in first]


def _dot(row: list[Numbers], column: list[Numbers]) -> Numbers:
    products = [[one * other for one in left for other in right] for left, right in zip(row, column, strict=True)]
    terms = sum(max(map(abs, sides)) for sides in products)
    low, high = (sum(extreme(sides) for sides in products) for extreme in (min, max))
    return float(lowered(low, terms)), float(raised(high, terms))


def _angle_of(sine: Numbers, cosine: Numbers) -> Angle:
    """Range of atan(sine / cosine) for cosines above 0; `sine` may be both of any size."""
    tangents = [one / other for one in sine for other in cosine]
    low, high = (float(arctangent(np.array([extreme(tangents)]))[0]) for extreme in (min, max))
    return float(lowered(low, abs(low))), float(raised(high, abs(high)))


def _sized(angle: Angle) -> Angle:
    """The interval, with sides that are too small for products moved outward."""
    low, high = angle
    low = -SMALLEST_RAD if -SMALLEST_RAD < low < 0 else 0.0 if 0 < low < SMALLEST_RAD else low
    return low, SMALLEST_RAD if 0 < high < SMALLEST_RAD else 0.0 if -SMALLEST_RAD < high < 0 else high


def _around(value: float, plus_minus: float) -> tuple[float, float]:
    if plus_minus == 0:
        return value, value
    terms = abs(value) + plus_minus
    return float(lowered(value - plus_minus, terms)), float(raised(value + plus_minus, terms))


@dataclass(frozen=True)
class Turns:
    """Rotations R_z(a) R_y(b) of many sets of states: one in the middle, and how far a and b may be from it. Arrays are (sets,)."""

    cos_a: Floats
    sin_a: Floats
    cos_b: Floats
    sin_b: Floats
    off_a: Floats
    off_b: Floats

    @staticmethod
    def of(seen_pitch: Floats, roll: Floats, yaw: Floats) -> Turns:
        """Of all states whose ideal frame shows a pitch c in `seen_pitch`, with roll and yaw in these intervals; (sets, 2) each, rad."""
        cos_c, tan_c = _cosines_and_tangents(seen_pitch)
        low, high = _product((-cos_c[1], -cos_c[0]), _tangents(yaw))
        b = arctangent(np.stack([low, high]))
        sin_b = low / np.sqrt(1 + low * low), high / np.sqrt(1 + high * high)
        shift = _product(sin_b, tan_c)
        shift = arctangent(np.stack([lowered(shift[0], np.abs(shift[0])), raised(shift[1], np.abs(shift[1]))]))
        a = shift[0] - roll[:, 1], shift[1] - roll[:, 0]
        (cos_a, sin_a), off_a = _middle(a, np.abs(shift[0]) + np.abs(shift[1]) + np.abs(roll).max(axis=1))
        (cos_b, sin_b0), off_b = _middle((b[0], b[1]), np.abs(b[0]) + np.abs(b[1]))
        return Turns(cos_a, sin_a, cos_b, sin_b0, off_a, off_b)

    @staticmethod
    def level(count: int, off_a: float, off_b: float) -> Turns:
        """Of `count` sets whose sensor is not turned, but for so much at most."""
        one, nothing = np.ones(count), np.zeros(count)
        return Turns(one, nothing, one, nothing, np.full(count, off_a), np.full(count, off_b))

    @property
    def off(self) -> Floats:
        """The largest angle between one of a set's rotations and the one in the middle."""
        return self.off_a + self.off_b


def camera_pitch(seen_pitch: Floats, yaw: Floats) -> Floats:
    """Interval of theta where the ideal frame shows a pitch in `seen_pitch`: tan(theta) = tan(c) cos(psi). All are (sets, 2), rad."""
    return _angles(_product(_tangents(seen_pitch), _cosines(yaw)))


def seen_pitch(pitch: Floats, yaw: Floats) -> Floats:
    """Interval of the pitch c that the ideal frame shows where the camera's is in `pitch`; shapes as in `camera_pitch`."""
    cosine = _cosines(yaw)
    return _angles(_product(_tangents(pitch), (1 / cosine[1], 1 / cosine[0])))


def rotation_at(theta: Floats, attitude: Attitude) -> tuple[Floats, Floats, Floats]:
    """(a, b, c) of cameras that look down by `theta`, any shape, with the attitude's own roll and yaw. For drawing: no interval."""
    tangent, psi = np.tan(theta), attitude.yaw_rad
    c = np.arctan(tangent / math.cos(psi))
    b = np.arctan(-np.cos(c) * math.tan(psi))
    return np.arctan(np.sin(b) * np.tan(c)) - attitude.roll_rad, b, c


def lead(seen_pitch: Floats, pitch: Floats, yaw: Floats) -> Floats:
    """Interval of c - theta, (sets, 2), for a pitch c that the ideal frame shows and the camera's theta, in these intervals at this yaw.

    sin(c - theta) = cos(theta) sin(c) (1 - cos(psi)).
    """
    low, high = _cosines(yaw)
    share = np.maximum(lowered(1 - high, 1.0), 0), raised(1 - low, 1.0)
    sine = cosine_and_sine(seen_pitch)[1]
    sine = _product((lowered(sine[:, 0], np.abs(sine[:, 0])), raised(sine[:, 1], np.abs(sine[:, 1]))), _product(_cosines(pitch), share))
    return _angles((sine[0] / np.sqrt(1 - sine[0] ** 2), sine[1] / np.sqrt(1 - sine[1] ** 2)))


def _middle(angle: Interval, terms: Floats) -> tuple[tuple[Floats, Floats], Floats]:
    """Cosine and sine of an angle within the interval, and how far the others are from it, with what rounding `terms` adds."""
    low, high = angle
    middle = (low + high) / 2
    return cosine_and_sine(middle), raised(np.maximum(high - middle, middle - low), terms)


def _cosines(angle: Floats) -> Interval:
    """Range of the cosine over intervals (sets, 2) within -pi/2 and pi/2."""
    return _cosines_and_tangents(angle)[0]


def _tangents(angle: Floats) -> Interval:
    """Range of the tangent over intervals (sets, 2) within -pi/2 and pi/2."""
    return _cosines_and_tangents(angle)[1]


def _cosines_and_tangents(angle: Floats) -> tuple[Interval, Interval]:
    """Both ranges."""
    cosine, sine = cosine_and_sine(angle)
    tangent = sine / cosine
    low, high = np.minimum(cosine[:, 0], cosine[:, 1]), np.maximum(cosine[:, 0], cosine[:, 1])
    high = np.where((angle[:, 0] <= 0) & (angle[:, 1] >= 0), 1.0, high)
    return (lowered(low, low), raised(high, high)), (
        lowered(tangent[:, 0], np.abs(tangent[:, 0])),
        raised(tangent[:, 1], np.abs(tangent[:, 1])),
    )


def _angles(tangent: Interval) -> Floats:
    """Range of the arctangent, (sets, 2)."""
    low, high = arctangent(tangent[0]), arctangent(tangent[1])
    return np.stack([lowered(low, np.abs(low)), raised(high, np.abs(high))], axis=-1)


def _product(first: Interval, second: Interval) -> Interval:
    """Range of a product, rounded outward."""
    sides = [one * other for one in first for other in second]
    low, high = np.minimum.reduce(sides), np.maximum.reduce(sides)
    return lowered(low, np.abs(low)), raised(high, np.abs(high))

"""The image of a state in rational numbers: a second, independent reading of the camera equations and of a lit pixel.

Where tan(theta/2) is rational, so are cos(theta) = (1 - t^2)/(1 + t^2) and sin(theta) = 2t/(1 + t^2), and with rational x, y and z every
end of a marking is projected without any rounding:

    X = p_x - x        down = y cos(theta) - d sin(theta)        Z = y sin(theta) + d cos(theta),        d = p_z + z
    u = u0 + F_u X/Z     v = v0 + F_v down/Z

A camera that is off is turned by rational half-angle tangents too: first yawed, then rolled. Behind a lens a marking is a curve, of which
pieces are enclosed in balls and halved until each lies in one pixel, or is shorter than anything that matters (`curved_image.py`). A pixel
is lit if a point of a closed segment lies in it; pixels are half-open, so that a point on the border of two belongs to the right or the
lower one. Nothing here is shared with the packages that build and run a model: the scene comes as the plain tables of its file, whose
float64 are taken exactly.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import flint
import numpy as np
from curved_image import BallLens, CurvedCamera
from numpy.typing import NDArray

Frame = NDArray[np.bool_]
Point = tuple[Fraction, Fraction]

SURE_RAD = 1e-12
"""Angles farther apart than this are told apart by float64, whose atan is right to some 1e-16."""
FIRST_BITS = 128
NEARLY_BESIDE = Fraction(1, 2**40)
"""Where a marking that runs from before to behind the camera is cut, as a share of what lies before it: far out of view."""


def turn(half_tangent: Fraction) -> tuple[Fraction, Fraction]:
    """Cosine and sine of the angle whose half has this tangent."""
    square = half_tangent**2
    return (1 - square) / (1 + square), 2 * half_tangent / (1 + square)


@dataclass(frozen=True)
class RationalState:
    """A state [theta, x, y, z] given by tan(theta/2) and by x, y, z in m."""

    tangent: Fraction
    x: Fraction
    y: Fraction
    z: Fraction

    @staticmethod
    def near(floats: Sequence[float] | NDArray[np.float64]) -> RationalState:
        """The rational state at [theta, x, y, z], (4,): theta within float64's spacing, the lengths exactly."""
        theta, x, y, z = map(float, floats)
        return RationalState(Fraction(math.tan(theta / 2)), Fraction(x), Fraction(y), Fraction(z))

    @property
    def floats(self) -> NDArray[np.float64]:
        """[theta, x, y, z], (4,), rounded to float64."""
        return np.array([2 * math.atan(self.tangent), self.x, self.y, self.z], dtype=np.float64)

    def within(self, lower: Sequence[float] | NDArray[np.float64], upper: Sequence[float] | NDArray[np.float64]) -> bool:
        """True if the state lies in the box [lower, upper], (4,) float64 each, borders included: decided exactly."""
        lengths = zip((self.x, self.y, self.z), map(float, lower[1:]), map(float, upper[1:]), strict=True)
        if not all(low <= value <= high for value, low, high in lengths):  # Fraction and float are compared exactly
            return False
        return angle_is_at_least(self.tangent, float(lower[0])) and angle_is_at_least(-self.tangent, -float(upper[0]))

    def __str__(self) -> str:
        return " ".join(map(str, (self.tangent, self.x, self.y, self.z)))


def angle_is_at_least(half_tangent: Fraction, bound_rad: float) -> bool:
    """True if 2 atan(half_tangent) >= bound_rad, decided exactly: by balls of more and more bits where float64 cannot tell.

    It ends: but for 0, the atan of a rational number is transcendental, and so is no float64.
    """
    nearly = 2 * math.atan(half_tangent) - bound_rad
    if abs(nearly) > SURE_RAD:
        return nearly > 0
    bits = FIRST_BITS
    while True:
        with flint.ctx.workprec(bits):
            angle = 2 * (flint.arb(half_tangent.numerator) / half_tangent.denominator).atan()
            if angle >= bound_rad:
                return True
            if angle < bound_rad:
                return False
        bits *= 2


@dataclass(frozen=True)
class Stripe:
    """A marking: the segment from (x, 0, near_z) to (x, 0, far_z), m."""

    x: Fraction
    near_z: Fraction
    far_z: Fraction


@dataclass(frozen=True)
class RunwayImage:
    """Lit pixels, as a frame (height, width) and as rows and columns in the order of the frame, all read-only."""

    frame: Frame
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]

    def __post_init__(self) -> None:
        for array in (self.frame, self.rows, self.columns):
            array.flags.writeable = False

    @property
    def flat(self) -> NDArray[np.int64]:
        """Numbers of the pixels in the flattened frame, ascending."""
        return self.rows * self.frame.shape[1] + self.columns

    def thickened(self, radius_px: int) -> Frame:
        """A frame in which everything is lit that lies within `radius_px` rows and columns of a pixel."""
        thick = np.zeros_like(self.frame)
        for row, column in zip(self.rows.tolist(), self.columns.tolist(), strict=True):
            thick[max(row - radius_px, 0) : row + radius_px + 1, max(column - radius_px, 0) : column + radius_px + 1] = True
        return thick


def _focal_lengths(camera: dict[str, Any]) -> tuple[Fraction, Fraction]:
    """F_u and F_v of a scene's table `camera`, px."""
    if "focal_px" in camera:
        return Fraction(camera["focal_px"][0]), Fraction(camera["focal_px"][1])
    focal = Fraction(camera["focal_length_m"]) / Fraction(camera["pixel_pitch_m"])
    return focal, focal


@dataclass(frozen=True)
class RationalView:
    """A camera and what it looks at. `roll` and `yaw` are the tangents of half the angles by which the camera is off."""

    width: int
    height: int
    focal_u: Fraction
    focal_v: Fraction
    u0: Fraction
    v0: Fraction
    stripes: tuple[Stripe, ...]
    roll: Fraction = Fraction(0)
    yaw: Fraction = Fraction(0)
    lens: BallLens | None = None
    """What distorts the rays; all else of the view is as without it."""

    @staticmethod
    def of(tables: dict[str, Any]) -> RationalView:
        """The view of a scene's tables, as a scene file or a model's metadata have them."""
        camera = tables["camera"]
        u0, v0 = camera.get("principal_point") or (Fraction(camera["width"], 2), Fraction(camera["height"], 2))
        stripes = []
        for marking in tables["runway"]["markings"]:
            start = Fraction(marking["start_z_m"])
            stripes.append(Stripe(Fraction(marking["x_m"]), start, start + Fraction(marking["length_m"])))
        focal = _focal_lengths(camera)
        lens = BallLens.of(camera["distortion"]) if "distortion" in camera else None
        return RationalView(camera["width"], camera["height"], *focal, Fraction(u0), Fraction(v0), tuple(stripes), lens=lens)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of a frame."""
        return self.height, self.width

    def project(self, state: RationalState, p_x: Fraction, p_z: Fraction) -> Point:
        """(u, v) of the ground point (p_x, 0, p_z), px. Raises ValueError where it is not in front of the camera."""
        right, down, depth = self.in_camera(state, p_x, p_z)
        if depth <= 0:
            raise ValueError("the point lies behind the camera")
        return self.u0 + self.focal_u * right / depth, self.v0 + self.focal_v * down / depth

    def in_camera(self, state: RationalState, p_x: Fraction, p_z: Fraction) -> tuple[Fraction, Fraction, Fraction]:
        """The ground point in the camera's frame: to the right, down and ahead, m."""
        cosine, sine = turn(state.tangent)
        ahead = p_z + state.z
        right, down, depth = p_x - state.x, state.y * cosine - ahead * sine, state.y * sine + ahead * cosine
        if self.yaw:
            cosine, sine = turn(self.yaw)
            right, depth = right * cosine - depth * sine, right * sine + depth * cosine
        if self.roll:
            cosine, sine = turn(self.roll)
            right, down = right * cosine - down * sine, right * sine + down * cosine
        return right, down, depth

    def aside(self, state: RationalState, column: Fraction, row: Fraction) -> Fraction | None:
        """How far to the right of the camera, per metre of its altitude, the ground lies that a pinhole shows there; None of the sky."""
        along_x = self.in_camera(replace(state, y=Fraction(0)), state.x + 1, -state.z)
        downward = self.in_camera(replace(state, y=Fraction(1)), state.x, -state.z)
        ray = (column - self.u0) / self.focal_u, (row - self.v0) / self.focal_v, Fraction(1)
        right, fall = (sum((one * other for one, other in zip(axis, ray, strict=True)), Fraction(0)) for axis in (along_x, downward))
        return right / fall if fall > 0 else None

    def segments(self, state: RationalState) -> list[tuple[Point, Point]]:
        """The near and the far end of each marking in the image, as far as it lies in front of the camera."""
        return [
            (self.project(state, stripe.x, near), self.project(state, stripe.x, far))
            for stripe in self.stripes
            for near, far in self._ahead(state, stripe)
        ]

    def _ahead(self, state: RationalState, stripe: Stripe) -> list[tuple[Fraction, Fraction]]:
        """The part of a stripe that lies in front of the camera, by its p_z; none if all of it is behind. The depth is affine in p_z."""
        near, far = stripe.near_z, stripe.far_z
        start, stop = self.in_camera(state, stripe.x, near)[2], self.in_camera(state, stripe.x, far)[2]
        if start > 0 and stop > 0:
            return [(near, far)]
        if start <= 0 and stop <= 0:
            return []
        beside = near - (far - near) * start / (stop - start)
        ahead = far if stop > 0 else near
        cut = beside + (ahead - beside) * NEARLY_BESIDE
        return [(cut, far) if stop > 0 else (near, cut)]

    def image(self, state: RationalState) -> RunwayImage:
        """Every pixel of the frame that a marking meets."""
        frame = np.zeros(self.shape, dtype=np.bool_)
        if self.lens is None:
            for start, stop in self.segments(state):
                for row, first, last in lit_columns(start, stop, self.height):
                    frame[row, max(first, 0) : max(last + 1, 0)] = True
        else:
            for start, stop in self._rays(state):
                frame[self._curved.met(start, stop)] = True
        return RunwayImage(frame, *np.nonzero(frame))

    @functools.cached_property
    def _curved(self) -> CurvedCamera:
        """The camera as what shows rays through its lens."""
        assert self.lens is not None
        return CurvedCamera(self.lens, self.width, self.height, (self.focal_u, self.focal_v), (self.u0, self.v0))

    def _rays(self, state: RationalState) -> list[tuple[Point, Point]]:
        """Right and down per depth of the near and the far end of each marking, as far as it lies in front of the camera."""
        ends = [[self.in_camera(state, stripe.x, p_z) for p_z in part] for stripe in self.stripes for part in self._ahead(state, stripe)]
        rays = [[(right / depth, down / depth) for right, down, depth in pair] for pair in ends]
        return [(near, far) for near, far in rays]


def lit_columns(start: Point, stop: Point, height: int) -> Iterator[tuple[int, int, int]]:
    """(row, first column, last column) of the pixels that a closed segment meets, for rows 0 to height - 1, exactly.

    In row r lie the points with r <= v < r + 1. On a line u = base + slope v all columns are quotients of integers with one denominator.
    """
    (u_top, v_top), (u_bottom, v_bottom) = sorted((start, stop), key=lambda point: point[1])
    slope = (u_bottom - u_top) / (v_bottom - v_top) if v_bottom > v_top else Fraction(0)
    base = u_top - slope * v_top
    common = math.lcm(base.denominator, slope.denominator, u_top.denominator, u_bottom.denominator)
    base_units, slope_units, top_units, bottom_units = (int(value * common) for value in (base, slope, u_top, u_bottom))
    first_row, last_row = math.floor(v_top), math.floor(v_bottom)
    for row in range(max(first_row, 0), min(last_row, height - 1) + 1):
        enters = top_units if row == first_row else base_units + slope_units * row
        leaves = bottom_units if row == last_row else base_units + slope_units * (row + 1)
        last = max(enters, leaves)
        if row < last_row and leaves > enters:
            last -= 1  # the point on the row's lower border belongs to the next row: the largest unit short of it
        yield row, min(enters, leaves) // common, last // common

"""What a camera may see of a runway, drawn at random: the rows where markings end, and the columns where they pass.

A sight is drawn for a *place*: markings wholly in view, within one row of pixels, cut by a border of the frame, ending a million rows below
it. Altitude and pitch follow from the place, and where the markings lie on the ground from their rows and columns (`runtime.camera`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from runtime.camera import ground_scale
from runtime.scene import Camera

Rng = np.random.Generator
Floats = NDArray[np.float64]

WIDTH_PX, HEIGHT_PX = (32, 2000), (32, 1500)
FOCAL_WIDTHS = (0.6, 8.0)
ALTITUDE_M = (0.3, 300.0)
FARTHEST_M = 3000.0
STRAIGHT_DOWN_RAD = math.pi / 2 - 2e-6
"""Steepest angle below the horizon at which a marking ends."""


class UndrawableError(ValueError):
    """A draw that contradicts itself: another one is needed."""


@dataclass(frozen=True)
class Outlook:
    """A camera at an altitude y and a pitch theta: what lies in a row of its image. Angles psi are below the horizon, rad."""

    camera: Camera
    theta: float
    y: float

    @property
    def flattest(self) -> float:
        """The angle at which the farthest ground lies that a marking may reach."""
        return math.atan2(self.y, FARTHEST_M)

    def angle(self, row: float) -> float:
        """psi of a row."""
        return self.theta + angle_in_image(self.camera, row)

    def row(self, angle: float) -> float:
        """The row of a psi."""
        return self.camera.v0 + self.camera.focal_v_px * math.tan(angle - self.theta)

    def distance(self, row: float) -> float:
        """How far ahead the ground of a row lies, m."""
        return self.y / math.tan(self.angle(row))

    def scale(self, row: float) -> float:
        """px per metre across the runway at a row."""
        return float(ground_scale(self.camera, self.theta, self.y, row))

    def on_ground(self, far: float, near: float) -> tuple[float, float]:
        """The rows of a marking's ends, moved onto ground neither too far nor behind. Raises `UndrawableError` if there is none."""
        psi_far, psi_near = max(self.angle(far), self.flattest), min(self.angle(near), STRAIGHT_DOWN_RAD)
        if not psi_far < psi_near:
            raise UndrawableError("no ground there")
        return self.row(psi_far), self.row(psi_near)


@dataclass(frozen=True)
class Sight:
    """What a camera sees: the rows (far, near) of every marking's ends, and the column it passes through at a row in view."""

    outlook: Outlook
    rows: list[tuple[float, float]]
    columns: list[float]
    steadiness_px: float = math.inf
    """By how much the ends may move over the whole domain."""
    few_sets: bool = False
    """The domain is one cell of a few bins: few sets of states are all there is to refine."""

    def in_view(self, marking: int) -> tuple[float, float] | None:
        """The rows of a marking that are in view, first and last; None if none are."""
        far, near = self.rows[marking]
        top, bottom = max(far, 0.0), min(near, float(self.outlook.camera.height))
        return (top, bottom) if top < bottom else None

    def anchor(self, marking: int) -> float:
        """The row in which the marking passes through its column."""
        seen = self.in_view(marking)
        return sum(seen) / 2 if seen else sum(self.rows[marking]) / 2

    @property
    def across(self) -> Floats:
        """p_x - x of every marking, m."""
        camera = self.outlook.camera
        anchors = [self.anchor(marking) for marking in range(len(self.rows))]
        return np.array([(u - camera.u0) / self.outlook.scale(row) for u, row in zip(self.columns, anchors, strict=True)])

    @property
    def ahead(self) -> Floats:
        """Distances of every marking's near and far end, (markings, 2) m."""
        return np.array([[self.outlook.distance(near), self.outlook.distance(far)] for far, near in self.rows])


ASPECTS = (0.9, 1.1)
"""F_u in units of F_v, where pixels are not square."""
Place = Callable[[Rng, Camera, int], Sight]


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def angle_in_image(camera: Camera, row: float) -> float:
    """The angle of a row below the camera's axis, rad."""
    return math.atan((row - camera.v0) / camera.focal_v_px)


# --- places ---


def columns_of(rng: Rng, camera: Camera, count: int) -> list[float]:
    """Columns of markings: the first in view, the others nearly so."""
    return [rng.uniform(0.02, 0.98) * camera.width, *(rng.uniform(-0.3, 1.3, count - 1) * camera.width)]


def alike_or_not(rng: Rng, count: int, one: Callable[[], tuple[float, float]]) -> list[tuple[float, float]]:
    """The ends of all markings: the same, or each its own."""
    return [one()] * count if rng.random() < 0.5 else [one() for _ in range(count)]


def outlook_at(rng: Rng, camera: Camera, row: float) -> Outlook:
    """A camera that sees ground in a row."""
    y = log_uniform(rng, *ALTITUDE_M)
    psi = log_uniform(rng, max(1.5 * math.atan2(y, FARTHEST_M), 1e-3), 1.5)
    theta = psi - angle_in_image(camera, row)
    if abs(theta) > STRAIGHT_DOWN_RAD:
        raise UndrawableError("a camera that looks behind itself")
    return Outlook(camera, theta, y)


def in_view(rng: Rng, camera: Camera, count: int) -> Sight:
    """Markings about a row in view, from a few rows long to more than the frame."""
    row = rng.uniform(0.05, 0.95) * camera.height
    outlook = outlook_at(rng, camera, row)
    extent = log_uniform(rng, 2, 1.5 * camera.height)
    rows = alike_or_not(rng, count, lambda: outlook.on_ground(row - extent * rng.random(), row + extent * rng.random()))
    return Sight(outlook, rows, columns_of(rng, camera, count))


def few_rows(rng: Rng, camera: Camera, count: int, rows: int) -> Sight:
    """All markings within one row of pixels, or two."""
    row = int(rng.integers(camera.height - rows + 1))
    outlook = outlook_at(rng, camera, row + 0.5)

    def span() -> tuple[float, float]:
        far, near = np.sort(rng.uniform(0.02, 0.98, 2))
        if near - far < 0.05:
            raise UndrawableError("too short a marking")
        return outlook.on_ground(row + rows * far, row + rows * near)

    return Sight(outlook, alike_or_not(rng, count, span), columns_of(rng, camera, count), steadiness_px=0.1 * 10 ** rng.uniform(-2, 1))


def horizon(rng: Rng, camera: Camera, count: int) -> Sight:
    """The horizon is in view, and markings end just below it."""
    y = log_uniform(rng, *ALTITUDE_M)
    row = rng.uniform(0, 0.8) * camera.height
    outlook = Outlook(camera, -angle_in_image(camera, row), y)
    below = camera.height - row

    def span() -> tuple[float, float]:
        far = outlook.row(outlook.flattest * log_uniform(rng, 1, 10))
        return outlook.on_ground(far, far + below * rng.uniform(0.05, 1.5))

    return Sight(outlook, alike_or_not(rng, count, span), columns_of(rng, camera, count))


def straight_down(rng: Rng, camera: Camera, count: int) -> Sight:
    """The camera looks down, up to a hair; the ground below it is in view."""
    theta = math.pi / 2 - log_uniform(rng, 4e-6, 0.3)
    outlook = Outlook(camera, theta, log_uniform(rng, *ALTITUDE_M))
    top, bottom = 0.0, min(float(camera.height), outlook.row(STRAIGHT_DOWN_RAD))

    def span() -> tuple[float, float]:
        far, near = np.sort(rng.uniform(-0.2, 1.2, 2)) * (bottom - top) + top
        return outlook.on_ground(far, near)

    return Sight(outlook, alike_or_not(rng, count, span), columns_of(rng, camera, count))


def near_end_far_below(rng: Rng, camera: Camera, count: int, least: float = 1e3, most: float = 1e8) -> Sight:
    """Near ends lie `least` to `most` rows below the frame, beside the camera's plane; far ends are in view."""
    below = log_uniform(rng, least, most)
    spare = math.pi / 2 - angle_in_image(camera, below)
    lowest = angle_in_image(camera, camera.height)
    theta = spare * rng.uniform(0, 0.95) if rng.random() < 0.5 else rng.uniform(-min(max(0.9 * lowest, 0.0), 0.8), 0)
    outlook = Outlook(camera, theta, log_uniform(rng, *ALTITUDE_M))

    def span() -> tuple[float, float]:
        far = outlook.row(max(rng.uniform(0, 1) * outlook.angle(camera.height), outlook.flattest))
        return outlook.on_ground(far, below * rng.uniform(0.5, 1))

    return Sight(outlook, alike_or_not(rng, count, span), columns_of(rng, camera, count))


def near_end_a_million_rows_below(rng: Rng, camera: Camera, _count: int) -> Sight:
    """One marking whose near end lies 10^6 rows below the frame, or a few times that, in a domain of few sets of states."""
    return replace(near_end_far_below(rng, camera, 1, least=1e6, most=1e7), few_sets=True)


def far_end_far_above(rng: Rng, camera: Camera, count: int) -> Sight:
    """The camera looks down; far ends lie 10^3 to 10^7 rows above the frame, near ends are in view."""
    above = log_uniform(rng, 1e3, 1e7)
    spare = math.pi / 2 + angle_in_image(camera, -above)
    theta = math.pi / 2 - spare * rng.uniform(0.02, 0.7)
    flattest = theta + angle_in_image(camera, -above)
    highest = FARTHEST_M * math.tan(flattest)
    if highest < ALTITUDE_M[0]:
        raise UndrawableError("too low an altitude")
    outlook = Outlook(camera, theta, log_uniform(rng, ALTITUDE_M[0], min(highest, ALTITUDE_M[1])))
    bottom = min(float(camera.height), outlook.row(STRAIGHT_DOWN_RAD))
    rows = alike_or_not(rng, count, lambda: outlook.on_ground(-above * rng.uniform(1, 2), bottom * rng.uniform(0.05, 1.1)))
    return Sight(outlook, rows, columns_of(rng, camera, count))


def cut_by_borders(rng: Rng, camera: Camera, count: int) -> Sight:
    """Markings that the frame's borders cut, often so that little is left of them."""
    left_in_view = log_uniform(rng, 0.3, camera.height)
    up = rng.random() < 0.5
    row = left_in_view if up else camera.height - left_in_view
    outlook = outlook_at(rng, camera, float(np.clip(row, 0, camera.height)))
    beyond = camera.height * log_uniform(rng, 0.05, 20)
    rows = alike_or_not(
        rng,
        count,
        lambda: outlook.on_ground(
            -beyond if up else row * rng.uniform(0.9, 1), row * rng.uniform(0.9, 1) if up else camera.height + beyond
        ),
    )
    border = rng.choice([0.0, camera.width])
    columns = columns_of(rng, camera, count)
    columns[0] = border + rng.normal() * log_uniform(rng, 0.3, 30) if rng.random() < 0.7 else columns[0]
    return Sight(outlook, rows, columns)


PLACES: dict[str, tuple[float, Place]] = {
    "in view": (0.22, in_view),
    "within one row": (0.08, functools.partial(few_rows, rows=1)),
    "within two rows": (0.06, functools.partial(few_rows, rows=2)),
    "horizon in view": (0.15, horizon),
    "looking straight down": (0.12, straight_down),
    "near end far below": (0.1, near_end_far_below),
    "near end a million rows below": (0.05, near_end_a_million_rows_below),
    "far end far above": (0.09, far_end_far_above),
    "cut by borders": (0.13, cut_by_borders),
}
"""How often each place is drawn, and how."""


def draw_camera(rng: Rng) -> Camera:
    """A frame of any size, a lens of any length, a principal point in the middle, off it, or out of the frame, pixels square or not."""
    width, height = (round(log_uniform(rng, *sides)) for sides in (WIDTH_PX, HEIGHT_PX))
    pitch = log_uniform(rng, 1e-6, 1e-4)
    camera = Camera(width, height, width * log_uniform(rng, *FOCAL_WIDTHS) * pitch, pitch)
    if rng.random() < 0.4:
        focal_v_px = camera.focal_v_px
        camera = Camera(width, height, focal_px=(focal_v_px * log_uniform(rng, *ASPECTS), focal_v_px))
    off = rng.choice([0.0, 0.3, 1.5], p=[0.5, 0.35, 0.15])
    if off == 0.0:
        return camera
    u0, v0 = (side / 2 + side * float(off) * rng.uniform(-1, 1) for side in (width, height))
    return replace(camera, principal_point=(u0, v0))


def mirrored(rng: Rng, sight: Sight) -> Sight:
    """Now and then, two markings that mirror each other about the principal column, with the same ends."""
    camera = sight.outlook.camera
    if len(sight.rows) != 2 or rng.random() < 0.7:
        return sight
    return replace(sight, rows=[sight.rows[0]] * 2, columns=[sight.columns[0], 2 * camera.u0 - sight.columns[0]])

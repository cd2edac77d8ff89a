"""The map between a sensor's own pixels and the ideal frame, that of the pinhole of `runtime.camera` for which NN_F is built.

A ray (x, y, 1) of the ideal frame, right, down and forward, is the sensor's ray R_z(a) R_y(b) (x, y, 1); a lens shows that one at D
(`runtime.lens`), in column u0 + F_u D_x and row v0 + F_v D_y of the sensor. Back again:

    (s, t) = D^-1((column - u0)/F_u, (row - v0)/F_v)            a table, made once
    (s', t') = (s cos(a) + t sin(a), t cos(a) - s sin(a))
    x = (s' - tan(b)) / (1 + s' tan(b))      y = t' / (cos(b) + s' sin(b))

a and b are intervals, and so are the sensor's focal lengths and principal point where the scene's `[calibration]` has a plus-minus:
every result is an outward interval that holds what any of them gives.

The *ideal frame* has the sensor's focal lengths, and the whole columns and rows, counted from the principal point, that hold what the
sensor shows of the runway in any state of the domain. Nothing of a certificate rests on this choice: a marking's part that lies out of
the ideal frame is not looked for.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from runtime.lens import Lens
from runtime.refine.interval import Floats, Interval
from runtime.rounding import ROUNDING_SHARE
from runtime.scene import MARGIN_PX, Calibration, Camera, Scene, SceneError
from runtime.turn import cosine_and_sine

Integers = NDArray[np.int64]
Angle = tuple[float, float]
"""The least and the largest value of an angle, rad."""

BEYOND_RUNWAY_PX = 4
"""Columns and rows of the ideal frame on every side of what the runway can reach."""
LARGEST_ANGLE_RAD, EDGES_BEYOND = 1.4, 1.25
"""Rays farther off the axis are not told apart, and how far beyond those that are needed an edge is looked for that begins within them."""
LEAST_DEPTH = 2.0**-8
"""A ray whose depth in the other frame is not certainly above this, per unit of its own, counts as not seen there."""


@dataclass(frozen=True)
class Turn:
    """Rotations R_z(a) R_y(b): middles with cosine and sine, and half-widths, rounded up."""

    a: tuple[float, float, float]
    """Cosine and sine of the middle, half-width."""
    b: tuple[float, float, float]

    @staticmethod
    def of(a: Angle, b: Angle) -> Turn:
        """From the least and the largest angles. Raises ValueError where one is inverted or beyond a quarter turn."""
        return Turn(*(_middle(name, angle) for name, angle in (("a", a), ("b", b))))

    @property
    def largest_rad(self) -> float:
        """By how much it turns the axis at most: only R_y(b) does."""
        return math.atan2(abs(self.b[1]), self.b[0]) + self.b[2] + ROUNDING_SHARE


def _middle(name: str, angle: Angle) -> tuple[float, float, float]:
    low, high = (float(side) for side in angle)
    if not -math.pi / 2 < low <= high < math.pi / 2:
        raise ValueError(f"turn: found {name} from {low} to {high} rad; give the least and the largest, within a quarter turn")
    middle = (low + high) / 2
    cosine, sine = (float(part[0]) for part in cosine_and_sine(np.array([middle])))
    return cosine, sine, max(high - middle, middle - low) * (1 + ROUNDING_SHARE) + ROUNDING_SHARE


@dataclass(frozen=True)
class SensorMap:
    """The map of one sensor, for one interval of rotations. Make it with `of`, and others of the same sensor with `turned`."""

    camera: Camera
    """The sensor's."""
    ideal: Camera
    calibration: Calibration
    lens: Lens
    turn: Turn | None
    rays: tuple[Floats, Floats, Floats]
    """Of every corner of the sensor's pixels, (height + 1, width + 1) each: the lens's ray (s, t), and how far from it the true one is."""

    @staticmethod
    def of(scene: Scene, turn: tuple[Angle, Angle] | None = None) -> SensorMap:
        """The map of a scene's camera, for rotations with a and b within the intervals of `turn`.

        Without `turn` there is none but the plus-minus of roll and yaw of the scene's calibration; who gives one includes them. Raises
        `SceneError` for a lens that folds within the frame.
        """
        camera, off = scene.camera, scene.calibration
        lens = lens_of(camera, off)
        rays = corner_rays(camera, lens, off)
        still = SensorMap(camera, ideal_camera(scene), off, lens, None, rays)
        if turn is None and (off.roll_rad or off.yaw_rad):
            turn = (-off.roll_rad, off.roll_rad), (-off.yaw_rad, off.yaw_rad)
        return still if turn is None else still.turned(turn)

    def turned(self, turn: tuple[Angle, Angle]) -> SensorMap:
        """The same sensor's map for other rotations; its lens's table is shared."""
        return dataclasses.replace(self, turn=Turn.of(*turn))

    def corners(self, rows: Integers, columns: Integers) -> tuple[Interval, Interval]:
        """(u, v) in the ideal frame of pixels' corners: `rows` from 0 to the sensor's height and `columns` from 0 to its width, any shape.

        Closed intervals, px, over all rotations and calibrations; without bounds where the corner is not certainly seen.
        """
        x, y, off = (table[rows, columns] for table in self.rays)
        (x, x_off), (y, y_off) = ((x, off), (y, off)) if self.turn is None else _ideal_rays(self.turn, x, y, off)
        return _pixels(x, x_off, self.ideal.focal_u_px, self.ideal.u0), _pixels(y, y_off, self.ideal.focal_v_px, self.ideal.v0)

    def to_sensor(self, u: Interval, v: Interval) -> tuple[Interval, Interval]:
        """(column, row) of the sensor, px: an outward enclosure of what it shows of boxes of the ideal frame, of any shape.

        Without bounds where the box is not certainly within the disc of the lens (`Lens.radius`).
        """
        x, y = self._lens_rays(u, v)
        farthest = np.sqrt(np.maximum(-x[0], x[1]) ** 2 + np.maximum(-y[0], y[1]) ** 2) * (1 + ROUNDING_SHARE)
        seen = farthest <= self.lens.radius
        x, y = ((np.where(seen, side[0], 0.0), np.where(seen, side[1], 0.0)) for side in (x, y))
        shown = self.lens.shown_range(x, y)
        camera, off = self.camera, self.calibration
        column, row = (
            _shown(side, focal, centre, off)
            for side, focal, centre in zip(shown, (camera.focal_u_px, camera.focal_v_px), (camera.u0, camera.v0), strict=True)
        )
        return _where(seen, column), _where(seen, row)

    def lens_rays(self, u: Floats, v: Floats) -> tuple[Interval, Interval]:
        """(s, t): an outward enclosure of the rays that the lens is given of points of the ideal frame; without bounds where not seen."""
        return self._lens_rays((u, u), (v, v))

    def _lens_rays(self, u: Interval, v: Interval) -> tuple[Interval, Interval]:
        x, y = _tangents(u, self.ideal.focal_u_px, self.ideal.u0), _tangents(v, self.ideal.focal_v_px, self.ideal.v0)
        return (x, y) if self.turn is None else _sensor_rays(self.turn, x, y)

    @cached_property
    def bow_px(self) -> float:
        """Bound, in px of the ideal frame, on how far the image of a pixel's edge lies from the segment between its corners' images.

        A lens bends an edge of length h by h^2/8 of its curvature, and a rotation, which keeps lines straight, magnifies that by 1 + M^2
        at most where the ideal frame shows M. The curvature is that of the rays which the ideal frame can show, and of an edge beyond.
        """
        if self.lens.model is None:
            return 0.0
        camera, ideal = self.camera, self.ideal
        edge = 1 / (min(camera.focal_u_px, camera.focal_v_px) * (1 - self.calibration.focal_relative))
        across = max(abs(ideal.u0), abs(ideal.width - ideal.u0)) / ideal.focal_u_px
        down = max(abs(ideal.v0), abs(ideal.height - ideal.v0)) / ideal.focal_v_px
        magnified = 1.0 if self.turn is None else 1 + across**2 + down**2 + 2.0**-4
        angle = math.atan(math.hypot(across, down)) + (0.0 if self.turn is None else self.turn.largest_rad)
        needed = math.tan(angle) if angle < LARGEST_ANGLE_RAD else self.lens.radius
        beyond = EDGES_BEYOND * needed
        if needed + 2 * edge / self.lens.stretch_within(beyond) > beyond:
            beyond = self.lens.radius
        return max(ideal.focal_u_px, ideal.focal_v_px) * edge**2 / 8 * self.lens.curvature_within(beyond) * magnified * (1 + ROUNDING_SHARE)

    def project(self, points: Floats, a: float = 0.0, b: float = 0.0) -> Floats:
        """Where the sensor shows points (..., 2), (u, v) px, of the ideal frame at one rotation: (..., 2), (column, row) px.

        For drawing: exact up to float64 for the scene's own calibration; no enclosure, and nonsense beyond the lens's disc.
        """
        x, y = (points[..., 0] - self.ideal.u0) / self.ideal.focal_u_px, (points[..., 1] - self.ideal.v0) / self.ideal.focal_v_px
        right, down, depth = x * math.cos(b) + math.sin(b), y, math.cos(b) - x * math.sin(b)
        right, down = right * math.cos(a) - down * math.sin(a), right * math.sin(a) + down * math.cos(a)
        shown_x, shown_y = self.lens.distorted(right / depth, down / depth)
        camera = self.camera
        return np.stack([camera.u0 + camera.focal_u_px * shown_x, camera.v0 + camera.focal_v_px * shown_y], axis=-1)


def lens_of(camera: Camera, off: Calibration) -> Lens:
    """The lens of a camera, over all that its frame may show. Raises `SceneError` if it folds there."""
    zoom = 1 - off.focal_relative
    across = (max(abs(camera.u0), abs(camera.width - camera.u0)) + off.principal_px) / (camera.focal_u_px * zoom)
    down = (max(abs(camera.v0), abs(camera.height - camera.v0)) + off.principal_px) / (camera.focal_v_px * zoom)
    return Lens.of(camera.distortion, math.hypot(across, down) * (1 + ROUNDING_SHARE))


def corner_rays(camera: Camera, lens: Lens, off: Calibration | None = None) -> tuple[Floats, Floats, Floats]:
    """Of every corner of the sensor's pixels, (height + 1, width + 1) each: the lens's ray (s, t), and how far from it the true one is."""
    columns, rows = np.meshgrid(np.arange(camera.width + 1.0), np.arange(camera.height + 1.0))
    rays = _rays(camera, off or Calibration(), lens, columns, rows)
    for array in rays:
        array.flags.writeable = False
    return rays


def ideal_camera(scene: Scene) -> Camera:
    """The ideal frame of a scene's camera: the camera itself where that is a pinhole.

    Raises `SceneError` if the sensor shows nothing of the runway in any state of the domain, or the lens folds.
    """
    camera = scene.camera
    if camera.pinhole:
        return dataclasses.replace(camera, distortion=None, mount=None)
    sees, shows = _seen_by_sensor(camera, scene.calibration), _reached_by_runway(scene)
    sides = []
    for (low, high), (least, most), focal in zip(sees, shows, (camera.focal_u_px, camera.focal_v_px), strict=True):
        sides.append(
            (math.floor(max(low * focal, least * focal - BEYOND_RUNWAY_PX)), math.ceil(min(high * focal, most * focal + BEYOND_RUNWAY_PX)))
        )
    (left, right), (top, bottom) = sides
    if right <= left or bottom <= top:
        raise SceneError(
            "camera: found a sensor that shows nothing of the runway in any state; turn it, or change [domain] or [[runway.markings]]"
        )
    focal_px = camera.focal_u_px, camera.focal_v_px
    return Camera(right - left, bottom - top, principal_point=(float(-left), float(-top)), focal_px=focal_px)


def runway_beyond(scene: Scene) -> bool:
    """False if the frame of a scene's pinhole certainly holds every point of the runway, in every state of the domain."""
    camera, ((left, right), (top, bottom)) = scene.camera, _reached_by_runway(scene)
    least = camera.u0 + camera.focal_u_px * left, camera.v0 + camera.focal_v_px * top
    most = camera.width - camera.u0 - camera.focal_u_px * right, camera.height - camera.v0 - camera.focal_v_px * bottom
    return not min(*least, *most) > MARGIN_PX


def _seen_by_sensor(camera: Camera, off: Calibration) -> tuple[Angle, Angle]:
    """The least and the largest x and y of the rays that the sensor's border shows within the lens's disc."""
    lens = lens_of(camera, off)
    columns, rows = np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)
    around_u = np.concatenate([columns, columns, 0 * rows, 0 * rows + camera.width])
    around_v = np.concatenate([0 * columns, 0 * columns + camera.height, rows, rows])
    x, y, distance = _rays(camera, off, lens, around_u, around_v)
    seen = np.isfinite(distance)
    if not lens.whole:
        return (-lens.radius, lens.radius), (-lens.radius, lens.radius)
    return (float(x[seen].min()), float(x[seen].max())), (float(y[seen].min()), float(y[seen].max()))


def _reached_by_runway(scene: Scene) -> tuple[Angle, Angle]:
    """Bounds on x and y of all rays to the markings, in any state of the domain; infinite where one may lie beside the camera.

    Rows rise in y and fall in theta and z (`runtime.camera`); columns are the range of X over that of Z, and those of a marking's inner
    points lie between those of its ends.
    """
    (theta_low, x_low, y_low, z_low), (theta_high, x_high, y_high, z_high) = scene.domain.lower.tolist(), scene.domain.upper.tolist()
    near, far = float(scene.runway.ends_z_m.min()) + z_low, float(scene.runway.ends_z_m.max()) + z_high
    rows = [math.tan(math.atan2(y, d) - theta) for y, d, theta in ((y_low, far, theta_high), (y_high, near, theta_low))]
    depths = [y * math.sin(theta) + d * math.cos(theta) for y in (y_low, y_high) for d in (near, far) for theta in (theta_low, theta_high)]
    nearest, farthest = min(depths), math.hypot(y_high, far)
    left, right = float(scene.runway.x_m.min()) - x_high, float(scene.runway.x_m.max()) - x_low
    columns = min(left / nearest, left / farthest), max(right / nearest, right / farthest)
    return columns, (rows[0], rows[1])


def _rays(camera: Camera, off: Calibration, lens: Lens, columns: Floats, rows: Floats) -> tuple[Floats, Floats, Floats]:
    """The lens's rays at points of the sensor, px, and how far from them the true ones are at most."""
    x, y = (columns - camera.u0) / camera.focal_u_px, (rows - camera.v0) / camera.focal_v_px
    moved_x, moved_y = (
        (np.abs(side) * off.focal_relative + off.principal_px / focal) / (1 - off.focal_relative)
        for side, focal in ((x, camera.focal_u_px), (y, camera.focal_v_px))
    )
    rounding = ROUNDING_SHARE * (1 + np.abs(x) + np.abs(y) + (abs(camera.u0) + abs(camera.v0)) / min(camera.focal_u_px, camera.focal_v_px))
    return lens.undistorted(x, y, np.sqrt(moved_x**2 + moved_y**2) * (1 + ROUNDING_SHARE) + rounding)


def _ideal_rays(turn: Turn, s: Floats, t: Floats, off: Floats) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """R_y(-b) R_z(-a) of the sensor's rays, each within `off` of (s, t): x with how far it is off at most, and y; infinite if not seen.

    About the middles of a and b. The rest of a, at most h, moves a coordinate by no more than h of the other and h^2/2 of itself. At the
    middle b, z = s' sin(b) + cos(b), a change e of s' and f of t' changes x by e/(z z') and y by (f - y e sin(b))/z'. The rest of b, of
    tangent w at most, then changes x by w (1 + x^2)/(1 - |x| w) and y by |y| (|x| w + h^2)/(1 - |x| w) at most.
    """
    (cosine_a, sine_a, half_a), (cosine_b, sine_b, half_b) = turn.a, turn.b
    aside, down = s * cosine_a + t * sine_a, t * cosine_a - s * sine_a
    rounding = 8 * ROUNDING_SHARE * (1 + np.abs(s) + np.abs(t)) + off
    aside_off = half_a * np.abs(down) + half_a**2 / 2 * np.abs(aside) + rounding
    down_off = half_a * np.abs(aside) + half_a**2 / 2 * np.abs(down) + rounding
    z = aside * sine_b + cosine_b
    nearest = z - aside_off * (abs(sine_b) + ROUNDING_SHARE)
    tangent = half_b * (1 + half_b**2)
    ahead = nearest > LEAST_DEPTH
    z, nearest = np.where(ahead, z, 1.0), np.where(ahead, nearest, 1.0)
    aside_off, down_off = np.where(ahead, aside_off, 0.0), np.where(ahead, down_off, 0.0)
    x, y = (aside * cosine_b - sine_b) / z, down / z
    x_off, y_off = aside_off / (z * nearest), (down_off + np.abs(y) * aside_off * abs(sine_b)) / nearest
    x_size, y_size = np.abs(x) + x_off, np.abs(y) + y_off
    left = 1 - x_size * tangent
    seen = ahead & (left > LEAST_DEPTH)
    left = np.where(seen, left, 1.0)
    x_off = x_off + tangent * (1 + x_size**2) / left
    y_off = y_off + y_size * (x_size * tangent + half_b**2) / left
    x_off, y_off = (
        np.where(seen, side * (1 + 2.0**-40) + 8 * ROUNDING_SHARE * (1 + np.abs(at)), np.inf) for side, at in ((x_off, x), (y_off, y))
    )
    return (x, x_off), (y, y_off)


def _sensor_rays(turn: Turn, x: Interval, y: Interval) -> tuple[Interval, Interval]:
    """Outward enclosure of R_z(a) R_y(b) of boxes of the ideal frame's rays; without bounds where one may not be seen."""
    (cosine_a, sine_a, half_a), (cosine_b, sine_b, half_b) = turn.a, turn.b
    (x_low, x_high), (y_low, y_high) = x, y
    far_x, far_y = np.maximum(-x_low, x_high), np.maximum(-y_low, y_high)
    margin = 4 * ROUNDING_SHARE * (1 + far_x + far_y)
    turned_x = half_b * (1 + far_x) * (1 + half_b) + margin  # what the rest of b moves a coordinate by at most
    depth = (
        np.minimum(-x_low * sine_b, -x_high * sine_b) + cosine_b - turned_x,
        np.maximum(-x_low * sine_b, -x_high * sine_b) + cosine_b + turned_x,
    )
    seen = depth[0] > LEAST_DEPTH
    near, distant = np.where(seen, depth[0], 1.0), np.where(seen, depth[1], 1.0)
    # At the middle b, the column (x c + s) / (c - x s) rises in x; the rest of b moves a quotient p/z by |dp| + |p/z| |dz| over z.
    middle_low, middle_high = ((side * cosine_b + sine_b) / np.where(seen, cosine_b - side * sine_b, 1.0) for side in (x_low, x_high))
    sway = (turned_x + np.maximum(np.abs(middle_low), np.abs(middle_high)) * turned_x) / near
    s = middle_low - sway, middle_high + sway
    t = np.minimum(y_low / near, y_low / distant), np.maximum(y_high / near, y_high / distant)
    # At the middle a; the rest of it, at most h, moves a coordinate by no more than h of the other there and h^2/2 of itself.
    column = _scaled(s, cosine_a)[0] + _scaled(t, -sine_a)[0], _scaled(s, cosine_a)[1] + _scaled(t, -sine_a)[1]
    row = _scaled(s, sine_a)[0] + _scaled(t, cosine_a)[0], _scaled(s, sine_a)[1] + _scaled(t, cosine_a)[1]
    column_size, row_size = (np.maximum(np.abs(side[0]), np.abs(side[1])) for side in (column, row))
    rounding = 8 * ROUNDING_SHARE * (1 + column_size + row_size)
    column_rest = half_a * row_size + half_a**2 / 2 * column_size + rounding
    row_rest = half_a * column_size + half_a**2 / 2 * row_size + rounding
    column, row = (column[0] - column_rest, column[1] + column_rest), (row[0] - row_rest, row[1] + row_rest)
    return _where(seen, column), _where(seen, row)


def _scaled(interval: Interval, factor: float) -> Interval:
    return (interval[0] * factor, interval[1] * factor) if factor >= 0 else (interval[1] * factor, interval[0] * factor)


def _pixels(tangent: Floats, off: Floats, focal_px: float, centre: float) -> Interval:
    """Columns or rows centre + focal (tangent +- off), rounded outward."""
    middle, half = focal_px * tangent, focal_px * off
    margin = half * (1 + ROUNDING_SHARE) + ROUNDING_SHARE * (np.abs(middle) + abs(centre))
    return centre + middle - margin, centre + middle + margin


def _tangents(pixels: Interval, focal_px: float, centre: float) -> Interval:
    """(pixels - centre) / focal, rounded outward."""
    low, high = pixels
    margin = ROUNDING_SHARE * (np.abs(low) + np.abs(high) + abs(centre)) / focal_px
    return (low - centre) / focal_px - margin, (high - centre) / focal_px + margin


def _shown(side: Interval, focal_px: float, centre: float, off: Calibration) -> Interval:
    """Columns or rows that a calibrated sensor shows tangents in."""
    size = np.maximum(np.abs(side[0]), np.abs(side[1])) * focal_px
    margin = off.principal_px + size * off.focal_relative + ROUNDING_SHARE * (size + abs(centre) + 1)
    return centre + focal_px * side[0] - margin, centre + focal_px * side[1] + margin


def _where(seen: NDArray[np.bool_], interval: Interval) -> Interval:
    """The intervals, without bounds where not seen."""
    return np.where(seen, interval[0], -np.inf), np.where(seen, interval[1], np.inf)

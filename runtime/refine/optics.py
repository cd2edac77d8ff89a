"""What a lens does between the pixels of a sensor and the rays (S, T, 1) of a pinhole in its place, for the borders of its rows.

Distances here are in units of the focal lengths: a point of the sensor in column u and row v is shown at ((u - u0)/F_u, (v - v0)/F_v).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from runtime.attitude import Attitude, Turns
from runtime.lens import LARGEST_RADIUS, Lens
from runtime.refine.interval import Bits, Floats, Interval
from runtime.rounding import ROUNDING_SHARE
from runtime.scene import Calibration, Camera, Scene
from runtime.sensor_map import corner_rays, lens_of
from runtime.state_set import StateSet

ZOOMED_PX = 0.2
"""A plus-minus of the focal lengths is cut into parts, up to `MOST_PARTS`, of which none moves a corner of the frame by much more."""
MOST_PARTS = 4
STILL_PX = 0.1
"""What the plus-minus of roll and yaw moves points by is taken out of offsets (`runtime.refine.unknowns`) from here on; below, and for what
a known rotation does at a set's pitches, bounds on it are as good."""
SWAYING_PX = 0.5
"""From here on that is worth its time for a pinhole too: its boxes are narrower, in x with a pitch reference, on all axes without one."""
ROUNDED_DERIVATIVE = 2.0**-30
"""Covers what rounding does to a lens's derivatives."""


@dataclass(frozen=True)
class Stretch:
    """Stretches of borders between corners of pixels, in rays (S, T), of one shape."""

    left: tuple[Floats, Floats]
    right: tuple[Floats, Floats]
    off: Floats
    """How far the ends may be from these."""
    reach: Floats
    """How far any point of the stretch is from `middle` at most."""
    known: Bits

    @property
    def middle(self) -> tuple[Floats, Floats]:
        """What lies halfway between the ends."""
        return (self.left[0] + self.right[0]) / 2, (self.left[1] + self.right[1]) / 2


@dataclass(frozen=True)
class Patch:
    """Patches of the frame between two columns and two rows, in rays (S, T): left and right edges, (2, ...), by upper and lower end."""

    left: tuple[Floats, Floats]
    right: tuple[Floats, Floats]
    off: Floats
    """How far a point of an edge may be from the segment between its ends."""
    middle: tuple[Floats, Floats]
    reach: Floats
    """How far any point of the patch is from `middle` at most."""
    down: Floats
    """And how far along T."""
    known: Bits


@dataclass(frozen=True)
class Optics:
    """A sensor's lens, and the rays of the corners of its pixels, row by row, flat."""

    camera: Camera
    lens: Lens
    corners: tuple[Floats, Floats, Floats]
    """S and T of each corner, and how far from it the true ray is at most; infinite where it is not known."""
    calibration: Calibration
    """What the sensor may be off by: these are of the one in the middle."""
    way: Floats
    """Bound on the way in rays from the first corner of a row to each, along the border."""

    @staticmethod
    def parts_of(scene: Scene) -> tuple[Optics, ...]:
        """The optics of a scene's sensor, its plus-minus of the focal lengths cut into parts; none for a pinhole that is known exactly.

        Raises `SceneError` for a lens that folds within the frame.
        """
        camera, off = scene.camera, scene.calibration
        if camera.pinhole and off.exact:
            return ()
        moved_px = off.focal_relative * math.hypot(camera.width, camera.height)
        count = min(math.ceil(moved_px / ZOOMED_PX), MOST_PARTS) if moved_px > 0 else 1
        parts = []
        for number in range(count):
            middle = 1 + off.focal_relative * ((2 * number + 1) / count - 1)
            focal_px = camera.focal_u_px * middle, camera.focal_v_px * middle
            narrower = replace(off, focal_relative=off.focal_relative / (count * middle) * (1 + ROUNDING_SHARE))
            zoomed = replace(camera, focal_px=focal_px, focal_length_m=None, pixel_pitch_m=None) if count > 1 else camera
            parts.append(Optics.of(zoomed, narrower))
        return tuple(parts)

    @staticmethod
    def of(camera: Camera, off: Calibration) -> Optics:
        """The optics of a sensor that may be off by so much. Raises `SceneError` for a lens that folds within the frame."""
        lens = lens_of(camera, off)
        if lens.model is None:
            lens = replace(lens, radius=LARGEST_RADIUS)
        s, t, away = corner_rays(camera, lens)
        a_pixel = 1 / camera.focal_u_px * (1 + ROUNDED_DERIVATIVE)
        steps = a_pixel / lens.stretches_around(np.sqrt(s * s + t * t), a_pixel / lens.stretch)
        way = np.cumsum(np.pad(steps[:, :-1], ((0, 0), (1, 0))), axis=1)
        return Optics(camera, lens, (s.ravel(), t.ravel(), away.ravel()), off, way.ravel())

    @staticmethod
    def sways(camera: Camera, attitude: Attitude) -> bool:
        """True if an attitude's plus-minus moves what a frame shows by `SWAYING_PX`."""
        return _moved_px(camera, np.array([attitude.roll, attitude.yaw])) >= SWAYING_PX

    @cached_property
    def swings(self) -> tuple[float, float, float]:
        """How far g, Q_u and Q_v may be from 0 (`runtime.refine.unknowns`)."""
        off, camera = self.calibration, self.camera
        zoom = (1 + ROUNDING_SHARE) / (1 - off.focal_relative)
        return off.focal_relative * zoom, off.principal_px / camera.focal_u_px * zoom, off.principal_px / camera.focal_v_px * zoom

    def turns(self, sets: StateSet) -> Turns:
        """The rotations of sets, whose pitch is the one that is seen (`tilt`): by their attitude, or that of the calibration alone."""
        if sets.roll is None or sets.yaw is None:
            return Turns.level(len(sets), self.calibration.roll_rad, self.calibration.yaw_rad)
        return sets.turns if self.tilt == 0 else Turns.of(sets.theta + np.array([-self.tilt, self.tilt]), sets.roll, sets.yaw)

    def off(self, turns: Turns) -> tuple[Floats, ...]:
        """How far a, b, g, Q_u and Q_v may be from their middles, (sets,) each."""
        return turns.off_a, turns.off_b, *(np.full(len(turns.off_a), side) for side in self.swings)

    def moved(self, s: Floats, t: Floats, reach: Floats) -> Floats:
        """How far the calibration's plus-minus may move the rays within `reach` of these, their places in the frame given."""
        zoom, across, down = self.swings
        if zoom == across == down == 0:
            return np.zeros(1)
        radius = np.sqrt(s * s + t * t)
        shown = zoom * (radius + reach) * self.lens.largest_scale + math.hypot(across, down)
        around = float(np.max(reach + shown / self.lens.stretch, initial=0.0))
        return shown / self.lens.stretches_around(radius, around) * (1 + ROUNDED_DERIVATIVE)

    def known(self, sets: StateSet) -> bool:
        """True where nothing is unknown of the sets' camera, but of its roll and yaw what moves nothing by `STILL_PX`."""
        sides = [angle for angle in (sets.roll, sets.yaw) if angle is not None]
        return self.calibration.exact and all(_moved_px(self.camera, side) < STILL_PX for side in sides)

    def border(self, border: Floats) -> Floats:
        """How far from a border's own row, in focal lengths, other focal lengths may show it."""
        return np.abs(border) * self.swings[0]

    def beside_px(self, shown: Floats, focal_px: float) -> Floats:
        """How far, px, other focal lengths show what is at some focal lengths from the axis."""
        return np.abs(shown) * (self.calibration.focal_relative * focal_px)

    @property
    def tilt(self) -> float:
        """By how much the pitch that is seen may differ from the ideal frame's: a principal point that lies lower is seen as a pitch.

        Sets that are contracted on the sensor have the pitch c'' = c + p, where the true principal point lies p F_v above the one in the
        middle (or below, where p < 0), so that the lens shows N at D = (1 + g) N - (Q_u, -p).
        """
        return self.swings[2]

    def beside_tilt(self, turns: Turns, s: Floats, t: Floats, reach: Floats) -> tuple[Floats, Floats]:
        """How far in D_x and D_y points within `reach` of some rays are shown from where the tilt and the principal point cancel.

        A pitch that is p less moves a ray r by -p e x r, e being across the runway: by (dS, dT), and in the frame by J (dS, dT) - (0, p).
        What is of second order, or due to another e or ray, is bounded by the sizes of all factors.
        """
        if self.tilt == 0:
            return np.zeros(1), np.zeros(1)
        e_x, e_y, e_z = turns.cos_a * turns.cos_b, turns.sin_a * turns.cos_b, -turns.sin_b
        x, y, z = e_z * t - e_y, e_x - e_z * s, e_y * s - e_x * t
        right, down = x - s * z, y - t * z
        across, mixed, along, off = self.derivatives(s, t, np.zeros(1))
        length = 1 + s * s + t * t
        more = 4 * length * length * (self.lens.largest_scale + self.lens.largest_bend) * (self.tilt + turns.off + reach) + 2 * length * off
        beside_u = np.abs(across * right + mixed * down) + more
        beside_v = np.abs(mixed * right + along * down - 1) + more
        return self.tilt * beside_u, self.tilt * beside_v

    def tilt_growth(self, turns: Turns, s: Floats, t: Floats) -> Floats:
        """By how much the bounds of `beside_tilt` grow at most a way in rays, no farther than |s| and |t| from the axis.

        L being the square of a ray's length, (right, down) is 2 L long at most and grows by 4 of that length; an entry of J grows by its
        bend, what is of second order by the growth of 4 L^2.
        """
        if self.tilt == 0:
            return np.zeros(1)
        length = 1 + s * s + t * t
        return self.tilt * (4 + 16 * (self.tilt + turns.off)) * length * length * (self.lens.largest_scale + self.lens.largest_bend)

    def between(self, first: Floats, last: Floats, row: Floats) -> Stretch:
        """Of the border between two columns, of one shape; `row` is of that shape, or its last axes."""
        left, right = self._place(first, row), self._place(last, row)
        known, (s, t, off) = (left >= 0) & (right >= 0), self.corners
        left, right = np.where(known, left, 0), np.where(known, right, 0)
        off = np.maximum(off.take(left), off.take(right))
        known &= np.isfinite(off)
        off = np.where(known, off, 0.0)
        reach = np.abs(self.way.take(right) - self.way.take(left)) / 2 * (1 + ROUNDED_DERIVATIVE) + off
        return Stretch((s.take(left), t.take(left)), (s.take(right), t.take(right)), off, reach, known)

    def patch(self, columns: Interval, rows: Interval) -> Patch:
        """Of what the frame shows between two columns and two rows that are at most one apart, each of any one shape."""
        camera, known = self.camera, np.logical_and.reduce([np.isfinite(side) for side in (*columns, *rows)])
        u = [(np.where(known, side, camera.u0) - camera.u0) / camera.focal_u_px for side in columns]
        v = [(np.where(known, side, camera.v0) - camera.v0) / camera.focal_v_px for side in rows]
        across = np.stack([u[0], u[0], u[1], u[1], (u[0] + u[1]) / 2])
        down = np.stack([v[0], v[1], v[0], v[1], (v[0] + v[1]) / 2])
        s, t, away = self.lens.undistorted(across, down)
        middle, off = (s[4], t[4]), away.max(axis=0)
        known &= np.isfinite(off)
        wide, tall = np.abs(u[1] - u[0]) / 2, np.abs(v[1] - v[0]) / 2
        radius, around = np.sqrt(s[4] * s[4] + t[4] * t[4]), float(np.max(wide + tall, initial=0.0)) / self.lens.stretch
        stretch = self.lens.stretches_around(radius, around)
        bow = self.lens.largest_bend / stretch**3 * tall**2 / 2
        off = np.where(known, off + away[4] + bow, 0.0) * (1 + ROUNDED_DERIVATIVE) + ROUNDING_SHARE
        reach, beside = (wide + tall) / stretch, wide * (1 / stretch - 1 / self.lens.largest_scale) / 2
        reach, down = (side * (1 + ROUNDED_DERIVATIVE) + off for side in (reach, tall / stretch + beside))
        return Patch((s[:2], t[:2]), (s[2:4], t[2:4]), off, middle, reach, down, known)

    def _place(self, column: Floats, row: Floats) -> NDArray[np.int64]:
        """Where a corner stands in the tables; -1 where it is no corner of the frame."""
        camera = self.camera
        inside = (column >= 0) & (column <= camera.width) & (row >= 0) & (row <= camera.height)
        return np.where(inside, row * (camera.width + 1) + np.where(inside, column, 0.0), -1).astype(np.int64)

    def derivatives(self, s: Floats, t: Floats, reach: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """dD_x/dS, dD_x/dT = dD_y/dS and dD_y/dT at rays, and how far each may be from that within `reach` of them, within the disc."""
        return *self.lens.jacobian(s, t), self.bent(reach)

    def bent(self, reach: Floats) -> Floats:
        """How far derivatives at rays of the disc that are so far apart may differ, and what float64 loses of them."""
        return self.lens.largest_bend * reach * (1 + ROUNDED_DERIVATIVE) + ROUNDED_DERIVATIVE

    def within(self, s: Floats, t: Floats, reach: Floats) -> Bits:
        """True where all rays within `reach` of these lie in the lens's disc."""
        return np.sqrt(s * s + t * t) + reach <= self.lens.radius * (1 - ROUNDED_DERIVATIVE)


def _moved_px(camera: Camera, angles: Floats) -> float:
    """How far the widest of some intervals, (angles, 2), rad, moves points of the frame's middle to either side."""
    return float(np.ptp(angles, axis=1).max(initial=0.0)) / 2 * camera.focal_u_px

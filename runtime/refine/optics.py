"""What a lens does between the pixels of a sensor and the rays (S, T, 1) of a pinhole in its place, for the borders of its rows.

Distances here are in units of the focal lengths: a point of the sensor in column u and row v is shown at ((u - u0)/F_u, (v - v0)/F_v).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from runtime.lens import Lens
from runtime.refine.interval import Bits, Floats
from runtime.scene import Calibration, Camera, Scene
from runtime.sensor_map import SensorMap

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
class Optics:
    """A sensor's lens, and the rays of the corners of its pixels, row by row, flat."""

    camera: Camera
    lens: Lens
    corners: tuple[Floats, Floats, Floats]
    """S and T of each corner, and how far from it the true ray is at most; infinite where it is not known."""
    way: Floats
    """Bound on the way in rays from the first corner of a row to each, along the border."""

    @staticmethod
    def of(scene: Scene) -> Optics | None:
        """The optics of a scene's sensor; None for a pinhole. Raises `SceneError` for a lens that folds within the frame."""
        if scene.camera.pinhole:
            return None
        still = SensorMap.of(replace(scene, calibration=Calibration()))
        s, t, off = still.rays
        a_pixel = 1 / scene.camera.focal_u_px * (1 + ROUNDED_DERIVATIVE)
        steps = a_pixel / still.lens.stretches_around(np.sqrt(s * s + t * t), a_pixel / still.lens.stretch)
        way = np.cumsum(np.pad(steps[:, :-1], ((0, 0), (1, 0))), axis=1)
        return Optics(scene.camera, still.lens, (s.ravel(), t.ravel(), off.ravel()), way.ravel())

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

    def _place(self, column: Floats, row: Floats) -> NDArray[np.int64]:
        """Where a corner stands in the tables; -1 where it is no corner of the frame."""
        camera = self.camera
        inside = (column >= 0) & (column <= camera.width) & (row >= 0) & (row <= camera.height)
        return np.where(inside, row * (camera.width + 1) + np.where(inside, column, 0.0), -1).astype(np.int64)

    def derivatives(self, s: Floats, t: Floats, reach: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """dD_x/dS, dD_x/dT = dD_y/dS and dD_y/dT at rays, and how far each may be from that within `reach` of them, within the disc."""
        across, mixed, down = self.lens.jacobian(s, t)
        return across, mixed, down, self.lens.largest_bend * reach * (1 + ROUNDED_DERIVATIVE) + ROUNDED_DERIVATIVE

    def within(self, s: Floats, t: Floats, reach: Floats) -> Bits:
        """True where all rays within `reach` of these lie in the lens's disc."""
        return np.sqrt(s * s + t * t) + reach <= self.lens.radius * (1 - ROUNDED_DERIVATIVE)

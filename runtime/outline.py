"""What a sensor's frame shows of a window of the ideal frame, told by few rays: those of its border, and of tiles of its pixels.

R_z(a) R_y(b) takes straight lines to straight lines: of a window, a rectangle of the ideal frame, the sensor's lens is given the rays of a
convex quadrilateral. Each corner of it lies in a box, over all rotations of an interval. So, whatever the rotation is,

- within a half-plane for each edge, moved outward until it holds the boxes of all corners, lies all of the window;
- a ray that is farther within the middle quadrilateral than any corner is from its box's middle lies in the window;
- if no ray of the frame's border lies in these half-planes, nor near, and some ray that the frame shows lies in the window, the frame shows
  all of it: the window is connected, and its way out of what is shown would lead across the border.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.refine.interval import Floats
from runtime.rounding import ROUNDING_SHARE
from runtime.sensor_map import SensorMap

Bits = NDArray[np.bool_]
Window = tuple[slice, slice]
"""Rows and columns of a frame; a slice need not stop at its border."""

FAR = 1e150
"""Stands for the bound on a ray that is not certainly seen."""
TILE_PX = 16
"""Sides of the tiles of the sensor, which are looked at before its pixels are."""


@dataclass(frozen=True)
class Outline:
    """Rays of a sensor without rotation."""

    shape: tuple[int, int]
    border: tuple[Floats, Floats]
    """The lens's rays (s, t) of the corners of pixels along the frame's border, (n,) each."""
    spacing: float
    """No ray of the border is farther from all of these; infinite where one is not certainly seen."""
    low: tuple[Floats, Floats]
    high: tuple[Floats, Floats]
    """The least and the largest (s, t) of every tile's rays, (tiles down, tiles across) each."""
    inner: tuple[Floats, Floats]
    inner_off: Floats
    """A ray within every tile, and how far from it the true one is at most."""

    @staticmethod
    def of(still: SensorMap) -> Outline:
        """Of a sensor's map."""
        s, t, off = still.rays
        edge = 1 / (min(still.camera.focal_u_px, still.camera.focal_v_px) * (1 - still.calibration.focal_relative))
        bow = 0.0 if still.lens.model is None else edge**2 / 8 * still.lens.curvature * (1 + ROUNDING_SHARE)
        around = [np.concatenate([side[0], side[1:, -1], side[-1, -2::-1], side[-2:0:-1, 0]]) for side in (s, t, off)]
        steps = np.hypot(*(np.diff(side, append=side[:1]) for side in around[:2]))
        spacing = float(2 * steps.max() + around[2].max() + bow) if still.lens.whole else np.inf
        # a pixel of the ideal frame more on all sides: what is told of a pixel's own quadrilateral is a little wider than the pixel
        more = off + bow + 2 * edge
        low_s, low_t = (_over_tiles(np.where(np.isfinite(off), side - more, -FAR), np.minimum) for side in (s, t))
        high_s, high_t = (_over_tiles(np.where(np.isfinite(off), side + more, FAR), np.maximum) for side in (s, t))
        rows, columns = (_middles(size) for size in still.camera.shape)
        inner = s[rows[:, None], columns], t[rows[:, None], columns]
        return Outline(
            still.camera.shape, (around[0], around[1]), spacing, (low_s, low_t), (high_s, high_t), inner, off[rows[:, None], columns]
        )

    def seen(self, sensor: SensorMap, window: Window) -> tuple[Window, bool]:
        """Rows and columns outside which the sensor shows nothing of a window of the ideal frame, and True if it certainly shows it all."""
        quadrilateral = Quadrilateral.of(sensor, window)
        if quadrilateral is None:
            return (slice(0, self.shape[0]), slice(0, self.shape[1])), False
        met = quadrilateral.meets(self.low, self.high)
        rows, columns = (_span(np.any(met, axis=axis), size) for axis, size in zip((1, 0), self.shape, strict=True))
        clear = np.isfinite(self.spacing) and bool((quadrilateral.beyond(*self.border) > self.spacing).all())
        return (rows, columns), clear and bool(quadrilateral.holds(*self.inner, self.inner_off).any())

    def not_within(self, sensor: SensorMap) -> Bits:
        """The pixels of the sensor, (height, width), but for tiles that show nothing beyond the ideal frame."""
        quadrilateral = Quadrilateral.of(sensor, (slice(0, sensor.ideal.height), slice(0, sensor.ideal.width)))
        outside = np.ones(self.low[0].shape, dtype=bool)
        if quadrilateral is not None:
            outside = ~quadrilateral.holds_all(self.low, self.high)
        height, width = self.shape
        return outside.repeat(TILE_PX, axis=0).repeat(TILE_PX, axis=1)[:height, :width]


@dataclass(frozen=True)
class Quadrilateral:
    """Half-planes (across, along) of length 1 for each edge, (4,) each: all of a window's rays have a product of at most `outer` with it,
    and a ray whose products are below `inner` lies in the window.
    """

    across: Floats
    along: Floats
    outer: Floats
    inner: Floats

    @staticmethod
    def of(sensor: SensorMap, window: Window) -> Quadrilateral | None:
        """Of a window of the ideal frame; None where a corner is not certainly before the sensor."""
        rows, columns = window
        top, bottom = max(rows.start, 0), min(rows.stop, sensor.ideal.height)
        left, right = max(columns.start, 0), min(columns.stop, sensor.ideal.width)
        s, t = sensor.lens_rays(np.array([left, right, right, left], float), np.array([top, top, bottom, bottom], float))
        if top >= bottom or left >= right or not (np.isfinite(s[1]).all() and np.isfinite(t[1]).all()):
            return None
        middle_s, middle_t, half = (s[0] + s[1]) / 2, (t[0] + t[1]) / 2, float(max((s[1] - s[0]).max(), (t[1] - t[0]).max()))
        across, along = np.roll(middle_t, -1) - middle_t, middle_s - np.roll(middle_s, -1)
        length = np.sqrt(across**2 + along**2)
        across, along = across / length, along / length
        products = across * middle_s[:, None] + along * middle_t[:, None]
        slack = half * (1 + ROUNDING_SHARE) + 8 * ROUNDING_SHARE * (1 + float(np.abs(middle_s).max() + np.abs(middle_t).max()))
        return Quadrilateral(across, along, products.max(axis=0) + slack, products[np.arange(4), np.arange(4)] - slack)

    def beyond(self, s: Floats, t: Floats) -> Floats:
        """How far rays are at least from any ray of the window."""
        return (self._products(s, t) - _each(self.outer, s)).max(axis=0)

    def holds(self, s: Floats, t: Floats, off: Floats) -> Bits:
        """True for rays that lie in the window with all within `off` of them."""
        return np.all(self._products(s, t) + off < _each(self.inner, s), axis=0)

    def meets(self, low: tuple[Floats, Floats], high: tuple[Floats, Floats]) -> Bits:
        """False for boxes of rays that lie on the outer side of an edge."""
        return np.all(self._extremes(np.minimum, low, high) <= _each(self.outer, low[0]), axis=0)

    def holds_all(self, low: tuple[Floats, Floats], high: tuple[Floats, Floats]) -> Bits:
        """True for boxes of rays that lie in the window."""
        return np.all(self._extremes(np.maximum, low, high) < _each(self.inner, low[0]), axis=0)

    def _products(self, s: Floats, t: Floats) -> Floats:
        """The product of each half-plane with rays of any shape, (4, ...)."""
        return np.multiply.outer(self.across, s) + np.multiply.outer(self.along, t)

    def _extremes(self, extreme: np.ufunc, low: tuple[Floats, Floats], high: tuple[Floats, Floats]) -> Floats:
        """The least or the largest product of each half-plane with a box's rays, (4, ...)."""
        sides = (self.across, low[0], high[0]), (self.along, low[1], high[1])
        s, t = (extreme(np.multiply.outer(one, least), np.multiply.outer(one, most)) for one, least, most in sides)
        return s + t


def _each(bounds: Floats, rays: Floats) -> Floats:
    """Bounds of each half-plane, (4,), beside products with such rays."""
    return bounds.reshape(-1, *[1] * rays.ndim)


def _over_tiles(corners: Floats, extreme: np.ufunc) -> Floats:
    """The extreme value over each tile's corners of pixels, its far border included; (height + 1, width + 1) of them."""
    for axis in (0, 1):
        size = corners.shape[axis] - 1
        starts = np.arange(0, size, TILE_PX)
        own = extreme.reduceat(corners, starts, axis=axis)
        corners = extreme(own, corners.take(np.minimum(starts + TILE_PX, size), axis=axis))
    return corners


def _middles(size: int) -> NDArray[np.int64]:
    """A corner of pixels within each tile along a side of the frame."""
    starts = np.arange(0, size, TILE_PX)
    return (starts + np.minimum(starts + TILE_PX, size)) // 2


def _span(met: Bits, size: int) -> slice:
    """From the first to the last of the tiles that are met, in pixels."""
    places = np.flatnonzero(met)
    if len(places) == 0:
        return slice(0, 0)
    return slice(int(places[0]) * TILE_PX, min((int(places[-1]) + 1) * TILE_PX, size))

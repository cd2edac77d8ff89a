"""A frame of a rolled and yawed sensor painted outward onto the ideal frame, for NN_F (`runtime.attitude`)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from runtime.attitude import Turns
from runtime.rounding import ROUNDING_SHARE, above, below
from runtime.scene import Camera, Scene
from runtime.state_set import tangent_of_row

Floats = NDArray[np.float64]


def painted(camera: Camera, frame: NDArray[np.bool_], turns: Turns) -> NDArray[np.uint8]:
    """Every pixel of the ideal frame that meets what a lit pixel of the sensor may show, or that the sensor may not wholly show.

    `frame` (height, width); `turns` are those of one set. Where a point of the runway lies in a lit pixel of the sensor, the pixel of the
    ideal frame that it lies in is painted, whatever the rotation.
    """
    canvas = ~_wholly_shown(camera, turns)
    rows, columns = np.nonzero(frame)
    low, high = _seen(camera, turns, columns, rows)
    first = np.maximum(np.floor(below(low)), 0).astype(np.int64)
    last = np.minimum(np.floor(above(high)), np.array([[camera.width - 1], [camera.height - 1]])).astype(np.int64)
    if len(rows):
        for down in range(int((last - first)[1].max()) + 1):
            for aside in range(int((last - first)[0].max()) + 1):
                column, row = first[0] + aside, first[1] + down
                inside = (column <= last[0]) & (row <= last[1])
                canvas[row[inside], column[inside]] = True
    return canvas.view(np.uint8)


def met_by_one(scene: Scene, turns: Turns) -> int:
    """Most pixels of the ideal frame that all markings together can meet inside what one pixel of the sensor shows.

    With S' = cos(a) S + sin(a) T, d(X/Z)/dS' = 1/Z^2 and d(Y/Z) = dT'/Z - Y sin(b) dS'/Z^2. What spans w px meets at most floor(w) + 2
    columns or rows, and a straight line in so many columns and rows one pixel fewer than they are together.
    """
    camera = scene.camera
    cos_a, sin_a, sin_b = (float(np.abs(side[0])) + float(off[0]) for side, off in _sizes(turns))
    sides = np.abs([camera.u0, camera.width - camera.u0]).max() / camera.focal_u_px
    heights = np.abs([camera.v0, camera.height - camera.v0]).max() / camera.focal_v_px
    aside, down = cos_a * sides + sin_a * heights, cos_a * heights + sin_a * sides
    ahead = float(turns.cos_b[0] - turns.off_b[0]) - sin_b * aside
    if ahead <= 0:
        return camera.width * camera.height
    across, fall = cos_a / camera.focal_u_px + sin_a / camera.focal_v_px, cos_a / camera.focal_v_px + sin_a / camera.focal_u_px
    spans = camera.focal_u_px * across / ahead**2, camera.focal_v_px * (fall / ahead + down * sin_b * across / ahead**2)
    columns, rows = (math.floor(span * (1 + 2.0**-30)) + 2 for span in spans)
    return min(columns * rows, len(scene.runway.markings) * (columns + rows - 1))


def _sizes(turns: Turns) -> tuple[tuple[Floats, Floats], ...]:
    return (turns.cos_a, turns.off_a), (turns.sin_a, turns.off_a), (turns.sin_b, turns.off_b)


def _seen(camera: Camera, turns: Turns, columns: NDArray[np.int64], rows: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Bounds (2, pixels), u and v px, of the ideal frame on what these pixels of the sensor show."""
    lows, highs = [], []
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        s = (columns + corner[0] - camera.u0) / camera.focal_u_px
        t = tangent_of_row(camera, rows + corner[1])
        aside, down = turns.cos_a * s + turns.sin_a * t, turns.cos_a * t - turns.sin_a * s
        x, z = turns.cos_b * aside - turns.sin_b, turns.sin_b * aside + turns.cos_b
        off = (turns.off + ROUNDING_SHARE) * (1 + np.abs(s) + np.abs(t))
        ahead = z - off
        x_size, y_size = np.abs(x) + off, np.abs(down) + off
        by_a = (y_size * ahead + x_size * (np.abs(turns.sin_b) + turns.off_b) * y_size) / ahead**2
        sway_u = turns.off_a * by_a + turns.off_b * (1 + (x_size / ahead) ** 2)
        by_a = ((np.abs(aside) + off) + y_size**2 * (np.abs(turns.sin_b) + turns.off_b) / ahead) / ahead
        sway_v = turns.off_a * by_a + turns.off_b * x_size * y_size / ahead**2
        point = np.stack([camera.u0 + camera.focal_u_px * x / z, camera.v0 + camera.focal_v_px * down / z])
        sway = np.stack([camera.focal_u_px * sway_u, camera.focal_v_px * sway_v]) * (1 + 2.0**-20)
        lows.append(point - sway)
        highs.append(point + sway)
    return np.minimum.reduce(lows), np.maximum.reduce(highs)


def _wholly_shown(camera: Camera, turns: Turns) -> NDArray[np.bool_]:
    """True for pixels of the ideal frame all of which lies within the sensor, whatever the rotation."""
    u = (np.arange(camera.width + 1) - camera.u0) / camera.focal_u_px
    v = (np.arange(camera.height + 1) - camera.v0) / camera.focal_v_px
    cos_a, sin_a, cos_b, sin_b = (float(side[0]) for side in (turns.cos_a, turns.sin_a, turns.cos_b, turns.sin_b))
    right, down, ahead = (cos_a * cos_b, -sin_a, cos_a * sin_b), (sin_a * cos_b, cos_a, sin_a * sin_b), (-sin_b, 0.0, cos_b)
    sides = [(right, u[0], 1), (right, u[-1], -1), (down, v[0], 1), (down, v[-1], -1)]
    shown = np.ones((camera.height, camera.width), dtype=bool)
    for axis, limit, sign in sides:
        normal = [sign * (one - limit * other) for one, other in zip(axis, ahead, strict=True)]
        slack = (float(turns.off[0]) + 2.0**-30) * (np.abs(normal).sum()) * 1.0
        across = np.minimum(normal[0] * u[:-1], normal[0] * u[1:]) - slack * np.abs(u).max()
        along = np.minimum(normal[1] * v[:-1], normal[1] * v[1:]) + normal[2] - slack * (1 + np.abs(v).max())
        shown &= along[:, None] + across[None, :] > 0
    return shown

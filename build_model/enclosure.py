"""What a set of states can light, and what it must light: outer and inner enclosures of I_r, row by row.

The ranges behind them are `runtime.state_set`'s, exact closed forms; `runtime.rounding` turns them into pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.rounding import above, below, first_crossed, first_touched, inverted, last_crossed, last_touched
from runtime.scene import Camera, Scene
from runtime.state_set import Floats, StateSet, angle_below_axis, column_range, end_rows, scale_between

Columns = tuple[NDArray[np.int64], NDArray[np.int64]]
"""First and last column a marking lights in a row, two arrays (sets, markings, height); none where last < first."""


def _scale_at_distance(camera: Camera, theta: Floats, d: Floats, start: Floats, stop: Floats) -> tuple[Floats, Floats]:
    """Range of g over rows [start, stop], (sets, rows) each, of ground d (sets, 2) ahead: F cos(psi) / (d cos(phi)), psi in [0, pi/2].

    F (cos(theta) - sin(theta) tan(phi)) / d is affine in the row and falls in theta.
    """
    ends = [angle_below_axis(camera, row) for row in (start, stop)]
    low = [np.maximum(np.cos(theta[:, 1:] + phi), 0) / np.cos(phi) for phi in ends]
    high = [np.cos(np.maximum(theta[:, :1] + phi, 0)) / np.cos(phi) for phi in ends]
    return camera.focal_px * np.minimum(*low) / d[:, 1:], camera.focal_px * np.maximum(*high) / d[:, :1]


def _altitude(psi: Floats, d: Floats) -> Floats:
    """y = d tan(psi) of the ground seen at psi below the horizon, d ahead; 0 above the horizon, infinite from straight down on."""
    return np.where(psi < np.pi / 2, d * np.tan(np.clip(psi, 0, np.pi / 2)), np.inf)


def columns_that_may_be_lit(scene: Scene, sets: StateSet) -> Columns:
    """Outer enclosure of I_r: each pixel that some state of the set lights lies within the returned columns of its row.

    A point of a marking that is seen in a row lies d ahead, with d between the marking's ends: that bounds the altitudes which
    show it, and its scale, in each row on its own.
    """
    camera = scene.camera
    top = np.arange(camera.height, dtype=np.float64)
    enclosures = []
    for marking in scene.runway.markings:
        d = sets.z + np.array(marking.ends_z_m)
        near, far = marking.ends_z_m
        start = np.maximum(top, below(end_rows(camera, sets, far)[0])[:, None])
        stop = np.minimum(top + 1, above(end_rows(camera, sets, near)[1])[:, None])
        y_low = _altitude(sets.theta[:, :1] + angle_below_axis(camera, start), d[:, :1])
        y_high = _altitude(sets.theta[:, 1:] + angle_below_axis(camera, stop), d[:, 1:])
        by_state = scale_between(camera, sets, sets.y[:, None, :], start, stop)
        by_distance = _scale_at_distance(camera, sets.theta, d, start, stop)
        scale = np.maximum(by_state[0], by_distance[0]), np.minimum(by_state[1], by_distance[1])
        low, high = column_range(camera, marking.x_m - sets.x[:, ::-1], scale)
        absent = (start > stop) | inverted(y_low, sets.y[:, 1:]) | inverted(sets.y[:, :1], y_high) | inverted(*scale)
        enclosures.append((np.where(absent, 0, first_touched(low)), np.where(absent, -1, last_touched(high))))
    firsts, lasts = zip(*enclosures, strict=True)
    return np.stack(firsts, axis=1), np.stack(lasts, axis=1)


def columns_that_must_be_lit(scene: Scene, sets: StateSet) -> Columns:
    """Inner enclosure of I_r: every state of the set lights each pixel within the returned columns of a row.

    All markings of the set cross the rows from `start` to `stop`. A path from column u(start) to u(stop) enters every pixel
    that neither end of it lies wholly before or wholly behind.
    """
    camera = scene.camera
    top = np.arange(camera.height, dtype=np.float64)
    enclosures = []
    for marking in scene.runway.markings:
        near, far = marking.ends_z_m
        start = np.maximum(top, above(end_rows(camera, sets, far)[1])[:, None])
        stop = np.minimum(top + 1, below(end_rows(camera, sets, near)[0])[:, None])
        across = marking.x_m - sets.x[:, ::-1]
        ends = [column_range(camera, across, scale_between(camera, sets, sets.y[:, None, :], row, row)) for row in (start, stop)]
        first = first_crossed(np.minimum(ends[0][1], ends[1][1]))
        last = last_crossed(np.maximum(ends[0][0], ends[1][0]))
        absent = start >= stop
        enclosures.append((np.where(absent, 0, first), np.where(absent, -1, last)))
    firsts, lasts = zip(*enclosures, strict=True)
    return np.stack(firsts, axis=1), np.stack(lasts, axis=1)

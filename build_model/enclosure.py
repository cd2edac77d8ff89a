"""What a set of states can light, and what it must light: outer and inner enclosures of I_r, row by row.

The ranges behind them are `runtime.state_set`'s, exact closed forms; `runtime.rounding` turns them into pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from runtime.rounding import above, below, first_crossed, first_touched, inverted, last_crossed, last_touched
from runtime.scene import Camera, Runway, Scene
from runtime.state_set import Floats, StateSet, column_range, end_rows, fall, reach, scale_between, tangent_of_row

Columns = tuple[NDArray[np.int64], NDArray[np.int64]]
"""First and last column a marking lights in a row, two arrays (sets, markings, rows); none where last < first."""


MARKINGS_AT_ONCE = 8
"""Markings of which something is computed at once: memory does not grow with their number."""


def in_parts(scene: Scene) -> Iterator[Scene]:
    """The scene with `MARKINGS_AT_ONCE` of its markings after the other."""
    markings = scene.runway.markings
    for first in range(0, len(markings), MARKINGS_AT_ONCE):
        yield replace(scene, runway=Runway(markings[first : first + MARKINGS_AT_ONCE]))


def _scale_at_distance(camera: Camera, theta: Floats, d: Floats, start: Floats, stop: Floats) -> tuple[Floats, Floats]:
    """Range of g over rows with tangents [start, stop], (sets, rows) each, of ground d (sets, 2) ahead that is seen there.

    F_u (cos(theta) - t sin(theta)) / d is affine in t, and falls in theta as long as psi >= 0; it is at most F_u sqrt(1 + t^2) / d.
    """
    low = np.minimum(*(np.maximum(reach(theta[:, 1:], tangent), 0) for tangent in (start, stop)))
    high = np.maximum(*(_farthest_reach(theta[:, :1], tangent) for tangent in (start, stop)))
    return camera.focal_u_px * low / d[:, 1:], camera.focal_u_px * high / d[:, :1]


def _farthest_reach(theta: Floats, tangent: Floats) -> Floats:
    """Largest cos(theta') - t sin(theta') over theta' >= theta with psi' >= 0."""
    return np.where(fall(theta, tangent) >= 0, reach(theta, tangent), np.sqrt(1 + tangent**2))


def _altitude(theta: Floats, tangent: Floats, d: Floats) -> Floats:
    """y = d tan(psi) of the ground seen at psi below the horizon, d ahead; 0 above the horizon, infinite from straight down on."""
    falls, reaches = fall(theta, tangent), reach(theta, tangent)
    return np.where(falls <= 0, 0.0, np.where(reaches > 0, d * falls / np.where(reaches > 0, reaches, 1.0), np.inf))


def columns_that_may_be_lit(scene: Scene, sets: StateSet, beyond_px: int = 0) -> Columns:
    """Outer enclosure of I_r: each pixel that some state of the set lights lies within the returned columns of its row.

    The rows are those of the frame and `beyond_px` more above and below it. A point of a marking that is seen in a row lies d ahead, with
    d between the marking's ends: that bounds the altitudes which show it, and its scale, in each row on its own.
    """
    camera = scene.camera
    top = np.arange(-beyond_px, camera.height + beyond_px, dtype=np.float64)
    enclosures = []
    for marking in scene.runway.markings:
        d = sets.z + np.array(marking.ends_z_m)
        near, far = marking.ends_z_m
        start = np.maximum(top, below(end_rows(camera, sets, far)[0])[:, None])
        stop = np.minimum(top + 1, above(end_rows(camera, sets, near)[1])[:, None])
        first, last = tangent_of_row(camera, start), tangent_of_row(camera, stop)
        y_low, y_high = _altitude(sets.theta[:, :1], first, d[:, :1]), _altitude(sets.theta[:, 1:], last, d[:, 1:])
        by_state, by_distance = scale_between(camera, sets, first, last), _scale_at_distance(camera, sets.theta, d, first, last)
        scale = np.maximum(by_state[0], by_distance[0]), np.minimum(by_state[1], by_distance[1])
        low, high = column_range(camera, marking.x_m - sets.x[:, ::-1], scale)
        absent = (start > stop) | inverted(y_low, sets.y[:, 1:]) | inverted(sets.y[:, :1], y_high) | inverted(*scale)
        enclosures.append((np.where(absent, 0, first_touched(low)), np.where(absent, -1, last_touched(high))))
    firsts, lasts = zip(*enclosures, strict=True)
    return np.stack(firsts, axis=1), np.stack(lasts, axis=1)


def columns_at_borders(scene: Scene, sets: StateSet) -> tuple[Columns, NDArray[np.bool_]]:
    """Columns of the pixels in whose closed columns a marking can meet the border v = r above row r, for r = 1 to height - 1, and whether
    the markings of all states of a set cross it, (sets, markings, height - 1) each.
    """
    camera, row = scene.camera, np.arange(1, scene.camera.height, dtype=np.float64)
    tangent = tangent_of_row(camera, np.broadcast_to(row, (len(sets), len(row))))
    scale = scale_between(camera, sets, tangent, tangent)
    firsts, lasts, crossed = [], [], []
    for marking in scene.runway.markings:
        near, far = marking.ends_z_m
        lowest, highest = above(end_rows(camera, sets, far)[1]), below(end_rows(camera, sets, near)[0])
        low, high = column_range(camera, marking.x_m - sets.x[:, ::-1], scale)
        firsts.append(first_touched(low))
        lasts.append(last_touched(high))
        crossed.append((row > lowest[:, None]) & (row < highest[:, None]))
    return (np.stack(firsts, axis=1), np.stack(lasts, axis=1)), np.stack(crossed, axis=1)


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
        tangents = (tangent_of_row(camera, row) for row in (start, stop))
        ends = [column_range(camera, across, scale_between(camera, sets, tangent, tangent)) for tangent in tangents]
        first = first_crossed(np.minimum(ends[0][1], ends[1][1]))
        last = last_crossed(np.maximum(ends[0][0], ends[1][0]))
        absent = start >= stop
        enclosures.append((np.where(absent, 0, first), np.where(absent, -1, last)))
    firsts, lasts = zip(*enclosures, strict=True)
    return np.stack(firsts, axis=1), np.stack(lasts, axis=1)

"""How far ahead the ground is that a set of states sees in a row, and what that says of z."""

from __future__ import annotations

import numpy as np

from runtime.refine.interval import Floats, Interval
from runtime.rounding import lowered, raised
from runtime.scene import Camera
from runtime.state_set import StateSet, scale_ratio, tangent_of_row


def ground_distances(camera: Camera, sets: StateSet, nearest_row: Floats, farthest_row: Floats) -> Interval:
    """Lower bound on the distance d = F_u (cos(theta) - t sin(theta)) / (scale R) of the ground at some rows, and upper bound at others, m.

    Rows are (rows, sets) each, and so are the bounds. There is no upper one where some state of the set may see the horizon.
    """
    tangent = tangent_of_row(camera, np.array([nearest_row, farthest_row]))
    low, high = scale_ratio(sets, tangent)
    tilt = 1 + np.abs(tangent)
    terms = sets.condition * (tilt + high)
    slow, fast = sets.scale[:, 0] * lowered(low[1], terms[1]), sets.scale[:, 1] * raised(high[0], terms[0])
    (cosine_low, cosine_high), (sine_low, sine_high) = sets.turn[0].T, sets.turn[1].T
    near = lowered(cosine_high - sine_high * tangent[0], tilt[0])
    far = raised(cosine_low - sine_low * tangent[1], tilt[1])
    seen = slow > 0
    nearest, farthest = np.maximum(near, 0) / fast, np.maximum(far, 0) / np.where(seen, slow, 1.0)
    return camera.focal_u_px * nearest, camera.focal_u_px * np.where(seen, farthest, np.inf)


def z_of_rows(camera: Camera, sets: StateSet, lowest: Floats, not_below: Floats, highest: Floats, not_above: Floats) -> Interval:
    """Bounds on z, (sets,) each, of states that see some ends no lower, and some no higher, than in these rows (markings, sets).

    `lowest` are the rows of the ends with p_z `not_below`, (markings,), and `highest` those of the ends with p_z `not_above`.
    """
    nearest, farthest = ground_distances(camera, sets, lowest, highest)
    near_end, far_end = not_below[:, None], not_above[:, None]
    low, high = lowered(nearest - near_end, nearest + np.abs(near_end)), raised(farthest - far_end, farthest + np.abs(far_end))
    return np.maximum.reduce(low, axis=0), np.minimum.reduce(high, axis=0)

"""How far ahead the ground is that a set of states sees in a row, and what that says of z."""

from __future__ import annotations

import numpy as np

from runtime.refine.interval import Floats, Interval
from runtime.rounding import lowered, raised
from runtime.scene import Camera
from runtime.state_set import StateSet, scale_ratio, tangent_of_row


def ground_distances(camera: Camera, sets: StateSet, row: Floats) -> Interval:
    """Range of the distance d = F (cos(theta) - t sin(theta)) / (scale R) of the ground at rows (rows, sets), m.

    It has no upper bound where some state of the set may see the horizon there.
    """
    tangent = tangent_of_row(camera, row)
    low, high = scale_ratio(sets, tangent)
    terms = sets.condition * (1 + np.abs(tangent) + high)
    slow, fast = sets.scale[:, 0] * lowered(low, terms), sets.scale[:, 1] * raised(high, terms)
    (cosine_low, cosine_high), (sine_low, sine_high) = sets.turn[0].T, sets.turn[1].T
    far = raised(cosine_low - sine_low * tangent, 1 + np.abs(tangent))
    near = lowered(cosine_high - sine_high * tangent, 1 + np.abs(tangent))
    nearest, farthest = np.maximum(near, 0) / fast, np.maximum(far, 0) / np.where(slow > 0, slow, 1.0)
    return camera.focal_px * nearest, camera.focal_px * np.where(slow > 0, farthest, np.inf)


def z_at_least(camera: Camera, sets: StateSet, row: Floats, end_z_m: Floats) -> Floats:
    """Lower bound on z, (sets,), of states whose ends, (markings,), are seen no lower than in these rows, (markings, sets)."""
    nearest, end = ground_distances(camera, sets, row)[0], end_z_m[:, None]
    return lowered(nearest - end, nearest + np.abs(end)).max(axis=0)


def z_at_most(camera: Camera, sets: StateSet, row: Floats, end_z_m: Floats) -> Floats:
    """Upper bound on z, (sets,), of states whose ends, (markings,), are seen no higher than in these rows, (markings, sets)."""
    farthest, end = ground_distances(camera, sets, row)[1], end_z_m[:, None]
    return raised(farthest - end, farthest + np.abs(end)).min(axis=0)

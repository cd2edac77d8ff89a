"""Entries refined on the sensor's own pixels, behind a lens or turned: not on the ideal frame, where NN_F has found them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from runtime.motion import tilted
from runtime.refine.interval import Bits
from runtime.refine.lit_pixels import LitPixels
from runtime.refine.optics import Optics
from runtime.refine.refiner import LARGEST_SENSOR_START, Refiner, joined
from runtime.refine.sensor_borders import SensorBorders
from runtime.refine.slices import INTERVALS, rereferenced
from runtime.rounding import ROUNDING_SHARE, lowered, raised
from runtime.scene import Scene
from runtime.state_set import StateSet

BEYOND_PX = 2
"""How far beyond where the sets show their markings the refinement looks at pixels; those farther out it takes for lit."""
MOST_ENTRIES = 512
"""More passing entries than this are refined as hulls of them."""
A_HULL = 16
"""Where an attitude is known so little that hundreds of bins have more entries than that, a hull is of about so many of them."""
FIRST_ROW_STEP = 2.0**-5
"""Tangent of the rows that reference rows are put together by, at first."""
MOST_DOUBLINGS = 6
"""How often bins of scale and of reference rows are doubled for that."""

LEAST_DEPTH = 2.0**-20
"""Depth of an end, per unit of its distance, below which it counts as beside the camera."""


def refined(refiner: Refiner, parts: tuple[Optics, ...], lit: Bits, entries: StateSet, narrowed: bool) -> StateSet:
    """What of the entries is consistent with a frame of the sensor, (height, width), dilated by the tolerance; by Theorem A alone.

    The refiner is of the sensor's scene, `parts` are of its optics; `narrowed` as the refiner has it. A state is consistent if one of the
    parts allows it.
    """
    if len(entries) == 0:
        return entries
    few = grouped(entries, min(max(len(entries) // A_HULL, MOST_ENTRIES), LARGEST_SENSOR_START))
    refiner = replace(refiner, extra_budget=-1)
    if not parts:
        return replace(refiner, window=window_of(refiner.scene, few, None)).refine(lit, few, narrowed=narrowed)
    refiner = replace(refiner, most_rows=refiner.most_rows // len(parts))
    return joined(*(_refined_by(refiner, optics, lit, few, narrowed) for optics in parts))


def _refined_by(refiner: Refiner, optics: Optics, lit: Bits, entries: StateSet, narrowed: bool) -> StateSet:
    """The same by one part: with its focal lengths, of which scales are multiples, and the pitch that is seen.

    Entries that may see an end beside the camera with such a pitch are left as they are: rows tell nothing there.
    """
    scene, zoom = replace(refiner.scene, camera=optics.camera), optics.camera.focal_u_px / refiner.scene.camera.focal_u_px
    seen = zoomed(entries, zoom)
    seen = tilted(scene.camera, seen, optics.tilt) if optics.tilt else seen
    ahead = all_ahead(scene, seen)
    if not ahead.any():
        return entries
    seen = seen[ahead]
    sensor = replace(refiner, scene=scene, optics=optics, window=window_of(scene, seen, optics))
    left = sensor.refine(lit, seen, narrowed=narrowed)
    left = tilted(scene.camera, left, optics.tilt) if optics.tilt else left
    left = within_hull(zoomed(left, 1 / zoom), entries)
    return left if ahead.all() else joined(left, entries[~ahead])


def all_ahead(scene: Scene, sets: StateSet) -> Bits:
    """True for the sets whose states all see every end of a marking certainly in front of the camera, (sets,).

    The depth y sin(theta) + d cos(theta) is least at corners: it is concave in theta where it is above 0.
    """
    d = sets.z[:, 0] + scene.runway.ends_z_m.min()
    depths = [y * sine + d * cosine for y in sets.y.T for cosine, sine in zip(sets.turn[0].T, sets.turn[1].T, strict=True)]
    terms = sets.y[:, 1] + np.abs(sets.z[:, 0]) + np.abs(scene.runway.ends_z_m).max()
    return np.minimum.reduce(depths) > LEAST_DEPTH * (sets.y[:, 1] + np.abs(d)) + ROUNDING_SHARE * terms


def zoomed(sets: StateSet, by: float) -> StateSet:
    """The sets with scales, px per metre, for focal lengths that are so many times as long."""
    if by == 1:
        return sets
    scale = sets.scale * by
    return replace(sets, scale=np.stack([lowered(scale[:, 0], scale[:, 0]), raised(scale[:, 1], scale[:, 1])], axis=-1))


def within_hull(sets: StateSet, others: StateSet) -> StateSet:
    """The parts of sets that lie in the box around others, but for their scale."""
    closer = {}
    for name in INTERVALS[:4]:
        own, other = getattr(sets, name), getattr(others, name)
        closer[name] = np.stack([np.maximum(own[:, 0], other[:, 0].min()), np.minimum(own[:, 1], other[:, 1].max())], axis=-1)
    sets = replace(sets, **closer)
    return sets[~sets.empty]


def grouped(sets: StateSet, most: int) -> StateSet:
    """At most about so many sets that hold the given ones: hulls of those that differ in x, roll and yaw alone, or in little else.

    Their ends' rows then stay as narrow as those of the entries, which have one pitch, one scale and one distance but for a bin of each.
    Bins of the scale are doubled until there are few enough.
    """
    if len(sets) <= most:
        return sets
    pitch, scale = (getattr(sets, name).mean(axis=1) for name in ("theta", "scale"))
    pitch_step, scale_step = (float(np.median(np.ptp(getattr(sets, name), axis=1))) or 1.0 for name in ("theta", "scale"))
    distance = np.unique(sets.z, axis=0, return_inverse=True)[1].ravel()
    place, row_step = np.zeros(len(sets), dtype=np.int64), FIRST_ROW_STEP
    for _ in range(MOST_DOUBLINGS):
        keys = np.stack([np.floor(side) for side in (pitch / pitch_step, sets.tangent / row_step, distance, scale / scale_step)], axis=-1)
        place = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
        if place.max() < most:
            break
        scale_step, row_step = 2 * scale_step, 2 * row_step
    return hulls_of(sets, place)


def hulls_of(sets: StateSet, place: NDArray[np.int64]) -> StateSet:
    """The hull of the sets at each place, from 0 on without a gap, with its scale at the lowest of their reference rows."""
    count = int(place.max()) + 1
    tangent, hulls = np.full(count, -np.inf), {}
    np.maximum.at(tangent, place, sets.tangent)
    sets = rereferenced(sets, tangent[place])
    for name in (*INTERVALS, *(("roll", "yaw") if sets.roll is not None else ())):
        side = getattr(sets, name)
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, place, side[:, 0])
        np.maximum.at(high, place, side[:, 1])
        hulls[name] = np.stack([low, high], axis=-1)
    return StateSet(**hulls, tangent=tangent)


def window_of(scene: Scene, sets: StateSet, optics: Optics | None) -> tuple[slice, slice]:
    """The rows and columns of the sensor that show what the sets may show, with a margin of `BEYOND_PX`."""
    camera = scene.camera
    whole = LitPixels.of(np.zeros(camera.shape, dtype=bool), (slice(0, camera.height), slice(0, camera.width)), True)
    borders = SensorBorders.of(scene, sets, whole, optics)
    low, high = borders.columns
    sides = (
        (min(borders.far[0].min(), borders.near[0].min()), max(borders.far[1].max(), borders.near[1].max()), camera.height),
        (low.min(), high.max(), camera.width),
    )
    rows, columns = (
        slice(int(np.clip(np.floor(first) - BEYOND_PX, 0, size - 1)), int(np.clip(np.floor(last) + 1 + BEYOND_PX, 1, size)))
        for first, last, size in sides
    )
    return rows, columns

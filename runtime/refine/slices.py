"""What is known besides the frame, as sets of states: a prior, and slices of theta on which several sources meet.

Pitch and altitude compensate each other in an image, so that a box around what one frame leaves forgets most of what the frame said. On
thin slices of theta the intervals of scale, y and z are narrow: a union of sets is passed on as the hulls of its slices. Sources that are
cut into the same slices, with scales at the same row, meet slice by slice (docs/guarantee.md, Theorems C and D).

Guarantee: every function here keeps each state that its claim speaks of; bounds are rounded outward (`runtime.rounding`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from runtime.estimate import Box
from runtime.model.limits import BELOW_HORIZON_PX
from runtime.refine.altitude import contract_by_altitude
from runtime.refine.interval import intersected
from runtime.refine.refiner import joined
from runtime.rounding import lowered, raised
from runtime.scene import Camera
from runtime.state_set import StateSet, scale_ratio, tangent_of_row
from runtime.turn import cosine_and_sine

Floats = NDArray[np.float64]

SLICES = 32
"""Slices of theta that a union of sets is passed on in."""
INTERVALS = ("theta", "x", "y", "z", "scale")


def covering(camera: Camera, box: Box, row: float) -> StateSet:
    """One set that holds all states of the box; the row its scale refers to is `row`, or lower where that is too near the horizon."""
    theta, x, y, z = (np.array([[low, high]]) for low, high in zip(box.lower, box.upper, strict=True))
    tangent = tangents_below_horizon(camera, tangent_of_row(camera, np.array([row])), box.lower[:1])
    sets = StateSet(theta, x, y, z, np.array([[0.0, np.inf]]), tangent)
    return contract_by_altitude(camera, sets)


def tangents_below_horizon(camera: Camera, tangent: Floats, theta_low: Floats) -> Floats:
    """The tangents of rows, (n,), or of lower ones, `BELOW_HORIZON_PX` below the horizon of every theta from `theta_low`, (n,), on."""
    cosine, sine = cosine_and_sine(theta_low)
    return np.maximum(tangent, BELOW_HORIZON_PX / camera.focal_v_px - sine / cosine)


def rereferenced(sets: StateSet, tangent: Floats) -> StateSet:
    """The sets with their scales at other rows, (sets,), which must lie below the horizon of all their states."""
    low, high = (side[0] for side in scale_ratio(sets, tangent[None]))
    rounded = (1 + np.abs(tangent)) / sets.reference_fall.min(axis=1)
    slow, fast = sets.scale.T
    scale = lowered(slow * low, slow * (rounded + low * sets.condition)), raised(fast * high, fast * (rounded + high * sets.condition))
    return replace(sets, scale=np.stack(scale, axis=-1), tangent=tangent)


def within(camera: Camera, sets: StateSet, known: StateSet) -> StateSet:
    """For each of the sets the hull of what it has in common with the `known` ones; those that have nothing are left out."""
    meets = np.ones((len(sets), len(known)), dtype=bool)
    for name in ("theta", "x", "y", "z"):
        own, other = getattr(sets, name), getattr(known, name)
        meets &= (own[:, None, 0] <= other[None, :, 1]) & (other[None, :, 0] <= own[:, None, 1])
    mine, theirs = np.nonzero(meets)
    own, other = sets[mine], known[theirs]
    theta = _common(own.theta, other.theta)
    other = rereferenced(replace(other, theta=theta), own.tangent)
    both = replace(own, **{name: _common(getattr(own, name), getattr(other, name)) for name in INTERVALS})
    hulls = _hulls(contract_by_altitude(camera, both), mine, len(sets), sets.tangent)
    return replace(hulls, roll=sets.roll, yaw=sets.yaw)[~hulls.empty]


def slice_edges(theta: Floats) -> Floats:
    """Borders of `SLICES` equal slices from the smallest to the largest of `theta`, (sets, 2); of one where that is a single angle."""
    low, high = float(theta[:, 0].min()), float(theta[:, 1].max())
    edges = low + (high - low) * (np.arange(SLICES + 1) / SLICES) if high > low else np.array([low, high])
    edges[-1] = high
    return edges


def sliced(camera: Camera, sets: StateSet, edges: Floats, tangent: float) -> StateSet:
    """The hull of what each slice, between neighbours of `edges`, holds of the union of `sets`; an inverted set where that is nothing.

    All scales refer to one row: that of `tangent`, or a lower one where the states need it (`tangents_below_horizon`). Slices are closed;
    what lies outside of the edges is left out.
    """
    return sliced_each(camera, [sets], edges, tangent)[0]


def sliced_each(camera: Camera, unions: Sequence[StateSet], edges: Floats, tangent: float) -> list[StateSet]:
    """`sliced` of several unions, at hardly more than the cost of one."""
    sets, union = joined(*unions), np.arange(len(unions)).repeat([len(each) for each in unions])
    count = len(edges) - 1
    tangents = tangents_below_horizon(camera, np.full(count, tangent), edges[:1])
    meets = (sets.theta[:, :1] <= edges[1:]) & (edges[:-1] <= sets.theta[:, 1:])
    which, place = np.nonzero(meets)
    parts = sets[which]
    sides = np.stack([edges[place], edges[place + 1]], axis=-1)
    parts = replace(parts, theta=_common(parts.theta, sides))
    parts = contract_by_altitude(camera, rereferenced(parts, tangents[place]))
    slices = _hulls(parts, union[which] * count + place, count * len(unions), np.tile(tangents, len(unions)))
    return [slices[number * count : (number + 1) * count] for number in range(len(unions))]


def all_but(sources: Sequence[StateSet], start: StateSet, outliers: int) -> list[StateSet]:
    """For q = 0 to `outliers`: slices that hold every state of `start` which lies in all but q of the sources, at most.

    Sources and `start` are cut into the same slices with scales at the same row. One source after the other is met: what all but q of
    the first k hold is what the k-th holds of what all but q of those before hold, or what all but q - 1 of those hold. Hulls are taken
    on the way: a union of boxes is passed on as the box around it (q-relaxed intersection; sound, and the hull where q = 0).
    """
    held = [_bounds(start)] * (outliers + 1)
    for source in sources:
        low, high = _bounds(source)
        met = [_nothing_where_inverted(np.maximum(below, low), np.minimum(above, high)) for below, above in held]
        held = [met[0]] + [(np.minimum(met[q][0], held[q - 1][0]), np.maximum(met[q][1], held[q - 1][1])) for q in range(1, outliers + 1)]
    return [_of_bounds(low, high, start.tangent) for low, high in held]


def _common(first: Floats, second: Floats) -> Floats:
    """What two intervals (sets, 2) have in common; inverted if nothing."""
    return np.stack(intersected((first[:, 0], first[:, 1]), (second[:, 0], second[:, 1])), axis=-1)


def _hulls(parts: StateSet, place: NDArray[np.int64], count: int, tangent: Floats) -> StateSet:
    """`count` sets: the hull of the parts at each place, wholly inverted where all are empty. Parts of one place share its tangent."""
    left = np.flatnonzero(~parts.empty)
    low, high = np.full((count, len(INTERVALS)), np.inf), np.full((count, len(INTERVALS)), -np.inf)
    if len(left) > 0:
        left = left[np.argsort(place[left], kind="stable")]
        below, above = _bounds(parts[left])
        places, first = np.unique(place[left], return_index=True)
        low[places], high[places] = np.minimum.reduceat(below, first, axis=0), np.maximum.reduceat(above, first, axis=0)
    return _of_bounds(low, high, tangent)


def _bounds(sets: StateSet) -> tuple[Floats, Floats]:
    """Lower and upper bounds of all intervals, (sets, 5) each."""
    bounds = np.stack([getattr(sets, name) for name in INTERVALS], axis=1)
    return bounds[..., 0], bounds[..., 1]


def _of_bounds(low: Floats, high: Floats, tangent: Floats) -> StateSet:
    theta, x, y, z, scale = np.stack([low, high], axis=-1).swapaxes(0, 1)
    return StateSet(theta, x, y, z, scale, tangent)


def _nothing_where_inverted(low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """The same boxes, (sets, 5) bounds each; wholly inverted where one interval is, so that hulls with others ignore them."""
    empty = (low > high).any(axis=1, keepdims=True)
    return np.where(empty, np.inf, low), np.where(empty, -np.inf, high)

"""Offsets from the borders that all states cross: on both sides of one a state lights the pixels that it crosses it in (Theorem A).

    u(r) = u0 + (p_x - x) scale R(theta, r)  lies in the closed columns of a lit pixel of the half-window above r, and of one below r

but for missed pixels. One spoils what its own row shows, on both of its borders: all but m' rows hold. Where none may be missed, the closer
one of the two pixels at a border is all that counts of them.
"""

from __future__ import annotations

import numpy as np

from runtime.refine.interval import Bits, Floats, Interval, intersected, relaxed_intersection
from runtime.refine.sight import Sight
from runtime.state_set import StateSet


def offsets_at_crossings(_: StateSet, sight: Sight) -> Interval:
    """Bounds on the offset (p_x - x) scale of each marking, (markings, sets), px."""
    borders, missed = sight.borders, sight.missed
    if missed.budget == 0:
        low, high = borders.offsets(sight.scene, *columns_at_borders(sight))
        return np.maximum.reduce(low, axis=1), np.minimum.reduce(high, axis=1)
    usable = sight.crossed & ~missed.halves
    upper, lower = (
        _where(usable[half], *borders.offsets(sight.scene, sight.halves.first[half], sight.halves.last[half], rows))
        for half, rows in enumerate((slice(None, -1), slice(1, None)))
    )
    low, high = intersected(upper, lower)
    return relaxed_intersection(low, high, np.maximum(missed.left, 0), missed.budget)


def columns_at_borders(sight: Sight) -> Interval:
    """First and last column that each marking can cross each border in, by the closer of the two rows there, (markings, rows + 1, sets).

    Infinite where nothing is told. They hold for sets without missed pixels left.
    """
    halves, missed = sight.halves, sight.missed
    if missed.budget == 0:
        none = np.where(sight.borders.crossed, 0.0, np.inf)
        return at_borders(halves.first, np.maximum) - none, at_borders(halves.last, np.minimum) + none
    none = np.where(sight.crossed & ~missed.halves, 0.0, np.inf)
    return at_borders(halves.first - none, np.maximum), at_borders(halves.last + none, np.minimum)


def _where(usable: Bits, low: Floats, high: Floats) -> Interval:
    """The bounds where they are usable, and none elsewhere."""
    none = np.where(usable, np.inf, -np.inf)
    return np.minimum(low, none, out=low), np.maximum(high, np.negative(none, out=none), out=high)


def at_borders(halves: Floats, closer: np.ufunc) -> Floats:
    """The closer of what is shown above and below each border, (markings, rows + 1, sets); at the outermost ones there is one row alone."""
    upper, lower = halves
    both = np.empty((len(upper), upper.shape[1] + 1, upper.shape[2]))
    both[:, 0], both[:, -1] = upper[:, 0], lower[:, -1]
    closer(lower[:, :-1], upper[:, 1:], out=both[:, 1:-1])
    return both

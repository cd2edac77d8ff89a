"""What is left of the entries as boxes: connected parts of a union of sets of states, and their hulls."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from runtime.estimate import Box
from runtime.state_set import StateSet

MOST_TO_JOIN = 1024
"""More pieces than this are taken for one connected part, whose hull is the same, at a bounded cost."""


def regions_of(pieces: StateSet, domain: Box, parts: Sequence[NDArray[np.int64]] | None = None) -> tuple[Box, ...]:
    """The boxes of parts of the pieces, none of which may be empty, within the domain; by default of the connected parts."""
    return hulls(pieces.lower, pieces.upper, connected_parts(pieces) if parts is None else parts, domain)


def hulls(lower: NDArray, upper: NDArray, parts: Sequence[NDArray[np.int64]], domain: Box) -> tuple[Box, ...]:
    """The box around each part of the boxes `lower`, `upper`, (boxes, 4), within the domain, which holds the state by assumption."""
    return tuple(
        Box(
            np.clip(lower[part].min(axis=0).astype(np.float64), domain.lower, domain.upper),
            np.clip(upper[part].max(axis=0).astype(np.float64), domain.lower, domain.upper),
        )
        for part in parts
    )


def connected_parts(sets: StateSet) -> list[NDArray[np.int64]]:
    """Numbers of the sets in each connected part of their union: parts are joined where boxes (theta, x, y, z) touch.

    Every round of the loops adds a set to a part or ends a part, so that there are no more rounds than twice the sets.
    """
    if len(sets) > MOST_TO_JOIN:
        return [np.arange(len(sets))]
    touch = np.ones((len(sets), len(sets)), dtype=bool)
    for low, high in (side.T for side in (sets.theta, sets.x, sets.y, sets.z)):
        touch &= low[:, None] <= high
    touch &= touch.T.copy()
    left, parts = np.ones(len(sets), dtype=bool), []
    for first in range(len(sets)):
        if left[first]:
            part, newest = np.zeros(len(sets), dtype=bool), np.array([first])
            while len(newest):
                part[newest] = True
                newest = np.flatnonzero(np.logical_or.reduce(touch[newest], axis=0) & ~part)
            parts.append(np.flatnonzero(part))
            left &= ~part
    return parts

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
    bounds = np.stack([sets.theta, sets.x, sets.y, sets.z])  # axes first, so that numpy compares whole rows of pairs
    starts_before_end = np.logical_and.reduce(bounds[:, :, None, 0] <= bounds[:, None, :, 1], axis=0)
    touch = (starts_before_end & starts_before_end.T) | np.eye(len(sets), dtype=bool)
    left: NDArray[np.bool_] = np.ones(len(sets), dtype=bool)
    parts: list[NDArray[np.int64]] = []
    for first in range(len(sets)):
        if left[first]:
            size, reached = 0, np.array([first])
            while len(reached) > size:
                size, reached = len(reached), np.flatnonzero(touch[reached].any(axis=0))
            parts.append(reached)
            left[reached] = False
    return parts

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

    Every set is labelled with the smallest number that it is known to be connected to; each round of the loop lowers a label.
    """
    if len(sets) > MOST_TO_JOIN:
        return [np.arange(len(sets))]
    touch = np.ones((len(sets), len(sets)), dtype=bool)
    for low, high in (side.T for side in (sets.theta, sets.x, sets.y, sets.z)):
        touch &= low[:, None] <= high
    touch &= touch.T.copy()
    labels, before = np.arange(len(sets)), np.zeros(0)
    while not np.array_equal(labels, before):
        before = labels
        labels = np.minimum.reduce(np.where(touch, labels, len(sets)), axis=1, initial=len(sets))
        labels = labels[labels]  # what is connected to a label's set has that set's label
    return [np.flatnonzero(labels == label) for label in np.flatnonzero(labels == np.arange(len(sets)))]

"""Masks as look-ups: S, K and O of all cells, counted by sums of the frame down its columns.

A mask is a few vertical runs (`build_model.pixel_mask`), and the lit pixels of a run are the sum down to its end less the sum down to
its start. Equal masks, which neighbouring cells often have, are counted once. Sorting the masks by their number of runs leaves few look-ups
without use. Where every mask is its own mirror image, as those of a runway straight ahead are, the frame is folded along that axis first,
and half of the runs remain.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from build_model.filter_tables import RunTable, SpatialRuns
from build_model.hough_bank import CellBank
from build_model.pixel_mask import VerticalRuns
from build_model.window import Window

BLOCK_COST = 2500
"""What a further block costs, in runs: its nodes take as long as it takes to count this many."""


def run_table(banks: Sequence[CellBank], window: Window, dilated: bool, width: int) -> RunTable:
    """The masks of all cells as look-ups into the window's sums; `dilated`: those of K into sums of their own. `width`: of a row."""
    entries = [len(bank) for bank in banks]
    sizes = np.array([[1] * len(banks), entries, entries])
    first = (np.cumsum(sizes) - sizes.ravel()).reshape(sizes.shape)
    groups = [bank.spatial for bank in banks], [bank.must_light for bank in banks], [bank.may_light for bank in banks]
    runs = _joined(list(itertools.chain(*groups)), first.ravel())
    rows, columns = window.shape
    if folded := mirrored(runs, window):
        columns //= 2
        left = runs.column < window.left + columns
        runs = VerticalRuns(runs.mask[left], runs.column[left], runs.start[left], runs.stop[left])
    in_must_light = (runs.mask >= first[1, 0]) & (runs.mask < first[2, 0])
    base = runs.column - window.left + np.where(in_must_light & dilated, (rows + 1) * columns, 0)
    ends = np.stack([(row - window.top) * columns + base for row in (runs.stop, runs.start)])
    distinct, mask, ends = _distinct(runs.mask, ends, int(sizes.sum()))
    place, blocks = _blocks(mask, ends, int(distinct.max()) + 1)

    def rows_of(starts: NDArray[np.int64]) -> NDArray[np.int32]:
        cells = zip(starts, entries, strict=True)
        filled = [np.resize(place[distinct[start : start + size]], -(-size // width) * width) for start, size in cells]
        return np.concatenate(filled).reshape(-1, width)

    return RunTable(blocks, columns, folded, place[distinct[first[0]]], rows_of(first[1]), rows_of(first[2]))


def spatial_runs(banks: Sequence[CellBank], window: Window) -> SpatialRuns:
    """The runs of every S_i, numbered by cell."""
    runs = _joined([bank.spatial for bank in banks], np.arange(len(banks)))
    inside = runs.stop < window.bottom
    column = runs.column - window.left
    start, stop = ((row - window.top) * window.shape[1] + column for row in (runs.start, runs.stop))
    parts = (runs.mask, runs.mask[inside]), (start, stop[inside]), (np.ones(len(start)), -np.ones(inside.sum()))
    return SpatialRuns(*(np.concatenate(part).astype(np.int32) for part in parts))


def mirrored(runs: VerticalRuns, window: Window) -> bool:
    """True if every mask is its own mirror image about the window's middle, which no column of pixels lies on."""
    ends = np.stack([runs.start, runs.column, runs.mask])
    image = np.stack([runs.start, window.left + window.right - 1 - runs.column, runs.mask])
    to, back = np.lexsort(ends), np.lexsort(image)
    return window.shape[1] % 2 == 0 and bool((ends[:, to] == image[:, back]).all() and (runs.stop[to] == runs.stop[back]).all())


def _joined(parts: Sequence[VerticalRuns], first: NDArray[np.int64]) -> VerticalRuns:
    """All masks in one list; `first` is the number of each part's first mask."""
    mask = np.concatenate([part.mask + number for part, number in zip(parts, first, strict=True)])
    return VerticalRuns(mask, *(np.concatenate([getattr(part, name) for part in parts]) for name in ("column", "start", "stop")))


def _distinct(
    mask: NDArray[np.int64], ends: NDArray[np.int64], masks: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The number of every mask among those that differ, in order of appearance, and the runs of these alone, as in `_blocks`."""
    numbers: dict[bytes, int] = {}
    cuts = np.searchsorted(mask, np.arange(masks + 1)).tolist()
    distinct = np.array([numbers.setdefault(ends[:, low:high].tobytes(), len(numbers)) for low, high in itertools.pairwise(cuts)])
    kept = np.isin(mask, np.unique(distinct, return_index=True)[1])
    return distinct, distinct[mask[kept]], ends[:, kept]


def _blocks(mask: NDArray[np.int64], ends: NDArray[np.int64], masks: int) -> tuple[NDArray[np.int32], tuple[NDArray[np.int32], ...]]:
    """The place of every mask, and the blocks; run k, with ends (stop, start) in ends[:, k], belongs to mask[k], which is sorted."""
    runs = np.bincount(mask, minlength=masks)
    place = np.empty(masks, dtype=np.int32)
    place[np.argsort(-runs, kind="stable")] = np.arange(masks)
    rank = np.arange(len(mask)) - np.searchsorted(mask, mask)
    table = np.zeros((2, runs.max(), masks), dtype=np.int32)
    table[:, rank, place[mask]] = ends
    reached = [masks, *(int((runs > bound).sum()) for bound in range(1, runs.max()))]
    return place, tuple(np.ascontiguousarray(table[:, low:high, : reached[low]]) for low, high in block_borders(reached))


def block_borders(reached: Sequence[int]) -> list[tuple[int, int]]:
    """The cheapest division of runs into blocks [low, high). `reached[k]`: masks with a run k, falling; a block is as wide as its first."""
    count = len(reached)
    cost, following = [0] * (count + 1), [count] * count
    for low in reversed(range(count)):
        cost[low], following[low] = min((BLOCK_COST + (high - low) * reached[low] + cost[high], high) for high in range(low + 1, count + 1))
    borders = [0]
    while borders[-1] < count:
        borders.append(following[borders[-1]])
    return list(itertools.pairwise(borders))

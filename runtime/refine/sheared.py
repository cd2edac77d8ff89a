"""Contractor of scale and x by offsets, of a camera of which something is unknown: as seen, offsets are scaled, shifted and sheared.

By `runtime.refine.unknowns` an offset is seen as (p_x - x'') scale'' - kappa (w - w*), but for a rest that is in its bounds. kappa, one
number a state, is cut into pieces: in each of them the borders bound (p_x - x'') scale'' as they bound offsets elsewhere (`crossings`), and
what holds in some piece that the frame does not refute holds of the set.
"""

from __future__ import annotations

import math

import numpy as np

from runtime.refine.crossings import at_borders
from runtime.refine.interval import Bits, Floats, Interval, intersected, relaxed_intersection
from runtime.refine.lateral import scale_and_x
from runtime.refine.sensor_borders import SensorBorders
from runtime.refine.sensor_end_pixels import sheared_at_ends
from runtime.refine.sight import Sight
from runtime.rounding import ROUNDING_SHARE, lowered, raised
from runtime.state_set import StateSet

PIECE_PX = 0.01
"""kappa is cut until it shears no offset by more within a piece, into `MOST_PIECES` at most."""
MOST_PIECES = 32

Sheared = tuple[Floats, Floats, Floats]
"""Bounds on an offset as it is seen, and w - w*, (markings, rows or borders, sets)."""


def contract_by_sheared_offsets(sets: StateSet, sight: Sight) -> StateSet:
    """The sets with scale and x contracted.

    Sets whose offsets the frame contradicts, or whose states miss too many pixels, come out empty.
    """
    borders = sight.borders
    assert isinstance(borders, SensorBorders)
    assert borders.unknowns is not None
    seen, ends = _seen(borders, sight), sheared_at_ends(borders, sight)
    unknowns, known = borders.unknowns, borders.unknowns.known
    largest, scaled = (np.where(known, side, 0.0) for side in (unknowns.sheared_px, unknowns.scaled))
    scale = lowered(sets.scale[:, 0] * (1 - scaled), sets.scale[:, 0]), raised(sets.scale[:, 1] * (1 + scaled), sets.scale[:, 1])
    at_ends = [] if ends is None or not (sight.missed.left == 0).any() else [ends]
    hull, count = _Hull.none(len(sets)), _pieces([*seen, *at_ends], largest)
    for number in range(count):
        least, most = largest * (2 * number / count - 1), largest * (2 * (number + 1) / count - 1)
        parts, whole = ([_unsheared(part, least, most) for part in side] for side in (seen, at_ends))
        shift = _over(unknowns.shifted_px(least, most), scale)
        x = lowered(sets.x[:, 0] + shift[0], np.abs(sets.x[:, 0])), raised(sets.x[:, 1] + shift[1], np.abs(sets.x[:, 1]))
        of_piece, seen_x, holds = _by_piece(sight, parts, whole, scale, x)
        seen_x = seen_x[0] - shift[1], seen_x[1] - shift[0]
        hull = hull.joined(of_piece, seen_x, holds)
    refuted = (known & ~hull.some) | (sight.missed.left < 0)
    low, high = (np.where(hull.some, side, 1.0) for side in hull.scale)
    low, high = lowered(low / (1 + scaled), low), raised(high / (1 - scaled), high)
    x_low, x_high = (np.where(hull.some, side, 0.0) for side in hull.x)
    x_low, x_high = (rounded(side, np.abs(side) + np.abs(sets.x).max(axis=1)) for rounded, side in ((lowered, x_low), (raised, x_high)))
    low, high, x_low, x_high = (
        np.where(known, side, bound) for side, bound in zip((low, high, x_low, x_high), (0.0, np.inf, -np.inf, np.inf), strict=True)
    )
    return sets.contracted(scale=(low, high), x=(x_low, x_high)).emptied(refuted)


def _over(shift_px: Interval, scale: Interval) -> Interval:
    """Range of C/scale'', (sets,), m; without bounds where the scale may be 0."""
    low, high = shift_px
    slow, fast = np.where(scale[0] > 0, scale[0], 1.0), scale[1]
    low, high = np.minimum(low / slow, low / fast), np.maximum(high / slow, high / fast)
    low, high = lowered(low, np.abs(low)), raised(high, np.abs(high))
    return np.where(scale[0] > 0, low, -np.inf), np.where(scale[0] > 0, high, np.inf)


def _seen(borders: SensorBorders, sight: Sight) -> list[Sheared]:
    """What the borders show: where pixels may be missed, by the pixels above and by those below each."""
    first, last, missed = sight.halves.first, sight.halves.last, sight.missed
    if missed.budget == 0:
        bounds = borders.sheared_offsets(at_borders(first, np.maximum), at_borders(last, np.minimum))
        return [_where(borders.crossed, bounds)]
    usable = sight.crossed & ~missed.halves
    return [
        _where(usable[half], borders.sheared_offsets(first[half], last[half], rows))
        for half, rows in enumerate((slice(None, -1), slice(1, None)))
    ]


def _where(usable: Bits, bounds: Sheared) -> Sheared:
    """The bounds where they are usable, and none elsewhere."""
    low, high, w = bounds
    return np.where(usable, low, -np.inf), np.where(usable, high, np.inf), np.where(usable, w, 0.0)


def _pieces(seen: list[Sheared], largest: Floats) -> int:
    """How many pieces kappa is cut into, which is up to `largest` in size."""
    sheared = max(float(np.max(np.abs(w).max(axis=(0, 1), initial=0.0) * largest, initial=0.0)) for _, _, w in seen)
    return min(max(math.ceil(2 * sheared / PIECE_PX), 1), MOST_PIECES)


def _unsheared(seen: Sheared, least: Floats, most: Floats) -> Interval:
    """Bounds on (p_x - x'') scale'' for kappa between two numbers, (sets,) each."""
    low, high, w = seen
    one, other = least * w, most * w
    margin = ROUNDING_SHARE * np.maximum(np.abs(one), np.abs(other))
    return low + np.minimum(one, other) - margin, high + np.maximum(one, other) + margin


def _by_piece(sight: Sight, parts: list[Interval], whole: list[Interval], scale: Interval, x: Interval) -> tuple[Interval, Interval, Bits]:
    """scale'', x'' and True for the sets that this piece does not refute; `whole`: bounds which no missed pixel spoils."""
    missed = sight.missed
    if missed.budget == 0:
        ((low, high),) = parts
        low, high = np.maximum.reduce(low, axis=1), np.minimum.reduce(high, axis=1)
    else:
        low, high = relaxed_intersection(*intersected(*parts), np.maximum(missed.left, 0), missed.budget)
    for least, most in whole:
        low, high = intersected((low, high), (np.maximum.reduce(least, axis=1), np.minimum.reduce(most, axis=1)))
    refuted = np.logical_or.reduce(low > high, axis=0)
    offset = np.where(refuted, 0.0, low), np.where(refuted, 0.0, high)
    scale, seen_x = scale_and_x(sight.scene.runway.x_m, offset, scale, x)
    x = x if seen_x is None else intersected(seen_x, x)
    return scale, x, ~refuted & (scale[0] <= scale[1]) & (x[0] <= x[1])


class _Hull:
    """Hulls of what holds in some pieces: scale'' and x'', (sets,) each; nothing where there is none."""

    def __init__(self, scale: Interval, x: Interval, some: Bits) -> None:
        self.scale, self.x, self.some = scale, x, some

    @staticmethod
    def none(count: int) -> _Hull:
        nothing = np.full(count, np.inf), np.full(count, -np.inf)
        return _Hull(nothing, nothing, np.zeros(count, dtype=bool))

    def joined(self, scale: Interval, x: Interval, holds: Bits) -> _Hull:
        """With another piece, where that holds."""
        sides = []
        for own, other in ((self.scale, scale), (self.x, x)):
            low, high = np.where(holds, other[0], np.inf), np.where(holds, other[1], -np.inf)
            sides.append((np.minimum(own[0], low), np.maximum(own[1], high)))
        return _Hull(sides[0], sides[1], self.some | holds)

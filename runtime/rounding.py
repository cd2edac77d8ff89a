"""Outward rounding: every real bound behind a certificate becomes a pixel or a float32 here, and nowhere else.

The closed forms of `build_model.enclosure` are evaluated in float64, whose error there is a few hundred units in the last
place: below 1e-9 px for any frame of up to 16384 px and any focal length up to 1e6 px. `OUTWARD_PX` is a thousand times that,
and costs a millionth of a pixel of tightness. The same margin makes the integers independent of the machine's libm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.scene import MARGIN_PX

OUTWARD_PX = MARGIN_PX
"""Margin that every bound on a row or a column is widened by, in px."""

ROUNDING_SHARE = 2.0**-46
"""Where the terms of a bound may be of any size, the bound is moved outward by this share of them: 128 units of float64's last place.

A sum or product that is rounded a few dozen times is wrong by at most as many times 2^-53 of its largest terms; the altitude, which is
rounded most often, by a twentieth of this share."""

OUTWARD_RELATIVE = 2.0**-30
"""Share by which a lower bound must exceed an upper one before an interval of angles, altitudes or scales is called empty.

The share is taken of the upper bound's size, and of 1 where that is smaller: an angle near 0 is the difference of larger ones, and has
their error."""


def below(values_px: ArrayLike) -> NDArray[np.float64]:
    """Rows or columns that lie below the given ones by the margin."""
    return np.asarray(values_px) - OUTWARD_PX


def above(values_px: ArrayLike) -> NDArray[np.float64]:
    """Rows or columns that lie above the given ones by the margin."""
    return np.asarray(values_px) + OUTWARD_PX


def lowered(values: ArrayLike, terms: ArrayLike) -> NDArray[np.float64]:
    """Lower bounds on the real numbers that `values` are rounded from, each a sum or product of terms of the sizes `terms`."""
    return np.asarray(values) - ROUNDING_SHARE * np.asarray(terms)


def raised(values: ArrayLike, terms: ArrayLike) -> NDArray[np.float64]:
    """Upper bounds on the real numbers that `values` are rounded from; `terms` as in `lowered`."""
    return np.asarray(values) + ROUNDING_SHARE * np.asarray(terms)


def column_margin_px(terms_px: ArrayLike) -> NDArray[np.float64]:
    """Margin of a column that is the sum of terms of this size, px: `OUTWARD_PX`, and what rounding adds where they are large."""
    return raised(OUTWARD_PX, terms_px)


def first_touched(lower_px: ArrayLike) -> NDArray[np.int64]:
    """Smallest index of a pixel that a coordinate of at least `lower_px` can fall into."""
    return np.floor(below(lower_px)).astype(np.int64)


def last_touched(upper_px: ArrayLike) -> NDArray[np.int64]:
    """Largest index of a pixel that a coordinate of at most `upper_px` can fall into."""
    return np.floor(above(upper_px)).astype(np.int64)


def first_crossed(start_upper_px: ArrayLike) -> NDArray[np.int64]:
    """Smallest index of a pixel that is not wholly before a path which starts at `start_upper_px` or earlier."""
    return np.floor(above(start_upper_px)).astype(np.int64)


def last_crossed(stop_lower_px: ArrayLike) -> NDArray[np.int64]:
    """Largest index of a pixel whose inside is reached by every path that goes on to `stop_lower_px` or farther."""
    return np.ceil(below(stop_lower_px)).astype(np.int64) - 1


def inverted(lower: ArrayLike, upper: ArrayLike) -> NDArray[np.bool_]:
    """True where lower exceeds upper by more than float64's error could: the interval between them is proved empty."""
    return np.asarray(lower) > np.asarray(upper) + OUTWARD_RELATIVE * np.maximum(np.abs(upper), 1)


def float32_below(values: ArrayLike) -> NDArray[np.float32]:
    """A float32 below each value, by at least half a unit in its last place."""
    return np.nextafter(np.asarray(values, dtype=np.float32), np.float32(-np.inf))


def float32_above(values: ArrayLike) -> NDArray[np.float32]:
    """A float32 above each value, by at least half a unit in its last place."""
    return np.nextafter(np.asarray(values, dtype=np.float32), np.float32(np.inf))

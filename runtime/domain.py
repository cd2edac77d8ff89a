"""The domain: the states that a certificate speaks of, and the cells that it is divided into.

Each axis is divided into intervals, in one of three ways:

    { centres = [...], width = w }     cells of one width about these centres; width 0 fixes the axis at its one centre
    { edges = [...] }                  cells from each edge to the next
    { from = a, to = b, ratio = q }    cells that grow by a ratio: from a to a q, from there to a q^2, and so on; the last one ends at b

and a cell is a box of one interval of each, so that the domain is a box too. In place of the altitudes' axis there may be

    glide = { angle_rad = [lo, hi], aim_m = 300.0, cells = 1 }

the altitudes of an approach to a point `aim_m` behind the threshold: a cell of z from z0 to z1 has those from (z0 + aim_m) tan(lo) to
(z1 + aim_m) tan(hi), divided into `cells` equal parts. The domain is then the union of its cells: a staircase of altitude over distance, in
which no step stands apart from the next, since the altitudes (z1 + aim_m) tan(lo) to (z1 + aim_m) tan(hi) belong to both cells at z1.

Cells are numbered from 0, row-major over (theta, x, y, z), ascending; with a glide, y counts the parts of the altitudes from the lowest.
Neighbours share their borders to the last bit, and the borders have the same digits on every machine.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.scene_error import demand
from runtime.turn import cosine_and_sine

TILING_TOLERANCE = 1e-9
"""Largest gap or overlap between neighbouring cells, in the axis's unit, that is read as decimal rounding in the file."""
SMALLEST_EXTENT = 1e-6
"""Smallest width of a cell, length of a marking, altitude and distance ahead: far above `TILING_TOLERANCE`, and never lost when
added to a coordinate."""
LARGEST_COORDINATE = 1e6
"""Largest size of a coordinate: with it no sum or quotient of a scene's numbers overflows, nor loses `SMALLEST_EXTENT`."""
MOST_ITEMS = 2**12
"""Markings, and cells along an axis, that are read: a tenth of a second's work."""

Floats = NDArray[np.float64]


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """The array itself, from now on read-only."""
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class Axis:
    """One axis of the domain, tiled by cells of one width around the given centres; width 0 fixes the axis at its one centre."""

    centres: tuple[float, ...]
    width: float

    def check(self, key: str) -> None:
        """Raises `SceneError` unless the cells tile an interval without gap or overlap."""
        demand(len(self.centres) > 0, f"{key}.centres", "none", "give at least one centre")
        for value in self.centres:
            demand(abs(value) <= LARGEST_COORDINATE, f"{key}.centres", value, f"stay within {LARGEST_COORDINATE:.0f}")
        usable = self.width == 0 or SMALLEST_EXTENT <= self.width <= LARGEST_COORDINATE
        demand(usable, f"{key}.width", self.width, f"give 0 (fixed axis), or {SMALLEST_EXTENT} to {LARGEST_COORDINATE:.0f}")
        if self.width == 0:
            demand(len(self.centres) == 1, f"{key}.centres", list(self.centres), "an axis of width 0 has one centre")
        for left, right in itertools.pairwise(self.centres):
            gap = right - left - self.width
            demand(abs(gap) <= TILING_TOLERANCE, f"{key}.centres", f"{left} and {right}", f"neighbours must ascend by {self.width}")

    @cached_property
    def borders(self) -> Floats:
        """Borders of the cells, (cells + 1,), ascending; neighbours share theirs to the last bit. Two equal ones if fixed."""
        centres, half = np.array(self.centres), self.width / 2
        return read_only(np.concatenate([centres[:1] - half, (centres[:-1] + centres[1:]) / 2, centres[-1:] + half]))


@dataclass(frozen=True)
class Edges:
    """One axis of the domain, divided at the given edges: the first and the last one are its ends."""

    edges: tuple[float, ...]

    def check(self, key: str) -> None:
        """Raises `SceneError` unless there are two edges or more, and they ascend by `SMALLEST_EXTENT` at least."""
        demand(len(self.edges) >= 2, f"{key}.edges", list(self.edges), "give two edges or more")
        for value in self.edges:
            demand(abs(value) <= LARGEST_COORDINATE, f"{key}.edges", value, f"stay within {LARGEST_COORDINATE:.0f}")
        for left, right in itertools.pairwise(self.edges):
            advice = f"edges must ascend by {SMALLEST_EXTENT} or more; a fixed axis has one centre and width 0"
            demand(right - left >= SMALLEST_EXTENT, f"{key}.edges", f"{left} and {right}", advice)

    @cached_property
    def borders(self) -> Floats:
        """The edges, (cells + 1,)."""
        return read_only(np.array(self.edges))


@dataclass(frozen=True)
class Growth:
    """One axis of the domain, from `from_` to `to`, in cells that grow by a ratio, as what a pixel tells of a distance does.

    Each border is the one before times `ratio`, rounded to the nearest float64, as long as half of the cell that it begins, or more, lies
    before `to`. So the last cell, which ends at `to`, is at least half and at most 1 + ratio/2 times as wide as it would be by the ratio.
    """

    from_: float
    to: float
    ratio: float

    def check(self, key: str) -> None:
        """Raises `SceneError` unless the cells ascend from above 0, by `SMALLEST_EXTENT` at least, and are not too many."""
        advice = f"give {SMALLEST_EXTENT} to {LARGEST_COORDINATE:.0f}; an axis that reaches 0 or below has edges"
        demand(SMALLEST_EXTENT <= self.from_ <= LARGEST_COORDINATE, f"{key}.from", self.from_, advice)
        demand(self.to <= LARGEST_COORDINATE, f"{key}.to", self.to, f"stay within {LARGEST_COORDINATE:.0f}")
        demand(self.to - self.from_ >= SMALLEST_EXTENT, f"{key}.to", self.to, f"give more than from, {self.from_}")
        demand(1 < self.ratio <= LARGEST_COORDINATE, f"{key}.ratio", self.ratio, "give a cell's far border over its near one, above 1")
        cells = math.log(self.to / self.from_) / math.log(self.ratio)
        demand(cells < MOST_ITEMS, f"{key}.ratio", self.ratio, f"that makes {cells:.3g} cells: give more, for {MOST_ITEMS} or fewer")
        narrowest = float(np.diff(self.borders).min())
        advice = f"that makes a cell {narrowest:.3g} wide: give more, for {SMALLEST_EXTENT} or more"
        demand(narrowest >= SMALLEST_EXTENT, f"{key}.ratio", self.ratio, advice)

    @cached_property
    def borders(self) -> Floats:
        """Borders of the cells, (cells + 1,), ascending."""
        borders, ratio, to = [self.from_], Fraction(self.ratio), Fraction(self.to)
        while Fraction(following := borders[-1] * self.ratio) * (1 + ratio) <= 2 * to:
            borders.append(following)
        return read_only(np.array([*borders, self.to]))


AnyAxis = Axis | Edges | Growth


@dataclass(frozen=True)
class Glide:
    """The altitudes of an approach, in place of an axis of their own: in each cell of z, those between two glide angles."""

    angle_rad: tuple[float, float]
    """The flattest and the steepest glide angle, from the aim point up to the camera."""
    aim_m: float = 300.0
    """How far behind the threshold the aim point lies."""
    cells: int = 1
    """Equal parts that the altitudes of each cell of z are divided into."""

    def check(self, key: str, z_borders: Floats) -> None:
        """Raises `SceneError` unless each cell of z has altitudes above 0, and their parts are `SMALLEST_EXTENT` high or more."""
        low, high = self.angle_rad
        advice = "give the flattest and the steepest angle, above 0 and below pi/2, in that order"
        demand(0 < low < high < math.pi / 2, f"{key}.angle_rad", [low, high], advice)
        advice = f"stay within {LARGEST_COORDINATE:.0f} m, and above {-z_borders[0]:.6g} m, where the nearest state is"
        demand(SMALLEST_EXTENT - z_borders[0] <= self.aim_m <= LARGEST_COORDINATE, f"{key}.aim_m", self.aim_m, advice)
        most = MOST_ITEMS // (len(z_borders) - 1)
        demand(1 <= self.cells <= most, f"{key}.cells", self.cells, f"give 1 to {most}")
        borders = self.borders(z_borders)
        highest, lowest, thinnest = float(borders.max()), float(borders.min()), float(np.diff(borders, axis=1).min())
        advice = f"stay within {LARGEST_COORDINATE:.0f} m"
        demand(highest <= LARGEST_COORDINATE, f"{key}.angle_rad", f"altitudes of up to {highest:.6g} m", advice)
        advice = f"the camera must be {SMALLEST_EXTENT} m or more above the runway"
        demand(lowest >= SMALLEST_EXTENT, f"{key}.angle_rad", f"altitudes down to {lowest:.3g} m", advice)
        advice = f"give fewer cells, or angles that differ by more: {SMALLEST_EXTENT} m or more"
        demand(thinnest >= SMALLEST_EXTENT, f"{key}.cells", f"parts of {thinnest:.3g} m", advice)

    def borders(self, z_borders: Floats) -> Floats:
        """Borders of the altitudes in each cell of z, (cells of z, `cells` + 1), ascending, m.

        The outermost are float32 numbers, beyond the exact ones by half to one and a half units in a float32's last place: far above what
        float64 loses on the way, so that no altitude between the two angles is left out.
        """
        cosine, sine = cosine_and_sine(np.array(self.angle_rad))
        flattest, steepest = (sine / cosine).tolist()
        beyond = z_borders + self.aim_m
        low = np.nextafter((beyond[:-1] * flattest).astype(np.float32), np.float32(-np.inf))
        high = np.nextafter((beyond[1:] * steepest).astype(np.float32), np.float32(np.inf))
        return np.array([_equal_parts(float(first), float(last), self.cells) for first, last in zip(low, high, strict=True)])


def _equal_parts(low: float, high: float, count: int) -> list[float]:
    """The borders of equal parts of [low, high], each the float64 number nearest to the exact fraction."""
    step = (Fraction(high) - Fraction(low)) / count
    return [low, *(float(Fraction(low) + part * step) for part in range(1, count)), high]


@dataclass(frozen=True)
class Domain:
    """The states that a certificate speaks of: the union of its cells, boxes in (theta, x, y, z). Either `y_m` or `glide` is None."""

    theta_rad: AnyAxis
    x_m: AnyAxis
    y_m: AnyAxis | None
    z_m: AnyAxis
    glide: Glide | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        demand(self.y_m is not None or self.glide is not None, "domain.y_m", "nothing", "this key is required, or glide in its place")
        demand(self.y_m is None or self.glide is None, "domain.glide", "y_m beside it", "give one of the two")
        for each, axis in zip(dataclasses.fields(self), self.axes, strict=False):
            if axis is not None:
                axis.check(f"domain.{each.name}")
        if self.glide is not None:
            self.glide.check("domain.glide", self.z_m.borders)
        low, high = self.lower, self.upper
        pitches = [float(low[0]), float(high[0])]
        demand(low[0] > -math.pi / 2 and high[0] < math.pi / 2, "domain.theta_rad", pitches, "stay within -pi/2 and pi/2")
        demand(low[2] >= SMALLEST_EXTENT, "domain.y_m", low[2], "the camera must be above the runway: y > 0 throughout")

    @property
    def axes(self) -> tuple[AnyAxis, AnyAxis, AnyAxis | None, AnyAxis]:
        """The four axes in state order; None in place of the altitudes' where a glide gives them."""
        return self.theta_rad, self.x_m, self.y_m, self.z_m

    @cached_property
    def altitude_borders(self) -> Floats:
        """Borders of the altitudes in each cell of z, (cells of z, cells of y + 1), ascending; the same in each without a glide."""
        if self.glide is not None:
            return read_only(self.glide.borders(self.z_m.borders))
        assert self.y_m is not None
        return np.broadcast_to(self.y_m.borders, (len(self.z_m.borders) - 1, len(self.y_m.borders)))

    @cached_property
    def lower(self) -> Floats:
        """Smallest theta, x, y, z of the domain, (4,): a corner of its hull, and a state of it."""
        return read_only(np.array([self.borders_along(axis)[0] for axis in range(4)]))

    @cached_property
    def upper(self) -> Floats:
        """Largest theta, x, y, z of the domain, (4,)."""
        return read_only(np.array([self.borders_along(axis)[-1] for axis in range(4)]))

    @cached_property
    def fixed(self) -> NDArray[np.bool_]:
        """The axes that are a single number, (4,)."""
        return read_only(self.lower == self.upper)

    @property
    def cell_counts(self) -> tuple[int, int, int, int]:
        """Cells along each axis: a cell's number is row-major over them."""
        return (
            len(self.theta_rad.borders) - 1,
            len(self.x_m.borders) - 1,
            self.altitude_borders.shape[1] - 1,
            len(self.z_m.borders) - 1,
        )

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return math.prod(self.cell_counts)

    def cells(self) -> tuple[Floats, Floats]:
        """Lower and upper bounds of every cell, (cells, 4) each, in the order of their numbers."""
        altitudes = self.altitude_borders.T
        bounds = []
        for side in (slice(None, -1), slice(1, None)):
            theta, x, z = (axis.borders[side] for axis in (self.theta_rad, self.x_m, self.z_m))
            parts = theta[:, None, None, None], x[:, None, None], altitudes[side], z
            bounds.append(np.stack(np.broadcast_arrays(*parts), axis=-1).reshape(-1, 4))
        return bounds[0], bounds[1]

    def borders_along(self, axis: int) -> Floats:
        """Where some cell has a face across an axis, ascending, each once; two equal ones if it is fixed."""
        tiled = self.axes[axis]
        return np.unique(self.altitude_borders) if tiled is None else tiled.borders

    def altitudes_at(self, z: ArrayLike) -> tuple[Floats, Floats]:
        """Smallest and largest altitude of the states at distances z, of any shape, within the domain's."""
        borders, last = self.z_m.borders, len(self.z_m.borders) - 2
        cells = [np.clip(np.searchsorted(borders, z, side) - 1, 0, last) for side in ("left", "right")]  # on a border, those of both cells
        low, high = (self.altitude_borders[:, side] for side in (0, -1))
        return np.minimum(low[cells[0]], low[cells[1]]), np.maximum(high[cells[0]], high[cells[1]])

    def contains(self, states: ArrayLike) -> NDArray[np.bool_]:
        """True for states (..., 4) of the domain, its faces included: (...,)."""
        points = np.asarray(states, dtype=np.float64)
        low, high = self.altitudes_at(points[..., 3])
        inside = ((self.lower <= points) & (points <= self.upper)).all(axis=-1)
        return inside & (low <= points[..., 2]) & (points[..., 2] <= high)

    def nearest(self, states: ArrayLike) -> Floats:
        """States (..., 4) moved into the domain: onto its hull axis by axis, and then to the altitudes that it has at their distance."""
        points = np.clip(np.asarray(states, dtype=np.float64), self.lower, self.upper)
        points[..., 2] = np.clip(points[..., 2], *self.altitudes_at(points[..., 3]))
        return points

    def uniform(self, rng: np.random.Generator, count: int) -> Floats:
        """Random states, uniform over the domain, (count, 4)."""
        states = rng.uniform(self.lower, self.upper, (count, 4))
        while len(outside := np.flatnonzero(~self.contains(states))):
            states[outside] = rng.uniform(self.lower, self.upper, (len(outside), 4))
        return states

    def reaches_boundary(self, lower: Floats, upper: Floats) -> bool:
        """True if a box [lower, upper], (4,) each, reaches a face of the union of the cells, or out of it; on axes that are not fixed.

        A face, or a part of it, that two cells share is none of the union's. The box keeps clear of the union's faces if it is within its
        ends in theta, x and z, and within the altitudes of each cell of z that it meets, which are an interval.
        """
        ends = (lower <= self.lower) | (upper >= self.upper)
        borders = self.z_m.borders
        met = (borders[:-1] <= upper[3]) & (borders[1:] >= lower[3])
        low, high = self.altitude_borders[met, 0], self.altitude_borders[met, -1]
        ends[2] |= bool(((lower[2] <= low) | (upper[2] >= high)).any())
        return bool((ends & ~self.fixed).any())

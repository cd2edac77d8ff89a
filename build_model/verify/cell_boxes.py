"""The cells that a scene defines (`runtime.domain`), derived anew: what the model's cells are proved to be.

Borders of an axis are the float64 numbers that exact fractions round to. The altitudes of a glide are proved in Arb's balls to hold those
between its two angles, and to exceed them by no more than two units in the last place of a float32.
"""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray

from build_model.partition import Partition
from build_model.verify.ball_camera import PRECISION_BITS
from build_model.verify.counterexample import demand
from runtime.domain import AnyAxis, Domain, Edges, Glide, Growth
from runtime.scene import Scene

FLOAT32_STEPS = 2
"""Units in the last place of a float32 by which a cell's altitudes may exceed those of the glide."""


def cell_boxes(scene: Scene) -> Partition:
    """The cells as the model's documentation defines them, sharing their borders. Raises `Refuted` where the scene's own are others.

    Row-major over the intervals of theta, x, y and z; those of y are the parts of the altitudes in the interval of z, from the lowest.
    """
    domain = scene.domain
    theta, x, z = (list(itertools.pairwise(axis_borders(axis))) for axis in (domain.theta_rad, domain.x_m, domain.z_m))
    altitudes = [list(itertools.pairwise(borders)) for borders in altitude_borders(domain)]
    numbers = itertools.product(theta, x, range(len(altitudes[0])), range(len(z)))
    boxes = [(angle, lateral, altitudes[far][part], z[far]) for angle, lateral, part, far in numbers]
    lower, upper = np.moveaxis(np.array(boxes), 2, 0)
    cells = Partition(lower, upper)
    claimed = Partition(*domain.cells())
    same = cells.lower.shape == claimed.lower.shape and (cells.lower == claimed.lower).all() and (cells.upper == claimed.upper).all()
    demand(bool(same), "the cells are not those of the scene's domain")
    return cells


def axis_borders(axis: AnyAxis) -> list[float]:
    """Borders of an axis's cells, ascending, each the float64 number nearest to the exact fraction.

    About centres: half-way between them, and half a width beyond the outermost. By a ratio: each the one before times the ratio, as long
    as half of the cell that it begins lies before the end.
    """
    if isinstance(axis, Edges):
        return list(axis.edges)
    if isinstance(axis, Growth):
        return _grown_borders(Fraction(axis.from_), Fraction(axis.to), Fraction(axis.ratio))
    centres, half = [Fraction(centre) for centre in axis.centres], Fraction(axis.width) / 2
    middles = [(left + right) / 2 for left, right in itertools.pairwise(centres)]
    return [float(border) for border in (centres[0] - half, *middles, centres[-1] + half)]


def _grown_borders(start: Fraction, end: Fraction, ratio: Fraction) -> list[float]:
    borders = [float(start)]
    while True:
        border = float(Fraction(borders[-1]) * ratio)
        half_cell = (Fraction(border) * ratio - Fraction(border)) / 2
        if Fraction(border) + half_cell > end:
            return [*borders, float(end)]
        borders.append(border)


def altitude_borders(domain: Domain) -> list[list[float]]:
    """Borders of the altitudes in each cell of z, ascending. Raises `Refuted` where the scene's own leave an altitude of the glide out."""
    z = axis_borders(domain.z_m)
    if domain.y_m is not None:
        return [axis_borders(domain.y_m)] * (len(z) - 1)
    assert domain.glide is not None
    claimed = domain.altitude_borders
    demand(claimed.shape == (len(z) - 1, domain.glide.cells + 1), "the glide's altitudes are not those of the scene's cells of z")
    with ctx.workprec(PRECISION_BITS):
        return [_proved(domain.glide, side, altitudes) for side, altitudes in zip(itertools.pairwise(z), claimed, strict=True)]


def _proved(glide: Glide, z: tuple[float, float], claimed: NDArray[np.float64]) -> list[float]:
    """The borders of the altitudes between z[0] and z[1], proved to hold those between the glide's angles, and cut into equal parts."""
    flattest, steepest = (arb(angle).tan() for angle in glide.angle_rad)
    lowest, highest = (arb(z[0]) + arb(glide.aim_m)) * flattest, (arb(z[1]) + arb(glide.aim_m)) * steepest
    low, high = float(claimed[0]), float(claimed[-1])
    where = f"in z {z[0]!r} to {z[1]!r}"
    demand(bool(lowest >= low) and bool(highest <= high), f"{where}, the cells leave out an altitude between the glide's angles")
    steps = (arb(FLOAT32_STEPS * float(np.spacing(np.float32(side)))) for side in (low, high))
    close = bool(lowest - low <= next(steps)) and bool(high - highest <= next(steps))
    demand(close, f"{where}, the cells have altitudes beyond the glide's angles by more than rounding asks")
    part = (Fraction(high) - Fraction(low)) / glide.cells
    return [low, *(float(Fraction(low) + number * part) for number in range(1, glide.cells)), high]

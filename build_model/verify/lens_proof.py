"""What is proved of a camera with a lens: its ideal frame is a pinhole of its own focal lengths, the lens does not fold, and the rays that
the refinement takes for those of the pixels' corners are theirs.

The Jacobian of the lens's D is symmetric (`build_model.verify.ball_lens`). Where both eigenvalues are certainly above 0 on a disc, no two
of its rays are shown at one point; and where f - 3 |p| r^2 at its border exceeds the distance of the frame's farthest corner, all that the
frame shows lies in it. Slices of the radius are balls of 64 bits, from 0 outward until the frame is filled.

A table says of every corner of pixels: the ray of the disc that is shown there lies within `away` of (s, t). Let q be that ray, and be it
farther away. Along the way from p = (s, t) to q, (D(q) - D(p)) . (q - p)/|q - p| grows by an eigenvalue or more, from none: so by `away`
times the least eigenvalue within `away` of p. So the claim holds where |D(p) - corner| is certainly less.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import joblib
import numpy as np
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray

from build_model.verify.ball_camera import PRECISION_BITS, BallInterval, focal_lengths
from build_model.verify.ball_lens import BallLens, RadialSlice
from build_model.verify.counterexample import Counterexample, Refuted, demand
from runtime.scene import Calibration, Camera

SLICES_PER_UNIT = 512
"""Slices of the radius, per focal length."""
LARGEST_RADIUS = 6
"""Beyond this, 80 degrees off the axis, nothing counts as seen."""
SLICES_BEYOND = 8
"""Beyond the slice that fills the frame: what is looked at around its corners."""
ROWS_AT_ONCE = 64
PARTS = 1, 8, 64, 512
"""Into so many slices what lies around a corner is cut, one after another, to tell how near its ray is."""


@dataclass(frozen=True)
class UnfoldedDisc:
    """The disc of rays that fills a frame, slice by slice of the radius; `filled` slices of them, the others beyond."""

    lens: BallLens
    slices: tuple[RadialSlice, ...]
    filled: int

    @staticmethod
    def of(camera: Camera, off: Calibration) -> UnfoldedDisc:
        """Raises `Refuted` unless every slice, up to the one that fills the frame, has derivatives that are certainly above 0."""
        lens, slices, filled = BallLens.of(camera.distortion), [], LARGEST_RADIUS * SLICES_PER_UNIT
        farthest = _farthest_corner(camera, off)
        number = 0
        while number < min(filled + SLICES_BEYOND, LARGEST_RADIUS * SLICES_PER_UNIT):
            low, high = arb(number) / SLICES_PER_UNIT, arb(number + 1) / SLICES_PER_UNIT
            each = lens.slice(low, high)
            if number < filled and not each.stretch > 0:
                raise Refuted(Counterexample("camera.distortion: the lens is not proved to be free of folds within the frame"))
            if number < filled and high * lens.ratio_and_slope(high)[0] - 3 * lens.tangential_size * high**2 > farthest:
                filled = number + 1
            slices.append(each)
            number += 1
        return UnfoldedDisc(lens, tuple(slices), min(filled, len(slices)))

    @property
    def radius(self) -> float:
        """That of the disc."""
        return self.filled / SLICES_PER_UNIT

    def bend_up_to(self, radius: float) -> arb | None:
        """A bound above second derivatives on the disc of a radius; None beyond what the frame shows, and a little."""
        place = math.floor(radius * SLICES_PER_UNIT)
        return self._bends[place] if place < len(self._bends) else None

    def stretch_up_to(self, radius: float) -> arb | None:
        """A bound below the eigenvalues on the disc of a radius; None where none above 0 is known."""
        place = math.floor(radius * SLICES_PER_UNIT)
        least = functools.reduce(arb.min, (each.stretch for each in self.slices[: place + 1])).lower()
        return least if place < len(self.slices) and least > 0 else None

    @cached_property
    def _bends(self) -> tuple[arb, ...]:
        return tuple(itertools.accumulate((each.bend for each in self.slices), arb.max))


def check_lens(camera: Camera, off: Calibration, ideal: Camera) -> None:
    """Raises `Refuted` unless the ideal frame is a pinhole with the sensor's focal lengths, and the lens is proved free of folds."""
    same = ideal.focal_px == (camera.focal_u_px, camera.focal_v_px) and ideal.distortion is None and ideal.mount is None
    demand(same, "metadata: ideal_camera is no pinhole of the camera's own focal lengths")
    with ctx.workprec(PRECISION_BITS):
        UnfoldedDisc.of(camera, off)


Rays = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""Of every corner of a camera's pixels: s, t and `away`, (height + 1, width + 1) each."""


def check_rays(camera: Camera, off: Calibration, rays: Rays, jobs: int = 1) -> int:
    """How many corners' rays are proved: of any camera within the calibration's plus-minus each is certainly as near as `away`.

    Raises `Refuted` with the corner of which that is not proved. Of those that are not certainly seen nothing is claimed.
    """
    with ctx.workprec(PRECISION_BITS):
        radius = UnfoldedDisc.of(camera, off).radius
    parcels = range(0, camera.height + 1, ROWS_AT_ONCE)
    work = (
        joblib.delayed(_first_far)(camera, off, radius, first, *(side[first : first + ROWS_AT_ONCE] for side in rays)) for first in parcels
    )
    for corner in joblib.Parallel(n_jobs=jobs, return_as="generator")(work):
        if corner is not None:
            raise Refuted(Counterexample("the ray of a corner of pixels is not proved to be near to that of the table", pixel=corner))
    return int(np.isfinite(rays[2]).sum())


def _first_far(camera: Camera, off: Calibration, radius: float, first: int, *rays: NDArray[np.float64]) -> tuple[int, int] | None:
    """Row and column of the first corner of some rows whose claim is not proved."""
    with ctx.workprec(PRECISION_BITS):
        lens, (focal_u, focal_v), farthest = BallLens.of(camera.distortion), focal_lengths(camera), arb(radius)
        across = [_shown_at(column, focal_u, camera.u0, off) for column in range(camera.width + 1)]
        for row, table in enumerate(zip(*(side.tolist() for side in rays), strict=True), start=first):
            down = _shown_at(row, focal_v, camera.v0, off)
            for column, (s, t, away) in enumerate(zip(*table, strict=True)):
                if math.isfinite(away) and not _is_near(lens, farthest, (across[column], down), (arb(s), arb(t)), arb(away)):
                    return row, column
    return None


def _shown_at(place: int, focal: arb, centre: float, off: Calibration) -> BallInterval:
    """The least and the largest distance from the axis, in focal lengths, that a column or row of a frame may be."""
    sides = [
        (arb(place) - arb(centre) + shift * arb(off.principal_px)) / (focal * (1 + zoom * arb(off.focal_relative)))
        for shift in (-1, 1)
        for zoom in (-1, 1)
    ]
    return functools.reduce(arb.min, sides), functools.reduce(arb.max, sides)


def _is_near(lens: BallLens, farthest: arb, corner: tuple[BallInterval, BallInterval], ray: BallInterval, away: arb) -> bool:
    """True if all rays no farther than `farthest` from the axis that are shown between a corner's least and largest places certainly lie
    within `away` of one of them.
    """
    shown, _ = lens.shown(*ray)
    right, down = (abs(at - low).max(abs(at - high)).upper() for at, (low, high) in zip(shown, corner, strict=True))
    radius, miss = (ray[0] * ray[0] + ray[1] * ray[1]).sqrt(), (right * right + down * down).sqrt()
    beyond = farthest * (1 + arb(2) ** -40)  # a ray on the disc's border, as float64 has it
    if not radius <= beyond:
        return False
    low, high = (radius - away).max(0).min(farthest), (radius + away).min(beyond)
    return any(miss <= lens.stretch_between(low, high, parts) * away for parts in PARTS)


def _farthest_corner(camera: Camera, off: Calibration) -> arb:
    """How far from the axis the frame's farthest corner is, in focal lengths, whatever the calibration's plus-minus."""
    sides = []
    for focal, centre, size in zip(focal_lengths(camera), (camera.u0, camera.v0), (camera.width, camera.height), strict=True):
        reach = abs(arb(centre)).max(abs(arb(size) - arb(centre))) + arb(off.principal_px)
        sides.append(reach / (focal * (1 - arb(off.focal_relative))))
    return (sides[0] ** 2 + sides[1] ** 2).sqrt()

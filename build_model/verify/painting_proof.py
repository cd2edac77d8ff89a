"""What is proved of the frame that NN_F sees behind a lens: it covers what the sensor shows, and c is what a missed pixel takes from it.

Forward alone, by the lens's own formulas. A pixel of the ideal frame is a box of rays, with a middle m and half-widths h; D of it lies
within |J(m)| h + B |h|^2/2 of D(m), B being a bound on second derivatives. A box that is not decided is cut into four. Of every pixel of
the ideal frame that the painting does not light always, for all rotations and calibrations within the plus-minus, is proved:

    all of it is shown within the sensor's frame, and each pixel that may show some of it paints it when lit.

So where a point of the runway is shown by a lit pixel of the sensor, its ideal pixel is painted. And of the ideal pixels that one of the
sensor may show, the markings together meet c at most. Pixels are closed: a point on a border is shown by both.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import cast

import joblib
import numpy as np
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray

from build_model.verify.ball_camera import PRECISION_BITS, focal_lengths
from build_model.verify.counterexample import Counterexample, Refuted, demand
from build_model.verify.lens_proof import Rays, UnfoldedDisc
from runtime.painting import Painting
from runtime.scene import Camera, Scene

FINEST = 10
"""How often an ideal pixel is cut into four at most."""
NEAR = 2.0**-30
"""More than what float64 loses of a column or row, px, or of the sum of a few."""
UP = 1 + 2.0**-40
"""More than the rounding of a few products."""
PIXELS_AT_ONCE = 2**12

Pixel = tuple[int, int]
Integers = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BallSensor:
    """How a camera shows rays of its ideal frame, with all that it may be off by; roll and yaw, balls around 0, where they may be."""

    disc: UnfoldedDisc
    focal: tuple[arb, arb]
    centre: tuple[arb, arb]
    size: Pixel
    """Columns and rows."""
    principal: arb
    """A ball around 0, px."""
    zoom: arb
    """A ball around 1."""
    turn: tuple[arb, arb] | None

    @staticmethod
    def of(scene: Scene) -> BallSensor:
        """A scene's. Raises `Refuted` for a lens that is not proved to be free of folds."""
        camera, off = scene.camera, scene.calibration
        disc = UnfoldedDisc.of(camera, off)
        turn = (arb(0, off.roll_rad), arb(0, off.yaw_rad)) if off.roll_rad or off.yaw_rad else None
        centre, size = (arb(camera.u0), arb(camera.v0)), (camera.width, camera.height)
        return BallSensor(disc, focal_lengths(camera), centre, size, arb(0, off.principal_px), arb(1, off.focal_relative), turn)

    def shows(self, x: arb, y: arb, width: arb, height: arb) -> tuple[range, range] | None:
        """Columns and rows of pixels that may show some of a box of rays, by its middle and half-widths; None if not all of it is shown."""
        if self.turn is not None:
            x, y, width, height = self._turned(arb(x.mid(), width.upper()), arb(y.mid(), height.upper()))
        bend = self.disc.bend_up_to(math.hypot(float((abs(x) + width).upper()), float((abs(y) + height).upper())) * UP)
        if bend is None:
            return None
        place, (across, mixed, down) = self.disc.lens.shown(x, y)
        more = bend * (width * width + height * height) / 2
        halves = abs(across) * width + abs(mixed) * height + more, abs(mixed) * width + abs(down) * height + more
        spans = []
        for at, half, focal, centre, size in zip(place, halves, self.focal, self.centre, self.size, strict=True):
            shown = centre + focal * self.zoom * (at + arb(0, half.upper())) + self.principal
            low, high = shown.lower(), shown.upper()
            if not (low >= 0 and high <= size):
                return None
            spans.append(range(max(math.ceil(float(low) - NEAR) - 1, 0), min(math.floor(float(high) + NEAR), size - 1) + 1))
        return spans[0], spans[1]

    def _turned(self, x: arb, y: arb) -> tuple[arb, arb, arb, arb]:
        """Middle and half-widths of a box around R_z(a) R_y(b) of a box of rays."""
        assert self.turn is not None
        (sin_a, cos_a), (sin_b, cos_b) = (angle.sin_cos() for angle in self.turn)
        depth = cos_b - x * sin_b
        right, down = (x * cos_b + sin_b) / depth, y / depth
        right, down = right * cos_a - down * sin_a, right * sin_a + down * cos_a
        return arb(right.mid()), arb(down.mid()), right.rad(), down.rad()


@dataclass(frozen=True)
class Met:
    """The first and last row and column of the ideal pixels that each of the sensor's may show, (height, width) each; none at first."""

    first: tuple[Integers, Integers]
    last: tuple[Integers, Integers]

    @staticmethod
    def none(shape: Pixel) -> Met:
        """Of no pixel yet."""
        first, last = np.full((2, *shape), np.iinfo(np.int64).max), np.full((2, *shape), -1)
        return Met((first[0], first[1]), (last[0], last[1]))

    def add(self, pairs: Integers) -> None:
        """Rows and columns of pixels of the sensor, and of ideal ones that they may show, (pairs, 4)."""
        *sensor, row, column = pairs.T
        for first, last, place in zip(self.first, self.last, (row, column), strict=True):
            np.minimum.at(first, tuple(sensor), place)
            np.maximum.at(last, tuple(sensor), place)

    def most(self, scene: Scene, ideal: Camera, extents: tuple[Floats, Floats]) -> int:
        """Most of them that all markings together meet, of any of the sensor's; `extents` as of `extents_px`.

        What is w wide meets floor(w) + 2 columns at most. A marking's line crosses |p_x - x| (F_u/F_v) cos(theta)/y columns a row, and in
        so many rows and columns it meets one pixel fewer than they are together. Two lines that meet what one pixel shows are no farther
        apart than that is wide, and than a line leans in it.
        """
        seen = self.last[0] >= 0
        if not seen.any():
            return 1
        (focal_u, focal_v), lower = focal_lengths(ideal), arb(float(scene.domain.lower[2]))
        flattest = float((_lever(scene) * focal_u / focal_v / lower).upper()) * UP
        px_per_m = float((focal_u / _farthest(scene)).lower()) / UP
        rows, columns = (last[seen] - first[seen] + 1 for first, last in zip(self.first, self.last, strict=True))
        wide, tall = (np.minimum(side[seen], met) for side, met in zip(extents, (columns, rows), strict=True))
        rows, columns = np.minimum(rows, np.floor(tall) + 2), np.minimum(columns, np.floor(np.minimum(wide, flattest * tall)) + 2)
        span_m = float((wide + flattest * tall).max()) * UP / px_per_m
        places = np.unique(scene.runway.x_m)
        lines = max(int(((places >= place) & (places - place <= span_m)).sum()) for place in places)
        return lines * int((rows + columns - 1).max())


def extents_px(sensor: BallSensor, ideal: Camera, rays: Rays) -> tuple[Floats, Floats]:
    """Bounds on width and height, px of the ideal frame, of what each pixel of the sensor shows, (height, width); infinite where not known.

    `rays`: of its corners, as they are proved. What a pixel shows lies within the hull of its corners' rays, but for as much as an edge of
    length h may bow: h^2/8 of |D''| over the least eigenvalue's cube. A rotation by b magnifies what is r off the axis (1 + r sin(b)) /
    (cos(b) - r sin(b))^2 times at most; one by a turns it.
    """
    s, t, away = rays
    disc, known = sensor.disc, np.isfinite(away)
    radius = np.where(known, np.hypot(s, t) + away, 0.0).max() * UP
    bend, stretch = disc.bend_up_to(float(radius)), disc.stretch_up_to(float(radius))
    if bend is None or stretch is None:
        nothing = np.full([side - 1 for side in s.shape], np.inf)
        return nothing, nothing
    edge = 1 / (sensor.focal[0].min(sensor.focal[1]) * sensor.zoom.lower())
    bow = edge * edge * bend / (8 * stretch**3)
    magnified, turned = arb(1), arb(0)
    if sensor.turn is not None:
        (turned, _), (sine, cosine) = (arb(angle.upper()).sin_cos() for angle in sensor.turn)
        magnified = (1 + radius * sine) / (cosine - radius * sine) ** 2
    sides = []
    for side in (s, t):
        ends = np.where(known, side - away, -np.inf), np.where(known, side + away, np.inf)
        low, high = (
            extreme(extreme(end[:-1, :-1], end[1:, 1:]), extreme(end[1:, :-1], end[:-1, 1:]))
            for extreme, end in zip((np.minimum, np.maximum), ends, strict=True)
        )
        sides.append((high - low + 2 * float(bow.upper()) * UP) * UP)
    wide, tall = sides
    factor, mixed = (float(number.upper()) * UP for number in (magnified, magnified * turned))
    focal_u, focal_v = (float(focal.upper()) * UP for focal in focal_lengths(ideal))
    return focal_u * (wide * factor + tall * mixed), focal_v * (tall * factor + wide * mixed)


def _lever(scene: Scene) -> arb:
    """The largest |p_x - x|."""
    sides = [abs(arb(float(p_x)) - arb(float(x))) for p_x in scene.runway.x_m for x in (scene.domain.lower[1], scene.domain.upper[1])]
    return functools.reduce(arb.max, sides)


def _farthest(scene: Scene) -> arb:
    """A bound above the depth of any point of a marking: its distance, whatever the pitch."""
    y, d = arb(float(scene.domain.upper[2])), arb(float(scene.domain.upper[3])) + arb(float(scene.runway.ends_z_m.max()))
    return (y * y + d * d).sqrt()


def check_painting(scene: Scene, ideal: Camera, painting: Painting, count: int, rays: Rays, jobs: int = 1) -> int:
    """How many pixels of the ideal frame are proved to be painted where the sensor shows the runway in them; the others always are.

    Raises `Refuted` with one of which that is not proved, and unless the markings certainly meet no more than `count` in what any one of
    the sensor shows. `rays`: of the sensor's corners, proved (`check_rays`).
    """
    painted_by, met = PaintedBy.of(painting), Met.none(scene.camera.shape)
    looked_at = np.argwhere(~painting.unseen.reshape(painting.shape))
    parcels = (looked_at[at : at + PIXELS_AT_ONCE] for at in range(0, len(looked_at), PIXELS_AT_ONCE))
    work = (joblib.delayed(_pairs_of)(scene, ideal, painted_by, parcel) for parcel in parcels)
    for pairs in joblib.Parallel(n_jobs=jobs, return_as="generator")(work):
        if isinstance(pairs, Counterexample):
            raise Refuted(pairs)
        met.add(cast(Integers, pairs))
    with ctx.workprec(PRECISION_BITS):
        most = met.most(scene, ideal, extents_px(BallSensor.of(scene), ideal, rays))
    demand(most <= count, f"metadata: ideal_pixels_a_pixel is {count}, and no more than {most} is proved")
    return len(looked_at)


def _pairs_of(scene: Scene, ideal: Camera, painted_by: PaintedBy, pixels: Integers) -> Integers | Counterexample:
    """Pixels of the sensor and those of some ideal ones, (pixels, 2), that they may show, all of which they paint: (pairs, 4)."""
    pairs: list[tuple[int, int, int, int]] = []
    with ctx.workprec(PRECISION_BITS):
        sensor, (focal_u, focal_v) = BallSensor.of(scene), focal_lengths(ideal)
        width, height = 1 / (2 * focal_u), 1 / (2 * focal_v)
        for row, column in pixels.tolist():
            x, y = (arb(column) + 0.5 - arb(ideal.u0)) / focal_u, (arb(row) + 0.5 - arb(ideal.v0)) / focal_v
            own, every, boxes = painted_by.pixels(row, column), painted_by.everything, [(x, y, width, height, 0)]
            while boxes:
                x, y, half_x, half_y, depth = boxes.pop()
                shown = sensor.shows(x, y, half_x, half_y)
                by = None if shown is None else [(down, aside) for down in shown[1] for aside in shown[0]]
                if by is not None and all(each in own or each in every for each in by):
                    pairs += [(*each, row, column) for each in by]
                    continue
                if depth == FINEST:
                    return Counterexample("the painted frame is not proved to cover a pixel of the ideal one", pixel=(row, column))
                half_x, half_y = half_x / 2, half_y / 2
                boxes += [(x + side * half_x, y + other * half_y, half_x, half_y, depth + 1) for side in (-1, 1) for other in (-1, 1)]
    return np.array(pairs, dtype=np.int64).reshape(-1, 4)


@dataclass(frozen=True)
class PaintedBy:
    """The sensor's pixels that paint each pixel of the ideal frame: `pixels` sorted by those, and where each one's start."""

    rows: Integers
    columns: Integers
    starts: Integers
    width: int
    everything: frozenset[Pixel]
    """Those that paint all of it."""

    @staticmethod
    def of(painting: Painting) -> PaintedBy:
        """By a painting's table."""
        rows, columns = (side.ravel() for side in np.mgrid[painting.window])
        pixel, place = np.nonzero(painting.table < len(painting.unseen))
        ideal = painting.table[pixel, place]
        order = np.argsort(ideal, kind="stable")
        starts = np.searchsorted(ideal[order], np.arange(len(painting.unseen) + 1))
        every = np.flatnonzero(painting.everything)
        everything = frozenset(zip(rows[every].tolist(), columns[every].tolist(), strict=True))
        return PaintedBy(rows[pixel[order]], columns[pixel[order]], starts, painting.shape[1], everything)

    def pixels(self, row: int, column: int) -> frozenset[Pixel]:
        """Rows and columns of those that paint one of the ideal frame, but for those that paint everything."""
        place = row * self.width + column
        own = slice(self.starts[place], self.starts[place + 1])
        return frozenset(zip(self.rows[own].tolist(), self.columns[own].tolist(), strict=True))

"""Our certified box against set inversion by codac, on the same frames: how wide each is, and how long each takes.

    python scripts/compare_codac.py [--model MODEL.onnx] [--frames 200] [--clutter 0 --clutter 0.02] [--precision 0.02] [-o FILE.csv]

The set to enclose is Theorem A's for m = 0: all states (theta, y, z), x fixed, whose image lies within the frame. Up to the closure of
the pixels, and for markings that move by less than a column a row, it is the set of solutions of these constraints on each marking:

    border   every border r of two rows with v_far < r < v_near has u(r) in the closed columns that are lit both above and below r
    end      both ends (u, v) lie in closed lit pixels

    v = v0 + F tan(atan2(y, p_z + z) - theta)      u(r) = u0 + (p_x - x) g(r)      g(r) = F sqrt(1 + t^2) sin(theta + atan(t)) / y

with t = (r - v0)/F. Rows v and scales g are written with each variable once, so that their interval evaluation is exact. A box of
states is dropped where evaluation proves that a constraint fails in all of it; codac's `CtcInverse` contracts it to the columns that
are lit, and to the rows in which a marking can end; then it is bisected, as in SIVIA. Unlike textbook SIVIA the search leaves alone
what cannot widen the result: a box within the hull of the states found consistent so far (middles of boxes whose exact image lies within
the frame, `runtime.image`), widened by the precision. That is kind to codac: a full paving takes far longer. So each face of codac's
box lies within one precision of a consistent state, or of a box that is no larger than the precision on any axis; "inner" in the table is
the hull of those states. No method can be narrower than it.

The precision is a share of the half-widths that are typical of the paper's scene, `TYPICAL_HALF_WIDTHS`. codac starts from the whole
domain and is told nothing of our result. Intervals and contractors are codac's, in C++; numpy looks up columns in the frame, and Python
drives the search. Times are processor times of one thread; on a busy machine only ratios mean something.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from comparison_frames import draw_frames, write_csv
from numpy.typing import ArrayLike, NDArray
from rich.progress import track
from rich.table import Table

from runtime import Estimator, ModelError, Scene, terminal
from runtime.errors import fail
from runtime.image import lit_columns
from runtime.rounding import above, below


@contextmanager
def rounding_mode_kept() -> Iterator[None]:
    """Gives the thread its rounding mode back: codac leaves the processor rounding upward, on import and after interval functions.

    All float64 arithmetic of the process would round upward from then on, ours and numpy's included.
    """
    libm = ctypes.CDLL(ctypes.util.find_library("m"))
    mode = libm.fegetround()
    try:
        yield
    finally:
        libm.fesetround(mode)


with rounding_mode_kept():
    codac: Any = importlib.import_module("codac")
"""Imported by name: codac comes without the stubs that type checkers need."""
IntervalVector = Any
"""A codac.IntervalVector."""
VectorFunction = Any
"""A codac.AnalyticFunction_Vector."""

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bits = NDArray[np.bool_]

UNKNOWNS = [0, 2, 3]
"""theta, y, z among theta, x, y, z."""
TYPICAL_HALF_WIDTHS = np.array([0.0145, 0.0265, 0.0185])
"""Half-widths of theta (rad), y and z (m) that a clean image of the paper's scene leaves; a precision is a share of them."""
BLOCK = 10
"""Row borders that one of codac's vector functions evaluates: its `vec` takes no more components."""
RING = 2
"""Width of the ring of lit pixels around the frame, px: what lies outside counts as lit."""
WORTHWHILE = 0.7
"""A box is contracted again while its extent along some axis falls below this share of what it was; then it is bisected."""
NEAR_ROW, NEAR_DEPTH, FAR_ROW, FAR_DEPTH = range(4)
"""Components of a marking's ends."""
NATURAL = codac.EvalMode.NATURAL
"""Plain interval evaluation: exact here, and twice as fast as codac's default, which adds the centred form."""


class LitPixels:
    """What the constraints look up in a frame (height, width): columns lit on both sides of a border, lit pixels in a rectangle."""

    def __init__(self, frame: NDArray) -> None:
        self._frame = frame.astype(bool)
        canvas = np.pad(self._frame, RING, constant_values=True)
        self._counts = np.pad(canvas.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        places = _crossing_places(canvas)
        index = np.arange(places.shape[1])
        self._next = np.minimum.accumulate(np.where(places, index, len(index))[:, ::-1], axis=1)[:, ::-1]
        self._previous = np.maximum.accumulate(np.where(places, index, -1), axis=1)

    def usable(self, borders: Integers, low: Floats, high: Floats) -> tuple[Floats, Floats]:
        """Hull of what the closed columns that are lit on both sides of each border share with [low, high], px; inverted if nothing."""
        height, _ = self._frame.shape
        row = np.clip(borders + RING - 1, 0, height + 2 * RING - 2)
        first, last = self._next[row, self._place(low)], self._previous[row, self._place(high)]
        return np.maximum(low, first // 2 - RING), np.minimum(high, (last + 1) // 2 - RING)

    def any_within(self, rows: tuple[ArrayLike, ArrayLike], columns: tuple[ArrayLike, ArrayLike]) -> bool:
        """True if a lit pixel meets the rectangle rows x columns, px."""
        height, width = self._frame.shape
        top, bottom = np.clip(np.floor(np.array(rows)).astype(np.int64), -RING, height + RING - 1) + RING
        left, right = np.clip(np.floor(np.array(columns)).astype(np.int64), -RING, width + RING - 1) + RING
        counts = self._counts
        return bool(counts[bottom + 1, right + 1] - counts[top, right + 1] - counts[bottom + 1, left] + counts[top, left] > 0)

    def hold_image(self, scene: Scene, state: Floats) -> bool:
        """True if I_r of a state (4,) lies within the frame."""
        _, width = self._frame.shape
        first, last = lit_columns(scene, state)
        first, last = np.maximum(first, 0), np.minimum(last, width - 1)
        rows = np.nonzero(first <= last)[1]
        runs = zip(rows, first[first <= last], last[first <= last], strict=True)
        return all(self._frame[row, start : stop + 1].all() for row, start, stop in runs)

    def _place(self, columns: Floats) -> Integers:
        """Number of the open column that holds each of `columns`, among the places of `_crossing_places`."""
        _, width = self._frame.shape
        return 2 * (np.clip(np.floor(columns).astype(np.int64), -RING, width + RING - 1) + RING) + 1


def _crossing_places(canvas: Bits) -> Bits:
    """Where each inner border of rows may be crossed: even places are the lines between columns, odd ones the open columns."""
    touched = np.zeros((canvas.shape[0], 2 * canvas.shape[1] + 1), dtype=bool)
    touched[:, 1::2] = canvas
    touched[:, :-1:2] |= canvas
    touched[:, 2::2] |= canvas
    return touched[:-1] & touched[1:]


@dataclass(frozen=True)
class Hull:
    """A box in (theta, y, z), (3,) each; the hull of nothing reaches from plus to minus infinity."""

    lower: Floats
    upper: Floats

    @classmethod
    def of_nothing(cls) -> Hull:
        """The hull that any other is joined to without a trace."""
        return cls(np.full(len(UNKNOWNS), np.inf), np.full(len(UNKNOWNS), -np.inf))

    @property
    def half_widths(self) -> Floats:
        """Half of the extent, (3,); 0 for the hull of nothing."""
        return np.maximum(self.upper - self.lower, 0) / 2

    def joined(self, other: Hull) -> Hull:
        """The smallest box around both."""
        return Hull(np.minimum(self.lower, other.lower), np.maximum(self.upper, other.upper))

    def holds(self, other: Hull, margin: Floats | float = 0.0) -> bool:
        """True if the other lies in this one widened by the margin."""
        return bool((self.lower - margin <= other.lower).all() and (other.upper <= self.upper + margin).all())


@dataclass(frozen=True)
class Inversion:
    """What codac finds: no state outside `outer` is consistent; `inner` is a hull of states that are."""

    outer: Hull
    inner: Hull
    boxes: int
    milliseconds: float


class SetInversion:
    """Encloses the states of a scene's domain whose image lies within a frame, with codac's intervals and contractors."""

    @rounding_mode_kept()
    def __init__(self, scene: Scene) -> None:
        if scene.domain.lower[1] != scene.domain.upper[1] or scene.tolerance.line_px or scene.tolerance.missed_budget:
            raise ValueError("scene: found a free x axis or a tolerance; this comparison needs x fixed, line_px 0 and missed_budget 0")
        self._scene = scene
        self._focal_u, self._focal_v = codac.Interval(scene.camera.focal_u_px), codac.Interval(scene.camera.focal_v_px)
        self._variables = codac.VectorVar(len(UNKNOWNS))
        self._functions: dict[int, VectorFunction] = {}
        across, ends = scene.runway.x_m - scene.domain.lower[1], scene.runway.ends_z_m
        self._stripes = [(self._ends(pair), across[(ends == pair).all(axis=1)]) for pair in np.unique(ends, axis=0)]

    @rounding_mode_kept()
    def invert(self, frame: NDArray, precision: Floats) -> Inversion:
        """The hull of what a frame allows in the whole domain. `precision`: (3,), rad, m, m."""
        start = time.thread_time()
        lit = LitPixels(frame)
        domain = self._scene.domain
        queue = deque([codac.IntervalVector(np.stack([domain.lower[UNKNOWNS], domain.upper[UNKNOWNS]], axis=1).tolist())])
        inner = outer = Hull.of_nothing()
        boxes = 0
        while queue:
            boxes += 1
            box = queue.popleft()
            if not self._contracted(lit, box):
                continue
            left = Hull(*_bounds(box))
            middle = (left.lower + left.upper) / 2
            point = Hull(middle, middle)
            if not inner.holds(point) and lit.hold_image(self._scene, np.insert(middle, 1, domain.lower[1])):
                inner = inner.joined(point)
            extent = left.upper - left.lower
            if inner.holds(left, precision) or (extent <= precision).all():
                outer = outer.joined(left)
            else:
                queue.extend(box.bisect(int(np.argmax(extent / precision))))
        return Inversion(outer, inner, boxes, (time.thread_time() - start) * 1e3)

    def _ends(self, ends_z_m: Floats) -> VectorFunction:
        """(theta, y, z) to row v and depth Z of the near end, then of the far end."""
        theta, y, z = (self._variables[axis] for axis in range(len(UNKNOWNS)))
        components = []
        for distance in (z + float(end) for end in ends_z_m):
            components.append(self._scene.camera.v0 + self._focal_v * codac.tan(codac.atan2(y, distance) - theta))
            components.append(y * codac.sin(theta) + distance * codac.cos(theta))
        return codac.AnalyticFunction([self._variables], codac.vec(*components))

    def _scales(self, block: int) -> VectorFunction:
        """(theta, y, z) to the scales g at the borders of one block."""
        if block not in self._functions:
            theta, y = self._variables[0], self._variables[1]
            components = []
            for border in range(block * BLOCK, (block + 1) * BLOCK):
                tangent = (codac.Interval(border) - self._scene.camera.v0) / self._focal_v
                components.append(self._focal_u * codac.sqrt(1.0 + codac.sqr(tangent)) * codac.sin(theta + codac.atan(tangent)) / y)
            self._functions[block] = codac.AnalyticFunction([self._variables], codac.vec(*components))
        return self._functions[block]

    def _contracted(self, lit: LitPixels, box: IntervalVector) -> bool:
        """Contracts `box` in place for as long as it pays; False if the constraints contradict all of it."""
        while True:
            before = [side.diam() for side in box]
            for ends, across in self._stripes:
                if not self._contract(lit, box, ends, across) or box.is_empty():
                    return False
            if all(side.diam() >= WORTHWHILE * extent for side, extent in zip(box, before, strict=True)):
                return True

    def _contract(self, lit: LitPixels, box: IntervalVector, ends: VectorFunction, across: Floats) -> bool:
        """One contraction of `box`, in place, by the markings with these ends, `across` m beside the camera; False if contradicted."""
        low, high = _bounds(ends.eval(NATURAL, box))
        if not self._ends_may_be_lit(lit, low, high, across):
            return False
        blocks = range(int(np.floor(low[FAR_ROW])) // BLOCK, int(np.ceil(high[NEAR_ROW])) // BLOCK + 1)
        borders = np.arange(blocks.start * BLOCK, blocks.stop * BLOCK)
        scales = np.concatenate([_bounds(self._scales(block).eval(NATURAL, box)) for block in blocks], axis=1)
        usable = self._usable_scales(lit, borders, scales, across)
        blocked = usable[0] > usable[1]
        past_far, before_near = borders > high[FAR_ROW], borders < low[NEAR_ROW]
        crossed = past_far & before_near
        if (blocked & crossed).any():
            return False
        _contract_ends(box, ends, stops=borders[blocked & past_far], starts=borders[blocked & before_near])
        usable = np.where(crossed, usable, [[-np.inf], [np.inf]])
        bites = (usable[0] > scales[0]) | (usable[1] < scales[1])
        for block, part in zip(blocks, range(0, len(borders), BLOCK), strict=True):
            if bites[part : part + BLOCK].any() and not box.is_empty():
                targets = codac.IntervalVector(usable[:, part : part + BLOCK].T.tolist())
                codac.CtcInverse_IntervalVector(self._scales(block), targets, False).contract(box)
        return True

    def _ends_may_be_lit(self, lit: LitPixels, low: Floats, high: Floats, across: Floats) -> bool:
        """False if some marking has an end that falls on dark pixels alone; `low`, `high`: bounds of the ends' components."""
        camera = self._scene.camera
        for row, depth in ((NEAR_ROW, NEAR_DEPTH), (FAR_ROW, FAR_DEPTH)):
            columns = np.sort(camera.u0 + camera.focal_u_px * np.outer(across, [1 / low[depth], 1 / high[depth]]), axis=1)
            rows = below(low[row]), above(high[row])
            if not all(lit.any_within(rows, (below(left), above(right))) for left, right in columns):
                return False
        return True

    def _usable_scales(self, lit: LitPixels, borders: Integers, scales: Floats, across: Floats) -> Floats:
        """Of `scales`, (2, borders), those at which every marking crosses the border where it is lit; inverted where there are none."""
        u0 = self._scene.camera.u0
        low, high = scales
        for offset in across:
            left, right = np.sort(u0 + offset * scales, axis=0)
            first, last = lit.usable(borders, below(left), above(right))
            dark = first > last
            if offset != 0:
                slowest, fastest = np.sort((np.stack([below(first), above(last)]) - u0) / offset, axis=0)
                low, high = np.maximum(low, slowest), np.minimum(high, fastest)
            low = np.where(dark, np.inf, low)
        return np.stack([low, high])


def _contract_ends(box: IntervalVector, ends: VectorFunction, stops: Integers, starts: Integers) -> None:
    """Contracts `box` in place: no marking crosses `stops`, all past its far end, nor `starts`, all before its near end."""
    if len(stops) + len(starts):
        rows = codac.IntervalVector(4)
        if len(stops):
            rows[NEAR_ROW] = codac.Interval(-codac.oo, float(stops.min()))
        if len(starts):
            rows[FAR_ROW] = codac.Interval(float(starts.max()), codac.oo)
        codac.CtcInverse_IntervalVector(ends, rows, False).contract(box)


def _bounds(box: IntervalVector) -> Floats:
    """Lower and upper bounds, (2, size)."""
    return np.array([(side.lb(), side.ub()) for side in box]).T


@dataclass(frozen=True)
class Comparison:
    """One frame: both results, and our time."""

    clutter: float
    truth: Floats
    ours: Hull
    codac: Inversion
    milliseconds: float

    @property
    def ratio(self) -> Floats:
        """Width of our box over that of codac's, (3,)."""
        return self.ours.half_widths / self.codac.outer.half_widths

    @property
    def violations(self) -> int:
        """How many of the two boxes lack the truth."""
        point = Hull(self.truth[UNKNOWNS], self.truth[UNKNOWNS])
        return int(not self.ours.holds(point)) + int(not self.codac.outer.holds(point))


def compare(estimator: Estimator, inversion: SetInversion, truth: Floats, frame: NDArray, clutter: float, precision: Floats) -> Comparison:
    """Runs both on one frame. Ours runs twice and the second run is timed: codac's search leaves cold caches behind."""
    estimator.estimate(frame)
    start = time.thread_time()
    box = estimator.estimate(frame).box
    milliseconds = (time.thread_time() - start) * 1e3
    ours = Hull.of_nothing() if box is None else Hull(box.lower[UNKNOWNS], box.upper[UNKNOWNS])
    return Comparison(clutter, truth, ours, inversion.invert(frame, precision), milliseconds)


def table_of(results: Sequence[Comparison], precision: Floats) -> Table:
    """Medians, and the spread of the ratio, of each clutter density."""
    size = " ".join(f"{value:.2g}" for value in precision)
    table = Table(title=f"Half-widths of theta (rad), y, z (m); codac's precision {size}", title_justify="left")
    for heading in ("clutter", "frames", "method", "theta", "y", "z", "ratio theta, y, z: median", "95 %", "violations", "ms", "x ours"):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for clutter in dict.fromkeys(result.clutter for result in results):
        chosen = [result for result in results if result.clutter == clutter]
        time_ours, time_codac = (np.median([getter(result) for result in chosen]) for getter in (_time_of_ours, _time_of_codac))
        ratios = np.quantile([result.ratio for result in chosen], [0.5, 0.95], axis=0)
        spread = [" ".join(f"{value:.3f}" for value in row) for row in ratios]
        violations = str(sum(result.violations for result in chosen))
        rows = {
            "ours": ([result.ours for result in chosen], [*spread, violations, f"{time_ours:.1f}", "1"]),
            "codac": ([result.codac.outer for result in chosen], ["", "", "", f"{time_codac:.0f}", f"{time_codac / time_ours:.0f}"]),
            "inner": ([result.codac.inner for result in chosen], [""] * 5),
        }
        for name, (hulls, rest) in rows.items():
            middle = np.median([hull.half_widths for hull in hulls], axis=0)
            table.add_row(f"{clutter:.0%}", str(len(chosen)), name, *(f"{value:.5f}" for value in middle), *rest)
        table.add_section()
    return table


def _time_of_ours(result: Comparison) -> float:
    return result.milliseconds


def _time_of_codac(result: Comparison) -> float:
    return result.codac.milliseconds


def figures_of(result: Comparison) -> list[object]:
    """One row of the CSV, in the order of `HEADER`."""
    hulls = (result.ours, result.codac.outer, result.codac.inner)
    widths = [float(value) for hull in hulls for value in hull.half_widths]
    return [result.clutter, *map(float, result.truth), *widths, result.milliseconds, result.codac.milliseconds, result.codac.boxes]


HEADER = [
    *("clutter", "theta_rad", "x_m", "y_m", "z_m"),
    *(f"{method}_{axis}" for method in ("ours", "codac", "inner") for axis in ("theta_rad", "y_m", "z_m")),
    *("ours_ms", "codac_ms", "codac_boxes"),
]


def main(
    model: Annotated[Path, typer.Option(help="Model to compare.")] = Path("models/paper.onnx"),
    frames: Annotated[int, typer.Option(min=1, help="Frames a clutter density.")] = 200,
    clutter: Annotated[list[float] | None, typer.Option(help="Densities of random clutter; give it more than once.")] = None,
    precision: Annotated[float, typer.Option(min=1e-3, max=1.0, help="codac's, as a share of typical half-widths.")] = 0.02,
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV file, a row a frame.")] = Path("out/compare_codac.csv"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of states and clutter.")] = 1,
) -> None:
    """Compare widths and times, print the table and write the CSV; exit code 1 if a box lacks the truth."""
    errors = terminal.console(stderr=True)
    try:
        estimator = Estimator.load(model)
        if not estimator.scene.camera.pinhole:
            raise ValueError(f"{model}: its camera has a lens, which the set inversion does not know; give a model of a pinhole")
        inversion = SetInversion(estimator.scene)
    except (ModelError, ValueError) as error:
        fail(error)
    size = precision * TYPICAL_HALF_WIDTHS
    results = []
    for density in clutter or [0.0, 0.02]:
        drawn = draw_frames(estimator.scene, frames, density, seed)
        for truth, frame in track(drawn, f"clutter {density:.0%}", total=frames, console=errors, transient=True):
            results.append(compare(estimator, inversion, truth, frame, density, size))
    terminal.console(170).print(table_of(results, size))
    write_csv(output, HEADER, [figures_of(result) for result in results])
    if any(result.violations for result in results):
        raise typer.Exit(1)


if __name__ == "__main__":
    terminal.run(main)

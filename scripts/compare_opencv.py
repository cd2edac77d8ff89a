"""What users would do without us: OpenCV finds the two markings and a solver the pose. Error and time beside ours, on the same frames.

    python scripts/compare_opencv.py [--model MODEL.onnx] [--frames 200] [--clutter 0 --clutter 0.02 --clutter 0.05] [--missed-budget 0]

The model's scene has two markings with common ends; the paper's, an airport's, a long final (models/approach.toml). The baseline is told
all that we know: the exact camera, no roll or yaw, x if it is fixed, the markings, and the domain of states. Frames of a camera with a
lens are undistorted for it first.

1. The frame is cropped to what the runway can reach from the domain. Connected components of lit pixels smaller than a marking can be are
   removed: a marking is one component, clutter is mostly single pixels.
2. Segments are found by `HoughLinesP` or by `LineSegmentDetector` (LSD; on the frame drawn as a grey picture). Both were tuned on other
   seeds than those of the table.
3. Segments are sorted to the markings by slope and place, as the domain allows, the longest `MOST_SEGMENTS` of each. From every pair of a
   left and a right one that lie as a common x demands, the ground's scale at two rows gives a first pitch and altitude; absurd ones are
   dropped.
4. Lines are fitted again, together, to the centres of all lit pixels near them, three times; then the ends are taken from the rows of
   those pixels: the longest run of rows, gaps of one row closed. An end lies in the middle of its last row, on average.
5. The pose: "least squares" fits (theta, y, z), and x if it is free, to the pixels' columns and the ends' rows by Gauss-Newton on the
   closed forms of `runtime.camera`, which is as much as these measurements give; "solvePnP" is `cv2.solvePnP` (iterative; IPPE answers
   NaN where the image is exactly symmetric) with the four ends, which does not know that there is no roll.
6. A pose farther than `DOMAIN_MARGIN` outside the domain is rejected, one that is nearer is moved to the domain's face. Of the poses of
   all pairs the one is taken whose image is lit to the largest share. Without any the frame counts as failed.

"Ours" are NN_e alone (if the model has one), the centre of the certified box alone, and the state that `Estimator.estimate` returns.
Errors are 2-norms over theta (rad), x, y and z (m), as in the paper, and those of each axis that is free; quantiles are over the frames
that have an answer. A frame fails without an answer, or with an error above `GROSS_ERROR` of the domain's extent. Every time is the
median over frames of the processor time of one thread, and each method's own work alone; on a busy machine only ratios mean something.
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import cv2
import numpy as np
import typer
from comparison_frames import draw_frames, write_csv
from numpy.typing import NDArray
from rich.progress import track
from rich.table import Table

from runtime import Estimator, ModelError, Scene, terminal
from runtime.camera import ground_scale, project, row_of_point
from runtime.errors import fail
from runtime.scene import STATE_NAMES

Floats = NDArray[np.float64]
Frame = NDArray[np.uint8]
T = TypeVar("T")

DETECTORS, SOLVERS = ("HoughLinesP", "LSD"), ("least squares", "solvePnP")
OURS = "ours: the estimate, certified"
GROSS_ERROR = 1 / 3
"""An error above this, in extents of the domain, counts as a failure: in the paper's scene, 0.1, the width of a cell."""
DOMAIN_MARGIN = 1 / 6
"""How far outside the domain, in its extents, a pose may lie before it is rejected as absurd: in the paper's scene, 0.05 rad or m."""
SMALLEST_COMPONENT = 8
"""Connected lit pixels fewer than these cannot be a marking, which has 25 rows and more in the paper's scene."""
SLOPE_MARGIN, PLACE_MARGIN_PX = 0.08, 3.0
"""What a detected segment's slope (columns a row) and place may exceed the domain's by."""
SYMMETRY_PX = 3.0
"""How far, px, a pair of segments may differ in the scale of the ground that they show, measured at the outer marking; or, where x is free,
in the x that they show at both ends."""
MOST_SEGMENTS = 64
"""Segments that may be a marking's and are looked at, the longest first."""
NEAR_LINE_PX = (2.5, 1.5, 1.2)
"""In each round, the pixels whose centres lie this near to a line are taken as its own."""
LARGEST_GAP = 1
"""Rows without a pixel that a marking may have between its ends."""
MOST_PAIRS = 12
"""Pairs of segments that are followed up, the longest first."""
NEWTON_STEPS = 3
"""Gauss-Newton converges in two from the pose of the fitted lines."""


@dataclass(frozen=True)
class Region:
    """What the domain allows: the window of the frame, and each marking's range of slope and of column at the middle row."""

    top: int
    bottom: int
    left: int
    right: int
    slope: Floats
    middle: Floats

    @staticmethod
    def of(scene: Scene) -> Region:
        """From the projections of a grid of states, moved into the domain; 9 points an axis leave it far below the margins."""
        domain = scene.domain
        axes = [np.linspace(low, high, 9) for low, high in zip(domain.lower, domain.upper, strict=True)]
        ends = project(scene, domain.nearest(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 4)))
        near, far = ends[:, :, 0], ends[:, :, 1]
        slope = (near[..., 0] - far[..., 0]) / (near[..., 1] - far[..., 1])
        low, high = np.floor(ends.min(axis=(0, 1, 2))).astype(int), np.ceil(ends.max(axis=(0, 1, 2))).astype(int)
        left, top = np.maximum(low - 2, 0)
        right, bottom = np.minimum(high + 2, scene.camera.shape[::-1])
        middle = near[..., 0] / 2 + far[..., 0] / 2
        ranges = (np.stack([values.min(axis=0), values.max(axis=0)], axis=-1) for values in (slope, middle))
        return Region(int(top), int(bottom), int(left), int(right), *ranges)


def without_specks(window: Frame) -> Frame:
    """The window, {0, 255}, without its connected components of fewer than `SMALLEST_COMPONENT` pixels."""
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(window, connectivity=8)
    kept = np.where(statistics[:, cv2.CC_STAT_AREA] >= SMALLEST_COMPONENT, np.uint8(255), np.uint8(0))
    kept[0] = 0
    return np.take(kept, np.asarray(labels, dtype=np.intp))


def segments_by_hough(picture: Frame) -> Floats:
    """Segments (segments, 4): u, v of both ends, px, at pixels' centres, by the probabilistic Hough transform."""
    found = cv2.HoughLinesP(picture, rho=1, theta=np.pi / 360, threshold=10, minLineLength=10, maxLineGap=4)
    return np.empty((0, 4)) if found is None else found.reshape(-1, 4).astype(np.float64) + 0.5


def segments_by_lsd(picture: Frame, detector: cv2.LineSegmentDetector) -> Floats:
    """Segments as `segments_by_hough`, by LSD; it finds both sides of a line of one pixel, whose middle the fit finds again."""
    found = detector.detect(picture)[0]
    return np.empty((0, 4)) if found is None else found.reshape(-1, 4).astype(np.float64) + 0.5


@dataclass(frozen=True)
class Measured:
    """What the frame gives of both markings: pixels' columns and rows (centres), who lies where, and the rows of the common ends."""

    u: Floats
    v: Floats
    lateral: Floats
    """p_x of the marking that each pixel belongs to, m."""
    near_row: float
    far_row: float
    line: Floats
    """(a, b, c, d), fitted to the pixels: the ground's scale is g = a t + b, t = (v - v0)/F, and x g = c t + d."""

    @property
    def x(self) -> float:
        """The lateral position that the lines show, m."""
        a, b, c, d = self.line
        return float((a * c + b * d) / (a * a + b * b))


class Baseline:
    """Detection, fit and pose for a scene of two markings with common ends."""

    def __init__(self, scene: Scene) -> None:
        ends = np.unique(scene.runway.ends_z_m, axis=0)
        if len(scene.runway.x_m) != 2 or len(ends) != 1:
            raise ValueError("scene: found other than two markings with common ends, which this baseline is made for")
        self._scene, self._region = scene, Region.of(scene)
        self._lateral, self._x = scene.runway.x_m, scene.domain.lower[1] if scene.domain.fixed[1] else None
        self._near_z, self._far_z = ends[0]
        self._lsd = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 0.8)

    def picture(self, frame: Frame) -> Frame:
        """The frame's window that the runway can reach, {0, 255}, without specks."""
        region = self._region
        return without_specks(frame[region.top : region.bottom, region.left : region.right])

    def detect(self, picture: Frame, detector: str) -> Floats:
        """Segments (segments, 4) in the whole frame's coordinates, px."""
        found = segments_by_hough(picture) if detector == "HoughLinesP" else segments_by_lsd(picture, self._lsd)
        return found + np.array([self._region.left, self._region.top] * 2)

    def estimate(self, frame: Frame, detector: str, solver: str) -> Floats | None:
        """The pose (4,), or None where nothing plausible is found. Steps 1 to 6 of the module's docstring."""
        picture = self.picture(frame)
        rows, columns = np.nonzero(picture)
        centres = np.stack([columns + self._region.left, rows + self._region.top]).astype(np.float64) + 0.5
        best, best_share = None, 0.0
        for left, right in self._pairs(self.detect(picture, detector)):
            measured = self._measured(np.concatenate([left, right]), centres)
            state = None if measured is None else self._plausible(self._solve(measured, solver))
            share = 0.0 if state is None else self._share_lit(frame, state)
            if share > best_share:
                best, best_share = state, share
            if share == 1.0:
                break
        return best

    def _pairs(self, segments: Floats) -> list[tuple[Floats, Floats]]:
        """Pairs of a segment of each marking, as points (2, 3) of (u, v, p_x), that fit each other; the longest first."""
        points = segments.reshape(-1, 2, 2)
        du, dv = np.moveaxis(points[:, 1] - points[:, 0], -1, 0)
        slope, longest = du / np.where(dv == 0, 1e-9, dv), np.argsort(-np.hypot(du, dv), kind="stable")
        middle = points[..., 0].mean(axis=1)
        candidates = []
        for (low_slope, high_slope), (low, high), lateral in zip(self._region.slope, self._region.middle, self._lateral, strict=True):
            fits = (slope > low_slope - SLOPE_MARGIN) & (slope < high_slope + SLOPE_MARGIN)
            fits &= (middle > low - PLACE_MARGIN_PX) & (middle < high + PLACE_MARGIN_PX)
            chosen = longest[fits[longest]][:MOST_SEGMENTS]
            candidates.append([np.insert(part, 2, lateral, axis=1) for part in points[np.sort(chosen)]])
        pairs = [(left, right) for left, right in itertools.product(*candidates) if self._symmetric(left, right)]
        pairs.sort(key=lambda pair: -sum(abs(part[1, 1] - part[0, 1]) for part in pair))
        return pairs[:MOST_PAIRS]

    def _symmetric(self, left: Floats, right: Floats) -> bool:
        """True if both show the ground at one scale, where their rows overlap or come nearest; or, where x is free, an x of the domain."""
        low, high = max(left[:, 1].min(), right[:, 1].min()), min(left[:, 1].max(), right[:, 1].max())
        u0, width_m = self._scene.camera.u0, self._lateral[1] - self._lateral[0]
        rows = np.array([(low + high) / 2] if self._x is not None else [low, high])
        columns = [part[0, 0] + (rows - part[0, 1]) * _slope(part) - u0 for part in (left, right)]
        if self._x is not None:
            scales = [column / (lateral - self._x) for column, lateral in zip(columns, self._lateral, strict=True)]
            return bool(abs(scales[0] - scales[1]) * np.abs(self._lateral - self._x).max() < SYMMETRY_PX)
        scale = (columns[1] - columns[0]) / width_m
        if (scale <= 0).any():
            return False
        x = self._lateral[0] - columns[0] / scale
        least, most = (side[1] for side in (self._scene.domain.lower, self._scene.domain.upper))
        margin = DOMAIN_MARGIN * (most - least)
        inside = (x > least - margin) & (x < most + margin)
        return bool(inside.all() and np.ptp(x) * scale.max() < SYMMETRY_PX)

    def _measured(self, points: Floats, centres: Floats) -> Measured | None:
        """Lines fitted to all pixels near a pair's, and the rows of the ends; None where fewer than two rows are left."""
        u, v, lateral = points.T
        line, marking = self._fitted(u, v, lateral), np.zeros(len(u))
        for near in NEAR_LINE_PX:
            columns, rows = np.broadcast_arrays(centres[0], centres[1])
            tangent, (a, b, c, d) = self._tangent(rows), line
            offsets = columns - self._scene.camera.u0 - self._lateral[:, None] * (tangent * a + b) + (tangent * c + d)
            steepness = np.maximum(np.abs(self._lateral * a - c) / self._scene.camera.focal_v_px, 1)  # columns a row
            taken = np.abs(offsets) <= near * steepness[:, None]
            marking, pixel = np.nonzero(taken)
            if len(pixel) < 4:
                return None
            u, v, lateral = columns[pixel], rows[pixel], self._lateral[marking]
            line = self._fitted(u, v, lateral)
        common = np.intersect1d(v[marking == 0], v[marking == 1])
        runs = np.split(common, np.flatnonzero(np.diff(common) > LARGEST_GAP + 1) + 1)
        run = max(runs, key=len)
        if len(run) < 2:
            return None
        inside = (v >= run[0]) & (v <= run[-1])
        u, v, lateral = u[inside], v[inside], lateral[inside]
        return Measured(u, v, lateral, near_row=run[-1], far_row=run[0], line=self._fitted(u, v, lateral))

    def _tangent(self, v: Floats | float) -> Floats:
        return (np.asarray(v) - self._scene.camera.v0) / self._scene.camera.focal_v_px

    def _fitted(self, u: Floats, v: Floats, lateral: Floats) -> Floats:
        """(a, b, c, d) of u - u0 = p_x (a t + b) - (c t + d), c = x a and d = x b if x is known, by linear least squares."""
        tangent, offset = np.stack([self._tangent(v), np.ones_like(v)], axis=1), u - self._scene.camera.u0
        if self._x is not None:
            scale = np.linalg.lstsq((lateral - self._x)[:, None] * tangent, offset, rcond=None)[0]
            return np.concatenate([scale, self._x * scale])
        design = np.concatenate([lateral[:, None] * tangent, -tangent], axis=1)
        return np.asarray(np.linalg.lstsq(design, offset, rcond=None)[0], dtype=np.float64)

    def _solve(self, measured: Measured, solver: str) -> Floats:
        return self._by_solve_pnp(measured) if solver == "solvePnP" else self._by_least_squares(measured)

    def _by_lines(self, measured: Measured) -> Floats:
        """Pose (theta, x, y, z) of the fitted lines and the ends: tan(theta) = b/a, y = F_u cos(theta)/a, z by the near end."""
        slope, scale = measured.line[:2]
        theta = np.arctan2(scale, slope)
        y = self._scene.camera.focal_u_px * np.cos(theta) / slope
        beta = theta + np.arctan(self._tangent(measured.near_row))
        with np.errstate(divide="ignore"):  # of lines that show the near end on the horizon
            return np.array([theta, measured.x, y, y / np.tan(beta) - self._near_z])

    def _by_least_squares(self, measured: Measured) -> Floats:
        """Gauss-Newton on all columns and both ends, from the pose of the lines; x stays if it is known."""
        state = self._by_lines(measured)
        steps = 1e-6 * np.eye(4)[[0, 2, 3] if self._x is not None else slice(None)]
        for _ in range(NEWTON_STEPS):
            if not np.isfinite(state).all() or state[2] <= 0:
                break
            residual = self._residuals(measured, state)
            jacobian = np.stack([self._residuals(measured, state + step) - residual for step in steps], axis=1) / 1e-6
            if not np.isfinite(jacobian).all():
                return np.full(4, np.nan)
            state = state - 1e6 * np.linalg.lstsq(jacobian, residual, rcond=None)[0] @ steps
        return state

    def _residuals(self, measured: Measured, state: Floats) -> Floats:
        """Columns and rows of the ends as predicted less as measured, px; all are known to within a pixel and weigh the same.

        An end in the frame's last or first row may lie beyond it, and tells nothing.
        """
        theta, x, y, z = state
        camera = self._scene.camera
        columns = camera.u0 + (measured.lateral - x) * ground_scale(camera, theta, y, measured.v) - measured.u
        ends = ((self._near_z, measured.near_row, camera.height - 0.5), (self._far_z, measured.far_row, 0.5))
        rows = [row_of_point(camera, theta, y, end + z) - row for end, row, last in ends if row != last]
        return np.concatenate([columns, rows])

    def _by_solve_pnp(self, measured: Measured) -> Floats:
        """cv2.solvePnP with the four ends on the fitted lines, six degrees of freedom; pitch, altitude and distance of what it finds."""
        camera = self._scene.camera
        scene_points, image_points = [], []
        a, b, c, d = measured.line
        for p_x in self._lateral:
            for p_z, row in ((self._near_z, measured.near_row), (self._far_z, measured.far_row)):
                tangent = self._tangent(row)
                scene_points.append((p_x, p_z, 0.0))  # right, ahead, up
                image_points.append((camera.u0 + p_x * (tangent * a + b) - (tangent * c + d), row))
        matrix = np.array([[camera.focal_u_px, 0, camera.u0], [0, camera.focal_v_px, camera.v0], [0, 0, 1]])
        points = np.array(scene_points), np.array(image_points)
        try:
            _, turn, shift = cv2.solvePnP(*points, matrix, None, flags=cv2.SOLVEPNP_ITERATIVE)
        except cv2.error:  # of four points all but on one line
            return np.full(4, np.nan)
        rotation = cv2.Rodrigues(turn)[0]
        right, ahead, up = (-rotation.T @ shift).ravel()
        pitch = np.arctan2(-rotation[2, 2], rotation[2, 1])
        return np.array([pitch, right if self._x is None else self._x, up, -ahead], dtype=np.float64)

    def _plausible(self, state: Floats) -> Floats | None:
        """The state, moved into the domain; None if it is too far from it."""
        if not np.isfinite(state).all():
            return None
        domain = self._scene.domain
        inside = domain.nearest(state)
        return inside if (np.abs(state - inside) <= DOMAIN_MARGIN * (domain.upper - domain.lower)).all() else None

    def _share_lit(self, frame: Frame, state: Floats) -> float:
        """Share of the rows' centres on the predicted markings that are lit."""
        camera = self._scene.camera
        near, far = (row_of_point(camera, state[0], state[2], end + state[3]) for end in (self._near_z, self._far_z))
        rows = np.arange(max(int(np.ceil(far - 0.5)), 0), min(int(np.floor(near + 0.5)), camera.height)) + 0.5
        columns = camera.u0 + np.outer(self._lateral - state[1], ground_scale(camera, state[0], state[2], rows))
        inside = (columns >= 0) & (columns < camera.width)
        lit = frame[np.broadcast_to(rows, columns.shape)[inside].astype(int), columns[inside].astype(int)]
        return float(lit.mean()) if lit.size else 0.0


def _slope(points: Floats) -> float:
    """Columns a row of a segment's points (2, 3)."""
    rise = points[1, 1] - points[0, 1]
    return float((points[1, 0] - points[0, 0]) / rise) if rise else 0.0


@dataclass(frozen=True)
class Answer:
    """What one method says of one frame."""

    clutter: float
    truth: Floats
    method: str
    state: Floats | None
    milliseconds: float

    @property
    def apart(self) -> Floats:
        """State minus truth; NaN without an answer."""
        return np.full(4, np.nan) if self.state is None else self.state - self.truth

    @property
    def error(self) -> float:
        """2-norm of state minus truth; NaN without an answer."""
        return float(np.linalg.norm(self.apart))


@functools.cache
def undistortion(scene: Scene, ideal: Scene) -> Callable[[Frame], Frame]:
    """What users do with frames of a lens first: OpenCV's undistortion, onto the ideal frame, each pixel from the one that it lies in."""
    camera, to = scene.camera, ideal.camera
    if camera.distortion is None or camera.pinhole:
        return lambda frame: frame
    matrices = [
        np.array([[each.focal_u_px, 0, each.u0 - 0.5], [0, each.focal_v_px, each.v0 - 0.5], [0, 0, 1]])  # OpenCV counts from centres
        for each in (camera, to)
    ]
    coefficients, size = np.array(camera.distortion.coefficients), (to.width, to.height)
    of = cv2.fisheye.initUndistortRectifyMap if camera.distortion.model == "fisheye" else cv2.initUndistortRectifyMap
    maps = of(matrices[0], coefficients, np.eye(3), matrices[1], size, cv2.CV_32FC1)
    return lambda frame: np.asarray(cv2.remap(frame, maps[0], maps[1], cv2.INTER_NEAREST), dtype=np.uint8)


def has_network(estimator: Estimator) -> bool:
    """True unless the model's NN_e says NaN of a dark frame, as the one does that stands for none."""
    dark = np.zeros(estimator.scene.camera.shape, dtype=np.uint8)
    return bool(np.isfinite(estimator.estimate(dark, refine=False).network_state).all())


def answers_of(
    estimator: Estimator, baseline: Baseline, truth: Floats, frame: Frame, clutter: float, network: bool = True
) -> Iterator[Answer]:
    """Every method on one frame: ours first, NN_e alone if there is a `network`; then each detector with each solver,
    behind a lens on the undistorted frame.
    """
    straight = undistortion(estimator.scene, estimator.ideal)
    if network:
        unrefined, milliseconds = timed(lambda: estimator.estimate(frame, refine=False))
        yield Answer(clutter, truth, "ours: NN_e alone", unrefined.network_state, milliseconds)
    estimate, milliseconds = timed(lambda: estimator.estimate(frame))
    centre = None if estimate.box is None else estimate.box.centre
    yield Answer(clutter, truth, "ours: centre of the box", centre, milliseconds)
    yield Answer(clutter, truth, OURS, estimate.state, milliseconds)
    for detector, solver in itertools.product(DETECTORS, SOLVERS):
        state, milliseconds = timed(lambda detector=detector, solver=solver: baseline.estimate(straight(frame), detector, solver))
        yield Answer(clutter, truth, f"{detector}, {solver}", state, milliseconds)


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """The result of a call, and the processor time of this thread that it took, ms."""
    start = time.thread_time()
    result = call()
    return result, (time.thread_time() - start) * 1e3


Groups = dict[tuple[float, str], list[Answer]]
"""The answers of each clutter density and method."""


def grouped(answers: Sequence[Answer]) -> Groups:
    """Answers by clutter density and method, in the order in which they first appear."""
    groups: Groups = {}
    for answer in answers:
        groups.setdefault((answer.clutter, answer.method), []).append(answer)
    return groups


def table_of(groups: Groups, scene: Scene) -> Table:
    """Errors, failures and times of each clutter density and method."""
    free = ~scene.domain.fixed
    extent = (scene.domain.upper - scene.domain.lower)[free]
    table = Table(title="Error: 2-norm over theta (rad), x, y, z (m)", title_justify="left")
    for heading in ("clutter", "method", "frames", "error 50 %", "95 %", "largest", "no answer", "failures", "ms", "x ours"):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    times = {group: float(np.median([answer.milliseconds for answer in answers])) for group, answers in groups.items()}
    before = None
    for (clutter, method), answers in groups.items():
        if before not in (None, clutter):
            table.add_section()
        before, known = clutter, [answer for answer in answers if answer.state is not None]
        quantiles = np.quantile([answer.error for answer in known], [0.5, 0.95, 1.0]) if known else []
        figures = [f"{value:.4g}" for value in quantiles] or ["-"] * 3
        near = sum(np.linalg.norm(answer.apart[free] / extent) <= GROSS_ERROR for answer in known)
        shares = [f"{1 - len(known) / len(answers):.1%}", f"{1 - near / len(answers):.1%}"]
        ms, ours = times[clutter, method], times[clutter, OURS]
        table.add_row(f"{clutter:.0%}", method, str(len(answers)), *figures, *shares, f"{ms:.2f}", f"{ms / ours:.2f}")
    return table


def table_of_axes(groups: Groups, scene: Scene) -> Table:
    """Errors on each free axis, median and 95 %."""
    free = [axis for axis in range(4) if not scene.domain.fixed[axis]]
    table = Table("clutter", "method", title="Errors of each axis: 50 %, 95 %", title_justify="left")
    for axis in free:
        table.add_column(f"{STATE_NAMES[axis]}, {'rad' if axis == 0 else 'm'}", justify="right")
    for (clutter, method), answers in groups.items():
        apart = np.array([answer.apart for answer in answers if answer.state is not None])
        quantiles = np.quantile(np.abs(apart), [0.5, 0.95], axis=0).T if len(apart) else np.zeros((4, 0))
        table.add_row(f"{clutter:.0%}", method, *(", ".join(f"{value:.2g}" for value in quantiles[axis]) or "-" for axis in free))
    return table


HEADER = ["clutter", "method", "theta_rad", "x_m", "y_m", "z_m", "error", "ms", *(f"found_{name}" for name in ("theta", "x", "y", "z"))]


def figures_of(answer: Answer) -> list[object]:
    """One row of the CSV, in the order of `HEADER`."""
    found = [""] * 4 if answer.state is None else list(map(float, answer.state))
    return [answer.clutter, answer.method, *map(float, answer.truth), answer.error, answer.milliseconds, *found]


def main(
    model: Annotated[Path, typer.Option(help="Model to compare.")] = Path("models/paper.onnx"),
    frames: Annotated[int, typer.Option(min=1, help="Frames a clutter density.")] = 200,
    clutter: Annotated[list[float] | None, typer.Option(help="Densities of random clutter; give it more than once.")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV file, a row a frame and method.")] = Path("out/compare_opencv.csv"),
    missed_budget: Annotated[int | None, typer.Option(min=0, help="In place of the model's; none is missed on these frames.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of states and clutter; the baseline was tuned on 2.")] = 1,
) -> None:
    """Compare errors and times, print the table and write the CSV."""
    cv2.setNumThreads(1)
    errors = terminal.console(stderr=True)
    try:
        estimator = Estimator.load(model, missed_budget=missed_budget)
        baseline = Baseline(estimator.ideal)
    except (ModelError, ValueError) as error:
        fail(error)
    answers: list[Answer] = []
    network = has_network(estimator)
    for density in clutter or [0.0, 0.02, 0.05]:
        drawn = draw_frames(estimator.scene, frames, density, seed)
        for truth, frame in track(drawn, f"clutter {density:.0%}", total=frames, console=errors, transient=True):
            answers.extend(answers_of(estimator, baseline, truth, frame, density, network))
    groups = grouped(answers)
    terminal.console(150).print(table_of(groups, estimator.scene), table_of_axes(groups, estimator.scene))
    write_csv(output, HEADER, [figures_of(answer) for answer in answers])


if __name__ == "__main__":
    terminal.run(main)

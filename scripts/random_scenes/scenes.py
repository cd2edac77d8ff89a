"""Scenes drawn at random: frames, lenses, altitudes, runways, domains and banks of all sizes that a scene file can hold.

A scene is drawn about what its camera sees (`random_scenes.sights`). Its cells are as wide as a bank can serve whose entries move a line
by well under a pixel, or narrower; its calibration uses its tolerance up; and its coordinates are shifted by up to 100 km. All of this is
a plan in float64: what a frame of the scene shows is decided in fractions elsewhere.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from build_model.calibration import displacement_px
from build_model.pixel_mask import Window
from build_model.window_bank import group_count
from random_scenes.divisions import EQUAL, Division, draw_division, stretch_of
from random_scenes.sights import PLACES, Floats, Rng, Sight, UndrawableError, draw_camera, mirrored
from runtime.camera import ground_scale, project, row_of_point
from runtime.domain import Domain, Edges, Growth
from runtime.scene import STATE_NAMES, Bank, Calibration, EstimatorTraining, Marking, Runway, Scene, SceneError, Tolerance, WindowedBank

FARTHEST_SHIFT_M = 1e5
MOST_CELLS, MOST_OF_AN_AXIS = 81, 3
MOST_ENTRIES = 2000
MOST_PAINTED = 3e8
"""Limit on the pixels that a bank paints, in all slices and entries: a second or two."""
MOST_AT_ONCE = 1e8
"""The same of one cell, which are in memory together."""
MOST_ROWS = 1.5e7
"""Limit on the rows that a bank encloses, in all slices and entries and markings."""
WINDOWED_SHARE = 1 / 3
"""Share of the scenes that have a bank of windows."""
MOST_GROUPS = 600
"""Limit on its groups, the same share of it for each cell: a second or two."""
MANY_BINS, FEW_BINS = (6, 9, 20, 5), (2, 2, 5, 3)
"""Bins of theta, x, scale and z stay below these."""
ENOUGH_BINS = 8
"""With no more bins a cell, cells are given up before bins."""
SLICES = 32
"""Slices of a cell whose masks the build paints beside those of the entries."""
NARROWEST = 2e-6
"""Cells that would be narrower than this make a fixed axis, rad or m."""
EXACT = Calibration()
UNTRAINED = EstimatorTraining(training_frames=256, epochs=1)
BOUNDS_USED = 0.98
"""Share of the tolerance that the calibration's bounds use up."""


@dataclass(frozen=True)
class DrawnScene:
    """A scene, and the kinds that it belongs to: its place first."""

    scene: Scene
    kinds: tuple[str, ...]


@dataclass(frozen=True)
class Rates:
    """How the image moves with the state, px per rad or m, largest over what is in view; and how much of it there is.

    `line` is how far columns move with theta at one scale, `ends` how far rows of ends in view move with theta, y and z, all ends
    with `all_ends`; `lever` and `reference_scale` are the bank's; `growth` is by how much the scale exceeds the reference row's.
    """

    line: float
    ends: Floats
    lever: float
    reference_scale: float
    outermost: float
    growth: float
    longest: float

    @staticmethod
    def of(sight: Sight) -> Rates:
        """The rates of a sight. Raises `UndrawableError` where nothing is in view."""
        outlook = sight.outlook
        shown = [(sight.across[marking], sight.in_view(marking)) for marking in range(len(sight.rows))]
        seen = [(across, rows) for across, rows in shown if rows is not None]
        if not seen or max(bottom - top for _, (top, bottom) in seen) < 0.02:
            raise UndrawableError("nothing in view")
        reference = reference_row(sight)
        angle, scale = outlook.angle(reference), outlook.scale(reference)
        borders = [(across, row) for across, rows in seen for row in rows]
        turning = [abs(across * outlook.scale(row) * (1 / math.tan(outlook.angle(row)) - 1 / math.tan(angle))) for across, row in borders]
        return Rates(
            line=max(turning),
            ends=end_rates(sight),
            lever=max(float(np.abs(sight.across).max()), 1e-3),
            reference_scale=scale,
            outermost=max(abs(across * outlook.scale(row)) for across, row in borders) / scale,
            growth=max(outlook.scale(row) for _, row in borders) / scale,
            longest=max(bottom - top for _, (top, bottom) in seen),
        )


def reference_row(sight: Sight) -> float:
    """The row in which the bank states scales: where the middle of all markings is seen."""
    outlook = sight.outlook
    return float(row_of_point(outlook.camera, outlook.theta, outlook.y, sight.ahead.mean()))


def end_rates(sight: Sight) -> Floats:
    """Rows by which the ends in view move with theta, y and z, (3,), the largest; 0 where no end is in view."""
    outlook = sight.outlook
    rates = np.zeros(3)
    for rows, distances in zip(sight.rows, sight.ahead, strict=True):
        for row, d in zip(reversed(rows), distances, strict=True):
            if -1 <= row <= outlook.camera.height + 1:
                steepness = outlook.camera.focal_v_px / math.cos(math.atan2(outlook.y, d) - outlook.theta) ** 2
                rates = np.maximum(rates, steepness * np.array([1.0, d, outlook.y]) / [1.0, *[d**2 + outlook.y**2] * 2])
    return rates


@dataclass(frozen=True)
class Plan:
    """Cells and bank about a sight. Arrays are (4,), by theta, x, y, z; a cell is divided into `bins` of theta, x, scale and z.

    `steps`: what one bin may be wide, rad or m, so that an entry has pixels to be sure of. `limits`: what the domain may be wide. `shares`:
    how much of that is used; 0 fixes the axis, and above 1 the build has to halve its entries.
    """

    steps: Floats
    limits: Floats
    shares: Floats
    bins: Floats
    counts: Floats
    column_px: float
    lateral_px: float
    division: Division = EQUAL

    @property
    def widths(self) -> Floats:
        """Width of a cell on each axis."""
        shares = np.where(self.shares > 0, self.shares, 1.0)
        widths = np.minimum(shares * self.bins * self.steps, np.minimum(shares, 1) * self.limits / self.counts)
        return np.where((self.shares == 0) | (widths < NARROWEST), 0.0, widths)

    @property
    def bank(self) -> Bank:
        """The bank that serves the cells."""
        return Bank(int(self.bins[0]), int(self.bins[3]), self.column_px, self.lateral_px)

    def domain(self, centres: tuple[float, ...]) -> Domain:
        """The domain about a state (4,)."""
        return self.division.domain(centres, self.widths.tolist(), self.counts.astype(int).tolist())

    def affordable(self, scene: Scene) -> bool:
        """True if the bank takes a second or two. Raises `UndrawableError` if nothing is in view."""
        window, markings = window_in_view(scene), len(scene.runway.markings)
        pixels = (window.bottom - window.top) * (window.right - window.left)
        entries, cells = math.prod(self.bins * np.maximum(self.shares, 1)), scene.domain.cell_count
        entries *= stretch_of(scene.domain, self.widths)
        masks = SLICES + 3 * entries  # O, K, and O again within S
        rows = cells * (SLICES + entries) * markings * scene.camera.height
        painted = masks * pixels <= MOST_AT_ONCE and cells * masks * pixels * markings <= MOST_PAINTED
        return cells * entries <= MOST_ENTRIES and painted and rows <= MOST_ROWS

    def coarser(self) -> Plan:
        """The plan with fewer bins, or fewer cells where bins are few. Raises `UndrawableError` if there is nothing left to divide."""
        if math.prod(self.bins) > ENOUGH_BINS or max(self.counts) == 1:
            if max(self.bins) == 1:
                raise UndrawableError("too large a bank")
            return replace(self, bins=one_less(self.bins))
        return replace(self, counts=one_less(self.counts))


def one_less(numbers: Floats) -> Floats:
    """The numbers with the largest one less."""
    return numbers - (np.arange(len(numbers)) == numbers.argmax())


def draw_plan(rng: Rng, sight: Sight) -> Plan:
    """Cells that a bank can serve: within an entry a line moves by a share of a pixel, and ends by a share of what is in view."""
    rates = Rates.of(sight)
    turned, shifted, scaled = rng.uniform(0.05, 0.35, 3)
    end_rows = rng.uniform(0.05, 0.4) * rates.longest
    column_px = float(np.clip(scaled * rates.lever / max(rates.outermost, 1e-12), 0.01, 10))
    lateral_px = float(np.clip(shifted / rates.growth, 0.01, 10))
    with np.errstate(divide="ignore"):
        ends = end_rows / rates.ends
    altitude_step = sight.outlook.y * column_px / (rates.lever * rates.reference_scale)
    steps = [min(turned / max(rates.line, 1e-12), ends[0]), lateral_px / rates.reference_scale, min(altitude_step, ends[1]), ends[2]]
    counts = np.array([1, 1, 1, 1] if sight.few_sets else draw_counts(rng))
    fixed = (rng.random(4) < (0.12, 0.6, 0.2, 0.15)) & (counts < MOST_OF_AN_AXIS)
    width = rng.choice([0.1, 1.0, 10.0], 4, p=[0.25, 0.55, 0.2]) ** rng.uniform(0, 1, 4)
    return Plan(
        steps=np.array(steps),
        limits=widest(sight, rates),
        shares=np.where(fixed, 0.0, width),
        bins=np.where(fixed, 1, rng.integers(1, FEW_BINS if sight.few_sets else MANY_BINS)).astype(float),
        counts=np.where(fixed, 1, counts).astype(float),
        column_px=column_px,
        lateral_px=lateral_px,
        division=draw_division(rng.spawn(1)[0], MOST_OF_AN_AXIS),
    )


def draw_counts(rng: Rng) -> list[int]:
    """Cells on each axis, 1 to 81 in all, few more often than many."""
    most = int(rng.choice([1, 4, 9, 27, MOST_CELLS], p=[0.5, 0.22, 0.14, 0.1, 0.04]))
    if most == MOST_CELLS:
        return [MOST_OF_AN_AXIS] * 4
    counts = [1, 1, 1, 1]
    for axis in rng.permutation(4).tolist() * 2:
        counts[axis] *= int(rng.integers(1, min(most // math.prod(counts), MOST_OF_AN_AXIS) + 1))
    return counts


def widest(sight: Sight, rates: Rates) -> Floats:
    """Widths (4,) of a domain all of whose states have the runway ahead of them, and its ends as steady as the place asks."""
    outlook, d, far = sight.outlook, sight.ahead.min(), sight.ahead.max()
    y, theta = outlook.y, outlook.theta
    spare = min(math.pi / 2 - (math.atan2(y, d) - theta), math.pi / 2 + math.atan2(y, far) - theta)
    below_horizon = max(outlook.angle(0.0), math.atan2(y, far))
    turning = [0.5 * spare, 1.8 * (math.pi / 2 - abs(theta)), below_horizon]
    rising, nearing = 0.5 * spare * (d**2 + y**2) / d, 0.5 * spare * (d**2 + y**2) / y
    limits = np.array([min(turning), math.inf, min(rising, 0.5 * y), min(nearing, 1.5 * d)])
    with np.errstate(divide="ignore"):
        return np.minimum(limits, np.insert(sight.steadiness_px / rates.ends, 1, math.inf))


@dataclass(frozen=True)
class Setting:
    """Where the sight is put: the camera `z_m` before the threshold, and all coordinates shifted by `across_m` and `along_m`."""

    z_m: float
    across_m: float
    along_m: float

    @staticmethod
    def draw(rng: Rng, sight: Sight) -> Setting:
        """At the nearest end or elsewhere; not shifted, or by up to 100 km."""
        nearest = float(sight.ahead.min())
        far = 10.0 ** rng.uniform(0, math.log10(FARTHEST_SHIFT_M), 2) * rng.choice([-1, 1], 2)
        across_m, along_m = np.where(rng.random(2) < 0.5, 0.0, far).tolist()
        return Setting(nearest * float(rng.choice([1.0, rng.uniform(-1, 2)])), across_m, along_m)

    def scene(self, sight: Sight, plan: Plan, tolerance: Tolerance, calibration: Calibration = EXACT) -> Scene:
        """The scene. Raises `SceneError` where its own checks refuse it."""
        z_m = self.z_m + self.along_m
        markings = [
            Marking(f"m{number}", float(across) + self.across_m, float(near) - z_m, float(far - near))
            for number, (across, (near, far)) in enumerate(zip(sight.across, sight.ahead, strict=True))
        ]
        domain = plan.domain((sight.outlook.theta, self.across_m, sight.outlook.y, z_m))
        return Scene(sight.outlook.camera, Runway(tuple(markings)), domain, plan.bank, calibration, tolerance, UNTRAINED)


def window_in_view(scene: Scene) -> Window:
    """About what all markings fill of the frame over the whole domain. Raises `UndrawableError` if nothing."""
    corners = np.array(list(itertools.product(*zip(scene.domain.lower, scene.domain.upper, strict=True))))
    height, width = scene.camera.shape
    ends = project(scene, corners)
    shares = np.linspace(0, 1, 5)[:, None]
    steps = np.clip(ends[..., 1], 0, height)
    rows = steps[..., :1] + (steps[..., 1:] - steps[..., :1]) * shares.T
    scales = ground_scale(scene.camera, corners[:, None, None, 0], corners[:, None, None, 2], rows)
    columns = scene.camera.u0 + (scene.runway.x_m[None, :, None] - corners[:, None, None, 1]) * scales
    seen = (ends[..., 1].max(axis=-1) > 0) & (ends[..., 1].min(axis=-1) < height)
    if not seen.any():
        raise UndrawableError("nothing in view")
    left, right = (int(np.clip(bound, 0, width)) for bound in (columns[seen].min() - 3, columns[seen].max() + 4))
    top, bottom = (int(np.clip(bound, 0, height)) for bound in (rows[seen].min() - 3, rows[seen].max() + 4))
    if left >= right or top >= bottom:
        raise UndrawableError("nothing in view")
    return Window(top, bottom, left, right)


def draw_tolerance(rng: Rng) -> Tolerance:
    """Mostly none; else up to 2 px, a few missed pixels, and Theorem B's budget."""
    return Tolerance(
        line_px=int(rng.choice([0, 1, 2], p=[0.6, 0.25, 0.15])),
        missed_budget=int(rng.choice([0, 1, 4], p=[0.7, 0.2, 0.1])),
        extra_budget=int(rng.choice([-1, 0, 3], p=[0.8, 0.1, 0.1])),
    )


def draw_calibration(rng: Rng, scene: Scene) -> Calibration:
    """Bounds that use up the tolerance, in one of the calibration's numbers or in all."""
    line_px = scene.tolerance.line_px
    if line_px == 0 or rng.random() < 0.2:
        return Calibration()
    shares = rng.random(4) if rng.random() < 0.5 else np.eye(4)[rng.integers(4)]
    most = shares * [0.1, 0.1, 0.2, 2.0]
    window = window_in_view(scene)
    wide = Window(window.top - line_px, window.bottom + line_px, window.left - line_px, window.right + line_px)
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (
            (middle, high) if moves_within(replace(scene, calibration=Calibration(*(middle * most))), wide, line_px) else (low, middle)
        )
    return Calibration(*(float(value) for value in low * BOUNDS_USED * most))


def moves_within(scene: Scene, window: Window, most_px: float) -> bool:
    """True if the calibration moves nothing in the window by more than `most_px`."""
    try:
        return displacement_px(scene, window) <= most_px
    except SceneError:
        return False


def draw_scene(rng: Rng) -> DrawnScene:
    """A scene of some place. Raises `SceneError` where the scene's own checks refuse it."""
    while True:
        try:
            return draw_once(rng)
        except UndrawableError:
            continue


def draw_once(rng: Rng) -> DrawnScene:
    """One try. Raises `UndrawableError`, or `SceneError`."""
    place = str(rng.choice(list(PLACES), p=[share for share, _ in PLACES.values()]))
    sight = mirrored(rng, PLACES[place][1](rng, draw_camera(rng), int(rng.integers(1, 5))))
    plan, tolerance, setting = draw_plan(rng, sight), draw_tolerance(rng), Setting.draw(rng, sight)
    scene = setting.scene(sight, plan, tolerance)
    while not plan.affordable(scene):
        plan = plan.coarser()
        scene = setting.scene(sight, plan, tolerance)
    scene = in_windows(rng.spawn(1)[0], scene, sight, plan, setting)
    scene = replace(scene, calibration=draw_calibration(rng, scene))
    return DrawnScene(scene, (place, *kinds_of(scene, setting)))


def in_windows(rng: Rng, scene: Scene, sight: Sight, plan: Plan, setting: Setting) -> Scene:
    """One scene of three with a bank of windows, over a domain up to 16 times as wide on each axis, if that can be built quickly."""
    bank = WindowedBank(float(10 ** rng.uniform(0.3, 2)), int(rng.integers(3, 25)), int(10 ** rng.uniform(0, 2.5)))
    if rng.random() > WINDOWED_SHARE:
        return scene
    for factor in (16 ** rng.uniform(0, 1), 1.0):
        try:
            wide = replace(setting.scene(sight, replace(plan, steps=plan.steps * factor), scene.tolerance), bank=bank)
            lower, upper = wide.domain.cells()
            most = MOST_GROUPS // len(lower)
            if all(group_count(wide, *cell, most) <= most for cell in zip(lower, upper, strict=True)):
                return wide
        except SceneError:
            continue
    return scene


def kinds_of(scene: Scene, setting: Setting) -> list[str]:
    """What else a scene is an instance of."""
    camera, cells = scene.camera, scene.domain.cell_count
    pixels = camera.width * camera.height
    domain = scene.domain
    free = [name for name, fixed in zip(STATE_NAMES, domain.fixed, strict=True) if not fixed]
    kinds = {
        f"{len(scene.runway.markings)} markings": True,
        "x free": "x" in free,
        "theta fixed": "theta" not in free,
        "all axes fixed": not free,
        "1 cell": cells == 1,
        "2 to 9 cells": 2 <= cells <= 9,
        "10 to 81 cells": cells >= 10,
        "unlike edges": any(isinstance(axis, Edges) and len(axis.edges) > 2 for axis in domain.axes),
        "cells by a ratio": any(isinstance(axis, Growth) for axis in domain.axes),
        "glide": domain.glide is not None,
        "bank of windows": isinstance(scene.bank, WindowedBank),
        "coordinates above 1 km": max(abs(setting.across_m), abs(setting.along_m)) > 1000,
        "frame below 10,000 px": pixels < 1e4,
        "frame above 1,000,000 px": pixels > 1e6,
        "principal point out of the frame": not (0 <= camera.u0 <= camera.width and 0 <= camera.v0 <= camera.height),
        "pixels not square": camera.focal_u_px != camera.focal_v_px,
        f"line_px {scene.tolerance.line_px}": scene.tolerance.line_px > 0,
        "camera off": not scene.calibration.exact,
    }
    return [kind for kind, holds in kinds.items() if holds]

"""The certificate at scales far from the paper's: fixed scenes, one for each kind that the campaign over random scenes draws.

A scene is given by what its camera sees: the rows where markings end, and the columns they pass through (`random_scenes.sights`). Frames
are the campaign's: clutter, dark pixels in the worst places, budgets up to |K| - 1, Theorem B, states on faces and at the border of what
the frame allows. Whatever the campaign calls a finding fails the test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("faery", reason="the extra 'recordings' is not installed")

from random_scenes.models import build_scene, forget_scenes
from random_scenes.outcomes import Outcomes
from random_scenes.scenes import DrawnScene, Plan, Setting
from random_scenes.sights import Outlook, Sight
from random_scenes.trial import Trial

from runtime.scene import Calibration, Camera, Scene, Tolerance

FRAMES, SEED, PATIENCE_S = 10, 7, 20.0
EXACT, EXACTLY = Calibration(), Tolerance()


@dataclass(frozen=True)
class Seen:
    """What a camera of `pixels` (width, height, focal length) sees at a pitch and an altitude, and the domain about it."""

    pixels: tuple[int, int, float]
    theta: float
    y: float
    rows: list[tuple[float, float]]
    """Of the far and the near end of each marking."""
    columns: list[float]
    widths: tuple[float, float, float, float]
    """Of a cell, along theta, x, y and z."""
    counts: tuple[int, int, int, int] = (1, 1, 1, 1)
    bins: tuple[int, int] = (1, 1)
    """Of theta and z in a cell."""
    column_px: float = 0.4
    lateral_px: float = 0.35
    principal_point: tuple[float, float] | None = None
    shift: tuple[float, float] = (0.0, 0.0)
    """Of all x and of all z, m."""
    tolerance: Tolerance = EXACTLY
    calibration: Calibration = EXACT

    @property
    def scene(self) -> Scene:
        """The scene, with the threshold at the nearest end of a marking."""
        width, height, focal_px = self.pixels
        camera = Camera(width, height, focal_px * 1e-5, 1e-5, self.principal_point)
        sight = Sight(Outlook(camera, self.theta, self.y), self.rows, self.columns)
        bins = np.array([self.bins[0], 1.0, 1.0, self.bins[1]])
        plan = Plan(
            steps=np.array(self.widths) / bins,
            limits=np.full(4, math.inf),
            shares=np.array(self.widths) > 0,
            bins=bins,
            counts=np.array(self.counts),
            column_px=self.column_px,
            lateral_px=self.lateral_px,
        )
        setting = Setting(float(sight.ahead.min()), *self.shift)
        return setting.scene(sight, plan, self.tolerance, self.calibration)


DOWN = math.pi / 2
ROLLED, AT_CORNERS = Calibration(roll_rad=0.002), Calibration(0.001, 0.0005, 0.001, 0.3)
SCENES = {
    "an end a million rows below": Seen((640, 480, 1500.0), 0.0, 10.0, [(300, 1.3e6)], [120.0], (1e-4, 0, 1e-3, 1e-3)),
    "ends a hundred million rows below": Seen(
        (320, 240, 400.0), -0.1, 2.0, [(200, 1e7), (190, 6e7)], [60.0, 250.0], (3e-6, 0, 6e-5, 5e-6), column_px=0.3
    ),
    "far ends ten million rows above": Seen(
        (400, 300, 600.0), DOWN - 4e-5, 0.5, [(-1e7, 120), (-4e6, 100)], [90.4, 280.3], (0, 0, 2e-3, 1e-3), bins=(1, 2), column_px=0.2
    ),
    "all markings within one row": Seen(
        (64, 64, 200.0), 0.1, 3.0, [(40.2, 40.6), (40.3, 40.7)], [15.0, 50.0], (2e-4, 0, 0.004, 0.03), column_px=0.3
    ),
    "all markings within two rows, x free": Seen(
        (200, 100, 300.0), 0.05, 20.0, [(60.2, 61.6)], [90.0], (1e-3, 0.6, 0.4, 3.0), column_px=0.2, lateral_px=0.25
    ),
    "low over the threshold": Seen(
        (640, 480, 1600.0), 0.006, 10.0, [(232, 8000)] * 2, [100.0, 540.0], (0.003, 0, 1.0, 1.0), bins=(2, 1), column_px=2.0
    ),
    "32 x 32": Seen((32, 32, 40.0), 0.7, 0.3, [(4, 29), (6, 28)], [8.0, 25.0], (0.02, 0, 0.02, 0.02), bins=(2, 2)),
    "2000 x 1500, a long lens": Seen(
        (2000, 1500, 16000.0), 0.06, 150.0, [(500, 1200), (600, 1100)], [400.0, 1700.0], (2e-4, 0, 0.1, 4.0), bins=(2, 1)
    ),
    "the horizon in view": Seen(
        (640, 480, 500.0), -0.02, 60.0, [(260, 420), (262, 400)], [250.0, 420.0], (8e-4, 0, 2.0, 10.0), bins=(3, 1)
    ),
    "looking straight down": Seen(
        (500, 400, 450.0), DOWN - 1e-5, 40.0, [(30, 190), (60, 195)], [100.4, 300.1], (1.8e-5, 0, 0.3, 0.3), (1, 1, 1, 2)
    ),
    "100 km away": Seen((640, 480, 533.0), 0.6, 0.3, [(180, 330)] * 2, [260.0, 390.0], (0.02, 0, 0.006, 0.003), shift=(1e5, -1e5)),
    "looking down and 100 km away": Seen(
        (500, 400, 450.0), 1.4, 40.0, [(30, 200), (60, 180)], [100.0, 380.0], (0.01, 0.1, 0.3, 1.0), bins=(2, 1), shift=(-1e5, 1e5)
    ),
    "81 cells": Seen(
        (160, 120, 140.0), 0.5, 3.0, [(30, 100), (25, 90)], [40.0, 120.0], (0.01, 0.03, 0.06, 0.1), (3, 3, 3, 3), column_px=0.6
    ),
    "cut by left, top and bottom": Seen(
        (300, 200, 350.0), 0.5, 5.0, [(-60, 250), (-40, 260), (150, 270)], [1.0, 298.0, 150.0], (0.004, 0, 0.06, 0.3), bins=(2, 1)
    ),
    "principal point out of the frame": Seen(
        (600, 400, 400.0), 0.5, 30.0, [(40, 350), (90, 380)], [100.0, 420.0], (0.004, 0.05, 0.1, 0.5), principal_point=(900.0, -150.0)
    ),
    "four unlike markings": Seen(
        (640, 480, 700.0),
        0.45,
        80.0,
        [(50, 460), (100, 300), (200, 640), (-40, 260)],
        [150.0, 300.0, 420.0, 600.0],
        (0.001, 0, 0.6, 3.0),
        bins=(2, 2),
    ),
    "a mirrored pair": Seen((300, 200, 250.0), 0.3, 12.0, [(60, 180)] * 2, [100.0, 200.0], (0.01, 0, 0.4, 1.0), (2, 1, 2, 1), bins=(3, 1)),
    "a fixed pitch": Seen((640, 480, 533.0), 0.3, 7.0, [(120, 420), (150, 400)], [200.0, 450.0], (0, 0.05, 0.2, 0.5), (1, 2, 2, 1)),
    "camera off, 1 px": Seen(
        (400, 300, 400.0),
        0.4,
        25.0,
        [(60, 250), (80, 240)],
        [120.0, 280.0],
        (0.005, 0, 0.4, 1.0),
        bins=(2, 1),
        tolerance=Tolerance(line_px=1),
        calibration=ROLLED,
    ),
    "camera off at its corners, 2 px, cut": Seen(
        (400, 300, 400.0),
        0.6,
        25.0,
        [(-50, 250), (80, 340)],
        [3.0, 280.0],
        (0.005, 0, 0.4, 1.0),
        bins=(2, 1),
        tolerance=Tolerance(line_px=2, missed_budget=2),
        calibration=AT_CORNERS,
    ),
    "missed pixels and Theorem B by the scene": Seen(
        (300, 200, 250.0),
        0.35,
        6.0,
        [(40, 190), (70, 150)],
        [90.0, 230.0],
        (0.01, 0.02, 0.1, 0.4),
        bins=(2, 2),
        tolerance=Tolerance(missed_budget=4, extra_budget=3),
    ),
    "300 m up": Seen((800, 600, 3000.0), 0.25, 300.0, [(100, 500), (150, 450)], [250.0, 600.0], (5e-4, 0.4, 1.0, 3.0), bins=(2, 1)),
}


@pytest.mark.parametrize("name", SCENES)
def test_every_box_holds_what_it_must(name: str, tmp_path: Path) -> None:
    built = build_scene(DrawnScene(SCENES[name].scene, (name,)), tmp_path / "model.onnx", name)
    trial, outcomes = Trial(SEED, list(SCENES).index(name), FRAMES, PATIENCE_S), Outcomes()
    trial.judge_frames(built, range(FRAMES), outcomes)
    forget_scenes()
    assert outcomes.findings == []
    assert outcomes.counts[name]["judged"] >= outcomes.counts[name]["certified"] == FRAMES

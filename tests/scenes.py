"""Scenes, states and frames that several tests share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import reject, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from build_model.spatial_filter import reference_row
from runtime.camera import ground_scale
from runtime.domain import Edges, Glide, Growth
from runtime.scene import (
    Axis,
    Bank,
    Calibration,
    Camera,
    Domain,
    EstimatorTraining,
    Marking,
    Runway,
    Scene,
    SceneError,
    Tolerance,
    WindowedBank,
)
from runtime.state_set import StateSet, scale_range, tangent_of_row

Floats = NDArray[np.float64]
Frame = NDArray[np.uint8]

QUICK = EstimatorTraining(training_frames=256, epochs=1)
"""NN_e is not certified: one epoch gives it a shape, and that is all these tests need of it."""
PAPER = replace(Scene.load(Path(__file__).parents[1] / "models" / "paper.toml"), estimator=QUICK)


def examples(count: int) -> settings:
    """As many examples in the quick profile, and as many times more in a longer one as it draws of other tests."""
    return settings(max_examples=count * settings.default.max_examples // 100)


def seen_from(scene: Scene, u0: float, v0: float) -> Scene:
    """The scene with its principal point moved, so that borders of the frame may cut the runway."""
    return replace(scene, camera=replace(scene.camera, principal_point=(u0, v0)))


def tolerant(scene: Scene, calibration: Calibration) -> Scene:
    """The scene with a camera that may be off, and a tolerance of 1 px for it."""
    return replace(scene, calibration=calibration, tolerance=Tolerance(line_px=1))


OFF_BY = Calibration(roll_rad=0.001, yaw_rad=0.0005, focal_relative=0.001, principal_px=0.2)
SHIFTED = Calibration(principal_px=0.99)
"""Uses the whole tolerance of 1 px up in one shift, so that what lies at the frame's border leaves it."""

THREE_MARKINGS = replace(PAPER, runway=Runway((*PAPER.runway.markings, Marking("C", 0.0, 0.0, 0.3))))
UNLIKE_MARKINGS = replace(PAPER, runway=Runway((Marking("L", -0.1, 0.05, 0.3), Marking("R", 0.15, 0.0, 0.25))))
CUT_LEFT, CUT_RIGHT, CUT_BELOW = seen_from(PAPER, 25.0, 240.0), seen_from(PAPER, 614.0, 240.0), seen_from(PAPER, 320.0, 430.0)
FREE_X = replace(
    PAPER,
    camera=Camera(width=320, height=240, focal_length_m=0.008, pixel_pitch_m=30e-6),
    domain=Domain(
        Axis((0.55, 0.6, 0.65), 0.05), Axis((-0.04, 0.0, 0.04), 0.04), Axis((0.85, 0.9, 0.95), 0.05), Axis((1.65, 1.7, 1.75), 0.05)
    ),
    bank=Bank(pitch_bins=2, distance_bins=1, column_px=0.35, lateral_px=0.35),
)
"""81 cells, three of them along x."""
ONE_CELL = replace(PAPER, domain=Domain(Axis((0.6,), 0.1), Axis((0.1,), 0.0), Axis((0.9,), 0.1), Axis((1.7,), 0.1)))
"""Quick to build; its x is fixed at 0.1, which float32 cannot hold."""
OBLONG = replace(ONE_CELL, camera=Camera(width=640, height=480, focal_px=(560.0, 520.0), principal_point=(331.5, 236.25)))
"""Pixels that are not square, the principal point off the centre."""
BARELY_ABOVE = seen_from(replace(ONE_CELL, runway=Runway((Marking("L", -0.1, 0.0, 0.3), Marking("R", 0.1, 0.2, 0.3)))), 320.0, 110.0)
BARELY_BELOW = seen_from(replace(ONE_CELL, runway=Runway((Marking("L", -0.1, 0.0, 0.3), Marking("R", 0.1, 0.0, 0.1)))), 320.0, 520.0)
"""In some states the right marking lies just above, or just below, the frame: a camera that is off brings it into view."""

STRIP = replace(
    PAPER,
    camera=Camera(width=346, height=260, focal_length_m=0.006, pixel_pitch_m=18.5e-6),
    runway=Runway((Marking("L", -0.5, 0.0, 4.0), Marking("R", 0.5, 0.0, 4.0))),
    domain=Domain(Axis((0.4, 0.5), 0.1), Axis((0.0,), 0.0), Axis((1.25, 1.75), 0.5), Axis((2.25, 2.75), 0.5)),
    bank=Bank(pitch_bins=4, distance_bins=2, column_px=0.5),
)
"""A drone over a strip of 1 x 4 m."""
AIRPORT = replace(
    PAPER,
    camera=Camera(width=1280, height=720, focal_length_m=0.008, pixel_pitch_m=4.86e-6),
    runway=Runway((Marking("L", -22.5, 0.0, 2500.0), Marking("R", 22.5, 0.0, 2500.0))),
    domain=Domain(Axis((0.0, 0.02, 0.04), 0.02), Axis((0.0,), 0.0), Axis((53.0,), 28.0), Axis((1000.0,), 200.0)),
    bank=Bank(pitch_bins=4, distance_bins=2, column_px=0.5),
)
"""A runway of 45 x 2500 m, 3 degrees down its final approach, the horizon in view in some states."""
LOW_OVER_THE_THRESHOLD = replace(
    AIRPORT, domain=Domain(Axis((0.006,), 0.004), Axis((0.0,), 0.0), Axis((10.0,), 1.0), Axis((6.0,), 10.0)), bank=Bank(2, 1, 2.0)
)
"""The near ends are up to 15,000 rows below the frame."""
FAR_FROM_THE_ORIGIN = replace(
    STRIP,
    runway=Runway((Marking("L", 99_999.5, -1e5, 4.0), Marking("R", 100_000.5, 0.5 - 1e5, 3.0))),
    domain=Domain(Axis((0.4, 0.5), 0.1), Axis((1e5,), 0.2), Axis((1.25, 1.75), 0.5), Axis((100_002.25, 100_002.75), 0.5)),
)
"""The strip with coordinates of 100 km, its markings unlike and x free."""
STRAIGHT_DOWN = replace(
    STRIP,
    runway=Runway((Marking("L", -0.5, 0.0, 0.6), Marking("R", 0.3, 0.1, 0.6))),
    domain=Domain(Axis((1.4,), 0.2), Axis((0.0,), 0.0), Axis((2.0,), 0.5), Axis((0.5,), 0.4)),
)

SCENES = {
    "paper": PAPER,
    "three markings": THREE_MARKINGS,
    "unlike markings": UNLIKE_MARKINGS,
    "cut left": CUT_LEFT,
    "cut right": CUT_RIGHT,
    "cut below": CUT_BELOW,
    "free x": FREE_X,
    "one cell": ONE_CELL,
    "oblong pixels": OBLONG,
    "tolerant": tolerant(PAPER, OFF_BY),
    "tolerant, cut left": tolerant(CUT_LEFT, SHIFTED),
    "tolerant, cut right": tolerant(CUT_RIGHT, SHIFTED),
    "tolerant, barely above": tolerant(BARELY_ABOVE, SHIFTED),
    "tolerant, barely below": tolerant(BARELY_BELOW, SHIFTED),
    "tolerant, free x": tolerant(replace(FREE_X, bank=replace(FREE_X.bank, pitch_bins=3)), SHIFTED),
}
"""Scenes that have a model; `conftest.model_of` exports each when it is first asked for."""


FINAL = replace(
    AIRPORT,
    camera=Camera(width=480, height=300, focal_length_m=0.008, pixel_pitch_m=12e-6),
    domain=Domain(
        Edges((-0.01, 0.02, 0.05)), Edges((-20.0, 20.0)), None, Growth(500.0, 1400.0, 1.5), glide=Glide((0.045, 0.06), aim_m=300.0)
    ),
    bank=WindowedBank(set_px=16.0, rows=12, places=64),
)
"""A long final over a coarser sensor, x free, altitudes by glide angles, 6 cells of a bank of windows."""
WINDOWED = {
    "final": FINAL,
    "final, few places": replace(FINAL, bank=replace(FINAL.bank, places=3), tolerance=Tolerance(missed_budget=2)),
    "final, tolerant": replace(
        tolerant(FINAL, Calibration(principal_px=0.6)),
        domain=replace(FINAL.domain, x_m=Axis((3.0,), 0.0)),
        bank=replace(FINAL.bank, places=8),
    ),
    "strip in windows": replace(STRIP, bank=WindowedBank(set_px=14.0, rows=10, places=32)),
    "final, from the left": replace(
        FINAL,
        domain=replace(FINAL.domain, theta_rad=Edges((0.0, 0.02)), x_m=Edges((-24.0, -22.5)), z_m=Edges((900.0, 1100.0))),
        bank=WindowedBank(set_px=24.0, rows=8, places=2),
    ),
}
"""Scenes with a bank of windows, which have a model too; with few places, many frames overflow them. Seen from the left of the runway, or
from above its edge, windows begin where S of all cells does."""


def states_of(scene: Scene) -> st.SearchStrategy[Floats]:
    """States of the domain, its faces and corners among them."""
    lower, upper = scene.domain.lower, scene.domain.upper
    shares = st.lists(st.floats(0, 1), min_size=4, max_size=4)
    return shares.map(lambda share: scene.domain.nearest(lower + np.array(share) * (upper - lower)))


def random_clutter(rng: np.random.Generator, shape: tuple[int, int], density: float) -> Frame:
    """Each pixel lit with the given probability."""
    return (rng.random(shape) < density).astype(np.uint8)


@st.composite
def intervals(draw: st.DrawFn, low: float, high: float, widest: float) -> tuple[float, float]:
    """Intervals within [low, high] that are up to `widest` wide, single numbers among them."""
    start = draw(st.floats(low, high))
    return start, min(high, start + draw(st.floats(0, widest)))


@st.composite
def state_sets(draw: st.DrawFn, scene: Scene) -> StateSet:
    """One set of states: a box within the scene's domain, cut by an interval of the scale at the row where its middle sees the runway."""
    lower, upper = scene.domain.lower, scene.domain.upper
    box = np.array([draw(intervals(low, high, 0.1)) for low, high in zip(lower, upper, strict=True)])
    try:
        row = reference_row(scene.camera, box[:, 0], box[:, 1], scene.runway.ends_z_m.mean())
    except SceneError:  # some state of the box sees the sky there, as none of an entry does
        reject()
    tangent = tangent_of_row(scene.camera, np.array([row]))
    low, high = (float(part[0]) for part in scale_range(scene.camera, box[:1], box[2:3], tangent))
    theta, x, y, z = box[:, None, :]
    return StateSet(theta, x, y, z, np.array([draw(intervals(low, high, 5.0))]), tangent)


def states_in(scene: Scene, sets: StateSet, count: int, seed: int) -> Floats:
    """Random states of the one set in `sets`, (n, 4), n at most `count`: drawn by theta and scale, so that thin sets have states too."""
    rng = np.random.default_rng(seed)
    sides = np.stack([sets.theta[0], sets.x[0], sets.scale[0], sets.z[0]])
    share = rng.random((count, 4))
    share[: count // 2] = np.round(share[: count // 2])  # half of them on corners
    # a + (b - a) may exceed b by its last bit: such a state would be no state of the set
    theta, x, scale, z = np.minimum(sides[:, 0] + share * (sides[:, 1] - sides[:, 0]), sides[:, 1]).T
    row = scene.camera.v0 + scene.camera.focal_v_px * sets.tangent[0]
    y = ground_scale(scene.camera, theta, 1.0, row) / scale
    keep = (y >= sets.y[0, 0]) & (y <= sets.y[0, 1])
    corners = np.stack([rng.choice(sets.theta[0], count), rng.choice(sets.y[0], count)])
    held = ground_scale(scene.camera, *corners, row)
    keep_corner = (held >= sets.scale[0, 0]) & (held <= sets.scale[0, 1])
    states = np.stack([theta, x, y, z], axis=-1)[keep]
    return np.concatenate([states, np.stack([corners[0], x, corners[1], z], axis=-1)[keep_corner]])

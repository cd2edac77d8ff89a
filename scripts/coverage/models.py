"""The models of the coverage campaign: the one given, the same with a tolerance, and some whose frame's border cuts the runway."""

from __future__ import annotations

import functools
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rational_image import RationalState, RationalView

from build_model.calibration import displacement_px
from build_model.export import export_model
from build_model.partition import partition
from build_model.spatial_filter import spatial_filter
from build_model.user_network import NO_ESTIMATOR
from build_model.window import Window
from runtime import Scene
from runtime.domain import AnyAxis, Axis, Domain, Edges
from runtime.scene import Calibration, Camera, Distortion, EstimatorTraining, Runway, Tolerance

OFF_BY = Calibration(roll_rad=0.001, yaw_rad=0.0005, focal_relative=0.001, principal_px=0.2)
SHIFTED = Calibration(principal_px=0.99)
"""Uses a tolerance of 1 px up in one shift, which takes the most out of view, or into it."""
LEFT_IN_VIEW_PX = 15
"""Rows of each marking that are in view at the state that shows the fewest."""
MISSED_BY_PX = 0.3
"""By how much the frame misses a marking in the state that comes closest to showing it: less than a camera may be off by."""
SMALL_CELL = 8
"""How many times smaller a cell is in which a whole marking stays out of view."""
SIDES = ("left", "top", "bottom")
BARELY = ("barely above", "barely below")
LENSES = {
    "barrel lens": Distortion("radial-tangential", (-0.4, 0.17, 0.0, 0.0)),
    "wide lens": Distortion("radial-tangential", (-0.28, 0.07, 0.001, -0.002, 0.003)),
    "pincushion lens": Distortion("radial-tangential", (0.2, 0.0, -0.001, 0.001)),
    "fisheye lens": Distortion("fisheye", (-0.013, 0.05, -0.045, 0.012)),
    "wide lens, off": Distortion("radial-tangential", (-0.28, 0.07, 0.001, -0.002, 0.003)),
}
"""Lenses before which the scene's camera is put, its pixels oblong and its principal point off by a tenth; the last one's camera is off."""
THROUGH_A_LENS_OFF = Calibration(roll_rad=0.0005, yaw_rad=0.0005, focal_relative=0.0005, principal_px=0.3)
DERIVED = ("tolerant", *(f"cut {side}{also}" for side in SIDES for also in ("", ", tolerant")), *BARELY, *LENSES)
"""Names of the models that are built."""
UNTRAINED = EstimatorTraining(training_frames=256, epochs=1)
"""NN_e is not certified: one epoch gives it a shape."""


def derived_scene(scene: Scene, name: str) -> Scene:
    """The scene of one of `DERIVED`."""
    exact = replace(scene, estimator=UNTRAINED, calibration=Calibration(), tolerance=Tolerance(missed_budget=scene.tolerance.missed_budget))
    if name == "tolerant":
        return replace(exact, calibration=off_by_a_pixel(exact), tolerance=replace(exact.tolerance, line_px=1))
    if name in LENSES:
        return seen_through(exact, name)
    side, _, also = name.removeprefix("cut ").partition(", ")
    cut = staggered_scene(exact, above=name == BARELY[0]) if name in BARELY else cut_scene(exact, side)
    return replace(cut, calibration=SHIFTED, tolerance=replace(exact.tolerance, line_px=1)) if also or name in BARELY else cut


def off_by_a_pixel(scene: Scene) -> Calibration:
    """`OFF_BY`, or a half, a quarter and so on of it, so that it moves no marking by more than a pixel."""
    window = functools.reduce(Window.union, (spatial_filter(scene, *cell)[1] for cell in zip(*scene.domain.cells(), strict=True)))
    off = OFF_BY
    while displacement_px(replace(scene, calibration=off), window) > 1:
        off = Calibration(*(getattr(off, field.name) / 2 for field in fields(Calibration)))
    return off


def seen_through(scene: Scene, name: str) -> Scene:
    """Up to two cells an axis, behind one of `LENSES`."""
    camera = scene.camera
    axes = zip(("theta_rad", "x_m", "y_m", "z_m"), scene.domain.axes, strict=True)
    fewer = {name: few_cells(axis, number % 2 == 0) for number, (name, axis) in enumerate(axes) if axis is not None}
    scene = replace(scene, domain=replace(scene.domain, **fewer))
    off = THROUGH_A_LENS_OFF if name.endswith("off") else Calibration()
    behind = Camera(
        camera.width,
        camera.height,
        principal_point=(camera.u0 + camera.width / 10, camera.v0 - camera.height / 20),
        focal_px=(camera.focal_u_px * 1.03, camera.focal_v_px * 0.98),
        distortion=LENSES[name],
    )
    return replace(scene, camera=behind, calibration=off)


def build_model(scene: Scene, name: str, folder: Path, jobs: int) -> Path:
    """Writes one of `DERIVED` to `folder` and returns its path. The same scene and versions give the same file."""
    path = folder / f"{name.replace(', ', '-').replace(' ', '-')}.onnx"
    export_model(derived_scene(scene, name), path, jobs=jobs, estimator=NO_ESTIMATOR if name in LENSES else None)
    return path


def cut_scene(scene: Scene, side: str) -> Scene:
    """Up to two cells an axis, and the principal point so moved that the left, top or bottom border of the frame cuts the runway.

    Top and bottom leave `LEFT_IN_VIEW_PX` rows to the state that shows the fewest; the left border runs through the leftmost marking.
    """
    down = side == "bottom"
    picks = (down, None, not down, down)
    axes = zip(("theta_rad", "x_m", "y_m", "z_m"), scene.domain.axes, picks, strict=True)
    fewer = {name: few_cells(axis, first) for name, axis, first in axes if axis is not None}
    scene = replace(scene, domain=replace(scene.domain, **fewer))
    ends = corner_ends(scene)
    if side != "left":
        rows = ends[..., 1]
        kept = scene.camera.height - LEFT_IN_VIEW_PX
        return moved_down(scene, round(kept - rows[:, :, 1].max() if down else LEFT_IN_VIEW_PX - rows[:, :, 0].min()))
    leftmost = ends[:, scene.runway.x_m.argmin(), :, 0]
    u0 = scene.camera.u0 - round((leftmost.min() + leftmost.max()) / 2)
    return replace(scene, camera=replace(scene.camera, principal_point=(u0, scene.camera.v0)))


def staggered_scene(scene: Scene, above: bool) -> Scene:
    """One small cell, none of whose states shows the last marking, which lies beyond the others or is shorter: one misses it by little."""
    axes = [small_cell(scene.domain, axis) for axis in range(4)]
    *others, last = scene.runway.markings
    third = last.length_m / 3
    moved = replace(last, start_z_m=last.start_z_m + 2 * third) if above else replace(last, length_m=third)
    scene = replace(scene, domain=Domain(*axes), runway=Runway((*others, moved)))
    rows = corner_ends(scene)[:, -1, :, 1]
    return moved_down(scene, -MISSED_BY_PX - rows[:, 0].max() if above else scene.camera.height + MISSED_BY_PX - rows[:, 1].min())


def moved_down(scene: Scene, by_px: float) -> Scene:
    """The scene with its principal point farther down."""
    return replace(scene, camera=replace(scene.camera, principal_point=(scene.camera.u0, scene.camera.v0 + by_px)))


def few_cells(axis: AnyAxis, first: bool | None) -> AnyAxis:
    """The first or the last two cells of an axis; the middle one, or the one there is, where it does not matter."""
    cells = len(axis.borders) - 1
    chosen = slice(cells // 2, cells // 2 + 1) if first is None else slice(0, 2) if first else slice(max(cells - 2, 0), cells)
    if isinstance(axis, Axis):
        return Axis(axis.centres[chosen], axis.width)
    return Edges(tuple(axis.borders[chosen.start : chosen.stop + 1].tolist()))


def small_cell(domain: Domain, number: int) -> Axis:
    """The middle of an axis's middle cell, `SMALL_CELL` times smaller; of a glide's altitudes, that of the middle cell of z."""
    axis = domain.axes[number]
    if isinstance(axis, Axis):
        return Axis(axis.centres[len(axis.centres) // 2 :][:1], axis.width / SMALL_CELL)
    borders = domain.altitude_borders[len(domain.altitude_borders) // 2] if axis is None else axis.borders
    low, high = borders[(len(borders) - 1) // 2 :][:2].tolist()
    return Axis(((low + high) / 2,), (high - low) / SMALL_CELL)


def corner_ends(scene: Scene) -> NDArray[np.float64]:
    """The ends of all markings at all corners of all cells, (corners, markings, 2, 2) px: near and far end, (u, v)."""
    view, cells = RationalView.of(scene.to_dict()), partition(scene)
    sides = [np.unique([cells.lower[:, axis], cells.upper[:, axis]]) for axis in range(4)]
    corners = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 4)
    states = (RationalState.near(corner) for corner in corners)
    return np.array([[[[float(value) for value in point] for point in segment] for segment in view.segments(state)] for state in states])

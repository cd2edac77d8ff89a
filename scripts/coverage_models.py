"""The models of the coverage campaign: the one given, the same with a tolerance, and some whose frame's border cuts the runway."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rational_image import RationalState, RationalView

from build_model.export import export_model
from build_model.partition import partition
from runtime import Scene
from runtime.scene import Axis, Calibration, EstimatorTraining, Tolerance

OFF_BY = Calibration(roll_rad=0.001, yaw_rad=0.0005, focal_relative=0.001, principal_px=0.2)
SHIFTED = Calibration(principal_px=0.99)
"""Uses a tolerance of 1 px up in one shift, which takes the most out of view, or into it."""
LEFT_IN_VIEW_PX = 15
"""Rows of the runway that are in view at the state that shows the fewest."""
SIDES = ("left", "top", "bottom")
DERIVED = ("tolerant", *(f"cut {side}{also}" for side in SIDES for also in ("", ", tolerant")))
"""Names of the models that are built."""
UNTRAINED = EstimatorTraining(training_frames=256, epochs=1)
"""NN_e is not certified: one epoch gives it a shape."""


def derived_scenes(scene: Scene) -> Iterator[Scene]:
    """The scenes of `DERIVED`."""
    exact = replace(scene, estimator=UNTRAINED, calibration=Calibration(), tolerance=Tolerance())
    one_px = Tolerance(line_px=1)
    yield replace(exact, calibration=OFF_BY, tolerance=one_px)
    for side in SIDES:
        cut = cut_scene(exact, side)
        yield cut
        yield replace(cut, calibration=SHIFTED, tolerance=one_px)


def build_models(scene: Scene, folder: Path, jobs: int) -> Iterator[tuple[str, Path]]:
    """Writes every derived model to `folder`; yields its name and path. Equal scenes and versions give equal files."""
    for name, derived in zip(DERIVED, derived_scenes(scene), strict=True):
        path = folder / f"coverage-{name.replace(', ', '-').replace(' ', '-')}.onnx"
        export_model(derived, path, jobs=jobs)
        yield name, path


def cut_scene(scene: Scene, side: str) -> Scene:
    """Up to two cells an axis, and the principal point so moved that the left, top or bottom border of the frame cuts the runway.

    Top and bottom leave `LEFT_IN_VIEW_PX` rows to the state that shows the fewest; the left border runs through the leftmost marking.
    """
    down = side == "bottom"
    picks = (down, None, not down, down)
    axes = [few_cells(axis, first) for axis, first in zip(scene.domain.axes, picks, strict=True)]
    scene = replace(scene, domain=replace(scene.domain, theta_rad=axes[0], x_m=axes[1], y_m=axes[2], z_m=axes[3]))
    ends = corner_ends(scene)
    camera = scene.camera
    u0, v0 = camera.u0, camera.v0
    if side == "left":
        leftmost = ends[:, scene.runway.x_m.argmin(), :, 0]
        u0 -= round((leftmost.min() + leftmost.max()) / 2)
    elif side == "top":
        v0 -= round(ends[:, :, 0, 1].min()) - LEFT_IN_VIEW_PX
    else:
        v0 += camera.height - LEFT_IN_VIEW_PX - round(ends[:, :, 1, 1].max())
    return replace(scene, camera=replace(camera, principal_point=(u0, v0)))


def few_cells(axis: Axis, first: bool | None) -> Axis:
    """The first or the last two cells of an axis; the middle one, or the one there is, where it does not matter."""
    if first is None:
        return Axis(axis.centres[len(axis.centres) // 2 :][:1], axis.width)
    return Axis(axis.centres[:2] if first else axis.centres[-2:], axis.width)


def corner_ends(scene: Scene) -> np.ndarray:
    """The ends of all markings at all corners of all cells, (corners, markings, 2, 2) px: near and far end, (u, v)."""
    view, cells = RationalView.of(scene.to_dict()), partition(scene)
    sides = [np.unique([cells.lower[:, axis], cells.upper[:, axis]]) for axis in range(4)]
    corners = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 4)
    states = (RationalState.near(corner) for corner in corners)
    return np.array([[[[float(value) for value in point] for point in segment] for segment in view.segments(state)] for state in states])

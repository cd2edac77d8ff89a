"""The scenes that cameras are drawn for: the paper's, a strip that a drone comes down on, a real runway's final approach, and random ones.

Of the first three a model has all cells or, more often, a few, and x is often free: where x and yaw are known exactly, the runway's place
across the frame tells the pitch, so that fixed ones would flatter.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from coverage.models import few_cells
from random_scenes.scenes import draw_scene
from random_scenes.sights import Rng

from runtime import Scene
from runtime.scene import Axis, Bank, Camera, Domain, Marking, Runway

STRIP = Scene(
    Camera(width=346, height=260, focal_length_m=0.006, pixel_pitch_m=18.5e-6),
    Runway((Marking("L", -0.5, 0.0, 4.0), Marking("R", 0.5, 0.0, 4.0))),
    Domain(Axis((0.4, 0.5), 0.1), Axis((0.0,), 0.0), Axis((1.25, 1.75), 0.5), Axis((2.25, 2.75), 0.5)),
    Bank(pitch_bins=4, distance_bins=2, column_px=0.5, lateral_px=0.5),
)
AIRPORT = Scene(
    Camera(width=1280, height=720, focal_length_m=0.008, pixel_pitch_m=4.86e-6),
    Runway((Marking("L", -22.5, 0.0, 2500.0), Marking("R", 22.5, 0.0, 2500.0))),
    Domain(Axis((-0.02, 0.0, 0.02, 0.04, 0.06, 0.08), 0.02), Axis((0.0,), 0.0), Axis((53.0,), 28.0), Axis((1000.0,), 200.0)),
    Bank(pitch_bins=4, distance_bins=2, column_px=0.5, lateral_px=0.5),
)
RANDOM = "random scene"
FREE_X_PX = 40.0
"""About how wide the range of a free x is in the image, at most."""
WHOLE, FREE = 0.25, 0.4
"""How often a model has all cells, and how often x is free."""


def named_scenes(files: list[Path]) -> dict[str, Scene | None]:
    """The scenes by name, None standing for random ones; or those of files instead. Raises `SceneError`."""
    if files:
        return {path.stem: Scene.load(path) for path in files}
    paper = Scene.load(Path(__file__).parents[2] / "models" / "paper.toml")
    return {"paper": paper, "strip": STRIP, "airport": AIRPORT, RANDOM: None}


def draw_base(choice: Rng, rng: Rng, bases: dict[str, Scene | None]) -> tuple[Scene, tuple[str, ...]]:
    """The scene that `choice` picks, with all its cells or some, and its name. Raises `SceneError` where a random one is refused."""
    name = str(choice.choice(list(bases)))
    scene = bases[name]
    if scene is None:
        drawn = draw_scene(rng)
        return drawn.scene, (name, drawn.kinds[0])
    kinds = [name]
    if rng.random() >= WHOLE:
        axes = zip(("theta_rad", "x_m", "y_m", "z_m"), scene.domain.axes, strict=True)
        fewer = {key: few_cells(axis, (None, True, False)[rng.integers(3)]) for key, axis in axes if axis is not None}
        scene = replace(scene, domain=replace(scene.domain, **fewer))
    if rng.random() < FREE and scene.domain.fixed[1]:
        kinds.append("x free")
        scene = with_free_x(rng, scene)
    return scene, tuple(kinds)


def with_free_x(rng: Rng, scene: Scene) -> Scene:
    """The scene with one cell of x, as wide as to move the runway's near ends by up to `FREE_X_PX`; other axes have a cell each."""
    lower, upper = scene.domain.lower, scene.domain.upper
    nearest = float(np.hypot(lower[2], lower[3] + scene.runway.ends_z_m.min()))
    width = float(rng.uniform(0.1, 1)) * FREE_X_PX * nearest / scene.camera.focal_u_px
    axes = zip(("theta_rad", "y_m", "z_m"), (scene.domain.axes[axis] for axis in (0, 2, 3)), strict=True)
    fewer = {key: few_cells(axis, None) for key, axis in axes if axis is not None}
    x_m = float(lower[1] + upper[1]) / 2
    return replace(scene, domain=replace(scene.domain, x_m=Axis((x_m,), width), **fewer), bank=replace(scene.bank, lateral_px=0.7))

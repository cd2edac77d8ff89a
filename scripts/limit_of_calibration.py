"""What a clean frame leaves free of a camera that may be off, beside what it leaves of one that is known: the limits, sampled from within.

    python scripts/limit_of_calibration.py [SCENE.toml] [--frames 20] [--seed 1]

No certificate under Theorem A can be narrower than the extent of all states whose image, by some camera within `[calibration]`, is lit in
the frame. States are drawn together with the camera's roll, yaw, focal length and principal point (`OffSampler`), and the same is done of
the scene with a camera that is known exactly, on frames of the same states. Without a scene, it is the paper's with the camera `off` of
`compare_attitude`, once with x fixed and once with x free within +-0.06 m. Prints medians of half-widths and their ratios; what is found
is at most the limit.
"""

from __future__ import annotations

from dataclasses import astuple, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from compare_attitude import CAMERAS, PAPER, free_scene
from consistent_states import LARGEST_STEP, RANDOM_PX, SMALLEST_STEP, STEPS, Bits, Floats, Integers, Sampler
from rich.progress import track
from rich.table import Table

from runtime import Scene, SceneError, terminal
from runtime.camera import project
from runtime.errors import fail
from runtime.image import image_of_ends
from runtime.scene import STATE_NAMES, Calibration

AT_BOUNDS = 0.1
"""Share of the steps that put some of the camera's unknowns at their bounds, where extremes mostly lie."""
UNKNOWNS = 5
"""Roll, yaw, focal length, and the principal point to the right and down."""


def bounds_of(off: Calibration) -> Floats:
    """How far each of the unknowns may be off, (5,)."""
    return np.array([off.roll_rad, off.yaw_rad, off.focal_relative, off.principal_px, off.principal_px])


def ends_seen(scene: Scene, states: Floats, unknowns: Floats) -> Floats:
    """(u, v) of both ends of all markings, (n, markings, 2, 2), by cameras that are off so much, (n, 5)."""
    camera = scene.camera
    roll, yaw, zoom, right, down = (side[:, None, None] for side in unknowns.T)
    focal = np.array([camera.focal_u_px, camera.focal_v_px])
    across, fall = np.moveaxis((project(scene, states) - [camera.u0, camera.v0]) / focal, -1, 0)
    across, ahead = across * np.cos(yaw) - np.sin(yaw), across * np.sin(yaw) + np.cos(yaw)
    across, fall = across * np.cos(roll) - fall * np.sin(roll), across * np.sin(roll) + fall * np.cos(roll)
    u = camera.u0 + right + camera.focal_u_px * (1 + zoom) * across / ahead
    v = camera.v0 + down + camera.focal_v_px * (1 + zoom) * fall / ahead
    return np.stack([u, v], axis=-1)


def image_seen(scene: Scene, state: Floats, unknowns: Floats) -> Bits:
    """The frame of one state, (4,), by a camera that is off so much, (5,)."""
    return image_of_ends(ends_seen(scene, state[None], unknowns[None])[0], scene.camera.shape).view(np.bool_)


class OffSampler(Sampler):
    """Searches states, (n, 9): of the scene's domain, with the camera's five unknowns."""

    def __init__(self, scene: Scene, witnesses: Bits, start: Floats, rng: np.random.Generator) -> None:
        """`start`, (9,): a state and a camera that the frame was taken by. Raises ValueError if they are not."""
        self._bounds = bounds_of(scene.calibration)
        super().__init__(scene, witnesses, 0, start, rng)

    def _tried(self) -> Floats:
        known, rng = np.hstack([self._line.of(self.states[:, :4]), self.states[:, 4:]]), self._rng
        start, one, other = rng.integers(len(known), size=(3, STEPS))
        share = np.exp(rng.uniform(np.log(SMALLEST_STEP), np.log(LARGEST_STEP), (STEPS, 1)))
        size = np.exp(rng.uniform(np.log(RANDOM_PX[0]), np.log(RANDOM_PX[1]), (STEPS, 1)))
        at_random = size * rng.normal(size=(STEPS, 4 + UNKNOWNS))
        farthest_m = np.abs(self._scene.runway.x_m - self.states[0, 1]).max()
        at_random[:, :4] /= [farthest_m, farthest_m, 1, 1]
        at_random[:, 4:] *= self._bounds
        stepped = known[start] + np.where(rng.random((STEPS, 1)) < 0.8, share * (known[one] - known[other]), at_random)
        unknowns = np.clip(stepped[:, 4:], -self._bounds, self._bounds)
        extreme = (rng.random((STEPS, 1)) < AT_BOUNDS) & (rng.random(unknowns.shape) < 0.5)
        unknowns = np.where(extreme, rng.choice([-1.0, 1.0], unknowns.shape) * self._bounds, unknowns)
        states = np.hstack([self._line.states(stepped[:, :4]), unknowns])
        return states[self._allowed(states)]

    def _allowed(self, states: Floats) -> Integers:
        inside = np.flatnonzero(self._scene.domain.contains(states[:, :4]))
        ends = ends_seen(self._scene, states[inside, :4], states[inside, 4:])
        return inside[self._dark.missed_of(ends) <= self._budget]


def limits(scene: Scene, frames: int, seed: int) -> tuple[Floats, Floats]:
    """Half-widths of what frames leave of the states, (frames, 4) each: of a camera that may be off, and of one that is known exactly."""
    found = []
    known = replace(scene, calibration=Calibration())
    for number in track(range(frames), "frames", console=terminal.console(stderr=True), transient=True):
        rng = np.random.default_rng([seed, number])
        state = scene.domain.uniform(rng, 1)[0]
        sides = []
        for each in (scene, known):
            start = np.concatenate([state, bounds_of(each.calibration) * rng.uniform(-1, 1, UNKNOWNS)])
            sampler = OffSampler(each, image_seen(each, state, start[4:]), start, rng)
            sides.append(sampler.extent().half_widths[:4])
        found.append(sides)
    off, exact = np.moveaxis(np.array(found), 1, 0)
    return off, exact


def scenes_of(path: Path | None) -> dict[str, Scene]:
    """The scenes by name. Raises `SceneError` for one that is known exactly, or has a lens."""
    if path is None:
        free = free_scene("off")
        return {"x fixed": replace(Scene.load(PAPER), calibration=CAMERAS["off"][1]), "x free": free}
    scene = Scene.load(path)
    if not scene.camera.pinhole or scene.calibration.exact:
        raise SceneError(f"{path}: calibration: found {astuple(scene.calibration)}; give a plus-minus, of a camera without a lens")
    return {path.stem: scene}


def main(
    scene: Annotated[Path | None, typer.Argument(help="Scene with a [calibration]; by default the paper's with x fixed and free.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Seed of states, cameras and samples.")] = 1,
) -> None:
    """Sample what a clean frame leaves free of a camera that may be off, and of the same camera known exactly."""
    try:
        scenes = scenes_of(scene)
    except SceneError as error:
        fail(error)
    table = Table("scene", "half-width of", "may be off", "known", "ratio", title=f"Limits, {frames} clean frames")
    for name, each in scenes.items():
        off, known = (np.median(side, axis=0) for side in limits(each, frames, seed))
        free = np.flatnonzero(~each.domain.fixed)
        for axis in free.tolist():
            row = STATE_NAMES[axis], f"{off[axis]:.4f}", f"{known[axis]:.4f}", f"{off[axis] / known[axis]:.2f}"
            table.add_row(name, *row, end_section=axis == free[-1])
    terminal.console(100).print(table)


if __name__ == "__main__":
    terminal.run(main)

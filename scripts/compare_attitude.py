"""What a roll and a yaw cost: certified boxes of a turned camera beside those of the level one, with x free within +-0.06 m.

    python scripts/compare_attitude.py [MODEL.onnx] [--frames 40] [--seed 1]

With x and yaw known exactly, where the runway is seen across the frame tells the pitch; so x is free. Without a model, the paper's
scene with such an x is built first (`free_scene`, a minute or two). Each row is one way of knowing the attitude, on clean frames: medians
of the half-widths of theta, x, y and z, their ratio to those of the level camera at the same states, with the same pitch reference, runs
of NN_F and milliseconds a frame, and boxes without the state, of which there must be none. Exit code 1 if there is one.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from compare_limit import constant_network
from rational_image import RationalView
from rich.progress import track
from rich.table import Table
from turned_state import Floats, TurnedState

from runtime import Box, Estimator, ModelError, Scene, terminal
from runtime.errors import fail
from runtime.scene import Axis

PAPER = Path(__file__).parents[1] / "models" / "paper.toml"
X_CENTRES_M, X_WIDTH_M, LATERAL_PX = (-0.04, 0.0, 0.04), 0.04, 0.7
HAIR_RAD = 1e-12


@dataclass(frozen=True)
class Row:
    """One way of knowing the attitude; angles in degrees, `pitch` the plus-minus of a pitch reference, None where there is none."""

    text: str
    roll: float
    yaw: float
    plus_minus: float
    pitch: float | None = None


ROWS = (
    Row("roll 2, yaw -3 degrees, known", 2.0, -3.0, 0.0),
    Row("roll and yaw to +-0.1 degrees", 2.0, -3.0, 0.1),
    Row("and the pitch to +-0.1 degrees", 2.0, -3.0, 0.1, 0.1),
    Row("roll, yaw and pitch to +-0.5 degrees", 2.0, -3.0, 0.5, 0.5),
)


def free_scene() -> Scene:
    """The paper's scene with x within +-0.06 m."""
    scene = Scene.load(PAPER)
    domain = replace(scene.domain, x_m=Axis(X_CENTRES_M, X_WIDTH_M))
    return replace(scene, domain=domain, bank=replace(scene.bank, lateral_px=LATERAL_PX))


def loaded(model: Path | None) -> Estimator:
    """The model, or that of `free_scene`, with a constant in place of NN_e."""
    if model is not None:
        return Estimator.load(model)
    from build_model.export import export_model

    scene = free_scene()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "free.onnx"
        export_model(scene, path, estimator=constant_network(scene.camera.shape, Path(folder) / "constant.onnx"))
        return Estimator.load(path)


def drawn(estimator: Estimator, row: Row, rng: np.random.Generator) -> TurnedState:
    """A state whose camera's roll and yaw are about the row's, as far off as its plus-minus allows."""
    lower, upper = estimator.domain.lower, estimator.domain.upper
    c, *rest = lower + (upper - lower) * rng.uniform(0.02, 0.98, 4)
    roll, yaw = (math.radians(angle + rng.uniform(-1, 1) * row.plus_minus) for angle in (row.roll, row.yaw))
    b = -math.atan(math.cos(c) * math.tan(yaw))
    return TurnedState.near(np.array([c, *rest]), -roll + math.atan(math.sin(b) * math.tan(c)), b)


def pitch_reference(estimator: Estimator, theta: float, row: Row, rng: np.random.Generator) -> Box | None:
    """The domain, and more on all sides, with a pitch to the row's plus-minus that holds theta."""
    if row.pitch is None:
        return None
    half = math.radians(row.pitch)
    reading = theta + rng.uniform(-1, 1) * half
    return Box(estimator.domain.lower - 1, estimator.domain.upper + 1).replace(theta=(reading - half - HAIR_RAD, reading + half + HAIR_RAD))


def compared(estimator: Estimator, row: Row, frames: int, seed: int) -> tuple[Floats, Floats, list[int], list[float], int]:
    """Half-widths turned and level, (frames, 4) each, runs of NN_F, milliseconds a frame, and how many boxes lack the state."""
    rng, widths, level, runs, spent, lacking = np.random.default_rng(seed), [], [], [], [], 0
    for _ in track(range(frames), row.text, console=terminal.console(stderr=True), transient=True):
        state = drawn(estimator, row, rng)
        frame = state.view(estimator.scene).image(state.seen).frame.copy()
        half = math.radians(row.plus_minus)
        attitude = state.attitude(rng, half, half)
        if half:  # the reading is the row's own
            attitude = replace(attitude, roll_rad=math.radians(row.roll), yaw_rad=math.radians(row.yaw))
        prior = pitch_reference(estimator, float(state.angles[1].mid()), row, rng)
        begun = time.perf_counter()
        estimate = estimator.estimate(frame, prior=prior, attitude=attitude)
        spent.append(1000 * (time.perf_counter() - begun))
        turned = estimator.find(frame, attitude, prior).turned
        runs.append(len(turned.parts) if turned else 0)
        if estimate.box is None or not state.within(estimate.box.lower, estimate.box.upper):
            lacking += 1
            continue
        ideal = RationalView.of(estimator.scene.to_dict()).image(state.seen).frame.copy()
        prior = pitch_reference(estimator, float(state.seen.floats[0]), row, rng)
        flat = estimator.estimate(ideal, prior=prior).box
        if flat is not None:
            widths.append(estimate.box.half_widths)
            level.append(flat.half_widths)
    return np.array(widths), np.array(level), runs, spent, lacking


def main(
    model: Annotated[Path | None, typer.Argument(help="Model with x free; by default the paper's scene is built with one.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames for each row.")] = 40,
    seed: Annotated[int, typer.Option(min=0, help="Seed of states and readings.")] = 1,
) -> None:
    """Compare certified boxes of a turned camera with those of a level one."""
    console = terminal.console(140)
    try:
        estimator = loaded(model)
    except ModelError as error:
        fail(error)
    table = Table("attitude", "half-widths", "of the level camera's", "NN_F runs", "ms", "lacking", title=f"{frames} clean frames a row")
    total = 0
    for row in ROWS:
        widths, level, runs, spent, lacking = compared(estimator, row, frames, seed)
        medians = np.median(widths, axis=0), np.median(level, axis=0)
        texts = (" ".join(f"{value:.4f}" for value in medians[0]), " ".join(f"{value:.2f}" for value in medians[0] / medians[1]))
        table.add_row(row.text, *texts, f"{np.median(runs):.0f}", f"{np.median(spent):.0f}", str(lacking))
        total += lacking
    console.print(table)
    if total:
        raise typer.Exit(1)


if __name__ == "__main__":
    terminal.run(main)

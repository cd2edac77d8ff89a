"""What a roll, a yaw, a lens and a plus-minus cost: certified boxes beside those of the level pinhole, with x free within +-0.06 m.

    python scripts/compare_attitude.py [MODEL.onnx] [--frames 40] [--seed 1]

With x and yaw known exactly, where the runway is seen across the frame tells the pitch; so x is free. Without a model, the paper's
scene with such an x is built first (`free_scene`, a minute or two), and again behind each of `CAMERAS`; with one, there are the rows of a
pinhole alone. Each row is one way of knowing the camera, on clean frames: medians of the half-widths of theta, x, y and z, their ratio to
those of the level camera at the same states, with the same pitch reference, runs of NN_F and milliseconds a frame, and boxes without the
state, of which there must be none. Exit code 1 if there is one.
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
from coverage.scenarios import camera_off
from coverage.states import Stage
from numpy.typing import NDArray
from rational_image import RationalView
from rich.progress import track
from rich.table import Table
from turned_state import Floats, TurnedState

from runtime import Box, Estimator, ModelError, Scene, terminal
from runtime.attitude import Attitude
from runtime.errors import fail
from runtime.scene import Axis, Calibration, Distortion
from runtime.turned import bins_of, seen_box

PAPER = Path(__file__).parents[1] / "models" / "paper.toml"
X_CENTRES_M, X_WIDTH_M, LATERAL_PX = (-0.04, 0.0, 0.04), 0.04, 0.7
HAIR_RAD = 1e-12
WHOLE_PIXELS = 2
"""`line_px` of the camera that is off: NN_F's share of the calibration."""


@dataclass(frozen=True)
class Row:
    """One way of knowing the attitude; angles in degrees, `pitch` the plus-minus of a pitch reference, None where there is none."""

    text: str
    roll: float
    yaw: float
    plus_minus: float
    pitch: float | None = None
    camera: str = "pinhole"
    """One of `CAMERAS`."""
    most_frames: int | None = None
    """Where each takes seconds."""

    @property
    def level(self) -> bool:
        """True if no attitude is told; of a camera that may be off, it is, so that its plus-minus counts by what it is."""
        return self.roll == self.yaw == self.plus_minus == 0 and self.camera != "off"


CAMERAS = {
    "pinhole": (None, Calibration()),
    "barrel": (Distortion("radial-tangential", (-0.28, 0.07, 0.0, 0.0)), Calibration()),
    "fisheye": (Distortion("fisheye", (-0.013, 0.05, -0.045, 0.012)), Calibration()),
    "off": (None, Calibration(math.radians(0.05), math.radians(0.05), 0.001, 0.3)),
}
"""Lenses, and what the camera may be off by."""
ROWS = (
    Row("roll 2, yaw -3 degrees, known", 2.0, -3.0, 0.0),
    Row("roll and yaw to +-0.1 degrees", 2.0, -3.0, 0.1),
    Row("and the pitch to +-0.1 degrees", 2.0, -3.0, 0.1, 0.1),
    Row("roll, yaw and pitch to +-0.5 degrees", 2.0, -3.0, 0.5, 0.5),
    Row("no reference, roll and yaw within +-2 degrees", 0.0, 0.0, 2.0, most_frames=6),
    Row("k1 -0.28, k2 0.07, known", 0.0, 0.0, 0.0, camera="barrel"),
    Row("and roll 2, yaw -3 degrees, known", 2.0, -3.0, 0.0, camera="barrel"),
    Row("a fisheye lens, known", 0.0, 0.0, 0.0, camera="fisheye"),
    Row("roll, yaw to 0.05 degrees, F to 0.1 %, centre to 0.3 px", 0.0, 0.0, 0.0, camera="off"),
)


def free_scene(camera: str = "pinhole") -> Scene:
    """The paper's scene with x within +-0.06 m, seen by one of `CAMERAS`."""
    scene, (distortion, calibration) = Scene.load(PAPER), CAMERAS[camera]
    domain = replace(scene.domain, x_m=Axis(X_CENTRES_M, X_WIDTH_M))
    scene = replace(scene, domain=domain, bank=replace(scene.bank, lateral_px=LATERAL_PX))
    line_px = 0 if calibration.exact else WHOLE_PIXELS
    return replace(
        scene,
        camera=replace(scene.camera, distortion=distortion),
        calibration=calibration,
        tolerance=replace(scene.tolerance, line_px=line_px),
    )


def loaded(model: Path | None, camera: str) -> Estimator:
    """The model, or that of `free_scene`, without NN_e."""
    if model is not None:
        return Estimator.load(model)
    from build_model.export import export_model
    from build_model.user_network import NO_ESTIMATOR

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "free.onnx"
        export_model(free_scene(camera), path, estimator=NO_ESTIMATOR)
        return Estimator.load(path)


def drawn(estimator: Estimator, row: Row, rng: np.random.Generator) -> TurnedState:
    """A state whose camera's roll and yaw are about the row's, as far off as its plus-minus and the calibration allow."""
    lower, upper, off = estimator.domain.lower, estimator.domain.upper, estimator.scene.calibration
    c, *rest = lower + (upper - lower) * rng.uniform(0.02, 0.98, 4)
    sides = (row.roll, off.roll_rad), (row.yaw, off.yaw_rad)
    roll, yaw = (math.radians(angle) + rng.uniform(-1, 1) * (math.radians(row.plus_minus) + beside) for angle, beside in sides)
    b = -math.atan(math.cos(c) * math.tan(yaw))
    return TurnedState.near(np.array([c, *rest]), -roll + math.atan(math.sin(b) * math.tan(c)), b)


def pitch_reference(estimator: Estimator, theta: float, row: Row, rng: np.random.Generator) -> Box | None:
    """The domain, and more on all sides, with a pitch to the row's plus-minus that holds theta."""
    if row.pitch is None:
        return None
    half = math.radians(row.pitch)
    reading = theta + rng.uniform(-1, 1) * half
    return Box(estimator.domain.lower - 1, estimator.domain.upper + 1).replace(theta=(reading - half - HAIR_RAD, reading + half + HAIR_RAD))


def seen(estimator: Estimator, state: TurnedState, rng: np.random.Generator) -> NDArray[np.bool_]:
    """The frame of a state, of a camera within the scene's calibration, whose share of roll and yaw is the state's."""
    view, off = state.view(estimator.scene), replace(estimator.scene.calibration, roll_rad=0.0, yaw_rad=0.0)
    if not off.exact:
        shown = camera_off(rng, Stage("", None, replace(estimator.scene, calibration=off), view))
        view = replace(shown, roll=view.roll, yaw=view.yaw)
    return view.image(state.seen).frame.copy()


def runs_of(estimator: Estimator, attitude: Attitude | None, prior: Box | None) -> int:
    """How often NN_F is run."""
    known = estimator.known_attitude(attitude)
    if known is None:
        return 1
    box = estimator.domain if prior is None else seen_box(prior, known)
    low, high = max(box.lower[0], estimator.domain.lower[0]), min(box.upper[0], estimator.domain.upper[0])
    return len(list(bins_of(estimator.ideal.camera, known, (float(low), float(high)))))


def compared(
    estimator: Estimator, pinhole: Estimator, row: Row, frames: int, seed: int
) -> tuple[Floats, Floats, list[int], list[float], int]:
    """Half-widths and those of the level pinhole, (frames, 4) each, runs of NN_F, ms a frame, and how many boxes lack the state."""
    rng, widths, level, runs, spent, lacking = np.random.default_rng(seed), [], [], [], [], 0
    for _ in track(range(frames), row.text, console=terminal.console(stderr=True), transient=True):
        state = drawn(estimator, row, rng)
        frame = seen(estimator, state, rng)
        half = math.radians(row.plus_minus)
        attitude = None if row.level else state.attitude(rng, half, half)
        if attitude is not None and (half or not estimator.scene.calibration.exact):  # the reading is the row's own
            attitude = replace(attitude, roll_rad=math.radians(row.roll), yaw_rad=math.radians(row.yaw))
        prior = pitch_reference(estimator, float(state.angles[1].mid()), row, rng)
        begun = time.perf_counter()
        estimate = estimator.estimate(frame, prior=prior, attitude=attitude)
        spent.append(1000 * (time.perf_counter() - begun))
        runs.append(runs_of(estimator, attitude, prior))
        held = state.seen if row.level else state  # by the pitch that the ideal frame shows, where no attitude is told
        if estimate.box is None or not held.within(estimate.box.lower, estimate.box.upper):
            lacking += 1
            continue
        ideal = RationalView.of(pinhole.scene.to_dict()).image(state.seen).frame.copy()
        prior = pitch_reference(pinhole, float(state.seen.floats[0]), row, rng)
        flat = pinhole.estimate(ideal, prior=prior).box
        if flat is not None:
            widths.append(estimate.box.half_widths)
            level.append(flat.half_widths)
    return np.array(widths), np.array(level), runs, spent, lacking


def main(
    model: Annotated[Path | None, typer.Argument(help="Model with x free; by default the paper's scene is built with one.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames for each row.")] = 40,
    seed: Annotated[int, typer.Option(min=0, help="Seed of states and readings.")] = 1,
) -> None:
    """Compare certified boxes of a turned camera, of one behind a lens, or of one that may be off, with those of a level pinhole."""
    console = terminal.console(140)
    try:
        cameras = {name: loaded(model, name) for name in CAMERAS if model is None or name == "pinhole"}
    except ModelError as error:
        fail(error)
    table = Table("camera", "half-widths", "of the level camera's", "NN_F runs", "ms", "lacking", title=f"{frames} clean frames a row")
    total = 0
    for row in ROWS:
        if row.camera not in cameras:
            continue
        count = frames if row.most_frames is None else min(frames, row.most_frames)
        widths, level, runs, spent, lacking = compared(cameras[row.camera], cameras["pinhole"], row, count, seed)
        medians = np.median(widths, axis=0), np.median(level, axis=0)
        texts = (" ".join(f"{value:.4f}" for value in medians[0]), " ".join(f"{value:.2f}" for value in medians[0] / medians[1]))
        text = row.text if count == frames else f"{row.text} ({count} frames)"
        table.add_row(text, *texts, f"{np.median(runs):.0f}", f"{np.median(spent):.0f}", str(lacking))
        total += lacking
    console.print(table)
    if total:
        raise typer.Exit(1)


if __name__ == "__main__":
    terminal.run(main)

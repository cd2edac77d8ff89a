"""Certificates of a rolled and yawed camera against the truth in rational numbers: random states, attitudes, clutter and missed pixels.

    python scripts/attitudes.py [MODEL.onnx] [--frames 1000] [--largest-deg 10] [--missed-budget M] [--seed 0] [--jobs 2]

The image of each state is drawn exactly, of a camera R_z(a) R_y(b) R_x(c) with rational half-angle tangents (`turned_state`), and its roll,
pitch and yaw are judged as balls. What is told of them is off by up to a plus-minus of 0 to 0.6 degrees each. Prints the frames, the
violations, which are boxes without the state and frames without a box, and the median half-widths; exit code 1 if there is a violation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, cast

import joblib
import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track
from turned_state import TurnedState

from runtime import Attitude, Box, Estimator, ModelError, terminal
from runtime.errors import fail

Floats = NDArray[np.float64]

PLUS_MINUS_RAD = (0.0, 0.0002, 0.002, 0.01)
PITCH_PLUS_MINUS_RAD = (0.001, 0.01)
CLUTTER = (0.0, 0.0, 0.01, 0.05)
STRIDES = (1, 2, 7)
"""Of the missed pixels along the image: neighbours, and some apart."""
A_PART = 20
"""Frames that a job does at a time."""


@dataclass(frozen=True)
class Trial:
    """One frame: a sensor's own, what is told of the camera, and the truth."""

    state: TurnedState
    frame: NDArray[np.bool_]
    attitude: Attitude
    prior: Box | None
    refine: bool

    @staticmethod
    def draw(estimator: Estimator, largest_rad: float, rng: np.random.Generator) -> Trial:
        """A state of the domain, seldom near its faces; every third frame with a pitch reference, every tenth without refinement."""
        lower, upper = estimator.domain.lower, estimator.domain.upper
        seen = lower + (upper - lower) * rng.uniform(1e-9, 1 - 1e-9, 4)
        state = TurnedState.near(seen, *rng.uniform(-largest_rad, largest_rad, 2))
        image = state.view(estimator.scene).image(state.seen)
        frame, missed = image.frame.copy(), int(rng.integers(0, estimator.missed_budget + 1))
        if missed and len(image.flat):
            first, stride = rng.integers(len(image.flat)), rng.choice(STRIDES)
            frame.ravel()[image.flat[(first + stride * np.arange(missed)) % len(image.flat)]] = False
        frame |= rng.random(frame.shape) < rng.choice(CLUTTER)
        prior = None
        if rng.random() < 1 / 3:
            half = float(rng.choice(PITCH_PLUS_MINUS_RAD))
            reading = float(state.angles[1].mid()) + rng.uniform(-1, 1) * half
            prior = Box(lower - 1, upper + 1).replace(theta=(reading - half - 1e-12, reading + half + 1e-12))
        return Trial(state, frame, state.attitude(rng, *rng.choice(PLUS_MINUS_RAD, 2)), prior, bool(rng.random() < 0.9))

    def widths(self, estimator: Estimator) -> Floats | None:
        """Half-widths of the box; None if that lacks the state, or is none."""
        box = estimator.estimate(self.frame, prior=self.prior, attitude=self.attitude, refine=self.refine).box
        return None if box is None or not self.state.within(box.lower, box.upper) else box.half_widths


def judged(model: Path | None, missed_budget: int | None, largest_rad: float, seeds: list[list[int]]) -> list[tuple[str, Floats | None]]:
    """What was drawn and the half-widths of some frames; None for a violation."""
    estimator = Estimator.load(model, missed_budget=missed_budget)
    results: list[tuple[str, Floats | None]] = []
    for seed in seeds:
        trial = Trial.draw(estimator, largest_rad, np.random.default_rng(seed))
        results.append((f"seed {seed}: {trial.state.seen} a {trial.state.a} b {trial.state.b}", trial.widths(estimator)))
    return results


def parts(frames: int, seed: int) -> Iterator[list[list[int]]]:
    """Seeds of all frames, some at a time."""
    seeds = [[seed, number] for number in range(frames)]
    return (seeds[start : start + A_PART] for start in range(0, frames, A_PART))


def main(
    model: Annotated[Path | None, typer.Argument(help="Model that export-model wrote; by default the paper's.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="How many frames.")] = 1000,
    largest_deg: Annotated[float, typer.Option(min=0, max=30, help="Largest a and b, degrees.")] = 10.0,
    missed_budget: Annotated[
        int | None, typer.Option(min=0, help="Pixels of the runway that may be dark, in place of the model's.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is drawn.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
) -> None:
    """Judge certificates of a rolled and yawed camera."""
    try:
        Estimator.load(model, missed_budget=missed_budget)
    except ModelError as error:
        fail(error)
    work = [joblib.delayed(judged)(model, missed_budget, np.radians(largest_deg), part) for part in parts(frames, seed)]
    done = cast(Iterator[list[tuple[str, Floats | None]]], joblib.Parallel(jobs, return_as="generator")(work))
    errors, console = terminal.console(stderr=True), terminal.console()
    results = [result for part in track(done, "frames", total=len(work), console=errors, transient=True) for result in part]
    violations = [text for text, widths in results if widths is None]
    for text in violations:
        console.print(f"violation: {text}", markup=False)
    held = [widths for _, widths in results if widths is not None]
    medians = " ".join(f"{np.median([widths[axis] for widths in held]):.4g}" for axis in range(4)) if held else "-"
    console.print(f"{len(results)} frames, {len(violations)} violations; half-widths, median: {medians}")
    if violations:
        raise typer.Exit(1)


if __name__ == "__main__":
    terminal.run(main)

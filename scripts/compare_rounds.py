"""What rounds of the refinement are worth: the width of the certified box and the time of a frame, by how many are taken at most.

    python scripts/compare_rounds.py [MODEL.onnx] [--missed-budget M] [--frames 60] [--clutter 0.01] [--rounds 1 --rounds 2 ...]

M random pixels of the runway are missed. Each frame is estimated with every number of rounds in turn, so that what else the machine does
weighs on all alike; times are processor times, the smallest of `REPEATS`, and half-widths are those of the refinement as it is, 1 for each
axis. A frame stops before the last round where a round gains little.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from comparison_frames import draw_frames
from known_besides import FREE
from numpy.typing import NDArray
from rich.progress import track
from rich.table import Table

from runtime import Estimator, ModelError, terminal
from runtime.errors import fail
from runtime.image import runway_image
from runtime.refine import refiner

REPEATS = 3
SEARCHES = ("NONE_MISSED", "SOME_MISSED", "SOME_MISSED_X_KNOWN")
"""Those of a level pinhole's frame alone, in `runtime.refine.refiner`."""

Floats = NDArray[np.float64]


@contextmanager
def at_most(rounds: int) -> Iterator[None]:
    """The refinement takes at most so many rounds meanwhile."""
    searches = {name: getattr(refiner, name) for name in SEARCHES}
    try:
        for name, search in searches.items():
            setattr(refiner, name, replace(search, rounds=rounds))
        yield
    finally:
        for name, search in searches.items():
            setattr(refiner, name, search)


def missing(estimator: Estimator, state: Floats, frame: NDArray[np.uint8], count: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The frame without so many random pixels of the state's runway."""
    lit = np.flatnonzero(runway_image(estimator.scene, state) & frame)
    frame.flat[rng.permutation(lit)[:count]] = 0
    return frame


def timed(estimator: Estimator, frame: NDArray[np.uint8]) -> tuple[float, Floats]:
    """Seconds of one estimate, and the half-widths of its box; without one, those of the domain."""
    begun = time.process_time()
    box = estimator.estimate(frame).box
    spent = time.process_time() - begun
    return spent, (box or estimator.domain).half_widths[FREE]


def compared(estimator: Estimator, frames: list[NDArray[np.uint8]], rounds: list[int]) -> tuple[Floats, Floats]:
    """Seconds, (1 + rounds, frames), as it is and with at most so many rounds, and half-widths, (1 + rounds, frames, 3)."""
    spent, widths = np.full((1 + len(rounds), len(frames)), np.inf), np.empty((1 + len(rounds), len(frames), len(FREE)))
    for number, frame in enumerate(track(frames, "frames", console=terminal.console(stderr=True), transient=True)):
        for _ in range(REPEATS):
            took, widths[0, number] = timed(estimator, frame)
            spent[0, number] = min(spent[0, number], took)
            for place, most in enumerate(rounds, start=1):
                with at_most(most):
                    took, widths[place, number] = timed(estimator, frame)
                spent[place, number] = min(spent[place, number], took)
    return spent, widths


def main(
    model: Annotated[Path | None, typer.Argument(help="Model that export-model wrote; by default the paper's.")] = None,
    missed_budget: Annotated[int, typer.Option(min=0, help="Pixels of the runway's image that are dark, and may be.")] = 0,
    frames: Annotated[int, typer.Option(min=1, help="How many frames.")] = 60,
    clutter: Annotated[float, typer.Option(min=0, max=1, help="Density of random clutter.")] = 0.01,
    rounds: Annotated[list[int] | None, typer.Option(min=0, help="Rounds at most; give it again for another row.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of states, clutter and missed pixels.")] = 1,
) -> None:
    """Print the time of a frame and the width of its box by the rounds that the refinement takes at most."""
    try:
        estimator = Estimator.load(model, missed_budget=missed_budget)
    except ModelError as error:
        fail(error)
    rng, most = np.random.default_rng([seed, missed_budget]), rounds or [0, 1, 2, 3, 4, 6, 8]
    drawn = [missing(estimator, state, frame, missed_budget, rng) for state, frame in draw_frames(estimator.scene, frames, clutter, seed)]
    spent, widths = compared(estimator, drawn, most)
    title = f"{frames} frames, {clutter:.0%} clutter, {missed_budget} of {missed_budget} pixels missed"
    table = Table("rounds at most", "ms, median", "p99 / p50", "half-widths theta, y, z: mean", "95 %", title=title)
    share = widths / np.where(widths[0] > 0, widths[0], 1.0)
    for name, times, ratios in zip(["as it is", *map(str, most)], 1000 * spent, share, strict=True):
        middle = np.median(times)
        texts = (" ".join(f"{value:.2f}" for value in each) for each in (ratios.mean(axis=0), np.quantile(ratios, 0.95, axis=0)))
        table.add_row(name, f"{middle:.1f}", f"{np.quantile(times, 0.99) / middle:.2f}", *texts)
    terminal.console(120).print(table)


if __name__ == "__main__":
    typer.run(main)

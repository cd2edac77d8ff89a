"""What a model of a long final says from afar and from near by: how much passes, how wide the box is, how long it takes; with pictures.

    python scripts/long_final.py out/approach.onnx [-o out/long_final] [--frames 20] [--clutter 0.02] [--missed 5]

At each distance, states of the domain are drawn, pixels of the runway go dark, and clutter is added. Half-widths are in degrees and
metres, and in per cent of altitude and distance. Exit 1 if a box misses the truth, or is missing.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from runtime import Estimator, terminal
from runtime.errors import fail
from runtime.image import runway_image
from runtime.model.format import ModelError
from runtime.recordings.draw import contact_sheet, draw_runway, png
from runtime.whole_file import write_whole

DISTANCES_M = (2900.0, 2000.0, 1500.0, 1000.0, 500.0, 320.0)
PICTURED_M = (2900.0, 1500.0, 500.0)


@dataclass(frozen=True)
class Look:
    """One frame's answer: the truth, what passed, the box's half-widths (NaN without a box), and whether the box holds the truth."""

    truth: NDArray[np.float64]
    entries: int
    cells: int
    overflow: bool
    half_widths: NDArray[np.float64]
    holds: bool
    run_ms: float
    estimate_ms: float


def looks_from(
    estimator: Estimator, distance_m: float, frames: int, clutter: float, missed: int, rng: np.random.Generator
) -> list[tuple[Look, NDArray[np.uint8]]]:
    """Answers at states about a distance, with their frames."""
    return [look_at(estimator, state_at(estimator, distance_m, rng), clutter, missed, rng) for _ in range(frames)]


def state_at(estimator: Estimator, distance_m: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """A state of the domain within 1 % of a distance, uniform otherwise."""
    domain = estimator.scene.domain
    state = domain.uniform(rng, 1)[0]
    z = float(np.clip(distance_m * rng.uniform(0.99, 1.01), domain.lower[3], domain.upper[3]))
    low, high = domain.altitudes_at(z)
    state[2:] = rng.uniform(low, high), z
    return state


def look_at(
    estimator: Estimator, truth: NDArray[np.float64], clutter: float, missed: int, rng: np.random.Generator
) -> tuple[Look, NDArray[np.uint8]]:
    """One frame with `missed` pixels dark and a share `clutter` lit, and its answer."""
    frame = runway_image(estimator.scene, truth)
    frame.ravel()[rng.choice(np.flatnonzero(frame), missed, replace=False)] = 0
    frame |= rng.random(frame.shape) < clutter
    start = time.perf_counter()
    outputs = estimator.run(frame)
    between = time.perf_counter()
    estimate = estimator.estimate(frame)
    spent = between - start, time.perf_counter() - between
    box = estimate.box
    half_widths = np.full(4, np.nan) if box is None else (box.upper - box.lower) / 2
    counts = int(outputs["passes"].sum()), int((outputs["support"] > 0).sum()), bool(outputs.get("overflow", False))
    holds = box is not None and bool(box.contains(truth))
    return Look(truth, *counts, half_widths, holds, *(1e3 * part for part in spent)), frame


def table(by_distance: dict[float, list[Look]]) -> Table:
    """A row for each distance, medians."""
    view = Table("distance m", "entries", "cells", "overflow", "theta deg", "x m", "y %", "z %", "run ms", "estimate ms", "truth in box")
    for distance, looks in by_distance.items():
        theta, x, y, z = np.nanmedian([look.half_widths for look in looks], axis=0)
        truth = np.median([look.truth for look in looks], axis=0)
        widths = f"{np.degrees(theta):.4f}", f"{x:.3f}", f"{100 * y / truth[2]:.3f}", f"{100 * z / truth[3]:.2f}"
        times = (f"{np.median([getattr(look, name) for look in looks]):.1f}" for name in ("run_ms", "estimate_ms"))
        counts = (f"{np.median([getattr(look, name) for look in looks]):.0f}" for name in ("entries", "cells"))
        overflows, held = sum(look.overflow for look in looks), sum(look.holds for look in looks)
        view.add_row(f"{distance:.0f}", *counts, str(overflows), *widths, *times, f"{held} of {len(looks)}")
    return view


def pictures(estimator: Estimator, clutter: float, missed: int, rng: np.random.Generator) -> list[NDArray[np.uint8]]:
    """The runway's surroundings from afar to near by, with the certified box."""
    drawn = []
    for distance in PICTURED_M:
        look, frame = look_at(estimator, state_at(estimator, distance, rng), clutter, missed, rng)
        drawn.append(
            draw_runway(estimator.scene, frame, estimator.estimate(frame), truth=look.truth, title=f"{distance:.0f} m", zoom=3, scale=1)
        )
    return drawn


def run(model: Path, output: Path, frames: int, clutter: float, missed: int | None, seed: int, console: Console) -> bool:
    """Measures, prints, draws; True if every box held its truth. Raises `ModelError` and OSError."""
    estimator = Estimator.load(model, missed_budget=missed)
    rng, domain = np.random.default_rng(seed), estimator.domain
    distances = [distance for distance in DISTANCES_M if domain.lower[3] <= distance <= domain.upper[3]]
    if not distances:
        raise ModelError(f"{model}: its distances, {domain.lower[3]:.0f} to {domain.upper[3]:.0f} m, have none of {DISTANCES_M}")
    budget, by_distance = estimator.missed_budget, {}
    for distance in track(distances, "distances", console=console, transient=True):
        by_distance[distance] = [look for look, _ in looks_from(estimator, distance, frames, clutter, budget, rng)]
    console.print(
        f"{100 * clutter:g} % clutter, {budget} of at most {budget} pixels missed, medians of {frames} frames", table(by_distance)
    )
    if set(PICTURED_M) <= set(distances):
        write_whole(output / "long_final.png", png(contact_sheet(pictures(estimator, clutter, budget, rng), columns=3)))
        console.print(f"written: {output}/long_final.png")
    return all(look.holds for looks in by_distance.values() for look in looks)


def main(
    model: Annotated[Path, typer.Argument(help="Model of a long final.")] = Path("out/approach.onnx"),
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the picture.")] = Path("out/long_final"),
    frames: Annotated[int, typer.Option(min=1, help="Frames at each distance.")] = 20,
    clutter: Annotated[float, typer.Option(min=0, max=1, help="Share of the pixels that are lit besides.")] = 0.02,
    missed: Annotated[int | None, typer.Option(min=0, help="Pixels missed, and the budget; by default the scene's.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of states and frames.")] = 0,
) -> None:
    """Look at the runway from several distances."""
    console = terminal.console(140)
    try:
        output.mkdir(parents=True, exist_ok=True)
        held = run(model, output, frames, clutter, missed, seed, console)
    except (ModelError, OSError) as error:
        fail(error)
    if not held:
        fail(f"{model}: a box does not hold the truth, or is missing", 1)


if __name__ == "__main__":
    terminal.run(main)

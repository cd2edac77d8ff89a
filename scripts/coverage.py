"""Counts how often a certificate holds: random states, clutter, missed pixels, a camera off by its calibration.

    python scripts/coverage.py [MODEL.onnx] [--states N] [--recording FILE] [-o FILE.json]

Every frame's truth is known: the runway's exact image (`runtime.image`) is joined with clutter, and pixels of it may be put out. One
certified box without the truth in it, or one lit pixel of the runway that `filtered` loses, is a violation, and the exit code is 1.
"""

from __future__ import annotations

import functools
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast

import joblib
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from runtime import Estimator, Scene
from runtime.camera import project
from runtime.frames import events_to_frames
from runtime.image import image_of_ends, runway_image
from runtime.recording import read_events
from runtime.scene import Calibration, EstimatorTraining, Tolerance

CHUNK = 250
WINDOW_US = 40_000
OFF_BY = Calibration(roll_rad=0.001, yaw_rad=0.0005, focal_relative=0.001, principal_px=0.2)
Rng = np.random.Generator


@dataclass(frozen=True)
class Scenario:
    """What is done to a frame. `clutter` is a density, a pair of them to draw from, or the path of a recording."""

    name: str
    clutter: float | tuple[float, float] | str = 0.0
    missed: int = 0
    tolerant: bool = False
    runway: bool = True
    outside_by: float = 0.0


@dataclass
class Tally:
    """Counts over the frames of a scenario, and the figures of each frame."""

    frames: int = 0
    certified: int = 0
    violations: int = 0
    pixels_lost: int = 0
    no_runway: int = 0
    flagged: int = 0
    named: int = 0
    fallbacks: int = 0
    passing: tuple[int, ...] = ()
    errors: tuple[float, ...] = ()
    half_widths: tuple[tuple[float, ...], ...] = ()

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))


def scenarios(recording: str | None) -> Iterator[Scenario]:
    """All that is measured, in the order of the table."""
    for density in (0.0, 0.01, 0.02, 0.05, 0.2):
        yield Scenario(f"clutter {density:.0%}", density)
    if recording is not None:
        yield Scenario("real clutter", recording)
    yield Scenario("8 missed, clutter 2%", 0.02, missed=8)
    yield Scenario("camera off, clutter 2%", 0.02, tolerant=True)
    for missed in (0, 8):
        yield Scenario(f"clutter alone 1-5%, m = {missed}", (0.01, 0.05), missed=missed, runway=False)
    yield Scenario("outside the domain by up to 0.05", outside_by=0.05)


@functools.cache
def estimator_of(path: str, missed_budget: int) -> Estimator:
    """One loaded model a process and budget."""
    return Estimator.load(path, missed_budget=missed_budget)


@functools.cache
def recorded_frames(path: str, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """The recording's 40 ms frames, (frames, height, width)."""
    packets = list(read_events(path, shape))
    return events_to_frames(np.concatenate(packets), shape, WINDOW_US)[1]


def clutter(rng: Rng, scenario: Scenario, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """A frame of clutter: each pixel lit at random, or a frame of the recording, mirrored at random."""
    if isinstance(scenario.clutter, str):
        frames = recorded_frames(scenario.clutter, shape)
        return frames[rng.integers(len(frames)), :: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
    density = rng.uniform(*scenario.clutter) if isinstance(scenario.clutter, tuple) else scenario.clutter
    frame = np.zeros(math.prod(shape), dtype=np.uint8)
    frame[rng.integers(frame.size, size=rng.binomial(frame.size, density))] = 1
    return frame.reshape(shape)


def draw_state(rng: Rng, scene: Scene, outside_by: float) -> NDArray[np.float64]:
    """A state of the domain, or one that lies up to `outside_by` outside one of its faces."""
    lower, upper = scene.domain.lower, scene.domain.upper
    state = rng.uniform(lower, upper)
    if outside_by:
        axis = rng.choice(np.flatnonzero(upper > lower))
        distance = rng.uniform(0, outside_by)
        state[axis] = rng.choice([lower[axis] - distance, upper[axis] + distance])
    return state


def draw_image(rng: Rng, scene: Scene, state: NDArray[np.float64], scenario: Scenario) -> NDArray[np.uint8]:
    """The runway as the camera shows it, which may be off by the calibration."""
    if scenario.tolerant:
        return image_of_ends(off_camera(rng, scene, project(scene, state)), scene.camera.shape)
    return runway_image(scene, state)


def off_camera(rng: Rng, scene: Scene, ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ends as a camera sees them that is turned, zoomed and shifted by random amounts within the scene's calibration."""
    camera, off = scene.camera, scene.calibration
    roll, yaw, zoom = rng.uniform(-1, 1, 3) * (off.roll_rad, off.yaw_rad, off.focal_relative)
    shift = rng.uniform(-1, 1, 2) * off.principal_px
    centre = np.array([camera.u0, camera.v0])
    rays = np.concatenate([(ends - centre) / camera.focal_px, np.ones((*ends.shape[:-1], 1))], axis=-1)
    turn_yaw = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    turn_roll = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    seen = rays @ (turn_roll @ turn_yaw).T
    return centre + shift + camera.focal_px * (1 + zoom) * seen[..., :2] / seen[..., 2:]


def put_out(rng: Rng, image: NDArray[np.uint8], pixels: int) -> NDArray[np.uint8]:
    """The image with exactly `pixels` of its lit pixels dark, or all of them if it has fewer."""
    lit = np.flatnonzero(image)
    dark = image.copy().ravel()
    dark[rng.choice(lit, size=min(pixels, len(lit)), replace=False)] = 0
    return dark.reshape(image.shape)


def run_chunk(path: str, scenario: Scenario, seed: list[int], frames: int) -> Tally:
    """`frames` random frames of a scenario."""
    rng = np.random.default_rng(seed)
    estimator = estimator_of(path, scenario.missed)
    return sum((run_frame(rng, estimator, scenario) for _ in range(frames)), Tally())


def run_frame(rng: Rng, estimator: Estimator, scenario: Scenario) -> Tally:
    """One random frame, judged against its truth."""
    scene = estimator.scene
    state = draw_state(rng, scene, scenario.outside_by)
    image = draw_image(rng, scene, state, scenario)
    seen = put_out(rng, image, scenario.missed) if scenario.runway else np.zeros_like(image)
    estimate = estimator.estimate(seen | clutter(rng, scenario, scene.camera.shape))
    if estimate.box is None or estimate.state is None:
        lost = scenario.runway and not scenario.outside_by
        return Tally(frames=1, no_runway=1, violations=int(lost))
    judged = scenario.runway and not scenario.outside_by
    return Tally(
        frames=1,
        certified=1,
        violations=int(judged and not estimate.box.contains(state)),
        pixels_lost=int((seen > estimate.filtered).sum()) if judged else 0,
        flagged=int(estimate.touches_boundary),
        named=int(estimate.cell == cell_of(scene, state)) if judged else 0,
        fallbacks=int(estimate.used_fallback),
        passing=(len(estimate.passing),),
        errors=(float(np.linalg.norm(estimate.state - state)),),
        half_widths=(tuple(estimate.box.half_widths),),
    )


def cell_of(scene: Scene, state: NDArray[np.float64]) -> int:
    """Number of the cell that holds a state of the domain."""
    axes = scene.domain.axes
    index = [int(np.searchsorted(axis.edges[1:-1], value)) for axis, value in zip(axes, state, strict=True)]
    return int(np.ravel_multi_index(index, [len(axis.centres) for axis in axes]))


def tolerant_model(scene: Scene, folder: Path) -> Path:
    """A model of the same scene whose camera may be off by `OFF_BY`, with a tolerance of 1 px that covers it."""
    from build_model.export import export_model

    path = folder / "coverage-tolerant.onnx"
    tolerance = Tolerance(line_px=1, missed_budget=scene.tolerance.missed_budget)
    quick = EstimatorTraining(training_frames=256, epochs=1)
    export_model(replace(scene, tolerance=tolerance, calibration=OFF_BY, estimator=quick), path, jobs=2)
    return path


def table(results: dict[str, Tally]) -> Table:
    """The results as a table for people."""
    view = Table(title="Coverage", title_justify="left")
    headings = ("scenario", "frames", "certified", "violations", "pixels lost", "no runway", "at boundary", "cells", "named", "fallback")
    for heading in (*headings, "half-widths θ y z", "error 50 %", "95 %"):
        view.add_column(heading, justify="right" if heading != "scenario" else "left")
    for name, tally in results.items():
        certified = max(tally.certified, 1)
        middle = np.median(np.array(tally.half_widths), axis=0)[[0, 2, 3]] if tally.half_widths else []
        quantiles = np.quantile(tally.errors, [0.5, 0.95]) if tally.errors else []
        row = [name, tally.frames, tally.certified, tally.violations, tally.pixels_lost, f"{tally.no_runway / tally.frames:.2%}"]
        row += [f"{tally.flagged / certified:.1%}", f"{np.mean(tally.passing or [0]):.2f}", f"{tally.named / certified:.1%}"]
        row += [tally.fallbacks, " ".join(f"{value:.4f}" for value in middle), *(f"{value:.4f}" for value in quantiles)]
        view.add_row(*map(str, row))
    return view


def main(
    model: Annotated[Path, typer.Argument(help="Model to test.")] = Path("models/paper.onnx"),
    states: Annotated[int, typer.Option(help="Frames a scenario.")] = 20_000,
    recording: Annotated[Path | None, typer.Option(help="Event recording whose frames serve as clutter.")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="JSON file for the counts.")] = Path("out/coverage.json"),
    seed: Annotated[int, typer.Option(help="Seed of all frames.")] = 1,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 2,
) -> None:
    """Run every scenario and print the table."""
    output.parent.mkdir(parents=True, exist_ok=True)
    tolerant = tolerant_model(Estimator.load(model).scene, output.parent)
    work: list[tuple[str, Any]] = []
    for number, scenario in enumerate(scenarios(None if recording is None else str(recording))):
        path = str(tolerant if scenario.tolerant else model)
        for chunk in range(math.ceil(states / CHUNK)):
            frames = min(CHUNK, states - chunk * CHUNK)
            work.append((scenario.name, joblib.delayed(run_chunk)(path, scenario, [seed, number, chunk], frames)))
    results: dict[str, Tally] = {}
    tallies = joblib.Parallel(n_jobs=jobs, return_as="generator")(job for _, job in work)
    for (name, _), tally in zip(work, track(iter(tallies), total=len(work), description="frames"), strict=True):
        results[name] = results.get(name, Tally()) + cast(Tally, tally)
    Console(width=200).print(table(results))
    output.write_text(json.dumps({name: summary(tally) for name, tally in results.items()}, indent=2))
    if any(tally.violations or tally.pixels_lost for tally in results.values()):
        sys.exit(1)


def summary(tally: Tally) -> dict[str, object]:
    """Counts and quantiles of a scenario, for JSON."""
    lists = ("passing", "errors", "half_widths")
    counts = {name: value for name, value in asdict(replace(tally, passing=(), errors=(), half_widths=())).items() if name not in lists}
    quantiles = {f"{level:.0%}": value for level, value in zip((0.5, 0.95), np.quantile(tally.errors or [0], (0.5, 0.95)), strict=True)}
    return {**counts, "mean_passing": float(np.mean(tally.passing or [0])), "error_quantiles": quantiles}


if __name__ == "__main__":
    typer.run(main)

"""Flies a simulated approach past the estimator: the runway's exact image under clutter, frame by frame, with the truth known.

    python scripts/fly_approach.py [--model MODEL.onnx] [--frames 100] [--clutter 0.02 | --clutter RECORDING] [--out out/approach]

The aircraft descends from the far and high end of the domain to the near and low one while its pitch swings. Every frame is
`I_r(xi) or I_n`: no pixel of the runway fails and the camera is the scene's, so that Theorem A promises a certified box with the
truth inside, whatever the clutter. Prints a row a frame and a summary; writes approach.csv, state.png (state against time), pictures and a
contact sheet. Exit code 1 if a frame breaks the promise, 2 if something given cannot be used. Needs the extra `pictures` alone, and the
extra `recordings` where the clutter is a recording in a format that numpy does not read.
"""

from __future__ import annotations

import csv
import io
import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from approach import approach_states
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rich.text import Text

from runtime import Estimate, Estimator, ModelError, Scene, terminal
from runtime.errors import fail
from runtime.frames import FrameStream
from runtime.image import runway_image
from runtime.recordings.draw import contact_sheet, draw_estimate, draw_runway, png
from runtime.recordings.history import History, Moment, draw_history
from runtime.recordings.recording import RecordingError, read_events
from runtime.scene import STATE_COLUMNS, STATE_NAMES, STATE_UNITS
from runtime.whole_file import write_whole

WINDOW_US = 40_000
PICTURES = 10
NARROWEST_TABLE = 150
UNSAFE = 1
BUILT_MODEL = Path("out/paper.onnx")

Frames = Iterator[NDArray[np.uint8]]


@dataclass(frozen=True)
class Step:
    """One frame of the approach, and what the estimator made of it."""

    number: int
    truth: NDArray[np.float64]
    frame: NDArray[np.uint8]
    estimate: Estimate
    milliseconds: float

    @property
    def safe(self) -> bool:
        """The promise is kept: there is a box and the truth lies in it."""
        return self.estimate.box is not None and self.estimate.box.contains(self.truth)

    @property
    def error(self) -> NDArray[np.float64]:
        """Estimate minus truth, (4,), rad and m; NaN where nothing is certified."""
        return np.full(4, np.nan) if self.estimate.state is None else self.estimate.state - self.truth


def clutter_frames(clutter: str, shape: tuple[int, int], count: int, rng: np.random.Generator, console: Console) -> Frames:
    """`count` frames of I_n, as the option says: random pixels of a density, or a recording. Raises `RecordingError`."""
    try:
        density = float(clutter)
    except ValueError:
        return recorded_clutter(Path(clutter), shape, count, console)
    if not 0 <= density <= 1:
        raise RecordingError(f"--clutter: found {clutter}; give a share of 0 to 1, or the path of a recording")
    return ((rng.random(shape) < density).astype(np.uint8) for _ in range(count))


def recorded_clutter(path: Path, shape: tuple[int, int], count: int, console: Console) -> Frames:
    """The recording's 40 ms frames, over and over if it has less than `count`. Raises `RecordingError`, also if it has none."""
    stream = FrameStream(shape, WINDOW_US)
    # Held as bits: an eighth of the frames' size.
    held = [np.packbits(frame) for _, frame in itertools.islice(stream.frames(read_events(path, shape)), count)]
    if not held:
        raise RecordingError(f"{path}: no event on a sensor of shape {shape}; take another recording")
    lost = f"{stream.late_events} late, {stream.unsorted_events} unsorted, {stream.outside_events} outside the sensor"
    console.print(f"{path}: {len(held)} frames of {WINDOW_US // 1000} ms; events {lost}", markup=False)
    return (np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape) for bits in itertools.islice(itertools.cycle(held), count))


def fly(estimator: Estimator, states: NDArray[np.float64], clutter: Frames) -> Iterator[Step]:
    """Frame by frame: the runway's image or clutter, and its estimate."""
    for number, (state, noise) in enumerate(zip(states, clutter, strict=True)):
        frame = runway_image(estimator.scene, state) | noise
        start = time.perf_counter()
        estimate = estimator.estimate(frame)
        yield Step(number, state, frame, estimate, 1000 * (time.perf_counter() - start))


def free_axes(scene: Scene) -> list[int]:
    """Numbers of the axes that are not fixed."""
    return np.flatnonzero(scene.domain.upper > scene.domain.lower).tolist()


def flight_table(scene: Scene, steps: Sequence[Step]) -> Table:
    """A row a frame; axes of width 0 are left out."""
    table = Table(title="approach", title_justify="left", box=None, pad_edge=False)
    names = [f"{kind} {STATE_NAMES[axis]}" for kind in ("true", "est.", "+-") for axis in free_axes(scene)]
    for name in ("frame", *names, "inside", "fallback", "at face", "cell", "passing", "ms"):
        table.add_column(name, justify="right", no_wrap=True)
    for step in steps:
        estimate = step.estimate
        states = step.truth, estimate.state, None if estimate.box is None else estimate.box.half_widths
        numbers = ["-" if state is None else f"{state[axis]:.4f}" for state in states for axis in free_axes(scene)]
        answers = ["yes" if answer else "no" for answer in (estimate.used_fallback, estimate.touches_boundary)]
        counts = [str(estimate.cell), str(len(estimate.passing)), f"{step.milliseconds:.2f}"]
        table.add_row(str(step.number), *numbers, "yes" if step.safe else Text("NO", style="bold red"), *answers, *counts)
    return table


def summary_table(scene: Scene, steps: Sequence[Step], lit_shares: Sequence[float]) -> Table:
    """Counts, and medians over the frames."""
    estimates = [step.estimate for step in steps]
    table = Table(title="summary", title_justify="left", show_header=False, box=None, pad_edge=False)
    table.add_row("frames", str(len(steps)))
    table.add_row("certified", str(sum(estimate.certified for estimate in estimates)))
    table.add_row("violations (no box, or truth outside)", str(sum(not step.safe for step in steps)))
    if boxes := [estimate.box for estimate in estimates if estimate.box is not None]:
        median, high = np.nanquantile(np.abs([step.error for step in steps]), (0.5, 0.95), axis=0)
        half_widths = np.median([box.half_widths for box in boxes], axis=0)
        free = [(axis, STATE_NAMES[axis], STATE_UNITS[axis]) for axis in free_axes(scene)]
        table.add_row(
            "error, median / 95 %", ", ".join(f"{name} {median[axis]:.4f} / {high[axis]:.4f} {unit}" for axis, name, unit in free)
        )
        table.add_row("box half-width, median", ", ".join(f"{name} {half_widths[axis]:.4f} {unit}" for axis, name, unit in free))
    table.add_row("box reaches a face of the domain", str(sum(estimate.touches_boundary for estimate in estimates)))
    table.add_row("fallback to the box's centre", str(sum(estimate.used_fallback for estimate in estimates)))
    table.add_row("cells passing, median", f"{np.median([len(e.passing) for e in estimates]):g} of {scene.domain.cell_count}")
    table.add_row("lit share of a frame, median", f"{np.median(lit_shares):.2%}")
    table.add_row("estimate, median", f"{np.median([step.milliseconds for step in steps]):.2f} ms")
    return table


def csv_text(steps: Sequence[Step], lit_shares: Sequence[float]) -> str:
    """approach.csv: a line a frame, every state with its units; empty where nothing is certified."""
    kinds = ("truth", "estimate", "network", "lower", "upper")
    states = [f"{kind}_{name}" for kind in kinds for name in STATE_COLUMNS]
    answers = ["outcome", "truth_inside", "fallback", "touches_boundary", "cell", "passing", "mismatch"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", *states, *answers, *(f"error_{name}" for name in STATE_COLUMNS), "lit_share", "milliseconds"])
    for step, lit_share in zip(steps, lit_shares, strict=True):
        e = step.estimate
        sides = (None, None) if e.box is None else (e.box.lower, e.box.upper)
        numbers = [[""] * 4 if state is None else state.tolist() for state in (step.truth, e.state, e.network_state, *sides)]
        outcome = [e.outcome.value, step.safe, e.used_fallback, e.touches_boundary, e.cell, len(e.passing), e.mismatch]
        writer.writerow(
            [step.number, *itertools.chain(*numbers), *outcome, *(step.error if e.certified else [""] * 4), lit_share, step.milliseconds]
        )
    return text.getvalue()


def moment_of(step: Step) -> Moment:
    """The step as a window of `WINDOW_US`, each after the one before."""
    start_us, box = step.number * WINDOW_US, step.estimate.box
    return Moment(start_us, start_us + WINDOW_US, step.estimate.state, box and box.lower, box and box.upper, step.truth)


def run(model: Path | None, frames: int, clutter: str, out: Path, seed: int, console: Console) -> bool:
    """Flies, prints and writes; True if every certificate was kept. Raises `ModelError`, `RecordingError`, OSError."""
    estimator = Estimator.load(model, extra_budget=-1)
    scene, rng = estimator.scene, np.random.default_rng(seed)
    states = approach_states(scene, frames, rng.uniform(0, 2 * np.pi))
    noise = clutter_frames(clutter, scene.camera.shape, frames, rng, console)
    pictured = set(np.linspace(0, frames - 1, min(PICTURES, frames)).round().astype(int).tolist())
    steps, lit_shares, small, history = [], [], [], History()
    for step in track(fly(estimator, states, noise), "flying", total=frames, console=console, transient=True):
        lit_shares.append(float(step.frame.mean()))
        if step.number in pictured:
            shown = {"mask": estimator.spatial_mask(step.estimate.cell), "truth": step.truth, "title": f"frame {step.number}"}
            write_whole(out / f"overlay_{len(small)}.png", png(draw_estimate(scene, step.frame, step.estimate, **shown)))
            small.append(draw_runway(scene, step.frame, step.estimate, **shown))
        history.add(moment_of(step))
        # An approach may be long: its frames are not kept.
        nothing = np.empty((0, 0), dtype=np.uint8)
        steps.append(replace(step, frame=nothing, estimate=replace(step.estimate, filtered=nothing)))
    write_whole(out / "contact_sheet.png", png(contact_sheet(small, columns=5)))
    write_whole(out / "state.png", png(draw_history(scene, history)))
    write_whole(out / "approach.csv", csv_text(steps, lit_shares).encode())
    console.print(flight_table(scene, steps), summary_table(scene, steps, lit_shares))
    lines = [
        f"written: {out}/approach.csv, {out}/state.png, {out}/contact_sheet.png and {len(small)} overlays",
        "assumed:",
        *estimator.metadata["assumptions"],
    ]
    console.print(*lines, sep="\n", markup=False, highlight=False)
    return all(step.safe for step in steps)


def fly_approach(
    model: Annotated[Path | None, typer.Option(help="Model; by default out/paper.onnx, else the one of models/.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames of the approach.")] = 100,
    clutter: Annotated[str, typer.Option(help="Share of lit pixels, or a recording whose 40 ms frames are cycled.")] = "0.02",
    out: Annotated[Path, typer.Option(help="Folder for the table and the pictures.")] = Path("out/approach"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the clutter and of the pitch's phase.")] = 0,
) -> None:
    """Fly a simulated approach with a known truth and check every certificate."""
    console = terminal.console(NARROWEST_TABLE)
    try:
        kept = run(model or (BUILT_MODEL if BUILT_MODEL.is_file() else None), frames, clutter, out, seed, console)
    except (ModelError, RecordingError, OSError) as error:
        fail(error)
    if not kept:
        raise typer.Exit(UNSAFE)


if __name__ == "__main__":
    terminal.run(fly_approach)

"""Flies a simulated approach past the estimator: the runway's exact image under clutter, frame by frame, with the truth known.

    python scripts/fly_approach.py [--model MODEL.onnx] [--frames 100] [--clutter 0.02 | --clutter RECORDING] [--out out/approach]

The aircraft descends from the far and high corner of the domain to the near and low one, its pitch swinging gently. Every frame is
`I_r(xi) or I_n`: no pixel of the runway fails, so that Theorem A (any clutter) promises a certified box with the truth inside. Prints a
row a frame and a summary; writes approach.csv, overlay pictures and a contact sheet. Exit code 1 if any frame breaks the promise.
"""

from __future__ import annotations

import csv
import io
import itertools
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from build_model.spatial_filter import spatial_filters
from runtime import Estimate, Estimator, ModelError, Scene
from runtime.frames import EventError, FrameStream
from runtime.image import runway_image
from runtime.recording import RecordingError, read_events
from runtime.scene import STATE_NAMES, STATE_UNITS

WINDOW_US = 40_000
FACE_MARGIN = 0.02
"""Share of the domain's width, on every axis, that the approach keeps from its faces."""
PITCH_SWINGS, PITCH_SHARE = 1.5, 0.9
"""Periods of the pitch on the approach, and its amplitude as a share of what the domain allows."""
PICTURES = 10
NARROWEST_TABLE = 140
UNSAFE, USER_ERROR = 1, 2
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
        """The certificate was kept: there is a box and the truth lies in it."""
        return self.estimate.box is not None and self.estimate.box.contains(self.truth)

    @property
    def error(self) -> float:
        """2-norm of estimate minus truth over (theta rad, x m, y m, z m), as in the paper; NaN where nothing is certified."""
        return float("nan") if self.estimate.state is None else float(np.linalg.norm(self.estimate.state - self.truth))


def approach_states(scene: Scene, count: int, phase_rad: float) -> NDArray[np.float64]:
    """`count` states of a descent through the domain, (count, 4): y and z fall from their largest to their smallest values."""
    centre, half = (scene.domain.upper + scene.domain.lower) / 2, (scene.domain.upper - scene.domain.lower) / 2
    along = np.linspace(0, 1, count)
    descent = np.cos(np.pi * along)
    swing = PITCH_SHARE * np.sin(2 * np.pi * PITCH_SWINGS * along + phase_rad)
    drift = PITCH_SHARE * np.sin(2 * np.pi * along)
    return centre + (1 - 2 * FACE_MARGIN) * half * np.stack([swing, drift, descent, 1 - 2 * along], axis=-1)


def random_clutter(shape: tuple[int, int], density: float, rng: np.random.Generator) -> Frames:
    """Frames in which each pixel is lit with probability `density`, without end."""
    while True:
        yield (rng.random(shape) < density).astype(np.uint8)


def recorded_clutter(path: Path, shape: tuple[int, int], console: Console) -> Frames:
    """The recording's 40 ms frames, over and over. Raises `RecordingError`, also if it holds no event."""
    for turn in itertools.count():
        stream = FrameStream(shape, WINDOW_US)
        count = 0
        for packet in itertools.chain(read_events(path, shape), [None]):
            for _, frame in stream.flush() if packet is None else stream.feed(packet):
                count += 1
                yield frame
        if count == 0:
            raise RecordingError(f"{path}: no events on the sensor; take another recording")
        if turn == 0:
            console.print(
                f"{path}: {count} frames; events late {stream.late_events}, unsorted {stream.unsorted_events}, outside {stream.outside_events}"
            )


def clutter_frames(clutter: str, shape: tuple[int, int], rng: np.random.Generator, console: Console) -> Frames:
    """Clutter as the option says it: a density, or a recording's path. Raises `RecordingError`."""
    try:
        density = float(clutter)
    except ValueError:
        return recorded_clutter(Path(clutter), shape, console)
    if not 0 <= density <= 1:
        raise RecordingError(f"--clutter: found {clutter}; give a share of 0 to 1, or the path of a recording")
    return random_clutter(shape, density, rng)


def fly(estimator: Estimator, states: NDArray[np.float64], clutter: Frames) -> Iterator[Step]:
    """Frame by frame: the runway's image or clutter, and its estimate."""
    for number, (state, noise) in enumerate(zip(states, clutter, strict=False)):
        frame = runway_image(estimator.scene, state) | noise
        start = time.perf_counter()
        estimate = estimator.estimate(frame)
        yield Step(number, state, frame, estimate, 1000 * (time.perf_counter() - start))


def flight_table(scene: Scene) -> Table:
    """The table's head; axes of width 0 are left out."""
    table = Table(title="approach", title_justify="left", box=None, header_style="bold", pad_edge=False)
    table.add_column("frame", justify="right")
    for group in ("true", "est.", "+-"):
        for axis in free_axes(scene):
            table.add_column(f"{group} {STATE_NAMES[axis]}", justify="right", no_wrap=True)
    for name in ("inside", "fallback", "face"):
        table.add_column(name)
    for name in ("cell", "passing", "ms"):
        table.add_column(name, justify="right")
    return table


def free_axes(scene: Scene) -> list[int]:
    """Numbers of the axes that are not fixed."""
    return np.flatnonzero(scene.domain.upper > scene.domain.lower).tolist()


def flight_row(scene: Scene, step: Step) -> list[str]:
    """What `flight_table` shows of one frame."""
    estimate = step.estimate
    half_widths = None if estimate.box is None else estimate.box.half_widths
    numbers = [
        "-" if state is None else f"{state[axis]:.4f}" for state in (step.truth, estimate.state, half_widths) for axis in free_axes(scene)
    ]
    answers = ["yes" if step.safe else "[bold red]NO", "yes" if estimate.used_fallback else "no", "yes" if estimate.touches_boundary else "no"]
    return [str(step.number), *numbers, *answers, str(estimate.cell), str(len(estimate.passing)), f"{step.milliseconds:.2f}"]


def csv_row(step: Step) -> dict[str, object]:
    """One line of approach.csv; empty where nothing is certified."""
    estimate = step.estimate
    box = estimate.box
    states = {
        "truth": step.truth,
        "estimate": estimate.state,
        "network": estimate.network_state,
        "lower": None if box is None else box.lower,
        "upper": None if box is None else box.upper,
    }
    return {
        "frame": step.number,
        **{
            f"{kind}_{name}_{unit}": "" if state is None else repr(float(state[axis]))
            for kind, state in states.items()
            for axis, (name, unit) in enumerate(zip(STATE_NAMES, STATE_UNITS, strict=True))
        },
        "outcome": estimate.outcome.value,
        "truth_inside": step.safe,
        "fallback": estimate.used_fallback,
        "touches_boundary": estimate.touches_boundary,
        "cell": estimate.cell,
        "passing": len(estimate.passing),
        "mismatch": estimate.mismatch,
        "error_2norm": "" if box is None else step.error,
        "lit_share": step.frame.mean(),
        "milliseconds": step.milliseconds,
    }


def summary_table(scene: Scene, rows: list[dict[str, object]], steps_half_widths: NDArray[np.float64]) -> Table:
    """Counts and medians over the approach."""
    column = {name: np.array([row[name] for row in rows if row[name] != ""]) for name in rows[0]}
    certified = int(np.sum(column["outcome"] == "certified"))
    table = Table(title="summary", title_justify="left", show_header=False, box=None, pad_edge=False)
    lines = {
        "frames": str(len(rows)),
        "certified": str(certified),
        "violations (no box, or truth outside)": str(int(np.sum(~column["truth_inside"]))),
        "lit share of the frame, median": f"{np.median(column['lit_share']):.2%}",
        "fallback to the box's centre": str(int(column["fallback"].sum())),
        "box reaches a face of the domain": str(int(column["touches_boundary"].sum())),
        "cells passing, median": f"{np.median(column['passing']):g} of {scene.domain.cell_count}",
        "estimate, median ms": f"{np.median(column['milliseconds']):.2f}",
    }
    if certified:
        half_widths = np.median(steps_half_widths, axis=0)
        lines["error (2-norm of rad and m), median / 95 %"] = " / ".join(f"{np.quantile(column['error_2norm'], q):.4f}" for q in (0.5, 0.95))
        lines["box half-width, median"] = ", ".join(f"{STATE_NAMES[axis]} {half_widths[axis]:.4f}" for axis in free_axes(scene))
    for name, value in lines.items():
        table.add_row(name, value)
    return table

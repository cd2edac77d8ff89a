"""How much narrower the certified box becomes by what is known besides the frame: a pitch reference, or the frames before.

    python scripts/known_besides.py [MODEL.onnx] [--frames N] [--flights N] [--seed N]

Prints medians of half-widths in theta, y and z. Frames are exact images of random states with m pixels missed and clutter; the pitch is
known to plus-minus e, its reading anywhere within. Flights are 60 frames, 25 a second, at rates that are drawn anew now and then within
bounds, which a tracker knows; or it is told each displacement with a plus-minus. The boxes of their last 30 frames count, the frame's own
beside the tracked one. Every box is asserted to hold its state.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from runtime import Box, Estimate, Estimator, Motion, Scene, Tracker, terminal
from runtime.errors import fail
from runtime.image import runway_image
from runtime.model.format import ModelError
from runtime.scene import STATE_NAMES

FREE = [0, 2, 3]
"""The axes that are shown: theta, y and z."""
PLUS_MINUS_RAD = (0.02, 0.01, 0.005)
BUDGETS = (0, 2, 8)
FLIGHT_FRAMES, COUNTED, FRAME_US = 60, 30, 40_000
RATES = np.array([0.1, 0.0, 0.05, 0.05])
"""The largest of theta, rad/s, and of x, y and z, m/s."""
GYROSCOPE = np.array([0.02, 0.0, 0.02, 0.02])
"""The rates' plus-minus where they are told."""
TRACKED = ((0, 0, None), (0, 0, GYROSCOPE), (2, 0, GYROSCOPE), (2, 2, GYROSCOPE))
"""Budget m, pixels missed, and how well the rates are told, if they are."""

Floats = NDArray[np.float64]


def seen(estimator: Estimator, state: Floats, missed: int, clutter: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """A state's image with `missed` of its pixels dark, and clutter elsewhere."""
    image = runway_image(estimator.scene, state).astype(np.bool_)
    frame = image | (rng.random(image.shape) < clutter)
    frame[tuple(rng.permutation(np.argwhere(image))[:missed].T)] = False
    return frame


def half_widths(estimate: Estimate, state: Floats) -> Floats:
    """Those of theta, y and z. Raises AssertionError for a box that does not hold the state."""
    box: Box | None = estimate.box
    assert box is not None
    assert box.contains(state), (box, state)
    return box.half_widths[FREE]


def with_a_pitch_reference(path: Path | None, budget: int, frames: int, clutter: float, seed: int, console: Console) -> list[Floats]:
    """Median half-widths without a prior, and for each of `PLUS_MINUS_RAD`."""
    estimator, rng = Estimator.load(path, missed_budget=budget), np.random.default_rng([seed, budget])
    widths: list[list[Floats]] = [[] for _ in (None, *PLUS_MINUS_RAD)]
    for _ in track(range(frames), f"m = {budget}", console=console, transient=True):
        state = estimator.scene.domain.uniform(rng, 1)[0]
        frame = seen(estimator, state, budget, clutter, rng)
        widths[0].append(half_widths(estimator.estimate(frame), state))
        for place, error in enumerate(PLUS_MINUS_RAD, start=1):
            reading = state[0] + rng.uniform(-error, error)
            prior = estimator.domain.replace(theta=(reading - error, reading + error))
            widths[place].append(half_widths(estimator.estimate(frame, prior=prior), state))
    return [np.median(each, axis=0) for each in widths]


def tracked(
    path: Path | None, budget: int, missed: int, plus_minus: Floats | None, flights: int, clutter: float, seed: int, console: Console
) -> tuple[Floats, Floats, float]:
    """Median half-widths of the frame alone and over time, and the median ratio of their times."""
    estimator, rng = Estimator.load(path, missed_budget=budget), np.random.default_rng([seed, budget, missed])
    alone, followed, ratios = [], [], []
    for _ in track(range(flights), f"m = {budget}, {missed} missed", console=console, transient=True):
        tracker = Tracker(estimator, Motion(-RATES, RATES))
        for number, (state, before) in enumerate(flown(estimator.scene, rng)):
            frame = seen(estimator, state, missed, clutter, rng)
            begun = time.thread_time()
            told = None if plus_minus is None else displacement(state - before, plus_minus * (FRAME_US / 1e6), rng)
            over_time = half_widths(tracker.update(frame, number * FRAME_US, displacement=told), state)
            between = time.thread_time()
            by_itself = half_widths(estimator.estimate(frame), state)
            if number >= FLIGHT_FRAMES - COUNTED:
                alone.append(by_itself)
                followed.append(over_time)
                ratios.append((between - begun) / (time.thread_time() - between))
    return np.median(alone, axis=0), np.median(followed, axis=0), float(np.median(ratios))


def flown(scene: Scene, rng: np.random.Generator) -> Iterator[tuple[Floats, Floats]]:
    """The states of a flight, `FRAME_US` apart, each with the one before it: at rates within bounds that are drawn anew now and then."""
    state = scene.domain.uniform(rng, 1)[0]
    rate, before = rng.uniform(-RATES, RATES), state
    for _ in range(FLIGHT_FRAMES):
        yield state, before
        rate, before = rng.uniform(-RATES, RATES) if rng.random() < 0.1 else rate, state
        after = state + rate * (1 - 1e-9) * FRAME_US / 1e6
        outside = scene.domain.nearest(after) != after
        rate, state = np.where(outside, -rate, rate), np.where(outside, state, after)


def displacement(moved: Floats, plus_minus: Floats, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """What is told of a displacement: an interval of that plus-minus that holds it."""
    reading, hair = moved + rng.uniform(-1, 1, 4) * plus_minus, 1e-12
    sides = zip(STATE_NAMES, reading - plus_minus - hair, reading + plus_minus + hair, strict=True)
    return {name: (float(low), float(high)) for name, low, high in sides}


def main(
    model: Annotated[Path | None, typer.Argument(help="Model that export-model wrote; by default the paper's.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames for each budget.")] = 60,
    flights: Annotated[int, typer.Option(min=1, help="Flights for each motion.")] = 10,
    clutter: Annotated[float, typer.Option(min=0, max=1, help="Share of the pixels that clutter lights.")] = 0.02,
    seed: Annotated[int, typer.Option(min=0, help="Seed of states, frames and flights.")] = 0,
) -> None:
    """Compare certified boxes with and without what is known besides the frame."""
    console = terminal.console()
    try:
        table = Table("m = missed", "no prior", *(f"pitch +-{error}" for error in PLUS_MINUS_RAD), title="a pitch reference")
        for budget in BUDGETS:
            rows = with_a_pitch_reference(model, budget, frames, clutter, seed, console)
            table.add_row(str(budget), *(_text(each) for each in rows))
        console.print(table)
        table = Table("m", "missed", "rates told", "frame alone", "over time", "time, ratio", title="25 frames a second")
        for budget, missed, plus_minus in TRACKED:
            alone, followed, ratio = tracked(model, budget, missed, plus_minus, flights, clutter, seed, console)
            told = "no" if plus_minus is None else f"+-{plus_minus[0]} rad/s, {plus_minus[2]} m/s"
            table.add_row(str(budget), str(missed), told, _text(alone), _text(followed), f"{ratio:.2f}")
        console.print(table)
    except ModelError as error:
        fail(error)


def _text(widths: Floats) -> str:
    return " ".join(f"{width:.4f}" for width in widths)


if __name__ == "__main__":
    terminal.run(main)

"""Counts how often a certificate over time holds, and how soon a fault is found: random flights whose truth is known exactly.

    python scripts/flights.py [MODEL.onnx ...] [--flights N] [--seed N] [-o FILE.json]

Two kinds of flights of 50 frames, 40 ms apart. In *sound* ones all assumptions hold: motion at and within its bounds, up to m missed
pixels, priors with the truth on their face, told displacements, frames that are dropped, repeated or late, with a horizon up to q broken
frames of any N. A box without the truth, at a frame or between two, and INCONSISTENT are violations. In *faulty* ones one assumption is
broken from frame 20 on: it is found (INCONSISTENT or NO_RUNWAY within a second), harmless (the truth stays inside for that second), or
silent.

The runway's images are drawn in rational numbers by code that the build does not have (`rational_image`). Exit code 1 for a violation.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import joblib
import numpy as np
import typer
from coverage.states import Stage, estimator_of, image_of
from numpy.typing import NDArray
from rational_image import RationalState
from rich.progress import track
from rich.table import Table

from runtime import Box, Motion, Tracker, terminal
from runtime.errors import fail
from runtime.model.format import ModelError
from runtime.scene import STATE_NAMES
from runtime.whole_file import OutputError, write_whole

FRAMES, FRAME_US = 50, 40_000
FAULT_AT, FOUND_WITHIN = 20, 25
"""The frame from which an assumption is broken, and the frames of a second."""
BUDGETS = (0, 2, 8)
HORIZONS = ((None, 0), (None, 0), (10, 0), (8, 1), (10, 2))
"""Horizon and outliers of a tracker."""
CLUTTER = (0.0, 0.01, 0.05)
PITCH_PLUS_MINUS_RAD = 0.01
LATE = "found after a box without the truth"
PAPER = Path(__file__).resolve().parent.parent / "models" / "paper.onnx"

Floats = NDArray[np.float64]
Frame = NDArray[np.bool_]


@dataclass
class Flight:
    """One flight of a model: its motion, its drawn numbers, and the state that it has come to."""

    stage: Stage
    budget: int
    rng: np.random.Generator
    motion: Motion
    state: Floats
    rate: Floats

    @staticmethod
    def drawn(path: str, seed: Sequence[int]) -> Flight:
        """A flight that begins anywhere in the domain; its rates' bounds are up to a third of the domain a second."""
        rng = np.random.default_rng(seed)
        stage = Stage.of(path, None)
        largest = int(estimator_of(path).largest_missed_budget)
        budget = min(int(rng.choice(BUDGETS)), largest)
        most = (stage.upper - stage.lower) * rng.uniform(0.02, 0.3)
        motion = Motion(-most, most)
        return Flight(stage, budget, rng, motion, stage.scene.domain.uniform(rng, 1)[0], most)

    def step(self) -> None:
        """The next state: at one of the motion's limits, or at any rate within; the domain's faces turn it back."""
        share = self.rng.uniform(-1, 1, 4)
        rate = self.motion.rate_upper * (np.sign(share) if self.rng.random() < 0.3 else share) * (1 - 1e-9)
        after = self.state + rate * (FRAME_US / 1e6)
        domain = self.stage.scene.domain
        turned = np.where(domain.nearest(after) != after, self.state, after)
        self.state = turned if domain.contains(turned) else self.state

    def frame(self, state: Floats, missed: int) -> Frame:
        """A state's image with so many of its pixels dark, side by side or anywhere, and clutter everywhere else."""
        image = image_of(self.stage.view, RationalState.near(state)).frame
        lit = np.argwhere(image)
        start = self.rng.integers(0, max(len(lit) - missed, 0) + 1)
        dark = lit[start : start + missed] if self.rng.random() < 0.5 else self.rng.permutation(lit)[:missed]
        frame = image | (self.rng.random(image.shape) < self.rng.choice(CLUTTER))
        frame[tuple(dark.T)] = False
        return frame

    def around(self) -> Box:
        """A prior with the state in it, on some of its faces."""
        size = (self.stage.upper - self.stage.lower) * self.rng.choice([0.0, 0.003, 0.1, 1.0], (2, 4))
        hair = 2 * np.spacing(np.abs(self.state))  # the rational state is as near to its floats
        return Box(self.state - size[0] - hair, self.state + size[1] + hair)

    def with_pitch(self, pitch_rad: float) -> Box:
        """The domain with theta within `PITCH_PLUS_MINUS_RAD` of a reading."""
        domain = Box(self.stage.lower, self.stage.upper)
        return domain.replace(theta=(pitch_rad - PITCH_PLUS_MINUS_RAD, pitch_rad + PITCH_PLUS_MINUS_RAD))

    def jump(self) -> None:
        """Goes to a state that is a third of the domain away on every axis."""
        size = self.stage.upper - self.stage.lower
        self.state = self.stage.scene.domain.nearest(
            self.stage.lower + (self.state - self.stage.lower + size / 3) % np.where(size > 0, size, 1)
        )

    def elsewhere(self) -> Floats:
        """A state of the domain that has nothing to do with the flight."""
        return self.stage.scene.domain.uniform(self.rng, 1)[0]


def holds(box: Box | None, state: Floats) -> bool:
    """True if a box that is given has the state."""
    return box is None or RationalState.near(state).within(box.lower, box.upper)


# --- sound flights ---


def fly_soundly(path: str, seed: tuple[int, ...]) -> Counter[str]:
    """Counts of one flight on which all assumptions hold: frames, certified ones, and violations."""
    flight, counts = Flight.drawn(path, seed), Counter[str]()
    horizon, outliers = HORIZONS[flight.rng.integers(len(HORIZONS))]
    estimator = estimator_of(path, flight.budget)
    tracker = Tracker(estimator, flight.motion, horizon, outliers)
    broken: list[bool] = []
    time_us, before = 0, flight.state
    for _ in range(FRAMES):
        kind = flight.rng.choice(["next", "next", "next", "next", "dropped", "repeated", "late"])
        if kind == "late" and time_us > 0:
            late = tracker.update(flight.frame(flight.elsewhere(), 0), time_us - 1)
            counts["late"] += 1
            counts["violations"] += not late.certified
            continue
        for _ in range({"dropped": 3, "repeated": 0}.get(str(kind), 1)):
            flight.step()
            time_us += FRAME_US
        counts["violations"] += not holds(tracker.box_at(time_us) if broken else None, flight.state)
        breaks = outliers > 0 and sum(broken[-(horizon or 1) + 1 :]) < outliers and flight.rng.random() < 0.3
        broken.append(breaks)
        shown = flight.elsewhere() if breaks else flight.state
        prior = flight.around() if flight.rng.random() < 0.3 else None
        frame = flight.frame(shown, int(flight.rng.integers(0, flight.budget + 1)))
        estimate = tracker.update(frame, time_us, prior, told(flight, flight.state - before))
        before = flight.state
        counts["frames"] += 1
        counts["certified"] += estimate.certified
        counts["violations"] += not (estimate.certified and holds(estimate.box, flight.state))
    return counts


def told(flight: Flight, moved: Floats) -> dict[str, tuple[float, float]]:
    """What odometry says of some axes, loosely or to the last digits."""
    loose = flight.rng.choice([1e-12, 1e-3], 4)
    named = flight.rng.random(4) < 0.2
    return {name: (moved[i] - loose[i], moved[i] + loose[i]) for i, name in enumerate(STATE_NAMES) if named[i]}


# --- faulty flights ---


def runway_elsewhere(flight: Flight) -> Frame:
    """All markings are painted somewhat to the side of where the scene has them: the image of a state nearby."""
    size = flight.stage.upper - flight.stage.lower
    shift = size * flight.rng.uniform(0.1, 0.4, 4) * flight.rng.choice([-1, 1], 4)
    return flight.frame(np.clip(flight.state + shift, flight.stage.lower, flight.stage.upper), 0)


def missed_too_many(flight: Flight) -> Frame:
    """Three times the budget and ten more are dark."""
    return flight.frame(flight.state, 3 * flight.budget + 10)


def another_runway(flight: Flight) -> Frame:
    """Another runway is lit, and the true one is not."""
    return flight.frame(flight.elsewhere(), 0)


def as_it_is(flight: Flight) -> Frame:
    """Nothing is wrong with the frame itself."""
    return flight.frame(flight.state, 0)


JUMP, BIAS = "a jump beyond the motion's bounds", "a pitch reference off by 2 to 6 times its plus-minus"
FAULTS: dict[str, Callable[[Flight], Frame]] = {
    "the runway seen elsewhere": runway_elsewhere,
    "more pixels missed than the budget": missed_too_many,
    "another runway, the true one dark": another_runway,
    JUMP: as_it_is,
    BIAS: as_it_is,
}
"""By what is wrong: the frames that such a flight shows from `FAULT_AT` on."""


def fly_with_fault(path: str, name: str, seed: tuple[int, ...]) -> Counter[str]:
    """How one flight with a fault ends: found within a second, harmless, or silent."""
    flight = Flight.drawn(path, seed)
    tracker = Tracker(estimator_of(path, flight.budget), flight.motion)
    bias = flight.rng.uniform(2, 6) * flight.rng.choice([-1, 1]) * PITCH_PLUS_MINUS_RAD
    lost = False
    for number in range(FAULT_AT + FOUND_WITHIN):
        flight.step()
        faulty = number >= FAULT_AT
        if name == JUMP and number == FAULT_AT:
            flight.jump()
        frame = FAULTS[name](flight) if faulty else as_it_is(flight)
        off = bias if faulty else flight.rng.uniform(-0.99, 0.99) * PITCH_PLUS_MINUS_RAD
        prior = flight.with_pitch(flight.state[0] + off) if name == BIAS else None
        estimate = tracker.update(frame, number * FRAME_US, prior)
        if not faulty and not (estimate.certified and holds(estimate.box, flight.state)):
            return Counter({"violations": 1})
        if not estimate.certified:
            return Counter({"found": 1, LATE: int(lost)})
        lost |= not holds(estimate.box, flight.state)
    return Counter({"silent" if lost else "harmless": 1})


def run(path: str, name: str | None, seed: tuple[int, ...]) -> tuple[str, Counter[str]]:
    """One flight: a sound one, or one with the named fault."""
    return name or "sound", fly_soundly(path, seed) if name is None else fly_with_fault(path, name, seed)


def main(
    models: Annotated[list[Path] | None, typer.Argument(help="Models that export-model wrote; by default the paper's.")] = None,
    flights: Annotated[int, typer.Option(min=1, help="Sound flights of each model; a tenth as many with each fault.")] = 2000,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    seed: Annotated[int | None, typer.Option(help="Seed of the flights; by default drawn anew.")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="File of the counts.")] = Path("out/flights.json"),
) -> None:
    """Fly random flights and count what is certified, lost and found."""
    console = terminal.console()
    drawn = int(np.random.default_rng(seed).integers(2**32)) if seed is None else seed
    console.print(f"seed {drawn}")
    results: dict[str, dict[str, Counter[str]]] = {}
    try:
        for path in models or [PAPER]:
            estimator_of(str(path))
            work = [(str(path), None, (drawn, number)) for number in range(flights)]
            work += [(str(path), name, (drawn, number, 1)) for name in FAULTS for number in range(-(-flights // 10))]
            done = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")(joblib.delayed(run)(*each) for each in work)
            counts = results.setdefault(path.stem, {})
            bar = track(done, str(path), total=len(work), console=terminal.console(stderr=True))  # pyright: ignore[reportArgumentType]
            for name, result in bar:  # pyright: ignore[reportGeneralTypeIssues]
                counts.setdefault(name, Counter()).update(result)
            console.print(_table(path.stem, counts))
        write_whole(output, json.dumps({"seed": drawn, "models": results}, indent=2).encode())
    except (ModelError, OutputError) as error:
        fail(error)
    if any(count["violations"] for counts in results.values() for count in counts.values()):
        raise SystemExit(1)


def _table(name: str, counts: dict[str, Counter[str]]) -> Table:
    sound = counts["sound"]
    title = f"{name}: {sound['frames']} frames, {sound['certified']} certified, {sound['violations']} violations"
    kinds = ("found", LATE, "harmless", "silent")
    table = Table("fault", "found within 1 s", *kinds[1:], title=title, title_justify="left")
    for fault in FAULTS:
        table.add_row(fault, *(str(counts[fault][kind]) for kind in kinds))
    return table


if __name__ == "__main__":
    terminal.run(main)

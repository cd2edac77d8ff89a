"""The band that is certified over time against its limit: states with a whole history that no frame contradicts, sampled.

    python scripts/compare_limit_over_time.py [MODEL.onnx] [--flights 3] [--missed-budget M] [--missed K]
    python scripts/compare_limit_over_time.py MODEL.onnx --recording FILE --truth CSV [--motion 0.05,0,0.02,0.02] [--attitude CSV]
        [--parts 6] [--windows 100] [--counted 50] [--exact 25]

No certificate that rests on the same frames, the same bounds on the motion and the same references (Theorem D) can be narrower than the
extent of the states that they leave. `Histories` finds it from within: each of its states is allowed by the latest frame, and has come,
within the motion's bounds, from one that was allowed by the frame before, and so on. What is printed is at most the limit, and the ratio at
least the true one. Every such state must lie in the tracked box, which is checked: exit code 1 if one does not.

Without a recording, flights are those of `scripts/known_besides.py`: by the rates' bounds alone, and with each displacement told. Of a
recording several parts are followed, each with a new tracker, and the last windows of each count; windows that break the assumptions are
left out, for the tracker and for the samples alike. `--exact N` samples what the last N windows of each part would leave if the motion
between them were known exactly.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import known_besides
import numpy as np
import typer
from compare_tracking import Windows, windows_of
from consistent_states import DarkPixels, Extent, LineCoordinates, Sampler
from known_besides import FRAME_US, FREE, GYROSCOPE, RATES, displacement, flown, seen
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from runtime import Box, Estimator, EventError, ModelError, Motion, Scene, Tracker, terminal
from runtime.errors import fail
from runtime.motion import Displacement
from runtime.recordings.attitude import AttitudeError
from runtime.recordings.follower import Follower, References, TrackingError
from runtime.recordings.recording import RecordingError
from runtime.recordings.truth import Truth, TruthError

Floats = NDArray[np.float64]

TRIES = 16_000
"""States that are tried of every frame."""
EXTREME, COMMON = 80, 1_500
"""Kept for the next frame: so many on each side of each axis, and others at random."""
KINDS = (0.4, 0.25, 0.05, 0.05, 0.15)
"""Shares of the tries that move, besides as the truth does, along a difference of two states in line coordinates, or as far as the bounds
let it in state coordinates, anywhere within the bounds, to a corner of them, and along z alone; the rest move as the truth does."""
SMALLEST_STEP = 1e-3
"""Share of a difference in line coordinates that a step takes at least."""


class Histories:
    """States of the latest frame with a history that no frame contradicts, `states` (n, 4); searched around the truth's own history."""

    def __init__(self, scene: Scene, budget: int, rng: np.random.Generator) -> None:
        self._scene, self._budget, self._rng = scene, budget, rng
        self.states, self._truth = np.zeros((0, 4)), np.zeros(4)

    def update(self, frame: NDArray[np.uint8], truth: Floats, moved: Displacement | None, prior: Box) -> Extent:
        """The next frame: its true state (4,), bounds on how far any state has moved since the last one, None of the first, and a prior.

        Raises ValueError if nothing is left, as where the truth itself breaks an assumption.
        """
        dark = DarkPixels.of(frame.view(np.bool_))
        if moved is None:
            sampler = Sampler(self._scene, frame.view(np.bool_), self._budget, truth, self._rng)
            sampler.extent()
            tried = np.concatenate([sampler.states, truth[None]])
        else:
            tried = self._moved(truth, moved)
        inside = self._scene.domain.contains(tried) & ((prior.lower <= tried) & (tried <= prior.upper)).all(axis=1)
        tried = tried[inside]
        self.states = self._kept(tried[dark.missed(self._scene, tried) <= self._budget], truth)
        self._truth = truth
        return Extent(self.states.min(axis=0), self.states.max(axis=0), 1, True)

    def _moved(self, truth: Floats, by: Displacement) -> Floats:
        """States to which the ones before may have moved: those moved as the truth has, and others, each within the bounds."""
        rng, states, shift = self._rng, self.states, truth - self._truth
        parent, one, other = states[rng.integers(len(states), size=(3, TRIES))]
        low, high = by.lower - shift, by.upper - shift
        along = one - other
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(along > 0, high / along, np.where(along < 0, low / along, np.inf))[:, FREE].min(axis=1)
        within = rng.uniform(low, high, (TRIES, 4))
        line = LineCoordinates.around(self._scene, self._truth)
        share = np.exp(rng.uniform(np.log(SMALLEST_STEP), 0, (TRIES, 1)))
        steps = [
            line.states(line.of(parent) + share * (line.of(one) - line.of(other))) - parent,
            along * (np.clip(room, 0, 1) * rng.random(TRIES) ** 0.5)[:, None],
            within,
            np.where(rng.random((TRIES, 4)) < 0.5, low, high),
            within * [0, 0, 0, 1],
            np.zeros((TRIES, 4)),
        ]
        kind = np.searchsorted(np.cumsum(KINDS), rng.random(TRIES))
        moved = np.stack(steps)[kind, np.arange(TRIES)] + parent + shift
        parents = np.concatenate([states, parent])
        moved = np.concatenate([states + shift, moved])
        moved = np.clip(np.nan_to_num(moved), parents + by.lower, parents + by.upper)
        kept = (states == self._truth).all(axis=1).any()
        within = ((by.lower <= shift) & (shift <= by.upper)).all()
        return np.concatenate([moved, truth[None]]) if kept and within else moved

    def _kept(self, states: Floats, truth: Floats) -> Floats:
        """The most extreme states, the true one if it is there, and some others."""
        if len(states) == 0:
            raise ValueError("nothing is left that the frames, the motion and the references allow; give bounds that the truth keeps")
        order = np.argsort(states[:, FREE], axis=0, kind="stable")
        others = self._rng.integers(len(states), size=COMMON)
        true = np.flatnonzero((states == truth).all(axis=1))[:1]
        return states[np.unique(np.concatenate([order[:EXTREME].ravel(), order[-EXTREME:].ravel(), others, true]))]


class _ExactMotion(Sampler):
    """The states of the last frame from which no earlier frame is contradicted either, if each state has moved as the truth has."""

    def __init__(self, scene: Scene, windows: Windows, budget: int, rng: np.random.Generator) -> None:
        *_, (_, last, now) = windows
        self._earlier = [(DarkPixels.of(frame.view(np.bool_)), state - now) for _, frame, state in windows[-2::-1]]
        super().__init__(scene, last.view(np.bool_), budget, now, rng)

    def _allowed(self, states: Floats) -> NDArray[np.int64]:
        left = super()._allowed(states)
        for dark, shift in self._earlier:
            left = left[dark.missed(self._scene, states[left] + shift) <= self._budget] if len(left) else left
        return left


@dataclass
class Compared:
    """One way of following: half-widths of theta, y and z of each window that counts."""

    name: str
    band: list[Floats] = field(default_factory=list)
    limit: list[Floats] = field(default_factory=list)
    states: int = 0
    outside: int = 0
    """States with a history that the tracked box lacks."""

    def add(self, box: Box | None, histories: Histories, extent: Extent, counts: bool) -> None:
        """A window; only those that count are shown, and all are checked."""
        within = np.zeros(len(histories.states), dtype=bool)
        if box is not None:
            within = np.logical_and.reduce((box.lower <= histories.states) & (histories.states <= box.upper), axis=1)
        self.states, self.outside = self.states + len(within), self.outside + int((~within).sum())
        if counts and box is not None:
            self.band.append(box.half_widths[FREE])
            self.limit.append(extent.half_widths[FREE])


def followed_flights(estimator: Estimator, flights: int, missed: int, clutter: float, seed: int, console: Console) -> list[Compared]:
    """By the rates' bounds alone, and with each displacement told."""
    told_to = f"told to {GYROSCOPE[0]} rad/s, {GYROSCOPE[2]} m/s"
    bounds, told = Compared("by the rates' bounds alone"), Compared(told_to)
    motion, scene, budget = Motion(-RATES, RATES), estimator.scene, estimator.missed_budget
    first = known_besides.FLIGHT_FRAMES - known_besides.COUNTED
    for flight in track(range(flights), "flights", console=console, transient=True):
        rng = np.random.default_rng([seed, budget, missed, flight])
        samples = (np.random.default_rng([seed, budget, missed, flight, way]) for way in range(2))
        ways = [(way, Tracker(estimator, motion), Histories(scene, budget, own)) for way, own in zip((bounds, told), samples, strict=True)]
        for number, (state, before) in enumerate(flown(scene, rng)):
            frame = seen(estimator, state, missed, clutter, rng).view(np.uint8)
            since = displacement(state - before, GYROSCOPE * (FRAME_US / 1e6), rng)
            for way, tracker, histories in ways:
                intervals = since if way is told else {}
                box = tracker.update(frame, number * FRAME_US, displacement=intervals or None).box
                moved = motion.over(FRAME_US).replaced(intervals) if number else None
                way.add(box, histories, histories.update(frame, state, moved, estimator.domain), number >= first)
    return [bounds, told]


def parts_of(windows: Windows, parts: int, length: int) -> list[Windows]:
    """As many stretches of so many windows, at equal distances. Raises ValueError if there are not as many windows."""
    if len(windows) < length:
        raise ValueError(f"--windows: found {length}, of a recording with {len(windows)} that keep the assumptions; give fewer")
    starts = np.linspace(0, len(windows) - length, parts).astype(int)
    return [windows[start : start + length] for start in starts]


def followed_recording(
    estimator: Estimator, stretches: Sequence[Windows], counted: int, motion: str | None, attitude: Path | None, seed: int, console: Console
) -> list[Compared]:
    """Over time, and with the pitch of an attitude reference too."""
    ways = [Compared("over time")] + ([] if attitude is None else [Compared("with the reference")])
    for way, (number, windows) in itertools.product(ways, enumerate(stretches)):
        references = References(None if way is ways[0] else attitude, None, pitch_alone=True)
        follower = Follower.of(estimator, references, motion, None, 0)
        histories = Histories(estimator.scene, estimator.missed_budget, np.random.default_rng([seed, number]))
        before_us = None
        shown = track(windows, f"{way.name}, part {number + 1}", console=console, transient=True)
        for place, (instant_us, frame, state) in enumerate(shown):
            prior = follower.known(instant_us)[1]
            box = follower.update(frame, instant_us).box
            moved = None if before_us is None else follower.tracker.motion.over(instant_us - before_us)
            extent = histories.update(frame, state, moved, estimator.domain if prior is None else prior)
            way.add(box, histories, extent, place >= len(windows) - counted)
            before_us = instant_us
    return ways


def with_exact_motion(estimator: Estimator, stretches: Iterable[Windows], last: int, seed: int) -> Iterator[Floats]:
    """Half-widths of what the last windows of each stretch leave."""
    for number, windows in enumerate(stretches):
        rng = np.random.default_rng([seed, 1, number])
        yield _ExactMotion(estimator.scene, windows[-last:], estimator.missed_budget, rng).extent().half_widths[FREE]


def table_of(compared: Sequence[Compared], title: str) -> Table:
    """A row a way: medians over the windows that count."""
    table = Table("half-widths theta, y, z", "band", "limit, sampled", "band over limit", title=title, title_justify="left")
    for way in compared:
        if way.band:
            ratios = np.median(np.divide(way.band, way.limit), axis=0)
            table.add_row(way.name, _text(way.band), _text(way.limit), " ".join(f"{ratio:.2f}" for ratio in ratios))
        else:
            table.add_row(way.name, "-", _text(way.limit), "-")
    return table


def _text(widths: Sequence[Floats]) -> str:
    return " ".join(f"{width:.4f}" for width in np.median(widths, axis=0)) if len(widths) else "-"


def main(
    model: Annotated[Path | None, typer.Argument(help="Model that export-model wrote; by default the paper's.")] = None,
    recording: Annotated[Path | None, typer.Option(help="Event recording; without one, flights are simulated.")] = None,
    truth: Annotated[Path | None, typer.Option(help="CSV of its true states: time_us, theta_rad, x_m, y_m, z_m.")] = None,
    attitude: Annotated[Path | None, typer.Option(help="CSV of an attitude reference, of which the pitch is taken.")] = None,
    motion: Annotated[str | None, typer.Option(help="Largest rates of theta, x, y, z in a recording; by default the scene's.")] = None,
    parts: Annotated[int, typer.Option(min=1, help="Parts of the recording.")] = 6,
    windows: Annotated[int, typer.Option(min=2, help="Windows of 40 ms of each part.")] = 100,
    counted: Annotated[int, typer.Option(min=1, help="The last so many of each count.")] = 50,
    exact: Annotated[int, typer.Option(min=0, help="Windows before each part's end whose motion were known exactly.")] = 0,
    flights: Annotated[int, typer.Option(min=1, help="Simulated flights.")] = 3,
    missed_budget: Annotated[int | None, typer.Option(min=0, help="Pixels of the runway that may be dark, not the model's.")] = None,
    missed: Annotated[int, typer.Option(min=0, help="How many are dark in each frame of a simulated flight.")] = 0,
    clutter: Annotated[float, typer.Option(min=0, max=1, help="Share of the pixels that clutter lights there.")] = 0.02,
    seed: Annotated[int, typer.Option(min=0, help="Seed of flights and samples.")] = 0,
) -> None:
    """Compare what is certified over time with the states that have a history which no frame contradicts."""
    errors = terminal.console(stderr=True)
    try:
        estimator = Estimator.load(model, missed_budget=missed_budget)
        scene, budget = estimator.scene, estimator.missed_budget
        if not scene.camera.pinhole or scene.tolerance.line_px:
            raise ValueError(
                "the limit is sampled of a pinhole and of frames that are exact alone; give a model without distortion and line_px"
            )
        if missed > budget:
            raise ValueError(f"--missed: found {missed}, expected at most the budget, {budget}; raise --missed-budget")
        if (recording is None) != (truth is None):
            raise ValueError("--recording and --truth: found one without the other; give both, or none")
        if recording is None or truth is None:
            compared = followed_flights(estimator, flights, missed, clutter, seed, errors)
            title = f"{flights} flights, m = {budget}, {missed} missed"
        else:
            known = windows_of(estimator, recording, Truth.load(truth), FRAME_US)
            kept = [window for window in known if DarkPixels.of(window[1].view(np.bool_)).missed(scene, window[2][None])[0] <= budget]
            stretches = parts_of(kept, parts, windows)
            compared = followed_recording(estimator, stretches, counted, motion, attitude, seed, errors)
            if exact:
                name = f"the last {exact} windows, motion exact"
                compared.append(Compared(name, limit=list(with_exact_motion(estimator, stretches, exact, seed))))
            title = f"{parts} parts of {windows} windows, the last {counted} of each, m = {budget}"
    except (ModelError, RecordingError, EventError, TruthError, AttitudeError, TrackingError, ValueError, OSError) as error:
        fail(error)
    console = terminal.console(140)
    console.print(table_of(compared, title))
    outside, states = sum(way.outside for way in compared), sum(way.states for way in compared)
    console.print(f"states with a history that the tracked box lacks: {outside} of {states}", highlight=False)
    if outside:
        raise typer.Exit(1)


if __name__ == "__main__":
    terminal.run(main)

"""What `run-model` writes of a recording, window by window, in constant memory: a table, a summary, pictures, a video.

| file | what |
|---|---|
| estimates.csv | a line a window: see `COLUMNS` |
| summary.json | counts, means, the model's digest and assumptions |
| overlay.mp4, overlay_<window>.png | `runtime.recordings.draw.draw_estimate` |
| state.png | `runtime.recordings.draw.draw_history`: state against time with the certified band |

Every file is written beside its name and renamed when the report is closed, also after an interruption. With a truth, every window is
judged: whether Theorem A's assumptions hold for it, and whether the certified box has the truth in it.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.errors import one_line
from runtime.estimate import Estimate
from runtime.estimator import Estimator
from runtime.image import dilated, runway_image
from runtime.recordings.draw import History, Moment, Picture, draw_estimate, draw_history, png
from runtime.scene import STATE_NAMES, STATE_UNITS, Scene
from runtime.whole_file import replacing, write_whole

STATE_COLUMNS = [f"{name}_{unit}" for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True)]
COLUMNS = [
    *("time_us", "outcome", *STATE_COLUMNS, *(f"lower_{name}" for name in STATE_COLUMNS), *(f"upper_{name}" for name in STATE_COLUMNS)),
    *("cell", "passing", "regions", "fallback", "touches_boundary", "mismatch", "lit_share", "milliseconds"),
]
"""A window's start, its outcome, state and certified box (empty where nothing is certified), and the rest of `runtime.Estimate`."""
TRUTH_COLUMNS = [*(f"truth_{name}" for name in STATE_COLUMNS), "missed", "assumptions_hold", "truth_inside", "error_2norm"]
"""With a truth: the state at the window's middle, and how the window fares against it (`Judgement`)."""
MOST_PICTURES = 12


class TruthError(ValueError):
    """A truth file that cannot be used. One line: the file, what was found, what to do."""


@dataclass(frozen=True)
class Truth:
    """States (n, 4) known at ascending times (n,) us, between which is interpolated."""

    time_us: NDArray[np.float64]
    states: NDArray[np.float64]

    @classmethod
    def load(cls, path: str | Path) -> Truth:
        """Reads a CSV file with the columns time_us, theta_rad, x_m, y_m, z_m. Raises `TruthError`."""
        try:
            with Path(path).open(encoding="utf-8", newline="") as file:
                names = next(csv.reader(file), [])
            wanted = [names.index(name) for name in ("time_us", *STATE_COLUMNS)]
            rows = np.loadtxt(path, delimiter=",", skiprows=1, usecols=wanted, ndmin=2)
        except (OSError, ValueError) as error:
            reason = one_line(error)
            raise TruthError(f"{path}: {reason}; give a CSV file with the columns time_us, {', '.join(STATE_COLUMNS)}") from error
        if len(rows) == 0 or not np.isfinite(rows).all() or (np.diff(rows[:, 0]) <= 0).any():
            raise TruthError(f"{path}: found {len(rows)} lines, or times that do not ascend; give finite numbers in order of time")
        return cls(rows[:, 0], rows[:, 1:])

    def at(self, time_us: float) -> NDArray[np.float64] | None:
        """The state (4,) at a time, or None before the first and after the last."""
        if not self.time_us[0] <= time_us <= self.time_us[-1]:
            return None
        return np.array([np.interp(time_us, self.time_us, column) for column in self.states.T])


@dataclass(frozen=True)
class Judgement:
    """A window against its truth."""

    truth: NDArray[np.float64]
    missed: int
    """Pixels of I_r(truth) without a lit pixel within the tolerance."""
    assumptions_hold: bool
    """`missed` is within the budget and the truth lies in the domain: Theorem A promises a box with the truth in it."""
    inside: bool
    """There is a box and the truth lies in it."""
    error: float | None
    """2-norm of estimate minus truth, rad and m together as in the paper; None where nothing is certified."""


def missed_pixels(scene: Scene, frame: NDArray[np.uint8], state: NDArray[np.float64], line_px: int) -> int:
    """Pixels of I_r(state) without a lit pixel of the frame within `line_px` in the sup norm: what Theorem A's assumption counts."""
    return int(np.count_nonzero((runway_image(scene, state) != 0) & ~dilated(frame != 0, line_px)))


def judge(scene: Scene, frame: NDArray[np.uint8], estimate: Estimate, truth: NDArray[np.float64], missed_budget: int) -> Judgement:
    """The window's frame and estimate, made with that budget, against its true state (4,)."""
    missed = missed_pixels(scene, frame, truth, scene.tolerance.line_px)
    in_domain = bool(((scene.domain.lower <= truth) & (truth <= scene.domain.upper)).all())
    error = None if estimate.state is None else float(np.linalg.norm(estimate.state - truth))
    inside = estimate.box is not None and estimate.box.contains(truth)
    return Judgement(truth, missed, in_domain and missed <= missed_budget, inside, error)


@dataclass
class Tally:
    """Counts and sums over the windows so far."""

    counts: Counter[str] = field(default_factory=Counter)
    half_widths: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))
    milliseconds: float = 0.0
    slowest_ms: float = 0.0
    errors: dict[str, list[float]] = field(default_factory=lambda: {"held": [0.0, 0.0], "broken": [0.0, 0.0]})
    """Sum and largest of the errors, where the assumptions hold and where they do not."""

    def add(self, estimate: Estimate, milliseconds: float, judgement: Judgement | None) -> None:
        """Counts one window."""
        self.milliseconds += milliseconds
        self.slowest_ms = max(self.slowest_ms, milliseconds)
        answers = {"windows": True, "certified": estimate.certified, "fallback": estimate.used_fallback}
        self.counts.update(name for name, answer in (answers | {"touches_boundary": estimate.touches_boundary}).items() if answer)
        if estimate.box is not None:
            self.half_widths += estimate.box.half_widths
        if judgement is not None:
            self._judge(estimate, judgement)

    def _judge(self, estimate: Estimate, judgement: Judgement) -> None:
        kind = "held" if judgement.assumptions_hold else "broken"
        verdict = "no_runway" if not estimate.certified else "inside" if judgement.inside else "outside"
        self.counts.update([kind, f"{kind}_{verdict}"])
        if judgement.error is not None:
            total, largest = self.errors[kind]
            self.errors[kind] = [total + judgement.error, max(largest, judgement.error)]

    def table(self) -> dict[str, Any]:
        """Counts and means, for JSON."""
        windows, certified = max(self.counts["windows"], 1), max(self.counts["certified"], 1)
        found: dict[str, Any] = {name: self.counts[name] for name in ("windows", "certified", "fallback", "touches_boundary")}
        found["no_runway"] = self.counts["windows"] - self.counts["certified"]
        found["mean_half_widths"] = dict(zip(STATE_COLUMNS, (self.half_widths / certified).tolist(), strict=True))
        found["milliseconds_a_window"] = {"mean": self.milliseconds / windows, "largest": self.slowest_ms}
        if self.counts["held"] + self.counts["broken"]:
            found["assumptions_hold"], found["assumptions_broken"] = self._judged("held"), self._judged("broken")
        return found

    def _judged(self, kind: str) -> dict[str, Any]:
        counts = {"windows": self.counts[kind]}
        counts |= {verdict: self.counts[f"{kind}_{verdict}"] for verdict in ("inside", "outside", "no_runway")}
        certified = counts["inside"] + counts["outside"]
        total, largest = self.errors[kind]
        return {**counts, "mean_error": total / certified if certified else None, "largest_error": largest if certified else None}


class Report:
    """Takes windows with `add` and writes the files above; `close` finishes them. Raises OSError where a file cannot be written.

    `missed_budget`: the one that the estimator was loaded with, None for the model's.
    """

    def __init__(
        self,
        folder: Path,
        estimator: Estimator,
        window_us: int,
        step_us: int,
        truth: Truth | None,
        *,
        video: bool,
        missed_budget: int | None = None,
    ) -> None:
        self.folder, self.estimator, self.window_us, self.truth, self.video = folder, estimator, window_us, truth, video
        self.step_us = step_us
        self.missed_budget = estimator.scene.tolerance.missed_budget if missed_budget is None else missed_budget
        self.tally = Tally()
        self._parts = ExitStack()
        self._file = self._parts.enter_context(replacing(folder / "estimates.csv")).open("w", encoding="utf-8", newline="")
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._rows.writerow([*COLUMNS, *(TRUTH_COLUMNS if truth else [])])
        self._history = History()
        self._pictures: dict[int, Picture] = {}
        self._picture_every = 1
        self._writer: Any = None

    def add(self, start_us: int, frame: NDArray[np.uint8], estimate: Estimate, milliseconds: float) -> None:
        """One window: its start, its frame, what the estimator made of it, and how long that took."""
        number = self.tally.counts["windows"]
        state = self.truth.at(start_us + self.window_us / 2) if self.truth else None
        judgement = None if state is None else judge(self.estimator.scene, frame, estimate, state, self.missed_budget)
        self.tally.add(estimate, milliseconds, judgement)
        row = _row(start_us, estimate, float(frame.mean()), milliseconds)
        self._rows.writerow([*row, *(_judgement_row(judgement) if self.truth else [])])
        box = estimate.box
        self._history.add(Moment(start_us, start_us + self.step_us, estimate.state, box and box.lower, box and box.upper, state))
        if self.video or number % self._picture_every == 0:
            self._draw(number, start_us, frame, estimate, state)

    def _draw(self, number: int, start_us: int, frame: NDArray[np.uint8], estimate: Estimate, truth: NDArray[np.float64] | None) -> None:
        mask = self.estimator.spatial_mask(estimate.cell)
        title = f"{start_us / 1e6:.3f} s"
        picture = draw_estimate(self.estimator.scene, frame, estimate, mask=mask, truth=truth, title=title)
        if self.video:
            self._film(picture)
        if number % self._picture_every == 0:
            self._pictures[number] = picture
        if len(self._pictures) > MOST_PICTURES:
            self._picture_every *= 2
            self._pictures = {kept: shown for kept, shown in self._pictures.items() if kept % self._picture_every == 0}

    def _film(self, picture: Picture) -> None:
        height, width = (side - side % 2 for side in picture.shape[:2])
        if self._writer is None:
            rate = min(1e6 / self.step_us, 60.0)
            part = self._parts.enter_context(replacing(self.folder / "overlay.mp4"))
            self._writer = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*"mp4v"), rate, (width, height))
            if not self._writer.isOpened():
                raise OSError(f"{part}: OpenCV cannot write this video; use --no-video")
        self._writer.write(picture[:height, :width])

    def close(self, extra: dict[str, Any]) -> dict[str, Any]:
        """Finishes every file; `extra` goes into summary.json, which is returned."""
        self._file.close()
        if self._writer is not None:
            self._writer.release()
        self._parts.close()
        for old in self.folder.glob("overlay_*.png"):
            old.unlink()
        pictures = {f"overlay_{number:06d}.png": picture for number, picture in self._pictures.items()}
        pictures["state.png"] = draw_history(self.estimator.scene, self._history)
        for name, picture in pictures.items():
            write_whole(self.folder / name, png(picture))
        budget = {"missed_budget": self.missed_budget, "assumptions": self._assumptions()}
        summary = {**extra, **self.tally.table(), **budget}
        write_whole(self.folder / "summary.json", json.dumps(summary, indent=2).encode())
        return summary

    def _assumptions(self) -> list[str]:
        """The model's, and what the caller put in place of its budget."""
        own = self.estimator.scene.tolerance.missed_budget
        if self.missed_budget == own:
            return self.estimator.metadata["assumptions"]
        return [*self.estimator.metadata["assumptions"], f"In place of these {own} pixels: at most {self.missed_budget}."]


def _row(start_us: int, estimate: Estimate, lit_share: float, milliseconds: float) -> list[object]:
    sides = (None, None) if estimate.box is None else (estimate.box.lower, estimate.box.upper)
    states = [number for state in (estimate.state, *sides) for number in ([""] * 4 if state is None else state.tolist())]
    flags = [int(estimate.used_fallback), int(estimate.touches_boundary)]
    counts = [estimate.cell, len(estimate.passing), len(estimate.regions), *flags, estimate.mismatch]
    return [start_us, estimate.outcome.value, *states, *counts, f"{lit_share:.6f}", f"{milliseconds:.3f}"]


def _judgement_row(judgement: Judgement | None) -> list[object]:
    if judgement is None:
        return [""] * len(TRUTH_COLUMNS)
    error = "" if judgement.error is None else judgement.error
    return [*judgement.truth.tolist(), judgement.missed, int(judgement.assumptions_hold), int(judgement.inside), error]

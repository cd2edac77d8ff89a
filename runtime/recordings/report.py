"""What `run-model` writes of a recording, window by window, in constant memory: a table, a summary, pictures, a video.

| file | what |
|---|---|
| estimates.csv | a line a window: see `COLUMNS` |
| summary.json | counts, means, why nothing was certified, the model's digest and assumptions, names of the other files |
| overlay.mp4, overlay_<window>.png | `runtime.recordings.draw.draw_estimate` |
| state.png | `runtime.recordings.history.draw_history`: state against time with the certified band |

All files get their names together when the report is closed, also after an interruption; those of an earlier report that have no new
one are removed. With a truth, every window is judged: whether Theorem A's assumptions hold for it, and whether the certified box has the
truth in it.
"""

from __future__ import annotations

import contextlib
import csv
import json
import re
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.assumptions import told_turn
from runtime.attitude import Attitude
from runtime.estimate import Estimate
from runtime.estimator import Estimator
from runtime.explanation import Explanation, explain
from runtime.recordings.draw import Picture, draw_estimate, png
from runtime.recordings.history import History, Moment, draw_history
from runtime.recordings.tally import Tally
from runtime.recordings.truth import Judgement, Truth, judge
from runtime.recordings.video import WIDTH, Video
from runtime.scene import STATE_COLUMNS
from runtime.whole_file import OutputFolder, writing

COLUMNS = [
    *("time_us", "outcome", *STATE_COLUMNS, *(f"lower_{name}" for name in STATE_COLUMNS), *(f"upper_{name}" for name in STATE_COLUMNS)),
    *("cell", "passing", "regions", "fallback", "touches_boundary", "mismatch", "lit_share", "milliseconds"),
    *("reason", *(f"nearest_{name}" for name in STATE_COLUMNS), "nearest_pixels", "nearest_missed", "nearest_dark_rows"),
]
"""A window's start, its outcome, state and certified box (empty where nothing is certified), the rest of `runtime.Estimate`; and, where
nothing is certified, what `runtime.explanation` has to say."""
TRUTH_COLUMNS = [
    *(*(f"truth_{name}" for name in STATE_COLUMNS), "missed", "dark_rows", "assumptions_hold", "truth_inside"),
    *(f"error_{name}" for name in STATE_COLUMNS),
]
"""With a truth: the state at the window's instant, and how the window fares against it (`runtime.recordings.truth.Judgement`)."""
TRACKED_COLUMNS = [
    *("instant_us", "tracked_outcome", *(f"tracked_{name}" for name in STATE_COLUMNS)),
    *(f"tracked_{side}_{name}" for side in ("lower", "upper") for name in STATE_COLUMNS),
]
"""With a tracker: the instant that the certificate speaks of, and outcome, state and box over time; with a truth, whether it is inside."""
TRACKED_INSIDE = "tracked_truth_inside"
TABLE, SUMMARY, VIDEO = "estimates.csv", "summary.json", "overlay.mp4"
PICTURE_NAME = re.compile(r"overlay_\d{6,}\.png")
MOST_PICTURES = 12


class Report:
    """Takes windows with `add` and writes the files above; `close` finishes them. As a context it leaves nothing half-written behind.

    `turned`: roll and yaw are told of every window. `inputs`: files that are being read. Raises `runtime.whole_file.OutputError` where a
    file cannot be written.
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
        tracked: bool = False,
        turned: bool = False,
        inputs: Iterable[Path] = (),
    ) -> None:
        self.folder, self.estimator, self.window_us, self.step_us, self.truth = folder, estimator, window_us, step_us, truth
        self.instant_us = window_us * estimator.scene.instant_share
        """From the start of a window to the instant that its certificate speaks of."""
        self._turned = turned
        self._tracked_columns = [*TRACKED_COLUMNS, *([TRACKED_INSIDE] if truth else [])] if tracked else []
        self.tally = Tally(estimator.missed_budget, estimator.largest_missed_budget)
        self._outputs = OutputFolder(folder, inputs)
        with writing(folder / TABLE):
            self._file = self._outputs.begin(TABLE).open("w", encoding="utf-8", newline="")
            self._rows = csv.writer(self._file, lineterminator="\n")
            self._rows.writerow([*COLUMNS, *(TRUTH_COLUMNS if truth else []), *self._tracked_columns])
        self._video = Video(self._outputs, VIDEO, step_us) if video else None
        self._history = History()
        self._to_draw: dict[int, Callable[[], Picture]] = {}
        self._instants_us: tuple[float, float] | None = None
        self._picture_every = 1

    def __enter__(self) -> Report:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._file.close()
        self._outputs.discard()

    def add(
        self,
        start_us: int,
        frame: NDArray[np.uint8],
        estimate: Estimate,
        milliseconds: float,
        tracked: Estimate | None = None,
        attitude: Attitude | None = None,
    ) -> None:
        """One window: its start, its frame, what the estimator made of it, how long that took, and what a tracker made of it.

        Of a camera that an `attitude` is told of no truth tells which pixels should be lit: windows are not judged or explained then.
        """
        level = attitude is None
        number = self.tally.counts["windows"]
        instant_us = start_us + self.instant_us
        earliest, latest = self._instants_us or (instant_us, instant_us)  # of all runs of a clock that went back, too
        self._instants_us = min(earliest, instant_us), max(latest, instant_us)
        state = self.truth.at(instant_us) if self.truth else None
        judgement = (
            None if state is None or not level else judge(self.estimator.scene, frame, estimate, state, self.estimator.missed_budget)
        )
        explanation = None if estimate.certified or not level else explain(self.estimator, frame, estimate)
        self.tally.add(estimate, milliseconds, judgement, explanation)
        if tracked is not None:
            self.tally.follow(tracked, state)
        row = [*_row(start_us, estimate, float(frame.mean()), milliseconds), *_explanation_row(explanation)]
        with writing(self.folder / TABLE):
            row += [*(_judgement_row(judgement) if self.truth else []), *self._tracked_row(instant_us, tracked, state)]
            self._rows.writerow(row)
        box, followed = estimate.box, tracked and tracked.box
        best = estimate if tracked is None or followed is None else tracked
        self._history.add(Moment(start_us, start_us + self.step_us, best.state, box and box.lower, box and box.upper, state, followed))
        shown = {"truth": state, "explanation": explanation, "title": f"{start_us / 1e6:.3f} s", "attitude": attitude, "over_time": tracked}
        self._draw(number, frame, estimate, shown)

    def _tracked_row(self, instant_us: float, tracked: Estimate | None, truth: NDArray[np.float64] | None) -> list[object]:
        if tracked is None:
            return [""] * len(self._tracked_columns)
        inside = "" if truth is None else int(tracked.box is not None and tracked.box.contains(truth))
        return [instant_us if instant_us % 1 else int(instant_us), tracked.outcome.value, *_numbers(tracked), inside][
            : len(self._tracked_columns)
        ]

    def _draw(self, number: int, frame: NDArray[np.uint8], estimate: Estimate, shown: dict[str, Any]) -> None:
        """Draws the window if it is one for the video; keeps what a picture needs, as most are given up for later ones."""
        filmed = self._video is not None and number % self._video.every == 0
        pictured = number % self._picture_every == 0
        if self._video is not None and filmed:
            self._video.add(self._picture(frame, estimate, width=WIDTH, **shown))
        if pictured:
            self._to_draw[number] = partial(self._picture, frame, estimate, **shown)
        if len(self._to_draw) > MOST_PICTURES:
            self._picture_every *= 2
            self._to_draw = {kept: picture for kept, picture in self._to_draw.items() if kept % self._picture_every == 0}

    def _picture(self, frame: NDArray[np.uint8], estimate: Estimate, **shown: Any) -> Picture:
        mask = self.estimator.spatial_mask(estimate.cell, shown["attitude"])
        return draw_estimate(self.estimator.scene, frame, estimate, mask=mask, **shown)

    def close(self, extra: dict[str, Any]) -> dict[str, Any]:
        """Finishes every file; `extra` goes into summary.json, which is returned."""
        with writing(self.folder / TABLE):
            self._file.close()
        if self._video is not None:
            self._video.close()
        for number, picture in self._to_draw.items():
            self._outputs.write(f"overlay_{number:06d}.png", png(picture()))
        self._outputs.write("state.png", png(draw_history(self.estimator.scene, self._history)))
        names = [*self._outputs.names, SUMMARY]
        extra = {**extra, "window_instants_us": self._instants_us}
        summary = {**extra, **self.tally.table(), "missed_budget": self.estimator.missed_budget, "assumptions": self._assumptions()}
        earlier = _files_of_report(self.folder)
        self._outputs.write(SUMMARY, json.dumps({**summary, "files": names}, indent=2).encode())
        self._outputs.replace(earlier)
        return summary

    def _assumptions(self) -> list[str]:
        """The model's, and what the caller put in place of its budget."""
        own, used = self.estimator.scene.tolerance.missed_budget, self.estimator.missed_budget
        lines = self.estimator.metadata["assumptions"]
        lines = told_turn(lines, self.estimator.scene) if self._turned else lines
        return lines if used == own else [*lines, f"In place of these {own} pixels: at most {used}."]


def _files_of_report(folder: Path) -> list[str]:
    """The files that a report in the folder says it wrote, as far as such a report writes such files."""
    try:
        names = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))["files"]
        return [name for name in names if name in (TABLE, VIDEO, "state.png") or PICTURE_NAME.fullmatch(name)]
    except (OSError, ValueError, LookupError, TypeError):
        return []


def _row(start_us: int, estimate: Estimate, lit_share: float, milliseconds: float) -> list[object]:
    flags = [int(estimate.used_fallback), int(estimate.touches_boundary)]
    counts = [estimate.cell, len(estimate.passing), len(estimate.regions), *flags, estimate.mismatch]
    return [start_us, estimate.outcome.value, *_numbers(estimate), *counts, f"{lit_share:.6f}", f"{milliseconds:.3f}"]


def _numbers(estimate: Estimate) -> list[object]:
    """State, lower and upper bounds; empty where nothing is certified."""
    sides = (None, None) if estimate.box is None else (estimate.box.lower, estimate.box.upper)
    return [number for state in (estimate.state, *sides) for number in ([""] * 4 if state is None else state.tolist())]


def _explanation_row(explanation: Explanation | None) -> list[object]:
    if explanation is None:
        return [""] * 8
    nearest = explanation.nearest
    return [explanation.reason.value, *nearest.state.tolist(), nearest.pixels, nearest.missed, nearest.rows_text()]


def _judgement_row(judgement: Judgement | None) -> list[object]:
    if judgement is None:
        return [""] * len(TRUTH_COLUMNS)
    error = [""] * 4 if judgement.error is None else judgement.error.tolist()
    lacking, answers = judgement.shortfall, [int(judgement.assumptions_hold), int(judgement.inside)]
    return [*judgement.truth.tolist(), lacking.missed, lacking.rows_text(), *answers, *error]

"""Why a frame has no certificate: the state whose runway it comes nearest to showing, and which of that runway's pixels are dark.

For reports and pictures, off the path of an estimate. A state's *shortfall* is exact: it counts what Theorem A's assumption counts. The
nearest state is what a search finds: no state with fewer dark pixels was met, and nothing of it is certified. Since a state that lacks
at most `missed_budget` pixels is never refuted, its shortfall is a budget at which the frame would have a certificate.
"""

from __future__ import annotations

import enum
import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.camera import project
from runtime.estimate import Estimate
from runtime.estimator import Estimator
from runtime.image import columns_of_ends, dilated, marking_images, runway_image
from runtime.scene import STATE_NAMES, STATE_UNITS, Scene
from runtime.state_set import StateSet, fall

Floats = NDArray[np.float64]

STARTS, KEPT, ROUND = 256, 8, 128
"""States that the search draws from the entries, how many it goes on from, and how many it draws around them in a round."""
ROUNDS, NARROWING = 8, 0.5
"""Rounds, and the share of the spread of its draws that each keeps of the one before."""
SLACK = 2
"""Entries with so many more dark pixels than the best are searched too: an entry counts only what all of its states light."""


@dataclass(frozen=True)
class Shortfall:
    """What a frame lacks of a state's runway."""

    state: Floats
    """(4,), rad and m."""
    pixels: int
    """How many pixels the runway's image has."""
    missed: int
    """How many of them have no lit pixel of the frame within `line_px` in the sup norm."""
    dark_rows: Mapping[str, tuple[int, ...]]
    """The rows, from 0 at the top, in which a marking has such pixels, by the marking's name; a marking without any is left out."""

    def rows_text(self) -> str:
        """For example "L rows 231-236, 240; R row 238"."""
        return "; ".join(f"{name} row{'s'[: len(rows) > 1]} {_ranges(rows)}" for name, rows in self.dark_rows.items())


class Reason(enum.Enum):
    """Why nothing is certified."""

    NOT_FOUND = "no entry passes NN_F"
    REFUTED = "found by NN_F, refuted by the refinement"
    CLUTTERED = "more lit pixels around the runway than extra_budget allows"


@dataclass(frozen=True)
class Explanation:
    """Why a frame has no certificate. `nearest` is the best state that was found; nothing is certified of it."""

    reason: Reason
    nearest: Shortfall
    missed_budget: int

    def text(self) -> str:
        """One line: the reason, the nearest state, its dark pixels against the budget, and where they are."""
        state = zip(STATE_NAMES, self.nearest.state, STATE_UNITS, strict=True)
        place = " ".join(f"{name} {value:.4f} {unit}" for name, value, unit in state)
        return f"{self.reason.value}; nearest state found, not certified: {place}, {self.count_text()}"

    def count_text(self) -> str:
        """The dark pixels against the budget, and where they are."""
        dark = self.nearest.rows_text()
        return f"{self.nearest.missed} of {self.nearest.pixels} pixels dark, {self.missed_budget} may be{f': {dark}' if dark else ''}"


def shortfall(scene: Scene, frame: NDArray, state: Floats) -> Shortfall:
    """The shortfall of a frame (height, width), lit where not 0, against the runway's image in the state (4,)."""
    dark = dark_pixels(scene, frame, state)
    rows = {marking.name: tuple(np.flatnonzero(own.any(axis=1)).tolist()) for marking, own in zip(scene.runway.markings, dark, strict=True)}
    pixels, missed = int(np.count_nonzero(runway_image(scene, state))), missed_pixels(scene, frame, state, scene.tolerance.line_px)
    return Shortfall(state, pixels, missed, {name: own for name, own in rows.items() if own})


def missed_pixels(scene: Scene, frame: NDArray, state: Floats, line_px: int) -> int:
    """Pixels of I_r(state) without a lit pixel of the frame within `line_px` in the sup norm: what Theorem A's assumption counts."""
    return int(np.count_nonzero((runway_image(scene, state) != 0) & ~dilated(frame != 0, line_px)))


def dark_pixels(scene: Scene, frame: NDArray, state: Floats) -> NDArray[np.bool_]:
    """The pixels of each marking's image that have no lit pixel of the frame within `line_px`, (markings, height, width)."""
    return marking_images(scene, state) & ~dilated(frame != 0, scene.tolerance.line_px)


def explain(estimator: Estimator, frame: NDArray, estimate: Estimate) -> Explanation:
    """Why `estimate`, which the estimator made of the frame, has no box. Takes some ms more than an estimate; the same every time."""
    nearest = shortfall(estimator.scene, frame, _nearest_state(estimator, frame))
    if nearest.missed <= estimator.missed_budget and estimator.extra_budget >= 0:
        reason = Reason.CLUTTERED
    else:
        reason = Reason.REFUTED if len(estimate.passing) else Reason.NOT_FOUND
    return Explanation(reason, nearest, estimator.missed_budget)


def _nearest_state(estimator: Estimator, frame: NDArray) -> Floats:
    """The state (4,) with the fewest dark pixels that a search meets: from draws out of the likeliest entries ever closer to the best."""
    scene, rng = estimator.ideal, np.random.default_rng(0)
    sums = _dark_sums(scene, estimator.ideal_frame(frame))
    entries = _likeliest_entries(estimator, frame)
    sides = np.stack([entries.theta, entries.x, entries.scale, entries.z], axis=1)
    low, width = sides[..., 0], np.maximum(sides[..., 1] - sides[..., 0], 0)
    drawn = np.linspace(0, len(entries) - 1, STARTS).astype(int)
    lines, tangents, spread = low[drawn] + width[drawn] * rng.random((STARTS, 4)), entries.tangent[drawn], width.mean(axis=0)
    for _ in range(ROUNDS):
        best = np.argsort(_dark_pixels(scene, sums, _states(scene, lines, tangents)), kind="stable")[:KEPT]
        around = np.resize(best, ROUND)
        lines = np.concatenate([lines[best], lines[around] + spread * rng.standard_normal((ROUND, 4))])
        tangents, spread = tangents[np.concatenate([best, around])], spread * NARROWING
    states = _states(scene, lines, tangents)
    return states[np.argmin(_dark_pixels(scene, sums, states))]


def _likeliest_entries(estimator: Estimator, frame: NDArray) -> StateSet:
    """The entries with the fewest dark pixels among those that all of their states light, and `SLACK` more; all, if none comes close."""
    low, high = estimator.missed_budget, estimator.largest_missed_budget
    if len(estimator.entries_within(frame, high)) == 0:
        return estimator.entries_within(frame, frame.size)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if len(estimator.entries_within(frame, middle)) else (middle + 1, high)
    return estimator.entries_within(frame, min(low + SLACK, estimator.largest_missed_budget))


def _states(scene: Scene, lines: Floats, tangents: Floats) -> Floats:
    """States (n, 4) of the domain, near those with the line coordinates theta, x, scale, z (n, 4); `runtime.state_set`."""
    theta, x, scale, z = lines.T
    y = scene.camera.focal_u_px * fall(theta, tangents) / scale
    return np.clip(np.stack([theta, x, y, z], axis=-1), scene.domain.lower, scene.domain.upper)


def _dark_sums(scene: Scene, frame: NDArray) -> NDArray[np.int32]:
    """Numbers of pixels without a lit one nearby to the left of each column's start, (height, width + 1)."""
    dark = ~dilated(frame != 0, scene.tolerance.line_px)
    return np.cumsum(np.pad(dark, ((0, 0), (1, 0))), axis=1, dtype=np.int32)


def _dark_pixels(scene: Scene, sums: NDArray[np.int32], states: Floats) -> NDArray[np.int64]:
    """Dark pixels of each state's runway, (n,); those that markings share count for each of them."""
    ends = project(scene, states)
    height, width = scene.camera.shape
    top = int(np.clip(np.floor(ends[..., 1].min()), 0, height - 1))
    bottom = int(np.clip(np.ceil(ends[..., 1].max()), top + 1, height))
    first, last = columns_of_ends(ends - [0, top], bottom - top)
    rows = np.arange(top, bottom)
    start, stop = np.clip(first, 0, width), np.clip(last + 1, 0, width)
    return (sums[rows, stop] - sums[rows, start]).sum(axis=(1, 2))


def _ranges(rows: tuple[int, ...]) -> str:
    """Ascending numbers as "231-236, 240"."""
    runs = [[row for _, row in run] for _, run in itertools.groupby(enumerate(rows), lambda each: each[1] - each[0])]
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)

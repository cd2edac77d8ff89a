"""What a recording's windows come to: counts, means, errors axis by axis, and why windows have no certificate. In constant memory."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.estimate import Estimate
from runtime.explanation import Explanation, Reason
from runtime.recordings.truth import Judgement
from runtime.scene import STATE_COLUMNS


def by_column(values: NDArray[np.float64]) -> dict[str, float]:
    """A state's numbers (4,) under the names of their columns."""
    return dict(zip(STATE_COLUMNS, values.tolist(), strict=True))


def mean_of(total: NDArray[np.float64], count: int) -> dict[str, float] | None:
    """The mean of a sum of states' numbers (4,), for JSON; None of none."""
    return by_column(total / count) if count else None


@dataclass
class Errors:
    """Sizes of errors, axis by axis, (4,) each, rad and m."""

    count: int = 0
    total: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))
    largest: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))

    def add(self, error: NDArray[np.float64]) -> None:
        """Takes one estimate minus its truth, (4,)."""
        self.count += 1
        self.total += np.abs(error)
        self.largest = np.maximum(self.largest, np.abs(error))

    def table(self) -> dict[str, Any]:
        """Means and largest, for JSON; None where there is no error."""
        return {"mean_error": mean_of(self.total, self.count), "largest_error": by_column(self.largest) if self.count else None}


@dataclass
class Lacking:
    """What windows without a certificate lack."""

    reasons: Counter[Reason] = field(default_factory=Counter)
    missed: Counter[int] = field(default_factory=Counter)
    """Windows by the number of dark pixels of their nearest state."""
    dark_rows: dict[str, Counter[int]] = field(default_factory=dict)
    """By marking: windows whose nearest state has dark pixels of it in a row."""

    def add(self, explanation: Explanation) -> None:
        """Takes one window's explanation."""
        self.reasons[explanation.reason] += 1
        self.missed[explanation.nearest.missed] += 1
        for name, rows in explanation.nearest.dark_rows.items():
            self.dark_rows.setdefault(name, Counter()).update(rows)

    def table(self, missed_budget: int, largest_budget: int) -> dict[str, Any]:
        """For JSON. `certifying_budget`: a missed budget at which at least half of these windows would have a certificate; None if that is
        the present one, or if the model takes none so large."""
        missed = sorted(self.missed.elements())
        median = missed[(len(missed) - 1) // 2]
        return {
            "reasons": {reason.value: count for reason, count in self.reasons.items()},
            "missed_budget": missed_budget,
            "nearest_state_missed": {"least": missed[0], "median": median, "most": missed[-1]},
            "certifying_budget": median if missed_budget < median <= largest_budget else None,
            "largest_budget": largest_budget,
            "windows_by_dark_row": {name: {str(row): rows[row] for row in sorted(rows)} for name, rows in self.dark_rows.items()},
        }


@dataclass
class Tally:
    """Counts and sums over the windows so far. `missed_budget` and the largest that the model takes: `runtime.estimator.Estimator`."""

    missed_budget: int
    largest_budget: int
    counts: Counter[str] = field(default_factory=Counter)
    half_widths: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))
    milliseconds: float = 0.0
    slowest_ms: float = 0.0
    errors: dict[str, Errors] = field(default_factory=lambda: {"held": Errors(), "broken": Errors()})
    """Where the assumptions hold, and where they do not."""
    lacking: Lacking = field(default_factory=Lacking)
    followed: Counter[str] = field(default_factory=Counter)
    """Of the windows that a tracker followed: their outcomes, and where a truth is known, whether the box has it."""
    followed_half_widths: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))
    followed_errors: Errors = field(default_factory=Errors)

    def follow(self, tracked: Estimate, truth: NDArray[np.float64] | None) -> None:
        """Counts what a tracker made of one window, whose true state is known or not."""
        self.followed[tracked.outcome.value] += 1
        if tracked.box is not None:
            self.followed_half_widths += tracked.box.half_widths
            if truth is not None and tracked.state is not None:
                self.followed["inside" if tracked.box.contains(truth) else "outside"] += 1
                self.followed_errors.add(tracked.state - truth)

    def add(self, estimate: Estimate, milliseconds: float, judgement: Judgement | None, explanation: Explanation | None) -> None:
        """Counts one window."""
        self.milliseconds += milliseconds
        self.slowest_ms = max(self.slowest_ms, milliseconds)
        answers = {"windows": True, "certified": estimate.certified, "fallback": estimate.used_fallback}
        self.counts.update(name for name, answer in (answers | {"touches_boundary": estimate.touches_boundary}).items() if answer)
        if estimate.box is not None:
            self.half_widths += estimate.box.half_widths
        if explanation is not None:
            self.lacking.add(explanation)
        if judgement is not None:
            self._judge(estimate, judgement)

    def _judge(self, estimate: Estimate, judgement: Judgement) -> None:
        kind = "held" if judgement.assumptions_hold else "broken"
        verdict = "no_runway" if not estimate.certified else "inside" if judgement.inside else "outside"
        self.counts.update(["judged", kind, f"{kind}_{verdict}"])
        if judgement.error is not None:
            self.errors[kind].add(judgement.error)

    def table(self) -> dict[str, Any]:
        """Counts and means, for JSON."""
        windows = max(self.counts["windows"], 1)
        found: dict[str, Any] = {name: self.counts[name] for name in ("windows", "certified", "fallback", "touches_boundary")}
        found["no_runway"] = self.counts["windows"] - self.counts["certified"]
        found["mean_half_widths"] = mean_of(self.half_widths, self.counts["certified"])
        found["milliseconds_a_window"] = {"mean": self.milliseconds / windows, "largest": self.slowest_ms}
        if self.followed:
            widths = mean_of(self.followed_half_widths, self.followed["certified"])
            found["tracked"] = {**self.followed, "mean_half_widths": widths, **self.followed_errors.table()}
        if self.lacking.reasons:
            found["no_runway_explained"] = self.lacking.table(self.missed_budget, self.largest_budget)
        if self.counts["judged"]:
            found["assumptions_hold"], found["assumptions_broken"] = self._judged("held"), self._judged("broken")
        return found

    def _judged(self, kind: str) -> dict[str, Any]:
        counts = {"windows": self.counts[kind]}
        counts |= {verdict: self.counts[f"{kind}_{verdict}"] for verdict in ("inside", "outside", "no_runway")}
        return {**counts, **self.errors[kind].table()}

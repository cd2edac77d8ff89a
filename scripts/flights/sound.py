"""Flights on which all assumptions hold: every box must have the state, and no frame may contradict another.

A tracker is given frames of a flight (`flights.course`) as the campaigns draw them, with clutter and missed pixels of all kinds, under
Theorem A or B; priors with the truth on their face, told displacements, frames without a runway, late ones, times that repeat, and with a
horizon up to q broken frames of any N.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from coverage.scenarios import Scenario
from coverage.states import Rng, Stage, estimator_of, into_domain, uniform
from numpy.typing import NDArray
from random_scenes.frames import CLUTTER, EXTRA, ORDERS, STATES
from random_scenes.outcomes import Finding, Outcomes
from random_scenes.pitched_state import as_fixed
from random_scenes.watch import OutOfTimeError, described, watched
from rational_image import RationalState

from flights.course import ORIGINS_US, Course, draw_motion
from runtime import Box, Estimate, Tracker

FRAMES = 40
SHORT_FLIGHT = 12
"""Frames of each flight over a scene that is drawn at random."""
HORIZONS = ((None, 0), (None, 0), (None, 0), (1, 0), (2, 0), (10, 0), (2, 1), (8, 1), (10, 2), (9, 3))
"""Horizon and outliers of a tracker."""
BUDGETS = (0, 0, 1, 2, 8, 15)
"""Missed budgets, as far as the model takes them; or the most that it takes."""
PATIENCE_S = 120.0
SLOW_S = 5.0
"""Of one update; what a frame alone takes is some milliseconds."""

Frame = NDArray[np.bool_]


@dataclass
class SoundFlight:
    """One flight over a model's scene, and what came of it."""

    path: str
    place: str
    rng: Rng
    frames: int = FRAMES
    number: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Draws what the flight is about."""
        rng, most = self.rng, estimator_of(self.path).largest_missed_budget
        self.missed = min(int(rng.choice([*BUDGETS, most])), most)
        self.extra = int(rng.choice([-1, -1, -1, *EXTRA[:3]]))
        self.horizon, self.outliers = HORIZONS[rng.integers(len(HORIZONS))]
        self.begins, self.order = str(rng.choice(list(STATES))), ORDERS[str(rng.choice(list(ORDERS)))]
        self.layers = CLUTTER[str(rng.choice(list(CLUTTER), p=[share for share, _ in CLUTTER.values()]))][1]

    def run(self) -> Outcomes:
        """Flies it."""
        try:
            with watched(PATIENCE_S):
                self.fly()
        except OutOfTimeError:
            self.find("a flight does not end", f"in {PATIENCE_S:g} s")
        except Exception as error:
            self.find(f"{type(error).__name__}", described(error))
        outcomes = Outcomes(findings=self.findings)
        outcomes.count(("sound",), self.counts + Counter(findings=len(self.findings)))
        return outcomes

    def fly(self) -> None:
        """Goes from frame to frame."""
        rng, stage = self.rng, Stage.of(self.path, None)
        course = Course(stage, draw_motion(rng, stage), rng, STATES[self.begins](rng, stage), Fraction(int(rng.choice(ORIGINS_US))))
        tracker = Tracker(estimator_of(self.path, self.missed, self.extra), course.motion, self.horizon, self.outliers)
        past: list[tuple[float, RationalState]] = []
        broken: list[bool] = []
        for number in range(self.frames):
            self.number = number
            course.go()
            if past:
                self.judge_predictions(tracker, [(course.instant_us, course.state), past[rng.integers(len(past))]])
            if past and rng.random() < 0.1:
                self.judge_late(tracker, course, past[-1][0])
            if rng.random() < 0.02:
                tracker.reset()
                past, broken = [], []
            broken.append(self.may_break(broken) and rng.random() < 0.4)
            self.judge_update(tracker, course, broken[-1], past)

    def may_break(self, broken: list[bool]) -> bool:
        """True if fewer than q of the last N - 1 frames are broken."""
        return self.outliers > 0 and sum(broken[max(len(broken) - (self.horizon or 1) + 1, 0) :]) < self.outliers

    def judge_update(self, tracker: Tracker, course: Course, breaks: bool, past: list[tuple[float, RationalState]]) -> None:
        """One frame, its own assumptions broken or not."""
        rng, state = self.rng, course.state
        shown = as_fixed(course.stage, into_domain(course.stage, uniform(rng, course.stage))) if breaks else state
        frame = self.frame(course.stage, shown)
        if breaks and rng.random() < 0.3:
            frame = np.full_like(frame, bool(rng.random() < 0.3))
        prior = course.prior(shown if rng.random() < 0.5 else state) if rng.random() < 0.3 else None
        told = course.told(past[-1][1]) if past and rng.random() < 0.5 else None
        now_us, begun = course.instant_us, time.process_time()
        estimate = tracker.update(frame, now_us, prior, told)
        past.append((now_us, state))
        self.counts.update(
            frames=1, certified=int(estimate.certified), broken=int(breaks), told=int(bool(told)), priors=int(prior is not None)
        )
        if time.process_time() - begun > SLOW_S:
            self.find("a frame is slow", f"{time.process_time() - begun:.1f} s")
        self.judge_estimate(estimate, state)

    def judge_estimate(self, estimate: Estimate, state: RationalState) -> None:
        """A box, one of whose regions has the state."""
        if estimate.box is None:
            self.find("not certified", f"{estimate.outcome}; state {state.floats.tolist()}")
        elif not holds(estimate.box, state):
            self.find("a box without the state", f"{estimate.box}; state {state.floats.tolist()}")
        elif not any(holds(region, state) for region in estimate.regions):
            self.find("no region with the state", f"{estimate.regions}; state {state.floats.tolist()}")

    def judge_predictions(self, tracker: Tracker, known: list[tuple[float, RationalState]]) -> None:
        """The boxes at instants whose states are known, ahead and before."""
        for time_us, state in known:
            box = tracker.box_at(time_us)
            self.counts["predicted"] += box is not None
            if box is not None and not holds(box, state):
                self.find("a predicted box without the state", f"at {time_us}: {box}; state {state.floats.tolist()}")

    def judge_late(self, tracker: Tracker, course: Course, last_us: float) -> None:
        """A frame that comes after a later one, and tells its own state whatever the tracker holds."""
        before, state = tracker.box_at(last_us), as_fixed(course.stage, into_domain(course.stage, uniform(self.rng, course.stage)))
        late = tracker.update(self.frame(course.stage, state), last_us - float(self.rng.choice([1, 10**6])))
        self.counts["late"] += 1
        self.judge_estimate(late, state)
        if str(tracker.box_at(last_us)) != str(before):
            self.find("a late frame changes a box", f"{before} to {tracker.box_at(last_us)}")

    def frame(self, stage: Stage, state: RationalState) -> Frame:
        """A state's frame that keeps the budgets, and mostly uses them up."""
        missed, extra = (
            int(self.rng.integers(most + 1)) if self.rng.random() < 0.4 else most for most in (self.missed, max(self.extra, 0))
        )
        layers = self.layers if self.rng.random() < 0.7 else ()
        shares = {"missed": (missed,), "order": self.order, "extra": (min(extra, self.extra),)}
        return Scenario("", layers, lambda _rng, _stage: state, **shares).draw(self.rng, stage)[0].frame

    def find(self, fault: str, detail: str) -> None:
        """Adds a finding."""
        kinds = (f"m {self.missed}", f"e {self.extra}", f"horizon {self.horizon}", f"outliers {self.outliers}")
        self.findings.append(Finding(f"{self.place}#{self.number}", fault, detail, kinds))


def holds(box: Box, state: RationalState) -> bool:
    """True if a box has the state, decided exactly."""
    return state.within(box.lower, box.upper)

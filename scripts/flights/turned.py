"""Sound flights of a camera that rolls and yaws: its attitude is told with a plus-minus, frame by frame, and every box must have the state.

The domain holds the pitch that the ideal frame shows, motion, priors and told displacements are of the camera's own (`runtime.attitude`);
the truth is drawn in rational numbers by another form of the same rotation (`turned_state`), and its angles are judged as balls.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from coverage.states import Floats, Rng, estimator_of
from flint import arb, ctx
from numpy.typing import NDArray
from random_scenes.outcomes import Finding, Outcomes
from random_scenes.watch import OutOfTimeError, described, watched
from turned_state import BITS, TurnedState

from runtime import Box, Estimator, Motion, Tracker

FRAMES = 12
STEP_US = 40_000
PATIENCE_S = 600.0
"""Of one flight: where roll and yaw have a plus-minus, a frame takes half a second."""
HORIZONS = ((None, 0), (None, 0), (4, 0), (5, 1))
BUDGETS = (0, 0, 2)
CLUTTER = (0.0, 0.01, 0.05)
PLUS_MINUS_RAD = (0.0, 0.0, 0.0002, 0.002)
LARGEST_RAD, TURN_RAD = 0.1, 0.004
"""Of roll and yaw about, and by how much they change from frame to frame."""
PITCH_PLUS_MINUS_RAD = 0.005
SLACK = 1e-12
"""What is told of a float64 is wider by this."""


@dataclass
class TurnedFlight:
    """One flight over a model's scene, and what came of it."""

    path: str
    place: str
    rng: Rng
    number: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)

    def run(self) -> Outcomes:
        """Flies it; of a model that takes no attitude, nothing."""
        try:
            with watched(PATIENCE_S):
                self.fly(estimator_of(self.path, self.budget()))
        except OutOfTimeError:
            self.find("a flight does not end", f"in {PATIENCE_S:g} s")
        except Exception as error:
            self.find(f"{type(error).__name__}", described(error))
        outcomes = Outcomes(findings=self.findings)
        outcomes.count(("turned",), self.counts + Counter(findings=len(self.findings)))
        return outcomes

    def budget(self) -> int:
        """m, as far as the model takes it; behind a lens an attitude is taken with 0 alone."""
        estimator = estimator_of(self.path)
        return min(int(self.rng.choice(BUDGETS)), estimator.largest_missed_budget) if estimator.scene.camera.pinhole else 0

    def fly(self, estimator: Estimator) -> None:
        """Goes from frame to frame."""
        if not estimator.scene.calibration.exact:
            return
        rng, domain = self.rng, estimator.domain
        most = (domain.upper - domain.lower) * rng.uniform(0.02, 0.3)
        most[0] += 2 * LARGEST_RAD * TURN_RAD / (STEP_US / 1e6)  # of the pitch that yaw takes from the ideal frame's
        tracker = Tracker(estimator, Motion(-most, most), *HORIZONS[rng.integers(len(HORIZONS))])
        state, before = TurnedState.near(self.drawn(estimator), *rng.uniform(-LARGEST_RAD, LARGEST_RAD, 2)), None
        for self.number in range(FRAMES):
            state = state if before is None else self.moved(estimator, state, most)
            predicted = tracker.box_at(self.number * STEP_US)
            if predicted is not None and not state.within(predicted.lower, predicted.upper):
                self.find("a predicted box without the state", f"{predicted}; {state}")
            attitude = state.attitude(rng, *rng.choice(PLUS_MINUS_RAD, 2))
            told = None if before is None or rng.random() < 0.5 else {"theta": turned(before, state)}
            prior = self.prior(domain, state) if rng.random() < 0.3 else None
            estimate = tracker.update(self.frame(estimator, state), self.number * STEP_US, prior, told, attitude)
            self.counts.update(frames=1, certified=int(estimate.certified), told=int(bool(told)), priors=int(prior is not None))
            if estimate.box is None:
                self.find("not certified", f"{estimate.outcome}; {state}, {attitude}")
            elif not state.within(estimate.box.lower, estimate.box.upper):
                self.find("a box without the state", f"{estimate.box}; {state}, {attitude}")
            before = state

    def drawn(self, estimator: Estimator) -> Floats:
        """A state of the domain by the ideal frame's pitch, seldom near a face."""
        return estimator.scene.domain.uniform(self.rng, 1)[0]

    def moved(self, estimator: Estimator, state: TurnedState, most: Floats) -> TurnedState:
        """A state that the motion's bounds and the domain allow after a step: the same one where the one that was drawn is not."""
        rng, seen = self.rng, state.seen.floats
        share = rng.uniform(-1, 1, 4)
        after = seen + (np.sign(share) if rng.random() < 0.3 else share) * (1 - 1e-9) * most * (STEP_US / 1e6)
        sides = [2 * np.arctan(float(half)) + rng.uniform(-TURN_RAD, TURN_RAD) for half in (state.a, state.b)]
        drawn = TurnedState.near(after, *np.clip(sides, -LARGEST_RAD, LARGEST_RAD))
        allowed = estimator.scene.domain.contains(after) and bool(abs(difference(state, drawn)) <= arb(float(most[0])) * STEP_US / 10**6)
        lengths = all(
            abs(getattr(drawn.seen, name) - getattr(state.seen, name)) <= Fraction(float(rate)) * STEP_US / 10**6
            for name, rate in zip("xyz", most[1:], strict=True)
        )
        return drawn if allowed and lengths else state

    def frame(self, estimator: Estimator, state: TurnedState) -> NDArray[np.bool_]:
        """The sensor's frame, with up to m pixels dark, side by side, and clutter."""
        image = state.view(estimator.scene).image(state.seen)
        frame, missed = image.frame.copy(), int(self.rng.integers(0, estimator.missed_budget + 1))
        if missed and len(image.flat):
            frame.ravel()[image.flat[(self.rng.integers(len(image.flat)) + np.arange(missed)) % len(image.flat)]] = False
        return frame | (self.rng.random(frame.shape) < self.rng.choice(CLUTTER))

    def prior(self, domain: Box, state: TurnedState) -> Box:
        """What a pitch reference says of the camera's own theta; of the rest nothing."""
        reading = float(state.angles[1].mid()) + self.rng.uniform(-1, 1) * PITCH_PLUS_MINUS_RAD
        sides = reading - PITCH_PLUS_MINUS_RAD - SLACK, reading + PITCH_PLUS_MINUS_RAD + SLACK
        return Box(domain.lower - 1, domain.upper + 1).replace(theta=sides)

    def find(self, fault: str, detail: str) -> None:
        """Adds a finding."""
        self.findings.append(Finding(f"{self.place}#{self.number}", fault, detail, ("turned",)))


def difference(before: TurnedState, after: TurnedState) -> arb:
    """How far the camera's own theta has moved, as a ball."""
    with ctx.workprec(BITS):
        return after.angles[1] - before.angles[1]


def turned(before: TurnedState, after: TurnedState) -> tuple[float, float]:
    """Bounds on that, as odometry tells it."""
    near = float(difference(before, after).mid())
    return near - SLACK, near + SLACK

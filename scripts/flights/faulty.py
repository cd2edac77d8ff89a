"""Flights on which one assumption is broken from frame `FAULT_AT` on: found, harmless or silent for a second.

Found is INCONSISTENT or NO_RUNWAY; harmless, that the state stays inside for that second; silent, that a box lacks it and nothing is said.
Before the fault all assumptions hold, and every box must have the state.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from coverage.states import Floats, Rng, Stage, estimator_of, image_of
from random_scenes.outcomes import Finding, Outcomes
from rational_image import RationalState, RationalView

from flights.sound import Frame, holds
from runtime import Box, Motion, Tracker

FRAME_US = 40_000
FAULT_AT, FOUND_WITHIN = 20, 25
"""The frame from which an assumption is broken, and the frames of a second."""
BUDGETS = (0, 2, 8)
CLUTTER = (0.0, 0.01, 0.05)
PITCH_PLUS_MINUS_RAD = 0.01
LATE = "found after a box without the truth"


@dataclass
class Flight:
    """One flight of a model: its motion, its drawn numbers, the state that it has come to, and its fault's size and sign on each axis."""

    stage: Stage
    budget: int
    rng: Rng
    motion: Motion
    state: Floats
    size: Floats

    @staticmethod
    def drawn(path: str, rng: Rng) -> Flight:
        """A flight that begins anywhere in the domain; its rates' bounds are up to a third of the domain a second."""
        stage = Stage.of(path, None)
        budget = min(int(rng.choice(BUDGETS)), estimator_of(path).largest_missed_budget)
        most = (stage.upper - stage.lower) * rng.uniform(0.02, 0.3)
        size = rng.uniform(0, 1, 4) * rng.choice([-1, 1], 4)
        return Flight(stage, budget, rng, Motion(-most, most), stage.scene.domain.uniform(rng, 1)[0], size)

    def step(self) -> None:
        """The next state: at one of the motion's limits, or at any rate within; the domain's faces turn it back."""
        share = self.rng.uniform(-1, 1, 4)
        rate = self.motion.rate_upper * (np.sign(share) if self.rng.random() < 0.3 else share) * (1 - 1e-9)
        after = self.state + rate * (FRAME_US / 1e6)
        domain = self.stage.scene.domain
        turned = np.where(domain.nearest(after) != after, self.state, after)
        self.state = turned if domain.contains(turned) else self.state

    def frame(self, state: Floats, missed: int, view: RationalView | None = None) -> Frame:
        """A state's image with so many of its pixels dark, side by side or anywhere, and clutter everywhere else."""
        image = image_of(view or self.stage.view, RationalState.near(state)).frame
        lit = np.argwhere(image)
        start = self.rng.integers(0, max(len(lit) - missed, 0) + 1)
        dark = lit[start : start + missed] if self.rng.random() < 0.5 else self.rng.permutation(lit)[:missed]
        frame = image | (self.rng.random(image.shape) < self.rng.choice(CLUTTER))
        frame[tuple(dark.T)] = False
        return frame

    def with_pitch(self, pitch_rad: float) -> Box:
        """The domain with theta within `PITCH_PLUS_MINUS_RAD` of a reading."""
        domain = Box(self.stage.lower, self.stage.upper)
        return domain.replace(theta=(pitch_rad - PITCH_PLUS_MINUS_RAD, pitch_rad + PITCH_PLUS_MINUS_RAD))

    def jump(self, by: Floats) -> None:
        """Goes to a state that is so far away; beyond a face of the domain it comes in at the other one."""
        size = self.stage.upper - self.stage.lower
        around = self.stage.lower + (self.state - self.stage.lower + by) % np.where(size > 0, size, 1)
        self.state = self.stage.scene.domain.nearest(around)

    def near(self, state: Floats, share: float) -> Floats:
        """A state that is up to this share of the domain away, by the flight's own size and sign."""
        size = self.stage.upper - self.stage.lower
        return self.stage.scene.domain.nearest(state + self.size * share * size)


def as_it_is(flight: Flight) -> Frame:
    """Nothing is wrong with the frame itself."""
    return flight.frame(flight.state, 0)


def runway_elsewhere(flight: Flight) -> Frame:
    """The whole runway is painted elsewhere: always the image of a state that is as far away, on each axis, up to 0.4 of the domain."""
    return flight.frame(flight.near(flight.state, 0.4), 0)


def marking_elsewhere(flight: Flight) -> Frame:
    """One marking is painted beside its place, by 2 to 20 % of the distance between the outermost ones."""
    stripes = flight.stage.view.stripes
    width = max(stripe.x for stripe in stripes) - min(stripe.x for stripe in stripes)
    share = 0.02 + 0.18 * abs(flight.size[0])
    moved = replace(stripes[0], x=stripes[0].x + width * Fraction(float(np.copysign(share, flight.size[0]))))
    return flight.frame(flight.state, 0, replace(flight.stage.view, stripes=(moved, *stripes[1:])))


def missed_too_many(flight: Flight) -> Frame:
    """Three times the budget and ten more are dark."""
    return flight.frame(flight.state, 3 * flight.budget + 10)


def missed_some_more(flight: Flight) -> Frame:
    """One to three more are dark than the budget."""
    return flight.frame(flight.state, flight.budget + int(flight.rng.integers(1, 4)))


def another_runway(flight: Flight) -> Frame:
    """Another runway is lit, always as far away, up to the whole domain on each axis, and the true one is not."""
    return flight.frame(flight.near(flight.state, 1.0), 0)


def bounds_of_a_frame(flight: Flight) -> Floats:
    """2 to 10 times what the motion's bounds allow from one frame to the next, at once."""
    return (2 + 8 * np.abs(flight.size)) * np.sign(flight.size) * flight.motion.rate_upper * (FRAME_US / 1e6)


def third_of_domain(flight: Flight) -> Floats:
    """A third of the domain on every axis."""
    return (flight.stage.upper - flight.stage.lower) / 3


BIAS = "a pitch reference off by 2 to 6 times its plus-minus"
JUMPS: dict[str, Callable[[Flight], Floats]] = {
    "a jump by a third of the domain": third_of_domain,
    "a jump by 2 to 10 times the motion's bounds": bounds_of_a_frame,
}
FAULTS: dict[str, Callable[[Flight], Frame]] = {
    "the runway painted elsewhere": runway_elsewhere,
    "one marking painted elsewhere": marking_elsewhere,
    "1 to 3 pixels missed beyond the budget": missed_some_more,
    "three times the budget and 10 pixels missed": missed_too_many,
    "another runway, the true one dark": another_runway,
    **dict.fromkeys(JUMPS, as_it_is),
    BIAS: as_it_is,
}
"""By what is wrong: the frames that such a flight shows from `FAULT_AT` on."""


@dataclass
class FaultyFlight:
    """One flight with the named fault."""

    path: str
    name: str
    place: str
    rng: Rng

    def run(self) -> Outcomes:
        """How it ends, counted under the fault's name."""
        outcomes = Outcomes()
        ends = self.fly()
        if ends is None:
            outcomes.findings.append(Finding(self.place, "a sound frame is not certified", "before the fault", (self.name,)))
        outcomes.count((self.name,), Counter({"flights": 1}) + Counter(ends))
        return outcomes

    def fly(self) -> dict[str, int] | None:
        """Found, harmless or silent; None if a frame before the fault is not certified with its state."""
        flight = Flight.drawn(self.path, self.rng)
        tracker = Tracker(estimator_of(self.path, flight.budget), flight.motion)
        bias = (2 + 4 * abs(flight.size[0])) * float(np.sign(flight.size[0])) * PITCH_PLUS_MINUS_RAD
        lost = False
        for number in range(FAULT_AT + FOUND_WITHIN):
            flight.step()
            faulty = number >= FAULT_AT
            if number == FAULT_AT and self.name in JUMPS:
                flight.jump(JUMPS[self.name](flight))
            frame = FAULTS[self.name](flight) if faulty else as_it_is(flight)
            off = bias if faulty else flight.rng.uniform(-0.99, 0.99) * PITCH_PLUS_MINUS_RAD
            prior = flight.with_pitch(flight.state[0] + off) if self.name == BIAS else None
            box = tracker.update(frame, number * FRAME_US, prior).box
            has = box is not None and holds(box, RationalState.near(flight.state))
            if not faulty and not has:
                return None
            if box is None:
                return {"found": 1, LATE: int(lost)}
            lost |= not has
        return {"silent" if lost else "harmless": 1}

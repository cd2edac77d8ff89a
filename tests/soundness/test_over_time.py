"""Theorems C and D end to end: priors with the truth on their face, and flights whose motion stays within its bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import SCENES, Floats, examples, random_clutter, states_of

from runtime import Box, Estimator, Motion, Outcome, Tracker
from runtime.image import runway_image
from runtime.scene import Scene

EstimatorOf = Callable[..., Estimator]
NAMES = ("paper", "free x", "unlike markings", "cut left")


def around(state: Floats, scene: Scene, shares: Floats) -> Box:
    """A box with the state in it: each side as many shares of the domain's size away, some on the state itself."""
    size = scene.domain.upper - scene.domain.lower
    return Box(state - shares[0] * size, state + shares[1] * size)


@pytest.mark.parametrize("missed", [0, 3])
@pytest.mark.parametrize("name", NAMES)
@examples(25)
@given(data=st.data())
def test_within_a_prior_that_holds_the_state(estimator_of: EstimatorOf, name: str, missed: int, data: st.DataObject) -> None:
    scene, estimator = SCENES[name], estimator_of(name, missed)
    state = data.draw(states_of(scene))
    shares = data.draw(st.lists(st.sampled_from([0.0, 0.001, 0.03, 0.3, 2.0]), min_size=8, max_size=8))
    prior = around(state, scene, np.reshape(shares, (2, 4)))
    frame = seen(scene, state, missed, np.random.default_rng(data.draw(st.integers(0, 99))), 0.02)
    alone = estimator.estimate(frame)
    assert alone.box is not None
    for refine in (True, False):
        estimate = estimator.estimate(frame, prior=prior, refine=refine)
        assert estimate.outcome is Outcome.CERTIFIED
        assert estimate.box is not None
        assert estimate.box.contains(state)
        assert any(region.contains(state) for region in estimate.regions)
        assert (estimate.box.lower >= prior.lower).all()
        assert (estimate.box.upper <= prior.upper).all()
        assert estimate.assumed[:-1] == estimator.assumed
        assert estimate.assumed[-1].startswith("A prior: the state lies in theta ")


def seen(scene: Scene, state: Floats, missed: int, rng: np.random.Generator, clutter: float) -> np.ndarray:
    """The state's image with up to `missed` of its pixels dark, and clutter."""
    frame = runway_image(scene, state)
    lit = np.argwhere(frame)
    dark = rng.permutation(len(lit))[: rng.integers(0, missed + 1)]
    image = frame.copy()
    image[tuple(lit[dark].T)] = 0
    clutter_there = random_clutter(rng, frame.shape, clutter).astype(bool)
    clutter_there[tuple(lit[dark].T)] = False
    return image | clutter_there


# --- flights ---


@dataclass(frozen=True)
class Flight:
    """States of a flight within a motion's bounds, and their times."""

    scene: Scene
    motion: Motion
    rng: np.random.Generator

    def steps(self, count: int) -> Iterator[tuple[int, Floats, dict[str, tuple[float, float]]]]:
        """Time, us, state, and the true displacement since the last step with a plus-minus; often at the limit of the motion."""
        low, high = self.scene.domain.lower, self.scene.domain.upper
        state, time_us = self.rng.uniform(low, high), int(self.rng.integers(0, 10**9))
        before = state
        for _ in range(count):
            share = self.rng.random(4)
            rate = np.where(self.rng.random() < 0.5, np.round(share), share) * (self.motion.rate_upper - self.motion.rate_lower)
            elapsed_us = int(self.rng.choice([0, 1, 5_000, 40_000, 200_000]))
            state = np.clip(state + (self.motion.rate_lower + rate) * (elapsed_us * 1e-6) * (1 - 1e-12), low, high)
            time_us += elapsed_us
            moved, loose = state - before, self.rng.choice([0.0, 1e-3], 2)
            names = ("theta", "x", "y", "z")
            tight = {name: (moved[i] - loose[0] - 1e-15, moved[i] + loose[1] + 1e-15) for i, name in enumerate(names)}
            yield time_us, state, {name: tight[name] for name in self.rng.permutation(names)[: self.rng.integers(0, 3)]}
            before = state


def flight(scene: Scene, seed: int) -> Flight:
    rng = np.random.default_rng(seed)
    size = scene.domain.upper - scene.domain.lower
    return Flight(scene, Motion(-size * rng.uniform(0, 1, 4), size * rng.uniform(0, 1, 4)), rng)


@pytest.mark.parametrize(("horizon", "outliers"), [(None, 0), (1, 0), (4, 0), (5, 1), (5, 2)])
@pytest.mark.parametrize(("name", "missed"), [("paper", 0), ("paper", 3), ("free x", 2), ("cut left", 0)])
@examples(3)
@given(seed=st.integers(0, 10**6))
def test_no_box_of_a_flight_is_without_its_state(
    estimator_of: EstimatorOf, name: str, missed: int, horizon: int | None, outliers: int, seed: int
) -> None:
    """Displacements that are told, times that repeat, and up to q broken frames of any N."""
    estimator = estimator_of(name, missed)
    path = flight(estimator.scene, seed)
    tracker = Tracker(estimator, path.motion, horizon, outliers)
    broken: list[bool] = []
    for time_us, state, displacement in path.steps(9):
        if broken:
            box = tracker.box_at(time_us)
            told = Box(state, state) if box is None else box
            assert told.contains(state)
        breaks = sum(broken[-(horizon or 1) + 1 :]) < outliers and path.rng.random() < 0.4
        broken.append(breaks)
        other = path.rng.uniform(estimator.domain.lower, estimator.domain.upper)
        frame = seen(estimator.scene, other if breaks else state, missed, path.rng, 0.01)
        estimate = tracker.update(frame, time_us, displacement=displacement)
        assert estimate.outcome is Outcome.CERTIFIED
        assert estimate.box is not None
        assert estimate.box.contains(state)
        assert any(region.contains(state) for region in estimate.regions)

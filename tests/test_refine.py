"""Refinement: no state that is consistent with the frame is lost, whatever was added or missed; what is left is close to the limit."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import (
    AIRPORT,
    CUT_BELOW,
    CUT_LEFT,
    CUT_RIGHT,
    FAR_FROM_THE_ORIGIN,
    FREE_X,
    LOW_OVER_THE_THRESHOLD,
    PAPER,
    STRAIGHT_DOWN,
    STRIP,
    THREE_MARKINGS,
    UNLIKE_MARKINGS,
    Floats,
    Frame,
    examples,
    random_clutter,
    state_sets,
    states_in,
)

from runtime.camera import ground_scale
from runtime.estimator import Estimator
from runtime.image import dilated, runway_image
from runtime.refine.refiner import LARGEST_START, Refiner, joined
from runtime.refine.regions import MOST_TO_JOIN, connected_parts
from runtime.refine.theorem_b import LEAST_SEARCH
from runtime.rounding import inverted
from runtime.scene import Scene
from runtime.state_set import StateSet

EstimatorOf = Callable[..., Estimator]
RandomStates = Callable[[Scene, int, int], Floats]
CASES = {
    "paper": PAPER,
    "three": THREE_MARKINGS,
    "unlike": UNLIKE_MARKINGS,
    "free x": FREE_X,
    "cut left": CUT_LEFT,
    "cut right": CUT_RIGHT,
    "cut below": CUT_BELOW,
    "strip": STRIP,
    "airport": AIRPORT,
    "low over the threshold": LOW_OVER_THE_THRESHOLD,
    "far from the origin": FAR_FROM_THE_ORIGIN,
    "straight down": STRAIGHT_DOWN,
}
SCENES = pytest.mark.parametrize("scene", CASES.values(), ids=CASES)


def holds(scene: Scene, pieces: StateSet, state: Floats) -> bool:
    """Is the state in one of the pieces? The scale up to float64's error."""
    row = scene.camera.v0 + scene.camera.focal_v_px * pieces.tangent
    scale = ground_scale(scene.camera, state[0], state[2], row)
    inside = ((pieces.lower <= state) & (state <= pieces.upper)).all(axis=1)
    return bool((inside & ~inverted(pieces.scale[:, 0], scale) & ~inverted(scale, pieces.scale[:, 1])).any())


def put_out(image: Frame, places: list[int]) -> Frame:
    """The image with those of its lit pixels dark, counted along its rows."""
    lit = np.flatnonzero(image)
    dark = image.copy()
    dark.ravel()[lit[[place % len(lit) for place in places]]] = 0
    return dark


@SCENES
@examples(30)
@given(
    data=st.data(),
    seed=st.integers(0, 1000),
    density=st.sampled_from([0.0, 0.02, 0.3, 1.0]),
    missed=st.lists(st.integers(0, 10_000), max_size=4),
    tolerance=st.integers(0, 1),
)
def test_a_consistent_state_is_never_lost(
    scene: Scene, data: st.DataObject, seed: int, density: float, missed: list[int], tolerance: int
) -> None:
    """Straight on one set of states, without a bank before it; the budget is the number of missed pixels."""
    sets = data.draw(state_sets(scene))
    states = states_in(scene, sets, 8, seed)
    assume(len(states) > 0)
    state = states[data.draw(st.integers(0, len(states) - 1))]
    rng = np.random.default_rng(seed)
    frame = put_out(runway_image(scene, state), missed) | random_clutter(rng, scene.camera.shape, density)
    pieces = Refiner(scene, len(missed), -1).refine(dilated(frame.astype(bool), tolerance), sets)
    assert holds(scene, pieces, state)


@SCENES
@examples(20)
@given(data=st.data(), seed=st.integers(0, 1000), extra=st.integers(0, 6), missed=st.lists(st.integers(0, 10_000), max_size=2))
def test_a_state_with_bounded_clutter_is_never_lost(scene: Scene, data: st.DataObject, seed: int, extra: int, missed: list[int]) -> None:
    """Theorem B: all vouched pixels are the runway's but for `extra`, which lie on and around it."""
    sets = data.draw(state_sets(scene))
    states = states_in(scene, sets, 8, seed)
    assume(len(states) > 0)
    state = states[data.draw(st.integers(0, len(states) - 1))]
    rng = np.random.default_rng(seed)
    image = runway_image(scene, state)
    near = np.flatnonzero(dilated(image.astype(bool), 2) & ~image.astype(bool))
    frame = put_out(image, missed)
    frame.ravel()[rng.choice(near, extra, replace=False)] = 1
    pieces = Refiner(scene, len(missed), extra).refine(frame.astype(bool), sets, frame.astype(bool))
    assert holds(scene, pieces, state)


def test_bounded_clutter_draws_the_box_in(estimator_of: EstimatorOf, model_of: Callable, random_states: RandomStates) -> None:
    """Tightness of Theorem B: smaller boxes than under Theorem A on clean frames, near the limit (theory 0.010, 0.018, 0.010)."""
    any_clutter, no_clutter = estimator_of("paper"), Estimator.load(model_of("paper"), extra_budget=0)
    widths = []
    for state in random_states(PAPER, 60, 21):
        frame = runway_image(PAPER, state)
        loose, close = any_clutter.estimate(frame).box, no_clutter.estimate(frame).box
        assert loose is not None
        assert close is not None
        assert close.contains(state)
        widths.append((loose.half_widths, close.half_widths))
    loose_median, close_median = np.median(widths, axis=0)
    assert (close_median[[0, 2, 3]] < [0.016, 0.029, 0.016]).all()
    assert (close_median[[0, 3]] < 0.95 * loose_median[[0, 3]]).all()


def test_boxes_are_at_the_limit_of_one_image(estimator_of: EstimatorOf, random_states: RandomStates) -> None:
    """Tightness of Theorem A on clean frames; without the lit pixels at the ends of markings, every mean is above its bound here."""
    half_widths = []
    for state in random_states(PAPER, 60, 21):
        box = estimator_of("paper").estimate(runway_image(PAPER, state)).box
        assert box is not None
        assert box.contains(state)
        half_widths.append(box.half_widths)
    assert (np.mean(half_widths, axis=0)[[0, 2, 3]] < [0.0134, 0.0250, 0.0171]).all()


def test_a_set_far_from_the_frame_is_dropped() -> None:
    """Tightness: nothing is left of a small set when the frame shows a state a tenth away, or nothing at all."""
    lower, upper = PAPER.domain.lower, PAPER.domain.upper
    state = (lower + upper) / 2
    around = np.array([0.01, 0, 0.01, 0.01])
    sides = np.stack([state - around, state + around], axis=-1)[:, None]
    sets = StateSet(*sides, np.array([[1.0, 1000.0]]), np.array([0.0]))
    refiner = Refiner(PAPER, 0, -1)
    assert len(refiner.refine(np.zeros((480, 640), dtype=bool), sets)) == 0
    for offset in ([0.1, 0, 0, 0], [0, 0, 0.1, 0], [0, 0, 0, 0.1], [-0.1, 0, 0, 0], [0, 0, -0.1, 0]):
        other = runway_image(PAPER, state + offset).astype(bool)
        assert len(refiner.refine(other, sets)) == 0
    assert len(refiner.refine(runway_image(PAPER, state).astype(bool), sets)) > 0


def test_nothing_is_left_of_nothing() -> None:
    none = StateSet(*[np.zeros((0, 2))] * 5, np.zeros(0))
    assert len(Refiner(PAPER, 0, -1).refine(np.ones((480, 640), dtype=bool), none)) == 0
    assert connected_parts(none) == []


def test_more_entries_than_a_frame_can_tell_apart_are_left_as_they_are() -> None:
    many = boxes(np.zeros((LARGEST_START + 1, 4)), np.ones((LARGEST_START + 1, 4)))
    assert Refiner(PAPER, 0, -1).refine(np.zeros((480, 640), dtype=bool), many) is many


def test_when_enough_rows_were_looked_at_no_more_rounds_are_begun(estimator_of: EstimatorOf, random_states: RandomStates) -> None:
    """A bound on time: what is left then holds the state, and all that more rounds leave."""
    model, shares = estimator_of("paper"), []
    for state in random_states(PAPER, 6, 3):
        frame = runway_image(PAPER, state)
        entries = model.left_of(model.find(frame), refine=False)
        whole, one_round = (
            refiner.refine(frame.astype(bool), entries) for refiner in (Refiner(PAPER, 0, -1), Refiner(PAPER, 0, -1, most_rows=0))
        )
        assert holds(PAPER, one_round, state)
        assert (one_round.lower.min(axis=0) <= whole.lower.min(axis=0)).all()
        assert (one_round.upper.max(axis=0) >= whole.upper.max(axis=0)).all()
        shares.append(np.ptp(one_round.theta) / np.ptp(whole.theta))
    assert max(shares) > 1.01


# --- connected parts ---


def boxes(lower: Floats, upper: Floats) -> StateSet:
    theta, x, y, z = np.stack([lower, upper], axis=-1).transpose(1, 0, 2)
    return StateSet(theta, x, y, z, np.ones((len(lower), 2)), np.zeros(len(lower)))


def naive_parts(lower: NDArray, upper: NDArray) -> set[frozenset[int]]:
    """Merges parts until no two of them have boxes that touch."""
    parts = [{number} for number in range(len(lower))]

    def touch(first: set[int], second: set[int]) -> bool:
        return any((lower[a] <= upper[b]).all() and (lower[b] <= upper[a]).all() for a, b in itertools.product(first, second))

    while pair := next(((a, b) for a, b in itertools.combinations(parts, 2) if touch(a, b)), None):
        parts = [part for part in parts if part not in pair] + [pair[0] | pair[1]]
    return {frozenset(part) for part in parts}


@given(seed=st.integers(0, 10_000), count=st.integers(1, 14), extent=st.integers(0, 2))
def test_connected_parts_are_those_of_the_naive_merging(seed: int, count: int, extent: int) -> None:
    """On a coarse grid, where boxes often share a face, an edge or a corner."""
    rng = np.random.default_rng(seed)
    lower = rng.integers(0, 5, (count, 4)).astype(float)
    upper = lower + rng.integers(0, extent + 1, (count, 4))
    parts = connected_parts(boxes(lower, upper))
    assert {frozenset(part.tolist()) for part in parts} == naive_parts(lower, upper)
    assert sorted(np.concatenate(parts).tolist()) == list(range(count))


def test_very_many_boxes_are_one_part() -> None:
    apart = 3.0 * np.arange(MOST_TO_JOIN + 1)[:, None] * np.ones(4)
    assert len(connected_parts(boxes(apart[:-1], apart[:-1] + 1))) == MOST_TO_JOIN
    (part,) = connected_parts(boxes(apart, apart + 1))
    assert (part == np.arange(MOST_TO_JOIN + 1)).all()


def test_joined_sets_keep_their_order() -> None:
    first, second = boxes(np.zeros((2, 4)), np.ones((2, 4))), boxes(np.full((1, 4), 5.0), np.full((1, 4), 6.0))
    both = joined(first, second)
    assert both.lower[:, 0].tolist() == [0, 0, 5]
    assert both.upper[:, 3].tolist() == [1, 1, 6]


def test_a_frame_in_which_much_passes_is_left_as_it_is_cell_by_cell_too(estimator_of: Callable[..., Estimator]) -> None:
    """Under Theorem B each cell is refined by itself: all of them together are bounded, not each alone."""
    paper = estimator_of("paper")
    estimator = Estimator.load(paper._name, missed_budget=20, extra_budget=2**31 - 1)
    found = estimator.find(np.ones(estimator.scene.camera.shape, dtype=bool))
    left = estimator.left_of(found)
    cells = np.bincount(np.nonzero(found.passes)[0])
    assert len(left) == cells.sum()
    assert cells.max() + LEAST_SEARCH < LARGEST_START < (cells + LEAST_SEARCH).sum()

"""Unions of sets as slices of theta, what two unions have in common, and what lies in all but q of several."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scenes import AIRPORT, FREE_X, PAPER, STRIP, Floats, examples, state_sets, states_in

from runtime import Box
from runtime.camera import ground_scale
from runtime.motion import Displacement, moved, moved_each
from runtime.refine.refiner import joined
from runtime.refine.slices import SLICES, all_but, covering, rereferenced, slice_edges, sliced, sliced_each, within
from runtime.scene import Scene
from runtime.state_set import StateSet

SCENES = pytest.mark.parametrize("scene", [PAPER, FREE_X, STRIP, AIRPORT], ids=["paper", "free x", "strip", "airport"])


def holds(scene: Scene, sets: StateSet, states: Floats) -> np.ndarray:
    """(states, sets): True where a set holds a state, its scale included, up to float64's rounding of the scale here."""
    rows = scene.camera.v0 + scene.camera.focal_v_px * sets.tangent
    scale = ground_scale(scene.camera, states[:, :1], states[:, 2:3], rows)
    inside = (sets.scale[:, 0] <= scale * (1 + 1e-12)) & (scale * (1 - 1e-12) <= sets.scale[:, 1])
    return inside & ((sets.lower <= states[:, None]) & (states[:, None] <= sets.upper)).all(axis=2)


def some_sets(scene: Scene, data: st.DataObject, count: int) -> tuple[StateSet, Floats]:
    """Some sets, and states of each."""
    drawn = [data.draw(state_sets(scene)) for _ in range(count)]
    states = np.concatenate([np.clip(states_in(scene, sets, 60, number), sets.lower, sets.upper) for number, sets in enumerate(drawn)])
    assume(len(states) > 0)
    return joined(*drawn), states


@SCENES
@given(data=st.data())
def test_slices_hold_the_states_of_the_union(scene: Scene, data: st.DataObject) -> None:
    sets, states = some_sets(scene, data, 4)
    edges = slice_edges(sets.theta)
    slices = sliced(scene.camera, sets, edges, float(sets.tangent[0]))
    left = slices[~slices.empty]
    assert holds(scene, left, states).any(axis=1).all()
    assert (left.lower.min(axis=0) >= sets.lower.min(axis=0)).all()
    assert (left.upper.max(axis=0) <= sets.upper.max(axis=0)).all()
    for number in np.flatnonzero(~slices.empty):
        assert edges[number] <= slices.theta[number, 0] <= slices.theta[number, 1] <= edges[number + 1]


@SCENES
@given(data=st.data())
def test_slices_of_one_set_keep_pitch_and_altitude_together(scene: Scene, data: st.DataObject) -> None:
    """Their scales are no wider than the set's own, and hardly wider where they refer to another row."""
    sets, states = some_sets(scene, data, 1)
    same = sliced(scene.camera, sets, slice_edges(sets.theta), float(sets.tangent[0]))
    same = same[~same.empty]
    assert (same.scale[:, 0] >= sets.scale[0, 0] * (1 - 1e-9)).all()
    assert (same.scale[:, 1] <= sets.scale[0, 1] * (1 + 1e-9)).all()
    tangent = float(sets.tangent[0]) + 20 / scene.camera.focal_v_px
    other = sliced(scene.camera, sets, slice_edges(sets.theta), tangent)
    other = other[~other.empty]
    assert holds(scene, other, states).any(axis=1).all()
    widest = (other.scale[:, 1] / other.scale[:, 0]).max()
    there = rereferenced(sets, np.full(1, tangent))
    assert widest <= there.scale[0, 1] / there.scale[0, 0] * (1 + 1e-9)


@SCENES
@examples(20)
@given(data=st.data())
def test_several_unions_are_cut_as_each_by_itself(scene: Scene, data: st.DataObject) -> None:
    unions = [some_sets(scene, data, count)[0] for count in (2, 1, 3)]
    unions.insert(1, unions[0][:0])
    edges, tangent = slice_edges(joined(*unions).theta), float(unions[0].tangent[0])
    for together, sets in zip(sliced_each(scene.camera, unions, edges, tangent), unions, strict=True):
        assert_same(together, sliced(scene.camera, sets, edges, tangent))


@SCENES
@examples(20)
@given(data=st.data())
def test_several_unions_are_moved_as_each_by_itself(scene: Scene, data: st.DataObject) -> None:
    unions = [some_sets(scene, data, count)[0] for count in (2, 1, 3)]
    unions.insert(2, unions[0][:0])
    size, rng = scene.domain.upper - scene.domain.lower, np.random.default_rng(data.draw(st.integers(0, 99)))
    steps = [Displacement(*np.sort(rng.uniform(-0.5, 0.5, (2, 4)) * size, axis=0)) for _ in unions]
    domain = Box(scene.domain.lower, scene.domain.upper)
    for together, sets, step in zip(moved_each(scene.camera, unions, steps, domain), unions, steps, strict=True):
        assert_same(together, moved(scene.camera, sets, step, domain))
    assert moved_each(scene.camera, [], [], domain) == []


def assert_same(first: StateSet, second: StateSet) -> None:
    """To the last bit."""
    for name in ("theta", "x", "y", "z", "scale", "tangent"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@SCENES
@given(data=st.data())
def test_what_two_unions_have_in_common(scene: Scene, data: st.DataObject) -> None:
    sets, states = some_sets(scene, data, 3)
    known, others = some_sets(scene, data, 3)
    states = np.concatenate([states, others])
    both = within(scene.camera, sets, known)
    in_both = holds(scene, sets, states).any(axis=1) & holds(scene, known, states).any(axis=1)
    assert (holds(scene, both, states).any(axis=1) >= in_both).all()
    assert len(both) <= len(sets)
    for name in ("theta", "x", "y", "z"):
        low, high = getattr(both, name).T
        for source in (sets, known):
            assert (low >= getattr(source, name)[:, 0].min()).all()
            assert (high <= getattr(source, name)[:, 1].max()).all()


def test_a_box_cuts_sets_exactly() -> None:
    sets = covering(PAPER.camera, Box(PAPER.domain.lower, PAPER.domain.upper), 300.0)
    domain = Box(PAPER.domain.lower, PAPER.domain.upper)
    box = domain.replace(theta=(0.5, 0.625), z=(1.625, 1.75))
    both = within(PAPER.camera, sets, covering(PAPER.camera, box, 100.0))
    assert both.lower.tolist() == [box.lower.tolist()]
    assert both.upper.tolist() == [box.upper.tolist()]
    nothing = covering(PAPER.camera, domain.replace(z=(1.9, 2.0)), 300.0)
    assert len(within(PAPER.camera, sets, nothing)) == 0


def test_a_row_above_the_horizon_gives_way_to_one_below() -> None:
    box = Box([-0.2, 0, 1, 10], [0.3, 0, 2, 20])
    (tangent,) = covering(AIRPORT.camera, box, 0.0).tangent
    assert AIRPORT.camera.focal_v_px * (tangent + np.tan(-0.2)) == pytest.approx(0.5)


# --- all but q ---


@given(data=st.data(), count=st.integers(0, 6), outliers=st.integers(0, 3))
def test_all_but_q_hold_what_all_but_q_hold(data: st.DataObject, count: int, outliers: int) -> None:
    """Boxes of integers in three slices, so that borders meet."""
    numbers = st.lists(st.integers(0, 8), min_size=30, max_size=30)
    lower = [np.reshape(data.draw(numbers), (3, 5, 2)) for _ in range(count)]
    sources = [StateSet(*np.sort(sides, axis=2).astype(float).swapaxes(0, 1), np.zeros(3)) for sides in lower]
    start = StateSet(*np.tile([0.0, 8.0], (5, 3, 1)), np.zeros(3))
    held = all_but(sources, start, outliers)
    assert len(held) == outliers + 1
    points = np.random.default_rng(count).integers(0, 9, (400, 3, 5))
    contained = np.array([inside(source, points) for source in sources]).reshape(count, 400, 3)
    for q, sets in enumerate(held):
        demanded = contained.sum(axis=0) >= count - q
        assert (inside(sets, points) >= demanded).all()
        if q == 0:
            assert (inside(sets, points) == demanded).all()
        if q >= count:
            assert inside(sets, points).all()


def inside(sets: StateSet, points: np.ndarray) -> np.ndarray:
    sides = np.stack([sets.theta, sets.x, sets.y, sets.z, sets.scale], axis=1)
    return ((sides[..., 0] <= points) & (points <= sides[..., 1])).all(axis=-1)


def test_one_source_elsewhere_is_left_out() -> None:
    """Ten that agree and one that does not: with one outlier the box is theirs, and with none there is nothing."""
    here, there = (StateSet(*np.tile(side, (5, 1, 1)), np.zeros(1)) for side in ([0.0, 1.0], [5.0, 6.0]))
    start = StateSet(*np.tile([0.0, 8.0], (5, 1, 1)), np.zeros(1))
    for place in range(11):
        sources = [here] * place + [there] + [here] * (10 - place)
        none, one = all_but(sources, start, 1)
        assert none.empty.all()
        assert one.theta.tolist() == [[0.0, 1.0]]


def test_a_single_angle_is_one_slice() -> None:
    assert slice_edges(np.array([[0.5, 0.5]])).tolist() == [0.5, 0.5]
    assert len(slice_edges(np.array([[0.5, 0.6]]))) == SLICES + 1

"""Outer and inner enclosures of I_r: every lit pixel inside the first, every pixel of the second lit, and both close to the truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scenes import CUT_BELOW, CUT_LEFT, FREE_X, PAPER, UNLIKE_MARKINGS, Floats, examples, seen_from, state_sets, states_in

from build_model.enclosure import Columns, columns_that_may_be_lit, columns_that_must_be_lit
from build_model.hough_bank import line_boxes
from build_model.partition import partition
from runtime.image import runway_image
from runtime.rounding import OUTWARD_PX, first_crossed, first_touched, last_crossed, last_touched
from runtime.scene import Axis, Marking, Runway, Scene
from runtime.state_set import StateSet, contract

GENTLE = replace(
    FREE_X,
    runway=Runway((Marking("far left", -2.5, 0.0, 0.3), Marking("under", 0.001, 0.1, 0.5))),
    domain=replace(FREE_X.domain, theta_rad=Axis((0.2, 0.5), 0.3)),
)
"""A marking that lights several pixels a row, and one that is all but upright."""
CASES = {"paper": PAPER, "free x": FREE_X, "unlike": UNLIKE_MARKINGS, "cut left": CUT_LEFT, "cut below": CUT_BELOW, "gentle": GENTLE}
SCENES = pytest.mark.parametrize("scene", CASES.values(), ids=CASES)


def bits_of(columns: Columns, width: int) -> np.ndarray:
    """Columns of a row as bits (sets, height, width) of all markings: the naive loops."""
    first, last = columns
    bits = np.zeros((len(first), first.shape[2], width), dtype=bool)
    for index, marking, row in zip(*np.nonzero(first <= last), strict=True):
        low, high = max(first[index, marking, row], 0), min(last[index, marking, row], width - 1)
        for column in range(low, high + 1):
            bits[index, row, column] = True
    return bits


def images(scene: Scene, states: Floats) -> np.ndarray:
    return runway_image(scene, states).astype(bool)


@SCENES
@examples(50)
@given(data=st.data())
def test_the_image_of_each_state_lies_between_both_enclosures(scene: Scene, data: st.DataObject) -> None:
    drawn = data.draw(state_sets(scene))
    states = states_in(scene, drawn, 40, data.draw(st.integers(0, 1000)))
    assume(len(states) > 0)
    lit = images(scene, states)
    for sets in (drawn, contract(scene.camera, drawn)):
        may = bits_of(columns_that_may_be_lit(scene, sets), scene.camera.width)[0]
        must = bits_of(columns_that_must_be_lit(scene, sets), scene.camera.width)[0]
        assert not (lit & ~may).any()
        assert not (must & ~lit).any()


def box_of(states: Floats) -> StateSet:
    """Each state as a set of its own, with no bound on the scale."""
    sides = [np.stack([column, column], axis=-1) for column in states.T]
    free = np.broadcast_to([1e-3, 1e6], sides[0].shape)
    return StateSet(sides[0], sides[1], sides[2], sides[3], free, np.zeros(len(states)))


@SCENES
def test_a_single_state_is_enclosed_exactly(scene: Scene) -> None:
    """Away from ties by the margin both enclosures of one state are its image."""
    states = np.random.default_rng(3).uniform(scene.domain.lower, scene.domain.upper, (200, 4))
    lit, sets = images(scene, states), box_of(states)
    may, must = (bits_of(enclose(scene, sets), scene.camera.width) for enclose in (columns_that_may_be_lit, columns_that_must_be_lit))
    assert lit.any(axis=(1, 2)).all()
    assert (may == lit).all(axis=(1, 2)).mean() > 0.99
    assert (must == lit).all(axis=(1, 2)).mean() > 0.99


def test_entries_of_the_paper_are_enclosed_closely() -> None:
    """K is at least 0.9 of what 300 states of an entry light all together, and O at most 1.1 of what they light in all."""
    cells = partition(PAPER)
    inner, outer = [], []
    for cell in (0, 13, 26):
        lower, upper = cells.lower[cell], cells.upper[cell]
        sets = contract(PAPER.camera, line_boxes(PAPER, lower, upper).states(PAPER.camera, lower, upper))
        for entry in range(0, len(sets), 20):
            one = sets[np.array([entry])]
            states = states_in(PAPER, one, 600, entry)[:300]
            if len(states) >= 200:
                lit = images(PAPER, states)
                inner.append(bits_of(columns_that_must_be_lit(PAPER, one), 640).sum() / lit.all(axis=0).sum())
                outer.append(bits_of(columns_that_may_be_lit(PAPER, one), 640).sum() / lit.any(axis=0).sum())
    assert len(inner) > 5
    assert np.median(inner) > 0.9
    assert np.median(outer) < 1.1


def test_a_runway_out_of_the_frame_is_enclosed_by_nothing() -> None:
    scene = seen_from(PAPER, 320.0, 2000.0)
    sets = box_of((scene.domain.lower + scene.domain.upper)[None] / 2)
    for enclose in (columns_that_may_be_lit, columns_that_must_be_lit):
        first, last = enclose(scene, sets)
        assert (last < first).all()


@given(lower=st.integers(-40, 40), offset=st.integers(-3, 3), share=st.floats(0, 1))
def test_bounds_become_pixels_outward(lower: int, offset: int, share: float) -> None:
    """Near whole numbers: whatever coordinate within the margin of the bound is meant, its pixel is not lost."""
    bound = lower + offset * OUTWARD_PX / 2
    meant = bound + (2 * share - 1) * OUTWARD_PX
    assert first_touched(bound) <= math.floor(meant) <= last_touched(bound)
    # a path from column `meant` to the right starts before or in the pixel `first_crossed` says, and a path up to it reaches `last_crossed`
    assert meant < first_crossed(bound) + 1
    assert last_crossed(bound) < meant
    assert last_touched(bound) - first_touched(bound) <= 1
    assert first_crossed(bound) - last_crossed(bound) <= 2

"""Masks counted by look-ups into sums against the sums of the masks themselves: a naive reading of the table, exactly."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from build_model.filter_tables import RunTable
from build_model.hough_bank import CellBank
from build_model.line_boxes import LineBoxes
from build_model.pixel_mask import VerticalRuns, runs_of
from build_model.run_table import BLOCK_COST, block_borders, mirrored, run_table, spatial_runs
from build_model.window import Window

Bits = NDArray[np.bool_]
Frame = NDArray[np.uint8]
WINDOW = Window(5, 13, 20, 30)
ROWS, COLUMNS = WINDOW.shape


def bank_of(spatial: Bits, must: Bits, may: Bits) -> CellBank:
    """A cell with the given masks, (rows, columns) and twice (entries, rows, columns); its boxes are of no interest here."""
    blank = np.zeros((len(must), 4))
    lines = LineBoxes(blank, blank, blank[:, 0])
    masks = (runs_of(bits, WINDOW) for bits in (spatial[None], must, may))
    return CellBank(lines, *masks, WINDOW, blank.astype(np.float32), blank.astype(np.float32))


@st.composite
def cells(draw: st.DrawFn, symmetric: bool = False) -> list[tuple[Bits, Bits, Bits]]:
    """One to three cells of one to four entries; masks of any density, empty and full ones among them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**16)))
    drawn = []
    for _ in range(draw(st.integers(1, 3))):
        entries = draw(st.integers(1, 4))
        density = draw(st.sampled_from([0.1, 0.4, 0.8, 1.0]))
        masks = rng.random((2 * entries + 1, ROWS, COLUMNS)) < density * rng.random((2 * entries + 1, 1, 1)).round(1)
        masks[0, 0, 0] = True
        if symmetric:
            masks |= masks[:, :, ::-1]
        drawn.append((masks[0], masks[1 : entries + 1], masks[entries + 1 :]))
    return drawn


def flat_sums(pixels: Frame, folded: bool) -> list[int]:
    """Sums down the columns under a row of zeros, of the window or of the window folded along its middle: plain loops."""
    rows = [[int(value) for value in row] for row in pixels]
    if folded:
        half = COLUMNS // 2
        rows = [[row[column] + row[COLUMNS - 1 - column] for column in range(half)] for row in rows]
    sums = [[0] * len(rows[0])]
    for row in rows:
        sums.append([above + value for above, value in zip(sums[-1], row, strict=True)])
    return list(itertools.chain(*sums))


def counted(table: RunTable, sums: list[int], place: int) -> int:
    total = 0
    for block in table.blocks:
        for run in range(block.shape[1] if place < block.shape[2] else 0):
            total += sums[block[0, run, place]] - sums[block[1, run, place]]
    return total


def check(drawn: list[tuple[Bits, Bits, Bits]], seed: int, dilated: bool, folded: bool) -> None:
    rng = np.random.default_rng(seed)
    frame, witnesses = rng.integers(0, 2, (2, ROWS, COLUMNS), dtype=np.uint8)
    width = int(rng.integers(1, 5))
    table = run_table([bank_of(*cell) for cell in drawn], WINDOW, dilated, width)
    assert table.folded == folded
    sums = flat_sums(frame, folded) + (flat_sums(witnesses, folded) if dilated else [])
    row = 0
    for cell, (spatial, must, may) in enumerate(drawn):
        assert counted(table, sums, table.spatial[cell]) == int((spatial & (frame == 1)).sum())
        for entry in range(len(must)):
            judged, place = witnesses if dilated else frame, (row + entry // width, entry % width)
            assert counted(table, sums, table.must_light[place]) == int((must[entry] & (judged == 1)).sum())
            assert counted(table, sums, table.may_light[place]) == int((may[entry] & (frame == 1)).sum())
        row += -(-len(must) // width)
    assert table.must_light.shape == table.may_light.shape == (row, width)


@given(drawn=cells(), seed=st.integers(0, 1000), dilated=st.booleans())
def test_look_ups_count_the_lit_pixels_of_each_mask(drawn: list[tuple[Bits, Bits, Bits]], seed: int, dilated: bool) -> None:
    symmetric = all((mask == mask[..., ::-1]).all() for cell in drawn for mask in cell)
    check(drawn, seed, dilated, folded=symmetric)


@given(drawn=cells(symmetric=True), seed=st.integers(0, 1000), dilated=st.booleans())
def test_masks_that_mirror_themselves_are_counted_in_half(drawn: list[tuple[Bits, Bits, Bits]], seed: int, dilated: bool) -> None:
    check(drawn, seed, dilated, folded=True)


@given(drawn=cells())
def test_painting_the_spatial_runs_gives_the_masks(drawn: list[tuple[Bits, Bits, Bits]]) -> None:
    runs = spatial_runs([bank_of(*cell) for cell in drawn], WINDOW)
    for cell, (spatial, _, _) in enumerate(drawn):
        steps = np.zeros(ROWS * COLUMNS, dtype=int)
        for number, index, step in zip(runs.cell, runs.index, runs.step, strict=True):
            if number == cell:
                steps[index] += step
        covered = np.zeros((ROWS, COLUMNS), dtype=int)
        for row, column in np.ndindex(ROWS, COLUMNS):
            covered[row, column] = steps.reshape(ROWS, COLUMNS)[: row + 1, column].sum()
        assert (covered == spatial).all()


def test_no_mirror_image_is_seen_where_a_column_is_the_middle() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert mirrored(VerticalRuns(none, none, none, none), Window(0, 4, 0, 6))
    assert not mirrored(VerticalRuns(none, none, none, none), Window(0, 4, 0, 7))


@given(falls=st.lists(st.integers(0, 4000), min_size=0, max_size=7), masks=st.integers(1, 9000))
def test_blocks_are_the_cheapest_of_all_divisions(falls: list[int], masks: int) -> None:
    """Against every division there is."""
    reached = [masks, *(max(masks - fall, 1) for fall in itertools.accumulate(falls))]

    def cost(borders: list[tuple[int, int]]) -> int:
        return sum(BLOCK_COST + (high - low) * reached[low] for low, high in borders)

    count = len(reached)
    every = []
    for chosen in itertools.product([False, True], repeat=count - 1):
        marks = [0, *(index + 1 for index, cut in enumerate(chosen) if cut), count]
        every.append(cost(list(itertools.pairwise(marks))))
    assert cost(block_borders(reached)) == min(every)


@pytest.mark.parametrize("dilated", [False, True])
def test_only_wanted_sums_are_looked_up(dilated: bool) -> None:
    """Tightness: one mask with three runs beside many with one costs little more than the runs themselves, and equal masks cost nothing."""
    tall = Window(0, 130, 20, 21)
    solid = np.zeros((4000, 130, 1), dtype=bool)
    for mask, (start, stop) in zip(solid, itertools.combinations(range(130), 2), strict=False):
        mask[start:stop] = True
    striped = np.zeros((1, 130, 1), dtype=bool)
    striped[:, [0, 2, 4]] = True
    may = runs_of(np.concatenate([striped, solid[1:]]), tall)
    blank = np.zeros((4000, 4))
    lines, states = LineBoxes(blank, blank, blank[:, 0]), blank.astype(np.float32)
    bank = CellBank(lines, runs_of(solid[:1], tall), runs_of(solid, tall), may, tall, states, states)
    look_ups = run_table([bank], tall, dilated, 4000).look_ups
    assert look_ups == 2 * ((2 if dilated else 1) * 4000 + 1 + 2)
    assert run_table([bank, bank], tall, dilated, 4000).look_ups == look_ups

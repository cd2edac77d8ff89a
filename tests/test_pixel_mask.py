"""Masks of pixels against naive twins: painting, widening, runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import PAPER, examples

from build_model.pixel_mask import VerticalRuns, inset, paint, runs_of, widened, window_of
from build_model.window import Window
from runtime.scene import Camera, Scene

HEIGHT, WIDTH = 12, 16
SMALL = replace(PAPER, camera=Camera(width=WIDTH, height=HEIGHT, focal_length_m=0.008, pixel_pitch_m=15e-6))
FRAME = Window(0, HEIGHT, 0, WIDTH)
BEYOND = 6
"""Columns on either side of the frame that the naive twin paints too."""
Columns = tuple[NDArray[np.int64], NDArray[np.int64]]


@st.composite
def markings(draw: st.DrawFn, beyond: int = 0, sets: int = 2, count: int = 2) -> Columns:
    """Columns of markings whose rows touch each other, some beyond the frame's sides, some absent; `beyond` more rows above and below."""
    rows = HEIGHT + 2 * beyond
    first, last = np.zeros((2, sets, count, rows), dtype=np.int64)
    last -= 1
    for index in np.ndindex(sets, count):
        top, length = draw(st.integers(0, rows)), draw(st.integers(0, rows))
        left = draw(st.integers(-BEYOND, WIDTH + BEYOND - 1))
        right = left + draw(st.integers(0, 2))
        for row in range(top, min(top + length, rows)):
            first[(*index, row)], last[(*index, row)] = left, right
            left, right = (lambda start, span: (start, start + span))(draw(st.integers(left - 1, right + 1)), draw(st.integers(0, 2)))
    return first, last


def painted(columns: Columns, margin: int = 0) -> NDArray[np.bool_]:
    """The double loop: bits (sets, rows, columns), with `margin` more columns on either side of the frame."""
    first, last = columns
    bits = np.zeros((len(first), first.shape[2], WIDTH + 2 * margin), dtype=bool)
    for index, marking, row in np.ndindex(first.shape):
        for column in range(first[index, marking, row], last[index, marking, row] + 1):
            if -margin <= column < WIDTH + margin:
                bits[index, row, column + margin] = True
    return bits


def dilated(bits: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    """The double loop: lit where a pixel within `radius` in the sup norm is lit."""
    result = np.zeros_like(bits)
    for index, row, column in np.argwhere(bits):
        for down in range(max(row - radius, 0), min(row + radius + 1, bits.shape[1])):
            for across in range(max(column - radius, 0), min(column + radius + 1, bits.shape[2])):
                result[index, down, across] = True
    return result


@given(columns=markings(), window=st.tuples(st.integers(0, 5), st.integers(6, HEIGHT), st.integers(0, 7), st.integers(8, WIDTH)))
def test_paint_is_the_double_loop(columns: Columns, window: tuple[int, int, int, int]) -> None:
    cut = Window(*window)
    assert (paint(columns, cut) == painted(columns)[:, *cut.slices]).all()


@examples(60)
@given(radius_and_columns=st.integers(0, 3).flatmap(lambda radius: st.tuples(st.just(radius), markings(beyond=radius))))
def test_widening_is_a_dilation_of_the_painted_bits(radius_and_columns: tuple[int, Columns]) -> None:
    """Of what lies beyond the frame too; then the frame cuts it."""
    radius, columns = radius_and_columns
    margin = BEYOND + 5
    naive = dilated(painted(columns, margin), radius)[:, radius : radius + HEIGHT, margin:-margin]
    assert (paint(widened(SMALL, columns, radius), FRAME) == naive).all()


@given(columns=markings(), by_px=st.integers(0, 3))
def test_an_inset_keeps_off_the_frames_border(columns: Columns, by_px: int) -> None:
    naive = np.zeros((2, HEIGHT, WIDTH), dtype=bool)
    inner = np.s_[:, by_px : HEIGHT - by_px, by_px : WIDTH - by_px]
    naive[inner] = painted(columns)[inner]
    assert (paint(inset(SMALL, columns, by_px), FRAME) == naive).all()


@given(columns=markings())
def test_the_window_is_the_smallest_that_holds_all(columns: Columns) -> None:
    bits = painted(columns).any(axis=0)
    window = window_of(widened(SMALL, columns, 0))
    if not bits.any():
        assert window.shape == (0, 0)
        return
    rows, across = np.nonzero(bits)
    assert window == Window(rows.min(), rows.max() + 1, across.min(), across.max() + 1)


@st.composite
def masks(draw: st.DrawFn) -> tuple[NDArray[np.bool_], Window]:
    """Random bits, full and empty masks among them, in a window away from the origin."""
    rows, columns = draw(st.integers(1, 9)), draw(st.integers(1, 7))
    seed, density = draw(st.integers(0, 2**16)), draw(st.sampled_from([0.0, 0.2, 0.5, 0.9, 1.0]))
    bits = np.random.default_rng(seed).random((draw(st.integers(1, 5)), rows, columns)) < density
    return bits, Window(4, 4 + rows, 3, 3 + columns)


def naive_runs(bits: NDArray[np.bool_], window: Window) -> list[tuple[int, int, int, int]]:
    runs = []
    for mask in range(len(bits)):
        for column in range(bits.shape[2]):
            row = 0
            while row < bits.shape[1]:
                if bits[mask, row, column]:
                    start = row
                    while row < bits.shape[1] and bits[mask, row, column]:
                        row += 1
                    runs.append((mask, column + window.left, start + window.top, row + window.top))
                row += 1
    return runs


@given(drawn=masks())
def test_runs_are_the_loops_and_give_the_bits_back(drawn: tuple[NDArray[np.bool_], Window]) -> None:
    bits, window = drawn
    runs = runs_of(bits, window)
    found = list(zip(runs.mask.tolist(), runs.column.tolist(), runs.start.tolist(), runs.stop.tolist(), strict=True))
    assert found == naive_runs(bits, window)
    assert (runs.bits(len(bits), window) == bits).all()
    assert (runs.sizes(len(bits)) == bits.sum(axis=(1, 2))).all()


def test_an_empty_set_of_runs_has_sizes_of_zero() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert VerticalRuns(none, none, none, none).sizes(3).tolist() == [0, 0, 0]


@pytest.mark.parametrize("scene", [SMALL], ids=["small"])
def test_columns_outside_the_frame_are_dropped(scene: Scene) -> None:
    first = np.full((1, 1, HEIGHT), WIDTH + 3)
    assert not paint(widened(scene, (first, first + 1), 0), FRAME).any()

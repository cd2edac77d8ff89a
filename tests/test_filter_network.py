"""Rows of entries: the cheapest width, and each entry in its cell's rows once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import SCENES

from build_model.assembly import ROW_COST, SECOND_REDUCTION_COST, assemble, row_width
from build_model.export import build_banks
from runtime.model.format import PADDING_SIZE


@given(st.lists(st.integers(1, 60), min_size=1, max_size=2000))
def test_no_other_width_is_cheaper(entries: list[int]) -> None:
    """Against every width there is, with plain loops."""

    def cost(width: int) -> int:
        rows = [-(-count // width) for count in entries]
        again = SECOND_REDUCTION_COST + max(rows) * len(entries) if max(rows) > 1 else 0
        return sum(width + ROW_COST for count in rows for _ in range(count)) + again

    assert cost(row_width(entries)) == min(cost(width) for width in range(1, max(entries) + 1))


def test_like_numbers_of_entries_take_one_row_and_unlike_ones_several() -> None:
    assert row_width([100] * 27) == 100
    assert row_width([9, 5, 7] * 500) == 9
    unlike = [20] * 1500 + [72] * 200
    width = row_width(unlike)
    assert width < 72
    padded = sum(-(-count // width) * width for count in unlike)
    assert padded < 1.3 * sum(unlike) < 72 * len(unlike)


@pytest.mark.parametrize("width", [4, 100])
def test_rows_hold_each_cells_entries_in_order(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    monkeypatch.setattr("build_model.assembly.row_width", lambda _entries: width)
    banks = build_banks(SCENES["cut left"])
    tables = assemble(SCENES["cut left"], banks)
    rows = tables.rows_of_cell
    for cell, bank in enumerate(banks):
        own = np.flatnonzero(tables.row_cell == cell)
        assert (np.unique(rows[:, cell]) == own).all()
        sizes = tables.must_light_size[own].ravel()
        assert sizes[: len(bank)].tolist() == bank.must_light_sizes.tolist()
        assert (sizes[len(bank) :] == PADDING_SIZE).all()
        assert (tables.line_lower[own].reshape(-1, 4)[: len(bank)] == bank.lines.lower).all()
        assert (tables.state_upper[own].reshape(-1, 4)[: len(bank)] == bank.state_upper).all()

"""verify-model of banks of windows: what was built is proved, and each kind of change of a table or of the graph is refuted."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import numpy_helper
from scenes import FINAL, WINDOWED
from taken_apart import Model

from build_model.export import build_banks, export_model
from build_model.filter_tables import WindowTable, WindowTables
from build_model.verify.proof import verify_model
from runtime.domain import Edges
from runtime.model.format import PADDING_SIZE
from runtime.scene import Calibration, Scene, Tolerance, WindowedBank

Rng = np.random.Generator
SMALL = replace(
    FINAL,
    domain=replace(FINAL.domain, theta_rad=Edges((0.0, 0.015, 0.02)), x_m=Edges((-4.0, 4.0)), z_m=Edges((900.0, 1100.0))),
    bank=WindowedBank(set_px=24.0, rows=8, places=2),
)
TOLERANT = replace(SMALL, calibration=Calibration(principal_px=0.5), tolerance=Tolerance(line_px=1, missed_budget=1))
PROVED = {"small": SMALL, "tolerant": TOLERANT, "strip": WINDOWED["strip in windows"], "from the left": WINDOWED["final, from the left"]}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One exported model a scene."""
    folder = tmp_path_factory.mktemp("windowed")
    for name, scene in PROVED.items():
        export_model(scene, folder / f"{name}.onnx", estimator="none")
    return {name: folder / f"{name}.onnx" for name in PROVED}


def taken_apart(path: Path, scene: Scene) -> Model:
    proto = onnx.load(path)
    return Model(scene, [], proto, json.loads(proto.metadata_props[0].value))


@pytest.mark.parametrize("name", PROVED)
def test_what_was_built_is_proved(files: dict[str, Path], name: str) -> None:
    report = verify_model(files[name])
    assert report.counterexample is None
    banks = build_banks(PROVED[name])
    assert (report.cells, report.entries) == (PROVED[name].domain.cell_count, sum(len(bank) for bank in banks))
    assert report.windows > report.entries * PROVED[name].tolerance.missed_budget
    assert 0 < report.margin_px < 0.5


def with_windows(model: Model, change: Callable[[WindowTable], WindowTable]) -> None:
    tables = model.tables()
    assert isinstance(tables, WindowTables)
    model.set_tables(replace(tables, windows=change(tables.windows)))


def some_window(rng: Rng, tables: Any, columns: int = 3) -> tuple[int, ...]:
    """Where a used window of an entry, of so many columns or more, lies in the table."""
    places = np.argwhere(tables.windows.columns >= columns)
    return tuple(places[rng.integers(len(places))].tolist())


def narrow_a_window(rng: Rng, model: Model) -> None:
    """From its left: some state crosses the border there."""
    place = some_window(rng, tables := model.tables())
    rows, start, columns = tables.window.shape[0], tables.windows.start.copy(), tables.windows.columns.copy()
    start[place] += 2 * rows
    columns[place] -= 2
    with_windows(model, lambda table: replace(table, start=start, columns=columns))


def narrow_a_gate(rng: Rng, model: Model) -> None:
    """From its right."""
    tables = model.tables()
    stop = tables.windows.gate_stop.copy()
    places = np.argwhere(stop > tables.windows.gate_start)
    stop[tuple(places[rng.integers(len(places))])] -= 2 * tables.window.shape[0]
    with_windows(model, lambda table: replace(table, gate_stop=stop))


def move_a_window_down(rng: Rng, model: Model) -> None:
    """To the border below, of which another window may have pixels."""
    place = some_window(rng, tables := model.tables())
    start = tables.windows.start.copy()
    start[place] += 1
    with_windows(model, lambda table: replace(table, start=start))


def use_a_window_twice(rng: Rng, model: Model) -> None:
    """The sizes agree; a missed pixel would be counted twice."""
    tables = model.tables()
    group, entry, place = some_window(rng, tables)
    used = np.flatnonzero(tables.windows.columns[group, entry])
    other = used[used != place][0]
    start, columns = tables.windows.start.copy(), tables.windows.columns.copy()
    start[group, entry, other], columns[group, entry, other] = start[group, entry, place], columns[group, entry, place]
    with_windows(model, lambda table: replace(table, start=start, columns=columns))


def swap_windows_of_entries(rng: Rng, model: Model) -> None:
    tables = model.tables()
    groups = np.flatnonzero((tables.must_light_size[:, :2] != PADDING_SIZE).all(axis=1))
    group = int(rng.choice(groups))
    start, columns, size = tables.windows.start.copy(), tables.windows.columns.copy(), tables.must_light_size.copy()
    for table in (start, columns, size):
        table[group, [0, 1]] = table[group, [1, 0]]
    model.set_tables(replace(tables, must_light_size=size, windows=replace(tables.windows, start=start, columns=columns)))


def misstate_a_size(rng: Rng, model: Model) -> None:
    tables = model.tables()
    size = tables.must_light_size.copy()
    places = np.argwhere(size != PADDING_SIZE)
    size[tuple(places[rng.integers(len(places))])] += 1
    model.set_tables(replace(tables, must_light_size=size))


def misstate_a_gates_size(rng: Rng, model: Model) -> None:
    """A smaller number lets fewer dark windows count."""
    tables = model.tables()
    size = tables.windows.gate_size.copy()
    size[rng.integers(len(size))] += rng.choice([-1, 1])
    model.set_tables(replace(tables, windows=replace(tables.windows, gate_size=size)))


def narrow_a_span(rng: Rng, model: Model) -> None:
    """S of a cell lacks what a state lights."""
    tables = model.tables()
    first, stop = tables.windows.span_first.copy(), tables.windows.span_stop.copy()
    cell, marking = int(rng.integers(len(first))), int(rng.integers(first.shape[1]))
    rows = np.flatnonzero(stop[cell, marking] > first[cell, marking])
    row = int(rows[len(rows) // 2])
    first[cell, marking, row] = stop[cell, marking, row]
    with_windows(model, lambda table: replace(table, span_first=first, span_stop=stop))


def remove_an_entry(rng: Rng, model: Model) -> None:
    tables = model.tables()
    size, columns = tables.must_light_size.copy(), tables.windows.columns.copy()
    places = np.argwhere(size != PADDING_SIZE)
    place = tuple(places[rng.integers(len(places))])
    size[place], columns[place] = PADDING_SIZE, 0
    model.set_tables(replace(tables, must_light_size=size, windows=replace(tables.windows, columns=columns)))


def narrow_a_state_box(rng: Rng, model: Model) -> None:
    tables = model.tables()
    upper = tables.state_upper.copy()
    places = np.argwhere(tables.must_light_size != PADDING_SIZE)
    group, entry = places[rng.integers(len(places))]
    low, high = tables.state_lower[group, entry, 3], upper[group, entry, 3]
    upper[group, entry, 3] = low + np.float32(0.9) * (high - low)
    model.set_tables(replace(tables, state_upper=upper))


def give_a_group_two_reference_rows(rng: Rng, model: Model) -> None:
    tables = model.tables()
    rows = tables.reference_row.copy()
    groups = np.flatnonzero((tables.must_light_size != PADDING_SIZE).sum(axis=1) > 1)
    group = int(rng.choice(groups))
    rows[group, np.flatnonzero(tables.must_light_size[group] != PADDING_SIZE)[0]] += 1
    model.set_tables(replace(tables, reference_row=rows))


def give_a_group_to_another_cell(_rng: Rng, model: Model) -> None:
    tables = model.tables()
    row_cell = tables.row_cell.copy()
    row_cell[np.searchsorted(row_cell, 1)] = 0
    model.set_tables(replace(tables, row_cell=row_cell))


def point_beyond_the_sums(_rng: Rng, model: Model) -> None:
    """From an unused place: a frame that opens the group could not be looked at."""
    tables = model.tables()
    start, stop = tables.windows.gate_start.copy(), tables.windows.gate_stop.copy()
    place = tuple(np.argwhere(start == stop)[-1])
    start[place] = stop[place] = 10**8
    with_windows(model, lambda table: replace(table, gate_start=start, gate_stop=stop))


def reach_to_infinity(_rng: Rng, model: Model) -> None:
    """An entry that goes on beyond its cell holds no more states; but the loader takes no such number."""
    tables = model.tables()
    lower = tables.line_lower.copy()
    lower[..., 0] = np.where(lower[..., 0] <= SMALL.domain.lower[0], -np.inf, lower[..., 0])
    model.set_tables(replace(tables, line_lower=lower))


def misstate_the_least(_rng: Rng, model: Model) -> None:
    model.metadata["smallest_must_light"] += 1


def open_fewer_places(_rng: Rng, model: Model) -> None:
    """The constant in the graph: groups beyond it would be dropped, not kept."""
    model.set_constant("places", np.array(1, dtype=np.int32))


def keep_the_larger_of_nothing(_rng: Rng, model: Model) -> None:
    """Scattered counts replace those of gates in place of being compared with them."""
    (node,) = (node for node in model.proto.graph.node if node.name == "missed_flat")
    next(part for part in node.attribute if part.name == "reduction").s = b"min"


def change_a_shift(_rng: Rng, model: Model) -> None:
    """J looks at the pixel to the right in the same row."""
    for side in ("from", "to"):
        model.set_constant(f"beneath_2_{side}", numpy_helper.to_array(model.constants[f"beneath_2_{side}"]) - np.array([1, 0]))


def call_it_masks(_rng: Rng, model: Model) -> None:
    model.metadata["scene"]["bank"] = {"pitch_bins": 2, "distance_bins": 1, "column_px": 0.5}


MUTATIONS = {
    narrow_a_window: "does not cross the border|outside the window",
    narrow_a_gate: "does not cross the border|outside the window",
    move_a_window_down: "does not cross|outside the window|pixel in common|frame's border",
    use_a_window_twice: "pixel in common|does not cross",
    swap_windows_of_entries: "does not cross|outside the window",
    misstate_a_size: "must_light_size",
    misstate_a_gates_size: "gate_size|smallest_must_light",
    narrow_a_span: "not in O",
    remove_an_entry: "do not cover",
    narrow_a_state_box: "box of states",
    give_a_group_two_reference_rows: "reference rows|do not cover|does not cross",
    give_a_group_to_another_cell: "reaches out of its cell",
    point_beyond_the_sums: "unused place lies outside the sums",
    reach_to_infinity: "line_lower is not finite",
    misstate_the_least: "smallest_must_light",
    open_fewer_places: "graph: the constant 'places'",
    keep_the_larger_of_nothing: "node",
    change_a_shift: "graph: the constant 'beneath_2_from'",
    call_it_masks: "not of the kind",
}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("mutate", "claims"), MUTATIONS.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_a_wrong_model_is_refuted(
    files: dict[str, Path], tmp_path: Path, mutate: Callable[[Rng, Model], None], claims: str, seed: int
) -> None:
    model = taken_apart(files["small"], SMALL)
    mutate(np.random.default_rng(seed), model)
    report = verify_model(model.save(tmp_path / "mutated.onnx"))
    assert report.counterexample is not None
    assert re.search(claims, str(report.counterexample)), str(report.counterexample)


def test_a_refuted_window_shows_a_state_of_the_entry(files: dict[str, Path], tmp_path: Path) -> None:
    model = taken_apart(files["small"], SMALL)
    narrow_a_window(np.random.default_rng(3), model)
    found = verify_model(model.save(tmp_path / "mutated.onnx")).counterexample
    assert found is not None
    assert found.state is not None
    assert SMALL.domain.contains(np.array(found.state))


@pytest.mark.evidence
@pytest.mark.parametrize(("mutate", "claims"), MUTATIONS.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_a_wrong_model_of_a_long_final_is_refuted(tmp_path: Path, mutate: Callable[[Rng, Model], None], claims: str) -> None:
    """Every kind of mutation of the model of models/approach.toml, at a random place."""
    scene = Scene.load(Path(__file__).parents[1] / "models" / "approach.toml")
    path = tmp_path / "approach.onnx"
    export_model(scene, path, estimator="none", jobs=2)
    model = taken_apart(path, scene)
    mutate(np.random.default_rng(4), model)
    found = verify_model(model.save(tmp_path / "mutated.onnx"), jobs=2).counterexample
    assert found is not None
    assert re.search(claims, str(found)), str(found)

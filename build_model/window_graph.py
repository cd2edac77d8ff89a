"""NN_F of a bank of windows as a static graph: groups by their gates, the entries of those that pass, S row by row.

With the sums of J (`build_model.window_bank`) along its rows, a window is lit where the sum at its end exceeds that at its start: two
look-ups. The gates of all groups are looked up; the windows of entries only in the first `places` groups that pass, gathered from the
tables. A group beyond these is not opened: all of its entries stand as it does (`overflow`). What passes is then summed up as in a bank
of masks.

Look-ups go down the columns of the turned frame, since onnxruntime sums five times as fast along the first axis as along the last.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper

from build_model.bank_graph import BIT, GraphWriter, decide, finished, framed, shown_cells, window_of_frame, witnesses
from build_model.filter_tables import WindowTables
from runtime.model.format import OVERFLOW, PADDING_SIZE
from runtime.scene import Scene, WindowedBank


def window_graph(scene: Scene, tables: WindowTables) -> onnx.GraphProto:
    """The graph from `frame` and the two budgets to every output but `network_state` (table in `models/README.md`)."""
    g = GraphWriter()
    crop = window_of_frame(g, tables)
    sums = _row_sums(g, scene, tables, crop)
    g.constant("row_cell", tables.row_cell)
    g.whole("first_axis", 0)
    missed = _missed(g, scene, tables, sums)
    decide(g, scene, tables, missed, g.constant("none_extra", np.array(0, dtype=np.int32)))  # O is S: no lit pixel of S is outside it
    _filtered(g, scene, tables, crop)
    graph = finished(g, scene, tables)
    graph.output.append(helper.make_tensor_value_info(OVERFLOW, TensorProto.BOOL, []))
    return graph


def _row_sums(g: GraphWriter, scene: Scene, tables: WindowTables, crop: str) -> str:
    """Flat sums (int32) of J along its rows: (columns + 1, rows) under a column of zeros."""
    tolerance = scene.tolerance.line_px
    g.whole("column_of_zeros", 1, 0, 0, 0)
    g.constant("along", np.array(0, dtype=np.int64))
    g.whole("flat", -1)
    if tolerance:
        crop = witnesses(g, crop, tolerance)
    turned = g.node("Transpose", "turned", _both_sides(g, tables, crop), perm=[1, 0])
    counted = g.node("Pad", "turned_counted", g.node("Cast", "turned_lit", turned, to=TensorProto.INT32), "column_of_zeros")
    return g.node("Reshape", "sums", g.node("CumSum", "row_sums", counted, "along"), "flat")


def _both_sides(g: GraphWriter, tables: WindowTables, pixels: str) -> str:
    """J: the pixels with one below them, or below and beside. Of bools, since not every onnxruntime has Max and Min of bytes."""
    rows, columns = tables.window.shape
    wide = g.node("Cast", "pixels_lit", g.node("Pad", "pixels_padded", pixels, g.whole("around", 0, 1, 1, 1)), to=TensorProto.BOOL)

    def part(name: str, row: int, column: int) -> str:
        first, stop = g.whole(f"{name}_from", row, column), g.whole(f"{name}_to", row + rows, column + columns)
        return g.node("Slice", name, wide, first, stop, "rows_and_columns")

    own, beneath = part("own", 0, 1), [part(f"beneath_{shift}", 1, shift) for shift in range(3)]
    beside = g.node("Or", "beside", beneath[0], beneath[2])
    return g.node("And", "both_sides", own, g.node("Or", "beneath", beside, beneath[1]))


def _missed(g: GraphWriter, scene: Scene, tables: WindowTables, sums: str) -> str:
    """How many pixels each entry misses at least, (rows, width): dark windows of its group, or of its own if the group is opened."""
    windows, (rows, width) = tables.windows, tables.must_light_size.shape
    each = g.constant("each_window", np.ones((windows.gate_start.shape[1], 1), dtype=BIT))
    by_gate = g.whole("by_gate", *windows.gate_start.shape)
    start, stop = (g.constant(f"gate_{side}", getattr(windows, f"gate_{side}").ravel()) for side in ("start", "stop"))
    gate_lit = _lit(g, "gate", sums, start, stop, by_gate, each)
    gate = g.node("Sub", "gate_missed", g.constant("gate_size", windows.gate_size[:, None]), gate_lit)
    opened = _opened(g, scene, rows, gate)
    missed = _missed_of_opened(g, tables, sums, opened, each)
    nowhere = np.where(tables.must_light_size == PADDING_SIZE, PADDING_SIZE, 0).astype(np.int32)
    by_group = g.node("Reshape", "missed_by_group", g.node("Max", "missed_by_gate", gate, g.constant("no_entry", nowhere)), "flat")
    first = g.node("Mul", "first_of_opened", opened, g.constant("row_width", np.array(width, dtype=np.int32)))
    column = g.node("Reshape", "opened_column", first, g.whole("column", -1, 1))
    place = g.node("Add", "place_of_opened", column, _numbers(g, "places_of_row", width))
    place = g.node("Reshape", "places_flat", place, "flat")
    flat = g.node("ScatterElements", "missed_flat", by_group, place, missed, axis=0, reduction="max")
    return g.node("Reshape", "missed", flat, g.whole("by_entry", rows, width))


def _numbers(g: GraphWriter, name: str, count: int) -> str:
    return g.constant(name, np.arange(count, dtype=np.int32))


def _lit(g: GraphWriter, name: str, sums: str, start: str, stop: str, layout: str, each: str) -> str:
    """Number of lit windows of sets, (sets, 1) int32, from the flat places of their windows' starts and ends; `layout`: (sets, windows)."""
    before, behind = (g.node("GatherElements", f"{name}_{side}_sums", sums, places) for side, places in (("start", start), ("stop", stop)))
    lit = g.node("Cast", f"{name}_lit_counted", g.node("Greater", f"{name}_lit", behind, before), to=TensorProto.UINT8)
    return g.node("MatMulInteger", f"{name}_lit_windows", g.node("Reshape", f"{name}_lit_of_set", lit, layout), each)


def _opened(g: GraphWriter, scene: Scene, rows: int, gate: str) -> str:
    """Numbers of the groups that are opened, (places,): the first that pass their gate, and group 0 where there are no more."""
    assert isinstance(scene.bank, WindowedBank)
    places = min(scene.bank.places, rows)
    passes = g.node("Reshape", "gate_passes", g.node("LessOrEqual", "gate_within", gate, "missed_budget"), "flat")
    rank = g.node("CumSum", "gate_rank", g.node("Cast", "gate_counted", passes, to=TensorProto.INT32), "along")
    most = g.constant("places", np.array(places, dtype=np.int32))
    found = g.node("Slice", "gate_total", rank, g.whole("last_rank", -1), g.whole("behind_last", rows), "first_axis")
    g.node("Squeeze", OVERFLOW, g.node("Greater", "gates_above", found, most), "first_axis")
    placed = g.node("And", "gate_placed", passes, g.node("LessOrEqual", "gate_in_reach", rank, most))
    place = g.node("Sub", "gate_place", rank, g.constant("one", np.array(1, dtype=np.int32)))
    place = g.node("Where", "place_or_none", placed, place, most)
    empty = g.constant("places_and_none", np.zeros(places + 1, dtype=np.int32))
    filled = g.node("ScatterElements", "places_filled", empty, place, _numbers(g, "group_numbers", rows), axis=0, reduction="max")
    return g.node("Slice", "opened", filled, "first_axis", g.whole("behind_places", places), "first_axis")


def _missed_of_opened(g: GraphWriter, tables: WindowTables, sums: str, opened: str, each: str) -> str:
    """Dark windows of the entries of opened groups, flat; padding is far above any budget."""
    windows, rows = tables.windows, len(tables.row_cell)
    starts = g.constant("window_start", windows.start.reshape(rows, -1))
    columns = g.constant("window_columns", windows.columns.reshape(rows, -1))
    start = g.node("Gather", "opened_start", starts, opened)
    across = g.node("Cast", "opened_columns", g.node("Gather", "opened_bytes", columns, opened), to=TensorProto.INT32)
    rows_of_window = g.constant("rows_of_window", np.array(tables.window.shape[0], dtype=np.int32))
    stop = g.node("Add", "opened_stop", start, g.node("Mul", "opened_across", across, rows_of_window))
    start, stop = (g.node("Reshape", f"{name}_flat", name, "flat") for name in (start, stop))
    lit = _lit(g, "entry", sums, start, stop, g.whole("by_opened", -1, windows.start.shape[2]), each)
    size = g.node("Gather", "opened_size", g.constant("must_light_size", tables.must_light_size), opened)
    return g.node("Sub", "opened_missed", g.node("Reshape", "opened_size_flat", size, "flat"), g.node("Reshape", "lit_flat", lit, "flat"))


def _filtered(g: GraphWriter, scene: Scene, tables: WindowTables, crop: str) -> None:
    """filtered = frame within S, for each marking and row from the first to the last column of all shown cells."""
    windows, (rows, columns) = tables.windows, tables.window.shape
    shown = g.node("Reshape", "shown_by_cell", shown_cells(g, tables), g.whole("cell_marking_row", -1, 1, 1))
    flat = []
    numbers = _numbers(g, "row_numbers", rows)
    for side, none, reduction in (("first", columns, "ReduceMin"), ("stop", 0, "ReduceMax")):
        spans = g.node("Cast", f"span_{side}_counted", g.constant(f"span_{side}", getattr(windows, f"span_{side}")), to=TensorProto.INT32)
        chosen = g.node("Where", f"span_{side}_shown", shown, spans, g.constant(f"span_{side}_none", np.array(none, dtype=np.int32)))
        extreme = g.node(reduction, f"span_{side}_hull", chosen, "first_axis", keepdims=0)
        flat.append(extreme)
    first, stop = flat[0], g.node("Max", "span_stop_hull_behind", flat[1], flat[0])
    places = []
    for side, column in (("first", first), ("stop", stop)):
        at = g.node("Mul", f"span_{side}_at", column, "rows_of_window")
        places.append(g.node("Reshape", f"span_{side}_places", g.node("Add", f"span_{side}_index", at, numbers), "flat"))
    flat_frame = g.node("Reshape", "turned_flat", "turned_counted", "flat")
    blank = g.node("Mul", "blank", flat_frame, g.constant("nothing", np.array(0, dtype=np.int32)))  # as a constant, it would fill the file
    markings = windows.span_first.shape[1]
    steps = g.constant("span_steps", np.repeat(np.array([1, -1], dtype=np.int32), markings * rows))
    place = g.node("Concat", "span_places", *places, axis=0)
    painted = g.node("ScatterElements", "painted_flat", blank, place, steps, axis=0, reduction="add")
    turned = g.node("Reshape", "painted", painted, g.whole("turned_shape", columns + 1, rows))
    sums = g.node("CumSum", "cover_sums", turned, "along")
    cover = g.node("Slice", "cover", sums, "first_axis", g.whole("behind_columns", columns), "first_axis")
    covered = g.node("Transpose", "covered", g.node("Cast", "covered_turned", cover, to=TensorProto.BOOL), perm=[1, 0])
    framed(g, scene, tables, g.node("Where", "filtered_crop", covered, crop, g.constant("dark", np.array(0, dtype=np.uint8))))

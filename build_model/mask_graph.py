"""NN_F of a bank of masks as a static graph.

Markings are steep, so a mask is a few vertical runs (`build_model.run_table`): with the sums of the frame down its columns, a run is
counted by two look-ups, and a mask's score is the same affine map of the frame as the matrix product it replaces, at a fraction of
its weights. The union of the passing cells' S is painted by the transpose of that map: 1 and -1 at the ends of the runs, summed down the
columns. A product with a row of 1 and -1 adds up faster than ReduceSum, and one of bytes folds the frame faster than a reversed Slice.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto

from build_model.bank_graph import BIT, GraphWriter, decide, finished, framed, shown_cells, window_of_frame, witnesses
from build_model.filter_tables import FilterTables
from runtime.scene import Scene


def mask_graph(scene: Scene, tables: FilterTables) -> onnx.GraphProto:
    """The graph from `frame` and the two budgets to every output but `network_state` (table in `models/README.md`)."""
    g = GraphWriter()
    crop, sums = _column_sums(g, scene, tables)
    g.constant("row_cell", tables.row_cell)
    missed, extra = _scores(g, tables, _lit(g, tables, sums))
    decide(g, scene, tables, missed, extra)
    _filtered(g, scene, tables, crop)
    return finished(g, scene, tables)


def _column_sums(g: GraphWriter, scene: Scene, tables: FilterTables) -> tuple[str, str]:
    """The frame within the window, and the flat sums down its columns, those of the dilated frame behind, if there is one."""
    tolerance = scene.tolerance.line_px
    crop = window_of_frame(g, tables)
    g.whole("row_of_zeros", 1, 0, 0, 0)
    g.constant("down", np.array(0, dtype=np.int64))
    g.whole("flat", -1)
    if tables.runs.folded:
        g.constant("fold", np.concatenate([half := np.eye(tables.runs.columns, dtype=BIT), half[::-1]]))
    sums = _sums(g, "frame", tables, crop)
    if tolerance == 0:
        return crop, sums
    return crop, g.node("Concat", "all_sums", sums, _sums(g, "witness", tables, witnesses(g, crop, tolerance)), axis=0)


def _sums(g: GraphWriter, name: str, tables: FilterTables, pixels: str) -> str:
    """Flat sums (int32) down the columns, under a row of zeros; of the frame, or of its left half and the mirrored right one together."""
    if tables.runs.folded:
        counted = g.node("MatMulInteger", f"{name}_folded", pixels, "fold")
    else:
        counted = g.node("Cast", f"{name}_counted", pixels, to=TensorProto.INT32)
    padded = g.node("Pad", f"{name}_padded", counted, "row_of_zeros")
    return g.node("Reshape", f"{name}_sums", g.node("CumSum", f"{name}_column_sums", padded, "down"), "flat")


def _lit(g: GraphWriter, tables: FilterTables, sums: str) -> str:
    """Lit pixels of every mask, flat, in the order of the run table: from the block that reaches the fewest masks to that of all."""
    total, blocks = "", tables.runs.blocks
    for number, block in reversed(list(enumerate(blocks))):
        _, runs, reached = block.shape
        looked_up = g.node("GatherElements", f"looked_up_{number}", sums, g.constant(f"runs_{number}", block.ravel()))
        ends = g.node("Reshape", f"run_ends_{number}", looked_up, g.whole(f"run_layout_{number}", 2 * runs, reached))
        signs = g.constant(f"stop_minus_start_{number}", np.repeat(np.array([[1, -1]], dtype=np.int32), runs, axis=1))
        lit = g.node("MatMul", f"lit_{number}", signs, ends)
        if total:
            beyond = g.whole(f"masks_beyond_{number}", 0, 0, 0, reached - blocks[number + 1].shape[2])
            lit = g.node("Add", f"lit_so_far_{number}", lit, g.node("Pad", f"lit_wide_{number}", total, beyond))
        total = lit
    return g.node("Reshape", "lit", total, "flat")


def _scores(g: GraphWriter, tables: FilterTables, lit: str) -> tuple[str, str]:
    """missed = |K| - lit K (among witnesses) and extra = lit S - lit O of every entry, (rows, width)."""
    g.whole("first_axis", 0)
    rows, width = tables.must_light_size.shape
    one_each = g.whole("by_row", rows, 1)
    by_entry = g.whole("by_entry", rows, width)

    def lit_of(name: str) -> str:
        return g.node("GatherElements", f"{name}_lit_flat", lit, g.constant(f"{name}_place", getattr(tables.runs, name).ravel()))

    spatial = lit_of("spatial")
    if rows > len(tables.cells):
        spatial = g.node("GatherElements", "spatial_lit_of_row", spatial, "row_cell")
    spatial = g.node("Reshape", "spatial_lit", spatial, one_each)
    must_light, may_light = (g.node("Reshape", f"{name}_lit", lit_of(name), by_entry) for name in ("must_light", "may_light"))
    missed = g.node("Sub", "missed", g.constant("must_light_size", tables.must_light_size), must_light)
    return missed, g.node("Sub", "extra", spatial, may_light)


def _filtered(g: GraphWriter, scene: Scene, tables: FilterTables, crop: str) -> None:
    """filtered = frame within the union of S over the passing cells, or within S of `cell` where none passes."""
    window, runs = tables.window, tables.spatial_runs
    chosen = g.node("Cast", "chosen", shown_cells(g, tables), to=TensorProto.INT32)
    shown = g.node("GatherElements", "shown_runs", chosen, g.constant("spatial_run_cell", runs.cell))
    steps = g.node("Mul", "shown_steps", shown, g.constant("spatial_run_step", runs.step))
    blank = g.constant("blank", np.zeros(np.prod(window.shape), dtype=np.int32))
    index = g.constant("spatial_run_index", runs.index)
    painted = g.node("ScatterElements", "painted_flat", blank, index, steps, axis=0, reduction="add")
    cover = g.node("CumSum", "cover", g.node("Reshape", "painted", painted, g.whole("window_shape", *window.shape)), "down")
    covered = g.node("Cast", "covered", cover, to=TensorProto.BOOL)
    kept = g.node("Where", "filtered_crop", covered, crop, g.constant("dark", np.array(0, dtype=np.uint8)))
    framed(g, scene, tables, kept)

"""NN_F as a static ONNX graph of standard operators, without control flow.

Markings are steep, so a mask is a few vertical runs (`build_model.run_table`): with the sums of the frame down its columns, a run is
counted by two look-ups, and a mask's score is the same affine map of the frame as the matrix product it replaces, at a fraction of
its weights. The union of the passing cells' S is painted by the transpose of that map: 1 and -1 at the ends of the runs, summed down the
columns. Where a cell's entries fill several rows, what the rows give is gathered by cell and reduced again.

Of operators that do the same, those stand here that onnxruntime is quick with: GatherElements looks up five times as fast as Gather, a
product with a row of 1 and -1 adds up faster than ReduceSum, and one of bytes folds the frame faster than a reversed Slice.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from build_model.filter_tables import FilterTables
from runtime.model.format import BUDGETS, FRAME, LINE_BOX_TENSORS
from runtime.scene import STATE_NAMES, Scene

BIT = np.int8
"""Type of the weights in a product of bytes: the frame's bytes are unsigned, and for this pair processors have instructions."""


class GraphWriter:
    """Collects nodes and constants; every node has one output, named after what it means."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, values: NDArray | np.generic) -> str:
        """Adds an initialiser and returns its name."""
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(values).reshape(np.shape(values)), name))
        return name

    def node(self, operator: str, output: str, *inputs: str, **attributes: Any) -> str:
        """Adds a node and returns the name of its output."""
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def whole(self, name: str, *values: int) -> str:
        """An int64 vector: axes, shapes and borders."""
        return self.constant(name, np.array(values, dtype=np.int64))


def filter_graph(scene: Scene, tables: FilterTables) -> onnx.GraphProto:
    """The graph from `frame` and the two budgets to every output but `network_state` (table in `models/README.md`)."""
    g = GraphWriter()
    crop, sums = _column_sums(g, scene, tables)
    g.constant("row_cell", tables.row_cell)
    missed, extra = _scores(g, tables, _lit(g, tables, sums))
    _decide(g, scene, tables, missed, extra)
    _filtered(g, scene, tables, crop)
    for name in LINE_BOX_TENSORS:
        g.constant(name, getattr(tables, name))
    for name in BUDGETS:
        g.constant(name, np.array(getattr(scene.tolerance, name), dtype=np.int32))
    cells = len(tables.cells)
    inputs = [helper.make_tensor_value_info(FRAME, TensorProto.UINT8, scene.camera.shape)]
    inputs += [helper.make_tensor_value_info(name, TensorProto.INT32, []) for name in BUDGETS]
    outputs = [
        helper.make_tensor_value_info("cell", TensorProto.INT64, []),
        helper.make_tensor_value_info("support", TensorProto.INT32, [cells]),
        helper.make_tensor_value_info("mismatch", TensorProto.INT32, [cells]),
        helper.make_tensor_value_info("passes", TensorProto.BOOL, tables.must_light_size.shape),
        helper.make_tensor_value_info("cell_lower", TensorProto.FLOAT, [cells, 4]),
        helper.make_tensor_value_info("cell_upper", TensorProto.FLOAT, [cells, 4]),
        helper.make_tensor_value_info("filtered", TensorProto.UINT8, scene.camera.shape),
    ]
    return helper.make_graph(g.nodes, "glideproof", inputs, outputs, g.constants)


def _column_sums(g: GraphWriter, scene: Scene, tables: FilterTables) -> tuple[str, str]:
    """The frame within the window, and the flat sums down its columns, those of the dilated frame behind, if there is one."""
    window, tolerance = tables.window, scene.tolerance.line_px
    g.whole("rows_and_columns", 0, 1)
    first, stop = g.whole("window_first", window.top, window.left), g.whole("window_stop", window.bottom, window.right)
    g.whole("row_of_zeros", 1, 0, 0, 0)
    g.constant("down", np.array(0, dtype=np.int64))
    g.whole("flat", -1)
    crop = g.node("Slice", "crop", FRAME, first, stop, "rows_and_columns")
    if tables.runs.folded:
        g.constant("fold", np.concatenate([half := np.eye(tables.runs.columns, dtype=BIT), half[::-1]]))
    sums = _sums(g, "frame", tables, crop)
    if tolerance == 0:
        return crop, sums
    g.whole("image_axes", 0, 1)
    image = g.node("Unsqueeze", "crop_image", crop, "image_axes")
    dilated = g.node("MaxPool", "dilated_image", image, kernel_shape=[2 * tolerance + 1] * 2, pads=[tolerance] * 4, strides=[1, 1])
    witnesses = g.node("Squeeze", "witnesses", dilated, "image_axes")
    return crop, g.node("Concat", "all_sums", sums, _sums(g, "witness", tables, witnesses), axis=0)


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


def _decide(g: GraphWriter, scene: Scene, tables: FilterTables, missed: str, extra: str) -> None:
    """support, mismatch, cell and the hulls; `passing` (cells,) bool stays for `_filtered`."""
    g.whole("last_axis", -1)
    zero = g.constant("zero", np.array(0, dtype=np.int32))
    within_missed = g.node("LessOrEqual", "within_missed", missed, "missed_budget")
    unused = g.node("Less", "extra_unused", "extra_budget", zero)
    largest = g.constant("largest_extra", np.array(np.iinfo(np.int32).max, dtype=np.int32))
    allowed = g.node("Where", "extra_allowed", unused, largest, "extra_budget")
    passes = g.node("And", "passes", within_missed, g.node("LessOrEqual", "within_extra", extra, allowed))
    _support(g, tables, passes)
    if len(rows := tables.rows_of_cell) > 1:
        g.constant("rows_of_cell", rows.ravel())
        g.whole("rows_and_cells", *rows.shape)
    _extreme(g, tables, "ReduceMin", "mismatch", g.node("Add", "missed_and_extra", missed, extra))
    g.whole("axes_and_cells", len(STATE_NAMES), len(tables.cells))
    g.node("Greater", "passing", "support", zero)
    most = g.node("ReduceMax", "most_support", "support", "first_axis", keepdims=0)
    g.node("Greater", "some_pass", most, zero)
    best = g.node("ArgMax", "most_supported", "support", axis=0, keepdims=0)
    g.node("Where", "cell", "some_pass", best, g.node("ArgMin", "least_mismatch", "mismatch", axis=0, keepdims=0))
    fails = g.node("Cast", "fails_counted", g.node("Not", "fails", passes), to=TensorProto.FLOAT)
    g.node("Mul", "removed_by", fails, g.constant("farthest", np.finfo(np.float32).max))
    _hull(g, scene, tables, "lower", tables.cell_lower, "Add", "ReduceMin")
    _hull(g, scene, tables, "upper", tables.cell_upper, "Sub", "ReduceMax")


def _support(g: GraphWriter, tables: FilterTables, passes: str) -> None:
    """support: the number of each cell's entries that pass, (rows, width) to (cells,). A product of bytes counts faster than ReduceSum."""
    cells, (rows, width) = len(tables.cells), tables.must_light_size.shape
    counted = g.node("Cast", "passes_counted", passes, to=TensorProto.UINT8)
    in_row = g.node("MatMulInteger", "support_in_row", counted, g.constant("each_entry", np.ones((width, 1), dtype=BIT)))
    if rows == cells:
        g.node("Reshape", "support", in_row, "flat")
        return
    nothing = g.constant("no_support", np.zeros(cells, dtype=np.int32))
    by_row = g.node("Reshape", "support_by_row", in_row, "flat")
    g.node("ScatterElements", "support", nothing, "row_cell", by_row, axis=0, reduction="add")


def _extreme(g: GraphWriter, tables: FilterTables, reduction: str, name: str, by_entry: str) -> str:
    """The least or the greatest over each cell's entries, (rows, width) to (cells,)."""
    rows = tables.rows_of_cell
    if len(rows) == 1:
        return g.node(reduction, name, by_entry, "last_axis", keepdims=0)
    by_row = g.node(reduction, f"{name}_by_row", by_entry, "last_axis", keepdims=0)
    gathered = g.node("GatherElements", f"{name}_gathered", by_row, "rows_of_cell")
    by_cell = g.node("Reshape", f"{name}_by_cell", gathered, "rows_and_cells")
    return g.node(reduction, name, by_cell, "first_axis", keepdims=0)


def _hull(g: GraphWriter, scene: Scene, tables: FilterTables, side: str, cells: NDArray, remove: str, reduction: str) -> None:
    """cell_lower or cell_upper: the extreme over the passing entries, the others moved out of its way by the largest float32.

    Where none passes, and on a fixed axis, it is the cell's own side. Each axis is taken by itself, so that its numbers stay in the cache.
    """
    states, sides = getattr(tables, f"state_{side}"), []
    for axis, name in enumerate(STATE_NAMES):
        own = g.constant(f"{name}_{side}", states[..., axis])
        if scene.domain.fixed[axis]:
            sides.append(g.constant(f"whole_{name}_{side}", cells[:, axis]))
        else:
            candidates = g.node(remove, f"{name}_{side}_candidates", own, "removed_by")
            sides.append(_extreme(g, tables, reduction, f"{name}_{side}_hull", candidates))
    hull = g.node("Reshape", f"{side}_hull", g.node("Concat", f"{side}_hull_flat", *sides, axis=0), "axes_and_cells")
    chosen = g.node("Where", f"{side}_by_axis", "passing", hull, g.constant(f"whole_{side}", cells.T))
    g.node("Transpose", f"cell_{side}", chosen, perm=[1, 0])


def _filtered(g: GraphWriter, scene: Scene, tables: FilterTables, crop: str) -> None:
    """filtered = frame within the union of S over the passing cells, or within S of `cell` where none passes."""
    window, runs = tables.window, tables.spatial_runs
    g.constant("cell_numbers", np.arange(len(tables.cells), dtype=np.int64))
    alone = g.node("And", "cell_alone", g.node("Equal", "is_cell", "cell_numbers", "cell"), g.node("Not", "none_passes", "some_pass"))
    chosen = g.node("Cast", "chosen", g.node("Or", "shown", "passing", alone), to=TensorProto.INT32)
    shown = g.node("GatherElements", "shown_runs", chosen, g.constant("spatial_run_cell", runs.cell))
    steps = g.node("Mul", "shown_steps", shown, g.constant("spatial_run_step", runs.step))
    blank = g.constant("blank", np.zeros(np.prod(window.shape), dtype=np.int32))
    index = g.constant("spatial_run_index", runs.index)
    painted = g.node("ScatterElements", "painted_flat", blank, index, steps, axis=0, reduction="add")
    cover = g.node("CumSum", "cover", g.node("Reshape", "painted", painted, g.whole("window_shape", *window.shape)), "down")
    covered = g.node("Cast", "covered", cover, to=TensorProto.BOOL)
    kept = g.node("Where", "filtered_crop", covered, crop, g.constant("dark", np.array(0, dtype=np.uint8)))
    height, width = scene.camera.shape
    g.node("Pad", "filtered", kept, g.whole("border", window.top, window.left, height - window.bottom, width - window.right))

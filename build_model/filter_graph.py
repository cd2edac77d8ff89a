"""NN_F as a static ONNX graph of standard operators, without control flow.

Markings are steep, so a mask is a few vertical runs (`build_model.pixel_mask`): with the sums of the frame down its columns, a run is
counted by two look-ups, and a mask's score is the same affine map of the frame as the matrix product it replaces, at a fraction of
its weights. GatherElements is the look-up, five times as fast as Gather in onnxruntime. The union of the passing cells' S is painted
by the transpose of that map: +1 and -1 at the ends of the runs, summed down the columns.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from build_model.filter_network import FilterTables, RunTable
from runtime.rounding import float32_above, float32_below
from runtime.scene import Scene

OPSET = 20
IR_VERSION = 10
BUDGETS = ("missed_budget", "extra_budget")

LINE_BOXES = ("line_lower", "line_upper", "reference_row")
"""Initialisers that no node reads: the entries' boxes, which say what the masks claim."""


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
    crop, sums, witness_sums = _column_sums(g, scene, tables)
    missed, extra = _scores(g, tables, sums, witness_sums)
    _decide(g, tables, missed, extra)
    _filtered(g, scene, tables, crop)
    for name in LINE_BOXES:
        g.constant(name, getattr(tables, name))
    for name in BUDGETS:
        g.constant(name, np.array(getattr(scene.tolerance, name), dtype=np.int32))
    cells = len(tables.cells)
    inputs = [helper.make_tensor_value_info("frame", TensorProto.UINT8, scene.camera.shape)]
    inputs += [helper.make_tensor_value_info(name, TensorProto.INT32, []) for name in BUDGETS]
    outputs = [
        helper.make_tensor_value_info("cell", TensorProto.INT64, []),
        helper.make_tensor_value_info("support", TensorProto.INT32, [cells]),
        helper.make_tensor_value_info("mismatch", TensorProto.INT32, [cells]),
        helper.make_tensor_value_info("passes", TensorProto.BOOL, [cells, tables.entries]),
        helper.make_tensor_value_info("cell_lower", TensorProto.FLOAT, [cells, 4]),
        helper.make_tensor_value_info("cell_upper", TensorProto.FLOAT, [cells, 4]),
        helper.make_tensor_value_info("filtered", TensorProto.UINT8, scene.camera.shape),
    ]
    return helper.make_graph(g.nodes, "glideproof", inputs, outputs, g.constants)


def _column_sums(g: GraphWriter, scene: Scene, tables: FilterTables) -> tuple[str, str, str]:
    """The frame within the window, and the flat sums of frame and dilated frame down the columns, a row of zeros on top."""
    window, tolerance = tables.window, scene.tolerance.line_px
    g.whole("rows_and_columns", 0, 1)
    first, stop = g.whole("window_first", window.top, window.left), g.whole("window_stop", window.bottom, window.right)
    g.whole("row_of_zeros", 1, 0, 0, 0)
    g.constant("down", np.array(0, dtype=np.int64))
    g.whole("flat", -1)
    crop = g.node("Slice", "crop", "frame", first, stop, "rows_and_columns")
    sums = _sums(g, "frame", crop)
    if tolerance == 0:
        return crop, sums, sums
    g.whole("image_axes", 0, 1)
    image = g.node("Unsqueeze", "crop_image", crop, "image_axes")
    dilated = g.node("MaxPool", "dilated_image", image, kernel_shape=[2 * tolerance + 1] * 2, pads=[tolerance] * 4, strides=[1, 1])
    return crop, sums, _sums(g, "dilated", g.node("Squeeze", "dilated", dilated, "image_axes"))


def _sums(g: GraphWriter, name: str, pixels: str) -> str:
    counted = g.node("Cast", f"{name}_counted", pixels, to=TensorProto.INT32)
    padded = g.node("Pad", f"{name}_padded", counted, "row_of_zeros")
    return g.node("Reshape", f"{name}_sums", g.node("CumSum", f"{name}_column_sums", padded, "down"), "flat")


def _lit(g: GraphWriter, name: str, sums: str, table: RunTable, shape: str) -> str:
    """Lit pixels of every mask, in the given shape."""
    totals = []
    layout = g.whole(f"{name}_layout", *table.start.shape)
    for side in ("stop", "start"):
        index = g.constant(f"{name}_{side}", getattr(table, side).ravel())
        looked_up = g.node("Reshape", f"{name}_{side}_table", g.node("GatherElements", f"{name}_{side}_sums", sums, index), layout)
        totals.append(g.node("ReduceSum", f"{name}_{side}_total", looked_up, "first_axis", keepdims=0))
    return g.node("Reshape", f"{name}_lit", g.node("Sub", f"{name}_lit_flat", *totals), shape)


def _scores(g: GraphWriter, tables: FilterTables, sums: str, witness_sums: str) -> tuple[str, str]:
    """missed = |K| - lit K (among witnesses) and extra = lit S - lit O of every entry, (cells, entries)."""
    g.whole("first_axis", 0)
    by_entry, by_cell = g.whole("by_entry", len(tables.cells), tables.entries), g.whole("by_cell", len(tables.cells), 1)
    size = g.constant("must_light_size", tables.must_light_size)
    missed = g.node("Sub", "missed", size, _lit(g, "must_light", witness_sums, tables.must_light, by_entry))
    spatial, may_light = _lit(g, "spatial", sums, tables.spatial, by_cell), _lit(g, "may_light", sums, tables.may_light, by_entry)
    return missed, g.node("Sub", "extra", spatial, may_light)


def _decide(g: GraphWriter, tables: FilterTables, missed: str, extra: str) -> None:
    """support, mismatch, cell and the hulls; `passing` (cells,) bool stays for `_filtered`."""
    g.whole("entry_axis", 1)
    zero = g.constant("zero", np.array(0, dtype=np.int32))
    within_missed = g.node("LessOrEqual", "within_missed", missed, "missed_budget")
    within_extra = g.node(
        "Or", "within_extra", g.node("LessOrEqual", "few_extra", extra, "extra_budget"), g.node("Less", "any_extra", "extra_budget", zero)
    )
    passes = g.node("And", "passes", within_missed, within_extra)
    g.node("ReduceSum", "support", g.node("Cast", "passes_counted", passes, to=TensorProto.INT32), "entry_axis", keepdims=0)
    g.node("ReduceMin", "mismatch", g.node("Add", "missed_and_extra", missed, extra), "entry_axis", keepdims=0)
    g.node("Greater", "passing", "support", zero)
    most = g.node("ReduceMax", "most_support", "support", "first_axis", keepdims=0)
    g.node("Greater", "some_pass", most, zero)
    best = g.node("ArgMax", "most_supported", "support", axis=0, keepdims=0)
    g.node("Where", "cell", "some_pass", best, g.node("ArgMin", "least_mismatch", "mismatch", axis=0, keepdims=0))
    _hull(g, "lower", tables.state_lower, float32_below(tables.cells.lower), "ReduceMin", np.inf)
    _hull(g, "upper", tables.state_upper, float32_above(tables.cells.upper), "ReduceMax", -np.inf)


def _hull(g: GraphWriter, side: str, states: NDArray, cells: NDArray, extreme: str, neutral: float) -> None:
    """cell_lower or cell_upper: the extreme over the passing entries, the cell's own side where none passes."""
    by_axis = g.constant(f"state_{side}", states.transpose(2, 0, 1))
    absent = g.constant(f"absent_{side}", np.array(neutral, dtype=np.float32))
    g.whole(f"{side}_axis", 2)
    candidates = g.node("Where", f"{side}_candidates", "passes", by_axis, absent)
    hull = g.node(extreme, f"{side}_hull", candidates, f"{side}_axis", keepdims=0)
    whole = g.constant(f"whole_{side}", cells.T)
    chosen = g.node("Where", f"{side}_by_axis", "passing", hull, whole)
    g.node("Transpose", f"cell_{side}", chosen, perm=[1, 0])


def _filtered(g: GraphWriter, scene: Scene, tables: FilterTables, crop: str) -> None:
    """filtered = frame within the union of S over the passing cells, or within S of `cell` where none passes."""
    window, table = tables.window, tables.spatial
    rows, columns = window.shape
    run, cell = np.nonzero(table.stop != table.start)
    ends = np.concatenate([table.start[run, cell], table.stop[run, cell]])
    g.constant("cell_numbers", np.arange(len(tables.cells), dtype=np.int64))
    alone = g.node("And", "cell_alone", g.node("Equal", "is_cell", "cell_numbers", "cell"), g.node("Not", "none_passes", "some_pass"))
    chosen = g.node("Cast", "chosen", g.node("Or", "shown", "passing", alone), to=TensorProto.INT32)
    starts = g.node("GatherElements", "run_starts", chosen, g.constant("run_cells", cell.astype(np.int64)))
    steps = g.node("Concat", "run_steps", starts, g.node("Neg", "run_stops", starts), axis=0)
    blank = g.constant("blank", np.zeros((rows + 1) * columns, dtype=np.int32))
    index = g.constant("run_ends", ends.astype(np.int64))
    painted = g.node("ScatterElements", "painted_flat", blank, index, steps, axis=0, reduction="add")
    painted = g.node("Reshape", "painted", painted, g.whole("painted_shape", rows + 1, columns))
    cover = g.node("CumSum", "cover", painted, "down")
    cover = g.node("Slice", "cover_rows", cover, g.whole("first_row", 0), g.whole("stop_row", rows), "first_axis")
    mask = g.node("Cast", "mask", g.node("Greater", "covered", cover, "zero"), to=TensorProto.UINT8)
    height, width = scene.camera.shape
    border = g.whole("border", window.top, window.left, height - window.bottom, width - window.right)
    g.node("Pad", "filtered", g.node("Mul", "filtered_crop", crop, mask), border)

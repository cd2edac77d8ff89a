"""What the graphs of both kinds of bank have in common: from the entries that pass to support, mismatch, cell and hulls.

Of operators that do the same, those stand here that onnxruntime is quick with: GatherElements looks up five times as fast as Gather, and a
product of bytes adds up faster than ReduceSum. Where a cell's entries fill several rows, what the rows give is gathered by cell and
reduced again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from build_model.filter_tables import BankTables
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


def window_of_frame(g: GraphWriter, tables: BankTables) -> str:
    """The frame within the window."""
    window = tables.window
    g.whole("rows_and_columns", 0, 1)
    first, stop = g.whole("window_first", window.top, window.left), g.whole("window_stop", window.bottom, window.right)
    return g.node("Slice", "crop", FRAME, first, stop, "rows_and_columns")


def witnesses(g: GraphWriter, crop: str, tolerance: int) -> str:
    """The window's part of the frame dilated by a tolerance, px, of 1 or more."""
    g.whole("image_axes", 0, 1)
    image = g.node("Unsqueeze", "crop_image", crop, "image_axes")
    dilated = g.node("MaxPool", "dilated_image", image, kernel_shape=[2 * tolerance + 1] * 2, pads=[tolerance] * 4, strides=[1, 1])
    return g.node("Squeeze", "witnesses", dilated, "image_axes")


def decide(g: GraphWriter, scene: Scene, tables: BankTables, missed: str, extra: str) -> None:
    """support, mismatch, cell and the hulls; `passing` (cells,) bool stays for what follows."""
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


def _support(g: GraphWriter, tables: BankTables, passes: str) -> None:
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


def _extreme(g: GraphWriter, tables: BankTables, reduction: str, name: str, by_entry: str) -> str:
    """The least or the greatest over each cell's entries, (rows, width) to (cells,)."""
    rows = tables.rows_of_cell
    if len(rows) == 1:
        return g.node(reduction, name, by_entry, "last_axis", keepdims=0)
    by_row = g.node(reduction, f"{name}_by_row", by_entry, "last_axis", keepdims=0)
    gathered = g.node("GatherElements", f"{name}_gathered", by_row, "rows_of_cell")
    by_cell = g.node("Reshape", f"{name}_by_cell", gathered, "rows_and_cells")
    return g.node(reduction, name, by_cell, "first_axis", keepdims=0)


def _hull(g: GraphWriter, scene: Scene, tables: BankTables, side: str, cells: NDArray, remove: str, reduction: str) -> None:
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


def shown_cells(g: GraphWriter, tables: BankTables) -> str:
    """The cells whose S is shown in the filtered frame, (cells,): those that pass, or `cell` where none does."""
    g.constant("cell_numbers", np.arange(len(tables.cells), dtype=np.int64))
    alone = g.node("And", "cell_alone", g.node("Equal", "is_cell", "cell_numbers", "cell"), g.node("Not", "none_passes", "some_pass"))
    return g.node("Or", "shown", "passing", alone)


def framed(g: GraphWriter, scene: Scene, tables: BankTables, kept: str) -> str:
    """filtered: what is kept of the window, in a frame that is dark elsewhere."""
    window, (height, width) = tables.window, scene.camera.shape
    return g.node("Pad", "filtered", kept, g.whole("border", window.top, window.left, height - window.bottom, width - window.right))


def finished(g: GraphWriter, scene: Scene, tables: BankTables) -> onnx.GraphProto:
    """The graph of all nodes, from `frame` and the two budgets to every output but `network_state` (table in `models/README.md`)."""
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

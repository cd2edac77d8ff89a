"""NN_F as a static ONNX graph of standard operators, without control flow.

Markings are steep, so a mask is a few vertical runs (`build_model.pixel_mask`): with the sums of the frame down its columns, a run is
counted by two look-ups, and a mask's score is the same affine map of the frame as the matrix product it replaces, at a fraction of
its weights. GatherElements is the look-up, five times as fast as Gather in onnxruntime; a product with a row of 1 and -1 adds up faster
than ReduceSum. The union of the passing cells' S is painted by the transpose of that map: 1 and -1 at the ends of the runs, summed
down the columns.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from build_model.filter_network import FilterTables
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
    crop, sums = _column_sums(g, scene, tables)
    missed, extra = _scores(g, tables, _lit(g, tables, sums))
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


def _column_sums(g: GraphWriter, scene: Scene, tables: FilterTables) -> tuple[str, str]:
    """The frame within the window (int32), and the flat sums down its columns, those of the dilated frame behind, if there is one."""
    window, tolerance = tables.window, scene.tolerance.line_px
    g.whole("rows_and_columns", 0, 1)
    first, stop = g.whole("window_first", window.top, window.left), g.whole("window_stop", window.bottom, window.right)
    g.whole("row_of_zeros", 1, 0, 0, 0)
    g.constant("down", np.array(0, dtype=np.int64))
    g.whole("flat", -1)
    crop = g.node("Slice", "crop", "frame", first, stop, "rows_and_columns")
    counted = g.node("Cast", "counted", crop, to=TensorProto.INT32)
    sums = _sums(g, "frame", tables, counted)
    if tolerance == 0:
        return counted, sums
    g.whole("image_axes", 0, 1)
    image = g.node("Unsqueeze", "crop_image", crop, "image_axes")
    dilated = g.node("MaxPool", "dilated_image", image, kernel_shape=[2 * tolerance + 1] * 2, pads=[tolerance] * 4, strides=[1, 1])
    witnesses = g.node("Cast", "witnesses", g.node("Squeeze", "dilated", dilated, "image_axes"), to=TensorProto.INT32)
    return counted, g.node("Concat", "all_sums", sums, _sums(g, "witness", tables, witnesses), axis=0)


def _sums(g: GraphWriter, name: str, tables: FilterTables, pixels: str) -> str:
    """Flat sums down the columns, under a row of zeros; the right half, mirrored, is first added to the left one where masks are."""
    if tables.runs.folded:
        rows, columns = tables.window.shape
        middle = tables.runs.columns
        mirrored = np.tile(np.arange(columns - 1, middle - 1, -1, dtype=np.int32), (rows, 1))
        left = g.node(
            "Slice", f"{name}_left", pixels, g.whole(f"{name}_first", 0), g.whole(f"{name}_middle", middle), g.whole(f"{name}_axis", 1)
        )
        right = g.node(
            "GatherElements", f"{name}_right", pixels, g.constant(f"{name}_mirrored", mirrored), axis=1
        )  # a Slice by steps of -1 is slower
        pixels = g.node("Add", f"{name}_folded", left, right)
    padded = g.node("Pad", f"{name}_padded", pixels, "row_of_zeros")
    return g.node("Reshape", f"{name}_sums", g.node("CumSum", f"{name}_column_sums", padded, "down"), "flat")


def _lit(g: GraphWriter, tables: FilterTables, sums: str) -> str:
    """Lit pixels of every mask, flat, in the order of the run table."""
    total, masks = "", tables.runs.blocks[0].shape[2]
    for number, block in enumerate(tables.runs.blocks):
        _, runs, reached = block.shape
        looked_up = g.node("GatherElements", f"looked_up_{number}", sums, g.constant(f"runs_{number}", block.ravel()))
        ends = g.node("Reshape", f"run_ends_{number}", looked_up, g.whole(f"run_layout_{number}", 2 * runs, reached))
        signs = g.constant(f"stop_minus_start_{number}", np.repeat(np.array([[1, -1]], dtype=np.int32), runs, axis=1))
        lit = g.node("MatMul", f"lit_{number}", signs, ends)
        if number:
            wide = g.node("Pad", f"lit_wide_{number}", lit, g.whole(f"masks_beyond_{number}", 0, 0, 0, masks - reached))
            lit = g.node("Add", f"lit_so_far_{number}", total, wide)
        total = lit
    return g.node("Reshape", "lit", total, "flat")


def _scores(g: GraphWriter, tables: FilterTables, lit: str) -> tuple[str, str]:
    """missed = |K| - lit K (among witnesses) and extra = lit S - lit O of every entry, (cells, entries)."""
    g.whole("first_axis", 0)
    shapes = {"spatial": g.whole("by_cell", len(tables.cells), 1)}
    shapes |= dict.fromkeys(("must_light", "may_light"), g.whole("by_entry", len(tables.cells), tables.entries))
    counts = {}
    for name, shape in shapes.items():
        place = g.constant(f"{name}_place", getattr(tables.runs, name).ravel())
        counts[name] = g.node("Reshape", f"{name}_lit", g.node("GatherElements", f"{name}_lit_flat", lit, place), shape)
    missed = g.node("Sub", "missed", g.constant("must_light_size", tables.must_light_size), counts["must_light"])
    return missed, g.node("Sub", "extra", counts["spatial"], counts["may_light"])


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
    nothing, infinite = g.constant("no_distance", np.array(0, dtype=np.float32)), g.constant("infinite", np.array(np.inf, dtype=np.float32))
    g.node("Where", "removed_by", passes, nothing, infinite)
    _hull(g, "lower", tables.state_lower, float32_below(tables.cells.lower), "Add", "ReduceMin")
    _hull(g, "upper", tables.state_upper, float32_above(tables.cells.upper), "Sub", "ReduceMax")


def _hull(g: GraphWriter, side: str, states: NDArray, cells: NDArray, remove: str, extreme: str) -> None:
    """cell_lower or cell_upper: the extreme over the passing entries, the others moved out of its way to infinity.

    The cell's own side where none passes.
    """
    by_axis = g.constant(f"state_{side}", states.transpose(2, 0, 1))
    candidates = g.node(remove, f"{side}_candidates", by_axis, "removed_by")
    hull = g.node(extreme, f"{side}_hull", candidates, g.whole(f"{side}_axis", 2), keepdims=0)
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
    kept = g.node("Cast", "filtered_crop", g.node("Min", "covered", crop, cover), to=TensorProto.UINT8)
    height, width = scene.camera.shape
    g.node("Pad", "filtered", kept, g.whole("border", window.top, window.left, height - window.bottom, width - window.right))

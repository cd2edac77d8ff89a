"""The graph of a model file, compared with the one that NN_F's tables demand, and NN_F's tables read back from it.

The tables (masks as look-ups, boxes, sizes) are read from the file's own initialisers. From them the expected NN_F is written anew and
compared node by node and constant by constant, so that what is proved of the tables holds for the graph. NN_e is not certified: its
nodes may compute what they like, but write nothing that a certificate reads.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from build_model.bank_graph import BIT
from build_model.filter_graph import filter_graph
from build_model.filter_tables import BankTables, FilterTables, RunTable, SpatialRuns, WindowTable, WindowTables
from build_model.partition import Partition
from build_model.verify.counterexample import demand
from build_model.window import Window
from runtime.model.format import IR_VERSION, NETWORK_OUTPUT, NETWORK_PREFIX, OPSET, SIDES
from runtime.scene import STATE_NAMES, Scene, WindowedBank

Part = onnx.NodeProto | onnx.ValueInfoProto
CONTROL_FLOW = ("If", "Loop", "Scan")


class _Constants:
    """The graph's initialisers, read with the type and shape that they must have."""

    def __init__(self, graph: onnx.GraphProto) -> None:
        self.tensors = {tensor.name: tensor for tensor in graph.initializer}

    def __contains__(self, name: str) -> bool:
        return name in self.tensors

    def read(self, name: str, dtype: type, *shape: int) -> NDArray:
        """The constant; -1 in `shape` stands for any size. Raises `Refuted` if it is missing or another."""
        demand(name in self.tensors, f"graph: the constant {name!r} is missing")
        demand(self.tensors[name].data_location != TensorProto.EXTERNAL, f"graph: the constant {name!r} is kept in another file")
        values = numpy_helper.to_array(self.tensors[name])
        fits = values.ndim == len(shape) and all(want in (-1, found) for want, found in zip(shape, values.shape, strict=True))
        demand(fits and values.dtype == dtype, f"graph: the constant {name!r} is {values.dtype} {list(values.shape)}")
        return values


def read_tables(graph: onnx.GraphProto, cells: Partition) -> FilterTables | WindowTables:
    """NN_F's tables from the initialisers. Raises `Refuted` if one is missing, or not of a shape that fits the others."""
    constants = _Constants(graph)
    row_cell = constants.read("row_cell", np.int32, -1)
    ascending = bool((np.diff(row_cell) >= 0).all()) and np.array_equal(np.unique(row_cell), np.arange(len(cells)))
    demand(ascending, "graph: row_cell does not number the cells from 0 in their order")
    size = constants.read("must_light_size", np.int32, len(row_cell), -1)
    rows, width = size.shape
    demand(width > 0, "graph: the bank has no entry")
    (top, left), (bottom, right) = (constants.read(name, np.int64, 2).tolist() for name in ("window_first", "window_stop"))
    window = Window(top, bottom, left, right)
    lower, upper = (
        np.stack([constants.read(f"{name}_{side}", np.float32, rows, width) for name in STATE_NAMES], axis=-1) for side in SIDES
    )
    line_lower, line_upper = (constants.read(f"line_{side}", np.float64, rows, width, 4) for side in SIDES)
    bank = {
        "window": window,
        "cells": cells,
        "cell_lower": np.nextafter(cells.lower.astype(np.float32), np.float32(-np.inf)),
        "cell_upper": np.nextafter(cells.upper.astype(np.float32), np.float32(np.inf)),
        "row_cell": row_cell,
        "must_light_size": size,
        "state_lower": lower,
        "state_upper": upper,
        "line_lower": line_lower,
        "line_upper": line_upper,
        "reference_row": constants.read("reference_row", np.float64, rows, width),
    }
    if "gate_size" in constants:
        return WindowTables(**bank, windows=_read_windows(constants, window, len(cells), (rows, width)))
    runs = _read_runs(constants, window, len(cells), (rows, width))
    return FilterTables(**bank, runs=runs, spatial_runs=_read_painted(constants, len(cells)))


def _read_painted(constants: _Constants, cells: int) -> SpatialRuns:
    """S of all cells, as it is painted."""
    painted = SpatialRuns(*(constants.read(f"spatial_run_{name}", np.int32, -1) for name in ("cell", "index", "step")))
    same = painted.cell.shape == painted.index.shape == painted.step.shape
    known = bool(((painted.cell >= 0) & (painted.cell < cells)).all())
    demand(same and known, "graph: the constants spatial_run_* do not fit each other or the cells")
    return painted


def _read_windows(constants: _Constants, window: Window, cells: int, shape: tuple[int, int]) -> WindowTable:
    """Windows of groups and of entries, and S of all cells. `shape`: (rows, width)."""
    rows, width = shape
    size = constants.read("gate_size", np.int32, rows, 1)[:, 0]
    start = constants.read("window_start", np.int32, rows, -1)
    demand(start.shape[1] > 0 and start.shape[1] % width == 0, "graph: the constant 'window_start' does not fit the entries")
    columns = constants.read("window_columns", np.uint8, *start.shape)
    windows = start.shape[1] // width
    gate_start, gate_stop = (constants.read(f"gate_{side}", np.int32, rows * windows).reshape(rows, windows) for side in ("start", "stop"))
    first = constants.read("span_first", np.int16, cells, -1, window.bottom - window.top)
    stop = constants.read("span_stop", np.int16, *first.shape)
    by_entry = (rows, width, windows)
    return WindowTable(size, gate_start, gate_stop, start.reshape(by_entry), columns.reshape(by_entry), first, stop)


def _read_runs(constants: _Constants, window: Window, cells: int, shape: tuple[int, int]) -> RunTable:
    """The look-ups of all masks, block by block, and the place of every mask. `shape`: (rows, width)."""
    folded, across = "fold" in constants, window.right - window.left
    columns = constants.read("fold", BIT, across, -1).shape[1] if folded else across
    demand(not folded or 2 * columns == across, "graph: the frame is not folded along the window's middle")
    blocks = []
    while (name := f"runs_{len(blocks)}") in constants:
        sides, masks = constants.read(f"run_layout_{len(blocks)}", np.int64, 2).tolist()
        runs = constants.read(name, np.int32, -1)
        fits = sides > 0 and sides % 2 == 0 and masks > 0 and runs.size == sides * masks
        demand(fits, f"graph: the constant {name!r} does not fit its layout")
        blocks.append(runs.reshape(2, sides // 2, masks))
    demand(len(blocks) > 0, "graph: the constant 'runs_0' is missing")
    masks = blocks[0].shape[2]
    demand(all(block.shape[2] <= masks for block in blocks), "graph: a later block of runs reaches more masks than the first")
    places = []
    for name, count in (("spatial", cells), ("must_light", math.prod(shape)), ("may_light", math.prod(shape))):
        place = constants.read(f"{name}_place", np.int32, count)
        demand(bool(((place >= 0) & (place < masks)).all()), f"graph: {name}_place points at no mask")
        places.append(place)
    return RunTable(tuple(blocks), columns, folded, places[0], places[1].reshape(shape), places[2].reshape(shape))


def check_graph(model: onnx.ModelProto, scene: Scene, tables: BankTables) -> None:
    """The file's graph is the NN_F of these tables, followed by an NN_e that reads `filtered` and writes `network_state` alone.

    Raises `Refuted` with the first node, constant, input or output that differs.
    """
    window, (height, width) = tables.window, scene.camera.shape
    inside = 0 <= window.top < window.bottom <= height and 0 <= window.left < window.right <= width
    demand(inside, f"graph: the window {window} does not lie in the frame")
    windowed = isinstance(scene.bank, WindowedBank)
    demand(windowed == isinstance(tables, WindowTables), "graph: its bank is not of the kind that the scene asks for")
    graph, expected = model.graph, filter_graph(scene, tables)
    _check_file(model)
    _check_each("input", list(graph.input), list(expected.input))
    outputs = [*expected.output, helper.make_tensor_value_info(NETWORK_OUTPUT, TensorProto.FLOAT, [4])]
    _check_each("output", list(graph.output), outputs)
    _check_each("node", list(graph.node[: len(expected.node)]), list(expected.node))
    constants = {tensor.name: tensor for tensor in graph.initializer}
    demand(len(constants) == len(graph.initializer), "graph: two constants have the same name")
    for tensor in expected.initializer:
        same = tensor.name in constants and _same(constants.pop(tensor.name), tensor)
        demand(same, f"graph: the constant {tensor.name!r} is not what the tables and the scene demand")
    _check_network(list(graph.node[len(expected.node) :]), constants)
    written = Counter([value.name for value in graph.input] + [name for node in graph.node for name in node.output if name])
    named = Counter(set(constants) | {tensor.name for tensor in expected.initializer} - {value.name for value in graph.input})
    twice = sorted(name for name, count in (written + named).items() if count > 1)
    demand(not twice, f"graph: {twice[:1]} is written twice")


def _check_file(model: onnx.ModelProto) -> None:
    opsets = [(opset.domain, opset.version) for opset in model.opset_import]
    demand(opsets == [("", OPSET)], f"graph: operator sets {opsets}, not the standard one, version {OPSET}")
    demand(model.ir_version == IR_VERSION, f"graph: IR version {model.ir_version}, not {IR_VERSION}")
    demand(len(model.functions) == 0, "graph: the file defines functions")
    graph = model.graph
    extras = [*graph.sparse_initializer, *graph.quantization_annotation, *graph.value_info]
    demand(not extras, "graph: it has sparse constants, annotations or stated shapes")


def _same(found: onnx.TensorProto, expected: onnx.TensorProto) -> bool:
    """Type, shape and every bit of two tensors."""
    return found.SerializeToString(deterministic=True) == expected.SerializeToString(deterministic=True)


def _check_each(kind: str, found: Sequence[Part], expected: Sequence[Part]) -> None:
    demand(len(found) == len(expected), f"graph: {len(found)} {kind}s where {len(expected)} are expected")
    for place, (one, other) in enumerate(zip(found, expected, strict=True)):
        same = one.SerializeToString(deterministic=True) == other.SerializeToString(deterministic=True)
        demand(same, f"graph: {kind} {place} ({one.name!r}) is not the expected {other.name!r}")


def _check_network(nodes: list[onnx.NodeProto], constants: dict[str, onnx.TensorProto]) -> None:
    """NN_e's part: filtered -> [1, 1, height, width] -> its own nodes -> network_state (4,)."""
    shapes = {"batch_and_channel": [0, 1], "state_shape": [4]}
    for name, values in shapes.items():
        wanted = numpy_helper.from_array(np.array(values, dtype=np.int64), name)
        demand(name in constants and _same(constants[name], wanted), f"graph: the constant {name!r} is not {values}")
    strange = sorted(name for name in constants if name not in shapes and not name.startswith(NETWORK_PREFIX))
    demand(not strange, f"graph: the constant {strange[:1]} belongs neither to NN_F nor to NN_e")
    head = [helper.make_node("Unsqueeze", ["filtered", "batch_and_channel"], ["filtered_image"], name="filtered_image")]
    casts = len(nodes) > 1 and nodes[1].op_type == "Cast"
    if casts:
        head.append(helper.make_node("Cast", ["filtered_image"], ["filtered_float"], name="filtered_float", to=TensorProto.FLOAT))
    demand(len(nodes) >= len(head) + 2, "graph: NN_e is missing")
    _check_each("node before NN_e", nodes[: len(head)], head)
    feed, tail, own = nodes[len(head)], nodes[-1], nodes[len(head) : -1]
    fed = feed.op_type == "Identity" and list(feed.input) == [head[-1].output[0]]
    demand(fed, f"graph: NN_e is not fed by {head[-1].output[0]!r} alone")
    ends = tail.op_type == "Reshape" and list(tail.output) == [NETWORK_OUTPUT] and list(tail.input)[1:] == ["state_shape"]
    demand(ends and tail.input[0].startswith(NETWORK_PREFIX), f"graph: {NETWORK_OUTPUT!r} is not what NN_e writes")
    for node in own:
        reads = [] if node is feed else [name for name in node.input if name]
        foreign = [name for name in (*reads, *node.output) if name and not name.startswith(NETWORK_PREFIX)]
        demand(not foreign, f"graph: the node {node.name!r} of NN_e reads or writes {foreign[:1]}")
        demand(node.domain == "" and node.op_type not in CONTROL_FLOW, f"graph: the node {node.name!r} is not a standard operator")

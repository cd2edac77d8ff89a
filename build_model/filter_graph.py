"""NN_F as a static ONNX graph of standard operators, without control flow."""

from __future__ import annotations

import onnx

from build_model.filter_tables import BankTables, FilterTables, WindowTables
from build_model.mask_graph import mask_graph
from build_model.window_graph import window_graph
from runtime.scene import Scene


def filter_graph(scene: Scene, tables: BankTables) -> onnx.GraphProto:
    """The graph from `frame` and the two budgets to every output but `network_state` (table in `models/README.md`)."""
    if isinstance(tables, WindowTables):
        return window_graph(scene, tables)
    assert isinstance(tables, FilterTables)
    return mask_graph(scene, tables)

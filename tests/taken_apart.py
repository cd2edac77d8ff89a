"""A model file taken apart, for the mutations that a proof must refute, and a small network to stand for NN_e."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from build_model.assembly import assemble
from build_model.filter_graph import filter_graph
from build_model.filter_tables import BankTables
from build_model.hough_bank import CellBank
from build_model.verify.cell_boxes import cell_boxes
from build_model.verify.model_graph import read_tables
from runtime.model.format import METADATA_KEY, NETWORK_PREFIX, metadata_digest
from runtime.scene import Scene


@dataclass
class Model:
    """A model file taken apart: what a mutation may change."""

    scene: Scene
    banks: list[CellBank]
    proto: onnx.ModelProto
    metadata: dict[str, Any]

    @property
    def constants(self) -> dict[str, onnx.TensorProto]:
        return {tensor.name: tensor for tensor in self.proto.graph.initializer}

    def tables(self) -> Any:
        return read_tables(self.proto.graph, cell_boxes(self.scene))

    def set_constant(self, name: str, values: NDArray) -> None:
        self.constants[name].CopyFrom(numpy_helper.from_array(np.asarray(values, order="C"), name))

    def set_tables(self, tables: BankTables) -> None:
        """NN_F written anew from other tables, as a wrong build would write it."""
        graph = self.proto.graph
        expected = filter_graph(self.scene, tables)
        first = next(place for place, node in enumerate(graph.node) if node.name == "filtered_image")
        nodes = [*expected.node, *graph.node[first:]]
        network = [tensor for tensor in graph.initializer if tensor.name.startswith((NETWORK_PREFIX, "batch_and_", "state_shape"))]
        outputs = [*expected.output, graph.output[-1]]
        del graph.node[:], graph.initializer[:], graph.output[:]
        graph.output.extend(outputs)
        graph.node.extend(nodes)
        graph.initializer.extend([*expected.initializer, *network])
        self.metadata["smallest_must_light"] = tables.smallest_must_light

    def set_bank(self, cell: int, **changes: Any) -> None:
        """The model with another bank for a cell."""
        self.banks[cell] = replace(self.banks[cell], **changes)
        self.set_tables(assemble(self.scene, self.banks))

    def save(self, path: Path) -> Path:
        """Writes the file with its checksums recomputed."""
        graph = self.proto.graph
        self.metadata["graph_sha256"] = hashlib.sha256(graph.SerializeToString(deterministic=True)).hexdigest()
        self.metadata["metadata_sha256"] = metadata_digest(self.metadata)
        helper.set_model_props(self.proto, {METADATA_KEY: json.dumps(self.metadata, sort_keys=True)})
        path.write_bytes(self.proto.SerializeToString(deterministic=True))
        return path


def small_network(scene: Scene, path: Path) -> Path:
    """A user's NN_e: the share of lit pixels, four times."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, *scene.camera.shape])
    state = helper.make_tensor_value_info("state", TensorProto.FLOAT, [1, 4])
    constants = {"axes": np.array([2, 3]), "shape": np.array([1, 1]), "weights": np.ones((1, 4), dtype=np.float32)}
    nodes = [
        helper.make_node("ReduceMean", ["image", "axes"], ["mean"], keepdims=1),
        helper.make_node("Reshape", ["mean", "shape"], ["row"]),
        helper.make_node("MatMul", ["row", "weights"], ["state"]),
    ]
    tensors = [numpy_helper.from_array(values, name) for name, values in constants.items()]
    graph = helper.make_graph(nodes, "share", [image], [state], tensors)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10), path)
    return path

"""An NN_e that answers with the domain's centre whatever it is shown: for a model that certifies and leaves the estimate to others."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from runtime.scene import Scene


def constant_network(scene: Scene) -> onnx.GraphProto:
    """A graph from float32 [1, 1, height, width] to float32 [1, 4], the centre of the scene's domain; nothing is trained."""
    centre = ((scene.domain.lower + scene.domain.upper) / 2).astype(np.float32)
    nodes = [
        helper.make_node("GlobalAveragePool", ["image"], ["mean"], name="mean"),
        helper.make_node("Flatten", ["mean"], ["flat"], name="flat"),
        helper.make_node("Gemm", ["flat", "weights", "centre"], ["state"], name="state"),
    ]
    constants = [numpy_helper.from_array(np.zeros((1, 4), dtype=np.float32), "weights"), numpy_helper.from_array(centre, "centre")]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, *scene.camera.shape])
    state = helper.make_tensor_value_info("state", TensorProto.FLOAT, [1, 4])
    return helper.make_graph(nodes, "constant", [image], [state], constants)

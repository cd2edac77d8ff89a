"""An NN_e that answers NaN whatever it is shown: for a model that certifies and leaves the estimate to the box's centre, or to others."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from runtime.scene import Scene


def constant_network(scene: Scene) -> onnx.GraphProto:
    """A graph from uint8 [1, 1, height, width] to float32 [1, 4], all NaN, which looks at one pixel.

    Nothing is trained. NaN lies in no box, so the box's centre is the estimate.
    """
    nodes = [
        helper.make_node("Slice", ["image", "first", "second", "axes"], ["pixel"], name="pixel"),
        helper.make_node("Flatten", ["pixel"], ["flat"], name="flat"),
        helper.make_node("Cast", ["flat"], ["shade"], name="shade", to=TensorProto.FLOAT),
        helper.make_node("Gemm", ["shade", "weights", "none"], ["state"], name="state"),
    ]
    constants = [numpy_helper.from_array(np.zeros((1, 4), dtype=np.float32), "weights")]
    constants += [numpy_helper.from_array(np.full(4, np.nan, dtype=np.float32), "none")]
    corners = {"first": [0, 0], "second": [1, 1], "axes": [2, 3]}
    constants += [numpy_helper.from_array(np.array(values, dtype=np.int64), name) for name, values in corners.items()]
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, [1, 1, *scene.camera.shape])
    state = helper.make_tensor_value_info("state", TensorProto.FLOAT, [1, 4])
    return helper.make_graph(nodes, "constant", [image], [state], constants)

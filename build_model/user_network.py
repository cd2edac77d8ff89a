"""A user's own NN_e: an ONNX file that is taken into the model if its runtime would take it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnx.shape_inference
import onnx.version_converter
from onnx import TensorProto, helper, numpy_helper

from runtime.errors import one_line
from runtime.model.format import OPSET, ModelError
from runtime.model.onnx_subset import check_graph
from runtime.scene import Scene

CONSTANT_VALUES = {"value": None, "value_float": np.float32, "value_floats": np.float32, "value_int": np.int64, "value_ints": np.int64}
"""How a Constant may hold its value: as a tensor, or as numbers of the type given."""


class EstimatorError(ValueError):
    """A user's network that cannot serve as NN_e."""


def user_network(scene: Scene, path: Path) -> onnx.GraphProto:
    """A user's NN_e, its constants as initialisers of raw bytes, as the runtime wants them.

    Raises `EstimatorError` unless it maps float32 [1, 1, height, width] to float32 [1, 4], with fixed shapes throughout and nothing that
    the runtime would refuse (`runtime.model.model_file`).
    """
    try:
        model = onnx.load(path, load_external_data=False)
        onnx.checker.check_model(model)
        model = onnx.version_converter.convert_version(model, OPSET) if model.opset_import[0].version != OPSET else model
        graph = _with_plain_constants(model.graph)
        shapes = onnx.shape_inference.infer_shapes(
            helper.make_model(graph, opset_imports=model.opset_import), strict_mode=True, data_prop=True
        )
    except OSError as error:
        raise EstimatorError(f"{path}: cannot be read ({error.strerror}); give the path of an ONNX file") from error
    except Exception as error:  # onnx's parser, checker and converter raise classes that share only this one
        reason = one_line(error)
        raise EstimatorError(f"{path}: not a usable ONNX model ({reason:.160})") from error
    inputs = list(graph.input)
    expected = f"one input float32 [1, 1, {scene.camera.height}, {scene.camera.width}] and one output float32 [1, 4]"
    found = f"inputs {[_described(value) for value in inputs]} and outputs {[_described(value) for value in graph.output]}"
    wanted = [f"FLOAT {[1, 1, *scene.camera.shape]}"], [f"FLOAT {[1, 4]}"]
    if ([_described(value) for value in inputs], [_described(value) for value in graph.output]) != wanted:
        raise EstimatorError(f"{path}: found {found}; expected {expected}")
    if any(domain.domain not in ("", "ai.onnx") for domain in model.opset_import) or model.functions:
        raise EstimatorError(f"{path}: found operators or functions of its own; expected standard operators only")
    _check_static(path, shapes.graph)
    try:
        check_graph(bare(graph).SerializeToString())
    except ModelError as error:
        raise EstimatorError(f"{path}: {error}") from error
    return graph


def _with_plain_constants(graph: onnx.GraphProto) -> onnx.GraphProto:
    """The graph with every Constant among the initialisers, these as raw bytes, and none of them an input too."""
    plain = onnx.GraphProto()
    plain.CopyFrom(graph)
    constants = [node for node in plain.node if node.op_type == "Constant" and node.attribute[0].name in CONSTANT_VALUES]
    for node in constants:
        value = helper.get_attribute_value(node.attribute[0])
        dtype = CONSTANT_VALUES[node.attribute[0].name]
        array = numpy_helper.to_array(value) if dtype is None else np.array(value, dtype=dtype)
        plain.initializer.append(numpy_helper.from_array(array, node.output[0]))
        plain.node.remove(node)
    for tensor in plain.initializer:
        tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor), tensor.name))
    given = {tensor.name for tensor in plain.initializer}
    for value in [value for value in plain.input if value.name in given]:
        plain.input.remove(value)
    return plain


def _check_static(path: Path, inferred: onnx.GraphProto) -> None:
    """Raises `EstimatorError` unless every tensor between the nodes has a fixed shape."""
    values = {value.name: value for value in (*inferred.value_info, *inferred.output)}
    for node in inferred.node:
        for name in filter(None, node.output):
            shown = _described(values[name]) if name in values else "of unknown shape"
            dims = values[name].type.tensor_type.shape.dim if name in values else []
            if (
                name not in values
                or not values[name].type.tensor_type.HasField("shape")
                or not all(dim.HasField("dim_value") for dim in dims)
            ):
                raise EstimatorError(
                    f"{path}: found {name!r} ({node.op_type}), {shown}; expected fixed shapes throughout: export it with them"
                )


def _described(value: onnx.ValueInfoProto) -> str:
    tensor = value.type.tensor_type
    dims = [dim.dim_value if dim.HasField("dim_value") else dim.dim_param or "?" for dim in tensor.shape.dim]
    return f"{TensorProto.DataType.Name(tensor.elem_type)} {dims}"


def bare(network: onnx.GraphProto) -> onnx.GraphProto:
    """The graph without notes of how it came about, which name files of the machine that made it."""
    bare = onnx.GraphProto()
    bare.CopyFrom(network)
    for part in (bare, *bare.node, *bare.input, *bare.output, *bare.initializer):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    bare.ClearField("value_info")
    return bare

"""A user's own NN_e: an ONNX file that is taken into the model if its runtime would take it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnx.version_converter
from onnx import TensorProto, helper, numpy_helper

from build_model.constant_network import constant_network
from runtime.errors import one_line
from runtime.model.format import OPSET, ModelError
from runtime.model.onnx_subset import check_graph
from runtime.model.operators.table import OPERATORS, Attribute
from runtime.model.operators.tensor import LARGEST_RANK
from runtime.scene import Scene

CONSTANT_VALUES = {"value": None, "value_float": np.float32, "value_floats": np.float32, "value_int": np.int64, "value_ints": np.int64}
"""How a Constant may hold its value: as a tensor, or as numbers of the type given."""
OLDEST_OPSET = 13
"""Oldest operator set of a user's network: since then what decides a shape is an input, but for the axes of reductions."""
AXES = Attribute(tuple, None, -LARGEST_RANK, LARGEST_RANK - 1)
"""The attribute `axes` of a reduction, in operator sets before 18."""


class EstimatorError(ValueError):
    """A user's network that cannot serve as NN_e."""


NO_ESTIMATOR = "none"
"""In place of a network's file: no NN_e; `network_state` is NaN, and the box's centre the estimate."""


def given_network(scene: Scene, estimator: str | Path | None) -> onnx.GraphProto | None:
    """NN_e as a graph where it is not to be trained: the user's, or a constant that stands for none.

    Raises `EstimatorError` for a network that does not fit.
    """
    if estimator is None:
        return None
    return constant_network(scene) if estimator == NO_ESTIMATOR else user_network(scene, Path(estimator))


def user_network(scene: Scene, path: Path) -> onnx.GraphProto:
    """A user's NN_e in the operator set of the model, its constants as initialisers of raw bytes, as the runtime wants them.

    Raises `EstimatorError` unless it maps float32 [1, 1, height, width] to float32 [1, 4], with fixed shapes throughout and nothing that
    the runtime would refuse (`runtime.model.operators`); onnx's own code is given no network that was not checked.
    """
    try:
        model = onnx.load(path, load_external_data=False)
        graph = bare(_with_plain_constants(_converted(model)))
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
    try:
        check_graph(graph.SerializeToString())
    except ModelError as error:
        raise EstimatorError(f"{path}: {error}") from error
    return graph


def _converted(model: onnx.ModelProto) -> onnx.GraphProto:
    """The network in the model's operator set. Raises ValueError, or what onnx raises, for one that cannot be converted."""
    versions = [opset.version for opset in model.opset_import if opset.domain in ("", "ai.onnx")]
    if len(versions) != 1 or len(model.opset_import) != 1 or model.functions:
        raise ValueError("expected standard operators only, of one operator set, and no functions")
    if versions == [OPSET]:
        return model.graph
    if versions[0] < OLDEST_OPSET:
        raise ValueError(f"operator set {versions[0]}; export the network with {OLDEST_OPSET} or a later one")
    plain = helper.make_model(_with_plain_constants(model.graph), opset_imports=model.opset_import, ir_version=model.ir_version)
    for node in plain.graph.node:
        _check_convertible(node)
    onnx.checker.check_model(plain)
    return onnx.version_converter.convert_version(plain, OPSET).graph


def _check_convertible(node: onnx.NodeProto) -> None:
    """Raises ValueError for an operator, or an attribute's value, that no operator set has: onnx's converter may end the process there."""
    if node.op_type not in OPERATORS:
        raise ValueError(f"found the operator {node.op_type}; static, standard operators only are taken")
    known = {"axes": AXES, **OPERATORS[node.op_type].attributes}
    for attribute in node.attribute:
        value = helper.get_attribute_value(attribute)
        value = value.decode() if isinstance(value, bytes) else tuple(value) if isinstance(value, list) else value
        if attribute.name not in known or not known[attribute.name].takes(value):
            raise ValueError(f"found {node.op_type} with {attribute.name} = {value!s:.60}")


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


def _described(value: onnx.ValueInfoProto) -> str:
    tensor = value.type.tensor_type
    dims = [dim.dim_value if dim.HasField("dim_value") else dim.dim_param or "?" for dim in tensor.shape.dim]
    return f"{TensorProto.DataType.Name(tensor.elem_type)} {dims}"


def bare(network: onnx.GraphProto) -> onnx.GraphProto:
    """The graph without its metadata, which name files of the machine that made it."""
    bare = onnx.GraphProto()
    bare.CopyFrom(network)
    for part in (bare, *bare.node, *bare.input, *bare.output, *bare.initializer):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    bare.ClearField("value_info")
    return bare

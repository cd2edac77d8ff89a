"""The operators that a model may use: complete against the ONNX standard, true to onnxruntime, and closed to what would crash it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from fuzz_networks import EXAMPLES, SCENE, Computed, Example, Network, run_network
from onnx import TensorProto, helper, numpy_helper

from build_model.user_network import EstimatorError, user_network
from runtime.model.format import OPSET, ModelError
from runtime.model.onnx_subset import MOST_VALUES, check_graph
from runtime.model.operators.graph import LARGEST_BYTES, MOST_EDGES, MOST_NODES, MOST_TERMS
from runtime.model.operators.table import OPERATORS, REQUIRED

KINDS = {"INT": int, "FLOAT": float, "STRING": str, "INTS": tuple}
AT_ANY_INDEX = ("Gather", "GatherElements", "GatherND", "ScatterElements")
TRAINING_INPUTS = {"Dropout": 1}
"""Inputs of the standard's that are left out at the end: they make a node train, or draw at random."""
TRAINING_OUTPUTS = {"Dropout": 1, "BatchNormalization": 2, "LayerNormalization": 2}


def network_of(example: Example) -> onnx.ModelProto:
    network = Network(np.random.default_rng(1))
    return network.model(network.example(example)[0])


def example_of(operator: str, place: int = 0) -> Example:
    return [example for example in EXAMPLES if example.operator == operator][place]


@pytest.mark.parametrize("name", OPERATORS)
def test_the_table_has_what_the_standard_has(name: str) -> None:
    """Every attribute, its type, default and whether it is required; no more inputs and outputs; no graph among attributes."""
    taken, schema = OPERATORS[name], onnx.defs.get_schema(name, OPSET)
    assert not schema.deprecated
    assert set(taken.attributes) == set(schema.attributes)
    for label, attribute in schema.attributes.items():
        own = taken.attributes[label]
        assert own.kind is KINDS[attribute.type.name]
        assert (own.default is REQUIRED) == attribute.required
        if attribute.default_value.name:
            default = helper.get_attribute_value(attribute.default_value)
            assert (
                own.default == pytest.approx(default) if own.kind is float else own.default in (default, getattr(default, "decode", str)())
            )
    many = 2**10
    assert taken.inputs == (schema.min_input, min(schema.max_input - TRAINING_INPUTS.get(name, 0), many))
    assert taken.outputs == (schema.min_output, min(schema.max_output - TRAINING_OUTPUTS.get(name, 0), many))


def test_no_operator_makes_a_tensor_from_a_number_or_branches() -> None:
    makers = {"Constant", "ConstantOfShape", "EyeLike", "Expand", "Tile", "OneHot", "Range", "Resize", "RandomNormal", "Shape"}
    assert not set(OPERATORS) & (makers | {"If", "Loop", "Scan", "NonZero", "Unique", "Compress"})
    assert {example.operator for example in EXAMPLES} == set(OPERATORS)


@pytest.mark.parametrize("name", OPERATORS)
def test_onnxruntime_gives_what_the_rule_says(tmp_path: Path, name: str) -> None:
    """Type and shape of all that the examples compute; an index out of range is onnxruntime's error."""
    for number, example in enumerate(example for example in EXAMPLES if example.operator == name):
        path = tmp_path / f"{number}.onnx"
        onnx.save(network_of(example), path)
        if name in AT_ANY_INDEX and isinstance(example.inputs[1], Computed):
            with pytest.raises(ModelError, match=r"it fails when it runs .*(out of data bounds|Out of range|invalid index)"):
                run_network(path)
        else:
            run_network(path)


def computed(example: Example, place: int, dtype: str) -> Example:
    """The example with an input that is computed, with another type for all that are."""
    inputs = [replace(given, dtype=dtype) if isinstance(given, Computed) else given for given in example.inputs]
    inputs[place] = Computed(dtype, np.shape(example.inputs[place]) if not isinstance(inputs[place], Computed) else inputs[place].shape)
    return replace(example, inputs=tuple(inputs))


def constant(operator: str, *numbers: int, dtype: type = np.int32, **attributes: int) -> Example:
    """Integers over, or modulo, a constant."""
    kind = np.dtype(dtype).str
    return Example(operator, (Computed(kind, (2, len(numbers))), np.array(numbers, dtype=dtype)), 1, attributes)


def stating(operator: str, **attributes: Any) -> Example:
    example = example_of(operator)
    return replace(example, attributes={**example.attributes, **attributes})


def without(operator: str, attribute: str) -> Example:
    example = example_of(operator)
    return replace(example, attributes={name: value for name, value in example.attributes.items() if name != attribute})


def given(operator: str, place: int, value: Any) -> Example:
    example = example_of(operator)
    return replace(example, inputs=(*example.inputs[:place], value, *example.inputs[place + 1 :]))


FLOATS = Computed("<f4", (4, 6))
REFUSED: dict[str, tuple[Example, str]] = {
    # what ends a process that gives it to onnxruntime
    "blocks of 2^32": (stating("DepthToSpace", blocksize=2**32), "DepthToSpace with the attribute blocksize = 4294967296"),
    "blocks of 2^62": (stating("DepthToSpace", blocksize=2**62), "blocksize = 4611686018427387904"),
    "a negative number of batch axes": (stating("GatherND", batch_dims=-1), "batch_dims = -1"),
    "batch axes of unlike sizes": (given("GatherND", 1, Computed("<i8", (3, 1))), r"of shapes \(2, 3, 4\), \(3, 1\) with 1 axes in common"),
    "a sum of nothing": (given("Sum", 1, None), "Sum without its input 1"),
    "a maximum of nothing": (given("Max", 1, None), "Max without its input 1"),
    "a zero point left out": (given("ConvInteger", 2, None), "ConvInteger without its input 2"),
    "a type of a norm's sums": (stating("LayerNormalization", stash_type=2**62), "stash_type = 4611686018427387904"),
    "more parts than are said": (replace(example_of("Split"), outputs=3), r"Split of 4 into \[1, 3\] with 3 outputs"),
    "integers over what is computed": (computed(example_of("Div", 1), 1, "<i4"), "Div of integers by what is computed"),
    "long integers over what is computed": (computed(example_of("Div", 1), 1, "<i8"), "Div of integers by what is computed"),
    "integers modulo what is computed": (computed(example_of("Mod", 1), 1, "<i8"), "Mod of integers by what is computed"),
    "integers over 0": (constant("Div", 3, 0), "Div of integers by 0 or -1"),
    "integers over -1": (constant("Div", 3, -1), "Div of integers by 0 or -1"),
    "long integers modulo -1": (constant("Mod", -1, 2, dtype=np.int64), "Mod of integers by 0 or -1"),
    "integers modulo 0, as floats are": (constant("Mod", 0, 2, fmod=1), "Mod of integers by 0 or -1"),
    "bytes over 0": (constant("Div", 0, dtype=np.uint8), "Div of integers by 0 or -1"),
    # attributes
    "an unknown attribute": (stating("Relu", alpha=1.0), "Relu with the attribute alpha = 1.0"),
    "an attribute of another type": (stating("Softmax", axis=1.0), "Softmax with the attribute axis = 1.0"),
    "a number in place of a list": (stating("Conv", strides=1), "strides = 1"),
    "a missing attribute": (without("Concat", "axis"), "Concat without its attribute axis"),
    "a missing type": (without("Cast", "to"), "Cast without its attribute to"),
    "an unknown type": (stating("Cast", to=8), "Cast to the type 8"),
    "an unknown text": (stating("Pad", mode="circle"), "Pad with the attribute mode = circle"),
    "an endless list": (stating("Conv", strides=[1] * 100), "Conv with the attribute strides"),
    "a step of 0": (stating("MaxPool", strides=[0, 1]), r"MaxPool with the attribute strides = \(0, 1\)"),
    "a kernel of 0": (stating("AveragePool", kernel_shape=[0, 1]), "kernel_shape"),
    "a negative padding": (stating("Conv", pads=[-1, 0, 0, 0]), "pads"),
    "a padding as large as the kernel": (stating("MaxPool", pads=[3, 0, 0, 0]), "MaxPool by a kernel of 3 every 1 over 6 with pads 3, 0"),
    "a kernel larger than the image": (stating("AveragePool", dilations=[4, 1]), "by a kernel of 3 every 4 over 6"),
    "no groups": (stating("Conv", group=0), "group = 0"),
    "groups that do not fit": (stating("Conv", group=3), "in 3 groups"),
    "an axis too many": (stating("Softmax", axis=4), r"Softmax along axes \[4\] of 4"),
    "an axis twice": (given("ReduceSum", 1, np.array([1, -1])), r"ReduceSum along axes \[1, -1\] of 2"),
    "an axis that is computed": (given("CumSum", 1, Computed("<i8", ())), "CumSum with a shape that is computed"),
    "an order that is none": (stating("Transpose", perm=[0, 1, 1, 3]), "Transpose by"),
    "training": (stating("BatchNormalization", training_mode=1), "training_mode = 1"),
    "floats modulo as integers are": (stating("Mod", fmod=0), "Mod of floats with fmod 0"),
    "a norm of no kind": (stating("LpNormalization", p=3), "p = 3"),
    "an even number of channels": (stating("LRN", size=2), "LRN of 2 channels"),
    "endless numbers": (stating("Elu", alpha=float("inf")), "Elu with the attribute alpha = inf"),
    # inputs
    "too many inputs": (replace(example_of("Relu"), inputs=(FLOATS, FLOATS)), "Relu with 2 inputs; it takes 1 to 1"),
    "too many outputs": (replace(example_of("Relu"), outputs=2), "Relu with 2 outputs"),
    "unlike types": (given("Add", 1, Computed("<i4", (6,))), "Add of types float32, int32"),
    "unlike shapes": (given("Add", 1, Computed("<f4", (5,))), r"Add of shapes \(4, 6\), \(5,\)"),
    "booleans added": (computed(example_of("Add"), 0, "|b1"), "Add of type bool"),
    "a mean of integers": (computed(example_of("Mean"), 0, "<i4"), "Mean of type int32"),
    "an empty constant": (given("Add", 1, np.zeros((0,), dtype=np.float32)), "Add of an empty tensor"),
    "a slice without elements": (given("Slice", 2, np.array([5, 4])), "Slice give float32"),
    "a step of 0 in a slice": (given("Slice", 4, np.array([0, 1])), r"by \[0, 1\]"),
    "a shape of another size": (given("Reshape", 1, np.array([5, -1])), "Reshape of shape"),
    "a shape of two unknowns": (given("Reshape", 1, np.array([-1, -1])), "Reshape of shape"),
    "a mirror farther than the tensor": (replace(example_of("Pad", 1), inputs=(FLOATS, np.array([4, 0, 0, 0]))), "Pad of 4 by 4 and 0"),
    "more axes than are taken": (given("Unsqueeze", 1, np.arange(2, 9)), "Unsqueeze give float32"),
    "matrices that do not fit": (given("MatMul", 1, Computed("<f4", (5, 3))), "MatMul of shapes"),
    "indices that are floats": (given("Gather", 1, Computed("<f4", (2,))), "Gather at indices of type float32"),
}


@pytest.fixture
def no_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """onnxruntime must not see the file, nor onnx's own code."""

    def seen(*_arguments: object, **_options: object) -> None:
        pytest.fail("a network that is not taken was run, checked or converted")

    monkeypatch.setattr(onnxruntime, "InferenceSession", seen)
    for owner, name in ((onnx.checker, "check_model"), (onnx.version_converter, "convert_version")):
        monkeypatch.setattr(owner, name, seen)


@pytest.mark.usefixtures("no_session")
@pytest.mark.parametrize("case", REFUSED)
def test_a_node_that_does_not_fit_is_refused_by_the_runtime_and_by_the_export(tmp_path: Path, case: str) -> None:
    """With one message, before native code sees it."""
    example, message = REFUSED[case]
    network = network_of(example)
    with pytest.raises(ModelError, match=message) as caught:
        check_graph(network.graph.SerializeToString())
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300
    path = tmp_path / "user.onnx"
    onnx.save(network, path)
    with pytest.raises(EstimatorError, match=message) as caught:
        user_network(SCENE, path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.usefixtures("no_session")
@pytest.mark.parametrize("opset", [12, 17, 21])
def test_a_network_of_another_operator_set_is_looked_at_before_it_is_converted(tmp_path: Path, opset: int) -> None:
    """onnx's converter infers shapes, and ends the process where an axis or a type is out of range."""
    path = tmp_path / "user.onnx"
    for name in ("a negative number of batch axes", "a type of a norm's sums", "an unknown attribute", "an endless list"):
        network = network_of(REFUSED[name][0])
        network.opset_import[0].version = opset
        onnx.save(network, path)
        with pytest.raises(
            EstimatorError, match="operator set 12; export the network with 13" if opset == 12 else "not a usable ONNX model"
        ):
            user_network(SCENE, path)


def chain(operators: list[str], *, reads: int = 1) -> onnx.ModelProto:
    """Nodes in a row, each reading the one before it so many times."""
    network, name = Network(np.random.default_rng(0)), "image"
    for operator in operators:
        (name,) = network.node(operator, [name] * reads)
    return network.model(name)


@pytest.mark.usefixtures("no_session")
def test_a_graph_is_bounded_by_what_loads_soon() -> None:
    """Nodes, edges, constants, inputs, bytes and products; the limits themselves are taken."""
    room = MOST_NODES - 3
    assert len(check_graph(chain(["Relu"] * room).graph.SerializeToString())) > room
    many = [numpy_helper.from_array(np.zeros(1, dtype=np.float32), f"constant {number}") for number in range(MOST_VALUES)]
    crowded, wide, doubled = chain(["Relu"]), chain(["Sum"] * 17, reads=1000), chain(["Add"] * 20, reads=2)
    crowded.graph.initializer.extend(many)
    doubled.graph.node[0].CopyFrom(helper.make_node("Concat", ["image"] * 1000, ["t0_0"], axis=3))
    for number in range(1, 6):
        doubled.graph.node[number].CopyFrom(helper.make_node("Concat", [f"t{number - 1}_0"] * 10, [f"t{number}_0"], axis=3))
    inputs = chain(["Relu"])
    inputs.graph.input.extend(helper.make_tensor_value_info(f"input {number}", TensorProto.FLOAT, [1]) for number in range(MOST_VALUES))
    heavy = Network(np.random.default_rng(0))
    square = [heavy.node("MatMul", [heavy.computed(Computed("<f4", (8192, 1))), heavy.computed(Computed("<f4", (1, 8192)))])[0]]
    square += heavy.node("MatMul", [square[0], square[0]])
    for graph, message in (
        (chain(["Relu"] * 20_000), "a graph with 20003 fields node; at most 2048"),
        (chain(["Add"] * 20_000, reads=2), "a graph with 20003 fields node; at most 2048"),
        (wide, f"found nodes with 17024 inputs and outputs; at most {MOST_EDGES}"),
        (crowded, f"{MOST_VALUES + 1} fields initializer; at most {MOST_VALUES}"),
        (inputs, f"{MOST_VALUES + 1} fields input; at most {MOST_VALUES}"),
        (doubled, f"bytes of tensors up to Concat; at most {LARGEST_BYTES}"),
        (heavy.model(square[-1]), f"terms of sums up to MatMul; at most {MOST_TERMS}"),
    ):
        with pytest.raises(ModelError, match=message):
            check_graph(graph.graph.SerializeToString())


@pytest.mark.parametrize("version", [13, 17, OPSET])
def test_a_deep_network_is_taken(tmp_path: Path, version: int) -> None:
    """As deep as any: 200 residual blocks of a convolution, its norm and an activation."""
    network = Network(np.random.default_rng(0))
    weights, channels = network.constant(np.full((1, 1, 3, 3), 0.1, dtype=np.float32)), network.constant(np.ones(1, dtype=np.float32))
    name = "image"
    for _ in range(200):
        (inner,) = network.node("Conv", [name, weights, channels], kernel_shape=[3, 3], pads=[1, 1, 1, 1])
        (inner,) = network.node("BatchNormalization", [inner, *[channels] * 4])
        (name,) = network.node("Add", [name, network.node("Relu", [inner])[0]])
    model = network.model(name)
    if version < 18:  # the reduction's axes, of which it has none, were an attribute
        model.opset_import[0].version = version
    onnx.save(model, tmp_path / "deep.onnx")
    run_network(tmp_path / "deep.onnx")


@pytest.mark.usefixtures("no_session")
def test_nodes_out_of_order_and_names_twice_are_refused() -> None:
    """What a graph says of a name is so wherever the name is read."""
    reversed_order, twice, again, shadowed, stated = (chain(["Relu", "Abs"]) for _ in range(5))
    reversed_order.graph.node.insert(0, reversed_order.graph.node.pop(1))
    twice.graph.node[1].output[0] = twice.graph.node[0].output[0]
    again.graph.input.append(again.graph.input[0])
    shadowed.graph.initializer.append(numpy_helper.from_array(np.zeros((2, 2), dtype=np.float32), "image"))
    stated.graph.output[0].type.tensor_type.elem_type = TensorProto.DOUBLE
    for graph, message in (
        (reversed_order, "found Abs before t0_0, which it reads"),
        (twice, "found t0_0 written twice, by Abs the second time"),
        (again, "found two inputs image"),
        (shadowed, r"found the input image stated as float32 \[1, 1, 12, 16\] where it is float32 \[2, 2\]"),
        (stated, r"found the output state stated as float64 \[1, 4\] where it is float32 \[1, 4\]"),
    ):
        with pytest.raises(ModelError, match=message):
            check_graph(graph.graph.SerializeToString())


@pytest.mark.usefixtures("no_session")
def test_a_constant_that_a_caller_may_replace_is_none() -> None:
    """An initialiser that is an input too, as the budgets are: neither a shape nor a divisor that is known."""
    for operator, numbers in (("Reshape", np.array([1, 4])), ("Div", np.array([7, 7, 7, 7], dtype=np.int64))):
        network = Network(np.random.default_rng(0))
        data = network.computed(Computed("<i8", (4,)))
        (name,) = network.node(operator, [data, network.constant(numbers)])
        model = network.model(name)
        assert check_graph(model.graph.SerializeToString())
        label = model.graph.node[-4].input[1]
        model.graph.input.append(helper.make_tensor_value_info(label, TensorProto.INT64, [len(numbers)]))
        with pytest.raises(ModelError, match=r"with a shape that is computed|of integers by what is computed"):
            check_graph(model.graph.SerializeToString())

"""The exported graph against its torch reference, and NN_F's integers over optimisation levels, threads and evaluators, ties included."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator
from onnx.reference.op_run import OpRun
from scenes import SCENES, Frame, random_clutter

from build_model.export import build_banks
from build_model.filter_graph import IR_VERSION, OPSET, filter_graph
from build_model.filter_network import NEVER, FilterNetwork, assemble
from build_model.hough_bank import CellBank
from runtime.image import runway_image
from runtime.scene import Scene

ModelOf = Callable[[str], Path]
Outputs = dict[str, NDArray]
INTEGERS = ("cell", "support", "mismatch", "passes", "filtered")
BOUNDS = ("cell_lower", "cell_upper")
REFERENCE = ("cell", "support", "mismatch", "filtered", *BOUNDS)
NAMES = ("paper", "three markings", "cut left", "tolerant", "tolerant, cut left", "one cell")
STANDARD = {
    "Add",
    "And",
    "ArgMax",
    "ArgMin",
    "Cast",
    "Concat",
    "Conv",
    "CumSum",
    "Equal",
    "Flatten",
    "GatherElements",
    "Gemm",
    "Greater",
    "Identity",
    "Less",
    "LessOrEqual",
    "MatMul",
    "MatMulInteger",
    "MaxPool",
    "Mul",
    "Neg",
    "Not",
    "Or",
    "Pad",
    "ReduceMax",
    "ReduceMin",
    "ReduceSum",
    "Relu",
    "Reshape",
    "ScatterElements",
    "Slice",
    "Split",
    "Squeeze",
    "Sub",
    "Transpose",
    "Unsqueeze",
    "Where",
}
"""Operators of the default domain that a model may use; none of them has a graph in it."""


def session(path: Path | bytes, level: onnxruntime.GraphOptimizationLevel | None = None, threads: int = 1) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    options.graph_optimization_level = level or onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def evaluate(model: onnxruntime.InferenceSession, frame: Frame, budgets: tuple[int, int] | None) -> Outputs:
    feed: dict[str, NDArray] = {"frame": frame}
    if budgets is not None:
        feed |= dict(zip(("missed_budget", "extra_budget"), np.array(budgets, dtype=np.int32), strict=True))
        feed = {name: np.asarray(value) for name, value in feed.items()}
    names = [output.name for output in model.get_outputs()]
    return dict(zip(names, model.run(names, feed), strict=True))


def frames_of(scene: Scene) -> list[Frame]:
    """Empty, all lit, single pixels, clean and cluttered runways, a runway with missed pixels, a runway just outside the domain."""
    rng = np.random.default_rng(7)
    shape = scene.camera.shape
    frames = [np.zeros(shape, dtype=np.uint8), np.ones(shape, dtype=np.uint8), random_clutter(rng, shape, 0.5)]
    corner = np.zeros(shape, dtype=np.uint8)
    corner[0, 0] = corner[-1, -1] = 1
    states = rng.uniform(scene.domain.lower, scene.domain.upper, (3, 4))
    for density, state in zip((0.0, 0.02, 0.2), states, strict=True):
        frames.append(runway_image(scene, state) | random_clutter(rng, shape, density))
    outside = (scene.domain.lower + scene.domain.upper) / 2
    outside[0] = scene.domain.upper[0] + 0.01
    missed = runway_image(scene, states[0])
    missed.ravel()[np.flatnonzero(missed)[::6]] = 0
    return [*frames, corner, runway_image(scene, outside), missed]


BUDGETS = (None, (0, -1), (5, -1), (2, 0), (0, 4), (11, 1000))


def budgets_of(scene: Scene, banks: list[CellBank]) -> list[tuple[int, int] | None]:
    weakest = min(int(bank.must_light_sizes.min()) for bank in banks)
    return [pair for pair in BUDGETS if pair is None or pair[0] < weakest or scene is SCENES["paper"]]


@pytest.mark.parametrize("name", NAMES)
def test_onnxruntime_gives_the_torch_networks_outputs(model_of: ModelOf, name: str) -> None:
    """Every integer output and both bounds, equal to the last bit, for every frame and budget; the scene's budgets by default."""
    scene = SCENES[name]
    banks = build_banks(scene)
    network, model = FilterNetwork(scene, banks), session(model_of(name))
    frames = frames_of(scene)
    choices = budgets_of(scene, banks)
    chosen = [*itertools.product(frames[3:5], choices), *((frame, choices[number % len(choices)]) for number, frame in enumerate(frames))]
    for frame, budgets in chosen:
        missed, extra = budgets or (scene.tolerance.missed_budget, scene.tolerance.extra_budget)
        expected = network(torch.from_numpy(frame), missed, extra)
        found = evaluate(model, frame, budgets)
        for output in REFERENCE:
            reference = expected[output].numpy()
            assert found[output].shape == reference.shape
            assert (found[output] == reference).all(), (output, budgets)


@pytest.mark.parametrize(("name", "width"), [("paper", 64), ("paper", 7), ("tolerant, free x", 3), ("one cell", 1)])
def test_rows_of_any_width_give_the_same(monkeypatch: pytest.MonkeyPatch, name: str, width: int) -> None:
    """A cell's entries in several rows: all outputs as the torch network gives them; `passes` cut into rows, padding never among it."""
    monkeypatch.setattr("build_model.filter_network.row_width", lambda _entries: width)
    scene = SCENES[name]
    banks = build_banks(scene)
    network, tables = FilterNetwork(scene, banks), assemble(scene, banks)
    opsets = [onnx.helper.make_opsetid("", OPSET)]
    model = session(onnx.helper.make_model(filter_graph(scene, tables), opset_imports=opsets, ir_version=IR_VERSION).SerializeToString())
    assert tables.must_light_size.shape == (sum(-(-len(bank) // width) for bank in banks), width)
    for frame, budgets in zip(frames_of(scene), itertools.cycle([(0, -1), (2, 0), (1, 30)]), strict=False):
        expected, found = network(torch.from_numpy(frame), *budgets), evaluate(model, frame, budgets)
        for output in REFERENCE:
            assert np.array_equal(found[output], expected[output].numpy()), (output, budgets)
        assert not (found["passes"] & (tables.must_light_size == NEVER)).any()
        assert np.array_equal(np.bincount(tables.row_cell, weights=found["passes"].sum(axis=1)), found["support"])


def test_the_torch_network_is_what_the_definition_says(model_of: ModelOf) -> None:
    """On one cell, with sets of pixels and plain counting: missed, extra, support, mismatch, passes, hull and filtered."""
    scene = SCENES["one cell"]
    (bank,) = build_banks(scene)
    frame = frames_of(scene)[4]
    pixels = {tuple(pixel) for pixel in np.argwhere(frame).tolist()}

    def sets(bits: NDArray) -> list[set[tuple[int, int]]]:
        return [{(row + bank.window.top, column + bank.window.left) for row, column in np.argwhere(mask).tolist()} for mask in bits]

    (spatial,) = sets(bank.spatial.bits(1, bank.window))
    must, may = (sets(runs.bits(len(bank), bank.window)) for runs in (bank.must_light, bank.may_light))
    missed = [len(own - pixels) for own in must]
    extra = [len((pixels & spatial) - own) for own in may]
    found = evaluate(session(model_of("one cell")), frame, (3, -1))
    passes = [count <= 3 for count in missed]
    assert any(passes)
    assert found["passes"].tolist() == [passes]
    assert found["support"].tolist() == [sum(passes)]
    assert found["mismatch"].tolist() == [min(map(sum, zip(missed, extra, strict=True)))]
    assert (found["cell_lower"][0] == bank.state_lower[passes].min(axis=0)).all()
    assert (found["cell_upper"][0] == bank.state_upper[passes].max(axis=0)).all()
    assert {tuple(pixel) for pixel in np.argwhere(found["filtered"]).tolist()} == pixels & spatial


@pytest.mark.parametrize("name", ["paper", "tolerant"])
def test_levels_and_threads_change_no_integer(model_of: ModelOf, name: str) -> None:
    """And `network_state` by no more than float32's rounding of its sums: 1e-4 rad or m is a thousand units in its last place."""
    levels = onnxruntime.GraphOptimizationLevel
    plain = session(model_of(name))
    others = [session(model_of(name), level, threads) for level in (levels.ORT_DISABLE_ALL, levels.ORT_ENABLE_BASIC) for threads in (1, 2)]
    others.append(session(model_of(name), threads=2))
    for frame in frames_of(SCENES[name]):
        expected = evaluate(plain, frame, (1, -1))
        for other in others:
            found = evaluate(other, frame, (1, -1))
            for output in (*INTEGERS, *BOUNDS):
                assert (found[output] == expected[output]).all(), output
            assert np.abs(found["network_state"] - expected["network_state"]).max() < 1e-4


class GatherElements(OpRun):
    """In place of onnx's own, which numpy.choose limits to 64 elements where the data have one axis."""

    def _run(self, data: NDArray, indices: NDArray, axis: int = 0) -> tuple[NDArray]:
        return (np.take_along_axis(data, indices, axis),)


def test_onnxs_reference_evaluator_agrees(model_of: ModelOf) -> None:
    """Overriding the budgets as well."""
    path = model_of("one cell")
    reference, model = ReferenceEvaluator(str(path), new_ops=[GatherElements]), session(path)
    names = [output.name for output in model.get_outputs()]
    for frame, budgets in itertools.product(frames_of(SCENES["one cell"])[::3], (None, (4, 2))):
        feed: dict[str, NDArray] = {"frame": frame}
        if budgets is not None:
            feed |= {"missed_budget": np.array(budgets[0], np.int32), "extra_budget": np.array(budgets[1], np.int32)}
        found = dict(zip(names, reference.run(names, feed), strict=True))
        expected = evaluate(model, frame, budgets)
        for output in (*INTEGERS, *BOUNDS):
            assert (found[output] == expected[output]).all(), output
        assert np.abs(found["network_state"] - expected["network_state"]).max() < 1e-4


def test_ties_go_to_the_lowest_cell(model_of: ModelOf) -> None:
    """Of many cells with equal support, and, where none has any, of many with equal mismatch."""
    model = session(model_of("free x"))
    shape = SCENES["free x"].camera.shape
    all_lit = evaluate(model, np.ones(shape, dtype=np.uint8), None)
    most = np.flatnonzero(all_lit["support"] == all_lit["support"].max())
    assert len(most) > 1
    assert all_lit["cell"] == most[0]
    empty = evaluate(model, np.zeros(shape, dtype=np.uint8), None)
    least = np.flatnonzero(empty["mismatch"] == empty["mismatch"].min())
    assert len(least) > 1
    assert not empty["support"].any()
    assert empty["cell"] == least[0]


def test_the_default_budgets_are_the_scenes(model_of: ModelOf) -> None:
    for frame in frames_of(SCENES["paper"])[3:]:
        default, given = evaluate(session(model_of("paper")), frame, None), evaluate(session(model_of("paper")), frame, (0, -1))
        for output in INTEGERS:
            assert (default[output] == given[output]).all()


# --- the graph's shape ---


@pytest.mark.parametrize("name", ["paper", "free x", "tolerant, cut left"])
def test_the_graph_is_static_and_standard(model_of: ModelOf, name: str) -> None:
    """Operators of an allow-list, no graph within a node, every dimension a number, one domain."""
    model = onnx.load(model_of(name))
    onnx.checker.check_model(model, full_check=True)
    assert [entry.domain for entry in model.opset_import] == [""]
    assert len(model.functions) == 0
    assert {node.op_type for node in model.graph.node} <= STANDARD
    attributes = [attribute for node in model.graph.node for attribute in node.attribute]
    assert not any(attribute.HasField("g") or attribute.graphs for attribute in attributes)
    inferred = onnx.shape_inference.infer_shapes(model, strict_mode=True, data_prop=True).graph
    values = {value.name: value for value in (*inferred.value_info, *inferred.output, *inferred.input)}
    for node in model.graph.node:
        for output in filter(None, node.output):
            dims = values[output].type.tensor_type.shape.dim
            assert all(dim.HasField("dim_value") for dim in dims), output


@pytest.mark.parametrize("name", ["paper", "free x"])
def test_inputs_and_outputs_are_those_of_the_table(model_of: ModelOf, name: str) -> None:
    """The frame, and the two budgets with a default each; the outputs with the types that models/README.md gives."""
    graph, scene = onnx.load(model_of(name)).graph, SCENES[name]
    given = {tensor.name: tensor for tensor in graph.initializer}
    assert [value.name for value in graph.input] == ["frame", "missed_budget", "extra_budget"]
    assert "frame" not in given
    for budget in ("missed_budget", "extra_budget"):
        default = onnx.numpy_helper.to_array(given[budget])
        assert (default.dtype, default.shape, int(default)) == (np.int32, (), getattr(scene.tolerance, budget))
    model = session(model_of(name))
    cells, (rows, width) = scene.domain.cell_count, given["must_light_size"].dims
    assert {output.name: (output.type, output.shape) for output in model.get_outputs()} == {
        "cell": ("tensor(int64)", []),
        "support": ("tensor(int32)", [cells]),
        "mismatch": ("tensor(int32)", [cells]),
        "passes": ("tensor(bool)", [rows, width]),
        "cell_lower": ("tensor(float)", [cells, 4]),
        "cell_upper": ("tensor(float)", [cells, 4]),
        "filtered": ("tensor(uint8)", list(scene.camera.shape)),
        "network_state": ("tensor(float)", [4]),
    }
    assert model.get_inputs()[0].shape == list(scene.camera.shape)
    assert model.get_inputs()[0].type == "tensor(uint8)"


def test_padding_never_passes(model_of: ModelOf) -> None:
    """Cells of the paper have unlike numbers of entries; no frame passes what fills them up, at the largest budget."""
    tensors = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in onnx.load(model_of("paper")).graph.initializer}
    padding = tensors["must_light_size"] == NEVER
    assert padding.any()
    weakest = int(tensors["must_light_size"][~padding].min())
    for frame in frames_of(SCENES["paper"]):
        outputs = evaluate(session(model_of("paper")), frame, (weakest - 1, -1))
        assert not (outputs["passes"] & padding).any()
        assert (outputs["mismatch"] < NEVER // 2).all()

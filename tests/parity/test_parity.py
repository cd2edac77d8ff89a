"""The exported graph against its torch reference, and over onnxruntime's optimisation levels and threads, other operator sets and other
evaluators: onnx's reference, OpenVINO and tract. Every integer is equal, ties included; `network_state` is as near to its value in
float64 as float32 allows.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import onnx
import onnx.version_converter
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator
from onnx.reference.op_run import OpRun
from rounding_bound import exact_state_and_bound
from scenes import SCENES, WINDOWED, Frame, random_clutter

from build_model.assembly import assemble
from build_model.export import build_banks
from build_model.filter_graph import filter_graph
from build_model.filter_network import FilterNetwork, WindowNetwork
from build_model.hough_bank import CellBank
from build_model.state_network import StateNetwork
from runtime.estimator import Estimator
from runtime.image import runway_image
from runtime.model.format import BUDGETS as FILTER_BUDGETS
from runtime.model.format import IR_VERSION, OPSET, PADDING_SIZE
from runtime.scene import Scene

ModelOf = Callable[[str], Path]
Outputs = dict[str, NDArray]
INTEGERS = ("cell", "support", "mismatch", "passes", "filtered")
OF_WINDOWS = ("overflow",)
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
    "Gather",
    "GatherElements",
    "Gemm",
    "Greater",
    "Identity",
    "Less",
    "LessOrEqual",
    "MatMul",
    "MatMulInteger",
    "Max",
    "MaxPool",
    "Min",
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
    if level is not None:
        options.graph_optimization_level = level
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


@pytest.mark.parametrize("name", WINDOWED)
def test_onnxruntime_gives_the_torch_networks_outputs_of_windows(model_of: ModelOf, name: str) -> None:
    """The same of banks of windows, `overflow` too; with few places some frames overflow them and some do not."""
    scene = WINDOWED[name]
    network, model = WindowNetwork(scene, build_banks(scene)), session(model_of(name))
    overflows = set()
    for number, frame in enumerate(frames_of(scene)):
        for budgets in (None, (0, -1), (1, 5))[: 3 if number < 2 else 2]:
            missed, extra = budgets or (scene.tolerance.missed_budget, scene.tolerance.extra_budget)
            expected, found = network(torch.from_numpy(frame), missed, extra), evaluate(model, frame, budgets)
            for output in (*REFERENCE, "overflow"):
                assert np.array_equal(found[output], expected[output].numpy()), (output, number, budgets)
            overflows.add(bool(found["overflow"]))
    assert overflows == {True, False}


@pytest.mark.parametrize(("name", "width"), [("paper", 64), ("paper", 7), ("tolerant, free x", 3), ("one cell", 1)])
def test_rows_of_any_width_give_the_same(monkeypatch: pytest.MonkeyPatch, name: str, width: int) -> None:
    """A cell's entries in several rows: all outputs as the torch network gives them; `passes` cut into rows, padding never among it."""
    monkeypatch.setattr("build_model.assembly.row_width", lambda _entries: width)
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
        assert not (found["passes"] & (tables.must_light_size == PADDING_SIZE)).any()
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


# --- other evaluators ---

LEVELS = tuple(onnxruntime.GraphOptimizationLevel.__members__.values())
OTHER_OPSETS = (18, 24)
"""The oldest and the newest that onnx's version converter takes this graph to."""
CLUTTER = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.8, 1.0)
COMPARED = ("committed", "tolerant", "free x", "final, few places", "final, tolerant")


@pytest.fixture(scope="module")
def model_at(model_of: ModelOf, repository: Path) -> ModelOf:
    """The committed model of the paper's scene, with a trained NN_e, or a shared one."""
    return lambda name: repository / "models" / "paper.onnx" if name == "committed" else model_of(name)


def compared_frames(scene: Scene) -> list[Frame]:
    """Those above, and a runway at every density of clutter."""
    rng = np.random.default_rng(11)
    states = rng.uniform(scene.domain.lower, scene.domain.upper, (len(CLUTTER), 4))
    runways = (runway_image(scene, state) for state in states)
    return frames_of(scene) + [
        runway | random_clutter(rng, scene.camera.shape, density) for runway, density in zip(runways, CLUTTER, strict=True)
    ]


def compared_budgets(path: Path) -> list[tuple[int, int]]:
    """Budgets that the model's entries allow, the scene's first."""
    estimator = Estimator.load(path)
    tolerance, weakest = estimator.scene.tolerance, estimator.metadata["smallest_must_light"]
    others = [pair for pair in BUDGETS if pair is not None and pair[0] < weakest]
    return [(tolerance.missed_budget, tolerance.extra_budget), *others]


def network_of(path: Path) -> StateNetwork:
    """The torch network with the weights of a model file."""
    model = onnx.load(path)
    network = StateNetwork(Estimator.load(path).scene)
    tensors = {tensor.name.removeprefix("state_network/"): onnx.numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    (product,) = (node for node in model.graph.node if node.op_type == "MatMul" and node.input[1].startswith("state_network/"))
    tensors["first.halves.weight"] = tensors[product.input[1].removeprefix("state_network/")].T
    network.load_state_dict({name: torch.from_numpy(tensors[name].copy()) for name in network.state_dict()})
    return network


class Expected:
    """What onnxruntime with one thread gives, frame by frame; of the committed model, also NN_e in float64 and what float32 may be off."""

    def __init__(self, path: Path, with_states: bool) -> None:
        self.scene = Estimator.load(path).scene
        self.frames, self.budgets = compared_frames(self.scene), compared_budgets(path)
        self.network, plain = network_of(path), session(path)
        self.outputs = {
            (number, budgets): evaluate(plain, frame, budgets) for number, frame in enumerate(self.frames) for budgets in self.budgets
        }
        states = cache(lambda filtered: exact_state_and_bound(self.network, as_image(np.frombuffer(filtered, np.uint8), self.scene)))
        self.states = {
            (number, budgets): states(outputs["filtered"].tobytes())
            for (number, budgets), outputs in self.outputs.items()
            if with_states and budgets == self.budgets[0]
        }

    def check(self, number: int, budgets: tuple[int, int], found: Outputs, flushes_denormals: bool = False) -> None:
        """Integers and bounds to the last bit, `network_state` within its bound."""
        expected = self.outputs[number, budgets]
        assert set(found) == set(expected)
        for output in (*INTEGERS, *BOUNDS, *(name for name in OF_WINDOWS if name in expected)):
            wanted = expected[output]
            if flushes_denormals and output in BOUNDS:
                wanted = np.where(np.abs(wanted) < np.finfo(np.float32).smallest_normal, np.float32(0), wanted)
            assert (found[output].shape, found[output].dtype) == (wanted.shape, wanted.dtype)
            assert (found[output] == wanted).all(), (output, number, budgets)
        assert found["network_state"].dtype == np.float32
        if (number, budgets) in self.states:
            state, bound = self.states[number, budgets]
            assert (np.abs(found["network_state"].astype(np.float64) - state) <= bound).all(), number


def as_image(filtered: Frame, scene: Scene) -> torch.Tensor:
    """NN_e's input, (1, 1, height, width)."""
    return torch.from_numpy(filtered.copy()).reshape(1, 1, *scene.camera.shape)


@pytest.fixture(scope="module")
def expected_of(model_at: ModelOf) -> Callable[[str], Expected]:
    return cache(lambda name: Expected(model_at(name), with_states=name == "committed"))


def with_defaults(path: Path, budgets: tuple[int, int], changed: Path) -> Path:
    """The model with other default budgets, for evaluators that cannot override an initialiser."""
    model = onnx.load(path)
    for tensor in model.graph.initializer:
        if tensor.name in FILTER_BUDGETS:
            budget = np.array(budgets[FILTER_BUDGETS.index(tensor.name)], dtype=np.int32)
            tensor.CopyFrom(onnx.numpy_helper.from_array(budget, tensor.name))
    onnx.save(model, changed)
    return changed


@pytest.mark.parametrize("name", COMPARED)
def test_levels_and_threads_change_no_integer(model_at: ModelOf, expected_of: Callable[[str], Expected], name: str) -> None:
    """Nor does the way in which the runtime opens a model."""
    expected = expected_of(name)
    for level, threads in itertools.product(LEVELS, (1, 2, 4)):
        other = session(model_at(name), level, threads)
        for (number, budgets), frame in cases(expected):
            expected.check(number, budgets, evaluate(other, frame, budgets))
    for budgets in expected.budgets:
        estimator = Estimator.load(model_at(name), missed_budget=budgets[0], extra_budget=budgets[1])
        for number, frame in enumerate(expected.frames):
            expected.check(number, budgets, estimator.run(frame))


def cases(expected: Expected) -> list[tuple[tuple[int, tuple[int, int]], Frame]]:
    """Every frame with the scene's budgets and with one of the others, in turn."""
    others = expected.budgets[1:]
    numbered = list(enumerate(expected.frames))
    chosen = [((number, expected.budgets[0]), frame) for number, frame in numbered]
    return chosen + [((number, others[number % len(others)]), frame) for number, frame in numbered]


@pytest.mark.parametrize("opset", OTHER_OPSETS)
@pytest.mark.parametrize("name", COMPARED)
def test_other_operator_sets_change_no_integer(
    model_at: ModelOf, expected_of: Callable[[str], Expected], name: str, opset: int, tmp_path: Path
) -> None:
    converted = onnx.version_converter.convert_version(onnx.load(model_at(name)), opset)
    assert [entry.version for entry in converted.opset_import] == [opset]
    onnx.save(converted, tmp_path / "converted.onnx")
    expected, other = expected_of(name), session(tmp_path / "converted.onnx")
    for (number, budgets), frame in cases(expected):
        expected.check(number, budgets, evaluate(other, frame, budgets))


@pytest.mark.parametrize("name", COMPARED)
def test_openvino_agrees(model_at: ModelOf, expected_of: Callable[[str], Expected], name: str, tmp_path: Path) -> None:
    """It keeps the default budgets, and sets denormal numbers to 0: the bounds of an axis fixed at 0 are its smallest two."""
    openvino = pytest.importorskip("openvino", reason="OpenVINO is not installed")
    expected, core = expected_of(name), openvino.Core()
    for budgets, threads in zip(expected.budgets[::2], itertools.cycle((1, 2)), strict=False):
        read = core.read_model(with_defaults(model_at(name), budgets, tmp_path / "changed.onnx"))
        # Without the hint it computes in bfloat16 where the processor can.
        model = core.compile_model(read, "CPU", {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32"})
        for number, frame in enumerate(expected.frames):
            found = {output.any_name: np.asarray(value) for output, value in model({"frame": frame}).items()}
            expected.check(number, budgets, found, flushes_denormals=True)


@pytest.mark.parametrize("name", COMPARED)
def test_tract_agrees(model_at: ModelOf, expected_of: Callable[[str], Expected], name: str, tmp_path: Path) -> None:
    """It keeps the default budgets."""
    tract = pytest.importorskip("tract", reason="tract is not installed")
    expected = expected_of(name)
    for budgets in expected.budgets[::2]:
        read = tract.onnx().load(with_defaults(model_at(name), budgets, tmp_path / "changed.onnx"))
        names = [read.output_name(place) for place in range(read.output_count())]
        model = read.into_model().into_runnable()
        for number, frame in enumerate(expected.frames):
            found = dict(zip(names, (value.to_numpy() for value in model.run([frame])), strict=True))
            expected.check(number, budgets, found)


class GatherElements(OpRun):
    """In place of onnx's own, whose numpy.choose takes 64 elements at most where the data have one axis; the standard has no such limit."""

    def _run(self, data: NDArray, indices: NDArray, axis: int = 0) -> tuple[NDArray]:
        return (np.take_along_axis(data, indices, axis),)


@pytest.mark.parametrize(("name", "step"), [("one cell", 1), ("committed", 4), ("free x", 4)])
def test_onnxs_reference_evaluator_agrees(model_at: ModelOf, expected_of: Callable[[str], Expected], name: str, step: int) -> None:
    """Overriding the budgets as well."""
    expected = expected_of(name)
    reference = ReferenceEvaluator(str(model_at(name)), new_ops=[GatherElements])
    for (number, budgets), frame in cases(expected)[::step]:
        feed = {"frame": frame} | {name: np.array(value, np.int32) for name, value in zip(FILTER_BUDGETS, budgets, strict=True)}
        found = dict(zip(reference.output_names, reference.run(None, feed), strict=True))
        expected.check(number, budgets, {name: np.asarray(value) for name, value in found.items()})


def test_torch_gives_the_committed_models_state(expected_of: Callable[[str], Expected]) -> None:
    expected = expected_of("committed")
    for case, (exact, bound) in expected.states.items():
        with torch.no_grad():
            state = expected.network(as_image(expected.outputs[case]["filtered"], expected.scene)).numpy()[0]
        assert (np.abs(state - exact) <= bound).all()


def test_the_frames_have_ties_and_every_answer(expected_of: Callable[[str], Expected]) -> None:
    """Cells that share the largest support, cells that share the smallest mismatch where none passes; and frames that only some pass."""
    outputs = list(expected_of("free x").outputs.values())
    assert any((found["support"] == found["support"].max()).sum() > 1 for found in outputs if found["support"].any())
    assert any((found["mismatch"] == found["mismatch"].min()).sum() > 1 for found in outputs if not found["support"].any())
    passing = {int((found["support"] > 0).sum()) for found in outputs}
    assert min(passing) == 0
    assert max(passing) == len(outputs[0]["support"])
    assert len(passing) > 5


def test_the_bound_on_the_state_is_tight(expected_of: Callable[[str], Expected]) -> None:
    """Below 2e-5 rad or m and 4e-8 more for each lit pixel, since sums grow with them; and missed, in most frames, by a network whose
    weights are rounded to bfloat16."""
    expected = expected_of("committed")
    coarse = StateNetwork(expected.scene)
    coarse.load_state_dict({name: value.to(torch.bfloat16).to(torch.float32) for name, value in expected.network.state_dict().items()})
    missed = 0
    for case, (exact, bound) in expected.states.items():
        filtered = expected.outputs[case]["filtered"]
        assert (bound < 2e-5 + 4e-8 * filtered.sum()).all()
        with torch.no_grad():
            state = coarse(as_image(filtered, expected.scene)).numpy()[0]
        missed += bool((np.abs(state - exact) > bound).any())
    assert missed > 0.9 * len(expected.states)


# --- ties, defaults, padding ---


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
    padding = tensors["must_light_size"] == PADDING_SIZE
    assert padding.any()
    weakest = int(tensors["must_light_size"][~padding].min())
    for frame in frames_of(SCENES["paper"]):
        outputs = evaluate(session(model_of("paper")), frame, (weakest - 1, -1))
        assert not (outputs["passes"] & padding).any()
        assert (outputs["mismatch"] < PADDING_SIZE // 2).all()

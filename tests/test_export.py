"""export-model's library: reproducible bytes, what the metadata say, users' networks, and that no failure harms the old file."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from scenes import OFF_BY, ONE_CELL, PAPER, SCENES

from build_model.export import export_model
from build_model.paper.paper_bound import paper_bound
from build_model.partition import partition
from build_model.user_network import NO_ESTIMATOR, EstimatorError, user_network
from build_model.verify.proof import verify_model
from runtime import Estimator
from runtime.assumptions import assumptions
from runtime.image import runway_image
from runtime.model.format import METADATA_KEY
from runtime.rounding import OUTWARD_PX
from runtime.scene import Scene, SceneError, Tolerance
from runtime.whole_file import write_whole

ModelOf = Callable[[str], Path]
HEIGHT, WIDTH = ONE_CELL.camera.shape


# --- the file ---


def differences(first: bytes, second: bytes) -> list[str]:
    """Names of the initialisers, nodes and metadata in which two models differ."""
    models = [onnx.ModelProto.FromString(content) for content in (first, second)]
    parts = [
        {part.name: part.SerializeToString(deterministic=True) for part in (*model.graph.initializer, *model.graph.node)}
        for model in models
    ]
    metadata = [json.loads(model.metadata_props[0].value) for model in models]
    return [name for one, other in (parts, metadata) for name in sorted({*one, *other}) if one.get(name) != other.get(name)]


def test_the_same_seed_gives_the_same_bytes_whoever_builds_the_cells(tmp_path: Path) -> None:
    """With training, in one process and in two, over an existing file and beside none; another seed gives another NN_e only."""
    two_cells = replace(ONE_CELL, domain=replace(ONE_CELL.domain, z_m=PAPER.domain.z_m))
    reports, contents = [], []
    for name, jobs in (("a", 1), ("b", 2), ("a", 2)):
        reports.append(export_model(two_cells, tmp_path / name, seed=5, jobs=jobs))
        contents.append((tmp_path / name).read_bytes())
    for content in contents[1:]:
        assert differences(contents[0], content) == []
        assert content == contents[0]
    assert {report.sha256 for report in reports} == {hashlib.sha256(contents[0]).hexdigest()}
    assert {report.file_bytes for report in reports} == {len(contents[0])}
    export_model(two_cells, tmp_path / "c", seed=6)
    differing = differences(contents[0], (tmp_path / "c").read_bytes())
    assert any(name.startswith("state_network/") for name in differing)
    assert all(name.startswith("state_network/") or name in ("graph_sha256", "metadata_sha256", "seed", "training") for name in differing)


def test_metadata_say_what_the_model_is(model_of: ModelOf) -> None:
    model = onnx.load(model_of("tolerant"))
    (entry,) = model.metadata_props
    assert entry.key == METADATA_KEY
    metadata = json.loads(entry.value)
    scene = SCENES["tolerant"]
    assert Scene.from_dict(metadata["scene"]) == scene
    assert metadata["graph_sha256"] == hashlib.sha256(model.graph.SerializeToString(deterministic=True)).hexdigest()
    assert metadata["margin_px"] == OUTWARD_PX
    assert metadata["assumptions"] == assumptions(scene)
    assert 0 < metadata["calibration_shift_px"] <= scene.tolerance.line_px
    assert metadata["seed"] == 1
    assert set(metadata["versions"]) == {"python", "glideproof", "numpy", "onnx", "onnxruntime", "torch"}
    sizes = next(numpy_helper.to_array(tensor) for tensor in model.graph.initializer if tensor.name == "must_light_size")
    assert metadata["smallest_must_light"] == sizes.min()
    cells = partition(scene)
    bounds = [paper_bound(scene, lower, upper) for lower, upper in zip(cells.lower, cells.upper, strict=True)]
    assert metadata["paper_bounds"] == [None if bound is None else asdict(bound) for bound in bounds]


def test_no_name_of_the_machine_is_in_the_file(model_of: ModelOf) -> None:
    """Torch's exporter notes the source files that a node comes from."""
    content = model_of("paper").read_bytes()
    for trace in (b"site-packages", b".py", os.fsencode(Path.cwd()), b"torch.onnx"):
        assert trace not in content.replace(b'"python"', b"")


def test_the_report_counts_what_was_built(tmp_path: Path) -> None:
    stages: list[tuple[str, int, int]] = []
    report = export_model(ONE_CELL, tmp_path / "model.onnx", progress=lambda stage, done, total, _loss: stages.append((stage, done, total)))
    tensors = {tensor.name: numpy_helper.to_array(tensor) for tensor in onnx.load(tmp_path / "model.onnx").graph.initializer}
    assert report.cells == 1
    assert report.entries == tensors["must_light_size"].size
    assert report.smallest_must_light == tensors["must_light_size"].min()
    assert report.file_bytes == (tmp_path / "model.onnx").stat().st_size
    assert list(report.seconds) == ["NN_F", "NN_e", "file"]
    assert report.training is not None
    assert report.training.training_frames == 256
    assert stages[0] == ("cells", 1, 1)
    assert {stage for stage, _, _ in stages} == {"cells", "frames for NN_e", "training NN_e"}
    assert all(0 < done <= total for _, done, total in stages)


def test_the_assumptions_are_named() -> None:
    plain, full = assumptions(PAPER), assumptions(replace(PAPER, tolerance=Tolerance(1, 8, 3), calibration=OFF_BY))
    assert len(plain) == 3
    assert any("domain" in line for line in plain)
    assert "At most 0 pixels of the runway's image have no lit pixel." in plain
    assert "At most 8 pixels of the runway's image have no lit pixel within 1 px." in full
    assert full[-1].startswith("At most 3 lit pixels of the true cell's spatial mask are not the runway's")


# --- scenes without a certificate ---


def test_a_scene_without_a_certificate_leaves_no_file(tmp_path: Path) -> None:
    cases = {
        r"^bank: in theta .*missed_budget 100": replace(ONE_CELL, tolerance=Tolerance(missed_budget=100)),
        r"^bank: in theta .* only 0 pixels": replace(ONE_CELL, camera=replace(ONE_CELL.camera, principal_point=(320.0, 3000.0))),
        r"^tolerance\.line_px: found 0, but \[calibration\] can move": replace(ONE_CELL, calibration=OFF_BY),
    }
    for message, scene in cases.items():
        with pytest.raises(SceneError, match=message):
            export_model(scene, tmp_path / "model.onnx")
    assert list(tmp_path.iterdir()) == []


# --- a write that fails ---


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """The system refuses to let a file grow beyond `size`, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def test_a_disk_that_is_full_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    path.write_bytes(b"old")
    with largest_file(10_000), pytest.raises(OSError, match="File too large"):
        write_whole(path, bytes(20_000))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"


def test_a_full_disk_during_an_export_leaves_the_old_model(tmp_path: Path, model_of: ModelOf) -> None:
    path = tmp_path / "model.onnx"
    path.write_bytes(model_of("one cell").read_bytes())
    with largest_file(50_000), pytest.raises(OSError, match="File too large"):
        export_model(ONE_CELL, path, seed=2)
    assert path.read_bytes() == model_of("one cell").read_bytes()
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("stage", ["cells", "frames for NN_e", "training NN_e"])
def test_an_interrupt_leaves_the_old_model(tmp_path: Path, model_of: ModelOf, stage: str, request: pytest.FixtureRequest) -> None:
    """A real SIGINT, in each stage; the handler is set since a background job of a shell ignores the signal."""
    earlier = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, earlier))
    path = tmp_path / "model.onnx"
    path.write_bytes(model_of("one cell").read_bytes())

    def interrupt(current: str, _done: int, _total: int, _loss: float | None) -> None:
        if current == stage:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        export_model(ONE_CELL, path, seed=2, progress=interrupt)
    assert path.read_bytes() == model_of("one cell").read_bytes()
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_is_made_and_a_folder_in_the_way_is_left(tmp_path: Path) -> None:
    write_whole(tmp_path / "new" / "folder" / "model.onnx", b"content")
    assert (tmp_path / "new" / "folder" / "model.onnx").read_bytes() == b"content"
    (tmp_path / "model.onnx").mkdir()
    with pytest.raises(IsADirectoryError):
        write_whole(tmp_path / "model.onnx", b"content")
    assert {path.name for path in tmp_path.iterdir()} == {"new", "model.onnx"}
    with pytest.raises(NotADirectoryError):
        write_whole(tmp_path / "new" / "folder" / "model.onnx" / "more", b"content")


# --- users' networks ---


def network(
    inputs: dict[str, tuple[int, list]],
    outputs: dict[str, tuple[int, list]],
    *,
    opset: int = 20,
    operator: str = "ReduceMean",
    domain: str = "",
) -> onnx.ModelProto:
    """NN_e = mean of the image times ones, with inputs and outputs declared as given."""
    infos = [[helper.make_tensor_value_info(name, *kind) for name, kind in side.items()] for side in (inputs, outputs)]
    nodes = [
        helper.make_node(operator, [next(iter(inputs))], ["mean"], domain=domain, **({} if domain else {"keepdims": 0})),
        helper.make_node("Mul", ["mean", "ones"], [next(iter(outputs))]),
    ]
    dtype = helper.tensor_dtype_to_np_dtype(next(iter(outputs.values()))[0])
    graph = helper.make_graph(nodes, "user", *infos, [numpy_helper.from_array(np.ones((1, 4), dtype=dtype), "ones")])
    imports = [helper.make_opsetid("", opset), *([helper.make_opsetid(domain, 1)] if domain else [])]
    return helper.make_model(graph, opset_imports=imports, ir_version=8)


IMAGE, STATE = (TensorProto.FLOAT, [1, 1, HEIGHT, WIDTH]), (TensorProto.FLOAT, [1, 4])


@pytest.mark.parametrize("opset", [13, 17, 20, 21])
def test_a_users_network_answers_in_place_of_ours(tmp_path: Path, opset: int) -> None:
    """Of older and newer opsets; it sees the filtered frame."""
    onnx.save(network({"image": IMAGE}, {"state": STATE}, opset=opset), tmp_path / "user.onnx")
    report = export_model(ONE_CELL, tmp_path / "model.onnx", estimator=tmp_path / "user.onnx")
    assert report.training is None
    estimator = Estimator.load(tmp_path / "model.onnx")
    state = (ONE_CELL.domain.lower + ONE_CELL.domain.upper) / 2
    frame = runway_image(ONE_CELL, state)
    frame[:, :100] = 1
    estimate = estimator.estimate(frame)
    share = np.float32(estimate.filtered.sum() / frame.size)
    assert 0 < estimate.filtered.sum() < frame.sum()
    assert estimate.network_state[[0, 2, 3]] == pytest.approx([share] * 3, rel=1e-5)
    assert estimate.box is not None
    assert estimate.box.contains(state)
    assert estimate.used_fallback


def test_names_of_a_users_network_do_not_clash_with_ours(tmp_path: Path) -> None:
    onnx.save(network({"frame": IMAGE}, {"cell": STATE}), tmp_path / "user.onnx")
    export_model(ONE_CELL, tmp_path / "model.onnx", estimator=tmp_path / "user.onnx")
    assert np.isfinite(Estimator.load(tmp_path / "model.onnx").estimate(np.ones((HEIGHT, WIDTH), dtype=bool)).network_state).all()


REFUSED = {
    "another height": ({"image": (TensorProto.FLOAT, [1, 1, HEIGHT + 1, WIDTH])}, {"state": STATE}, "expected one input float32"),
    "no batch axis": ({"image": (TensorProto.FLOAT, [1, HEIGHT, WIDTH])}, {"state": STATE}, r"\[1, 480, 640\]"),
    "a batch of any size": ({"image": (TensorProto.FLOAT, ["n", 1, HEIGHT, WIDTH])}, {"state": STATE}, r"\['n', 1, 480, 640\]"),
    "another type": ({"image": (TensorProto.DOUBLE, [1, 1, HEIGHT, WIDTH])}, {"state": (TensorProto.DOUBLE, [1, 4])}, "DOUBLE"),
    "three numbers": ({"image": IMAGE}, {"state": (TensorProto.FLOAT, [1, 3])}, "expected|usable"),
    "four without a batch": ({"image": IMAGE}, {"state": (TensorProto.FLOAT, [4])}, r"FLOAT \[4\]|usable"),
    "two inputs": ({"image": IMAGE, "other": IMAGE}, {"state": STATE}, r"inputs \['FLOAT .*', 'FLOAT .*'\]"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_any_other_network_is_refused_with_what_was_found(tmp_path: Path, case: str) -> None:
    inputs, outputs, message = REFUSED[case]
    path = tmp_path / "user.onnx"
    onnx.save(network(inputs, outputs), path)
    with pytest.raises(EstimatorError, match=message) as caught:
        user_network(ONE_CELL, path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_network_with_two_outputs_is_refused(tmp_path: Path) -> None:
    model = network({"image": IMAGE}, {"state": STATE})
    model.graph.node.append(helper.make_node("Identity", ["state"], ["again"]))
    model.graph.output.append(helper.make_tensor_value_info("again", *STATE))
    onnx.save(model, tmp_path / "user.onnx")
    with pytest.raises(EstimatorError, match=r"outputs \['FLOAT \[1, 4\]', 'FLOAT \[1, 4\]'\]"):
        user_network(ONE_CELL, tmp_path / "user.onnx")


def test_operators_that_are_not_standard_are_refused(tmp_path: Path) -> None:
    onnx.save(network({"image": IMAGE}, {"state": STATE}, operator="Mean", domain="com.example"), tmp_path / "user.onnx")
    with pytest.raises(EstimatorError, match=r"not a usable ONNX model|standard operators only"):
        user_network(ONE_CELL, tmp_path / "user.onnx")


def test_control_flow_is_refused(tmp_path: Path) -> None:
    """A model has none: it would no longer be static."""
    branch = helper.make_graph(
        [helper.make_node("Identity", ["ones"], ["chosen"])], "b", [], [helper.make_tensor_value_info("chosen", *STATE)]
    )
    nodes = [
        helper.make_node("ReduceMax", ["image"], ["largest"], keepdims=0),
        helper.make_node("Cast", ["largest"], ["lit"], to=TensorProto.BOOL),
        helper.make_node("If", ["lit"], ["state"], then_branch=branch, else_branch=branch),
    ]
    infos = [[helper.make_tensor_value_info(*value)] for value in (("image", *IMAGE), ("state", *STATE))]
    graph = helper.make_graph(nodes, "user", *infos, [numpy_helper.from_array(np.ones((1, 4), dtype=np.float32), "ones")])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=8), tmp_path / "user.onnx")
    with pytest.raises(EstimatorError, match="If"):
        user_network(ONE_CELL, tmp_path / "user.onnx")


def test_files_that_are_no_network_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("no network")
    (tmp_path / "empty.onnx").write_bytes(b"")
    for name, message in (
        ("missing.onnx", r"cannot be read \(No such file"),
        ("text.onnx", "not a usable"),
        ("empty.onnx", "not a usable"),
    ):
        with pytest.raises(EstimatorError, match=rf"{name}: {message}"):
            user_network(ONE_CELL, tmp_path / name)


def test_weights_in_another_file_are_refused(tmp_path: Path) -> None:
    """The model is one file; weights beside the user's network would be left behind."""
    onnx.save(
        network({"image": IMAGE}, {"state": STATE}),
        tmp_path / "user.onnx",
        save_as_external_data=True,
        location="weights",
        size_threshold=0,
    )
    assert (tmp_path / "weights").exists()
    with pytest.raises(EstimatorError):
        user_network(ONE_CELL, tmp_path / "user.onnx")


def small_network(*nodes: onnx.NodeProto, **tensors: np.ndarray) -> onnx.ModelProto:
    """NN_e of these nodes, `image` to `state`."""
    infos = [[helper.make_tensor_value_info(*value)] for value in (("image", *IMAGE), ("state", *STATE))]
    graph = helper.make_graph(list(nodes), "user", *infos, [numpy_helper.from_array(value, name) for name, value in tensors.items()])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=8)


ANSWER = np.ones((1, 4), dtype=np.float32)
DYNAMIC_INSIDE = {
    "a slice whose end is computed": (
        [
            helper.make_node("ArgMax", ["image"], ["row"], axis=2),
            helper.make_node("Reshape", ["row", "one"], ["short"]),
            helper.make_node("Slice", ["short", "zero", "first", "zero"], ["first_row"]),
            helper.make_node("Slice", ["image", "zero", "first_row", "two"], ["cut"]),
            helper.make_node("ReduceSum", ["cut"], ["sum"], keepdims=0),
        ],
        "found Slice with a shape that is computed; only constant shapes are taken",
    ),
    "as many as are lit": (
        [
            helper.make_node("NonZero", ["image"], ["places"]),
            helper.make_node("Cast", ["places"], ["numbers"], to=TensorProto.FLOAT),
            helper.make_node("ReduceSum", ["numbers"], ["sum"], keepdims=0),
        ],
        "found the operator NonZero; a model has static, standard operators only",
    ),
}


@pytest.mark.parametrize("case", DYNAMIC_INSIDE)
def test_a_network_that_is_dynamic_inside_is_refused(tmp_path: Path, case: str) -> None:
    """Between an input and an output of fixed shapes."""
    nodes, message = DYNAMIC_INSIDE[case]
    sizes = {"zero": np.array([0]), "first": np.array([1]), "two": np.array([2]), "one": np.array([-1])}
    model = small_network(*nodes, helper.make_node("Mul", ["sum", "answer"], ["state"]), answer=ANSWER, **sizes)
    onnx.save(model, tmp_path / "user.onnx")
    with pytest.raises(EstimatorError, match=message) as caught:
        user_network(ONE_CELL, tmp_path / "user.onnx")
    assert str(caught.value).startswith(str(tmp_path / "user.onnx"))
    assert "\n" not in str(caught.value)


def test_a_network_that_the_runtime_would_refuse_is_refused(tmp_path: Path) -> None:
    """Expand, of a constant shape: the runtime takes no operator that makes a tensor from a number."""
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], keepdims=0),
        helper.make_node("Expand", ["mean", "shape"], ["state"]),
    ]
    onnx.save(small_network(*nodes, shape=np.array([1, 4])), tmp_path / "user.onnx")
    with pytest.raises(EstimatorError, match="found the operator Expand; a model has static, standard operators only"):
        user_network(ONE_CELL, tmp_path / "user.onnx")


def test_constants_of_any_kind_become_what_the_runtime_reads(tmp_path: Path) -> None:
    """A Constant as a tensor and as numbers, typed data, and a constant that is an input too, as older exporters write them."""
    nodes = [
        helper.make_node("Constant", [], ["axes"], value_ints=[0, 1, 2, 3]),
        helper.make_node("Constant", [], ["half"], value=helper.make_tensor("half", TensorProto.FLOAT, [], [0.5])),
        helper.make_node("ReduceMean", ["image", "axes"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "half"], ["scaled"]),
        helper.make_node("Mul", ["scaled", "answer"], ["state"]),
    ]
    model = small_network(*nodes)
    model.graph.initializer.append(helper.make_tensor("answer", TensorProto.FLOAT, [1, 4], [1.0, 2.0, 3.0, 4.0]))
    model.graph.input.append(helper.make_tensor_value_info("answer", *STATE))
    onnx.save(model, tmp_path / "user.onnx")
    export_model(ONE_CELL, tmp_path / "model.onnx", estimator=tmp_path / "user.onnx")
    outputs = Estimator.load(tmp_path / "model.onnx").run(np.ones((HEIGHT, WIDTH), dtype=bool))
    share = outputs["filtered"].mean() / 2
    assert outputs["network_state"] == pytest.approx(share * np.arange(1, 5), rel=1e-5)


def test_a_model_without_an_estimator_certifies_all_the_same(tmp_path: Path, estimator_of: Callable[..., Estimator]) -> None:
    report = export_model(ONE_CELL, tmp_path / "none.onnx", estimator=NO_ESTIMATOR)
    assert report.training is None
    verify_model(tmp_path / "none.onnx")
    certifier, trained = Estimator.load(tmp_path / "none.onnx"), estimator_of("one cell")
    centre = (ONE_CELL.domain.lower + ONE_CELL.domain.upper) / 2
    for state in (ONE_CELL.domain.lower, centre):
        frame = runway_image(ONE_CELL, state)
        found, expected = certifier.estimate(frame), trained.estimate(frame)
        assert found.box is not None
        assert expected.box is not None
        assert (found.box.lower.tolist(), found.box.upper.tolist()) == (expected.box.lower.tolist(), expected.box.upper.tolist())
        assert np.isnan(found.network_state[~ONE_CELL.domain.fixed]).all()
        assert found.state is not None
        assert (found.state.tolist(), found.used_fallback) == (found.box.centre.tolist(), True)

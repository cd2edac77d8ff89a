"""Reading a model file's wire format without onnx, against onnx; and every kind of file that is not a sound model."""

from __future__ import annotations

import hashlib
import json
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from fuzz_networks import Computed, Example, Network, with_chain, with_network
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from runtime.estimator import Estimator
from runtime.model.format import BOX_TENSORS, FORMAT_VERSION, METADATA_KEY, OPSET, ModelError, metadata_digest
from runtime.model.model_file import LARGEST_FILE_BYTES, LARGEST_METADATA_BYTES, parse_model
from runtime.model.onnx_subset import check_graph
from runtime.model.protobuf import LARGEST_FIELDS

ModelOf = Callable[[str], Path]


@pytest.fixture(scope="module")
def content(model_of: ModelOf) -> bytes:
    return model_of("one cell").read_bytes()


def with_metadata(content: bytes, **changes: object) -> bytes:
    """The model with entries of its metadata replaced."""
    model = onnx.ModelProto.FromString(content)
    metadata = json.loads(model.metadata_props[0].value)
    changed = {**metadata, **changes}
    model.metadata_props[0].value = json.dumps({**changed, "metadata_sha256": metadata_digest(changed)})
    return model.SerializeToString()


def test_metadata_and_tensors_are_those_that_onnx_reads(content: bytes) -> None:
    read = parse_model(content, "model", BOX_TENSORS)
    model = onnx.ModelProto.FromString(content)
    assert read.metadata == json.loads({entry.key: entry.value for entry in model.metadata_props}[METADATA_KEY])
    assert read.sha256 == hashlib.sha256(content).hexdigest()
    assert set(read.tensors) == set(BOX_TENSORS)
    for tensor in model.graph.initializer:
        if tensor.name in BOX_TENSORS:
            expected = numpy_helper.to_array(tensor)
            assert read.tensors[tensor.name].dtype == expected.dtype
            assert (read.tensors[tensor.name] == expected).all()
            assert not read.tensors[tensor.name].flags.writeable


@given(
    dims=st.lists(st.integers(0, 300), min_size=0, max_size=3).filter(lambda dims: np.prod(dims, initial=1) < 2000),
    dtype=st.sampled_from([np.float32, np.float64, np.int32, np.int64]),
)
def test_arrays_of_any_shape_are_read(dims: list[int], dtype: type) -> None:
    """Sizes beyond 127 take two bytes of the wire format; a graph of no nodes is all that is needed."""
    values = np.arange(np.prod(dims, initial=1), dtype=dtype).reshape(dims)
    graph = helper.make_graph([], "g", [], [], [numpy_helper.from_array(values, "wanted"), numpy_helper.from_array(values, "other")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
    digest = hashlib.sha256(graph.SerializeToString()).hexdigest()
    metadata = {"format_version": FORMAT_VERSION, "graph_sha256": digest}
    signed = {**metadata, "metadata_sha256": metadata_digest(metadata)}
    helper.set_model_props(model, {"else": "é", METADATA_KEY: json.dumps(signed)})
    read = parse_model(model.SerializeToString(), "model", ["wanted"])
    assert list(read.tensors) == ["wanted"]
    assert (read.tensors["wanted"] == values).all()
    assert read.tensors["wanted"].shape == tuple(dims)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.7, 0.999])
def test_a_file_cut_short_is_refused(content: bytes, share: float, tmp_path: Path) -> None:
    path = tmp_path / "cut.onnx"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ModelError, match=r"cut\.onnx: (not an ONNX model|no metadata|damaged)"):
        Estimator.load(path)


def test_a_damaged_byte_anywhere_in_the_graph_is_found(content: bytes) -> None:
    """200 places in the graph, which is all but a few kB of the file."""
    rng = np.random.default_rng(1)
    start = content.index(b"graph_sha256") if content.index(b"graph_sha256") < 1000 else 1000
    end = content.rindex(METADATA_KEY.encode()) - 100
    for place in rng.integers(start, end, 200):
        damaged = bytearray(content)
        damaged[place] ^= 1 << rng.integers(8)
        with pytest.raises(ModelError):
            parse_model(bytes(damaged), "model", BOX_TENSORS)


def test_damaged_metadata_are_found(content: bytes) -> None:
    """A scene that differs by one digit is another scene: its boxes would be certified for the wrong domain."""
    text = json.dumps(json.loads(onnx.ModelProto.FromString(content).metadata_props[0].value)["scene"], sort_keys=True).encode()
    assert content.count(text) == 1
    place = content.index(text)
    digits = [place + offset for offset, byte in enumerate(text) if chr(byte).isdigit()]
    for digit in digits[::3]:
        damaged = bytearray(content)
        damaged[digit] = ord("3") if damaged[digit] != ord("3") else ord("4")
        with pytest.raises(ModelError):
            parse_model(bytes(damaged), "model", BOX_TENSORS)


def test_other_files_are_refused(tmp_path: Path, repository: Path) -> None:
    """No file, a folder, a text, a foreign network."""
    network = tmp_path / "foreign.onnx"
    value = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])
    onnx.save(helper.make_model(helper.make_graph([helper.make_node("Relu", ["x"], ["y"])], "g", [value], [value])), network)
    cases = {
        tmp_path / "missing.onnx": r"missing\.onnx: cannot be read \(No such file or directory\)",
        tmp_path: "is no file but a folder",
        repository / "pyproject.toml": "not an ONNX model, or cut short",
        network: r"foreign\.onnx: no metadata 'glideproof'",
    }
    for path, message in cases.items():
        with pytest.raises(ModelError, match=message) as caught:
            Estimator.load(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("version", [FORMAT_VERSION + 1, 0, "1", None])
def test_another_format_version_is_refused(content: bytes, version: object) -> None:
    with pytest.raises(ModelError, match=f"format version {version!r}, this runtime reads {FORMAT_VERSION}"):
        parse_model(with_metadata(content, format_version=version), "model")


@pytest.mark.parametrize("text", ["", "{", "[]", "7", "[" * 100_000])
def test_metadata_that_are_no_object_are_refused(content: bytes, text: str) -> None:
    model = onnx.ModelProto.FromString(content)
    model.metadata_props[0].value = text
    with pytest.raises(ModelError, match="its metadata are not"):
        parse_model(model.SerializeToString(), "model")


def test_a_model_without_its_boxes_is_refused(content: bytes) -> None:
    with pytest.raises(ModelError, match=r"lacks the initialisers \['nowhere'\]"):
        parse_model(content, "model", [*BOX_TENSORS, "nowhere"])


def test_the_digest_that_a_caller_trusts_decides(model_of: ModelOf) -> None:
    path = model_of("one cell")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert Estimator.load(path, sha256=digest.upper()).sha256 == digest
    with pytest.raises(ModelError, match=f"sha256 is {digest}, the caller trusts {'0' * 64}"):
        Estimator.load(path, sha256="0" * 64)


@given(garbage=st.binary(max_size=200))
def test_garbage_is_refused_with_a_model_error(garbage: bytes) -> None:
    with pytest.raises(ModelError):
        parse_model(garbage, "garbage")


# --- an attacker's files: every digest is right, and nothing else need be ---


def forged(content: bytes, change: Callable[[onnx.ModelProto], object], **metadata: object) -> bytes:
    """The model changed, with entries of its metadata replaced and all digests computed anew."""
    model = onnx.ModelProto.FromString(content)
    change(model)
    return with_metadata(model.SerializeToString(), graph_sha256=hashlib.sha256(model.graph.SerializeToString()).hexdigest(), **metadata)


def initialiser(model: onnx.ModelProto, name: str) -> onnx.TensorProto:
    return next(tensor for tensor in model.graph.initializer if tensor.name == name)


def node(model: onnx.ModelProto, operator: str) -> onnx.NodeProto:
    return next(node for node in model.graph.node if node.op_type == operator)


def reshaped(*dims: int) -> Callable[[onnx.ModelProto], object]:
    def change(model: onnx.ModelProto) -> None:
        tensor = initialiser(model, "theta_lower")
        tensor.ClearField("dims")
        tensor.dims.extend(dims)

    return change


def replaced(name: str, values: np.ndarray) -> Callable[[onnx.ModelProto], object]:
    return lambda model: initialiser(model, name).CopyFrom(numpy_helper.from_array(values, name))


def external(model: onnx.ModelProto) -> None:
    tensor = initialiser(model, "theta_lower")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")


def typed(model: onnx.ModelProto) -> None:
    tensor = initialiser(model, "theta_lower")
    tensor.ClearField("raw_data")
    tensor.float_data.append(0.0)


def branching(model: onnx.ModelProto) -> None:
    body = helper.make_graph([helper.make_node("Identity", ["frame"], ["y"])], "body", [], [])
    node(model, "Relu").attribute.append(helper.make_attribute("then_branch", body))


def computed_shape(model: onnx.ModelProto) -> None:
    node(model, "Reshape").input[1] = model.graph.node[0].output[0]


def tensor_in_a_node(model: onnx.ModelProto) -> None:
    node(model, "Cast").attribute.append(helper.make_attribute("value", numpy_helper.from_array(np.zeros(3), "t")))


def of_domain(model: onnx.ModelProto) -> None:
    node(model, "Relu").domain = "com.microsoft"


def with_function(model: onnx.ModelProto) -> None:
    model.functions.append(helper.make_function("f", "F", ["a"], ["b"], [helper.make_node("Relu", ["a"], ["b"])], []))


def split_into(parts: int) -> Callable[[onnx.ModelProto], object]:
    def change(model: onnx.ModelProto) -> None:
        next(attribute for attribute in node(model, "Split").attribute if attribute.name == "num_outputs").i = parts

    return change


def estimating_by(example: Example) -> Callable[[onnx.ModelProto], object]:
    """NN_e replaced by a network of this node."""

    def change(model: onnx.ModelProto) -> None:
        network = Network(np.random.default_rng(0))
        with_network(model, network.model(network.example(example)[0]))

    return change


ATTACKS: dict[str, tuple[Callable[[onnx.ModelProto], object], str]] = {
    "a constant of a terabyte": (reshaped(4, 2**38), r"constant theta_lower with shape \[4, 274877906944\], type 1, \d+ bytes of data"),
    "a size that is 0 in 64 bits": (reshaped(2**32, 2**32), "constant theta_lower with shape"),
    "a negative size": (reshaped(-1, 4), "constant theta_lower with shape"),
    "no elements of endless rows": (reshaped(0, 2**62), "constant theta_lower with shape"),
    "too many axes": (reshaped(*[1] * 100), "constant theta_lower with shape"),
    "texts": (lambda model: setattr(initialiser(model, "theta_lower"), "data_type", TensorProto.STRING), "type 8"),
    "weights in another file": (external, "found external_data in a constant"),
    "typed data": (typed, "found float_data in a constant"),
    "sparse constants": (lambda model: model.graph.sparse_initializer.add().dims.append(2**40), "found sparse_initializer in a graph"),
    "two constants of a name": (lambda model: model.graph.initializer.append(model.graph.initializer[0]), "two constants rows_and_columns"),
    "functions": (with_function, "found functions"),
    "another domain": (of_domain, "operator Relu of com.microsoft"),
    "another operator set": (lambda model: model.opset_import.append(helper.make_opsetid("com.microsoft", 1)), "found operator sets"),
    "an old operator set": (lambda model: setattr(model.opset_import[0], "version", 9), "found operator sets"),
    "a graph in a node": (branching, "found a graph in an attribute"),
    "a tensor in a node": (tensor_in_a_node, "found a tensor in an attribute"),
    "a computed shape": (computed_shape, "Reshape with a shape that is computed"),
    "a split into fewer parts": (split_into(1), r"found Split of \d+ into \[\d+\] with 2 outputs"),
    "a padding of terabytes": (
        replaced("border", np.array([2**40, 0, 0, 2**40])),
        r"found \d+ bytes of tensors up to Pad; at most 2147483648 are taken",
    ),
    "blocks of 2^32": (
        estimating_by(Example("DepthToSpace", (Computed("<f4", (1, 4, 2, 2)),), 1, {"blocksize": 2**32})),
        "DepthToSpace with the attribute blocksize = 4294967296, which the operator does not take",
    ),
    "integers divided": (
        estimating_by(Example("Div", (Computed("<i4", (4,)), Computed("<i4", (4,))))),
        "Div of integers by what is computed; only floats, or integers by constants, are divided",
    ),
    "3,000 nodes in a row": (lambda model: with_chain(model, "Add", 3000), r"a graph with 3\d{3} fields node; at most 2048 are taken"),
    **{
        operator: (lambda model, operator=operator: setattr(node(model, "Relu"), "op_type", operator), f"found the operator {operator};")
        for operator in ("Expand", "Tile", "Range", "ConstantOfShape", "Resize", "Loop", "If", "Scan", "NonZero", "x" * 40)
    },
}


@pytest.fixture
def no_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """onnxruntime must not see the file."""

    def seen(*_arguments: object, **_options: object) -> None:
        pytest.fail("onnxruntime was given the file")

    monkeypatch.setattr(onnxruntime, "InferenceSession", seen)


@pytest.mark.usefixtures("no_session")
@pytest.mark.parametrize("attack", ATTACKS)
def test_a_forged_model_is_refused_before_anything_is_made_of_it(content: bytes, tmp_path: Path, attack: str) -> None:
    """One line that says what was found; memory no more than a few copies of the file."""
    change, message = ATTACKS[attack]
    path = tmp_path / "forged.onnx"
    path.write_bytes(forged(content, change))
    tracemalloc.start()
    with pytest.raises(ModelError, match=message) as caught:
        Estimator.load(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).isprintable()
    assert peak < 4 * len(content) + 2**20


@pytest.mark.usefixtures("no_session")
def test_scenes_that_do_not_fit_the_constants_are_refused(content: bytes, tmp_path: Path) -> None:
    """A camera of a terapixel, and a domain of a million million cells, of which the file has none."""
    scene = json.loads(onnx.ModelProto.FromString(content).metadata_props[0].value)["scene"]
    many = {"centres": [1.0 + place / 1000 for place in range(1000)], "width": 0.001}
    huge = {**scene["camera"], "width": 10**6}
    domain = {**scene["domain"], "x_m": many, "y_m": many, "z_m": many}
    cases = {
        r"scene in its metadata is unusable \(camera\.width: found 1000000;": {"scene": {**scene, "camera": huge}},
        "rows to every one of 1000000000 cells": {"scene": {**scene, "domain": domain}},
        "misstate the smallest": {"smallest_must_light": 10**9},
        "lack smallest_must_light": {"smallest_must_light": "9"},
        "scene in its metadata is unusable": {"scene": None},
    }
    path = tmp_path / "forged.onnx"
    for message, changes in cases.items():
        path.write_bytes(with_metadata(content, **changes))
        with pytest.raises(ModelError, match=message):
            Estimator.load(path)


def test_inputs_and_outputs_other_than_the_scenes_are_refused(content: bytes, tmp_path: Path) -> None:
    """An output that is missing, or of another shape than is declared: shapes are inferred, not believed."""

    def without_cell(model: onnx.ModelProto) -> None:
        model.graph.output.remove(next(value for value in model.graph.output if value.name == "cell"))

    def wider_state(model: onnx.ModelProto) -> None:
        value = next(value for value in model.graph.output if value.name == "network_state")
        value.type.tensor_type.shape.dim[0].dim_value = 5

    def another_input(model: onnx.ModelProto) -> None:
        model.graph.input.append(helper.make_tensor_value_info("more", TensorProto.FLOAT, [2**40]))

    path = tmp_path / "forged.onnx"
    for change, message in (
        (without_cell, "its outputs are"),
        (wider_state, r"found the output network_state stated as float32 \[5\] where it is float32 \[4\]"),
        (another_input, "its inputs are"),
    ):
        path.write_bytes(forged(content, change))
        with pytest.raises(ModelError, match=message):
            Estimator.load(path)


def test_a_model_that_fails_when_it_runs_is_a_model_error(content: bytes, tmp_path: Path) -> None:
    """Found by fuzzing: an index beyond its data is noticed by onnxruntime only when it looks there."""
    path = tmp_path / "forged.onnx"
    size = onnx.numpy_helper.to_array(initialiser(onnx.ModelProto.FromString(content), "must_light_place")).size
    path.write_bytes(forged(content, replaced("must_light_place", np.full(size, 2**30, dtype=np.int32))))
    estimator = Estimator.load(path)
    with pytest.raises(ModelError, match="onnxruntime cannot run it") as caught:
        estimator.estimate(np.zeros(estimator.scene.camera.shape, dtype=bool))
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("no_session")
def test_messages_that_protocol_buffers_would_merge_are_refused(content: bytes) -> None:
    """A second graph, or a second operator in a node, would be checked here and overruled there."""
    graph = onnx.ModelProto.FromString(content).graph
    with pytest.raises(ModelError, match="found graph twice in a file"):
        parse_model(content + b"\x3a\x02\x12\x00", "model")
    twice = graph.node[0].SerializeToString() + b"\x22\x04Loop"
    assert onnx.NodeProto.FromString(twice).op_type == "Loop"
    with pytest.raises(ModelError, match="found op_type twice in a node"):
        check_graph(b"\x0a" + bytes([len(twice)]) + twice)


@pytest.mark.usefixtures("no_session")
def test_sizes_are_limited_before_anything_is_read(content: bytes, tmp_path: Path) -> None:
    """A file that is all a hole, twice as long as is read; a pipe; a folder; metadata and numbers of fields beyond the limits."""
    large, pipe = tmp_path / "large.onnx", tmp_path / "pipe.onnx"
    with large.open("wb") as file:
        file.truncate(2 * LARGEST_FILE_BYTES)
    os.mkfifo(pipe)
    found = {large: f"of {2 * LARGEST_FILE_BYTES} bytes", **dict.fromkeys((pipe, tmp_path), "no file but a folder, a device or a pipe")}
    for path, kind in found.items():
        with pytest.raises(ModelError) as caught:
            Estimator.load(path)
        assert str(caught.value) == f"{path}: is {kind}; give the path of a model that export-model wrote, of up to 128 MiB"
    with pytest.raises(ModelError, match=r"found metadata of \d+ bytes; at most"):
        parse_model(with_metadata(content, assumptions=["x" * LARGEST_METADATA_BYTES]), "model")
    with pytest.raises(ModelError, match=f"found more than {LARGEST_FIELDS} fields"):
        check_graph(b"\x0a\x00" * (LARGEST_FIELDS + 1))


@pytest.mark.usefixtures("no_session")
def test_the_callers_digest_is_compared_before_the_file_is_parsed(tmp_path: Path) -> None:
    (tmp_path / "garbage.onnx").write_bytes(b"garbage")
    with pytest.raises(ModelError, match="the caller trusts"):
        Estimator.load(tmp_path / "garbage.onnx", sha256="0" * 64)


@pytest.mark.parametrize("name", ["paper", "free x", "tolerant, cut left"])
def test_every_model_of_ours_is_taken(model_of: ModelOf, name: str) -> None:
    assert Estimator.load(model_of(name)).metadata["seed"] == 1

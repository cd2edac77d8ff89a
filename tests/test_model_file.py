"""Reading a model file's wire format without onnx, against onnx; and every kind of file that is not a sound model."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from runtime.estimator import BOX_TENSORS, Estimator
from runtime.model_file import FORMAT_VERSION, METADATA_KEY, ModelError, metadata_digest, parse_model

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
    model = helper.make_model(graph)
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
        tmp_path: "cannot be read",
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

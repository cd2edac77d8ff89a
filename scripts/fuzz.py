"""Feeds damaged and hostile files to everything that reads one, and looks for anything but our own errors.

    python scripts/fuzz.py --minutes 10

Targets: `Estimator.load` with model files; networks as `export-model --estimator` takes them (`scripts/fuzz_networks.py`); `Scene.load`
with scene files; `read_events` with recordings of every kind (then `FrameStream`); `events_to_frames` with arrays of any type. Inputs
are valid ones with bytes changed, cut or repeated; model files also with lengths, dims, attributes, constants, nodes and metadata
changed as an attacker would, their digests recomputed; scene files with numbers and keys replaced.

Cases run in a worker process with a limit on its memory. A case that raises another error than ours, takes longer than `CASE_SECONDS`,
takes the processor for longer than `LOAD_SECONDS` to load or refuse a model, or ends the worker (a crash, or memory beyond the limit) is
a finding: its input and its traceback are kept in the output folder, and the exit code is 1. Each case has a number: the same seed and
number give the same input.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import hashlib
import json
import multiprocessing
import re
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import onnx
from fuzz_networks import CHAINED, CHAINS, fuzzed_network, run_network, with_chain, with_network
from onnx import TensorProto, helper, numpy_helper
from onnx.checker import ValidationError

from build_model.user_network import EstimatorError
from runtime import Estimator, FrameError, FrameStream, ModelError, SceneError, terminal
from runtime.frames import EventError, events_to_frames
from runtime.model.model_file import METADATA_KEY, metadata_digest
from runtime.recordings.recording import RecordingError, read_events
from runtime.scene import Scene

CASE_SECONDS = 60
"""A case that takes longer hangs; a machine that is busy otherwise is given time."""
LOAD_SECONDS = 2
"""Processor time that loading or refusing a model may take."""
MEMORY_BYTES = 4 * 2**30
"""Address space of a worker: several times what a valid file takes, of which onnxruntime's threads and libraries reserve much."""
OWN_ERRORS = (ModelError, SceneError, RecordingError, EventError, FrameError, EstimatorError)
SHAPE = (10, 20)
FAERY_KINDS: dict[str, Any] = {".evt2.raw": "evt2", ".evt3.raw": "evt3", ".dat": "dat2", ".es": None, ".aedat4": None, ".csv": None}
"""Recordings that faery writes: the end of a name, and faery's name of the version."""
SIZES = (0, 1, 2, 7, 127, 128, 255, 2**15, 2**20, 2**31 - 1, 2**31, 2**32, 2**40, 2**62, 2**63 - 1, -1, -(2**31), -(2**63))
NUMBERS = (
    "0",
    "-1",
    "1e308",
    "-1e308",
    "nan",
    "inf",
    "1e-320",
    "16384",
    "16385",
    "99999999999999999999",
    "true",
    '"a"',
    "[]",
    "{}",
    "1.5",
    "[[1]]",
)
REPOSITORY = Path(__file__).parents[1]

Random = np.random.Generator
Case = tuple[str, bytes]
"""Suffix and content of a file."""


def changed_bytes(rng: Random, content: bytes) -> bytes:
    """A few bytes set, a part cut out or repeated, or the end cut off."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        start = int(rng.integers(len(data) + 1))
        stop = min(len(data), start + int(2 ** rng.uniform(0, 12)))
        kind = rng.integers(5)
        if kind == 0:
            data[start : start + 1] = rng.bytes(1)
        elif kind == 1:
            del data[start:stop]
        elif kind == 2:
            data[start:start] = data[start:stop]
        elif kind == 3:
            data[start : start + 9] = b"\xff" * 9
        else:
            del data[start:]
    return bytes(data)


# --- model files ---


def fuzzed_model(rng: Random, seeds: dict[str, bytes]) -> Case:
    """A model with bytes changed, or with its messages changed and its digests recomputed."""
    content = seeds["model"]
    if rng.random() < 0.3:
        return ".onnx", changed_bytes(rng, content)
    model = onnx.ModelProto.FromString(content)
    metadata = json.loads(model.metadata_props[0].value)
    for _ in range(int(rng.integers(1, 3))):
        change = MODEL_CHANGES[int(rng.integers(len(MODEL_CHANGES)))]
        # onnx's own classes refuse some numbers, and to read what an earlier change made foreign
        with contextlib.suppress(ValueError, OverflowError, LookupError, TypeError, ValidationError):
            change(rng, model, metadata)
    graph = model.graph.SerializeToString(deterministic=True)
    if rng.random() < 0.2:
        graph = changed_bytes(rng, graph)
    return ".onnx", sealed(model, graph, metadata)


def sealed(model: onnx.ModelProto, graph: bytes, metadata: dict[str, Any]) -> bytes:
    """The file with this graph and these metadata, their digests recomputed."""
    metadata["graph_sha256"] = hashlib.sha256(graph).hexdigest()
    metadata["metadata_sha256"] = metadata_digest(metadata)
    outer = onnx.ModelProto()
    outer.CopyFrom(model)
    outer.ClearField("graph")
    for entry in outer.metadata_props:
        entry.value = json.dumps(metadata) if entry.key == METADATA_KEY else entry.value
    length, prefix = len(graph), b"\x3a"
    while length > 127:
        prefix, length = prefix + bytes([length & 127 | 128]), length >> 7
    return outer.SerializeToString() + prefix + bytes([length]) + graph


def _size(rng: Random) -> int:
    return int(SIZES[rng.integers(len(SIZES))])


def _pick(rng: Random, values: Any) -> Any:
    """One of the values."""
    return values[int(rng.integers(len(values)))]


def _dims(rng: Random, model: onnx.ModelProto, _metadata: dict[str, Any]) -> None:
    tensor = _pick(rng, model.graph.initializer)
    if len(tensor.dims) and rng.random() < 0.7:
        tensor.dims[int(rng.integers(len(tensor.dims)))] = _size(rng)
    else:
        tensor.dims.append(_size(rng))


def _constant(rng: Random, model: onnx.ModelProto, _metadata: dict[str, Any]) -> None:
    """Other values, of the same or of another shape and type: shapes, axes, paddings and indices among them."""
    tensor = _pick(rng, model.graph.initializer)
    values = numpy_helper.to_array(tensor).copy()
    if rng.random() < 0.5 and values.size:
        with np.errstate(all="ignore"):
            values.ravel()[int(rng.integers(values.size))] = np.array(float(_size(rng))).astype(values.dtype)
    elif rng.random() < 0.5:
        values = values.ravel()[: int(rng.integers(values.size + 1))]
    else:
        with np.errstate(invalid="ignore"):  # whatever a cast makes of numbers out of range
            values = np.nan_to_num(values).astype(_pick(rng, (np.float32, np.int32, np.int64, np.float64, np.uint8)))
    tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))


def _attribute(rng: Random, model: onnx.ModelProto, _metadata: dict[str, Any]) -> None:
    node = _pick(rng, [node for node in model.graph.node if node.attribute])
    attribute = _pick(rng, node.attribute)
    if attribute.type == onnx.AttributeProto.INT:
        attribute.i = _size(rng)
    elif attribute.ints:
        attribute.ints[int(rng.integers(len(attribute.ints)))] = _size(rng)
    elif attribute.type == onnx.AttributeProto.STRING:
        attribute.s = rng.bytes(int(rng.integers(200)))
    else:
        attribute.f = float(_size(rng))


def _operator(rng: Random, model: onnx.ModelProto, _metadata: dict[str, Any]) -> None:
    node = _pick(rng, model.graph.node)
    node.op_type = _pick(
        rng, ("Expand", "Tile", "Loop", "If", "Range", "ConstantOfShape", "Resize", *(n.op_type for n in model.graph.node))
    )


def _network(rng: Random, model: onnx.ModelProto, _metadata: dict[str, Any]) -> None:
    """Another NN_e, or a longer one."""
    if rng.random() < 0.7:
        with_network(model, fuzzed_network(rng))
    else:
        with_chain(model, _pick(rng, CHAINED), int(_pick(rng, CHAINS)))


def _wiring(rng: Random, model: onnx.ModelProto, _metadata: dict[str, Any]) -> None:
    node, other = _pick(rng, model.graph.node), _pick(rng, model.graph.node)
    kind = rng.integers(4)
    if kind == 0 and node.input:
        node.input[int(rng.integers(len(node.input)))] = _pick(rng, [*other.output, "", "frame", _pick(rng, model.graph.initializer).name])
    elif kind == 1:
        node.output[0] = other.output[0]
    elif kind == 2:
        model.graph.node.remove(node)
    else:
        model.graph.node.append(other)


def _interface(rng: Random, model: onnx.ModelProto, _metadata: dict[str, Any]) -> None:
    value = _pick(rng, [*model.graph.input, *model.graph.output])
    tensor = value.type.tensor_type
    if tensor.shape.dim and rng.random() < 0.5:
        _pick(rng, tensor.shape.dim).dim_value = _size(rng)
    elif rng.random() < 0.5:
        tensor.elem_type = int(rng.integers(24))
    else:
        value.name = _pick(rng, ("frame", "cell", "", "x" * 1000))


def _foreign(rng: Random, model: onnx.ModelProto, _metadata: dict[str, Any]) -> None:
    """Weights in another file, other domains, functions, graphs in nodes, sparse and typed constants."""
    tensor, node = _pick(rng, model.graph.initializer), _pick(rng, model.graph.node)
    kind = rng.integers(7)
    if kind == 0:
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=_pick(rng, ("/etc/passwd", "../x", "*/_ORT_MEM_ADDR_/*")))
        tensor.ClearField("raw_data")
    elif kind == 1:
        node.domain = _pick(rng, ("com.microsoft", "ai.onnx.ml", "x" * 1000))
        model.opset_import.append(helper.make_opsetid(node.domain, 1))
    elif kind == 2:
        body = helper.make_graph([helper.make_node("Identity", ["frame"], ["y"])], "b", [], [])
        node.attribute.append(helper.make_attribute("body", body))
    elif kind == 3:
        model.functions.append(helper.make_function("f", "F", ["a"], ["b"], [helper.make_node("F", ["a"], ["b"], domain="f")], []))
    elif kind == 4:
        model.graph.sparse_initializer.add().dims.append(_size(rng))
    elif kind == 5:
        model.opset_import[0].version = _size(rng)
    else:
        tensor.data_type = int(rng.integers(24))


def _scene_value(rng: Random, _model: onnx.ModelProto, metadata: dict[str, Any]) -> None:
    """A value somewhere in the metadata."""
    holder: Any = metadata
    while True:
        key = _pick(rng, list(holder) if isinstance(holder, dict) else range(len(holder)))
        if isinstance(holder[key], dict | list) and holder[key] and rng.random() < 0.9:
            holder = holder[key]
            continue
        holder[key] = _pick(rng, (*SIZES, 1e308, float("nan"), float("inf"), None, "a", [], {}, [[[]]], True, 10**400 // 3, [0.5] * 1000))
        return


MODEL_CHANGES: tuple[Callable[[Random, onnx.ModelProto, dict[str, Any]], None], ...] = (
    _dims,
    _constant,
    _attribute,
    _operator,
    _network,
    _wiring,
    _interface,
    _foreign,
    _scene_value,
)


# --- networks, scene files, recordings, arrays of events ---


def fuzzed_estimator(rng: Random, _seeds: dict[str, bytes]) -> Case:
    """A network of a user's."""
    return ".onnx", fuzzed_network(rng).SerializeToString()


def fuzzed_scene(rng: Random, seeds: dict[str, bytes]) -> Case:
    """A scene file with bytes changed, or with numbers and keys replaced."""
    text = seeds["scene"].decode()
    if rng.random() < 0.3:
        return ".toml", changed_bytes(rng, text.encode())
    for _ in range(int(rng.integers(1, 4))):
        places = list(re.finditer(r"(?<==\s)[^\s,\]}]+|(?<=\[)[\d.]+|^\w+(?= =)|^\[+[\w.]+\]+", text, re.MULTILINE))
        place = _pick(rng, places)
        text = text[: place.start()] + _pick(rng, (*NUMBERS, "[" * 5000, "é", "\x00", "a.b.c")) + text[place.end() :]
    return ".toml", text.encode()


def fuzzed_recording(rng: Random, seeds: dict[str, bytes]) -> Case:
    """A recording with bytes changed."""
    name = _pick(rng, [name for name in seeds if name.startswith(".")])
    return Path(f"a{name}").suffix, changed_bytes(rng, seeds[name])


def fuzzed_events(rng: Random, _seeds: dict[str, bytes]) -> Case:
    """The choices that `events_of` makes."""
    return ".npy", rng.bytes(8)


def events_of(content: bytes) -> tuple[np.ndarray, dict[str, Any]]:
    """Events of any types, fields and values, and the arguments to turn them into frames with.

    The sensor is so large that no arguments here make gigabytes of frames that `events_to_frames` would still give.
    """
    rng = np.random.default_rng(int.from_bytes(content, "little"))
    kinds = ("i8", "u8", "i4", "u2", "i1", "f8", "?", "S3", "O", "(2,)i4", ">i8", "m8[us]", "c16")
    fields = [(name, _pick(rng, kinds[:7] if rng.random() < 0.9 else kinds)) for name in "txyp" if rng.random() < 0.97]
    events = np.zeros(int(rng.integers(0, 50)), dtype=fields)
    for name in events.dtype.names or ():
        if events[name].dtype.kind in "iu" and events[name].ndim == 1:
            limits = np.iinfo(events[name].dtype)
            low, high = (limits.min, limits.max) if rng.random() < 0.2 else (0, 10)
            events[name] = rng.integers(low, high, len(events), dtype=events[name].dtype.newbyteorder("="), endpoint=True)
    if rng.random() < 0.1:
        events = events.reshape(1, -1)
    sizes = (0, 1, 3, 10, 1000, 2**20, 2**40, 2**61, 2**63, -1, 1.5, None, "a")
    weights = np.array([1, 4, 4, 4, 4] + [1] * 8) / 25
    window, step = (sizes[int(rng.choice(len(sizes), p=weights))] for _ in range(2))
    shape = (1100, 1100) if rng.random() < 0.8 else (_pick(rng, sizes), _pick(rng, sizes))
    return events, {"shape": shape, "window_us": window, "step_us": step}


# --- the targets ---


def load_model(path: Path) -> None:
    """Loads the model and, if it is accepted, estimates from two frames."""
    start = time.process_time()
    try:
        estimator = Estimator.load(path)
    finally:
        if (spent := time.process_time() - start) > LOAD_SECONDS:
            raise RuntimeError(f"loaded or refused after more than {LOAD_SECONDS} s") from TimeoutError(f"{spent:.1f} s")
    for frame in (np.zeros(estimator.scene.camera.shape, dtype=np.uint8), np.ones(estimator.scene.camera.shape, dtype=np.uint8)):
        estimator.run(frame)


def load_scene(path: Path) -> None:
    """Loads the scene."""
    Scene.load(path)


def read_recording(path: Path) -> None:
    """Reads a recording without and with its size, and makes up to 1000 of its frames."""
    with contextlib.suppress(*OWN_ERRORS):
        collections.deque(read_events(path), maxlen=0)
    for _ in zip(range(1000), FrameStream(SHAPE, 1000).frames(read_events(path, SHAPE)), strict=False):
        pass


def make_frames(path: Path) -> None:
    """Makes frames of an array, whole and in packets."""
    events, arguments = events_of(path.read_bytes())
    with contextlib.suppress(*OWN_ERRORS):
        for _ in zip(range(20), FrameStream(**arguments).frames([events[:5], events[5:]]), strict=False):
            pass
    events_to_frames(events, **arguments)


TARGETS: dict[str, tuple[Callable[[Random, dict[str, bytes]], Case], Callable[[Path], None]]] = {
    "model": (fuzzed_model, load_model),
    "network": (fuzzed_estimator, run_network),
    "scene": (fuzzed_scene, load_scene),
    "recording": (fuzzed_recording, read_recording),
    "events": (fuzzed_events, make_frames),
}


def seed_files(model: Path, scene: Path) -> dict[str, bytes]:
    """Valid inputs, which the cases are made from: a model, a scene, and the same events as a recording of every kind."""
    import faery

    seeds = {"model": model.read_bytes(), "scene": scene.read_bytes()}
    rng, count = np.random.default_rng(0), 300
    columns: dict[str, Any] = {
        "t": np.sort(rng.integers(0, 20_000, count)),
        "x": rng.integers(0, 20, count),
        "y": rng.integers(0, 10, count),
    }
    columns["p"] = rng.integers(0, 2, count)
    packet = np.empty(count, dtype=faery.EVENTS_DTYPE)
    packet["t"], packet["x"], packet["y"], packet["on"] = columns.values()
    with tempfile.TemporaryDirectory() as folder:
        for name, version in FAERY_KINDS.items():
            path = Path(folder) / f"a{name}"
            faery.events_stream_from_array(packet, dimensions=(SHAPE[1], SHAPE[0])).to_file(str(path), version=version)
            seeds[name] = path.read_bytes()
        np.savez(Path(folder) / "a.npz", **columns)
        np.savez_compressed(Path(folder) / "b.npz", **columns)
        with h5py.File(Path(folder) / "a.h5", "w") as file:
            for name, values in columns.items():
                file.create_dataset(name, data=values, chunks=True, compression="gzip")
            file["davis/left/events"] = np.stack(list(columns.values()), axis=1)
        np.save(Path(folder) / "a.npy", np.stack(list(columns.values()), axis=1))
        seconds = np.stack([columns["t"] / 1e6, *list(columns.values())[1:]], axis=1)
        np.savetxt(Path(folder) / "a.txt", seconds, fmt="%.6f %d %d %d", header="20 10", comments="")
        (Path(folder) / "a.evt21").write_bytes(evt21_file(columns))
        names = {".plain.npz": "a.npz", ".packed.npz": "b.npz", ".h5": "a.h5", ".npy": "a.npy", ".txt": "a.txt", ".evt21.raw": "a.evt21"}
        for name, source in names.items():
            seeds[name] = (Path(folder) / source).read_bytes()
    return seeds


def evt21_file(columns: dict[str, Any]) -> bytes:
    """The events as an EVT2.1 file, which faery does not write: a TIME_HIGH word before each, and a mask of one column."""
    t, x, y, p = (columns[name].astype(np.uint64) for name in "txyp")
    high = np.uint64(8) << np.uint64(60) | t >> np.uint64(6) << np.uint64(32)
    event = p << np.uint64(60) | (t & np.uint64(63)) << np.uint64(54) | x << np.uint64(43) | y << np.uint64(32) | np.uint64(1)
    header = f"% evt 2.1\n% endianness little\n% geometry {SHAPE[1]}x{SHAPE[0]}\n% end\n"
    return header.encode() + np.stack([high, event], axis=1).astype("<u8").tobytes()


def made_case(target: str, number: int, seed: int, seeds: dict[str, bytes]) -> Case:
    """Input `number` of a target."""
    return TARGETS[target][0](np.random.default_rng([seed, number, *target.encode()]), seeds)


# --- the workers ---


def work(pipe: Connection, folder: Path) -> None:
    """Runs the cases that come through the pipe; answers with how each ended and, for a finding, the traceback."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    while True:
        target, suffix, content = pipe.recv()
        path = folder / f"case{suffix}"
        path.write_bytes(content)
        try:
            TARGETS[target][1](path)
            pipe.send(("accepted", ""))
        except OWN_ERRORS as error:
            pipe.send(("refused", "" if "\n" not in str(error) else f"an error of several lines: {error}"))
        except BaseException:
            pipe.send(("failed", traceback.format_exc()))


class Worker:
    """A process that runs cases, started anew when one ends it or does not end."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=work, args=(other, self.folder), daemon=True)
        self.process.start()
        other.close()

    def run(self, target: str, case: Case) -> tuple[str, str]:
        """How the case ended, and what is wrong with that; empty if nothing is."""
        self.pipe.send((target, *case))
        if not self.pipe.poll(CASE_SECONDS):
            return self._ended("hung", f"no answer within {CASE_SECONDS} s")
        try:
            return self.pipe.recv()
        except EOFError:
            self.process.join()
            return self._ended("crashed", f"the process ended with exit code {self.process.exitcode}")

    def _ended(self, how: str, why: str) -> tuple[str, str]:
        self.close()
        self._start()
        return how, why

    def close(self) -> None:
        """Ends the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def fuzz(targets: list[str], minutes: float, seed: int, seeds: dict[str, bytes], output: Path) -> bool:
    """Runs cases of all targets in turn until the time is over. Returns True if there is no finding."""
    from rich.progress import Progress

    counts: dict[str, collections.Counter[str]] = {target: collections.Counter() for target in targets}
    findings, number, start, passed = set(), 0, time.monotonic(), 0.0
    with tempfile.TemporaryDirectory() as folder, Progress() as progress:
        bar, worker = progress.add_task("fuzzing", total=minutes * 60), Worker(Path(folder))
        while passed < minutes * 60:
            for target in targets:
                case = made_case(target, number, seed, seeds)
                how, why = worker.run(target, case)
                counts[target][how] += 1
                key = (target, how, why.splitlines()[-1] if why else "")
                if why and key not in findings:
                    findings.add(key)
                    keep(output, f"{target}-{seed}-{number}", case, why)
                    progress.console.print(f"{target} {number}: {how}: {key[2]}", markup=False)
            number += 1
            passed = time.monotonic() - start
            progress.update(bar, completed=passed, description=f"{number} rounds, {len(findings)} findings")
        worker.close()
    console = terminal.console()
    for target, ended in counts.items():
        console.print(f"{target}: {ended.total()} cases, {', '.join(f'{count} {how}' for how, count in sorted(ended.items()))}")
    console.print(f"{len(findings)} findings{f', kept in {output}' if findings else ''}")
    return not findings


def keep(output: Path, name: str, case: Case, why: str) -> None:
    """Writes a finding's input and what was wrong."""
    output.mkdir(parents=True, exist_ok=True)
    suffix, content = case
    (output / f"{name}{suffix}").write_bytes(content)
    (output / f"{name}.txt").write_text(why)


def main() -> int:
    """Parses the arguments; exit code 0 if nothing was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, nargs="?", default=REPOSITORY / "models" / "paper.onnx", help="model to start from")
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", choices=TARGETS, action="append", help="only this one; may be given several times")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/fuzz"), help="folder for findings")
    arguments = parser.parse_args()
    seeds = seed_files(arguments.model, REPOSITORY / "models" / "paper.toml")
    return 0 if fuzz(arguments.target or list(TARGETS), arguments.minutes, arguments.seed, seeds, arguments.output) else 1


if __name__ == "__main__":
    sys.exit(main())

"""export-model: scene in, one ONNX file with NN_F and NN_e out.

The certified part is built cell by cell (`hough_bank`), laid out (`assembly`) and written as a graph (`filter_graph`); NN_e is trained on
frames that this very graph filters (`state_network`), or taken from the user (`user_network`). Both become one graph, with everything
that a runtime or a verifier must know in its metadata. The same scene, seed and versions give the same bytes, whoever builds the cells.
"""

from __future__ import annotations

import hashlib
import json
import platform
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib import metadata as distributions
from pathlib import Path
from typing import Any, cast

import joblib
import numpy as np
import onnx
import onnx.compose
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper

from build_model.assembly import assemble
from build_model.bank_graph import GraphWriter
from build_model.build_size import BuildTooLargeError, Ledger
from build_model.calibration import check_calibration
from build_model.filter_graph import filter_graph
from build_model.filter_tables import BankTables
from build_model.hough_bank import CellBank, cell_bank
from build_model.paper.paper_bound import PaperBound, paper_bound
from build_model.partition import partition
from build_model.state_network import TrainingReport, domain_window, state_graph, train_state_network
from build_model.user_network import bare, given_network
from build_model.window import Bits
from build_model.window_bank import CellWindows, cell_windows
from runtime.assumptions import assumptions
from runtime.model.format import FORMAT_VERSION, IR_VERSION, METADATA_KEY, NETWORK_OUTPUT, NETWORK_PREFIX, OPSET, metadata_digest
from runtime.rounding import OUTWARD_PX
from runtime.scene import Scene, WindowedBank
from runtime.sensor import Sensor
from runtime.whole_file import write_whole

Progress = Callable[[str, int, int, float | None], None]
"""Called with a stage, steps done, steps in all, and the loss where there is one."""
CONNECT_SECONDS = 10
"""How long the scheduler of a cluster may take to answer."""
VERSIONS = ("glideproof", "numpy", "onnx", "onnxruntime", "torch")


class ClusterError(RuntimeError):
    """A cluster that cannot be used."""


@dataclass(frozen=True)
class ExportReport:
    """What was built, for the summary."""

    cells: int
    entries: int
    smallest_must_light: int
    spatial_pixels: NDArray[np.int64]
    displacement_px: float
    paper_bounds: list[PaperBound | None]
    """Of every cell, as `paper_bounds` gives them."""
    file_bytes: int
    sha256: str
    seconds: dict[str, float]
    training: TrainingReport | None


@dataclass
class _Stopwatch:
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start


def _silent(_stage: str, _done: int, _total: int, _loss: float | None) -> None:
    pass


def export_model(
    scene: Scene,
    path: str | Path,
    *,
    estimator: str | Path | None = None,
    seed: int = 0,
    jobs: int = 1,
    dask: str | None = None,
    memory_mb: float | None = None,
    progress: Progress = _silent,
) -> ExportReport:
    """Builds the scene's model and writes it to `path`, whole or not at all.

    `estimator`: an ONNX file to serve as NN_e in place of a trained one, or `NO_ESTIMATOR`. `jobs`, `dask`: who builds the cells
    (`build_banks`). `memory_mb`: what the build may take; by default all there is. Raises `SceneError` for a scene that has no certificate,
    or whose tables do not fit into that, `EstimatorError` for a network that does not fit, `ClusterError` for a cluster that cannot be
    used, OSError if the file cannot be written.
    """
    watch = _Stopwatch()
    sensor = Sensor.of(scene)
    ideal = sensor.ideal
    given = given_network(ideal, estimator)
    with watch.stage("NN_F"):
        if not ideal.calibration.exact:
            check_calibration(ideal, domain_window(ideal))  # of the tables' window again below: this spares a build in vain
        banks = build_banks(ideal, jobs, progress, dask, memory_mb, sensor.unseen)
        tables = assemble(ideal, banks)
        shift_px = check_calibration(ideal, tables.window)
        filter_part = filter_graph(ideal, tables)
    with watch.stage("NN_e"):
        network, report = (given, None) if given is not None else _trained_network(sensor, filter_part, seed, progress)
    with watch.stage("file"):
        graph = _joined(filter_part, network)
        bounds = paper_bounds(ideal, jobs, dask)
        content = _serialised(graph, _metadata(sensor, tables, graph, shift_px, bounds, report, seed))
        write_whole(Path(path), content)
    return ExportReport(
        cells=len(banks),
        entries=tables.entries,
        smallest_must_light=tables.smallest_must_light,
        spatial_pixels=np.array([bank.spatial_pixels for bank in banks]),
        displacement_px=shift_px,
        paper_bounds=bounds,
        file_bytes=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
        seconds=watch.seconds,
        training=report,
    )


def build_banks(
    scene: Scene,
    jobs: int = 1,
    progress: Progress = _silent,
    dask: str | None = None,
    memory_mb: float | None = None,
    unseen: Bits | None = None,
) -> list[CellBank] | list[CellWindows]:
    """S, entries, and O and K or windows of every cell, in the order of the partition.

    Pixels that are `unseen`, (height, width), and so lit in any frame, are in no K and in no window. Cells are independent: `jobs` local
    processes build them, or the workers of the dask.distributed scheduler at the address `dask`, who must have the same version of this
    package; cells of a worker that is lost are built by another one. Raises `ClusterError`, and `BuildTooLargeError` where the tables
    of the cells will take more than `memory_mb`, or memory runs out.
    """
    cells = partition(scene)
    ledger = None if memory_mb is None else Ledger(len(cells), memory_mb)
    build = cell_windows if isinstance(scene.bank, WindowedBank) else cell_bank
    work = (joblib.delayed(build)(scene, lower, upper, unseen) for lower, upper in zip(cells.lower, cells.upper, strict=True))
    banks = []
    with _workers(jobs, dask):
        for bank in joblib.Parallel(return_as="generator")(work):
            banks.append(bank)
            if ledger is not None:
                ledger.add(cast(CellBank | CellWindows, bank))
            progress("cells", len(banks), len(cells), None)
    return banks


def paper_bounds(scene: Scene, jobs: int = 1, dask: str | None = None) -> list[PaperBound | None]:
    """The paper's bound of every cell, in the order of the partition, by the workers of `build_banks`. Raises `ClusterError`.

    None for a cell without a finite bound, such as one that is a single state.
    """
    cells = partition(scene)
    if (cells.lower == cells.upper).all():
        return [None] * len(cells)
    work = (joblib.delayed(paper_bound)(scene, lower, upper) for lower, upper in zip(cells.lower, cells.upper, strict=True))
    with _workers(jobs, dask):
        return [cast(PaperBound | None, bound) for bound in joblib.Parallel(return_as="generator")(work)]


@contextmanager
def _workers(jobs: int, dask: str | None) -> Iterator[None]:
    """Where joblib runs its calls: local processes, or a dask cluster."""
    if dask is None:
        try:
            with joblib.parallel_config(n_jobs=jobs):
                yield
        except (MemoryError, BrokenProcessPool) as error:
            raise BuildTooLargeError(f"--jobs: found {jobs}; a process that builds cells had no memory left: give fewer") from error
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise ClusterError(f"--dask {dask}: the package {error.name!r} is missing; pip install 'glideproof[cluster]'") from error
    try:
        client = Client(dask, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterError(
            f"--dask {dask}: no scheduler answers there ({error}); start one with `dask scheduler`, or use --jobs"
        ) from error
    with client, joblib.parallel_config(backend="dask", client=client):
        yield


def filter_function(filter_part: onnx.GraphProto) -> Callable[[NDArray[np.uint8]], NDArray[np.uint8]]:
    """NN_F alone as a function from frames (n, height, width) to filtered frames of the same shape and order, on two threads."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3  # it warns of the budgets, initialisers that are inputs too
    session = onnxruntime.InferenceSession(_serialised(filter_part, {}), options, providers=["CPUExecutionProvider"])

    def filtered(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(session.run(["filtered"], {"frame": frame})[0])

    pool = ThreadPoolExecutor(2)
    return lambda frames: np.stack(list(pool.map(filtered, frames)))


def _trained_network(sensor: Sensor, filter_part: onnx.GraphProto, seed: int, progress: Progress) -> tuple[onnx.GraphProto, TrainingReport]:
    """NN_e as a graph, trained on what NN_F lets through."""
    network, report = train_state_network(sensor.ideal, filter_function(filter_part), seed, progress, sensor)
    return state_graph(network, OPSET).graph, report


def _joined(filter_part: onnx.GraphProto, network: onnx.GraphProto) -> onnx.GraphProto:
    """NN_e behind NN_F: `network_state` = NN_e(filtered)."""
    g = GraphWriter()
    network = onnx.compose.add_prefix_graph(bare(network), NETWORK_PREFIX)
    image = g.node("Unsqueeze", "filtered_image", "filtered", g.whole("batch_and_channel", 0, 1))
    elem_type = network.input[0].type.tensor_type.elem_type
    image = image if elem_type == TensorProto.UINT8 else g.node("Cast", "filtered_float", image, to=TensorProto.FLOAT)
    feed = helper.make_node("Identity", [image], [network.input[0].name], name="network_input")
    g.node("Reshape", NETWORK_OUTPUT, network.output[0].name, g.whole("state_shape", 4))
    joined = onnx.GraphProto()
    joined.CopyFrom(filter_part)
    joined.node.extend([*g.nodes[:-1], feed, *network.node, g.nodes[-1]])
    joined.initializer.extend([*g.constants, *network.initializer])
    joined.output.append(helper.make_tensor_value_info(NETWORK_OUTPUT, TensorProto.FLOAT, [4]))
    return joined


def _metadata(
    sensor: Sensor,
    tables: BankTables,
    graph: onnx.GraphProto,
    shift_px: float,
    bounds: list[PaperBound | None],
    report: TrainingReport | None,
    seed: int,
) -> dict[str, Any]:
    scene, through = sensor.scene, {}
    if sensor.map is not None:
        through = {"ideal_camera": sensor.ideal.to_dict()["camera"], "ideal_pixels_a_pixel": sensor.pixels_a_pixel}
    return {
        **through,
        "format_version": FORMAT_VERSION,
        "scene": scene.to_dict(),
        "graph_sha256": hashlib.sha256(graph.SerializeToString(deterministic=True)).hexdigest(),
        "smallest_must_light": tables.smallest_must_light,
        "margin_px": OUTWARD_PX,
        "calibration_shift_px": shift_px,
        "assumptions": assumptions(scene),
        "paper_bounds": [None if bound is None else asdict(bound) for bound in bounds],
        "training": None if report is None else asdict(report),
        "seed": seed,
        "versions": {"python": platform.python_version(), **{name: distributions.version(name) for name in VERSIONS}},
    }


def _serialised(graph: onnx.GraphProto, metadata: dict[str, Any]) -> bytes:
    """The model file: graph, versions and metadata with their digest, checked by onnx."""
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="glideproof")
    signed = {**metadata, "metadata_sha256": metadata_digest(metadata)}
    helper.set_model_props(model, {METADATA_KEY: json.dumps(signed, sort_keys=True)})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)

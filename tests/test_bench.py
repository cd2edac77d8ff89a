"""bench-model: what is timed is what the table says; and the work that the paper's model does a frame. Nothing here looks at the clock."""

from __future__ import annotations

import csv
import itertools
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest

from build_model.assembly import row_width, rows_filled
from runtime.estimator import Estimator
from runtime.recordings.bench import (
    REFERENCE,
    WARM_UP,
    Latency,
    as_csv,
    benchmark,
    cluttered_frames,
    latencies,
    measure,
    rate,
    throughput,
)
from runtime.recordings.chart import BLUE
from runtime.recordings.latency_chart import latency_chart
from runtime.scene import Scene

COMMAND = [sys.executable, "-c", "from runtime.recordings.cli import bench_model_command; bench_model_command()"]
HEADER = {"processor": "abacus", "opencv": "5"}
LEGEND_PX = 60
"""Rows of the chart above its panels."""


def row(frames: str, method: str, p50_ms: float) -> Latency:
    return Latency(frames, method, p50_ms, 2 * p50_ms, 3 * p50_ms, 1.0)


def test_methods_take_turns_on_the_same_frames_and_detectors_see_255() -> None:
    frames = [np.full((2, 3), number == 1, dtype=np.uint8) for number in range(3)]
    seen = []
    ticks = itertools.count()
    timed = {name: lambda image, name=name: seen.append((name, int(image[0, 0]))) for name in ("session.run", REFERENCE)}
    spent = measure(timed, frames, rounds=2, clock=lambda: float(next(ticks)))
    on = [[(name, value * (255 if name == REFERENCE else 1)) for value in (0, 1, 0)] for name in timed]
    expected = [on[method][index] for turn in range(6) for method in (0, 1) for index in ((turn - 1) % 3, turn % 3)]
    assert seen == expected
    assert {name: times.tolist() for name, times in spent.items()} == {name: [1000.0] * 6 for name in timed}


def test_a_row_holds_the_quantiles_and_the_median_of_the_ratios() -> None:
    spent = {"session.run": np.array([1.0, 2.0, 9.0]), REFERENCE: np.array([2.0, 8.0, 9.0])}
    run, reference = latencies("clean", spent)
    assert (run.frames, run.method, run.p50_ms, run.max_ms, run.ratio) == ("clean", "session.run", 2.0, 9.0, 0.5)
    assert run.p99_ms == pytest.approx(2 + 7 * 0.98)
    assert reference.ratio == 1.0


def test_frames_hold_the_runway_and_the_clutter_that_was_asked_for(paper_scene: Scene) -> None:
    clean, cluttered = (cluttered_frames(paper_scene, density, 4, seed=3) for density in (0.0, 0.02))
    assert all(0 < frame.sum() < 400 for frame in clean)
    assert np.mean(cluttered) == pytest.approx(0.02, rel=0.1)
    assert all(set(np.unique(frame)) == {0, 1} and frame.dtype == np.uint8 for frame in [*clean, *cluttered])


def test_the_csv_gives_the_rows_back() -> None:
    rows = [row("clean", "a, b", 0.25), row("5% clutter", "c", 1.5)]
    lines = as_csv(HEADER, rows).splitlines()
    assert lines[:2] == ["# processor: abacus", "# opencv: 5"]
    back = [
        Latency(entry["frames"], entry["method"], *(float(entry[name]) for name in ("p50_ms", "p99_ms", "max_ms", "ratio")))
        for entry in csv.DictReader(lines[2:])
    ]
    assert back == rows


def test_bars_grow_by_the_same_length_for_each_factor_of_ten() -> None:
    picture = latency_chart(HEADER, [row("clean", f"session {number}", 10.0**number) for number in range(-2, 2)])
    lengths = [int(count) for count in np.unique((picture[LEGEND_PX:] == BLUE).all(axis=2).sum(axis=1)) if count]
    assert len(lengths) == 4 or len(set(np.diff(lengths))) <= 2
    steps = np.diff([length for length in lengths if length > 20])
    assert steps.max() - steps.min() <= 4  # a pixel of rounding on each side, and the mark at p99


def test_every_method_is_timed_on_every_kind_of_frame(estimator_of: Callable[..., Estimator]) -> None:
    kinds = list(benchmark(estimator_of("one cell"), count=2, rounds=1, clutter=(0.0, 0.02)))
    assert [kind[0].frames for kind in kinds] == ["clean", "2% clutter"]
    methods = ["session.run", "estimate, no refinement", "estimate", "HoughLinesP", "HoughLines", "LSD", "sum of bytes"]
    assert [[latency.method for latency in kind] for kind in kinds] == [methods, methods]
    assert all(0 < latency.p50_ms <= latency.p99_ms <= latency.max_ms for kind in kinds for latency in kind)


def test_a_rate_counts_what_comes_after_the_start() -> None:
    taken = []
    ticks = iter([10.0, 14.0])
    stream = (taken.append(number) for number in itertools.count())
    assert rate(stream, 8, clock=lambda: next(ticks)) == 2.0  # pyright: ignore[reportArgumentType]
    assert len(taken) == WARM_UP + 8


def test_throughput_is_measured_alone_and_together(estimator_of: Callable[..., Estimator]) -> None:
    estimator = estimator_of("one cell")
    assert min(throughput(estimator, cluttered_frames(estimator.scene, 0.02, 3, seed=0), 5, refine=False)) > 0


def test_the_command_writes_table_and_picture(model_of: Callable[[str], Path], tmp_path: Path) -> None:
    command = [*COMMAND, str(model_of("one cell")), "--frames", "2", "--rounds", "1", "-o", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for kind in ("with refinement", "without refinement"):
        assert f"estimate_many {kind}, 2 workers:" in done.stdout
    text = (tmp_path / "bench.csv").read_text(encoding="utf-8").splitlines()
    header = [line.partition(":")[0] for line in text if line.startswith("#")]
    assert header == [
        f"# {name}" for name in ("model", "processor", "cores", "python", "numpy", "onnxruntime", "opencv", "threads", "clock")
    ]
    assert len(text) == len(header) + 1 + 4 * 7
    assert cv2.imread(str(tmp_path / "bench.png")) is not None


def test_a_missing_model_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    done = subprocess.run([*COMMAND, "nowhere.onnx", "-o", str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "nowhere.onnx: cannot be read" in done.stderr
    assert list(tmp_path.iterdir()) == []


# --- the work that the paper's model does a frame ---

CONTROL_FLOW = {"If", "Loop", "Scan", "SequenceMap"}
LARGEST_FILE = 4_000_000
MOST_NODES = 115
MOST_LOOK_UPS = 55_000
MOST_BYTES_READ = 1_100_000
MOST_BYTES_WRITTEN = 1_600_000


@pytest.fixture(scope="module")
def paper_model(model_of: Callable[[str], Path]) -> Path:
    """Built anew, so that what is judged is the graph that the sources write; its NN_e has the size of the paper's."""
    return model_of("paper")


@pytest.fixture(scope="module")
def paper_graph(paper_model: Path) -> onnx.GraphProto:
    return onnx.load(paper_model).graph


def test_the_papers_file_is_small_and_its_shapes_are_fixed(paper_model: Path, paper_graph: onnx.GraphProto, repository: Path) -> None:
    assert max(path.stat().st_size for path in (paper_model, repository / "models" / "paper.onnx")) <= LARGEST_FILE
    for value in (*paper_graph.input, *paper_graph.output):
        assert all(dim.HasField("dim_value") for dim in value.type.tensor_type.shape.dim), value.name
    assert {node.op_type for node in paper_graph.node} & CONTROL_FLOW == set()
    assert {node.domain for node in paper_graph.node} == {""}


def test_the_papers_frame_costs_few_nodes_look_ups_and_bytes(paper_model: Path, paper_graph: onnx.GraphProto) -> None:
    """What a frame costs is what its nodes read and write: look-ups of the masks, constants, and what passes between nodes."""
    sizes = {tensor.name: int(np.prod(tensor.dims)) for tensor in paper_graph.initializer}
    look_ups = sum(size for name, size in sizes.items() if name.startswith("runs_"))
    read = {name for node in paper_graph.node for name in node.input}
    read_bytes = sum(len(tensor.raw_data) for tensor in paper_graph.initializer if tensor.name in read)
    assert len(paper_graph.node) <= MOST_NODES
    assert 0 < look_ups <= MOST_LOOK_UPS
    assert 4 * look_ups < read_bytes <= MOST_BYTES_READ
    inferred = onnx.shape_inference.infer_shapes(onnx.load(paper_model), strict_mode=True, data_prop=True).graph
    values = {value.name: value.type.tensor_type for value in (*inferred.value_info, *inferred.output)}
    written = [
        values[name] for node in paper_graph.node if node.op_type not in ("Reshape", "Identity", "Unsqueeze") for name in node.output
    ]
    types = [onnx.helper.tensor_dtype_to_np_dtype(value.elem_type).itemsize for value in written]
    written_bytes = sum(size * int(np.prod([dim.dim_value for dim in value.shape.dim])) for size, value in zip(types, written, strict=True))
    assert 480 * 640 < written_bytes <= MOST_BYTES_WRITTEN


def test_the_whole_frame_is_read_once_and_written_once(paper_graph: onnx.GraphProto) -> None:
    """All else sees the window: of the nodes that touch a whole frame, one cuts it, one writes `filtered`, and NN_e cuts that again."""
    readers = [node.op_type for node in paper_graph.node if "frame" in node.input]
    assert readers == ["Slice"]
    assert [node.op_type for node in paper_graph.node if "filtered" in node.output] == ["Pad"]
    fed = next(node for node in paper_graph.node if "state_network/filtered" in node.input)
    assert fed.op_type == "Slice"


def test_the_work_grows_with_the_entries_and_not_with_the_largest_cell() -> None:
    """512 cells, a few of them three times as large: no more than 1.3 places in the tables an entry, and equal masks looked up once."""
    entries = [20] * 480 + [70] * 32
    width = row_width(entries)
    assert rows_filled(entries, width).sum() * width <= 1.3 * sum(entries) < 512 * 70

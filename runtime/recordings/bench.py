"""What `bench-model` measures: what a frame costs, beside the line detectors that the certified estimate replaces.

All methods see the same frames, one after the other in every round, in one process on one thread, so that what else the machine does
falls on all alike; ratios are medians over the pairs of neighbouring runs. A method's frames are the exact image of a random state of
the domain under clutter, and those of a recording, if there is one.
"""

from __future__ import annotations

import csv
import io
import itertools
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from runtime.estimate import Estimate
from runtime.estimator import Estimator
from runtime.frames import FrameStream
from runtime.image import runway_image
from runtime.recordings.recording import read_events
from runtime.scene import Scene

Frames = Sequence[NDArray[np.uint8]]
Method = Callable[[NDArray[np.uint8]], object]

CLUTTER = (0.0, 0.01, 0.02, 0.05)
WINDOW_US = 40_000
WARM_UP, WORKERS = 100, 2
"""When throughput is measured: frames ahead of those that are counted, and cores that `estimate_many` takes."""
THROUGHPUT_CLUTTER = 0.02
"""Share of lit pixels of the clutter when throughput is measured."""
REFERENCE = "HoughLinesP"
"""The detector that ratios refer to."""


@dataclass(frozen=True)
class Latency:
    """Milliseconds a frame of one method on one kind of frames; `ratio` is the median of its time over `REFERENCE`'s."""

    frames: str
    method: str
    p50_ms: float
    p99_ms: float
    max_ms: float
    ratio: float


def cluttered_frames(scene: Scene, density: float, count: int, seed: int) -> Frames:
    """Exact images of random states of the domain; each pixel is lit besides with probability `density`."""
    rng = np.random.default_rng(seed)
    images = (runway_image(scene, scene.domain.uniform(rng, 1)[0]) for _ in range(count))
    return [image | (rng.random(image.shape) < density) for image in images]


def recorded_frames(path: Path, shape: tuple[int, int], count: int) -> Frames:
    """`count` frames of a recording, evenly spread over it. Raises `RecordingError` and `EventError`."""
    frames = [frame for _, frame in FrameStream(shape, WINDOW_US).frames(read_events(path, shape))]
    return [frames[index] for index in np.linspace(0, len(frames) - 1, min(count, len(frames))).astype(int)] if frames else []


def methods(estimator: Estimator) -> dict[str, Method]:
    """What is timed. The detectors take pixels of 0 and 255, which are made outside the clock."""
    cv2.setNumThreads(1)
    segments = cv2.createLineSegmentDetector()
    return {
        "session.run": estimator.run_unchecked,
        "estimate, no refinement": lambda frame: estimator.estimate(frame, refine=False),
        "estimate": estimator.estimate,
        REFERENCE: lambda image: cv2.HoughLinesP(image, 1, np.pi / 180, 20, minLineLength=20, maxLineGap=3),
        "HoughLines": lambda image: cv2.HoughLines(image, 1, np.pi / 180, 30),
        "LSD": segments.detect,
        "sum of bytes": lambda frame: frame.sum(),
    }


OF_OPENCV = (REFERENCE, "HoughLines", "LSD")


def measure(
    timed: Mapping[str, Method], frames: Frames, rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, NDArray[np.float64]]:
    """Milliseconds of every method on every frame, (rounds * frames,), in alternation.

    Before it is timed, a method sees the frame before, so that it finds the caches as it leaves them itself, as in a loop of its own.
    """
    spent = {name: [] for name in timed}
    before = frames[-1]
    for frame in itertools.chain.from_iterable(itertools.repeat(frames, rounds)):
        for name, method in timed.items():
            earlier, given = ((part * np.uint8(255) if name in OF_OPENCV else part) for part in (before, frame))
            method(earlier)
            start = clock()
            method(given)
            spent[name].append((clock() - start) * 1e3)
        before = frame
    return {name: np.array(times) for name, times in spent.items()}


def latencies(kind: str, spent: Mapping[str, NDArray[np.float64]]) -> list[Latency]:
    """The table's rows for one kind of frames."""
    rows = []
    for name, times in spent.items():
        p50, p99 = np.quantile(times, [0.5, 0.99]).tolist()
        rows.append(Latency(kind, name, p50, p99, float(times.max()), float(np.median(times / spent[REFERENCE]))))
    return rows


def benchmark(
    estimator: Estimator,
    count: int,
    rounds: int,
    recording: Path | None = None,
    seed: int = 0,
    clock: Callable[[], float] = time.perf_counter,
    clutter: Iterable[float] = CLUTTER,
) -> Iterator[list[Latency]]:
    """The rows of one kind of frames after the other. Raises `RecordingError` and `EventError`."""
    timed = methods(estimator)
    for number, density in enumerate(clutter):
        kind = f"{density:.0%} clutter" if density else "clean"
        yield latencies(kind, measure(timed, cluttered_frames(estimator.scene, density, count, seed + number), rounds, clock))
    if recording is not None:
        yield latencies("recording", measure(timed, recorded_frames(recording, estimator.scene.camera.shape, count), rounds, clock))


def rate(estimates: Iterator[Estimate], count: int, clock: Callable[[], float] = time.perf_counter) -> float:
    """Estimates a second of an endless stream that runs already: workers have started, and as many frames are under way before as after."""
    for _ in itertools.islice(estimates, WARM_UP):
        pass
    start = clock()
    for _ in itertools.islice(estimates, count):
        pass
    return count / (clock() - start)


def throughput(estimator: Estimator, frames: Frames, count: int, refine: bool) -> tuple[float, float]:
    """Frames a second by single calls of `estimate`, and by `estimate_many` on `WORKERS` cores."""
    alone = rate((estimator.estimate(frame, refine=refine) for frame in itertools.cycle(frames)), count)
    together = estimator.estimate_many(itertools.cycle(frames), refine=refine, processes=WORKERS)
    return alone, rate(together, count)


def machine() -> dict[str, str]:
    """Processor and versions."""
    return {
        "processor": processor(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "onnxruntime": onnxruntime.__version__,
        "opencv": cv2.__version__,
        "threads": "1",
    }


def processor() -> str:
    """The processor's name, as far as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def as_csv(header: Mapping[str, str], rows: Sequence[Latency]) -> str:
    """Comment lines `# name: value`, then a table."""
    text = io.StringIO()
    text.writelines(f"# {name}: {value}\n" for name, value in header.items())
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Latency.__dataclass_fields__)
    writer.writerows([f"{value:.4f}" if isinstance(value, float) else value for value in vars(row).values()] for row in rows)
    return text.getvalue()

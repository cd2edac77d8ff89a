"""Embedded use: installed size, cold start, memory, and a long loop of frames in which memory must not grow.

    python scripts/soak.py [MODEL.onnx] [--frames 100000] [--no-refine]

Everything is measured in fresh processes that import the runtime alone. Prints the resident set at the start and the end of the loop;
exit code 1 if it grew by more than `--allowed-mb`. Linux only: the resident set is read from /proc.
"""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from runtime import terminal

MB = 1e6
STARTS = 5
"""Cold starts, of which the median is printed."""

COLD_START = """
import json, os, sys, time
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
start = time.perf_counter()
import numpy, onnxruntime
imported, memory = time.perf_counter(), resident()
from runtime import Estimator
known = time.perf_counter()
estimator = Estimator.load(sys.argv[1])
loaded = time.perf_counter()
estimator.estimate(numpy.zeros(estimator.scene.camera.shape, numpy.uint8))
done = time.perf_counter()
names = ("import numpy and onnxruntime", "import runtime", "Estimator.load", "first estimate")
seconds = dict(zip(names, (imported - start, known - imported, loaded - known, done - loaded)))
print(json.dumps({"seconds": seconds, "resident": memory, "more": resident() - memory}))
"""

LOOP = """
import os, sys
import numpy
sys.path.insert(0, sys.argv[4])
from runtime import Estimator
from comparison_frames import draw_frames
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
estimator, count, refine = Estimator.load(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "True"
frames = [frame for seed, density in enumerate((0.0, 0.01, 0.02, 0.05)) for _, frame in draw_frames(estimator.scene, 25, density, seed)]
for frame in frames:
    estimator.estimate(frame, refine=refine)
for number in range(count + 1):
    if number % max(count // 10, 1) == 0:
        print(number, resident(), flush=True)
    estimator.estimate(frames[number % len(frames)], refine=refine)
"""


def installed_bytes(distribution: str) -> int:
    """Bytes of the files of an installed distribution."""
    files = (Path(str(file.locate())) for file in metadata.files(distribution) or ())
    return sum(path.stat().st_size for path in files if path.is_file())


def sizes(model: Path) -> dict[str, int]:
    """Bytes on disk of all that embedded use needs, Python apart."""
    runtime = Path(__file__).parents[1] / "runtime"
    own = sum(path.stat().st_size for path in runtime.rglob("*.py") if path.parent.name != "recordings")
    return {"runtime": own, "model": model.stat().st_size, **{name: installed_bytes(name) for name in ("onnxruntime", "numpy")}}


def cold_starts(model: Path) -> list[dict]:
    """What each of several fresh processes reports of its start."""
    command = [sys.executable, "-c", COLD_START, str(model)]
    return [json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout) for _ in range(STARTS)]


def middle(values: list[float]) -> float:
    """The median of an odd number of values."""
    return sorted(values)[len(values) // 2]


def main(
    model: Annotated[Path, typer.Argument(help="Model to run.")] = Path("models/paper.onnx"),
    frames: Annotated[int, typer.Option(min=1, help="Frames of the loop.")] = 100_000,
    refine: Annotated[bool, typer.Option(help="Contract the passing entries.")] = True,
    allowed_mb: Annotated[float, typer.Option(help="Growth that counts as none.")] = 2.0,
) -> None:
    """Print sizes and starts, run the loop, print the resident set."""
    console = terminal.console()
    table = Table("embedded use", "", title_justify="left")
    on_disk = sizes(model)
    for name, size in on_disk.items():
        table.add_row(f"{name}, on disk", f"{size / MB:.1f} MB")
    table.add_row("together", f"{sum(on_disk.values()) / MB:.1f} MB")
    starts = cold_starts(model)
    for name in starts[0]["seconds"]:
        table.add_row(f"{name}, cold", f"{middle([start['seconds'][name] for start in starts]) * 1e3:.0f} ms")
    table.add_row("resident with numpy and onnxruntime", f"{middle([start['resident'] for start in starts]) / MB:.1f} MB")
    table.add_row("more after the first estimate", f"{middle([start['more'] for start in starts]) / MB:.1f} MB")
    console.print(table)
    command = [sys.executable, "-c", LOOP, str(model), str(frames), str(refine), str(Path(__file__).parent)]
    resident = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as loop:
        for line in loop.stdout or ():
            number, size = map(int, line.split())
            resident.append(size)
            console.print(f"frame {number:>9,}: resident {size / MB:.2f} MB", highlight=False)
    if loop.returncode:
        sys.exit(f"the loop ended early, with exit code {loop.returncode}")
    growth = (resident[-1] - resident[0]) / MB
    console.print(f"start to end: {growth:+.2f} MB", highlight=False)
    if growth > allowed_mb:
        sys.exit(1)


if __name__ == "__main__":
    terminal.run(main)

"""What a frame, the file and the build cost as the domain is divided more finely, or grows.

    python scripts/bench_scale.py [SCENE.toml] [-o out/scale] [--jobs 2]

Two families: the paper's domain with cells of 0.1, 0.05 and 0.025, with fewer bins in a cell as cells shrink; and cells of 0.1 in domains
of 27, 216 and 1,728 cells, placed where every state sees the whole runway. Prints a table, writes scale.csv and scale.png. NN_e, whose
cost does not depend on the cells, is trained for one epoch only.
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray
from rich.table import Table

from build_model.export import export_model
from build_model.hough_bank import mask_bank
from runtime import Estimator, Scene, terminal
from runtime.recordings.bench import cluttered_frames, machine
from runtime.recordings.chart import BLUE, FONT_PT, INK, PALE, RED, new_figure, picture_of, rgb, style_axes, with_own_settings
from runtime.recordings.draw import Picture, png
from runtime.scene import Axis, Domain, EstimatorTraining
from runtime.whole_file import write_whole

CLUTTER = 0.02
QUICK = EstimatorTraining(training_frames=256, epochs=1)
HEIGHT_IN, WIDTH_PX = 3.8, 1280
FAMILIES = {"finer": ("the same domain, finer cells", BLUE), "larger": ("cells of 0.1, a larger domain", RED)}
"""What the chart calls each family, and its colour there."""


@dataclass(frozen=True)
class Size:
    """A scene's figures. `ratio` is the median of the time of `run` over that of the first scene."""

    family: str
    cells: int
    entries: int
    look_ups: int
    file_mb: float
    build_s: float
    run_ms: float
    ratio: float
    estimate_ms: float
    passing_cells: float


def tiled(lower: float, count: int, width: float) -> Axis:
    """`count` cells of the given width from `lower` on."""
    return Axis(tuple(np.round(lower + width * (np.arange(count) + 0.5), 9).tolist()), width)


def scenes(paper: Scene) -> list[tuple[str, Scene]]:
    """Both families, each from 27 cells to 1,728."""
    x = paper.domain.axes[1]
    chosen = [("finer", paper)]
    for count, width, pitch_bins, distance_bins in ((6, 0.05, 2, 1), (12, 0.025, 1, 1)):
        domain = Domain(tiled(0.45, count, width), x, tiled(0.75, count, width), tiled(1.55, count, width))
        bank = replace(mask_bank(paper), pitch_bins=pitch_bins, distance_bins=distance_bins)
        chosen.append(("finer", replace(paper, domain=domain, bank=bank)))
    for y, z in (((0.75, 8), (1.55, 9)), ((2.2, 24), (4.5, 24))):
        domain = Domain(tiled(0.4, 3, 0.1), x, tiled(y[0], y[1], 0.1), tiled(z[0], z[1], 0.1))
        chosen.append(("larger", replace(paper, domain=domain)))
    return [(family, replace(scene, estimator=QUICK)) for family, scene in chosen]


def run_times(estimators: Sequence[Estimator], count: int, rounds: int, clock: Callable[[], float]) -> NDArray[np.float64]:
    """Milliseconds of `run`, (models, rounds * count), in alternation; each model on its own frames, the one before run untimed."""
    frames = [cluttered_frames(estimator.scene, CLUTTER, count, seed=0) for estimator in estimators]
    spent = np.zeros((len(estimators), rounds * count))
    for turn in range(rounds * count):
        for number, estimator in enumerate(estimators):
            estimator.run_unchecked(frames[number][turn - 1 - count * (turn // count)])
            start = clock()
            estimator.run_unchecked(frames[number][turn % count])
            spent[number, turn] = (clock() - start) * 1e3
    return spent


def estimate_time(estimator: Estimator, count: int, clock: Callable[[], float]) -> tuple[float, float]:
    """Median milliseconds of `estimate`, and the mean number of passing cells."""
    spent, passing = [], []
    for frame in cluttered_frames(estimator.scene, CLUTTER, count, seed=1):
        start = clock()
        passing.append(len(estimator.estimate(frame).passing))
        spent.append((clock() - start) * 1e3)
    return float(np.median(spent)), float(np.mean(passing))


def look_ups(path: Path) -> int:
    """Sums that the model looks up in a frame for S, K and O."""
    import onnx

    return sum(int(np.prod(tensor.dims)) for tensor in onnx.load(path).graph.initializer if tensor.name.startswith("runs_"))


@with_own_settings
def scale_chart(sizes: Sequence[Size]) -> Picture:
    """Milliseconds of `run` against cells, both axes logarithmic, a line a family from the first scene on: (height, `WIDTH_PX`, 3)."""
    figure = new_figure(HEIGHT_IN, WIDTH_PX)
    axes = figure.subplots()
    style_axes(axes, INK, PALE)
    for family, (name, colour) in FAMILIES.items():
        chosen = [sizes[0], *(size for size in sizes[1:] if size.family == family)]
        axes.plot([size.cells for size in chosen], [size.run_ms for size in chosen], "o-", color=rgb(colour), label=name)
    axes.set(xscale="log", yscale="log", xlabel="cells of the domain", ylabel="one run of the model, one thread (ms)")
    axes.set_xticks(sorted({size.cells for size in sizes}))
    axes.set_yticks(_powers_of_two([size.run_ms for size in sizes]))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:,.10g}")
        axis.set_minor_locator(NullLocator())
    axes.grid(color=rgb(PALE), linewidth=0.5)
    axes.legend(frameon=False, fontsize=FONT_PT, labelcolor=rgb(INK))
    return picture_of(figure)


def _powers_of_two(values: Sequence[float]) -> list[float]:
    """The powers of two from the one below the smallest value to the one above the largest."""
    low, high = np.floor(np.log2(min(values))), np.ceil(np.log2(max(values)))
    return np.exp2(np.arange(low, high + 1)).tolist()


def table(sizes: Sequence[Size]) -> Table:
    """The figures for people."""
    view = Table("family", "cells", "entries", "look-ups", "file MB", "NN_F s", "run ms", "/ 27", "estimate ms", "passing cells")
    for size in sizes:
        times = (f"{size.build_s:.1f}", f"{size.run_ms:.3f}", f"{size.ratio:.2f}", f"{size.estimate_ms:.1f}", f"{size.passing_cells:.1f}")
        view.add_row(size.family, f"{size.cells:,}", f"{size.entries:,}", f"{size.look_ups:,}", f"{size.file_mb:.1f}", *times)
    return view


def main(
    scene: Annotated[Path, typer.Argument(help="The paper's scene.")] = Path("models/paper.toml"),
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for scale.csv, scale.png and the models.")] = Path("out/scale"),
    jobs: Annotated[int, typer.Option(help="Processes that build cells.")] = 2,
    frames: Annotated[int, typer.Option(help="Frames of each model.")] = 50,
    rounds: Annotated[int, typer.Option(help="How often each frame is run.")] = 4,
    cpu_time: Annotated[bool, typer.Option(help="Count the thread's time on the processor, if the machine is busy otherwise.")] = False,
) -> None:
    """Build every scene, time it, print the table."""
    output.mkdir(parents=True, exist_ok=True)
    console = terminal.console(140)
    clock = time.thread_time if cpu_time else time.perf_counter
    reports, paths = [], []
    for family, chosen in scenes(Scene.load(scene)):
        path = output / f"{family}-{chosen.domain.cell_count}.onnx"
        reports.append((family, export_model(chosen, path, jobs=jobs)))
        paths.append(path)
        console.print(f"{path}: NN_F in {reports[-1][1].seconds['NN_F']:.1f} s")
    estimators = [Estimator.load(path) for path in paths]
    spent = run_times(estimators, frames, rounds, clock)
    sizes = []
    for (family, report), path, estimator, times in zip(reports, paths, estimators, spent, strict=True):
        ratio = float(np.median(times / spent[0]))
        estimate_ms, passing = estimate_time(estimator, frames, clock)
        size = report.cells, report.entries, look_ups(path), report.file_bytes / 1e6, report.seconds["NN_F"]
        sizes.append(Size(family, *size, float(np.median(times)), ratio, estimate_ms, passing))
    header = {**machine(), "clock": clock.__name__}
    console.print(", ".join(f"{name} {value}" for name, value in header.items()), table(sizes), highlight=False)
    text = io.StringIO()
    text.writelines(f"# {name}: {value}\n" for name, value in header.items())
    writer = csv.writer(text)
    writer.writerow(Size.__dataclass_fields__)
    writer.writerows(vars(size).values() for size in sizes)
    write_whole(output / "scale.csv", text.getvalue().encode())
    write_whole(output / "scale.png", png(scale_chart(sizes)))


if __name__ == "__main__":
    terminal.run(main)

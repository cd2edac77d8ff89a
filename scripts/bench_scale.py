"""What a frame, the file and the build cost as the domain is divided more finely, or grows.

    python scripts/bench_scale.py [SCENE.toml] [-o out/scale] [--jobs 2] [--family finer --family larger --family windows] [--cpu-time]

Three families: the paper's domain with cells of 0.1, 0.05 and 0.025, with fewer bins in a cell as cells shrink; cells of 0.1 in domains
of 27, 216 and 1,728 cells, placed where every state sees the whole runway; and, with a bank of windows, the long final of `--final` and its
middles of an 8th and a 64th of the volume: half and a quarter of theta, of x and of the logarithm of z. All models are timed by turns, in
one process. Prints a table, writes scale.csv and, of banks of masks, scale.png. NN_e, whose cost does not depend on the cells, is trained
for one epoch only; the long final has none.
"""

from __future__ import annotations

import csv
import io
import math
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

from build_model.export import ExportReport, export_model
from build_model.hough_bank import mask_bank
from build_model.user_network import NO_ESTIMATOR
from runtime import Estimator, Scene, terminal
from runtime.domain import Edges, Growth
from runtime.errors import fail
from runtime.recordings.bench import cluttered_frames, machine
from runtime.recordings.chart import BLUE, FONT_PT, INK, PALE, RED, new_figure, picture_of, rgb, style_axes, with_own_settings
from runtime.recordings.draw import Picture, png
from runtime.scene import Axis, Domain, EstimatorTraining, WindowedBank
from runtime.whole_file import write_whole

CLUTTER = 0.02
QUICK = EstimatorTraining(training_frames=256, epochs=1)
HEIGHT_IN, WIDTH_PX = 3.8, 1280
FAMILIES = {"finer": ("the same domain, finer cells", BLUE), "larger": ("cells of 0.1, a larger domain", RED)}
"""What the chart calls each family of banks of masks, and its colour there."""
WINDOWS = "windows"
"""The family of banks of windows."""


@dataclass(frozen=True)
class Size:
    """A scene's figures. `ratio` is the median of the time of `run` over that of the first scene with a bank of the same kind;
    `estimate_ratio` is the medians' ratio likewise.
    """

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
    estimate_ratio: float


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


def parts_of(final: Scene) -> list[tuple[str, Scene]]:
    """A long final's middle of a 64th and an 8th of the volume, and the whole: theta, x and the logarithm of z cut short alike.

    Cells are as wide as the final's own, about, in theta, and grow by its ratio in z; x is one cell.
    """
    domain, ratio = final.domain, final.domain.z_m
    if not isinstance(ratio, Growth):
        raise ValueError("domain.z_m: found no ratio; give a scene like models/approach.toml")
    width = np.diff(domain.theta_rad.borders).mean()
    parts = []
    for share in (0.25, 0.5, 1.0):
        middle, half = (domain.lower + domain.upper) / 2, share * (domain.upper - domain.lower) / 2
        count = max(1, round(2 * half[0] / width))
        theta = np.linspace(middle[0] - half[0], middle[0] + half[0], count + 1).round(9)
        z, reach = math.sqrt(ratio.from_ * ratio.to), (ratio.to / ratio.from_) ** (share / 2)
        parts.append(
            replace(
                domain,
                theta_rad=Edges(tuple(theta.tolist())),
                x_m=Edges((float(middle[1] - half[1]), float(middle[1] + half[1]))),
                z_m=Growth(round(z / reach, 3), round(z * reach, 3), ratio.ratio),
            )
        )
    return [(WINDOWS, replace(final, domain=part)) for part in parts]


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


def estimate_times(estimators: Sequence[Estimator], count: int, clock: Callable[[], float]) -> tuple[NDArray[np.float64], list[float]]:
    """Milliseconds of `estimate`, (models, count), in alternation, and each model's mean number of passing cells."""
    frames = [cluttered_frames(estimator.scene, CLUTTER, count, seed=1) for estimator in estimators]
    spent, passing = np.zeros((len(estimators), count)), np.zeros((len(estimators), count))
    for turn in range(count):
        for number, estimator in enumerate(estimators):
            start = clock()
            passing[number, turn] = len(estimator.estimate(frames[number][turn]).passing)
            spent[number, turn] = (clock() - start) * 1e3
    return spent, passing.mean(axis=1).tolist()


def look_ups(path: Path, scene: Scene) -> int:
    """Sums that the model looks up in a frame: for S, K and O; or for windows, those of all gates and of as many groups as have places."""
    import onnx

    sizes = {tensor.name: int(np.prod(tensor.dims)) for tensor in onnx.load(path).graph.initializer}
    if not isinstance(scene.bank, WindowedBank):
        return sum(size for name, size in sizes.items() if name.startswith("runs_"))
    groups = sizes["gate_size"]
    return 2 * sizes["gate_start"] + 2 * sizes["window_start"] * min(scene.bank.places, groups) // groups


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
    view = Table("family", "cells", "entries", "look-ups", "file MB", "NN_F s", "run ms", "/ first", "estimate ms", "/ first", "passing")
    for size in sizes:
        times = (f"{size.build_s:.1f}", f"{size.run_ms:.3f}", f"{size.ratio:.2f}", f"{size.estimate_ms:.1f}")
        counts = f"{size.cells:,}", f"{size.entries:,}", f"{size.look_ups:,}", f"{size.file_mb:.1f}"
        view.add_row(size.family, *counts, *times, f"{size.estimate_ratio:.2f}", f"{size.passing_cells:.1f}")
    return view


def figures_of(
    families: Sequence[str], exported: Sequence[tuple[Path, ExportReport]], frames: int, rounds: int, clock: Callable[[], float]
) -> list[Size]:
    """Times all models by turns, and puts each one's figures together."""
    estimators = [Estimator.load(path) for path, _ in exported]
    spent, (estimating, passing) = run_times(estimators, frames, rounds, clock), estimate_times(estimators, frames, clock)
    firsts = [next(place for place, other in enumerate(families) if (other == WINDOWS) == (family == WINDOWS)) for family in families]
    sizes = []
    for place, (family, first, (path, report)) in enumerate(zip(families, firsts, exported, strict=True)):
        estimate_ms = np.median(estimating, axis=1)
        sizes.append(
            Size(
                family=family,
                cells=report.cells,
                entries=report.entries,
                look_ups=look_ups(path, estimators[place].scene),
                file_mb=report.file_bytes / 1e6,
                build_s=report.seconds["NN_F"],
                run_ms=float(np.median(spent[place])),
                ratio=float(np.median(spent[place] / spent[first])),
                estimate_ms=float(estimate_ms[place]),
                passing_cells=passing[place],
                estimate_ratio=float(estimate_ms[place] / estimate_ms[first]),
            )
        )
    return sizes


def main(
    scene: Annotated[Path, typer.Argument(help="The paper's scene.")] = Path("models/paper.toml"),
    final: Annotated[Path, typer.Option(help="A long final, with a bank of windows.")] = Path("models/approach.toml"),
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for scale.csv, scale.png and the models.")] = Path("out/scale"),
    jobs: Annotated[int, typer.Option(help="Processes that build cells.")] = 2,
    frames: Annotated[int, typer.Option(help="Frames of each model.")] = 50,
    rounds: Annotated[int, typer.Option(help="How often each frame is run.")] = 4,
    family: Annotated[list[str] | None, typer.Option(help="finer, larger or windows; more than once; all by default.")] = None,
    cpu_time: Annotated[bool, typer.Option(help="Count the thread's time on the processor, if the machine is busy otherwise.")] = False,
) -> None:
    """Build every scene, time it, print the table."""
    names = family or [*FAMILIES, WINDOWS]
    if strange := set(names) - {*FAMILIES, WINDOWS}:
        fail(f"--family: found {sorted(strange)[0]}; give {', '.join(FAMILIES)} or {WINDOWS}")
    console = terminal.console(150)
    clock = time.thread_time if cpu_time else time.perf_counter
    try:
        chosen = [*scenes(Scene.load(scene)), *parts_of(Scene.load(final))]
    except ValueError as error:
        fail(error)
    chosen = [(name, one) for place, (name, one) in enumerate(chosen) if name in names or (place == 0 and "larger" in names)]
    output.mkdir(parents=True, exist_ok=True)
    exported = []
    for name, one in chosen:
        path = output / f"{name}-{one.domain.cell_count}.onnx"
        report = export_model(one, path, jobs=jobs, estimator=NO_ESTIMATOR if name == WINDOWS else None)
        exported.append((path, report))
        console.print(f"{path}: NN_F in {report.seconds['NN_F']:.1f} s")
    sizes = figures_of([name for name, _ in chosen], exported, frames, rounds, clock)
    header = {**machine(), "clock": clock.__name__}
    console.print(", ".join(f"{name} {value}" for name, value in header.items()), table(sizes), highlight=False)
    text = io.StringIO()
    text.writelines(f"# {name}: {value}\n" for name, value in header.items())
    writer = csv.writer(text)
    writer.writerow(Size.__dataclass_fields__)
    writer.writerows(vars(size).values() for size in sizes)
    write_whole(output / "scale.csv", text.getvalue().encode())
    if drawn := [size for size in sizes if size.family != WINDOWS]:
        write_whole(output / "scale.png", png(scale_chart(drawn)))


if __name__ == "__main__":
    terminal.run(main)

"""The build's commands. They parse and print; `build_model.export` does the work."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from runtime import terminal
from runtime.assumptions import assumptions
from runtime.errors import INTERRUPTED, fail
from runtime.scene import STATE_NAMES, STATE_UNITS
from runtime.whole_file import OutputError, write_whole, writing

if TYPE_CHECKING:
    from types import FrameType

    from numpy.typing import NDArray
    from rich.console import Console

    from build_model.export import ExportReport
    from build_model.paper.paper_bound import PaperBound
    from runtime.scene import Scene

try:
    import typer
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Table
except ImportError as error:
    fail(f"export-model: the package {error.name!r} is missing; pip install 'glideproof[build]'")

DEFAULT_SCENE = Path("models/paper.toml")


def export_model(
    scene: Annotated[Path, typer.Argument(help="Scene file (TOML).")] = DEFAULT_SCENE,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Model to write, or its folder; by default out/.")] = None,
    estimator: Annotated[str | None, typer.Option(help="Your own NN_e: float32 [1,1,height,width] to [1,4]; or none: no NN_e.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the training.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that build cells.")] = 2,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="dask.distributed scheduler whose workers build them instead.")
    ] = None,
    memory_mb: Annotated[
        int | None, typer.Option("--memory-mb", min=1, help="Memory that the build may take; by default most of what is free.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Tell what the scene takes to build, and build nothing.")] = False,
) -> None:
    """Build NN_F from the scene, train NN_e (or take yours), and write one ONNX file with both."""
    target = output or Path("out")
    if output is None or output.is_dir():
        target /= f"{scene.stem}.onnx"
    console = terminal.console()
    with _interrupts_end_in_a_line(target):
        loaded, may_take = _planned(console, scene, estimator, 1 if dask else jobs, memory_mb)
        if dry_run:
            return
        report = _export(console, loaded, target, estimator=estimator, seed=seed, jobs=jobs, dask=dask, memory_mb=may_take)
    _print_summary(console, loaded, target, report, _clean_half_widths(target))


@contextmanager
def _interrupts_end_in_a_line(target: Path) -> Iterator[None]:
    """Ends the command with one line and exit code 130 on Ctrl-C, or on a signal that `runtime.terminal` takes for it.

    Any exception that ends the block after the signal counts as its consequence: where the signal breaks off an import of torch, that
    raises an error of another class. A signal that is ignored, as in a background job of a shell, stays so.
    """
    seen = []

    def note(signum: int, frame: FrameType | None) -> None:
        seen.append(signum)
        signal.default_int_handler(signum, frame)

    earlier = signal.getsignal(signal.SIGINT)
    if earlier is signal.default_int_handler:
        signal.signal(signal.SIGINT, note)
    try:
        yield
    except BaseException as end:
        if not seen and not isinstance(end, KeyboardInterrupt):
            raise
        fail(f"{target}: interrupted; the model that was there before is untouched", INTERRUPTED)
    finally:
        signal.signal(signal.SIGINT, earlier)


def _planned(console: Console, path: Path, estimator: str | None, jobs: int, memory_mb: float | None) -> tuple[Scene, float]:
    """Reads the scene, and a given network, prints what it takes to build, and refuses what takes too much memory, MB."""
    from build_model.build_size import build_size, check_size, free_memory_mb
    from build_model.user_network import EstimatorError, given_network
    from runtime.scene import Scene, SceneError
    from runtime.sensor import Sensor

    may_take = free_memory_mb() if memory_mb is None else memory_mb
    try:
        scene = Scene.load(path)
        ideal = Sensor.of(scene).ideal
        given_network(ideal, estimator)
        size = build_size(ideal, jobs, estimator is None, may_take)
        console.print(f"{path}: what it takes, estimated before anything is built", markup=False, highlight=False, soft_wrap=True)
        table = Table(show_header=False)
        for name, value in {**size.rows(), "memory that it may take": f"{may_take:.0f} MB"}.items():
            table.add_row(name, value)
        console.print(table)
        check_size(scene, size, may_take)
    except (SceneError, EstimatorError) as error:
        fail(error)
    return scene, may_take


def _export(console: Console, scene: Scene, target: Path, **options: Any) -> ExportReport:
    """Builds the model, with a progress bar. torch is imported here, where an interrupt is provided for."""
    try:
        from build_model.export import ClusterError, export_model
        from build_model.user_network import EstimatorError
        from runtime.scene import SceneError
    except ModuleNotFoundError as error:
        fail(f"export-model: the package {error.name!r} is missing; pip install 'glideproof[build]'")
    try:
        with _progress(console) as bars:
            return export_model(scene, target, progress=_Bars(bars).update, **options)
    except (SceneError, EstimatorError, ClusterError) as error:
        fail(error)
    except OSError as error:
        fail(f"{target}: cannot be written ({error.strerror}); the model that was there before is untouched")


def _clean_half_widths(target: Path) -> NDArray[np.float64]:
    from build_model.box_size import clean_half_widths
    from runtime.estimator import Estimator

    return clean_half_widths(Estimator.load(target))


def _progress(console: Console) -> Progress:
    texts = TextColumn("{task.description:<22}"), TextColumn("{task.fields[loss]}")
    return Progress(texts[0], BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), texts[1], console=console)


class _Bars:
    """One progress bar a stage, made when the stage is first heard of."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.tasks = {}

    def update(self, stage: str, done: int, total: int, loss: float | None) -> None:
        if stage not in self.tasks:
            self.tasks[stage] = self.progress.add_task(stage, total=total, loss="")
        self.progress.update(self.tasks[stage], completed=done, total=total, loss="" if loss is None else f"loss {loss:.5f}")


def _print_summary(console: Console, scene: Scene, target: Path, report: ExportReport, half_widths: NDArray[np.float64]) -> None:
    table = Table(title=str(target), show_header=False, title_justify="left")
    rows = {
        "cells": report.cells,
        "entries": report.entries,
        "smallest |K| - m": report.smallest_must_light - scene.tolerance.missed_budget,
        "S, pixels a cell": f"{report.spatial_pixels.min()} to {report.spatial_pixels.max()}",
        "calibration moves the image by": f"{report.displacement_px:.2f} px at most (line_px {scene.tolerance.line_px})",
        **bound_rows(scene, report.paper_bounds, half_widths),
        **{f"{stage}, seconds": f"{seconds:.1f}" for stage, seconds in report.seconds.items()},
        "file": f"{report.file_bytes / 1e6:.2f} MB",
        "sha256": report.sha256,
    }
    for name, value in rows.items():
        table.add_row(name, str(value))
    console.print(table)
    if report.training is not None:
        console.print(report.training.table())
    console.print("The certificate assumes:")
    for line in assumptions(scene):
        console.print(f"  - {line}", highlight=False)


def bound_rows(scene: Scene, bounds: Sequence[PaperBound | None], half_widths: NDArray[np.float64]) -> dict[str, str]:
    """The paper's bound 4 L_h delta over the cells, and what it is to be compared with: the certified box from corner to corner.

    The paper adds rad and m in one 2-norm; the box's diagonal bounds the same norm of the error of any estimate in the box.
    """
    finite = [bound for bound in bounds if bound is not None]
    paper = "no finite L_h is proved for any cell"
    if finite:
        constants = _span([bound.inverse_lipschitz_per_px for bound in finite])
        extents = _span([bound.zeta_half_extent_px for bound in finite])
        lacking = f"; none for {len(bounds) - len(finite)} of {len(bounds)} cells" if len(finite) < len(bounds) else ""
        paper = f"{_span([bound.state_error for bound in finite])} (L_h {constants} per px, delta {extents} px){lacking}"
    diagonal = np.median(2 * np.linalg.norm(half_widths, axis=1))
    free = np.flatnonzero(~scene.domain.fixed)
    medians = np.median(half_widths, axis=0)
    return {
        "the paper's bound, not a certificate": paper,
        "certified box, corner to corner": f"{diagonal:.4g}, median of {len(half_widths)} frames without clutter",
        "certified box, half-widths": ", ".join(f"{STATE_NAMES[axis]} {medians[axis]:.4f} {STATE_UNITS[axis]}" for axis in free) or "-",
    }


def _span(values: Sequence[float]) -> str:
    return f"{min(values):.3g} to {max(values):.3g}"


def import_camera(
    calibration: Annotated[Path, typer.Argument(help="Calibration file of OpenCV, ROS, Kalibr or Metavision: YAML, XML or JSON.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Where to write the table; by default it is printed.")] = None,
    camera: Annotated[str | None, typer.Option(help="Which camera of a Kalibr chain: cam0, cam1, ...")] = None,
    model: Annotated[str | None, typer.Option(help="The lens, in place of what the file says: radial-tangential or fisheye.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WIDTHxHEIGHT", help="The frame, where the file does not say.")] = None,
) -> None:
    """Turn a camera's calibration file into a scene's table of its camera."""
    try:
        from build_model import import_camera as reader
    except ImportError as error:
        fail(f"import-camera: the package {error.name!r} is missing; pip install 'glideproof[build]'")
    try:
        sides = None if size is None else [int(side) for side in size.lower().split("x")]
        if sides is not None and len(sides) != 2:
            raise ValueError
    except ValueError:
        fail(f"--size {size}: give the frame's width and height, such as 640x480")
    try:
        found = reader.import_camera(calibration, reader.Wanted(camera, model, None if sides is None else (sides[0], sides[1])))
    except reader.CalibrationFileError as error:
        fail(error)
    text = reader.camera_toml(found, calibration.name)
    if output is None:
        print(text, end="")
        return
    try:
        with writing(output):
            write_whole(output, text.encode())
    except OutputError as error:
        fail(error)


def import_camera_command() -> None:
    """Entry point of `import-camera`."""
    terminal.run(import_camera)


def export_model_command() -> None:
    """Entry point of `export-model`."""
    terminal.run(export_model)

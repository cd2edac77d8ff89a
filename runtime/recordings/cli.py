"""The runtime's command: `run-model` takes a recording to estimates. It parses and prints; `runtime.recordings.report` writes."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

if TYPE_CHECKING:
    from numpy.typing import NDArray

try:
    import typer
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Table
except ImportError as missing:
    raise SystemExit(f"run-model: the package {missing.name!r} is missing; pip install 'glideproof[recordings]'") from None

DAMAGED, USER_ERROR, INTERRUPTED = 1, 2, 130


def fail(message: object, code: int = USER_ERROR) -> NoReturn:
    """One line on stderr, then exit."""
    _complain(message)
    raise typer.Exit(code)


def _complain(message: object) -> None:
    print(" ".join(str(message).split()), file=sys.stderr)


def run_model(
    model: Annotated[Path, typer.Argument(help="Model that export-model wrote.")],
    recording: Annotated[Path, typer.Argument(help="Event recording: .raw .dat .aedat4 .es .csv .npz .h5")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write; by default the recording's name in out/.")] = None,
    window_ms: Annotated[float, typer.Option(help="Length of a window.")] = 40.0,
    step_ms: Annotated[float | None, typer.Option(help="From one window to the next, at most the window; less overlaps.")] = None,
    missed_budget: Annotated[int | None, typer.Option(help="Pixels of the runway that may be dark, in place of the model's.")] = None,
    truth: Annotated[Path | None, typer.Option(help="CSV: time_us, theta_rad, x_m, y_m, z_m. Judges every window.")] = None,
    video: Annotated[bool, typer.Option("--video/--no-video", help="Write overlay.mp4.")] = True,
    refine: Annotated[bool, typer.Option("--refine/--no-refine", help="Contract the passing entries: tighter and slower.")] = True,
) -> None:
    """Take a recording to states and certified boxes: estimates.csv, summary.json, pictures and a video.

    Exit code 0; 1 if the recording is damaged or ends early (what was good before is written); 2 if something given cannot be used;
    130 after Ctrl-C (what was done is written).
    """
    try:
        import cv2  # noqa: F401

        from runtime.estimator import Estimator
        from runtime.frames import EventError, FrameStream
        from runtime.model.model_file import ModelError
        from runtime.recordings.recording import RecordingError, read_events
        from runtime.recordings.report import Report, Truth, TruthError
    except ImportError as error:
        fail(f"run-model: the package {error.name!r} is missing; pip install 'glideproof[recordings]'")
    console = Console(width=None if sys.stdout.isatty() else 120)
    try:
        estimator = Estimator.load(model, missed_budget=missed_budget)
        step_us = None if step_ms is None else _microseconds(step_ms)
        stream = FrameStream(estimator.scene.camera.shape, _microseconds(window_ms), step_us)
        known = None if truth is None else Truth.load(truth)
        packets = _nonempty(recording, read_events(recording, estimator.scene.camera.shape))
        folder = output or Path("out") / recording.stem
        report = Report(folder, estimator, stream.window_us, stream.step_us, known, video=video, missed_budget=missed_budget)
    except (ModelError, EventError, RecordingError, TruthError, OSError) as error:
        fail(error)
    fault, code = None, 0
    try:
        with _progress(console) as bar:
            _estimate_all(stream, packets, report, refine, bar)
    except (RecordingError, EventError) as error:
        # What came before the fault is whole: its last windows are estimated as well.
        _estimate_all(stream, iter(()), report, refine, None)
        fault, code = str(error), DAMAGED
    except KeyboardInterrupt:
        fault, code = "interrupted", INTERRUPTED
    except OSError as error:
        fail(f"{folder}: cannot be written ({error})")
    lost = {"late": stream.late_events, "unsorted": stream.unsorted_events, "outside_sensor": stream.outside_events}
    source = {"model": str(model), "sha256": estimator.sha256, "recording": str(recording), "fault": fault}
    sizes = {"window_us": stream.window_us, "step_us": stream.step_us, "events_to_note": lost}
    summary = report.close({**source, **sizes})
    _print_summary(console, folder, summary)
    if any(lost.values()):
        noted = ", ".join(f"{count} {name.replace('_', ' the ')}" for name, count in lost.items() if count)
        _complain(f"{recording}: events to note: {noted}; late ones and those outside the sensor are in no window")
    if fault:
        fail(f"{fault}; {summary['windows']} windows are written to {folder}", code)


def _microseconds(milliseconds: float) -> int:
    return round(milliseconds * 1000) if abs(milliseconds) < 1e15 else 0


def _nonempty(recording: Path, packets: Iterator[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """The same packets, once one with an event is seen. Raises `RecordingError` if there is none, or if the file is unusable."""
    from runtime.recordings.recording import RecordingError

    for packet in packets:
        if len(packet):
            return itertools.chain([packet], packets)
    raise RecordingError(f"{recording}: no event in it; take another recording")


def _progress(console: Console) -> Progress:
    texts = TextColumn("windows {task.completed}"), TextColumn("{task.fields[seconds]:.2f} s of recording")
    return Progress(texts[0], BarColumn(), texts[1], TimeElapsedColumn(), console=console, transient=True)


def _estimate_all(stream: Any, packets: Iterator[NDArray[Any]], report: Any, refine: bool, bar: Progress | None) -> None:
    """Every window of the packets into the report."""
    task = None if bar is None else bar.add_task("windows", total=None, seconds=0.0)
    first_us = None
    for start_us, frame in stream.frames(packets):
        begun = time.perf_counter()
        estimate = report.estimator.estimate(frame, refine=refine)
        report.add(start_us, frame, estimate, 1000 * (time.perf_counter() - begun))
        first_us = start_us if first_us is None else first_us
        if bar is not None and task is not None:
            bar.update(task, advance=1, seconds=(start_us - first_us) / 1e6)


def _print_summary(console: Console, folder: Path, summary: dict[str, Any]) -> None:
    table = Table(title=str(folder), title_justify="left", show_header=False)
    half_widths = ", ".join(f"{name} {value:.4f}" for name, value in summary["mean_half_widths"].items())
    rows = {
        "windows": summary["windows"],
        "certified": summary["certified"],
        "no runway": summary["no_runway"],
        "fallback to the box's centre": summary["fallback"],
        "box reaches the domain's face": summary["touches_boundary"],
        "half-widths, mean": half_widths if summary["certified"] else "-",
        "ms a window, mean / largest": "{mean:.2f} / {largest:.2f}".format(**summary["milliseconds_a_window"]),
    }
    for kind, name in (("assumptions_hold", "assumptions hold"), ("assumptions_broken", "assumptions broken")):
        if kind in summary:
            rows[name] = _judged(summary[kind])
    for name, value in rows.items():
        table.add_row(name, str(value))
    console.print(table)
    console.print("The certificate assumes:")
    for line in summary["assumptions"]:
        console.print(f"  - {line}", highlight=False, markup=False)


def _judged(counts: dict[str, Any]) -> str:
    text = "{windows} windows: {inside} with the truth inside, {outside} outside, {no_runway} no runway".format(**counts)
    mean, largest = counts["mean_error"], counts["largest_error"]
    return text if mean is None else f"{text}; error {mean:.4f} mean, {largest:.4f} largest"


def run_model_command() -> None:
    """Entry point of `run-model`."""
    typer.run(run_model)

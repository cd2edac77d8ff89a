"""The commands of the extra `recordings`: `run-model` takes a recording to estimates, `bench-model` measures. They parse and print."""

from __future__ import annotations

import itertools
import logging
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from numpy.typing import NDArray

from runtime import terminal
from runtime.errors import INTERRUPTED, complain, fail
from runtime.estimate import Outcome
from runtime.estimator import Estimator
from runtime.frames import LARGEST_GAP_US, EventError, FrameStream
from runtime.model.format import ModelError
from runtime.whole_file import OutputError, OutputFolder

if TYPE_CHECKING:
    from rich.console import Console

logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it has advice on stderr, as on a home that cannot be written

try:
    import typer
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Table

    from runtime.recordings.attitude import AttitudeError
    from runtime.recordings.bench import (
        REFERENCE,
        THROUGHPUT_CLUTTER,
        WORKERS,
        Latency,
        as_csv,
        benchmark,
        cluttered_frames,
        machine,
        throughput,
    )
    from runtime.recordings.draw import png
    from runtime.recordings.follower import Follower, References, TrackingError
    from runtime.recordings.gyroscope import GyroscopeError
    from runtime.recordings.latency_chart import latency_chart
    from runtime.recordings.noted import lines_of, noted_of
    from runtime.recordings.recording import Notes, RecordingError, read_events
    from runtime.recordings.report import Report
    from runtime.recordings.truth import Truth, TruthError
except ImportError as missing:
    fail(f"{Path(sys.argv[0]).name}: the package {missing.name!r} is missing; pip install 'glideproof[recordings]'")

DAMAGED = 1
"""Exit code where a recording ends early or is damaged."""


def run_model(
    model: Annotated[Path, typer.Argument(help="Model that export-model wrote.")],
    recording: Annotated[Path, typer.Argument(help="Event recording: .raw .dat .aedat4 .es .csv .txt .npz .h5")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write; by default the recording's name in out/.")] = None,
    window_ms: Annotated[float, typer.Option(help="Length of a window.")] = 40.0,
    step_ms: Annotated[float | None, typer.Option(help="From one window to the next, at most the window; less overlaps.")] = None,
    largest_gap_ms: Annotated[float, typer.Option(help="A longer pause begins a new run of windows.")] = LARGEST_GAP_US / 1000,
    missed_budget: Annotated[int | None, typer.Option(help="Pixels of the runway that may be dark, in place of the model's.")] = None,
    truth: Annotated[Path | None, typer.Option(help="CSV: time_us, theta_rad, x_m, y_m, z_m. Judges every window.")] = None,
    video: Annotated[bool, typer.Option("--video/--no-video", help="Write overlay.mp4.")] = True,
    refine: Annotated[bool, typer.Option("--refine/--no-refine", help="Contract the passing entries: tighter and slower.")] = True,
    track: Annotated[bool, typer.Option("--track", help="Certify over time too: each frame within what those before leave.")] = False,
    motion: Annotated[str | None, typer.Option(help="Largest rates of theta, x, y, z, as 0.1,0,0.3,1; by default the scene's.")] = None,
    attitude: Annotated[Path | None, typer.Option(help="CSV of an attitude reference: the aircraft's roll, pitch and yaw.")] = None,
    pitch_alone: Annotated[
        bool, typer.Option("--pitch-alone", help="Of --attitude: take roll and yaw for 0, as the scene has it.")
    ] = False,
    gyroscope: Annotated[Path | None, typer.Option(help="CSV of a gyroscope, by which --track bounds how far the pitch turns.")] = None,
    horizon: Annotated[int | None, typer.Option(help="With --track: a box rests on the last so many windows alone.")] = None,
    outliers: Annotated[int, typer.Option(help="With --horizon: windows of it that may break their assumptions.")] = 0,
) -> None:
    """Take a recording to states and certified boxes: estimates.csv, summary.json, pictures and a video.

    Exit code 0; 1 if the recording is damaged or ends early (what was good before is written); 2 if something given cannot be used, as
    a truth within whose times no window lies (the estimates are written); 130 after Ctrl-C (what was done is written, unless that is
    interrupted too).
    """
    console = terminal.console()
    folder = output or Path("out") / recording.stem
    try:
        estimator = Estimator.load(model, missed_budget=missed_budget)
        step_us = None if step_ms is None else _microseconds(step_ms)
        gap_us, notes = _microseconds(largest_gap_ms), Notes()
        stream = FrameStream(estimator.scene.camera.shape, _microseconds(window_ms), step_us, largest_gap_us=gap_us)
        known = None if truth is None else Truth.load(truth)
        follower = Follower.of(estimator, References(attitude, gyroscope, pitch_alone), motion, horizon, outliers) if track else None
        files = {"--attitude": attitude, "--gyroscope": gyroscope, "--pitch-alone": pitch_alone or None}
        _demand_track(track, {"--motion": motion, **files, "--horizon": horizon, "--outliers": outliers or None})
        packets = _nonempty(recording, read_events(recording, estimator.scene.camera.shape, notes))
        inputs = [path for path in (model, recording, truth, attitude, gyroscope) if path is not None]
        turned = follower is not None and follower.turned
        kinds = {"video": video, "tracked": track, "turned": turned}
        with Report(folder, estimator, stream.window_us, stream.step_us, known, inputs=inputs, **kinds) as report:
            fault, code = _estimated(console, stream, packets, report, refine, follower)
            noted = noted_of(stream, notes)
            source = {"model": str(model), "sha256": estimator.sha256, "recording": str(recording), "fault": fault}
            source |= {} if follower is None else {"tracking": follower.description}
            summary = report.close({**source, "window_us": stream.window_us, "step_us": stream.step_us, **noted})
    except (ModelError, EventError, RecordingError, TruthError, AttitudeError, GyroscopeError, TrackingError, OutputError) as error:
        fail(error)
    except OSError as error:
        fail(f"{recording}: cannot be read ({error.strerror or error}); give the path of a recording that can")
    except KeyboardInterrupt:
        fail(f"{folder}: interrupted before or after the windows; nothing is written, earlier files are untouched", INTERRUPTED)
    level = estimator.attitude is None and not turned
    _print_summary(console, folder, summary, truth is not None and not level)
    for line in lines_of(noted):
        complain(f"{recording}: {line}")
    if fault:
        fail(f"{fault}; {summary['windows']} windows are written to {folder}", code)
    if truth is not None and known is not None and level and "assumptions_hold" not in summary:
        fail(_unmatched(truth, known, summary))


def _estimated(
    console: Console, stream: FrameStream, packets: Iterator[NDArray[Any]], report: Report, refine: bool, follower: Follower | None
) -> tuple[str | None, int]:
    """Every window into the report; what ended them early, if something did, and the exit code for it."""
    try:
        with _progress(console) as bar:
            _estimate_all(stream, packets, report, refine, follower, bar)
    except KeyboardInterrupt:
        return "interrupted", INTERRUPTED
    except (RecordingError, EventError, OSError) as error:
        # What came before the fault is whole: its last windows are estimated as well.
        _estimate_all(stream, iter(()), report, refine, follower, None)
        return str(error), DAMAGED
    return None, 0


def _demand_track(track: bool, options: dict[str, object]) -> None:
    """Raises `TrackingError` for an option that says nothing without --track."""
    for name, value in options.items():
        if value is not None and not track:
            raise TrackingError(f"{name}: found {value} without --track; add --track, or leave it out")


def _unmatched(path: Path, truth: Truth, summary: dict[str, Any]) -> str:
    """What to say of a truth that judges no window."""
    known, seen = _seconds((truth.time_us[0], truth.time_us[-1])), _seconds(summary["window_instants_us"])
    return f"{path}: no window's instant lies within its times, {known}; they run from {seen}; give time_us on the recording's own clock"


def _seconds(range_us: tuple[float, float] | None) -> str:
    return "none to none" if range_us is None else f"{range_us[0] / 1e6:.6f} to {range_us[1] / 1e6:.6f} s"


def _microseconds(milliseconds: float) -> int:
    return round(milliseconds * 1000) if abs(milliseconds) < 1e15 else 0


def _nonempty(recording: Path, packets: Iterator[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """The same packets, once one with an event is seen. Raises `RecordingError` if there is none, or if the file is unusable."""
    for packet in packets:
        if len(packet):
            return itertools.chain([packet], packets)
    raise RecordingError(f"{recording}: no event in it; take another recording")


def _progress(console: Console) -> Progress:
    texts = TextColumn("windows {task.completed}"), TextColumn("{task.fields[seconds]:.2f} s of recording")
    return Progress(texts[0], BarColumn(), texts[1], TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal)


def _estimate_all(
    stream: FrameStream, packets: Iterator[NDArray[Any]], report: Report, refine: bool, follower: Follower | None, bar: Progress | None
) -> None:
    """Every window of the packets into the report."""
    task = None if bar is None else bar.add_task("windows", total=None, seconds=0.0)
    seconds = 0.0
    for start_us, frame in stream.frames(packets):
        attitude = None if follower is None else follower.known(start_us + report.instant_us)[0]
        begun = time.perf_counter()
        estimate = report.estimator.estimate(frame, refine=refine, attitude=attitude)
        milliseconds = 1000 * (time.perf_counter() - begun)
        tracked = None if follower is None else follower.update(frame, start_us + report.instant_us)
        report.add(start_us, frame, estimate, milliseconds, tracked, attitude or report.estimator.attitude)
        if bar is not None and task is not None:
            seconds += stream.step_us / 1e6
            bar.update(task, advance=1, seconds=seconds)


def _print_summary(console: Console, folder: Path, summary: dict[str, Any], unjudged: bool) -> None:
    """`unjudged`: a truth is given that cannot tell which windows keep the assumptions."""
    table = Table(title=str(folder), title_justify="left", show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    rows = {
        "recording read as": summary["layout"],
        "windows": summary["windows"],
        "certified": summary["certified"],
        "no runway": summary["no_runway"],
        **_explained(summary.get("no_runway_explained")),
        "fallback to the box's centre": summary["fallback"],
        "box reaches the domain's face": summary["touches_boundary"],
        "half-widths, mean": _by_axis(summary["mean_half_widths"]),
        "ms a window, mean / largest": "{mean:.2f} / {largest:.2f}".format(**summary["milliseconds_a_window"]),
    }
    rows |= _tracked(summary.get("tracked"))
    rows |= {"assumptions hold": "not told: of a camera that rolls or yaws the truth tells no pixels"} if unjudged else {}
    for kind, name in (("assumptions_hold", "assumptions hold"), ("assumptions_broken", "assumptions broken")):
        if kind in summary:
            rows |= _judged(f"{name}, the frame alone" if "tracked" in summary else name, summary[kind])
    for name, value in rows.items():
        table.add_row(name, str(value))
    console.print(table)
    console.print("The certificate assumes:")
    for line in [*summary["assumptions"], *summary.get("tracking", [])]:
        console.print(f"  - {line}", highlight=False)


def _tracked(followed: dict[str, Any] | None) -> dict[str, str]:
    """Rows on what a tracker made of the windows."""
    if followed is None:
        return {}
    counts = ", ".join(f"{followed[name]} {name}" for name in (outcome.value for outcome in Outcome) if name in followed)
    if "inside" in followed or "outside" in followed:
        counts += f"; truth inside {followed.get('inside', 0)}, outside {followed.get('outside', 0)}"
    return {"over time": counts, "over time: half-widths, mean": _by_axis(followed["mean_half_widths"])} | _errors("over time", followed)


def _by_axis(numbers: dict[str, float] | None) -> str:
    return "-" if numbers is None else ", ".join(f"{name} {value:.4f}" for name, value in numbers.items())


def _errors(name: str, counts: dict[str, Any]) -> dict[str, str]:
    """A row on the errors, where a truth is known."""
    if counts["mean_error"] is None:
        return {}
    sizes = zip(counts["mean_error"].items(), counts["largest_error"].values(), strict=True)
    return {f"{name}: error, mean / largest": ", ".join(f"{column} {mean:.4f} / {largest:.4f}" for (column, mean), largest in sizes)}


def _explained(lacking: dict[str, Any] | None) -> dict[str, str]:
    """Rows on the windows without a certificate: why, how far off their nearest states are, where, and which number to change."""
    if lacking is None:
        return {}
    reasons = "; ".join(f"{count} {reason}" for reason, count in lacking["reasons"].items())
    missed = "{least} to {most} pixels dark, {median} in the median".format(**lacking["nearest_state_missed"])
    rows = {"  why": reasons, "  nearest states, not certified": f"{missed}; {lacking['missed_budget']} may be"}
    darkest = [f"{name} row {max(counts, key=counts.get)}" for name, counts in lacking["windows_by_dark_row"].items()]
    if darkest:
        rows["  dark most often"] = ", ".join(darkest)
    if (budget := lacking["certifying_budget"]) is not None:
        rows["  at least half would be certified"] = f"with --missed-budget {budget}"
    elif lacking["nearest_state_missed"]["median"] > lacking["largest_budget"]:
        rows["  half of them lack more than"] = f"any --missed-budget that this model takes, {lacking['largest_budget']}"
    return rows


def _judged(name: str, counts: dict[str, Any]) -> dict[str, str]:
    """Rows on the windows with a truth."""
    rows = {name: "{windows} windows: {inside} with the truth inside, {outside} outside, {no_runway} no runway".format(**counts)}
    return rows | _errors(name, counts)


def run_model_command() -> None:
    """Entry point of `run-model`."""
    terminal.run(run_model)


def bench_model(
    model: Annotated[Path | None, typer.Argument(help="Model that export-model wrote; by default the paper's.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each kind.")] = 50,
    rounds: Annotated[int, typer.Option(min=1, help="How often each frame is seen.")] = 10,
    recording: Annotated[Path | None, typer.Option(help="Event recording whose frames are timed too.")] = None,
    cpu_time: Annotated[bool, typer.Option(help="Count the thread's time on the processor, if the machine is busy otherwise.")] = False,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for bench.csv and bench.png.")] = Path("out/bench"),
    seed: Annotated[int, typer.Option(help="Seed of the frames.")] = 0,
) -> None:
    """Time the model beside OpenCV's line detectors, on one thread, on the same frames: table, bench.csv and bench.png."""
    console = terminal.console()
    rows: list[Latency] = []
    try:
        estimator = Estimator.load(model)
        clock = time.thread_time if cpu_time else time.perf_counter
        header = {"model": estimator.sha256[:16], **machine(), "clock": clock.__name__}
        console.print(", ".join(f"{name} {value}" for name, value in header.items()), highlight=False)
        for kind in benchmark(estimator, frames, rounds, recording, seed, clock):
            console.print(_latency_table(kind))
            rows += kind
        for refine in (False, True):
            seen = cluttered_frames(estimator.scene, THROUGHPUT_CLUTTER, frames, seed)
            console.print(_rates(refine, *throughput(estimator, seen, frames * rounds, refine)), highlight=False)
        files = OutputFolder(output)
        files.write("bench.csv", as_csv(header, rows).encode())
        files.write("bench.png", png(latency_chart(header, rows)))
        files.replace()
    except (ModelError, EventError, RecordingError, OutputError, OSError) as error:
        fail(error)


def _rates(refine: bool, alone: float, together: float) -> str:
    kind = "with refinement" if refine else "without refinement"
    return f"estimate_many {kind}, {WORKERS} workers: {together:,.0f} frames/s, {together / alone:.2f} x the {alone:,.0f} of single calls"


def _latency_table(rows: Sequence[Latency]) -> Table:
    table = Table("method", "p50 ms", "p99 ms", "max ms", "p99/p50", f"/ {REFERENCE}", title=rows[0].frames, title_justify="left")
    for row in rows:
        figures = (row.p50_ms, row.p99_ms, row.max_ms)
        spread, ratio = f"{row.p99_ms / row.p50_ms:.2f}", f"{row.ratio:.3f}" + (f" = 1/{1 / row.ratio:.1f}" if row.ratio < 1 else "")
        table.add_row(row.method, *(f"{figure:.3f}" for figure in figures), spread, ratio)
    return table


def bench_model_command() -> None:
    """Entry point of `bench-model`."""
    terminal.run(bench_model)

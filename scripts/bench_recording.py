"""What run-model costs on a busy recording, made for the purpose: time, memory and the video's size.

    python scripts/bench_recording.py [--seconds 10] [--longer 10] [--rate 2e6] [--model MODEL.onnx] [--out out/bench_recording]

The recording is Prophesee EVT3 of the scene's sensor: in every window of 40 ms the runway's exact image of an approach, each of its pixels
at least once, and events of other pixels that fire again and again, a share of `BUSY` of the sensor. Prints, each in processes of
their own, wall-clock time and time on the processor (user and system):

- the stages that every window passes through: decoding, framing, estimating without and with refinement;
- the command run-model without and with its video, with the largest resident set, and the video's size a second of recording;
- the same without video on a recording `--longer` times as long, whose memory must not have grown.

Exit code 2 if something given cannot be used. Linux only: times and memory are those that the system counts for a child that has ended.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from approach import approach_states
from numpy.typing import NDArray
from rich.table import Table

from runtime import Estimator, ModelError, Scene, terminal
from runtime.errors import fail
from runtime.image import runway_image
from runtime.recordings.recording import EVENT
from runtime.whole_file import replacing

WINDOW_US = 40_000
BUSY = 0.05
"""Share of the sensor's pixels that fire in a window: what a moving camera shows of textured ground."""
MB = 1e6
TIME_HIGH, TIME_LOW, ROW, COLUMN = 0x8000, 0x6000, 0x0000, 0x2000
"""Kinds of the 16-bit words of EVT3."""

STAGES = """
import sys
from runtime import Estimator, FrameStream
from runtime.recordings.recording import read_events
model, recording, last = sys.argv[1:]
estimator = Estimator.load(model)
shape = estimator.scene.camera.shape
packets = read_events(recording, shape)
if last == "decode":
    for _ in packets:
        pass
else:
    for _, frame in FrameStream(shape, 40_000).frames(packets):
        if last != "frame":
            estimator.estimate(frame, refine=last == "refine")
"""
STAGE_NAMES = {"decode": "decoding", "frame": "and framing", "entries": "and estimating, unrefined", "refine": "and refining"}
RUN_MODEL = "from runtime.recordings.cli import run_model_command; run_model_command()"


@dataclass(frozen=True)
class Cost:
    """What a process took: seconds of wall-clock and of the processor, and its largest resident set, MB."""

    wall_s: float
    processor_s: float
    resident_mb: float


def events_of_window(scene: Scene, state: NDArray[np.float64], start_us: int, count: int, rng: np.random.Generator) -> NDArray[Any]:
    """`count` events of one window, sorted by time: the runway's image of the state (4,), and pixels that fire again and again."""
    runway = np.flatnonzero(runway_image(scene, state))
    busy = np.flatnonzero(rng.random(scene.camera.width * scene.camera.height) < BUSY)
    pixels = np.concatenate([runway, rng.choice(np.concatenate([runway, busy]), count - len(runway))])
    events = np.empty(count, dtype=EVENT)
    events["y"], events["x"] = np.divmod(rng.permutation(pixels), scene.camera.width)
    events["t"], events["p"] = np.sort(rng.integers(start_us, start_us + WINDOW_US, count)), rng.integers(0, 2, count)
    return events


def evt3_words(events: NDArray[Any]) -> NDArray[np.uint16]:
    """Events sorted by time as EVT3, which says a time or a row only where it changes; complete in itself."""
    t, y = events["t"], events["y"]
    words = np.empty((len(events), 4), dtype=np.uint16)
    words[:, 0], words[:, 1] = TIME_HIGH | (t >> 12 & 0xFFF), TIME_LOW | (t & 0xFFF)
    words[:, 2], words[:, 3] = ROW | y, COLUMN | events["p"].astype(np.int32) << 11 | events["x"]
    said = np.ones(words.shape, dtype=bool)
    said[1:, 0], said[1:, 1], said[1:, 2] = t[1:] >> 12 != t[:-1] >> 12, t[1:] != t[:-1], y[1:] != y[:-1]
    return words[said]


def write_recording(path: Path, scene: Scene, seconds: float, rate_hz: float, seed: int = 0) -> int:
    """Writes the recording window by window, in constant memory, whole or not at all; returns how many events it has."""
    rng, windows, count = np.random.default_rng(seed), round(seconds * 1e6 / WINDOW_US), round(rate_hz * WINDOW_US / 1e6)
    with replacing(path) as part, part.open("wb") as file:
        file.write(f"% evt 3.0\n% geometry {scene.camera.width}x{scene.camera.height}\n% end\n".encode())
        for number, state in enumerate(approach_states(scene, windows, 0.0)):
            file.write(evt3_words(events_of_window(scene, state, number * WINDOW_US, count, rng)).tobytes())
    return windows * count


def cost_of(program: str, *arguments: object) -> Cost:
    """Runs a Python program in a process of its own, its output discarded. Raises OSError if it fails."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    begun = time.perf_counter()
    pid = os.posix_spawn(
        sys.executable,
        [sys.executable, "-c", program, *map(str, arguments)],
        os.environ,
        file_actions=[(os.POSIX_SPAWN_DUP2, nowhere, 1)],
    )
    _, status, usage = os.wait4(pid, 0)
    os.close(nowhere)
    if status:
        raise OSError(f"the measured process ended with exit code {os.waitstatus_to_exitcode(status)}")
    return Cost(time.perf_counter() - begun, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / MB)


def rows_of(costs: Iterator[tuple[str, float, Cost, str]]) -> Iterator[list[str]]:
    """A line a measured process: its name, its time beside the recording's, its memory, and what else there is to say."""
    for name, seconds, cost, note in costs:
        times = f"{cost.wall_s:.1f}", f"{cost.wall_s / seconds:.2f}", f"{cost.processor_s:.1f}", f"{cost.processor_s / seconds:.2f}"
        yield [name, *times, f"{cost.resident_mb:.0f}", note]


def measured(model: Path, scene: Scene, out: Path, seconds: float, rate_hz: float, longer: int) -> Iterator[tuple[str, float, Cost, str]]:
    """Name, seconds of recording, cost and note of each process, one after the other."""
    short, long = out / "short.raw", out / "long.raw"
    count = write_recording(short, scene, seconds, rate_hz)
    for stage, name in STAGE_NAMES.items():
        yield name, seconds, cost_of(STAGES, model, short, stage), f"{count:,} events" if stage == "decode" else ""
    yield "run-model --no-video", seconds, cost_of(RUN_MODEL, model, short, "-o", out / "run", "--no-video"), ""
    with_video = cost_of(RUN_MODEL, model, short, "-o", out / "run")
    size_mb = (out / "run" / "overlay.mp4").stat().st_size / MB
    yield "run-model", seconds, with_video, f"video {size_mb / seconds:.2f} MB a second"
    if longer > 1:
        write_recording(long, scene, seconds * longer, rate_hz)
        cost = cost_of(RUN_MODEL, model, long, "-o", out / "run", "--no-video")
        yield f"run-model --no-video, {longer} x as long", seconds * longer, cost, ""
        long.unlink()


def main(
    model: Annotated[Path, typer.Option(help="Model to run.")] = Path("models/paper.onnx"),
    seconds: Annotated[float, typer.Option(min=0.04, help="Length of the recording.")] = 10.0,
    longer: Annotated[int, typer.Option(min=1, help="How many times as long the recording is whose memory is compared; 1: none.")] = 10,
    rate: Annotated[float, typer.Option(min=1e5, help="Events a second.")] = 2e6,
    out: Annotated[Path, typer.Option(help="Folder for the recordings and what is made of them.")] = Path("out/bench_recording"),
) -> None:
    """Make a busy recording, run run-model on it and print what that costs."""
    console = terminal.console(130)
    table = Table("process", "wall s", "/ real time", "processor s", "/ real time", "MB", "", title_justify="left")
    try:
        scene = Estimator.load(model).scene
        out.mkdir(parents=True, exist_ok=True)
        for row in rows_of(measured(model, scene, out, seconds, rate, longer)):
            table.add_row(*row)
    except (ModelError, OSError) as error:
        fail(error)
    console.print(table)


if __name__ == "__main__":
    terminal.run(main)

"""Which window of events, which instant of it and which budget a camera needs: how many pixels of the runway are dark, on a recording.

    python scripts/choose_window.py RECORDING TRUTH.csv [--scene SCENE.toml] [--every N] [--share 0.95]

For windows of 2 to 40 ms and their start, middle and end: the pixels of the runway's image at that instant which show no event, as
Theorem A's assumption counts them; their median, and the budget that the given share of the windows keeps. Every N-th window counts. A
long window gathers more edges, and more clutter; the instant matters where the runway moves by a pixel or more within it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import track
from rich.table import Table

from runtime import EventError, FrameStream, Scene, SceneError, terminal
from runtime.errors import fail
from runtime.explanation import missed_pixels
from runtime.recordings.recording import RecordingError, read_events
from runtime.recordings.truth import Truth, TruthError
from runtime.scene import INSTANTS

WINDOWS_MS = (2, 5, 10, 20, 40)
FIELD = Path(__file__).resolve().parent.parent / "models" / "field.toml"


@dataclass(frozen=True)
class Shortage:
    """Windows of one length: the share of the pixels that are lit, and by instant how many pixels of the runway are dark in each window."""

    window_ms: int
    lit_share: float
    missed: dict[str, list[int]]


def shortage(scene: Scene, recording: Path, truth: Truth, window_ms: int, every: int) -> Shortage:
    """What every N-th window of that length lacks of the true runway. Raises `RecordingError` or `EventError`."""
    window_us, lit = 1000 * window_ms, []
    missed: dict[str, list[int]] = {name: [] for name in INSTANTS}
    frames = FrameStream(scene.camera.shape, window_us).frames(read_events(recording, scene.camera.shape))
    for number, (start_us, frame) in enumerate(frames):
        if number % every:
            continue
        states = {name: truth.at(start_us + share * window_us) for name, share in INSTANTS.items()}
        if any(state is None for state in states.values()):
            continue
        lit.append(float(frame.mean()))
        for name, state in states.items():
            assert state is not None
            missed[name].append(missed_pixels(scene, frame, state, scene.tolerance.line_px))
    return Shortage(window_ms, float(np.mean(lit)) if lit else 0.0, missed)


def main(
    recording: Annotated[Path, typer.Argument(help="Event recording.")],
    truth: Annotated[Path, typer.Argument(help="CSV of its true states: time_us, theta_rad, x_m, y_m, z_m.")],
    scene: Annotated[Path, typer.Option(help="Scene file: camera and markings.")] = FIELD,
    every: Annotated[int, typer.Option(min=1, help="Every so many windows of 40 ms one counts, and as many of the shorter ones.")] = 10,
    share: Annotated[float, typer.Option(min=0, max=1, help="Share of the windows that the budget shall hold for.")] = 0.95,
) -> None:
    """Count dark pixels of the runway by window, instant and budget."""
    console = terminal.console()
    try:
        loaded, known = Scene.load(scene), Truth.load(truth)
        found = [
            shortage(loaded, recording, known, window_ms, every * max(WINDOWS_MS) // window_ms)
            for window_ms in track(WINDOWS_MS, "windows", console=terminal.console(stderr=True), transient=True)
        ]
    except (SceneError, TruthError, RecordingError, EventError, OSError) as error:
        fail(error)
    if not found[-1].missed["middle"]:
        fail(f"{truth}: no window lies within its times; give the truth of this recording")
    table = Table("window", "lit", *(f"{name}: median, {share:.0%}" for name in INSTANTS), title="dark pixels of the runway")
    for each in found:
        counts = (f"{np.median(missed):.0f}, {np.quantile(missed, share):.0f}" for missed in each.missed.values())
        table.add_row(f"{each.window_ms} ms", f"{each.lit_share:.2%}", *counts)
    console.print(table)


if __name__ == "__main__":
    terminal.run(main)

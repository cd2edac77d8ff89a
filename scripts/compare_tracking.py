"""What is known besides the frames of a recording, and what each of it is worth: certified bands over time, one beside the other.

    python scripts/compare_tracking.py MODEL.onnx RECORDING TRUTH.csv [--attitude CSV] [--gyroscope CSV] [--motion 0.05,0,0.02,0.02]
        [--window-ms 40] [--missed-budget M] [--horizon N] [--outliers Q]

For the frame alone, over time, and over time with the attitude reference, with the gyroscope, and with both, as `run-model --track` follows
them: windows that are certified, how many of these lack the truth, how often a fault is found, and half-widths of theta, y and z. The truth
is that of each window's instant; `broken` windows lack more pixels of the true runway than the budget, and nothing is certified of those,
nor, without a horizon, of what follows them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track
from rich.table import Table

from runtime import Estimate, Estimator, EventError, FrameStream, ModelError, Outcome, terminal
from runtime.errors import fail
from runtime.explanation import missed_pixels
from runtime.recordings.attitude import AttitudeError
from runtime.recordings.follower import Follower, References, TrackingError
from runtime.recordings.gyroscope import GyroscopeError
from runtime.recordings.recording import RecordingError, read_events
from runtime.recordings.truth import Truth, TruthError

FREE = [0, 2, 3]
"""The axes that are shown: theta, y and z."""

Frame = NDArray[np.uint8]
Windows = list[tuple[float, Frame, NDArray[np.float64]]]
"""Instant, us, frame, and true state of each window."""


@dataclass
class Band:
    """What one way of reading the windows came to."""

    name: str
    counts: Counter[str] = field(default_factory=Counter)
    half_widths: list[NDArray[np.float64]] = field(default_factory=list)

    def add(self, estimate: Estimate, state: NDArray[np.float64], broken: bool) -> None:
        """Counts a window."""
        kind = "broken" if broken else "kept"
        self.counts["found"] += estimate.outcome is not Outcome.CERTIFIED
        if estimate.box is not None:
            self.counts.update({"certified": 1, f"{kind}, without the truth": int(not estimate.box.contains(state))})
            self.half_widths.append(estimate.box.half_widths[FREE])


def windows_of(estimator: Estimator, recording: Path, truth: Truth, window_us: int) -> Windows:
    """The recording's windows whose instants have a truth. Raises `RecordingError` and `EventError`."""
    shape, share = estimator.scene.camera.shape, estimator.scene.instant_share
    frames = FrameStream(shape, window_us).frames(read_events(recording, shape))
    timed = ((start_us + share * window_us, frame.copy()) for start_us, frame in frames)
    return [(instant_us, frame, state) for instant_us, frame in timed if (state := truth.at(instant_us)) is not None]


def band_of(name: str, estimated: Callable[[Frame, float], Estimate], windows: Windows, broken: list[bool]) -> Band:
    """All windows, read one after the other."""
    band = Band(name)
    rows = list(zip(windows, broken, strict=True))
    for (instant_us, frame, state), breaks in track(rows, name, console=terminal.console(stderr=True), transient=True):
        band.add(estimated(frame, instant_us), state, breaks)
    return band


def table_of(bands: list[Band], title: str) -> Table:
    """A row a band."""
    columns = ("certified", "found", "kept, without the truth", "broken, without the truth")
    table = Table("", *columns, "half-widths, median", "mean", title=title, title_justify="left")
    for band in bands:
        widths = np.array(band.half_widths).reshape(-1, len(FREE))
        shown = [" ".join(f"{width:.4f}" for width in of(widths, axis=0)) if len(widths) else "-" for of in (np.median, np.mean)]
        table.add_row(band.name, *(str(band.counts[column]) for column in columns), *shown)
    return table


def main(
    model: Annotated[Path, typer.Argument(help="Model that export-model wrote.")],
    recording: Annotated[Path, typer.Argument(help="Event recording.")],
    truth: Annotated[Path, typer.Argument(help="CSV of its true states: time_us, theta_rad, x_m, y_m, z_m.")],
    attitude: Annotated[Path | None, typer.Option(help="CSV of an attitude reference.")] = None,
    gyroscope: Annotated[Path | None, typer.Option(help="CSV of a gyroscope.")] = None,
    motion: Annotated[str | None, typer.Option(help="Largest rates of theta, x, y, z; by default the scene's.")] = None,
    window_ms: Annotated[float, typer.Option(help="Length of a window.")] = 40.0,
    missed_budget: Annotated[int | None, typer.Option(help="Pixels of the runway that may be dark, in place of the model's.")] = None,
    horizon: Annotated[int | None, typer.Option(help="A box rests on the last so many windows alone.")] = None,
    outliers: Annotated[int, typer.Option(help="Windows of the horizon that may break their assumptions.")] = 0,
) -> None:
    """Compare certified bands over time on one recording."""
    try:
        estimator = Estimator.load(model, missed_budget=missed_budget)
        windows = windows_of(estimator, recording, Truth.load(truth), round(1000 * window_ms))
        line_px, budget = estimator.scene.tolerance.line_px, estimator.missed_budget
        broken = [missed_pixels(estimator.scene, frame, state, line_px) > budget for _, frame, state in windows]
        ways: dict[str, tuple[Path | None, Path | None]] = {"over time": (None, None)}
        ways |= {} if attitude is None else {"with the reference": (attitude, None)}
        ways |= {} if gyroscope is None else {"with the gyroscope": (None, gyroscope)}
        ways |= {} if attitude is None or gyroscope is None else {"with both": (attitude, gyroscope)}
        followers = {
            name: Follower.of(estimator, References(*files, pitch_alone=True), motion, horizon, outliers) for name, files in ways.items()
        }
        bands = [band_of("the frame alone", lambda frame, _: estimator.estimate(frame), windows, broken)]
        bands += [band_of(name, follower.update, windows, broken) for name, follower in followers.items()]
    except (ModelError, RecordingError, EventError, TruthError, AttitudeError, GyroscopeError, TrackingError, OSError) as error:
        fail(error)
    lasts = "" if horizon is None else f", horizon {horizon}, outliers {outliers}"
    title = f"{len(windows)} windows of {window_ms:g} ms, {sum(broken)} broken, m = {budget}{lasts}"
    terminal.console(150).print(table_of(bands, title))


if __name__ == "__main__":
    terminal.run(main)

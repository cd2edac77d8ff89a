"""Replays a recording at its own pace into the estimator, the way a camera's driver would feed it.

    python scripts/replay.py RECORDING [--model MODEL.onnx] [--packet-ms 10] [--speed 1] [--window-ms 40] [--step-ms 40]

A driver calls back with a packet of events every few milliseconds. `Replay.run` does that with a file's events: it waits until the
packet's last event is due and calls back. `LiveEstimator.on_events` is such a callback, all that a program with a camera needs: it feeds
a `FrameStream` and estimates every frame that the packet completes. Prints a line a window, with the delay from the window's last
instant to its estimate. Ctrl-C ends the replay. Exit code 2 if something given cannot be used.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from runtime import Estimate, Estimator, ModelError, terminal
from runtime.errors import fail
from runtime.frames import LARGEST_GAP_US, EventError, FrameStream
from runtime.recordings.recording import RecordingError, read_events
from runtime.runs import LARGEST_STEP_BACK_US
from runtime.scene import STATE_NAMES

Packet = NDArray[Any]


class Replay:
    """Events in packets of `packet_us`, each handed over when its last event is due, `speed` times as fast as recorded.

    Where time goes back, or on by more than a pause, the recording's clock broke: the next packet is due at once, and the pace goes on.
    """

    def __init__(self, packets: Iterable[Packet], packet_us: int, speed: float) -> None:
        self._packets, self._packet_us, self._speed = packets, packet_us, speed
        self._first_us = 0
        self._begun_s = 0.0

    def run(self, on_events: Callable[[Packet], None]) -> None:
        """Calls `on_events` with every packet, in order; a callback that takes too long delays the next one and loses nothing."""
        last_us: int | None = None
        for packet in _packets_of(self._packets, self._packet_us):
            latest_us = int(packet["t"].max())
            if last_us is None:
                self._first_us, self._begun_s = int(packet["t"][0]), time.monotonic()
            elif not -LARGEST_STEP_BACK_US <= latest_us - last_us <= LARGEST_GAP_US:
                self._first_us += latest_us - last_us
            last_us = latest_us
            due_s = self._begun_s + (latest_us - self._first_us) / 1e6 / self._speed
            time.sleep(max(0.0, due_s - time.monotonic()))
            on_events(packet)

    def lag_ms(self, time_us: int) -> float:
        """How long ago an instant of the recording was due, ms of the clock on the wall."""
        return 1000 * (time.monotonic() - self._begun_s - (time_us - self._first_us) / 1e6 / self._speed)


def _packets_of(packets: Iterable[Packet], packet_us: int) -> Iterator[Packet]:
    """The same events, cut where a multiple of `packet_us` passes."""
    for packet in packets:
        borders = np.flatnonzero(np.diff(packet["t"] // packet_us)) + 1
        yield from (part for part in np.split(packet, borders) if len(part))


class LiveEstimator:
    """A driver's callback: `on_events` takes packets and hands (start_us, estimate) of every completed window to `on_estimate`."""

    def __init__(self, estimator: Estimator, stream: FrameStream, on_estimate: Callable[[int, Estimate], None]) -> None:
        self._estimator, self._stream, self._on_estimate = estimator, stream, on_estimate

    def on_events(self, events: Packet) -> None:
        """Takes a packet; returns when the windows that it completes are estimated."""
        for start_us, frame in self._stream.feed(events):
            self._on_estimate(start_us, self._estimator.estimate(frame))


def line_of(start_us: int, estimate: Estimate, lag_ms: float) -> str:
    """A window's line: start, outcome, state with half-widths, delay."""
    if estimate.box is None or estimate.state is None:
        found = f"{estimate.outcome.value:<10}"
    else:
        rows = zip(STATE_NAMES, estimate.state, estimate.box.half_widths, strict=True)
        state = "  ".join(f"{name} {value:.4f} (box ±{half:.4f})" for name, value, half in rows if half > 0)
        found = f"{estimate.outcome.value:<10} {state}"
    return f"{start_us / 1e6:9.3f} s  {found}  {lag_ms:.1f} ms late"


def run(replay: Replay, estimator: Estimator, stream: FrameStream) -> None:
    """Replays, and prints every window and at the end what became of the events."""

    def show(start_us: int, estimate: Estimate) -> None:
        print(line_of(start_us, estimate, replay.lag_ms(start_us + stream.window_us)), flush=True)

    try:
        replay.run(LiveEstimator(estimator, stream, show).on_events)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    lost = f"{stream.late_events} late, {stream.unsorted_events} unsorted, {stream.outside_events} outside the sensor"
    print(f"events: {lost}, {stream.misdated_events} misdated; {stream.runs} {'run' if stream.runs == 1 else 'runs'} of the clock")


def main(
    recording: Annotated[Path, typer.Argument(help="Event recording.")],
    model: Annotated[Path | None, typer.Option(help="Model; by default the paper's.")] = None,
    packet_ms: Annotated[float, typer.Option(min=0.001, help="A driver's packet.")] = 10.0,
    speed: Annotated[float, typer.Option(min=0.001, help="1 is the pace of the recording.")] = 1.0,
    window_ms: Annotated[float, typer.Option(help="Length of a window.")] = 40.0,
    step_ms: Annotated[float | None, typer.Option(help="From one window to the next; less than a window overlaps.")] = None,
) -> None:
    """Replay a recording at its own pace into the estimator."""
    try:
        estimator = Estimator.load(model)
        shape = estimator.scene.camera.shape
        stream = FrameStream(shape, round(window_ms * 1000), None if step_ms is None else round(step_ms * 1000))
        run(Replay(read_events(recording, shape), max(1, round(packet_ms * 1000)), speed), estimator, stream)
    except (ModelError, RecordingError, EventError) as error:
        fail(error)


if __name__ == "__main__":
    terminal.run(main)

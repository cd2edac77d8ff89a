"""What a command tells of a recording beside its windows: events that are in none, breaks of the clock, and how the file was understood."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from runtime.frames import FrameStream
from runtime.recordings.packet import Notes

BREAKS_TOLD = 3
"""Breaks of the clock that are told on the screen; summary.json has more."""


def noted_of(stream: FrameStream, notes: Notes) -> dict[str, Any]:
    """For summary.json: counts of events, what the reader found, and the runs of the clock."""
    events = {"late": stream.late_events, "unsorted": stream.unsorted_events, "outside_sensor": stream.outside_events}
    return {
        "layout": notes.layout,
        "events_to_note": {**events, "misdated": stream.misdated_events},
        "recording_to_note": {name: count for name, count in sorted(notes.counts.items()) if count},
        "largest_gap_us": stream.largest_gap_us,
        "runs": stream.runs,
        "breaks": [asdict(found) for found in stream.breaks],
    }


def lines_of(noted: dict[str, Any]) -> list[str]:
    """The same for the screen: a line on events, on the reader and on the clock, each only if there is something to tell."""
    lines, gap = [], f"largest_gap_us {noted['largest_gap_us']}"
    counts = noted["events_to_note"]
    if any(counts.values()):
        counted = ", ".join(f"{count} {name.replace('_', ' the ')}" for name, count in counts.items() if count)
        misdated = f"; misdated: at times that their neighbours contradict, {gap}" if counts["misdated"] else ""
        lines.append(f"events to note: {counted}; late and misdated ones and those outside the sensor are in no window{misdated}")
    if noted["recording_to_note"]:
        lines.append("recording to note: " + ", ".join(f"{name}: {count}" for name, count in noted["recording_to_note"].items()))
    if noted["runs"] > 1:
        told = [f"after {found['before_us'] / 1e6:.6f} s comes {found['after_us'] / 1e6:.6f} s" for found in noted["breaks"][:BREAKS_TOLD]]
        more = ["..."] if noted["runs"] - 1 > len(told) else []
        cause = f"it went back, or on by more than {gap}"
        lines.append(f"clock to note: {noted['runs']} runs of windows ({'; '.join([*told, *more])}): {cause}")
    return lines

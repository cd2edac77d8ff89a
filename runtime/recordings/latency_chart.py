"""The chart of `bench-model`: what a frame costs by each method, on each kind of frames."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from runtime.recordings.bench import Latency
from runtime.recordings.chart import (
    BLUE,
    FONT_PT,
    GREY,
    INK,
    PALE,
    RED,
    SMALL_PT,
    new_figure,
    picture_of,
    rgb,
    style_axes,
    with_own_settings,
)
from runtime.recordings.draw import Picture

WIDTH_PX = 1280
ROW_IN, PANEL_IN, FRAME_IN = 0.17, 0.35, 1.1
"""Heights of a method's row, of what a panel needs besides, and of what all panels share."""
LETTERS = 110
"""Most letters on a line of small ones."""


@with_own_settings
def latency_chart(header: Mapping[str, str], rows: Sequence[Latency]) -> Picture:
    """Milliseconds a frame on a logarithmic scale, a panel for each kind of frames: bars to p50, marks at p99, both as numbers; (height,
    `WIDTH_PX`, 3).
    """
    kinds = list(dict.fromkeys(row.frames for row in rows))
    panels_in = [PANEL_IN + ROW_IN * sum(row.frames == kind for row in rows) for kind in kinds]
    figure = new_figure(FRAME_IN + sum(panels_in), WIDTH_PX)
    panels = figure.subplots(len(kinds), sharex=True, squeeze=False, height_ratios=panels_in)[:, 0]
    for panel, kind in zip(panels, kinds, strict=True):
        _draw_panel(panel, kind, [row for row in rows if row.frames == kind])
    panels[-1].set(xscale="log", xlim=(min(row.p50_ms for row in rows) / 2, max(row.p99_ms for row in rows) * 4))
    panels[-1].set_xlabel("time of a frame (ms)")
    panels[-1].xaxis.set_major_formatter(lambda milliseconds, _: f"{milliseconds:g}")
    marks = [
        Patch(color=rgb(BLUE), label="p50, Glideproof"),
        Patch(color=rgb(GREY), label="p50, others"),
        Line2D([], [], color=rgb(RED), linewidth=0, marker="|", markersize=9, markeredgewidth=1.5, label="p99"),
    ]
    figure.legend(handles=marks, loc="outside upper left", ncols=len(marks), frameon=False, fontsize=FONT_PT, labelcolor=rgb(INK))
    machine = textwrap.fill(", ".join(f"{name} {value}" for name, value in header.items()), LETTERS)
    figure.supxlabel(machine, x=0.02, ha="left", fontsize=SMALL_PT, color=rgb(INK))
    return picture_of(figure)


def _draw_panel(panel: Axes, kind: str, rows: Sequence[Latency]) -> None:
    """The rows of one kind of frames, from the top down."""
    style_axes(panel, INK, PALE)
    panel.set_title(kind, loc="left", fontsize=FONT_PT, color=rgb(INK), fontweight="bold")
    places = range(len(rows))
    ours = [row.method.startswith(("session", "estimate")) for row in rows]
    panel.barh(places, [row.p50_ms for row in rows], height=0.7, color=[rgb(BLUE if own else GREY) for own in ours])
    panel.plot([row.p99_ms for row in rows], places, color=rgb(RED), linewidth=0, marker="|", markersize=9, markeredgewidth=1.5)
    for place, row in zip(places, rows, strict=True):
        text = {"va": "center", "fontsize": SMALL_PT, "color": rgb(INK)}
        panel.annotate(f"{row.p50_ms:#.3g}, {row.p99_ms:#.3g} ms", (row.p99_ms, place), (6, 0), textcoords="offset points", **text)
    panel.set_yticks(places, [row.method for row in rows])
    panel.tick_params(axis="y", length=0)
    panel.grid(axis="x", color=rgb(PALE), linewidth=0.5)
    panel.invert_yaxis()

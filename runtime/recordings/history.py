"""States against time: what a history keeps of a recording of any length, and its chart.

The chart has the colours of `runtime.recordings.draw`: amber for the certified bands, magenta for the estimate, white for the truth, red
for times at which nothing is certified. With a tracker the estimate is the one over time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from numpy.typing import NDArray

from runtime.estimate import Box
from runtime.recordings.chart import FONT_PT, new_figure, picture_of, rgb, style_axes, with_own_settings
from runtime.recordings.draw import BACKGROUND, FRAME_BORDER, NO_RUNWAY, STATE, TEXT, TRUTH, Picture
from runtime.scene import STATE_NAMES, STATE_UNITS, Scene

MOST_MOMENTS = 2048
"""Moments that a history keeps: more than a picture has columns."""
WIDTH_PX = 1280
PANEL_IN, LEGEND_AND_TIME_IN = 1.3, 0.8
"""Heights of one axis's panel, and of what all panels share."""
MARGIN = 0.2
"""What a panel shows above and below the domain, as a share of the domain's width."""
BAND = (0, 85, 130)
"""Amber as it looks over the background."""
TRACKED = (60, 175, 240)
"""Lighter amber: what is certified over time, within the band of the frame alone."""
MARK_HEIGHT = 0.05
"""Height of the mark where nothing is certified, at the foot of a panel, as a share of the panel's."""


@dataclass(frozen=True)
class Moment:
    """What is known of the time from `start_us` to `stop_us`: estimate, certified bounds and truth, (4,) each or None.

    The bounds are those of the frame alone; the estimate is the best there is: with `tracked`, that over time.
    """

    start_us: float
    stop_us: float
    state: NDArray[np.float64] | None
    lower: NDArray[np.float64] | None
    upper: NDArray[np.float64] | None
    truth: NDArray[np.float64] | None
    tracked: Box | None = None
    """Certified over time (`runtime.tracker`)."""

    def joined(self, later: Moment) -> Moment:
        """Both as one: the hull of their bounds, the later states; uncertified only if neither is certified."""
        bounds = [(moment.lower, moment.upper) for moment in (self, later) if moment.lower is not None and moment.upper is not None]
        lower = np.min([low for low, _ in bounds], axis=0) if bounds else None
        upper = np.max([high for _, high in bounds], axis=0) if bounds else None
        tracked = Box.around([moment.tracked for moment in (self, later) if moment.tracked is not None])
        state, truth = (old if new is None else new for old, new in ((self.state, later.state), (self.truth, later.truth)))
        return Moment(self.start_us, later.stop_us, state, lower, upper, truth, tracked)


class History:
    """Moments one after the other, in constant memory: when there are too many, neighbours are joined.

    Each begins where the one before it ends, whatever its time: after a break of the camera's clock the picture goes on.
    """

    def __init__(self) -> None:
        self.moments: list[Moment] = []
        self._every = 1
        self._count = 0

    def add(self, moment: Moment) -> None:
        """Takes the next moment."""
        if self.moments:
            start_us = self.moments[-1].stop_us
            moment = replace(moment, start_us=start_us, stop_us=start_us + moment.stop_us - moment.start_us)
        if self._count % self._every:
            self.moments[-1] = self.moments[-1].joined(moment)
        else:
            self.moments.append(moment)
        self._count += 1
        if len(self.moments) == MOST_MOMENTS and self._count % self._every == 0:
            self.moments = [even.joined(odd) for even, odd in zip(self.moments[::2], self.moments[1::2], strict=True)]
            self._every *= 2


@with_own_settings
def draw_history(scene: Scene, history: History, width: int = WIDTH_PX) -> Picture:
    """State against time in s, a panel for each free axis of the domain, whose faces are marked: (height, `width`, 3)."""
    free = [axis for axis in range(4) if scene.domain.upper[axis] > scene.domain.lower[axis]]
    moments = history.moments or [Moment(0, 1, None, None, None, None)]
    figure = new_figure(LEGEND_AND_TIME_IN + PANEL_IN * len(free), width)
    figure.set_facecolor(rgb(BACKGROUND))
    panels = figure.subplots(len(free), sharex=True, squeeze=False)[:, 0] if free else []
    for panel, axis in zip(panels, free, strict=True):
        _draw_panel(panel, moments, axis, float(scene.domain.lower[axis]), float(scene.domain.upper[axis]))
    figure.supxlabel("time (s)", color=rgb(TEXT), fontsize=FONT_PT)
    figure.align_ylabels()
    handles = [Patch(color=rgb(colour), label=label) for label, colour in _legend(moments)]
    look = {"frameon": False, "fontsize": FONT_PT, "labelcolor": rgb(TEXT), "handlelength": 1.2}
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles), **look)
    return picture_of(figure)


def _legend(moments: Sequence[Moment]) -> list[tuple[str, tuple[int, int, int]]]:
    """Names and colours of what the moments have."""
    followed = any(moment.tracked is not None for moment in moments)
    present = {
        ("certified by the frame alone" if followed else "certified band", BAND): any(moment.lower is not None for moment in moments),
        ("certified over time", TRACKED): followed,
        ("estimate", STATE): any(moment.state is not None for moment in moments),
        ("truth", TRUTH): any(moment.truth is not None for moment in moments),
        ("no runway", NO_RUNWAY): any(moment.lower is None for moment in moments),
    }
    return [entry for entry, there in present.items() if there]


def _draw_panel(panel: Axes, moments: Sequence[Moment], axis: int, low: float, high: float) -> None:
    """One axis of the state, over the domain's range [low, high] and `MARGIN` above and below it."""
    edges = np.array([(moment.start_us, moment.stop_us) for moment in moments]) / 1e6
    lower, upper, state, truth = (
        np.array([np.nan if values is None else values[axis] for values in (getattr(moment, name) for moment in moments)])
        for name in ("lower", "upper", "state", "truth")
    )
    # A moment's bounds hold from its start to its stop: steps, with both ends of each.
    times, ends = edges.ravel(), (lower.repeat(2), upper.repeat(2))
    panel.set_facecolor(rgb(BACKGROUND))
    style_axes(panel, TEXT, FRAME_BORDER)
    panel.set_ylabel(f"{STATE_NAMES[axis]} ({STATE_UNITS[axis]})")
    margin = MARGIN * (high - low)
    panel.set(xlim=(times[0], times[-1]), ylim=(low - margin, high + margin), yticks=[low, (low + high) / 2, high])
    panel.hlines([low, high], times[0], times[-1], colors=[rgb(FRAME_BORDER)], linewidth=0.8)
    panel.fill_between(times, *ends, color=rgb(BAND), linewidth=0)
    tracked = np.array(
        [[np.nan] * 2 if box is None else [box.lower[axis], box.upper[axis]] for box in (moment.tracked for moment in moments)]
    )
    panel.fill_between(times, *tracked.T.repeat(2, axis=1), color=rgb(TRACKED), linewidth=0)
    none = np.isnan(lower).repeat(2)
    panel.fill_between(times, 0, MARK_HEIGHT, where=none.tolist(), transform=panel.get_xaxis_transform(), color=rgb(NO_RUNWAY), linewidth=0)
    for values, colour in ((state, STATE), (truth, TRUTH)):
        panel.plot(edges.mean(axis=1), values, color=rgb(colour), linewidth=0.7)

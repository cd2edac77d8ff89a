"""Charts: matplotlib's figures as pictures, through its objects alone, so that neither a window nor a global state is involved.

What makes one is decorated with `with_own_settings`: a chart looks the same whoever draws it, and wherever.
"""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from runtime.recordings.draw import Colour, Picture

WIDTH_IN = 6.4
"""Width of every chart, in inches; a wider picture has more pixels an inch, and larger letters with them."""
EDGE_IN = 0.08
"""Margin around the figure and between its parts, in inches."""
INK, PALE, BLUE, GREY, RED = (40, 40, 40), (205, 205, 205), (170, 110, 40), (160, 160, 160), (40, 40, 200)
"""Colours on white: of letters, of grids, and of what is compared."""
FONT_PT, SMALL_PT = 9.0, 7.0
"""Letters of `FONT_PT` are 25 px high in a picture 1280 px wide: readable where a page shows it at 640."""

OWN_SETTINGS: dict[Any, Any] = {name: value for name, value in matplotlib.rcParamsDefault.items() if not name.startswith("backend")}
"""matplotlib's defaults, but for what shows windows. A user's own, from a file in the home or in the current folder, may be of any kind,
letters by LaTeX among them."""
with_own_settings = matplotlib.rc_context(OWN_SETTINGS)
"""Decorator, and context, in which a chart is made and drawn."""


def new_figure(height_in: float, width_px: int) -> Figure:
    """An empty figure, `WIDTH_IN` x `height_in` inches, of `width_px` pixels across; what is added is laid out without overlaps."""
    layout = ConstrainedLayoutEngine(w_pad=EDGE_IN, h_pad=EDGE_IN / 2)
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=width_px / WIDTH_IN, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def rgb(colour: Colour) -> tuple[float, float, float]:
    """A picture's colour, BGR of 0 to 255, as matplotlib takes it."""
    blue, green, red = (part / 255 for part in colour)
    return red, green, blue


def style_axes(axes: Axes, text: Colour, lines: Colour) -> None:
    """Letters in the colour `text`; a grid, ticks and the left and lower border in the colour `lines`, behind the data."""
    axes.set_axisbelow(True)
    axes.tick_params(which="both", colors=rgb(lines), labelcolor=rgb(text), labelsize=FONT_PT)
    for side, spine in axes.spines.items():
        spine.set(visible=side in ("left", "bottom"), color=rgb(lines))
    for label in (axes.xaxis.label, axes.yaxis.label, axes.title):
        label.set(color=rgb(text), fontsize=FONT_PT)


def picture_of(figure: Figure) -> Picture:
    """The figure drawn, (height, width, 3), BGR."""
    canvas = figure.canvas
    if not isinstance(canvas, FigureCanvasAgg):
        raise TypeError(f"figure: found a canvas of {type(canvas).__name__}; take one of new_figure()")
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[:, :, 2::-1])

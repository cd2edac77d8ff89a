"""Pictures of an estimate, BGR uint8 arrays as OpenCV takes them.

| colour | what |
|---|---|
| grey | lit pixels of the frame |
| blue | the spatial mask S of the named cell |
| green | filtered pixels: the frame within the masks of the passing cells |
| amber, translucent | the certified box, projected into the image |
| magenta line | the markings of the estimated state |
| white line and circles | the markings of the true state and their ends, where it is known |

`draw_history` shows states against time in the same colours.

Pictures illustrate; the certificate is the box's numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.camera import project
from runtime.estimate import Box, Estimate
from runtime.scene import STATE_NAMES, STATE_UNITS, Scene

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

BACKGROUND, TEXT, FRAME, FRAME_BORDER = (24, 22, 20), (225, 225, 225), (150, 150, 150), (90, 90, 90)
MASK, MASK_TEXT, FILTERED, BOX, STATE, TRUTH = (140, 60, 20), (230, 140, 70), (90, 215, 70), (0, 170, 255), (255, 60, 255), (255, 255, 255)
CERTIFIED, NO_RUNWAY = (90, 215, 70), (80, 80, 255)
BAND = (0, 85, 130)
"""Amber as it looks over the background."""
BOX_LIGHT = 0.16
"""Share of its colour that the box adds to what lies under it: blue stays blue, dark turns amber."""
SAMPLES = 5
"""States an axis at which a box is projected."""
FRACTION_BITS = 4
"""Lines are placed to a 16th of a picture's pixel."""
END_RADIUS = 4
"""A circle marks each end of a marking, px of the picture; the truth's shows around an estimate that covers its line."""
MOST_MOMENTS = 2048
"""Moments that a history keeps: more than a picture has columns."""
HISTORY_WIDTH, PANEL_HEIGHT, PANEL_LEFT, PANEL_GAP = 1280, 200, 150, 14
NARROWEST_PICTURE = 560
"""Width that the text needs, px; narrower frames are magnified."""
LINE_HEIGHT = 24


@dataclass(frozen=True)
class View:
    """The part of the frame from (`top`, `left`), of `shape` (height, width) px, magnified `scale` times."""

    top: int
    left: int
    shape: tuple[int, int]
    scale: int

    def points(self, uv: ArrayLike) -> NDArray[np.int32]:
        """Frame coordinates (..., 2) px as the picture's fixed-point coordinates for OpenCV's `shift`."""
        # Pixel 0 covers [0, 1) in the frame, and OpenCV counts from a pixel's centre: hence the half.
        at = (np.asarray(uv, dtype=np.float64) - (self.left, self.top)) * self.scale - 0.5
        return np.round(np.clip(at, -(2**14), 2**14) * 2**FRACTION_BITS).astype(np.int32)


def draw_estimate(
    scene: Scene,
    frame: NDArray,
    estimate: Estimate,
    *,
    mask: NDArray[np.bool_] | None = None,
    truth: ArrayLike | None = None,
    title: str = "",
    zoom: int = 5,
) -> Picture:
    """The whole frame, beside it the runway `zoom` times larger, and below them the outcome in numbers with a legend.

    `frame`: (height, width), lit where not 0. `mask`: S of `estimate.cell`, bool (height, width). `truth`: a state (4,).
    Returns (height', 2 width', 3), where width' is the frame's width, magnified until the text fits.
    """
    scale = -(-NARROWEST_PICTURE // frame.shape[1])
    whole = View(0, 0, frame.shape, scale)
    close = runway_view(scene, estimate, truth, zoom, scale * zoom)
    pixels = colour_pixels(frame, estimate.filtered, mask)
    panels = [_magnified(pixels, whole), _magnified(pixels, close)]
    _outline(panels[0], whole, close)
    _draw_states(panels[1], scene, close, estimate, truth)
    beside = np.full((panels[0].shape[0], 2 * panels[0].shape[1], 3), BACKGROUND, dtype=np.uint8)
    for panel, left in zip(panels, (0, panels[0].shape[1]), strict=True):
        beside[: panel.shape[0], left : left + panel.shape[1]] = panel
    beside[:, panels[0].shape[1]] = FRAME_BORDER
    return np.concatenate([beside, _text_strip(scene, estimate, truth, title, mask is not None, beside.shape[1])])


def draw_runway(
    scene: Scene,
    frame: NDArray,
    estimate: Estimate,
    *,
    mask: NDArray[np.bool_] | None = None,
    truth: ArrayLike | None = None,
    title: str = "",
    zoom: int = 5,
    scale: int = 3,
) -> Picture:
    """Only the runway's surroundings, 1/`zoom` of the frame a side, magnified `scale` times, with one line of text."""
    view = runway_view(scene, estimate, truth, zoom, scale)
    panel = _magnified(colour_pixels(frame, estimate.filtered, mask), view)
    _draw_states(panel, scene, view, estimate, truth)
    strip = np.full((LINE_HEIGHT, panel.shape[1], 3), BACKGROUND, dtype=np.uint8)
    _write(strip, 0, [(title, TEXT), _outcome(estimate), (_cells(scene, estimate), TEXT)])
    return np.concatenate([strip, panel])


@dataclass(frozen=True)
class Moment:
    """What is known of the time from `start_us` to `stop_us`: estimate, certified bounds and truth, (4,) each or None."""

    start_us: float
    stop_us: float
    state: NDArray[np.float64] | None
    lower: NDArray[np.float64] | None
    upper: NDArray[np.float64] | None
    truth: NDArray[np.float64] | None

    def joined(self, later: Moment) -> Moment:
        """Both as one: the hull of their bounds, the later states; uncertified only if neither is certified."""
        bounds = [(moment.lower, moment.upper) for moment in (self, later) if moment.lower is not None and moment.upper is not None]
        lower = np.min([low for low, _ in bounds], axis=0) if bounds else None
        upper = np.max([high for _, high in bounds], axis=0) if bounds else None
        state, truth = (old if new is None else new for old, new in ((self.state, later.state), (self.truth, later.truth)))
        return Moment(self.start_us, later.stop_us, state, lower, upper, truth)


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


def draw_history(scene: Scene, history: History, width: int = HISTORY_WIDTH) -> Picture:
    """State against time: a panel for each free axis of the domain, whose range it spans.

    Amber: the certified band. Magenta: the estimate. White: the truth. Red, below: nothing is certified. Returns (height, width, 3).
    """
    free = [axis for axis in range(4) if scene.domain.upper[axis] > scene.domain.lower[axis]]
    moments = history.moments or [Moment(0, 1, None, None, None, None)]
    picture = np.full((len(free) * (PANEL_HEIGHT + PANEL_GAP) + 2 * LINE_HEIGHT, width, 3), BACKGROUND, dtype=np.uint8)
    seconds = moments[0].start_us / 1e6, moments[-1].stop_us / 1e6
    _write(picture, 0, [("certified band", BOX), ("estimate", STATE), ("truth", TRUTH), ("no runway", NO_RUNWAY)])
    for place, axis in enumerate(free):
        top = LINE_HEIGHT + place * (PANEL_HEIGHT + PANEL_GAP)
        _draw_panel(picture[top : top + PANEL_HEIGHT], moments, axis, scene.domain.lower[axis], scene.domain.upper[axis])
    _write(picture[-LINE_HEIGHT:], 0, [("", TEXT), (f"{seconds[0]:.2f} s to {seconds[1]:.2f} s", TEXT)])
    return picture


def _draw_panel(panel: Picture, moments: Sequence[Moment], axis: int, low: float, high: float) -> None:
    """One axis of the state over [low, high], with a fifth of that above and below."""
    first, last, right_end = moments[0].start_us, moments[-1].stop_us, panel.shape[1] - 1
    margin = (high - low) / 5

    def column(time_us: float) -> int:
        return PANEL_LEFT + int((time_us - first) / (last - first) * (right_end - PANEL_LEFT))

    def row(value: float) -> int:
        return int(np.clip((high + margin - value) / (high - low + 2 * margin), 0, 1) * (PANEL_HEIGHT - 1))

    for value in (low, high):
        cv2.line(panel, (PANEL_LEFT, row(value)), (right_end, row(value)), FRAME_BORDER, 1)
        text = f"{STATE_NAMES[axis]} {value:.2f} {STATE_UNITS[axis]}"
        cv2.putText(panel, text, (8, row(value) + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, TEXT, 1, cv2.LINE_AA)
    for moment in moments:
        left, right = column(moment.start_us), column(moment.stop_us)
        if moment.lower is None or moment.upper is None:
            cv2.rectangle(panel, (left, PANEL_HEIGHT - 8), (right, PANEL_HEIGHT - 1), NO_RUNWAY, cv2.FILLED)
        else:
            cv2.rectangle(panel, (left, row(moment.upper[axis])), (right, row(moment.lower[axis])), BAND, cv2.FILLED)
    for kind, colour in (("truth", TRUTH), ("state", STATE)):
        known = [(column((m.start_us + m.stop_us) / 2), row(getattr(m, kind)[axis])) for m in moments if getattr(m, kind) is not None]
        if known:
            cv2.polylines(panel, [np.array(known, dtype=np.int32)], False, colour, 1, cv2.LINE_AA)


def contact_sheet(pictures: Sequence[Picture], columns: int = 4, gap: int = 8) -> Picture:
    """Pictures of one shape, row by row, at most `columns` beside each other, `gap` px apart."""
    columns = min(columns, len(pictures))
    height, width, _ = pictures[0].shape
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * (height + gap) + gap, columns * (width + gap) + gap, 3), FRAME_BORDER, dtype=np.uint8)
    for position, picture in enumerate(pictures):
        row, column = divmod(position, columns)
        top, left = gap + row * (height + gap), gap + column * (width + gap)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def runway_view(scene: Scene, estimate: Estimate, truth: ArrayLike | None, zoom: int, scale: int) -> View:
    """1/`zoom` of the frame a side, within it, around the markings of estimate and truth, or of NN_e's state if there is neither."""
    known = [np.asarray(state) for state in (estimate.state, truth) if state is not None] or [estimate.network_state]
    centre = project(scene, np.stack(known)).reshape(-1, 2).mean(axis=0)
    size = np.maximum(np.array(scene.camera.shape) // zoom, 1)
    start = np.clip(np.round(np.nan_to_num(centre[::-1]) - size / 2), 0, np.array(scene.camera.shape) - size).astype(int)
    return View(int(start[0]), int(start[1]), (int(size[0]), int(size[1])), scale)


def box_outlines(scene: Scene, box: Box) -> NDArray[np.float64]:
    """Ends of every marking at `SAMPLES` states an axis of the box, corners included: (markings, points, 2) px.

    Every sampled marking lies in the convex hull of its row.
    """
    sides = zip(box.lower, box.upper, strict=True)
    axes = [np.unique(np.linspace(low, high, SAMPLES)) for low, high in sides]
    states = np.array(list(itertools.product(*axes)))
    return np.moveaxis(project(scene, states), 1, 0).reshape(len(scene.runway.markings), -1, 2)


def colour_pixels(frame: NDArray, filtered: NDArray, mask: NDArray[np.bool_] | None) -> Picture:
    """Background, S, frame and filtered pixels, each over the ones before: (height, width, 3)."""
    pixels = np.full((*frame.shape, 3), BACKGROUND, dtype=np.uint8)
    if mask is not None:
        pixels[mask] = MASK
    pixels[frame != 0] = FRAME
    pixels[filtered != 0] = FILTERED
    return pixels


def _magnified(pixels: Picture, view: View) -> Picture:
    part = pixels[view.top : view.top + view.shape[0], view.left : view.left + view.shape[1]]
    return part.repeat(view.scale, axis=0).repeat(view.scale, axis=1)


def _outline(panel: Picture, whole: View, part: View) -> None:
    """Marks in `panel`, which shows `whole`, where `part` was taken from."""
    corners = [(part.left, part.top), (part.left + part.shape[1], part.top + part.shape[0])]
    (left, top), (right, bottom) = (whole.points(corners) >> FRACTION_BITS).tolist()
    cv2.rectangle(panel, (left, top), (right, bottom), FRAME_BORDER, 1)


def _draw_states(panel: Picture, scene: Scene, view: View, estimate: Estimate, truth: ArrayLike | None) -> None:
    """The box as a translucent band, then the markings of the estimate and of the truth."""
    if estimate.box is not None:
        hulls = [cv2.convexHull(view.points(points)) for points in box_outlines(scene, estimate.box)]
        filled = np.zeros_like(panel)
        for hull in hulls:
            cv2.fillPoly(filled, [hull], BOX, cv2.LINE_AA, FRACTION_BITS)
        panel[:] = cv2.addWeighted(filled, BOX_LIGHT, panel, 1, 0)
        cv2.polylines(panel, hulls, True, BOX, 1, cv2.LINE_AA, FRACTION_BITS)
    if truth is not None:
        for u, v in view.points(project(scene, truth)).reshape(-1, 2).tolist():
            cv2.circle(panel, (u, v), END_RADIUS << FRACTION_BITS, TRUTH, 1, cv2.LINE_AA, FRACTION_BITS)
    for state, colour in ((truth, TRUTH), (estimate.state, STATE)):
        if state is not None:
            cv2.polylines(panel, list(view.points(project(scene, state))), False, colour, 1, cv2.LINE_AA, FRACTION_BITS)


def _text_strip(scene: Scene, estimate: Estimate, truth: ArrayLike | None, title: str, has_mask: bool, width: int) -> Picture:
    strip = np.full((5 * LINE_HEIGHT, width, 3), BACKGROUND, dtype=np.uint8)
    fallback = "estimate: box centre, as NN_e's state lies outside" if estimate.used_fallback else ""
    boundary = "box reaches the domain's face" if estimate.touches_boundary else ""
    _write(strip, 0, [(title, TEXT), _outcome(estimate), (_cells(scene, estimate), TEXT), (fallback, TEXT), (boundary, TEXT)])
    if estimate.box is not None:
        _write(strip, 1, [("certified box", BOX), *((text, TEXT) for text in _ranges(estimate.box))])
    for line, (name, state, colour) in enumerate((("estimate", estimate.state, STATE), ("truth", truth, TRUTH)), start=2):
        if state is not None:
            _write(strip, line, [(name, colour), *((text, TEXT) for text in _numbers(np.asarray(state)))])
    _write(strip, 4, [("lit", FRAME), ("filtered", FILTERED), (f"S of cell {estimate.cell}" if has_mask else "", MASK_TEXT)])
    return strip


def _outcome(estimate: Estimate) -> tuple[str, Colour]:
    return (estimate.outcome.value.upper(), CERTIFIED if estimate.certified else NO_RUNWAY)


def _cells(scene: Scene, estimate: Estimate) -> str:
    return f"cell {estimate.cell}, {len(estimate.passing)} of {scene.domain.cell_count} pass"


def _numbers(state: NDArray[np.float64]) -> list[str]:
    return [f"{name} {value:.4f} {unit}" for name, value, unit in zip(STATE_NAMES, state, STATE_UNITS, strict=True)]


def _ranges(box: Box) -> list[str]:
    rows = zip(STATE_NAMES, box.lower, box.upper, STATE_UNITS, strict=True)
    return [f"{name} {low:.4f} to {high:.4f} {unit}" for name, low, high, unit in rows]


def _write(strip: Picture, line: int, parts: Sequence[tuple[str, Colour]]) -> None:
    """Texts from left to right on one line of the strip, each in its colour; empty ones take no room."""
    left = 8
    for text, colour in parts:
        if text:
            cv2.putText(strip, text, (left, line * LINE_HEIGHT + 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
            left += cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0] + 18


def png(picture: Picture) -> bytes:
    """The picture as a PNG file."""
    return cv2.imencode(".png", picture)[1].tobytes()

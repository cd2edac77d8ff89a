"""Pictures of an estimate, BGR uint8 arrays as OpenCV takes them.

| colour | what |
|---|---|
| grey | lit pixels of the frame |
| blue | the spatial mask S of the named cell |
| green | filtered pixels: the frame within the masks of the passing cells |
| amber, translucent | the certified box, projected into the image |
| pale amber line | the box that is certified over time, where a tracker follows |
| magenta line | the markings of the estimated state |
| cyan line | where nothing is certified: the markings of the nearest state, of which nothing is certified |
| red pixels | dark ones of the true state's runway, or of the nearest state's where the truth is not known |
| white line and circles | the markings of the true state and their ends, where it is known |

Pictures illustrate; the certificate is the box's numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.attitude import Attitude
from runtime.estimate import Box, Estimate
from runtime.explanation import Explanation, dark_pixels
from runtime.image import runway_image
from runtime.scene import STATE_NAMES, STATE_UNITS, Scene
from runtime.sensor_image import DRAWN_POINTS, sensor_curves

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

BACKGROUND, TEXT, FRAME, FRAME_BORDER = (24, 22, 20), (225, 225, 225), (150, 150, 150), (90, 90, 90)
MASK, MASK_TEXT, FILTERED, BOX, STATE, TRUTH = (140, 60, 20), (230, 140, 70), (90, 215, 70), (0, 170, 255), (255, 60, 255), (255, 255, 255)
CERTIFIED, NO_RUNWAY, NEAREST, OVER_TIME = (90, 215, 70), (80, 80, 255), (255, 230, 90), (115, 200, 250)
PIXELS = np.array([BACKGROUND, MASK, FRAME, FILTERED, NO_RUNWAY], dtype=np.uint8)
"""Colours of pixels: dark, dark in S, lit, lit and filtered, dark in the runway."""
BOX_LIGHT = 0.16
"""Share of its colour that the box adds to what lies under it: blue stays blue, dark turns amber."""
SAMPLES = 5
"""States an axis at which a box is projected."""
BOX_POINTS = 9
"""Points of each marking's curve behind a lens, in one of these."""
FRACTION_BITS = 4
"""Lines are placed to a 16th of a picture's pixel."""
END_RADIUS = 4
"""A circle marks each end of a marking, px of the picture; the truth's shows around an estimate that covers its line."""
NARROWEST_PICTURE = 560
"""Width that the text needs, px; narrower frames are magnified."""
LINE_HEIGHT = 24
TEXT_LINES, LONGEST_TEXT = 5, 110
"""Lines below a picture, and characters of one that says why nothing is certified."""
ROOM = 1.25
"""Sides of the part of the frame that is shown close up, over those of the markings' image."""


@dataclass(frozen=True)
class View:
    """The part of the frame from (`top`, `left`), of `shape` (height, width) px, magnified `scale` times."""

    top: int
    left: int
    shape: tuple[int, int]
    scale: float

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of its picture."""
        return int(self.shape[0] * self.scale), int(self.shape[1] * self.scale)

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
    explanation: Explanation | None = None,
    title: str = "",
    zoom: int = 5,
    width: int | None = None,
    attitude: Attitude | None = None,
    over_time: Estimate | None = None,
) -> Picture:
    """The whole frame, beside it the runway at most `zoom` times larger, and below them the outcome in numbers with a legend.

    `frame`: (height, width), lit where not 0. `mask`: S of `estimate.cell`, bool (height, width). `truth`: a state (4,). `explanation`:
    of an estimate without a box. Returns (height', `width`, 3); by default twice the frame's width, magnified until the text fits.
    `attitude`: of a rolled and yawed camera, as whose middle everything is drawn; its dark pixels are not. `over_time`: what a tracker
    makes of the frame, whose box is outlined too, and has a line of its own; the estimate is its.
    """
    if over_time is not None and over_time.box is not None:
        estimate = replace(estimate, state=over_time.state, used_fallback=over_time.used_fallback)
    scale = -(-NARROWEST_PICTURE // frame.shape[1]) if width is None else width / 2 / frame.shape[1]
    whole = View(0, 0, frame.shape, scale)
    close = runway_view(scene, estimate, truth, zoom, scale * zoom, explanation, attitude)
    dark = _dark(scene, frame, truth, explanation) if attitude is None else None
    panels = [_magnified(_pixels(frame, estimate.filtered, mask, dark), view) for view in (whole, close)]
    _outline(panels[0], whole, close)
    if over_time is not None and over_time.box is not None:
        cv2.polylines(panels[1], _hulls(scene, close, over_time.box, attitude), True, OVER_TIME, 1, cv2.LINE_AA, FRACTION_BITS)
    _draw_states(panels[1], scene, close, estimate, truth, explanation, attitude)
    height, half = whole.size
    beside = _canvas(height, 2 * half)
    for panel, left in zip(panels, (0, half), strict=True):
        beside[: panel.shape[0], left : left + panel.shape[1]] = panel
    beside[:, half] = FRAME_BORDER
    shown = mask is not None, dark is not None
    return np.concatenate([beside, _text_strip(scene, estimate, truth, explanation, title, shown, beside.shape[1], over_time)])


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
    attitude: Attitude | None = None,
) -> Picture:
    """Only the runway's surroundings, as large as 1/`zoom` of the frame a side magnified `scale` times, with one line of text."""
    view = runway_view(scene, estimate, truth, zoom, scale, attitude=attitude)
    panel = _magnified(_pixels(frame, estimate.filtered, mask, None), view)
    _draw_states(panel, scene, view, estimate, truth, None, attitude)
    height, width = (max(side // zoom, 1) * scale for side in frame.shape)
    picture = _canvas(LINE_HEIGHT + height, width)
    picture[LINE_HEIGHT : LINE_HEIGHT + panel.shape[0], : panel.shape[1]] = panel
    _write(picture, 0, [(title, TEXT), _outcome(estimate), (_cells(scene, estimate), TEXT)])
    return picture


def png(picture: Picture) -> bytes:
    """The picture as a PNG file."""
    return cv2.imencode(".png", picture)[1].tobytes()


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


def runway_view(
    scene: Scene,
    estimate: Estimate,
    truth: ArrayLike | None,
    zoom: int,
    scale: float,
    explanation: Explanation | None = None,
    attitude: Attitude | None = None,
) -> View:
    """The part of the frame, within it, around all markings of estimate and truth; else of the nearest state, else of NN_e's.

    1/`zoom` of the frame a side, magnified `scale` times; where the markings need more room, a larger part that is magnified less.
    """
    nearest = None if explanation is None else explanation.nearest.state
    known = [np.asarray(state) for state in (estimate.state, truth) if state is not None]
    known = known or [estimate.network_state if nearest is None else nearest]
    frame = np.array(scene.camera.shape)
    low, high = _extent(scene, np.stack(known), attitude)
    part = next((part for part in range(zoom, 1, -1) if (frame // part >= ROOM * (high - low)).all()), 1)
    size = np.maximum(frame // part, 1)
    start = np.clip(np.round((low + high) / 2 - size / 2), 0, frame - size).astype(int)
    fitting = scale if part == zoom else scale * (np.maximum(frame // zoom, 1) / size).min()
    return View(int(start[0]), int(start[1]), (int(size[0]), int(size[1])), fitting)


def _extent(scene: Scene, states: NDArray[np.float64], attitude: Attitude | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """First and last (row, column) of the frame that the states' runways light; where they light none, the place nearest to them."""
    states = states[np.isfinite(states).all(axis=1)]
    lit = np.argwhere(runway_image(scene, states).any(axis=0)) if attitude is None else _points_in_view(scene, states, attitude)
    if len(lit) == 0:
        curves = sensor_curves(scene, states, attitude=attitude)
        centre = np.nan_to_num(curves).mean(axis=(0, 1, 2))[::-1] if len(states) else np.zeros(2)
        nearest = np.clip(centre, 0, scene.camera.shape)
        return nearest, nearest
    return lit.min(axis=0), lit.max(axis=0) + 1.0


def _points_in_view(scene: Scene, states: NDArray[np.float64], attitude: Attitude) -> NDArray[np.float64]:
    """(row, column) of points along the markings as a turned camera shows them, those in the frame: (n, 2)."""
    curves = sensor_curves(scene, states, attitude=attitude)
    if scene.camera.pinhole:  # the two ends of straight lines
        curves = curves[..., :1, :] + (curves[..., 1:, :] - curves[..., :1, :]) * np.linspace(0, 1, 2 * DRAWN_POINTS)[:, None]
    points = curves.reshape(-1, 2)[:, ::-1]
    return np.floor(points[((points >= 0) & (points < scene.camera.shape)).all(axis=1)])


def box_outlines(scene: Scene, box: Box, attitude: Attitude | None = None) -> NDArray[np.float64]:
    """Every marking's ends, or points of its curve, at `SAMPLES` states an axis of the box, corners included: (markings, points, 2) px.

    Every sampled marking lies in the convex hull of its row. Of a turned camera, what the attitude's middle shows.
    """
    sides = zip(box.lower, box.upper, strict=True)
    axes = [np.unique(np.linspace(low, high, SAMPLES)) for low, high in sides]
    states = np.array(list(itertools.product(*axes)))
    outlines = np.moveaxis(sensor_curves(scene, states, BOX_POINTS, attitude), 1, 0).reshape(len(scene.runway.markings), -1, 2)
    return outlines[:, np.isfinite(outlines).all(axis=(0, 2))]


def _seen(scene: Scene, state: ArrayLike, attitude: Attitude | None) -> NDArray[np.float64]:
    """The curves of the markings that the camera shows something of, (markings, points, 2) px."""
    curves = sensor_curves(scene, state, attitude=attitude)
    return curves[np.isfinite(curves).all(axis=(1, 2))]


def _ends(scene: Scene, state: ArrayLike, attitude: Attitude | None) -> NDArray[np.float64]:
    """Near and far end of each of those, (markings, 2, 2) px."""
    return _seen(scene, state, attitude)[:, [0, -1]]


def colour_pixels(frame: NDArray, filtered: NDArray, mask: NDArray[np.bool_] | None) -> Picture:
    """Background, S, frame and filtered pixels, each over the ones before: (height, width, 3)."""
    return _coloured(_pixels(frame, filtered, mask, None))


def _pixels(frame: NDArray, filtered: NDArray, mask: NDArray[np.bool_] | None, dark: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    """Each pixel's place in `PIXELS`, (height, width)."""
    places = np.zeros(frame.shape, dtype=np.uint8)
    for place, lit in enumerate((mask, frame, filtered, dark), start=1):
        if lit is not None:
            places[lit != 0] = place
    return places


def _dark(scene: Scene, frame: NDArray, truth: ArrayLike | None, explanation: Explanation | None) -> NDArray[np.bool_] | None:
    """The runway's dark pixels, (height, width): the true one's, or the nearest state's."""
    if truth is None and explanation is None:
        return None
    state = truth if explanation is None or truth is not None else explanation.nearest.state
    return np.any(dark_pixels(scene, frame, np.asarray(state)), axis=0)


def _coloured(places: NDArray[Any]) -> Picture:
    table = np.zeros((256, 1, 3), dtype=np.uint8)
    table[: len(PIXELS), 0] = PIXELS
    return np.asarray(cv2.applyColorMap(places, table), dtype=np.uint8)


def _canvas(height: int, width: int) -> Picture:
    """An empty picture."""
    row = np.full((width, 3), BACKGROUND, dtype=np.uint8)
    return np.broadcast_to(row, (height, width, 3)).copy()  # a row at a time, which is much faster than pixel by pixel


def _magnified(places: NDArray[np.uint8], view: View) -> Picture:
    """The view's part of the pixels; pixels stay squares where they are larger than the picture's, and are averaged where smaller."""
    part = np.ascontiguousarray(places[view.top : view.top + view.shape[0], view.left : view.left + view.shape[1]])
    if view.scale >= 1:
        return _coloured(cv2.resize(part, view.size[::-1], interpolation=cv2.INTER_NEAREST))
    return np.asarray(cv2.resize(_coloured(part), view.size[::-1], interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _outline(panel: Picture, whole: View, part: View) -> None:
    """Marks in `panel`, which shows `whole`, where `part` was taken from."""
    corners = [(part.left, part.top), (part.left + part.shape[1], part.top + part.shape[0])]
    (left, top), (right, bottom) = (whole.points(corners) >> FRACTION_BITS).tolist()
    cv2.rectangle(panel, (left, top), (right, bottom), FRAME_BORDER, 1)


def _draw_states(
    panel: Picture,
    scene: Scene,
    view: View,
    estimate: Estimate,
    truth: ArrayLike | None,
    explanation: Explanation | None,
    attitude: Attitude | None,
) -> None:
    """The box as a translucent band, then the markings of the nearest state, of the truth and of the estimate."""
    if estimate.box is not None:
        hulls = _hulls(scene, view, estimate.box, attitude)
        filled = np.zeros_like(panel)
        for hull in hulls:
            cv2.fillPoly(filled, [hull], BOX, cv2.LINE_AA, FRACTION_BITS)
        panel[:] = cv2.addWeighted(filled, BOX_LIGHT, panel, 1, 0)
        cv2.polylines(panel, hulls, True, BOX, 1, cv2.LINE_AA, FRACTION_BITS)
    if truth is not None:
        for u, v in view.points(_ends(scene, truth, attitude)).reshape(-1, 2).tolist():
            cv2.circle(panel, (u, v), END_RADIUS << FRACTION_BITS, TRUTH, 1, cv2.LINE_AA, FRACTION_BITS)
    nearest = None if explanation is None else explanation.nearest.state
    for state, colour in ((nearest, NEAREST), (truth, TRUTH), (estimate.state, STATE)):
        if state is not None:
            cv2.polylines(panel, list(view.points(_seen(scene, state, attitude))), False, colour, 1, cv2.LINE_AA, FRACTION_BITS)


def _hulls(scene: Scene, view: View, box: Box, attitude: Attitude | None) -> list[Any]:
    """The box as OpenCV's polygons, one for each marking that the camera shows something of."""
    return [cv2.convexHull(view.points(points)) for points in box_outlines(scene, box, attitude) if len(points)]


def _text_strip(
    scene: Scene,
    estimate: Estimate,
    truth: ArrayLike | None,
    explanation: Explanation | None,
    title: str,
    shown: tuple[bool, bool],
    width: int,
    over_time: Estimate | None,
) -> Picture:
    """Lines of text; `shown`: whether a mask and the runway's dark pixels are."""
    size = min(1.0, width / (2 * NARROWEST_PICTURE))
    strip = _canvas((TEXT_LINES + (over_time is not None)) * int(LINE_HEIGHT * size), width)
    fallback = "estimate: the box's centre" if estimate.used_fallback else ""
    boundary = "box reaches the domain's face" if estimate.touches_boundary else ""
    lines = [[(title, TEXT), _outcome(estimate), (_cells(scene, estimate), TEXT), (fallback, TEXT), (boundary, TEXT)], [], [], []]
    if estimate.box is not None:
        lines[1] = [("certified box", BOX), *((text, TEXT) for text in _ranges(estimate.box))]
    if explanation is not None:
        lines[1] = [(explanation.reason.value, NO_RUNWAY), (_shortened(explanation.count_text()), TEXT)]
        lines[2] = [("nearest, not certified", NEAREST), *((text, TEXT) for text in _numbers(explanation.nearest.state))]
    if estimate.state is not None:
        lines[2] = [("estimate", STATE), *((text, TEXT) for text in _numbers(estimate.state))]
    if over_time is not None:
        ranges = [] if over_time.box is None else _ranges(over_time.box)
        lines.insert(2, [("over time", OVER_TIME), _outcome(over_time), *((text, TEXT) for text in ranges)])
    if truth is not None:
        lines[-1] = [("truth", TRUTH), *((text, TEXT) for text in _numbers(np.asarray(truth)))]
    mask, dark = (text if shows else "" for text, shows in zip((f"S of cell {estimate.cell}", "runway, dark"), shown, strict=True))
    lines.append([("lit", FRAME), ("filtered", FILTERED), (mask, MASK_TEXT), (dark, NO_RUNWAY)])
    for line, parts in enumerate(lines):
        _write(strip, line, parts, size)
    return strip


def _shortened(text: str) -> str:
    return text if len(text) <= LONGEST_TEXT else f"{text[: LONGEST_TEXT - 3]}..."


def _outcome(estimate: Estimate) -> tuple[str, Colour]:
    return (estimate.outcome.value.upper(), CERTIFIED if estimate.certified else NO_RUNWAY)


def _cells(scene: Scene, estimate: Estimate) -> str:
    refuted = "" if estimate.certified or len(estimate.passing) == 0 else ", all refuted by the refinement"
    return f"cell {estimate.cell}, {len(estimate.passing)} of {scene.domain.cell_count} pass NN_F{refuted}"


def _numbers(state: NDArray[np.float64]) -> list[str]:
    return [f"{name} {value:.4f} {unit}" for name, value, unit in zip(STATE_NAMES, state, STATE_UNITS, strict=True)]


def _ranges(box: Box) -> list[str]:
    rows = zip(STATE_NAMES, box.lower, box.upper, STATE_UNITS, strict=True)
    return [f"{name} {low:.4f} to {high:.4f} {unit}" for name, low, high, unit in rows]


def _write(strip: Picture, line: int, parts: Sequence[tuple[str, Colour]], size: float = 1.0) -> None:
    """Texts from left to right on one line of the strip, each in its colour; empty ones take no room. `size`: 1 for pictures."""
    left, font = int(8 * size), 0.5 * size
    for text, colour in parts:
        if text:
            place = left, int((line * LINE_HEIGHT + 17) * size)
            cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, font, colour, 1, cv2.LINE_AA)
            left += cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, font, 1)[0][0] + int(18 * size)

"""The paper's section IV as one page: the 27 cells, 1320 frames, Tests 1 and 24 as in Fig. 5 and 6, and the standard Hough of Fig. 7.

    python scripts/reproduce_paper.py [--model models/paper.onnx] [--frames 1320] [--run DIR ...] [--out out/paper]

The frames are the runway's exact image on the descent of `fly_approach`, joined with noise and with the outlines of objects. Each
`--run` is a folder that `run-model --truth` wrote, of a simulated event camera for instance; they are set side by side. The paper's own
recordings are not public: its figures stand beside ours, taken on other frames and another machine.

Writes index.html, which needs no other file, and every picture as a PNG. Exit code 1 if a certificate is broken, 2 if something given
cannot be used.
"""

from __future__ import annotations

import base64
import html
import itertools
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from approach import approach_states
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from build_model.hough_bank import cell_bank
from build_model.partition import partition
from runtime import Estimate, Estimator, ModelError, Scene, terminal
from runtime.camera import project
from runtime.errors import fail
from runtime.image import runway_image
from runtime.recordings.draw import FILTERED, LINE_HEIGHT, STATE, Picture, colour_pixels, draw_runway, png
from runtime.recordings.history import History, Moment, draw_history
from runtime.whole_file import write_whole

PAPER_MINUTES_A_CELL, PAPER_SECONDS_A_FRAME, PAPER_ERRORS, PAPER_FRAMES = 20, 37, (0.0777, 0.045), 1320
TESTS = (1, 24)
"""The paper's numbers of the cells that its two tests fall into."""
NOISE_SHARE = 0.01
OBJECTS = 8
FRAME_US = 40_000
NEAR_PX = 3.0
"""A found line is the runway's if both of its ends lie within this of one marking; else it is false."""
HOUGH = {"rho": 1, "theta": np.pi / 180, "threshold": 20, "minLineLength": 15, "maxLineGap": 3}
"""Settings of OpenCV's HoughLinesP: a marking is about 35 pixels long."""
SUBDIVISIONS = 8
MOST_TRIES = 100
HISTORY_WIDTH = 640
"""Narrow, so that its texts can be read on a telephone."""
LINE_PX = 4
"""Lines on the picture of the standard Hough's, seen on a telephone too."""
CLOSE_UP = (160, 213)
"""Rows and columns around the runway that a filter's picture shows, magnified three times."""
UNSAFE = 1

Frame = NDArray[np.uint8]
Rng = np.random.Generator
Segments = NDArray[np.float64]


@dataclass(frozen=True)
class CellRow:
    """One cell of the partition: what its filters are made of."""

    number: int
    centre: NDArray[np.float64]
    pixels: int
    lines: NDArray[np.float64]
    """Per marking: smallest and largest rho (px), smallest and largest angle of the normal (degrees): (markings, 4)."""
    entries: int
    seconds: float


def hough_ranges(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> NDArray[np.float64]:
    """Enclosure of rho = u cos(phi) + v sin(phi) of every marking's line over the box [lower, upper], (4,) each: (markings, 4).

    The line is u = m v + c with m = a cos(theta) / y, c = u0 + a (F_v sin(theta) - v0 cos(theta)) / y, a = (p_x - x) F_u/F_v: hence
    tan(phi) = -m and rho = c cos(phi). m, c and cos(phi) are monotone in each variable where sin and cos are; the box is divided until
    the products of their ranges are tight. Returned: rho's ends (px), phi's ends (degrees).
    """
    axes = [np.linspace(low, high, SUBDIVISIONS + 1) for low, high in zip(lower, upper, strict=True)]
    corners = np.stack(np.meshgrid(axes[0], axes[1], axes[2], indexing="ij"))
    camera, ranges = scene.camera, []
    for x_m in scene.runway.x_m:
        theta, across, y = corners[0], (x_m - corners[1]) * (camera.focal_u_px / camera.focal_v_px), corners[2]
        slope = across * np.cos(theta) / y
        offset = camera.u0 + across * (camera.focal_v_px * np.sin(theta) - camera.v0 * np.cos(theta)) / y
        low_c, high_c = _over_boxes(offset)
        low_m, high_m = _over_boxes(slope)
        straight = np.where(low_m * high_m < 0, 0, np.minimum(np.abs(low_m), np.abs(high_m)))
        factors = 1 / np.hypot(1, straight), 1 / np.hypot(1, np.maximum(np.abs(low_m), np.abs(high_m)))
        rho = np.stack([c * factor for c in (low_c, high_c) for factor in factors])
        ranges.append([rho.min(), rho.max(), *np.degrees([np.arctan(-high_m.max()), np.arctan(-low_m.min())])])
    return np.array(ranges)


def _over_boxes(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Smallest and largest value at the 8 corners of each box of a grid."""
    windows = np.lib.stride_tricks.sliding_window_view(values, (2, 2, 2))
    return windows.min(axis=(-3, -2, -1)), windows.max(axis=(-3, -2, -1))


def cell_rows(scene: Scene, advance: Callable[[Iterable[int], int], Iterable[int]]) -> list[CellRow]:
    """Builds every cell's filters anew, one process, and takes the time. `advance` wraps the loop."""
    cells, rows = partition(scene), []
    for cell in advance(range(len(cells)), len(cells)):
        lower, upper = cells.lower[cell], cells.upper[cell]
        begun = time.perf_counter()
        bank = cell_bank(scene, lower, upper)
        seconds = time.perf_counter() - begun
        lines = hough_ranges(scene, lower, upper)
        rows.append(CellRow(cell + 1, (lower + upper) / 2, int(bank.spatial.sizes(1)[0]), lines, len(bank), seconds))
    return rows


def clutter(shape: tuple[int, int], rng: Rng) -> Frame:
    """I_n: random pixels, and the outlines of boxes, ellipses and straight edges all over the frame."""
    frame = (rng.random(shape) < NOISE_SHARE).astype(np.uint8)
    height, width = shape
    for number in range(OBJECTS):
        u, v = int(rng.integers(width)), int(rng.integers(height))
        across, down = rng.integers(10, 70, 2).tolist()
        if number % 3 == 0:
            corners = cv2.boxPoints(((u, v), (across, down), float(rng.uniform(0, 90)))).astype(np.int32)
            cv2.polylines(frame, [corners], True, 1, 1)
        elif number % 3 == 1:
            cv2.ellipse(frame, (u, v), (across // 2, down // 2), float(rng.uniform(0, 180)), 0, 360, 1, 1)
        else:
            end = int(u + rng.integers(-120, 120)), int(v + rng.integers(-120, 120))
            cv2.line(frame, (u, v), end, 1, 1)
    return frame


def hough_segments(frame: Frame) -> Segments:
    """What OpenCV's probabilistic Hough transform finds, (n, 2, 2) px: ends (u, v), at the pixels' centres."""
    found = cv2.HoughLinesP(frame * 255, **HOUGH)
    return np.empty((0, 2, 2)) if found is None else found.reshape(-1, 2, 2).astype(np.float64) + 0.5


def is_runway(segments: Segments, scene: Scene, truth: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which segments (n, 2, 2) have both ends within `NEAR_PX` of one marking of the true state."""
    near = [_distance(segments, marking).max(axis=-1) <= NEAR_PX for marking in project(scene, truth)]
    return np.logical_or.reduce(near)


def _distance(points: NDArray[np.float64], segment: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of points (..., 2) to a segment (2, 2), px."""
    start, along = segment[0], segment[1] - segment[0]
    share = np.clip((points - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(points - start - share[..., None] * along, axis=-1)


@dataclass
class Flight:
    """What the frames gave, frame by frame."""

    errors: list[float]
    milliseconds: list[float]
    inside: list[bool]
    half_widths: list[NDArray[np.float64]]
    false_lines: list[tuple[int, int]]
    """Standard Hough's and ours."""
    missing: list[tuple[int, int]]
    """Markings that no line matches, of the standard Hough's and of ours."""
    fallbacks: int
    history: History


def fly(estimator: Estimator, states: NDArray[np.float64], seed: int, frames: Iterable[int]) -> Flight:
    """Estimates every frame and compares its lines with the standard Hough's."""
    scene, flight = estimator.scene, Flight([], [], [], [], [], [], 0, History())
    for number in frames:
        truth = states[number]
        frame = runway_image(scene, truth) | clutter(scene.camera.shape, np.random.default_rng([seed, number]))
        begun = time.perf_counter()
        estimate = estimator.estimate(frame)
        flight.milliseconds.append(1000 * (time.perf_counter() - begun))
        flight.inside.append(estimate.box is not None and estimate.box.contains(truth))
        flight.errors.append(float("nan") if estimate.state is None else float(np.linalg.norm(estimate.state - truth)))
        flight.fallbacks += estimate.used_fallback
        box = estimate.box
        if box is not None:
            flight.half_widths.append(box.half_widths)
        ours = np.empty((0, 2, 2)) if estimate.state is None else project(scene, estimate.state)
        lines = hough_segments(frame), ours
        flight.false_lines.append((int((~is_runway(lines[0], scene, truth)).sum()), int((~is_runway(lines[1], scene, truth)).sum())))
        flight.missing.append((_missing(lines[0], scene, truth), _missing(lines[1], scene, truth)))
        start = number * FRAME_US
        flight.history.add(Moment(start, start + FRAME_US, estimate.state, box and box.lower, box and box.upper, truth))
    return flight


def _missing(segments: Segments, scene: Scene, truth: NDArray[np.float64]) -> int:
    """Markings of the true state that no segment is near to."""
    return sum(not (_distance(segments, marking).max(axis=-1) <= NEAR_PX).any() for marking in project(scene, truth))


@dataclass(frozen=True)
class Test:
    """One of the paper's two tests: a state of a given cell, its frame and its estimate."""

    number: int
    truth: NDArray[np.float64]
    frame: Frame
    estimate: Estimate


def find_test(estimator: Estimator, number: int, seed: int) -> Test:
    """The first of a seed's random states of the paper's cell `number` whose cell is named, as in the paper; else the last tried."""
    cells = partition(estimator.scene)
    rng = np.random.default_rng([seed, number])
    tests = (_random_test(estimator, number, cells.lower[number - 1], cells.upper[number - 1], rng) for _ in range(MOST_TRIES))
    last = first = next(tests)
    for last in itertools.chain([first], tests):
        if last.estimate.cell == number - 1:
            break
    return last


def _random_test(estimator: Estimator, number: int, lower: NDArray[np.float64], upper: NDArray[np.float64], rng: Rng) -> Test:
    truth = rng.uniform(lower, upper)
    frame = runway_image(estimator.scene, truth) | clutter(estimator.scene.camera.shape, rng)
    return Test(number, truth, frame, estimator.estimate(frame))


def shown_cells(test: Test, count: int) -> list[int]:
    """The named cell and three others: the one with the next number, and two spread over the rest, in order."""
    others = [(test.estimate.cell + step) % count for step in (1, count // 3, 2 * count // 3)]
    return sorted({test.estimate.cell, *others})


def filter_picture(scene: Scene, frame: Frame, mask: NDArray[np.bool_], truth: NDArray[np.float64]) -> Picture:
    """A cell's spatial filter on the frame, around the runway, magnified: S in blue, what it lets through in green."""
    centre = project(scene, truth).reshape(-1, 2).mean(axis=0)[::-1]
    start = np.clip(np.round(centre - np.array(CLOSE_UP) / 2), 0, np.array(scene.camera.shape) - CLOSE_UP).astype(int)
    pixels = colour_pixels(np.zeros_like(frame), frame * mask, mask)
    part = pixels[start[0] : start[0] + CLOSE_UP[0], start[1] : start[1] + CLOSE_UP[1]]
    return part.repeat(3, axis=0).repeat(3, axis=1)


def hough_picture(scene: Scene, test: Test) -> tuple[Picture, int, int]:
    """The frame with the standard Hough's lines, false ones dashed red, the runway's green, and ours magenta; both counts."""
    segments = hough_segments(test.frame)
    right = is_runway(segments, scene, test.truth)
    picture = colour_pixels(test.frame, np.zeros_like(test.frame), None).repeat(2, axis=0).repeat(2, axis=1)
    for segment, matches in zip(segments * 2, right, strict=True):
        if matches:
            cv2.line(picture, *_whole(segment), FILTERED, LINE_PX, cv2.LINE_AA)
        else:
            _dashed(picture, segment, (80, 80, 255))
    if test.estimate.state is not None:
        for marking in project(scene, test.estimate.state) * 2:
            cv2.line(picture, *_whole(marking), STATE, 1, cv2.LINE_AA)
    return picture, int((~right).sum()), int(right.sum())


def _whole(segment: NDArray[np.float64]) -> tuple[tuple[int, int], tuple[int, int]]:
    (a, b), (c, d) = np.round(segment).astype(int).tolist()
    return (a, b), (c, d)


def _dashed(picture: Picture, segment: NDArray[np.float64], colour: tuple[int, int, int]) -> None:
    dashes = max(3, int(np.linalg.norm(segment[1] - segment[0]) / (3 * LINE_PX)))
    for dash in range(0, dashes, 2):
        part = segment[0] + np.outer([dash / dashes, (dash + 1) / dashes], segment[1] - segment[0])
        cv2.line(picture, *_whole(part), colour, LINE_PX, cv2.LINE_AA)


# --- the page ---

STYLE = """
:root { color-scheme: light dark; --text: #1b1f24; --page: #ffffff; --quiet: #57606a; --line: #d0d7de; --stripe: #f6f8fa; --win: #1a7f37; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e6edf3; --page: #0d1117; --quiet: #9aa4af; --line: #30363d; --stripe: #161b22; --win: #3fb950; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 72rem; font: 16px/1.5 system-ui, sans-serif; color: var(--text); background: var(--page);
  overflow-wrap: break-word; }
h1 { font-size: 1.6rem; line-height: 1.25; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
p.note, figcaption { color: var(--quiet); font-size: .9rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .85rem; width: 100%; }
th, td { padding: .3rem .5rem; text-align: right; border-bottom: 1px solid var(--line); }
th:first-child, td:first-child { text-align: left; } tr:nth-child(even) td { background: var(--stripe); }
table.tight { font-size: .8rem; } table.tight th, table.tight td { white-space: nowrap; }
img { display: block; width: 100%; height: auto; border-radius: 4px; }
figure.narrow { max-width: 44rem; margin-inline: auto; }
figure { margin: 1rem 0; } figure > figcaption { margin-top: .4rem; }
.filters { display: grid; grid-template-columns: repeat(auto-fit, minmax(160px, 1fr)); gap: .7rem; }
.filters.wide { grid-template-columns: repeat(auto-fit, minmax(300px, 1fr)); margin-bottom: .7rem; }
.filters figure { margin: 0; border: 3px solid var(--line); border-radius: 6px; padding: .3rem; }
.filters figure.win { border-color: var(--win); }
"""


class Page:
    """Collects sections and pictures; a picture goes into the page itself and beside it as a PNG."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._parts: list[str] = []

    def heading(self, text: str) -> None:
        """A section's heading."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def text(self, text: str, kind: str = "") -> None:
        """A paragraph."""
        self._parts.append(f'<p class="{kind}">{html.escape(text)}</p>')

    def table(self, headings: Sequence[str], rows: Iterable[Sequence[object]], kind: str = "") -> None:
        """A table that scrolls by itself where the page is narrow; one of kind "tight" keeps every row on one line."""
        head = "".join(f"<th>{html.escape(heading)}</th>" for heading in headings)
        body = "".join("<tr>" + "".join(f"<td>{html.escape(str(value))}</td>" for value in row) + "</tr>" for row in rows)
        self._parts.append(
            f'<div class="scroll" tabindex="0"><table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )

    def figure(self, name: str, picture: Picture, caption: str, kind: str = "") -> None:
        """A picture as wide as the page, or one of kind "narrow"."""
        self._parts.append(self._figure(name, picture, caption, kind))

    def figures(self, figures: Iterable[tuple[str, Picture, str, bool]], kind: str = "") -> None:
        """Pictures beside each other; those marked True are framed in green."""
        inner = "".join(self._figure(name, picture, caption, "win" if won else "") for name, picture, caption, won in figures)
        self._parts.append(f'<div class="filters {kind}">{inner}</div>')

    def _figure(self, name: str, picture: Picture, caption: str, kind: str) -> str:
        content = png(picture)
        write_whole(self._folder / f"{name}.png", content)
        source = f"data:image/png;base64,{base64.b64encode(content).decode()}"
        text = html.escape(caption)
        return f'<figure class="{kind}"><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>'

    def write(self, title: str) -> None:
        """index.html."""
        head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>'
        body = f"<h1>{title}</h1>{''.join(self._parts)}"
        content = f'<!doctype html><html lang="en"><head>{head}<style>{STYLE}</style></head><body>{body}</body></html>'
        write_whole(self._folder / "index.html", content.encode())


def add_cells(page: Page, scene: Scene, rows: Sequence[CellRow]) -> None:
    """The table of the cells."""
    page.heading(f"{len(rows)} cells")
    total = sum(row.seconds for row in rows)
    page.text(
        f"All filters are built in {total:.1f} s, one process, {total / len(rows):.2f} s a cell; the paper: about "
        f"{PAPER_MINUTES_A_CELL} minutes a cell, 9 hours in all. ρ and φ (of the line's normal) are enclosed over the cell; S and entries "
        "are the model's."
    )
    names = [marking.name for marking in scene.runway.markings]
    headings = ["cell", "θ, y, z", "S, pixels", *(f"{kind} {name}" for name in names for kind in ("ρ px", "φ °")), "entries", "seconds"]
    page.table(headings, [_cell_texts(row) for row in rows], "tight")


def _cell_texts(row: CellRow) -> list[object]:
    theta, _, y, z = row.centre
    ranges = [f"{low:.2f} … {high:.2f}" for line in row.lines for low, high in (line[:2], line[2:])]
    return [row.number, f"{theta:.1f}, {y:.1f}, {z:.1f}", row.pixels, *ranges, row.entries, f"{row.seconds:.2f}"]


def add_frames(page: Page, scene: Scene, flight: Flight) -> None:
    """Outcomes, errors and times over all frames, beside the paper's."""
    count, errors = len(flight.inside), np.array(flight.errors)
    quantiles = [f"{value:.4f}" for value in np.nanquantile(errors, (0.5, 0.95, 1.0))]
    half = np.median(flight.half_widths, axis=0) if flight.half_widths else np.full(4, np.nan)
    page.heading(f"{count} frames")
    page.table(
        ["", "here", "paper"],
        [
            ("certified", int(np.isfinite(errors).sum()), "-"),
            ("certified, truth inside the box", sum(flight.inside), "-"),
            ("error, median", quantiles[0], f"{PAPER_ERRORS[0]} (Test 1), {PAPER_ERRORS[1]} (Test 24)"),
            ("error, 95 %", quantiles[1], "-"),
            ("error, largest", quantiles[2], "-"),
            (f"errors above {PAPER_ERRORS[0]} / {PAPER_ERRORS[1]}", " / ".join(str(int((errors > e).sum())) for e in PAPER_ERRORS), "-"),
            ("half-widths of the box, medians: θ rad, y m, z m", f"{half[0]:.4f}, {half[2]:.4f}, {half[3]:.4f}", "-"),
            ("NN_e's state outside the box, the centre taken", flight.fallbacks, "-"),
            ("time a frame, median", f"{np.median(flight.milliseconds):.1f} ms", f"about {PAPER_SECONDS_A_FRAME} s"),
        ],
    )
    page.text("Errors are 2-norms of (θ, x, y, z), rad and m together, as in the paper.", "note")
    caption = "State against time: certified band (amber), estimate (magenta), truth (white)."
    page.figure("state", draw_history(scene, flight.history, HISTORY_WIDTH), caption, "narrow")


def add_test(page: Page, estimator: Estimator, test: Test) -> None:
    """A test as in Fig. 5 and 6: the frame, four spatial filters' outputs, the winner framed in green."""
    scene, estimate = estimator.scene, test.estimate
    named = f"cell {estimate.cell + 1} is named, {len(estimate.passing)} cells pass"
    error = "" if estimate.state is None else f", error {np.linalg.norm(estimate.state - test.truth):.4f}"
    page.heading(f"Test {test.number}: a state of cell {test.number}")
    page.text(f"Truth θ {test.truth[0]:.4f} rad, y {test.truth[2]:.4f} m, z {test.truth[3]:.4f} m: {named}{error}.")
    whole = colour_pixels(test.frame, np.zeros_like(test.frame), None)
    shown = {"mask": estimator.spatial_mask(estimate.cell), "truth": test.truth, "scale": 5}
    close = draw_runway(scene, test.frame, estimate, **shown)[LINE_HEIGHT:]
    captions = (
        "The frame: runway, objects and noise.",
        "The runway close up: S blue, filtered pixels green, certified band amber, estimate magenta, truth white.",
    )
    names = f"test_{test.number}_frame", f"test_{test.number}_runway"
    page.figures(zip(names, (whole, close), captions, (False, False), strict=True), "wide")
    figures = []
    for cell in shown_cells(test, scene.domain.cell_count):
        mask = estimator.spatial_mask(cell)
        verdict = "passes" if cell in estimate.passing else "no entry passes"
        caption = (
            f"Cell {cell + 1}: {int((test.frame * mask).sum())} pixels let through, {verdict}{', named' if cell == estimate.cell else ''}"
        )
        shown = filter_picture(scene, test.frame, mask, test.truth)
        figures.append((f"test_{test.number}_cell_{cell + 1}", shown, caption, cell == estimate.cell))
    page.figures(figures)


def add_hough(page: Page, scene: Scene, test: Test, flight: Flight) -> None:
    """Fig. 7: Hough lines on the same frame, and the counts over all frames."""
    picture, false, right = hough_picture(scene, test)
    page.heading("Hough lines on the frame of Test 1")
    caption = f"OpenCV's HoughLinesP: {false} false lines (dashed red), {right} on the runway (green); our estimate's markings in magenta."
    page.figure("hough", picture, caption)
    lines, missing = np.array(flight.false_lines), np.array(flight.missing)
    rows = [
        ("false lines, all frames", *(f"{value:,}" for value in lines.sum(axis=0))),
        ("false lines a frame, median", *(f"{value:g}" for value in np.median(lines, axis=0))),
        ("frames with a false line", *(int(value) for value in (lines > 0).sum(axis=0))),
        (f"markings found by no line, of {2 * len(missing)}", *(int(value) for value in missing.sum(axis=0))),
    ]
    page.table(["", "HoughLinesP", "ours"], rows)
    settings = ", ".join(f"{name} {value:.4g}" for name, value in HOUGH.items())
    page.text(f"A line is false unless both of its ends lie within {NEAR_PX:g} px of one true marking. HoughLinesP: {settings}.", "note")


def add_runs(page: Page, runs: Sequence[dict[str, Any]]) -> None:
    """Recordings with a truth, side by side."""
    page.heading("An event camera, simulated")
    page.text(
        "Lines thicker than a pixel, pixels that fail to fire, vibration. Theorem A promises the truth inside where its assumptions hold."
    )
    names = [Path(run["model"]).stem for run in runs]
    page.table(["", *names], run_rows(runs))
    for name, run in zip(names, runs, strict=True):
        page.text(f"{name} assumes: {' '.join(run['assumptions'])}", "note")


def run_rows(runs: Sequence[dict[str, Any]]) -> list[list[object]]:
    """A row a figure of run-model's summaries, a column a run."""
    rows: list[list[object]] = [["windows", *(run["windows"] for run in runs)], ["certified", *(run["certified"] for run in runs)]]
    for kind, name in (("assumptions_hold", "assumptions hold"), ("assumptions_broken", "assumptions broken")):
        for key, text in (("windows", ""), ("inside", ", truth inside"), ("outside", ", truth outside"), ("no_runway", ", no runway")):
            rows.append([f"{name}{text}", *(run[kind][key] for run in runs)])
        for key, text in (("mean_error", "mean error"), ("largest_error", "largest error")):
            rows.append([f"{name}, {text}: θ rad, y m, z m", *(_by_axis(run[kind][key]) for run in runs)])
    rows.append(["half-widths of the box, means: θ rad, y m, z m", *(_by_axis(run["mean_half_widths"]) for run in runs)])
    if any("tracked" in run for run in runs):
        for key, text in (("mean_half_widths", "half-widths, means"), ("mean_error", "mean error"), ("largest_error", "largest error")):
            rows.append([f"over time, {text}: θ rad, y m, z m", *(_by_axis(run.get("tracked", {}).get(key)) for run in runs)])
    rows.append(["ms a window, mean", *(f"{run['milliseconds_a_window']['mean']:.1f}" for run in runs)])
    return rows


def _by_axis(values: dict[str, float] | None) -> str:
    """Theta, y and z of a summary's numbers; a dash where it has none."""
    return "-" if values is None else ", ".join(f"{values[name]:.4f}" for name in ("theta_rad", "y_m", "z_m"))


def reproduce(model: Path | None, frames: int, runs: Sequence[Path], out: Path, seed: int, console: Console) -> bool:
    """Writes the page; True if every certificate was kept. Raises `ModelError`, OSError, ValueError."""

    def progress(name: str) -> Callable[[Iterable[int], int], Iterable[int]]:
        return lambda items, count: track(items, name, total=count, console=console, transient=True)

    estimator = Estimator.load(model)
    scene, page = estimator.scene, Page(out)
    summaries = [json.loads((folder / "summary.json").read_text(encoding="utf-8")) for folder in runs]
    if lacking := [str(folder) for folder, summary in zip(runs, summaries, strict=True) if "assumptions_hold" not in summary]:
        raise ValueError(f"--run: {', '.join(lacking)}: no truth in summary.json; run-model must be given --truth")
    out.mkdir(parents=True, exist_ok=True)
    page.text(
        "Certified Vision-based State Estimation for Autonomous Landing Systems using Reachability Analysis, section IV, with the "
        f"corrections of docs/guarantee.md. Model sha256 {estimator.sha256[:16]}…, seed {seed}. Page written by scripts/reproduce_paper.py."
    )
    add_cells(page, scene, cell_rows(scene, progress("cells")))
    states = approach_states(scene, frames, np.random.default_rng(seed).uniform(0, 2 * np.pi))
    flight = fly(estimator, states, seed, progress("frames")(range(frames), frames))
    add_frames(page, scene, flight)
    tests = [find_test(estimator, number, seed) for number in TESTS]
    for test in tests:
        add_test(page, estimator, test)
    add_hough(page, scene, tests[0], flight)
    if summaries:
        add_runs(page, summaries)
    page.heading(f"Every certificate of the {len(flight.inside)} frames assumes")
    for line in estimator.metadata["assumptions"]:
        page.text(line)
    page.write("The paper's experiment, reproduced")
    broken = sum(not inside for inside in flight.inside)
    console.print(f"written: {out}/index.html; {frames} frames, {broken} without the truth in a certified box", markup=False)
    return broken == 0 and all(run["assumptions_hold"]["inside"] == run["assumptions_hold"]["windows"] for run in summaries)


def main(
    model: Annotated[Path | None, typer.Option(help="Model; by default the one of models/.")] = None,
    frames: Annotated[int, typer.Option(min=2, help="Frames of the approach.")] = PAPER_FRAMES,
    run: Annotated[list[Path] | None, typer.Option(help="Folder that run-model --truth wrote; may be given again.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the page and the pictures.")] = Path("out/paper"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of clutter and states.")] = 0,
) -> None:
    """Reproduce the paper's section IV as one page."""
    console = terminal.console(130)
    try:
        kept = reproduce(model, frames, run or [], out, seed, console)
    except (ModelError, ValueError, OSError) as error:
        fail(error)
    if not kept:
        raise typer.Exit(UNSAFE)


if __name__ == "__main__":
    terminal.run(main)

"""What a scene takes to build: boxes, entries, memory, seconds and the size of its file, told before anything is built.

Boxes are counted. The rest is estimated from a sample, a few cells and a few of their entries, made as the build makes them, and from
constants that were measured (below). So the estimate takes seconds and no more memory than the bound that it tells, whatever the scene: of
hundreds of markings, which make each cell dear, fewer cells and entries are sampled.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from build_model.calibration import check_calibration
from build_model.enclosure import MARKINGS_AT_ONCE, in_parts
from build_model.hough_bank import BATCH_BYTES, BYTES_A_ROW, CellBank, CellMasks, box_count, some_boxes
from build_model.paper.paper_bound import paper_bound
from build_model.partition import Partition, partition
from build_model.pixel_mask import runs_of
from build_model.run_table import mirrored
from build_model.spatial_filter import SLICES, spatial_window
from build_model.window import Window
from build_model.window_bank import CellWindows, cell_windows, group_boxes, group_count, halved_axes, sets_at_once, windowed_bank
from runtime.scene import STATE_NAMES, Bank, Scene, SceneError

MB = 1e6
MOST_CELLS = 10**6
"""More cells than this are refused without a look at them."""
COUNTED_CELLS = 1000
"""Cells whose boxes are counted and whose windows are looked at; of more, so many at equal distances."""
COUNTED_BINS = 40_000
"""Bins of theta and z in all of these, or those of one cell."""
SAMPLED_CELLS, SAMPLED_BOXES, SAMPLED_GROUPS = 8, 24, 200
"""Cells of which entries are made, and boxes of each, or groups in a bank of windows."""
LOOKED_COLUMNS, SPANNED_COLUMNS, WINDOWED_COLUMNS = 2**26, 2**25, 2**22
"""Columns of markings, a slice or a set each, that are bounded at most: for the window of all, S of sampled cells, and groups of one."""
GROUPS_BYTES = 2**26
"""What a cell's sampled groups may take."""
BYTES_A_SPAN, PAPER_BYTES = 72, 9e6
"""What a slice of a cell takes for each row of a marking while S is made, and what the paper's bound takes for each marking at once."""
PROCESS_BYTES, WORKER_BYTES = 3.0e8, 1.5e8
"""What the command holds with torch and onnxruntime loaded, and what each further process does."""
BYTES_A_RUN, BYTES_A_PLACE, BYTES_AN_ENTRY = 200, 72, 600
"""What the tables take in memory at most while they are laid out, for each vertical run of a mask, for each place of a window, and for each
entry beside these."""
SHARE_IN_WORKER = 0.5
"""What a worker holds and sends of the cell that it has built, over what that takes while the tables are laid out."""
FILE_BYTES_AN_ENTRY, FILE_BYTES_A_CELL, FILE_BYTES = 116, 250, 20_000
"""What an entry's boxes, places and size take in the file, what a cell's box and the paper's bound do, and what nodes and scene do."""
UNUSED_LOOK_UPS = 1.05
"""Look-ups a run has, two at best, over those that are used: masks of unlike numbers of runs share a block."""
LAYOUT_SECONDS_A_BYTE = 5e-9
FRAME_SECONDS, EPOCH_SECONDS = 6e-4, 1.3e-4
"""What a frame of the training takes to draw and filter, and in each epoch: measured on the paper's scene, in whose window that is."""
PAPERS_WINDOW_PX = 314 * 66
FRAMES_IN_MEMORY = 64 * 12
"""Whole frames, in bytes, that the training holds at once beside its own, 8 pixels to a byte."""
MARGIN = 1.3
"""The bound on memory over its estimate."""
FIXED_SHARE = 1.05
"""A build is told to take more memory, rather than a smaller scene, that has no more than this share of what its processes take alone."""
SHARE_OF_FREE = 0.8
"""Share of the machine's free memory that a build may take unless it is told."""


class BuildTooLargeError(SceneError):
    """A scene whose build would take more memory than it may. One line: the key, what was found, what to do."""


@dataclass(frozen=True)
class BuildSize:
    """What a scene takes to build. All but `cells` and `boxes` are estimates."""

    cells: int
    boxes: int
    entries: int
    memory_bytes: float
    """A bound, up to the sample's luck; the build stops where it is exceeded (`Ledger`)."""
    of_processes: float
    of_training: float
    """What of that is there whatever the scene, and where the training of NN_e takes most."""
    file_bytes: float
    seconds: dict[str, float]
    divisions: NDArray[np.float64]
    """Intervals that the domain's theta, x, scale and z are divided into, about, (4,)."""

    def rows(self) -> dict[str, str]:
        """For a table: names and values."""
        return {
            "cells": f"{self.cells}",
            "boxes": f"{self.boxes}",
            "entries, about": f"{self.entries}",
            "memory, at most about": f"{self.memory_bytes / MB:.0f} MB",
            "file, about": f"{self.file_bytes / MB:.2f} MB",
            **{f"{stage}, seconds, about": f"{seconds:.0f}" for stage, seconds in self.seconds.items()},
        }


@dataclass(frozen=True)
class _Sample:
    """What was made of a cell: a part of its boxes, and what the tables of these take."""

    boxes: int
    entries: int
    cell_bytes: float
    """In the file, of the cell itself."""
    box_bytes: float
    """In the file, of all the boxes that were made."""
    layout_bytes: float
    """In memory, of the same, while the tables are laid out."""
    batch_bytes: float
    """In memory, while masks are made."""
    cell_seconds: float
    box_seconds: float


def build_size(scene: Scene, jobs: int = 1, trained: bool = True, memory_mb: float = math.inf) -> BuildSize:
    """The estimate; `trained`: NN_e is trained too. The counts and bytes are the same every time, the seconds this machine's.

    Raises `SceneError` where the calibration or a sampled entry shows that the scene has no certificate, and `BuildTooLargeError` for too
    many cells, and where making windows at all takes more than `memory_mb`, so that none can be sampled.
    """
    if scene.domain.cell_count > MOST_CELLS:
        raise BuildTooLargeError(f"domain: found {scene.domain.cell_count} cells; give {MOST_CELLS} or fewer")
    cells = partition(scene)
    masks = isinstance(scene.bank, Bank)
    if not masks and memory_mb * MB < (least := MARGIN * (PROCESS_BYTES + _windows_bytes(scene))):
        raise BuildTooLargeError(_more_memory(memory_mb, least / MB))
    bins = scene.bank.pitch_bins * scene.bank.distance_bins if isinstance(scene.bank, Bank) else 1
    counted = np.unique(np.linspace(0, len(cells) - 1, max(1, min(COUNTED_CELLS, COUNTED_BINS // bins))).astype(int))
    count, parts = (box_count, 1) if masks else (group_count, 2 ** len(halved_axes(scene)))
    counts = parts * np.array([count(scene, cells.lower[cell], cells.upper[cell]) for cell in counted])
    looked = counted[_spread(len(counted), max(2, LOOKED_COLUMNS // _spanned(scene)))]
    window = reduce(Window.union, (spatial_window(scene, cells.lower[cell], cells.upper[cell]) for cell in looked))
    check_calibration(scene, window)
    sample_of, most = (_sample_of_masks, SAMPLED_CELLS) if masks else (_sample_of_windows, SPANNED_COLUMNS // _spanned(scene))
    drawn = _drawn(counted, counts, min(max(2, most), SAMPLED_CELLS))
    samples = [sample_of(scene, cells.lower[cell], cells.upper[cell], window) for cell in drawn]

    def per_box(name: str) -> float:
        return float(sum(getattr(sample, name) for sample in samples) / sum(sample.boxes for sample in samples))

    boxes = round(counts.mean() * len(cells))
    layout = per_box("layout_bytes") * boxes
    file_bytes = FILE_BYTES + 4 * math.prod(window.shape) * masks + per_box("box_bytes") * boxes
    file_bytes += (FILE_BYTES_A_CELL + float(np.mean([sample.cell_bytes for sample in samples]))) * len(cells)
    file_bytes += _network_bytes(window) if trained else 0.0
    largest_cell = per_box("layout_bytes") * float(counts.max()) * SHARE_IN_WORKER
    processes = jobs * (max(sample.batch_bytes for sample in samples) + WORKER_BYTES * (jobs > 1))
    training = _training_bytes(scene, window) if trained else 0.0
    bounds = jobs * PAPER_BYTES * min(len(scene.runway.markings), MARKINGS_AT_ONCE)
    stages = processes + jobs * largest_cell + SHARE_IN_WORKER * layout, layout, 6 * file_bytes + bounds, training
    return BuildSize(
        cells=len(cells),
        boxes=boxes,
        entries=math.ceil(boxes * per_box("entries")),
        memory_bytes=MARGIN * (PROCESS_BYTES + max(stages)),
        of_processes=MARGIN * (PROCESS_BYTES + processes),
        of_training=MARGIN * (PROCESS_BYTES + training),
        file_bytes=file_bytes,
        seconds=_seconds(scene, cells, samples, boxes, layout, window, jobs, trained),
        divisions=_divisions(scene, boxes),
    )


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """Places among `count` at equal distances, the first and the last among them: all, or `most`."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


def _spanned(scene: Scene) -> int:
    """Columns that S of a cell takes to bound."""
    return SLICES * len(scene.runway.markings) * scene.camera.height


def _windows_bytes(scene: Scene) -> float:
    """In memory, while windows and S of a cell are made."""
    markings, height = len(scene.runway.markings), scene.camera.height
    at_once = sets_at_once(scene) * BYTES_A_ROW * height * (1 + markings)
    return max(at_once, BYTES_A_SPAN * SLICES * height * min(markings, MARKINGS_AT_ONCE))


def _drawn(counted: NDArray[np.int64], counts: NDArray[np.int64], cells: int) -> NDArray[np.int64]:
    """So many cells, drawn by their numbers of boxes, so that a box of each kind is as likely as in the bank."""
    rng, ends = np.random.default_rng(0), np.cumsum(counts)
    places = (np.arange(cells) + rng.random(cells)) / cells * ends[-1]
    return counted[np.searchsorted(ends, places, "right").clip(0, len(counted) - 1)]


def _sample_of_masks(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], window: Window) -> _Sample:
    start = time.perf_counter()
    cell = CellMasks.of(scene, lower, upper)
    spatial_runs = len(runs_of(cell.spatial[None], cell.window).mask)
    between = time.perf_counter()
    boxes = box_count(scene, lower, upper)
    numbers = np.unique(np.random.default_rng(0).integers(boxes, size=SAMPLED_BOXES)) if boxes > SAMPLED_BOXES else np.arange(boxes)
    some = some_boxes(scene, lower, upper, numbers)
    entries = cell.strong_entries(some)
    end = time.perf_counter()
    folded = mirrored(entries.must_light, window) and mirrored(entries.may_light, window)
    look_ups, runs = 8 * UNUSED_LOOK_UPS / (2 if folded else 1), len(entries.must_light.mask) + len(entries.may_light.mask)
    return _Sample(
        boxes=len(some),
        entries=len(entries),
        cell_bytes=(look_ups + 24) * spatial_runs,
        box_bytes=look_ups * runs + FILE_BYTES_AN_ENTRY * len(entries),
        layout_bytes=BYTES_A_RUN * runs + BYTES_AN_ENTRY * len(entries),
        batch_bytes=max(BATCH_BYTES, cell.bytes_an_entry),
        cell_seconds=between - start,
        box_seconds=end - between,
    )


def _sample_of_windows(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], window: Window) -> _Sample:
    """Of the whole cell, or of some of its groups if it has many, or if each takes much."""
    markings, parts = len(scene.runway.markings), 2 ** len(halved_axes(scene))
    places = windowed_bank(scene).rows * markings
    most = min(WINDOWED_COLUMNS // (markings * scene.camera.height), GROUPS_BYTES // (BYTES_A_PLACE * places)) // (1 + parts)
    boxes = group_boxes(scene, lower, upper)
    boxes = boxes[np.sort(np.random.default_rng(0).permutation(len(boxes))[: max(1, min(SAMPLED_GROUPS, most))])]
    start = time.perf_counter()
    bank = cell_windows(scene, lower, upper, boxes=boxes)
    seconds = time.perf_counter() - start
    return _Sample(
        boxes=parts * len(boxes),
        entries=len(bank),
        cell_bytes=4.0 * markings * window.shape[0],
        box_bytes=bank.exists.size * (5 * places + FILE_BYTES_AN_ENTRY) + len(bank.exists) * 8 * places,
        layout_bytes=bank.exists.size * (BYTES_A_PLACE * places + BYTES_AN_ENTRY),
        batch_bytes=_windows_bytes(scene),
        cell_seconds=0.0,
        box_seconds=seconds,
    )


def _network_bytes(window: Window) -> float:
    """Of the weights of NN_e, float32: its first layer reads every column of the window, four rows at a time, the others little."""
    return 4 * (2 * 32 * 4 * window.shape[1] + 130_000)


def _training_bytes(scene: Scene, window: Window) -> float:
    pixels = math.prod(window.shape)
    return scene.estimator.training_frames * (pixels / 8 + 40) * 2 + FRAMES_IN_MEMORY * math.prod(scene.camera.shape)


def _seconds(
    scene: Scene, cells: Partition, samples: Sequence[_Sample], boxes: int, layout: float, window: Window, jobs: int, trained: bool
) -> dict[str, float]:
    """Of each stage, with so many processes on this machine."""
    at_once = min(jobs, os.cpu_count() or 1, len(cells))
    cell_seconds = float(np.mean([sample.cell_seconds for sample in samples]))
    box_seconds = sum(sample.box_seconds for sample in samples) / sum(sample.boxes for sample in samples)
    seconds = {"NN_F": (len(cells) * cell_seconds + boxes * box_seconds) / at_once + LAYOUT_SECONDS_A_BYTE * layout}
    if trained:
        training = scene.estimator
        an_epoch = EPOCH_SECONDS * math.prod(window.shape) / PAPERS_WINDOW_PX
        seconds["NN_e"] = training.training_frames * (FRAME_SECONDS + training.epochs * an_epoch)
    start, seconds["file"] = time.perf_counter(), 0.0
    if (cells.lower < cells.upper).any():
        some = next(in_parts(scene))
        paper_bound(some, cells.lower[len(cells) // 2], cells.upper[len(cells) // 2])
        cells_like_it = len(cells) * len(scene.runway.markings) / len(some.runway.markings)
        seconds["file"] = (time.perf_counter() - start) * cells_like_it / at_once
    return seconds


def _divisions(scene: Scene, boxes: int) -> NDArray[np.float64]:
    """Intervals of theta, x, scale and z that all the boxes together are about the product of."""
    theta, x, y, z = scene.domain.cell_counts
    lower, upper, bank = scene.domain.lower, scene.domain.upper, scene.bank
    middle = (lower + upper) / 2
    scale = scene.camera.focal_u_px / math.hypot(middle[2], middle[3] + scene.runway.ends_z_m.mean())
    pitch, lateral_px, distance = (bank.pitch_bins, bank.lateral_px, bank.distance_bins) if isinstance(bank, Bank) else (1, bank.set_px, 1)
    known = np.array([theta * pitch, max(x, (upper[1] - lower[1]) * scale / lateral_px), 1.0, z * distance])
    known[2] = max(boxes / known.prod(), y)
    return known


def check_size(scene: Scene, size: BuildSize, memory_mb: float) -> None:
    """Raises `BuildTooLargeError`, which names the number in the scene to change, where the bound on memory exceeds what there may be."""
    if size.memory_bytes > memory_mb * MB:
        raise BuildTooLargeError(_advice(scene, size.memory_bytes / MB, memory_mb, size))


def _more_memory(memory_mb: float, fixed_mb: float) -> str:
    return (
        f"--memory-mb: found {memory_mb:.0f}; give {math.ceil(FIXED_SHARE * fixed_mb)} or more, or fewer --jobs: processes alone take most"
    )


def _advice(scene: Scene, needed_mb: float, memory_mb: float, size: BuildSize) -> str:
    """What takes most: the processes, the training's frames, or the axis that is divided most finely."""
    takes = f"takes up to about {needed_mb:.0f} MB to build, more than the {memory_mb:.0f} MB of --memory-mb"
    fixed = size.of_processes / MB
    if memory_mb <= FIXED_SHARE * fixed:
        return _more_memory(memory_mb, fixed)
    share = (memory_mb - fixed) / (needed_mb - fixed)
    if size.of_training == size.memory_bytes:
        frames = scene.estimator.training_frames
        return (
            f"estimator.training_frames: found {frames}, which {takes}; give about {max(1, int(0.9 * share * frames))}, or --estimator none"
        )
    axis = int(size.divisions.argmax())
    span = scene.domain.upper[axis] - scene.domain.lower[axis]
    keys = ("theta_rad", "x_m", "y_m" if scene.domain.glide is None else "glide.angle_rad", "z_m")
    coarser = ("fewer bank.pitch_bins", "a larger bank.lateral_px", "a larger bank.column_px", "fewer bank.distance_bins")[axis]
    coarser = coarser if isinstance(scene.bank, Bank) else "a larger bank.set_px"
    unit = "rad" if axis == 0 else "m"
    return (
        f"domain.{keys[axis]}: {STATE_NAMES[axis]} spans {span:.4g} {unit} in about {size.divisions[axis]:.0f} of the bins that make "
        f"{size.entries} entries, and {takes}; narrow it to about {share * span:.2g} {unit}, or give {coarser}"
    )


class Ledger:
    """Keeps a build within its memory: counts what the cells that are built have taken, and stops it before the rest exceeds the bound."""

    def __init__(self, cells: int, memory_mb: float) -> None:
        self._cells, self._memory_mb, self._bytes = cells, memory_mb, PROCESS_BYTES
        self._built = self._entries = 0

    def add(self, bank: CellBank | CellWindows) -> None:
        """Another cell was built. Raises `BuildTooLargeError` where the tables of those so far no longer fit."""
        if isinstance(bank, CellBank):
            runs = sum(len(masks.mask) for masks in (bank.spatial, bank.must_light, bank.may_light))
            self._bytes += BYTES_A_RUN * runs + BYTES_AN_ENTRY * len(bank)
        else:
            self._bytes += bank.exists.size * (BYTES_A_PLACE * bank.windows.border.shape[1] + BYTES_AN_ENTRY)
        self._built, self._entries = self._built + 1, self._entries + len(bank)
        if self._bytes > self._memory_mb * MB:
            raise BuildTooLargeError(
                f"bank: {self._built} of {self._cells} cells alone have {self._entries} entries and take {self._bytes / MB:.0f} MB to lay "
                f"out, of the {self._memory_mb:.0f} MB of --memory-mb; narrow the domain, or give coarser bins in [bank]"
            )


def free_memory_mb() -> float:
    """The share of the machine's free memory that a build may take, MB: also of what a container leaves it."""
    free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
        free = 1024 * float(lines["MemAvailable"].split()[0])
        limit, used = (Path(f"/sys/fs/cgroup/memory.{name}").read_text(encoding="ascii").strip() for name in ("max", "current"))
        free = min(free, math.inf if limit == "max" else float(limit) - float(used))
    except (OSError, KeyError, ValueError):
        pass
    return SHARE_OF_FREE * max(free, 0.0) / MB

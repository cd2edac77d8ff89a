"""What a scene takes to build: boxes, entries, memory, seconds and the size of its file, told before anything is built.

Boxes are counted. The rest is estimated from a sample, a few cells and a few of their entries, made as the build makes them, and from
constants that were measured (below). So the estimate takes seconds, whatever the scene.
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
from build_model.hough_bank import BATCH_BYTES, BYTES_A_ROW, CellBank, CellMasks, box_count, some_boxes
from build_model.paper.paper_bound import paper_bound
from build_model.partition import Partition, partition
from build_model.pixel_mask import runs_of
from build_model.run_table import mirrored
from build_model.spatial_filter import spatial_window
from build_model.window import Window
from build_model.window_bank import CellWindows, cell_windows, group_count, halved_axes, sets_at_once
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
PROCESS_BYTES, WORKER_BYTES = 3.0e8, 1.5e8
"""What the command holds with torch and onnxruntime loaded, and what each further process does."""
BYTES_A_RUN, BYTES_AN_ENTRY = 200, 600
"""What the tables take in memory at most while they are laid out, for each vertical run of a mask and for each entry beside its runs."""
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


def build_size(scene: Scene, jobs: int = 1, trained: bool = True) -> BuildSize:
    """The estimate; `trained`: NN_e is trained too. The counts and bytes are the same every time, the seconds this machine's.

    Raises `SceneError` where the calibration or a sampled entry shows that the scene has no certificate, and `BuildTooLargeError` for too
    many cells.
    """
    if scene.domain.cell_count > MOST_CELLS:
        raise BuildTooLargeError(f"domain: found {scene.domain.cell_count} cells; give {MOST_CELLS} or fewer")
    cells = partition(scene)
    masks = isinstance(scene.bank, Bank)
    bins = scene.bank.pitch_bins * scene.bank.distance_bins if isinstance(scene.bank, Bank) else 1
    counted = np.unique(np.linspace(0, len(cells) - 1, max(1, min(COUNTED_CELLS, COUNTED_BINS // bins))).astype(int))
    count, parts = (box_count, 1) if masks else (group_count, 2 ** len(halved_axes(scene)))
    counts = parts * np.array([count(scene, cells.lower[cell], cells.upper[cell]) for cell in counted])
    window = reduce(Window.union, (spatial_window(scene, cells.lower[cell], cells.upper[cell]) for cell in counted))
    check_calibration(scene, window)
    sample_of = _sample_of_masks if masks else _sample_of_windows
    samples = [sample_of(scene, cells.lower[cell], cells.upper[cell], window) for cell in _drawn(counted, counts)]

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
    stages = processes + jobs * largest_cell + SHARE_IN_WORKER * layout, layout, 6 * file_bytes, training
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


def _drawn(counted: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells drawn by their numbers of boxes, so that a box of each kind is as likely as in the bank."""
    rng, ends = np.random.default_rng(0), np.cumsum(counts)
    places = (np.arange(SAMPLED_CELLS) + rng.random(SAMPLED_CELLS)) / SAMPLED_CELLS * ends[-1]
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
    """Of the whole cell, or of a part of its theta if it has many groups."""
    groups, part = group_count(scene, lower, upper), upper.copy()
    part[0] = lower[0] + (upper[0] - lower[0]) * min(1.0, SAMPLED_GROUPS / groups)
    start = time.perf_counter()
    bank = cell_windows(scene, lower, part)
    seconds, parts = time.perf_counter() - start, bank.exists.shape[1]
    places, markings = bank.windows.border.shape[1], len(scene.runway.markings)
    return _Sample(
        boxes=parts * group_count(scene, lower, part),
        entries=len(bank),
        cell_bytes=4.0 * markings * window.shape[0],
        box_bytes=bank.exists.size * (5 * places + FILE_BYTES_AN_ENTRY) + len(bank.exists) * 8 * places,
        layout_bytes=bank.exists.size * (72 * places + BYTES_AN_ENTRY),
        batch_bytes=sets_at_once(scene) * BYTES_A_ROW * scene.camera.height * (1 + markings),
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
    start = time.perf_counter()
    if (cells.lower < cells.upper).any():
        paper_bound(scene, cells.lower[len(cells) // 2], cells.upper[len(cells) // 2])
    seconds["file"] = (time.perf_counter() - start) * len(cells) / at_once
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


def _advice(scene: Scene, needed_mb: float, memory_mb: float, size: BuildSize) -> str:
    """What takes most: the processes, the training's frames, or the axis that is divided most finely."""
    takes = f"takes up to about {needed_mb:.0f} MB to build, more than the {memory_mb:.0f} MB of --memory-mb"
    fixed = size.of_processes / MB
    if memory_mb <= FIXED_SHARE * fixed:
        return (
            f"--memory-mb: found {memory_mb:.0f}; give {math.ceil(FIXED_SHARE * fixed)} or more, or fewer --jobs: processes alone take most"
        )
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
            self._bytes += bank.exists.size * (72 * bank.windows.border.shape[1] + BYTES_AN_ENTRY)
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

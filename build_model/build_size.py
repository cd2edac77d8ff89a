"""What a scene takes to build: boxes, entries, memory, seconds and the size of its file, told before anything is built.

Boxes are counted. The rest is estimated from a sample: a few cells, their spatial masks, and a few of their entries, made as the build makes
them; and from constants that were measured (below). So the estimate takes seconds, whatever the scene.
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

from build_model.assembly import row_width, rows_filled
from build_model.hough_bank import BATCH_BYTES, CellMasks, Entries, box_count, line_boxes
from build_model.paper.paper_bound import paper_bound
from build_model.partition import Partition, partition
from build_model.pixel_mask import runs_of
from build_model.run_table import mirrored
from build_model.spatial_filter import spatial_window
from build_model.window import Window
from runtime.scene import STATE_NAMES, Bank, Scene, SceneError

MB = 1e6
MOST_CELLS = 10**6
"""More cells than this are refused without a look at them."""
COUNTED_CELLS = 1000
"""Cells whose boxes are counted and whose windows are looked at; of more, so many at equal distances."""
SAMPLED_CELLS, SAMPLED_BOXES = 8, 24
"""Cells of which entries are made, and boxes of each."""
PROCESS_BYTES, WORKER_BYTES = 3.0e8, 1.5e8
"""What the command holds with torch and onnxruntime loaded, and what each further process does."""
BYTES_A_RUN, BYTES_AN_ENTRY = 200, 600
"""What the tables take in memory at most while they are laid out, for each vertical run of a mask and for each entry beside its runs."""
RUNS_IN_WORKER = 100
"""Bytes a run that a worker holds and sends of the cell that it has built."""
FILE_BYTES_AN_ENTRY, FILE_BYTES_A_CELL, FILE_BYTES = 116, 250, 20_000
"""What an entry's boxes, places and size take in the file, what a cell's box and the paper's bound do, and what nodes and scene do."""
UNUSED_LOOK_UPS = 1.05
"""Look-ups a run has, two at best, over those that are used: masks of unlike numbers of runs share a block."""
LAYOUT_SECONDS_A_RUN = 1e-6
FRAME_SECONDS, EPOCH_SECONDS = 6e-4, 1.3e-4
"""What a frame of the training takes to draw and filter, and in each epoch: measured on the paper's scene, in whose window that is."""
PAPERS_WINDOW_PX = 314 * 66
FRAMES_IN_MEMORY = 64 * 12
"""Whole frames, in bytes, that the training holds at once beside its own, 8 pixels to a byte."""
MARGIN = 1.3
"""The bound on memory over its estimate."""
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
    """Entries of a few boxes of a cell, made as the build makes them, and what that took."""

    boxes: int
    entries: Entries
    cell: CellMasks
    spatial_runs: int
    cell_seconds: float
    box_seconds: float

    @staticmethod
    def of(scene: Scene, lower: NDArray[np.float64], upper: NDArray[np.float64], rng: np.random.Generator) -> _Sample:
        start = time.perf_counter()
        cell = CellMasks.of(scene, lower, upper)
        spatial = runs_of(cell.spatial[None], cell.window)
        between = time.perf_counter()
        lines = line_boxes(scene, lower, upper)
        some = lines[np.sort(rng.permutation(len(lines))[:SAMPLED_BOXES])]
        entries = cell.strong_entries(some)
        return _Sample(len(some), entries, cell, len(spatial.mask), between - start, time.perf_counter() - between)

    @property
    def runs(self) -> int:
        """Runs of K and O of all the entries."""
        return len(self.entries.must_light.mask) + len(self.entries.may_light.mask)


def build_size(scene: Scene, jobs: int = 1, trained: bool = True) -> BuildSize:
    """The estimate; `trained`: NN_e is trained too. The counts and bytes are the same every time, the seconds this machine's.

    Raises `SceneError` where a sampled entry shows that the scene has no certificate, and `BuildTooLargeError` for too many cells.
    """
    if scene.domain.cell_count > MOST_CELLS:
        raise BuildTooLargeError(f"domain: found {scene.domain.cell_count} cells; give {MOST_CELLS} or fewer")
    cells = partition(scene)
    counted = np.unique(np.linspace(0, len(cells) - 1, COUNTED_CELLS).astype(int))
    counts = np.array([box_count(scene, cells.lower[cell], cells.upper[cell]) for cell in counted])
    boxes = round(counts.mean() * len(cells))
    window = reduce(Window.union, (spatial_window(scene, cells.lower[cell], cells.upper[cell]) for cell in counted))
    samples = _samples(scene, cells, counted, counts)
    folded = all(_mirrored(sample, window) for sample in samples)
    kept = sum(len(sample.entries) for sample in samples) / sum(sample.boxes for sample in samples)
    runs_an_entry = sum(sample.runs for sample in samples) / max(sum(len(sample.entries) for sample in samples), 1)
    spatial_runs = np.mean([sample.spatial_runs for sample in samples]) * len(cells)
    entries = math.ceil(boxes * kept)
    runs = entries * runs_an_entry + spatial_runs
    network, training = _network_bytes(window) if trained else 0.0, _training_bytes(scene, window) if trained else 0.0
    file_bytes = 8 * UNUSED_LOOK_UPS * runs / (2 if folded else 1) + 24 * spatial_runs + 4 * math.prod(window.shape) + network + FILE_BYTES
    file_bytes += FILE_BYTES_AN_ENTRY * _places(counts * kept, len(cells)) + FILE_BYTES_A_CELL * len(cells)
    largest_cell = float(counts.max()) * kept * runs_an_entry * RUNS_IN_WORKER
    workers = jobs * (max(BATCH_BYTES, max(sample.cell.bytes_an_entry for sample in samples)) + largest_cell + WORKER_BYTES * (jobs > 1))
    memory = PROCESS_BYTES + max(workers + 40 * runs, BYTES_A_RUN * runs + BYTES_AN_ENTRY * entries, 6 * file_bytes, training)
    return BuildSize(
        cells=len(cells),
        boxes=boxes,
        entries=entries,
        memory_bytes=MARGIN * memory,
        file_bytes=file_bytes,
        seconds=_seconds(scene, cells, samples, boxes, runs, window, jobs, trained),
        divisions=_divisions(scene, boxes),
    )


def _samples(scene: Scene, cells: Partition, counted: NDArray[np.int64], counts: NDArray[np.int64]) -> list[_Sample]:
    """Of cells drawn by their numbers of boxes, so that a box of each kind is as likely as in the bank."""
    rng, ends = np.random.default_rng(0), np.cumsum(counts)
    places = (np.arange(SAMPLED_CELLS) + rng.random(SAMPLED_CELLS)) / SAMPLED_CELLS * ends[-1]
    chosen = counted[np.searchsorted(ends, places, "right").clip(0, len(counted) - 1)]
    return [_Sample.of(scene, cells.lower[cell], cells.upper[cell], rng) for cell in chosen]


def _mirrored(sample: _Sample, window: Window) -> bool:
    return mirrored(sample.entries.must_light, window) and mirrored(sample.entries.may_light, window)


def _places(entries: NDArray[np.float64], cells: int) -> float:
    """Places in the bank's rows, padding included, for all cells if some have about these numbers of entries."""
    whole = np.maximum(np.ceil(entries), 1).astype(int).tolist()
    width = row_width(whole) if max(whole) <= MOST_CELLS // 100 else max(whole)
    return float(rows_filled(whole, width).sum() * width) * cells / len(whole)


def _network_bytes(window: Window) -> float:
    """Of the weights of NN_e, float32: its first layer reads every column of the window, four rows at a time, the others little."""
    return 4 * (2 * 32 * 4 * window.shape[1] + 130_000)


def _training_bytes(scene: Scene, window: Window) -> float:
    pixels = math.prod(window.shape)
    return scene.estimator.training_frames * (pixels / 8 + 40) * 2 + FRAMES_IN_MEMORY * math.prod(scene.camera.shape)


def _seconds(
    scene: Scene, cells: Partition, samples: Sequence[_Sample], boxes: int, runs: float, window: Window, jobs: int, trained: bool
) -> dict[str, float]:
    """Of each stage, with so many processes on this machine."""
    at_once = min(jobs, os.cpu_count() or 1, len(cells))
    cell_seconds = np.mean([sample.cell_seconds for sample in samples])
    box_seconds = sum(sample.box_seconds for sample in samples) / sum(sample.boxes for sample in samples)
    seconds = {"NN_F": (len(cells) * cell_seconds + boxes * box_seconds) / at_once + LAYOUT_SECONDS_A_RUN * runs}
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
    assert isinstance(scene.bank, Bank)
    theta, x, y, z = scene.domain.cell_counts
    lower, upper = scene.domain.lower, scene.domain.upper
    middle = (lower + upper) / 2
    scale = scene.camera.focal_u_px / math.hypot(middle[2], middle[3] + scene.runway.ends_z_m.mean())
    lateral = max(x, (upper[1] - lower[1]) * scale / scene.bank.lateral_px)
    known = np.array([theta * scene.bank.pitch_bins, lateral, 1.0, z * scene.bank.distance_bins])
    known[2] = max(boxes / known.prod(), y)
    return known


def check_size(scene: Scene, size: BuildSize, memory_mb: float) -> None:
    """Raises `BuildTooLargeError`, which names the number in the scene to change, where the bound on memory exceeds what there may be."""
    if size.memory_bytes > memory_mb * MB:
        raise BuildTooLargeError(_advice(scene, size.memory_bytes / MB, memory_mb, size))


def _advice(scene: Scene, needed_mb: float, memory_mb: float, size: BuildSize) -> str:
    """What takes most: the training's frames, or the axis that is divided most finely."""
    takes = f"takes up to about {needed_mb:.0f} MB to build, more than the {memory_mb:.0f} MB of --memory-mb"
    fixed = PROCESS_BYTES * MARGIN / MB
    if memory_mb <= 1.5 * fixed:
        return f"--memory-mb: found {memory_mb:.0f}; give {math.ceil(1.5 * fixed)} or more, as torch and onnxruntime alone take that"
    share = (memory_mb - fixed) / (needed_mb - fixed)
    axis = int(size.divisions.argmax())
    span = scene.domain.upper[axis] - scene.domain.lower[axis]
    keys = ("theta_rad", "x_m", "y_m" if scene.domain.glide is None else "glide.angle_rad", "z_m")
    cuts = ("bank.pitch_bins", "bank.lateral_px", "bank.column_px", "bank.distance_bins")
    finer = "fewer" if axis in (0, 3) else "a larger"
    unit = "rad" if axis == 0 else "m"
    return (
        f"domain.{keys[axis]}: {STATE_NAMES[axis]} spans {span:.4g} {unit} in about {size.divisions[axis]:.0f} bins, of {size.entries} entries, "
        f"and {takes}; narrow it to about {share * span:.2g} {unit}, or give {finer} {cuts[axis]}"
    )


class Ledger:
    """Keeps a build within its memory: counts what the cells that are built have taken, and stops it before the rest exceeds the bound."""

    def __init__(self, scene: Scene, cells: int, memory_mb: float) -> None:
        self._scene, self._cells, self._memory_mb = scene, cells, memory_mb
        self._built = self._runs = self._entries = 0

    def add(self, entries: int, runs: int) -> None:
        """Another cell was built. Raises `BuildTooLargeError` where the tables of those so far no longer fit."""
        self._built, self._runs, self._entries = self._built + 1, self._runs + runs, self._entries + entries
        taken = PROCESS_BYTES + BYTES_A_RUN * self._runs + BYTES_AN_ENTRY * self._entries
        if taken > self._memory_mb * MB:
            raise BuildTooLargeError(
                f"bank: {self._built} of {self._cells} cells alone have {self._entries} entries and take {taken / MB:.0f} MB to lay out, "
                f"of the {self._memory_mb:.0f} MB of --memory-mb; narrow the domain, or give coarser bins in [bank]"
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

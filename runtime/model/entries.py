"""The bank of a loaded model, as the runtime needs it: every entry as a set of states, and every cell's spatial mask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.model.format import SIDES, STATE_BOX_TENSORS, ModelError
from runtime.scene import STATE_NAMES, Scene
from runtime.state_set import StateSet, tangent_of_row


@dataclass(frozen=True)
class Entries:
    """Every bank entry of the model as a set of states, padding included, which never passes; and the cells' spatial masks."""

    all: StateSet
    row_cell: NDArray[np.int32]
    """The cell of each row of entries, (rows,)."""
    run_cell: NDArray[np.int32]
    run_index: NDArray[np.int32]
    run_step: NDArray[np.int32]
    """Ends of the runs of S: their cell, flat index in the window, and 1 at a start or -1 below a stop, (ends,) each."""
    window: tuple[slice, slice]

    @staticmethod
    def of(scene: Scene, tensors: dict[str, NDArray[Any]], name: str) -> Entries:
        """The entries from the model's initialisers; an axis of width 0 is exact. Raises `ModelError` if they do not fit the scene."""
        _check(scene, tensors, name)
        boxes = (np.stack([tensors[f"{axis}_{side}"].ravel() for side in SIDES], axis=-1) for axis in STATE_NAMES)
        states = np.stack(list(boxes)).astype(np.float64)
        scale = np.stack([tensors["line_lower"][..., 2], tensors["line_upper"][..., 2]], axis=-1).reshape(-1, 2)
        for axis, (low, high) in enumerate(zip(scene.domain.lower, scene.domain.upper, strict=True)):
            states[axis] = np.clip(states[axis], low, high)
        theta, x, y, z = states
        sets = StateSet(theta, x, y, z, scale, tangent_of_row(scene.camera, tensors["reference_row"].ravel()))
        window = tuple(slice(int(first), int(stop)) for first, stop in zip(tensors["window_first"], tensors["window_stop"], strict=True))
        cell, index, step = (tensors[f"spatial_run_{part}"].copy() for part in ("cell", "index", "step"))  # not to keep the file
        return Entries(sets, tensors["row_cell"].copy(), cell, index, step, (window[0], window[1]))

    def sets(self, passes: NDArray[np.bool_]) -> StateSet:
        """The entries that pass; `passes` is (rows, width), a cell's entries in one row or several."""
        return self.all[np.flatnonzero(passes)]

    def window_and_beyond(self, margin_px: int) -> tuple[slice, slice]:
        """The masks' window with a margin; a slice need not stop at the frame's border."""
        rows, columns = (slice(max(side.start - margin_px, 0), side.stop + margin_px) for side in self.window)
        return rows, columns

    def within(self, cell: int, frame: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The frame within the cell's spatial mask S."""
        seen = np.zeros_like(frame)
        crop = frame[self.window]
        steps = np.zeros(crop.shape, dtype=np.int32)
        own = self.run_cell == cell
        steps.ravel()[self.run_index[own]] = self.run_step[own]  # a run's stop lies below it, and so never on another one's start
        mask = steps.cumsum(axis=0) > 0
        seen[self.window] = crop & mask
        return seen


def _check(scene: Scene, tensors: dict[str, NDArray[Any]], name: str) -> None:
    """Types, shapes and ranges of the initialisers that the runtime reads. Raises `ModelError`."""
    cells, rows, ends = scene.domain.cell_count, tensors["row_cell"].shape[:1], tensors["spatial_run_index"].shape[:1]
    entries = (*rows, *tensors["must_light_size"].shape[1:2])
    layout = {"row_cell": (np.int32, rows), "must_light_size": (np.int32, entries), "reference_row": (np.float64, entries)}
    layout |= dict.fromkeys(STATE_BOX_TENSORS, (np.float32, entries))
    layout |= {f"line_{side}": (np.float64, (*entries, 4)) for side in SIDES}
    layout |= {f"window_{side}": (np.int64, (2,)) for side in ("first", "stop")}
    layout |= {f"spatial_run_{part}": (np.int32, ends) for part in ("cell", "index", "step")}
    for label, (dtype, shape) in layout.items():
        found = tensors[label]
        if found.dtype != dtype or found.shape != shape or found.size == 0:
            expected = f"{np.dtype(dtype)} {list(shape)}"
            raise ModelError(f"{name}: {label} is {found.dtype} {list(found.shape)}, its scene asks for {expected}; export it again")
        if not np.isfinite(found).all():
            raise ModelError(f"{name}: {label} holds values that are not finite; export it again with export-model")
    if rows[0] < cells or not np.array_equal(np.unique(tensors["row_cell"]), np.arange(cells)):
        raise ModelError(f"{name}: row_cell does not give rows to every one of {cells} cells; export it again with export-model")
    first, stop = tensors["window_first"], tensors["window_stop"]
    inside = bool(((first >= 0) & (first < stop) & (stop <= scene.camera.shape)).all())
    limits = {"cell": (0, cells - 1), "index": (0, int(np.prod(stop - first)) - 1 if inside else -1), "step": (-1, 1)}
    for part, (low, high) in limits.items():
        inside &= bool(((tensors[f"spatial_run_{part}"] >= low) & (tensors[f"spatial_run_{part}"] <= high)).all())
    if not inside:
        raise ModelError(f"{name}: its window or its spatial masks lie outside the frame; export it again with export-model")

"""The bank of a loaded model, as the runtime needs it: every entry as a set of states, and every cell's spatial mask.

What the loader guarantees, whoever wrote the file, of every set that `Entries.sets` gives; H is the frame's height, v_h(theta) =
v0 - F_v tan(theta) the horizon, (theta, x, y, z) a state of the set's box, all numbers float64:

1. All bounds are finite, and each lower one is at most its upper one. theta, x, y and z lie in the domain's hull, and an axis of width 0 is
   its value; so what `runtime.scene` demands of all states of the hull holds of every state of the box: y and the distances of all ends are
   above 0, all ends lie in front of the camera, and the margins of `runtime.rounding` exceed float64's error on rows and columns in view.
2. The reference row is in the frame or a pixel below it, 0 <= v_ref <= H + 1, and `BELOW_HORIZON_PX` or more below the horizon: v_ref -
   v_h(theta) >= 0.5. So s(theta, t_ref) > 0, and R = s(theta, t) / s(theta, t_ref) = (v - v_h) / (v_ref - v_h), at a row v below the
   horizon, lies between 0 and 1 + 2 |v - v_ref|.
3. The scale lies in the range of F_u s(theta, t_ref) / y over the box, up to the share `OUTWARD_RELATIVE` of it: above 0, and no smaller or
   larger than the box allows.

Padding, and entries whose box of states and scale contradict each other by more than float64's error, are in no such set: they have no
state. That the sets hold all states which the graph's `passes` stands for is the model's claim, and `verify-model` proves it. Of the
numbers in the file it also proves statement 2, that boxes are ordered and lie in the domain up to float32's rounding, and that scales are
above 0 and exceed the range of statement 3 by no more than a step of their bins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.model.format import PADDING_SIZE, SIDES, STATE_BOX_TENSORS, ModelError
from runtime.model.limits import BELOW_HORIZON_PX, ROWS_BELOW_FRAME, largest_steps
from runtime.model.spatial_masks import SpatialRuns, SpatialSpans
from runtime.rounding import OUTWARD_RELATIVE, float32_above, float32_below
from runtime.scene import STATE_NAMES, Scene, WindowedBank
from runtime.state_set import StateSet, tangent_of_row


@dataclass(frozen=True)
class Entries:
    """The bank's entries as sets of states, and the cells' spatial masks."""

    all: StateSet
    number: NDArray[np.int64]
    """The number in `all` of the entry at each place of the bank, (rows * width,); -1 where it has no state."""
    row_cell: NDArray[np.int32]
    """The cell of each row of entries, (rows,)."""
    spatial: SpatialRuns | SpatialSpans
    window: tuple[slice, slice]

    @staticmethod
    def of(scene: Scene, tensors: dict[str, NDArray[Any]], name: str) -> Entries:
        """The entries from the model's initialisers; an axis of width 0 is exact. Raises `ModelError` if they do not fit the scene."""
        _check(scene, tensors, name)
        size = tensors["must_light_size"].ravel()
        places = np.flatnonzero(size != PADDING_SIZE)
        sets = _state_sets(scene, tensors, places, name)
        with_states = sets.scale[:, 0] <= sets.scale[:, 1]
        number = np.full(len(size), -1)
        number[places[with_states]] = np.arange(with_states.sum())
        window = tuple(slice(int(first), int(stop)) for first, stop in zip(tensors["window_first"], tensors["window_stop"], strict=True))
        return Entries(sets[with_states], number, tensors["row_cell"].copy(), _spatial(scene, tensors, name), (window[0], window[1]))

    def sets(self, passes: NDArray[np.bool_]) -> StateSet:
        """The entries that pass and have states; `passes` is (rows, width), a cell's entries in one row or several."""
        numbers = self.number[np.flatnonzero(passes)]
        return self.all[numbers[numbers >= 0]]

    def window_and_beyond(self, margin_px: int) -> tuple[slice, slice]:
        """The masks' window with a margin; a slice need not stop at the frame's border."""
        rows, columns = (slice(max(side.start - margin_px, 0), side.stop + margin_px) for side in self.window)
        return rows, columns

    def within(self, cell: int, frame: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The frame within the cell's spatial mask S."""
        seen, crop = np.zeros_like(frame), frame[self.window]
        seen[self.window] = crop & self.spatial.bits(cell, crop.shape)
        return seen


def _check(scene: Scene, tensors: dict[str, NDArray[Any]], name: str) -> None:
    """Types, shapes and ranges of the initialisers that the runtime reads. Raises `ModelError`."""
    cells, rows = scene.domain.cell_count, tensors["row_cell"].shape[:1]
    entries = (*rows, *tensors["must_light_size"].shape[1:2])
    layout = {"row_cell": (np.int32, rows), "must_light_size": (np.int32, entries), "reference_row": (np.float64, entries)}
    layout |= dict.fromkeys(STATE_BOX_TENSORS, (np.float32, entries))
    layout |= {f"line_{side}": (np.float64, (*entries, 4)) for side in SIDES}
    layout |= {f"window_{side}": (np.int64, (2,)) for side in ("first", "stop")}
    layout |= _layout_of_masks(scene, tensors, rows)
    if missing := sorted(set(layout) - set(tensors)):
        raise ModelError(f"{name}: it lacks the initialisers {missing}, which its scene asks for; export it again with export-model")
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
    if not ((first >= 0) & (first < stop) & (stop <= scene.camera.shape)).all():
        raise ModelError(f"{name}: its window or its spatial masks lie outside the frame; export it again with export-model")


def _layout_of_masks(scene: Scene, tensors: dict[str, NDArray[Any]], rows: tuple[int, ...]) -> dict[str, tuple[type, tuple[int, ...]]]:
    """Type and shape that the initialisers of the cells' masks must have."""
    if isinstance(scene.bank, WindowedBank):
        height = int(tensors["window_stop"].ravel()[:1].sum() - tensors["window_first"].ravel()[:1].sum())
        spans = (scene.domain.cell_count, len(scene.runway.markings), height)
        return {"span_first": (np.int16, spans), "span_stop": (np.int16, spans), "gate_size": (np.int32, (*rows, 1))}
    ends = tensors["spatial_run_index"].shape[:1] if "spatial_run_index" in tensors else (1,)
    return {f"spatial_run_{part}": (np.int32, ends) for part in ("cell", "index", "step")}


def _spatial(scene: Scene, tensors: dict[str, NDArray[Any]], name: str) -> SpatialRuns | SpatialSpans:
    """The cells' masks. Raises `ModelError` if they lie outside the window."""
    height, width = (tensors["window_stop"] - tensors["window_first"]).tolist()
    if isinstance(scene.bank, WindowedBank):
        return SpatialSpans.of(tensors, (height, width), name)
    return SpatialRuns.of(scene, tensors, (height, width), name)


def _state_sets(scene: Scene, tensors: dict[str, NDArray[Any]], places: NDArray[np.int64], name: str) -> StateSet:
    """The entries at these places, their boxes within the domain, their scales within what the boxes allow. Raises `ModelError`."""
    boxes = (np.stack([tensors[f"{axis}_{side}"].ravel()[places] for side in SIDES], axis=-1) for axis in STATE_NAMES)
    states = np.stack(list(boxes))
    _check_states(scene, states, name)
    lower, upper = (side[:, None, None] for side in (scene.domain.lower, scene.domain.upper))
    theta, x, y, z = np.clip(states.astype(np.float64), lower, upper)
    row = tensors["reference_row"].ravel()[places]
    _check_reference_rows(scene, row, theta, name)
    scale = np.stack([tensors[f"line_{side}"].reshape(-1, 4)[places, 2] for side in SIDES], axis=-1)
    sets = StateSet(theta, x, y, z, scale, tangent_of_row(scene.camera, row))
    return replace(sets, scale=_contracted_scales(scene, sets, name))


def _check_states(scene: Scene, states: NDArray[np.float32], name: str) -> None:
    """Boxes of states, (4, entries, 2), are ordered and within the domain, but for float32's rounding. Raises `ModelError`."""
    lower, upper = float32_below(scene.domain.lower), float32_above(scene.domain.upper)
    for axis, low, high, box in zip(STATE_NAMES, lower, upper, states, strict=True):
        wrong = (box[:, 0] > box[:, 1]) | (box[:, 0] < low) | (box[:, 1] > high)
        if wrong.any():
            found = "{} to {}".format(*box[wrong][0])
            raise ModelError(
                f"{name}: an entry's {axis} is from {found}, its scene's domain from {low} to {high}; export it again with export-model"
            )


def _check_reference_rows(scene: Scene, rows: NDArray[np.float64], theta: NDArray[np.float64], name: str) -> None:
    """Reference rows are near the frame, and below the horizon of the smallest of `theta`, (entries, 2). Raises `ModelError`."""
    camera, lowest = scene.camera, scene.camera.height + ROWS_BELOW_FRAME
    horizon = camera.v0 - camera.focal_v_px * np.tan(theta[:, 0])
    for wrong, limits in (
        ((rows < 0) | (rows > lowest), f"0 to {lowest} are taken"),
        (rows < horizon + BELOW_HORIZON_PX, "which is not below the horizon of all its states"),
    ):
        if wrong.any():
            raise ModelError(f"{name}: an entry's reference_row is {rows[wrong][0]:.6g}, {limits}; export it again with export-model")


def _contracted_scales(scene: Scene, sets: StateSet, name: str) -> NDArray[np.float64]:
    """The sets' scales, (sets, 2), contracted to what theta, y and the reference row allow; inverted where they contradict each other.

    The file's scales may exceed that range by a step of their bins. Raises `ModelError` if they exceed it by more, or are not ordered
    above 0.
    """
    low, high = (scene.camera.focal_u_px * side for side in sets.reference_range)
    low, high = low / sets.y[:, 1], high / sets.y[:, 0]
    step = largest_steps(scene, sets.x, sets.scale)
    slow, fast = sets.scale.T
    wrong = (slow <= 0) | (slow > fast) | (slow < low - step) | (fast > high + step)
    if wrong.any():
        found, allowed = ("{:.6g} to {:.6g}".format(*pair) for pair in (sets.scale[wrong][0], (low[wrong][0], high[wrong][0])))
        raise ModelError(f"{name}: an entry's scale is {found} px/m where its states allow {allowed}; export it again with export-model")
    low, high = low * (1 - OUTWARD_RELATIVE), high * (1 + OUTWARD_RELATIVE)
    return np.stack([np.maximum(slow, low), np.minimum(fast, high)], axis=-1)

"""What a model states of one cell, taken from its tables: masks as look-ups, boxes, sizes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from build_model.filter_tables import BankTables, FilterTables
from build_model.verify.counterexample import demand
from build_model.window import Bits, Window
from runtime.scene import Scene


@dataclass(frozen=True)
class MaskRuns:
    """Masks of a cell as the model's look-ups: both (runs, masks), flat indices into the (rows + 1, columns) sums down the window's
    columns. `folded`: the sums are those of the window folded along its middle, so that a mask has each pixel's mirror image too.
    """

    start: NDArray[np.int32]
    stop: NDArray[np.int32]
    folded: bool

    def bits(self, window: Window, cell: int, name: str) -> Bits:
        """The masks, (masks, rows, columns). Raises `Refuted` unless each look-up counts a run of its own down one column."""
        rows, columns = window.shape
        across = columns // 2 if self.folded else columns
        run, mask = np.nonzero(self.start != self.stop)
        start, stop = self.start[run, mask].astype(np.int64), self.stop[run, mask].astype(np.int64)
        inside = (start >= 0) & (stop > start) & (stop < (rows + 1) * across) & (start % across == stop % across)
        if not inside.all():
            demand(False, f"{name}: an index does not count a run of pixels down one column", cell, int(mask[~inside][0]))
        counts = np.zeros((self.start.shape[1], rows + 1, across), dtype=np.int32)
        np.add.at(counts, (mask, start // across, start % across), 1)
        np.subtract.at(counts, (mask, stop // across, stop % across), 1)
        counts = np.cumsum(counts, axis=1)[:, :-1]
        if counts.max(initial=0) > 1:
            demand(False, f"{name}: a pixel is counted twice", cell, int(np.argwhere(counts > 1)[0, 0]))
        return np.concatenate([counts, counts[..., ::-1]], axis=2) > 0 if self.folded else counts > 0


@dataclass(frozen=True)
class PaintedRuns:
    """A cell's S as it is painted: `step` is added at the flat pixel `index` of the window and summed down the columns."""

    index: NDArray[np.int32]
    step: NDArray[np.int32]

    def cover(self, window: Window, cell: int) -> NDArray[np.int64]:
        """What is painted on each pixel, (rows, columns). Raises `Refuted` for an index outside the window."""
        inside = (self.index >= 0) & (self.index < math.prod(window.shape))
        demand(bool(inside.all()), "S as painted: an index lies outside the window", cell)
        steps = np.zeros(math.prod(window.shape), dtype=np.int64)
        np.add.at(steps, self.index, self.step)
        return np.cumsum(steps.reshape(window.shape), axis=0)


@dataclass(frozen=True, kw_only=True)
class BankClaim:
    """What a model of either kind states of one cell: box [lower, upper] (4,), its entries' boxes and sizes as the file has them."""

    scene: Scene
    cell: int
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    window: Window
    must_light_size: NDArray[np.int32]
    line_lower: NDArray[np.float64]
    line_upper: NDArray[np.float64]
    reference_row: NDArray[np.float64]
    state_lower: NDArray[np.float32]
    state_upper: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class CellClaim(BankClaim):
    """What a model of masks states of one cell: S, and of every entry K and O."""

    spatial: MaskRuns
    painted: PaintedRuns
    must_light: MaskRuns
    may_light: MaskRuns


def bank_claim(scene: Scene, tables: BankTables, cell: int) -> dict[str, Any]:
    """The fields of `BankClaim`, from the tables."""
    rows = tables.row_cell == cell
    return {
        "scene": scene,
        "cell": cell,
        "lower": tables.cells.lower[cell],
        "upper": tables.cells.upper[cell],
        "window": tables.window,
        "must_light_size": tables.must_light_size[rows].ravel(),
        "line_lower": tables.line_lower[rows].reshape(-1, 4),
        "line_upper": tables.line_upper[rows].reshape(-1, 4),
        "reference_row": tables.reference_row[rows].ravel(),
        "state_lower": tables.state_lower[rows].reshape(-1, 4),
        "state_upper": tables.state_upper[rows].reshape(-1, 4),
    }


def cell_claims(scene: Scene, tables: FilterTables) -> Iterator[CellClaim]:
    """What the tables state of each cell. Look-ups of K into the sums of the dilated frame are renumbered from 0."""
    runs, rows = tables.runs, tables.window.shape[0]
    masks = runs.blocks[0].shape[2]
    stop, start = np.concatenate([np.pad(block, ((0, 0), (0, 0), (0, masks - block.shape[2]))) for block in runs.blocks], axis=1)
    witnesses = (rows + 1) * runs.columns if scene.tolerance.line_px else 0

    def counted(places: NDArray[np.int32], base: int = 0) -> MaskRuns:
        places = places.ravel()
        used = start[:, places] != stop[:, places]
        return MaskRuns(*(np.where(used, side[:, places] - base, 0) for side in (start, stop)), folded=runs.folded)

    for cell in range(len(tables.cells)):
        painted, rows = tables.spatial_runs.cell == cell, tables.row_cell == cell
        yield CellClaim(
            **bank_claim(scene, tables, cell),
            spatial=counted(runs.spatial[cell : cell + 1]),
            painted=PaintedRuns(tables.spatial_runs.index[painted], tables.spatial_runs.step[painted]),
            must_light=counted(runs.must_light[rows], witnesses),
            may_light=counted(runs.may_light[rows]),
        )

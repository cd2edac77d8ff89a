"""NN_F, the filter of all cells (paper, section III.D): its tables, and a torch module that evaluates it as it is defined.

`FilterTables` lays the cells' banks out in rows of one width, ready for the static graph of `build_model.filter_graph`: a row for a cell
where the cells have about as many entries each, several rows for the larger ones where they have not. `FilterNetwork` evaluates S, K
and O as dense 0/1 weights instead: spatial masks by elementwise products, banks by integer matrix products, an argmax over the cells. The
two share no index, so that their parity is a test of both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from build_model.hough_bank import CellBank
from build_model.partition import Partition, partition
from build_model.pixel_mask import Window
from build_model.run_table import RunTable, SpatialRuns, run_table, spatial_runs
from runtime.rounding import float32_above, float32_below
from runtime.scene import Scene

NEVER = 2**20
"""|K| of the padding: more than any frame can light, so that padding never passes and is never the least mismatch."""
ROW_COST, SECOND_REDUCTION_COST = 8, 2000
"""What a row costs beside its entries, and what it costs to gather rows by cell and reduce them again, in entries scored and reduced."""


@dataclass(frozen=True)
class FilterTables:
    """Constants of NN_F. A cell's entries fill one row or several, (rows, width), the last of them padded."""

    window: Window
    cells: Partition
    row_cell: NDArray[np.int32]
    """The cell of each row, (rows,), ascending."""
    runs: RunTable
    spatial_runs: SpatialRuns
    must_light_size: NDArray[np.int32]
    """|K_ij|, (rows, width); `NEVER` in the padding."""
    state_lower: NDArray[np.float32]
    state_upper: NDArray[np.float32]
    """Each entry in state coordinates, (rows, width, 4)."""
    line_lower: NDArray[np.float64]
    line_upper: NDArray[np.float64]
    """Each entry's box in theta, x, scale, z, (rows, width, 4): what a verifier must prove the masks for."""
    reference_row: NDArray[np.float64]
    """The row of the frame that each entry's scale refers to, (rows, width) px."""

    @property
    def rows_of_cell(self) -> NDArray[np.int32]:
        """Every cell's rows, (rows of the largest cell, cells); a smaller cell's last one again where it has no more."""
        first, last = (np.searchsorted(self.row_cell, np.arange(len(self.cells)), side) for side in ("left", "right"))
        return np.minimum(first + np.arange((last - first).max())[:, None], last - 1).astype(np.int32)

    @property
    def smallest_must_light(self) -> int:
        """Smallest |K_ij| of all entries."""
        return int(self.must_light_size.min())


def assemble(scene: Scene, banks: Sequence[CellBank]) -> FilterTables:
    """Lays out the banks of all cells, in the order of the partition."""
    window = banks[0].window
    for bank in banks[1:]:
        window = window.union(bank.window)
    entries = [len(bank) for bank in banks]
    width = row_width(entries)
    rows = rows_filled(entries, width)

    def padded(parts: Iterable[NDArray], padding: int = 0) -> NDArray:
        fitted = [
            np.pad(part, [(0, count * width - len(part))] + [(0, 0)] * (part.ndim - 1), constant_values=padding)
            for part, count in zip(parts, rows, strict=True)
        ]
        return np.concatenate(fitted).reshape(-1, width, *fitted[0].shape[1:])

    return FilterTables(
        window=window,
        cells=partition(scene),
        row_cell=np.repeat(np.arange(len(banks), dtype=np.int32), rows),
        runs=run_table(banks, window, scene.tolerance.line_px > 0, width),
        spatial_runs=spatial_runs(banks, window),
        must_light_size=padded((bank.must_light_sizes for bank in banks), NEVER).astype(np.int32),
        state_lower=padded(bank.state_lower for bank in banks),
        state_upper=padded(bank.state_upper for bank in banks),
        line_lower=padded(bank.lines.lower for bank in banks),
        line_upper=padded(bank.lines.upper for bank in banks),
        reference_row=padded(bank.lines.reference_row for bank in banks),
    )


def rows_filled(entries: Sequence[int], width: int) -> NDArray[np.int64]:
    """Rows of that width which each cell's entries take."""
    return -(-np.asarray(entries) // width)


def row_width(entries: Sequence[int]) -> int:
    """The width of rows that makes a frame cheapest: every place in a row is scored and reduced, padding too.

    One row a cell needs no second reduction; a narrower one has less padding where cells have unlike numbers of entries.
    """

    def cost(width: int) -> float:
        rows = rows_filled(entries, width)
        again = SECOND_REDUCTION_COST + len(entries) * rows.max() if rows.max() > 1 else 0
        return float(rows.sum() * (width + ROW_COST) + again)

    most = max(entries)
    return min(dict.fromkeys(-(-most // parts) for parts in range(1, most + 1)), key=cost)


class FilterNetwork(nn.Module):
    """NN_F in torch, as it is defined; slow and exact. Outputs as in `models/README.md`, without `network_state`."""

    def __init__(self, scene: Scene, banks: Sequence[CellBank]) -> None:
        super().__init__()
        self.scene = scene
        self.banks = banks
        cells = partition(scene)
        self.cell_lower = torch.from_numpy(float32_below(cells.lower))
        self.cell_upper = torch.from_numpy(float32_above(cells.upper))

    def forward(self, frame: Tensor, missed_budget: int, extra_budget: int) -> dict[str, Tensor]:
        """`frame`: uint8 (height, width) of {0, 1}."""
        witnessed = self._dilated(frame)
        support, mismatch, lowers, uppers, masks = [], [], [], [], []
        for cell, bank in enumerate(self.banks):
            missed, extra, spatial = self._scores(bank, frame, witnessed)
            passes = (missed <= missed_budget) & ((extra <= extra_budget) | (extra_budget < 0))
            support.append(passes.sum(dtype=torch.int32))
            mismatch.append((missed + extra).min())
            lowers.append(self._hull(bank.state_lower, passes, self.cell_lower[cell], torch.amin))
            uppers.append(self._hull(bank.state_upper, passes, self.cell_upper[cell], torch.amax))
            masks.append(spatial)
        counts, mismatches = torch.stack(support), torch.stack(mismatch)
        cell = counts.argmax() if bool(counts.any()) else mismatches.argmin()
        chosen = counts > 0 if bool(counts.any()) else torch.arange(len(counts)) == cell
        union = torch.stack(masks)[chosen].any(dim=0)
        return {
            "cell": cell,
            "support": counts,
            "mismatch": mismatches,
            "cell_lower": torch.stack(lowers),
            "cell_upper": torch.stack(uppers),
            "filtered": frame * union.to(torch.uint8),
        }

    def _dilated(self, frame: Tensor) -> Tensor:
        """The frame dilated by the tolerance in the sup norm: a pixel's witnesses."""
        span = 2 * self.scene.tolerance.line_px + 1
        wide = frame[None, None].to(torch.float32)
        return nn.functional.max_pool2d(wide, span, stride=1, padding=span // 2)[0, 0].to(torch.uint8)

    def _scores(self, bank: CellBank, frame: Tensor, witnessed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """missed and extra of every entry, int32 (entries,), and S in the whole frame."""
        spatial, must, may = (
            torch.from_numpy(runs.bits(masks, bank.window)).flatten(1).to(torch.int32)
            for runs, masks in ((bank.spatial, 1), (bank.must_light, len(bank)), (bank.may_light, len(bank)))
        )
        pixels, witnesses = (image[bank.window.slices].flatten().to(torch.int32) for image in (frame, witnessed))
        missed = must.sum(dim=1, dtype=torch.int32) - must @ witnesses
        extra = (spatial * (1 - may)) @ pixels
        mask = torch.zeros(frame.shape, dtype=torch.bool)
        mask[bank.window.slices] = spatial.reshape(bank.window.shape) > 0
        return missed, extra, mask

    @staticmethod
    def _hull(bounds: NDArray[np.float32], passes: Tensor, cell_bound: Tensor, extreme: Callable[..., Tensor]) -> Tensor:
        """Hull of the passing entries' boxes on one side; the cell's own bound where none passes."""
        if not bool(passes.any()):
            return cell_bound
        return extreme(torch.from_numpy(bounds)[passes], dim=0)

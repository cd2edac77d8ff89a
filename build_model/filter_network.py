"""NN_F, the filter of all cells (paper, section III.D), in torch as it is defined.

S, K, O and windows are evaluated as dense 0/1 weights: spatial masks by elementwise products, banks by integer matrix products, an argmax
over the cells. The static graph of `build_model.filter_graph` shares no index with it, so that their parity is a test of both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from build_model.hough_bank import CellBank
from build_model.partition import partition
from build_model.window_bank import CellWindows, Windows, windowed_bank
from runtime.model.format import PADDING_SIZE
from runtime.rounding import float32_above, float32_below
from runtime.scene import Scene


class FilterNetwork(nn.Module):
    """NN_F of a bank of masks in torch, as it is defined; slow and exact. Outputs as in `models/README.md`, without `network_state`."""

    def __init__(self, scene: Scene, banks: Sequence[CellBank]) -> None:
        super().__init__()
        self.scene = scene
        self.banks = banks
        cells = partition(scene)
        self.cell_lower = torch.from_numpy(float32_below(cells.lower))
        self.cell_upper = torch.from_numpy(float32_above(cells.upper))

    def forward(self, frame: Tensor, missed_budget: int, extra_budget: int) -> dict[str, Tensor]:
        """`frame`: uint8 (height, width) of {0, 1}."""
        witnessed, masks = dilated(self.scene, frame), []
        scores = []
        for bank in self.banks:
            *missed_and_extra, spatial = self._scores(bank, frame, witnessed)
            scores.append(missed_and_extra)
            masks.append(spatial)
        passes = [(missed <= missed_budget) & ((extra <= extra_budget) | (extra_budget < 0)) for missed, extra in scores]
        outputs, chosen = self._summed_up(passes, [missed + extra for missed, extra in scores])
        union = torch.stack(masks)[chosen].any(dim=0)
        return outputs | {"filtered": frame * union.to(torch.uint8)}

    def _summed_up(self, passes: Sequence[Tensor], mismatches: Sequence[Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        """Outputs that follow from the passing entries and all mismatches, one tensor a cell; and the cells whose S is shown, (cells,)."""
        counts = torch.stack([part.sum(dtype=torch.int32) for part in passes])
        mismatch = torch.stack([part.min() for part in mismatches])
        cell = counts.argmax() if bool(counts.any()) else mismatch.argmin()
        chosen = counts > 0 if bool(counts.any()) else torch.arange(len(counts)) == cell
        lower = [
            self._hull(bank.state_lower, part, whole, torch.amin)
            for bank, part, whole in zip(self.banks, passes, self.cell_lower, strict=True)
        ]
        upper = [
            self._hull(bank.state_upper, part, whole, torch.amax)
            for bank, part, whole in zip(self.banks, passes, self.cell_upper, strict=True)
        ]
        bounds = {"cell_lower": torch.stack(lower), "cell_upper": torch.stack(upper)}
        return {"cell": cell, "support": counts, "mismatch": mismatch, **bounds}, chosen

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
        return extreme(torch.from_numpy(bounds)[passes], dim=0) if bool(passes.any()) else cell_bound


class WindowNetwork(FilterNetwork):
    """NN_F of a bank of windows in torch, as it is defined.

    The first `places` groups that pass their gates are opened, and group 0 if they are fewer. An entry misses as many pixels as its group's
    gate shows, or as its own windows do where the group is opened and that is more. Outside the smallest rectangle that holds S of all
    cells, everything counts as dark.
    """

    def __init__(self, scene: Scene, banks: Sequence[CellWindows]) -> None:
        super().__init__(scene, [])
        self.banks = banks

    def forward(self, frame: Tensor, missed_budget: int, extra_budget: int) -> dict[str, Tensor]:  # noqa: ARG002 - O is S: none is extra
        """`frame`: uint8 (height, width) of {0, 1}. `extra_budget` has no effect."""
        seen = self._of_some_cell()
        both = both_sides(dilated(self.scene, frame * seen) * seen)
        gates = [dark_windows(bank.gate, both) for bank in self.banks]
        passing = torch.cat(gates) <= missed_budget
        places = min(windowed_bank(self.scene).places, len(passing))
        opened = passing & (passing.cumsum(dim=0) <= places)
        opened[0] |= int(passing.sum()) < places
        missed = []
        for bank, gate, is_opened in zip(self.banks, gates, opened.split([len(gate) for gate in gates]), strict=True):
            own = torch.maximum(dark_windows(bank.windows, both).reshape(bank.exists.shape), gate[:, None])
            counted = torch.where(is_opened[:, None], own, gate[:, None].expand_as(own))
            missed.append(torch.where(torch.from_numpy(bank.exists), counted, PADDING_SIZE))
        outputs, chosen = self._summed_up([part <= missed_budget for part in missed], missed)
        overflow = passing.sum() > places
        return outputs | {"filtered": frame * self._between(chosen).to(torch.uint8), "overflow": overflow}

    def _of_some_cell(self) -> Tensor:
        """1 in the smallest rectangle that holds S of all cells, uint8 (height, width)."""
        covered = self._between(torch.ones(len(self.banks), dtype=torch.bool))
        rows, columns = (covered.any(dim=axis).to(torch.uint8) for axis in (1, 0))
        rows, columns = (side.cummax(dim=0).values * side.flip(0).cummax(dim=0).values.flip(0) for side in (rows, columns))
        return rows[:, None] * columns

    def _between(self, chosen: Tensor) -> Tensor:
        """True, for each marking and row, from the first to the last column of the chosen cells' S, (height, width)."""
        column = torch.arange(self.scene.camera.width)
        covered = torch.zeros(self.scene.camera.shape, dtype=torch.bool)
        for marking in range(len(self.scene.runway.markings)):
            masks = [
                (column >= torch.from_numpy(bank.spans.first[marking])[:, None])
                & (column <= torch.from_numpy(bank.spans.last[marking])[:, None])
                for bank, is_chosen in zip(self.banks, chosen, strict=True)
                if is_chosen
            ]
            union = torch.stack(masks).any(dim=0).to(torch.uint8)
            reached, left = union.cummax(dim=1).values, union.flip(1).cummax(dim=1).values.flip(1)
            covered |= (reached * left) > 0
        return covered


def dilated(scene: Scene, frame: Tensor) -> Tensor:
    """The frame dilated by the tolerance in the sup norm: a pixel's witnesses."""
    span = 2 * scene.tolerance.line_px + 1
    wide = frame[None, None].to(torch.float32)
    return nn.functional.max_pool2d(wide, span, stride=1, padding=span // 2)[0, 0].to(torch.uint8)


def both_sides(frame: Tensor) -> Tensor:
    """J: the pixels of the frame with a lit one beneath, or beneath and beside, as a product, (height, width)."""
    beneath = nn.functional.pad(frame[1:][None, None].to(torch.float32), (1, 1, 0, 1))
    return frame * nn.functional.max_pool2d(beneath, (1, 3), stride=1)[0, 0].to(torch.uint8)


def dark_windows(windows: Windows, both: Tensor) -> Tensor:
    """How many windows of each set show nothing of J, int32 (sets,): a product of 0/1 weights for each of its windows."""
    column, counts = torch.arange(both.shape[1]), torch.zeros(len(windows), dtype=torch.int32)
    for border, first, last in zip(*(torch.from_numpy(part.T) for part in (windows.border, windows.first, windows.last)), strict=True):
        weights = ((column >= first[:, None]) & (column <= last[:, None])).to(torch.int32)
        lit = (weights * both[(border - 1).clamp(min=0)].to(torch.int32)).sum(dim=1)
        counts += ((first <= last) & (lit == 0)).to(torch.int32)
    return counts

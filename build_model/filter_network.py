"""NN_F, the filter of all cells (paper, section III.D), in torch as it is defined.

S, K and O are evaluated as dense 0/1 weights: spatial masks by elementwise products, banks by integer matrix products, an argmax over the
cells. The static graph of `build_model.filter_graph` shares no index with it, so that their parity is a test of both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from build_model.hough_bank import CellBank
from build_model.partition import partition
from runtime.rounding import float32_above, float32_below
from runtime.scene import Scene


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

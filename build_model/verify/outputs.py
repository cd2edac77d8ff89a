"""The outputs of a model on sample frames, compared with what its masks define, counted pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from build_model.filter_tables import FilterTables
from build_model.verify.cell_claim import CellClaim, cell_claims
from build_model.verify.counterexample import demand
from runtime.model.format import BUDGETS, FRAME
from runtime.scene import Scene

SAMPLE_FRAMES = 6
"""Frames on which the graph's outputs are compared with their definition."""
SAMPLE_DENSITIES = (0.0, 0.02, 0.2, 0.6, 1.0)


def check_outputs(content: bytes, scene: Scene, tables: FilterTables) -> None:
    """Runs the file in onnxruntime on sample frames, and compares NN_F's outputs with their definition. Raises `Refuted`."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3  # it warns of the budgets, initialisers that are inputs too
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(0)
    claims, width = list(cell_claims(scene, tables)), tables.must_light_size.shape[1]
    for number in range(SAMPLE_FRAMES):
        frame = (rng.random(scene.camera.shape) < SAMPLE_DENSITIES[number % len(SAMPLE_DENSITIES)]).astype(np.uint8)
        missed, extra = (int(budget) for budget in rng.integers([0, -1], [tables.smallest_must_light, 64]))
        expected = defined_outputs(claims, width, frame, missed, extra)
        budgets = {name: np.array(budget, dtype=np.int32) for name, budget in zip(BUDGETS, (missed, extra), strict=True)}
        found = session.run(list(expected), {FRAME: frame, **budgets})
        for name, value in zip(expected, map(np.asarray, found), strict=True):
            defined = expected[name]
            same = np.array_equal(value, np.where(np.isnan(defined), value, defined))
            demand(same, f"graph: on sample frame {number} the output {name!r} is not what the masks define")


def defined_outputs(
    claims: list[CellClaim], row_width: int, frame: NDArray[np.uint8], missed_budget: int, extra_budget: int
) -> dict[str, NDArray]:
    """NN_F's outputs by their definition; the hull of a cell without a passing entry is NaN. `row_width`: entries in a row."""
    window, line_px = claims[0].window, claims[0].scene.tolerance.line_px
    lit = frame.astype(bool)
    wide, span, (height, width) = np.pad(lit, line_px), range(2 * line_px + 1), lit.shape
    witnessed = np.logical_or.reduce([wide[row : row + height, column : column + width] for row in span for column in span])
    scores = [_scores(claim, lit[window.slices], witnessed[window.slices]) for claim in claims]
    passes = [(missed <= missed_budget) & ((extra <= extra_budget) | (extra_budget < 0)) for missed, extra in scores]
    support = np.array([part.sum() for part in passes], dtype=np.int32)
    mismatch = np.array([(missed + extra).min() for missed, extra in scores], dtype=np.int32)
    cell = support.argmax() if support.any() else mismatch.argmin()
    shown = support > 0 if support.any() else np.arange(len(claims)) == cell
    filtered = np.zeros_like(frame)
    spatial = [claim.spatial.bits(window, claim.cell, "S")[0] for claim in claims]
    filtered[window.slices] = frame[window.slices] * np.any(np.array(spatial)[shown], axis=0)
    lower = np.array([_hull(claim.state_lower[chosen], np.min) for claim, chosen in zip(claims, passes, strict=True)])
    upper = np.array([_hull(claim.state_upper[chosen], np.max) for claim, chosen in zip(claims, passes, strict=True)])
    outputs = {
        "passes": np.concatenate(passes).reshape(-1, row_width),
        "support": support,
        "mismatch": mismatch,
        "cell": np.array(cell),
        "filtered": filtered,
    }
    return outputs | {"cell_lower": lower, "cell_upper": upper}


def _hull(sides: NDArray[np.float32], extreme: Callable[..., NDArray[np.float32]]) -> NDArray[np.float32]:
    """The extreme of the passing entries' sides, (4,); NaN where no entry passes."""
    return extreme(sides, axis=0) if len(sides) else np.full(4, np.nan, dtype=np.float32)


def _scores(claim: CellClaim, lit: NDArray[np.bool_], witnessed: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """missed = |K without the dilated frame|, from the stated |K|, and extra = |(frame and S) without O|, of every entry."""
    window, cell = claim.window, claim.cell
    spatial, must_light = claim.spatial.bits(window, cell, "S"), claim.must_light.bits(window, cell, "K")
    extra = lit & spatial & ~claim.may_light.bits(window, cell, "O")
    return claim.must_light_size - (must_light & witnessed).sum(axis=(1, 2)), extra.sum(axis=(1, 2))

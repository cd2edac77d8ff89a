"""The outputs of a model on sample frames, compared with what its masks define, counted pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from build_model.filter_tables import BankTables, FilterTables, WindowTables
from build_model.verify.cell_claim import BankClaim, CellClaim, cell_claims
from build_model.verify.counterexample import Counterexample, Refuted, demand
from build_model.verify.window_claim import WindowClaim, window_claims
from build_model.window import Window
from runtime.errors import one_line
from runtime.model.format import BUDGETS, FRAME, OVERFLOW, PADDING_SIZE
from runtime.scene import Scene, WindowedBank

SAMPLE_FRAMES = 6
"""Frames on which the graph's outputs are compared with their definition."""
LOG_FATAL_ONLY = 4
SAMPLE_DENSITIES = (0.0, 0.02, 0.2, 0.6, 1.0)


def check_outputs(content: bytes, scene: Scene, tables: BankTables) -> None:
    """Runs the file in onnxruntime on sample frames, and compares NN_F's outputs with their definition. Raises `Refuted`."""
    session = _opened(content)
    rng = np.random.default_rng(0)
    defined = _definition(scene, tables)
    for number in range(SAMPLE_FRAMES):
        frame = (rng.random(scene.camera.shape) < SAMPLE_DENSITIES[number % len(SAMPLE_DENSITIES)]).astype(np.uint8)
        missed, extra = (int(budget) for budget in rng.integers([0, -1], [tables.smallest_must_light, 64]))
        expected = defined(frame, missed, extra)
        budgets = {name: np.array(budget, dtype=np.int32) for name, budget in zip(BUDGETS, (missed, extra), strict=True)}
        found = _run(session, list(expected), {FRAME: frame, **budgets})
        for name, value in zip(expected, map(np.asarray, found), strict=True):
            same = np.array_equal(value, np.where(np.isnan(expected[name]), value, expected[name]))
            demand(same, f"graph: on sample frame {number} the output {name!r} is not what the masks define")


def _opened(content: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = LOG_FATAL_ONLY  # it warns of the budgets, and an error becomes a refutation
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises classes of its own that share only this one
        raise Refuted(Counterexample(f"graph: onnxruntime cannot load it ({one_line(error):.160})")) from error


def _run(session: onnxruntime.InferenceSession, outputs: list[str], feed: dict[str, NDArray[Any]]) -> Sequence[Any]:
    try:
        return session.run(outputs, feed)
    except Exception as error:  # as above
        raise Refuted(Counterexample(f"graph: onnxruntime cannot run it ({one_line(error):.160})")) from error


def _definition(scene: Scene, tables: BankTables) -> Callable[[NDArray[np.uint8], int, int], dict[str, NDArray]]:
    """NN_F's outputs by their definition, of a frame and the two budgets."""
    if isinstance(tables, WindowTables):
        windowed = list(window_claims(scene, tables))
        return lambda frame, missed, _extra: defined_by_windows(windowed, frame, missed)
    assert isinstance(tables, FilterTables)
    claims, width = list(cell_claims(scene, tables)), tables.must_light_size.shape[1]
    return lambda frame, missed, extra: defined_outputs(claims, width, frame, missed, extra)


def defined_outputs(
    claims: list[CellClaim], row_width: int, frame: NDArray[np.uint8], missed_budget: int, extra_budget: int
) -> dict[str, NDArray]:
    """NN_F's outputs by their definition; the hull of a cell without a passing entry is NaN. `row_width`: entries in a row."""
    window = claims[0].window
    lit, witnessed = frame.astype(bool), _witnessed(claims[0], frame)
    scores = [_scores(claim, lit[window.slices], witnessed[window.slices]) for claim in claims]
    passes = [(missed <= missed_budget) & ((extra <= extra_budget) | (extra_budget < 0)) for missed, extra in scores]
    outputs = _summed_up(claims, passes, [missed + extra for missed, extra in scores], row_width)
    spatial = [claim.spatial.bits(window, claim.cell, "S")[0] for claim in claims]
    filtered = np.zeros_like(frame)
    filtered[window.slices] = frame[window.slices] * np.any(np.array(spatial)[_shown(outputs)], axis=0)
    return outputs | {"filtered": filtered}


def defined_by_windows(claims: list[WindowClaim], frame: NDArray[np.uint8], missed_budget: int) -> dict[str, NDArray]:
    """`defined_outputs` of a bank of windows: the first `places` groups that pass their gates are opened, and group 0 if they are fewer.

    What lies outside the window of all S counts as dark, for no state of the domain lights it, nor has a witness there.
    """
    bank, window = claims[0].scene.bank, claims[0].window
    assert isinstance(bank, WindowedBank)
    witnessed = np.pad(_within(window, _witnessed(claims[0], _within(window, frame))), 1)
    gates = np.concatenate([_dark(claim.gate.windows(window, claim.cell, "gate"), witnessed) for claim in claims])
    passing = np.flatnonzero(gates <= missed_budget)
    opened = set(passing[: bank.places].tolist()) | ({0} if len(passing) < min(bank.places, len(gates)) else set())
    scores, before = [], 0
    for claim in claims:
        own = _dark(claim.windows.windows(window, claim.cell, "window"), witnessed).reshape(-1, claim.parts)
        numbers = before + np.arange(len(own))
        gate = gates[numbers][:, None]
        missed = np.where(np.isin(numbers, list(opened))[:, None], np.maximum(own, gate), gate).ravel()
        scores.append(np.where(claim.must_light_size == PADDING_SIZE, PADDING_SIZE, missed))
        before += len(own)
    outputs = _summed_up(claims, [missed <= missed_budget for missed in scores], scores, claims[0].parts)
    shown, columns = _shown(outputs), np.arange(window.shape[1])
    first = np.array([claim.span_first for claim in claims])[shown].min(axis=0)[:, :, None]
    stop = np.array([claim.span_stop for claim in claims])[shown].max(axis=0)[:, :, None]
    filtered = np.zeros_like(frame)
    filtered[window.slices] = frame[window.slices] * ((columns >= first) & (columns < stop)).any(axis=0)
    return outputs | {"filtered": filtered, OVERFLOW: np.array(len(passing) > min(bank.places, len(gates)))}


def _dark(windows: tuple[NDArray[np.int64], ...], padded: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Number of each set's windows in which no pixel above the border is lit with one below it, (sets,). `padded`: dark all around."""
    both = padded[1:-2, 1:-1] & (padded[2:-1, :-2] | padded[2:-1, 1:-1] | padded[2:-1, 2:])
    counts = np.zeros(len(windows[0]), dtype=np.int64)
    for number, place in np.argwhere(windows[1] <= windows[2]).tolist():
        border, first, last = (int(part[number, place]) for part in windows)
        counts[number] += not both[border - 1, first : last + 1].any()
    return counts


def _within(window: Window, frame: NDArray[Any]) -> NDArray[Any]:
    """The frame, dark outside the window."""
    seen = np.zeros_like(frame)
    seen[window.slices] = frame[window.slices]
    return seen


def _witnessed(claim: BankClaim, frame: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The frame with every pixel lit that has a lit one within the tolerance."""
    line_px, lit = claim.scene.tolerance.line_px, frame.astype(bool)
    wide, span, (height, width) = np.pad(lit, line_px), range(2 * line_px + 1), lit.shape
    return np.logical_or.reduce([wide[row : row + height, column : column + width] for row in span for column in span])


def _summed_up(
    claims: Sequence[BankClaim], passes: list[NDArray[np.bool_]], mismatches: list[NDArray[np.int64]], row_width: int
) -> dict[str, NDArray]:
    """Outputs that follow from which entries pass, and from every entry's mismatch."""
    support = np.array([part.sum() for part in passes], dtype=np.int32)
    mismatch = np.array([part.min() for part in mismatches], dtype=np.int32)
    cell = support.argmax() if support.any() else mismatch.argmin()
    outputs = {"passes": np.concatenate(passes).reshape(-1, row_width), "support": support, "mismatch": mismatch, "cell": np.array(cell)}
    lower = np.array([_hull(claim.state_lower[chosen], np.min) for claim, chosen in zip(claims, passes, strict=True)])
    upper = np.array([_hull(claim.state_upper[chosen], np.max) for claim, chosen in zip(claims, passes, strict=True)])
    return outputs | {"cell_lower": lower, "cell_upper": upper}


def _shown(outputs: dict[str, NDArray]) -> NDArray[np.bool_]:
    """The cells whose S is shown: those that pass, or the one that is named where none does."""
    support: NDArray[np.int32] = outputs["support"]
    return support > 0 if support.any() else np.arange(len(support)) == outputs["cell"]


def _hull(sides: NDArray[np.float32], extreme: Callable[..., NDArray[np.float32]]) -> NDArray[np.float32]:
    """The extreme of the passing entries' sides, (4,); NaN where no entry passes."""
    return extreme(sides, axis=0) if len(sides) else np.full(4, np.nan, dtype=np.float32)


def _scores(claim: CellClaim, lit: NDArray[np.bool_], witnessed: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """missed = |K without the dilated frame|, from the stated |K|, and extra = |(frame and S) without O|, of every entry."""
    window, cell = claim.window, claim.cell
    spatial, must_light = claim.spatial.bits(window, cell, "S"), claim.must_light.bits(window, cell, "K")
    extra = lit & spatial & ~claim.may_light.bits(window, cell, "O")
    return claim.must_light_size - (must_light & witnessed).sum(axis=(1, 2)), extra.sum(axis=(1, 2))

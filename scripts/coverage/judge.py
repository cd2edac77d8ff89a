"""Judges one frame of the coverage campaign against its truth, and counts.

A state is judged if the theorem's assumptions hold for it, which is found out here and not taken from what was drawn: it lies in the
domain, its exact image lacks at most m witnesses in the frame, and under Theorem B at most e lit pixels of its cell's S are not of it.
Every judged state must be in every box, whichever of them the frame was drawn for.
"""

from __future__ import annotations

import zlib
from collections import Counter
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np
from rational_image import Frame, RationalState

from coverage.frames import Picture
from coverage.scenarios import Scenario
from coverage.states import Floats, Stage, estimator_of, image_of, spatial_mask
from runtime import Estimate

GRID = 1e-4
"""Errors and half-widths are counted in steps of this, rad or m: the last place that is printed."""
UNREFINED_EVERY = 4
"""Every fourth frame is also judged without refinement, whose certificate rests on the model's integers alone."""
HALF_WIDTHS = ("theta", "y", "z")


@dataclass
class Tally:
    """Counts over frames; sums and histograms, so that parts can be added. Histograms count multiples of `GRID`."""

    frames: int = 0
    judged: int = 0
    """States that the assumptions hold for."""
    certified: int = 0
    violations: int = 0
    pixels_lost: int = 0
    no_runway: int = 0
    at_boundary: int = 0
    named: int = 0
    fallbacks: int = 0
    passing: int = 0
    unrefined: int = 0
    error: Counter[int] = field(default_factory=Counter)
    theta: Counter[int] = field(default_factory=Counter)
    y: Counter[int] = field(default_factory=Counter)
    z: Counter[int] = field(default_factory=Counter)

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(getattr(self, part.name) + getattr(other, part.name) for part in fields(self)))

    @staticmethod
    def read(tables: dict[str, Any]) -> Tally:
        """A tally from JSON, which knows no whole numbers as keys."""
        tally = Tally(**tables)
        for name in ("error", *HALF_WIDTHS):
            setattr(tally, name, Counter({int(key): count for key, count in tables[name].items()}))
        return tally


def quantile(histogram: Counter[int], share: float) -> float:
    """The value below or at which `share` of the counted ones lie, to `GRID`; 0 without any."""
    if not histogram:
        return 0.0
    steps = sorted(histogram)
    reached = np.cumsum([histogram[step] for step in steps])
    return steps[int(np.searchsorted(reached, share * reached[-1]))] * GRID


@dataclass(frozen=True)
class Violation:
    """A certificate that does not hold, with what is needed to see it again: `--replay "SCENARIO#NUMBER"`."""

    scenario: str
    seed: int
    number: int
    state: str
    """tan(theta/2), x, y, z as fractions."""
    fault: str


class TrueState(Protocol):
    """What can be asked for exactly: a `RationalState`, or one of a turned camera."""

    def within(self, lower: Floats, upper: Floats, /) -> bool:
        """True if the state lies in a box, borders included."""
        ...


@dataclass(frozen=True)
class Judged:
    """A state that the certificate must hold for, and the pixels of its runway that are lit in the frame."""

    state: TrueState
    lit: Frame


def judge_frame(stage: Stage, scenario: Scenario, seed: int, number: int) -> tuple[Tally, list[Violation]]:
    """Draws frame `number` of a scenario, and judges it."""
    rng = np.random.default_rng([seed, zlib.crc32(scenario.name.encode()), number])
    picture, missed, extra = scenario.draw(rng, stage)
    estimator = estimator_of(stage.path, missed, extra)
    judged = judged_states(picture, missed, extra, scenario.runway)
    estimate = estimator.estimate(picture.frame)
    faults = faults_of(picture, judged, estimate)
    unrefined = number % UNREFINED_EVERY == 0
    if unrefined:
        hull = estimator.estimate(picture.frame, refine=False)
        faults += [("unrefined: " + fault, state) for fault, state in faults_of(picture, judged, hull)]
    lost = sum(pixels_lost(each, estimate) for each in judged)
    tally = tally_of(stage, picture, estimate, judged, len(faults), lost)
    tally.unrefined = int(unrefined)
    return tally, [Violation(scenario.name, seed, number, str(state), fault) for fault, state in faults]


def judged_states(picture: Picture, missed: int, extra: int, runway: bool) -> list[Judged]:
    """The states that the assumptions hold for."""
    stage = picture.stage
    judged = []
    for state in picture.states if runway else ():
        if not stage.contains(state):
            continue
        image, seen = image_of(stage.counted(picture.camera), state), image_of(picture.camera, state).frame
        if stage.unwitnessed(image, picture.frame) <= missed and (extra < 0 or extra_pixels(picture, state) <= extra):
            judged.append(Judged(state, seen & picture.frame))
    return judged


def pixels_lost(judged: Judged, estimate: Estimate) -> int:
    """Lit pixels of a judged runway that `filtered` does not have."""
    return int((judged.lit & (estimate.filtered == 0)).sum())


def extra_pixels(picture: Picture, state: RationalState) -> int:
    """Lit pixels in S of a cell that holds the state, but for those within the tolerance of its image and its runway as it is seen."""
    stage = picture.stage
    own = image_of(stage.view, state).thickened(stage.scene.tolerance.line_px) | image_of(picture.camera, state).frame
    return min(int((picture.frame & ~own & spatial_mask(stage.path, cell)).sum()) for cell in stage.cells_of(state))


def faults_of(picture: Picture, judged: list[Judged], estimate: Estimate) -> list[tuple[str, TrueState]]:
    """What an estimate claims and is not so, each with the state that shows it."""
    faults: list[tuple[str, TrueState]] = []
    for each in judged:
        if estimate.box is None:
            faults.append(("no runway", each.state))
            continue
        if not each.state.within(estimate.box.lower, estimate.box.upper):
            faults.append((f"not in the box {estimate.box.lower.tolist()} {estimate.box.upper.tolist()}", each.state))
        elif not any(each.state.within(region.lower, region.upper) for region in estimate.regions):
            faults.append(("in no region", each.state))
        if lost := pixels_lost(each, estimate):
            faults.append((f"filtered lacks {lost} pixels", each.state))
    if (estimate.filtered.astype(bool) & ~picture.frame).any():
        faults.append(("filtered adds pixels", picture.states[0]))
    if estimate.box is not None and (estimate.state is None or not estimate.box.contains(estimate.state)):
        faults.append(("the point estimate is not in the box", picture.states[0]))
    return faults


def tally_of(stage: Stage, picture: Picture, estimate: Estimate, judged: list[Judged], violations: int, lost: int) -> Tally:
    """The counts of one frame."""
    tally = Tally(frames=1, judged=len(judged), violations=violations, pixels_lost=lost, passing=len(estimate.passing))
    if estimate.box is None or estimate.state is None:
        tally.no_runway = 1
        return tally
    truth = picture.states[0]
    tally.certified, tally.at_boundary, tally.fallbacks = 1, int(estimate.touches_boundary), int(estimate.used_fallback)
    if picture.runway.any():
        tally.named = int(estimate.cell in stage.cells_of(truth))
        tally.error[steps(float(np.linalg.norm(estimate.state - truth.floats)))] += 1
    for name, value in zip(HALF_WIDTHS, estimate.box.half_widths[[0, 2, 3]].tolist(), strict=True):
        getattr(tally, name)[steps(value)] += 1
    return tally


def steps(value: float) -> int:
    """A value in multiples of `GRID`."""
    return round(value / GRID)

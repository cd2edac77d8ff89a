"""States at the border of what a frame allows: where a bound that is a little too tight shows.

Every state whose image the frame contains, but for m pixels, must be in the box, whichever of them the frame was drawn for. From the truth
a search climbs to a large or a small value of one axis, then goes along that axis to the border, all in float64. Whether the assumptions
hold for the state that it ends at is for the judge, who knows only fractions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from coverage.frames import Picture
from coverage.states import Stage, into_domain
from numpy.typing import NDArray
from rational_image import RationalState

from random_scenes.pitched_state import as_fixed
from random_scenes.sights import Floats, Rng
from runtime import Box, Scene
from runtime.camera import ground_scale
from runtime.domain import Domain
from runtime.image import dilated, lit_columns

PROPOSALS = 24
"""States that are looked at together."""
CLIMBS = 12
"""Rounds of proposals, by steps that grow where they find a better state and shrink where they do not."""
FIRST_STEP, GROWTH, SHRINKAGE = 0.3, 1.5, 0.4
"""The first step as a share of the domain."""
SECTIONS = 10
"""Rounds in which the last stretch to the border is cut into `PROPOSALS` parts: 24^10 is 2^45."""


@dataclass(frozen=True)
class Witnesses:
    """A frame, asked how many pixels of a state's image lack a witness. `sums` (height, width + 1): witnesses to the left, per row."""

    scene: Scene
    sums: NDArray[np.int32]

    @staticmethod
    def of(picture: Picture) -> Witnesses:
        """What is lit within the tolerance; what is out of view counts as lit."""
        scene = picture.stage.scene
        line_px, (height, width) = scene.tolerance.line_px, scene.camera.shape
        seen = dilated(np.pad(picture.frame, line_px, constant_values=True), line_px)[line_px : line_px + height, line_px : line_px + width]
        sums = np.zeros((height, width + 1), dtype=np.int32)
        np.cumsum(seen, axis=1, out=sums[:, 1:])
        return Witnesses(scene, sums)

    def missed(self, states: Floats) -> NDArray[np.int64]:
        """Pixels without a witness, up to float64; one that two markings share counts twice. `states`: (n, 4); returns (n,)."""
        first, last = lit_columns(self.scene, states)
        width = self.scene.camera.width
        first, stop = np.clip(first, 0, width), np.clip(last + 1, 0, width)
        rows = np.arange(self.scene.camera.height)
        missed = np.maximum(stop - first, 0) - np.where(stop > first, self.sums[rows, stop] - self.sums[rows, first], 0)
        return missed.sum(axis=(1, 2))


@dataclass(frozen=True)
class Extreme:
    """A state that a frame allows, up to float64, with a large value on an axis (`sign` 1) or a small one (-1)."""

    state: RationalState
    axis: int
    sign: int

    def in_outer_part(self, box: Box, part: float) -> bool:
        """True if the state lies in the outer part of the box, a share of its width, on its side of its axis."""
        face = box.upper[self.axis] if self.sign > 0 else box.lower[self.axis]
        return bool(abs(face - self.state.floats[self.axis]) <= part * 2 * box.half_widths[self.axis])


def extreme_state(rng: Rng, picture: Picture, missed: int) -> Extreme | None:
    """A state far out on one side of one axis; None if the domain is a single state."""
    stage, witnesses = picture.stage, Witnesses.of(picture)
    free = np.flatnonzero(stage.lower < stage.upper)
    if len(free) == 0:
        return None
    axis, sign = int(rng.choice(free)), int(rng.choice([-1, 1]))
    best, step = picture.states[0].floats, FIRST_STEP
    for _ in range(CLIMBS):
        proposals = proposed(rng, stage, best, step)
        value = np.where(witnesses.missed(proposals) <= missed, sign * proposals[:, axis], -np.inf)
        found = value.max() > sign * best[axis]
        best, step = (proposals[value.argmax()], step * GROWTH) if found else (best, step * SHRINKAGE)
    bound = stage.upper[axis] if sign > 0 else stage.lower[axis]
    outermost = RationalState.near(to_border(witnesses, stage.scene.domain, best, axis, bound, missed))
    return Extreme(as_fixed(stage, into_domain(stage, outermost)), axis, sign)


def proposed(rng: Rng, stage: Stage, state: Floats, step: float) -> Floats:
    """States of the domain about one, (n, 4): moved on some axes by shares of its width, half of them at the same scale in some row."""
    moves = rng.normal(size=(PROPOSALS, 4)) * step * (rng.random((PROPOSALS, 4)) < 0.6)
    states = state + moves * (stage.upper - stage.lower)
    rows = rng.uniform(0, stage.view.height, PROPOSALS // 2)
    camera, half = stage.scene.camera, slice(PROPOSALS // 2)
    before, after = ground_scale(camera, state[0], 1.0, rows), ground_scale(camera, states[half, 0], 1.0, rows)
    seen = (before > 0) & (after > 0)
    states[half, 2] = np.where(seen, states[half, 2] * after / np.where(seen, before, 1.0), states[half, 2])
    return stage.scene.domain.nearest(states)


def to_border(witnesses: Witnesses, domain: Domain, state: Floats, axis: int, bound: float, missed: int) -> Floats:
    """The state moved along one axis, towards `bound`, as far as frame and domain allow without a gap."""
    near, far = float(state[axis]), float(bound)
    for _ in range(SECTIONS):
        values = np.linspace(near, far, PROPOSALS + 1)
        states = np.repeat(state[None], PROPOSALS + 1, axis=0)
        states[:, axis] = values
        allowed = (witnesses.missed(states) <= missed) & domain.contains(states)
        if allowed.all():
            near = far
            break
        last = int(allowed.argmin())
        near, far = float(values[max(last - 1, 0)]), float(values[last])
    moved = state.copy()
    moved[axis] = near
    return moved

"""What one frame leaves possible: a sample of the states whose image lacks no more lit pixels than the budget (Theorem A).

The consistent set is thin: pitch, altitude and distance compensate each other in an image, so it is a sliver along a valley of states. In
line coordinates it is round,

    g1, g2      scale of the ground (px per m, `runtime.camera`) at the rows of the farthest and of the nearest end, as the truth shows them
    x g1        where the camera's own track lies there, px
    v           row of the nearest end

since each border between rows bounds (p_x - x) g at its own row, which is linear in the first three, and rows bound v. The search keeps
the most extreme states found on each side of each axis, and steps from them by shares of the differences of states that it holds, as
differential evolution does: steps have the shape of the set. A few are random ones in px.

A sample can only be too small. `Extent` says by how much the last rounds still grew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime import Scene
from runtime.camera import ground_scale, project, row_of_point
from runtime.image import columns_of_ends

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bits = NDArray[np.bool_]

EXTREME = 48
"""States kept on each side of each axis, by how far out they lie."""
COMMON = 192
"""States kept besides, at random, for the differences between them."""
STEPS = 3072
"""States that are tried at a time."""
GENERATIONS = 10
"""Times that states are tried in a round."""
SMALLEST_STEP, LARGEST_STEP = 2.0**-8, 1.5
"""Shares of a difference between two states that a step takes."""
RANDOM_PX = 2.0**-12, 1.0
"""Standard deviation of a random step, px at the markings."""
LEAPS = 0.1
"""Share of the steps that change z alone, to any of the domain's."""
ENOUGH, ROUNDS_WITHOUT = 0.01, 3
"""The search ends when no side of the extent has grown by this share in so many rounds."""
MOST_ROUNDS = 60


@dataclass(frozen=True)
class DarkPixels:
    """Counts the pixels of images that are dark in a frame. `counted` (height, width + 1): how many are dark before each column."""

    counted: Integers

    @staticmethod
    def of(frame: Bits) -> DarkPixels:
        """`frame`, (height, width): lit pixels, or with a tolerance those that have a witness."""
        return DarkPixels(np.pad(np.cumsum(~frame, axis=1, dtype=np.int64), ((0, 0), (1, 0))))

    def missed(self, scene: Scene, states: Floats) -> Integers:
        """|I_r \\ I| of every state, (n,): as many as `runtime.image.runway_image` lights and the frame does not. `states`: (n, 4)."""
        return self.missed_of(project(scene, states))

    def missed_of(self, ends: Floats) -> Integers:
        """The same of images by the ends of their markings, (n, markings, 2, 2)."""
        ends = ends.copy()
        height, width = self.counted.shape[0], self.counted.shape[1] - 1
        top = int(np.clip(np.floor(ends[..., 1].min()), 0, height - 1))
        bottom = int(np.clip(np.floor(ends[..., 1].max()), top, height - 1)) + 1
        ends[..., 1] -= top  # exact: a multiple of the last place of what it is taken from
        first, last = columns_of_ends(ends, bottom - top)
        order = np.argsort(first, axis=1, kind="stable")
        first, last = (np.take_along_axis(part, order, axis=1) for part in (first, last))
        before = np.maximum.accumulate(last, axis=1)[:, :-1] + 1
        first[:, 1:] = np.maximum(first[:, 1:], before)  # a pixel of two markings is counted once
        start, stop = np.clip(first, 0, width), np.clip(last + 1, 0, width)
        row = np.arange(top, bottom) * (width + 1)
        dark = self.counted.ravel()[row + np.maximum(start, stop)] - self.counted.ravel()[row + start]
        return dark.sum(axis=(1, 2))


@dataclass(frozen=True)
class LineCoordinates:
    """The coordinates (g1, g2, x g1, v) of states, for two rows and one distance from the threshold."""

    scene: Scene
    rows: tuple[float, float]
    end_z_m: float

    @staticmethod
    def around(scene: Scene, state: Floats) -> LineCoordinates:
        """With the rows of the farthest and of the nearest end as `state` (4,) shows them."""
        rows = project(scene, state)[..., 1]
        return LineCoordinates(scene, (float(rows.min()), float(rows.max())), float(scene.runway.ends_z_m.min()))

    def of(self, states: Floats) -> Floats:
        """(n, 4) of states (n, 4)."""
        theta, x, y, z = states.T
        far, near = (ground_scale(self.scene.camera, theta, y, row) for row in self.rows)
        return np.stack([far, near, x * far, row_of_point(self.scene.camera, theta, y, self.end_z_m + z)], axis=-1)

    def states(self, coordinates: Floats) -> Floats:
        """The states, (n, 4), within the domain's axes of width 0; NaN or nonsense where there is none in front of the camera."""
        far, near, track, row = coordinates.T
        camera, domain = self.scene.camera, self.scene.domain
        start, stop = ((at - camera.v0) / camera.focal_v_px for at in self.rows)
        slope = (near - far) / (stop - start)
        theta = np.arctan2(far - slope * start, slope)
        y = camera.focal_u_px * np.cos(theta) / slope
        tangent = (row - camera.v0) / camera.focal_v_px
        d = y * (np.cos(theta) - tangent * np.sin(theta)) / (tangent * np.cos(theta) + np.sin(theta))
        states = np.stack([theta, track / far, y, d - self.end_z_m], axis=-1)
        return np.where(domain.lower == domain.upper, domain.lower, states)


@dataclass(frozen=True)
class Extent:
    """The box around the consistent states that were found, (4,) each; `rounds` it took, and whether it had stopped growing."""

    lower: Floats
    upper: Floats
    rounds: int
    converged: bool

    @property
    def half_widths(self) -> Floats:
        """Half of the extent, (4,)."""
        return (self.upper - self.lower) / 2


class Sampler:
    """Searches the states of a scene's domain that a frame allows. `witnesses`: the frame, dilated by the tolerance."""

    def __init__(self, scene: Scene, witnesses: Bits, budget: int, start: Floats, rng: np.random.Generator) -> None:
        """`start`, (4,): a consistent state. Raises ValueError if it is not."""
        self._scene, self._dark, self._budget, self._rng = scene, DarkPixels.of(witnesses), budget, rng
        self._line = LineCoordinates.around(scene, start[:4])
        self._free = np.flatnonzero(scene.domain.lower < scene.domain.upper)
        if len(self._allowed(start[None])) == 0:
            raise ValueError("start: the frame or the domain does not allow it; give a state that they do")
        self.states = start[None]
        """Those kept, (n, 4): all allowed."""

    def extent(self) -> Extent:
        """Samples until the extent grows no more."""
        lower, upper = self.states[0], self.states[0]
        still, rounds = 0, 0
        while still < ROUNDS_WITHOUT and rounds < MOST_ROUNDS:
            for _ in range(GENERATIONS):
                self.states = self._kept(np.concatenate([self.states, self._tried()]))
            before = upper - lower
            lower, upper = self.states.min(axis=0), self.states.max(axis=0)
            rounds += 1
            still = 0 if (upper - lower > (1 + ENOUGH) * before)[:4].any() else still + 1
        return Extent(lower, upper, rounds, still == ROUNDS_WITHOUT)

    def _tried(self) -> Floats:
        """The allowed ones of the states that some steps lead to."""
        known, rng = self._line.of(self.states), self._rng
        start, one, other = rng.integers(len(known), size=(3, STEPS))
        share = np.exp(rng.uniform(np.log(SMALLEST_STEP), np.log(LARGEST_STEP), (STEPS, 1)))
        at_random = np.exp(rng.uniform(np.log(RANDOM_PX[0]), np.log(RANDOM_PX[1]), (STEPS, 1))) * rng.normal(size=(STEPS, 4))
        farthest_m = np.abs(self._scene.runway.x_m - self.states[0, 1]).max()
        at_random /= [farthest_m, farthest_m, 1, 1]
        step = np.where(rng.random((STEPS, 1)) < 0.8, share * (known[one] - known[other]), at_random)
        states = self._line.states(known[start] + step)
        leap = rng.random(STEPS) < LEAPS  # the same lines at any distance: parts that lie apart, where ends fall on other missed pixels
        domain = self._scene.domain
        states[leap] = self.states[start[leap]]
        states[leap, 3] = rng.uniform(domain.lower[3], domain.upper[3], int(leap.sum()))
        return states[self._allowed(states)]

    def _allowed(self, states: Floats) -> Integers:
        """Numbers of the states that lie in the domain and lack no more lit pixels than the budget."""
        inside = np.flatnonzero(self._scene.domain.contains(states))
        return inside[self._dark.missed(self._scene, states[inside]) <= self._budget]

    def _kept(self, states: Floats) -> Floats:
        """The most extreme states on each side of each axis, and some others."""
        order = np.argsort(states[:, self._free], axis=0, kind="stable")
        chosen = [order[:EXTREME].ravel(), order[-EXTREME:].ravel()]
        if len(states) > COMMON:
            chosen.append(self._rng.integers(len(states), size=COMMON))
        else:
            chosen.append(np.arange(len(states)))
        return states[np.unique(np.concatenate(chosen))]

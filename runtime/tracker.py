"""A certificate over time: each frame is read within what the frames before it leave possible (docs/guarantee.md, Theorem D).

If the state lay in B at the last frame and has moved by a displacement in D since, it lies in B + D, a prior for this frame (Theorem C). So
every box holds the state while the frames' assumptions and the motion's bounds hold. What is passed on are slices of theta with their
scales (`runtime.refine.slices`), not the box, which forgets that pitch and altitude compensate each other.

A chain is as good as its worst frame. With a *horizon* of N, a box rests on the last N frames alone. With q *outliers*, it holds even if q
of these break their assumptions: the state then lies in all but q of what the frames, each by itself, leave possible now.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from runtime.assumptions import prior_assumption
from runtime.attitude import Attitude
from runtime.estimate import Box, Estimate, Outcome
from runtime.estimator import Estimator, Found
from runtime.motion import STANDSTILL, Displacement, Motion, instant, moved_box, moved_each, with_pitches
from runtime.refine.refiner import joined
from runtime.refine.slices import all_but, covering, slice_edges, sliced, sliced_each, within
from runtime.state_set import StateSet

NO_YAW = 0.0, 0.0


@dataclass(frozen=True)
class Seen:
    """What an earlier frame left possible at its instant, in slices of theta, and how far the state can have moved since."""

    sets: StateSet
    since: Displacement
    yaw: tuple[float, float] = NO_YAW
    """Of the camera then: where it was yawed, theta of the sets is the pitch that the ideal frame showed (`runtime.attitude`)."""

    def later(self, step: Displacement) -> Seen:
        """The same after another displacement."""
        return replace(self, since=self.since + step)


class Tracker:
    """Follows an aircraft from frame to frame. Not thread-safe, as its `Estimator` is not.

    `motion`: bounds on the state's rates, by default the scene's [motion]. `horizon`: a box rests on the last so many frames alone; by
    default on all since the first, or since the last contradiction. `outliers`: a box holds if at most so many of them break their
    assumptions. Raises ValueError for a model whose scene has no [motion] where none is given, a horizon below 1, and outliers without
    a horizon or as many as that.
    """

    def __init__(self, estimator: Estimator, motion: Motion | None = None, horizon: int | None = None, outliers: int = 0) -> None:
        bounds = motion or Motion.of(estimator.scene)
        if bounds is None:
            raise ValueError("motion: none is given and the model's scene has no [motion]; give Motion(rate_lower, rate_upper)")
        if horizon is not None and horizon < 1:
            raise ValueError(f"horizon: found {horizon}; give 1 frame or more, or None")
        if outliers < 0 or (outliers > 0 and (horizon is None or outliers >= horizon)):
            lasts = "no horizon" if horizon is None else f"a horizon of {horizon}"
            raise ValueError(f"outliers: found {outliers} with {lasts}; give 0, or fewer than the frames of a horizon")
        self.estimator, self.motion, self.horizon, self.outliers = estimator, bounds, horizon, outliers
        self._camera, self._domain = estimator.ideal.camera, estimator.domain
        self.late = 0
        """Frames that came after a later one, and so were not followed."""
        self.reset()

    def reset(self) -> None:
        """Forgets all frames; the next one is read by itself."""
        self._earlier: tuple[Seen, ...] = ()
        self._latest: tuple[Box, Displacement] | None = None
        self._time_us: int | Fraction | None = None
        self._first_us: int | Fraction | None = None
        self._attitude: Attitude | None = None

    def update(
        self,
        frame: NDArray,
        time_us: float,
        prior: Box | None = None,
        displacement: Mapping[str, tuple[float, float]] | None = None,
        attitude: Attitude | None = None,
    ) -> Estimate:
        """State and certified box of the next frame, whose instant is `time_us`.

        `prior`: a box that is known to hold the state now. `displacement`: bounds on how far the state has moved since the last update
        that was not late, by axis: {"theta": (low, high)}; axes that are not named follow the motion. `attitude`: of the camera now, by
        default the scene's. Where frame, prior and the frames
        before contradict each other, the outcome is INCONSISTENT, and the tracker goes on from this frame alone. Nothing rests on a frame
        in which no state fits by itself; the displacement told with it counts. A frame older than the last one is estimated by itself and
        counted in `late`: after a time that was wrong, and far ahead, every frame is, until `reset`. Raises `FrameError` as
        `Estimator.estimate` does, and ValueError for a time that is not finite and for a displacement of another axis, or of bounds that
        are not ordered; the tracker is then as it was before, and the displacement told next is since the update before.
        """
        now_us, told, attitude = instant(time_us), attitude, self.estimator.known_attitude(attitude)
        step = self._step(now_us, displacement)
        if step is None:
            self.late += 1
            return self.estimator.estimate(frame, prior=prior, attitude=told)
        found = self.estimator.find(frame, attitude)
        self._time_us, self._attitude = now_us, attitude
        self._earlier = tuple(seen.later(step) for seen in self._earlier)
        self._latest = None if self._latest is None else (self._latest[0], self._latest[1] + step)
        left, seen = self._left(found, prior)
        return self._followed(found, left, seen, prior) if len(left) else self._contradicted(found, prior)

    def box_at(self, time_us: float) -> Box | None:
        """The box that the state lies in at another instant, by the last certified box and the motion; None where nothing is known.

        Raises ValueError for a time that is not finite.
        """
        other_us = instant(time_us)
        if self._latest is None or self._time_us is None:
            return None
        box, since = self._latest
        lower, upper = moved_box(box.lower, box.upper, since + self.motion.over(float(other_us - self._time_us)))
        return Box(lower, upper) if np.isfinite(lower).all() and np.isfinite(upper).all() else None

    def _step(self, now_us: int | Fraction, displacement: Mapping[str, tuple[float, float]] | None) -> Displacement | None:
        """How far the state can have moved since the last frame; None if this one is older."""
        elapsed_us = 0.0 if self._time_us is None else float(now_us - self._time_us)
        step = self.motion.over(max(elapsed_us, 0)).replaced(displacement or {})
        return step if elapsed_us >= 0 else None

    def _left(self, found: Found, prior: Box | None) -> tuple[StateSet, StateSet]:
        """The sets of states that this frame and the earlier ones leave, and what is passed on of this frame."""
        if not self._earlier and self.outliers == 0:
            left = self._read(found, None, prior)
            return left, left
        held = self._held()
        if self.horizon is None:
            left = self._read(found, held[-1], prior)
            return left, left
        alone = self._read(found, None, prior)
        left = self.estimator.left_of(found, within(self._camera, held[-1], alone))
        if self.outliers == 0:
            return left, alone
        others = held[-2] if found.turned is None else found.turned.of(held[-2])
        return joined(left, others), alone  # if this frame is one of the outliers, what one fewer of the others leave

    def _read(self, found: Found, known: StateSet | None, prior: Box | None) -> StateSet:
        """What is consistent with the frame and lies within the `known` sets and the prior."""
        if prior is not None:
            here = self.estimator.covering(prior, self._attitude)
            known = here if known is None else within(self._camera, known, here)
        return self.estimator.left_of(found, known)

    def _held(self) -> list[StateSet]:
        """For q = 0 to `outliers`: the states of the domain that lie in what all but q of the earlier frames leave possible now."""
        unions = [seen.sets for seen in self._earlier]
        parts = moved_each(self._camera, unions, [self._moved_by(seen) for seen in self._earlier], self._domain)
        if len(parts) == 1 and self.outliers == 0:
            return parts
        whole = covering(self._camera, self._domain, self._camera.v0)
        theta = whole.theta
        if len(parts) > self.outliers:  # each end of theta as all but `outliers` of the parts allow it
            lows = sorted(part.theta[:, 0].min(initial=np.inf) for part in parts)
            highs = sorted(part.theta[:, 1].max(initial=-np.inf) for part in parts)
            theta = np.array([[lows[-1 - self.outliers], highs[self.outliers]]])
        if theta[0, 0] > theta[0, 1]:
            return [whole[:0]] * (self.outliers + 1)
        edges = slice_edges(theta)
        tangent = max((float(np.median(part.tangent)) for part in parts if len(part)), default=float(whole.tangent[0]))
        start, *sources = sliced_each(self._camera, [whole, *parts], edges, tangent)
        return [sets[~sets.empty] for sets in all_but(sources, start, self.outliers)]

    def _moved_by(self, seen: Seen) -> Displacement:
        """How far the states of an earlier frame have moved, by the pitch that the ideal frame shows then and now."""
        yaw = NO_YAW if self._attitude is None else self._attitude.yaw
        return seen.since if (seen.yaw, yaw) == (NO_YAW, NO_YAW) else with_pitches(seen.sets, seen.since, seen.yaw, yaw)

    def _followed(self, found: Found, left: StateSet, seen: StateSet, prior: Box | None) -> Estimate:
        """The estimate of what is left; this frame is one of the earlier ones from now on."""
        earlier = () if self.horizon is None else self._earlier[max(len(self._earlier) + 2 - self.horizon, 0) :]
        kept = self.horizon is None or self.horizon > 1
        self._earlier = (*earlier, self._passed_on(seen)) if kept else ()
        self._first_us = self._time_us if self._first_us is None else self._first_us
        estimate = self.estimator.concluded(found, self.estimator.regions(found, left), self._assumed(found, prior), left=left)
        assert estimate.box is not None
        self._latest = estimate.box, STANDSTILL
        return estimate

    def _contradicted(self, found: Found, prior: Box | None) -> Estimate:
        """The estimate of a frame that the earlier ones or the prior contradict, or in which no state fits; what is wrong is forgotten."""
        assumed, alone = self._assumed(found, prior), self.estimator.left_of(found)
        if len(alone) == 0 and self.outliers == 0:
            return self.estimator.concluded(found, (), assumed)
        time_us, attitude = self._time_us, self._attitude
        self.reset()
        self._time_us, self._attitude = time_us, attitude
        if len(alone) == 0:
            return self.estimator.concluded(found, (), assumed)
        self._first_us = time_us
        if self.horizon != 1:
            self._earlier = (self._passed_on(alone),)
        if self.outliers == 0:
            self._latest = self.estimator.regions(found, alone, [np.arange(len(alone))])[0], STANDSTILL
        return self.estimator.concluded(found, (), assumed, Outcome.INCONSISTENT)

    def _passed_on(self, sets: StateSet) -> Seen:
        """What a frame leaves, in slices of theta, at its instant."""
        yaw = NO_YAW if self._attitude is None else self._attitude.yaw
        if len(sets) == 0:
            return Seen(replace(sets, roll=None, yaw=None), STANDSTILL, yaw)
        slices = sliced(self._camera, sets, slice_edges(sets.theta), float(np.median(sets.tangent)))
        return Seen(slices[~slices.empty], STANDSTILL, yaw)

    def _assumed(self, found: Found, prior: Box | None) -> tuple[str, ...]:
        """What a box rests on, in words."""
        frames = "every frame that was followed" if self.horizon is None else f"each of the last {self.horizon} frames"
        if self.outliers:
            frames = f"of the last {self.horizon} frames all but {self.outliers} at most"
        since = "" if self._first_us is None else f" since {float(self._first_us):.16g} us"
        own = (f"Over time: this holds of {frames}{since}, and the state moves by {self.motion}, or as told.",)
        return (*self.estimator.assumed_of(found), *(() if prior is None else (prior_assumption(prior.lower, prior.upper),)), *own)

"""One frame of a drawn scene, estimated with refinement and without under a watchdog, and judged against its truth."""

from __future__ import annotations

import gc
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from coverage.judge import Judged, faults_of, judged_states
from coverage.states import estimator_of

from random_scenes.frames import DrawnFrame
from random_scenes.models import BuiltScene
from random_scenes.outcomes import Finding
from random_scenes.watch import OutOfTimeError, described, raised_in, watched
from runtime import Estimate

SLOW_RATIO, SLOW_SECONDS = 100, 1.0
"""A frame is too slow if it takes this many times its scene's median, and this long."""
NARROWER = 1 - 1e-6
"""A box is narrower than another if an axis has less than this share of its width."""
OUTER_PART = 0.1
"""The outer part of a box on one side, as a share of its width, in which a state shows that the box is no wider than it must be."""


@dataclass
class FrameTrial:
    """A frame, and what came of it: `numbers` for the counts of its kinds, findings, and seconds of the slower estimate."""

    built: BuiltScene
    frame: DrawnFrame
    number: int
    numbers: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    """Why the estimator refuses what the frame asks of it: none of a level camera's."""
    seconds: float = 0.0
    endless: bool = False

    def run(self, patience_s: float) -> None:
        """Judges the frame's two estimates."""
        picture, extreme = self.frame.picture, self.frame.extreme
        judged = self.judged()
        boxes = []
        for refine in self.refinements:
            estimate = self.estimated(refine, patience_s)
            if estimate is None:
                continue
            for fault, state in faults_of(picture, judged, estimate):
                self.find(f"{'refined' if refine else 'unrefined'}: {kind_of(fault)}", f"{fault}; state {state}")
            boxes += [] if estimate.box is None else [estimate.box]
        self.numbers.update(frames=1, judged=len(judged), findings=len(self.findings))
        if len(boxes) == len(self.refinements):
            narrower = (boxes[0].half_widths < NARROWER * boxes[-1].half_widths).any()
            self.numbers.update(certified=1, narrower=int(narrower))
            if extreme is not None and any(each.state is extreme.state for each in judged):
                self.numbers.update(extremes=1, reached=int(extreme.in_outer_part(boxes[0], OUTER_PART)))

    @property
    def alike(self) -> str:
        """Frames of a scene with the same are alike in what they take, but for the frame."""
        return ""

    @property
    def refinements(self) -> tuple[bool, ...]:
        """With refinement, and without."""
        return True, False

    def estimate(self, refine: bool) -> Estimate:
        """The frame's estimate."""
        return estimator_of(str(self.built.path), *self.frame.budgets).estimate(self.frame.picture.frame, refine=refine)

    def judged(self) -> list[Judged]:
        """The states that the box must hold."""
        return judged_states(self.frame.picture, *self.frame.budgets, True)

    def estimated(self, refine: bool, patience_s: float) -> Estimate | None:
        """The estimate; None, and a finding, where there is none in time."""
        start = time.process_time()
        try:
            with watched(patience_s):
                estimator_of(str(self.built.path), *self.frame.budgets)  # loaded before the clock starts
                start = time.process_time()
                return self.estimate(refine)
        except OutOfTimeError as error:
            self.endless = True
            self.find("a frame does not end", f"in {patience_s:g} s, then at {'{}:{}'.format(*raised_in(error))}, refine={refine}")
        except Exception as error:
            self.find(f"{type(error).__name__} in {raised_in(error)[0]}", f"{described(error)}, refine={refine}")
        finally:
            self.seconds = max(self.seconds, time.process_time() - start)
        gc.collect()  # the exception and its frames, which hold the arrays of what took too much memory, refer to each other
        return None

    def find(self, fault: str, detail: str) -> None:
        """Adds a finding at this frame."""
        place = f"{self.built.place}#{self.number}"
        self.findings.append(Finding(place, fault, f"{detail}; m, e = {self.frame.budgets}", self.frame.kinds))


def find_slow(trials: Sequence[FrameTrial]) -> None:
    """Adds a finding to each frame that took far longer than the others of its scene that are alike, though it ended."""
    for alike in sorted({trial.alike for trial in trials}):
        ended = [trial for trial in trials if not trial.endless and trial.alike == alike]
        median = statistics.median(trial.seconds for trial in ended) if ended else 0.0
        for trial in ended:
            if trial.seconds > max(SLOW_RATIO * median, SLOW_SECONDS):
                trial.find("a frame is slow", f"{trial.seconds:.2f} s; the median of its scene is {median:.4f} s")


def kind_of(fault: str) -> str:
    """A fault without its numbers."""
    return "a state is not in the box" if fault.startswith("not in the box") else "filtered lacks pixels" if "lacks" in fault else fault

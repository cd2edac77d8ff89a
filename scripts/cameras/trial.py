"""One drawn camera put to the test: the model of its scene built, and frames of it judged, most of them with an attitude.

What counts as a finding is said in `random_scenes.trial`. A frame that the estimator refuses is counted with the reason.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from coverage.judge import Judged, extra_pixels
from coverage.states import estimator_of, image_of
from random_scenes.frame_trial import FrameTrial
from random_scenes.models import BuiltScene, build_scene
from random_scenes.scenes import DrawnScene
from random_scenes.trial import LONG_PATIENCE, Trial
from random_scenes.watch import watched

from cameras.attitudes import EXACTLY_KNOWN, KNOWN
from cameras.bases import draw_base, named_scenes
from cameras.frames import TurnedFrame, draw_frame
from cameras.scenes import draw_camera
from runtime import Estimate, Estimator

REFUSAL = "attitude: found "
"""How the estimator's refusals of an attitude begin."""


@dataclass
class CameraFrameTrial(FrameTrial):
    """A frame, estimated with what is told of its camera."""

    @property
    def turned(self) -> TurnedFrame:
        """The frame."""
        assert isinstance(self.frame, TurnedFrame)
        return self.frame

    @property
    def alike(self) -> str:
        """How well the attitude is known: a plus-minus is cut, and NN_F run again and again."""
        return self.turned.told.kinds[0]

    @property
    def refinements(self) -> tuple[bool, ...]:
        """As drawn."""
        return self.turned.refine

    @property
    def estimator(self) -> Estimator:
        """The model, with the frame's budget."""
        return estimator_of(str(self.built.path), *self.frame.budgets)

    def run(self, patience_s: float) -> None:
        """Judges the frame's estimates, unless it is refused."""
        super().run(patience_s)
        if self.refusals:
            self.numbers = Counter(frames=1, refused=1)

    def estimate(self, refine: bool) -> Estimate:
        """The frame's estimate."""
        told = self.turned.told
        return self.estimator.estimate(self.frame.picture.frame, refine=refine, prior=told.prior, attitude=told.attitude)

    def judged(self) -> list[Judged]:
        """The states of the frame's sights that lie in the domain, are as is told, and lack no more pixels than the budget.

        Where nothing is told of the attitude, there may be no more extra pixels than under Theorem B either.
        """
        picture, told, (missed, extra) = self.frame.picture, self.turned.told, self.frame.budgets
        vouched = extra >= 0 and self.estimator.known_attitude(told.attitude) is None
        judged = []
        for sight in self.turned.sights:
            state, image = sight.state, image_of(sight.view, sight.state.seen)
            allowed = picture.stage.unwitnessed(image_of(sight.counted, sight.state.seen), picture.frame) <= missed
            if not (allowed and picture.stage.contains(state.seen) and told.holds(state, self.estimator)):
                continue
            if not vouched or extra_pixels(picture, state.seen) <= extra:
                judged.append(Judged(state, image.frame & picture.frame))
        return judged

    def find(self, fault: str, detail: str) -> None:
        """Adds a finding at this frame, or the reason of a refusal."""
        if fault.startswith("ValueError") and REFUSAL in detail:
            self.refusals = [reason_of(detail)]
        else:
            super().find(fault, detail)


def reason_of(detail: str) -> str:
    """What an attitude was refused for, without its numbers."""
    found = detail.partition(REFUSAL)[2].partition(";")[0]
    return "attitude: " + "".join(sign for sign in found if not sign.isdigit()).replace("  ", " ").strip()


@dataclass(frozen=True)
class CameraTrial(Trial):
    """Camera number `scene` of a campaign, and how many frames of it are judged. `files`: the scenes, by default `named_scenes`'s.

    `exactly`: the camera and its attitude are told exactly.
    """

    files: tuple[str, ...] = ()
    exactly: bool = False

    @property
    def key(self) -> tuple[str | int, ...]:
        """What the outcomes are found again by."""
        return (*super().key, self.exactly, *(os.path.abspath(path) for path in self.files))

    def built(self, draw: int, path: Path) -> BuiltScene:
        """A draw's model. Raises `SceneError` where it is refused."""
        rng = np.random.default_rng([self.seed, self.scene, draw])
        with watched(LONG_PATIENCE * self.patience_s):
            # the scene is the same for all draws, but for a random one, so that no kind of scene is left out for a kind of camera
            base = np.random.default_rng([self.seed, self.scene])
            scene, kinds = draw_base(base, rng, named_scenes([Path(file) for file in self.files]))
            camera = draw_camera(rng, scene, self.exactly)
            return build_scene(DrawnScene(camera.scene, (*kinds, *camera.kinds)), path, self.place(draw))

    def frame_trial(self, built: BuiltScene, number: int) -> CameraFrameTrial:
        """Frame number `number` of a built scene, drawn."""
        rng = np.random.default_rng([self.seed, self.scene, number])
        shares = EXACTLY_KNOWN if self.exactly else KNOWN
        frame = draw_frame(rng, built.stage, lambda missed: estimator_of(str(built.path), missed, -1), shares)
        return CameraFrameTrial(built, replace(frame, kinds=(*built.drawn.kinds, *frame.kinds)), number)

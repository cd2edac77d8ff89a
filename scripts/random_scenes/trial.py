"""One drawn scene put to the test: its model built, and frames of it judged (`random_scenes.frame_trial`).

What counts as a finding: a state that a box must hold and does not, a lit pixel of the runway that `filtered` loses, an exception or a
warning, a frame that does not end in time or takes a hundred times as long as its scene's others, a build that fails other than by a
`SceneError`, and a model that `verify-model` does not prove. A scene that the build refuses is drawn anew, and counted.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from build_model.verify.proof import verify_model
from random_scenes.frame_trial import FrameTrial, find_slow
from random_scenes.frames import draw_budgets, draw_frame
from random_scenes.models import BuiltScene, build_scene
from random_scenes.outcomes import Finding, Outcomes
from random_scenes.scenes import draw_scene
from random_scenes.watch import OutOfTimeError, described, watched
from runtime import SceneError

MOST_ENDLESS = 2
"""After so many frames without end the scene's others are left out."""
MOST_FINDINGS = 20
"""Findings of one scene that are written down."""
PROVED_EVERY = 50
"""Every so many scenes, `verify-model` proves the model."""
LONG_PATIENCE = 20
"""How many times the patience with a frame the build and the proof of a model are given."""


@dataclass(frozen=True)
class Trial:
    """Scene number `scene` of a campaign, and how many frames of it are judged. `patience_s` is what a frame may take."""

    seed: int
    scene: int
    frames: int
    patience_s: float
    version: str = ""
    """Of the code, for the journal."""

    @property
    def key(self) -> tuple[str | int, ...]:
        """What the outcomes are found again by."""
        return self.version, self.seed, self.scene, self.frames

    def run(self) -> Outcomes:
        """Builds the first draw that is not refused, and judges its frames."""
        outcomes = Outcomes()
        with tempfile.TemporaryDirectory() as folder:
            built = self.first_built(Path(folder) / "model.onnx", outcomes)
            if built is not None:
                self.judge_frames(built, range(self.frames), outcomes)
                if (self.scene + 1) % PROVED_EVERY == 0:
                    self.prove(built, outcomes)
        return outcomes

    def first_built(self, path: Path, outcomes: Outcomes) -> BuiltScene | None:
        """The first draw whose model is built; None if a build fails in a way that is no refusal, which is a finding."""
        draw = 0
        while True:
            try:
                return self.built(draw, path)
            except SceneError as error:
                outcomes.refused[refusal(error)] += 1
            except OutOfTimeError:
                outcomes.refused["the build takes too long"] += 1
            except MemoryError:
                outcomes.refused["the build takes too much memory"] += 1
            except Exception as error:
                outcomes.findings.append(Finding(self.place(draw), "the build fails", described(error), ()))
                return None
            draw += 1

    def built(self, draw: int, path: Path) -> BuiltScene:
        """A draw's model. Raises `SceneError` where it is refused."""
        with watched(LONG_PATIENCE * self.patience_s):
            return build_scene(draw_scene(np.random.default_rng([self.seed, self.scene, draw])), path, self.place(draw))

    def place(self, draw: int) -> str:
        """The scene as `--replay` takes it; `draw` draws before it were refused."""
        return f"{self.seed}/{self.scene}.{draw}"

    def judge_frames(self, built: BuiltScene, numbers: Iterable[int], outcomes: Outcomes, keep: Path | None = None) -> None:
        """Judges frames of a built scene, and compares their times; keeps the frames in a folder if one is given."""
        outcomes.count(built.drawn.kinds, Counter(scenes=1))
        trials: list[FrameTrial] = []
        for number in numbers:
            try:
                trial = self.frame_trial(built, number)
            except Exception as error:  # a fault of the campaign, which is not to end it unseen
                outcomes.findings.append(Finding(f"{built.place}#{number}", "a frame cannot be drawn", described(error), built.drawn.kinds))
                continue
            if keep is not None:
                np.save(keep / f"replayed-{number}.npy", trial.frame.picture.frame)
            trials.append(trial)
            trial.run(self.patience_s)
            if sum(trial.endless for trial in trials) == MOST_ENDLESS:
                break
        find_slow(trials)
        for trial in trials:
            outcomes.count(trial.frame.kinds, trial.numbers)
            outcomes.refused.update(trial.refusals)
            outcomes.findings += trial.findings
        outcomes.findings = outcomes.findings[:MOST_FINDINGS]

    def frame_trial(self, built: BuiltScene, number: int) -> FrameTrial:
        """Frame number `number` of a built scene, drawn."""
        budgets = draw_budgets(np.random.default_rng([self.seed, self.scene]), built)
        frame = draw_frame(np.random.default_rng([self.seed, self.scene, number]), built, budgets)
        return FrameTrial(built, frame, number)

    def prove(self, built: BuiltScene, outcomes: Outcomes) -> None:
        """Has `verify-model` prove a model, and counts it under the outcome."""
        fault = None
        try:
            with watched(LONG_PATIENCE * self.patience_s):
                report = verify_model(built.path)
            if not report.proved:
                fault = "verify-model refutes a model", str(report.counterexample)
        except OutOfTimeError:
            outcomes.count(("proof takes too long",), Counter(scenes=1))
            return
        except Exception as error:
            fault = "verify-model fails", described(error)
        if fault is None:
            outcomes.count(("proved",), Counter(scenes=1))
        else:
            outcomes.findings.append(Finding(built.place, *fault, built.drawn.kinds))


def refusal(error: SceneError) -> str:
    """Which check refused a scene: the key, and what it is told to do."""
    key, _, rest = str(error).partition(":")
    return f"{key.split(' ')[0]}: {rest.rpartition(';')[2].strip()}"

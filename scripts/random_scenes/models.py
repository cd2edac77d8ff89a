"""The models of drawn scenes: built without training, and forgotten when their scene is done."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from coverage.frames import bank_of
from coverage.states import Stage, estimator_of, image_of, spatial_mask

from build_model.export import export_model
from build_model.user_network import NO_ESTIMATOR
from random_scenes.scenes import DrawnScene


@dataclass(frozen=True)
class BuiltScene:
    """A scene and its model's file. `place`: the scene as `--replay` takes it."""

    drawn: DrawnScene
    path: Path
    place: str

    @property
    def stage(self) -> Stage:
        """What states and frames are drawn for."""
        return Stage.of(str(self.path), None)

    @property
    def most_missed(self) -> int:
        """The largest m that the model can be loaded with."""
        return int(estimator_of(str(self.path)).metadata["smallest_must_light"]) - 1


def build_scene(drawn: DrawnScene, path: Path, place: str) -> BuiltScene:
    """Writes a scene's model to `path`. Raises `SceneError` where the build refuses it."""
    forget_scenes()
    export_model(drawn.scene, path, estimator=NO_ESTIMATOR)
    return BuiltScene(drawn, path, place)


def forget_scenes() -> None:
    """Empties what is kept of models, images and masks by their path: a campaign has too many scenes to keep them."""
    for kept in (Stage.of, estimator_of, spatial_mask, bank_of, image_of):
        kept.cache_clear()

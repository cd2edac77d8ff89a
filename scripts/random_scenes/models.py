"""The models of drawn scenes: built without training, and forgotten when their scene is done."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from coverage.frames import bank_of
from coverage.states import Stage, estimator_of, image_of, spatial_mask
from onnx import TensorProto, helper, numpy_helper

from build_model.export import export_model
from random_scenes.scenes import DrawnScene
from runtime import Scene

OPSET, IR_VERSION = 20, 10
"""Of the constant network, which the export converts to its own."""


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
    network = path.with_name("constant.onnx")
    write_constant_network(drawn.scene, network)
    export_model(drawn.scene, path, estimator=network)
    return BuiltScene(drawn, path, place)


def forget_scenes() -> None:
    """Empties what is kept of models, images and masks by their path: a campaign has too many scenes to keep them."""
    for kept in (Stage.of, estimator_of, spatial_mask, bank_of, image_of):
        kept.cache_clear()


def write_constant_network(scene: Scene, path: Path) -> None:
    """An NN_e that answers with the domain's centre whatever it is shown: nothing is trained."""
    centre = ((scene.domain.lower + scene.domain.upper) / 2).astype(np.float32)
    nodes = [
        helper.make_node("GlobalAveragePool", ["image"], ["mean"]),
        helper.make_node("Flatten", ["mean"], ["flat"]),
        helper.make_node("Gemm", ["flat", "weights", "centre"], ["state"]),
    ]
    constants = [numpy_helper.from_array(np.zeros((1, 4), dtype=np.float32), "weights"), numpy_helper.from_array(centre, "centre")]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, *scene.camera.shape])
    state = helper.make_tensor_value_info("state", TensorProto.FLOAT, [1, 4])
    graph = helper.make_graph(nodes, "constant", [image], [state], constants)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION), path)

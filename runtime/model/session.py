"""A model's graph in onnxruntime: how it is opened, and what goes in and comes out of it."""

from __future__ import annotations

import onnxruntime

from runtime.errors import one_line
from runtime.model.format import BUDGETS, FRAME, OUTPUTS, OVERFLOW, ModelError
from runtime.scene import Scene, WindowedBank

LOG_FATAL_ONLY = 4


def open_session(content: bytes, name: str, threads: int) -> onnxruntime.InferenceSession:
    """The file's graph, ready to run on the CPU. Raises `ModelError` if onnxruntime cannot load it."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = LOG_FATAL_ONLY  # otherwise it warns of the budgets; and an error becomes an exception below
    options.add_session_config_entry("session.strict_shape_type_inference", "1")  # declared shapes are then true ones
    try:
        # Folding constants would run operators of the file as it is loaded; on our graphs it saves nothing.
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"], disabled_optimizers=["ConstantFolding"])
    except Exception as error:  # onnxruntime raises classes of its own that share only this one
        raise ModelError(f"{name}: onnxruntime {onnxruntime.__version__} cannot load it ({reason_of(error)})") from error


def outputs_of(scene: Scene) -> tuple[str, ...]:
    """Names of a model's outputs, in the order in which `Estimator.run` gives them."""
    return (*OUTPUTS, OVERFLOW) if isinstance(scene.bank, WindowedBank) else OUTPUTS


def check_interface(session: onnxruntime.InferenceSession, scene: Scene, entries: tuple[int, ...], name: str) -> None:
    """Inputs and outputs are those of models/README.md, for the scene's frame and cells. Raises `ModelError`."""
    cells, frame = scene.domain.cell_count, list(scene.camera.shape)
    shapes = {"cell": [], "support": [cells], "mismatch": [cells], "passes": list(entries), "filtered": frame, "network_state": [4]}
    shapes |= {"cell_lower": [cells, 4], "cell_upper": [cells, 4], OVERFLOW: []}
    types = {"cell": "int64", "support": "int32", "mismatch": "int32", "passes": "bool", "filtered": "uint8", OVERFLOW: "bool"}
    expected = {
        "inputs": [(FRAME, "tensor(uint8)", frame)],
        "budgets": [(budget, "tensor(int32)", []) for budget in sorted(BUDGETS)],
        "outputs": [(output, f"tensor({types.get(output, 'float')})", shapes[output]) for output in sorted(outputs_of(scene))],
    }
    for kind, values in zip(expected, (session.get_inputs(), session.get_overridable_initializers(), session.get_outputs()), strict=True):
        found = sorted((value.name, value.type, value.shape) for value in values)
        if found != expected[kind]:
            raise ModelError(f"{name}: its {kind} are {found!s:.200}, its scene asks for {expected[kind]}; export it again")


def reason_of(error: Exception) -> str:
    """An error of onnxruntime's on one line."""
    return one_line(error)[:200]

"""verify-model: proves a model file's certificate anew, from the file's own tensors and the scene in its metadata.

What is proved, and by what arithmetic:

    cells      are those of the scene's domain: exact fractions, and balls for the altitudes of a glide (`build_model.verify.cell_boxes`)
    graph      NN_F is, node by node and bit by bit, the graph of the tables in the file (`build_model.verify.model_graph`); and on frames
               drawn at random, onnxruntime's outputs are those that the masks define, counted pixel by pixel: integers
    boxes      of states, scales and reference rows are what the refinement takes for granted (`build_model.verify.box_claims`)
    sizes      |K|, its least value, the budgets' defaults and the stated assumptions agree: integers
    masks, boxes and cover of every cell (`build_model.verify.cell_proof`): Arb's balls of 64 bits, from the plain camera equations
    lens       does not fold within the frame, NN_F is that of a pinhole with the sensor's focal lengths, and the rays of the corners of
               pixels, which the runtime derives from the scene, are theirs (`build_model.verify.lens_proof`): Arb's balls
    painting   of the sensor's frame covers what that shows, and of what a missed pixel shows c is a bound
               (`build_model.verify.painting_proof`): Arb's balls
    tolerance  line_px covers what the calibration can move a marking by (`build_model.verify.displacement`): Arb's balls

No mask, bound or rounding of the build is used; shared with it are the scene's reader and the writer of the expected graph.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import joblib
import numpy as np
import onnx
from google.protobuf.message import DecodeError

from build_model.filter_tables import BankTables, FilterTables, WindowTables
from build_model.partition import Partition
from build_model.verify.box_claims import check_boxes, demand_of_all
from build_model.verify.cell_boxes import cell_boxes
from build_model.verify.cell_claim import cell_claims
from build_model.verify.cell_proof import CellProof, prove_cell
from build_model.verify.counterexample import Counterexample, Refuted, demand
from build_model.verify.displacement import displacement_px
from build_model.verify.lens_proof import check_lens, check_rays
from build_model.verify.model_graph import check_graph, read_tables
from build_model.verify.outputs import check_outputs
from build_model.verify.painting_proof import check_painting
from build_model.verify.window_claim import window_claims
from build_model.verify.window_proof import prove_windows
from runtime.assumptions import assumptions
from runtime.errors import one_line
from runtime.ideal import ideal_scene
from runtime.model.format import METADATA_KEY, PADDING_SIZE, ModelError
from runtime.model.model_file import parse_model
from runtime.painting import Painting
from runtime.refine.optics import Optics
from runtime.scene import Calibration, Camera, Scene, SceneError
from runtime.sensor_map import SensorMap

Progress = Callable[[int, int], None]
"""Called with cells proved and cells in all."""


@dataclass(frozen=True)
class VerificationReport:
    """What was proved. `counterexample` is the first claim that does not hold; None if the whole certificate is proved."""

    cells: int
    entries: int
    spatial_pixels: int
    may_light_pixels: int
    must_light_pixels: int
    windows: int
    margin_px: float
    """Least distance, px, by which a bound on a column keeps from the border that it must not reach."""
    displacement_px: float
    """Bound on what the calibration can move a marking by."""
    corners: int
    """Corners of the sensor's pixels whose rays are proved; 0 without a lens."""
    painted_pixels: int
    """Pixels of the ideal frame of which is proved that they are painted where the sensor shows the runway in them."""
    seconds: float
    sha256: str
    counterexample: Counterexample | None

    @property
    def proved(self) -> bool:
        """True if every claim was proved."""
        return self.counterexample is None


def _silent(_done: int, _total: int) -> None:
    pass


def verify_model(path: str | Path, jobs: int = 1, progress: Progress = _silent) -> VerificationReport:
    """Proves the certificate of a model file, cell by cell with `jobs` processes.

    Raises `ModelError` for a file that cannot be read: missing, no model of ours, damaged, or with an unusable scene.
    """
    start = time.perf_counter()
    content = _content(Path(path))
    model, metadata, scene = _opened(content, str(path))
    proofs: list[CellProof] = []
    counterexample, shift_px, cells, corners, painted = None, float("nan"), 0, 0, 0
    try:
        cells = len(cell_boxes(scene))
        ideal = _ideal_of(scene, metadata)
        corners, painted = _check_sensor(scene, ideal.camera, metadata, jobs)
        tables, shift_px = _check_all_but_masks(model, metadata, ideal, assumptions(scene))
        for proof in _cell_proofs(ideal, tables, jobs):
            if isinstance(proof, Counterexample):
                raise Refuted(proof)
            proofs.append(proof)
            progress(len(proofs), cells)
        check_outputs(content, ideal, tables)
    except Refuted as refuted:
        counterexample = refuted.counterexample
    return VerificationReport(
        cells=len(proofs),
        entries=sum(proof.entries for proof in proofs),
        spatial_pixels=sum(proof.spatial_pixels for proof in proofs),
        may_light_pixels=sum(proof.may_light_pixels for proof in proofs),
        must_light_pixels=sum(proof.must_light_pixels for proof in proofs),
        windows=sum(proof.windows for proof in proofs),
        margin_px=min((proof.margin_px for proof in proofs), default=float("nan")),
        displacement_px=shift_px,
        corners=corners,
        painted_pixels=painted,
        seconds=time.perf_counter() - start,
        sha256=hashlib.sha256(content).hexdigest(),
        counterexample=counterexample,
    )


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror}); give the path of a model that export-model wrote") from error


def _opened(content: bytes, name: str) -> tuple[onnx.ModelProto, dict[str, Any], Scene]:
    """The model as onnx reads it, its metadata and scene. Raises `ModelError`."""
    metadata = parse_model(content, name).metadata
    try:
        model = onnx.load_model_from_string(content)
        onnx.checker.check_model(model)
    except (DecodeError, onnx.checker.ValidationError) as error:
        reason = one_line(error)
        raise ModelError(f"{name}: not a valid ONNX model ({reason:.160}); export it again with export-model") from error
    digest = hashlib.sha256(model.graph.SerializeToString(deterministic=True)).hexdigest()
    keys = [entry.key for entry in model.metadata_props]
    if digest != metadata["graph_sha256"] or keys != [METADATA_KEY]:
        raise ModelError(f"{name}: graph or metadata are in it more than once; export it again with export-model")
    try:
        return model, metadata, Scene.from_dict(metadata.get("scene", {}))
    except SceneError as error:
        raise ModelError(f"{name}: the scene in its metadata is unusable ({error}); export it again with export-model") from error


def _ideal_of(scene: Scene, metadata: dict[str, Any]) -> Scene:
    """The scene that NN_F is claimed to be built for: its own, or behind a lens that of the ideal frame. Raises `Refuted`."""
    stated = metadata.get("ideal_camera"), metadata.get("ideal_pixels_a_pixel")
    if scene.camera.pinhole:
        demand(stated == (None, None), "metadata: an ideal camera is stated of a scene without a lens")
        return scene
    camera, count = stated
    usable = isinstance(camera, dict) and isinstance(count, int) and not isinstance(count, bool) and count >= 1
    demand(usable, "metadata: ideal_camera or ideal_pixels_a_pixel is missing")
    try:
        ideal = ideal_scene(scene, Scene.from_dict({**scene.to_dict(), "camera": camera}).camera, cast(int, count))
    except SceneError as error:
        raise Refuted(Counterexample(f"metadata: ideal_camera is unusable ({error})")) from error
    check_lens(scene.camera, scene.calibration, ideal.camera)
    return ideal


def _check_sensor(scene: Scene, ideal: Camera, metadata: dict[str, Any], jobs: int) -> tuple[int, int]:
    """How many corners' rays and ideal pixels are proved, of the tables that the runtime derives behind a lens. Raises `Refuted`."""
    if scene.camera.pinhole:
        return 0, 0
    camera, off, sensor = scene.camera, scene.calibration, SensorMap.of(scene)
    demand(sensor.ideal == ideal, "metadata: ideal_camera is not the one that the runtime derives from the scene")
    corners = check_rays(camera, off, sensor.rays, jobs)
    for part in () if off.exact else Optics.parts_of(scene):
        s, t, away = (side.reshape(sensor.rays[0].shape) for side in part.corners)
        corners += check_rays(part.camera, Calibration(), (s, t, away), jobs)
    return corners, check_painting(scene, ideal, Painting.of(sensor), metadata["ideal_pixels_a_pixel"], sensor.rays, jobs)


def _check_all_but_masks(model: onnx.ModelProto, metadata: dict[str, Any], scene: Scene, assumed: list[str]) -> tuple[BankTables, float]:
    """Graph, metadata, cells' and padding's boxes, calibration. Returns the tables and the displacement, px. Raises `Refuted`."""
    cells = cell_boxes(scene)
    tables = read_tables(model.graph, cells)
    check_graph(model, scene, tables)
    least = tables.smallest_must_light
    demand(metadata.get("smallest_must_light") == least, f"metadata: smallest_must_light is not {least}, the least |K| of the file")
    demand(least > scene.tolerance.missed_budget, f"the least |K|, {least}, does not exceed the missed budget")
    demand(metadata.get("assumptions") == assumed, "metadata: the assumptions are not the scene's")
    _check_whole_cells(model, cells, tables)
    check_boxes(scene, tables)
    shift_px = displacement_px(scene, tables.window)
    demand(shift_px <= scene.tolerance.line_px, f"calibration: it can move a marking by {shift_px:.3f} px, more than line_px")
    stated = metadata.get("calibration_shift_px")
    covers = isinstance(stated, int | float) and shift_px <= stated <= scene.tolerance.line_px
    demand(covers, f"metadata: calibration_shift_px {stated!r} is not between the displacement {shift_px:.6f} px and line_px")
    return tables, shift_px


def _check_whole_cells(model: onnx.ModelProto, cells: Partition, tables: BankTables) -> None:
    """The cells' float32 boxes hold the cells, by no more than rounding asks, and hold the entries' boxes."""
    tensors = {tensor.name: onnx.numpy_helper.to_array(tensor).T for tensor in model.graph.initializer if tensor.name.startswith("whole_")}
    lower, upper = tensors["whole_lower"], tensors["whole_upper"]
    within = (lower <= cells.lower) & (upper >= cells.upper)
    slack = np.float32(2) * np.spacing(np.maximum(np.abs(lower), np.abs(upper)))
    close = (cells.lower - lower <= slack) & (upper - cells.upper <= slack)
    for text, holds in (("does not hold the cell", within), ("is wider than rounding asks", close)):
        demand(bool(holds.all()), f"the box of a whole cell {text}", int(np.argmin(holds.all(axis=1))))
    padding, cell = tables.must_light_size == PADDING_SIZE, tables.row_cell
    inside = ((tables.state_lower >= lower[cell][:, None]) & (tables.state_upper <= upper[cell][:, None])).all(axis=2)
    demand_of_all(padding | inside, "an entry's box of states reaches out of its cell", tables)


def _cell_proofs(scene: Scene, tables: BankTables, jobs: int) -> Iterator[CellProof | Counterexample]:
    if isinstance(tables, WindowTables):
        work = (joblib.delayed(prove_windows)(claim) for claim in window_claims(scene, tables))
    else:
        assert isinstance(tables, FilterTables)
        work = (joblib.delayed(prove_cell)(claim) for claim in cell_claims(scene, tables))
    for proof in joblib.Parallel(n_jobs=jobs, return_as="generator")(work):
        yield cast(CellProof | Counterexample, proof)

"""verify-model: proves a model file's certificate anew, from the file's own tensors and the scene in its metadata.

What is proved, and by what arithmetic:

    cells      the borders are the float64 numbers nearest to the scene's: exact fractions
    graph      NN_F is, node by node and bit by bit, the graph of the tables in the file (`build_model.verify.model_graph`); and on frames
               drawn at random, onnxruntime's outputs are those that the masks define, counted pixel by pixel: integers
    sizes      |K|, its least value, the budgets' defaults and the stated assumptions agree: integers
    masks, boxes and cover of every cell (`build_model.verify.cell_proof`): Arb's balls of 64 bits, from the plain camera equations
    tolerance  line_px covers what the calibration can move a marking by (`displacement_px` here): Arb's balls

No mask, bound or rounding of the build is used; shared with it are the scene's reader and the writer of the expected graph.
"""

from __future__ import annotations

import hashlib
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import joblib
import numpy as np
import onnx
import onnxruntime
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from build_model.export import assumptions
from build_model.filter_network import FilterTables
from build_model.partition import Partition
from build_model.pixel_mask import Window
from build_model.verify.ball_camera import PRECISION_BITS
from build_model.verify.cell_proof import (
    PADDING_SIZE,
    CellClaim,
    CellProof,
    Counterexample,
    MaskRuns,
    PaintedRuns,
    Refuted,
    demand,
    prove_cell,
)
from build_model.verify.model_graph import check_graph, read_tables
from runtime.model.model_file import METADATA_KEY, ModelError, parse_model
from runtime.scene import Axis, Scene, SceneError

Progress = Callable[[int, int], None]
"""Called with cells proved and cells in all."""
SAMPLE_FRAMES = 6
"""Frames on which the graph's outputs are compared with their definition."""
SAMPLE_DENSITIES = (0.0, 0.02, 0.2, 0.6, 1.0)
CALIBRATION_PARTS = 16
"""Parts of the window per axis over which the displacement by the calibration is bounded."""


@dataclass(frozen=True)
class VerificationReport:
    """What was proved. `counterexample` is the first claim that does not hold; None if the whole certificate is proved."""

    cells: int
    entries: int
    spatial_pixels: int
    may_light_pixels: int
    must_light_pixels: int
    margin_px: float
    """Least distance, px, by which a bound on a column keeps from the border that it must not reach."""
    displacement_px: float
    """Bound on what the calibration can move a marking by."""
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
    counterexample, shift_px, cells = None, float("nan"), 0
    try:
        cells = len(cell_boxes(scene))
        tables, shift_px = _check_all_but_masks(model, metadata, scene)
        for proof in _cell_proofs(scene, tables, jobs):
            if isinstance(proof, Counterexample):
                raise Refuted(proof)
            proofs.append(proof)
            progress(len(proofs), cells)
        check_outputs(content, scene, tables)
    except Refuted as refuted:
        counterexample = refuted.counterexample
    return VerificationReport(
        cells=len(proofs),
        entries=sum(proof.entries for proof in proofs),
        spatial_pixels=sum(proof.spatial_pixels for proof in proofs),
        may_light_pixels=sum(proof.may_light_pixels for proof in proofs),
        must_light_pixels=sum(proof.must_light_pixels for proof in proofs),
        margin_px=min((proof.margin_px for proof in proofs), default=float("nan")),
        displacement_px=shift_px,
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
        reason = " ".join(str(error).split())
        raise ModelError(f"{name}: not a valid ONNX model ({reason:.160}); export it again with export-model") from error
    digest = hashlib.sha256(model.graph.SerializeToString(deterministic=True)).hexdigest()
    keys = [entry.key for entry in model.metadata_props]
    if digest != metadata["graph_sha256"] or keys != [METADATA_KEY]:
        raise ModelError(f"{name}: graph or metadata are in it more than once; export it again with export-model")
    try:
        return model, metadata, Scene.from_dict(metadata.get("scene", {}))
    except SceneError as error:
        raise ModelError(f"{name}: the scene in its metadata is unusable ({error}); export it again with export-model") from error


def axis_borders(axis: Axis) -> list[float]:
    """Borders of an axis's cells, ascending: half-way between its centres, and half a width beyond the outermost.

    Each is the float64 number nearest to the exact fraction.
    """
    centres, half = [Fraction(centre) for centre in axis.centres], Fraction(axis.width) / 2
    middles = [(left + right) / 2 for left, right in itertools.pairwise(centres)]
    return [float(border) for border in (centres[0] - half, *middles, centres[-1] + half)]


def cell_boxes(scene: Scene) -> Partition:
    """The cells as the model's documentation defines them: row-major over the intervals of theta, x, y and z, sharing their borders."""
    intervals = [list(itertools.pairwise(axis_borders(axis))) for axis in scene.domain.axes]
    boxes = np.array(list(itertools.product(*intervals)))
    return Partition(lower=boxes[:, :, 0], upper=boxes[:, :, 1])


def _check_all_but_masks(model: onnx.ModelProto, metadata: dict[str, Any], scene: Scene) -> tuple[FilterTables, float]:
    """Graph, metadata, cells' and padding's boxes, calibration. Returns the tables and the displacement, px. Raises `Refuted`."""
    cells = cell_boxes(scene)
    tables = read_tables(model.graph, cells)
    check_graph(model, scene, tables)
    least = tables.smallest_must_light
    demand(metadata.get("smallest_must_light") == least, f"metadata: smallest_must_light is not {least}, the least |K| of the file")
    demand(least > scene.tolerance.missed_budget, f"the least |K|, {least}, does not exceed the missed budget")
    demand(metadata.get("assumptions") == assumptions(scene), "metadata: the assumptions are not the scene's")
    _check_whole_cells(model, cells, tables)
    shift_px = displacement_px(scene, tables.window)
    demand(shift_px <= scene.tolerance.line_px, f"calibration: it can move a marking by {shift_px:.3f} px, more than line_px")
    stated = metadata.get("calibration_shift_px")
    covers = isinstance(stated, int | float) and shift_px <= stated <= scene.tolerance.line_px
    demand(covers, f"metadata: calibration_shift_px {stated!r} is not between the displacement {shift_px:.6f} px and line_px")
    return tables, shift_px


def _check_whole_cells(model: onnx.ModelProto, cells: Partition, tables: FilterTables) -> None:
    """The cells' float32 boxes hold the cells, by no more than rounding asks, and hold the entries' boxes."""
    tensors = {tensor.name: onnx.numpy_helper.to_array(tensor).T for tensor in model.graph.initializer if tensor.name.startswith("whole_")}
    lower, upper = tensors["whole_lower"], tensors["whole_upper"]
    within = (lower <= cells.lower) & (upper >= cells.upper)
    slack = np.float32(2) * np.spacing(np.maximum(np.abs(lower), np.abs(upper)))
    close = (cells.lower - lower <= slack) & (upper - cells.upper <= slack)
    for text, holds in (("does not hold the cell", within), ("is wider than rounding asks", close)):
        demand(bool(holds.all()), f"the box of a whole cell {text}", int(np.argmin(holds.all(axis=1))))
    used, cell = (tables.must_light_size != PADDING_SIZE)[:, :, None], tables.row_cell
    inside = ((tables.state_lower >= lower[cell][:, None]) & (tables.state_upper <= upper[cell][:, None])) | ~used
    row, place = np.argwhere(~inside.all(axis=2))[0] if not inside.all() else (0, 0)
    demand(bool(inside.all()), "an entry's box of states reaches out of its cell", *_entry(tables, int(row), int(place)))


def _entry(tables: FilterTables, row: int, place: int) -> tuple[int, int]:
    """Cell and number of the entry at a place of a row."""
    cell = tables.row_cell[row]
    before = row - int(np.searchsorted(tables.row_cell, cell))
    return int(cell), before * tables.must_light_size.shape[1] + place


def displacement_px(scene: Scene, window: Window) -> float:
    """Bound on the shift, px in the sup norm, of a marking's point in view, by any camera within the scene's calibration.

    A ray (a, b, 1), a = (u - u0)/F, b = (v - v0)/F, is yawed by psi, then rolled by rho, each within its plus-minus:

        D = a sin(psi) + cos(psi)    a' - a = -sin(psi) (1 + a^2)/D      b' - b = b (1 - D)/D
        a'' - a' = a' (cos(rho) - 1) - b' sin(rho)                       b'' - b' = a' sin(rho) + b' (cos(rho) - 1)

    and then the focal length F is off by a share and the principal point by some px. Points in view lie in the spatial masks' window;
    where it reaches the frame's border, up to `line_px` beyond count too, since the shift can bring them into view.
    """
    if scene.calibration.exact:
        return 0.0
    with ctx.workprec(PRECISION_BITS):
        off, camera = scene.calibration, scene.camera
        focal = arb(camera.focal_length_m) / arb(camera.pixel_pitch_m)
        reach, (height, width) = scene.tolerance.line_px, camera.shape
        left = window.left - reach * (window.left == 0)
        right = window.right + reach * (window.right == width)
        top = window.top - reach * (window.top == 0)
        bottom = window.bottom + reach * (window.bottom == height)
        across = [(side - arb(camera.u0)) / focal for side in _parts(left, right)]
        down = [(side - arb(camera.v0)) / focal for side in _parts(top, bottom)]
        yaw, roll = (arb(0, angle).sin_cos() for angle in (off.yaw_rad, off.roll_rad))
        largest = arb(0)
        for a, b in itertools.product(across, down):
            depth = a * yaw[0] + yaw[1]
            if not depth > 0:
                return float("inf")
            shift_a, shift_b = -yaw[0] * (1 + a * a) / depth, b * (1 - depth) / depth
            yawed_a, yawed_b = a + shift_a, b + shift_b
            shift_a, shift_b = (
                shift_a + yawed_a * (roll[1] - 1) - yawed_b * roll[0],
                shift_b + yawed_a * roll[0] + yawed_b * (roll[1] - 1),
            )
            share = arb(0, off.focal_relative)
            for ray, shift in ((a, shift_a), (b, shift_b)):
                largest = largest.max(abs(focal * (shift + share * (ray + shift)) + arb(0, off.principal_px)).upper())
        return float(np.nextafter(float(largest.upper()), np.inf))


def _parts(low: int, high: int) -> list[arb]:
    """Balls that cover the interval [low, high]."""
    half = arb(high - low) / (2 * CALIBRATION_PARTS)
    return [arb((low + (2 * part + 1) * half).mid(), half.upper() + arb(2) ** -40) for part in range(CALIBRATION_PARTS)]


def cell_claims(scene: Scene, tables: FilterTables) -> Iterator[CellClaim]:
    """What the tables state of each cell. Look-ups of K into the sums of the dilated frame are renumbered from 0."""
    runs, rows = tables.runs, tables.window.shape[0]
    masks = runs.blocks[0].shape[2]
    stop, start = np.concatenate([np.pad(block, ((0, 0), (0, 0), (0, masks - block.shape[2]))) for block in runs.blocks], axis=1)
    witnesses = (rows + 1) * runs.columns if scene.tolerance.line_px else 0

    def counted(places: NDArray[np.int32], base: int = 0) -> MaskRuns:
        places = places.ravel()
        used = start[:, places] != stop[:, places]
        return MaskRuns(*(np.where(used, side[:, places] - base, 0) for side in (start, stop)), folded=runs.folded)

    for cell in range(len(tables.cells)):
        painted, rows = tables.spatial_runs.cell == cell, tables.row_cell == cell
        yield CellClaim(
            scene=scene,
            cell=cell,
            lower=tables.cells.lower[cell],
            upper=tables.cells.upper[cell],
            window=tables.window,
            spatial=counted(runs.spatial[cell : cell + 1]),
            painted=PaintedRuns(tables.spatial_runs.index[painted], tables.spatial_runs.step[painted]),
            must_light=counted(runs.must_light[rows], witnesses),
            may_light=counted(runs.may_light[rows]),
            must_light_size=tables.must_light_size[rows].ravel(),
            line_lower=tables.line_lower[rows].reshape(-1, 4),
            line_upper=tables.line_upper[rows].reshape(-1, 4),
            reference_row=tables.reference_row[rows].ravel(),
            state_lower=tables.state_lower[rows].reshape(-1, 4),
            state_upper=tables.state_upper[rows].reshape(-1, 4),
        )


def _cell_proofs(scene: Scene, tables: FilterTables, jobs: int) -> Iterator[CellProof | Counterexample]:
    work = (joblib.delayed(prove_cell)(claim) for claim in cell_claims(scene, tables))
    for proof in joblib.Parallel(n_jobs=jobs, return_as="generator")(work):
        yield cast(CellProof | Counterexample, proof)


def check_outputs(content: bytes, scene: Scene, tables: FilterTables) -> None:
    """Runs the file in onnxruntime on sample frames, and compares NN_F's outputs with their definition. Raises `Refuted`."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3  # it warns of the budgets, initialisers that are inputs too
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(0)
    claims, width = list(cell_claims(scene, tables)), tables.must_light_size.shape[1]
    for number in range(SAMPLE_FRAMES):
        frame = (rng.random(scene.camera.shape) < SAMPLE_DENSITIES[number % len(SAMPLE_DENSITIES)]).astype(np.uint8)
        missed, extra = (int(budget) for budget in rng.integers([0, -1], [tables.smallest_must_light, 64]))
        expected = defined_outputs(claims, width, frame, missed, extra)
        budgets = {"missed_budget": np.array(missed, dtype=np.int32), "extra_budget": np.array(extra, dtype=np.int32)}
        found = session.run(list(expected), {"frame": frame, **budgets})
        for name, value in zip(expected, map(np.asarray, found), strict=True):
            defined = expected[name]
            same = np.array_equal(value, np.where(np.isnan(defined), value, defined))
            demand(same, f"graph: on sample frame {number} the output {name!r} is not what the masks define")


def defined_outputs(
    claims: list[CellClaim], row_width: int, frame: NDArray[np.uint8], missed_budget: int, extra_budget: int
) -> dict[str, NDArray]:
    """NN_F's outputs by their definition; the hull of a cell without a passing entry is NaN. `row_width`: entries in a row."""
    window, reach = claims[0].window, claims[0].scene.tolerance.line_px
    lit = frame.astype(bool)
    wide, span, (height, width) = np.pad(lit, reach), range(2 * reach + 1), lit.shape
    witnessed = np.logical_or.reduce([wide[row : row + height, column : column + width] for row in span for column in span])
    scores = [_scores(claim, lit[window.slices], witnessed[window.slices]) for claim in claims]
    passes = [(missed <= missed_budget) & ((extra <= extra_budget) | (extra_budget < 0)) for missed, extra in scores]
    support = np.array([part.sum() for part in passes], dtype=np.int32)
    mismatch = np.array([(missed + extra).min() for missed, extra in scores], dtype=np.int32)
    cell = support.argmax() if support.any() else mismatch.argmin()
    shown = support > 0 if support.any() else np.arange(len(claims)) == cell
    filtered = np.zeros_like(frame)
    spatial = [claim.spatial.bits(window, claim.cell, "S")[0] for claim in claims]
    filtered[window.slices] = frame[window.slices] * np.any(np.array(spatial)[shown], axis=0)
    lower = np.array([_hull(claim.state_lower[chosen], np.min) for claim, chosen in zip(claims, passes, strict=True)])
    upper = np.array([_hull(claim.state_upper[chosen], np.max) for claim, chosen in zip(claims, passes, strict=True)])
    outputs = {
        "passes": np.concatenate(passes).reshape(-1, row_width),
        "support": support,
        "mismatch": mismatch,
        "cell": np.array(cell),
        "filtered": filtered,
    }
    return outputs | {"cell_lower": lower, "cell_upper": upper}


def _hull(sides: NDArray[np.float32], extreme: Callable[..., NDArray[np.float32]]) -> NDArray[np.float32]:
    """The extreme of the passing entries' sides, (4,); NaN if there is none."""
    return extreme(sides, axis=0) if len(sides) else np.full(4, np.nan, dtype=np.float32)


def _scores(claim: CellClaim, lit: NDArray[np.bool_], witnessed: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """missed = |K without the dilated frame|, from the stated |K|, and extra = |(frame and S) without O|, of every entry."""
    window, cell = claim.window, claim.cell
    spatial, must_light = claim.spatial.bits(window, cell, "S"), claim.must_light.bits(window, cell, "K")
    extra = lit & spatial & ~claim.may_light.bits(window, cell, "O")
    return claim.must_light_size - (must_light & witnessed).sum(axis=(1, 2)), extra.sum(axis=(1, 2))

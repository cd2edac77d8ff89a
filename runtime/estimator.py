"""The embedded estimator: event frame in, certified box and state out (paper, Eq. (8)).

    xi-hat = NN_e(NN_F(I))  if it lies in Xi-hat,  else  centre(Xi-hat)

Xi-hat is the hull of the cells whose bank passes. By Theorem A it contains the aircraft's state whatever the clutter, if the state
lies in the scene's domain, the camera is the scene's (no roll or yaw, the calibration as stated, up to the tolerance), and at most
`missed_budget` pixels of the runway's image are dark (up to the tolerance).
"""

from __future__ import annotations

import enum
import hashlib
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

from runtime.image import dilated
from runtime.model_file import LARGEST_FILE_BYTES, ModelError, ModelFile, parse_model
from runtime.refine import STATE_MARGIN, Refiner, connected_parts, joined
from runtime.scene import STATE_NAMES, Scene, SceneError
from runtime.state_set import StateSet, tangent_of_row

PACKAGED_MODELS = (Path(__file__).parent / "models", Path(__file__).parents[1] / "models")
"""Where the paper's model lies: in a wheel beside this file, in a checkout at the top."""
LOG_FATAL_ONLY = 4
REFINED_BEYOND_PX = 2
"""How far beyond the spatial masks the refinement looks at pixels; those farther out it takes for lit."""
OUTPUTS = ("cell", "support", "mismatch", "passes", "cell_lower", "cell_upper", "filtered", "network_state")
SIDES = ("lower", "upper")
STATE_BOX_TENSORS = tuple(f"{name}_{side}" for name in STATE_NAMES for side in SIDES)
BOX_TENSORS = ("row_cell", *STATE_BOX_TENSORS, "line_lower", "line_upper", "reference_row", "must_light_size")
MASK_TENSORS = ("spatial_run_cell", "spatial_run_index", "spatial_run_step", "window_first", "window_stop")
"""Initialisers that hold every entry as a box of states and of line coordinates, and every cell's spatial mask."""


class FrameError(ValueError):
    """A frame that the model cannot take."""

    def __init__(self, actual: str, expected: str) -> None:
        super().__init__(f"frame: found {actual}, expected {expected}")
        self.actual = actual
        self.expected = expected


class Outcome(enum.Enum):
    """What a frame says: CERTIFIED, a box is given; NO_RUNWAY, no state of the domain is consistent with it."""

    CERTIFIED = "certified"
    NO_RUNWAY = "no runway"


@dataclass(frozen=True)
class Box:
    """Certified: the state lies between `lower` and `upper`, (4,) float64 each, read-only, under the model's assumptions."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            side = np.array(getattr(self, name), dtype=np.float64)
            side.flags.writeable = False
            object.__setattr__(self, name, side)
        if self.lower.shape != (4,) or not (np.isfinite(self.lower) & np.isfinite(self.upper) & (self.lower <= self.upper)).all():
            raise ValueError(f"box: found lower {self.lower} and upper {self.upper}, expected four finite ordered bounds")

    def __reduce__(self) -> tuple[type[Box], tuple[NDArray[np.float64], NDArray[np.float64]]]:
        return Box, (self.lower, self.upper)  # a copy from another process is checked and read-only too

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle of the box, (4,); exact on an axis of width 0."""
        return np.clip((self.lower + self.upper) / 2, self.lower, self.upper)

    @property
    def half_widths(self) -> NDArray[np.float64]:
        """Half of the box's extent, (4,)."""
        return (self.upper - self.lower) / 2

    def contains(self, state: ArrayLike) -> bool:
        """True if a state (4,) lies in the box, borders included; False if it has a NaN."""
        point = np.asarray(state, dtype=np.float64)
        return bool(((self.lower <= point) & (point <= self.upper)).all())


@dataclass(frozen=True)
class Estimate:
    """What one frame tells. States are [theta, x, y, z] in rad and m (`runtime.camera`)."""

    outcome: Outcome
    box: Box | None
    """Certified; None where nothing is."""
    state: NDArray[np.float64] | None
    """The proposal if it lies in the box, else the box's centre; None where nothing is certified."""
    used_fallback: bool
    """True if the centre was taken."""
    network_state: NDArray[np.float64]
    """NN_e's answer, uncertified."""
    cell: int
    """The cell with the most consistent entries, or with the smallest mismatch where none is consistent."""
    passing: NDArray[np.int64]
    """Numbers of the cells that are consistent with the frame."""
    mismatch: int
    """Smallest missed + extra of `cell`."""
    filtered: NDArray[np.uint8]
    """The frame within the spatial masks of the passing cells: keeps every lit pixel of the runway."""
    regions: tuple[Box, ...]
    """Connected parts of what is consistent, each in its box; more than one is an ambiguity. One without refinement."""
    touches_boundary: bool
    """The box reaches a face of the domain: it holds the state only if the aircraft is in the domain."""

    @property
    def certified(self) -> bool:
        """True if a box is given."""
        return self.outcome is Outcome.CERTIFIED


class Estimator:
    """A loaded model. Not thread-safe; give each thread its own."""

    def __init__(self, model: ModelFile, name: str, threads: int, missed_budget: int | None, extra_budget: int | None) -> None:
        self.metadata: dict[str, Any] = model.metadata
        self.sha256 = model.sha256
        try:
            self.scene = Scene.from_dict(model.metadata.get("scene", {}))
        except SceneError as error:
            raise ModelError(f"{name}: the scene in its metadata is unusable ({error})") from error
        self._budgets = self._checked_budgets(name, missed_budget, extra_budget)
        self._entries = _Entries.of(self.scene, model.tensors, name)
        if self.metadata["smallest_must_light"] != model.tensors["must_light_size"].min():
            raise ModelError(f"{name}: its metadata misstate the smallest |K| of its entries; export it again with export-model")
        self._session = self._open(model.content, name, threads)
        _check_interface(self._session, self.scene, model.tensors["must_light_size"].shape, name)
        self._domain_lower, self._domain_upper = self.scene.domain.lower, self.scene.domain.upper
        self._fixed = self._domain_lower == self._domain_upper
        window = self._entries.window_and_beyond(REFINED_BEYOND_PX)
        self._refiner = Refiner(self.scene, int(self._budgets["missed_budget"]), int(self._budgets["extra_budget"]), window)
        self._arguments = {"path": name, "missed_budget": missed_budget, "extra_budget": extra_budget, "sha256": model.sha256}

    @classmethod
    def load(
        cls,
        path: str | Path | None = None,
        *,
        threads: int = 1,
        missed_budget: int | None = None,
        extra_budget: int | None = None,
        sha256: str | None = None,
    ) -> Estimator:
        """Reads a model file; without a path, the paper's model that comes with the package.

        `missed_budget` and `extra_budget` replace the scene's. `sha256` is the digest of the file that the caller trusts; nothing of
        another file is looked at. The file is checked before onnxruntime sees it (`runtime.model_file`). Raises `ModelError` for a file
        that is missing, too large, not ours, damaged or of another version, and for a budget that it cannot keep.
        """
        source = _packaged_model() if path is None else Path(path)
        content = _read(source)
        digest = hashlib.sha256(content).hexdigest()
        if sha256 is not None and sha256.lower() != digest:
            raise ModelError(f"{source}: sha256 is {digest}, the caller trusts {sha256}; take the file from its source again")
        model = parse_model(content, str(source), BOX_TENSORS + MASK_TENSORS)
        return cls(model, str(source), threads, missed_budget, extra_budget)

    def run(self, frame: NDArray) -> dict[str, Any]:
        """The model's own outputs for one frame (table in models/README.md). Raises `FrameError` as `estimate` does."""
        return self.run_unchecked(self._checked_frame(frame))

    def run_unchecked(self, pixels: NDArray[np.uint8]) -> dict[str, Any]:
        """`run` for a frame that is known to be uint8 (height, width) of {0, 1}: one call of onnxruntime.

        Raises `ModelError` if that fails, which it may for a file that no `sha256` vouches for.
        """
        try:
            return dict(zip(OUTPUTS, self._session.run(OUTPUTS, {"frame": pixels, **self._budgets}), strict=True))
        except Exception as error:  # onnxruntime raises classes of its own that share only this one
            raise ModelError(f"{self._arguments['path']}: onnxruntime cannot run it ({_reason(error)}); export it again") from error

    def estimate(self, frame: NDArray, proposal: ArrayLike | None = None, refine: bool = True) -> Estimate:
        """State and certified box of one frame.

        `frame`: (height, width), bool, or uint8 of {0, 1}. `proposal`: a state (4,) from elsewhere to be checked in place of NN_e's.
        `refine`: contract the passing entries to what the frame can tell (`runtime.refine`); without it, the box is their hull. Raises
        `FrameError` for any other frame and ValueError for a proposal of another shape.
        """
        pixels = self._checked_frame(frame)
        outputs = self.run_unchecked(pixels)
        cell, support, mismatch, passes, cell_lower, cell_upper, filtered, network_state = outputs.values()
        network = np.where(self._fixed, self._domain_lower, network_state)
        passing = np.flatnonzero(support)
        if refine and len(passing):
            regions = self._regions(self._refined(pixels.view(np.bool_), passes))
        else:
            regions = self._hulls(cell_lower[passing], cell_upper[passing], [np.arange(len(passing))] if len(passing) else [])
        box = Box(np.min([part.lower for part in regions], axis=0), np.max([part.upper for part in regions], axis=0)) if regions else None
        state, used_fallback = self._shielded(box, network if proposal is None else self._checked_proposal(proposal))
        return Estimate(
            outcome=Outcome.NO_RUNWAY if box is None else Outcome.CERTIFIED,
            box=box,
            state=state,
            used_fallback=used_fallback,
            network_state=network,
            cell=int(cell),
            passing=passing,
            mismatch=int(mismatch[cell]),
            filtered=filtered,
            regions=regions,
            touches_boundary=box is not None and self._touches_boundary(box),
        )

    def estimate_many(self, frames: Iterable[NDArray], refine: bool = True, processes: int = 2) -> Iterator[Estimate]:
        """`estimate` of every frame, in order, on several cores: the same answers to the last bit.

        Frames are taken a few ahead of the answers. Without refinement, `processes` threads do the work. With it, processes do, which
        read the model's file again and take about as long to start as 100 frames; a script then needs the usual
        `if __name__ == "__main__":`. Raises `FrameError` when it comes to a frame that the model cannot take, and `BrokenProcessPool`
        if the file has gone or changed.
        """
        from runtime.batch import by_processes, by_threads  # loads 3 MB that other programs can do without

        pixels = map(self._checked_frame, frames)
        if refine:
            return by_processes(self._arguments, self.scene.camera.width, pixels, processes)
        return by_threads(self, pixels, processes)

    def spatial_mask(self, cell: int) -> NDArray[np.bool_]:
        """S of a cell, (height, width): every pixel that one of its states can light, widened by the tolerance."""
        return self._entries.within(cell, np.ones(self.scene.camera.shape, dtype=np.bool_))

    def _refined(self, frame: NDArray[np.bool_], passes: NDArray[np.bool_]) -> StateSet:
        """What is left of the passing entries. Theorem B's claims, which differ from cell to cell, are made at tolerance 0 only."""
        witnesses = self._witnesses(frame)
        if self._refiner.extra_budget < 0 or self.scene.tolerance.line_px > 0:
            return self._refiner.refine(witnesses, self._entries.sets(passes))
        row_cell = self._entries.row_cell
        cells = np.unique(row_cell[passes.any(axis=1)])
        alone = row_cell[:, None]
        return joined(
            *(
                self._refiner.refine(witnesses, self._entries.sets(passes & (alone == cell)), self._entries.within(int(cell), frame))
                for cell in cells
            )
        )

    def _witnesses(self, frame: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Lit where a lit pixel lies within `line_px` in the sup norm, or the frame ends: what belongs there may be seen outside of it."""
        radius = self.scene.tolerance.line_px
        if radius == 0:
            return frame
        wide = dilated(np.pad(frame, radius, constant_values=True), radius)
        return wide[radius : radius + len(frame), radius : radius + frame.shape[1]]

    def _regions(self, pieces: StateSet) -> tuple[Box, ...]:
        """Boxes of the connected parts of the pieces."""
        return self._hulls(pieces.lower - STATE_MARGIN, pieces.upper + STATE_MARGIN, connected_parts(pieces))

    def _hulls(self, lower: NDArray, upper: NDArray, parts: list[NDArray[np.int64]]) -> tuple[Box, ...]:
        """The box of each part, within the domain, which holds the state by assumption."""
        return tuple(
            Box(
                np.clip(lower[part].min(axis=0).astype(np.float64), self._domain_lower, self._domain_upper),
                np.clip(upper[part].max(axis=0).astype(np.float64), self._domain_lower, self._domain_upper),
            )
            for part in parts
        )

    @staticmethod
    def _shielded(box: Box | None, proposal: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, bool]:
        """The paper's Eq. (8): the proposal if it lies in the box, else the box's centre; and whether the centre was taken."""
        if box is None:
            return None, False
        return (proposal, False) if box.contains(proposal) else (box.centre, True)

    def _touches_boundary(self, box: Box) -> bool:
        touches = (box.lower <= self._domain_lower) | (box.upper >= self._domain_upper)
        return bool((touches & ~self._fixed).any())

    def _checked_frame(self, frame: NDArray) -> NDArray[np.uint8]:
        expected = f"an array {self.scene.camera.shape} of bool, or of uint8 0 and 1"
        if not isinstance(frame, np.ndarray):
            raise FrameError(type(frame).__name__, expected)
        if frame.shape != self.scene.camera.shape or frame.dtype not in (np.bool_, np.uint8):
            raise FrameError(f"{frame.shape} of {frame.dtype}", expected)
        pixels = np.ascontiguousarray(frame).view(np.uint8)
        largest = int(pixels.max())
        if largest > 1:
            raise FrameError(f"a value of {largest}", expected)
        return pixels

    @staticmethod
    def _checked_proposal(proposal: ArrayLike) -> NDArray[np.float64]:
        state = np.asarray(proposal, dtype=np.float64)
        if state.shape != (4,):
            raise ValueError(f"proposal: found shape {state.shape}, expected (4,): {', '.join(STATE_NAMES)}")
        return state

    def _checked_budgets(self, name: str, missed: int | None, extra: int | None) -> dict[str, NDArray[np.int32]]:
        weakest = self.metadata.get("smallest_must_light")
        if not isinstance(weakest, int):
            raise ModelError(f"{name}: metadata lack smallest_must_light; export it again with export-model")
        tolerance = self.scene.tolerance
        missed = tolerance.missed_budget if missed is None else missed
        extra = tolerance.extra_budget if extra is None else extra
        if not 0 <= missed < weakest:
            raise ModelError(f"{name}: missed_budget {missed}: must be 0 to {weakest - 1}, below the smallest |K| of its entries")
        if not -1 <= extra < 2**31:
            raise ModelError(f"{name}: extra_budget {extra}: must be 0 or more, or -1 for not used")
        return {"missed_budget": np.array(missed, dtype=np.int32), "extra_budget": np.array(extra, dtype=np.int32)}

    @staticmethod
    def _open(content: bytes, name: str, threads: int) -> onnxruntime.InferenceSession:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = LOG_FATAL_ONLY  # it warns of the budgets, and an error becomes an exception below
        options.add_session_config_entry("session.strict_shape_type_inference", "1")  # declared shapes are then true ones
        try:
            # Folding constants would run operators of the file as it is loaded; on our graphs it saves nothing.
            return onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"], disabled_optimizers=["ConstantFolding"]
            )
        except Exception as error:  # onnxruntime raises classes of its own that share only this one
            raise ModelError(f"{name}: onnxruntime {onnxruntime.__version__} cannot load it ({_reason(error)})") from error


@dataclass(frozen=True)
class _Entries:
    """Every bank entry of the model as a set of states, padding included, which never passes; and the cells' spatial masks."""

    all: StateSet
    row_cell: NDArray[np.int32]
    """The cell of each row of entries, (rows,)."""
    run_cell: NDArray[np.int32]
    run_index: NDArray[np.int32]
    run_step: NDArray[np.int32]
    """Ends of the runs of S: their cell, flat index in the window, and 1 at a start or -1 below a stop, (ends,) each."""
    window: tuple[slice, slice]

    @staticmethod
    def of(scene: Scene, tensors: dict[str, NDArray[Any]], name: str) -> _Entries:
        """The entries from the model's initialisers; an axis of width 0 is exact. Raises `ModelError` if they do not fit the scene."""
        _check_tensors(scene, tensors, name)
        boxes = (np.stack([tensors[f"{axis}_{side}"].ravel() for side in SIDES], axis=-1) for axis in STATE_NAMES)
        states = np.stack(list(boxes)).astype(np.float64)
        scale = np.stack([tensors["line_lower"][..., 2], tensors["line_upper"][..., 2]], axis=-1).reshape(-1, 2)
        for axis, (low, high) in enumerate(zip(scene.domain.lower, scene.domain.upper, strict=True)):
            states[axis] = np.clip(states[axis], low, high)
        theta, x, y, z = states
        sets = StateSet(theta, x, y, z, scale, tangent_of_row(scene.camera, tensors["reference_row"].ravel()))
        window = tuple(slice(int(first), int(stop)) for first, stop in zip(tensors["window_first"], tensors["window_stop"], strict=True))
        cell, index, step = (tensors[f"spatial_run_{part}"].copy() for part in ("cell", "index", "step"))  # not to keep the file
        return _Entries(sets, tensors["row_cell"].copy(), cell, index, step, (window[0], window[1]))

    def sets(self, passes: NDArray[np.bool_]) -> StateSet:
        """The entries that pass; `passes` is (rows, width), a cell's entries in one row or several."""
        return self.all[np.flatnonzero(passes)]

    def window_and_beyond(self, margin_px: int) -> tuple[slice, slice]:
        """The masks' window with a margin; a slice need not stop at the frame's border."""
        rows, columns = (slice(max(side.start - margin_px, 0), side.stop + margin_px) for side in self.window)
        return rows, columns

    def within(self, cell: int, frame: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The frame within the cell's spatial mask S."""
        seen = np.zeros_like(frame)
        crop = frame[self.window]
        steps = np.zeros(crop.shape, dtype=np.int32)
        own = self.run_cell == cell
        steps.ravel()[self.run_index[own]] = self.run_step[own]  # a run's stop lies below it, and so never on another one's start
        mask = steps.cumsum(axis=0) > 0
        seen[self.window] = crop & mask
        return seen


def _check_tensors(scene: Scene, tensors: dict[str, NDArray[Any]], name: str) -> None:
    """Types, shapes and ranges of the initialisers that the runtime reads. Raises `ModelError`."""
    cells, rows, ends = scene.domain.cell_count, tensors["row_cell"].shape[:1], tensors["spatial_run_index"].shape[:1]
    entries = (*rows, *tensors["must_light_size"].shape[1:2])
    layout = {"row_cell": (np.int32, rows), "must_light_size": (np.int32, entries), "reference_row": (np.float64, entries)}
    layout |= dict.fromkeys(STATE_BOX_TENSORS, (np.float32, entries))
    layout |= {f"line_{side}": (np.float64, (*entries, 4)) for side in SIDES}
    layout |= {f"window_{side}": (np.int64, (2,)) for side in ("first", "stop")}
    layout |= {f"spatial_run_{part}": (np.int32, ends) for part in ("cell", "index", "step")}
    for label, (dtype, shape) in layout.items():
        found = tensors[label]
        if found.dtype != dtype or found.shape != shape or found.size == 0:
            expected = f"{np.dtype(dtype)} {list(shape)}"
            raise ModelError(f"{name}: {label} is {found.dtype} {list(found.shape)}, its scene asks for {expected}; export it again")
        if not np.isfinite(found).all():
            raise ModelError(f"{name}: {label} holds values that are not finite; export it again with export-model")
    if rows[0] < cells or not np.array_equal(np.unique(tensors["row_cell"]), np.arange(cells)):
        raise ModelError(f"{name}: row_cell does not give rows to every one of {cells} cells; export it again with export-model")
    first, stop = tensors["window_first"], tensors["window_stop"]
    inside = bool(((first >= 0) & (first < stop) & (stop <= scene.camera.shape)).all())
    limits = {"cell": (0, cells - 1), "index": (0, int(np.prod(stop - first)) - 1 if inside else -1), "step": (-1, 1)}
    for part, (low, high) in limits.items():
        inside &= bool(((tensors[f"spatial_run_{part}"] >= low) & (tensors[f"spatial_run_{part}"] <= high)).all())
    if not inside:
        raise ModelError(f"{name}: its window or its spatial masks lie outside the frame; export it again with export-model")


def _check_interface(session: onnxruntime.InferenceSession, scene: Scene, entries: tuple[int, ...], name: str) -> None:
    """Inputs and outputs are those of models/README.md, for the scene's frame and cells. Raises `ModelError`."""
    cells, frame = scene.domain.cell_count, list(scene.camera.shape)
    shapes = {"cell": [], "support": [cells], "mismatch": [cells], "passes": list(entries), "filtered": frame, "network_state": [4]}
    shapes |= {"cell_lower": [cells, 4], "cell_upper": [cells, 4]}
    types = {"cell": "int64", "support": "int32", "mismatch": "int32", "passes": "bool", "filtered": "uint8"}
    expected = {
        "inputs": [("frame", "tensor(uint8)", frame)],
        "budgets": [(budget, "tensor(int32)", []) for budget in ("extra_budget", "missed_budget")],
        "outputs": [(output, f"tensor({types.get(output, 'float')})", shapes[output]) for output in sorted(OUTPUTS)],
    }
    for kind, values in zip(expected, (session.get_inputs(), session.get_overridable_initializers(), session.get_outputs()), strict=True):
        found = sorted((value.name, value.type, value.shape) for value in values)
        if found != expected[kind]:
            raise ModelError(f"{name}: its {kind} are {found!s:.200}, its scene asks for {expected[kind]}; export it again")


def _reason(error: Exception) -> str:
    """An error of onnxruntime's on one line."""
    return " ".join(str(error).split())[:200]


def _read(path: Path) -> bytes:
    """The file's bytes. Raises `ModelError` if it cannot be read, is none, or is too large to be a model."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > LARGEST_FILE_BYTES:
            limit = f"files of up to {LARGEST_FILE_BYTES >> 20} MiB are read"
            raise ModelError(
                f"{path}: cannot be read (not a file, or of {status.st_size} bytes); {limit}: give a model that export-model wrote"
            )
        return path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror}); give the path of a model that export-model wrote") from error
    except ValueError as error:  # a null character in the path
        raise ModelError(f"{str(path)!r}: cannot be read ({error}); give the path of a model that export-model wrote") from error


def _packaged_model() -> Path:
    for folder in PACKAGED_MODELS:
        if (folder / "paper.onnx").is_file():
            return folder / "paper.onnx"
    raise ModelError("paper.onnx: comes with the package but is missing; give the path of a model, or reinstall glideproof")

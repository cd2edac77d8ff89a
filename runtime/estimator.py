"""The embedded estimator: event frame in, certified box and state out (paper, Eq. (8)).

    xi-hat = NN_e(NN_F(I))  if it lies in Xi-hat,  else  centre(Xi-hat)

Xi-hat is the hull of the bank entries that pass, contracted to what the frame can tell. By Theorem A it contains the aircraft's state
whatever the clutter, if the state lies in the scene's domain, the camera is the scene's (no roll or yaw, the calibration as stated, up to
the tolerance), and at most `missed_budget` pixels of the runway's image are dark (up to the tolerance). By Theorem C the same holds of what
is left of the entries within a box that is known to hold the state.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.assumptions import assumptions, prior_assumption
from runtime.attitude import Attitude
from runtime.estimate import Box, Estimate, FrameError, Outcome
from runtime.model.entries import Entries
from runtime.model.format import BOX_TENSORS, MASK_TENSORS, OVERFLOW, SPAN_TENSORS, ModelError
from runtime.model.model_file import ModelFile, packaged_model, parse_model, read_model
from runtime.model.session import check_interface, open_session, outputs_of, reason_of
from runtime.on_sensor import refined
from runtime.refine.refiner import Refiner
from runtime.refine.regions import hulls, regions_of
from runtime.refine.slices import covering, within
from runtime.refine.theorem_b import refined_by_cell
from runtime.refine.witnesses import witnesses
from runtime.scene import STATE_NAMES, Scene, SceneError
from runtime.sensor import Sensor
from runtime.state_set import StateSet
from runtime.turned import TurnedStart, hull_of, seen_box, seen_by_turned, started

REFINED_BEYOND_PX = 2
"""How far beyond the spatial masks the refinement looks at pixels; those farther out it takes for lit."""


@dataclass(frozen=True)
class Found:
    """What the model says of one frame: its outputs (models/README.md), `filtered` in the sensor's frame."""

    pixels: NDArray[np.uint8]
    """The sensor's frame, its own."""
    cell: int
    support: NDArray[np.int32]
    mismatch: NDArray[np.int32]
    passes: NDArray[np.bool_]
    cell_lower: NDArray[np.float32]
    cell_upper: NDArray[np.float32]
    filtered: NDArray[np.uint8]
    network_state: NDArray[np.float64]
    overflow: bool
    """More groups of a bank of windows passed than there are places: the others stand for all of their entries."""
    turned: TurnedStart | None = None
    """Where the camera is rolled or yawed: its attitude, and what of the bank passes (`runtime.turned`)."""


class Estimator:
    """A loaded model. Not thread-safe; give each thread its own, for example a `copy.copy`."""

    def __init__(self, model: ModelFile, name: str, threads: int, missed_budget: int | None, extra_budget: int | None) -> None:
        self.metadata: dict[str, Any] = model.metadata
        self.sha256 = model.sha256
        try:
            self.scene = Scene.from_dict(model.metadata.get("scene", {}))
        except SceneError as error:
            raise ModelError(f"{name}: the scene in its metadata is unusable ({error})") from error
        self.sensor = _sensor_of(self.scene, model.metadata, name)
        self._budgets = self._checked_budgets(name, missed_budget, extra_budget)
        self._entries = Entries.of(self.ideal, model.tensors, name)
        sizes = [model.tensors[label].min() for label in ("must_light_size", "gate_size") if label in model.tensors]
        if self.metadata["smallest_must_light"] != min(sizes):
            raise ModelError(f"{name}: its metadata misstate the smallest |K| of its entries; export it again with export-model")
        self._outputs = outputs_of(self.scene)
        self._session = open_session(model.content, name, threads)
        check_interface(self._session, self.ideal, model.tensors["must_light_size"].shape, name)
        self.domain = Box(self.scene.domain.lower, self.scene.domain.upper)  # the hull of the cells
        bounds = self.scene.attitude
        self.attitude = None if bounds is None else Attitude.between(bounds.roll_rad, bounds.yaw_rad)
        window = self._entries.window_and_beyond(REFINED_BEYOND_PX)
        self._refiner = Refiner(self.ideal, int(self._budgets["missed_budget"]), int(self._budgets["extra_budget"]), window)
        self._sensor_refiner = Refiner(self.scene, self.missed_budget, -1)
        budgets = {"missed_budget": self.missed_budget, "extra_budget": self.extra_budget}
        self.assumed = tuple(assumptions(replace(self.scene, tolerance=replace(self.scene.tolerance, **budgets))))
        # The file's absolute path: whoever reads it again may do so after a change of folder.
        budgets = {"missed_budget": missed_budget, "extra_budget": extra_budget}
        self._arguments = {"path": os.path.abspath(name), **budgets, "sha256": self.sha256}
        self._name, self._threads = name, threads

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy, or what another process unpickles, reads the model's file again; raises `ModelError` if that has gone or changed."""
        return partial(Estimator.load, threads=self._threads, **self._arguments), ()

    @property
    def ideal(self) -> Scene:
        """The scene that NN_F is built for: `scene` itself, or behind a lens what its ideal frame shows."""
        return self.sensor.ideal

    @property
    def missed_budget(self) -> int:
        """m of Theorem A: pixels of the runway's image that may be dark."""
        return int(self._budgets["missed_budget"]) // self.sensor.pixels_a_pixel

    @property
    def extra_budget(self) -> int:
        """e of Theorem B, or -1 where it is not used."""
        return int(self._budgets["extra_budget"])

    @property
    def beside_px(self) -> int:
        """How far beside its place a pixel may fire: `line_px`, less the whole pixels of it that NN_F needs for the calibration."""
        return max(self.scene.tolerance.line_px - math.ceil(self.metadata.get("calibration_shift_px", 0.0)), 0)

    @property
    def largest_missed_budget(self) -> int:
        """The largest that `load` takes: one below the smallest |K| of the model's entries."""
        return (self.metadata["smallest_must_light"] - 1) // self.sensor.pixels_a_pixel

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
        another file is looked at. The file is checked before onnxruntime sees it (`runtime.model.model_file`). Raises `ModelError` for a
        file that is missing, too large, not ours, damaged or of another version, and for a budget that it cannot keep.
        """
        source = packaged_model() if path is None else Path(path)
        content = read_model(source)
        if sha256 is not None and sha256.lower() != (digest := hashlib.sha256(content).hexdigest()):
            raise ModelError(f"{source}: sha256 is {digest}, the caller trusts {sha256}; take the file from its source again")
        model = parse_model(content, str(source), BOX_TENSORS, (MASK_TENSORS, SPAN_TENSORS))
        return cls(model, str(source), threads, missed_budget, extra_budget)

    def run(self, frame: NDArray) -> dict[str, Any]:
        """The model's own outputs for one frame (table in models/README.md). Raises `FrameError` as `estimate` does."""
        return self.run_unchecked(self.ideal_frame(frame))

    def run_unchecked(self, pixels: NDArray[np.uint8], budgets: Mapping[str, NDArray[np.int32]] | None = None) -> dict[str, Any]:
        """`run` for an ideal frame that is known to be uint8 (height, width) of {0, 1}: one call of onnxruntime. `budgets`: other ones.

        Raises `ModelError` if that fails, which it may for a file that no `sha256` vouches for.
        """
        try:
            feed = {"frame": pixels, **self._budgets, **(budgets or {})}
            return dict(zip(self._outputs, self._session.run(self._outputs, feed), strict=True))
        except Exception as error:  # onnxruntime raises classes of its own that share only this one
            raise ModelError(f"{self._name}: onnxruntime cannot run it ({reason_of(error)}); export it again") from error

    def estimate(
        self,
        frame: NDArray,
        proposal: ArrayLike | None = None,
        refine: bool = True,
        prior: Box | None = None,
        attitude: Attitude | None = None,
    ) -> Estimate:
        """State and certified box of one frame.

        `frame`: (height, width), bool, or uint8 of {0, 1}. `proposal`: a state (4,) from elsewhere to be checked in place of NN_e's.
        `refine`: contract the passing entries to what the frame can tell (`runtime.refine`); without it, the box is their hull. `prior`: a
        box that is known to hold the state (Theorem C); if it contradicts a frame which has a state without it, the outcome is
        INCONSISTENT. `attitude`: roll and yaw of the camera, by default the scene's; the frame is its sensor's own (`runtime.turned`), and
        Theorem A alone is used. Raises `FrameError` for any other frame, and ValueError for a proposal of another shape and a prior that is
        no box.
        """
        state = None if proposal is None else self._checked_proposal(proposal)
        attitude = self.known_attitude(attitude)
        found = self.find(frame, attitude, prior)
        if prior is None:
            return self._alone(found, refine, state)
        left = self.left_of(found, self.covering(prior, attitude), refine)
        parts = None if refine else [np.arange(len(left))]
        regions = self.regions(found, left, parts) if len(left) else ()
        otherwise = Outcome.NO_RUNWAY
        if not regions and self._alone(found if attitude is None else self.find(frame, attitude), refine).certified:
            otherwise = Outcome.INCONSISTENT
        assumed = (*self.assumed_of(found), prior_assumption(prior.lower, prior.upper))
        return self.concluded(found, regions, assumed, otherwise, state, left)

    def known_attitude(self, told: Attitude | None) -> Attitude | None:
        """Roll and yaw of the camera: as told or by the scene, and what [calibration] has of a plus-minus besides; None if level."""
        if not isinstance(told, Attitude | None):
            raise TypeError(f"attitude: found {type(told).__name__}; give an Attitude(roll_rad, yaw_rad)")
        told, off = told or self.attitude, self.scene.calibration
        return None if told is None else told.wider(off.roll_rad, off.yaw_rad)

    def find(self, frame: NDArray, attitude: Attitude | None = None, prior: Box | None = None) -> Found:
        """What the model says of a frame; of one of a rolled or yawed camera, at the pitches that a prior allows.

        `attitude`: as `known_attitude` has it. Raises `FrameError` as `estimate` does.
        """
        own, turned = self._checked_frame(frame), None
        if attitude is None:
            outputs = self.run_unchecked(self.sensor.painted(own))
        else:
            seen, window = self._seen(prior, attitude), self._refiner.window
            outputs, turned = started(self.sensor, self._entries, self._run_by_theorem_a, own, attitude, seen, self.beside_px, window)
        overflow = bool(outputs.pop(OVERFLOW, False))
        cell, support, mismatch, passes, lower, upper, filtered, network_state = outputs.values()
        network = np.where(self.scene.domain.fixed, self.domain.lower, network_state)
        if self.sensor.map is not None and turned is None:
            filtered = self.sensor.within(filtered.view(np.bool_), own)
        return Found(own, int(cell), support, mismatch, passes, lower, upper, filtered, network, overflow, turned)

    def _run_by_theorem_a(self, pixels: NDArray[np.uint8], met_by_one: int) -> dict[str, Any]:
        """`run_unchecked` of a painted frame, in which a missed pixel may spoil several; without Theorem B, which nobody vouches for."""
        budgets = {"missed_budget": self.missed_budget * met_by_one, "extra_budget": -1}
        return self.run_unchecked(pixels, {name: np.array(budget, dtype=np.int32) for name, budget in budgets.items()})

    def _seen(self, box: Box | None, attitude: Attitude | None) -> Box | None:
        """The part of a box, of the camera's pitch, that lies in the domain, of the ideal frame's; None where there is none."""
        if box is None:
            return self.domain
        if not isinstance(box, Box):
            raise ValueError(f"prior: found {type(box).__name__}; give a runtime.Box, or None")
        if attitude is not None:
            box = seen_box(box, attitude)
        low, high = np.maximum(box.lower, self.domain.lower), np.minimum(box.upper, self.domain.upper)
        return None if (low > high).any() else Box(low, high)

    def covering(self, prior: Box, attitude: Attitude | None = None) -> StateSet:
        """The part of a box that lies in the domain's hull, as a set of states; no set where there is none."""
        box = self._seen(prior, attitude)
        return self._entries.all[:0] if box is None else covering(self.ideal.camera, box, self.ideal.camera.v0)

    def left_of(self, found: Found, known: StateSet | None = None, refine: bool = True) -> StateSet:
        """Sets that hold every state which is consistent with the frame and, by Theorem C, lies in one of the `known` sets.

        Of a rolled or yawed camera, their theta is the pitch that the ideal frame shows, and so is that of the `known` ones.
        """
        cut = None if known is None else partial(within, self.ideal.camera, known=known)
        if found.turned is not None:
            return found.turned.left(self._sensor_refiner, cut, refine)
        if self.sensor.map is not None:
            entries = self._entries.sets(found.passes)
            entries = entries if cut is None else cut(entries)
            lit = witnesses(found.pixels.view(np.bool_), self.beside_px)
            return refined(self._sensor_refiner, self.sensor.optics, lit, entries, cut is not None) if refine else entries
        frame, line_px = found.pixels.view(np.bool_), self.ideal.tolerance.line_px
        if refine and self._refiner.extra_budget >= 0 and line_px == 0:  # Theorem B's claims are made at tolerance 0 only
            return refined_by_cell(self._refiner, self._entries, found.passes, frame, cut)
        entries = self._entries.sets(found.passes)
        entries = entries if cut is None else cut(entries)
        if not refine or len(entries) == 0:
            return entries
        return self._refiner.refine(witnesses(frame, line_px), entries, narrowed=cut is not None)

    def concluded(
        self,
        found: Found,
        regions: tuple[Box, ...],
        assumed: tuple[str, ...],
        otherwise: Outcome = Outcome.NO_RUNWAY,
        proposal: NDArray[np.float64] | None = None,
        left: StateSet | None = None,
    ) -> Estimate:
        """The estimate whose box is the hull of `regions`; its outcome is `otherwise` where there are none.

        `left`: the sets that they are around, which a rolled or yawed camera's faces of the domain are seen by.
        """
        box = Box.around(regions)
        state, used_fallback = self._shielded(box, found.network_state if proposal is None else proposal)
        return Estimate(
            outcome=otherwise if box is None else Outcome.CERTIFIED,
            box=box,
            state=state,
            used_fallback=used_fallback,
            network_state=found.network_state,
            cell=found.cell,
            passing=np.flatnonzero(found.support),
            mismatch=int(found.mismatch[found.cell]),
            filtered=found.filtered,
            regions=regions,
            touches_boundary=box is not None and self._reaches_boundary(found, box, left),
            assumed=assumed,
        )

    def assumed_of(self, found: Found) -> tuple[str, ...]:
        """What a certificate by this frame rests on, in words."""
        return self.assumed if found.turned is None else found.turned.assumed(self.assumed)

    def regions(self, found: Found, left: StateSet, parts: Sequence[NDArray[np.int64]] | None = None) -> tuple[Box, ...]:
        """Boxes around parts of what is left, by default the connected ones; of a rolled or yawed camera, by its own pitch."""
        return regions_of(left, self.domain, parts) if found.turned is None else found.turned.regions(left, self.domain, parts)

    def _alone(self, found: Found, refine: bool, proposal: NDArray[np.float64] | None = None) -> Estimate:
        """The estimate by the frame alone."""
        passing, left = np.flatnonzero(found.support), None
        if found.turned is not None or (refine and len(passing)):
            left = self.left_of(found, refine=refine)
            regions = self.regions(found, left, None if refine else [np.arange(len(left))]) if len(left) else ()
        else:
            cells = [np.arange(len(passing))] if len(passing) else []
            regions = hulls(found.cell_lower[passing], found.cell_upper[passing], cells, self.domain)
        return self.concluded(found, regions, self.assumed_of(found), proposal=proposal, left=left)

    def ideal_frame(self, frame: NDArray) -> NDArray[np.uint8]:
        """What NN_F sees of a frame: the frame, or behind a lens what is painted of it. Raises `FrameError` as `estimate` does."""
        return self.sensor.painted(self._checked_frame(frame))

    def entries_within(self, frame: NDArray, missed_budget: int) -> StateSet:
        """The bank's entries of whose pixels K, of the ideal frame, at most so many are dark: at another budget no certificate of anything.

        Raises `FrameError` as `estimate` does.
        """
        budgets = {"missed_budget": np.array(missed_budget, dtype=np.int32), "extra_budget": np.array(-1, dtype=np.int32)}
        (passes,) = self._session.run(["passes"], {"frame": self.ideal_frame(frame), **budgets})
        return self._entries.sets(np.asarray(passes))

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
            return by_processes(partial(_loaded, self._arguments), self.scene.camera.width, pixels, processes)
        return by_threads(partial(self.estimate, refine=False), pixels, processes)

    def spatial_mask(self, cell: int, attitude: Attitude | None = None) -> NDArray[np.bool_]:
        """S of a cell, (height, width): every pixel that one of its states can light, widened by the tolerance.

        For an attitude what a camera at its middle and at the middle of the cell's pitch shows of it, for drawing.
        """
        mask = self._entries.within(cell, np.ones(self.ideal.camera.shape, dtype=np.bool_))
        if attitude is None:
            return self.sensor.seen_in(mask)
        lower, upper = self.scene.domain.cells()
        return seen_by_turned(self.sensor, mask, attitude, float(lower[cell][0] + upper[cell][0]) / 2, self._refiner.window)

    def _reaches_boundary(self, found: Found, box: Box, left: StateSet | None) -> bool:
        """True if a box reaches a face of the domain; of a rolled or yawed camera, if what is left does, by the ideal frame's pitch."""
        seen = box if found.turned is None or left is None else hull_of(left)
        return self.scene.domain.reaches_boundary(seen.lower, seen.upper)

    @staticmethod
    def _shielded(box: Box | None, proposal: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, bool]:
        """The paper's Eq. (8): the proposal if it lies in the box, else the box's centre; and whether the centre was taken."""
        if box is None:
            return None, False
        return (proposal, False) if box.contains(proposal) else (box.centre, True)

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
        count = self.sensor.pixels_a_pixel
        if not 0 <= count * missed < weakest:
            largest = (weakest - 1) // count
            raise ModelError(f"{name}: missed_budget {missed}: must be 0 to {largest}, below the smallest |K| of its entries")
        if self.sensor.map is not None and extra != -1:
            raise ModelError(f"{name}: extra_budget {extra}: behind a lens only Theorem A holds; give -1")
        if not -1 <= extra < 2**31:
            raise ModelError(f"{name}: extra_budget {extra}: must be 0 or more, or -1 for not used")
        return {"missed_budget": np.array(count * missed, dtype=np.int32), "extra_budget": np.array(extra, dtype=np.int32)}


def _sensor_of(scene: Scene, metadata: dict[str, Any], name: str) -> Sensor:
    """What stands between a model's frames and its ideal ones. Raises `ModelError` if that is not what its metadata say."""
    try:
        sensor = Sensor.of(scene)
    except SceneError as error:
        raise ModelError(f"{name}: the scene in its metadata is unusable ({error})") from error
    stated = metadata.get("ideal_camera"), metadata.get("ideal_pixels_a_pixel")
    expected = (None, None) if sensor.map is None else (sensor.ideal.to_dict()["camera"], sensor.pixels_a_pixel)
    if stated != expected:
        raise ModelError(f"{name}: its ideal frame is not the one that its camera has; export it again with export-model")
    return sensor


def _loaded(arguments: dict[str, Any]) -> Callable[[NDArray[np.uint8]], Estimate]:
    """`estimate` of the model that these arguments of `load` give, for another process."""
    return Estimator.load(**arguments).estimate

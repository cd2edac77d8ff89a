"""Frames of a camera with roll and yaw: NN_F sees them painted onto the ideal frame, the refinement sees the sensor's own pixels.

A rotation within the plus-minus, and what it does at a pitch, is an interval of rotations (`runtime.attitude`). Where that moves the ideal
frame by more than about `BLUR_PX`, it is cut into bins of pitch, yaw and roll: each has a painted frame and a run of NN_F of its own.
Theorem A holds of each: with at most m pixels of the sensor's image dark, at most c m of the painted frame's are, c being the pixels of
the ideal frame that markings can meet inside one pixel of the sensor. So a state whose pitch, yaw and roll lie in a bin lies in an entry
that passes there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.assumptions import attitude_assumptions
from runtime.attitude import Attitude, Turns, camera_pitch, seen_pitch
from runtime.estimate import Box
from runtime.model.entries import Entries
from runtime.model.format import OVERFLOW
from runtime.motion import STEEPEST_RAD
from runtime.on_sensor import refined
from runtime.outline import Window
from runtime.painting import Painted
from runtime.refine.refiner import Refiner, joined
from runtime.refine.regions import regions_of
from runtime.refine.witnesses import witnesses
from runtime.scene import Camera, Scene
from runtime.sensor import Sensor
from runtime.sensor_map import LARGEST_ANGLE_RAD, SensorMap, Turn
from runtime.state_set import StateSet

Floats = NDArray[np.float64]
Bits = NDArray[np.bool_]

BLUR_PX = 2.0
"""Bins of pitch, yaw and roll are so narrow that none moves a point of the ideal frame by much more than this."""
MOST_BINS = 4096
"""More runs of NN_F than this are not made: bins are wider then."""


@dataclass(frozen=True)
class Bin:
    """Intervals, (1, 2) each, rad: of the pitch that the ideal frame shows, of roll and of yaw."""

    pitch: Floats
    roll: Floats
    yaw: Floats

    @property
    def turns(self) -> Turns:
        """The rotations of its states."""
        return Turns.of(self.pitch, self.roll, self.yaw)

    def of(self, sets: StateSet) -> StateSet:
        """The part of the sets that has a pitch of this bin, with its roll and yaw; sets without such a part are left out."""
        theta = np.stack([np.maximum(sets.theta[:, 0], self.pitch[0, 0]), np.minimum(sets.theta[:, 1], self.pitch[0, 1])], axis=-1)
        roll, yaw = (np.repeat(side, len(sets), axis=0) for side in (self.roll, self.yaw))
        return replace(sets, theta=theta, roll=roll, yaw=yaw)[theta[:, 0] <= theta[:, 1]]


def bins_of(camera: Camera, attitude: Attitude, pitch: tuple[float, float]) -> Iterator[Bin]:
    """Bins that cover the attitude at an interval of the pitch that the ideal frame shows."""
    reach = math.hypot(camera.width, camera.height) / 4  # of a point about whose distance from the centre is in the middle
    whole = Bin(np.array([pitch]), np.array([attitude.roll]), np.array([attitude.yaw]))
    by_pitch = Turns.of(whole.pitch, np.zeros((1, 2)), whole.yaw.mean() * np.ones((1, 2)))
    moved_px = 2 * (by_pitch.off_b[0] * camera.focal_u_px + by_pitch.off_a[0] * reach)
    spans = moved_px, np.ptp(whole.yaw) * camera.focal_u_px, np.ptp(whole.roll) * reach
    counts = [max(math.ceil(span / BLUR_PX), 1) for span in spans]
    while math.prod(counts) > MOST_BINS:
        counts = [max(math.ceil(count / 2), 1) for count in counts]
    pitches, yaws, rolls = (_cut(side[0], count) for side, count in zip((whole.pitch, whole.yaw, whole.roll), counts, strict=True))
    return (Bin(one[None], roll[None], yaw[None]) for one in pitches for yaw in yaws for roll in rolls)


def _cut(interval: Floats, count: int) -> Floats:
    """Equal parts of an interval (2,), which share their borders: (count, 2)."""
    edges = interval[0] + (interval[1] - interval[0]) * (np.arange(count + 1) / count)
    edges[-1] = interval[1]
    return np.stack([edges[:-1], edges[1:]], axis=-1)


@dataclass(frozen=True)
class TurnedStart:
    """What a frame of a rolled or yawed camera leaves of the bank."""

    sensor: Sensor
    attitude: Attitude
    lit: Bits
    """The sensor's frame, (height, width), dilated by the tolerance: what lies beyond it is lit."""
    parts: tuple[StateSet, ...]
    """For every bin the entries that pass on its painted frame, with its roll and yaw."""

    def left(self, refiner: Refiner, cut: Callable[[StateSet], StateSet] | None, refine: bool) -> StateSet:
        """What of the entries is consistent with the sensor's frame, and with what is known besides, to which `cut` cuts."""
        together = joined(*(sets if cut is None else cut(sets) for sets in self.parts))
        return refined(refiner, self.sensor.optics_at(self.attitude), self.lit, together, cut is not None) if refine else together

    def regions(self, left: StateSet, domain: Box, parts: Sequence[NDArray[np.int64]] | None) -> tuple[Box, ...]:
        """Boxes around parts of what is left, by the camera's pitch; `domain` is of the pitch that the ideal frame shows."""
        if len(left) == 0:
            return ()
        assert left.yaw is not None
        theta = camera_pitch(left.theta, left.yaw)
        seen = replace(left, theta=theta, roll=None, yaw=None)
        return regions_of(seen, domain.replace(theta=(theta[:, 0].min(), theta[:, 1].max())), parts)

    def of(self, sets: StateSet) -> StateSet:
        """Sets that are known from elsewhere, with the attitude's roll and yaw."""
        return _with(sets, self.attitude)

    def assumed(self, otherwise: tuple[str, ...]) -> tuple[str, ...]:
        """What a certificate rests on: the model's assumptions, that of the attitude in the place of none."""
        return (*attitude_assumptions(self.sensor.scene, str(self.attitude), len(self.parts)), *otherwise[2:])


def started(
    sensor: Sensor,
    entries: Entries,
    run: Callable[[NDArray[np.uint8], int], dict[str, Any]],
    pixels: NDArray[np.uint8],
    attitude: Attitude,
    seen: Box | None,
    beside_px: int,
    window: Window,
) -> tuple[dict[str, Any], TurnedStart]:
    """NN_F's outputs on the painted frames of all bins, taken together, `filtered` in the sensor's frame, and what of the bank passes.

    `run`: NN_F on a frame, with the budget of missed pixels times a number. `pixels`: the sensor's frame. `seen`: a box that holds the
    state, with the pitch that the ideal frame shows; None if there is none. `beside_px`: how far beside its place a pixel may fire.
    `window`: of the ideal frame, what is looked at.
    """
    scene = sensor.ideal
    lit = witnesses(pixels.view(np.bool_), beside_px)
    if seen is None:
        outputs = {**run(np.zeros(scene.camera.shape, dtype=np.uint8), 1), "filtered": np.zeros_like(pixels)}
        return outputs, TurnedStart(sensor, attitude, lit, (_with(entries.all[:0], attitude),))
    together: dict[str, Any] = {}
    parts = []
    for each in bins_of(scene.camera, attitude, (float(seen.lower[0]), float(seen.upper[0]))):
        turns = each.turns
        map_of_bin = turned_map(sensor, turns)
        painted = Painted.of(lit, map_of_bin, sensor.outline, window)
        outputs = run(painted.ideal, met_by_one(scene, turns, sensor.still))
        outputs["filtered"] = painted.within(outputs["filtered"].view(np.bool_), pixels)
        if sensor.runway_beyond:
            outputs["filtered"] |= pixels & sensor.outline.not_within(map_of_bin)
        parts.append(each.of(entries.sets(outputs["passes"])))
        together = _together(together, outputs)
    return together, TurnedStart(sensor, attitude, lit, tuple(parts))


def turned_map(sensor: Sensor, turns: Turns) -> SensorMap:
    """The map of a sensor for the rotations of one set."""
    a, b = ((float(cosine[0]), float(sine[0]), float(off[0])) for cosine, sine, off in _sides(turns))
    return replace(sensor.still, turn=Turn(a, b))


def seen_by_turned(sensor: Sensor, mask: Bits, attitude: Attitude, pitch: float, window: Window) -> Bits:
    """The pixels of the sensor that show some pixel of a mask of the ideal frame, within its window: for one pitch that this shows, and
    the attitude's middle. For drawing.
    """
    sides = (np.array([[side, side]]) for side in (pitch, attitude.roll_rad, attitude.yaw_rad))
    every = np.ones(sensor.scene.camera.shape, dtype=np.uint8)
    whole = Painted.of(every.view(np.bool_), turned_map(sensor, Turns.of(*sides)), sensor.outline, window)
    return whole.within(mask, every).view(np.bool_)


def _sides(turns: Turns) -> tuple[tuple[Floats, Floats, Floats], ...]:
    return (turns.cos_a, turns.sin_a, turns.off_a), (turns.cos_b, turns.sin_b, turns.off_b)


def _with(sets: StateSet, attitude: Attitude) -> StateSet:
    return replace(sets, **{name: np.tile(getattr(attitude, name), (len(sets), 1)) for name in ("roll", "yaw")})


def _together(before: dict[str, Any], outputs: dict[str, Any]) -> dict[str, Any]:
    """Outputs of NN_F for several bins as of one: what passes in one passes; the state is that of the bin with the most support."""
    if not before:
        return dict(outputs)
    more = outputs["support"].max() > before["support"].max()
    both = dict(outputs if more else before)
    both["passes"] = before["passes"] | outputs["passes"]
    both["support"] = np.maximum(before["support"], outputs["support"])
    both["mismatch"] = np.minimum(before["mismatch"], outputs["mismatch"])
    for name in {"filtered", OVERFLOW} & set(both):
        both[name] = before[name] | outputs[name]
    return both


def met_by_one(scene: Scene, turns: Turns, still: SensorMap | None = None) -> int:
    """Most pixels of the ideal frame that all markings together can meet inside what one pixel of the sensor shows.

    With S' = cos(a) S + sin(a) T, d(X/Z)/dS' = 1/Z^2 and d(Y/Z) = dT'/Z - Y sin(b) dS'/Z^2. What spans w px meets at most floor(w) + 2
    columns or rows, and a straight line in so many columns and rows one pixel fewer than they are together. `still`: the sensor's map,
    where that is no pinhole with the ideal frame's own focal lengths.
    """
    camera = scene.camera
    cos_a, sin_a, sin_b = (float(np.abs(side[0])) + float(off[0]) for side, off in _sizes(turns))
    sides, heights, wide, tall = _of_a_pixel(camera, turns, still)
    aside, down = cos_a * sides + sin_a * heights, cos_a * heights + sin_a * sides
    ahead = float(turns.cos_b[0] - turns.off_b[0]) - sin_b * aside
    if ahead <= 0:
        return camera.width * camera.height
    across, fall = cos_a * wide + sin_a * tall, cos_a * tall + sin_a * wide
    spans = camera.focal_u_px * across / ahead**2, camera.focal_v_px * (fall / ahead + down * sin_b * across / ahead**2)
    columns, rows = (math.floor(span * (1 + 2.0**-30)) + 2 for span in spans)
    return min(columns * rows, len(scene.runway.markings) * (columns + rows - 1))


def _of_a_pixel(camera: Camera, turns: Turns, still: SensorMap | None) -> tuple[float, float, float, float]:
    """Largest |S| and |T| of rays that the ideal frame can show, and the width and height in rays of what a pixel shows.

    A step of h in the sensor's frame is J^-1 h, J the lens's Jacobian with eigenvalues from l to L: along itself at most h/l, across
    h (1/l - 1/L)/2.
    """
    sides = float(np.abs([camera.u0, camera.width - camera.u0]).max() / camera.focal_u_px)
    heights = float(np.abs([camera.v0, camera.height - camera.v0]).max() / camera.focal_v_px)
    wide, tall = 1 / camera.focal_u_px, 1 / camera.focal_v_px
    if still is None or (still.lens.model is None and still.calibration.exact):
        return sides, heights, wide, tall
    zoom = 1 / (1 - still.calibration.focal_relative)
    angle = math.atan(math.hypot(sides, heights)) + math.asin(min(float(np.abs(turns.sin_b[0]) + turns.off_b[0]), 1.0))
    farthest = min(math.tan(angle), still.lens.radius) if angle < LARGEST_ANGLE_RAD else still.lens.radius
    step = zoom * max(wide, tall) / still.lens.stretch
    least = still.lens.stretch_within(farthest + 2 * step) if farthest + 2 * step < still.lens.radius else still.lens.stretch
    along, beside = zoom / least, zoom * (1 / least - 1 / still.lens.largest_scale) / 2
    return farthest, farthest, along * wide + beside * tall, along * tall + beside * wide


def _sizes(turns: Turns) -> tuple[tuple[Floats, Floats], ...]:
    return (turns.cos_a, turns.off_a), (turns.sin_a, turns.off_a), (turns.sin_b, turns.off_b)


def seen_box(box: Box, attitude: Attitude) -> Box:
    """A box of the camera's states with the pitch that the ideal frame may show of them."""
    theta = np.array([[box.lower[0], box.upper[0]]])
    low, high = seen_pitch(np.clip(theta, -STEEPEST_RAD, STEEPEST_RAD), np.array([attitude.yaw]))[0]
    below, above = theta[0] < -STEEPEST_RAD, theta[0] > STEEPEST_RAD  # all that a pitch of the ideal frame can be, then
    return box.replace(theta=(-math.pi / 2 if below[0] else low, math.pi / 2 if above[1] else high))


def hull_of(sets: StateSet) -> Box:
    """The box around all sets."""
    return Box(sets.lower.min(axis=0), sets.upper.max(axis=0))

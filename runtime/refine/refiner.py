"""From the entries that pass to the states that one image cannot tell apart: the certified box at its limit.

Every passing entry (`build_model.hough_bank`) is a set of states. It is cut into thin slices of theta, and each slice is contracted by
what the frame shows. A state whose markings cross the border r of two rows lights a pixel on both sides of it (Theorem A), so

    u(r) = u0 + (p_x - x) scale R(theta, r)  lies in the closed columns of a lit pixel above r, and of one below r

up to the missed pixels. In a thin slice R is all but a number, and every border bounds each marking's offset (p_x - x) scale on both
sides; so does, if none may be missed, the lit pixel of an end, and two borders bound theta (`scales`). Beyond the rows that all
states of the slice cross, the first row without a usable lit pixel ends a marking, and so bounds its distance. Slices that contradict the
frame are dropped; the others are cut finer, in the end only those that carry a face of the box.

Under Theorem B the lit pixels of S (here: vouched pixels) are the runway's, but for `extra_budget` of them. A vouched pixel that only one
marking of the slice could light bounds that marking's offset by the pixel's other side, and pulls its ends out to the pixel's row.

Guarantee: each state of the given entries that is consistent with the frame stays in some slice. Pixels outside the frame count as
lit. A dark pixel of the runway spoils at most the two borders of its row and one row of an end, for each marking that shares it.

Every bound is rounded outward where it is made (`runtime.rounding`), by a margin that grows with the terms it is the sum or quotient of.
So a set is empty exactly where an interval is inverted. "No bound" is an infinity of the right sign; a marking that the frame contradicts
is a mask. Rows that no pixel of the window lies in are not looked at.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from runtime.refine.altitude import contract_by_altitude
from runtime.refine.ends import contract_by_ends
from runtime.refine.interval import Bits, Floats
from runtime.refine.lit_pixels import LitPixels
from runtime.refine.offsets import contract_by_offsets
from runtime.refine.optics import Optics
from runtime.refine.scales import contract_by_scales
from runtime.refine.sight import Sight, Vouched
from runtime.refine.vouched import contract_by_vouched
from runtime.scene import Scene
from runtime.state_set import StateSet

CONTRACTORS: tuple[Callable[[StateSet, Sight], StateSet], ...] = (
    contract_by_offsets,
    contract_by_vouched,
    contract_by_scales,
    contract_by_ends,
)
"""Each gives subsets of the sets that hold all their states which the frame allows; in the order in which one helps the next."""


@dataclass(frozen=True)
class Search:
    """How the entries are cut: all of them at first, then in rounds the pieces that carry a face of the box around what is left."""

    first: int
    """Sets that the entries are cut into along theta, about."""
    sets: int
    """Sets of a round, about: what is not cut otherwise is cut along theta, in two or more."""
    pieces: int
    """How many pieces a face, at most."""
    rounds: int
    gain: float
    """At most so many rounds, and until one takes less than this share from every side of the box."""
    finest: int = 16
    """A set is cut into no more parts along theta at once."""
    z: int = 1
    scale: int = 1
    roll: int = 1
    yaw: int = 1
    """Parts that a piece which carries a face is cut into along each interval."""
    patience: int = 1
    """So many rounds in a row must take less than the share."""
    together: bool = False
    """Scale and z are cut in every round, not in turns."""

    def others(self, number: int) -> dict[str, int]:
        """Parts along all intervals but theta's in the round of this number: along scale and z in turns, scale first, or along both."""
        parts = {name: getattr(self, name) for name in ("z", "scale", "roll", "yaw")}
        return parts if self.together else parts | {"scale" if number % 2 else "z": 1}


FACES = 6
"""Of the box in theta, y and z that is searched."""
NONE_MISSED = Search(first=48, sets=96, pieces=6, rounds=4, gain=0.06, z=2, scale=2)
SOME_MISSED = Search(first=48, sets=144, pieces=6, rounds=20, gain=0.03, z=2, scale=2)
"""Missed pixels are counted where windows are a pixel or two wide (`missed`): then smaller pieces pay, cut along the scale too."""
NARROWED = Search(first=48, sets=144, pieces=6, rounds=20, gain=0.01, z=2, scale=2, patience=2)
"""Pixels may be missed, and the entries were cut to a prior: they are few, so that there is time for small gains, and for a round without
one, after which the pieces that carry the faces are small enough for the next one to tell more."""
SOME_MISSED_X_KNOWN = replace(SOME_MISSED, first=24, sets=216, gain=0.06, together=True)
NARROWED_X_KNOWN = replace(NARROWED, first=4, pieces=4, together=True)
"""Where x is known theta needs fewer slices, and cutting scale and z at once tells more of z; where it is not, theta is worth the sets."""
TURNED = Search(first=128, sets=128, pieces=6, rounds=40, gain=0.04, finest=8, z=2, scale=2, patience=2)
"""Pairs of borders tell nothing on a turned sensor: theta is cut, round by round, and the scale: some frames stay far wider without."""
UNKNOWN = Search(first=512, sets=512, pieces=8, rounds=40, gain=0.01, finest=4, z=2, scale=2, patience=2, together=True)
"""Where a camera may be off by its calibration, each piece is left with what that hides: more of them carry a face, and are cut smaller."""
SWAYING = Search(first=512, sets=1024, pieces=16, rounds=80, gain=0.002, finest=4, roll=2, yaw=2, patience=3)
"""Roll and yaw are known up to a plus-minus alone: half of it then tells more than half of a slice, and many pieces carry one face."""
LEAST_SWAY_PX = 0.25
"""A plus-minus that moves no point of the frame by as much is not cut."""
LARGEST_START = 2**12
"""More passing entries than this say that the frame tells next to nothing: they are left as they are, at a bounded cost."""
LARGEST_SENSOR_START = 2**13
"""The same of a sensor's frame, whose entries are those of all bins of pitch, yaw and roll."""
FEW, LARGEST_START_ROWS = 2**9, 2**22
"""Of a level pinhole, so few are refined however many rows their markings show; more are left, too, if these show more rows than this."""
LARGEST_ROUND = 2**18
"""Rows of markings that a round looks at, about: where each set shows very many, fewer pieces are cut, and less finely at first."""
LARGEST_BLOCK = 2**19
"""Sets are contracted so many at once that their markings have no more rows than this between them: memory is bounded."""
LARGEST_SEARCH = 2**24
"""Rows of markings that all rounds look at together, about: time is bounded, too, where many rounds go on gaining."""


@dataclass(frozen=True)
class Refiner:
    """Refines the entries of one model. `missed_budget` is m, `extra_budget` is e."""

    scene: Scene
    missed_budget: int
    extra_budget: int
    window: tuple[slice, slice] = (slice(None), slice(None))
    """Rows and columns outside of which pixels count as lit, whatever the frame shows there."""
    optics: Optics | None = None
    """Of the lens, where the frame is that of the sensor behind it; `scene` is the sensor's then."""
    most_rows: int = LARGEST_SEARCH
    """No more rounds are begun when so many rows were looked at."""

    def refine(self, frame: Bits, entries: StateSet, vouched_pixels: Bits | None = None, narrowed: bool = False) -> StateSet:
        """Slices that hold all states of `entries` which are consistent with `frame`, (height, width); none if there is none.

        `frame` is dilated by the tolerance. `vouched_pixels`: the lit pixels of S, for Theorem B at tolerance 0; the entries are of one
        cell then. `narrowed`: the entries were cut to what is known besides the frame.
        """
        flat = self.optics is None and entries.roll is None
        if self.too_many(len(entries), frame) if flat else len(entries) > LARGEST_SENSOR_START:
            return entries
        witnesses = LitPixels.of(frame, self.window, beyond=True)
        vouched = None if vouched_pixels is None else Vouched(LitPixels.of(vouched_pixels, self.window, beyond=False), self.extra_budget)
        level = NONE_MISSED if flat else TURNED if self.optics is None or self.optics.calibration.exact else UNKNOWN
        search = level if self.missed_budget == 0 else _search_with_missed(entries, narrowed)
        if not flat:
            entries = self._contracted(witnesses, vouched, entries)  # most contradict the frame as they are
            search = self._with_turns(search, entries) if entries.roll is not None else search
        set_rows = len(self.scene.runway.markings) * witnesses.rows
        most_sets = max(LARGEST_ROUND // set_rows, 1)
        a_face = min(max(most_sets // (FACES * 2 * max(math.prod(search.others(number).values()) for number in (0, 1))), 1), search.pieces)
        slices = _parts(min(search.first, most_sets), len(entries), 1, search.finest)
        pieces = self._contracted(witnesses, vouched, _cut(entries, theta=slices, roll=search.roll, yaw=search.yaw))
        extent, idle, looked_at = _extent(pieces), 0, 0
        for number in range(search.rounds if len(pieces) else 0):
            outer = _carries_a_face(pieces, a_face)
            others = search.others(number)
            slices = _parts(min(search.sets, most_sets), int(outer.sum()) * math.prod(others.values()), 2, search.finest)
            cut = _cut(pieces[outer], theta=slices, **others)
            looked_at += len(cut) * set_rows
            finer = self._contracted(witnesses, vouched, cut)
            pieces, before = joined(finer, pieces[~outer]), extent
            extent = _extent(pieces)
            idle = idle + 1 if (extent >= (1 - search.gain) * before).all() else 0
            if idle == search.patience or looked_at > self.most_rows:
                break
        return pieces

    def too_many(self, entries: int, frame: Bits) -> bool:
        """True if so many entries are left as they are, of a frame (height, width) of a level pinhole."""
        rows = len(range(*self.window[0].indices(frame.shape[0])))
        return entries > LARGEST_START or (entries > FEW and entries * len(self.scene.runway.markings) * rows > LARGEST_START_ROWS)

    def _with_turns(self, search: Search, entries: StateSet) -> Search:
        """The search of entries with roll and yaw, which cuts them where their plus-minus moves a point of the frame visibly.

        What the calibration has of that is not worth cutting: it is told from the rest of the calibration by nothing.
        """
        camera, off = self.scene.camera, self.scene.calibration
        reach = {"roll": math.hypot(camera.width, camera.height) / 2, "yaw": max(camera.focal_u_px, camera.focal_v_px)}
        beside = {"roll": 2 * off.roll_rad, "yaw": 2 * off.yaw_rad}
        widths = {name: (float(np.ptp(getattr(entries, name), axis=1).max(initial=0.0)) - beside[name]) * px for name, px in reach.items()}
        cuts = {name: getattr(SWAYING, name) for name, width_px in widths.items() if width_px >= LEAST_SWAY_PX}
        if not cuts:
            return search
        finer = replace(SWAYING, z=search.z, scale=search.scale) if self.missed_budget > 0 else SWAYING
        return replace(finer, **{"roll": 1, "yaw": 1, **cuts})

    def _contracted(self, witnesses: LitPixels, vouched: Vouched | None, sets: StateSet) -> StateSet:
        """The sets without most of the states that the frame contradicts, and without empty sets."""
        size = max(LARGEST_BLOCK // (len(self.scene.runway.markings) * witnesses.rows), 1)
        blocks = (sets[first : first + size] for first in range(0, max(len(sets), 1), size))
        return joined(*(self._contracted_block(witnesses, vouched, block) for block in blocks))

    def _contracted_block(self, witnesses: LitPixels, vouched: Vouched | None, sets: StateSet) -> StateSet:
        """`_contracted` for some sets at once."""
        if len(sets) == 0:
            return sets
        sets = contract_by_altitude(self.scene.camera, sets)
        sight = Sight.of(self.scene, sets, witnesses, self.missed_budget, vouched, self.optics)
        if self.missed_budget > 0:  # then most sets miss too many pixels, and each costs more
            left = np.flatnonzero(sight.missed.left >= 0)
            sets, sight = sets[left], sight.of_sets(left)
            if len(sets) == 0:
                return sets
        for contract in CONTRACTORS:
            sets = contract(sets, sight)
        sets = contract_by_altitude(self.scene.camera, sets)
        empty = sets.empty
        return sets[~empty] if empty.any() else sets


def _search_with_missed(entries: StateSet, narrowed: bool) -> Search:
    if entries.x_known:
        return NARROWED_X_KNOWN if narrowed else SOME_MISSED_X_KNOWN
    return NARROWED if narrowed else SOME_MISSED


def _parts(wanted: int, sets: int, least: int, finest: int) -> int:
    """Parts that each of so many sets is cut into, from `least` to `finest`, so that there are as many as wanted in all, about."""
    return min(max(wanted // max(sets, 1), least), finest)


def _cut(sets: StateSet, **parts: int) -> StateSet:
    """A copy with every set cut into equal parts along the named axes; neighbours share their borders to the last bit."""
    total = math.prod(parts.values())
    pieces, cuts, outer = sets[np.arange(len(sets)).repeat(total)], {}, 1
    for axis, count in parts.items():
        if count > 1:
            interval = getattr(sets, axis)
            edges = interval[:, :1] + (interval[:, 1:] - interval[:, :1]) * (np.arange(count + 1) / count)
            edges[:, -1] = interval[:, 1]
            shape = len(sets), outer, count, total // (outer * count)
            sides = np.empty((2, *shape))
            sides[:] = np.array([edges[:, :-1], edges[:, 1:]])[:, :, None, :, None]
            cuts[axis] = sides.reshape(2, -1).T
            outer *= count
    return replace(pieces, **cuts)


def joined(*parts: StateSet) -> StateSet:
    """All sets of the given batches in one."""
    if len(parts) == 1:
        return parts[0]
    names = ["theta", "x", "y", "z", "scale", "tangent"]
    names += ["roll", "yaw"] if all(part.roll is not None for part in parts) else []
    return StateSet(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _carries_a_face(sets: StateSet, pieces: int) -> Bits:
    """True for the `pieces` sets that reach farthest on each side of theta, y and z."""
    chosen = np.zeros(len(sets), dtype=bool)
    if len(sets) <= pieces:
        return ~chosen
    reach = np.empty((FACES, len(sets)))
    for side, bound in enumerate((sets.theta, sets.y, sets.z)):
        reach[2 * side] = bound[:, 0]
        np.negative(bound[:, 1], out=reach[2 * side + 1])
    farthest = reach.argsort(axis=1, kind="stable")  # ties are broken alike on every machine
    chosen[farthest[:, :pieces]] = True
    return chosen


def _extent(sets: StateSet) -> Floats:
    """Sides of the box around all sets, along theta, y and z; of no sets, 0."""
    if len(sets) == 0:
        return np.zeros(3)
    return np.array([np.maximum.reduce(side[:, 1]) - np.minimum.reduce(side[:, 0]) for side in (sets.theta, sets.y, sets.z)])

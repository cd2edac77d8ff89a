"""How a camera is turned, and what is told of it: exactly, by a reading with a plus-minus, by a mount and an aircraft's reading, or by the
scene alone."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from flint import arb
from random_scenes.outcomes import Kinds
from random_scenes.sights import Rng
from rational_image import RationalState
from turned_state import HAIR, Angles, Floats, TurnedState, holds

from cameras.scenes import LARGEST_RAD
from runtime import Attitude, Box, Estimator
from runtime.attitude import Angle, mounted
from runtime.scene import Scene
from runtime.turned import bins_of, seen_box

KNOWN = {"level": 0.15, "attitude known exactly": 0.65, "attitude to 0.1 degrees": 0.12, "attitude to 0.6 degrees": 0.08}
"""How well the attitude is known, and how often: a plus-minus takes ten times as long as none."""
EXACTLY_KNOWN = {"level": 0.2, "attitude known exactly": 0.8}
"""The same of a campaign in which all is told exactly: of a mounted camera the aircraft's pitch too, from which its roll and yaw follow."""
Shares = dict[str, float]
PLUS_MINUS_RAD = {"attitude to 0.1 degrees": (1e-5, 0.0017), "attitude to 0.6 degrees": (0.0017, 0.01)}
"""Of roll and of yaw; one of them is known exactly in a third of the frames."""
PITCH_TOLD, PITCH_PLUS_MINUS_RAD = 0.4, (1e-4, 0.01)
MOST_RUNS = 16
"""NN_F is run no more often a frame: what is told is told the better instead, first of the pitch."""
HALVINGS = 30
NOT_MOUNTED = "mount refused: the camera's own reading"


@dataclass(frozen=True)
class Told:
    """What is told of a frame's camera: its attitude, None where the scene tells it, and a box that holds its state, if any."""

    attitude: Attitude | None
    prior: Box | None
    kinds: Kinds

    def holds(self, state: TurnedState, estimator: Estimator) -> bool:
        """True if a state is as the camera is told to be, by the frame's attitude or the scene's, and its calibration."""
        attitude = estimator.known_attitude(self.attitude)
        roll, _, yaw = state.angles
        if attitude is None:
            return state.a == state.b == 0 and self._in_prior(state)
        inside = holds(attitude.roll[0], roll, attitude.roll[1]) and holds(attitude.yaw[0], yaw, attitude.yaw[1])
        return inside and self._in_prior(state)

    def _in_prior(self, state: TurnedState) -> bool:
        return self.prior is None or state.within(self.prior.lower, self.prior.upper)


def draw_turn(rng: Rng, seen: RationalState, bounds: Attitude | None) -> TurnedState:
    """A state whose roll and yaw lie within the bounds, or within `LARGEST_RAD`, often at the largest, at none or near to it."""
    sides = ((-LARGEST_RAD, LARGEST_RAD),) * 2 if bounds is None else (bounds.roll, bounds.yaw)
    angles = []
    for low, high in sides:
        shares = [0.0, 1.0, float(rng.uniform(0, 1))] if bounds is None else [1e-9, 1 - 1e-9, float(rng.uniform(1e-9, 1 - 1e-9))]
        angle = low + (high - low) * float(rng.choice(shares, p=[0.1, 0.1, 0.8]))
        angles.append(float(rng.choice([angle, 0.0, angle * 1e-6], p=[0.84, 0.08, 0.08])) if bounds is None else angle)
    return turned_by(seen, *angles)


def turned_by(seen: RationalState, roll: float, yaw: float) -> TurnedState:
    """The state of a camera with about this roll and yaw, whose ideal frame shows the state `seen`."""
    c = float(seen.floats[0])
    b = -math.atan(math.cos(c) * math.tan(yaw))
    a = math.atan(math.sin(b) * math.tan(c)) - roll
    return TurnedState(seen, *(RationalState.near(np.array([angle, 0, 0, 0])).tangent for angle in (a, b)))


@dataclass(frozen=True)
class Readings:
    """Half-widths of what is told of roll, pitch and yaw, rad, (3,), and the share of it that readings are off; pitch may not be told.

    `beside`: by how much more they are off, as far as the calibration allows.
    """

    halves: Floats
    off: Floats
    beside: Floats
    pitch: bool
    kinds: Kinds

    @staticmethod
    def draw(rng: Rng, scene: Scene, shares: Shares) -> Readings:
        """Of a frame whose camera's roll and yaw the scene states or not, and which may be off, known in one of these ways."""
        stated, calibration = scene.attitude is not None, scene.calibration
        chosen = {name: share for name, share in shares.items() if name != "level"}
        known = str(rng.choice(list(chosen), p=np.array(list(chosen.values())) / sum(chosen.values())))
        low, high = np.log10(PLUS_MINUS_RAD.get(known, (1.0, 1.0)))
        halves = 10.0 ** rng.uniform(low, high, 3) * (known in PLUS_MINUS_RAD)
        halves[[0, 2]] *= ((1, 1), (0, 1), (1, 0))[rng.integers(3)]
        halves[1] = 10.0 ** rng.uniform(*np.log10(PITCH_PLUS_MINUS_RAD).tolist())
        halves[1] *= scene.camera.mount is None or shares is not EXACTLY_KNOWN
        off = np.where(rng.random(3) < 0.5, rng.choice([-1.0, 1.0], 3), rng.uniform(-1, 1, 3))
        beside = np.array([calibration.roll_rad, 0.0, calibration.yaw_rad])
        if beside.any():
            beside *= np.where(rng.random(3) < 0.5, rng.choice([-1.0, 1.0], 3), rng.uniform(-1, 1, 3))
        return Readings(halves, off, beside, bool(rng.random() < PITCH_TOLD), ("as the scene states",) if stated else (known,))

    @property
    def better(self) -> Readings:
        """Readings of which NN_F is run less often."""
        return replace(self, halves=self.halves / 2) if self.pitch else replace(self, pitch=True)

    def told(self, estimator: Estimator, state: TurnedState) -> Told:
        """What they tell of a state: by the aircraft's angles where the camera is mounted otherwise than along its axis."""
        mount, kinds = estimator.scene.camera.mount, self.kinds
        attitude, theta = self._of_camera(state)
        if mount is not None and estimator.scene.attitude is None:
            try:
                roll_off, _, yaw_off = self.beside.tolist()
                attitude, theta = mounted(mount, *self._intervals(state.aircraft(mount, roll_off, yaw_off), np.zeros(3)))
                kinds = (*kinds, "by the aircraft's reading")
            except ValueError:  # a camera that looks down, of which no aircraft's angles tell the roll
                kinds = (*kinds, NOT_MOUNTED)
        lower, upper = estimator.domain.lower - 1, estimator.domain.upper + 1
        prior = Box(lower, upper).replace(theta=theta) if self.pitch else None
        kinds = (*kinds, "pitch told") if self.pitch else kinds
        return Told(None if estimator.scene.attitude else attitude, prior, kinds)

    def _of_camera(self, state: TurnedState) -> tuple[Attitude, Angle]:
        """The camera's own attitude, and the interval of its theta."""
        roll, theta, yaw = self._intervals(state.angles, self.beside)
        return Attitude.between(roll, yaw), theta

    def _intervals(self, angles: Angles, beside: Floats) -> tuple[Angle, ...]:
        """Of roll, pitch down and yaw, of which the true ones are so much more."""
        sides = zip(angles, self.halves.tolist(), self.off.tolist(), beside.tolist(), strict=True)
        return tuple(_around(angle - arb(more), half, share) for angle, half, share, more in sides)


def draw_told(rng: Rng, estimator: Estimator, state: TurnedState, level: bool, shares: Shares) -> Told:
    """What is told of a state's camera, enough for `MOST_RUNS`; nothing of its attitude where it is level."""
    readings = Readings.draw(rng, estimator.scene, shares)
    if level:
        prior = replace(readings, kinds=("level",)).told(estimator, state)
        return replace(prior, attitude=None)
    told = readings.told(estimator, state)
    for _ in range(HALVINGS):
        if runs(estimator, told) <= MOST_RUNS:
            break
        readings = readings.better
        told = readings.told(estimator, state)
    return told


def _around(angle: arb, half: float, share: float) -> Angle:
    """An interval that holds an angle, of a half-width, about a reading that is off by a share of it."""
    middle = float(angle.mid()) + share * half
    return middle - half - HAIR, middle + half + HAIR


def runs(estimator: Estimator, told: Told) -> int:
    """How often NN_F is run, up to one more than `MOST_RUNS`."""
    attitude = estimator.known_attitude(told.attitude)
    if attitude is None:
        return 1
    box = estimator.domain if told.prior is None else seen_box(told.prior, attitude)
    low, high = max(box.lower[0], estimator.domain.lower[0]), min(box.upper[0], estimator.domain.upper[0])
    if low > high:
        return 1
    return len(list(itertools.islice(bins_of(estimator.ideal.camera, attitude, (low, high)), MOST_RUNS + 1)))

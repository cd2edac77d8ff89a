"""What an estimate is: an outcome, a certified box, a state; and the error of a frame that a model cannot take."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.scene import STATE_NAMES


class FrameError(ValueError):
    """A frame that the model cannot take."""

    def __init__(self, actual: str, expected: str) -> None:
        super().__init__(f"frame: found {actual}, expected {expected}")
        self.actual = actual
        self.expected = expected

    def __reduce__(self) -> tuple[type[FrameError], tuple[str, str]]:
        return FrameError, (self.actual, self.expected)  # not the message alone, of which an exception is copied otherwise


def axis_number(name: str, key: str) -> int:
    """The number of a state's axis by its name. Raises ValueError, which names `key`, for another name."""
    if name not in STATE_NAMES:
        raise ValueError(f"{key}: no axis is called {name!r}; give some of {', '.join(STATE_NAMES)}")
    return STATE_NAMES.index(name)


class Outcome(enum.Enum):
    """What a frame says.

    CERTIFIED: a box is given. NO_RUNWAY: no state of the domain is consistent with the frame. INCONSISTENT: some state is, but none is
    consistent with what else is known too, so that one of the assumptions is broken: domain, calibration, motion, prior or budget.
    """

    CERTIFIED = "certified"
    NO_RUNWAY = "no runway"
    INCONSISTENT = "inconsistent"


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

    @staticmethod
    def around(boxes: Sequence[Box]) -> Box | None:
        """The smallest box that holds all of these; None of none."""
        if not boxes:
            return None
        return Box(np.min([box.lower for box in boxes], axis=0), np.max([box.upper for box in boxes], axis=0))

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle of the box, (4,); exact on an axis of width 0."""
        return np.clip((self.lower + self.upper) / 2, self.lower, self.upper)

    @property
    def half_widths(self) -> NDArray[np.float64]:
        """Half of the box's extent, (4,)."""
        return (self.upper - self.lower) / 2

    def replace(self, **intervals: tuple[float, float]) -> Box:
        """The box with other intervals on the named axes: `box.replace(theta=(0.49, 0.51))`, in rad and m.

        Raises ValueError for an axis of another name, and for bounds that are not finite and ordered.
        """
        lower, upper = self.lower.copy(), self.upper.copy()
        for name, (low, high) in intervals.items():
            axis = axis_number(name, "box")
            lower[axis], upper[axis] = low, high
        return Box(lower, upper)

    def contains(self, state: ArrayLike) -> bool:
        """True if a state (4,) lies in the box, borders included; False if it has a NaN."""
        point = np.asarray(state, dtype=np.float64)
        return bool(((self.lower <= point) & (point <= self.upper)).all())


@dataclass(frozen=True)
class Estimate:
    """What one frame tells. States are [theta, x, y, z] in rad and m (`runtime.camera`)."""

    outcome: Outcome
    box: Box | None
    """The certified box; None where nothing is certified."""
    state: NDArray[np.float64] | None
    """The proposal if it lies in the box, else the box's centre; None where nothing is certified."""
    used_fallback: bool
    """True if the centre was taken."""
    network_state: NDArray[np.float64]
    """NN_e's answer, uncertified; NaN of a model without one."""
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
    """The box reaches a face of the domain, the union of its cells: it holds the state only if the aircraft is in the domain."""
    assumed: tuple[str, ...]
    """What the certificate rests on, in words: the model's assumptions, and what else was taken to be known."""

    @property
    def certified(self) -> bool:
        """True if a box is given."""
        return self.outcome is Outcome.CERTIFIED

"""A scene: camera, runway, domain of states, and the sizes of the certificate.

A scene file is TOML; `Scene.load` reads it into frozen dataclasses that check themselves on construction. Every fault is a
`SceneError` that names the key, says what was found and what to do. Axes, signs and pixel coordinates: `runtime.camera`.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
import types
import typing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.domain import LARGEST_COORDINATE, MOST_ITEMS, SMALLEST_EXTENT, Domain, read_only
from runtime.domain import Axis as Axis
from runtime.scene_error import SceneError
from runtime.scene_error import demand as _demand

STATE_NAMES = ("theta", "x", "y", "z")
STATE_UNITS = ("rad", "m", "m", "m")
STATE_COLUMNS = tuple(f"{name}_{unit}" for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True))
"""Names of a state's numbers in tables."""
SMALLEST_ANGLE_AHEAD_RAD = 1e-6
"""A point closer than this to the plane Z = 0 through the camera's centre counts as behind it: far above float64's error."""
FOCAL_RANGE_PX = (1.0, 1e6)
"""Focal lengths for which the margin of `runtime.rounding` covers float64's error."""
LARGEST_PRINCIPAL_POINT_PX = 32768.0
"""Largest distance of the principal point from the frame's corner, per axis: twice the largest frame, for the same reason."""
LARGEST_LINE_PX = 16
"""Largest tolerance, px: with a larger one, clutter has a lit pixel near every point, and no frame refutes anything."""
MARGIN_PX = 2.0**-20
"""What `runtime.rounding` widens every bound on a row or a column by, px; a scene whose own rounding comes near it is refused."""
ROUNDED_SHARE_OF_COLUMN, ROUNDED_SHARE_OF_DISTANCE = 2.0**-51, 2.0**-52
"""What float64 loses at most: on a column, of |u - u0| |v - v0| over the row's distance from the horizon, as the scale there is rounded
(four units in the last place of 1); and on a distance, of the largest coordinate along the runway (two sums)."""
DISTORTIONS = {"radial-tangential": (4, 5), "fisheye": (4,)}
"""Models of a lens, and how many coefficients each has."""
LARGEST_COEFFICIENT = 1e3
"""Largest coefficient of a lens: far beyond any that is real, so that none overflows."""
LARGEST_TURN_RAD = 0.75
"""Largest roll or yaw of a camera, its plus-minus included: one that is turned farther sees its runway sideways."""
INSTANTS = {"start": 0.0, "middle": 0.5, "end": 1.0}
"""Instants of a window of events, and the share of it that lies before them."""


@dataclass(frozen=True)
class Distortion:
    """A lens that is no pinhole: OpenCV's model of it, its coefficients in OpenCV's order."""

    model: str
    """"radial-tangential": k1, k2, p1, p2 and, where given, k3; or "fisheye": k1, k2, k3, k4."""
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        _demand(self.model in DISTORTIONS, "camera.distortion.model", self.model, f"give one of {', '.join(DISTORTIONS)}")
        counts = DISTORTIONS[self.model]
        found, expected = list(self.coefficients), " or ".join(map(str, counts))
        _demand(len(found) in counts, "camera.distortion.coefficients", found, f"{self.model} has {expected} of them")
        usable = all(abs(value) <= LARGEST_COEFFICIENT for value in found)
        _demand(usable, "camera.distortion.coefficients", found, f"stay within {LARGEST_COEFFICIENT:.0f}")

    @property
    def none(self) -> bool:
        """True if it moves no point. A fisheye lens always does."""
        return self.model == "radial-tangential" and not any(self.coefficients)


@dataclass(frozen=True)
class Mount:
    """How the camera is turned in the aircraft: R_z(-roll) R_x(pitch down) R_y(-yaw), as the aircraft in turn is to the runway."""

    roll_rad: float = 0.0
    pitch_down_rad: float = 0.0
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            _demand(abs(value) < math.pi / 2, f"camera.mount.{field.name}", value, "stay within -pi/2 and pi/2")


@dataclass(frozen=True)
class Camera:
    """A camera: a pinhole, and a lens that distorts what it shows where `distortion` is given.

    The focal lengths are `focal_px` = (F_u, F_v), or one quotient of two lengths. `principal_point` is (u0, v0) in px, by default the
    frame's centre; pixel corners are at integers (`runtime.camera`).
    """

    width: int
    height: int
    focal_length_m: float | None = None
    pixel_pitch_m: float | None = None
    principal_point: tuple[float, float] | None = None
    focal_px: tuple[float, float] | None = None
    distortion: Distortion | None = None
    mount: Mount | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            _demand(1 <= getattr(self, name) <= 16384, f"camera.{name}", getattr(self, name), "give 1 to 16384 pixels")
        self._check_focal_lengths()
        reachable = all(abs(centre) <= LARGEST_PRINCIPAL_POINT_PX for centre in (self.u0, self.v0))
        _demand(reachable, "camera.principal_point", self.principal_point, f"stay within {LARGEST_PRINCIPAL_POINT_PX:.0f} px of the corner")

    def _check_focal_lengths(self) -> None:
        low, high = FOCAL_RANGE_PX
        lengths = {"focal_length_m": self.focal_length_m, "pixel_pitch_m": self.pixel_pitch_m}
        if self.focal_px is not None:
            given = [name for name, length in lengths.items() if length is not None]
            _demand(not given, f"camera.{' and '.join(given)}", "given beside focal_px", "give either focal_px or the two lengths")
            _demand(
                all(low <= focal <= high for focal in self.focal_px),
                "camera.focal_px",
                list(self.focal_px),
                f"give {low:.0f} to {high:.0f} px",
            )
            return
        for name, length in lengths.items():
            _demand(length is not None, f"camera.{name}", "nothing", "this key is required, or focal_px = [fx, fy]")
            _demand(length is not None and length > 0, f"camera.{name}", length, "give a length above 0")
        ratio = "focal_length_m / pixel_pitch_m"
        _demand(low <= self.focal_u_px <= high, f"camera.{ratio}", self.focal_u_px, f"give a ratio of {low:.0f} to {high:.0f} px")

    @cached_property
    def focal_u_px(self) -> float:
        """F_u: px that a point moves to the right per unit of X/Z."""
        return self._focal_px[0]

    @cached_property
    def focal_v_px(self) -> float:
        """F_v: px that a point moves down per unit of -Y/Z."""
        return self._focal_px[1]

    @property
    def _focal_px(self) -> tuple[float, float]:
        if self.focal_px is not None:
            return self.focal_px
        if self.focal_length_m is None or self.pixel_pitch_m is None:
            raise SceneError("camera.focal_px: found nothing; give focal_px, or focal_length_m and pixel_pitch_m")
        focal = self.focal_length_m / self.pixel_pitch_m
        return focal, focal

    @property
    def pinhole(self) -> bool:
        """True if the frame of a level camera is the ideal one: no distortion."""
        return self.distortion is None or self.distortion.none

    @property
    def u0(self) -> float:
        """Column of the principal point, px."""
        return self.width / 2 if self.principal_point is None else self.principal_point[0]

    @property
    def v0(self) -> float:
        """Row of the principal point, px."""
        return self.height / 2 if self.principal_point is None else self.principal_point[1]

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of a frame."""
        return self.height, self.width


@dataclass(frozen=True)
class Calibration:
    """What the camera model may be off by, plus or minus; a tolerance of `line_px` must cover what it moves a marking by."""

    roll_rad: float = 0.0
    yaw_rad: float = 0.0
    focal_relative: float = 0.0
    """Of both focal lengths, by the same share: F_u/F_v is the camera model's."""
    principal_px: float = 0.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value, limit = getattr(self, field.name), 16 if field.name == "principal_px" else 0.5
            _demand(0 <= value < limit, f"calibration.{field.name}", value, f"give a plus-minus of at least 0 and below {limit}")

    @property
    def exact(self) -> bool:
        """True if the camera model is taken to be exact."""
        return self == Calibration()


@dataclass(frozen=True)
class Marking:
    """A straight stripe along the runway: from (x_m, 0, start_z_m) to (x_m, 0, start_z_m + length_m)."""

    name: str
    x_m: float
    start_z_m: float
    length_m: float

    def __post_init__(self) -> None:
        key = f"runway.markings {self.name!r}"
        for name in ("x_m", "start_z_m", "length_m"):
            value = getattr(self, name)
            _demand(abs(value) <= LARGEST_COORDINATE, f"{key} {name}", value, f"stay within {LARGEST_COORDINATE:.0f} m")
        _demand(self.length_m >= SMALLEST_EXTENT, f"{key} length_m", self.length_m, f"give a length of {SMALLEST_EXTENT} m or more")

    @property
    def ends_z_m(self) -> tuple[float, float]:
        """p_z of the near and of the far end."""
        return self.start_z_m, self.start_z_m + self.length_m


@dataclass(frozen=True)
class Runway:
    """The markings that the camera sees, joined by OR in the image."""

    markings: tuple[Marking, ...]

    def __post_init__(self) -> None:
        names = [marking.name for marking in self.markings]
        _demand(len(names) > 0, "runway.markings", "none", "give at least one [[runway.markings]] table")
        _demand(len(set(names)) == len(names), "runway.markings name", names, "give each marking its own name")

    @cached_property
    def x_m(self) -> NDArray[np.float64]:
        """p_x of every marking, (markings,)."""
        return read_only(np.array([marking.x_m for marking in self.markings]))

    @cached_property
    def ends_z_m(self) -> NDArray[np.float64]:
        """p_z of the near and the far end of every marking, (markings, 2)."""
        return read_only(np.array([marking.ends_z_m for marking in self.markings]))

    @cached_property
    def distances_z_m(self) -> NDArray[np.float64]:
        """p_z of all ends, each once, ascending: what equal ends share is computed once."""
        return read_only(np.unique(self.ends_z_m))

    @cached_property
    def place_of_ends(self) -> NDArray[np.int64]:
        """Where the near and the far end of every marking are among `distances_z_m`, (markings, 2)."""
        return read_only(np.searchsorted(self.distances_z_m, self.ends_z_m))


@dataclass(frozen=True)
class Bank:
    """How finely `build_model.hough_bank` divides a cell into entries. Finer is tighter, larger and slower; all are sound."""

    pitch_bins: int
    """Equal bins of theta in a cell."""
    distance_bins: int
    """Equal bins of z in a cell."""
    column_px: float
    """Largest shift, in px at the reference row, that the states of an entry give the outermost marking through their scale."""
    lateral_px: float = 0.35
    """The same through their x; used where the x axis is free."""

    def __post_init__(self) -> None:
        for name in ("pitch_bins", "distance_bins"):
            _demand(1 <= getattr(self, name) <= 1000, f"bank.{name}", getattr(self, name), "give a count of 1 to 1000")
        for name in ("column_px", "lateral_px"):
            value = getattr(self, name)
            _demand(0.01 <= value <= 10, f"bank.{name}", value, "give 0.01 to 10 px; below 1 px or no pixel is lit by all of an entry")


@dataclass(frozen=True)
class WindowedBank:
    """A bank for a whole approach: entries that move the image by tens of px, tested by must-hit windows (`build_model.window_bank`)."""

    set_px: float = 30.0
    """How far, in px, the states of an entry move the image at most along each of its axes, about; less where the runway has few rows."""
    rows: int = 16
    """Rows of pixels in which an entry has windows, at most."""
    places: int = 512
    """Groups of entries that a frame opens, at most; what passes beyond these stays whole."""

    def __post_init__(self) -> None:
        _demand(0.5 <= self.set_px <= 1000, "bank.set_px", self.set_px, "give 0.5 to 1000 px")
        for name, most in (("rows", 1000), ("places", 10_000)):
            _demand(1 <= getattr(self, name) <= most, f"bank.{name}", getattr(self, name), f"give a count of 1 to {most}")


@dataclass(frozen=True)
class Tolerance:
    """What a frame may lack or add: see the assumptions of Theorems A and B in `docs/guarantee.md`."""

    line_px: int = 0
    missed_budget: int = 0
    extra_budget: int = -1

    def __post_init__(self) -> None:
        _demand(0 <= self.line_px <= LARGEST_LINE_PX, "tolerance.line_px", self.line_px, f"give 0 to {LARGEST_LINE_PX} px")
        _demand(0 <= self.missed_budget < 2**16, "tolerance.missed_budget", self.missed_budget, "give 0 or more pixels")
        _demand(-1 <= self.extra_budget < 2**31, "tolerance.extra_budget", self.extra_budget, "give 0 or more pixels, or -1: not used")


@dataclass(frozen=True)
class MotionBounds:
    """How fast the state can change between two frames: for each axis the least and the largest rate, per second."""

    theta_rad_s: tuple[float, float]
    x_m_s: tuple[float, float]
    y_m_s: tuple[float, float]
    z_m_s: tuple[float, float]
    roll_rad_s: tuple[float, float] | None = None
    yaw_rad_s: tuple[float, float] | None = None
    """Of the aircraft, for attitudes between two readings."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            rates = getattr(self, field.name)
            if rates is not None:
                _demand(rates[0] <= rates[1], f"motion.{field.name}", list(rates), "give the least and the largest rate, in that order")

    @property
    def rates(self) -> tuple[tuple[float, float], ...]:
        """Least and largest rate of theta, x, y and z."""
        return self.theta_rad_s, self.x_m_s, self.y_m_s, self.z_m_s


@dataclass(frozen=True)
class AttitudeBounds:
    """The camera's roll and yaw, least and largest, where no reference tells them."""

    roll_rad: tuple[float, float] = (0.0, 0.0)
    yaw_rad: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            low, high = getattr(self, field.name)
            usable = -LARGEST_TURN_RAD <= low <= high <= LARGEST_TURN_RAD
            _demand(usable, f"attitude.{field.name}", [low, high], f"give the least and the largest, within {LARGEST_TURN_RAD} rad")


@dataclass(frozen=True)
class EventWindow:
    """The instant of a window of events that a certificate speaks of: at it, no more than the budget of the runway's pixels are dark."""

    instant: str = "middle"

    def __post_init__(self) -> None:
        _demand(self.instant in INSTANTS, "window.instant", self.instant, f"give one of {', '.join(INSTANTS)}")

    @property
    def share(self) -> float:
        """The share of the window that lies before the instant."""
        return INSTANTS[self.instant]


@dataclass(frozen=True)
class EstimatorTraining:
    """How NN_e is trained (`build_model.state_network`): frames made by the supercover, with clutter and missed pixels."""

    training_frames: int = 100_000
    epochs: int = 11
    batch: int = 128
    largest_clutter: float = 0.06
    """Densities of random clutter are drawn from 0 to this."""

    def __post_init__(self) -> None:
        for name in ("training_frames", "epochs", "batch"):
            _demand(getattr(self, name) >= 1, f"estimator.{name}", getattr(self, name), "give a count above 0")
        _demand(0 <= self.largest_clutter <= 1, "estimator.largest_clutter", self.largest_clutter, "give a share of 0 to 1")


@dataclass(frozen=True)
class Scene:
    """Everything that a model is built from. `to_dict` and `from_dict` carry it through a model's metadata unchanged."""

    camera: Camera
    runway: Runway
    domain: Domain
    bank: Bank | WindowedBank
    calibration: Calibration = Calibration()
    tolerance: Tolerance = Tolerance()
    estimator: EstimatorTraining = EstimatorTraining()
    motion: MotionBounds | None = None
    window: EventWindow | None = None
    attitude: AttitudeBounds | None = None

    def __post_init__(self) -> None:
        low, high = self.domain.lower, self.domain.upper  # the hull's: the runtime's sets are cut to it
        nearest, farthest = low[3] + self.runway.ends_z_m.min(), high[3] + self.runway.ends_z_m.max()
        _demand(nearest >= SMALLEST_EXTENT, "domain.z_m", low[3], "a marking starts beside or behind the camera: keep z + start_z_m > 0")
        steepest, flattest = math.atan2(high[2], nearest) - low[0], math.atan2(low[2], farthest) - high[0]
        widest = math.pi / 2 - SMALLEST_ANGLE_AHEAD_RAD
        ahead = -widest <= flattest and steepest <= widest
        _demand(ahead, "domain", "a state with the runway behind the camera (Z <= 0)", "narrow theta_rad, y_m or z_m")
        self._check_margin(nearest, farthest)

    def _check_margin(self, nearest: float, farthest: float) -> None:
        """The margin of `runtime.rounding` is twice float64's error on rows and columns in view, or more. Raises `SceneError`.

        An end is F_v y / (Z cos(theta)) px below the horizon. A point in view, r away from the camera, moves by no more than
        F (1 + ((u - u0)/F_u)^2 + ((v - v0)/F_v)^2) / r px a metre along the runway, F the larger of F_u and F_v.
        """
        camera, (low, high) = self.camera, (self.domain.lower, self.domain.upper)
        focal_u, focal_v = camera.focal_u_px, camera.focal_v_px
        across, down = (
            max(abs(centre), abs(side - centre)) + LARGEST_LINE_PX
            for side, centre in ((camera.width, camera.u0), (camera.height, camera.v0))
        )
        below_horizon_px = focal_v * low[2] / math.hypot(high[2], farthest)
        lost = ROUNDED_SHARE_OF_COLUMN * across * down / below_horizon_px
        advice = "raise y_m, or end the runway or the domain nearer"
        _demand(lost <= MARGIN_PX / 2, "domain", f"an end {below_horizon_px:.3g} px below the horizon, too near to round safely", advice)
        largest = max(np.abs(self.runway.ends_z_m).max(), np.abs([low[3], high[3]]).max())
        px_per_m = max(focal_u, focal_v) * (1 + (across / focal_u) ** 2 + (down / focal_v) ** 2) / math.hypot(low[2], nearest)
        found = f"coordinates along the runway of up to {largest:.3g} m where a metre spans up to {px_per_m:.3g} px"
        lost = ROUNDED_SHARE_OF_DISTANCE * largest * px_per_m
        _demand(lost <= MARGIN_PX / 2, "domain.z_m", found, "put the origin near the threshold, so that they round safely")

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Reads a scene file. Raises `SceneError` for a missing file, bad TOML or a bad value."""
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise SceneError(f"{path}: cannot be read ({error}); give the path of a TOML scene file") from error
        try:
            tables = tomllib.loads(text)
        except (ValueError, RecursionError) as error:
            raise SceneError(f"{path}: not TOML ({error}); correct it there") from error
        try:
            return cls.from_dict(tables)
        except SceneError as error:
            raise SceneError(f"{path}: {error}") from error

    @classmethod
    def from_dict(cls, tables: dict[str, Any]) -> Scene:
        """A scene from TOML's or JSON's tables. Raises `SceneError`."""
        return _read(cls, tables, "")

    def to_dict(self) -> dict[str, Any]:
        """The scene as plain tables; `Scene.from_dict` gives it back."""
        return _plain(dataclasses.asdict(self))

    @property
    def instant_share(self) -> float:
        """The share of a window of events that lies before the instant which a certificate speaks of; by default half of it."""
        return (self.window or EventWindow()).share


def _plain(value: Any) -> Any:
    """`value` with tuples as lists and without the absent entries, which TOML cannot write."""
    if isinstance(value, dict):
        return {_key_of(name): _plain(item) for name, item in value.items() if item is not None}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def _key_of(name: str) -> str:
    """A field's key in a scene file: its name, without the underscore that keeps it apart from a word of Python."""
    return name.removesuffix("_")


def _read(kind: Any, value: Any, key: str) -> Any:
    """`value` as `kind`: a dataclass, a tuple, a number or a text. Raises `SceneError` that names `key`."""
    small = not isinstance(value, int) or value.bit_length() < 64
    _demand(small, key, "a whole number beyond 64 bits", "give a smaller one")
    if dataclasses.is_dataclass(kind):
        return _read_table(kind, value, key)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType:
        return _read(_kind_meant([part for part in arguments if part is not type(None)], value, key), value, key)
    if origin is tuple:
        return _read_tuple(arguments, value, key)
    if kind is float:
        usable = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        _demand(usable, key, repr(value), "give a finite number")
        return float(value)
    usable = isinstance(value, kind) and not (kind is int and isinstance(value, bool))
    _demand(usable, key, repr(value), f"give {'a whole number' if kind is int else 'a text'}")
    return value


def _kind_meant(kinds: list[Any], table: Any, key: str) -> Any:
    """Of several kinds of tables the one that has the most of the table's keys. Raises `SceneError` if none has any."""
    if len(kinds) == 1:
        return kinds[0]
    keys = {kind: [_key_of(field.name) for field in dataclasses.fields(kind)] for kind in kinds}
    *others, last = (f"{{ {', '.join(names)} }}" for names in keys.values())
    known = isinstance(table, dict) and any(name in table for names in keys.values() for name in names)
    _demand(known, key, repr(table), f"give {', '.join(others)} or {last}")
    meant = max(kinds, key=lambda kind: sum(name in table for name in keys[kind]))
    strays = [name for name in table if name not in keys[meant] and any(name in names for names in keys.values())]
    _demand(not strays, key, f"{', '.join(strays)} in a table of the other kind", f"give {', '.join(others)} or {last}, no keys of both")
    return meant


def _read_table(kind: Any, table: Any, key: str) -> Any:
    _demand(isinstance(table, dict), key or "scene", repr(table), "give a table")
    hints, fields = typing.get_type_hints(kind), {_key_of(field.name): field for field in dataclasses.fields(kind)}
    prefix = f"{key}." if key else ""
    for name in table:
        shown = name if isinstance(name, str) and name.isprintable() else repr(name)
        _demand(name in fields, f"{prefix}{shown}", "an unknown key", f"known here: {', '.join(fields)}")
    values = {}
    for name, field in fields.items():
        if name in table:
            values[field.name] = _read(hints[field.name], table[name], f"{prefix}{name}")
        elif field.default is dataclasses.MISSING:
            _demand(type(None) in typing.get_args(hints[field.name]), f"{prefix}{name}", "nothing", "this key is required")
            values[field.name] = None
    return kind(**values)


def _read_tuple(kinds: tuple[Any, ...], value: Any, key: str) -> tuple[Any, ...]:
    _demand(isinstance(value, list), key, repr(value), "give a list")
    _demand(len(value) <= MOST_ITEMS, key, f"{len(value)} values", f"give {MOST_ITEMS} or fewer")
    if kinds[-1] is not Ellipsis:
        _demand(len(value) == len(kinds), key, value, f"give {len(kinds)} values")
    return tuple(_read(kinds[0], item, f"{key}[{position}]") for position, item in enumerate(value))

"""An event camera that flies an approach over a physical runway target, with the truth of every window.

    python scripts/simulate_approach.py [--scene SCENE.toml] [--start 0] [--seconds 52.8] [--seed N] [--out out/simulated]

The target: flat textured ground with a stripe of real width around every marking of the scene (give one whose markings are stripes'
middles, as models/paper.toml; models/field.toml models their edges). A pixel sees the mean reflectance of
its footprint: exact for the stripes' edges up to the footprint's tilt, one bilinear sample for the texture. The camera follows the
descent of `fly_approach` and vibrates in yaw, roll and pitch with the propeller, which is what makes a slow camera's edges fire.

The sensor: each pixel fires when the log of its light has moved by its own contrast threshold from the level at its last event, then
stays blind for the refractory time and takes the level found at its end. Some pixels are dead, all others fire noise at a Poisson
rate, and every event comes after a latency with an exponential jitter. Light is sampled every millisecond and crossings are
placed between samples by linear interpolation; a pixel fires at most once a sample. A block of 80 ms samples only pixels whose
light, or that of a neighbour within the block's motion, is a threshold away from their level: the others cannot fire. Where footprints
are larger than the texture's grain, far above the runway, this may miss an event.

Writes approach.raw (Prophesee EVT3), approach.npz, truth.csv: the state at the instant of every window, from the first event on; and
attitude.csv and gyroscope.csv: what an attitude reference and a gyroscope would say, for `run-model --track --pitch-alone`.
At the defaults the windows are the paper's 1320 images at 25 per second. Exit code 2 if something given cannot be used.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from approach import approach_states
from attitude_reference import AttitudeReference, attitude_text
from gyroscope_reference import GyroscopeReference, gyroscope_text
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from runtime import Scene, SceneError, terminal
from runtime.errors import fail
from runtime.recordings.recording import EVENT
from runtime.scene import STATE_NAMES, STATE_UNITS, Calibration, Camera
from runtime.sensor_map import lens_of
from runtime.whole_file import OutputError, replacing, write_whole, writing

WINDOW_US = 40_000
STEP_US = 1_000
BLOCK_US = 80_000
PAPER_SECONDS = 52.8
PAPER_SCENE = Path(__file__).resolve().parent.parent / "models" / "paper.toml"
KNOTS = 10_561
"""States of the approach between which is interpolated, 5 ms apart."""
TEXEL_M = 0.004
TEXTURE_TEXELS = 1024
TEXTURE_GRAIN_M = 0.012
"""A footprint longer than this holds several independent spots, whose mean has as much less contrast."""
FLATTEST_FALL = 0.02
"""A ray that falls by less than this share of its length meets the ground beyond 50 altitudes; where no marking goes on so far, it counts
as falling by it."""
LARGEST_MOTION_PX = 3
"""Motion within a block, whole pixels, that the choice of pixels to sample covers; more is refused."""
TRUTH_COLUMNS = ("time_us", *(f"{name}_{unit}" for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True)))

Floats = NDArray[np.float64]
Levels = NDArray[np.floating]
"""Light and what it is computed from: float32, which halves the time."""


@dataclass(frozen=True)
class Target:
    """Stripes and ground. Reflectances are shares of the stripes'; the texture's spread is that of the log."""

    stripe_width_m: float = 0.004
    """To the stripes' distance of 0.2 m what ICAO Annex 14 (5.2.7) asks of a side stripe, 0.9 m, is to a runway of 45 m."""
    ground_reflectance: float = 0.2
    texture_spread: float = 0.05
    patch_share: float = 0.006
    """Share of the ground covered by bright or dark patches: what clutter is made of."""
    patch_contrast: float = 0.9


@dataclass(frozen=True)
class Sensor:
    """What a pixel of the event camera does. Thresholds are differences of the natural log of light.

    The values are those usual for this kind of sensor: Gallego et al., "Event-based Vision: A Survey" (2020), give thresholds of 10 to
    50 %; Hu et al., "v2e" (2021), simulate a spread of 0.03 to 0.05 and noise of 0.1 to some Hz a pixel.
    """

    contrast_threshold: float = 0.25
    threshold_spread: float = 0.04
    """Standard deviation from pixel to pixel; no threshold falls below half the mean."""
    refractory_us: float = 1000.0
    noise_rate_hz: float = 0.1
    latency_us: float = 200.0
    latency_jitter_us: float = 100.0
    dead_share: float = 1e-4


@dataclass(frozen=True)
class Vibration:
    """Largest angles of the airframe's vibration, rad, plus or minus: two tones an axis, 7 to 3, which swell and calm down.

    A propeller shakes the airframe at its rotation's frequency and at multiples of it: with two blades and 2400 rpm, 40 and 80 Hz. Both
    periods are shorter than a window, so that an edge sweeps all of its range in each.
    """

    yaw_rad: float = 0.0014
    roll_rad: float = 0.0007
    pitch_rad: float = 0.0006
    calmest: float = 0.75
    """Smallest amplitude, as a share of the largest."""
    swell_s: float = 6.1
    """Time from one calm to the next."""
    tones_hz: tuple[tuple[float, float], ...] = ((40.0, 80.0),) * 3

    def angles(self, time_us: Floats, phases_rad: Floats) -> Floats:
        """Yaw, roll and pitch at the given times (n,): (n, 3). `phases_rad`: (3, 2)."""
        tones = np.array(self.tones_hz)
        waves = np.sin(2e-6 * np.pi * time_us[:, None, None] * tones + phases_rad) @ [0.7, 0.3]
        swell = self.calmest + (1 - self.calmest) * np.sin(1e-6 * np.pi * time_us / self.swell_s) ** 2
        return swell[:, None] * waves * [self.yaw_rad, self.roll_rad, self.pitch_rad]

    def scaled(self, factor: float) -> Vibration:
        """The same vibration with all angles so many times as large."""
        return replace(self, yaw_rad=factor * self.yaw_rad, roll_rad=factor * self.roll_rad, pitch_rad=factor * self.pitch_rad)

    def calibration(self, focal_px: float) -> Calibration:
        """The plus-minus of a scene that covers it; pitch moves the image up and down, as an offset of the principal point does."""
        # Over the paper's field of view pitch moves a row by up to (1 + tan^2) of what it does at the centre.
        principal_px = math.ceil(focal_px * math.tan(self.pitch_rad) * 1.2 * 1000) / 1000
        return Calibration(roll_rad=self.roll_rad, yaw_rad=self.yaw_rad, principal_px=principal_px)


@dataclass(frozen=True)
class Views:
    """The camera at n times: `to_ground` (n, 3, 3) takes (u, v, 1) px to (p_x w, p_z w, w), m, where w is by how much the ray falls
    while it goes 1 forward; `altitude_m` (n,).
    """

    to_ground: Floats
    altitude_m: Floats

    def __len__(self) -> int:
        return len(self.altitude_m)

    def __getitem__(self, which: slice) -> Views:
        return Views(self.to_ground[which], self.altitude_m[which])


class Flight:
    """The camera's path: `seconds` of an approach that takes `PAPER_SECONDS`, from `start_s` on. Times count from there."""

    def __init__(self, scene: Scene, start_s: float, seconds: float, vibration: Vibration, rng: np.random.Generator) -> None:
        if not (0 <= start_s < start_s + seconds <= PAPER_SECONDS):
            raise ValueError(f"--start, --seconds: found {start_s} and {seconds}; stay within the approach's {PAPER_SECONDS} s")
        self.scene, self.vibration = scene, vibration
        self.duration_us = round(seconds * 1e6)
        self._knots = approach_states(scene, KNOTS, rng.uniform(0, 2 * np.pi))
        self._knots_us = (np.linspace(0, PAPER_SECONDS, KNOTS) - start_s) * 1e6
        self._phases_rad = rng.uniform(0, 2 * np.pi, (3, 2))

    def states(self, time_us: Floats) -> Floats:
        """The state without vibration, (n, 4)."""
        return np.stack([np.interp(time_us, self._knots_us, column) for column in self._knots.T], axis=-1)

    def views(self, time_us: Floats) -> Views:
        """The camera at the given times (n,).

        A pixel's ray is turned back by roll, yaw and pitch; with r its coordinates right, down and forward it meets the ground at
        p_x = x + y r_0 / w,  p_z = y (r_2 cos(theta) - r_1 sin(theta)) / w - z,  w = r_1 cos(theta) + r_2 sin(theta).
        """
        camera = self.scene.camera
        theta, x, y, z = self.states(time_us).T
        yaw, roll, pitch = self.vibration.angles(time_us, self._phases_rad).T
        to_rays = np.array([[1, 0, -camera.u0], [0, 1, -camera.v0], [0, 0, 1]]) / [[camera.focal_u_px], [camera.focal_v_px], [1]]
        rays = _turned(1, -yaw) @ _turned(2, -roll) @ to_rays
        cosine, sine = np.cos(theta + pitch)[:, None], np.sin(theta + pitch)[:, None]
        fall = cosine * rays[:, 1] + sine * rays[:, 2]
        ahead = cosine * rays[:, 2] - sine * rays[:, 1]
        x, y, z = x[:, None], y[:, None], z[:, None]
        return Views(np.stack([x * fall + y * rays[:, 0], y * ahead - z * fall, fall], axis=1), y[:, 0])


def _turned(axis: int, angle_rad: Floats) -> Floats:
    """Rotations (n, 3, 3) of rays (right, down, forward): axis 1 is yaw, axis 2 is roll, signs as in `build_model.calibration`."""
    cosine, sine, one, none = np.cos(angle_rad), np.sin(angle_rad), np.ones_like(angle_rad), np.zeros_like(angle_rad)
    if axis == 1:
        rows = [[cosine, none, -sine], [none, one, none], [sine, none, cosine]]
    else:
        rows = [[cosine, -sine, none], [sine, cosine, none], [none, none, one]]
    return np.moveaxis(np.array(rows), -1, 0)


def flattest_fall(scene: Scene) -> float:
    """How far a ray must fall, per unit of its length, to be followed to the ground: half of what leads to the farthest end, or less."""
    farthest_m = scene.domain.upper[3] + scene.runway.ends_z_m.max()
    return min(FLATTEST_FALL, float(scene.domain.lower[2] / farthest_m) / 2)


class Ground:
    """Log of the light that pixels receive from the target."""

    def __init__(self, scene: Scene, target: Target, rng: np.random.Generator) -> None:
        self.scene, self.target = scene, target
        self._flattest_fall = np.float32(flattest_fall(scene))
        self._texture = _texture(target, rng)

    def log_light(self, u: Floats, v: Floats, views: Views) -> Levels:
        """(n, pixels): at the pixels' centres `u`, `v` (pixels,) in each of the n views."""
        maps = views.to_ground.astype(np.float32)[:, :, :, None]
        columns, rows = u.astype(np.float32), v.astype(np.float32)
        x_w, z_w, fall = (maps[:, row, 0] * columns + maps[:, row, 1] * rows + maps[:, row, 2] for row in range(3))
        fall = np.maximum(fall, self._flattest_fall)
        x_m, z_m = x_w / fall, z_w / fall
        # Footprint of a pixel: p_x moves by y / (F_u w) for a column, p_z by y / (F_v w^2) for a row.
        camera = self.scene.camera
        across, down = ((views.altitude_m / focal).astype(np.float32)[:, None] / fall for focal in (camera.focal_u_px, camera.focal_v_px))
        along = down / fall
        mean = np.float32(self.target.ground_reflectance)
        ground = mean + (self._sampled(x_m, z_m) - mean) * np.minimum(np.float32(TEXTURE_GRAIN_M) / along, 1)
        covered = np.zeros_like(ground)
        half = self.target.stripe_width_m / 2
        for marking in self.scene.runway.markings:
            near, far = marking.ends_z_m
            covered += _overlap(x_m, across, marking.x_m - half, marking.x_m + half) * _overlap(z_m, along, near, far)
        return np.log(ground + (1 - ground) * np.minimum(covered, 1))

    def _sampled(self, x_m: Levels, z_m: Levels) -> Levels:
        """Reflectance of the ground, bilinear; the texture repeats."""
        column, row = x_m / np.float32(TEXEL_M), z_m / np.float32(TEXEL_M)
        left, top = np.floor(column), np.floor(row)
        right_share, bottom_share = column - left, row - top
        j, i = left.astype(np.int32) & (TEXTURE_TEXELS - 1), top.astype(np.int32) & (TEXTURE_TEXELS - 1)
        j_next, i_next = (j + 1) & (TEXTURE_TEXELS - 1), (i + 1) & (TEXTURE_TEXELS - 1)
        upper, lower = i * TEXTURE_TEXELS, i_next * TEXTURE_TEXELS
        texture = self._texture
        above = texture[upper + j] * (1 - right_share) + texture[upper + j_next] * right_share
        below = texture[lower + j] * (1 - right_share) + texture[lower + j_next] * right_share
        return above + (below - above) * bottom_share


def _overlap(centre: Levels, size: Levels, low: float, high: float) -> Levels:
    """Share of the interval of that centre and size that lies in [low, high]."""
    shared = np.minimum(centre + size / 2, np.float32(high)) - np.maximum(centre - size / 2, np.float32(low))
    return np.maximum(shared, 0) / size


def _texture(target: Target, rng: np.random.Generator) -> Levels:
    """Reflectance of the ground's texels, flat: a smooth random field of two sizes, and patches over it."""
    log_reflectance = np.full((TEXTURE_TEXELS, TEXTURE_TEXELS), math.log(target.ground_reflectance))
    for blur_texels in (2, 8):
        field = _smooth_field(blur_texels, rng)
        log_reflectance += target.texture_spread * field / (field.std() * math.sqrt(2))
    field = _smooth_field(3, rng)
    low, high = np.quantile(field, [target.patch_share / 2, 1 - target.patch_share / 2])
    log_reflectance += target.patch_contrast * ((field > high).astype(np.float64) - (field < low))
    return np.minimum(np.exp(log_reflectance), 1).astype(np.float32).ravel()


def _smooth_field(blur_texels: float, rng: np.random.Generator) -> Floats:
    """White noise under a Gaussian blur, (texels, texels); it repeats without a seam."""
    noise = np.fft.rfft2(rng.standard_normal((TEXTURE_TEXELS, TEXTURE_TEXELS)))
    decay = [np.exp(-2 * (np.pi * blur_texels * frequency(TEXTURE_TEXELS)) ** 2) for frequency in (np.fft.fftfreq, np.fft.rfftfreq)]
    return np.fft.irfft2(noise * np.outer(*decay), s=(TEXTURE_TEXELS, TEXTURE_TEXELS))


def pinhole_points(camera: Camera, u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Where a pinhole of the camera's focal lengths and principal point would show what the sensor shows at these points, px."""
    if camera.pinhole:
        return u, v
    x, y, _ = lens_of(camera, Calibration()).undistorted((u - camera.u0) / camera.focal_u_px, (v - camera.v0) / camera.focal_v_px)
    return camera.u0 + camera.focal_u_px * x, camera.v0 + camera.focal_v_px * y


def largest_stretch(camera: Camera) -> float:
    """By how much a lens enlarges what a pinhole shows, at most; 1 without one."""
    bounds = lens_of(camera, Calibration()).bounds
    return 1.0 if camera.pinhole else max(1.0, float(max(bounds.across[1].max(), bounds.along[1].max())))


class EventCamera:
    """The sensor over the ground: `blocks` gives the flight's events in order of time, at most 80 ms at once."""

    def __init__(self, flight: Flight, ground: Ground, sensor: Sensor, rng: np.random.Generator) -> None:
        self.flight, self.ground, self.sensor, self.rng = flight, ground, sensor, rng
        height, width = flight.scene.camera.shape
        rows, columns = np.mgrid[:height, :width]
        self._u, self._v = pinhole_points(flight.scene.camera, columns.ravel() + 0.5, rows.ravel() + 0.5)
        pixels = height * width
        spread = rng.normal(sensor.contrast_threshold, sensor.threshold_spread, pixels)
        self._threshold = np.maximum(spread, sensor.contrast_threshold / 2).astype(np.float32)
        self._alive = rng.random(pixels) >= sensor.dead_share
        self._level = self.ground.log_light(self._u, self._v, flight.views(np.zeros(1)))[0]
        self._blind_until_us = np.full(pixels, -np.inf)

    def blocks(self) -> Iterator[NDArray[Any]]:
        """Packets of dtype `runtime.recordings.recording.EVENT`, sorted, from time 0 to the flight's end."""
        held = np.empty(0, dtype=EVENT)
        for start_us in range(0, self.flight.duration_us, BLOCK_US):
            end_us = min(start_us + BLOCK_US, self.flight.duration_us)
            events = np.concatenate([held, self._block(start_us, end_us), self._noise(start_us, end_us)])
            events = events[np.argsort(events["t"], kind="stable")]
            due = np.searchsorted(events["t"], end_us)
            held = events[due:]
            yield events[:due]

    def _block(self, start_us: int, end_us: int) -> NDArray[Any]:
        """Events of the pixels that can fire between two times, delayed, unsorted."""
        times_us = np.arange(start_us, end_us + STEP_US, STEP_US, dtype=np.float64)
        views = self.flight.views(times_us)
        pixels = self._pixels_that_can_fire(views)
        light = self.ground.log_light(self._u[pixels], self._v[pixels], views)
        level, threshold, blind_until_us = self._level[pixels], self._threshold[pixels], self._blind_until_us[pixels]
        fired: list[tuple[NDArray[np.int64], Floats, NDArray[np.bool_]]] = []
        for before, now, time_us in zip(light[:-1], light[1:], times_us[:-1], strict=True):
            blind = blind_until_us > time_us
            level[blind] = before[blind]
            change = now - level
            which = np.flatnonzero((np.abs(change) >= threshold) & ~blind)
            crossed = level[which] + np.copysign(threshold[which], change[which])
            moved = now[which] - before[which]
            share = np.clip((crossed - before[which]) / np.where(moved == 0, 1, moved), 0, 1)
            at_us = time_us + share * STEP_US
            blind_until_us[which] = at_us + self.sensor.refractory_us
            level[which] = now[which]
            fired.append((pixels[which], at_us, change[which] > 0))
        self._level[pixels], self._blind_until_us[pixels] = level, blind_until_us
        return self._delayed(*(np.concatenate(column) for column in zip(*fired, strict=True)))

    def _pixels_that_can_fire(self, views: Views) -> NDArray[np.int64]:
        """Pixels with a threshold's difference between their level and the light now, theirs or a neighbour's within the motion."""
        shape = self.flight.scene.camera.shape
        light = self.ground.log_light(self._u, self._v, views[len(views) // 2 :][:1])[0].reshape(shape)
        motion_px = self._motion_px(views.to_ground)
        around = np.ones((2 * motion_px + 1, 2 * motion_px + 1), dtype=np.uint8)
        level, threshold = self._level, self._threshold
        can = (cv2.dilate(light, around).ravel() - level >= threshold) | (level - cv2.erode(light, around).ravel() >= threshold)
        return np.flatnonzero(can & self._alive)

    def _motion_px(self, maps: Floats) -> int:
        """Largest motion of the ground's image from the block's middle, at the frame's corners and centre, whole pixels."""
        camera = self.flight.scene.camera
        grid = np.array([[u, v, 1.0] for u in (0, camera.u0, camera.width) for v in (camera.v0, camera.height)]).T
        moved = np.linalg.inv(maps) @ (maps[len(maps) // 2] @ grid)
        motion = np.abs(moved[:, :2] / moved[:, 2:] - grid[:2]).max() * largest_stretch(camera)
        if motion > LARGEST_MOTION_PX:
            raise ValueError(f"vibration: the image moves by {motion:.1f} px in {BLOCK_US // 1000} ms; keep it to {LARGEST_MOTION_PX}")
        return max(1, math.ceil(motion))

    def _noise(self, start_us: int, end_us: int) -> NDArray[Any]:
        alive = np.flatnonzero(self._alive)
        count = self.rng.poisson(self.sensor.noise_rate_hz * len(alive) * (end_us - start_us) * 1e-6)
        pixels = self.rng.choice(alive, count)
        return self._delayed(pixels, self.rng.uniform(start_us, end_us, count), self.rng.random(count) < 0.5)

    def _delayed(self, pixels: NDArray[np.int64], time_us: Floats, brighter: NDArray[np.bool_]) -> NDArray[Any]:
        events = np.empty(len(pixels), dtype=EVENT)
        delay = self.sensor.latency_us + self.rng.exponential(self.sensor.latency_jitter_us, len(pixels))
        events["t"], events["p"] = np.floor(time_us + delay), brighter
        events["y"], events["x"] = np.divmod(pixels, self.flight.scene.camera.width)
        return events


def event_camera(
    scene: Scene,
    start_s: float,
    seconds: float,
    seed: int,
    target: Target = Target(),
    sensor: Sensor = Sensor(),
    vibration: Vibration = Vibration(),
) -> EventCamera:
    """A camera at the start of its flight; the same seed gives the same events."""
    rng = np.random.default_rng(seed)
    return EventCamera(Flight(scene, start_s, seconds, vibration, rng), Ground(scene, target, rng), sensor, rng)


def window_truths(flight: Flight, first_event_us: int) -> tuple[NDArray[np.int64], Floats]:
    """Instant (windows,) us, and state (windows, 4) at it, of every window that `FrameStream` makes of the flight."""
    starts = np.arange(first_event_us, flight.duration_us, WINDOW_US)
    instants = starts + round(WINDOW_US * flight.scene.instant_share)
    return instants, flight.states(instants.astype(np.float64))


def truth_text(instants_us: NDArray[np.int64], states: Floats) -> str:
    """truth.csv: a line a window, with the time of its instant."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(TRUTH_COLUMNS)
    writer.writerows([instant, *state] for instant, state in zip(instants_us.tolist(), states.tolist(), strict=True))
    return text.getvalue()


def attitudes(flight: Flight, seed: int) -> Floats:
    """What an attitude reference says of the flight; its errors are drawn apart, so that the events do not depend on them."""
    rng = np.random.default_rng([seed, 1])
    return AttitudeReference().readings(lambda times: flight.states(times)[:, 0], flight.duration_us, flight.vibration.pitch_rad, rng)


def body_rates(flight: Flight, seed: int, plus_minus_rad_s: float = GyroscopeReference.plus_minus_rad_s) -> Floats:
    """What a gyroscope says of the flight; its errors are drawn apart, too."""
    rng = np.random.default_rng([seed, 2])
    return GyroscopeReference(plus_minus_rad_s).readings(lambda times: flight.states(times)[:, 0], flight.duration_us, rng)


def write_raw(path: Path, events: NDArray[Any], shape: tuple[int, int]) -> None:
    """The events as Prophesee RAW, EVT3, whole or not at all."""
    import faery

    packet = np.empty(len(events), dtype=faery.EVENTS_DTYPE)
    packet["t"], packet["x"], packet["y"], packet["on"] = events["t"], events["x"], events["y"], events["p"]
    stream = faery.events_stream_from_array(packet, dimensions=(shape[1], shape[0]))
    with writing(path), replacing(path) as part:
        try:
            stream.to_file(part, version="evt3", zero_t0=False)
        except RuntimeError as error:  # faery's, of a disk that is full among others
            raise OutputError(f"{path}: cannot be written ({error}); free some space there, or give another folder") from error


def simulate(camera: EventCamera, seed: int, out: Path, console: Console) -> None:
    """Flies, writes the five files and prints what was recorded; `seed` is that of the errors of attitude reference and gyroscope."""
    count = -(-camera.flight.duration_us // BLOCK_US)
    packets = list(track(camera.blocks(), "flying", total=count, console=console, transient=True))
    events = np.concatenate(packets)
    instants, states = window_truths(camera.flight, int(events["t"][0]))
    write_raw(out / "approach.raw", events, camera.flight.scene.camera.shape)
    columns = io.BytesIO()
    np.savez_compressed(columns, t=events["t"], x=events["x"], y=events["y"], p=events["p"])
    write_whole(out / "approach.npz", columns.getvalue())
    write_whole(out / "truth.csv", truth_text(instants, states).encode())
    write_whole(out / "attitude.csv", attitude_text(attitudes(camera.flight, seed)).encode())
    write_whole(out / "gyroscope.csv", gyroscope_text(body_rates(camera.flight, seed)).encode())
    console.print(_summary(events, len(instants), camera))
    console.print(f"written: {out}/approach.raw, approach.npz, truth.csv, attitude.csv and gyroscope.csv", markup=False)


def _summary(events: NDArray[Any], windows: int, camera: EventCamera) -> Table:
    table = Table(title="simulated recording", title_justify="left", show_header=False, box=None, pad_edge=False)
    table.add_row("events", f"{len(events):,}")
    table.add_row("windows of 40 ms", str(windows))
    table.add_row("events a second", f"{len(events) / camera.flight.duration_us * 1e6:,.0f}")
    for part in (camera.ground.target, camera.sensor, camera.flight.vibration):
        table.add_row(type(part).__name__.lower(), ", ".join(f"{name} {value}" for name, value in vars(part).items()))
    return table


def main(
    scene: Annotated[Path, typer.Option(help="Scene file: camera, markings and domain.")] = PAPER_SCENE,
    start: Annotated[float, typer.Option(min=0, help="Second of the approach at which the recording starts.")] = 0.0,
    seconds: Annotated[float, typer.Option(min=0.08, help="Length of the recording.")] = PAPER_SECONDS,
    seed: Annotated[int, typer.Option(min=0, help="Seed of flight, ground and sensor.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the recording and its truth.")] = Path("out/simulated"),
    stripe_width: Annotated[float, typer.Option(min=1e-4, help="Width of the stripes, m.")] = Target.stripe_width_m,
    texture: Annotated[float, typer.Option(min=0, help="Spread of the log of the ground's reflectance.")] = Target.texture_spread,
    vibration: Annotated[float, typer.Option(min=0, help="How strongly the airframe vibrates; 1 is a propeller's usual.")] = 1.0,
) -> None:
    """Simulate an event camera on an approach and write its recording with the truth."""
    console = terminal.console(130)
    try:
        target = Target(stripe_width_m=stripe_width, texture_spread=texture)
        camera = event_camera(Scene.load(scene), start, seconds, seed, target, vibration=Vibration().scaled(vibration))
        simulate(camera, seed, out, console)
    except (SceneError, ValueError, OutputError, OSError) as error:
        fail(error)


if __name__ == "__main__":
    terminal.run(main)

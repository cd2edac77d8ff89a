"""The markings on a sensor behind a lens, where they are curves: for drawing, for simulation, and to count what a frame lacks.

A marking is a segment in the ideal frame (`runtime.camera`), of which the sensor shows the part within the disc of its lens
(`runtime.lens`). `sensor_images` are outward: they hold every pixel that the curve meets, and others only within `STEP_PX` of it.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.attitude import Attitude, rotation_at
from runtime.camera import project
from runtime.lens import Lens
from runtime.rounding import OUTWARD_PX
from runtime.scene import Calibration, Camera, Scene
from runtime.sensor_map import lens_of

Floats = NDArray[np.float64]

STEP_PX = 2.0**-4
"""A curve is followed in steps no longer than this."""
LEAST_DEPTH = 2.0**-8
"""A turned ray whose depth is not above this, per unit of its own, is not drawn."""
DRAWN_POINTS = 33
"""Points of a curve that is drawn."""


def sensor_curves(scene: Scene, states: ArrayLike, points: int = DRAWN_POINTS, attitude: Attitude | None = None) -> Floats:
    """Every marking as the scene's camera shows it, from near to far: (..., markings, points, 2), (u, v) px of the sensor.

    Of a pinhole the two ends, as `runtime.camera.project` has them. NaN where a lens shows nothing of a marking. `attitude`: of a camera
    with its roll and yaw in the middle; theta is the camera's own pitch, and a marking is drawn as far as it lies before the camera.
    """
    camera = scene.camera
    if camera.pinhole and attitude is None:
        return project(scene, states)
    lens, ends = _lens(camera), _tangents(scene, states) if attitude is None else _turned_tangents(scene, states, attitude)
    if camera.pinhole:
        return _shown(camera, lens, ends)
    first, last = _within_disc(lens, ends)
    share = np.linspace(0, 1, points)[:, None]
    along = first[..., None, :] * (1 - share) + last[..., None, :] * share
    return _shown(camera, lens, along)


def sensor_images(scene: Scene, states: ArrayLike) -> NDArray[np.uint8]:
    """What each marking lights in the sensor's frame, outward: (..., markings, height, width), uint8 of {0, 1}."""
    camera, lens = scene.camera, _lens(scene.camera)
    first, last = _within_disc(lens, _tangents(scene, states))
    frames = np.zeros((*first.shape[:-1], camera.height, camera.width), dtype=np.uint8)
    flat = frames.reshape(-1, camera.height, camera.width)
    for frame, start, stop in zip(flat, first.reshape(-1, 2), last.reshape(-1, 2), strict=True):
        if np.isfinite(start).all() and np.isfinite(stop).all():
            _follow(frame, camera, lens, start, stop)
    return frames


def _follow(frame: NDArray[np.uint8], camera: Camera, lens: Lens, start: Floats, stop: Floats) -> None:
    """Lights what the image of a segment meets: of steps so short that each stays within the box of its two ends, but for the bow."""
    focal = max(camera.focal_u_px, camera.focal_v_px)
    largest = float(max(lens.bounds.across[1].max(), lens.bounds.along[1].max())) + 6 * math.hypot(*lens.tangential) * lens.radius
    steps = max(math.ceil(float(np.hypot(*(stop - start))) * focal * largest / STEP_PX), 1)
    share = (np.arange(steps + 1) / steps)[:, None]
    shown = _shown(camera, lens, start * (1 - share) + stop * share)
    bend = 1.5 * float(lens.bounds.bend.max()) + 6 * math.hypot(*lens.tangential)
    margin = OUTWARD_PX + focal * bend * (STEP_PX / (focal * lens.stretch)) ** 2
    low, high = np.minimum(shown[:-1], shown[1:]) - margin, np.maximum(shown[:-1], shown[1:]) + margin
    first, last = np.floor(low).astype(np.int64), np.floor(high).astype(np.int64)
    for columns in (first[:, 0], last[:, 0]):
        for rows in (first[:, 1], last[:, 1]):
            inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
            frame[rows[inside], columns[inside]] = 1


@functools.lru_cache(maxsize=16)
def _lens(camera: Camera) -> Lens:
    return lens_of(camera, Calibration())


def _tangents(scene: Scene, states: ArrayLike) -> Floats:
    """The rays (x, y) to the near and the far end of every marking, (..., markings, 2, 2)."""
    camera = scene.camera
    ends = project(scene, states)
    return (ends - [camera.u0, camera.v0]) / [camera.focal_u_px, camera.focal_v_px]


def _turned_tangents(scene: Scene, states: ArrayLike, attitude: Attitude) -> Floats:
    """The same as a rolled and yawed camera sees them; NaN of an end that does not lie before it."""
    given = np.asarray(states, dtype=np.float64)
    a, b, c = (side[..., None, None] for side in rotation_at(given[..., 0], attitude))
    x, y = np.moveaxis(_tangents(scene, np.concatenate([c[..., 0], given[..., 1:]], axis=-1)), -1, 0)
    right, depth = x * np.cos(b) + np.sin(b), np.cos(b) - x * np.sin(b)
    depth = np.where(depth > LEAST_DEPTH, depth, np.nan)
    turned = right * np.cos(a) - y * np.sin(a), right * np.sin(a) + y * np.cos(a)
    return np.stack([side / depth for side in turned], axis=-1)


def _within_disc(lens: Lens, ends: Floats) -> tuple[Floats, Floats]:
    """The ends (..., 2) of the part of each segment that lies within the lens's disc; NaN where none does."""
    near, far = ends[..., 0, :], ends[..., 1, :]
    way = far - near
    length, towards, beyond = (way**2).sum(axis=-1), (near * way).sum(axis=-1), (near**2).sum(axis=-1) - lens.radius**2
    root = np.sqrt(np.maximum(towards**2 - length * beyond, 0.0))
    start, stop = np.maximum((-towards - root) / length, 0.0), np.minimum((-towards + root) / length, 1.0)
    seen = (towards**2 > length * beyond) & (start < stop)
    start, stop = (np.where(seen, share, np.nan)[..., None] for share in (start, stop))
    return near + start * way, near + stop * way


def _shown(camera: Camera, lens: Lens, rays: Floats) -> Floats:
    """Pixel coordinates of the sensor, (..., 2), of rays (..., 2)."""
    x, y = lens.distorted(rays[..., 0], rays[..., 1])
    return np.stack([camera.u0 + camera.focal_u_px * x, camera.v0 + camera.focal_v_px * y], axis=-1)

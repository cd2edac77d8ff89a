"""A scene with another camera: its lens, its focal lengths, its principal point, its mount and what it may be off by are drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from random_scenes.sights import Rng

from runtime import Scene
from runtime.scene import AttitudeBounds, Calibration, Camera, Distortion, EstimatorTraining, Mount, Tolerance

UNTRAINED = EstimatorTraining(training_frames=256, epochs=1)
LENSES = {"no lens": 0.4, "radial-tangential": 0.4, "fisheye": 0.2}
"""Models of a lens, and how often they are drawn."""
K1 = (-0.4, 0.2)
ASPECTS, OFF_CENTRE = (0.95, 1.05), 0.1
"""F_u in units of F_v; how far the principal point may be off, in widths and heights of the frame."""
LARGEST_RAD = math.radians(10)
"""Roll and yaw of the camera stay within this."""
LINE_PX = {0: 0.85, 1: 0.15}
MOUNTED, BOUNDED, OFF = 0.3, 0.05, 0.3
"""How often a camera is mounted otherwise than along the aircraft's axis, how often a scene states the attitude, and how often a camera may
be off by its calibration."""
STEEPEST_MOUNT_RAD = 1.55
WIDEST_BOUNDS_RAD = (1e-4, 0.02)
"""Half-widths of a stated attitude."""


@dataclass(frozen=True)
class DrawnCamera:
    """A scene with a drawn camera, and the kinds that it belongs to."""

    scene: Scene
    kinds: tuple[str, ...]


def draw_lens(rng: Rng) -> tuple[Distortion | None, str]:
    """A lens, and its kind. Coefficients of higher powers are drawn against a fold: a barrel's k2 is mostly above 0."""
    model = str(rng.choice(list(LENSES), p=list(LENSES.values())))
    if model == "no lens":
        return None, model
    if model == "fisheye":
        return Distortion(model, tuple(float(k) for k in rng.normal(0, 1, 4) * (0.03, 0.02, 0.01, 0.003))), "a fisheye lens"
    k1 = float(rng.uniform(*K1))
    k2 = float(rng.uniform(0, 1.2) * k1**2 if k1 < 0 else rng.uniform(-0.05, 0.1))
    tangential = [float(p) for p in rng.normal(0, 0.001, 2) * (rng.random() < 0.5)]
    third = [float(rng.normal(0, 0.005))] if rng.random() < 0.4 else []
    kind = "k1 -0.4 to -0.2" if k1 < -0.2 else "k1 -0.2 to 0" if k1 < 0 else "k1 0 to 0.2"
    return Distortion(model, (k1, k2, *tangential, *third)), kind


def draw_camera(rng: Rng, scene: Scene, exactly: bool = False) -> DrawnCamera:
    """The scene seen by another camera of the same size and about the same focal length. Raises `SceneError` where it is refused.

    `exactly`: it is off by nothing, and the scene states no attitude.
    """
    camera, (lens, kind) = scene.camera, draw_lens(rng)
    aspect, right, down = float(rng.uniform(*ASPECTS)), *(float(side) for side in rng.uniform(-OFF_CENTRE, OFF_CENTRE, 2))
    mount = draw_mount(rng, scene) if rng.random() < MOUNTED else None
    drawn = Camera(
        camera.width,
        camera.height,
        principal_point=(camera.u0 + right * camera.width, camera.v0 + down * camera.height),
        focal_px=(camera.focal_v_px * aspect, camera.focal_v_px),
        distortion=lens,
        mount=mount,
    )
    line_px = int(rng.choice(list(LINE_PX), p=list(LINE_PX.values())))
    off = draw_calibration(rng) if not exactly and rng.random() < OFF else Calibration()
    if lens is None:
        line_px += whole_pixels(drawn, off)
    bounds = draw_bounds(rng) if not exactly and rng.random() < BOUNDED else None
    kinds = {
        kind: True,
        "tangential": lens is not None and lens.model != "fisheye" and any(lens.coefficients[2:4]),
        "F_u/F_v off by more than 2 %": abs(aspect - 1) > 0.02,
        "principal point off by more than 5 %": max(abs(right), abs(down)) > OFF_CENTRE / 2,
        "line_px 1" if line_px == 1 else "line_px 2 or more": line_px > 0,
        "camera off": not off.exact,
        "camera off, no lens": not off.exact and lens is None,
        "camera off in roll and yaw": off.roll_rad > 0,
        "mounted": mount is not None,
        "[attitude] stated": bounds is not None,
    }
    changed = replace(
        scene, camera=drawn, calibration=off, tolerance=Tolerance(line_px=line_px), attitude=bounds, estimator=UNTRAINED, window=None
    )
    return DrawnCamera(changed, tuple(name for name, holds in kinds.items() if holds))


def draw_mount(rng: Rng, scene: Scene) -> Mount:
    """A camera that looks down at the runway from an aircraft about level, its own turn beside that."""
    roll, more, yaw = (float(angle) for angle in rng.uniform(-0.2, 0.2, 3))
    down = float(scene.domain.lower[0] + scene.domain.upper[0]) / 2 + more
    return Mount(roll, min(max(down, -STEEPEST_MOUNT_RAD), STEEPEST_MOUNT_RAD), yaw)


def draw_calibration(rng: Rng) -> Calibration:
    """What a camera is off by, or a tenth or less of it; every second time in focal length and principal point alone."""
    turned, share = rng.random() < 0.5, float(rng.choice([1.0, 10.0 ** rng.uniform(-3, -1)]))
    roll, yaw, focal, principal = (float(side) for side in share * rng.uniform(0, 1, 4) * (0.001 * turned, 0.001 * turned, 0.001, 0.5))
    return Calibration(roll, yaw, focal, principal)


def whole_pixels(camera: Camera, off: Calibration) -> int:
    """About by how many whole pixels a pinhole's plus-minus may move what its frame shows: the build asks for them as `line_px`."""
    sides = max(camera.u0, camera.width - camera.u0), max(camera.v0, camera.height - camera.v0)
    reach, focal = math.hypot(*sides), max(camera.focal_u_px, camera.focal_v_px)
    turned = off.roll_rad * reach + off.yaw_rad * focal * (1 + (reach / focal) ** 2)
    return math.ceil(turned + off.focal_relative * max(sides) + off.principal_px)


def draw_bounds(rng: Rng) -> AttitudeBounds:
    """An attitude that nothing tells but the scene: intervals about angles within `LARGEST_RAD`."""
    low, high = np.log10(WIDEST_BOUNDS_RAD)
    halves = 10.0 ** rng.uniform(low, high, 2)
    middles = rng.uniform(-1, 1, 2) * (LARGEST_RAD - halves)
    (roll, yaw) = ((float(middle - half), float(middle + half)) for middle, half in zip(middles, halves, strict=True))
    return AttitudeBounds(roll, yaw)

"""The ideal scene of a scene whose camera is no pinhole: what NN_F is built for, and what the refinement works on."""

from __future__ import annotations

from dataclasses import replace

from runtime.scene import Calibration, Camera, Scene, SceneError, Tolerance


def ideal_scene(scene: Scene, camera: Camera, pixels_a_pixel: int) -> Scene:
    """The scene as its ideal frame shows it: a pinhole `camera`, the calibration exact, no tolerance but a budget of missed pixels.

    What the camera may be off by is in the map from the sensor's frame, pixels that fire beside their place are looked for there too, and
    a pixel that the sensor misses takes up to `pixels_a_pixel` of the ideal frame with it (`runtime.painting`). Raises `SceneError` for a
    scene with Theorem B, whose pixels a painted frame does not count.
    """
    own = scene.tolerance
    if own.extra_budget >= 0:
        raise SceneError(f"tolerance.extra_budget: found {own.extra_budget}; behind a lens only Theorem A holds: give -1")
    budget = pixels_a_pixel * own.missed_budget
    if budget >= 2**16:
        raise SceneError(f"tolerance.missed_budget: found {own.missed_budget}, {budget} pixels of the ideal frame; give fewer")
    return replace(scene, camera=camera, calibration=Calibration(), tolerance=Tolerance(missed_budget=budget))

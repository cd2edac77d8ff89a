"""How far a camera that is off by its stated calibration moves a marking's image, and whether the tolerance covers it.

A ray (a, b, 1), a = (u - u0)/F_u, b = (v - v0)/F_v, seen by a camera that is yawed by psi and then rolled by rho:

    yaw    a -> (a cos(psi) - sin(psi)) / (a sin(psi) + cos(psi))      b -> b / (a sin(psi) + cos(psi))
    roll   a -> a cos(rho) - b sin(rho)                                b -> a sin(rho) + b cos(rho)

after which F_u and F_v are off by one share and the principal point by some px. Each step's displacement is bounded on its own.
"""

from __future__ import annotations

import math

from build_model.window import Window
from runtime.rounding import above
from runtime.scene import LARGEST_LINE_PX, Scene, SceneError


def displacement_px(scene: Scene, window: Window) -> float:
    """Bound on the shift, in px in the sup norm, of any point in `window` under any camera within the scene's calibration."""
    if scene.calibration.exact:
        return 0.0
    camera, off = scene.camera, scene.calibration
    across = max(abs(window.left - camera.u0), abs(window.right - camera.u0)) / camera.focal_u_px
    down = max(abs(window.top - camera.v0), abs(window.bottom - camera.v0)) / camera.focal_v_px
    sine, cosine = math.sin(off.yaw_rad), math.cos(off.yaw_rad)
    depth = cosine - across * sine
    if depth <= 0:
        raise SceneError(f"calibration.yaw_rad: {off.yaw_rad} can turn the runway behind the camera; give a smaller plus-minus")
    shift_across, shift_down = sine * (1 + across**2) / depth, down * (1 / depth - 1)
    wide, tall = across + shift_across, down + shift_down
    sine, versine = math.sin(off.roll_rad), 1 - math.cos(off.roll_rad)
    shift_across += wide * versine + tall * sine
    shift_down += tall * versine + wide * sine
    shift_across += off.focal_relative * (across + shift_across)
    shift_down += off.focal_relative * (down + shift_down)
    return float(above(max(camera.focal_u_px * shift_across, camera.focal_v_px * shift_down) + off.principal_px))


def check_calibration(scene: Scene, window: Window) -> float:
    """The bound on the displacement, px, of all that `window`, which holds every S, can show of the markings.

    Where the window reaches the frame's border, points up to `line_px` beyond it count too, since the shift can bring them into view.
    Raises `SceneError` unless `tolerance.line_px` is at least the bound, rounded up.
    """
    beyond, (height, width) = scene.tolerance.line_px, scene.camera.shape
    shown = Window(
        top=window.top - beyond * (window.top == 0),
        bottom=window.bottom + beyond * (window.bottom == height),
        left=window.left - beyond * (window.left == 0),
        right=window.right + beyond * (window.right == width),
    )
    shift = displacement_px(scene, shown)
    needed = math.ceil(shift)
    if needed > scene.tolerance.line_px:
        moved = f"found {scene.tolerance.line_px}, but [calibration] can move the markings by {shift:.2f} px"
        if needed > LARGEST_LINE_PX:
            limit = f"more than the largest line_px, {LARGEST_LINE_PX}"
            raise SceneError(f"tolerance.line_px: {moved}, {limit}; give at most {LARGEST_LINE_PX / shift:.2f} of its plus-minus")
        raise SceneError(f"tolerance.line_px: {moved}; give {needed} or more, or a smaller [calibration]")
    return shift

"""How far the calibration can move a marking in the image, in ball arithmetic: what the tolerance must cover."""

from __future__ import annotations

import itertools

import numpy as np
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]

from build_model.verify.ball_camera import PRECISION_BITS, focal_lengths
from build_model.window import Window
from runtime.scene import Scene

CALIBRATION_PARTS = 16
"""Parts of the window per axis over which the displacement by the calibration is bounded."""


def displacement_px(scene: Scene, window: Window) -> float:
    """Bound on the shift, px in the sup norm, of a marking's point in view, by any camera within the scene's calibration.

    A ray (a, b, 1), a = (u - u0)/F_u, b = (v - v0)/F_v, is yawed by psi, then rolled by rho, each within its plus-minus:

        D = a sin(psi) + cos(psi)    a' - a = -sin(psi) (1 + a^2)/D      b' - b = b (1 - D)/D
        a'' - a' = a' (cos(rho) - 1) - b' sin(rho)                       b'' - b' = a' sin(rho) + b' (cos(rho) - 1)

    and then F_u and F_v are off by one share and the principal point by some px. Points in view lie in the spatial masks' window;
    where it reaches the frame's border, up to `line_px` beyond count too, since the shift can bring them into view.
    """
    if scene.calibration.exact:
        return 0.0
    with ctx.workprec(PRECISION_BITS):
        off, camera = scene.calibration, scene.camera
        focal_u, focal_v = focal_lengths(camera)
        line_px, (height, width) = scene.tolerance.line_px, camera.shape
        left = window.left - line_px * (window.left == 0)
        right = window.right + line_px * (window.right == width)
        top = window.top - line_px * (window.top == 0)
        bottom = window.bottom + line_px * (window.bottom == height)
        across = [(side - arb(camera.u0)) / focal_u for side in _parts(left, right)]
        down = [(side - arb(camera.v0)) / focal_v for side in _parts(top, bottom)]
        yaw, roll = _sine_and_cosine(off.yaw_rad), _sine_and_cosine(off.roll_rad)
        largest = arb(0)
        for a, b in itertools.product(across, down):
            depth = a * yaw[0] + yaw[1]
            if not depth > 0:
                return float("inf")
            shift_a, shift_b = -yaw[0] * (1 + a * a) / depth, b * (1 - depth) / depth
            yawed_a, yawed_b = a + shift_a, b + shift_b
            shift_a, shift_b = (
                shift_a + yawed_a * (roll[1] - 1) - yawed_b * roll[0],
                shift_b + yawed_a * roll[0] + yawed_b * (roll[1] - 1),
            )
            share = arb(0, off.focal_relative)
            for focal, ray, shift in ((focal_u, a, shift_a), (focal_v, b, shift_b)):
                largest = largest.max(abs(focal * (shift + share * (ray + shift)) + arb(0, off.principal_px)).upper())
        return float(np.nextafter(float(largest.upper()), np.inf))


def _sine_and_cosine(largest_rad: float) -> tuple[arb, arb]:
    """Balls of the sine and the cosine of every angle within plus or minus `largest_rad`, which is below pi/2."""
    sine, cosine = arb(largest_rad).sin_cos()
    return arb(0, sine.upper()), cosine.union(arb(1))


def _parts(low: int, high: int) -> list[arb]:
    """Balls that cover the interval [low, high]."""
    half = arb(high - low) / (2 * CALIBRATION_PARTS)
    return [arb((low + (2 * part + 1) * half).mid(), half.upper() + arb(2) ** -40) for part in range(CALIBRATION_PARTS)]

"""What is proved of a camera with a lens: that its ideal frame is a pinhole of its own focal lengths, and that the lens does not fold.

On rays (x, y, 1), r^2 = x^2 + y^2, OpenCV's models are D = f(r) (x, y)/r, besides the tangential 2 (p . x) x + r^2 p with p = (p2, p1):

    radial-tangential   f = r + k1 r^3 + k2 r^5 + k3 r^7
    fisheye             f = a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9,    a = atan(r)

The Jacobian is symmetric, with the eigenvalues f/r and f', which the tangential part changes by 6 |p| r at most. Where both are certainly
above that on a disc, no two of its rays are shown at one point; and where f - 3 |p| r^2 at its border exceeds the distance of the frame's
farthest corner, all that the frame shows lies in it. Slices of the radius are balls of 64 bits, from 0 outward until the frame is filled.

Not proved here: the table of the lens's inverse and how many ideal pixels one of the sensor can show. The runtime derives both anew
whenever a model is loaded, with a certified remainder (`runtime.lens`, `runtime.painting`), and refuses a file that says otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]

from build_model.verify.ball_camera import PRECISION_BITS, focal_lengths
from build_model.verify.counterexample import demand
from runtime.scene import Calibration, Camera

SLICES_PER_UNIT = 512
"""Slices of the radius, per focal length."""
LARGEST_RADIUS = 6
"""Beyond this, 80 degrees off the axis, nothing counts as seen."""


def check_lens(camera: Camera, off: Calibration, ideal: Camera) -> None:
    """Raises `Refuted` unless the ideal frame is a pinhole with the sensor's focal lengths, and the lens is proved free of folds."""
    same = ideal.focal_px == (camera.focal_u_px, camera.focal_v_px) and ideal.distortion is None and ideal.mount is None
    demand(same, "metadata: ideal_camera is no pinhole of the camera's own focal lengths")
    with ctx.workprec(PRECISION_BITS):
        demand(_unfolded(camera, off), "camera.distortion: the lens is not proved to be free of folds within the frame")


def _unfolded(camera: Camera, off: Calibration) -> bool:
    """True if every slice of the radius, up to the one that fills the frame, has derivatives that are certainly above 0."""
    if camera.distortion is None or camera.distortion.none:
        return True
    coefficients = [arb(value) for value in camera.distortion.coefficients]
    fisheye = camera.distortion.model == "fisheye"
    radial = coefficients if fisheye else [*coefficients[:2], *coefficients[4:]]
    tangential = arb(0) if fisheye else (coefficients[2] ** 2 + coefficients[3] ** 2).sqrt()
    farthest = _farthest_corner(camera, off)
    for number in range(LARGEST_RADIUS * SLICES_PER_UNIT):
        low, high = arb(number) / SLICES_PER_UNIT, arb(number + 1) / SLICES_PER_UNIT
        across, along = _derivatives(low.union(high), radial, fisheye)
        bent = 6 * tangential * high
        if not (across > bent and along > bent):
            return False
        shown = high * _derivatives(high, radial, fisheye)[0]
        if shown - 3 * tangential * high**2 > farthest:
            return True
    return True


def _derivatives(r: arb, radial: Sequence[arb], fisheye: bool) -> tuple[arb, arb]:
    """f/r and f' at radii in a ball."""
    angle = r.atan() if fisheye else r
    square = angle**2
    ratio, slope, power = arb(1), arb(1), arb(1)
    for place, k in enumerate(radial):
        power = power * square
        ratio, slope = ratio + k * power, slope + (2 * place + 3) * k * power
    if not fisheye:
        return ratio, slope
    # a/r = the mean of 1/(1 + t^2) over t from 0 to r, which falls from 1
    share = (1 / (1 + r**2)).union(arb(1)) if r.contains(0) else angle / r
    return ratio * share, slope / (1 + r**2)


def _farthest_corner(camera: Camera, off: Calibration) -> arb:
    """How far from the axis the frame's farthest corner is, in focal lengths, whatever the calibration's plus-minus."""
    sides = []
    for focal, centre, size in zip(focal_lengths(camera), (camera.u0, camera.v0), (camera.width, camera.height), strict=True):
        reach = abs(arb(centre)).max(abs(arb(size) - arb(centre))) + arb(off.principal_px)
        sides.append(reach / (focal * (1 - arb(off.focal_relative))))
    return (sides[0] ** 2 + sides[1] ** 2).sqrt()

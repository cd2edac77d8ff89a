"""The change of coordinates h: bounds of zeta = h(xi), the ends of the markings in the image, and of its Jacobian over boxes of states."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from build_model.paper.intervals import RoundedInterval
from build_model.paper.method import Method
from build_model.paper.mixed_monotonicity import mixed_monotone_bounds
from runtime.camera import project, row_of_point
from runtime.refine.interval import Floats, Interval
from runtime.rounding import above, below
from runtime.scene import Scene


@dataclass(frozen=True)
class _EndGeometry:
    """The camera's equations (`runtime.camera`) for every end of every marking over boxes of states; fields (..., markings, 2)."""

    sine: RoundedInterval
    cosine: RoundedInterval
    across: RoundedInterval  # X = p_x - x
    altitude: RoundedInterval  # y
    ahead: RoundedInterval  # d = p_z + z
    upward: RoundedInterval  # Y
    depth: RoundedInterval  # Z


def _end_geometry(scene: Scene, lower: Floats, upper: Floats) -> _EndGeometry:
    theta, x, y, z = (RoundedInterval(lower[..., axis, None, None], upper[..., axis, None, None]) for axis in range(4))
    sine, cosine = theta.sin(), theta.cos()
    across, ahead = RoundedInterval.of(scene.runway.x_m[:, None]) - x, RoundedInterval.of(scene.runway.ends_z_m) + z
    return _EndGeometry(sine, cosine, across, y, ahead, ahead * sine - y * cosine, y * sine + ahead * cosine)


def _stack(parts: Sequence[RoundedInterval], axis: int) -> RoundedInterval:
    lowers = np.broadcast_arrays(*(part.lower for part in parts))
    uppers = np.broadcast_arrays(*(part.upper for part in parts))
    return RoundedInterval(np.stack(lowers, axis=axis), np.stack(uppers, axis=axis))


def projection_jacobian(scene: Scene, lower: ArrayLike, upper: ArrayLike) -> Interval:
    """Bounds of the Jacobian of zeta = (u1, v1, u2, v2) by (theta, x, y, z), by interval arithmetic.

        du = F_u (X Y / Z^2, -1 / Z, -X sin(theta) / Z^2, -X cos(theta) / Z^2)
        dv = F_v (-1 - (Y / Z)^2, 0, d / Z^2, -y / Z^2)

    `lower`, `upper`: boxes of states, (..., 4). Returns two arrays (..., markings, 4, 4), px per rad or m, rounded outward.
    Raises `ValueError` if intervals cannot exclude Z <= 0.
    """
    geometry = _end_geometry(scene, np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64))
    one, squared = RoundedInterval.of(1.0), geometry.depth.square()
    focal = RoundedInterval.of(np.array([[scene.camera.focal_u_px], [scene.camera.focal_v_px]]))  # of the rows u and v
    side, rise = geometry.across / geometry.depth, geometry.upward / geometry.depth
    shrink = side / geometry.depth
    u = _stack([side * rise, -(one / geometry.depth), -(shrink * geometry.sine), -(shrink * geometry.cosine)], axis=-1)
    v = _stack([-(one + rise.square()), RoundedInterval.of(0.0), geometry.ahead / squared, -(geometry.altitude / squared)], axis=-1)
    jacobian = focal * _stack([u, v], axis=-2)
    shape = (*jacobian.lower.shape[:-3], 4, 4)
    return jacobian.lower.reshape(shape), jacobian.upper.reshape(shape)


def zeta_bounds(scene: Scene, lower: ArrayLike, upper: ArrayLike, method: Method) -> Interval:
    """Bounds of zeta = h(xi) over boxes of states.

    `lower`, `upper`: (..., 4) with y > 0 and all ends ahead of the camera. Returns two arrays (..., markings, 4) px, order
    (u1, v1, u2, v2), rounded outward. `Method.CLOSED_FORM` gives the exact range of each coordinate. Raises `ValueError` if a
    method cannot exclude an end beside or behind the camera.
    """
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    bound = {Method.MIXED_MONOTONICITY: _zeta_mixed, Method.INTERVALS: _zeta_intervals, Method.CLOSED_FORM: _zeta_closed_form}[method]
    zeta_low, zeta_high = bound(scene, low, high)
    return below(zeta_low), above(zeta_high)


def _zeta_mixed(scene: Scene, lower: Floats, upper: Floats) -> Interval:
    jacobian_low, jacobian_high = projection_jacobian(scene, lower, upper)
    bounds = []
    for marking in range(len(scene.runway.markings)):

        def h(states: Floats, marking: int = marking) -> Floats:
            return project(scene, states)[..., marking, :, :].reshape(states.shape)

        bounds.append(mixed_monotone_bounds(h, jacobian_low[..., marking, :, :], jacobian_high[..., marking, :, :], lower, upper))
    return np.stack([low for low, _ in bounds], axis=-2), np.stack([high for _, high in bounds], axis=-2)


def _zeta_intervals(scene: Scene, lower: Floats, upper: Floats) -> Interval:
    geometry, camera = _end_geometry(scene, lower, upper), scene.camera
    u = RoundedInterval.of(camera.u0) + RoundedInterval.of(camera.focal_u_px) * (geometry.across / geometry.depth)
    v = RoundedInterval.of(camera.v0) - RoundedInterval.of(camera.focal_v_px) * (geometry.upward / geometry.depth)
    zeta = _stack([u, v], axis=-1)
    shape = (*zeta.lower.shape[:-2], 4)
    return zeta.lower.reshape(shape), zeta.upper.reshape(shape)


def _zeta_closed_form(scene: Scene, lower: Floats, upper: Floats) -> Interval:
    """Row of an end: up in y, down in z and theta. Column: X/Z, where X depends on x only and Z on all but x: both ranges are met."""
    camera = scene.camera
    theta, y = ((lower[..., axis, None, None], upper[..., axis, None, None]) for axis in (0, 2))
    ahead = [scene.runway.ends_z_m + bound[..., 3, None, None] for bound in (lower, upper)]
    across = [scene.runway.x_m[:, None] - bound[..., 1, None, None] for bound in (upper, lower)]
    depths = _depth_range(theta, y, (ahead[0], ahead[1]))
    if np.any(depths[0] <= 0):
        raise ValueError(f"box: an end has a depth Z of {depths[0].min():.3g} m; narrow the box to states with the runway ahead")
    quotients = [x / depth for x in across for depth in depths]
    u = [camera.u0 + camera.focal_u_px * extreme.reduce(quotients) for extreme in (np.minimum, np.maximum)]
    v = row_of_point(camera, theta[1], y[0], ahead[1]), row_of_point(camera, theta[0], y[1], ahead[0])
    low, high = (np.stack(np.broadcast_arrays(*pair), axis=-1) for pair in zip(u, v, strict=True))
    return low.reshape(*low.shape[:-2], 4), high.reshape(*high.shape[:-2], 4)


def _depth_range(theta: Interval, y: Interval, ahead: Interval) -> Interval:
    """Exact range of Z = y sin(theta) + d cos(theta) > 0: linear in y and d, and concave in theta with its top at atan2(y, d)."""
    depths = []
    for altitude, distance in itertools.product(y, ahead):
        top = np.clip(np.arctan2(altitude, distance), *theta)
        depths += [altitude * np.sin(angle) + distance * np.cos(angle) for angle in (*theta, top)]
    return np.minimum.reduce(depths), np.maximum.reduce(depths)

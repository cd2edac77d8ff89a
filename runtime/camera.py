"""The rigid pinhole camera, and the conventions of the whole project; its words are in the glossary of docs/architecture.md.

- State `[theta, x, y, z]`: pitch-down angle (rad), lateral position, altitude, and distance before the runway's threshold (m).
  The camera's centre in the Runway Coordinate Frame is (x, y, -z).
- Camera frame: X right, Y up, Z forward.
- Pixel frame: u right, v down, origin at the outer corner of the top left pixel. Pixel (row floor(v), column floor(u)),
  half-open; a frame is a (height, width) array. In view: 0 <= u < width and 0 <= v < height.
- F_u and F_v are the focal lengths in px per unit of X/Z and of Y/Z, equal where pixels are square; (u0, v0) is the principal point.

A point (p_x, 0, p_z) on the ground lies d = p_z + z ahead of the camera:

    X = p_x - x        Y = -y cos(theta) + d sin(theta)        Z = y sin(theta) + d cos(theta)
    u = u0 + F_u X/Z     v = v0 - F_v Y/Z

All rows of the ground obey one closed form, from which the certified masks are built:

    row of a point:             v = v0 + F_v tan(beta - theta),    beta = atan2(y, d)
    scale of the ground at v:   g(v) = F_u / Z = F_u (cos(theta) (v - v0)/F_v + sin(theta)) / y     px per metre across the runway
    line of a marking:          u = u0 + (p_x - x) g(v)          independent of z
    vanishing row, g = 0:       v0 - F_v tan(theta)                common to all markings
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.scene import Camera, Scene

Floats = NDArray[np.float64]


def project_points(camera: Camera, states: ArrayLike, x_m: ArrayLike, z_m: ArrayLike) -> Floats:
    """Pixel coordinates of ground points (p_x, 0, p_z): equation in the module's docstring.

    `states`: (..., 4); `x_m`, `z_m`: broadcast against `states[..., 0]`. Returns (..., 2) px, last axis (u, v), exact up to
    float64. The points must lie in front of the camera (Z > 0).
    """
    theta, x, y, z = np.moveaxis(np.asarray(states, dtype=np.float64), -1, 0)
    across, ahead = np.asarray(x_m) - x, np.asarray(z_m) + z
    depth = y * np.sin(theta) + ahead * np.cos(theta)
    upward = -y * np.cos(theta) + ahead * np.sin(theta)
    u, v = camera.u0 + camera.focal_u_px * across / depth, camera.v0 - camera.focal_v_px * upward / depth
    return np.stack(np.broadcast_arrays(u, v), axis=-1)


def project(scene: Scene, states: ArrayLike) -> Floats:
    """zeta = h(xi): the near and the far end of every marking.

    `states`: (..., 4). Returns (..., markings, 2, 2) px: marking, end (near, far), (u, v). Exact up to float64.
    """
    wide = np.asarray(states, dtype=np.float64)[..., None, None, :]
    return project_points(scene.camera, wide, scene.runway.x_m[:, None], scene.runway.ends_z_m)


def row_of_point(camera: Camera, theta: ArrayLike, y: ArrayLike, d: ArrayLike) -> Floats:
    """Row v0 + F_v tan(beta - theta), beta = atan2(y, d), of a ground point d metres ahead, px. Up in y, down in d and in theta.

    Evaluated as F_v (y cos - d sin) / (y sin + d cos), whose terms every libm agrees on to the last places.
    """
    cosine, sine, y, d = np.cos(theta), np.sin(theta), np.asarray(y), np.asarray(d)
    return camera.v0 + camera.focal_v_px * (y * cosine - d * sine) / (y * sine + d * cosine)


def ground_scale(camera: Camera, theta: ArrayLike, y: ArrayLike, v: ArrayLike) -> Floats:
    """Scale g(v) = F_u (cos(theta) (v - v0)/F_v + sin(theta)) / y of the ground at row v, px per metre across the runway."""
    tangent = (np.asarray(v) - camera.v0) / camera.focal_v_px
    return camera.focal_u_px * (np.cos(theta) * tangent + np.sin(theta)) / np.asarray(y)


def state_from_ends(scene: Scene, ends: ArrayLike, marking: int = 0) -> Floats:
    """The inverse of h for one marking with x known to be the domain's (a fixed axis): xi from (u1, v1, u2, v2).

    `ends`: (..., 2, 2) px, the near and far end, last axis (u, v). Returns (..., 4). From the two rows
    p_x - x = (u - u0)/F_u Z at both ends follow Z1 and Z2, and with tau = (v - v0)/F_v the ground coordinates
    d = Z (cos(theta) - tau sin(theta)), y = Z (tau cos(theta) + sin(theta)): theta solves y1 = y2, then z = d1 - start_z_m.
    The marking must not lie in the camera's vertical plane (u != u0).
    """
    x = scene.domain.lower[1]
    across = scene.runway.x_m[marking] - x
    points = np.asarray(ends, dtype=np.float64)
    depth = scene.camera.focal_u_px * across / (points[..., 0] - scene.camera.u0)
    fall = depth * (points[..., 1] - scene.camera.v0) / scene.camera.focal_v_px
    theta = np.arctan2(fall[..., 0] - fall[..., 1], depth[..., 1] - depth[..., 0])
    y = fall[..., 0] * np.cos(theta) + depth[..., 0] * np.sin(theta)
    d = depth[..., 0] * np.cos(theta) - fall[..., 0] * np.sin(theta)
    return np.stack([theta, np.full_like(theta, x), y, d - scene.runway.ends_z_m[marking, 0]], axis=-1)


def project_as_printed(scene: Scene, states: ArrayLike) -> Floats:
    """The paper's h of Appendix A, term by term, with r_w = 0: rotates first, then translates by the state (erratum E1).

    A reference only: over the paper's own domain it shows the runway in no cell. Shapes as `project`.
    """
    theta, x, y, z = np.moveaxis(np.asarray(states, dtype=np.float64)[..., None, None, :], -1, 0)
    p_x, p_z, camera = scene.runway.x_m[:, None], scene.runway.ends_z_m, scene.camera
    depth = p_z * np.cos(theta) + z
    u = camera.focal_u_px * (p_x + x) / depth + camera.u0
    v = -camera.focal_v_px * (p_z * np.sin(theta) + y) / depth + camera.v0
    return np.stack(np.broadcast_arrays(u, v), axis=-1)


def rigid_state_of_printed(states: ArrayLike) -> Floats:
    """The rigid camera that sees what the printed formula draws: its centre is -R^T t, so x changes sign.

    `states`: (..., 4) printed states. Returns (..., 4) with `project(scene, result) == project_as_printed(scene, states)`.
    """
    theta, x, y, z = np.moveaxis(np.asarray(states, dtype=np.float64), -1, 0)
    altitude = -y * np.cos(theta) + z * np.sin(theta)
    distance = y * np.sin(theta) + z * np.cos(theta)
    return np.stack([theta, -x, altitude, distance], axis=-1)

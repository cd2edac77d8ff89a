"""Offsets from the borders that all states cross: on both sides of one a state lights the pixels that it crosses it in (Theorem A).

    u(r) = u0 + (p_x - x) scale R(theta, r)  lies in the closed columns of a lit pixel of the half-window above r, and of one below r

but for missed pixels. One spoils what its own row shows, on both of its borders: all but m' rows hold.
"""

from __future__ import annotations

import numpy as np

from runtime.refine.interval import Interval, relaxed_intersection
from runtime.refine.sight import Sight


def offsets_at_crossings(sight: Sight) -> Interval:
    """Bounds on the offset (p_x - x) scale of each marking, (markings, sets), px."""
    borders, halves, u0 = sight.borders, sight.halves, sight.scene.camera.u0
    low, high = halves.first - (u0 + borders.margin_px), halves.last + (1 - u0 + borders.margin_px)
    usable = sight.crossed & ~sight.missed.halves
    slow, fast = (1 / np.where(ratio > 0, ratio, 1.0) for ratio in borders.ratio)  # above the horizon no border is crossed
    slow, fast = (np.stack([side[:-1], side[1:]])[:, None] for side in (slow, fast))
    low = np.where(usable, np.minimum(low * slow, low * fast), -np.inf).max(axis=0)
    high = np.where(usable, np.maximum(high * slow, high * fast), np.inf).min(axis=0)
    return relaxed_intersection(low, high, np.maximum(sight.missed.left, 0), sight.missed.budget)

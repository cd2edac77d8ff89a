"""The path of the simulated approaches: a descent through a scene's domain while pitch and lateral position swing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime import Scene

FACE_MARGIN = 0.02
"""Share of the domain's width that the approach keeps from its faces, on every axis."""
SWING = 0.9
"""Amplitude of pitch and of lateral position, as a share of what that margin leaves."""
PITCH_PERIODS = 1.5


def approach_states(scene: Scene, count: int, phase_rad: float) -> NDArray[np.float64]:
    """`count` states of a descent through the domain, (count, 4): y and z fall from one end of their range to the other."""
    centre, half = (scene.domain.upper + scene.domain.lower) / 2, (scene.domain.upper - scene.domain.lower) / 2
    along = np.linspace(0, 1, count)
    pitch = SWING * np.sin(2 * np.pi * PITCH_PERIODS * along + phase_rad)
    drift = SWING * np.sin(2 * np.pi * along)
    height, distance = np.cos(np.pi * along), 1 - 2 * along
    return centre + (1 - 2 * FACE_MARGIN) * half * np.stack([pitch, drift, height, distance], axis=-1)

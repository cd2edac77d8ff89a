"""Contractor of scale and y by each other: y = F_u s(theta, t_ref) / scale (`runtime.state_set`)."""

from __future__ import annotations

from runtime.rounding import lowered, raised
from runtime.scene import Camera
from runtime.state_set import StateSet


def contract_by_altitude(camera: Camera, sets: StateSet) -> StateSet:
    """The sets with scale and y contracted, whatever the frame shows; after it every scale is above 0."""
    low, high = (camera.focal_u_px * side for side in sets.reference_range)
    low, high = lowered(low, low * sets.condition), raised(high, high * sets.condition)
    closer = sets.contracted(scale=(low / sets.y[:, 1], high / sets.y[:, 0]))
    return closer.contracted(y=(low / closer.scale[:, 1], high / closer.scale[:, 0]))

"""What a model's certificates take for granted, in words."""

from __future__ import annotations

from runtime.scene import Scene


def assumptions(scene: Scene) -> list[str]:
    """What every certificate of this model takes for granted (Theorem A; the last line, Theorem B, where it is switched on)."""
    tolerance = scene.tolerance
    near = f" within {tolerance.line_px} px" if tolerance.line_px else ""
    lines = [
        "The state lies in the scene's domain; a box that reaches a face of the domain says so.",
        f"No roll or yaw, and the camera as in the scene, up to its [calibration] and {tolerance.line_px} px.",
        f"At most {tolerance.missed_budget} pixels of the runway's image have no lit pixel{near}.",
    ]
    if tolerance.extra_budget >= 0:
        lines.append(f"At most {tolerance.extra_budget} lit pixels of the true cell's spatial mask are not the runway's{near}.")
    return lines

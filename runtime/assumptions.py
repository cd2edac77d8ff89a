"""What certificates take for granted, in words."""

from __future__ import annotations

from collections.abc import Iterable

from runtime.scene import STATE_NAMES, STATE_UNITS, Scene


def assumptions(scene: Scene) -> list[str]:
    """What every certificate of this model takes for granted (Theorem A; the last line, Theorem B, where it is switched on)."""
    tolerance = scene.tolerance
    near = f" within {tolerance.line_px} px" if tolerance.line_px else ""
    lines = [
        "The state lies in the scene's domain; a box that reaches a face of the domain says so.",
        f"{_turn_of(scene)}, and the camera as in the scene, up to its [calibration] and {tolerance.line_px} px.",
        f"At most {tolerance.missed_budget} pixels of the runway's image have no lit pixel{near}.",
    ]
    if tolerance.extra_budget >= 0:
        lines.append(f"At most {tolerance.extra_budget} lit pixels of the true cell's spatial mask are not the runway's{near}.")
    return lines


def told_turn(lines: list[str], scene: Scene) -> list[str]:
    """A model's assumptions where roll, pitch and yaw are told frame by frame: in place of the first two, what holds of all frames."""
    tolerance = scene.tolerance
    return [
        "The state lies in the scene's domain with the pitch that the ideal frame shows, atan(tan(theta)/cos(yaw)), in the place of theta.",
        f"Roll and yaw as told, and the camera as in the scene, up to its [calibration] and {tolerance.line_px} px.",
        *lines[2:],
    ]


def _turn_of(scene: Scene) -> str:
    """What is taken for granted of roll and yaw where no reference tells them."""
    if scene.attitude is None:
        return "No roll or yaw"
    sides = (
        f"{name} within {low:g} and {high:g} rad"
        for name, (low, high) in (("Roll", scene.attitude.roll_rad), ("yaw", scene.attitude.yaw_rad))
    )
    return ", ".join(sides)


def attitude_assumptions(scene: Scene, attitude: str, runs: int) -> list[str]:
    """What takes the place of the first two assumptions where the camera has a roll and a yaw; `attitude` in words."""
    tolerance = scene.tolerance
    near = f" and {tolerance.line_px} px" if tolerance.line_px else ""
    left = ["For `line_px` stands below what [calibration] leaves of it."] if scene.camera.pinhole and not scene.calibration.exact else []
    return [
        "The state lies in the scene's domain with the pitch that the ideal frame shows, atan(tan(theta)/cos(yaw)), in the place of theta.",
        f"The camera has a {attitude}, and is as in the scene, up to its [calibration]{near}; NN_F saw {runs} painted frames.",
        *left,
    ]


def bounds_text(lower: Iterable[float], upper: Iterable[float]) -> str:
    """An interval a state axis, with units; an axis that is a number as one."""
    axes = zip(STATE_NAMES, STATE_UNITS, lower, upper, strict=True)
    return ", ".join(
        f"{name} {low:.6g} {unit}" if low == high else f"{name} {low:.6g} to {high:.6g} {unit}" for name, unit, low, high in axes
    )


def prior_assumption(lower: Iterable[float], upper: Iterable[float]) -> str:
    """What a certificate within a prior takes for granted besides (Theorem C)."""
    return f"A prior: the state lies in {bounds_text(lower, upper)}."

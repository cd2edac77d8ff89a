"""Derives models/field.toml: the tolerance, missed budget and calibration that the simulated event camera needs.

    python scripts/derive_field.py [--scene models/paper.toml] [--flights 2] [--share 0.95] [-o models/field.toml]

1. Calibration: what the vibration turns the camera by, at most. The build's own bound says by how many px that moves a marking.
2. Witnesses: on flights of other seeds than the recordings that are judged, every window's I_r is compared with the frame. missed(t) is
   the number of its pixels without a lit one within t px in the sup norm.
3. line_px is the smallest t that covers the calibration's shift and for which missed(t), at the given share of the windows, stays below
   the smallest |K| of the bank at that t; missed_budget is missed(t) at that share.

Prints each figure and writes the scene file. Exit code 2 if no t of 0 to 3 px will do.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from fly_approach import write_whole
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from simulate_approach import PAPER_SECONDS, WINDOW_US, Vibration, event_camera, window_truths

from build_model.calibration import displacement_px
from build_model.export import build_banks
from build_model.pixel_mask import Window
from runtime import Scene, SceneError
from runtime.frames import FrameStream
from runtime.report import missed_pixels
from runtime.scene import Calibration, Tolerance

FIRST_SEED = 1000
TOLERANCES_PX = (0, 1, 2, 3)
QUANTILES = (0.5, 0.9, 0.95, 0.99, 1.0)
PAPER_SCENE = Path(__file__).resolve().parent.parent / "models" / "paper.toml"


def missed_of_flight(scene: Scene, seed: int, seconds: float, tolerances: Sequence[int], console: Console) -> NDArray[np.int64]:
    """missed(t) of every window of a simulated flight, (windows, tolerances)."""
    camera = event_camera(scene, 0.0, seconds, seed)
    stream = FrameStream(scene.camera.shape, WINDOW_US)
    frames = stream.frames(camera.blocks())
    first_us, frame = next(frames)
    _, states = window_truths(camera.flight, first_us)
    rows = [[missed_pixels(scene, frame, states[0], t) for t in tolerances]]
    remaining = zip(frames, states[1:], strict=True)
    for (_, frame), state in track(remaining, f"flight {seed}", total=len(states) - 1, console=console, transient=True):
        rows.append([missed_pixels(scene, frame, state, t) for t in tolerances])
    return np.array(rows)


def shift_px(scene: Scene, calibration: Calibration, line_px: int) -> float:
    """Largest shift of a marking under the calibration over the filters' window at that tolerance, as the build bounds it."""
    banks = build_banks(replace(scene, tolerance=Tolerance(line_px=line_px)))
    window: Window = functools.reduce(Window.union, (bank.window for bank in banks))
    return displacement_px(replace(scene, calibration=calibration), window)


def smallest_must_light(scene: Scene, line_px: int) -> int:
    """Smallest |K| of the bank at that tolerance."""
    return min(int(bank.must_light_sizes.min()) for bank in build_banks(replace(scene, tolerance=Tolerance(line_px=line_px))))


def chosen_tolerance(missed: Sequence[int], must_light: Sequence[int], shifts: Sequence[float]) -> int | None:
    """Position of the smallest tolerance that covers its shift and whose missed budget the bank can bear; None if none does."""
    rows = zip(TOLERANCES_PX, missed, must_light, shifts, strict=True)
    return next((place for place, (t, m, smallest, shift) in enumerate(rows) if shift <= t and m < smallest), None)


def missed_table(missed: NDArray[np.int64], budgets: Sequence[int], must_light: Sequence[int], shifts: Sequence[float]) -> Table:
    """A row a tolerance: quantiles of missed(t), the calibration's shift and the smallest |K|."""
    table = Table(title=f"pixels of the runway without a witness, {len(missed)} windows", title_justify="left")
    for heading in ("t, px", *(f"{quantile:.0%}" for quantile in QUANTILES), "budget m", "windows within m", "smallest |K|", "shift, px"):
        table.add_column(heading, justify="right")
    for place, t in enumerate(TOLERANCES_PX):
        counts = [f"{value:.0f}" for value in np.quantile(missed[:, place], QUANTILES, method="higher")]
        within = f"{np.mean(missed[:, place] <= budgets[place]):.2%}"
        table.add_row(str(t), *counts, str(budgets[place]), within, str(must_light[place]), f"{shifts[place]:.2f}")
    return table


def scene_text(scene_path: Path, calibration: Calibration, tolerance: Tolerance, how: str) -> str:
    """The scene file with its [tolerance] replaced, [calibration] added, and a first line that says where they come from."""
    before, _, _ = scene_path.read_text(encoding="utf-8").partition("[tolerance]")
    body = "\n".join(line for line in before.splitlines() if not line.startswith("#")).strip()
    tables = {"calibration": vars(calibration), "tolerance": vars(tolerance)}
    added = ["\n".join([f"[{name}]", *(f"{key} = {value}" for key, value in table.items())]) for name, table in tables.items()]
    return f"{how}\n\n" + "\n\n".join([body, *added]) + "\n"


def derive(scene_path: Path, flights: int, seconds: float, share: float, console: Console) -> str | None:
    """The text of the new scene file, or None where no tolerance will do. Prints how it came about."""
    scene = Scene.load(scene_path)
    vibration = Vibration()
    calibration = vibration.calibration(scene.camera.focal_px)
    seeds = range(FIRST_SEED, FIRST_SEED + flights)
    missed = np.concatenate([missed_of_flight(scene, seed, seconds, TOLERANCES_PX, console) for seed in seeds])
    budgets = np.quantile(missed, share, axis=0, method="higher").tolist()
    must_light = [smallest_must_light(scene, t) for t in TOLERANCES_PX]
    shifts = [shift_px(scene, calibration, t) for t in TOLERANCES_PX]
    console.print(f"vibration up to {vars(vibration)}", f"hence {calibration}", sep="\n", highlight=False, markup=False)
    console.print(missed_table(missed, budgets, must_light, shifts))
    place = chosen_tolerance(budgets, must_light, shifts)
    if place is None:
        return None
    tolerance = Tolerance(line_px=TOLERANCES_PX[place], missed_budget=budgets[place])
    kept = np.mean(missed[:, place] <= tolerance.missed_budget)
    how = [
        "The paper's scene for an event camera whose lines are thicker than a pixel, whose pixels fail to fire, and which vibrates.",
        f"Derived by scripts/derive_field.py from {len(missed)} windows of {flights} simulated flights: vibration moves the markings by",
        f"up to {shifts[place]:.2f} px, and {kept:.1%} of the windows miss no more than missed_budget pixels at line_px.",
        "Lengths in metres, angles in radians. Conventions: runtime/camera.py.",
    ]
    console.print(f"chosen: {tolerance}", highlight=False, markup=False)
    return scene_text(scene_path, calibration, tolerance, "\n".join(f"# {line}" for line in how))


def main(
    scene: Annotated[Path, typer.Option(help="Scene file to start from.")] = PAPER_SCENE,
    flights: Annotated[int, typer.Option(min=1, help="Simulated flights.")] = 2,
    seconds: Annotated[float, typer.Option(min=0.08, help="Length of each.")] = PAPER_SECONDS,
    share: Annotated[float, typer.Option(min=0.0, max=1.0, help="Share of the windows whose assumptions shall hold.")] = 0.95,
    output: Annotated[Path, typer.Option("-o", "--output", help="Scene file to write.")] = Path("models/field.toml"),
) -> None:
    """Derive tolerance, missed budget and calibration from simulated flights and write the scene file."""
    console = Console(width=None if sys.stdout.isatty() else 130)
    try:
        text = derive(scene, flights, seconds, share, console)
    except (SceneError, ValueError, OSError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        raise typer.Exit(2) from None
    if text is None:
        print("no tolerance of 0 to 3 px covers the vibration and leaves every entry of the bank a pixel; lower --share", file=sys.stderr)
        raise typer.Exit(2)
    write_whole(output, text.encode())
    console.print(f"written: {output}", markup=False)


if __name__ == "__main__":
    typer.run(main)

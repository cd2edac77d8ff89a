"""Derives markings, tolerance and missed budget for the simulated event camera: at the defaults, those of models/field.toml.

    python scripts/derive_field.py [--scene models/paper.toml] [--flights 1] [--seconds 52.8] [--share 0.95] [-o out/field.toml]

The box is as wide as the frame leaves room for: a marking may lie wherever lit pixels reach. The paper's runway is 27 px either side of its
middle and 35 rows long, and pitch and altitude compensate each other: lines of one pixel give half-widths of 0.015 rad and 0.027 m, while
three quarters of a pixel more on either side of every marking make 0.05 rad and 0.1 m of them, and a line_px of 1 the whole domain. So the
markings should be where the pixels fire, and line_px no larger than it must be.

1. Markings. A stripe of some width fires along its edges, while its middle, once it is lit all the time, stays dark. Each stripe becomes
   two markings, at a distance from its middle for which they miss the fewest pixels; the ends, in whose last pixel little changes, are
   moved inward by `END_INSET_M`. The middle alone is tried too.
2. Witnesses. On flights of other seeds than the recordings that are judged, missed(t) of every window is the number of pixels of
   I_r(truth) without a lit one within t px in the sup norm.
3. missed_budget is missed(t) at the given share of the windows, and line_px the smallest t for which a bank can be built whose entries
   all have a larger |K|.
4. Calibration. The vibration moves the markings by more than half a pixel, but it is no calibration: its periods are shorter than a
   window, in which the camera so looks where the scene says, and more than once. What it leaves dark is counted in missed(t). The
   simulated camera has no other error; for a camera that has one, state it, and with it the line_px that the build then demands.
5. Bank. Under a missed budget finer entries tell little more, as those beside the true one pass as well; `FIELD_BANK` is a third of the
   paper's entries, for boxes 1 to 3 % wider in two thirds of the time (120 windows of three parts of a flight).

Prints each figure and writes the scene file. Exit code 2 if no t of 0 to 2 px will do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from simulate_approach import PAPER_SECONDS, WINDOW_US, Target, Vibration, event_camera, window_truths

from build_model.assembly import assemble
from build_model.calibration import displacement_px
from build_model.export import build_banks
from build_model.filter_tables import BankTables
from runtime import Scene, SceneError, terminal
from runtime.errors import fail
from runtime.frames import FrameStream
from runtime.image import dilated, runway_image
from runtime.scene import Bank, Marking, Runway, Tolerance
from runtime.whole_file import OutputError, write_whole, writing

FIRST_SEED = 1000
TOLERANCES_PX = (0, 1, 2)
QUANTILES = (0.5, 0.9, 0.95, 0.99, 1.0)
BESIDE_EDGES_M = (-0.0005, -0.00025, 0.0, 0.00025, 0.0005, 0.00075, 0.001)
"""Where, outward from a stripe's edges, its two markings are tried; the stripe's middle is tried as well."""
END_INSET_M = 0.004
"""About a row of the image at each end."""
FIELD_BANK = Bank(pitch_bins=3, distance_bins=1, column_px=0.5)
PAPER_SCENE = Path(__file__).resolve().parent.parent / "models" / "paper.toml"

Counts = NDArray[np.int64]


def field_scene(scene: Scene, from_middle_m: float) -> Scene:
    """The scene with `FIELD_BANK` and two markings a stripe, that far on either side of its middle; with one at the middle if that is 0."""
    sides = {" left": -from_middle_m, " right": from_middle_m} if from_middle_m else {"": 0.0}
    markings = [
        Marking(f"{stripe.name}{side}", round(stripe.x_m + x_m, 6), stripe.start_z_m + END_INSET_M, stripe.length_m - 2 * END_INSET_M)
        for stripe in scene.runway.markings
        for side, x_m in sides.items()
    ]
    return replace(scene, runway=Runway(tuple(markings)), bank=FIELD_BANK)


def missed_of_flight(scene: Scene, placed: Sequence[Scene], seed: int, seconds: float, console: Console) -> Counts:
    """missed(t) of every window of a simulated flight for every placing of the markings, (windows, placings, tolerances)."""
    camera = event_camera(scene, 0.0, seconds, seed)
    frames = FrameStream(scene.camera.shape, WINDOW_US).frames(camera.blocks())
    count, rows, states = round(seconds * 1e6) // WINDOW_US, [], None
    for number, (start_us, frame) in enumerate(track(frames, f"flight {seed}", total=count, console=console, transient=True)):
        states = window_truths(camera.flight, start_us)[1] if states is None else states
        dark = [~dilated(frame != 0, t) for t in TOLERANCES_PX]
        images = [runway_image(each, states[number]) != 0 for each in placed]
        rows.append([[np.count_nonzero(image & missing) for missing in dark] for image in images])
    return np.array(rows)


def smallest_must_light(scene: Scene, tolerance: Tolerance) -> int | None:
    """Smallest |K| of the bank, which exceeds the budget; None if no bank of sensible size has entries that strong."""
    try:
        return _tables(replace(scene, tolerance=tolerance)).smallest_must_light
    except SceneError:
        return None


def vibration_shift_px(scene: Scene) -> float:
    """Largest shift of a marking under the vibration, as the build bounds that of a calibration."""
    calibration = Vibration().calibration(scene.camera.focal_v_px)
    return displacement_px(replace(scene, calibration=calibration), _tables(scene).window)


def _tables(scene: Scene) -> BankTables:
    return assemble(scene, build_banks(scene))


def bearable(scene: Scene, budgets: Sequence[int]) -> Iterator[tuple[Tolerance, int | None]]:
    """Each of `TOLERANCES_PX` with its budget, and the smallest |K| of a bank for it (`smallest_must_light`)."""
    for line_px, budget in zip(TOLERANCES_PX, budgets, strict=True):
        tolerance = Tolerance(line_px=line_px, missed_budget=budget)
        yield tolerance, smallest_must_light(scene, tolerance)


def missed_table(title: str, first: str, rows: Sequence[tuple[str, Counts]]) -> Table:
    """A row a name: quantiles over the windows of its missed pixels (windows,)."""
    table = Table(title=title, title_justify="left")
    for heading in (first, *(f"{quantile:.0%}" for quantile in QUANTILES)):
        table.add_column(heading, justify="right")
    for name, missed in rows:
        table.add_row(name, *(str(value) for value in np.quantile(missed, QUANTILES, method="higher")))
    return table


def scene_text(scene: Scene, comment: str) -> str:
    """The scene as TOML below a comment; tables that have their default values are left out."""
    tables = scene.to_dict()
    lines = [*(f"# {line}" for line in comment.splitlines())]
    for name in ("camera", "runway", "domain", "bank", "calibration", "tolerance"):
        if name == "runway":
            for marking in tables[name]["markings"]:
                lines += ["", "[[runway.markings]]", *_assignments(marking)]
        elif name != "calibration" or not scene.calibration.exact:
            lines += ["", f"[{name}]", *_assignments(tables[name])]
    return "\n".join(lines) + "\n"


def _assignments(table: dict[str, Any]) -> list[str]:
    return [f"{key} = {_toml(value)}" for key, value in table.items()]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{ {', '.join(_assignments(value))} }}"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def derive(scene: Scene, flights: int, seconds: float, share: float, console: Console) -> str | None:
    """The text of the new scene file, or None where no tolerance will do. Prints how it came about."""
    half = Target().stripe_width_m / 2
    distances = [0.0, *(half + beside for beside in BESIDE_EDGES_M)]
    placed = [field_scene(scene, distance) for distance in distances]
    seeds = range(FIRST_SEED, FIRST_SEED + flights)
    missed = np.concatenate([missed_of_flight(scene, placed, seed, seconds, console) for seed in seeds])
    budgets = np.quantile(missed, share, axis=0, method="higher")
    names = ["0 (one)", *(f"{1000 * distance:.2f}" for distance in distances[1:])]
    console.print(missed_table(f"missed(0), {len(missed)} windows", "from middle, mm", list(zip(names, missed[:, :, 0].T, strict=True))))
    # Of distances with equal budgets the largest: the farther the markings are from the middle, the less room a frame leaves them.
    best = len(distances) - 1 - int(budgets[:0:-1, 0].argmin())
    tried = list(bearable(placed[best], budgets[best].tolist()))
    rows = [
        (f"{tolerance.line_px}, smallest |K| {smallest or '-'}", missed[:, best, place])
        for place, (tolerance, smallest) in enumerate(tried)
    ]
    console.print(missed_table(f"missed(t), markings {names[best]} mm from the middle", "t, px", rows))
    tolerance = next((tolerance for tolerance, smallest in tried if smallest is not None), None)
    if tolerance is None:
        return None
    shift_px = vibration_shift_px(placed[best])
    kept = np.mean(missed[:, best, TOLERANCES_PX.index(tolerance.line_px)] <= tolerance.missed_budget)
    comment = (
        "The paper's scene for an event camera on a propeller aircraft: stripes wider than a pixel, pixels that fail to fire, vibration.\n"
        f"Derived by scripts/derive_field.py from {len(missed)} windows of simulated flight: each stripe, {2000 * half:g} mm\n"
        f"wide, is two markings, {names[best]} mm from its middle, where pixels fire; {kept:.1%} of the windows miss no more than\n"
        f"missed_budget pixels of them. The vibration, up to {shift_px:.2f} px, is no calibration: a window holds more than a period.\n"
        "Lengths in metres, angles in radians. Conventions: runtime/camera.py."
    )
    console.print(f"chosen: {tolerance}; {kept:.2%} of the windows are within it", highlight=False, markup=False)
    return scene_text(replace(placed[best], tolerance=tolerance), comment)


def main(
    scene: Annotated[Path, typer.Option(help="Scene file to start from.")] = PAPER_SCENE,
    flights: Annotated[int, typer.Option(min=1, help="Simulated flights.")] = 1,
    seconds: Annotated[float, typer.Option(min=0.08, help="Length of each.")] = PAPER_SECONDS,
    share: Annotated[float, typer.Option(min=0.0, max=1.0, help="Share of the windows whose assumptions shall hold.")] = 0.95,
    output: Annotated[Path, typer.Option("-o", "--output", help="Scene file to write.")] = Path("out/field.toml"),
) -> None:
    """Derive markings, tolerance and missed budget from simulated flights and write the scene file."""
    console = terminal.console(130)
    try:
        text = derive(Scene.load(scene), flights, seconds, share, console)
        if text is None:
            fail("no tolerance of 0 to 2 px leaves every entry of the bank a pixel more than the budget; lower --share")
        with writing(output):
            write_whole(output, text.encode())
    except (SceneError, ValueError, OutputError, OSError) as error:
        fail(error)
    console.print(f"written: {output}", markup=False)


if __name__ == "__main__":
    terminal.run(main)

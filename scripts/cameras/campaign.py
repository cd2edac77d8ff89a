"""Counts how often a certificate holds of cameras drawn at random: lenses, focal lengths and principal points, rolled, yawed and mounted.

    python scripts/cameras [--cameras N] [--frames N] [--exactly] [--scene FILE.toml]... [--seed N] [-o FILE.json]
    python scripts/cameras [the same --exactly and --scene] --replay "SEED/CAMERA.DRAW#FRAME"

Scenes are the paper's, a strip, a runway's final approach, and random ones (`cameras.bases`), or those of files. The truth is drawn in
fractions, and behind a lens in balls, by code that the build and the runtime do not have (`rational_image`, `curved_image`,
`turned_state`); `cameras.trial` says what is a finding. With one, the exit code is 1. Without `--seed` every campaign draws other cameras;
one that was stopped goes on with its own, from what is kept beside the output.
"""

from __future__ import annotations

import functools
import os
import sys
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer
from random_scenes.campaign import replay, run, version_of_code
from random_scenes.sights import PLACES
from rich.table import Table

from cameras.attitudes import KNOWN, NOT_MOUNTED
from cameras.bases import named_scenes
from cameras.frames import BUDGETED, CLUTTER, STATES, TURNED_ORDERS
from cameras.trial import CameraTrial
from runtime import SceneError
from runtime.errors import fail

COLUMNS = ("scenes", "frames", "refused", "judged", "certified", "findings")


def table_of_kinds(counts: dict[str, Counter[str]]) -> Table:
    """Counts by what was drawn: scenes, cameras, attitudes, states, clutter and missed pixels. A frame counts for each of its kinds.

    Judged are the states that a box had to hold; certified the frames that have one.
    """
    view = Table(title="Cameras and attitudes", title_justify="left")
    for heading in ("kind", *COLUMNS):
        view.add_column(heading, justify="left" if heading == "kind" else "right")
    told = [*KNOWN, "as the scene states", "pitch told", "by the aircraft's reading", NOT_MOUNTED]
    frames = (told, list(STATES), list(CLUTTER), ["m = 0", "m > 0", *TURNED_ORDERS, *BUDGETED.values()])
    known = {kind for kinds in frames for kind in kinds} | {*PLACES, "all"}
    cameras = sorted(kind for kind in counts if kind not in known)
    for kinds in (cameras, [kind for kind in PLACES if kind in counts], *frames, ["all"]):
        present = [kind for kind in kinds if kind in counts]
        for kind in present:
            view.add_row(kind, *(f"{counts[kind][column]:,}" for column in COLUMNS), end_section=kind == present[-1])
    return view


def main(
    cameras: Annotated[int, typer.Option(min=1, help="Cameras to draw.")] = 1000,
    frames: Annotated[int, typer.Option(min=1, help="Frames to judge, of all cameras together.")] = 100_000,
    scene: Annotated[list[Path] | None, typer.Option(help="Scene file to draw cameras for; may be given again.")] = None,
    exactly: Annotated[
        bool, typer.Option("--exactly", help="Only cameras and attitudes that are known exactly: ten times as fast.")
    ] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of everything; another one each time if it is not given.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    patience: Annotated[float, typer.Option(min=0.1, help="Seconds after which a frame counts as without end.")] = 60.0,
    output: Annotated[Path, typer.Option("-o", "--output", help="JSON file for the counts.")] = Path("out/cameras.json"),
    replayed: Annotated[str | None, typer.Option("--replay", help='One frame again: "SEED/CAMERA.DRAW#FRAME".')] = None,
) -> None:
    """Draw cameras, judge frames of each, and print the tables; or go on with a campaign that was stopped."""
    output.parent.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        named_scenes(scene or [])
    except SceneError as error:
        fail(error)
    trial_of = functools.partial(CameraTrial, files=tuple(map(str, scene or [])), exactly=exactly)
    if replayed is not None:
        sys.exit(int(replay(replayed, patience, output.parent, trial_of) > 0))
    version = version_of_code("cameras.trial")
    sys.exit(int(run(version, cameras, frames, seed, jobs, patience, output, trial_of, table_of_kinds) > 0))

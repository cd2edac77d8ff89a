"""Counts how often a certificate over time holds, and how soon a fault is found: random flights whose truth is known exactly.

    python scripts/flights [MODEL.onnx ...] [--flights N] [--scenes N] [--no-faults] [--seed N] [-o FILE.json]

Sound flights (`flights.sound`, and of a camera that rolls and yaws `flights.turned`) keep all assumptions: a box without the state, at
a frame or between two, INCONSISTENT, an exception and a frame without end are findings, with which the exit code is 1. On faulty ones
(`flights.faulty`) one assumption is broken. Sound ones are flown over scenes that are drawn at random, too (`random_scenes`). The
runway's images are drawn in rational numbers by code that the build does not have (`rational_image`). A campaign that was stopped goes
on, from what is kept beside the output.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import secrets
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import joblib
import numpy as np
import typer
from coverage.chunk import digest
from coverage.journal import ResultJournal
from coverage.states import estimator_of
from import_graph import all_imports_of
from random_scenes.campaign import limit_memory, seed_of_stopped, table_of_findings
from random_scenes.outcomes import Outcomes
from random_scenes.trial import Trial
from rich.progress import track
from rich.table import Table

import runtime
from flights.faulty import FAULTS, LATE, FaultyFlight
from flights.sound import PATIENCE_S, SHORT_FLIGHT, SoundFlight
from flights.turned import TurnedFlight
from runtime import terminal
from runtime.errors import INTERRUPTED, fail
from runtime.model.format import ModelError
from runtime.whole_file import OutputError, write_whole

PAPER = Path(__file__).resolve().parents[2] / "models" / "paper.onnx"
SOUND, TURNED, SCENE = "sound", "turned", "random scene"
FAULTY_SHARE, TURNED_SHARE = 10, 20
"""One flight with each fault, and one of a camera that rolls and yaws, whose frames take far longer, for so many sound ones."""
FLIGHTS_OF_A_SCENE = 10


@dataclass(frozen=True)
class Task:
    """One flight of a model, sound or with the fault `kind`; or some over a scene that is drawn, which has no model yet."""

    version: str
    seed: int
    kind: str
    model: str
    """The model's name and digest."""
    path: str
    number: int

    @property
    def key(self) -> tuple[str | int, ...]:
        """What the outcomes are found again by."""
        return self.version, self.seed, self.kind, self.model, self.number

    def run(self) -> tuple[Task, Outcomes]:
        """Flies."""
        return self, self.scene_flown() if self.kind == SCENE else self.flown()

    def flown(self) -> Outcomes:
        """Over the model's scene."""
        rng = np.random.default_rng([self.seed, self.number, [SOUND, *FAULTS, TURNED].index(self.kind)])
        place = f"{self.model}: {self.kind} {self.seed}/{self.number}"
        if self.kind == TURNED:
            return TurnedFlight(self.path, place, rng).run()
        return SoundFlight(self.path, place, rng).run() if self.kind == SOUND else FaultyFlight(self.path, self.kind, place, rng).run()

    def scene_flown(self) -> Outcomes:
        """Over the first draw of a scene that the build does not refuse."""
        outcomes = Outcomes()
        with tempfile.TemporaryDirectory() as folder, limited_memory():
            built = Trial(self.seed, self.number, 0, PATIENCE_S).first_built(Path(folder) / "model.onnx", outcomes)
            for flight in range(0 if built is None else FLIGHTS_OF_A_SCENE):
                assert built is not None
                rng = np.random.default_rng([self.seed, self.number, flight])
                outcomes.add(SoundFlight(str(built.path), f"{built.place} flight {flight}", rng, SHORT_FLIGHT).run())
        return outcomes


@contextlib.contextmanager
def limited_memory() -> Iterator[None]:
    """An allocation fails in the block before the machine runs out of memory: some scenes that can be drawn are too large to build."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    limit_memory()
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def tasks_of(version: str, seed: int, models: list[Path], flights: int, scenes: int, faults: bool = True) -> list[Task]:
    """All that a campaign flies, scenes and models in turn, so that one that is stopped has some of each. Raises `ModelError`."""
    shares: dict[float, list[Task]] = {}
    for path in models:
        model = f"{path.stem} {estimator_of(str(path)).sha256[:16]}"
        counts = {SOUND: flights, TURNED: flights // TURNED_SHARE}
        counts |= dict.fromkeys(FAULTS, -(-flights // FAULTY_SHARE)) if faults else {}
        for kind, count in counts.items():
            for number in range(count):
                shares.setdefault(number / count, []).append(Task(version, seed, kind, model, str(path), number))
    for number in range(scenes):
        shares.setdefault(number / scenes, []).append(Task(version, seed, SCENE, "", "", number))
    return [task for share in sorted(shares) for task in shares[share]]


def flown(tasks: list[Task], jobs: int) -> Iterator[tuple[Task, Outcomes]]:
    """The outcomes, as they are finished."""
    return joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")(joblib.delayed(Task.run)(task) for task in tasks)  # pyright: ignore[reportReturnType]


def version_of_code() -> str:
    """Digest of all that a flight depends on."""
    roots = Path(runtime.__file__).parents[1], Path(__file__).parents[1]
    return digest(all_imports_of(["flights.sound", "flights.turned", "flights.faulty", "random_scenes.trial"], roots).values())


def main(
    models: Annotated[list[Path] | None, typer.Argument(help="Models that export-model wrote; by default the paper's.")] = None,
    flights: Annotated[int, typer.Option(min=1, help="Sound flights of each model; a tenth as many with each fault.")] = 1000,
    scenes: Annotated[int, typer.Option(min=0, help="Scenes drawn at random, some short flights over each.")] = 100,
    faults: Annotated[bool, typer.Option(help="Flights with each fault: as many frames again as the sound ones.")] = True,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the flights; by default drawn anew.")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="File of the counts.")] = Path("out/flights.json"),
) -> None:
    """Fly random flights and count what is certified, lost and found; or go on with a campaign that was stopped."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        journal_path, version = output.with_suffix(".flights.jsonl"), version_of_code()
        if seed is None:
            stopped = seed_of_stopped(journal_path, version, len(tasks_of(version, 0, models or [PAPER], flights, scenes, faults)))
            seed = secrets.randbelow(2**32) if stopped is None else stopped
        print(f"seed {seed}", file=sys.stderr)
        tasks = tasks_of(version, seed, models or [PAPER], flights, scenes, faults)
        journal = ResultJournal(journal_path, (task.key for task in tasks), Outcomes.read, Outcomes.tables)
        missing = [task for task in tasks if task.key not in journal.done]
        try:
            bar = track(flown(missing, jobs), "flights", total=len(missing), console=terminal.console(stderr=True))
            for task, outcomes in bar:
                journal.enter(task.key, outcomes)
        except KeyboardInterrupt:
            report(tasks, journal, seed, output)
            fail(f"stopped: {len(journal.done)} of {len(tasks)} flights are kept in {journal.path}; the same command goes on", INTERRUPTED)
        found = report(tasks, journal, seed, output)
    except (ModelError, OutputError, OSError) as error:
        fail(error)
    raise SystemExit(int(found > 0))


def report(tasks: list[Task], journal: ResultJournal[Outcomes], seed: int, output: Path) -> int:
    """Writes the JSON of what is finished, prints the tables and the findings, and returns how many there are."""
    total: dict[str, Outcomes] = {}
    for task in (task for task in tasks if task.key in journal.done):
        total.setdefault(task.model or SCENE, Outcomes()).add(journal.done[task.key])
    console = terminal.console(160)
    findings = [finding for outcomes in total.values() for finding in outcomes.findings]
    console.print(table_of_sound(total))
    console.print(table_of_faults(total))
    if findings:
        console.print(table_of_findings(findings))
    for finding in findings:
        print(f"{finding.fault}: {finding.detail}\n    {finding.place}, {', '.join(finding.kinds)}")
    write_whole(output, json.dumps({"seed": seed, "models": {name: each.tables() for name, each in total.items()}}, indent=2).encode())
    return len(findings)


def table_of_sound(total: dict[str, Outcomes]) -> Table:
    """What came of the sound flights of each model, and over scenes that were drawn."""
    columns = ("frames", "certified", "broken", "priors", "told", "late", "predicted", "findings")
    table = Table("sound flights", *columns, title_justify="left")
    for name, outcomes in total.items():
        for kind in (SOUND, TURNED):
            counts = outcomes.counts.get(kind, {})
            if counts:
                table.add_row(name if kind == SOUND else f"{name}, {kind}", *(f"{counts.get(column, 0):,}" for column in columns))
    return table


def table_of_faults(total: dict[str, Outcomes]) -> Table:
    """How flights with a fault ended, of all models together."""
    kinds = ("flights", "found", LATE, "harmless", "silent")
    table = Table("fault", "flights", "found within 1 s", *kinds[2:], title_justify="left")
    for fault in FAULTS:
        counts = [outcomes.counts.get(fault, {}) for outcomes in total.values()]
        table.add_row(fault, *(str(sum(count.get(kind, 0) for count in counts)) for kind in kinds))
    return table

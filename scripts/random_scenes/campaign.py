"""Counts how often a certificate holds on scenes drawn at random: other cameras, runways and domains than the paper's, at every scale.

    python scripts/random_scenes [--scenes N] [--frames N] [--seed N] [-o FILE.json]
    python scripts/random_scenes --replay "SEED/SCENE.DRAW#FRAME"

`random_scenes.trial` says what is a finding; with one, the exit code is 1. Without `--seed` every campaign draws other scenes; one that was
stopped goes on with its own, from what is kept beside the output.
"""

from __future__ import annotations

import json
import os
import re
import resource
import secrets
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from coverage.chunk import digest
from coverage.journal import ResultJournal
from import_graph import all_imports_of
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

import runtime
from random_scenes.outcomes import Finding, Outcomes
from random_scenes.sights import PLACES
from random_scenes.trial import Trial
from runtime import terminal
from runtime.whole_file import write_whole

MOST_MEMORY_BYTES = 4 * 2**30
"""A process's data beyond which an allocation fails, and its frame with it."""
COUNTED, SHARES = ("scenes", "frames", "judged", "findings", "certified"), {"narrower": "certified", "reached": "extremes"}
"""Columns of the table: counts, and counts as shares of others."""
SHOWN = 40
"""Findings that are printed; the JSON has all."""


@dataclass(frozen=True)
class Campaign:
    """How much is drawn, and from which seed."""

    seed: int
    scenes: int
    frames: int
    patience_s: float
    version: str
    """Digest of the code that decides what a scene is and what is said of it."""

    trial_of: Callable[[int, int, int, float, str], Trial] = Trial

    @property
    def trials(self) -> list[Trial]:
        """One trial a scene; the frames are shared out among them."""
        share, rest = divmod(self.frames, self.scenes)
        return [self.trial_of(self.seed, scene, share + (scene < rest), self.patience_s, self.version) for scene in range(self.scenes)]

    def journal(self, path: Path) -> ResultJournal[Outcomes]:
        """What is finished of this campaign."""
        return ResultJournal(path, (trial.key for trial in self.trials), Outcomes.read, Outcomes.tables)


def version_of_code(module: str = "random_scenes.trial") -> str:
    """Digest of all that a trial depends on, which is of this module."""
    roots = Path(runtime.__file__).parents[1], Path(__file__).parents[1]
    return digest(all_imports_of([module], roots).values())


def seed_of_stopped(journal: Path, version: str, scenes: int) -> int | None:
    """The seed of the campaign in a journal if it was stopped before its end, and the code is the same."""
    lines = journal.read_text(encoding="utf-8").splitlines() if journal.exists() else []
    found = [match for match in (re.match(r'\{"key": \["(\w+)", (\d+),', line) for line in lines) if match]
    same = {int(match[2]) for match in found if match[1] == version}
    return same.pop() if len(same) == 1 and len(found) < scenes else None


def limit_memory() -> None:
    """Makes an allocation fail before the machine runs out of memory."""
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_MEMORY_BYTES, resource.getrlimit(resource.RLIMIT_DATA)[1]))


def outcomes_of(trials: list[Trial], jobs: int) -> Iterator[tuple[Trial, Outcomes]]:
    """The trials' outcomes as they are finished. A trial that ends its process is found by running those alone that were not finished."""
    waiting = dict.fromkeys(trials)
    while waiting:
        pool = ProcessPoolExecutor(jobs, initializer=limit_memory)
        try:
            futures = {pool.submit(trial.run): trial for trial in waiting}
            for future in as_completed(futures):
                outcomes = future.result()
                del waiting[futures[future]]
                yield futures[future], outcomes
        except BrokenProcessPool:
            for suspect in list(waiting)[: 2 * jobs]:
                del waiting[suspect]
                yield suspect, outcomes_alone(suspect)
        finally:
            pool.shutdown(cancel_futures=True)


def outcomes_alone(trial: Trial) -> Outcomes:
    """A trial's outcomes from a process of its own, whose end is a finding."""
    with ProcessPoolExecutor(1, initializer=limit_memory) as pool:
        try:
            return pool.submit(trial.run).result()
        except BrokenProcessPool as error:
            return Outcomes(findings=[Finding(f"{trial.seed}/{trial.scene}", "the process ends", str(error), ())])


def run_campaign(campaign: Campaign, journal: ResultJournal[Outcomes], jobs: int) -> None:
    """Runs what the journal does not have yet, and enters it as it is finished."""
    trials = campaign.trials
    missing = [trial for trial in trials if trial.key not in journal.done]
    columns = (TextColumn("scenes"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.fields[found]} findings"))
    with Progress(*columns, console=terminal.console(stderr=True)) as bar:
        found = sum(len(outcomes.findings) for outcomes in journal.done.values())
        task = bar.add_task("scenes", total=len(trials), completed=len(trials) - len(missing), found=found)
        for trial, outcomes in outcomes_of(missing, jobs):
            journal.enter(trial.key, outcomes)
            found += len(outcomes.findings)
            bar.update(task, advance=1, found=found)


def table_of_kinds(counts: dict[str, Counter[str]]) -> Table:
    """Counts by kind of scene and of frame. A frame counts for each of its kinds.

    A box is narrower that the refinement made narrower; one is reached if its outer part has a state that it must hold, found by climbing.
    """
    view = Table(title="Random scenes", title_justify="left")
    for heading in ("kind", *COUNTED, *SHARES):
        view.add_column(heading, justify="left" if heading == "kind" else "right")
    of_scenes = sorted(kind for kind in counts if counts[kind]["scenes"] and kind not in PLACES)
    of_frames = sorted(kind for kind in counts if not counts[kind]["scenes"])
    for kinds in ([kind for kind in PLACES if kind in counts], of_scenes, of_frames):
        for kind in kinds:
            count = counts[kind]
            shares = [f"{count[part] / count[whole]:.1%}" if count[whole] else "-" for part, whole in SHARES.items()]
            view.add_row(kind, *(f"{count[column]:,}" for column in COUNTED), *shares, end_section=kind == kinds[-1])
    return view


TableOfKinds = Callable[[dict[str, Counter[str]]], Table]


def table_of_findings(findings: list[Finding]) -> Table:
    """Findings by fault: how many, in how many scenes, and the first of them."""
    view = Table(title="Findings", title_justify="left")
    for heading in ("fault", "findings", "scenes", "first", "kinds of its scene and frame"):
        view.add_column(heading)
    for fault, count in Counter(finding.fault for finding in findings).most_common():
        those = [finding for finding in findings if finding.fault == fault]
        scenes = {finding.place.partition("#")[0] for finding in those}
        view.add_row(fault, str(count), str(len(scenes)), those[0].place, ", ".join(those[0].kinds))
    return view


def report(campaign: Campaign, journal: ResultJournal[Outcomes], output: Path, table: TableOfKinds = table_of_kinds) -> int:
    """Writes the JSON, prints the tables and the findings of what is finished, and returns how many findings there are."""
    total = Outcomes()
    for trial in campaign.trials:
        if trial.key in journal.done:
            total.add(journal.done[trial.key])
    console = terminal.console(200)
    console.print(table(total.counts))
    print(f"seed {campaign.seed}; {total.refused.total()} draws refused: {dict(total.refused.most_common())}")
    if total.findings:
        console.print(table_of_findings(total.findings))
    for finding in total.findings[:SHOWN]:
        print(f'{finding.fault}: {finding.detail}\n    --replay "{finding.place}"')
    write_whole(output, json.dumps({"seed": campaign.seed, **total.tables()}, indent=2).encode())
    return len(total.findings)


def replay(place: str, patience_s: float, folder: Path, trial_of: Callable[[int, int, int, float], Trial] = Trial) -> int:
    """Builds a scene again and judges a frame of it, or its first ones; keeps model and frame. Returns the number of findings."""
    parts = re.fullmatch(r"(\d+)/(\d+)(?:\.(\d+))?(?:#(\d+))?", place)
    if parts is None:
        raise typer.BadParameter(f'found {place!r}; give "SEED/SCENE.DRAW#FRAME" as the report of a finding does')
    seed, scene, draw, frame = (None if part is None else int(part) for part in parts.groups())
    limit_memory()
    trial, outcomes = trial_of(seed or 0, scene or 0, 50, patience_s), Outcomes()
    path = folder / "replayed.onnx"
    built = trial.first_built(path, outcomes) if draw is None else trial.built(draw, path)
    if built is not None:
        print(f"{', '.join(built.drawn.kinds)}\n{json.dumps(built.drawn.scene.to_dict())}\n{path}")
        trial.judge_frames(built, range(trial.frames) if frame is None else range(frame, frame + 1), outcomes, folder)
    for finding in outcomes.findings:
        print(f"{finding.place}  {finding.fault}: {finding.detail}\n    {', '.join(finding.kinds)}")
    print(f"{len(outcomes.findings)} findings")
    return len(outcomes.findings)


def main(
    scenes: Annotated[int, typer.Option(min=1, help="Scenes to draw.")] = 1000,
    frames: Annotated[int, typer.Option(min=1, help="Frames to judge, of all scenes together.")] = 50_000,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of everything; another one each time if it is not given.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    patience: Annotated[float, typer.Option(min=0.1, help="Seconds after which a frame counts as without end.")] = 60.0,
    output: Annotated[Path, typer.Option("-o", "--output", help="JSON file for the counts.")] = Path("out/random_scenes.json"),
    replayed: Annotated[str | None, typer.Option("--replay", help='One frame again: "SEED/SCENE.DRAW#FRAME".')] = None,
) -> None:
    """Draw scenes, judge frames of each, and print the tables; or go on with a campaign that was stopped."""
    output.parent.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if replayed is not None:
        sys.exit(int(replay(replayed, patience, output.parent) > 0))
    sys.exit(int(run(version_of_code(), scenes, frames, seed, jobs, patience, output) > 0))


def run(
    version: str,
    scenes: int,
    frames: int,
    seed: int | None,
    jobs: int,
    patience: float,
    output: Path,
    trial_of: Callable[[int, int, int, float, str], Trial] = Trial,
    table: TableOfKinds = table_of_kinds,
) -> int:
    """Runs a campaign, or what is left of it, and reports; returns the number of findings. Ends the process if it is stopped."""
    path = output.with_suffix(".scenes.jsonl")
    if seed is None:
        stopped = seed_of_stopped(path, version, scenes)
        seed = secrets.randbelow(2**32) if stopped is None else stopped
    print(f"seed {seed}", file=sys.stderr)
    campaign = Campaign(seed, scenes, frames, patience, version, trial_of)
    journal = campaign.journal(path)
    try:
        run_campaign(campaign, journal, jobs)
    except KeyboardInterrupt:
        print(f"stopped: {len(journal.done)} of {scenes} scenes are kept in {journal.path}; the same command goes on", file=sys.stderr)
        report(campaign, journal, output, table)
        sys.exit(130)
    return report(campaign, journal, output, table)

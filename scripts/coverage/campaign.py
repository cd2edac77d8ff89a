"""Counts how often a certificate holds: random and adversarial frames whose truth is known exactly.

    python scripts/coverage [MODEL.onnx] [--frames N] [--recording FILE] [--only SCENARIO] [-o FILE.json]
    python scripts/coverage [the same options] --replay "SCENARIO#NUMBER"

The runway's images are drawn in rational numbers by code that the build does not have (`rational_image`), the frames are those of
`coverage.scenarios`, and `coverage.judge` says of which states a box must hold. One that does not, or one lit pixel of a judged runway that
`filtered` loses, is a violation: it is written with what is needed to replay it, and the exit code is 1. Finished chunks are kept beside
the output: the same command goes on where it was stopped, and begins anew if model, code, seed or recording are others.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import joblib
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn, track
from rich.table import Table

from coverage.chunk import Chunk, code, digest
from coverage.journal import ResultJournal
from coverage.judge import HALF_WIDTHS, Tally, Violation, quantile
from coverage.models import DERIVED, build_model
from coverage.scenarios import Scenario, scenarios
from runtime import Estimator, Scene, SceneError, terminal
from runtime.whole_file import write_whole

CHUNK = 250
COUNTS = ("frames", "judged", "certified", "violations", "pixels_lost", "no_runway", "at_boundary", "named", "fallbacks", "unrefined")


class Journal(ResultJournal[tuple[Tally, list[Violation]]]):
    """Finished chunks; what is not of this campaign is dropped."""

    def __init__(self, path: Path, chunks: Iterable[Chunk]) -> None:
        super().__init__(path, (chunk.key for chunk in chunks), self._read, self._written_out)

    @staticmethod
    def _read(tables: dict[str, Any]) -> tuple[Tally, list[Violation]]:
        return Tally.read(tables["tally"]), [Violation(**each) for each in tables["violations"]]

    @staticmethod
    def _written_out(result: tuple[Tally, list[Violation]]) -> dict[str, Any]:
        return {"tally": vars(result[0]), "violations": [asdict(each) for each in result[1]]}


def chunks_of(models: dict[str, Path], chosen: list[Scenario], frames: int, recording: Path | None, seed: int) -> list[Chunk]:
    """The campaign's work: a chunk of every scenario by turns, so that one that is stopped has seen them all."""
    others = code() if recording is None else [*code(), recording]
    campaigns = {name: digest([path, *others]) + f"-{seed}" for name, path in models.items()}
    film = None if recording is None else str(recording)
    return [
        Chunk(scenario, str(models[scenario.model]), film, seed, first, min(CHUNK, frames - first), campaigns[scenario.model])
        for first in range(0, frames, CHUNK)
        for scenario in chosen
    ]


def run_campaign(chunks: list[Chunk], journal: Journal, jobs: int) -> None:
    """Runs what the journal does not have yet, and enters it as it is finished."""
    missing = [chunk for chunk in chunks if chunk.key not in journal.done]
    found_so_far = TextColumn("{task.fields[violations]} violations")
    columns = (TextColumn("frames"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), found_so_far)
    with Progress(*columns, console=terminal.console(stderr=True)) as bar:
        found = sum(len(violations) for _, violations in journal.done.values())
        done = sum(chunk.frames for chunk in chunks) - sum(chunk.frames for chunk in missing)
        task = bar.add_task("frames", total=sum(chunk.frames for chunk in chunks), completed=done, violations=found)
        results = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")(joblib.delayed(Chunk.run)(chunk) for chunk in missing)
        for chunk, tally, violations in results:  # pyright: ignore[reportGeneralTypeIssues]
            journal.enter(chunk.key, (tally, violations))
            found += len(violations)
            bar.update(task, advance=chunk.frames, violations=found)


def table(results: dict[str, Tally]) -> Table:
    """The results as a table for people."""
    view = Table(title="Coverage", title_justify="left")
    headings = ("scenario", "frames", "judged", "certified", "violations", "pixels lost", "no runway", "at boundary", "cells", "named")
    for heading in (*headings, "fallback", "half-widths θ y z", "error 50 %", "95 %"):
        view.add_column(heading, justify="right" if heading != "scenario" else "left")
    for name, tally in (*results.items(), ("all", sum(results.values(), Tally()))):
        certified = max(tally.certified, 1)
        row = [name, tally.frames, tally.judged, tally.certified, tally.violations, tally.pixels_lost]
        row += [f"{tally.no_runway / tally.frames:.2%}", f"{tally.at_boundary / certified:.1%}", f"{tally.passing / certified:.2f}"]
        row += [f"{tally.named / certified:.1%}", tally.fallbacks]
        row += [" ".join(f"{quantile(getattr(tally, axis), 0.5):.4f}" for axis in HALF_WIDTHS)]
        row += [f"{quantile(tally.error, level):.4f}" for level in (0.5, 0.95)]
        view.add_row(*map(str, row), end_section=name == list(results)[-1])
    return view


def summary(tally: Tally) -> dict[str, object]:
    """Counts and quantiles of a scenario, for JSON."""
    half_widths = {axis: quantile(getattr(tally, axis), 0.5) for axis in HALF_WIDTHS}
    errors = {f"{level:.0%}": quantile(tally.error, level) for level in (0.5, 0.95)}
    cells = tally.passing / max(tally.certified, 1)
    counts = {name: getattr(tally, name) for name in COUNTS}
    return {**counts, "mean_passing": cells, "half_width_medians": half_widths, "error_quantiles": errors}


def report(chunks: list[Chunk], journal: Journal, output: Path) -> int:
    """Writes the JSON, prints the table and the violations, and returns how many there are."""
    results: dict[str, Tally] = {}
    violations: list[Violation] = []
    for chunk in chunks:
        tally, found = journal.done[chunk.key]
        results[chunk.scenario.name] = results.get(chunk.scenario.name, Tally()) + tally
        violations += found
    terminal.console(220).print(table(results))
    for each in violations[:20]:
        print(f'{each.fault}\n    state {each.state}\n    --seed {each.seed} --replay "{each.scenario}#{each.number}"')
    tables = {"scenarios": {name: summary(tally) for name, tally in results.items()}, "violations": [asdict(each) for each in violations]}
    write_whole(output, json.dumps(tables, indent=2).encode())
    return len(violations)


def scenario_named(name: str, chosen: list[Scenario]) -> Scenario:
    """The scenario of that name."""
    for each in chosen:
        if each.name == name:
            return each
    raise typer.BadParameter(f"no scenario {name!r}; give one of: {'; '.join(each.name for each in chosen)}")


def named(text: str, chosen: list[Scenario]) -> tuple[Scenario, int]:
    """The scenario and the number of a frame given as "SCENARIO#NUMBER"."""
    name, _, number = text.rpartition("#")
    if not number.isdecimal():
        raise typer.BadParameter(f'found {text!r}; give "SCENARIO#NUMBER" as the report of a violation does')
    return scenario_named(name, chosen), int(number)


def replay(chunk: Chunk) -> int:
    """Draws and judges a chunk's frames again, prints what is found, and returns the number of violations."""
    _, tally, violations = chunk.run()
    print(f"{tally.judged} states judged, {len(violations)} violations")
    for each in violations:
        print(f"{each.fault}\n    state {each.state}")
    return len(violations)


def derived_models(scene: Scene, wanted: set[str], folder: Path, jobs: int) -> dict[str, Path]:
    """Those of `DERIVED` that scenarios ask for. One that has no certificate, as where too little is left in view, is told and left out."""
    models = {}
    for name in track([name for name in DERIVED if name in wanted], "models", console=terminal.console(stderr=True)):
        try:
            models[name] = build_model(scene, name, folder, jobs)
        except SceneError as error:
            print(f"left out, with its scenarios: the model {name!r}, which this scene has none of ({error})", file=sys.stderr)
    return models


def is_allowed(scenario: Scenario, model: Path) -> bool:
    """True if the model's entries are strong enough for all pixels that are missed in the scenario; else it is told."""
    largest = Estimator.load(model).largest_missed_budget
    if max(scenario.missed, default=0) <= largest:
        return True
    print(f"left out: {scenario.name!r} misses up to {max(scenario.missed)} pixels, {model.name} takes {largest} at most", file=sys.stderr)
    return False


def main(
    model: Annotated[Path, typer.Argument(help="Model to test.")] = Path("models/paper.onnx"),
    frames: Annotated[int, typer.Option(min=1, help="Frames a scenario.")] = 2000,
    recording: Annotated[Path | None, typer.Option(help="Event recording whose frames serve as clutter.")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="JSON file for the counts.")] = Path("out/coverage.json"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of all frames.")] = 1,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 2,
    only: Annotated[list[str] | None, typer.Option(help="Scenario of the table, to run no others; may be given again.")] = None,
    replay_frame: Annotated[str | None, typer.Option("--replay", help='One frame again: "SCENARIO#NUMBER".')] = None,
) -> None:
    """Run every scenario, or what is left of an earlier run, and print the table."""
    folder = output.with_suffix("")  # of derived models: two campaigns at once have one each
    folder.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    given = Estimator.load(model)
    chosen = list(scenarios(recording is not None, given.largest_missed_budget))
    if replay_frame is not None:
        scenario, number = named(replay_frame, chosen)
        path = model if scenario.model == "given" else build_model(given.scene, scenario.model, folder, jobs)
        sys.exit(int(replay(Chunk(scenario, str(path), None if recording is None else str(recording), seed, number, 1, "")) > 0))
    if only:
        chosen = [scenario_named(name, chosen) for name in dict.fromkeys(only)]
    models = {"given": model} | derived_models(given.scene, {scenario.model for scenario in chosen}, folder, jobs)
    chosen = [scenario for scenario in chosen if scenario.model in models and is_allowed(scenario, models[scenario.model])]
    chunks = chunks_of(models, chosen, frames, recording, seed)
    journal = Journal(output.with_suffix(".chunks.jsonl"), chunks)
    try:
        run_campaign(chunks, journal, jobs)
    except KeyboardInterrupt:
        print(f"stopped: {len(journal.done)} of {len(chunks)} chunks are kept in {journal.path}; the same command goes on", file=sys.stderr)
        sys.exit(130)
    sys.exit(int(report(chunks, journal, output) > 0))

"""The command verify-model. It parses and prints; `build_model.verify.proof` does the work."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from runtime import terminal
from runtime.errors import fail
from runtime.model.format import ModelError

try:
    import typer
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Table

    from build_model.verify import proof
except ImportError as error:
    fail(f"verify-model: the package {error.name!r} is missing; pip install 'glideproof[build]'")

REFUTED = 1


def verify_model(
    model: Annotated[Path, typer.Argument(help="Model file that export-model wrote.")],
    jobs: Annotated[int, typer.Option(min=1, help="Processes that prove cells.")] = 2,
) -> None:
    """Prove a model's certificate anew, from its own tensors and the scene in its metadata. Exit code 1: a counterexample; 2: unusable."""
    console = terminal.console()
    columns = TextColumn("cells"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    try:
        with Progress(*columns, console=console) as bar:
            task = bar.add_task("cells", total=None)
            report = proof.verify_model(model, jobs, lambda done, total: bar.update(task, completed=done, total=total))
    except ModelError as error:
        fail(error)
    console.print(_table(model, report))
    if report.counterexample is not None:
        fail(f"{model}: refuted: {report.counterexample}", REFUTED)


def _table(model: Path, report: proof.VerificationReport) -> Table:
    table = Table(title=str(model), show_header=False, title_justify="left")
    table.add_column()
    table.add_column(overflow="fold")
    rows = {
        "cells": report.cells,
        "entries": report.entries,
        "pixels of S, bounds proved": report.spatial_pixels,
        "pixels of all O, bounds proved": report.may_light_pixels,
        "pixels of all K, each proved": report.must_light_pixels,
        "windows, each proved": report.windows,
        **({} if report.corners == 0 else _behind_a_lens(report)),
        "smallest margin": f"{report.margin_px:.3g} px",
        "calibration moves the image by": f"{report.displacement_px:.3f} px at most",
        "seconds": f"{report.seconds:.1f}",
        "sha256": report.sha256,
        "verdict": "proved" if report.proved else "REFUTED",
    }
    for name, value in rows.items():
        table.add_row(name, str(value))
    return table


def _behind_a_lens(report: proof.VerificationReport) -> dict[str, object]:
    return {
        "rays of the sensor's corners, each proved": report.corners,
        "pixels of the ideal frame, painting proved": report.painted_pixels,
    }


def verify_model_command() -> None:
    """Entry point of `verify-model`."""
    terminal.run(verify_model)

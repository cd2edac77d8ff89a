"""How close each way of computing the spatial filters S comes to what a cell's states can light: pixels of each, cell by cell.

    python scripts/compare_spatial_filters.py [SCENE.toml] [--samples N] [--seed N] [--whole-frame]

- sampled: the union of the images of random states of the cell. A lower bound: no sound filter is smaller.
- S: the filters that the build uses, `build_model.spatial_filter`, at tolerance 0.
- mixed monotonicity: the paper's way, Proposition 2 (corrected) on h and on NN_r, `build_model.paper.reachability`.
- intervals: interval arithmetic on h, then NN_r layer by layer.
- closed form: the exact ranges of zeta and of phi_Lin, then layer by layer: how much of the loss is the box of zeta's.

The last three bound NN_r at the pixels between a marking's ends; with --whole-frame at every pixel, where they light whole rows.
That takes minutes a cell.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import Progress
from rich.table import Table

from build_model.paper.method import Method
from build_model.paper.reachability import possible_pixels
from build_model.partition import partition
from build_model.spatial_filter import spatial_filters
from runtime import terminal
from runtime.errors import fail
from runtime.image import lit_columns
from runtime.scene import Scene, SceneError

Bits = NDArray[np.bool_]
STATES_AT_ONCE = 500
PAPER_SCENE = Path(__file__).resolve().parent.parent / "models" / "paper.toml"


def sampled_union(
    scene: Scene, lower: NDArray, upper: NDArray, samples: int, rng: np.random.Generator, advance: Callable[[], object]
) -> Bits:
    """The union of I_r over random states of the box [lower, upper], (height, width). Calls `advance` after each batch of states."""
    height, width = scene.camera.shape
    steps = np.zeros(height * (width + 1), dtype=np.int64)
    for start in range(0, samples, STATES_AT_ONCE):
        states = rng.uniform(lower, upper, (min(STATES_AT_ONCE, samples - start), 4))
        first, last = lit_columns(scene, states)
        first, last = np.maximum(first, 0), np.minimum(last, width - 1)
        *_, row = lit = np.nonzero(first <= last)
        for column, step in ((first[lit], 1), (last[lit] + 1, -1)):
            steps += step * np.bincount(row * (width + 1) + column, minlength=len(steps))
        advance()
    return np.cumsum(steps.reshape(height, width + 1), axis=1)[:, :-1] > 0


def compare(scene: Scene, samples: int, seed: int, *, whole_frame: bool, progress: Progress) -> NDArray[np.int64]:
    """Pixels of each cell, (cells, 5): sampled, S, and the three methods of `Method` in their order.

    Raises `ValueError` if a filter lacks a sampled pixel: it would not be sound.
    """
    scene = dataclasses.replace(scene, tolerance=dataclasses.replace(scene.tolerance, line_px=0))
    cells, filters = partition(scene), spatial_filters(scene)
    rng, counts = np.random.default_rng(seed), np.zeros((len(cells), 5), dtype=np.int64)
    batches = -(-samples // STATES_AT_ONCE)
    task = progress.add_task("cells", total=len(cells) * (batches + len(Method)))
    for cell, (lower, upper) in enumerate(zip(cells.lower, cells.upper, strict=True)):
        union = sampled_union(scene, lower, upper, samples, rng, lambda: progress.advance(task))
        masks = [filters[cell]]
        for method in Method:
            masks.append(possible_pixels(scene, lower, upper, method, between_ends=not whole_frame))
            progress.advance(task)
        for name, mask in zip(("S", *Method), masks, strict=True):
            if (union & ~mask).any():
                raise ValueError(f"cell {cell}: {name} lacks {(union & ~mask).sum()} pixels that sampled states light")
        counts[cell] = [union.sum(), *(mask.sum() for mask in masks)]
    return counts


def table_of(counts: NDArray[np.int64]) -> Table:
    """One row a cell, then totals: pixels, and their ratio to the sampled union where that is not empty."""
    table = Table("cell", "sampled", "S", *Method, title="Pixels of each cell's spatial filter, and ratio to the sampled union")
    for column in table.columns:
        column.justify = "right"
    for cell, row in enumerate(counts):
        table.add_row(str(cell), *_with_ratios(row))
    table.add_section()
    table.add_row("total", *_with_ratios(counts.sum(axis=0)))
    return table


def _with_ratios(row: NDArray[np.int64]) -> list[str]:
    sampled, *others = row.tolist()
    return [f"{sampled:,}", *(f"{other:,}  {other / sampled:.2f}" if sampled else f"{other:,}" for other in others)]


def main(
    scene_path: Annotated[Path, typer.Argument(metavar="SCENE.toml")] = PAPER_SCENE,
    samples: Annotated[int, typer.Option(min=1, help="Random states a cell.")] = 20_000,
    seed: Annotated[int, typer.Option(help="Seed of the random states.")] = 0,
    whole_frame: Annotated[bool, typer.Option("--whole-frame", help="Bound NN_r at every pixel of the frame; slow.")] = False,
) -> None:
    """Compare spatial filters: sampled union, the build's S, mixed monotonicity, intervals, closed form."""
    errors = terminal.console(stderr=True)
    try:
        with Progress(console=errors, transient=True) as progress:
            counts = compare(Scene.load(scene_path), samples, seed, whole_frame=whole_frame, progress=progress)
    except (SceneError, ValueError) as error:
        fail(error)
    terminal.console().print(table_of(counts))


if __name__ == "__main__":
    terminal.run(main)

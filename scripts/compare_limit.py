"""The certified box against the limit: the states that a frame allows, sampled until their extent grows no more.

    python scripts/compare_limit.py [MODEL.onnx | SCENE.toml] [--missed-budget M] [--missed K] [--clutter 0.01] [--frames 60] [-o FILE.csv]

No certificate under Theorem A can be narrower than the extent of all states of the domain whose image lacks at most `missed_budget` lit
pixels. `consistent_states.Sampler` finds that extent from within: what it prints is at most the limit, and the ratio at least the true
one. Frames are images of random states under random clutter, of which K pixels of the runway, chosen at random, then go dark. A scene
file is built first, with a constant in place of NN_e, which no certificate depends on. Exit code 1 if a box lacks a consistent state.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from comparison_frames import draw_frames, write_csv
from consistent_states import Extent, Sampler
from numpy.typing import NDArray
from rich.progress import track
from rich.table import Table

from runtime import Box, Estimator, ModelError, Scene, SceneError, terminal
from runtime.errors import fail
from runtime.image import runway_image
from runtime.scene import STATE_NAMES

Floats = NDArray[np.float64]

UNITS = ("rad", "m", "m", "m")


@dataclass(frozen=True)
class Comparison:
    """One frame: the certified box, None if there is none, and the extent of the consistent states that were found."""

    truth: Floats
    box: Box | None
    extent: Extent

    @property
    def ratio(self) -> Floats:
        """Width of the box over the limit's, (4,); NaN without a box, and on an axis where only one value was found."""
        limit = self.extent.half_widths
        return np.divide(self.half_widths, limit, out=np.full(4, np.nan), where=limit > 0)

    @property
    def half_widths(self) -> Floats:
        """The box's, (4,); NaN without a box."""
        return np.full(4, np.nan) if self.box is None else self.box.half_widths

    @property
    def violated(self) -> bool:
        """The box lacks a state that the frame allows."""
        return self.box is None or not (self.box.contains(self.extent.lower) and self.box.contains(self.extent.upper))


def loaded(path: Path, missed_budget: int) -> Estimator:
    """The model with that budget, for Theorem A; a scene's is built for it.

    Raises `ModelError` and `SceneError` as those do, ValueError for a model with a tolerance.
    """
    if path.suffix == ".toml":
        with tempfile.TemporaryDirectory() as folder:
            return _checked(Estimator.load(built(Scene.load(path), missed_budget, Path(folder)), extra_budget=-1))
    return _checked(Estimator.load(path, missed_budget=missed_budget, extra_budget=-1))


def _checked(estimator: Estimator) -> Estimator:
    tolerance = estimator.scene.tolerance.line_px
    if not estimator.scene.camera.pinhole:
        raise ValueError("camera.distortion: found a lens, of which the limit is not sampled; give a model of a pinhole")
    if tolerance:
        raise ValueError(f"tolerance.line_px: found {tolerance}, expected 0; give a model whose frames are exact")
    return estimator


def built(scene: Scene, missed_budget: int, folder: Path) -> Path:
    """The scene's model for that budget, with a constant for NN_e, in `folder`."""
    from build_model.export import export_model

    path = folder / "model.onnx"
    scene = replace(scene, tolerance=replace(scene.tolerance, missed_budget=missed_budget))
    export_model(scene, path, estimator=constant_network(scene.camera.shape, folder / "constant.onnx"))
    return path


def constant_network(shape: tuple[int, int], path: Path) -> Path:
    """Writes a network for `export_model` that answers 0 to every frame of `shape`, and returns its path."""
    import onnx
    from onnx import helper, numpy_helper

    weights = [numpy_helper.from_array(np.zeros((1, 4), np.float32), "zero"), numpy_helper.from_array(np.array([1, 1]), "flat")]
    nodes = [
        helper.make_node("GlobalAveragePool", ["frame"], ["mean"]),
        helper.make_node("Reshape", ["mean", "flat"], ["row"]),
        helper.make_node("MatMul", ["row", "zero"], ["state"]),
    ]
    frame = helper.make_tensor_value_info("frame", onnx.TensorProto.FLOAT, [1, 1, *shape])
    state = helper.make_tensor_value_info("state", onnx.TensorProto.FLOAT, [1, 4])
    graph = helper.make_graph(nodes, "constant", [frame], [state], weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10), path)
    return path


def frames_with_missed(scene: Scene, count: int, clutter: float, missed: int, seed: int) -> Iterator[tuple[Floats, NDArray[np.uint8]]]:
    """`draw_frames`, with `missed` pixels of each runway dark: all of them where it has no more."""
    for number, (state, frame) in enumerate(draw_frames(scene, count, clutter, seed)):
        lit = np.random.default_rng([seed, 2, number]).permutation(np.flatnonzero(runway_image(scene, state)))
        frame.ravel()[lit[:missed]] = 0
        yield state, frame


def compare(estimator: Estimator, truth: Floats, frame: NDArray[np.uint8], missed_budget: int, seed: Sequence[int]) -> Comparison:
    """The box and the sampled extent of one frame, in which at most `missed_budget` of the pixels of `truth` are dark."""
    sampler = Sampler(estimator.scene, frame.view(np.bool_), missed_budget, truth, np.random.default_rng(seed))
    return Comparison(truth, estimator.estimate(frame).box, sampler.extent())


def table_of(results: Sequence[Comparison], title: str) -> Table:
    """Medians over the frames that have a box, axis by axis; of y and z also in parts of the altitude and of the distance."""
    certified = [result for result in results if result.box is not None]
    free = [axis for axis in range(4) if any(result.extent.half_widths[axis] > 0 for result in certified)]
    table = Table(title=title, title_justify="left")
    table.add_column("half-widths", justify="left")
    for heading in (*(f"{STATE_NAMES[axis]}, {UNITS[axis]}" for axis in free), "y, %", "z, %"):
        table.add_column(heading, justify="right")
    truths = np.array([result.truth for result in certified])
    for name, widths in (
        ("certified box", [result.half_widths for result in certified]),
        ("limit, sampled", [result.extent.half_widths for result in certified]),
    ):
        shares = 100 * np.array(widths)[:, 2:] / truths[:, 2:]
        figures = [f"{value:.4g}" for value in np.median(widths, axis=0)[free]] + [f"{value:.3g}" for value in np.median(shares, axis=0)]
        table.add_row(name, *figures)
    for name, share in (("ratio, median", 0.5), ("ratio, 95 %", 0.95)):
        table.add_row(
            name, *(f"{value:.2f}" for value in np.nanquantile([result.ratio[free] for result in certified], share, axis=0)), "", ""
        )
    return table


def figures_of(result: Comparison) -> list[object]:
    """One row of the CSV, in the order of `HEADER`."""
    extent = result.extent
    return [*map(float, (*result.truth, *result.half_widths, *extent.half_widths)), extent.rounds, extent.converged]


HEADER = [*STATE_NAMES, *(f"{what}_{name}" for what in ("box", "limit") for name in STATE_NAMES), "rounds", "converged"]


def main(
    model: Annotated[Path, typer.Argument(help="Model, or a scene file to build one from.")] = Path("models/paper.onnx"),
    missed_budget: Annotated[int, typer.Option(min=0, help="Pixels of the runway's image that may be dark.")] = 0,
    missed: Annotated[int | None, typer.Option(min=0, help="How many really are; by default the budget.")] = None,
    clutter: Annotated[float, typer.Option(min=0.0, max=1.0, help="Density of random clutter.")] = 0.01,
    frames: Annotated[int, typer.Option(min=1, help="How many frames.")] = 60,
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV file, a row a frame.")] = Path("out/compare_limit.csv"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of states, clutter, missed pixels and sampling.")] = 1,
) -> None:
    """Compare the certified box with the states that the frame allows, print the table and write the CSV."""
    errors = terminal.console(stderr=True)
    dark = missed_budget if missed is None else missed
    try:
        if dark > missed_budget:
            raise ValueError(f"--missed: found {dark}, expected at most the budget, {missed_budget}; raise --missed-budget")
        estimator = loaded(model, missed_budget)
    except (ModelError, SceneError, ValueError) as error:
        fail(error)
    drawn = frames_with_missed(estimator.scene, frames, clutter, dark, seed)
    results = [
        compare(estimator, truth, frame, missed_budget, [seed, 3, number])
        for number, (truth, frame) in enumerate(track(drawn, "frames", total=frames, console=errors, transient=True))
    ]
    violations, unfinished = sum(result.violated for result in results), sum(not result.extent.converged for result in results)
    title = f"{estimator.scene.domain.cell_count} cells, {clutter:.0%} clutter, m = {missed_budget}, {dark} missed, {frames} frames"
    console = terminal.console(140)
    if any(result.box is not None for result in results):
        console.print(table_of(results, title))
    console.print(f"boxes that lack a consistent state: {violations}; samples that still grew after the last round: {unfinished}")
    write_csv(output, HEADER, [figures_of(result) for result in results])
    if violations:
        raise typer.Exit(1)


if __name__ == "__main__":
    terminal.run(main)

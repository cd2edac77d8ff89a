"""verify-model proves what was built, and nothing else: every mutation of a model must be refuted.

Some mutations change the banks and write the whole model anew, so that only the mathematics can tell; others change the file itself.
All checksums are recomputed.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import typer
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from taken_apart import Model, small_network
from typer.testing import CliRunner, Result

from build_model.assembly import assemble
from build_model.export import build_banks, export_model
from build_model.filter_graph import filter_graph
from build_model.hough_bank import CellBank
from build_model.line_boxes import LineBoxes
from build_model.pixel_mask import runs_of
from build_model.verify import cli
from build_model.verify.ball_camera import PRECISION_BITS, BallCamera, BallEntry, Ends, Slice, columns, columns_crossed
from build_model.verify.box_claims import check_boxes
from build_model.verify.cell_boxes import axis_borders, cell_boxes
from build_model.verify.cell_claim import cell_claims
from build_model.verify.cell_proof import prove_cell
from build_model.verify.counterexample import Counterexample, Refuted
from build_model.verify.displacement import displacement_px
from build_model.verify.outputs import check_outputs
from build_model.verify.proof import verify_model
from build_model.window import Bits
from runtime.camera import ground_scale, project, project_points
from runtime.image import runway_image
from runtime.model.format import NETWORK_PREFIX, PADDING_SIZE, ModelError
from runtime.scene import Axis, Bank, Calibration, Camera, Domain, Marking, Runway, Scene, Tolerance

SCENE = Scene(
    camera=Camera(width=128, height=96, focal_length_m=0.008, pixel_pitch_m=40e-6),
    runway=Runway((Marking("L", -0.1, 0.0, 0.6), Marking("R", 0.1, 0.0, 0.6))),
    domain=Domain(Axis((0.5,), 0.04), Axis((0.0,), 0.0), Axis((0.8, 0.84), 0.04), Axis((1.6,), 0.04)),
    bank=Bank(pitch_bins=2, distance_bins=1, column_px=0.35),
    tolerance=Tolerance(missed_budget=1),
)
OFF_BY = Calibration(roll_rad=0.001, yaw_rad=0.0005, focal_relative=0.001, principal_px=0.2)
TOLERANT = replace(SCENE, calibration=OFF_BY, tolerance=Tolerance(line_px=1, missed_budget=2, extra_budget=3))
FREE = replace(
    SCENE,
    camera=Camera(width=128, height=96, focal_px=(206.0, 198.0)),
    runway=Runway((*SCENE.runway.markings, Marking("C", 0.0, 0.2, 0.5))),
    domain=replace(SCENE.domain, x_m=Axis((0.0,), 0.01), y_m=Axis((0.8,), 0.04)),
)
SCENES = {"paper's shape": SCENE, "tolerant": TOLERANT, "oblong pixels, free x, three markings": FREE, "several rows a cell": SCENE}
WIDTH = 5
"""Of the rows in the last scene's model."""
Rng = np.random.Generator
PAPER_TOML = Path(__file__).parents[1] / "models" / "paper.toml"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One exported model a scene."""
    folder = tmp_path_factory.mktemp("models")
    paths = {}
    for number, (name, scene) in enumerate(SCENES.items()):
        paths[name] = folder / f"{number}.onnx"
        with pytest.MonkeyPatch.context() as patch:
            if name == "several rows a cell":
                patch.setattr("build_model.assembly.row_width", lambda _entries: WIDTH)
            export_model(scene, paths[name], estimator=small_network(scene, folder / f"network{number}.onnx"))
    return paths


def model_of_file(path: Path) -> Model:
    proto = onnx.load(path)
    return Model(SCENE, build_banks(SCENE), proto, json.loads(proto.metadata_props[0].value))


@pytest.fixture
def model(files: dict[str, Path]) -> Model:
    """The first scene's model, to be mutated."""
    return model_of_file(files["paper's shape"])


@pytest.fixture
def model_in_rows(files: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> Model:
    """The same with several rows a cell, which it keeps when it is written anew."""
    monkeypatch.setattr("build_model.assembly.row_width", lambda _entries: WIDTH)
    return model_of_file(files["several rows a cell"])


def bits_of(bank: CellBank) -> tuple[Bits, Bits, Bits]:
    """S, K and O as bits of the bank's window."""
    return (
        bank.spatial.bits(1, bank.window)[0],
        bank.must_light.bits(len(bank), bank.window),
        bank.may_light.bits(len(bank), bank.window),
    )


def random_state(rng: Rng, model: Model, cell: int) -> tuple[int, NDArray[np.float64]]:
    """An entry of the cell, and a state in it."""
    boxes, lines, camera = cell_boxes(model.scene), model.banks[cell].lines, model.scene.camera
    while True:
        entry = int(rng.integers(len(lines)))
        theta, x, scale, z = rng.uniform(lines.lower[entry], lines.upper[entry])
        y = float(ground_scale(camera, theta, 1.0, lines.reference_row[entry])) / scale
        if boxes.lower[cell, 2] <= y <= boxes.upper[cell, 2]:
            return entry, np.array([theta, x, y, z])


def random_pixel(rng: Rng, bits: Bits) -> tuple[int, int]:
    """Row and column of a random set bit."""
    row, column = rng.choice(np.argwhere(bits))
    return int(row), int(column)


def drop_pixel_from_spatial(rng: Rng, model: Model, cell: int) -> None:
    bank = model.banks[cell]
    spatial, _, may_light = bits_of(bank)
    _, state = random_state(rng, model, cell)
    pixel = random_pixel(rng, runway_image(model.scene, state)[bank.window.slices] > 0)
    spatial[pixel] = False
    model.set_bank(cell, spatial=runs_of(spatial[None], bank.window), may_light=runs_of(may_light & spatial, bank.window))


def add_pixel_to_must_light(rng: Rng, model: Model, cell: int) -> None:
    bank = model.banks[cell]
    _, must_light, may_light = bits_of(bank)
    entry, state = random_state(rng, model, cell)
    dark = runway_image(model.scene, state)[bank.window.slices] == 0
    must_light[(entry, *random_pixel(rng, may_light[entry] & dark))] = True
    model.set_bank(cell, must_light=runs_of(must_light, bank.window))


def drop_pixel_from_may_light(rng: Rng, model: Model, cell: int) -> None:
    bank = model.banks[cell]
    _, _, may_light = bits_of(bank)
    entry, state = random_state(rng, model, cell)
    may_light[(entry, *random_pixel(rng, runway_image(model.scene, state)[bank.window.slices] > 0))] = False
    model.set_bank(cell, may_light=runs_of(may_light, bank.window))


def add_pixel_to_may_light_outside_spatial(rng: Rng, model: Model, cell: int) -> None:
    bank = model.banks[cell]
    spatial, _, may_light = bits_of(bank)
    may_light[(int(rng.integers(len(bank))), *random_pixel(rng, ~spatial))] = True
    model.set_bank(cell, may_light=runs_of(may_light, bank.window))


def narrow_state_box(rng: Rng, model: Model, cell: int) -> None:
    entry, state = random_state(rng, model, cell)
    axis = int(rng.choice([0, 2, 3]))
    lower = model.banks[cell].state_lower.copy()
    lower[entry, axis] = np.nextafter(np.float32(state[axis]), np.float32(np.inf))
    model.set_bank(cell, state_lower=lower)


def shift_state_box(rng: Rng, model: Model, cell: int) -> None:
    bank, sign = model.banks[cell], rng.choice([-1, 1])
    shift = np.zeros_like(bank.state_lower)
    shift[rng.integers(len(bank)), rng.choice([0, 2, 3])] = sign * 1e-4
    model.set_bank(cell, state_lower=bank.state_lower + shift, state_upper=bank.state_upper + shift)


def shift_line_box(rng: Rng, model: Model, cell: int) -> None:
    """Along z, where every entry has states up to its faces."""
    lines = model.banks[cell].lines
    shift = np.zeros_like(lines.lower)
    shift[rng.integers(len(lines)), 3] = rng.choice([-1, 1]) * 1e-4
    model.set_bank(cell, lines=LineBoxes(lines.lower + shift, lines.upper + shift, lines.reference_row))


def shift_line_boxes_in_pitch(rng: Rng, model: Model, cell: int) -> None:
    """All entries of one bin of theta: some of them have states up to its faces."""
    lines = model.banks[cell].lines
    shift = np.zeros_like(lines.lower)
    shift[lines.lower[:, 0] == rng.choice(lines.lower[:, 0]), 0] = rng.choice([-1, 1]) * 1e-4
    model.set_bank(cell, lines=LineBoxes(lines.lower + shift, lines.upper + shift, lines.reference_row))


def shift_reference_row(rng: Rng, model: Model, cell: int) -> None:
    lines = model.banks[cell].lines
    row = lines.reference_row.copy()
    row[rng.integers(len(row))] += rng.choice([-1, 1])
    model.set_bank(cell, lines=LineBoxes(lines.lower, lines.upper, row))


def some_entry(rng: Rng, model: Model, cell: int) -> int:
    return int(rng.integers(len(model.banks[cell])))


def move_reference_rows_away(rng: Rng, model: Model, cell: int) -> None:
    """So far that no row tells scales apart any more, with scales that exclude nothing."""
    lines = model.banks[cell].lines
    lower, upper = lines.lower.copy(), lines.upper.copy()
    lower[:, 2], upper[:, 2] = 1e-300, 1e300
    model.set_bank(cell, lines=LineBoxes(lower, upper, np.full(len(lines), 1e16 * rng.choice([-1, 1]))))


def move_reference_row_out_of_the_frame(rng: Rng, model: Model, cell: int) -> None:
    lines = model.banks[cell].lines
    row = lines.reference_row.copy()
    row[some_entry(rng, model, cell)] = rng.choice([-1e-3, model.scene.camera.height + 1.001, np.nan, np.inf])
    model.set_bank(cell, lines=LineBoxes(lines.lower, lines.upper, row))


def unbind_scales(rng: Rng, model: Model, cell: int) -> None:
    """An entry's scales reach beyond what its states have by more than a step."""
    lines = model.banks[cell].lines
    upper = lines.upper.copy()
    upper[some_entry(rng, model, cell), 2] *= 1 + 10.0 ** rng.uniform(1, 290)
    model.set_bank(cell, lines=LineBoxes(lines.lower, upper, lines.reference_row))


def spoil_scales(rng: Rng, model: Model, cell: int) -> None:
    lines = model.banks[cell].lines
    lower, upper, entry = lines.lower.copy(), lines.upper.copy(), some_entry(rng, model, cell)
    if rng.random() < 0.5:
        lower[entry, 2] = rng.choice([0.0, -1.0, np.nan, np.nextafter(upper[entry, 2], np.inf)])
    else:
        upper[entry, 2] = rng.choice([np.inf, np.nan, np.nextafter(lower[entry, 2], 0)])
    model.set_bank(cell, lines=LineBoxes(lower, upper, lines.reference_row))


def invert_state_box(rng: Rng, model: Model, cell: int) -> None:
    bank, entry, axis = model.banks[cell], some_entry(rng, model, cell), int(rng.integers(4))
    lower, upper = bank.state_lower.copy(), bank.state_upper.copy()
    lower[entry, axis], upper[entry, axis] = upper[entry, axis], lower[entry, axis]
    model.set_bank(cell, state_lower=lower, state_upper=upper)


def remove_entry(rng: Rng, model: Model, cell: int) -> None:
    entry, _ = random_state(rng, model, cell)
    bank = model.banks[cell]
    kept = np.arange(len(bank)) != entry
    spatial, must_light, may_light = bits_of(bank)
    lines = LineBoxes(bank.lines.lower[kept], bank.lines.upper[kept], bank.lines.reference_row[kept])
    model.banks[cell] = CellBank(
        lines,
        runs_of(spatial[None], bank.window),
        runs_of(must_light[kept], bank.window),
        runs_of(may_light[kept], bank.window),
        bank.window,
        bank.state_lower[kept],
        bank.state_upper[kept],
    )
    model.set_tables(assemble(model.scene, model.banks))


def swap_cells(_rng: Rng, model: Model, _cell: int) -> None:
    model.banks.reverse()
    model.set_tables(assemble(model.scene, model.banks))


def swap_entries(rng: Rng, model: Model, cell: int) -> None:
    """Two entries of one cell exchange their masks, and keep their boxes."""
    bank = model.banks[cell]
    _, must_light, may_light = bits_of(bank)
    order = np.arange(len(bank))
    first, second = rng.choice(len(bank), 2, replace=False)
    order[[first, second]] = second, first
    model.set_bank(cell, must_light=runs_of(must_light[order], bank.window), may_light=runs_of(may_light[order], bank.window))


def misstate_size(rng: Rng, model: Model, cell: int) -> None:
    tables = model.tables()
    size = tables.must_light_size.copy()
    size[cell, rng.integers(len(model.banks[cell]))] += rng.choice([-1, 1])
    model.set_tables(replace(tables, must_light_size=size))


def raise_budget_above_weakest(_rng: Rng, model: Model, _cell: int) -> None:
    least = model.tables().smallest_must_light
    model.scene = replace(model.scene, tolerance=Tolerance(missed_budget=least))
    model.metadata["scene"] = model.scene.to_dict()
    model.set_tables(model.tables())


def change_focal_length(rng: Rng, model: Model, _cell: int) -> None:
    model.metadata["scene"]["camera"]["focal_length_m"] *= 1 + rng.choice([-1, 1]) * 1e-3


def change_marking(rng: Rng, model: Model, _cell: int) -> None:
    marking = model.metadata["scene"]["runway"]["markings"][rng.integers(2)]
    marking[rng.choice(["x_m", "start_z_m", "length_m"])] += rng.choice([-1, 1]) * 2e-3


def widen_domain(rng: Rng, model: Model, _cell: int) -> None:
    """By a millionth, shared out over an axis's cells, which go on touching each other."""
    axis = model.metadata["scene"]["domain"][str(rng.choice(["theta_rad", "z_m"]))]
    first, cells = axis["centres"][0], len(axis["centres"])
    axis["width"] += 1e-6 / cells
    axis["centres"] = [first + place * axis["width"] for place in range(cells)]


def change_tolerance(_rng: Rng, model: Model, _cell: int) -> None:
    model.metadata["scene"]["tolerance"]["line_px"] = 1


def change_calibration(_rng: Rng, model: Model, _cell: int) -> None:
    model.metadata["scene"]["calibration"]["yaw_rad"] = 1e-4


def change_smallest_must_light(_rng: Rng, model: Model, _cell: int) -> None:
    model.metadata["smallest_must_light"] += 1


def change_assumptions(_rng: Rng, model: Model, _cell: int) -> None:
    model.metadata["assumptions"].pop()


def change_default_budget(rng: Rng, model: Model, _cell: int) -> None:
    name = str(rng.choice(["missed_budget", "extra_budget"]))
    model.set_constant(name, numpy_helper.to_array(model.constants[name]) + np.int32(1))


def change_index(rng: Rng, model: Model, _cell: int) -> None:
    """One end of one run, of a mask that is read."""
    values = numpy_helper.to_array(model.constants["runs_0"]).copy()
    values[rng.choice(np.flatnonzero(values))] += rng.choice([-1, 1])
    model.set_constant("runs_0", values)


def point_beyond_the_sums(_rng: Rng, model: Model, _cell: int) -> None:
    """From an unused place, which counts nothing."""
    values = numpy_helper.to_array(model.constants["runs_0"]).copy()
    runs = values.reshape(2, -1)
    runs[:, np.flatnonzero(runs[0] == runs[1])[-1]] = 10**8
    model.set_constant("runs_0", values)


def change_place(rng: Rng, model: Model, cell: int) -> None:
    """An entry is given another one's mask."""
    name = str(rng.choice(["must_light_place", "may_light_place"]))
    place = numpy_helper.to_array(model.constants[name]).reshape(len(model.banks), -1).copy()
    first, second = rng.choice(len(model.banks[cell]), 2, replace=False)
    place[cell, first] = place[cell, second]
    model.set_constant(name, place.ravel())


def change_painted_run(rng: Rng, model: Model, _cell: int) -> None:
    values = numpy_helper.to_array(model.constants["spatial_run_index"]).copy()
    values[rng.integers(len(values))] += rng.choice([-1, 1])
    model.set_constant("spatial_run_index", values)


def change_small_constant(rng: Rng, model: Model, _cell: int) -> None:
    """A constant that stands for the graph's structure: axes, layouts, signs, borders."""
    names = [
        name
        for name in filter_constants(model)
        if not re.match("runs_|spatial_run|reference_row|largest_|farthest|[a-z]+_(lower|upper|budget|place|size)$", name)
    ]
    name = str(rng.choice(names))
    values = numpy_helper.to_array(model.constants[name]).copy()
    values.reshape(-1)[rng.integers(values.size)] += 1
    model.set_constant(name, values)


def filter_constants(model: Model) -> list[str]:
    return [tensor.name for tensor in filter_graph(model.scene, model.tables()).initializer]


def change_cell_box(rng: Rng, model: Model, cell: int) -> None:
    values = numpy_helper.to_array(model.constants["whole_lower"]).copy()
    values[rng.choice([0, 2, 3]), cell] += np.float32(rng.choice([-1, 1]) * 1e-4)
    model.set_constant("whole_lower", values)


def filter_node(model: Model, name: str) -> onnx.NodeProto:
    return next(node for node in model.proto.graph.node if node.name == name)


def change_threshold(rng: Rng, model: Model, _cell: int) -> None:
    filter_node(model, str(rng.choice(["within_missed", "within_extra"]))).op_type = "Less"


def change_operator(rng: Rng, model: Model, _cell: int) -> None:
    others = {"Add": "Sub", "Sub": "Add", "ReduceMin": "ReduceMax", "And": "Or", "Or": "And", "Greater": "Less", "ArgMax": "ArgMin"}
    nodes = [node for node in model.proto.graph.node if node.op_type in others and not node.name.startswith(NETWORK_PREFIX)]
    node = nodes[rng.integers(len(nodes))]
    node.op_type = others[node.op_type]


def change_attribute(_rng: Rng, model: Model, _cell: int) -> None:
    next(part for part in filter_node(model, "painted_flat").attribute if part.name == "reduction").s = b"max"


def swap_inputs(_rng: Rng, model: Model, _cell: int) -> None:
    inputs = filter_node(model, "missed").input
    inputs[0], inputs[1] = inputs[1], inputs[0]


def feed_network_with_frame(_rng: Rng, model: Model, _cell: int) -> None:
    filter_node(model, "filtered_image").input[0] = "frame"


def let_network_give_the_box(_rng: Rng, model: Model, _cell: int) -> None:
    """A node of NN_e writes `cell_lower`; NN_F's own goes by another name."""
    filter_node(model, "cell_lower").output[0] = f"{NETWORK_PREFIX}unused"
    graph = model.proto.graph
    own = next(node for node in graph.node if node.output[0].startswith(NETWORK_PREFIX) and node.op_type == "Identity")
    shape = numpy_helper.from_array(np.zeros((len(model.banks), 4), dtype=np.float32), f"{NETWORK_PREFIX}box")
    graph.initializer.append(shape)
    forged = helper.make_node("Identity", [shape.name], ["cell_lower"], name=f"{NETWORK_PREFIX}forged")
    graph.node.insert(list(graph.node).index(own) + 1, forged)


MATHEMATICAL = {
    drop_pixel_from_spatial: "not in O",
    add_pixel_to_must_light: "does not light a pixel of K",
    drop_pixel_from_may_light: "not in O",
    add_pixel_to_may_light_outside_spatial: "O has a pixel outside S",
    narrow_state_box: "outside its box of states",
    shift_state_box: "box of states",
    shift_line_box: "do not cover the cell|not in O|pixel of K|box of states",
    shift_line_boxes_in_pitch: "do not cover the cell|not in O|pixel of K|box of states",
    shift_reference_row: "do not cover the cell|not in O|pixel of K|box of states",
    move_reference_rows_away: "reference_row is not near the frame",
    move_reference_row_out_of_the_frame: "reference_row is not near the frame",
    unbind_scales: "scales reach beyond those of its states",
    spoil_scales: "scales are inverted, or not above 0 and finite",
    invert_state_box: "box of states is inverted",
    remove_entry: "do not cover the cell",
    swap_cells: "do not cover the cell|box of states",
    swap_entries: "not in O|pixel of K",
    misstate_size: r"must_light_size is not \|K\|",
    raise_budget_above_weakest: "does not exceed the missed budget",
    change_focal_length: "do not cover the cell|not in O|pixel of K|box of states",
    change_marking: "not in O|pixel of K",
    widen_domain: "constant 'whole_|do not cover the cell",
}
"""Mutations that only the mathematics can refute, and the claims that may be the first to fail."""
STRUCTURAL = {
    change_tolerance: "graph",
    change_calibration: "calibration",
    change_smallest_must_light: "smallest_must_light",
    change_assumptions: "assumptions",
    change_default_budget: "budget",
    change_index: r"not count a run|counted twice|S as painted|must_light_size|not in O|pixel of K|outside S",
    point_beyond_the_sums: "onnxruntime cannot run it",
    change_place: "must_light_size|not in O|pixel of K",
    change_painted_run: "S as painted|spatial_run",
    change_small_constant: "graph",
    change_cell_box: "whole_lower",
    change_threshold: "node",
    change_operator: "node",
    change_attribute: "node",
    swap_inputs: "node",
    feed_network_with_frame: "node before NN_e",
    let_network_give_the_box: "node",
}


@pytest.mark.parametrize("name", SCENES)
def test_what_was_built_is_proved(files: dict[str, Path], name: str) -> None:
    report = verify_model(files[name])
    assert report.counterexample is None
    assert report.cells == SCENES[name].domain.cell_count
    assert report.entries == sum(len(bank) for bank in build_banks(SCENES[name]))
    assert report.must_light_pixels < report.may_light_pixels
    assert 0 < report.margin_px < 1e-2
    assert report.sha256 == hashlib.sha256(files[name].read_bytes()).hexdigest()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("mutate", "claims"), MATHEMATICAL.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_a_wrong_build_is_refuted(model: Model, tmp_path: Path, mutate: Callable[[Rng, Model, int], None], claims: str, seed: int) -> None:
    assert_refuted(model, tmp_path, mutate, claims, seed)


def give_a_row_to_the_cell_before(_rng: Rng, model: Model, _cell: int) -> None:
    tables = model.tables()
    row_cell = tables.row_cell.copy()
    row_cell[np.searchsorted(row_cell, 1)] = 0
    model.set_tables(replace(tables, row_cell=row_cell))


def change_row_cell(_rng: Rng, model: Model, _cell: int) -> None:
    row_cell = model.tables().row_cell.copy()
    row_cell[-1] = 0
    model.set_constant("row_cell", row_cell)


IN_ROWS = {mutate: MATHEMATICAL[mutate] for mutate in (add_pixel_to_must_light, drop_pixel_from_may_light, narrow_state_box, remove_entry)}


@pytest.mark.parametrize(
    ("mutate", "claims"),
    {**IN_ROWS, give_a_row_to_the_cell_before: "reaches out of its cell", change_row_cell: "row_cell"}.items(),
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_wrong_model_of_several_rows_a_cell_is_refuted(
    model_in_rows: Model, tmp_path: Path, mutate: Callable[[Rng, Model, int], None], claims: str
) -> None:
    assert len(model_in_rows.tables().row_cell) > len(model_in_rows.banks)
    assert_refuted(model_in_rows, tmp_path, mutate, claims, seed=0)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("mutate", "claims"), STRUCTURAL.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_a_changed_file_is_refuted(model: Model, tmp_path: Path, mutate: Callable[[Rng, Model, int], None], claims: str, seed: int) -> None:
    assert_refuted(model, tmp_path, mutate, claims, seed)


def assert_refuted(model: Model, folder: Path, mutate: Callable[[Rng, Model, int], None], claims: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mutate(rng, model, int(rng.integers(len(model.banks))))
    report = verify_model(model.save(folder / "mutated.onnx"))
    assert report.counterexample is not None
    assert re.search(claims, str(report.counterexample)), str(report.counterexample)


@pytest.fixture(scope="module")
def paper_banks() -> list[CellBank]:
    return build_banks(Scene.load(PAPER_TOML))


@pytest.mark.evidence
@pytest.mark.parametrize(("mutate", "claims"), {**MATHEMATICAL, **STRUCTURAL}.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_a_wrong_paper_model_is_refuted(
    paper_banks: list[CellBank], tmp_path: Path, mutate: Callable[[Rng, Model, int], None], claims: str
) -> None:
    """Every kind of mutation of the model that comes with the package, at a random place."""
    proto = onnx.load(PAPER_TOML.with_suffix(".onnx"))
    model = Model(Scene.load(PAPER_TOML), list(paper_banks), proto, json.loads(proto.metadata_props[0].value))
    assert_refuted(model, tmp_path, mutate, claims, seed=4)


def test_boxes_that_the_refinement_cannot_rely_on_are_refuted(model: Model) -> None:
    """A camera that shows the horizon at the reference rows, and a domain that an entry leaves by float32's last place."""
    tables = model.tables()
    check_boxes(SCENE, tables)
    rows = tables.reference_row[tables.must_light_size != PADDING_SIZE]
    horizon = SCENE.camera.v0 - SCENE.camera.focal_v_px * np.tan(tables.state_lower[..., 0].max())
    camera = replace(SCENE.camera, principal_point=(SCENE.camera.u0, SCENE.camera.v0 + float(rows.min() - horizon)))
    with pytest.raises(Refuted, match="not certainly below the horizon of its states; cell 0; entry 0"):
        check_boxes(replace(SCENE, camera=camera), tables)
    upper = tables.state_upper.copy()
    upper[-1, 0, 3] = np.nextafter(upper[..., 3].max(), np.float32(np.inf))
    with pytest.raises(Refuted, match="reaches out of the domain; cell 1; entry 0"):
        check_boxes(SCENE, replace(tables, state_upper=upper))


def test_padding_that_reaches_into_the_hulls_is_refuted(model_in_rows: Model) -> None:
    tables = model_in_rows.tables()
    place = tuple(np.argwhere(tables.must_light_size == PADDING_SIZE)[0])
    for value, claim in ((np.finfo(np.float32).max, "out of the hulls' way"), (np.nan, "state_upper is not finite")):
        upper = tables.state_upper.copy()
        upper[place] = value
        with pytest.raises(Refuted, match=claim):
            check_boxes(SCENE, replace(tables, state_upper=upper))


def test_saving_without_a_mutation_changes_nothing(model: Model, tmp_path: Path) -> None:
    model.set_tables(assemble(model.scene, model.banks))
    assert verify_model(model.save(tmp_path / "same.onnx")).proved


@pytest.mark.parametrize("seed", range(4))
def test_a_counterexample_is_one(model: Model, tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mutate = (drop_pixel_from_may_light, add_pixel_to_must_light)[seed % 2]
    mutate(rng, model, 0)
    found = verify_model(model.save(tmp_path / "mutated.onnx")).counterexample
    assert found is not None
    assert found.pixel is not None
    assert found.entry is not None
    row, column = found.pixel
    bank = model.banks[0]
    _, must_light, may_light = bits_of(bank)
    inside = row - bank.window.top, column - bank.window.left
    lit = runway_image(model.scene, np.array(found.state))[row, column]
    if mutate is drop_pixel_from_may_light:
        assert lit
        assert not may_light[(found.entry, *inside)]
    else:
        assert not lit
        assert must_light[(found.entry, *inside)]


def test_a_network_that_reads_what_is_not_its_own_is_refuted(model: Model, tmp_path: Path) -> None:
    node = next(node for node in model.proto.graph.node if node.op_type == "ReduceMean" and node.output[0].startswith(NETWORK_PREFIX))
    node.input[0] = "cell_lower"
    model.set_constant(node.input[1], np.array([0, 1]))  # of cell_lower's two axes, so that the file can be loaded
    found = verify_model(model.save(tmp_path / "mutated.onnx")).counterexample
    assert found is not None
    assert "NN_e" in found.claim


def test_outputs_are_compared_with_their_definition(model: Model) -> None:
    """A graph that computes something else is caught by running it, even if it were the expected one."""
    tables = model.tables()
    check_outputs(model.proto.SerializeToString(), SCENE, tables)
    filter_node(model, "within_missed").op_type = "Less"
    with pytest.raises(Exception, match="is not what the masks define"):
        check_outputs(model.proto.SerializeToString(), SCENE, tables)


def ball_entry(camera: BallCamera, theta: tuple[float, float]) -> BallEntry:
    def pair(low: float, high: float) -> tuple[arb, arb]:
        return arb(low), arb(high)

    return BallEntry(camera, theta, pair(0.0, 0.01), pair(0.78, 0.82), pair(1.58, 1.62), pair(97.0, 101.0), 30.0)


def states_of(entry: BallEntry, rng: Rng, count: int) -> Iterator[NDArray[np.float64]]:
    """Random states of an entry."""
    while count:
        theta = rng.uniform(*entry.theta)
        x, scale, z = (rng.uniform(float(low), float(high)) for low, high in (entry.x, entry.scale, entry.z))
        y = float(ground_scale(SCENE.camera, theta, 1.0, entry.reference_row)) / scale
        if entry.y[0] <= y <= entry.y[1]:
            count -= 1
            yield np.array([theta, x, y, z])


@pytest.fixture
def precise() -> Iterator[None]:
    with ctx.workprec(PRECISION_BITS):
        yield


@pytest.mark.usefixtures("precise")
def test_the_ball_camera_is_the_rigid_camera() -> None:
    camera = BallCamera(SCENE.camera)
    for theta, y, d in np.random.default_rng(0).uniform([-0.4, 0.5, 1.0], [0.9, 1.5, 3.0], (200, 3)):
        _, v = project_points(SCENE.camera, np.array([theta, 0.0, y, 0.0]), 0.1, d)
        assert abs(float(camera.row(theta, arb(y), arb(d))) - v) < 1e-9
        fall, reach = (float(part) for part in camera.ray(theta, float(v)))
        depth = y * np.sin(theta) + d * np.cos(theta)
        assert abs(y / depth - fall) < 1e-12
        assert abs(d / depth - reach) < 1e-12


@pytest.mark.usefixtures("precise")
@pytest.mark.parametrize("row", [-300, 0, 48, 60, 400])
def test_ranges_of_a_ray_hold_every_theta_and_no_more(row: int) -> None:
    camera = BallCamera(SCENE.camera)
    for low, high in np.sort(np.random.default_rng(row + 300).uniform(-1.5, 1.5, (50, 2))).tolist():
        thetas = np.linspace(low, high, 101)
        tangent = (row - 48.0) / 200.0
        for bounds, values in (
            (camera.fall_range(low, high, row), np.sin(thetas) + tangent * np.cos(thetas)),
            (camera.reach_range(low, high, row), np.cos(thetas) - tangent * np.sin(thetas)),
        ):
            assert float(bounds[0]) <= values.min() + 1e-12
            assert float(bounds[1]) >= values.max() - 1e-12
            if values.min() > 0:
                assert values.max() > float(bounds[1]) - 1e-3
                assert values.min() < float(bounds[0]) + 1e-12


@pytest.mark.usefixtures("precise")
def test_a_slice_holds_what_its_states_show() -> None:
    camera, rng = BallCamera(SCENE.camera), np.random.default_rng(1)
    entry = ball_entry(camera, (0.49, 0.5))
    part = Slice(entry, *entry.theta)
    near, far = entry.z, (entry.z[0] + arb(0.6), entry.z[1] + arb(0.6))
    ends, across = Ends(near, far), (arb(0.1) - entry.x[1], arb(0.1) - entry.x[0])
    rows = part.rows(ends)
    assert rows is not None
    for state in states_of(entry, rng, 300):
        (_, v_near), (_, v_far) = project(SCENE, state)[1]
        assert float(rows[0][0]) <= v_near <= float(rows[0][1])
        assert float(rows[1][0]) <= v_far <= float(rows[1][1])
        image = runway_image(replace(SCENE, runway=Runway(SCENE.runway.markings[1:])), state)
        for row in range(96):
            lit = np.flatnonzero(image[row])
            seen = part.scales_seen_in(row, ends)
            if len(lit):
                assert seen is not None
                low, high = columns(camera, across, seen)
                assert float(low) < lit[0] + 1
                assert float(high) >= lit[-1]
            if (crossed := part.scales_crossed_in(row, ends)) is not None:
                smaller, greater = columns_crossed(camera, across, crossed)
                surely = [column for column in range(128) if smaller < column + 1 and greater > column]
                assert set(surely) <= set(lit.tolist())


@pytest.mark.usefixtures("precise")
def test_bounds_tend_to_what_the_states_show() -> None:
    """Tightness: over a thin slice of a thin entry the bounds are the states' own, to the width of the slice."""
    camera = BallCamera(SCENE.camera)
    thin = replace(ball_entry(camera, (0.495, 0.495 + 1e-6)), scale=(arb(99.0), arb(99.0 + 1e-6)), z=(arb(1.6), arb(1.6 + 1e-6)))
    part = Slice(thin, *thin.theta)
    ends = Ends(thin.z, (thin.z[0] + arb(0.6), thin.z[1] + arb(0.6)))
    state = next(states_of(thin, np.random.default_rng(0), 1))
    (_, v_near), (_, v_far) = project(SCENE, state)[1]
    for row in range(int(v_far), int(v_near) + 1):
        seen, crossed = part.scales_seen_in(row, ends), part.scales_crossed_in(row, ends)
        borders = np.clip([row, row + 1], v_far, v_near)
        expected = ground_scale(SCENE.camera, state[0], state[2], borders)
        for found in (seen, crossed):
            assert found is not None
            assert np.abs(np.array([float(side) for side in found]) - expected).max() < 1e-2


def test_borders_are_the_runtimes() -> None:
    for scene in (*SCENES.values(), Scene.load(PAPER_TOML)):
        for axis in scene.domain.axes:
            assert axis is not None
            assert axis_borders(axis) == axis.borders.tolist()


def test_displacement_holds_every_camera_within_the_calibration() -> None:
    from build_model.window import Window

    window, camera = Window(10, 60, 5, 100), TOLERANT.camera
    bound = displacement_px(TOLERANT, window)
    rng = np.random.default_rng(0)
    signs = rng.choice([-1, 1], (2000, 5)) * rng.choice([1.0, 0.5], (2000, 5))
    yaw, roll, share, right, down = (signs * [OFF_BY.yaw_rad, OFF_BY.roll_rad, OFF_BY.focal_relative, *[OFF_BY.principal_px] * 2]).T
    u, v = rng.choice([5, 52, 100], 2000), rng.choice([10, 35, 60], 2000)
    a, b = (u - camera.u0) / camera.focal_v_px, (v - camera.v0) / camera.focal_v_px
    depth = a * np.sin(yaw) + np.cos(yaw)
    a, b = (a * np.cos(yaw) - np.sin(yaw)) / depth, b / depth
    a, b = a * np.cos(roll) - b * np.sin(roll), a * np.sin(roll) + b * np.cos(roll)
    focal = camera.focal_v_px * (1 + share)
    shift = np.maximum(np.abs(camera.u0 + right + focal * a - u), np.abs(camera.v0 + down + focal * b - v))
    assert shift.max() <= bound
    assert shift.max() > 0.95 * bound
    assert displacement_px(SCENE, window) == 0


def test_the_builds_bound_on_the_displacement_is_proved() -> None:
    """Also where it is reached, at the corner of the window: ball arithmetic adds less than the build's margin."""
    from build_model.calibration import displacement_px as built_px
    from build_model.window import Window

    rng = np.random.default_rng(0)
    for kinds in itertools.product([0.0, 1.0], repeat=4):
        shares = 10 ** rng.uniform(-5, -1.5, 4) * [1, 1, 1, 100] * np.array(kinds)
        focal_length_m = TOLERANT.camera.focal_length_m * 10 ** rng.uniform(-1, 1)
        camera, calibration = replace(TOLERANT.camera, focal_length_m=focal_length_m), Calibration(*shares.tolist())
        scene = replace(TOLERANT, camera=camera, calibration=calibration)
        bound, stated = displacement_px(scene, Window(10, 60, 5, 100)), built_px(scene, Window(10, 60, 5, 100))
        assert bound <= stated <= 1.1 * bound


def test_a_cells_claim_is_refuted_where_its_entry_is(model: Model) -> None:
    claims = list(cell_claims(SCENE, model.tables()))
    found = prove_cell(replace(claims[1], lower=claims[0].lower))
    assert isinstance(found, Counterexample)
    assert found.cell == 1
    assert found.state is not None
    assert "do not cover" in found.claim


def invoke(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(cli.verify_model)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_command_prints_what_it_proved(files: dict[str, Path]) -> None:
    result = invoke(files["paper's shape"], "--jobs", 1)
    assert result.exit_code == 0, result.output
    assert "proved" in result.output
    assert verify_model(files["paper's shape"]).sha256 in re.sub(r"[^0-9a-z]", "", result.output)


def test_command_exits_1_with_the_counterexample(model: Model, tmp_path: Path) -> None:
    drop_pixel_from_may_light(np.random.default_rng(0), model, 1)
    result = invoke(model.save(tmp_path / "mutated.onnx"), "--jobs", 1)
    assert result.exit_code == cli.REFUTED
    line = result.stderr.strip()
    assert "\n" not in line
    for part in ("mutated.onnx: refuted: a state of the entry lights a pixel", "cell 1", "entry ", "row ", "column ", "theta "):
        assert part in line


@pytest.mark.parametrize("content", [None, b"", b"not a model"])
def test_command_exits_2_for_what_is_no_model(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "model.onnx"
    if content is not None:
        path.write_bytes(content)
    result = invoke(path)
    assert result.exit_code == 2
    assert str(path) in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_a_damaged_file_and_one_with_a_bad_scene_are_unusable(model: Model, tmp_path: Path) -> None:
    path = model.save(tmp_path / "model.onnx")
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(ModelError):
        verify_model(path)
    del model.metadata["scene"]["camera"]
    with pytest.raises(ModelError, match="scene"):
        verify_model(model.save(path))


def test_a_graph_given_twice_is_unusable(model: Model, tmp_path: Path) -> None:
    """Protocol Buffers joins two fields of one message; the runtime's digest would be that of the last."""
    path = model.save(tmp_path / "model.onnx")
    extra = onnx.ModelProto()
    extra.graph.node.add(op_type="Identity", input=["frame"], output=["extra"])
    path.write_bytes(extra.SerializeToString() + path.read_bytes())
    with pytest.raises(ModelError, match=r"graph twice in a file"):
        verify_model(path)

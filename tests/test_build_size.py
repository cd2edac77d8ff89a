"""What a scene takes to build: estimates beside the truth, and a bound on memory that is told and kept."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import AIRPORT, ONE_CELL, PAPER, STRIP

from build_model import build_size as build_size_module
from build_model import enclosure, hough_bank
from build_model.assembly import assemble
from build_model.build_size import (
    BYTES_A_RUN,
    BYTES_AN_ENTRY,
    MB,
    BuildSize,
    BuildTooLargeError,
    Ledger,
    build_size,
    check_size,
    free_memory_mb,
)
from build_model.export import build_banks, export_model
from build_model.hough_bank import CellBank, box_count, cell_bank, line_boxes, some_boxes
from build_model.line_boxes import LineBoxes
from build_model.paper.paper_bound import paper_bound
from build_model.partition import partition
from build_model.spatial_filter import spatial_filter, spatial_spans, spatial_window
from build_model.window_bank import CellWindows, cell_windows, group_boxes, group_count
from runtime import Scene, SceneError
from runtime.domain import Axis, Edges, Glide, Growth
from runtime.scene import Bank, Calibration, Marking, Runway, Tolerance, WindowedBank

WIDE = replace(AIRPORT, domain=replace(AIRPORT.domain, x_m=Axis((0.0,), 60.0)))
"""The bank of masks that a slice of a real approach takes is too large for most machines."""
SCENES = {
    "paper": replace(PAPER, domain=replace(PAPER.domain, theta_rad=Axis((0.6,), 0.1), y_m=Axis((0.9,), 0.1))),
    "one cell": ONE_CELL,
    "strip": replace(STRIP, domain=replace(STRIP.domain, theta_rad=Axis((0.45,), 0.1))),
    "airport": AIRPORT,
    "unlike cells": replace(
        STRIP,
        domain=replace(STRIP.domain, theta_rad=Axis((0.45,), 0.05), y_m=None, z_m=Growth(2.0, 3.0, 1.2), glide=Glide((0.3, 0.33), 2.0)),
    ),
    "windows": replace(
        AIRPORT,
        domain=replace(AIRPORT.domain, theta_rad=Edges((0.0, 0.03)), x_m=Axis((0.0,), 20.0), z_m=Growth(900.0, 1200.0, 1.15)),
        bank=WindowedBank(),
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_an_estimate_is_close_to_the_truth(name: str, tmp_path: Path) -> None:
    scene = SCENES[name]
    size = build_size(scene, trained=False)
    report = export_model(scene, tmp_path / "model.onnx", estimator="none", memory_mb=size.memory_bytes / MB)
    assert size.cells == report.cells
    assert size.boxes >= 0.9 * report.entries
    assert size.entries == pytest.approx(report.entries, rel=0.15)
    assert size.file_bytes == pytest.approx(report.file_bytes, rel=0.35)
    again = build_size(scene, trained=False)
    assert (again.boxes, again.entries, again.file_bytes, again.memory_bytes) == (
        size.boxes,
        size.entries,
        size.file_bytes,
        size.memory_bytes,
    )


@pytest.mark.parametrize("name", SCENES)
def test_boxes_are_counted_without_making_them(name: str) -> None:
    scene = SCENES[name]
    cells = partition(scene)
    for cell in {0, len(cells) - 1}:
        sides = cells.lower[cell], cells.upper[cell]
        if isinstance(scene.bank, Bank):
            boxes = line_boxes(scene, *sides)
            assert box_count(scene, *sides) == len(boxes)
            some = np.sort(np.random.default_rng(1).permutation(len(boxes))[:50])
            made = some_boxes(scene, *sides, some)
            for name_of_part in ("lower", "upper", "reference_row"):
                assert np.array_equal(getattr(made, name_of_part), getattr(boxes[some], name_of_part))
        else:
            assert group_count(scene, *sides) == len(group_boxes(scene, *sides))


def same(one: CellBank, other: CellBank) -> bool:
    arrays = [
        [bank.lines.lower, bank.lines.upper, bank.lines.reference_row, bank.state_lower, bank.state_upper]
        + [
            getattr(getattr(bank, masks), part)
            for masks in ("spatial", "must_light", "may_light")
            for part in ("mask", "column", "start", "stop")
        ]
        for bank in (one, other)
    ]
    return all(np.array_equal(left, right) for left, right in zip(*arrays, strict=True))


@pytest.mark.parametrize("name", ["one cell", "strip", "airport"])
def test_batches_of_any_size_give_the_same_bank(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, cells = SCENES[name], partition(SCENES[name])
    scene = replace(scene, tolerance=Tolerance(missed_budget=8))  # some entries are halved
    whole = cell_bank(scene, cells.lower[0], cells.upper[0])
    monkeypatch.setattr(hough_bank, "BATCH_BYTES", 2**21)
    assert same(whole, cell_bank(scene, cells.lower[0], cells.upper[0]))


def test_a_cell_is_built_in_a_memory_that_does_not_grow_with_its_entries(monkeypatch: pytest.MonkeyPatch) -> None:
    """One part of the wide scene's cell, and one twice as wide: what the entries themselves take is all that grows."""
    monkeypatch.setattr(hough_bank, "BATCH_BYTES", 2**24)
    peaks = []
    for width in (0.3, 0.9):
        scene = replace(WIDE, domain=replace(WIDE.domain, x_m=Axis((0.0,), width)))
        cells = partition(scene)
        tracemalloc.start()
        bank = cell_bank(scene, cells.lower[0], cells.upper[0])
        peaks.append(tracemalloc.get_traced_memory()[1] - layout_bytes([bank]) / 2)
        tracemalloc.stop()
    assert max(peaks) < 3 * 2**24


def layout_bytes(banks: list[CellBank]) -> int:
    runs = sum(len(masks.mask) for bank in banks for masks in (bank.spatial, bank.must_light, bank.may_light))
    return BYTES_A_RUN * runs + BYTES_AN_ENTRY * sum(map(len, banks))


@pytest.mark.parametrize("name", ["paper", "airport"])
def test_tables_are_laid_out_in_the_memory_that_is_told(name: str) -> None:
    tracemalloc.start()
    banks = [bank for bank in build_banks(SCENES[name]) if isinstance(bank, CellBank)]
    tracemalloc.reset_peak()
    assemble(SCENES[name], banks)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < layout_bytes(banks)


# --- what is refused ---


def refusal(scene: Scene, memory_mb: float, size: BuildSize | None = None) -> str:
    with pytest.raises(BuildTooLargeError) as caught:
        check_size(scene, size or build_size(scene, trained=False), memory_mb)
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value)


def test_a_scene_that_is_too_large_is_refused_by_the_number_to_change() -> None:
    found = refusal(WIDE, 1500)
    assert found.startswith("domain.x_m: x spans 60 m in about ")
    assert "more than the 1500 MB of --memory-mb; narrow it to about" in found
    assert found.endswith("or give a larger bank.lateral_px")
    narrower = replace(WIDE, domain=replace(WIDE.domain, x_m=Axis((0.0,), float(found.split("narrow it to about ")[1].split(" ")[0]))))
    size = build_size(narrower, trained=False)
    assert size.memory_bytes < 1.4 * 1500 * MB
    check_size(WIDE, build_size(WIDE, trained=False), 1e6)


def test_processes_and_training_are_named_where_they_take_most() -> None:
    assert refusal(ONE_CELL, 100).startswith("--memory-mb: found 100; give ")
    many = replace(AIRPORT, estimator=replace(AIRPORT.estimator, training_frames=10**7))
    assert refusal(many, 4000, build_size(many)).startswith("estimator.training_frames: found 10000000, which takes up to about ")


def test_cells_without_number_are_refused_at_once() -> None:
    theta = Edges(tuple(np.linspace(0.45, 0.75, 4001).tolist()))
    many = replace(PAPER, domain=replace(PAPER.domain, theta_rad=theta, z_m=Edges(tuple(np.linspace(1.6, 1.8, 301).tolist()))))
    with pytest.raises(BuildTooLargeError, match=r"^domain: found 3600000 cells; give 1000000 or fewer$"):
        build_size(many)


def test_a_build_stops_where_its_cells_take_more_than_was_estimated(tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    with pytest.raises(BuildTooLargeError, match=r"^bank: \d of 8 cells alone have \d+ entries and take 30\d MB to lay out, of the 302 MB"):
        export_model(STRIP, path, estimator="none", memory_mb=302, jobs=1)
    assert not path.exists()
    with pytest.raises(BuildTooLargeError):
        Ledger(1, 1.0).add(cell_bank(ONE_CELL, ONE_CELL.domain.lower, ONE_CELL.domain.upper))


def test_memory_that_runs_out_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def hungry(*_: object) -> CellBank:
        raise MemoryError

    monkeypatch.setattr("build_model.export.cell_bank", hungry)
    with pytest.raises(BuildTooLargeError, match=r"^--jobs: found 1; a process that builds cells had no memory left: give fewer$"):
        export_model(ONE_CELL, tmp_path / "model.onnx", estimator="none")


def test_a_calibration_that_no_tolerance_covers_is_refused_before_cells_are_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> CellBank:
        raise AssertionError("a cell was built")

    monkeypatch.setattr("build_model.export.cell_bank", never)
    for line_px, off, expected in ((0, 0.01, "give 3 or more"), (16, 0.4, "more than the largest line_px, 16")):
        scene = replace(PAPER, calibration=Calibration(roll_rad=off), tolerance=Tolerance(line_px=line_px))
        with pytest.raises(SceneError, match=rf"^tolerance\.line_px: found {line_px}, .*{expected}"):
            export_model(scene, tmp_path / "model.onnx", estimator="none")


@pytest.mark.parametrize("name", ["paper", "airport"])
def test_a_window_is_known_without_painting(name: str) -> None:
    scene = SCENES[name]
    cells = partition(scene)
    assert spatial_window(scene, cells.lower[0], cells.upper[0]) == spatial_filter(scene, cells.lower[0], cells.upper[0])[1]


def crowded(scene: Scene, markings: int) -> Scene:
    """The scene with so many markings between its edges, in one cell."""
    x_m, first = scene.runway.x_m, scene.runway.markings[0]
    across = np.linspace(x_m.min(), x_m.max(), markings)
    runway = Runway(tuple(Marking(f"m{number}", float(x), first.start_z_m, first.length_m) for number, x in enumerate(across)))
    domain = replace(scene.domain, theta_rad=Axis((0.02,), 0.03) if scene.bank == WindowedBank() else Axis((0.6,), 0.1))
    return replace(scene, runway=runway, domain=domain)


def test_a_sample_of_many_markings_keeps_to_the_memory_that_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Made whole, the cell takes more than that; what is sampled, and its time, does not grow with the markings."""
    made: list[int] = []

    def counted(scene: Scene, *sides: NDArray[np.float64], boxes: LineBoxes) -> CellWindows:
        made.append(len(boxes) * len(scene.runway.markings))
        return cell_windows(scene, *sides, boxes=boxes)

    monkeypatch.setattr(build_size_module, "cell_windows", counted)
    monkeypatch.setattr(build_size_module, "WINDOWED_COLUMNS", 2**20)
    monkeypatch.setattr(build_size_module, "SPANNED_COLUMNS", 2**22)
    whole = crowded(SCENES["windows"], 160)
    scene = replace(whole, bank=WindowedBank(set_px=8.0), domain=replace(whole.domain, z_m=Axis((950.0,), 50.0)))
    tracemalloc.start()
    size = build_size(scene, trained=False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < size.memory_bytes / 4
    assert size.boxes > 5 * 8 * sum(made) / 160
    assert 0 < 9 * scene.camera.height * max(made) <= 2**20
    assert len(made) == 2

    monkeypatch.setattr(build_size_module, "cell_windows", None)
    with pytest.raises(BuildTooLargeError, match=r"^--memory-mb: found 200; give \d+ or more"):
        build_size(scene, trained=False, memory_mb=200)


@pytest.mark.parametrize("name", ["paper", "windows"])
def test_markings_are_taken_in_parts_without_a_difference(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = crowded(SCENES[name], 20)
    cells = partition(scene)
    sides, found = (cells.lower[0], cells.upper[0]), []
    for at_once in (8, 20):
        monkeypatch.setattr(enclosure, "MARKINGS_AT_ONCE", at_once)
        found.append((spatial_window(scene, *sides), *spatial_spans(scene, *sides), paper_bound(scene, *sides)))
    for one, other in zip(*found, strict=True):
        assert np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other
    assert found[0][0] == spatial_filter(scene, *sides)[1]
    assert (found[0][-1] is None) == (name == "windows")


def test_some_memory_is_free() -> None:
    assert 0 < free_memory_mb() < 1e8

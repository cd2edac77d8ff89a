"""The bank of windows: what its windows claim, over states drawn at random, in arithmetic of their own; how strong and how tight it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import AIRPORT, FINAL, WINDOWED, examples, random_clutter, states_in

from build_model.export import build_banks
from build_model.line_boxes import LineBoxes
from build_model.partition import partition
from build_model.window_bank import CellWindows, Windows, cell_windows, group_boxes, step_px
from runtime.estimate import Outcome
from runtime.estimator import Estimator
from runtime.image import runway_image
from runtime.scene import Scene, SceneError, Tolerance, WindowedBank
from runtime.state_set import StateSet

SCENES = {**WINDOWED, "airport": replace(AIRPORT, bank=WindowedBank())}


@cache
def banks_of(name: str) -> list[CellWindows]:
    return [bank for bank in build_banks(SCENES[name]) if isinstance(bank, CellWindows)]


def entry_of(scene: Scene, bank: CellWindows, cell: int, number: int) -> StateSet:
    """An entry as a set of states, not contracted."""
    cells = partition(scene)
    return bank.lines[np.array([number])].states(scene.camera, cells.lower[cell], cells.upper[cell])


def lit_of_both(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """J, from a picture, by plain shifts: [r - 1, c] is lit with one of the three below it."""
    lit = np.pad(image > 0, 1)
    return (lit[1:-1] & (lit[2:] | np.roll(lit[2:], 1, axis=1) | np.roll(lit[2:], -1, axis=1)))[:, 1:-1]


def dark(windows: Windows, number: int, both: NDArray[np.bool_]) -> int:
    used = windows.first[number] <= windows.last[number]
    parts = (side[number][used] for side in (windows.border, windows.first, windows.last))
    return sum(not both[border - 1, first : last + 1].any() for border, first, last in zip(*parts, strict=True))


@pytest.mark.parametrize("name", SCENES)
@examples(60)
@given(data=st.data())
def test_every_state_lights_both_sides_of_each_border_within_its_window(name: str, data: st.DataObject) -> None:
    """Of an entry and of its group's gate; and with pixels dark, no more windows are than pixels."""
    scene, banks = SCENES[name], banks_of(name)
    cell = data.draw(st.integers(0, len(banks) - 1))
    numbers = np.flatnonzero(banks[cell].exists)
    number = int(numbers[data.draw(st.integers(0, len(numbers) - 1))])
    seed = data.draw(st.integers(0, 2**32 - 1))
    rng, group = np.random.default_rng(seed), number // banks[cell].exists.shape[1]
    for state in states_in(scene, entry_of(scene, banks[cell], cell, number), 12, seed):
        image = runway_image(scene, state)
        for windows, place in ((banks[cell].windows, number), (banks[cell].gate, group)):
            assert dark(windows, place, lit_of_both(image)) == 0
            pixels = np.flatnonzero(image)
            missed = image.copy()
            missed.ravel()[rng.choice(pixels, size := int(rng.integers(1, 9)), replace=False)] = 0
            assert dark(windows, place, lit_of_both(missed)) <= size


@pytest.mark.parametrize("name", SCENES)
def test_windows_of_a_set_share_no_pixel_and_lie_in_the_frame(name: str) -> None:
    scene = SCENES[name]
    margin, (height, width) = scene.tolerance.line_px, scene.camera.shape
    for bank in banks_of(name)[:2]:
        for windows in (bank.gate, bank.windows):
            for number in np.linspace(0, len(windows) - 1, 12).astype(int):
                taken = np.zeros((height, width), dtype=int)
                for border, first, last in zip(windows.border[number], windows.first[number], windows.last[number], strict=True):
                    if first <= last:
                        taken[border - 1, first : last + 1] += 1
                        taken[border, first - 1 : last + 2] += 1
                        assert border - 1 >= margin
                        assert border < height - margin
                        assert first > margin
                        assert last < width - 1 - margin
                assert taken.max() <= 1


@pytest.mark.parametrize("name", ["final", "airport", "strip in windows"])
def test_windows_are_as_narrow_as_their_states_allow(name: str) -> None:
    """On average a window is no more than 2 px wider than what 200 states of the entry light in it, corners among them."""
    scene, slack = SCENES[name], []
    for cell, bank in enumerate(banks_of(name)[:3]):
        for number in np.flatnonzero(bank.exists)[:: max(int(bank.exists.sum()) // 6, 1)]:
            images = [runway_image(scene, state) for state in states_in(scene, entry_of(scene, bank, cell, int(number)), 200, 3)]
            if len(images) < 50:
                continue
            seen = np.logical_or.reduce([lit_of_both(image) for image in images])
            for border, first, last in zip(*(getattr(bank.windows, part)[number] for part in ("border", "first", "last")), strict=True):
                if first <= last:
                    column = np.flatnonzero(seen[border - 1, first : last + 1])
                    slack.append(last - first - (column[-1] - column[0]))
    assert len(slack) > 100
    assert np.mean(slack) < 2


@pytest.mark.parametrize("name", SCENES)
def test_entries_cover_their_cell(name: str) -> None:
    """Every state of a cell lies in the box of some entry that exists."""
    scene, cells = SCENES[name], partition(SCENES[name])
    rng = np.random.default_rng(1)
    for cell, bank in enumerate(banks_of(name)):
        states = rng.uniform(cells.lower[cell], cells.upper[cell], (40, 4))
        lines: LineBoxes = bank.lines[bank.exists.ravel()]
        row, focal_u, focal_v = lines.reference_row, scene.camera.focal_u_px, scene.camera.focal_v_px
        for theta, x, y, z in states:
            scale = focal_u * (np.cos(theta) * (row - scene.camera.v0) / focal_v + np.sin(theta)) / y
            point = np.stack(np.broadcast_arrays(theta, x, scale, z), axis=-1)
            assert ((lines.lower <= point) & (point <= lines.upper)).all(axis=1).any()


def test_a_step_follows_the_rows_that_the_runway_spans() -> None:
    """Twice the rows, twice the step, up to `set_px`; the groups are then fewer."""
    cells = partition(FINAL)
    far, near = cells.lower[-1], cells.lower[0]
    upper = cells.upper[-1], cells.upper[0]
    assert step_px(FINAL, far, upper[0]) < step_px(FINAL, near, upper[1]) <= 16
    finer = replace(FINAL, bank=WindowedBank(set_px=4.0, rows=12))
    assert step_px(finer, near, upper[1]) == 4
    assert len(group_boxes(finer, near, upper[1])) > 4 * len(group_boxes(FINAL, near, upper[1]))


def test_a_budget_that_no_part_exceeds_is_refused() -> None:
    scene = replace(FINAL, tolerance=Tolerance(missed_budget=60))
    cells = partition(scene)
    with pytest.raises(SceneError, match=r"bank: in theta .* which does not exceed missed_budget 60; keep the runway in view"):
        cell_windows(scene, cells.lower[-1], cells.upper[-1])


def test_weak_groups_are_halved_until_they_are_strong() -> None:
    scene = replace(FINAL, tolerance=Tolerance(missed_budget=8))
    cells = partition(scene)
    bank, before = (cell_windows(chosen, cells.lower[-1], cells.upper[-1]) for chosen in (scene, FINAL))
    assert min(bank.gate.sizes.min(), bank.windows.sizes[bank.exists.ravel()].min()) > 8
    assert len(bank) > len(before)


@pytest.mark.parametrize("name", WINDOWED)
def test_the_box_holds_the_state_whatever_the_clutter(estimator_of: Callable[..., Estimator], name: str) -> None:
    """At 0 to 40 % clutter, with as many pixels missed as the budget allows, refined or not; overflow or not."""
    estimator, rng, overflows = estimator_of(name), np.random.default_rng(5), 0
    scene = estimator.scene
    for number, state in enumerate(scene.domain.uniform(rng, 24)):
        image = runway_image(scene, state)
        image.ravel()[rng.choice(np.flatnonzero(image), estimator.missed_budget, replace=False)] = 0
        frame = image | random_clutter(rng, scene.camera.shape, (0.0, 0.02, 0.1, 0.4)[number % 4])
        for refine in (False, True):
            estimate = estimator.estimate(frame, refine=refine)
            assert estimate.box is not None
            assert estimate.box.contains(state)
        overflows += bool(estimator.run(frame)["overflow"])
        kept = estimator.run(frame)["filtered"] > 0
        assert not ((image > 0) & ~kept).any()
    assert overflows > 0
    dark_frame = estimator.estimate(np.zeros(scene.camera.shape, dtype=np.uint8))
    assert dark_frame.outcome is Outcome.NO_RUNWAY


def test_theorem_b_uses_the_spatial_mask_of_a_cell(model_of: Callable[[str], Path]) -> None:
    """S row by row: the box under Theorem B holds the state, and is no wider than under Theorem A."""
    path = model_of("final")
    by_a, by_b = Estimator.load(path), Estimator.load(path, extra_budget=0)
    scene, rng = by_a.scene, np.random.default_rng(8)
    widths = []
    for state in scene.domain.uniform(rng, 8):
        frame = runway_image(scene, state)
        boxes = [estimator.estimate(frame).box for estimator in (by_a, by_b)]
        assert all(box is not None and box.contains(state) for box in boxes)
        widths.append([box.upper - box.lower for box in boxes if box is not None])
    assert (np.mean([width[1] for width in widths], axis=0) <= np.mean([width[0] for width in widths], axis=0) * 1.001).all()

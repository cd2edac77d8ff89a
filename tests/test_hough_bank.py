"""A cell's bank: its entries cover the cell, each state is in an entry that passes on its image, and the entries are sharp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import BARELY_ABOVE, BARELY_BELOW, CUT_LEFT, FREE_X, OFF_BY, PAPER, SHIFTED, THREE_MARKINGS, UNLIKE_MARKINGS, Floats, tolerant

from build_model.hough_bank import CellBank, _scale_bins, cell_bank, line_boxes
from build_model.line_boxes import LineBoxes
from build_model.partition import partition
from runtime.camera import ground_scale, project, project_points
from runtime.image import image_of_ends, runway_image
from runtime.model.limits import SCALE_STEP
from runtime.rounding import OUTWARD_PX, inverted
from runtime.scene import Axis, Camera, Scene, SceneError, Tolerance

HALVED = replace(PAPER, tolerance=Tolerance(missed_budget=45))
"""Many of the paper's entries have no more must-light pixels than that."""
CASES = {
    "paper": PAPER,
    "halved": HALVED,
    "three": THREE_MARKINGS,
    "unlike": UNLIKE_MARKINGS,
    "cut left": CUT_LEFT,
    "free x": FREE_X,
    "tolerant": tolerant(PAPER, OFF_BY),
}
SCENES = pytest.mark.parametrize("scene", CASES.values(), ids=CASES)


def states_of_cell(lower: Floats, upper: Floats, count: int, seed: int) -> Floats:
    """Random states of a cell, half of them on its faces, edges and corners, among them every corner."""
    share = np.random.default_rng(seed).random((count, 4))
    share[: count // 2] = np.clip(2 * share[: count // 2] - 0.5, 0, 1)
    share[:16] = np.stack(np.meshgrid(*[[0.0, 1.0]] * 4), axis=-1).reshape(16, 4)
    return np.clip(lower + share * (upper - lower), lower, upper)


def holding(scene: Scene, lines: LineBoxes, states: Floats) -> np.ndarray:
    """(states, entries): is the state in the entry's box? The scale is judged up to float64's error, the rest exactly."""
    theta, x, y, z = states.T[:, :, None]
    scale = ground_scale(scene.camera, theta, y, lines.reference_row)
    held = ~inverted(lines.lower[:, 2], scale) & ~inverted(scale, lines.upper[:, 2])
    for axis, value in ((0, theta), (1, x), (3, z)):
        held &= (lines.lower[:, axis] <= value) & (value <= lines.upper[:, axis])
    return held


def masks(bank: CellBank) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """S, K and O of every entry, in the bank's window."""
    return bank.spatial.bits(1, bank.window)[0], bank.must_light.bits(len(bank), bank.window), bank.may_light.bits(len(bank), bank.window)


def some_cells(scene: Scene) -> list[tuple[Floats, Floats]]:
    cells = partition(scene)
    return [(cells.lower[cell], cells.upper[cell]) for cell in (0, len(cells) // 2, len(cells) - 1)]


@SCENES
def test_each_state_of_a_cell_is_in_an_entry_that_passes_on_its_image(scene: Scene) -> None:
    """Every entry that holds the state: K is lit, and what is lit lies in O. With a tolerance O is wider, and K off the border."""
    for number, (lower, upper) in enumerate(some_cells(scene)):
        bank = cell_bank(scene, lower, upper)
        states = states_of_cell(lower, upper, 120, number)
        lit = runway_image(scene, states).astype(bool)
        spatial, must, may = masks(bank)
        held = holding(scene, bank.lines, states)
        assert held.any(axis=1).all()
        for image, entries in zip(lit, held, strict=True):
            cut = image[bank.window.slices]
            assert cut.sum() == image.sum()
            assert not (must[entries] & ~cut).any()
            assert not (cut & ~may[entries]).any()
            assert not (cut & ~spatial).any()


@SCENES
def test_entries_in_state_coordinates_hold_their_states(scene: Scene) -> None:
    """Strictly: `state_lower` and `state_upper` are rounded outward."""
    for number, (lower, upper) in enumerate(some_cells(scene)):
        bank = cell_bank(scene, lower, upper)
        states = states_of_cell(lower, upper, 200, number)
        state, entry = np.nonzero(holding(scene, bank.lines, states))
        assert (bank.state_lower[entry] < states[state]).all()
        assert (states[state] < bank.state_upper[entry]).all()


@pytest.mark.parametrize("scene", [PAPER, FREE_X], ids=["paper", "free x"])
def test_an_entry_moves_its_markings_by_no_more_than_the_bank_says(scene: Scene) -> None:
    """Through the scale, and through x, at the reference row and each on its own; no bin is much smaller than it may be."""
    for lower, upper in some_cells(scene):
        lines = line_boxes(scene, lower, upper)
        lever = np.abs(scene.runway.x_m[:, None] - lines.lower[:, 1]).max(axis=0)
        lever = np.maximum(lever, np.abs(scene.runway.x_m[:, None] - lines.upper[:, 1]).max(axis=0))
        by_scale = lever * (lines.upper[:, 2] - lines.lower[:, 2])
        by_x = (lines.upper[:, 1] - lines.lower[:, 1]) * lines.upper[:, 2]
        assert by_scale.max() <= scene.bank.column_px + OUTWARD_PX
        assert by_scale.min() > 0.9 * scene.bank.column_px
        assert by_x.max() <= scene.bank.lateral_px * 1.02  # the last bin of the scale may end beyond the cell
        assert (by_x.min() > 0.6 * scene.bank.lateral_px) == (upper[1] > lower[1])


def test_every_bin_of_the_scale_has_borders_that_any_machine_computes() -> None:
    for lower, upper in some_cells(PAPER):
        borders = line_boxes(PAPER, lower, upper).lower[:, 2] * 2**10
        assert (borders == np.round(borders)).all()


def test_scales_are_above_0_where_a_bin_reaches_beyond_the_smallest() -> None:
    """Far away a metre spans less than a bin, whose border at 0 would stand for the horizon."""
    far = replace(PAPER.domain, theta_rad=Axis((0.01,), 0.0), y_m=Axis((5.0,), 1.0), z_m=Axis((300.0,), 10.0))
    scene = replace(PAPER, domain=far)
    lines = line_boxes(scene, far.lower, far.upper)
    low, high = (float(ground_scale(scene.camera, 0.01, y, lines.reference_row[0])) for y in (5.5, 4.5))
    assert high < PAPER.bank.column_px / 0.1
    assert 0.25 * low <= lines.lower[:, 2].min() <= low
    assert lines.upper[:, 2].max() >= high


def test_the_papers_entries_must_light_thirty_pixels() -> None:
    """Median |K| of all 27 cells, and none below 20: empty masks would be sound and useless."""
    cells = partition(PAPER)
    banks = [cell_bank(PAPER, lower, upper) for lower, upper in zip(cells.lower, cells.upper, strict=True)]
    sizes = np.concatenate([bank.must_light_sizes for bank in banks])
    assert np.median(sizes) >= 30
    assert sizes.min() >= 20
    assert [bank.must_light_sizes.tolist() for bank in banks[:2]] == [masks(bank)[1].sum(axis=(1, 2)).tolist() for bank in banks[:2]]
    assert max(bank.may_light.sizes(len(bank)).max() / bank.spatial.sizes(1)[0] for bank in banks) < 0.5


def test_a_clean_image_passes_few_entries_of_its_cell() -> None:
    """Of some hundred: the bank tells states apart."""
    lower, upper = some_cells(PAPER)[1]
    bank = cell_bank(PAPER, lower, upper)
    _, must, _ = masks(bank)
    lit = runway_image(PAPER, states_of_cell(lower, upper, 100, 8)).astype(bool)
    passes = [(~(must & ~image[bank.window.slices]).any(axis=(1, 2))).sum() for image in lit]
    assert np.median(passes) < 0.25 * len(bank)
    assert min(passes) >= 1


def test_an_entry_that_any_frame_would_pass_is_halved() -> None:
    """|K| exceeds the budget in every entry, and no entry is halved that need not be."""
    lower, upper = some_cells(PAPER)[0]
    plain = cell_bank(PAPER, lower, upper)
    weakest = int(plain.must_light_sizes.min())
    spared = cell_bank(replace(PAPER, tolerance=Tolerance(missed_budget=weakest - 1)), lower, upper)
    assert (spared.lines.lower == plain.lines.lower).all()
    halved = cell_bank(HALVED, lower, upper)
    assert len(plain) < len(halved) < 3 * len(plain)
    assert halved.must_light_sizes.min() > HALVED.tolerance.missed_budget


def test_a_scene_that_no_division_saves_is_refused() -> None:
    """The message says where, how many pixels are left, and what to do."""
    lower, upper = some_cells(PAPER)[0]
    with pytest.raises(SceneError, match=r"^bank: in theta 0\.45\.\..* only \d+ pixels .*missed_budget 100; keep the runway in view"):
        cell_bank(replace(PAPER, tolerance=Tolerance(missed_budget=100)), lower, upper)
    out_of_view = replace(PAPER, camera=replace(PAPER.camera, principal_point=(320.0, 3000.0)))
    with pytest.raises(SceneError, match=r"^bank: in theta .* only 0 pixels .*keep the runway in view there$"):
        cell_bank(out_of_view, lower, upper)


def test_the_tolerance_takes_what_a_shift_can_carry_out_of_the_frame() -> None:
    """K of a tolerant scene keeps 1 px off the border, where some entries have pixels, and is otherwise the same."""
    height, width = CUT_LEFT.camera.shape
    at_border = 0
    for lower, upper in some_cells(CUT_LEFT):
        banks = cell_bank(CUT_LEFT, lower, upper), cell_bank(tolerant(CUT_LEFT, OFF_BY), lower, upper)
        for entry in range(0, len(banks[0]), 7):
            frames = np.zeros((2, height, width), dtype=bool)
            for frame, bank in zip(frames, banks, strict=True):
                frame[bank.window.slices] = bank.must_light.bits(len(bank), bank.window)[entry]
            exact, wide = frames
            at_border += int(exact[:, 0].any())
            exact[:1] = exact[-1:] = exact[:, :1] = exact[:, -1:] = False
            assert (exact == wide).all()
    assert at_border > 0


@pytest.mark.parametrize(("exact", "border", "down"), [(BARELY_ABOVE, 0, 1), (BARELY_BELOW, 480, -1)], ids=["above", "below"])
def test_o_holds_what_a_shift_brings_into_the_frame(exact: Scene, border: int, down: int) -> None:
    """The end of a marking that lies less than a pixel above the frame, or below it, where an exact camera does not show it."""
    scene = tolerant(exact, SHIFTED)
    lower, upper = scene.domain.lower, scene.domain.upper
    bank = cell_bank(scene, lower, upper)
    spatial, _, may = masks(bank)
    states = states_of_cell(lower, upper, 60_000, 3)
    beyond = down * (border - project(scene, states)[:, 1, :, 1])
    states = states[((beyond > 0) & (beyond < 1)).any(axis=1)]
    held = holding(scene, bank.lines, states)
    for across in (-0.99, 0.99):
        seen = image_of_ends(project(scene, states) + np.array([across, 0.99 * down]), scene.camera.shape).astype(bool)
        cut = seen[:, *bank.window.slices]
        assert (cut.sum(axis=(1, 2)) == seen.sum(axis=(1, 2))).all()
        assert not (cut & ~spatial).any()
        assert not any((lit & ~may[entries]).any() for lit, entries in zip(cut, held, strict=True))


def test_a_pitch_that_ends_at_zero_loses_no_state() -> None:
    """Level flight on the border of an entry: theta = 0 is where a margin that is relative would vanish."""
    camera = Camera(width=640, height=480, focal_length_m=0.006, pixel_pitch_m=15e-6, principal_point=(320.0, 100.0))
    theta = Axis((-0.05,), 0.1)
    domain = replace(PAPER.domain, theta_rad=theta, y_m=Axis((1.0,), 0.1), z_m=Axis((1.7,), 0.1))
    scene = replace(PAPER, camera=camera, domain=domain)
    lower, upper = scene.domain.lower, scene.domain.upper
    assert upper[0] == 0
    assert (project_points(camera, lower, 0.1, 0.0) > 0).all()
    bank = cell_bank(scene, lower, upper)
    states = states_of_cell(lower, upper, 400, 4)
    states[:, 0] = 0.0
    assert holding(scene, bank.lines, states).any(axis=1).all()


def test_bins_of_a_small_scale_begin_above_0() -> None:
    """Altitudes are divided by the scale; a runway so far away that its scale is below one step of the bins must not be lost."""
    smallest = SCALE_STEP / 3
    bins = _scale_bins(PAPER, np.array([0.0, 0.0]), np.array([smallest, 5 * SCALE_STEP]))
    assert 0 < bins[0, 0] <= smallest
    assert (bins[1:, 0] == bins[:-1, 1]).all()
    assert bins[-1, 1] >= 5 * SCALE_STEP

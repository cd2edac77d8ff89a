"""NN_r against the exact supercover: equal on generic states, and every tie counted and explained."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from build_model.paper.runway_network import RunwayNetwork, phi_abs, phi_det, pixel_weights
from build_model.window import Window
from runtime.camera import project, project_points
from runtime.image import runway_image
from runtime.scene import Axis, Bank, Camera, Domain, Marking, Runway, Scene

PAPER = Scene.load(Path(__file__).parent.parent / "models" / "paper.toml")


def dyadic_scene(*markings: Marking) -> Scene:
    """F = 512 px, and level flight at theta = 0 and y = 1/2 m over dyadic points: every column and row of an end is exact."""
    camera = Camera(width=320, height=320, focal_length_m=1.0, pixel_pitch_m=2.0**-9, principal_point=(32.0, 32.0))
    domain = Domain(Axis((0.0,), 0.1), Axis((0.0,), 0.0), Axis((0.5,), 0.1), Axis((1.0,), 0.1))
    return Scene(camera, Runway(markings), domain, Bank(1, 1, 0.5))


LEVEL = np.array([[0.0, 0.0, 0.5, 1.0]])


def both_images(scene: Scene, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(exact, NN_r) of the states, in the smallest window that holds all lit pixels and a border of 3."""
    exact = runway_image(scene, states).astype(bool)
    rows, columns = np.nonzero(exact.any(axis=0))
    height, width = scene.camera.shape
    window = Window(max(rows.min() - 3, 0), min(rows.max() + 4, height), max(columns.min() - 3, 0), min(columns.max() + 4, width))
    network = RunwayNetwork(scene.camera, window)
    batches = torch.from_numpy(project(scene, states)).split(8)
    return exact[:, *window.slices], np.concatenate([network.image(ends).numpy() for ends in batches])


def test_equals_the_supercover_on_random_states() -> None:
    rng = np.random.default_rng(1)
    states = rng.uniform(PAPER.domain.lower, PAPER.domain.upper, (60, 4))
    exact, network = both_images(PAPER, states)
    assert exact.sum(axis=(1, 2)).min() > 40
    np.testing.assert_array_equal(network, exact)


def test_equals_the_supercover_where_the_frame_cuts_the_runway() -> None:
    rng = np.random.default_rng(2)
    camera = dataclasses.replace(PAPER.camera, width=60, height=40)
    scene = dataclasses.replace(PAPER, camera=camera)
    states = rng.uniform(PAPER.domain.lower, PAPER.domain.upper, (60, 4)) + rng.uniform(-0.05, 0.05, (60, 4)) * [0, 1, 0, 0]
    exact, network = both_images(scene, states)
    assert exact[:, 0].any()
    assert exact.any(axis=0).mean() > 0.1
    np.testing.assert_array_equal(network, exact)


def test_a_window_is_a_part_of_the_whole_frame() -> None:
    states = np.array([[0.61, 0.0, 0.93, 1.71]])
    ends = torch.from_numpy(project(PAPER, states))
    frame = RunwayNetwork(PAPER.camera).image(ends).numpy()
    np.testing.assert_array_equal(frame, runway_image(PAPER, states).astype(bool))
    window = Window(150, 260, 280, 360)
    np.testing.assert_array_equal(RunwayNetwork(PAPER.camera, window).image(ends).numpy(), frame[:, *window.slices])


def test_a_marking_inside_one_pixel_lights_it() -> None:
    network = RunwayNetwork(PAPER.camera, Window(100, 104, 200, 205))
    lit = network(torch.tensor([[202.3, 101.8, 202.7, 101.2]], dtype=torch.float64))[0] > 0
    assert lit.nonzero().tolist() == [[1, 2]]


def test_the_weights_are_orientations_and_distances() -> None:
    """W zeta against the formulas written out, at one pixel."""
    zeta = torch.tensor([[310.5, 240.25, 314.75, 180.5]], dtype=torch.float64)
    (u1, v1, u2, v2), det = zeta[0].tolist(), phi_det(zeta).item()
    values = pixel_weights(Window(200, 201, 312, 313))[0, 0] @ [u1, v1, u2, v2, det, 1]

    def corner(x: float, y: float) -> float:
        return (u1 - x) * (v2 - y) - (v1 - y) * (u2 - x)

    left, right, top, bottom = 312, 313, 200, 201
    expected = [corner(left, top), corner(left, bottom), u1 - left, u2 - left]
    expected += [corner(right, top), corner(right, bottom), u1 - right, u2 - right]
    expected += [corner(left, top), corner(right, top), v1 - top, v2 - top]
    expected += [corner(left, bottom), corner(right, bottom), v1 - bottom, v2 - bottom]
    np.testing.assert_array_equal(values, expected)


def test_phi_abs_is_zero_exactly_for_one_sign() -> None:
    """No rounding: |a| + |b| and |a + b| round alike, however far apart a and b are."""
    rng = np.random.default_rng(3)
    magnitude = torch.from_numpy(np.exp(rng.uniform(-30, 30, (10_000, 16))))
    assert phi_abs(magnitude).abs().max() == 0
    assert phi_abs(-magnitude).abs().max() == 0
    opposite = magnitude * torch.tensor([1, -1] * 8)
    comparable = magnitude.clamp(1e-3, 1e3) * torch.tensor([1, -1] * 8)
    assert phi_abs(opposite)[:, :8].min() >= 0
    assert phi_abs(comparable)[:, :8].min() > 0


# Ties. On a tie the marking touches a pixel only along its border; the half-open pixel of the supercover owns a point that the
# strict inequalities of NN_r leave out. So NN_r can only miss pixels, and each case below says how many, and why.


def test_tie_a_marking_on_a_column_border() -> None:
    """x = p_x projects to u = u0 = 320 in every row. Both corners of each border on the line have orientation 0, and each end is
    at distance 0: NN_r lights no pixel of this marking, the supercover all of column 320."""
    state = np.array([[0.6, PAPER.runway.x_m[0], 0.9, 1.7]])
    ends = project(PAPER, state)
    assert (ends[0, 0, :, 0] == 320).all()
    exact, network = both_images(dataclasses.replace(PAPER, runway=Runway(PAPER.runway.markings[:1])), state)
    rows = int(np.floor(ends[0, 0, 0, 1])) - int(np.floor(ends[0, 0, 1, 1])) + 1
    assert exact.sum() == rows == 36
    assert network.sum() == 0


def test_tie_a_diagonal_through_pixel_corners() -> None:
    """X = y at theta = 0: u - u0 = v - v0, from (160, 160) to (288, 288). Each edge of a pixel on the diagonal has one corner on
    the line, so none is crossed: NN_r misses all 129 pixels."""
    scene = dyadic_scene(Marking("diagonal", 0.5, 0.0, 1.0))
    assert project(scene, LEVEL).reshape(-1).tolist() == [288, 288, 160, 160]
    exact, network = both_images(scene, LEVEL)
    assert exact.sum() == 129
    assert network.sum() == 0


def test_tie_a_diagonal_with_ends_inside_pixels() -> None:
    """The same with ends at u = v = 32 + 256/1.5: the end's own term still lights the far end's pixel, all others are missed."""
    scene = dyadic_scene(Marking("diagonal", 0.5, 0.0, 0.5))
    exact, network = both_images(scene, LEVEL)
    assert exact.sum() == 288 - 202 + 1
    assert network.sum() == 1
    assert (network & ~exact).sum() == 0


def test_tie_the_near_end_on_a_row_border() -> None:
    """v1 = 288 exactly, u1 = 134.4512 within a pixel. The end's point belongs to row 288, whose top border the marking only reaches:
    NN_r misses that one pixel. The far end, v2 = 160, ends a path that does cross the lower border of its pixel: lit."""
    scene = dyadic_scene(Marking("row", 0.2001, 0.0, 1.0))
    ends = project(scene, LEVEL)[0, 0]
    assert ends[:, 1].tolist() == [288, 160]
    exact, network = both_images(scene, LEVEL)
    assert (exact & ~network).sum() == 1
    assert (network & ~exact).sum() == 0


def test_tie_single_corners_of_a_falling_line() -> None:
    """X = -y/2: u - 200 = -(v - 32)/2, a corner in every second row. Going down the line moves left, so at each corner it touches,
    in one point, the pixel that owns the corner: one pixel missed for each."""
    scene = dyadic_scene(Marking("falling", -0.25, 0.0, 1.0))
    scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, principal_point=(200.0, 32.0)))
    ends = project(scene, LEVEL)[0, 0]
    assert ends.tolist() == [[72, 288], [136, 160]]
    exact, network = both_images(scene, LEVEL)
    corners = 136 - 72 + 1  # columns 72 to 136, each met at an integer row
    assert (exact & ~network).sum() == corners
    assert (network & ~exact).sum() == 0


def test_tie_single_corners_of_a_rising_line() -> None:
    """X = y/2: going down the line moves right, from a pixel to the one that owns the corner, whose inside it then enters. Only at
    the near end, on the corner (160, 288), it enters nothing more: one pixel missed."""
    scene = dyadic_scene(Marking("rising", 0.25, 0.0, 1.0))
    ends = project(scene, LEVEL)[0, 0]
    assert ends.tolist() == [[160, 288], [96, 160]]
    exact, network = both_images(scene, LEVEL)
    assert (exact & ~network).sum() == 1
    assert (network & ~exact).sum() == 0


def test_ties_decided_by_rounding_lie_at_corners() -> None:
    """X = 0.2 passes through a corner every fifth row, but 0.2 has no exact float64: rounding decides each of these, in either
    direction. Every pixel that differs has a corner within 1e-9 px of the line."""
    scene = dyadic_scene(Marking("fifths", 0.2, 0.1, 0.9))
    frame = runway_image(scene, LEVEL).astype(bool)
    differs = frame ^ RunwayNetwork(scene.camera).image(torch.from_numpy(project(scene, LEVEL))).numpy()
    _, row, column = np.nonzero(differs)
    assert 0 < len(row) <= 2 * 26
    corners = np.stack([np.abs(32 + 0.4 * (row + below - 32) - (column + right)) for below in (0, 1) for right in (0, 1)])
    assert corners.min(axis=0).max() < 1e-9


@pytest.mark.parametrize("shift_px", [2.0**-20, -(2.0**-20), 0.3])
def test_ties_vanish_when_the_camera_moves(shift_px: float) -> None:
    """The same five markings seen with another principal point: no tie, no disagreement."""
    across = (0.5, 0.2, -0.05, 0.25, 0.0)
    scene = dyadic_scene(*(Marking(str(x), x, 0.0, 1.0) for x in across))
    moved = dataclasses.replace(scene.camera, principal_point=(32.0 + shift_px, 32.0 + shift_px / 3))
    scene = dataclasses.replace(scene, camera=moved)
    exact, network = both_images(scene, LEVEL)
    np.testing.assert_array_equal(network, exact)
    assert project_points(moved, LEVEL[0], 0.5, 0.0)[0] != 288

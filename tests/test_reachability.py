"""Reachability: containment as a property, tightness beside it, and what the printed formulas do."""

from __future__ import annotations

import dataclasses
import itertools
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rich.progress import Progress
from scenes import examples

from build_model.paper.intervals import RoundedInterval
from build_model.paper.method import Method
from build_model.paper.mixed_monotonicity import mixed_monotone_bounds
from build_model.paper.network_bounds import (
    linear_layer_by_intervals,
    linear_layer_range,
    mixed_monotone_layers,
    network_upper_bounds,
    snap_outward,
)
from build_model.paper.network_layers import layers
from build_model.paper.paper_bound import PaperBound, paper_bound
from build_model.paper.projection_bounds import projection_jacobian, zeta_bounds
from build_model.paper.reachability import possible_pixels
from build_model.paper.runway_network import RunwayNetwork, pixel_weights
from build_model.partition import partition
from build_model.window import Window
from runtime.camera import project
from runtime.image import runway_image
from runtime.rounding import OUTWARD_PX
from runtime.scene import Axis, Bank, Camera, Domain, Marking, Runway, Scene, Tolerance

PAPER = Scene.load(Path(__file__).parent.parent / "models" / "paper.toml")
CELLS = partition(PAPER)
Floats = NDArray[np.float64]


def states_in(lower: Floats, upper: Floats, count: int, seed: int = 0) -> Floats:
    """Corners of the box, and states drawn from it: half of them uniformly, half with some coordinates on the box's faces."""
    rng = np.random.default_rng(seed)
    corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
    inner = rng.uniform(lower, upper, (count, 4))
    faces = np.where(rng.random((count, 4)) < 0.5, rng.choice(2, (count, 4)), (inner - lower) / np.where(upper > lower, upper - lower, 1))
    faces = np.where(faces == 1, upper, lower + faces * (upper - lower))
    return np.concatenate([corners, inner, faces])


def zeta_of(scene: Scene, states: Floats) -> Floats:
    """(..., markings, 4)."""
    ends = project(scene, states)
    return ends.reshape(*ends.shape[:-2], 4)


@st.composite
def boxes_of_states(draw: st.DrawFn) -> tuple[Floats, Floats]:
    """Boxes with the paper's runway ahead, wide and narrow, looking down and up, with fixed axes among them."""
    centre = [draw(st.floats(*bounds)) for bounds in ((-0.2, 0.9), (-0.3, 0.3), (0.5, 1.5), (1.0, 3.0))]
    half = [draw(st.sampled_from([0.0, 1e-6, 0.01, 0.05, 0.1])) for _ in range(4)]
    return np.array(centre) - half, np.array(centre) + half


# Proposition 2


def parabola_bounds(*, alpha_inside: bool) -> tuple[float, float]:
    """Proposition 2 on x^2 over [-1, 2], with J = [-2, 4]: as printed, and corrected."""
    low, high, jacobian_low, jacobian_high = -1.0, 2.0, -2.0, 4.0
    if not alpha_inside:
        jacobian = np.array([[jacobian_low]]), np.array([[jacobian_high]])
        bounds = mixed_monotone_bounds(np.square, jacobian[0], jacobian[1], np.array([low]), np.array([high]))
        return bounds[0].item(), bounds[1].item()
    alpha = min(0.0, jacobian_low)
    return (low - alpha * (low - high)) ** 2, (high + alpha * (low - high)) ** 2


def test_the_printed_proposition_2_fails_on_a_parabola() -> None:
    assert parabola_bounds(alpha_inside=True) == (49, 64)
    assert parabola_bounds(alpha_inside=False) == (-5, 10)  # contains the truth, [0, 4]


@given(st.data())
def test_proposition_2_contains_quadratic_maps(data: st.DataObject) -> None:
    """f_i(x) = x A_i x + B_i x over whole numbers: exact in float64, so the containment has no tolerance."""
    whole = st.integers(-5, 5)
    draw = lambda *shape: np.array(data.draw(st.lists(whole, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))).reshape(shape)  # noqa: E731
    squares, linear = draw(2, 3, 3).astype(float), draw(2, 3).astype(float)
    ends = np.sort(draw(2, 3).astype(float), axis=0)

    def f(x: Floats) -> Floats:
        return np.einsum("...j,ijk,...k->...i", x, squares, x) + x @ linear.T

    both = squares + squares.swapaxes(1, 2)
    products = both * ends[0], both * ends[1]
    jacobian = np.minimum(*products).sum(-1) + linear, np.maximum(*products).sum(-1) + linear
    low, high = mixed_monotone_bounds(f, *jacobian, *ends)
    inside = np.array(list(itertools.product(*(np.linspace(a, b, 5) for a, b in ends.T))))
    assert (low <= f(inside).min(axis=0)).all()
    assert (f(inside).max(axis=0) <= high).all()


def test_proposition_2_is_exact_for_monotone_maps_and_batches_of_boxes() -> None:
    rng = np.random.default_rng(4)
    lower = rng.uniform(-1, 0, (7, 3))
    upper = lower + rng.uniform(0, 1, (7, 3))
    signs = np.array([[1, -1, 1], [-1, -1, 1]])

    def f(x: Floats) -> Floats:
        return np.stack([np.exp(x[..., 0]) - x[..., 1] + x[..., 2] ** 3, -x[..., 0] - np.exp(x[..., 1]) + x[..., 2]], axis=-1)

    jacobian = np.broadcast_to(np.where(signs > 0, 0.0, -9.0), (7, 2, 3)), np.broadcast_to(np.where(signs > 0, 9.0, 0.0), (7, 2, 3))
    low, high = mixed_monotone_bounds(f, *jacobian, lower, upper)
    corners = np.array([f(np.array(list(itertools.product(*zip(a, b, strict=True))))) for a, b in zip(lower, upper, strict=True)])
    np.testing.assert_array_equal(low, corners.min(axis=1))
    np.testing.assert_array_equal(high, corners.max(axis=1))


# The change of coordinates h


@given(st.data(), st.floats(-1.5, 1.5), st.floats(0, 1))
def test_intervals_contain_points(data: st.DataObject, angle: float, spread: float) -> None:
    points = [data.draw(st.floats(-3, 3)), data.draw(st.floats(0.5, 3))]
    a, b = (RoundedInterval(np.array(point - spread / 4), np.array(point + spread / 4)) for point in points)
    turned = RoundedInterval(np.array(max(angle - spread, -np.pi / 2)), np.array(min(angle + spread, np.pi / 2)))
    x, y = points
    results = [(a + b, x + y), (a - b, x - y), (a * b, x * y), (a / b, x / y), (a.square(), x * x)]
    results += [(turned.sin(), np.sin(angle)), (turned.cos(), np.cos(angle))]
    for interval, value in results:
        assert interval.lower <= value <= interval.upper


@given(boxes_of_states(), st.integers(0, 2**32 - 1))
@examples(40)
def test_jacobian_bounds_contain_every_difference_quotient(box: tuple[Floats, Floats], seed: int) -> None:
    """By the mean value theorem a difference quotient of h along an axis is a value of the Jacobian between its points."""
    lower, upper = box
    low, high = projection_jacobian(PAPER, lower, upper)
    rng = np.random.default_rng(seed)
    for axis in np.flatnonzero(upper - lower > 0.005):
        start = rng.uniform(lower, upper, (50, 4))
        stop = start.copy()
        stop[:, axis] = np.where(start[:, axis] > (lower + upper)[axis] / 2, lower[axis], upper[axis])
        step = (stop - start)[:, axis]
        quotient = (zeta_of(PAPER, stop) - zeta_of(PAPER, start)) / step[:, None, None]
        rounding = 1e-8  # of two projections, 1e-12 px each, over a step of at least 0.0025
        assert (low[..., axis] - rounding <= quotient).all()
        assert (quotient <= high[..., axis] + rounding).all()


def test_jacobian_bounds_are_tight_on_a_small_box() -> None:
    centre, half = np.array([0.6, 0.02, 0.9, 1.7]), 1e-6
    low, high = projection_jacobian(PAPER, centre - half, centre + half)
    steps = np.eye(4) * 1e-5
    central = (zeta_of(PAPER, centre + steps) - zeta_of(PAPER, centre - steps)) / 2e-5
    np.testing.assert_allclose(np.moveaxis(central, 0, -1), (low + high) / 2, rtol=1e-6, atol=1e-5)
    assert (high - low).max() < 0.02


@pytest.mark.parametrize("method", Method)
@given(box=boxes_of_states(), seed=st.integers(0, 2**32 - 1))
@examples(40)
def test_zeta_bounds_contain_samples(method: Method, box: tuple[Floats, Floats], seed: int) -> None:
    low, high = zeta_bounds(PAPER, *box, method)
    zeta = zeta_of(PAPER, states_in(*box, 200, seed))
    assert (low <= zeta).all()
    assert (zeta <= high).all()


@given(box=boxes_of_states())
@examples(40)
def test_the_closed_form_is_tightest_and_attained(box: tuple[Floats, Floats]) -> None:
    """It lies within the other two, and states that attain it exist: corners, and the pitch at which an end crosses row v0."""
    low, high = zeta_bounds(PAPER, *box, Method.CLOSED_FORM)
    for method in (Method.MIXED_MONOTONICITY, Method.INTERVALS):
        other_low, other_high = zeta_bounds(PAPER, *box, method)
        assert (other_low <= low + OUTWARD_PX).all()
        assert (high <= other_high + OUTWARD_PX).all()
    corners = np.array(list(itertools.product(*zip(*box, strict=True))))
    crossings = np.repeat(corners, 2, axis=0)
    crossings[:, 0] = np.arctan2(crossings[:, 2], crossings[:, 3] + np.tile(PAPER.runway.ends_z_m[0], len(corners)))
    crossings = crossings[(crossings[:, 0] >= box[0][0]) & (crossings[:, 0] <= box[1][0])]
    zeta = zeta_of(PAPER, np.concatenate([corners, crossings]))
    np.testing.assert_allclose(zeta.min(axis=0), low, rtol=0, atol=2 * OUTWARD_PX)
    np.testing.assert_allclose(zeta.max(axis=0), high, rtol=0, atol=2 * OUTWARD_PX)


def test_corners_alone_miss_columns() -> None:
    """u of an end is not monotone in theta where the end crosses row v0: in 9 of the paper's cells, by up to 0.030 px."""
    low, high = zeta_bounds(PAPER, CELLS.lower, CELLS.upper, Method.CLOSED_FORM)
    missed = np.zeros(len(CELLS))
    for cell, box in enumerate(zip(CELLS.lower, CELLS.upper, strict=True)):
        zeta = zeta_of(PAPER, np.array(list(itertools.product(*zip(*box, strict=True)))))
        missed[cell] = max((zeta.min(axis=0) - low[cell]).max(), (high[cell] - zeta.max(axis=0)).max())
    assert (missed > 10 * OUTWARD_PX).sum() == 9
    assert 0.029 < missed.max() < 0.031


def test_a_box_with_the_runway_beside_the_camera_is_refused() -> None:
    lower, upper = np.array([0.0, 0.0, 0.9, -0.5]), np.array([0.1, 0.0, 1.0, 0.5])
    for method in Method:
        with pytest.raises(ValueError, match="depth Z"):
            zeta_bounds(PAPER, lower, upper, method)


# The network NN_r

ZETA = np.array([295.0, 262.0, 303.0, 221.0])
AROUND = Window(215, 268, 288, 312)


@pytest.mark.parametrize("half_px", [0.0, 0.3, 3.0, 30.0])
@pytest.mark.parametrize(("left", "top"), [(296, 232), (0, 0), (6, 0)])
def test_every_layer_contains_samples(half_px: float, left: int, top: int) -> None:
    """At the middle of a marking, there and where the frame begins, and near a far end with u2 = 0 within the box."""
    rng = np.random.default_rng(5)
    window = Window(top, top + 8, left, left + 8)
    zeta = ZETA + np.tile([left - 296, top - 232], 2) - (0 if left != 6 else [13, -11, 13, -21])
    low, high = snap_outward(zeta - half_px, zeta + half_px, window)
    weights = pixel_weights(window).reshape(-1, 16, 6)
    network = layers(weights)
    bounds = mixed_monotone_layers(network, *(np.broadcast_to(bound, (len(weights), 4)) for bound in (low, high)))
    values = np.broadcast_to(states_in(low, high, 100, int(rng.integers(99))), (len(weights), 216, 4))
    for layer, (layer_low, layer_high) in zip(network, bounds, strict=True):
        values = layer.apply(values)
        rounding = 1e-9  # of the samples: the bounds themselves are exact
        assert (layer_low[:, None] <= values + rounding).all()
        assert (values <= layer_high[:, None] + rounding).all()


@pytest.mark.parametrize("method", Method)
def test_bounds_over_one_point_are_the_network(method: Method) -> None:
    zeta = np.array([295.25, 262.5, 303.125, 221.75])
    value = RunwayNetwork(PAPER.camera, AROUND)(torch.from_numpy(zeta)[None])[0].numpy()
    assert 40 < (value > 0).sum() < 60
    np.testing.assert_array_equal(network_upper_bounds(AROUND, zeta, zeta, method), value)


@pytest.mark.parametrize("method", Method)
@pytest.mark.parametrize("half", [[0.5, 2.0, 0.5, 2.0], [4.0, 1.0, 2.0, 25.0]])
def test_upper_bounds_contain_the_network(method: Method, half: list[float]) -> None:
    """Markings leaning to the left and to the right, steep and flat, and with their ends swapped."""
    rng = np.random.default_rng(10)
    window = Window(0, 24, 0, 24)
    network = RunwayNetwork(PAPER.camera, window)
    for ends in ([6, 21, 13, 3], [13, 21, 6, 3], [3, 12, 21, 8], [3, 8, 21, 12]):
        for zeta in (np.array(ends), np.array([*ends[2:], *ends[:2]])):
            low, high = zeta + 0.37 - half, zeta + 0.37 + half
            bound = network_upper_bounds(window, low, high, method)
            value = network(torch.from_numpy(rng.uniform(low, high, (50, 4)))).numpy()
            assert (value <= bound * (1 + 1e-12)).all()
            assert (value > 0).any()


def test_orientation_is_exact_at_its_16_corners() -> None:
    """phi_Lin is affine in each coordinate of zeta. Proposition 2 from zeta is exact where no sign changes, and wider elsewhere;
    interval arithmetic, which forgets that det and the ends move together, is wider still."""
    half = np.array([1.2, 6.0, 1.0, 6.0])
    low, high = snap_outward(ZETA - half, ZETA + half, AROUND)
    weights = pixel_weights(AROUND).reshape(-1, 16, 6)
    exact = linear_layer_range(weights, low, high)
    mixed = mixed_monotone_layers(layers(weights), *(np.broadcast_to(bound, (len(weights), 4)) for bound in (low, high)))[1]
    plain = linear_layer_by_intervals(weights, low, high)
    inside = np.random.default_rng(6).uniform(low, high, (200, 4))
    samples = np.concatenate([inside, (inside[:, 0] * inside[:, 3] - inside[:, 1] * inside[:, 2])[:, None], np.ones((200, 1))], axis=1)
    values = samples @ weights.swapaxes(-1, -2)
    assert (exact[0] <= values.min(axis=1) + 1e-9).all()
    assert (values.max(axis=1) <= exact[1] + 1e-9).all()
    for inner, outer in ((exact, mixed), (mixed, plain)):
        assert (outer[0] <= inner[0]).all()
        assert (inner[1] <= outer[1]).all()
    orientations = [0, 1, 4, 5, 8, 9, 12, 13]
    width = [(bound[1] - bound[0])[:, orientations].mean() for bound in (exact, mixed, plain)]
    assert width[1] < 1.5 * width[0]
    assert width[2] > 5 * width[0]
    same = np.equal(mixed[1], exact[1])
    assert same[:, orientations].mean() > 0.3


def test_the_printed_jacobian_bounds_light_every_pixel() -> None:
    """[-2, 2] for phi_Abs adds twice the inputs' widths to each of its upper bounds, so that none is 0 over any box but a point."""
    low, high = ZETA - 0.01, ZETA + 0.01
    printed = network_upper_bounds(AROUND, low, high, Method.MIXED_MONOTONICITY, printed_jacobians=True)
    local = network_upper_bounds(AROUND, low, high, Method.MIXED_MONOTONICITY)
    assert (printed > 0).all()
    assert (local > 0).sum() < 60


# Masks of pixels


def may_light_all(scene: Scene, lower: Floats, upper: Floats, method: Method, count: int = 300, **options: bool) -> tuple[int, int]:
    """Asserts that the mask holds every sampled image; returns the pixels of the samples' union and of the mask, over the part of the
    frame within 20 px of that union."""
    union = np.any(runway_image(scene, states_in(lower, upper, count)), axis=0)
    rows, columns = np.nonzero(union)
    (height, width), margin = scene.camera.shape, 20
    window = Window(
        max(int(rows.min()) - margin, 0),
        min(int(rows.max()) + margin, height),
        max(int(columns.min()) - margin, 0),
        min(int(columns.max()) + margin, width),
    )
    mask, lit = possible_pixels(scene, lower, upper, method, window, **options), union[window.slices]
    assert not (lit & ~mask).any()
    return int(lit.sum()), int(mask.sum())


@pytest.mark.parametrize("method", Method)
@pytest.mark.parametrize("cell", [0, 13, 26])
def test_masks_contain_the_images_of_a_cell(method: Method, cell: int) -> None:
    lit, mask = may_light_all(PAPER, CELLS.lower[cell], CELLS.upper[cell], method)
    assert mask < 2.5 * lit


@pytest.mark.parametrize("method", Method)
def test_masks_of_a_small_box_are_tight(method: Method) -> None:
    """Over a box of a tenth of a millimetre the masks come close to the union itself, and NN_r alone needs no help for it. RoundedInterval
    arithmetic stays several pixels wide: det is a difference of two numbers near 70,000 px^2."""
    centre = np.array([0.61, 0.0, 0.93, 1.71])
    half = np.array([1e-4, 0, 1e-4, 1e-4])
    for between_ends, of_intervals in ((True, 4), (False, 12)):
        lit, mask = may_light_all(PAPER, centre - half, centre + half, method, between_ends=between_ends)
        assert mask <= (of_intervals if method is Method.INTERVALS else 1.25) * lit


def test_without_the_ends_the_network_lights_whole_rows() -> None:
    """Over a whole cell of the paper the bounds of v1 and v2 overlap, and Proposition 2 then clears no pixel of such a row."""
    window = Window(230, 234, 0, 640)
    box = CELLS.lower[0], CELLS.upper[0]
    assert possible_pixels(PAPER, *box, Method.MIXED_MONOTONICITY, window, between_ends=False).all()
    assert possible_pixels(PAPER, *box, Method.MIXED_MONOTONICITY, window).mean() < 0.05


@pytest.mark.parametrize("method", Method)
def test_masks_contain_ties(method: Method) -> None:
    """Markings on column borders, through pixel corners and with ends on integer rows, where NN_r itself lights nothing."""
    camera = Camera(width=80, height=80, focal_length_m=1.0, pixel_pitch_m=2.0**-7, principal_point=(8.0, 8.0))
    domain = Domain(Axis((0.0,), 0.1), Axis((0.0,), 0.0), Axis((0.5,), 0.1), Axis((1.0,), 0.1))
    markings = tuple(Marking(str(x), x, 0.0, 1.0) for x in (0.0, 0.125, 0.25, 0.5))
    scene = Scene(camera, Runway(markings), domain, Bank(1, 1, 0.5))
    tie = np.array([0.0, 0.0, 0.5, 1.0])
    assert may_light_all(scene, tie, tie, method)[0] > 100
    for half in ([0, 0.01, 0, 0], [0, 0, 2.0**-7, 0], [1e-3, 0, 0, 2.0**-6]):
        may_light_all(scene, tie - half, tie + half, method, count=50)
        may_light_all(scene, tie, tie + np.array(half), method, count=50)
        may_light_all(scene, tie - half, tie, method, count=50)


@pytest.mark.parametrize("method", Method)
def test_masks_are_clipped_to_frame_and_window(method: Method) -> None:
    camera = dataclasses.replace(PAPER.camera, width=60, height=40)
    scene = dataclasses.replace(PAPER, camera=camera)
    box = CELLS.lower[13], CELLS.upper[13]
    union = runway_image(scene, states_in(*box, 300)).any(axis=0)
    assert union.any()
    mask = possible_pixels(scene, *box, method)
    assert mask.shape == (40, 60)
    assert not (union & ~mask).any()
    assert not mask.all()
    window = Window(5, 30, 10, 50)
    np.testing.assert_array_equal(possible_pixels(scene, *box, method, window), mask[window.slices])
    assert possible_pixels(scene, *box, method, Window(3, 3, 0, 60)).shape == (0, 60)


# The script that compares the filters

SCRIPT = runpy.run_path(str(Path(__file__).parent.parent / "scripts" / "compare_spatial_filters.py"))


def test_the_sampled_union_is_that_of_the_images() -> None:
    camera = dataclasses.replace(PAPER.camera, width=80, height=60)  # cuts the runway off at all sides
    scene = dataclasses.replace(PAPER, camera=camera)
    box = CELLS.lower[4] - [0, 0.03, 0, 0], CELLS.upper[4] + [0, 0.03, 0, 0]
    batches = []
    union = SCRIPT["sampled_union"](scene, *box, 700, np.random.default_rng(9), lambda: batches.append(1))
    rng = np.random.default_rng(9)
    states = np.concatenate([rng.uniform(*box, (count, 4)) for count in (500, 200)])
    np.testing.assert_array_equal(union, runway_image(scene, states).any(axis=0))
    assert len(batches) == 2
    assert 0.1 < union.mean() < 0.9


def test_the_comparison_orders_the_filters() -> None:
    """No filter lacks a sampled pixel; the build's S is closest, and intervals are widest."""
    domain = Domain(Axis((0.6,), 0.1), Axis((0.0,), 0.0), Axis((0.9,), 0.1), Axis((1.7,), 0.1))
    scene = dataclasses.replace(PAPER, domain=domain, tolerance=Tolerance(line_px=2))
    counts = SCRIPT["compare"](scene, 2000, 0, whole_frame=False, progress=Progress(disable=True))
    sampled, build, mixed, intervals, closed = counts[0]
    assert sampled <= build < closed <= mixed < intervals
    assert build < 1.2 * sampled
    rows = SCRIPT["table_of"](counts).row_count
    assert rows == 2


# The paper's bound


@pytest.mark.parametrize("cell", [0, 13, 26])
def test_the_lipschitz_constant_holds_and_is_not_far_off(cell: int) -> None:
    lower, upper = CELLS.lower[cell], CELLS.upper[cell]
    bound = paper_bound(PAPER, lower, upper)
    assert bound is not None
    first, second = (states_in(lower, upper, 2000, seed) for seed in (7, 8))
    close = first + 1e-3 * (second - first)
    ratios = []
    for start, stop in ((first, second), (first, close)):
        apart = np.linalg.norm(start - stop, axis=-1)
        seen = np.linalg.norm(zeta_of(PAPER, start) - zeta_of(PAPER, stop), axis=-1).min(axis=-1)
        ratios.append((apart / np.where(seen > 0, seen, 1)).max())
    assert max(ratios) <= bound.inverse_lipschitz_per_px < 2.5 * max(ratios)


def test_delta_is_the_half_extent_in_px() -> None:
    bound = paper_bound(PAPER, CELLS.lower[0], CELLS.upper[0])
    assert bound is not None
    zeta = zeta_of(PAPER, states_in(CELLS.lower[0], CELLS.upper[0], 10))
    assert bound.zeta_half_extent_px == pytest.approx(np.ptp(zeta, axis=0).max() / 2, abs=1e-5)
    assert bound.state_error == 4 * bound.inverse_lipschitz_per_px * bound.zeta_half_extent_px


def test_the_papers_bound_says_less_than_the_cell_itself() -> None:
    """Two states of one cell are never farther apart than its diagonal, 0.17; the paper's bound on that is larger by far."""
    for lower, upper in zip(CELLS.lower, CELLS.upper, strict=True):
        bound = paper_bound(PAPER, lower, upper)
        assert bound is not None
        assert bound.state_error > 50 * np.linalg.norm(upper - lower)


def test_the_papers_bound_with_a_free_lateral_axis() -> None:
    half = np.array([0.01, 0.01, 0.01, 0.01])
    centre = np.array([0.6, 0.0, 0.9, 1.7])
    bound = paper_bound(PAPER, centre - half, centre + half)
    fixed = paper_bound(PAPER, centre - half * [1, 0, 1, 1], centre + half * [1, 0, 1, 1])
    assert bound is not None
    assert fixed is not None
    assert bound.inverse_lipschitz_per_px > fixed.inverse_lipschitz_per_px


def test_no_bound_where_zeta_does_not_fix_the_state() -> None:
    """A marking straight ahead, x = p_x, keeps u = u0: its two rows cannot fix theta, y and z."""
    ahead = dataclasses.replace(PAPER, runway=Runway((Marking("ahead", 0.0, 0.0, 0.3),)))
    assert paper_bound(ahead, CELLS.lower[0], CELLS.upper[0]) is None
    with pytest.raises(ValueError, match="single state"):
        paper_bound(PAPER, CELLS.lower[0], CELLS.lower[0])


@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan])
def test_a_bound_is_positive_and_finite(value: float) -> None:
    with pytest.raises(ValueError, match="positive and finite"):
        PaperBound(value, 1.0)
    with pytest.raises(ValueError, match="positive and finite"):
        PaperBound(1.0, value)

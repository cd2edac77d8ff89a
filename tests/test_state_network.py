"""NN_e: its shape, its export, and a training that is repeatable, honest about its errors, and works for other scenes."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray
from rich.console import Console
from rounding_bound import exact_state_and_bound
from torch.nn import functional

from build_model.assembly import assemble
from build_model.export import build_banks, filter_function
from build_model.filter_graph import filter_graph
from build_model.spatial_filter import spatial_filters
from build_model.state_network import (
    BLOCK_ROWS,
    FilteredFrames,
    FrameSource,
    RowConvolution,
    StateNetwork,
    TrainingReport,
    domain_window,
    in_whole_blocks,
    learning_rate_share,
    miss_pixels,
    state_graph,
    train_state_network,
    validation_error,
)
from build_model.window import Window
from runtime.image import runway_image
from runtime.model.format import OPSET
from runtime.scene import Axis, Bank, Camera, Distortion, Domain, EstimatorTraining, Marking, Runway, Scene
from runtime.sensor import Sensor

Filter = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
RandomStates = Callable[[Scene, int, int], NDArray[np.float64]]

SMALL = Scene(
    Camera(width=160, height=120, focal_length_m=0.008, pixel_pitch_m=60e-6),
    Runway((Marking("L", -0.25, 0.0, 0.6), Marking("R", 0.25, 0.0, 0.6))),
    Domain(Axis((0.55, 0.65), 0.1), Axis((0.1,), 0.0), Axis((0.9,), 0.1), Axis((1.7,), 0.1)),
    Bank(2, 1, 0.5),
    estimator=EstimatorTraining(training_frames=600, epochs=4, batch=32, largest_clutter=0.04),
)
FREE_X = replace(
    SMALL,
    camera=Camera(width=200, height=150, focal_length_m=0.008, pixel_pitch_m=50e-6, principal_point=(90.0, 70.0)),
    runway=Runway((*SMALL.runway.markings, Marking("centre", 0.05, 0.1, 0.4))),
    domain=replace(SMALL.domain, theta_rad=Axis((0.6,), 0.1), x_m=Axis((0.0,), 0.1)),
)


def filter_of(scene: Scene) -> Filter:
    return filter_function(filter_graph(scene, assemble(scene, build_banks(scene))))


@pytest.fixture(scope="module")
def small_filter() -> Filter:
    return filter_of(SMALL)


@pytest.fixture(scope="module")
def trained(small_filter: Filter) -> tuple[StateNetwork, TrainingReport]:
    return train_state_network(SMALL, small_filter, seed=3)


def weights(network: StateNetwork) -> bytes:
    return b"".join(tensor.numpy().tobytes() for tensor in network.state_dict().values())


# --- the frames that it is trained on ---


def test_frames_without_clutter_are_the_exact_images(small_filter: Filter) -> None:
    window = domain_window(SMALL)
    frames = FrameSource(SMALL, window, small_filter).draw(150, np.random.default_rng(0), clutter=0.0)
    images = runway_image(SMALL, frames.states)
    np.testing.assert_array_equal(frames.images(slice(None)).numpy(), images[:, *window.slices])
    assert images.sum() == frames.images(slice(None)).sum()
    assert ((frames.states >= SMALL.domain.lower) & (frames.states <= SMALL.domain.upper)).all()


def test_behind_a_lens_frames_are_those_that_are_painted() -> None:
    """Of the sensor's image of each state; clutter and missed pixels are the sensor's too."""
    camera = replace(SMALL.camera, distortion=Distortion("radial-tangential", (-0.3, 0.1, 0.0, 0.0)))
    sensor = Sensor.of(replace(SMALL, camera=camera))
    window, ideal = domain_window(sensor.ideal), sensor.ideal
    source = FrameSource(ideal, window, lambda frames: frames, sensor)
    frames = source.draw(20, np.random.default_rng(0), clutter=0.0)
    painted = np.stack([sensor.painted(image) for image in runway_image(sensor.scene, frames.states)])
    np.testing.assert_array_equal(frames.images(slice(None)).numpy(), painted[:, *window.slices])
    exact = runway_image(ideal, frames.states).sum()
    assert painted.sum() > 1.5 * exact  # thicker than the ideal images
    some, all_of = (source.draw(60, np.random.default_rng(1), clutter).images(slice(None)).mean() for clutter in (None, 0.0))
    assert 0.8 * all_of < some < 4 * all_of


def test_clutter_has_the_density_asked_for_and_the_filter_sees_whole_frames() -> None:
    window, shapes = domain_window(SMALL), []

    def let_all_pass(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
        shapes.append(frames.shape)
        return frames

    source = FrameSource(SMALL, window, let_all_pass)
    frames = source.draw(100, np.random.default_rng(0), clutter=0.05)
    runway = runway_image(SMALL, frames.states)[:, *window.slices].astype(bool)
    pixels = frames.images(slice(None)).numpy() > 0
    count = (~runway).sum()
    assert pixels[runway].all()
    assert abs(pixels[~runway].sum() - 0.05 * count) < 5 * np.sqrt(0.05 * 0.95 * count)
    assert sum(shape[0] for shape in shapes) == 100
    assert all(shape[1:] == SMALL.camera.shape for shape in shapes)


def test_training_frames_miss_pixels_and_have_clutter_up_to_the_largest() -> None:
    window = domain_window(SMALL)
    frames = FrameSource(SMALL, window, lambda frames: frames).draw(2000, np.random.default_rng(0))
    runway = runway_image(SMALL, frames.states)[:, *window.slices].astype(bool)
    pixels = frames.images(slice(None)).numpy() > 0
    missed, density = (runway & ~pixels).sum(axis=(1, 2)), (pixels & ~runway).sum(axis=(1, 2)) / (~runway).sum(axis=(1, 2))
    assert 0.4 < (missed == 0).mean() < 0.6
    assert set(missed) == set(range(9))
    assert 0.08 < (density == 0).mean() < 0.25
    assert 0.03 < density.max() < 0.05


def test_missing_pixels_darkens_as_many_lit_ones_as_asked() -> None:
    rng = np.random.default_rng(1)
    before = (rng.random((40, 6, 5)) < 0.3).astype(np.uint8)
    before[7] = 0
    missed = rng.integers(0, 9, 40)
    after, again = before.copy(), before.copy()
    miss_pixels(after, missed, rng)
    miss_pixels(again, missed, rng)
    assert (after <= before).all()
    np.testing.assert_array_equal((before - after).sum(axis=(1, 2)), np.minimum(missed, before.sum(axis=(1, 2))))
    assert (after != again).any()


@pytest.mark.parametrize(
    ("top", "bottom", "expected"), [(5, 18, (5, 21)), (8, 23, (7, 23)), (0, 23, (0, 23)), (5, 13, (5, 13)), (4, 22, (3, 23))]
)
def test_a_window_grows_to_whole_blocks_inside_the_frame(top: int, bottom: int, expected: tuple[int, int]) -> None:
    assert in_whole_blocks(Window(top, bottom, 2, 9), height=23) == Window(*expected, 2, 9)


def test_the_window_holds_every_spatial_filter_and_no_more() -> None:
    for scene in (SMALL, FREE_X):
        window, union = domain_window(scene), spatial_filters(scene).max(axis=0)
        rows, columns = np.flatnonzero(union.max(axis=1)), np.flatnonzero(union.max(axis=0))
        assert (window.top, window.bottom, window.left, window.right) == (rows[0], rows[-1] + 1, columns[0], columns[-1] + 1)


# --- training ---


def test_the_same_seed_gives_the_same_weights(trained: tuple[StateNetwork, TrainingReport], small_filter: Filter) -> None:
    network, report = train_state_network(SMALL, small_filter, seed=3)
    assert weights(network) == weights(trained[0])
    assert report == trained[1]
    brief = replace(SMALL, estimator=replace(SMALL.estimator, training_frames=32, epochs=1))
    assert weights(train_state_network(brief, small_filter, 4)[0]) != weights(train_state_network(brief, small_filter, 5)[0])


def test_training_leaves_torch_as_it_was(small_filter: Filter) -> None:
    torch.manual_seed(11)
    before, threads = torch.random.get_rng_state(), torch.get_num_threads()
    train_state_network(replace(SMALL, estimator=EstimatorTraining(training_frames=1, epochs=1, batch=8)), small_filter, seed=0)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.get_num_threads() == threads
    assert not torch.are_deterministic_algorithms_enabled()


def test_training_reduces_the_loss_far_below_the_best_constant(trained: tuple[StateNetwork, TrainingReport]) -> None:
    report = trained[1]
    free = SMALL.domain.upper > SMALL.domain.lower
    constant = np.linalg.norm(np.random.default_rng(0).uniform(-1, 1, (100_000, free.sum())), axis=1).mean()
    assert len(report.training_loss) == len(report.validation_loss) == SMALL.estimator.epochs
    assert report.validation_loss[-1] < report.validation_loss[0]
    assert report.validation_loss[-1] < 0.7 * constant
    assert report.training_loss[-1] < 0.7 * report.training_loss[0]


def test_the_reported_errors_are_those_of_whole_frames(
    trained: tuple[StateNetwork, TrainingReport], small_filter: Filter, random_states: RandomStates
) -> None:
    network, report = trained
    states = random_states(SMALL, 600, 5)
    filtered = small_filter(runway_image(SMALL, states))
    with torch.no_grad():
        found = network(torch.from_numpy(filtered)[:, None]).numpy()
    error = np.abs(found - states)
    window = network.window
    frames = FilteredFrames(states, np.packbits(filtered[:, *window.slices].reshape(len(states), -1), axis=1), window)
    measured = validation_error(network, frames, 0.0)
    assert measured.median == pytest.approx(np.median(np.linalg.norm(error, axis=1)), rel=1e-4)
    assert measured.percentile_95 == pytest.approx(np.quantile(np.linalg.norm(error, axis=1), 0.95), rel=1e-4)
    assert measured.axis_median == pytest.approx(np.median(error, axis=0), rel=1e-3, abs=1e-7)
    assert report.validation[0].median == pytest.approx(measured.median, rel=0.2)
    assert [row.clutter for row in report.validation] == [0.0, 0.02, 0.05]


def test_progress_counts_every_step_and_tells_the_loss(small_filter: Filter) -> None:
    calls: dict[str, list[tuple[int, int, float | None]]] = {}
    scene = replace(SMALL, estimator=EstimatorTraining(training_frames=70, epochs=2, batch=32))
    train_state_network(scene, small_filter, 0, lambda stage, done, total, loss: calls.setdefault(stage, []).append((done, total, loss)))
    (frames, training) = calls.values()
    assert frames == [(64, 70, None), (70, 70, None)]
    assert [(done, total) for done, total, _ in training] == [(step, 6) for step in range(1, 7)]
    assert all(loss is not None and loss > 0 for _, _, loss in training)


def test_the_report_prints_and_survives_json(trained: tuple[StateNetwork, TrainingReport]) -> None:
    report = trained[1]
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(report.table())
    table = console.export_text()
    for row in report.validation:
        assert f"{row.clutter:.0%}" in table
        assert f"{row.median:.4f}, 95 %: {row.percentile_95:.4f}" in table
    tables = json.loads(json.dumps(asdict(report)))
    assert tables["validation"][1]["median"] == report.validation[1].median
    assert tables["parameters"] == sum(weight.numel() for weight in trained[0].parameters())


@pytest.mark.parametrize("steps", [1, 2, 7, 1000])
def test_the_learning_rate_rises_then_falls_to_nothing(steps: int) -> None:
    shares = np.array([learning_rate_share(step, steps) for step in range(steps)])
    assert ((shares > 0) & (shares <= 1)).all()
    peak = shares.argmax()
    assert (np.diff(shares[: peak + 1]) > 0).all()
    assert (np.diff(shares[peak:]) < 0).all()
    if steps == 1000:
        assert shares[peak] > 0.999
        assert shares[-1] < 1e-4


# --- the network ---


def test_the_output_is_one_state_and_a_fixed_axis_is_exact(trained: tuple[StateNetwork, TrainingReport]) -> None:
    network = trained[0]
    frames = torch.zeros((3, 1, *SMALL.camera.shape), dtype=torch.uint8)
    frames[1] = 1
    frames[2, :, ::3, ::2] = 1
    with torch.no_grad():
        states = network(frames)
        single = network(frames[2:])
        assert torch.equal(states, network(frames.to(torch.float32)))
    assert states.dtype == torch.float32
    assert states.shape == (3, 4)
    assert single.shape == (1, 4)
    assert (states[:, 1].numpy() == np.float32(0.1)).all()
    assert len(set(states[:, 0].tolist())) == 3


def test_the_row_convolution_is_a_convolution() -> None:
    layer = RowConvolution(columns=7, channels=5).double()
    image = torch.rand(2, 6 * BLOCK_ROWS, 7, dtype=torch.float64)
    upper, lower = (half.reshape(5, BLOCK_ROWS, 7) for half in layer.halves.weight.split(5))
    kernel = torch.cat([upper, lower], dim=1).transpose(1, 2)
    bias = layer.halves.bias[:5] + layer.halves.bias[5:]
    expected = functional.conv1d(image.transpose(1, 2), kernel, bias, stride=BLOCK_ROWS)
    torch.testing.assert_close(layer(image), expected)


def test_only_the_window_is_looked_at(trained: tuple[StateNetwork, TrainingReport]) -> None:
    network = trained[0]
    dark = torch.zeros((1, 1, *SMALL.camera.shape), dtype=torch.uint8)
    outside = torch.ones_like(dark)
    rows, columns = network.window.slices
    outside[:, :, rows, columns] = 0
    with torch.no_grad():
        assert torch.equal(network(dark), network(outside))
        for row, column in ((rows.start, columns.start), (rows.stop - 1, columns.stop - 1)):
            corner = dark.clone()
            corner[:, :, row, column] = 1
            assert not torch.equal(network(dark), network(corner))


def test_a_free_x_and_a_third_marking_are_learnt() -> None:
    scene = replace(FREE_X, estimator=replace(FREE_X.estimator, training_frames=1200, epochs=6))
    union = spatial_filters(scene).any(axis=0)
    network, report = train_state_network(scene, lambda frames: frames * union, seed=0)
    half_widths = (scene.domain.upper - scene.domain.lower) / 2
    clean = report.validation[0]
    assert clean.axis_median[1] < 0.25 * half_widths[1]
    assert clean.axis_median[0] < 0.4 * half_widths[0]
    assert network(torch.zeros((1, 1, *scene.camera.shape), dtype=torch.uint8)).shape == (1, 4)


def test_low_and_high_windows_get_as_many_convolutions_as_they_need(paper_scene: Scene) -> None:
    low = replace(SMALL, camera=replace(SMALL.camera, width=16, height=12, pixel_pitch_m=600e-6))
    for scene, convolutions in ((low, 0), (paper_scene, 3)):
        network = StateNetwork(scene)
        assert len(network.convolutions) == convolutions
        assert network(torch.ones((2, 1, *scene.camera.shape), dtype=torch.uint8)).shape == (2, 4)
    assert sum(weight.numel() for weight in network.parameters()) < 150_000


# --- the export ---


@pytest.mark.parametrize("opset", [18, OPSET])
def test_the_export_agrees_with_torch_up_to_float32(
    opset: int, trained: tuple[StateNetwork, TrainingReport], small_filter: Filter, random_states: RandomStates
) -> None:
    network = trained[0]
    content = state_graph(network, opset).SerializeToString()
    clutter = (np.random.default_rng(0).random((8, *SMALL.camera.shape)) < 0.05).astype(np.uint8)
    frames = np.concatenate([small_filter(runway_image(SMALL, random_states(SMALL, 8, 1)) | clutter), np.ones_like(clutter[:1])])
    levels = onnxruntime.GraphOptimizationLevel
    for level in (levels.ORT_DISABLE_ALL, levels.ORT_ENABLE_ALL):
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = level
        options.intra_op_num_threads = 1
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        for frame in frames:
            image = frame[None, None]
            state = np.asarray(session.run(None, {session.get_inputs()[0].name: image})[0])
            with torch.no_grad():
                of_torch = network(torch.from_numpy(image)).numpy()
            exact, bound = exact_state_and_bound(network, torch.from_numpy(image))
            assert state.dtype == of_torch.dtype == np.float32
            for found in (state, of_torch):
                difference = np.abs(found[0].astype(np.float64) - exact)
                assert (difference <= bound).all()
                assert (difference <= 1e-5).all()
            assert state[0, 1] == np.float32(0.1)


def test_the_exported_graph_is_static_and_crops_first(trained: tuple[StateNetwork, TrainingReport]) -> None:
    model = state_graph(trained[0], OPSET)
    onnx.checker.check_model(model, full_check=True)
    assert model.graph.node[0].op_type == "Slice"
    operators = [node.op_type for node in model.graph.node]
    shaping, sums = {"Slice", "Cast", "Squeeze", "Unsqueeze", "Split", "Reshape", "Transpose"}, {"MatMul", "Add", "Mul", "Conv", "Gemm"}
    assert set(operators) <= shaping | sums | {"Relu"}
    assert all(node.domain == "" for node in model.graph.node)
    inferred = onnx.shape_inference.infer_shapes(model).graph
    for value in (*inferred.input, *inferred.output, *inferred.value_info):
        assert all(dim.HasField("dim_value") and dim.dim_value > 0 for dim in value.type.tensor_type.shape.dim)
    (taken,), (given,) = inferred.input, inferred.output
    assert [dim.dim_value for dim in taken.type.tensor_type.shape.dim] == [1, 1, *SMALL.camera.shape]
    assert [dim.dim_value for dim in given.type.tensor_type.shape.dim] == [1, 4]

"""The runtime's behaviour: what it takes, what it answers, the fallback, the domain's faces."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper
from scenes import ONE_CELL, PAPER, SCENES, Floats, Frame, examples, random_clutter, states_of

from build_model.export import export_model
from runtime import Box, Estimator, FrameError, ModelError, Outcome
from runtime.image import runway_image
from runtime.scene import Scene

EstimatorOf = Callable[..., Estimator]
ModelOf = Callable[[str], Path]
RandomStates = Callable[[Scene, int, int], Floats]
MIDDLE = (PAPER.domain.lower + PAPER.domain.upper) / 2


@pytest.fixture(scope="module")
def paper(estimator_of: EstimatorOf) -> Estimator:
    return estimator_of("paper")


def constant_network(path: Path, scene: Scene, values: list[float]) -> Path:
    """A user's NN_e that answers the same state to every frame."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, *scene.camera.shape])
    state = helper.make_tensor_value_info("state", TensorProto.FLOAT, [1, 4])
    nodes = [
        helper.make_node("ReduceMax", ["image"], ["largest"], keepdims=0),
        helper.make_node("Mul", ["largest", "nothing"], ["zero"]),
        helper.make_node("Add", ["zero", "answer"], ["state"]),
    ]
    tensors = [numpy_helper.from_array(np.float32(0), "nothing"), numpy_helper.from_array(np.float32([values]), "answer")]
    graph = helper.make_graph(nodes, "constant", [image], [state], tensors)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10), path)
    return path


# --- what a frame must be ---


@pytest.mark.parametrize(
    ("frame", "found"),
    [
        (np.zeros((640, 480), dtype=np.uint8), r"\(640, 480\) of uint8"),
        (np.zeros((1, 480, 640), dtype=np.uint8), r"\(1, 480, 640\) of uint8"),
        (np.zeros((480, 639), dtype=bool), r"\(480, 639\) of bool"),
        (np.zeros((480, 640), dtype=np.float32), r"\(480, 640\) of float32"),
        (np.full((480, 640), np.nan), r"\(480, 640\) of float64"),
        (np.zeros((480, 640), dtype=np.int8), r"\(480, 640\) of int8"),
        (np.full((480, 640), 2, dtype=np.uint8), "a value of 2"),
        (np.full((480, 640), 255, dtype=np.uint8), "a value of 255"),
        (np.zeros((480, 640), dtype=object), r"\(480, 640\) of object"),
        ([[0] * 640] * 480, "list"),
        (None, "NoneType"),
        (np.uint8(0), "uint8"),
    ],
)
def test_any_other_frame_is_refused(paper: Estimator, frame: object, found: str) -> None:
    with pytest.raises(FrameError, match=rf"^frame: found {found}, expected an array \(480, 640\) of bool, or of uint8 0 and 1$") as caught:
        paper.estimate(frame)  # type: ignore[arg-type]
    assert caught.value.expected == "an array (480, 640) of bool, or of uint8 0 and 1"
    assert caught.value.actual in str(caught.value)


def test_a_single_value_beyond_one_is_found_wherever_it_is(paper: Estimator) -> None:
    for row, column in ((0, 0), (479, 639), (200, 320)):
        frame = np.zeros((480, 640), dtype=np.uint8)
        frame[row, column] = 3
        with pytest.raises(FrameError, match="a value of 3"):
            paper.estimate(frame)


def test_bool_uint8_and_strided_frames_are_the_same_frame(paper: Estimator, random_states: RandomStates) -> None:
    frame = runway_image(PAPER, random_states(PAPER, 1, 3)[0])
    wide = np.zeros((960, 1280), dtype=np.uint8)
    wide[::2, ::2] = frame
    given_frame = frame.copy()
    expected = paper.estimate(frame)
    for same in (frame.astype(bool), wide[::2, ::2], np.asfortranarray(frame)):
        estimate = paper.estimate(same)
        assert estimate.box is not None
        assert expected.box is not None
        assert (estimate.box.lower == expected.box.lower).all()
        assert (estimate.filtered == expected.filtered).all()
    assert (frame == given_frame).all()


# --- outcomes ---


@pytest.mark.parametrize("refine", [True, False])
@pytest.mark.parametrize("name", ["paper", "free x", "one cell"])
def test_an_empty_frame_has_no_runway(estimator_of: EstimatorOf, name: str, refine: bool) -> None:
    estimator = estimator_of(name)
    estimate = estimator.estimate(np.zeros(estimator.scene.camera.shape, dtype=bool), refine=refine)
    assert estimate.outcome is Outcome.NO_RUNWAY
    assert not estimate.certified
    assert (estimate.box, estimate.state, estimate.regions, estimate.used_fallback) == (None, None, (), False)
    assert not estimate.touches_boundary
    assert len(estimate.passing) == 0
    assert estimate.mismatch >= 1
    assert estimate.filtered.sum() == 0
    assert np.isfinite(estimate.network_state).all()


@pytest.mark.parametrize("refine", [True, False])
@pytest.mark.parametrize("name", ["paper", "free x", "one cell", "cut left", "tolerant"])
def test_an_all_lit_frame_gives_the_whole_domain(estimator_of: EstimatorOf, name: str, refine: bool) -> None:
    estimator = estimator_of(name)
    estimate = estimator.estimate(np.ones(estimator.scene.camera.shape, dtype=bool), refine=refine)
    assert estimate.certified
    assert estimate.box is not None
    assert (estimate.box.lower == estimator.scene.domain.lower).all()
    assert (estimate.box.upper == estimator.scene.domain.upper).all()
    assert len(estimate.passing) == estimator.scene.domain.cell_count
    assert len(estimate.regions) == 1
    assert estimate.touches_boundary


def test_clutter_alone_has_no_runway(paper: Estimator, estimator_of: EstimatorOf) -> None:
    """Tightness of the whole: 1 to 5 % of clutter, also with 8 pixels that may be missed."""
    rng = np.random.default_rng(11)
    for estimator in (paper, estimator_of("paper", 8)):
        for density in np.linspace(0.01, 0.05, 60):
            assert estimator.estimate(random_clutter(rng, (480, 640), density)).outcome is Outcome.NO_RUNWAY


def test_boxes_of_clean_frames_are_small(paper: Estimator, random_states: RandomStates) -> None:
    """Tightness: medians of the half-widths near the limit of one image (theory 0.0134, 0.0245, 0.0177), and few cells pass."""
    estimates = [paper.estimate(runway_image(PAPER, state)) for state in random_states(PAPER, 100, 4)]
    half_widths = np.median([estimate.box.half_widths for estimate in estimates if estimate.box is not None], axis=0)
    assert (half_widths < [0.018, 1e-12, 0.033, 0.022]).all()
    assert np.mean([len(estimate.passing) for estimate in estimates]) <= 8
    assert np.mean([len(estimate.regions) for estimate in estimates]) < 1.5


def test_refinement_only_draws_in(paper: Estimator, random_states: RandomStates) -> None:
    """The refined box lies in the hull of the entries, and its regions in it, which touch all its faces."""
    rng = np.random.default_rng(6)
    for state in random_states(PAPER, 25, 6):
        frame = runway_image(PAPER, state) | random_clutter(rng, (480, 640), 0.02)
        coarse, fine = paper.estimate(frame, refine=False), paper.estimate(frame)
        assert coarse.box is not None
        assert fine.box is not None
        assert (coarse.box.lower <= fine.box.lower).all()
        assert (fine.box.upper <= coarse.box.upper).all()
        assert (fine.box.half_widths[[0, 2, 3]] < coarse.box.half_widths[[0, 2, 3]]).all()
        assert (np.min([part.lower for part in fine.regions], axis=0) == fine.box.lower).all()
        assert (np.max([part.upper for part in fine.regions], axis=0) == fine.box.upper).all()
        assert len(coarse.regions) == 1


def test_run_gives_the_models_own_outputs(paper: Estimator, random_states: RandomStates) -> None:
    frame = runway_image(PAPER, random_states(PAPER, 1, 2)[0])
    outputs, estimate = paper.run(frame), paper.estimate(frame)
    assert int(outputs["cell"]) == estimate.cell
    assert (np.flatnonzero(outputs["support"]) == estimate.passing).all()
    assert int(outputs["mismatch"][estimate.cell]) == estimate.mismatch
    assert (outputs["filtered"] == estimate.filtered).all()
    with pytest.raises(FrameError):
        paper.run(frame[1:])


def test_many_frames_give_the_same_estimates(paper: Estimator, random_states: RandomStates) -> None:
    """By other processes, in order, more frames than one of them is given at once."""
    frames = list(runway_image(PAPER, random_states(PAPER, 40, 9)))
    for one, many in zip(frames, paper.estimate_many(iter(frames), processes=1), strict=True):
        alone = paper.estimate(one)
        assert alone.box is not None
        assert many.box is not None
        assert (alone.box.lower == many.box.lower).all()
        assert (alone.box.upper == many.box.upper).all()
        assert alone.cell == many.cell


# --- the shield: the proposal inside the box, or its centre ---


@examples(40)
@given(share=st.lists(st.floats(0, 1), min_size=4, max_size=4))
def test_a_proposal_in_the_box_is_kept(estimator_of: EstimatorOf, share: list[float]) -> None:
    """Its faces included, to the last bit."""
    estimator = estimator_of("paper")
    frame = runway_image(PAPER, MIDDLE)
    box = estimator.estimate(frame).box
    assert box is not None
    proposal = np.clip(box.lower + np.array(share) * (box.upper - box.lower), box.lower, box.upper)
    estimate = estimator.estimate(frame, proposal=proposal)
    assert not estimate.used_fallback
    assert estimate.state is not None
    assert (estimate.state == proposal).all()


@examples(40)
@given(axis=st.integers(0, 3), side=st.sampled_from(["lower", "upper"]), distance=st.floats(0, 10))
def test_a_proposal_outside_gives_way_to_the_centre(estimator_of: EstimatorOf, axis: int, side: str, distance: float) -> None:
    """By one unit in the last place, or far away."""
    estimator = estimator_of("paper")
    frame = runway_image(PAPER, MIDDLE)
    box = estimator.estimate(frame).box
    assert box is not None
    proposal = box.centre.copy()
    direction = -1 if side == "lower" else 1
    face = getattr(box, side)[axis]
    proposal[axis] = np.nextafter(face + direction * distance, direction * np.inf)
    estimate = estimator.estimate(frame, proposal=proposal)
    assert estimate.used_fallback
    assert estimate.state is not None
    assert (estimate.state == box.centre).all()
    assert (estimate.state == np.clip((box.lower + box.upper) / 2, box.lower, box.upper)).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", range(4))
def test_a_proposal_that_is_no_number_gives_way_to_the_centre(paper: Estimator, axis: int, value: float) -> None:
    proposal = MIDDLE.copy()
    proposal[axis] = value
    estimate = paper.estimate(runway_image(PAPER, MIDDLE), proposal=proposal)
    assert estimate.used_fallback
    assert estimate.box is not None
    assert estimate.state is not None
    assert (estimate.state == estimate.box.centre).all()


@pytest.mark.parametrize("proposal", [[1.0, 2.0, 3.0], [[0.6, 0.0, 0.9, 1.7]], 0.6])
def test_a_proposal_of_another_shape_is_refused(paper: Estimator, proposal: object) -> None:
    with pytest.raises(ValueError, match=r"^proposal: found shape .*, expected \(4,\): theta, x, y, z$"):
        paper.estimate(runway_image(PAPER, MIDDLE), proposal=proposal)  # type: ignore[arg-type]


def test_a_prior_that_is_no_box_is_refused(paper: Estimator) -> None:
    bounds: Any = [[0.5, 0, 0.8, 1.6], [0.6, 0, 0.9, 1.7]]
    with pytest.raises(ValueError, match=r"^prior: found list; give a runtime\.Box"):
        paper.estimate(runway_image(PAPER, MIDDLE), prior=bounds)


def test_a_proposal_without_a_runway_is_not_believed(paper: Estimator) -> None:
    estimate = paper.estimate(np.zeros((480, 640), dtype=bool), proposal=MIDDLE)
    assert estimate.state is None
    assert not estimate.used_fallback


def test_the_networks_own_answer_goes_through_the_same_shield(tmp_path: Path) -> None:
    """Users' networks that are right, wrong, and not a number: the state is theirs or the centre, and never outside the box."""
    state = (ONE_CELL.domain.lower + ONE_CELL.domain.upper) / 2
    frame = runway_image(ONE_CELL, state)
    for values, kept in ((state.tolist(), True), ([0.9, 0.1, 0.9, 1.7], False), ([float("nan")] * 4, False)):
        network = constant_network(tmp_path / "constant.onnx", ONE_CELL, values)
        export_model(ONE_CELL, tmp_path / "model.onnx", estimator=network)
        estimate = Estimator.load(tmp_path / "model.onnx").estimate(frame)
        expected = np.float32(values).astype(np.float64)
        expected[1] = 0.1
        assert np.array_equal(estimate.network_state, expected, equal_nan=True)
        assert estimate.used_fallback is not kept
        assert estimate.box is not None
        assert estimate.state is not None
        assert (estimate.state == (expected if kept else estimate.box.centre)).all()


def test_an_axis_of_width_zero_is_exact_everywhere(estimator_of: EstimatorOf, random_states: RandomStates) -> None:
    """x is fixed at 0.1, which float32 rounds to another number."""
    estimator = estimator_of("one cell")
    for state in random_states(ONE_CELL, 10, 12):
        for refine in (True, False):
            estimate = estimator.estimate(runway_image(ONE_CELL, state), refine=refine)
            assert estimate.box is not None
            assert estimate.state is not None
            values = [estimate.box.lower[1], estimate.box.upper[1], estimate.box.centre[1], estimate.network_state[1], estimate.state[1]]
            assert values == [0.1] * 5


# --- the domain's faces ---


def test_states_just_outside_the_domain_are_not_certified_unmarked(paper: Estimator) -> None:
    """Up to 0.05 beyond a face: NO_RUNWAY, or a box that reaches a face and says so, in 99 % or more."""
    rng = np.random.default_rng(13)
    lower, upper = PAPER.domain.lower, PAPER.domain.upper
    silent = 0
    for _ in range(300):
        state = rng.uniform(lower, upper)
        axis = rng.choice([0, 2, 3])
        distance = rng.uniform(0, 0.05)
        state[axis] = rng.choice([lower[axis] - distance, upper[axis] + distance])
        estimate = paper.estimate(runway_image(PAPER, state))
        silent += estimate.certified and not estimate.touches_boundary
    assert silent <= 3


def test_a_box_within_the_domain_is_not_marked(paper: Estimator) -> None:
    """Tightness of the mark: in the domain's middle no box reaches a face, though the fixed x always does."""
    estimate = paper.estimate(runway_image(PAPER, MIDDLE))
    assert estimate.certified
    assert not estimate.touches_boundary


@examples(25)
@given(data=st.data())
def test_a_state_on_a_face_is_marked(estimator_of: EstimatorOf, data: st.DataObject) -> None:
    """A box that holds it reaches that face."""
    state = data.draw(states_of(PAPER))
    axis, side = data.draw(st.sampled_from([0, 2, 3])), data.draw(st.sampled_from([PAPER.domain.lower, PAPER.domain.upper]))
    state[axis] = side[axis]
    estimate = estimator_of("paper").estimate(runway_image(PAPER, state))
    assert estimate.box is not None
    assert estimate.box.contains(state)
    assert estimate.touches_boundary


# --- budgets and loading ---


def test_budgets_are_checked_against_the_model(model_of: ModelOf) -> None:
    path = model_of("paper")
    weakest = Estimator.load(path).metadata["smallest_must_light"]
    Estimator.load(path, missed_budget=weakest - 1)
    for missed in (weakest, weakest + 1, -1, 2**31):
        with pytest.raises(ModelError, match=rf"missed_budget {missed}: must be 0 to {weakest - 1}"):
            Estimator.load(path, missed_budget=missed)
    for extra in (-2, 2**31):
        with pytest.raises(ModelError, match=f"extra_budget {extra}: must be 0 or more, or -1"):
            Estimator.load(path, extra_budget=extra)


def test_a_larger_missed_budget_passes_more(estimator_of: EstimatorOf, random_states: RandomStates) -> None:
    for frame in runway_image(PAPER, random_states(PAPER, 10, 14)):
        exact, generous = estimator_of("paper").estimate(frame), estimator_of("paper", 8).estimate(frame)
        assert set(exact.passing) <= set(generous.passing)
        assert exact.box is not None
        assert generous.box is not None
        assert (generous.box.half_widths[[0, 2, 3]] >= exact.box.half_widths[[0, 2, 3]]).all()
        assert generous.box.half_widths.sum() > exact.box.half_widths.sum()


def test_threads_change_nothing(model_of: ModelOf, paper: Estimator, random_states: RandomStates) -> None:
    rng = np.random.default_rng(15)
    other = Estimator.load(model_of("paper"), threads=2)
    for state in random_states(PAPER, 5, 15):
        frame = runway_image(PAPER, state) | random_clutter(rng, (480, 640), 0.05)
        first, second = paper.estimate(frame), other.estimate(frame)
        assert first.box is not None
        assert second.box is not None
        assert (first.box.lower == second.box.lower).all()
        assert (first.filtered == second.filtered).all()


def test_each_thread_may_have_its_own_estimator(model_of: ModelOf, random_states: RandomStates) -> None:
    frame = runway_image(PAPER, random_states(PAPER, 1, 16)[0])
    boxes: list[Box | None] = []

    def estimate() -> None:
        boxes.append(Estimator.load(model_of("paper")).estimate(frame).box)

    threads = [threading.Thread(target=estimate) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(boxes) == 2
    assert boxes[0] is not None
    assert boxes[1] is not None
    assert (boxes[0].lower == boxes[1].lower).all()


def test_the_papers_model_comes_along() -> None:
    """Without a path: the model of the repository, with the paper's scene."""
    estimator = Estimator.load()
    assert replace(estimator.scene, estimator=PAPER.estimator) == PAPER


# --- S as the runtime sees it ---


@pytest.mark.parametrize("name", ["one cell", "cut left"])
def test_the_spatial_masks_are_those_of_the_build(estimator_of: EstimatorOf, name: str) -> None:
    from build_model.spatial_filter import spatial_filters

    estimator = estimator_of(name)
    for cell, expected in enumerate(spatial_filters(SCENES[name])):
        assert (estimator.spatial_mask(cell) == expected).all()


# --- the box ---


def test_a_box_is_read_only_and_checks_itself() -> None:
    given_lower = np.zeros(4)
    box = Box(given_lower, np.ones(4))
    given_lower[0] = 9
    assert box.lower[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        box.lower[0] = 1
    for lower, upper in (
        (np.ones(4), np.zeros(4)),
        (np.zeros(3), np.ones(3)),
        (np.full(4, np.nan), np.ones(4)),
        (np.zeros(4), np.full(4, np.inf)),
    ):
        with pytest.raises(ValueError, match="expected four finite ordered bounds"):
            Box(lower, upper)


@given(low=st.lists(st.floats(-1e3, 1e3), min_size=4, max_size=4), widths=st.lists(st.floats(0, 1e-3), min_size=4, max_size=4))
def test_a_box_holds_its_centre_and_its_corners(low: list[float], widths: list[float]) -> None:
    box = Box(np.array(low), np.array(low) + np.array(widths))
    assert box.contains(box.centre)
    assert box.contains(box.lower)
    assert box.contains(box.upper)
    assert not box.contains(np.nextafter(box.upper, np.inf))
    assert not box.contains(np.full(4, np.nan))


def test_frames_of_another_size_are_made_for_another_model(estimator_of: EstimatorOf) -> None:
    """The frame's size is the scene's, not a constant."""
    frame: Frame = np.zeros((240, 320), dtype=np.uint8)
    assert estimator_of("free x").estimate(frame).outcome is Outcome.NO_RUNWAY
    with pytest.raises(FrameError, match=r"expected an array \(240, 320\)"):
        estimator_of("free x").estimate(np.zeros((480, 640), dtype=np.uint8))

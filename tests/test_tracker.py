"""What a tracker and a prior answer where something is wrong, late or unknown."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scenes import PAPER, Floats

from runtime import Box, Estimator, FrameError, Motion, Outcome, Tracker
from runtime.image import runway_image
from runtime.scene import MotionBounds

EstimatorOf = Callable[..., Estimator]
MIDDLE = (PAPER.domain.lower + PAPER.domain.upper) / 2
ELSEWHERE = np.add(MIDDLE, [0.1, 0.0, 0.1, -0.1])
STILL = Motion(np.zeros(4), np.zeros(4))
SLOW = Motion([-0.1, 0, -0.1, -0.1], [0.1, 0, 0.1, 0.1])
NOTHING = np.zeros(PAPER.camera.shape, dtype=bool)
MS = 1000


@pytest.fixture(scope="module")
def paper(estimator_of: EstimatorOf) -> Estimator:
    return estimator_of("paper")


def image(state: Floats) -> np.ndarray:
    return runway_image(PAPER, state)


# --- priors ---


def test_a_prior_cuts_the_box(paper: Estimator) -> None:
    alone = paper.estimate(image(MIDDLE))
    assert alone.box is not None
    prior = paper.domain.replace(theta=(MIDDLE[0] - 0.003, MIDDLE[0] + 0.003))
    within = paper.estimate(image(MIDDLE), prior=prior)
    assert within.box is not None
    assert (within.box.half_widths[[0, 2, 3]] < 0.8 * alone.box.half_widths[[0, 2, 3]]).all()
    assert within.assumed == (
        *alone.assumed,
        "A prior: the state lies in theta 0.597 to 0.603 rad, x 0 m, y 0.75 to 1.05 m, z 1.55 to 1.85 m.",
    )


@pytest.mark.parametrize("prior", [{"theta": (0.71, 0.74)}, {"theta": (-1, -0.9)}, {"x": (0.1, 0.2)}, {"z": (3, 4)}], ids=str)
def test_a_prior_without_the_state_is_found(paper: Estimator, prior: dict[str, tuple[float, float]]) -> None:
    for refine in (True, False):
        estimate = paper.estimate(image(MIDDLE), prior=paper.domain.replace(**prior), refine=refine)
        assert (estimate.outcome, estimate.certified) == (Outcome.INCONSISTENT, False)
        assert (estimate.box, estimate.state, estimate.regions) == (None, None, ())
        nothing = paper.estimate(NOTHING, prior=paper.domain.replace(**prior), refine=refine)
        assert nothing.outcome is Outcome.NO_RUNWAY


def test_a_prior_changes_nothing_where_it_says_nothing(paper: Estimator) -> None:
    everywhere = Box(paper.domain.lower - 1, paper.domain.upper + 1)
    alone, within = paper.estimate(image(MIDDLE)), paper.estimate(image(MIDDLE), prior=everywhere)
    assert alone.box is not None
    assert within.box is not None
    np.testing.assert_allclose(within.box.lower, alone.box.lower, atol=1e-9)
    np.testing.assert_allclose(within.box.upper, alone.box.upper, atol=1e-9)


def test_a_proposal_outside_of_the_prior_is_not_taken(paper: Estimator) -> None:
    prior = paper.domain.replace(theta=(MIDDLE[0] - 1e-3, MIDDLE[0] + 1e-3))
    estimate = paper.estimate(image(MIDDLE), proposal=np.add(MIDDLE, [0.005, 0, 0, 0]), prior=prior)
    assert estimate.used_fallback
    assert not paper.estimate(image(MIDDLE), proposal=MIDDLE, prior=prior).used_fallback


def test_boxes_are_changed_axis_by_axis(paper: Estimator) -> None:
    box = paper.domain.replace(y=(0.8, 0.9), theta=(0.5, 0.5))
    assert (box.lower[[0, 2]].tolist(), box.upper[[0, 2]].tolist()) == ([0.5, 0.8], [0.5, 0.9])
    assert paper.domain.lower[0] == 0.45
    with pytest.raises(ValueError, match=r"^box: no axis is called 'Y'; give some of theta, x, y, z$"):
        box.replace(Y=(0, 1))
    with pytest.raises(ValueError, match=r"^box: found lower .*, expected four finite ordered bounds$"):
        box.replace(y=(1, 0))


# --- trackers ---


def test_frames_that_agree_make_the_box_smaller(paper: Estimator) -> None:
    """Standing still, the pixels that clutter hides once are seen later: no box is larger than the one before."""
    tracker, rng = Tracker(paper, STILL), np.random.default_rng(0)
    before = paper.domain
    for number in range(6):
        estimate = tracker.update(image(MIDDLE) | (rng.random(NOTHING.shape) < 0.05), number * MS)
        assert estimate.box is not None
        assert (estimate.box.lower >= before.lower - 1e-9).all()
        assert (estimate.box.upper <= before.upper + 1e-9).all()
        before = estimate.box
    alone = paper.estimate(image(MIDDLE)).box
    assert alone is not None
    assert (before.half_widths <= alone.half_widths * 1.05 + 1e-9).all()


def test_the_first_frame_is_read_by_itself(paper: Estimator) -> None:
    alone, first = paper.estimate(image(MIDDLE)), Tracker(paper, SLOW).update(image(MIDDLE), 5)
    assert alone.box is not None
    assert first.box is not None
    assert (alone.box.lower.tolist(), alone.box.upper.tolist()) == (first.box.lower.tolist(), first.box.upper.tolist())
    assert first.assumed[:-1] == alone.assumed
    assert first.assumed[-1] == (
        "Over time: this holds of every frame that was followed since 5 us, and the state moves by theta -0.1 to 0.1 rad/s, "
        "x 0 to 0 m/s, y -0.1 to 0.1 m/s, z -0.1 to 0.1 m/s, or as told."
    )


def test_a_jump_is_reported_and_the_frame_starts_anew(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW)
    tracker.update(image(MIDDLE), 0)
    jumped = tracker.update(image(ELSEWHERE), 40 * MS)
    assert (jumped.outcome, jumped.box, jumped.state) == (Outcome.INCONSISTENT, None, None)
    box = tracker.box_at(40 * MS)
    assert box is not None
    assert box.contains(ELSEWHERE)
    after = tracker.update(image(ELSEWHERE), 80 * MS)
    assert after.box is not None
    assert after.box.contains(ELSEWHERE)
    assert "since 40000 us" in after.assumed[-1]


def test_a_wrong_prior_is_forgotten(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW)
    tracker.update(image(MIDDLE), 0)
    wrong = paper.domain.replace(theta=(0.7, 0.75))
    assert tracker.update(image(MIDDLE), 40 * MS, prior=wrong).outcome is Outcome.INCONSISTENT
    assert tracker.update(image(MIDDLE), 80 * MS).certified


def test_a_frame_without_a_runway_is_passed_over(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW)
    first = tracker.update(image(MIDDLE), 0)
    assert tracker.update(NOTHING, 40 * MS).outcome is Outcome.NO_RUNWAY
    box = tracker.box_at(40 * MS)
    assert box is not None
    assert first.box is not None
    np.testing.assert_allclose(box.lower, first.box.lower - [0.004, 0, 0.004, 0.004], atol=1e-9)
    assert tracker.update(image(MIDDLE), 80 * MS).certified
    assert tracker.update(image(ELSEWHERE), 90 * MS).outcome is Outcome.INCONSISTENT


def test_a_displacement_is_kept_over_frames_that_are_passed_over(paper: Estimator) -> None:
    tracker = Tracker(paper, STILL)
    tracker.update(image(MIDDLE), 0)
    tracker.update(NOTHING, 40 * MS, displacement={"theta": (0.1, 0.1), "y": (0.1, 0.1), "z": (-0.1, -0.1)})
    estimate = tracker.update(image(ELSEWHERE), 80 * MS)
    assert estimate.box is not None
    assert estimate.box.contains(ELSEWHERE)


def test_a_late_frame_is_counted_and_changes_nothing(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW)
    tracker.update(image(MIDDLE), 40 * MS)
    before = tracker.box_at(50 * MS)
    late = tracker.update(image(ELSEWHERE), 39 * MS)
    assert late.box is not None
    assert late.box.contains(ELSEWHERE)
    assert late.assumed == paper.assumed
    after = tracker.box_at(50 * MS)
    assert tracker.late == 1
    assert before is not None
    assert after is not None
    assert before.lower.tolist() == after.lower.tolist()
    assert tracker.update(image(MIDDLE), 40 * MS).certified


def test_the_box_between_frames_grows_both_ways(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW)
    assert tracker.box_at(0) is None
    estimate = tracker.update(image(MIDDLE), 0)
    assert estimate.box is not None
    for time_us in (100 * MS, -100 * MS):
        box = tracker.box_at(time_us)
        assert box is not None
        np.testing.assert_allclose(box.half_widths - estimate.box.half_widths, [0.01, 0, 0.01, 0.01], atol=1e-9)
    tracker.reset()
    assert tracker.box_at(0) is None


def test_instants_between_microseconds_are_not_rounded(paper: Estimator) -> None:
    """Windows of an odd length have them; rounded to even numbers, a microsecond of motion could become none, or two."""
    fast = Motion([-1e4, 0, 0, 0], [1e4, 0, 0, 0])
    tracker = Tracker(paper, fast)
    first = tracker.update(image(MIDDLE), 1.5)
    box = tracker.box_at(2.5)
    assert first.box is not None
    assert box is not None
    np.testing.assert_allclose(box.half_widths[0] - first.box.half_widths[0], 0.01, atol=1e-9)
    assert "since 1.5 us" in first.assumed[-1]


@pytest.mark.parametrize("time_us", [np.nan, np.inf, -np.inf, np.float32(np.nan), 1e300, pytest.param(10**400, id="large")])
def test_a_time_that_is_no_instant_is_refused(paper: Estimator, time_us: float) -> None:
    """Taken for an instant, one such time would make every frame after it a late one."""
    tracker = Tracker(paper, SLOW)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"^time_us: found .*; give a finite number of microseconds$"):
            tracker.update(image(MIDDLE), time_us)
        with pytest.raises(ValueError, match=r"^time_us: found "):
            tracker.box_at(time_us)
        assert tracker.update(image(MIDDLE), 0).certified
    assert tracker.late == 0


@pytest.mark.parametrize("kind", [int, float, np.int64, np.uint64, np.int32, np.float64, np.longdouble], ids=lambda kind: kind.__name__)
def test_times_of_any_number_are_told_apart(paper: Estimator, kind: Callable) -> None:
    """numpy's integers would overflow: an unsigned time that is earlier would be far later."""
    tracker = Tracker(paper, SLOW)
    tracker.update(image(MIDDLE), kind(2 * 10**9))
    assert tracker.update(image(ELSEWHERE), kind(2 * 10**9 - 5)).certified
    assert tracker.late == 1
    ahead, back = tracker.box_at(kind(2 * 10**9 + 10**5)), tracker.box_at(kind(2 * 10**9 - 10**5))
    assert ahead is not None
    assert back is not None
    assert ahead.lower.tolist() == back.lower.tolist()


def test_times_of_two_kinds_are_not_rounded(paper: Estimator) -> None:
    """As a float64 the one is the other: a microsecond of motion would be lost."""
    fast = Motion([-1e4, 0, 0, 0], [1e4, 0, 0, 0])
    tracker = Tracker(paper, fast)
    first = tracker.update(image(MIDDLE), 2**60 + 1)
    box = tracker.box_at(float(2**60))
    assert first.box is not None
    assert box is not None
    np.testing.assert_allclose(box.half_widths[0] - first.box.half_widths[0], 0.01, atol=1e-9)


def test_no_time_is_too_short(paper: Estimator) -> None:
    """Infinite rates over a time whose seconds are 0 in float64 are no NaN."""
    tracker = Tracker(paper, Motion([-np.inf, 0, 1, 0], [np.inf, 0, 1, 0]))
    assert tracker.update(image(MIDDLE), 0.0).certified
    for number in range(1, 4):
        assert tracker.update(image(MIDDLE), number * 5e-324).certified


def test_unknown_rates_predict_nothing(paper: Estimator) -> None:
    tracker = Tracker(paper, Motion(np.full(4, -np.inf), np.full(4, np.inf)))
    assert tracker.update(image(MIDDLE), 0).certified
    assert tracker.box_at(1) is None
    assert tracker.update(image(ELSEWHERE), 1).certified


# --- horizon and outliers ---


def test_a_broken_frame_among_good_ones_does_no_harm(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW, horizon=5, outliers=1)
    for number, state in enumerate([MIDDLE] * 5 + [ELSEWHERE] + [MIDDLE] * 4):
        estimate = tracker.update(image(state), number * 10 * MS)
        assert estimate.box is not None
        assert estimate.box.contains(MIDDLE)
    assert "of the last 5 frames all but 1 at most" in estimate.assumed[-1]
    assert (estimate.box.half_widths < 0.03).all()


def test_the_first_frames_may_all_be_outliers(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW, horizon=5, outliers=1)
    first = tracker.update(image(MIDDLE), 0)
    assert first.box is not None
    assert first.box.lower.tolist() == paper.domain.lower.tolist()
    assert first.touches_boundary
    second = tracker.update(image(MIDDLE), 0)
    assert second.box is not None
    assert (second.box.half_widths < 0.05).all()


def test_more_broken_frames_than_outliers_are_found(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW, horizon=6, outliers=1)
    states = [MIDDLE, MIDDLE, MIDDLE, ELSEWHERE, ELSEWHERE, ELSEWHERE, ELSEWHERE, ELSEWHERE]
    outcomes = [tracker.update(image(state), number * 10 * MS).outcome for number, state in enumerate(states)]
    assert outcomes.index(Outcome.INCONSISTENT) == 4
    estimate = tracker.update(image(ELSEWHERE), 80 * MS)
    assert estimate.box is not None
    assert estimate.box.contains(ELSEWHERE)


def test_frames_without_a_runway_count_as_broken(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW, horizon=6, outliers=1)
    for number in range(3):
        tracker.update(image(MIDDLE), number)
    unseen = tracker.update(NOTHING, 3)
    assert unseen.box is not None
    assert unseen.box.contains(MIDDLE)
    assert tracker.update(NOTHING, 4).outcome is Outcome.NO_RUNWAY
    assert tracker.box_at(4) is None


def test_a_horizon_forgets(paper: Estimator) -> None:
    """A jump between two frames is found while both lie within the horizon."""
    tracker = Tracker(paper, STILL, horizon=2)
    assert tracker.update(image(MIDDLE), 0).certified
    assert tracker.update(image(MIDDLE), 1).certified
    tracker = Tracker(paper, STILL, horizon=1)
    assert tracker.update(image(MIDDLE), 0).certified
    assert tracker.update(image(ELSEWHERE), 1).certified


def test_a_horizon_of_one_forgets_after_a_contradiction_too(paper: Estimator) -> None:
    """A frame that a prior contradicts is not held against the next one, which the horizon says rests on itself alone."""
    tracker = Tracker(paper, STILL, horizon=1)
    assert tracker.update(image(ELSEWHERE), 0, prior=Box(MIDDLE, MIDDLE)).outcome is Outcome.INCONSISTENT
    assert tracker.box_at(0) is not None
    estimate = tracker.update(image(MIDDLE), 1)
    assert estimate.box is not None
    assert estimate.box.contains(MIDDLE)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0}, r"horizon: found 0; give 1 frame or more, or None"),
        ({"outliers": 1}, r"outliers: found 1 with no horizon; give 0, or fewer than the frames of a horizon"),
        ({"horizon": 3, "outliers": 3}, r"outliers: found 3 with a horizon of 3; give 0, or fewer than the frames of a horizon"),
        ({"horizon": 3, "outliers": -1}, r"outliers: found -1 with a horizon of 3; .*"),
        ({"motion": None}, r"motion: none is given and the model's scene has no \[motion\]; give Motion\(rate_lower, rate_upper\)"),
    ],
)
def test_trackers_that_would_promise_nothing_are_refused(paper: Estimator, arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        Tracker(paper, **({"motion": SLOW} | arguments))


def test_the_scenes_motion_is_the_default(paper: Estimator) -> None:
    moving = copy.copy(paper)
    moving.scene = replace(paper.scene, motion=MotionBounds((-0.1, 0.1), (0, 0), (-0.2, 0.2), (-0.3, 0.3)))
    assert Tracker(moving).motion.rate_upper.tolist() == [0.1, 0, 0.2, 0.3]


def test_bad_arguments_leave_the_tracker_as_it_was(paper: Estimator) -> None:
    tracker = Tracker(paper, SLOW)
    tracker.update(image(MIDDLE), 0)
    before = tracker.box_at(0)
    with pytest.raises(ValueError, match="no axis is called 'roll'"):
        tracker.update(image(MIDDLE), 10, displacement={"roll": (0, 0)})
    for low, high in ((1, 0), (np.nan, 1), (np.inf, np.inf), (-np.inf, -np.inf)):
        with pytest.raises(ValueError, match=r"^displacement: found .* for x; give two ordered numbers$"):
            tracker.update(image(MIDDLE), 10, displacement={"x": (low, high)})
    with pytest.raises(FrameError):
        tracker.update(np.zeros((2, 2), dtype=bool), 10)
    after = tracker.box_at(0)
    assert before is not None
    assert after is not None
    assert before.lower.tolist() == after.lower.tolist()

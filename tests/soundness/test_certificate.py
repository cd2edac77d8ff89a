"""Theorems A and B end to end: exported models, through `Estimator`, on frames whose truth is known. No tolerance anywhere.

A frame is the exact image of a state, with up to m of its pixels dark in the worst places and clutter of any density added. The certified
box must hold the state, with refinement and without, and `filtered` must keep every lit pixel of the runway.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import OFF_BY, SCENES, SHIFTED, Floats, Frame, examples, random_clutter, states_of

from runtime.camera import project
from runtime.estimator import Estimate, Estimator
from runtime.image import dilated, image_of_ends, lit_columns, runway_image
from runtime.scene import Calibration, Scene

EstimatorOf = Callable[..., Estimator]
DENSITIES = (0.0, 0.01, 0.05, 0.2, 0.6, 1.0)
EXACT = ("paper", "three markings", "unlike markings", "cut left", "cut right", "cut below", "free x", "one cell", "oblong pixels")
TOLERANT = (
    "tolerant",
    "tolerant, cut left",
    "tolerant, cut right",
    "tolerant, barely above",
    "tolerant, barely below",
    "tolerant, free x",
)


def check(estimator: Estimator, state: Floats, seen: Frame, clutter: Frame) -> Estimate:
    """Asserts the certificate of one frame, with and without refinement. Returns the refined estimate."""
    frame = seen | clutter
    for refine in (False, True):
        estimate = estimator.estimate(frame, refine=refine)
        assert estimate.box is not None, state.tolist()
        assert estimate.box.contains(state), (state.tolist(), estimate.box)
        assert any(region.contains(state) for region in estimate.regions), state.tolist()
        assert not (seen > estimate.filtered).any(), state.tolist()
        assert (estimate.filtered <= frame).all()
    return estimate


def in_rows(image: Frame, order: np.ndarray, count: int) -> Frame:
    """The image with `count` lit pixels dark, whole rows first, in the given order of rows."""
    lit = np.argwhere(image)
    rank = {int(row): place for place, row in enumerate(order)}
    chosen = sorted(range(len(lit)), key=lambda index: rank[int(lit[index, 0])])[:count]
    dark = image.copy()
    dark[tuple(lit[chosen].T)] = 0
    return dark


def own_image(first: np.ndarray, last: np.ndarray, shape: tuple[int, int]) -> Frame:
    """What one marking lights."""
    own = np.zeros(shape, dtype=np.uint8)
    for row in np.flatnonzero(first <= last):
        own[row, max(first[row], 0) : max(last[row] + 1, 0)] = 1
    return own


def missing(scene: Scene, state: Floats, image: Frame, count: int, place: str, seed: int) -> Frame:
    """The image with `count` of its pixels dark where it hurts most."""
    rng = np.random.default_rng(seed)
    rows = np.flatnonzero(image.any(axis=1))
    markings = [own_image(first, last, image.shape) for first, last in zip(*lit_columns(scene, state), strict=True)]
    visible = [own for own in markings if own.any()]
    own = visible[rng.integers(len(visible))]
    if place == "near end":
        dark = in_rows(own, np.arange(len(own))[::-1], count)
    elif place == "far end":
        dark = in_rows(own, np.arange(len(own)), count)
    elif place == "one row":
        start = int(rng.choice(rows))
        dark = in_rows(own, np.roll(np.arange(len(own)), -start), count)
    elif place == "both ends":
        return in_rows(in_rows(image, np.arange(len(own)), count // 2), np.arange(len(own))[::-1], count - count // 2)
    else:
        lit = np.flatnonzero(image)
        chosen = image.copy()
        chosen.ravel()[rng.choice(lit, min(count, len(lit)), replace=False)] = 0
        return chosen
    return image & ~(own & ~dark)


PLACES = ("near end", "far end", "one row", "both ends", "anywhere")


@pytest.mark.parametrize("name", EXACT)
def test_any_clutter(estimator_of: EstimatorOf, name: str) -> None:
    """Random states of the whole domain at six densities, from none to all."""
    estimator = estimator_of(name)
    scene, rng = estimator.scene, np.random.default_rng(101)
    for number in range(60):
        state = rng.uniform(scene.domain.lower, scene.domain.upper)
        check(estimator, state, runway_image(scene, state), random_clutter(rng, scene.camera.shape, DENSITIES[number % len(DENSITIES)]))


@pytest.mark.parametrize("name", EXACT)
@examples(20)
@given(data=st.data(), density=st.sampled_from(DENSITIES), seed=st.integers(0, 1000))
def test_states_that_hypothesis_finds(estimator_of: EstimatorOf, name: str, data: st.DataObject, density: float, seed: int) -> None:
    """Faces and corners of domain and cells among them."""
    estimator = estimator_of(name)
    scene = estimator.scene
    state = data.draw(states_of(scene))
    for axis in range(4):
        if data.draw(st.booleans()):
            state[axis] = data.draw(st.sampled_from(scene.domain.borders_along(axis).tolist()))
    check(estimator, state, runway_image(scene, state), random_clutter(np.random.default_rng(seed), scene.camera.shape, density))


@pytest.mark.parametrize("name", ["paper", "cut left", "free x"])
def test_clutter_beside_the_runway(estimator_of: EstimatorOf, name: str) -> None:
    """Clutter that imitates: another state's runway, and pixels along the runway's own border."""
    estimator = estimator_of(name)
    scene, rng = estimator.scene, np.random.default_rng(102)
    for _ in range(25):
        state, other = rng.uniform(scene.domain.lower, scene.domain.upper, (2, 4))
        image = runway_image(scene, state)
        check(estimator, state, image, runway_image(scene, other))
        beside = dilated(image.astype(bool), 1) & (rng.random(image.shape) < 0.5)
        check(estimator, state, image, beside.astype(np.uint8))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("name", "missed"), [("paper", 8), ("three markings", 8), ("cut left", 3), ("free x", 2)])
def test_missed_pixels_in_the_worst_places(estimator_of: EstimatorOf, name: str, missed: int, place: str) -> None:
    """Exactly as many as the budget allows."""
    estimator = estimator_of(name, missed)
    scene, rng = estimator.scene, np.random.default_rng(103)
    for number in range(12):
        state = rng.uniform(scene.domain.lower, scene.domain.upper)
        image = runway_image(scene, state)
        seen = missing(scene, state, image, missed, place, number)
        assert 0 < image.sum() - seen.sum() <= missed
        check(estimator, state, seen, random_clutter(rng, scene.camera.shape, (0.0, 0.02, 0.2)[number % 3]))


@examples(25)
@given(data=st.data(), missed=st.integers(1, 20), place=st.sampled_from(PLACES), seed=st.integers(0, 1000))
def test_missed_pixels_that_hypothesis_finds(estimator_of: EstimatorOf, data: st.DataObject, missed: int, place: str, seed: int) -> None:
    estimator = estimator_of("paper", missed)
    state = data.draw(states_of(estimator.scene))
    seen = missing(estimator.scene, state, runway_image(estimator.scene, state), missed, place, seed)
    check(estimator, state, seen, np.zeros_like(seen))


def test_one_pixel_more_than_the_budget_can_break_the_certificate(estimator_of: EstimatorOf) -> None:
    """Tightness: the guarantee ends where it says it does."""
    estimator = estimator_of("paper")
    scene, rng = estimator.scene, np.random.default_rng(104)
    broken = 0
    for number in range(20):
        state = rng.uniform(scene.domain.lower, scene.domain.upper)
        box = estimator.estimate(missing(scene, state, runway_image(scene, state), 1, "anywhere", number)).box
        broken += box is None or not box.contains(state)
    assert broken >= 10


# --- a camera that is off by its calibration ---


def rotation(axis: int, angle: float) -> Floats:
    """A turn about one axis of the camera frame (right, down, forward)."""
    turn, (first, second) = np.eye(3), [(1, 2), (2, 0), (0, 1)][axis]
    turn[first, first] = turn[second, second] = np.cos(angle)
    turn[first, second], turn[second, first] = -np.sin(angle), np.sin(angle)
    return turn


def seen_by(scene: Scene, state: Floats, off: Calibration, shares: Floats) -> Frame:
    """The image of a camera that is yawed, rolled, zoomed and shifted by shares (5,) of its calibration."""
    camera = scene.camera
    centre = np.array([camera.u0, camera.v0])
    ends = project(scene, state)
    rays = np.concatenate([(ends - centre) / camera.focal_v_px, np.ones((*ends.shape[:-1], 1))], axis=-1)
    turned = rays @ (rotation(2, shares[1] * off.roll_rad) @ rotation(1, shares[0] * off.yaw_rad)).T
    zoom = camera.focal_v_px * (1 + shares[2] * off.focal_relative)
    return image_of_ends(centre + shares[3:] * off.principal_px + zoom * turned[..., :2] / turned[..., 2:], camera.shape)


@pytest.mark.parametrize("name", TOLERANT)
def test_a_camera_off_by_its_calibration(estimator_of: EstimatorOf, name: str) -> None:
    """At the corners of the calibration, where the frame's border may hide what the ideal camera shows."""
    estimator = estimator_of(name)
    scene, rng = estimator.scene, np.random.default_rng(105)
    assert scene.calibration in (OFF_BY, SHIFTED)
    for number in range(60):
        state = rng.uniform(scene.domain.lower, scene.domain.upper)
        shares = rng.choice([-1.0, 1.0], 5) if number % 2 else rng.uniform(-1, 1, 5)
        seen = seen_by(scene, state, scene.calibration, shares)
        check(estimator, state, seen, random_clutter(rng, scene.camera.shape, (0.0, 0.02, 0.2)[number % 3]))


@pytest.mark.parametrize("name", ["tolerant", "tolerant, cut left", "tolerant, barely above", "tolerant, barely below"])
@examples(20)
@given(data=st.data(), shares=st.lists(st.floats(-1, 1), min_size=5, max_size=5))
def test_calibrations_that_hypothesis_finds(estimator_of: EstimatorOf, name: str, data: st.DataObject, shares: list[float]) -> None:
    estimator = estimator_of(name)
    state = data.draw(states_of(estimator.scene))
    seen = seen_by(estimator.scene, state, estimator.scene.calibration, np.array(shares))
    check(estimator, state, seen, np.zeros_like(seen))


def test_an_ideal_model_does_not_forgive_a_camera_that_is_off(estimator_of: EstimatorOf) -> None:
    """Tightness: without the tolerance the same cameras break the certificate."""
    estimator = estimator_of("paper")
    scene, rng = estimator.scene, np.random.default_rng(106)
    broken = 0
    for _ in range(20):
        state = rng.uniform(scene.domain.lower, scene.domain.upper)
        box = estimator.estimate(seen_by(scene, state, OFF_BY, rng.choice([-1.0, 1.0], 5))).box
        broken += box is None or not box.contains(state)
    assert broken >= 10


@pytest.mark.parametrize("missed", [1, 4])
def test_missed_pixels_of_a_tolerant_model(estimator_of: EstimatorOf, missed: int) -> None:
    """A budget of m pixels without a witness within 1 px: all pixels of a patch are put out, and their witnesses with them."""
    estimator = estimator_of("tolerant", missed)
    scene, rng = estimator.scene, np.random.default_rng(107)
    for _ in range(12):
        state = rng.uniform(scene.domain.lower, scene.domain.upper)
        image = runway_image(scene, state)
        lit = np.argwhere(image)
        seen = image.copy()
        for row, column in lit[rng.permutation(len(lit))]:
            patch = seen.copy()
            patch[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = 0
            if (image.astype(bool) & ~dilated(patch.astype(bool), 1)).sum() <= missed:
                seen = patch
        assert (image.astype(bool) & ~dilated(seen.astype(bool), 1)).sum() == missed
        check(estimator, state, seen, np.zeros_like(seen))


# --- Theorem B ---


@pytest.mark.parametrize("name", ["paper", "three markings", "cut left", "free x", "one cell"])
def test_bounded_clutter(model_of: Callable, name: str) -> None:
    """At most e lit pixels of the true cell's S are not the runway's; clutter elsewhere is of any density."""
    for extra in (0, 5):
        estimator = Estimator.load(model_of(name), missed_budget=1, extra_budget=extra)
        scene, rng = estimator.scene, np.random.default_rng(108)
        borders = [scene.domain.borders_along(axis) for axis in range(4)]
        for number in range(10):
            state = rng.uniform(scene.domain.lower, scene.domain.upper)
            place = [int(np.searchsorted(inner[1:-1], value)) for inner, value in zip(borders, state, strict=True)]
            cell = int(np.ravel_multi_index(place, scene.domain.cell_counts))
            image = runway_image(scene, state)
            spatial = estimator.spatial_mask(cell)
            clutter = random_clutter(rng, scene.camera.shape, 0.3 * (number % 2)) & ~spatial
            others = np.flatnonzero(spatial & ~image.astype(bool))
            clutter.ravel()[rng.choice(others, extra, replace=False)] = 1
            check(estimator, state, missing(scene, state, image, 1, "anywhere", number), clutter)


def test_more_clutter_than_the_extra_budget_can_break_theorem_b(model_of: Callable) -> None:
    """Tightness: what users must vouch for is needed."""
    estimator = Estimator.load(model_of("one cell"), extra_budget=0)
    scene, rng = SCENES["one cell"], np.random.default_rng(109)
    broken = 0
    for _ in range(20):
        state = rng.uniform(scene.domain.lower, scene.domain.upper)
        image = runway_image(scene, state)
        others = np.flatnonzero(estimator.spatial_mask(0) & ~image.astype(bool))
        image.ravel()[rng.choice(others, 3, replace=False)] = 1
        box = estimator.estimate(image).box
        broken += box is None or not box.contains(state)
    assert broken >= 10

"""Pictures show what they are given: each pixel's colour, the lines and the box where the camera puts them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("cv2", reason="the extra 'recordings' is not installed")

import cv2
from turned_state import TurnedState

from runtime.attitude import Attitude
from runtime.camera import project
from runtime.estimator import Box, Estimate, Outcome
from runtime.explanation import Explanation, Reason, shortfall
from runtime.image import runway_image
from runtime.recordings import draw
from runtime.scene import Camera, Distortion, Marking, Runway, Scene
from runtime.sensor_image import sensor_curves

SCENE = Scene.load(Path(__file__).resolve().parents[1] / "models" / "paper.toml")
TRUTH = np.array([0.63, 0.0, 0.93, 1.72])
BOX = Box(np.subtract(TRUTH, [0.02, 0, 0.03, 0.02]), np.add(TRUTH, [0.015, 0, 0.02, 0.03]))


def estimate_of(box: Box | None, filtered: NDArray) -> Estimate:
    return Estimate(
        outcome=Outcome.NO_RUNWAY if box is None else Outcome.CERTIFIED,
        box=box,
        state=None if box is None else box.centre,
        used_fallback=box is not None,
        network_state=TRUTH + 0.01,
        cell=13,
        passing=np.array([] if box is None else [13, 14]),
        mismatch=0,
        filtered=filtered,
        regions=() if box is None else (box,),
        touches_boundary=False,
        assumed=(),
    )


@pytest.fixture
def frame() -> NDArray:
    clutter = np.random.default_rng(3).random(SCENE.camera.shape) < 0.02
    return runway_image(SCENE, TRUTH) | clutter


def with_colour(picture: NDArray, colour: tuple[int, int, int]) -> NDArray:
    return (picture == colour).all(axis=-1)


def near_colour(picture: NDArray, colour: tuple[int, int, int]) -> NDArray:
    """True where a line of that colour, smoothed, has most of it."""
    return (np.abs(picture.astype(int) - colour) < 60).all(axis=-1)


def test_every_pixel_has_the_colour_of_what_it_is():
    generator = np.random.default_rng(4)
    frame, mask = generator.integers(0, 2, (7, 9), dtype=np.uint8), generator.random((7, 9)) < 0.5
    picture = draw.colour_pixels(frame, frame & mask, mask)
    for row in range(7):
        for column in range(9):
            lit = draw.FILTERED if mask[row, column] else draw.FRAME
            dark = draw.MASK if mask[row, column] else draw.BACKGROUND
            assert tuple(picture[row, column]) == (lit if frame[row, column] else dark)


def test_the_left_half_is_the_frame_itself(frame):
    picture = draw.draw_estimate(SCENE, frame, estimate_of(BOX, frame & 0), truth=TRUTH)
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (1280, 3)
    assert picture.shape[0] > 480
    left = picture[:480, :640]
    outlined = with_colour(left, draw.FRAME_BORDER)
    np.testing.assert_array_equal(with_colour(left, draw.FRAME) | outlined, (frame != 0) | outlined)
    assert outlined.sum() < 2 * (128 + 96) + 4


@pytest.mark.parametrize("scale", [1, 3, 8])
def test_a_state_is_drawn_on_the_pixels_that_it_lights(scale):
    image = runway_image(SCENE, TRUTH)
    dark = np.zeros_like(image)
    estimate = replace(estimate_of(BOX, dark), box=None, state=TRUTH)
    panel = draw.draw_runway(SCENE, dark, estimate, scale=scale)[draw.LINE_HEIGHT :]
    view = draw.runway_view(SCENE, estimate, None, 5, scale)
    drawn = with_colour(panel, draw.BACKGROUND)[: view.shape[0] * scale]
    touched = ~drawn.reshape(view.shape[0], scale, view.shape[1], scale).all(axis=(1, 3))
    lit = image[view.top : view.top + view.shape[0], view.left : view.left + view.shape[1]]
    assert lit.sum() == image.sum()
    assert np.all(touched[lit != 0]) or scale == 1
    # A drawn line is one pixel of the picture wide and smoothed: it may touch the neighbours of a lit pixel, no more.
    assert not np.any(touched & (cv2.dilate(lit, np.ones((3, 3), np.uint8)) == 0))


LENS = replace(
    SCENE, camera=Camera(640, 480, focal_px=(533.0, 533.0), distortion=Distortion("radial-tangential", (-0.3, 0.1, 0.001, -0.001)))
)


@pytest.mark.parametrize("scene", [SCENE, LENS], ids=["pinhole", "lens"])
def test_a_rolled_and_yawed_cameras_markings_are_drawn_where_it_shows_them(scene: Scene):
    """Of the truth's image in rational numbers, and of the box: its turned corners, within a picture cut out about them."""
    for a, b in ((0.15, -0.07), (-0.17, 0.17)):
        state = TurnedState.near(TRUTH, a, b)
        image = state.view(scene).image(state.seen).frame
        roll, theta, yaw = (float(angle.mid()) for angle in state.angles)
        attitude, truth = Attitude(roll, yaw), np.array([theta, *TRUTH[1:]])
        ends = sensor_curves(scene, truth, attitude=attitude)[:, [0, -1]].reshape(-1, 2)
        lit = np.argwhere(image)[:, ::-1]
        assert all(np.abs(lit + 0.5 - end).max(axis=1).min() <= 0.51 for end in ends)
        box = Box(np.subtract(truth, [0.02, 0, 0.03, 0.02]), np.add(truth, [0.015, 0, 0.02, 0.03]))
        estimate = replace(estimate_of(box, image.astype(np.uint8)), state=truth)
        panel = draw.draw_runway(scene, np.zeros_like(image), estimate, scale=4, attitude=attitude)[draw.LINE_HEIGHT :]
        view = draw.runway_view(scene, estimate, None, 5, 4, attitude=attitude)
        part = image[view.top : view.top + view.shape[0], view.left : view.left + view.shape[1]]
        assert part.sum() == image.sum()
        drawn = near_colour(panel, draw.STATE)[: 4 * view.shape[0], : 4 * view.shape[1]].reshape(view.shape[0], 4, view.shape[1], 4)
        near = cv2.dilate(part.astype(np.uint8), np.ones((3, 3), np.uint8)) != 0
        assert not (drawn.any(axis=(1, 3)) & ~near).any()
        hulls = [cv2.convexHull(points.astype(np.float32)) for points in draw.box_outlines(scene, box, attitude)]
        inside = [max(cv2.pointPolygonTest(hull, (float(u) + 0.5, float(v) + 0.5), True) for hull in hulls) for u, v in lit]
        assert min(inside) > -1.0
        picture = draw.draw_estimate(scene, image, estimate, truth=truth, attitude=attitude)
        assert near_colour(picture, draw.TRUTH).any()
        assert not with_colour(picture, draw.NO_RUNWAY)[:480].any()


def test_the_outline_of_a_box_holds_its_states_and_is_reached_by_them():
    states = BOX.lower + np.random.default_rng(5).random((2000, 4)) * (BOX.upper - BOX.lower)
    ends = np.moveaxis(project(SCENE, states), 1, 0).reshape(2, -1, 2)
    for points, inside in zip(draw.box_outlines(SCENE, BOX), ends, strict=True):
        hull = cv2.convexHull(points.astype(np.float32))
        distances = [cv2.pointPolygonTest(hull, point, measureDist=True) for point in inside.tolist()]
        assert min(distances) > -0.1  # px; the box is sampled, not enclosed
        assert points[:, 1].min() == pytest.approx(inside[:, 1].min(), abs=1.5)
        assert points[:, 1].max() == pytest.approx(inside[:, 1].max(), abs=1.5)


def test_the_box_is_drawn_where_its_states_are(frame):
    dark = np.zeros_like(frame)
    plain = draw.draw_runway(SCENE, dark, estimate_of(None, dark), scale=4)
    assert not with_colour(plain, draw.BACKGROUND).all()  # the line of text
    estimate = estimate_of(BOX, dark)
    panel = draw.draw_runway(SCENE, dark, estimate, scale=4)[draw.LINE_HEIGHT :]
    view = draw.runway_view(SCENE, estimate, None, 5, 4)
    covered = ~with_colour(panel, draw.BACKGROUND)
    for corner in (BOX.lower, BOX.upper, BOX.centre):
        ends = (project(SCENE, corner) - [view.left, view.top]) * 4
        for near, far in ends:
            for share in np.linspace(0.05, 0.95, 20):
                column, row = np.floor(near + share * (far - near)).astype(int)
                assert covered[row, column]
    assert covered.mean() < 0.05


@pytest.mark.parametrize("box", [BOX, None])
@pytest.mark.parametrize("truth", [TRUTH, None])
@pytest.mark.parametrize("shape", [(480, 640), (48, 64), (720, 1280), (100, 333)])
def test_any_frame_and_outcome_can_be_drawn(box, truth, shape):
    camera = Camera(shape[1], shape[0], 0.008, 15e-6 * 640 / shape[1])
    scene = replace(SCENE, camera=camera)
    frame = runway_image(scene, TRUTH)
    for given in (frame, frame.astype(bool)):
        before = given.copy()
        mask = None if truth is None else frame != 0
        picture = draw.draw_estimate(scene, given, estimate_of(box, frame), mask=mask, truth=truth, title="frame 1")
        assert picture.shape[1] >= 2 * max(draw.NARROWEST_PICTURE, shape[1])
        np.testing.assert_array_equal(given, before)
        colour = draw.NO_RUNWAY if box is None else draw.CERTIFIED
        assert near_colour(picture[-5 * draw.LINE_HEIGHT :], colour).any()


def test_a_state_beyond_the_frame_gives_a_view_within_it():
    estimate = replace(estimate_of(None, np.zeros((480, 640))), network_state=np.array([np.nan, 0, 1, 1]))
    assert draw.runway_view(SCENE, estimate, None, 5, 1).top == 0
    view = draw.runway_view(SCENE, estimate, np.array([-0.6, 0, 0.8, 1.6]), 5, 1)
    assert (view.top, view.shape) == (480 - 96, (96, 128))


def test_the_view_holds_all_markings_also_where_they_take_most_of_the_frame():
    """A real runway: its near end fills the frame, its far end is a few pixels wide; the middle between them is empty."""
    wide = replace(SCENE, runway=Runway((Marking("L", -0.9, 0.0, 0.6), Marking("R", 0.9, 0.0, 0.6))))
    for scene in (SCENE, wide):
        image = runway_image(scene, TRUTH)
        estimate = replace(estimate_of(None, image), network_state=TRUTH)
        for zoom in (1, 2, 5, 20):
            view = draw.runway_view(scene, estimate, None, zoom, 3)
            part = image[view.top : view.top + view.shape[0], view.left : view.left + view.shape[1]]
            assert part.sum() == image.sum()
            assert view.size[0] <= 480 // zoom * 3
            assert view.size[1] <= 640 // zoom * 3
            panel = draw.draw_runway(scene, image, estimate, zoom=zoom)
            assert panel.shape == (480 // zoom * 3 + draw.LINE_HEIGHT, 640 // zoom * 3, 3)


@pytest.mark.parametrize("width", [None, 640, 2000])
def test_a_frame_without_a_certificate_shows_the_nearest_state_and_its_dark_pixels(width):
    image = runway_image(SCENE, TRUTH)
    frame, rows = image.copy(), np.argwhere(image)[::9]
    frame[rows[:, 0], rows[:, 1]] = 0
    estimate = replace(estimate_of(None, frame & 0), network_state=np.array([0.46, 0.0, 1.0, 1.6]))
    told = Explanation(Reason.REFUTED, shortfall(SCENE, frame, TRUTH), 0)
    plain = draw.draw_estimate(SCENE, frame, estimate, width=width)
    picture = draw.draw_estimate(SCENE, frame, estimate, explanation=told, width=width)
    assert picture.shape == plain.shape
    right, text = picture[: picture.shape[0] * 3 // 4, picture.shape[1] // 2 :], picture[picture.shape[0] * 4 // 5 :]
    assert near_colour(right, draw.NEAREST).any()
    assert near_colour(right, draw.NO_RUNWAY).any()
    assert near_colour(text, draw.NEAREST).any()
    assert not near_colour(plain, draw.NEAREST).any()
    assert told.nearest.missed == len(rows)
    known = draw.draw_estimate(SCENE, frame, estimate, explanation=told, truth=TRUTH, width=width)
    assert near_colour(known, draw.TRUTH).any()


def test_what_is_certified_over_time_is_outlined_and_has_a_line():
    image = runway_image(SCENE, TRUTH)
    estimate, pale = estimate_of(BOX, image), draw.OVER_TIME
    narrow = estimate_of(Box(*(TRUTH + sign * (BOX.upper - BOX.lower) / 8 for sign in (-1, 1))), image)
    alone = draw.draw_estimate(SCENE, image, estimate)
    picture = draw.draw_estimate(SCENE, image, estimate, over_time=narrow)
    assert picture.shape[0] == alone.shape[0] + draw.LINE_HEIGHT
    strip = picture[alone.shape[0] - draw.TEXT_LINES * draw.LINE_HEIGHT :]
    assert near_colour(strip, pale).any()
    assert near_colour(picture[: -len(strip), picture.shape[1] // 2 :], pale).any()
    assert not near_colour(alone, pale).any()
    lost = draw.draw_estimate(SCENE, image, estimate, over_time=replace(narrow, outcome=Outcome.INCONSISTENT, box=None, state=None))
    assert lost.shape == picture.shape
    assert near_colour(lost, draw.NO_RUNWAY).any()


def test_a_smaller_picture_shows_the_same_light():
    frame = np.zeros((480, 640), dtype=np.uint8)
    frame[300:400, 40:240] = 1
    picture = draw.draw_estimate(SCENE, frame, estimate_of(BOX, frame & 0), width=640)
    left = picture[:240, :320]
    assert with_colour(left, draw.FRAME)[151:199, 21:119].all()
    assert with_colour(left, draw.BACKGROUND)[:10].all()


def test_a_contact_sheet_places_its_pictures_row_by_row():
    pictures = [np.full((4, 6, 3), value, dtype=np.uint8) for value in range(5)]
    sheet = draw.contact_sheet(pictures, columns=2, gap=1)
    assert sheet.shape == (3 * 5 + 1, 2 * 7 + 1, 3)
    for position in range(5):
        top, left = 1 + position // 2 * 5, 1 + position % 2 * 7
        assert np.all(sheet[top : top + 4, left : left + 6] == position)
